//! The menu and the panel at the side: what is shown, look, histogram, probe, parameters.

use super::session::{Look, Parameters};
use super::shortcuts::{self, Action};
use super::state::{Over, Source, State};
use super::worker::BINS_PER_STOP;
use super::{blur, export, words};
use crate::exposure::Frame;
use crate::image::{Plane, Rgb};
use crate::mask;
use crate::tonemap::Operator;
use crate::tsf::Model;
use egui::{Color32, Pos2, RichText, Slider, Stroke, Vec2};

/// A panel on the colour that the window is cleared to: filling it takes a software rasteriser as long as everything on it.
pub fn bare(ui: &egui::Ui) -> egui::Frame {
    egui::Frame::side_top_panel(ui.style()).fill(Color32::TRANSPARENT)
}

/// The menu; returns what was chosen.
pub fn menu(state: &mut State, ui: &mut egui::Ui, (undo, redo): (bool, bool)) -> Vec<Action> {
    let mut chosen = Vec::new();
    let mut open = None;
    egui::Panel::top("menu").frame(bare(ui)).show(ui, |ui| {
        egui::MenuBar::new().ui(ui, |ui| {
            let mut item = |ui: &mut egui::Ui, text: &str, action: Action, enabled: bool| {
                let button = egui::Button::new(text).shortcut_text(shortcuts::name(ui.ctx(), action));
                if ui.add_enabled(enabled, button).clicked() {
                    chosen.push(action);
                    ui.close();
                }
            };
            let frames = !state.session.shots.is_empty();
            ui.menu_button("File", |ui| {
                item(ui, "Open...", Action::Open, true);
                if ui.button("Add frames...").clicked() {
                    export::choose_frames(state, true);
                    ui.close();
                }
                ui.menu_button("Open recent", |ui| {
                    if state.recent.entries.is_empty() {
                        ui.weak("nothing yet");
                    }
                    for files in &state.recent.entries {
                        let name = |p: &std::path::PathBuf| p.file_name().unwrap_or(p.as_os_str()).to_string_lossy().into_owned();
                        let text = match files.as_slice() {
                            [one] => name(one),
                            [first, rest @ ..] => format!("{} and {} more", name(first), rest.len()),
                            [] => continue,
                        };
                        if ui.button(text).clicked() {
                            open = Some(files.clone());
                            ui.close();
                        }
                    }
                });
                item(ui, "Save session", Action::Save, frames);
                item(ui, "Export...", Action::Export, frames);
                item(ui, "Copy command line", Action::CopyCommand, frames);
                if ui.add_enabled(frames, egui::Button::new("Copy configuration (TOML)")).clicked() {
                    ui.ctx().copy_text(state.session.configuration(&state.noted()));
                    ui.close();
                }
            });
            ui.menu_button("Edit", |ui| {
                item(ui, "Undo", Action::Undo, undo);
                item(ui, "Redo", Action::Redo, redo);
                item(ui, "Leave the frame out / take it in", Action::Exclude, frames);
                item(ui, "Mark the frame as sharp", Action::Sharp, frames);
            });
            ui.menu_button("View", |ui| {
                item(ui, "Whole frame", Action::Fit, true);
                item(ui, "Actual pixels", Action::Actual, true);
                item(ui, "Before/after divider", Action::Divide, true);
                item(ui, "Picture or blur", Action::Blur, true);
                item(ui, "Light or dark", Action::Theme, true);
            });
            ui.menu_button("Help", |ui| item(ui, "Keyboard shortcuts", Action::Help, true));
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                if state.running.is_none() && ui.add_enabled(state.session.shots.len() > 1, egui::Button::new("Solve")).clicked() {
                    chosen.push(Action::Solve);
                }
                if ui.add_enabled(state.solved.is_some(), egui::Button::new("Export")).clicked() {
                    chosen.push(Action::Export);
                }
                ui.selectable_value(&mut state.blur.open, true, "Blur");
                ui.selectable_value(&mut state.blur.open, false, "Picture");
            });
        });
    });
    if let Some(files) = open {
        state.open(files);
    }
    chosen
}

fn heading(ui: &mut egui::Ui, text: &str) {
    ui.add_space(8.0);
    ui.label(RichText::new(text).strong().size(14.0));
    ui.add_space(2.0);
}

/// The panel.
pub fn panel(state: &mut State, ui: &mut egui::Ui) {
    egui::Panel::right("panel").frame(bare(ui)).default_size(300.0).size_range(260.0..=460.0).show(ui, |ui| {
        egui::ScrollArea::vertical().auto_shrink([false, false]).show(ui, |ui| {
            ui.spacing_mut().slider_width = 130.0;
            if state.blur.open {
                blur::panel(state, ui);
            } else {
                histogram(state, ui);
                look(state, ui);
            }
            compare(state, ui);
            parameters(state, ui);
            if !state.blur.open {
                probe(state, ui);
            }
        });
    });
}

