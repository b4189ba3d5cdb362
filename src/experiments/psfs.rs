//! Figures 3 and 4: patches of shaken frames, the true PSF of each and the estimated one.

use super::local::{self, RADIUS, error, median, smoothed};
use super::study::{Events, Exposures, Shaking, Study, seconds};
use super::{Lab, Report, sheet};
use crate::error::{Error, Result};
use crate::image::Plane;
use crate::noise;
use crate::pipeline::Event;
use crate::psf::{self, Patch, Psf};
use crate::response::Response;
use crate::synth::Drawn;
use crate::tonemap::codes;
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
                strips[0].push((format!("PATCH {}", k + 1), cut_out(&photo, &patch)));
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

/// Least width in pixels of the frames that pairs of patches are cut from, so that patches can be as large as the paper's.
const PAIR_WIDTH: usize = 400;
/// Patches in the table, and how many of them the picture shows.
const PAIRS: (usize, usize) = (6, 3);

pub(super) fn blind(lab: &mut Lab, events: Events) -> Result<Report> {
    let width = PAIR_WIDTH.max(lab.width);
    let made = Study::photographed((Drawn::Chart, Exposures::Shaken3, Shaking::Grid), width, lab.seed)?;
    let (bracket, (w, h)) = (&made.bracket, made.bracket.size());
    // Two frames, as the paper: the two longest differ in blur and both see the patches.
    let pair = [1, 2];
    let times = pair.map(|i| bracket.frames()[i].exposure_time);
    let own = pair.map(|i| noise::exposure(&bracket.frames()[i], &Response::Srgb).mean());
    let [first, second] = std::array::from_fn(|k| local::seen(bracket, &Response::Srgb, pair[k], &own[k].map(|v| v / times[k] as f32)));
    let both = first.1.zip(&second.1, |a, b| if a > 0.0 && b > 0.0 { a * b / (a + b) } else { 0.0 });
    // 120 and 25 pixels, as the paper.
    let (side, setup) = (120.min(h / 2), psf::Setup::default());
    let patches = psf::choose(&first.0, &both, side, PAIRS.0);
    let mut table = String::from(
        "| patch at | frame | true width (px) | estimated width | error | 1 px smoothed | a point's, 1 px smoothed |\n|---|---|---|---|---|---|---|\n",
    );
    let photos = pair.map(|i| codes(&bracket.frames()[i].intensity));
    let mut marked = photos.clone();
    let mut rows: [Vec<(String, RgbImage)>; 3] = Default::default();
    let mut errors = Vec::new();
    for (n, patch) in patches.iter().enumerate() {
        let part = n as f32 / patches.len() as f32;
        if !events(Event::Progress { stage: "two PSFs from two blurred patches".into(), fraction: part }) {
            return Err(Error::Cancelled);
        }
        let cut = |p: &Plane| p.crop(patch.x, patch.y, side, side);
        let Some(found) = psf::estimate_pair(&cut(&first.0), &cut(&second.0), [&cut(&first.1), &cut(&second.1)], &setup) else { continue };
        let at = patch.centred((w, h));
        let truth = pair.map(|i| psf_at(&made.tsfs[i], at, RADIUS).values);
        let estimated = aligned(&found.psfs.each_ref().map(|h| &h.values), &truth);
        let point = Plane::from_fn(2 * RADIUS + 1, 2 * RADIUS + 1, |x, y| if (x, y) == (RADIUS, RADIUS) { 1.0 } else { 0.0 });
        let points = aligned(&[&point, &point], &truth);
        for k in 0..2 {
            let (raw, smooth) = (error(&estimated[k], &truth[k]), error(&smoothed(&estimated[k]), &smoothed(&truth[k])));
            let none = error(&smoothed(&points[k]), &smoothed(&truth[k]));
            let extent = |p: &Plane| Psf { radius: RADIUS, values: p.clone() }.extent();
            table += &format!(
                "| ({}, {}), {side} px | {} | {:.1} | {:.1} | {raw:.2} | {smooth:.2} | {none:.2} |\n",
                patch.x,
                patch.y,
                seconds(times[k]).to_lowercase(),
                extent(&truth[k]),
                extent(&estimated[k])
            );
            errors.push([raw, smooth, none]);
            if n < PAIRS.1 {
                frame(&mut marked[k], patch);
                rows[0].push((format!("PATCH {}, {}", n + 1, seconds(times[k])), cut_out(&photos[k], patch)));
                rows[1].push((format!("EQ. (12): {raw:.2}"), sheet::grey(&estimated[k])));
                rows[2].push(("TRUE PSF".into(), sheet::grey(&truth[k])));
            }
        }
    }
    let of = |k: usize| median(errors.iter().map(|e| e[k]).collect());
    table += &format!("| median | | | | {:.2} | {:.2} | {:.2} |", of(0), of(1), of(2));
    let mut all = vec![std::iter::zip(times, marked).map(|(t, p)| (format!("FRAME OF {}", seconds(t)), p)).collect()];
    all.extend(rows);
    Ok(Report {
        title: "Figure 4: PSFs from two blurred frames".into(),
        text: format!(
            "Scene chart, {w} x {h} pixels; {} and {} shaken, on the paper's grid; full well 4000 electrons, read noise 8, 8-bit sRGB. Eq. (12) is solved for each pair of \
             patches by itself (patches of {side} px, PSFs of {} x {} px): neither frame is sharp, and nothing is known of poses. Patches are chosen by the program. Latent \
             patch and PSFs may be shifted against each other without any change in eq. (12): each pair of PSFs is compared after the one shift that suits both best. \
             The error is the norm of the difference over the norm of the true PSF; the last column is that of assuming no blur at all.",
            seconds(times[0]).to_lowercase(),
            seconds(times[1]).to_lowercase(),
            2 * setup.radius + 1,
            2 * setup.radius + 1,
        ),
        table,
        picture: sheet::sheet(&all, 190),
    })
}

/// A pair of PSFs after the one shift that brings both nearest to `truth`, on its grid.
fn aligned(psfs: &[&Plane; 2], truth: &[Plane; 2]) -> [Plane; 2] {
    let centroid = |p: &Plane| Psf { radius: p.width / 2, values: p.clone() }.centroid();
    let apart = (0..2).map(|k| {
        let (t, e) = (centroid(&truth[k]), centroid(psfs[k]));
        DVec2::new(t.0 - e.0, t.1 - e.1)
    });
    let mut best = 0.5 * apart.sum::<DVec2>();
    let shifted = |s: DVec2| psfs.map(|p| moved(p, RADIUS, s));
    let cost = |s: DVec2| shifted(s).iter().zip(truth).map(|(a, b)| error(&smoothed(a), &smoothed(b)).powi(2)).sum::<f64>();
    let mut step = 1.0;
    while step > 0.05 {
        let around = (-3..=3).flat_map(|j| (-3..=3).map(move |i| (i, j)));
        let tried = around.map(|(i, j)| best + step * DVec2::new(f64::from(i), f64::from(j)));
        best = tried.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(best);
        step *= 0.5;
    }
    shifted(best)
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

fn cut_out(photo: &RgbImage, patch: &Patch) -> RgbImage {
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
