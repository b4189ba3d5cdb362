//! Figure 3: patches of a shaken frame, the true PSF of each and the estimated one.

use super::study::{SHAKEN, Shaking, TIMES};
use super::{Lab, Report, sheet};
use crate::error::Result;
use crate::image::Plane;
use crate::pipeline::Event;
use crate::pose::project;
use crate::synth::Drawn;
use crate::tsf::Tsf;
use glam::DVec2;
use image::{RgbImage, imageops};

/// Patches that the picture shows.
const SHOWN: usize = 5;

/// True PSF at `p` (centred pixels) by eq. (5): each pose's weight at p - Γ⁻¹ p, split bilinearly.
pub(super) fn true_psf(tsf: &Tsf, p: DVec2, radius: usize) -> Plane {
    let side = 2 * radius + 1;
    let mut psf = Plane::filled(side, side, 0.0);
    for pose in &tsf.poses {
        let u = p - project(&pose.homography(tsf.focal_px).inverse(), p);
        let (fx, fy) = (u.x.floor(), u.y.floor());
        for (j, wy) in [(0.0, 1.0 - (u.y - fy)), (1.0, u.y - fy)] {
            for (i, wx) in [(0.0, 1.0 - (u.x - fx)), (1.0, u.x - fx)] {
                let (x, y) = (fx + i + radius as f64, fy + j + radius as f64);
                if x >= 0.0 && y >= 0.0 && x < side as f64 && y < side as f64 {
                    psf.data[y as usize * side + x as usize] += (pose.weight * wx * wy) as f32;
                }
            }
        }
    }
    psf
}

/// Mean over 3 x 3 pixels, weights 1 2 1: what a pixel's worth of displacement cannot change much.
fn smoothed(p: &Plane) -> Plane {
    let inside = |x: isize, y: isize| {
        if x < 0 || y < 0 || x >= p.width as isize || y >= p.height as isize { 0.0 } else { p.at(x as usize, y as usize) }
    };
    Plane::from_fn(p.width, p.height, |x, y| {
        let tap = |i: isize, j: isize| ((2 - i.abs()) * (2 - j.abs())) as f32 / 16.0 * inside(x as isize + i, y as isize + j);
        (-1..=1).flat_map(|j| (-1..=1).map(move |i| (i, j))).map(|(i, j)| tap(i, j)).sum()
    })
}

/// Norm of the difference over the norm of the truth.
fn error(a: &Plane, truth: &Plane) -> f64 {
    let norm = |v: &mut dyn Iterator<Item = f32>| v.map(|v| f64::from(v).powi(2)).sum::<f64>().sqrt();
    norm(&mut a.data.iter().zip(&truth.data).map(|(a, b)| a - b)) / norm(&mut truth.data.iter().copied()).max(1e-12)
}

pub(super) fn run(lab: &mut Lab, events: &mut dyn FnMut(Event) -> bool) -> Result<Report> {
    let study = lab.study(Drawn::Chart, Shaking::Grid, events)?;
    let (w, h) = study.made.bracket.size();
    let centre = DVec2::new((w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0);
    let mut table = String::from("| frame | patch at | true width (px) | error | error, 1 px smoothed |\n|---|---|---|---|---|\n");
    let (mut rows, mut errors) = (Vec::new(), Vec::new());
    for (i, time) in TIMES.into_iter().enumerate().skip(SHAKEN) {
        let mut marked = study.photo(i);
        let photo = study.photo(i);
        let mut strips: [Vec<(String, RgbImage)>; 3] = Default::default();
        let patches = study.joint.report["frames"][i]["blur"]["patches"].as_array().cloned().unwrap_or_default();
        for (k, patch) in patches.iter().enumerate() {
            let number = |v: &serde_json::Value| v.as_u64().unwrap_or(0) as usize;
            let (x, y, size, radius) = (number(&patch["x"]), number(&patch["y"]), number(&patch["size"]), number(&patch["psf"]["radius"]));
            let values: Vec<f32> =
                patch["psf"]["values"].as_array().into_iter().flatten().map(|v| v.as_f64().unwrap_or(0.0) as f32).collect();
            let Ok(estimated) = Plane::from_vec(2 * radius + 1, 2 * radius + 1, values) else { continue };
            let half = (size as f64 - 1.0) / 2.0;
            let truth = true_psf(&study.made.tsfs[i], DVec2::new(x as f64 + half, y as f64 + half) - centre, radius);
            let (raw, smooth) = (error(&estimated, &truth), error(&smoothed(&estimated), &smoothed(&truth)));
            let wide = crate::psf::Psf { radius, values: truth.clone() }.extent();
            table += &format!("| {} s | ({x}, {y}), {size} px | {wide:.1} | {raw:.2} | {smooth:.2} |\n", time);
            errors.push((raw, smooth));
            frame(&mut marked, x as u32, y as u32, size as u32);
            if k < SHOWN {
                strips[0].push((
                    format!("PATCH {}", k + 1),
                    imageops::crop_imm(&photo, x as u32, y as u32, size as u32, size as u32).to_image(),
                ));
                strips[1].push(("TRUE PSF".into(), sheet::grey(&truth)));
                strips[2].push((format!("ESTIMATED: {raw:.2}"), sheet::grey(&estimated)));
            }
        }
        let [a, b, c] = strips;
        rows.push(vec![(format!("FRAME OF {} S AND ITS PATCHES", time), marked)]);
        rows.extend([a, b, c]);
    }
    let median = |of: fn(&(f64, f64)) -> f64| -> f64 {
        let mut v: Vec<f64> = errors.iter().map(of).collect();
        v.sort_by(f64::total_cmp);
        v.get(v.len() / 2).copied().unwrap_or(f64::NAN)
    };
    table += &format!("| median | | | {:.2} | {:.2} |", median(|e| e.0), median(|e| e.1));
    Ok(Report {
        title: "Figure 3: local PSFs, true and estimated".into(),
        text: format!(
            "Scene chart, {w} x {h} pixels, 1/2 and 2 s shaken by TSFs on the paper's grid. The paper chooses patches by hand and shows PSFs side by side \
             without figures; here patches are chosen by the program, and the error is the norm of the difference over the norm of the true PSF. \
             The true PSF is eq. (5) at the patch's centre."
        ),
        table,
        picture: sheet::sheet(&rows, 190),
    })
}

/// A light frame round a patch.
fn frame(image: &mut RgbImage, x: u32, y: u32, size: u32) {
    for k in 0..size {
        for (u, v) in [(x + k, y), (x + k, y + size - 1), (x, y + k), (x + size - 1, y + k)] {
            if u < image.width() && v < image.height() {
                image.put_pixel(u, v, image::Rgb([255, 230, 60]));
            }
        }
    }
}