fn compare(state: &mut State, ui: &mut egui::Ui) {
    heading(ui, "Compare");
    let frames = state.session.shots.len();
    ui.checkbox(&mut state.view.divided, "Divider");
    for (label, before) in [("Before", true), ("After", false)] {
        let mut source = if before { state.before } else { state.after };
        egui::ComboBox::from_label(label).width(150.0).selected_text(state.source_name(source)).show_ui(ui, |ui| {
            ui.selectable_value(&mut source, Source::Merge, "Plain merge");
            ui.selectable_value(&mut source, Source::Result, "Result");
            for i in 0..frames {
                ui.selectable_value(&mut source, Source::Frame(i), format!("Frame {}", i + 1));
            }
        });
        *(if before { &mut state.before } else { &mut state.after }) = source;
    }
    egui::ComboBox::from_label("Overlay").width(150.0).selected_text(state.over.name()).show_ui(ui, |ui| {
        for over in Over::ALL {
            ui.selectable_value(&mut state.over, over, over.name());
        }
    });
    let meaning = match state.over {
        Over::Nothing => String::new(),
        Over::FrameClipped => format!("Striped: frame {} is clipped", state.frame + 1),
        Over::AllClipped => "Striped: clipped in every frame; nothing there is known beyond that it is brighter".into(),
        Over::Mask => format!("Red: frame {} does not count there", state.frame + 1),
        Over::Residual => format!("Bright: frame {} is not explained (dark: noise, yellow: 16 times its variance)", state.frame + 1),
    };
    if !meaning.is_empty() {
        ui.label(RichText::new(meaning).small());
    }
    ui.checkbox(&mut state.extremes, "Mark what the tone curve clips");
}

fn look(state: &mut State, ui: &mut egui::Ui) {
    heading(ui, "Look");
    let look = &mut state.session.look;
    ui.add(Slider::new(&mut look.exposure, -6.0..=6.0).text("Exposure, EV").step_by(0.05));
    egui::ComboBox::from_label("Tone curve").width(110.0).selected_text(look.curve.clone()).show_ui(ui, |ui| {
        for name in Operator::names() {
            if ui.selectable_label(look.curve == name, name).clicked() {
                look.choose(name);
            }
        }
    });
    ui.add(Slider::new(&mut look.saturation, 0.0..=2.0).text("Saturation").step_by(0.01));
    let keyed = look.has_key();
    let key = Slider::new(&mut look.key, 0.02..=0.6).text("Brightness of the middle").step_by(0.005);
    ui.add_enabled(keyed, key);
    if ui.button("Reset the look").clicked() {
        *look = Look::default();
    }
}

