//! Keys and what they do, in one table that the window and its help sheet share.

use egui::{Key, KeyboardShortcut, Modifiers};

/// What a key does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Choose frames.
    Open,
    /// Save the session.
    Save,
    /// Open the export window.
    Export,
    /// Copy the command line.
    CopyCommand,
    /// Take an edit back.
    Undo,
    /// Make it again.
    Redo,
    /// Solve now.
    Solve,
    /// Stop solving, or close what is open.
    Cancel,
    /// The whole frame.
    Fit,
    /// A pixel as a pixel.
    Actual,
    /// Closer.
    ZoomIn,
    /// Farther.
    ZoomOut,
    /// With or without divider.
    Divide,
    /// Picture or blur.
    Blur,
    /// The next overlay.
    Overlay,
    /// Mark what the curve clips.
    Extremes,
    /// Half a stop more.
    Brighter,
    /// Half a stop less.
    Darker,
    /// The frame after.
    Next,
    /// The frame before.
    Previous,
    /// Leave the frame out, or take it in again.
    Exclude,
    /// Say that the frame is sharp, or not.
    Sharp,
    /// Light or dark.
    Theme,
    /// The sheet of keys.
    Help,
}

const fn key(modifiers: Modifiers, key: Key) -> KeyboardShortcut {
    KeyboardShortcut::new(modifiers, key)
}

/// Every key with what it does, in the order of the sheet. Longer combinations come before shorter ones of the same key.
pub const KEYS: &[(KeyboardShortcut, Action, &str)] = &[
    (key(Modifiers::COMMAND, Key::O), Action::Open, "Open frames or a session"),
    (key(Modifiers::COMMAND, Key::S), Action::Save, "Save the session"),
    (key(Modifiers::COMMAND, Key::E), Action::Export, "Export"),
    (key(Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::C), Action::CopyCommand, "Copy the command line"),
    (key(Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::Z), Action::Redo, "Make the edit again"),
    (key(Modifiers::COMMAND, Key::Y), Action::Redo, "Make the edit again"),
    (key(Modifiers::COMMAND, Key::Z), Action::Undo, "Take the last edit back"),
    (key(Modifiers::COMMAND, Key::Enter), Action::Solve, "Solve now"),
    (key(Modifiers::NONE, Key::Escape), Action::Cancel, "Stop solving"),
    (key(Modifiers::NONE, Key::F), Action::Fit, "Whole frame"),
    (key(Modifiers::NONE, Key::Num1), Action::Actual, "Actual pixels"),
    (key(Modifiers::NONE, Key::Plus), Action::ZoomIn, "Zoom in"),
    (key(Modifiers::NONE, Key::Minus), Action::ZoomOut, "Zoom out"),
    (key(Modifiers::NONE, Key::D), Action::Divide, "Before/after divider"),
    (key(Modifiers::NONE, Key::B), Action::Blur, "Picture or blur"),
    (key(Modifiers::NONE, Key::O), Action::Overlay, "Next overlay"),
    (key(Modifiers::NONE, Key::C), Action::Extremes, "Mark what the tone curve clips"),
    (key(Modifiers::NONE, Key::CloseBracket), Action::Brighter, "Half a stop brighter"),
    (key(Modifiers::NONE, Key::OpenBracket), Action::Darker, "Half a stop darker"),
    (key(Modifiers::NONE, Key::N), Action::Next, "Next frame"),
    (key(Modifiers::NONE, Key::P), Action::Previous, "Previous frame"),
    (key(Modifiers::NONE, Key::X), Action::Exclude, "Leave the frame out, or take it in"),
    (key(Modifiers::NONE, Key::S), Action::Sharp, "Mark the frame as sharp, or not"),
    (key(Modifiers::NONE, Key::T), Action::Theme, "Light or dark"),
    (key(Modifiers::NONE, Key::F1), Action::Help, "This sheet"),
    (key(Modifiers::NONE, Key::Questionmark), Action::Help, "This sheet"),
];

/// What was asked by key since the last frame. Letters belong to whoever has the focus.
pub fn pressed(ctx: &egui::Context) -> Vec<Action> {
    let typing = ctx.text_edit_focused();
    ctx.input_mut(|i| {
        let hears =
            |k: &&(KeyboardShortcut, Action, &str)| !typing || k.0.modifiers.command || k.1 == Action::Help && k.0.logical_key == Key::F1;
        KEYS.iter().filter(hears).filter(|k| i.consume_shortcut(&k.0)).map(|k| k.1).collect()
    })
}

/// How the key of an action is written on this system.
pub fn name(ctx: &egui::Context, action: Action) -> String {
    KEYS.iter().find(|k| k.1 == action).map(|k| written(ctx, &k.0)).unwrap_or_default()
}

/// A key as it stands on a keyboard.
fn written(ctx: &egui::Context, key: &KeyboardShortcut) -> String {
    let mut text = ctx.format_shortcut(key);
    for (name, sign) in [("Plus", "+"), ("Minus", "-"), ("CloseBracket", "]"), ("OpenBracket", "["), ("Questionmark", "?")] {
        text = text.replace(name, sign);
    }
    text
}

/// The help sheet.
pub fn sheet(ctx: &egui::Context, open: &mut bool) {
    egui::Window::new("Keyboard shortcuts")
        .open(open)
        .resizable(false)
        .collapsible(false)
        .anchor(egui::Align2::CENTER_CENTER, [0.0, 0.0])
        .show(ctx, |ui| {
            egui::Grid::new("keys").num_columns(2).spacing([24.0, 4.0]).striped(true).show(ui, |ui| {
                for (key, _, text) in KEYS {
                    ui.monospace(written(ctx, key));
                    ui.label(*text);
                    ui.end_row();
                }
                for (what, text) in [
                    ("Wheel, pinch", "Zoom"),
                    ("Drag", "Pan; in the blur view, move a patch"),
                    ("Double click", "Actual pixels, or the whole frame"),
                    ("Click", "In the blur view, add a patch"),
                    ("Right click", "In the blur view, remove a patch"),
                ] {
                    ui.monospace(what);
                    ui.label(text);
                    ui.end_row();
                }
            });
        });
}
