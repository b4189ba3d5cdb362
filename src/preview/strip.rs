//! The strip of thumbnails, and the line of state below it.

use super::controls::bare;
use super::state::{Source, State};
use super::words::{seconds, time};
use egui::{Color32, RichText, Vec2};

/// Height of a thumbnail in points.
const HEIGHT: f32 = 84.0;

/// What is known of frame `i`: sharp or blurred, by how much.
fn badge(state: &State, i: usize) -> Option<(String, Color32, String)> {
    let shot = state.session.shots.get(i)?;
    if shot.excluded {
        return Some(("left out".into(), Color32::from_gray(110), "left out by you".into()));
    }
    let solved = state.solved.as_ref()?;
    let frame = &solved.outcome.report["frames"][i];
    let reason = frame["judgement"]["reason"].as_str().unwrap_or_default().to_string();
    if frame["used"] != true {
        let name = frame["frame"].as_str().unwrap_or_default();
        let why = solved.outcome.left_out.iter().find(|l| l.0 == name).map_or(reason, |l| l.1.clone());
        return Some(("unusable".into(), Color32::from_rgb(165, 42, 42), why));
    }
    if frame["sharp"] == true {
        let reference = if solved.outcome.reference == i { ", reference" } else { "" };
        return Some((format!("sharp{reference}"), Color32::from_rgb(30, 110, 60), reason));
    }
    let extent = solved.tsf(i).map(|t| {
        let (w, h) = solved.bracket.size();
        crate::tsf::extent(&t, w, h) * solved.divisor as f64
    });
    let size = extent.map_or(String::new(), |e| format!(" {e:.0} px"));
    Some((format!("blurred{size}"), Color32::from_rgb(150, 90, 10), reason))
}

/// The strip: chosen by click, excluded, marked sharp, exposure time.
pub fn strip(state: &mut State, ui: &mut egui::Ui) {
    if state.session.shots.is_empty() {
        return;
    }
    egui::Panel::bottom("frames").frame(bare(ui)).resizable(false).show(ui, |ui| {
        egui::ScrollArea::horizontal().auto_shrink([false, true]).show(ui, |ui| {
            ui.horizontal(|ui| {
                for i in 0..state.session.shots.len() {
                    one(state, ui, i);
                }
            });
        });
    });
}

