//! Figures 3 and 4: patches of shaken frames, the true PSF of each and the estimated one.

use super::local::{self, RADIUS, error, median, smoothed};
use super::study::{Events, Exposures, Shaking, seconds};
use super::{Joint, Lab, Report, sheet};
use crate::error::Result;
use crate::exposure::Bracket;
use crate::image::Plane;
use crate::pipeline::{Blind, Settings};
use crate::psf::{Patch, Psf};
use crate::synth::Drawn;
use crate::tsf::psf_at;
use glam::DVec2;
use image::{RgbImage, imageops};

/// Patches that the picture shows.
const SHOWN: usize = 5;

pub(super) fn run(lab: &mut Lab, events: Events) -> Result<Report> {
    let study = lab.study((Drawn::Chart, Exposures::Sharp3, Shaking::Grid), events)?;
    let size = study.made.bracket.size();
    let mut table = String::from(
        "| frame | patch at | true width (px) | error of eq. (11) | 1 px smoothed | error of the TSF's | 1 px smoothed |\n|---|---|---|---|---|---|---|\n",
    );
    let (mut rows, mut errors) = (Vec::new(), Vec::new());
    for (i, time) in study.times().into_iter().enumerate().skip(study.shaken()) {
        let photo = study.photo(i);
        let mut marked = photo.clone();
        let mut strips: [Vec<(String, RgbImage)>; 4] = Default::default();
        for (k, (patch, psf)) in local::measured(study, i, events)?.into_iter().enumerate() {
            let (x, y, side) = (patch.x, patch.y, patch.size);
            let at = patch.centred(size);
            let truth = psf_at(&study.made.tsfs[i], at, RADIUS).values;
            let by_tsf = psf_at(&study.joint.tsfs[i], at, RADIUS).values;
            let of = |p: &Plane| (error(p, &truth), error(&smoothed(p), &smoothed(&truth)));
            let (direct, global) = (of(&psf.values), of(&by_tsf));
            let wide = Psf { radius: RADIUS, values: truth.clone() }.extent();
            table += &format!(
                "| {} | ({x}, {y}), {side} px | {wide:.1} | {:.2} | {:.2} | {:.2} | {:.2} |\n",
                seconds(time).to_lowercase(),
                direct.0,
                direct.1,
                global.0,
                global.1
            );
            errors.push([direct.0, direct.1, global.0, global.1]);
            frame(&mut marked, &patch);
            if k < SHOWN {
                strips[0].push((format!("PATCH {}", k + 1), cut(&photo, &patch)));
                strips[1].push(("TRUE PSF".into(), sheet::grey(&truth)));
                strips[2].push((format!("EQ. (11): {:.2}", direct.0), sheet::grey(&psf.values)));
                strips[3].push((format!("OF THE TSF: {:.2}", global.0), sheet::grey(&by_tsf)));
            }
        }
        rows.push(vec![(format!("FRAME OF {} AND ITS PATCHES", seconds(time)), marked)]);
        rows.extend(strips);
    }
    let of = |k: usize| median(errors.iter().map(|e| e[k]).collect());
    table += &format!("| median | | | {:.2} | {:.2} | {:.2} | {:.2} |", of(0), of(1), of(2), of(3));
    Ok(Report {
        title: "Figure 3: local PSFs, true and estimated".into(),
        text: format!(
            "Scene chart, {}; TSFs on the paper's grid. Patches are chosen by the program; the paper chooses by hand and shows PSFs side by side without figures. \
             The error is the norm of the difference over the norm of the true PSF, which is eq. (5) at the patch's centre. Eq. (11) is solved for each patch by \
             itself against the denoised sharp frames, non-negative; 'the TSF's' is eq. (5) of the TSF that the program finds from the whole frame.",
            study.camera
        ),
        table,
        picture: sheet::sheet(&rows, 190),
    })
}

