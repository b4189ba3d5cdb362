//! The main view: which pictures lie left and right of the divider, by which curve, and what lies over them.

use super::blur::{self, Drawn};
use super::canvas::{self, Shown, Side};
use super::state::{Source, State};
use super::worker::{Overlay, OverlayKind, Picture};
use crate::kernels::{DisplayParams, Place};
use crate::tonemap::Operator;
use egui::Color32;

/// A toned picture's RGB is that of the screen.
const SAME: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// The picture of a source, as far as it is there; asked for where it is not.
fn picture(state: &mut State, source: Source) -> Option<Picture> {
    let ready = state.ready.clone()?;
    match source {
        Source::Merge => Some(ready.merge.clone()),
        Source::Result => {
            if let Some(e) = &state.estimate {
                let place = Place::padded(e.width, e.height, e.pad);
                return Some(Picture { planes: e.planes.clone(), place, version: state.heard });
            }
            Some(state.solved.as_ref().map_or_else(|| ready.merge.clone(), |s| s.picture.clone()))
        }
        Source::Frame(i) => state.pictures.frame(&state.workers, ready, i),
    }
}

/// The overlay that is chosen, as far as it is there, and what draws it.
fn overlay(state: &mut State) -> Option<(Overlay, u32)> {
    let ((kind, code), solved) = (state.over.kind()?, state.solved.clone()?);
    let frame = if kind == OverlayKind::AllClipped { 0 } else { state.frame };
    let key = (kind, frame, state.solutions, solved.divisor);
    state.pictures.overlay(&state.workers, key, solved).map(|overlay| (overlay, code))
}

/// What the view shows, once the frames are there, over `background`.
fn shown(state: &mut State, background: f32) -> Option<Shown> {
    let ready = state.ready.clone()?;
    let operator = Operator::parse(&state.session.look.words()).unwrap_or_default();
    let light = state.light()?;
    let local = operator.curve(&light).is_none();
    if !local {
        state.plain = operator.clone();
    }
    // Until the other is there.
    let curve = state.plain.curve(&light)?;
    let overlay = overlay(state);
    // Half precision is finest about 1.
    let (m, unit) = (&ready.opened.to_display, ready.light.middle);
    let column = |c: usize| [m[0][c], m[1][c], m[2][c], 0.0].map(|v| v as f32 / unit);
    let matrix = [column(0), column(1), column(2)];
    let pictures = [state.before, state.after].map(|source| picture(state, source));
    state.toning = local.then(|| state.pictures.tone(&state.workers, &operator, &state.plain, &pictures, &ready)).flatten();
    let sides = pictures.map(|picture| {
        let picture = picture?;
        Some(match state.pictures.toned(&picture, &operator).filter(|_| local) {
            Some(toned) => Side { picture: toned.clone(), matrix: SAME, curve: 2 },
            None => Side { picture, matrix, curve: u32::from(curve.filmic) },
        })
    });
    let params = DisplayParams {
        gain: curve.gain * unit,
        white: curve.white,
        saturation: curve.saturation,
        overlay_kind: overlay.as_ref().map_or(0, |o| o.1),
        extremes: state.extremes,
        background,
        ..DisplayParams::default()
    };
    Some(Shown { params, sides, overlay: overlay.map(|o| o.0) })
}

/// Draws the view, hears the pointer over it, and returns where the frame lies.
pub fn show(state: &mut State, drawn: &mut Drawn, ui: &mut egui::Ui) -> Option<canvas::Layout> {
    let (rect, response) = ui.allocate_exact_size(ui.available_size(), egui::Sense::click_and_drag());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, "Main view"));
    let dark = ui.visuals().dark_mode;
    let background = if dark { Color32::from_gray(18) } else { Color32::from_gray(200) };
    let Some(size) = state.size() else {
        ui.painter().rect_filled(rect, 0.0, background);
        let text = if state.session.shots.is_empty() {
            "Drop the frames of a bracket here, or open them (Ctrl+O)".to_string()
        } else {
            state.lacking().unwrap_or_else(|| "Reading the frames ...".into())
        };
        ui.painter().text(rect.center(), egui::Align2::CENTER_CENTER, text, egui::FontId::proportional(18.0), ui.visuals().text_color());
        return None;
    };
    let layout = state.view.layout(rect, size);
    let over_patch = state.blur.open && blur::wants_pointer(state, drawn, ui, &response, &layout);
    state.view.listen(ui, &response, &layout, !over_patch);
    let layout = state.view.layout(rect, size);
    state.probe = response.hover_pos().map(|p| layout.to_frame(p)).and_then(|q| {
        let inside = q.x >= 0.0 && q.y >= 0.0 && q.x < size.x && q.y < size.y;
        inside.then_some((q.x as usize, q.y as usize))
    });
    match shown(state, f32::from(background.r()) / 255.0) {
        Some(shown) => {
            let split = if state.view.divided { state.view.split } else { 0.0 };
            canvas::draw(ui, &layout, size, split, shown);
        }
        None => drop(ui.painter().rect_filled(rect, 0.0, background)),
    }
    if state.blur.open {
        blur::over_picture(state, drawn, ui, &response, &layout);
    }
    if state.view.divided {
        state.view.divider(ui, rect);
        canvas::tag(ui, rect, egui::Align2::LEFT_TOP, &state.source_name(state.before));
    }
    canvas::tag(ui, rect, egui::Align2::RIGHT_TOP, &state.source_name(state.after));
    if let Some(sign) = &state.toning {
        let place = canvas::tag(ui, rect, egui::Align2::RIGHT_BOTTOM, sign);
        let response = ui.interact(place, ui.scope_id().with("toning"), egui::Sense::hover());
        response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Label, true, sign));
    }
    Some(layout)
}
