//! The messages, over the main view.

use super::state::{Offer, State};
use egui::{Color32, RichText, Vec2};

/// Floats over the upper edge of the view `rect`, which stays where it is; returns the offer that was taken.
pub fn show(state: &mut State, ui: &egui::Ui, rect: egui::Rect) -> Option<Offer> {
    if state.messages.is_empty() {
        return None;
    }
    // Below what names the pictures.
    let place = rect.shrink2(Vec2::new(8.0, 0.0)).with_min_y(rect.top() + 44.0);
    let area = egui::Area::new(egui::Id::unique("messages")).fixed_pos(place.min).constrain_to(rect);
    area.show(ui.ctx(), |ui| {
        ui.set_width(place.width());
        list(state, ui)
    })
    .inner
}

fn list(state: &mut State, ui: &mut egui::Ui) -> Option<Offer> {
    let (mut gone, mut offered) = (None, None);
    for (i, message) in state.messages.iter().enumerate() {
        let (fill, sign) = if message.error { (Color32::from_rgb(120, 28, 28), "Error") } else { (Color32::from_rgb(104, 74, 8), "Note") };
        egui::Frame::new().fill(fill).inner_margin(6).corner_radius(4).show(ui, |ui| {
            ui.horizontal(|ui| {
                ui.label(RichText::new(sign).strong().color(Color32::WHITE));
                ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                    if ui.button("Dismiss").clicked() {
                        gone = Some(i);
                    }
                    if let Some(offer) = message.offer {
                        let text = match offer {
                            Offer::Smaller(d) => format!("Solve at 1/{d} of the size"),
                            Offer::Reopen => "Open the GPU again".into(),
                        };
                        if ui.button(text).clicked() {
                            offered = Some((i, offer));
                        }
                    }
                    ui.with_layout(egui::Layout::left_to_right(egui::Align::Center), |ui| {
                        ui.add(egui::Label::new(RichText::new(&message.text).color(Color32::WHITE)).wrap());
                    });
                });
            });
        });
    }
    if let Some(i) = offered.map(|o| o.0).or(gone) {
        state.messages.remove(i);
    }
    offered.map(|o| o.1)
}
