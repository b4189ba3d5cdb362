//! Footnote 1: how accurate TSFs found from PSFs are.

use super::local::{self, RADIUS};
use super::study::{Events, Exposures, Shaking, seconds};
use super::{Lab, Report, sheet};
use crate::error::Result;
use crate::image::{Plane, Rgb};
use crate::pose::PoseGrid;
use crate::psf::{Patch, Psf};
use crate::synth::{self, Drawn};
use crate::tsf::{self, Tsf, psf_at};

/// ‖K̂E - KE‖ / ‖KE‖ over all channels, inside a margin that nothing from beyond the frame reaches.
fn operator_error(estimated: &Rgb, truth: &Rgb) -> f64 {
    let (w, h) = truth.size();
    let (mut above, mut below) = (0.0, 0.0);
    for (a, b) in estimated.0.iter().zip(&truth.0) {
        for y in 24..h.saturating_sub(24) {
            for x in 24..w.saturating_sub(24) {
                above += f64::from(a.at(x, y) - b.at(x, y)).powi(2);
                below += f64::from(b.at(x, y)).powi(2);
            }
        }
    }
    (above / f64::max(below, 1e-30)).sqrt()
}

pub(super) fn run(lab: &mut Lab, events: Events) -> Result<Report> {
    let mut table = String::from(
        "| motion | frame | no blur assumed | TSF from true PSFs | TSF from PSFs of eq. (11) | from the whole frame | poses |\n|---|---|---|---|---|---|---|\n",
    );
    let mut rows = Vec::new();
    for (shaking, kind) in
        [(Shaking::Grid, "on the paper's grid"), (Shaking::Tremor, "tremor, off the grid"), (Shaking::SixD, "six degrees of freedom")]
    {
        let study = lab.study((Drawn::Chart, Exposures::Sharp3, shaking), events)?;
        let (w, h) = study.made.bracket.size();
        // The paper's transformation space, section IV.
        let grid = PoseGrid { radius: 12, angles_deg: (-6..=6).map(|k| 0.25 * f64::from(k)).collect() };
        for (i, time) in study.times().into_iter().enumerate().skip(study.shaken()) {
            let truth = synth::integrate(&study.scene, &study.motions[i].homographies());
            let of = |tsf: &Tsf| operator_error(&synth::expose(&study.scene, tsf), &truth);
            let psfs = local::measured(study, i, events)?;
            let exact: Vec<(Patch, Psf)> = psfs.iter().map(|(p, _)| (*p, psf_at(&study.made.tsfs[i], p.centred((w, h)), RADIUS))).collect();
            let (from_true, from_found) = (tsf::from_psfs(&exact, &grid, w, h), tsf::from_psfs(&psfs, &grid, w, h));
            let told = |tsf: &Option<Tsf>| tsf.as_ref().map_or("none".into(), |t| format!("{:.1} %", 100.0 * of(t)));
            let whole = &study.joint.tsfs[i];
            table += &format!(
                "| {kind} | {} | {:.1} % | {} | {} | {:.1} % | {} |\n",
                seconds(time).to_lowercase(),
                100.0 * of(&Tsf::identity()),
                told(&from_true),
                told(&from_found),
                100.0 * of(whole),
                whole.poses.len()
            );
            let shown = |tsf: &Option<Tsf>| tsf.as_ref().map_or_else(|| image::RgbImage::new(65, 65), projection);
            rows.push(vec![
                (format!("TRUE TSF, {}", seconds(time)), projection(&study.made.tsfs[i])),
                ("FROM TRUE PSFS".into(), shown(&from_true)),
                ("FROM EQ. (11)".into(), shown(&from_found)),
                ("WHOLE FRAME".into(), projection(whole)),
            ]);
        }
    }
    table.truncate(table.trim_end().len());
    Ok(Report {
        title: "Accuracy of TSFs from PSFs".into(),
        text: "Scene chart. Error of the blur operator on the true scene: norm of the difference over the norm. TSFs from PSFs (eq. 6) lie on the paper's grid; nine \
               patches a frame. The paper's footnote 1 refers to supplementary material; its figures are not in the paper. The picture shows each TSF over t_x and \
               t_y, a quarter of a pixel per pixel; a row per frame, in the table's order."
            .into(),
        table,
        picture: sheet::sheet(&rows, 190),
    })
}

/// A TSF over (t_x, t_y), summed over its angles: 16 px across, four cells a pixel.
fn projection(tsf: &Tsf) -> image::RgbImage {
    let side = 65;
    let mut plane = Plane::filled(side, side, 0.0);
    for p in &tsf.poses {
        // Where the pose takes the middle of the frame: pitch and yaw move it as well.
        let t = p.apply(tsf.focal_px, glam::DVec2::ZERO);
        let (x, y) = ((t.x * 4.0).round() + 32.0, (t.y * 4.0).round() + 32.0);
        for (dx, dy, k) in [(0.0, 0.0, 1.0), (1.0, 0.0, 0.5), (-1.0, 0.0, 0.5), (0.0, 1.0, 0.5), (0.0, -1.0, 0.5)] {
            let (x, y) = (x + dx, y + dy);
            if x >= 0.0 && y >= 0.0 && x < side as f64 && y < side as f64 {
                plane.data[y as usize * side + x as usize] += (p.weight * k) as f32;
            }
        }
    }
    sheet::grey(&plane)
}
