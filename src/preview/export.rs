//! Files in and out: dialogs, and the window for exports.

use super::state::{ExportForm, State};
use super::worker::{Chosen, News};
use crate::io::output;
use egui::RichText;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Endings of files that can be frames.
const FRAMES: [&str; 20] = [
    "jpg", "jpeg", "png", "tif", "tiff", "exr", "hdr", "dng", "cr2", "cr3", "nef", "arw", "raf", "orf", "rw2", "pef", "srw", "JPG", "NEF",
    "CR2",
];

/// Lets the user choose frames, or a session, to open or (`add`) to add.
pub fn choose_frames(state: &State, add: bool) {
    state.workers.beside(move |tell| {
        let dialog = rfd::FileDialog::new()
            .set_title("Frames of one bracket, or a session")
            .add_filter("Frames and sessions", &[&FRAMES[..], &["json"]].concat())
            .add_filter("All files", &["*"]);
        if let Some(files) = dialog.pick_files() {
            tell(News::Chosen(if add { Chosen::Add(files) } else { Chosen::Open(files) }));
        }
    });
}

/// Saves the session where it was saved before, or asks.
pub fn save(state: &mut State) {
    if let Some(path) = state.saved.clone() {
        return state.save_to(&path);
    }
    let folder = state.session.shots.first().and_then(|s| s.path.parent()).map(Path::to_path_buf).unwrap_or_default();
    state.workers.beside(move |tell| {
        let dialog = rfd::FileDialog::new().set_title("Save the session").set_directory(folder).set_file_name("bracket.unshaken.json");
        if let Some(path) = dialog.save_file() {
            tell(News::Chosen(Chosen::Session(path)));
        }
    });
}

fn ask_target(state: &State) {
    let start = PathBuf::from(&state.form.path);
    state.workers.beside(move |tell| {
        let mut dialog = rfd::FileDialog::new()
            .set_title("Export the linear result")
            .add_filter("OpenEXR", &["exr"])
            .add_filter("TIFF", &["tif"])
            .add_filter("Radiance HDR", &["hdr"])
            .set_file_name(start.file_name().unwrap_or_default().to_string_lossy());
        if let Some(folder) = start.parent().filter(|f| f.is_dir()) {
            dialog = dialog.set_directory(folder);
        }
        if let Some(path) = dialog.save_file() {
            tell(News::Chosen(Chosen::Export(path)));
        }
    });
}

impl ExportForm {
    /// What this form adds to the arguments of `merge`.
    fn options(&self, look: &str) -> Vec<OsString> {
        let path = Path::new(&self.path);
        let beside = |ending: &str| path.with_extension(ending).into_os_string();
        let mut all: Vec<OsString> = Vec::new();
        if self.picture {
            all.extend([format!("--tonemap={look}").into(), "--preview".into(), beside("png")]);
        }
        if self.report {
            all.extend(["--report".into(), beside("json")]);
        }
        if self.page {
            all.extend(["--report-html".into(), beside("html")]);
        }
        if self.half {
            all.push("--half".into());
        }
        if self.overwrite {
            all.push("--overwrite".into());
        }
        all
    }
}

/// Arguments of `merge` for what the form asks.
pub fn arguments(state: &State) -> Vec<OsString> {
    let mut all = state.session.arguments(&state.noted(), Path::new(&state.form.path));
    let at = all.iter().position(|a| a == "--").unwrap_or(all.len());
    all.splice(at..at, state.form.options(&state.session.look.words()));
    all
}

/// The window for exports.
pub fn window(state: &mut State, ctx: &egui::Context) {
    let mut open = state.form.open;
    egui::Window::new("Export").open(&mut open).resizable(false).collapsible(false).default_width(420.0).default_pos([120.0, 90.0]).show(
        ctx,
        |ui| {
            ui.horizontal(|ui| {
                let label = ui.label("Linear result");
                ui.add(egui::TextEdit::singleline(&mut state.form.path).desired_width(240.0)).labelled_by(label.id);
                if ui.button("Browse...").clicked() {
                    ask_target(state);
                }
            });
            ui.label(RichText::new("OpenEXR, TIFF or Radiance HDR, by the ending: .exr, .tif, .hdr").small().weak());
            ui.checkbox(&mut state.form.picture, "Picture as shown (PNG)");
            ui.checkbox(&mut state.form.report, "Report (JSON)");
            ui.checkbox(&mut state.form.page, "Report page (HTML)");
            ui.checkbox(&mut state.form.half, "16 bits instead of 32");
            ui.checkbox(&mut state.form.overwrite, "Replace files that exist");
            let ending = output::ending(Path::new(&state.form.path));
            let known = ["exr", "tif", "tiff", "hdr"].contains(&ending.as_str());
            let able = state.is_final() && known && !state.form.busy;
            ui.horizontal(|ui| {
                if ui.add_enabled(able, egui::Button::new("Write the files")).clicked()
                    && let Some(solved) = state.solved.clone()
                {
                    state.form.busy = true;
                    state.form.last = None;
                    state.workers.write(state.program.clone(), arguments(state), solved);
                }
                if ui.button("Copy command line").clicked() {
                    ui.ctx().copy_text(state.session.command_line(&state.noted(), Path::new(&state.form.path)));
                }
                if ui.button("Copy configuration").clicked() {
                    ui.ctx().copy_text(state.session.configuration(&state.noted()));
                }
            });
            if !known {
                ui.label(RichText::new("Name the file with .exr, .tif or .hdr at its end").color(ui.visuals().warn_fg_color));
            } else if !state.is_final() {
                let text = if state.is_busy() {
                    "The solution of this size and these settings is not there yet"
                } else {
                    "Solve first (Ctrl+Enter)"
                };
                ui.label(RichText::new(text).color(ui.visuals().warn_fg_color));
            }
            match &state.form.last {
                Some(Ok(text)) => drop(ui.label(text)),
                Some(Err(text)) => drop(ui.label(RichText::new(text).color(ui.visuals().error_fg_color))),
                None if state.form.busy => drop(ui.label("Writing ...")),
                None => {}
            }
        },
    );
    state.form.open = open && state.form.open;
}