fn one(state: &mut State, ui: &mut egui::Ui, i: usize) {
    let name = state.session.shots[i].name();
    let path = state.session.shots[i].path.clone();
    let chosen = state.frame == i;
    let stroke =
        if chosen { ui.visuals().selection.stroke } else { egui::Stroke::new(1.0, ui.visuals().weak_text_color().gamma_multiply(0.4)) };
    let badge = badge(state, i);
    egui::Frame::new().stroke(stroke).inner_margin(5).corner_radius(4).show(ui, |ui| {
        ui.vertical(|ui| {
            let (texture, size) = match state.thumbs.get(&path) {
                Some(Ok(t)) => (Some((t.texture.id(), t.texture.size_vec2())), t.size),
                _ => (None, (3, 2)),
            };
            let width = HEIGHT * size.0 as f32 / size.1.max(1) as f32;
            let (rect, response) = ui.allocate_exact_size(Vec2::new(width.clamp(60.0, 220.0), HEIGHT), egui::Sense::click());
            response.widget_info(|| egui::WidgetInfo::selected(egui::Role::Button, true, chosen, format!("Choose frame {}", i + 1)));
            let tint = if state.session.shots[i].excluded { Color32::from_gray(90) } else { Color32::WHITE };
            match texture {
                Some((id, _)) => {
                    let whole = egui::Rect::from_min_max(egui::Pos2::ZERO, egui::Pos2::new(1.0, 1.0));
                    ui.painter().image(id, rect, whole, tint);
                }
                None => {
                    ui.painter().rect_filled(rect, 2.0, ui.visuals().extreme_bg_color);
                    let text = if matches!(state.thumbs.get(&path), Some(Err(_))) { "cannot be read" } else { "..." };
                    ui.painter().text(
                        rect.center(),
                        egui::Align2::CENTER_CENTER,
                        text,
                        egui::FontId::proportional(12.0),
                        ui.visuals().weak_text_color(),
                    );
                }
            }
            if response.clicked() {
                state.choose(i);
            }
            if response.double_clicked() {
                state.before = Source::Frame(i);
            }
            response.on_hover_text(format!("{name}\nDouble click: show it left of the divider"));
            if let Some((text, colour, why)) = &badge {
                let galley = ui.painter().layout_no_wrap(text.clone(), egui::FontId::proportional(11.0), Color32::WHITE);
                let place = egui::Rect::from_min_size(rect.left_top() + Vec2::new(3.0, 3.0), galley.size() + Vec2::new(8.0, 3.0));
                ui.painter().rect_filled(place, 3.0, *colour);
                ui.painter().galley(place.min + Vec2::new(4.0, 1.5), galley, Color32::WHITE);
                let id = ui.scope_id().with(("badge", i));
                let badge = ui.interact(place, id, egui::Sense::hover());
                badge.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Label, true, format!("Frame {}: {text}", i + 1)));
                badge.on_hover_text(why);
            }
            ui.horizontal(|ui| {
                ui.spacing_mut().item_spacing.x = 4.0;
                ui.label(RichText::new(format!("{}", i + 1)).strong());
                let noted = state.thumbs.get(&path).and_then(|t| t.as_ref().ok()).and_then(|t| t.exposure_time);
                let given = state.session.shots[i].exposure_time;
                let shown = given.or(noted).map(time).unwrap_or_default();
                let mut text = state.typed.get(&path).cloned().unwrap_or_else(|| shown.clone());
                let missing = given.or(noted).is_none();
                let mut edit = egui::TextEdit::singleline(&mut text).desired_width(54.0).hint_text("time?");
                if missing {
                    edit = edit.background_color(Color32::from_rgb(120, 60, 10));
                }
                let response = ui.add(edit);
                response.widget_info(|| {
                    let mut info = egui::WidgetInfo::text_edit(true, shown.clone(), text.clone(), "time?");
                    info.label = Some(format!("Exposure time of frame {}", i + 1));
                    info
                });
                if response.changed() {
                    state.typed.insert(path.clone(), text.clone());
                }
                if response.lost_focus() && state.typed.remove(&path).is_some() {
                    match (text.trim().is_empty(), seconds(&text)) {
                        (true, _) => state.session.shots[i].exposure_time = None,
                        (_, Some(t)) if Some(t) != given.or(noted) && time(t) != shown => state.session.shots[i].exposure_time = Some(t),
                        (_, Some(_)) => {}
                        (_, None) => {
                            state.say(format!("{text:?} is no exposure time; type seconds such as 1/30 or 0.2"), true, None);
                        }
                    }
                }
                response.on_hover_text(if given.is_some() {
                    "Given by you; empty: what the file notes"
                } else {
                    "Exposure time in seconds"
                });
                let shot = &mut state.session.shots[i];
                let mut used = !shot.excluded;
                let label = format!("Use frame {}", i + 1);
                let response = ui.checkbox(&mut used, "use");
                response.widget_info(|| egui::WidgetInfo::selected(egui::Role::CheckBox, true, used, label.clone()));
                shot.excluded = !used;
                let label = format!("Frame {} is sharp", i + 1);
                let response = ui.toggle_value(&mut shot.sharp, "sharp");
                let sharp = shot.sharp;
                response.widget_info(|| egui::WidgetInfo::selected(egui::Role::Button, true, sharp, label.clone()));
                response.on_hover_text("Say that this frame is sharp. If any is marked, only the marked ones are");
            });
        });
    });
}

/// What goes on, and what is under the pointer.
pub fn status(state: &mut State, ui: &mut egui::Ui) {
    let mut cancel = false;
    egui::Panel::bottom("status").frame(bare(ui)).resizable(false).show(ui, |ui| {
        ui.horizontal(|ui| {
            if let Some(running) = &state.running {
                let elapsed = running.began.elapsed().as_secs_f32();
                let left = (running.fraction > 0.05).then(|| elapsed * (1.0 - running.fraction) / running.fraction);
                let size = if running.divisor > 1 { format!(" at 1/{}", running.divisor) } else { String::new() };
                let left = left
                    .map_or(String::new(), |s| if s < 90.0 { format!(", {s:.0} s left") } else { format!(", {:.0} min left", s / 60.0) });
                cancel = ui.button("Cancel").clicked();
                let text = format!("{}{size}{left}", running.stage);
                ui.add(egui::ProgressBar::new(running.fraction).desired_width(160.0).show_percentage());
                ui.label(text);
            } else if let Some(solved) = &state.solved {
                let how = if state.is_final() { "Solved" } else { "Stopped; solve again with Ctrl+Enter" };
                let (w, h) = solved.bracket.size();
                ui.label(format!("{how}: {w} x {h} in {:.1} s", solved.seconds));
            } else if let Some(lacking) = state.lacking().filter(|_| !state.session.shots.is_empty()) {
                ui.label(RichText::new(lacking).color(ui.visuals().warn_fg_color));
            } else {
                ui.label("Ready");
            }
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                if let Some((x, y)) = state.probe {
                    ui.monospace(format!("{x}, {y}"));
                }
                let percent = |z: f32| format!("{:.0} %", 100.0 * z * ui.ctx().pixels_per_point());
                ui.label(state.view.zoom.map_or("fit".to_string(), percent));
            });
        });
    });
    if cancel {
        state.cancel();
    }
}
