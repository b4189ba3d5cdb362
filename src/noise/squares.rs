//! The noise level by the means of squares, for files whose format has made the noise smooth: JPEG drops what is finest within squares of 8 × 8
//! pixels, here more and there less, and keeps their means.

use super::{MANY, NoiseModel, Quantile, Sample, bins, clear, fit, pairs, quantisation, rounding};
use crate::exposure::Frame;
use crate::image::{Plane, Rgb};
use crate::response::Response;
use rayon::prelude::*;

/// Side of the squares in pixels.
const SQUARE: usize = 8;
/// Squared differences have no texture to avoid where frames show the same in the same place: their middle stands for all, and that of one squared
/// normal number is this part of its expectation.
const MIDDLE: Quantile = Quantile { at: 0.5, of_noise: 0.4549 };
/// Part of the bins that the fitted line passes above.
const HALF: f64 = 0.5;
/// Variance over what a model says, on the whole, from which the model does not hold.
const SMOOTHED: f64 = 1.5;

/// The noise level of the frames `ids`, which show the same in the same place, if they have clearly more noise than `model` says: from the differences
/// between each and the next longer one, averaged over squares, from one square to the next. `None` where `model` does well or too little is unclipped.
pub fn of_squares(frames: &[Frame], exposures: &[Rgb], response: &Response, ids: &[usize], model: &NoiseModel) -> Option<NoiseModel> {
    let of_pair = |(i, j)| bins(differences(frames, exposures, response, i, j), &MIDDLE, MANY);
    let samples: Vec<Sample> = pairs(frames, ids.to_vec()).into_iter().flat_map(of_pair).collect();
    let (mut excess, mut count) = (0.0, 0.0);
    for s in &samples {
        excess += s.blocks * (s.variance / s.of(model)).ln();
        count += s.blocks;
    }
    if excess > SMOOTHED.ln() * count { fit(&samples, HALF) } else { None }
}

/// Squared differences of neighbouring squares of frame `i` less frame `j`, which is the longer one, all channels, as variances of single pixels.
fn differences(frames: &[Frame], exposures: &[Rgb], response: &Response, i: usize, j: usize) -> Vec<Sample> {
    let ratio = frames[i].exposure_time / frames[j].exposure_time;
    let levels = frames[i].levels.min(frames[j].levels);
    let of_channel = |c: usize| {
        let quantum = quantisation(response, c, levels);
        let means = means([&frames[i].intensity.0[c], &frames[j].intensity.0[c]], [&exposures[i].0[c], &exposures[j].0[c]], ratio);
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

/// Mean over each whole square of the shorter frame's exposure, and of it less `ratio` times the longer one's, where both are unclipped throughout.
fn means(intensities: [&Plane; 2], exposures: [&Plane; 2], ratio: f64) -> Vec<Option<(f64, f64)>> {
    let (columns, rows) = (exposures[0].width / SQUARE, exposures[0].height / SQUARE);
    let mean = |k: usize| {
        let (x, y) = (k % columns * SQUARE, k / columns * SQUARE);
        let (mut own, mut less) = (0.0, 0.0);
        for (i, j) in (y..y + SQUARE).flat_map(|j| (x..x + SQUARE).map(move |i| (i, j))) {
            if !intensities.iter().all(|z| clear(z, i, j)) {
                return None;
            }
            let [short, long] = exposures.map(|e| f64::from(e.at(i, j)));
            own += short;
            less += short - ratio * long;
        }
        let n = (SQUARE * SQUARE) as f64;
        Some((own / n, less / n))
    };
    (0..columns * rows).map(mean).collect()
}
