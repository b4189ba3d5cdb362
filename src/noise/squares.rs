//! The noise level by the means of squares, for files whose format has made the noise smooth: JPEG drops what is finest within squares of 8 × 8
//! pixels, here more and there less, and keeps their means.

use super::{MANY, NoiseModel, Quantile, Sample, bins, clear, fit, pairs, quantisation, rounding};
use crate::exposure::Frame;
use crate::image::{Plane, Rgb};
use crate::pose::project;
use crate::response::Response;
use crate::sampling::bilinear;
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Side of the squares in pixels.
const SQUARE: usize = 8;
/// Squared differences have no texture to avoid where frames show the same in the same place: their middle stands for all, and that of one squared
/// normal number is this part of its expectation.
const MIDDLE: Quantile = Quantile { at: 0.5, of_noise: 0.4549 };
/// Exposure from which what the format makes of edges (colour at half the resolution, rounding by the square) weighs as much as noise does and more: of sharp frames
/// in place the variance is 0.8 to 1.5 times the sensor's below and up to 5 above, of displaced ones up to 14.
const DARK: f64 = 0.02;
/// So many bins below tell a line by themselves.
const ENOUGH_DARK: usize = 3;
/// Part of the bins that the fitted line passes above.
const HALF: f64 = 0.5;
/// Variance over what a model says, on the whole, from which the model does not hold.
const SMOOTHED: f64 = 1.5;
/// The same from which frames that lie in different places differ by more than noise: their registration is not quite true, or something moved. JPEG takes up
/// to six sevenths of the noise; displaced frames of a benchmark measure 1.1 to 5.5, those of a photographed night (arch, trees and clouds) 17 at their full
/// size, 10 at half and 40 at a sixth of it.
const MOST_SMOOTHED: f64 = 7.0;

/// The noise level of the frames `ids`, which show the same where each lies by `motions` (from one grid to that of every frame, centred pixels), if they have
/// clearly more noise than `model` says: from the differences between each and the next longer one, averaged over squares, from one square to the next.
/// `None` where `model` does well, too little is unclipped, or displaced frames differ by more than noise.
pub fn of_squares(
    frames: &[Frame],
    exposures: &[Rgb],
    response: &Response,
    ids: &[usize],
    motions: &[DMat3],
    model: &NoiseModel,
) -> Option<NoiseModel> {
    let of_pair = |(i, j): (usize, usize)| {
        let in_place = motions[i] == motions[j];
        let motion = if in_place { DMat3::IDENTITY } else { motions[j] * motions[i].inverse() };
        let all = bins(differences(frames, exposures, response, i, j, &motion), &MIDDLE, MANY);
        all.into_iter().filter(move |s| in_place || s.exposure < DARK)
    };
    let mut samples: Vec<Sample> = pairs(frames, ids.to_vec()).into_iter().flat_map(of_pair).collect();
    if samples.iter().filter(|s| s.exposure < DARK).count() >= ENOUGH_DARK {
        samples.retain(|s| s.exposure < DARK);
    }
    let (mut excess, mut count) = (0.0, 0.0);
    for s in &samples {
        excess += s.blocks * (s.variance / s.of(model)).ln();
        count += s.blocks;
    }
    let displaced = ids.iter().any(|&i| motions[i] != motions[ids[0]]);
    let most = if displaced { MOST_SMOOTHED } else { f64::INFINITY };
    (excess > SMOOTHED.ln() * count && excess < most.ln() * count).then(|| fit(&samples, HALF)).flatten()
}

/// Squared differences of neighbouring squares of frame `i` less frame `j`, which is the longer one and lies at `motion` from it, all channels, as variances of
/// single pixels. Interpolation between the longer one's pixels takes up to an eighth of its part, which is the lesser, and is not made up for.
fn differences(frames: &[Frame], exposures: &[Rgb], response: &Response, i: usize, j: usize, motion: &DMat3) -> Vec<Sample> {
    let ratio = frames[i].exposure_time / frames[j].exposure_time;
    let levels = frames[i].levels.min(frames[j].levels);
    let of_channel = |c: usize| {
        let quantum = quantisation(response, c, levels);
        let means = means([&frames[i].intensity.0[c], &frames[j].intensity.0[c]], [&exposures[i].0[c], &exposures[j].0[c]], ratio, motion);
        let columns = exposures[i].width() / SQUARE;
        let sample = |(a, b): (&(f64, f64), &(f64, f64))| {
            let exposure = 0.5 * (a.0 + b.0);
            let square = 0.5 * (a.1 - b.1).powi(2) * (SQUARE * SQUARE) as f64;
            // The quantile is divided by its part of the expectation later on.
            Sample::new(exposure, ratio, (square - MIDDLE.of_noise * rounding(&quantum, exposure, ratio)).max(0.0))
        };
        let pair = |k: usize, next: usize| Some(sample((means[k].as_ref()?, means.get(next)?.as_ref()?)));
        let across = (0..means.len()).filter(|k| (k + 1) % columns != 0).filter_map(|k| pair(k, k + 1));
        across.chain((0..means.len()).filter_map(|k| pair(k, k + columns))).collect::<Vec<_>>()
    };
    (0..3).into_par_iter().flat_map_iter(of_channel).collect()
}

/// Mean over each whole square of the shorter frame's exposure, and of it less `ratio` times that of the longer one, which lies at `motion` from it, where both are
/// unclipped throughout.
fn means(intensities: [&Plane; 2], exposures: [&Plane; 2], ratio: f64, motion: &DMat3) -> Vec<Option<(f64, f64)>> {
    let (width, height) = exposures[0].size();
    let (columns, rows) = (width / SQUARE, height / SQUARE);
    let centre = 0.5 * DVec2::new(width as f64 - 1.0, height as f64 - 1.0);
    // The longer frame's exposure where the shorter one's pixel lies, if it is unclipped.
    let longer = |x: usize, y: usize| -> Option<f64> {
        if *motion == DMat3::IDENTITY {
            return clear(intensities[1], x, y).then(|| f64::from(exposures[1].at(x, y)));
        }
        let q = project(motion, DVec2::new(x as f64, y as f64) - centre) + centre;
        if !(q.x >= 0.0 && q.y >= 0.0 && q.x < (width - 1) as f64 && q.y < (height - 1) as f64) {
            return None;
        }
        let (i, j) = (q.x as usize, q.y as usize);
        let all = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)].iter().all(|&(i, j)| clear(intensities[1], i, j));
        all.then(|| f64::from(bilinear(exposures[1], q)))
    };
    let mean = |k: usize| {
        let (x, y) = (k % columns * SQUARE, k / columns * SQUARE);
        let (mut own, mut less) = (0.0, 0.0);
        for (i, j) in (y..y + SQUARE).flat_map(|j| (x..x + SQUARE).map(move |i| (i, j))) {
            if !clear(intensities[0], i, j) {
                return None;
            }
            let short = f64::from(exposures[0].at(i, j));
            own += short;
            less += short - ratio * longer(i, j)?;
        }
        let n = (SQUARE * SQUARE) as f64;
        Some((own / n, less / n))
    };
    (0..columns * rows).map(mean).collect()
}
