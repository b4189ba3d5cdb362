//! Footnote 1: how accurate TSFs found from PSFs are.

use super::study::{SHAKEN, Shaking, TIMES};
use super::{Lab, Report, sheet};
use crate::error::Result;
use crate::image::{Plane, Rgb};
use crate::pipeline::Event;
use crate::pose::Pose;
use crate::synth::{self, Drawn};
use crate::tsf::Tsf;

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

pub(super) fn run(lab: &mut Lab, events: &mut dyn FnMut(Event) -> bool) -> Result<Report> {
    let mut table = String::from(
        "| scene | motion | frame | no blur assumed | TSF from PSFs | refined on the frame | poses |\n|---|---|---|---|---|---|---|\n",
    );
    let mut rows = Vec::new();
    for (drawn, shaking) in [(Drawn::Chart, Shaking::Grid), (Drawn::Chart, Shaking::Tremor), (Drawn::Chart, Shaking::SixD)] {
        let study = lab.study(drawn, shaking, events)?;
        let kind = match shaking {
            Shaking::Grid => "on the paper's grid",
            Shaking::Tremor => "tremor, off the grid",
            Shaking::SixD => "six degrees of freedom",
        };
        for (i, time) in TIMES.into_iter().enumerate().skip(SHAKEN) {
            let truth = synth::integrate(&study.scene, &study.motions[i].homographies());
            let still = synth::expose(&study.scene, &Tsf::identity());
            let poses: Option<Vec<Pose>> = serde_json::from_value(study.joint.report["frames"][i]["blur"]["tsf_from_psfs"].clone()).ok();
            // Planar poses do not depend on the focal length.
            let from_psfs = poses.and_then(|p| Tsf::new(1000.0, p).ok());
            let of = |tsf: &Tsf| operator_error(&synth::expose(&study.scene, tsf), &truth);
            let refined = &study.joint.tsfs[i];
            let rough = from_psfs.as_ref().map_or("none".into(), |t| format!("{:.1} %", 100.0 * of(t)));
            table += &format!(
                "| {} | {kind} | {} s | {:.1} % | {rough} | {:.1} % | {} |\n",
                drawn.name(),
                time,
                100.0 * operator_error(&still, &truth),
                100.0 * of(refined),
                refined.poses.len()
            );
            rows.push(vec![
                (format!("TRUE TSF, {} S", time), projection(&study.made.tsfs[i])),
                ("FROM PSFS".into(), from_psfs.as_ref().map_or_else(|| image::RgbImage::new(65, 65), projection)),
                ("REFINED".into(), projection(refined)),
            ]);
        }
    }
    table.truncate(table.trim_end().len());
    Ok(Report {
        title: "Accuracy of TSFs from PSFs".into(),
        text: "Error of the blur operator on the true scene, norm of the difference over the norm. The paper's footnote 1 refers to supplementary \
               material; its figures are not in the paper. The picture shows each TSF over t_x and t_y, a quarter of a pixel per pixel."
            .into(),
        table,
        picture: sheet::sheet(&rows, 195),
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