fn parameters(state: &mut State, ui: &mut egui::Ui) {
    heading(ui, "Solve");
    let frames = state.session.shots.len();
    let p = &mut state.session.parameters;
    ui.checkbox(&mut state.live, "Solve after each edit");
    ui.add(Slider::new(&mut p.lambda, 0.1..=20.0).logarithmic(true).text("Smoothness, lambda").max_decimals(2))
        .on_hover_text("More is smoother, less keeps more noise and detail");
    egui::ComboBox::from_label("Prior").width(130.0).selected_text(p.prior.clone()).show_ui(ui, |ui| {
        for (word, text) in [("collaborative", "patches that look alike"), ("tv", "few edges (total variation)")] {
            ui.selectable_value(&mut p.prior, word.to_string(), format!("{word}: {text}"));
        }
    });
    ui.add(Slider::new(&mut p.robust, 0.0..=4.0).text("Robust weights").step_by(0.05))
        .on_hover_text("How much a shaken frame loses weight where its blur does not explain it; 0 trusts it everywhere");
    ui.add(Slider::new(&mut p.alpha, 0.0..=1.0).text("Mask taper, alpha").step_by(0.01));
    egui::ComboBox::from_label("Camera motion").width(130.0).selected_text(p.model.clone()).show_ui(ui, |ui| {
        for model in Model::ALL {
            ui.selectable_value(&mut p.model, model.name().to_string(), model.name());
        }
    });
    ui.add(Slider::new(&mut p.psf_radius, 0..=40).text("PSF size, px (0: as needed)"))
        .on_hover_text("Reach of the local blurs in the blur view");
    egui::ComboBox::from_label("Reference frame")
        .width(130.0)
        .selected_text(p.reference.map_or("longest sharp".to_string(), |i| format!("frame {}", i + 1)))
        .show_ui(ui, |ui| {
            ui.selectable_value(&mut p.reference, None, "longest sharp");
            for i in 0..frames {
                ui.selectable_value(&mut p.reference, Some(i), format!("frame {}", i + 1));
            }
        });
    egui::ComboBox::from_label("No frame sharp").width(130.0).selected_text(p.blind.clone()).show_ui(ui, |ui| {
        for (word, text) in
            [("auto", "estimate all blurs"), ("joint", "estimate all, always"), ("patches", "from pairs of patches"), ("off", "merge only")]
        {
            ui.selectable_value(&mut p.blind, word.to_string(), format!("{word}: {text}"));
        }
    });
    egui::ComboBox::from_label("Size")
        .width(130.0)
        .selected_text(if p.divisor == 1 { "full".to_string() } else { format!("1/{}", p.divisor) })
        .show_ui(ui, |ui| {
            for divisor in [1, 2, 3, 4, 8] {
                ui.selectable_value(&mut p.divisor, divisor, if divisor == 1 { "full".to_string() } else { format!("1/{divisor}") });
            }
        });
    ui.checkbox(&mut p.align, "Register the frames");
    ui.checkbox(&mut p.deghost, "Remove ghosts")
        .on_hover_text("Where something moved between sharp frames, the one that shows it best counts alone");
    ui.horizontal(|ui| {
        let label = ui.label("Response");
        let edit = egui::TextEdit::singleline(&mut state.typed_response).desired_width(120.0).hint_text("as the files say");
        let response =
            ui.add(edit).labelled_by(label.id).on_hover_text("auto, srgb, linear, gamma:2.2 or a file from 'unshaken calibrate'");
        if response.lost_focus() {
            p.response = state.typed_response.trim().to_string();
        } else if !response.has_focus() {
            state.typed_response.clone_from(&p.response);
        }
    });
    ui.horizontal(|ui| {
        let label = ui.label("GPU memory");
        let edit = egui::TextEdit::singleline(&mut state.typed_memory).desired_width(120.0).hint_text("all there is");
        let response = ui.add(edit).labelled_by(label.id).on_hover_text("At most this much, such as 2GiB; less is slower");
        if response.lost_focus() {
            p.memory_limit = state.typed_memory.trim().to_string();
        } else if !response.has_focus() {
            state.typed_memory.clone_from(&p.memory_limit);
        }
    });
    if ui.button("Reset the parameters").clicked() {
        *p = Parameters::default();
    }
}

fn histogram(state: &State, ui: &mut egui::Ui) {
    heading(ui, "Histogram");
    let (rect, response) = ui.allocate_exact_size(Vec2::new(ui.available_width(), 96.0), egui::Sense::hover());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, "Histogram of the irradiance"));
    let painter = ui.painter_at(rect);
    painter.rect_filled(rect, 3.0, ui.visuals().extreme_bg_color);
    let found = state.solved.as_ref().map(|s| &s.histogram).or(state.ready.as_ref().map(|r| &r.histogram));
    let Some(h) = found else { return };
    let count = h.bins[0].len().max(1);
    let most = h.bins.iter().flatten().copied().fold(1e-9f32, f32::max).sqrt();
    let plot = rect.shrink2(Vec2::new(4.0, 2.0)).with_max_y(rect.bottom() - 14.0);
    let x = |bin: f32| plot.left() + plot.width() * bin / count as f32;
    let dark = ui.visuals().dark_mode;
    let colours = if dark {
        [Color32::from_rgb(235, 80, 80), Color32::from_rgb(90, 210, 100), Color32::from_rgb(100, 140, 255)]
    } else {
        [Color32::from_rgb(190, 30, 30), Color32::from_rgb(20, 130, 40), Color32::from_rgb(40, 70, 200)]
    };
    let weak = Stroke::new(1.0, ui.visuals().weak_text_color().gamma_multiply(0.35));
    // White of the reference frame is 0 EV.
    let white = state.solved.as_ref().map(|s| -(s.bracket.frames()[s.outcome.reference].exposure_time as f32).log2());
    let zero = white.unwrap_or(h.first + (count / BINS_PER_STOP) as f32);
    for stop in (-24..=24).step_by(2) {
        let bin = (zero + stop as f32 - h.first) * BINS_PER_STOP as f32;
        if (0.0..=count as f32).contains(&bin) {
            painter.line_segment([Pos2::new(x(bin), plot.top()), Pos2::new(x(bin), plot.bottom())], weak);
            if stop % 4 == 0 {
                let place = Pos2::new(x(bin), rect.bottom() - 1.0);
                painter.text(
                    place,
                    egui::Align2::CENTER_BOTTOM,
                    format!("{stop:+}"),
                    egui::FontId::proportional(10.0),
                    ui.visuals().weak_text_color(),
                );
            }
        }
    }
    for (bins, colour) in h.bins.iter().zip(colours) {
        let points: Vec<Pos2> =
            bins.iter().enumerate().map(|(i, v)| Pos2::new(x(i as f32 + 0.5), plot.bottom() - plot.height() * v.sqrt() / most)).collect();
        painter.add(egui::Shape::line(points, Stroke::new(1.5, colour)));
    }
    // What the screen shows: from where the curve leaves black to where it is white.
    if let (Some(light), Ok(operator)) = (state.light(), Operator::parse(&state.session.look.words()))
        && let Some(curve) = operator.curve(&light)
    {
        let top = (curve.white / curve.gain).log2();
        let bin = (top - h.first) * BINS_PER_STOP as f32;
        if (0.0..=count as f32).contains(&bin) {
            painter.line_segment(
                [Pos2::new(x(bin), plot.top()), Pos2::new(x(bin), plot.bottom())],
                Stroke::new(1.5, ui.visuals().warn_fg_color),
            );
        }
    }
    let unit = if white.is_some() { "EV; 0 is the white of the reference frame. Orange line: white of the screen" } else { "EV" };
    ui.label(RichText::new(unit).small().weak());
}