pub(super) fn blind(lab: &mut Lab, events: Events) -> Result<Report> {
    let study = lab.study((Drawn::Chart, Exposures::Shaken3, Shaking::Grid), events)?;
    let (w, h) = study.made.bracket.size();
    // Two frames, as the paper: the two longest differ in blur and both see the patches.
    let pair = [1, 2];
    let frames = pair.map(|i| study.made.bracket.frames()[i].clone()).to_vec();
    let settings = Settings { blind: Blind::Joint, ..Settings::default() };
    let found = Joint::new(&Bracket::new(frames)?, &study.response, &settings, None, events)?;
    // What lies where is the same for both frames of a patch, and is not known: scene and PSFs may be shifted together.
    let latent = study.joint.irradiance.mean();
    let (_, weight) = local::seen(study, pair[1], &latent);
    let side = (w / 3).min(120);
    let patches = crate::psf::choose(&latent, &weight, side, 3);
    let mut table =
        String::from("| patch at | frame | true width (px) | estimated width | error | 1 px smoothed |\n|---|---|---|---|---|---|\n");
    let mut rows: Vec<Vec<(String, RgbImage)>> = vec![Vec::new(), Vec::new(), Vec::new()];
    let mut errors = Vec::new();
    for patch in &patches {
        let at = patch.centred((w, h));
        let truth = pair.map(|i| psf_at(&study.made.tsfs[i], at, RADIUS).values);
        let shifted =
            |s: DVec2| -> [Plane; 2] { std::array::from_fn(|k| moved(&psf_at(&found.tsfs[k], at, RADIUS + 8).values, RADIUS, s)) };
        let cost = |s: DVec2| shifted(s).iter().zip(&truth).map(|(a, b)| error(&smoothed(a), &smoothed(b)).powi(2)).sum::<f64>();
        let (mut best, mut step) = (DVec2::ZERO, 2.0);
        while step > 0.05 {
            let around = (-2..=2).flat_map(|j| (-2..=2).map(move |i| (i, j)));
            let tried = around.map(|(i, j)| best + step * DVec2::new(f64::from(i), f64::from(j)));
            best = tried.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(best);
            step *= 0.5;
        }
        for (k, estimated) in shifted(best).into_iter().enumerate() {
            let i = pair[k];
            let (raw, smooth) = (error(&estimated, &truth[k]), error(&smoothed(&estimated), &smoothed(&truth[k])));
            let width = |p: &Plane| Psf { radius: RADIUS, values: p.clone() }.extent();
            table += &format!(
                "| ({}, {}), {side} px | {} | {:.1} | {:.1} | {raw:.2} | {smooth:.2} |\n",
                patch.x,
                patch.y,
                seconds(study.times()[i]).to_lowercase(),
                width(&truth[k]),
                width(&estimated)
            );
            errors.push((raw, smooth));
            rows[0].push((format!("PATCH, {}", seconds(study.times()[i])), cut(&study.photo(i), patch)));
            rows[1].push((format!("ESTIMATED: {raw:.2}"), sheet::grey(&estimated)));
            rows[2].push(("TRUE PSF".into(), sheet::grey(&truth[k])));
        }
    }
    let of = |f: fn(&(f64, f64)) -> f64| median(errors.iter().map(f).collect());
    table += &format!("| median | | | | {:.2} | {:.2} |", of(|e| e.0), of(|e| e.1));
    let mut all = vec![pair.map(|i| (format!("FRAME OF {}", seconds(study.times()[i])), study.photo(i))).to_vec()];
    all.extend(rows);
    Ok(Report {
        title: "Figure 4: PSFs from two blurred frames".into(),
        text: format!(
            "Scene chart, {}; TSFs on the paper's grid. From the two longest frames alone, of which neither is sharp, the program finds the irradiance and both TSFs together; \
             the PSFs are eq. (5) of these. The paper estimates each patch by itself (eq. 12). Scene and PSFs may be shifted together without any change in the frames: \
             each patch's pair of PSFs is compared after the one shift that suits both best. The error is the norm of the difference over the norm of the true PSF.{}",
            study.camera,
            if found.report["blind"]["believed"].as_bool() == Some(true) {
                ""
            } else {
                " The blurs were not found: the PSFs are those of a merge."
            }
        ),
        table,
        picture: sheet::sheet(&all, 190),
    })
}

/// The middle of `psf`, up to `radius`, after a shift by `s` pixels.
fn moved(psf: &Plane, radius: usize, s: DVec2) -> Plane {
    let offset = (psf.width / 2) as f64 - radius as f64;
    let inside = |x: f64, y: f64| {
        if x < 0.0 || y < 0.0 || x >= psf.width as f64 || y >= psf.height as f64 { 0.0 } else { f64::from(psf.at(x as usize, y as usize)) }
    };
    Plane::from_fn(2 * radius + 1, 2 * radius + 1, |x, y| {
        let (u, v) = (x as f64 + offset - s.x, y as f64 + offset - s.y);
        let (i, j) = (u.floor(), v.floor());
        let (a, b) = (u - i, v - j);
        let row = |j: f64| (1.0 - a) * inside(i, j) + a * inside(i + 1.0, j);
        ((1.0 - b) * row(j) + b * row(j + 1.0)) as f32
    })
}

fn cut(photo: &RgbImage, patch: &Patch) -> RgbImage {
    imageops::crop_imm(photo, patch.x as u32, patch.y as u32, patch.size as u32, patch.size as u32).to_image()
}

/// A light frame round a patch.
fn frame(image: &mut RgbImage, patch: &Patch) {
    let (x, y, size) = (patch.x as u32, patch.y as u32, patch.size as u32);
    for k in 0..size {
        for (u, v) in [(x + k, y), (x + k, y + size - 1), (x, y + k), (x + size - 1, y + k)] {
            if u < image.width() && v < image.height() {
                image.put_pixel(u, v, image::Rgb([255, 230, 60]));
            }
        }
    }
}
