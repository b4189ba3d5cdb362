//! Local PSFs of a study: the true ones by eq. (5), those of eq. (11), and how far they are apart.

use super::study::{Events, Method, Study};
use crate::error::Result;
use crate::exposure::Bracket;
use crate::image::{Channels, Plane, Rgb};
use crate::mask;
use crate::merge::gradient_level;
use crate::noise;
use crate::psf::{self, Patch, Psf};
use crate::response::Response;

/// Patches per frame.
const PATCHES: usize = 9;
/// Side of a patch, pixels.
const SIZE: usize = 96;
/// Largest |u| of a PSF: the grid's 12 px, and what the roll adds towards the corners.
pub(super) const RADIUS: usize = 15;
/// Standard deviation of the blur model's own error, as a part of the mean absolute gradient around a pixel.
const MODEL_ERROR: f32 = 0.03;

/// Irradiance of frame `i` (mean of the channels) and its inverse variance, 0 where it is clipped. `latent`: the scene as far as it is known.
pub(super) fn seen(bracket: &Bracket, response: &Response, i: usize, latent: &Plane) -> (Plane, Plane) {
    let frames = bracket.frames();
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, response)).collect();
    let level = noise::estimate(frames, &exposures, response);
    let dt = frames[i].exposure_time as f32;
    let (clipped, local, exposure) = (mask::clipped(&frames[i], Channels::ALL), gradient_level(latent, 4), exposures[i].mean());
    let weight = |p: usize| {
        let x = exposure.data[p];
        let variance = level[i].variance_of_mean(Channels::ALL, f64::from(x)) as f32 / (dt * dt) + (MODEL_ERROR * local.data[p]).powi(2);
        if clipped[p] { 0.0 } else { 1.0 / variance }
    };
    let weight = Plane { data: (0..exposure.data.len()).map(weight).collect(), ..exposure };
    (exposure.map(|v| v / dt), weight)
}

/// Patches of the shaken frame `i` and their PSFs by eq. (11) against the sharp frames; nothing is known of the TSF.
pub(super) fn measured(study: &Study, i: usize, events: Events) -> Result<Vec<(Patch, Psf)>> {
    let latent = study.result(Method::Denoised, events)?.mean();
    let (blurred, weight) = seen(&study.made.bracket, &study.response, i, &latent);
    let (w, h) = latent.size();
    let patches = psf::choose(&latent, &weight, SIZE.min(w / 2).min(h / 2), PATCHES);
    let of = |p: Patch| psf::estimate(&latent, 0, &blurred, &weight, &p, RADIUS).map(|psf| (p, psf));
    Ok(patches.into_iter().filter_map(of).collect())
}

/// Mean over 3 x 3 pixels, weights 1 2 1: what a pixel's worth of displacement cannot change much.
pub(super) fn smoothed(p: &Plane) -> Plane {
    let inside = |x: isize, y: isize| {
        if x < 0 || y < 0 || x >= p.width as isize || y >= p.height as isize { 0.0 } else { p.at(x as usize, y as usize) }
    };
    Plane::from_fn(p.width, p.height, |x, y| {
        let tap = |i: isize, j: isize| ((2 - i.abs()) * (2 - j.abs())) as f32 / 16.0 * inside(x as isize + i, y as isize + j);
        (-1..=1).flat_map(|j| (-1..=1).map(move |i| (i, j))).map(|(i, j)| tap(i, j)).sum()
    })
}

/// Norm of the difference over the norm of the truth.
pub(super) fn error(a: &Plane, truth: &Plane) -> f64 {
    let norm = |v: &mut dyn Iterator<Item = f32>| v.map(|v| f64::from(v).powi(2)).sum::<f64>().sqrt();
    norm(&mut a.data.iter().zip(&truth.data).map(|(a, b)| a - b)) / norm(&mut truth.data.iter().copied()).max(1e-12)
}

/// Median; NaN of nothing.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
