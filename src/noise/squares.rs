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
/// Exposure up to which the flattest squares of displaced frames are of use.
const FLAT: f64 = 0.1;
/// So many bins below tell a line by themselves.
const ENOUGH_DARK: usize = 3;
/// Part of the bins that the fitted line passes above.
const HALF: f64 = 0.5;
/// Variance over what a model says, on the whole, from which the model does not hold.
const SMOOTHED: f64 = 1.5;
/// The most that displaced frames are believed to have, over what the model says: beyond, something moved. JPEG takes up to thirteen fourteenths of the noise, and what pixels
/// alias, up to five times the sensor's variance in squares, is an error of theirs as well.
const MOST_SMOOTHED: f64 = 50.0;

/// The noise level of the frames `ids`, which show the same where each lies by `motions` (from one grid to that of every frame, centred pixels), if they have
/// clearly more noise than `model` says: from the differences between each and the next longer one, averaged over squares, from one square to the next. Of displaced
/// frames, and where they are not known to be `sharp`, the flattest squares, of which a registration that is not quite true and blur change the least, tell by how much there is
/// more; they are too few to tell shot noise from read noise.
/// `None` where `model` does well or too little is unclipped.
pub fn of_squares(
    frames: &[Frame],
    exposures: &[Rgb],
    response: &Response,
    ids: &[usize],
    motions: &[DMat3],
    sharp: bool,
    model: &NoiseModel,
) -> Option<NoiseModel> {
    let of_pair = |(i, j): (usize, usize)| {
        let in_place = motions[i] == motions[j];
        let motion = if in_place { DMat3::IDENTITY } else { motions[j] * motions[i].inverse() };
        let all_tell = sharp && in_place;
        let mut found = differences(frames, exposures, response, (i, j), &motion, sharp);
        if !all_tell {
            found = flattest(found);
        }
        let all = bins(found.into_iter().map(|d| d.sample).collect(), &MIDDLE, MANY);
        all.into_iter().filter(move |s| all_tell || s.exposure < FLAT)
    };
    let mut samples: Vec<Sample> = pairs(frames, ids.to_vec()).into_iter().flat_map(of_pair).collect();
    let all_tell = sharp && ids.iter().all(|&i| motions[i] == motions[ids[0]]);
    if all_tell && samples.iter().filter(|s| s.exposure < DARK).count() >= ENOUGH_DARK {
        samples.retain(|s| s.exposure < DARK);
    }
    let (mut excess, mut count) = (0.0, 0.0);
    for s in &samples {
        excess += s.blocks * (s.variance / s.of(model)).ln();
        count += s.blocks;
    }
    if samples.is_empty() || excess <= SMOOTHED.ln() * count {
        return None;
    }
    if all_tell {
        return fit(&samples, HALF);
    }
    let more = (excess / count).exp().min(MOST_SMOOTHED);
    Some(NoiseModel { shot: more * model.shot, read: more * model.read })
}

/// What two neighbouring squares say of the noise.
struct Difference {
    sample: Sample,
    /// Mean square over squared mean of the longer frame's exposure, in the square where that is larger; of either frame's where they are not known to be sharp, since blur
    /// makes squares flat.
    contrast: f64,
}

/// Squared differences of neighbouring squares of frame `i` less frame `j`, which is the longer one and lies at `motion` from it, all channels, as variances of
/// single pixels. Interpolation between the longer one's pixels takes up to an eighth of its part, which is the lesser, and is not made up for.
fn differences(
    frames: &[Frame],
    exposures: &[Rgb],
    response: &Response,
    (i, j): (usize, usize),
    motion: &DMat3,
    sharp: bool,
) -> Vec<Difference> {
    let ratio = frames[i].exposure_time / frames[j].exposure_time;
    let levels = frames[i].levels.min(frames[j].levels);
    let of_channel = |c: usize| {
        let quantum = quantisation(response, c, levels);
        let means = means([&frames[i].intensity.0[c], &frames[j].intensity.0[c]], [&exposures[i].0[c], &exposures[j].0[c]], ratio, motion);
        let columns = exposures[i].width() / SQUARE;
        let difference = |(a, b): (&Square, &Square)| {
            let exposure = 0.5 * (a.own + b.own);
            let square = 0.5 * (a.less - b.less).powi(2) * (SQUARE * SQUARE) as f64;
            // The quantile is divided by its part of the expectation later on.
            let variance = (square - MIDDLE.of_noise * rounding(&quantum, exposure, ratio)).max(0.0);
            let contrast = |s: &Square| if sharp { s.contrast } else { s.contrast.max(s.own_contrast) };
            Difference { sample: Sample::new(exposure, ratio, variance), contrast: contrast(a).max(contrast(b)) }
        };
        let pair = |k: usize, next: usize| Some(difference((means[k].as_ref()?, means.get(next)?.as_ref()?)));
        let across = (0..means.len()).filter(|k| (k + 1) % columns != 0).filter_map(|k| pair(k, k + 1));
        across.chain((0..means.len()).filter_map(|k| pair(k, k + columns))).collect::<Vec<_>>()
    };
    (0..3).into_par_iter().flat_map_iter(of_channel).collect()
}

/// The third of `all`, among those of like exposure, whose squares are the flattest.
fn flattest(mut all: Vec<Difference>) -> Vec<Difference> {
    all.sort_by(|a, b| a.sample.exposure.total_cmp(&b.sample.exposure));
    let mut kept = Vec::with_capacity(all.len() / 3 + 1);
    let mut rest = all.into_iter().peekable();
    while rest.peek().is_some() {
        let mut alike: Vec<Difference> = rest.by_ref().take(3 * MANY).collect();
        alike.sort_by(|a, b| a.contrast.total_cmp(&b.contrast));
        alike.truncate(alike.len().div_ceil(3));
        kept.append(&mut alike);
    }
    kept
}

/// Means over a square.
struct Square {
    /// Of the shorter frame's exposure.
    own: f64,
    /// Of that less the ratio of the exposure times as often the longer frame's.
    less: f64,
    /// Mean square of the longer frame's exposure over its squared mean.
    contrast: f64,
    /// The same of the shorter frame.
    own_contrast: f64,
}

/// Each whole square of the shorter frame beside the longer one, which lies at `motion` from it, where both are unclipped throughout.
fn means(intensities: [&Plane; 2], exposures: [&Plane; 2], ratio: f64, motion: &DMat3) -> Vec<Option<Square>> {
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
        let (mut own, mut own_squares, mut longer_one, mut squares) = (0.0, 0.0, 0.0, 0.0);
        for (i, j) in (y..y + SQUARE).flat_map(|j| (x..x + SQUARE).map(move |i| (i, j))) {
            if !clear(intensities[0], i, j) {
                return None;
            }
            let (shorter, value) = (f64::from(exposures[0].at(i, j)), longer(i, j)?);
            own += shorter;
            own_squares += shorter * shorter;
            longer_one += value;
            squares += value * value;
        }
        let n = (SQUARE * SQUARE) as f64;
        let contrast = |sum: f64, squares: f64| n * squares / (sum * sum);
        Some(Square {
            own: own / n,
            less: (own - ratio * longer_one) / n,
            contrast: contrast(longer_one, squares),
            own_contrast: contrast(own, own_squares),
        })
    };
    (0..columns * rows).map(mean).collect()
}