fn number(v: f32) -> String {
    if v == 0.0 || (0.001..10_000.0).contains(&v.abs()) { format!("{v:.4}") } else { format!("{v:.2e}") }
}

/// Mask of each frame at a pixel of its own, by the rule for whole frames.
fn masks_at(frames: &[Frame], sharp: &[bool], alpha: f32, pixel: usize) -> Vec<f32> {
    let one = |f: &Frame| {
        let z = f.intensity.pixel(pixel);
        let intensity = Rgb(std::array::from_fn(|c| Plane { width: 1, height: 1, data: vec![z[c]] }));
        Frame {
            name: String::new(),
            intensity,
            levels: f.levels,
            chroma_subsampled: f.chroma_subsampled,
            lossy: f.lossy,
            speed: f.speed,
            exposure_time: f.exposure_time,
        }
    };
    let ones: Vec<Frame> = frames.iter().map(one).collect();
    let still = vec![glam::DMat3::IDENTITY; ones.len()];
    mask::counting(&ones, sharp, alpha, &still).iter().map(|m| m.data[0]).collect()
}

fn probe(state: &State, ui: &mut egui::Ui) {
    heading(ui, "Pixel");
    let Some(ready) = &state.ready else {
        ui.weak("Point at the picture");
        return;
    };
    let Some((x, y)) = state.probe else {
        ui.weak("Point at the picture");
        return;
    };
    let frames = ready.opened.bracket.frames();
    let pixel = y * ready.opened.bracket.size().0 + x;
    ui.monospace(format!("at {x}, {y}"));
    egui::Grid::new("probe").num_columns(4).spacing([10.0, 2.0]).striped(true).show(ui, |ui| {
        if let Some(s) = &state.solved {
            let (w, h) = s.bracket.size();
            let (u, v) = ((x / s.divisor).min(w - 1), (y / s.divisor).min(h - 1));
            ui.label("irradiance");
            for value in s.outcome.irradiance.pixel(v * w + u) {
                ui.monospace(number(value));
            }
            ui.end_row();
        }
        let report = state.solved.as_ref().map(|s| &s.outcome.report["frames"]);
        let sharp: Vec<bool> = (0..frames.len()).map(|i| report.is_none_or(|r| r[i]["sharp"] == true)).collect();
        let masks = masks_at(frames, &sharp, state.session.parameters.alpha as f32, pixel);
        for (i, frame) in frames.iter().enumerate() {
            ui.label(format!("{} at {}", i + 1, words::time(frame.exposure_time)));
            for z in frame.intensity.pixel(pixel) {
                let text = RichText::new(format!("{:.1}", 255.0 * z)).monospace();
                ui.label(if z >= mask::CLIPPED { text.color(ui.visuals().warn_fg_color) } else { text });
            }
            ui.monospace(format!("mask {:.2}", masks[i]));
            ui.end_row();
        }
    });
    let unit = state.solved.as_ref().map_or("code values of 255".to_string(), |s| {
        format!("irradiance: 1 is the white of frame {}; frames: codes of 255", s.outcome.reference + 1)
    });
    ui.label(RichText::new(unit).small().weak());
}
