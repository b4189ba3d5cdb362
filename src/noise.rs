//! Noise of an exposure x = f⁻¹(Z) (1 = white): variance = shot · x + read + (slope of f⁻¹ · step)²/12, and its level
//! estimated from the frames.

use crate::exposure::Frame;
use crate::image::{Plane, Rgb};
use crate::kernels::NOISE_STEPS;
use crate::response::Response;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

mod squares;

pub use squares::of_squares;

/// Shot and read noise of a camera at one sensitivity, in units of the exposure (1 = white).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoiseModel {
    /// Variance per unit of exposure: one over the full well in electrons.
    pub shot: f64,
    /// Variance of a black pixel: (read noise / full well)².
    pub read: f64,
}

impl NoiseModel {
    /// The model of a sensor with this full well and read noise, both in electrons.
    pub fn from_electrons(full_well: f64, read_noise: f64) -> Self {
        Self { shot: 1.0 / full_well, read: (read_noise / full_well).powi(2) }
    }

    /// Variance of the exposure `x` without quantisation.
    pub fn variance(&self, x: f64) -> f64 {
        self.shot * x.max(0.0) + self.read
    }

    /// Standard deviation, quantisation of `levels` steps through the response included, at [`NOISE_STEPS`] equal steps of
    /// √exposure from 0 to 1.
    pub fn curve(&self, response: &Response, channel: usize, levels: u32) -> Vec<f32> {
        let quantum = quantisation(response, channel, levels);
        (0..NOISE_STEPS)
            .map(|i| {
                let x = (i as f64 / (NOISE_STEPS - 1) as f64).powi(2);
                (self.variance(x) + quantum(x)).sqrt() as f32
            })
            .collect()
    }
}

/// [`NoiseModel::curve`] of each frame's channels.
pub fn curves(frames: &[Frame], response: &Response, model: &NoiseModel) -> Vec<[Vec<f32>; 3]> {
    frames.iter().map(|f| std::array::from_fn(|c| model.curve(response, c, f.levels))).collect()
}

/// What a [`NoiseModel::curve`] says at the exposure `x`: the sample below.
pub fn at(curve: &[f32], x: f32) -> f32 {
    curve[((x.clamp(0.0, 1.0).sqrt() * (NOISE_STEPS - 1) as f32) as usize).min(NOISE_STEPS - 1)]
}

/// Curve of the variance of the mean of a frame's channels, where all three have the same exposure.
pub fn of_mean(curves: &[Vec<f32>; 3]) -> Vec<f32> {
    (0..NOISE_STEPS).map(|i| curves.iter().map(|c| c[i] * c[i]).sum::<f32>() / 9.0).collect()
}

/// Variance of the exposure that rounding to `levels` steps of intensity adds, as a function of the exposure.
fn quantisation(response: &Response, channel: usize, levels: u32) -> impl Fn(f64) -> f64 {
    let step = 1.0 / f64::from(levels);
    let n = 1024;
    let table: Vec<f64> = (0..=n).map(|i| response.inverse(channel, i as f64 / n as f64)).collect();
    let slopes: Vec<f64> = (0..=n).map(|i| response.inverse_slope(channel, i as f64 / n as f64, step)).collect();
    move |x| {
        let i = table.partition_point(|&t| t < x).min(n);
        (slopes[i] * step).powi(2) / 12.0
    }
}

/// Variance by `quantum` of a frame at `exposure`, or of it less `ratio` times a longer one that shows the same.
fn rounding(quantum: &impl Fn(f64) -> f64, exposure: f64, ratio: f64) -> f64 {
    quantum(exposure) + if ratio > 0.0 { ratio * ratio * quantum(exposure / ratio) } else { 0.0 }
}

/// The frames `ids`, each with the next longer one.
fn pairs(frames: &[Frame], mut ids: Vec<usize>) -> Vec<(usize, usize)> {
    ids.sort_by(|&i, &j| frames[i].exposure_time.total_cmp(&frames[j].exposure_time));
    ids.windows(2).map(|p| (p[0], p[1])).collect()
}

/// Exposures f⁻¹(Z) of a frame.
pub fn exposure(frame: &Frame, response: &Response) -> Rgb {
    // Few distinct intensities: one table instead of a power per pixel.
    let n = frame.levels as usize;
    Rgb(std::array::from_fn(|c| {
        let table: Vec<f32> = (0..=n).map(|i| response.inverse(c, i as f64 / n as f64) as f32).collect();
        frame.intensity.0[c].map(|z| table[((z * n as f32).round() as usize).min(n)])
    }))
}

/// Side of the blocks whose variance is measured, pixels.
const BLOCK: usize = 8;
/// Blocks of one channel that are enough to tell the noise by, about.
const ENOUGH: usize = 60_000;
/// Quantile of variances that is taken for noise alone.
struct Quantile {
    at: f64,
    /// That quantile of noise over its expectation.
    of_noise: f64,
}

/// That of the variances of blocks, as texture only ever adds; for the mean square of 64 samples of filtered white noise (2·10⁴ simulated blocks).
const FLATTEST: Quantile = Quantile { at: 0.05, of_noise: 0.554 };

/// Noise level of a bracket's frames, from the high-pass variance of their flattest blocks at each exposure and of the flattest blocks of
/// the differences between each frame and the next longer one.
///
/// The high-pass is the difference of two Laplacians (Immerkær 1996), which removes planes; blocks of all frames and
/// channels are pooled, since shot and read noise depend on the exposure alone; blurred frames contribute most, as blur
/// removes texture but not noise. Where two frames show the same scene in the same place, their difference has no texture left; where they
/// do not, it has more, and texture never lowers a variance. Samples that others at a like exposure undercut are left out, where
/// no file format may have smoothed these: where bright parts are all texture and dark ones black, few blocks tell the noise. Falls back to a full well
/// of 10 000 e⁻ and read noise of 5 e⁻ when no block is usable.
pub fn estimate(frames: &[Frame], exposures: &[Rgb], response: &Response) -> NoiseModel {
    let at_lag = |lag| {
        let samples = samples(frames, exposures, response, lag);
        let many: Vec<Sample> = samples.iter().filter(|s| s.blocks >= MANY as f64).copied().collect();
        fit(&many, BELOW).map(|model| (samples, model))
    };
    match (at_lag(1), at_lag(COARSE_LAG)) {
        // White noise reads the same at both lags, texture only lifts the coarse one a little.
        (Some((_, fine)), Some((_, coarse))) if MID_EXPOSURES.iter().all(|&x| coarse.variance(x) > CORRELATED * fine.variance(x)) => coarse,
        (Some((samples, fine)), _) if !frames.iter().any(|f| f.lossy) => fit(&untextured(&samples, &fine), BELOW).unwrap_or(fine),
        (Some((_, fine)), _) => fine,
        (None, Some((_, coarse))) => coarse,
        (None, None) => NoiseModel::from_electrons(10_000.0, 5.0),
    }
}

/// Distance in pixels of the taps of the second high-pass, for noise that a file format has made smooth.
const COARSE_LAG: usize = 3;
/// Ratio of the two variances from which the noise counts as smoothed (JPEG drops the finest structure).
const CORRELATED: f64 = 2.5;
/// Exposures at which they are compared.
const MID_EXPOSURES: [f64; 2] = [0.02, 0.2];

/// Variance of what was looked at, and what the noise model says of it: `variance = shot · shots + read · reads`.
#[derive(Clone, Copy)]
struct Sample {
    exposure: f64,
    shots: f64,
    reads: f64,
    variance: f64,
    blocks: f64,
}

impl Sample {
    /// One block at `exposure` of a frame, or of a frame less `ratio` times a longer one; 0 where it is the frame alone.
    fn new(exposure: f64, ratio: f64, variance: f64) -> Self {
        // The longer frame has 1/ratio times the exposure, and its variance counts ratio² times.
        Self { exposure, shots: exposure * (1.0 + ratio), reads: 1.0 + ratio * ratio, variance, blocks: 1.0 }
    }

    /// What `model` says of the variance.
    fn of(&self, model: &NoiseModel) -> f64 {
        model.shot * self.shots + model.read * self.reads
    }
}

/// One channel of a frame, or of a frame less `ratio` times the next longer one.
struct Source<'a> {
    intensity: &'a Plane,
    exposure: &'a Plane,
    less: Option<(&'a Plane, &'a Plane, f64)>,
}

/// Samples of all frames and of all differences.
fn samples(frames: &[Frame], exposures: &[Rgb], response: &Response, lag: usize) -> Vec<Sample> {
    let source = |i: usize, c: usize| Source { intensity: &frames[i].intensity.0[c], exposure: &exposures[i].0[c], less: None };
    let each = |i: usize| {
        let blocks =
            (0..3).into_par_iter().flat_map_iter(|c| collect_blocks(&source(i, c), lag, &quantisation(response, c, frames[i].levels)));
        blocks.collect::<Vec<Sample>>()
    };
    let of_frames = bins((0..frames.len()).flat_map(each).collect(), &FLATTEST, FEWEST);
    let of_differences = pairs(frames, (0..frames.len()).collect()).into_iter().flat_map(|(i, j)| {
        let ratio = frames[i].exposure_time / frames[j].exposure_time;
        let differences = (0..3).into_par_iter().flat_map_iter(|c| {
            let less = Some((&frames[j].intensity.0[c], &exposures[j].0[c], ratio));
            let levels = frames[i].levels.min(frames[j].levels);
            collect_blocks(&Source { less, ..source(i, c) }, lag, &quantisation(response, c, levels))
        });
        bins(differences.collect(), &FLATTEST, FEWEST)
    });
    of_frames.into_iter().chain(of_differences).collect()
}

/// Exposures up to this factor apart count as alike.
const ALIKE: f64 = 1.5;
/// A sample shows texture where another has less than this part of its variance, both relative to the noise model.
const UNDERCUT: f64 = 0.75;

/// The samples that no other at a like exposure undercuts.
fn untextured(samples: &[Sample], model: &NoiseModel) -> Vec<Sample> {
    let relative: Vec<(f64, f64)> = samples.iter().map(|s| (s.exposure, s.variance / s.of(model))).collect();
    let undercut = |&(x, v): &(f64, f64)| relative.iter().any(|&(y, u)| (x / y).max(y / x) < ALIKE && u < UNDERCUT * v);
    samples.iter().zip(&relative).filter(|(_, r)| !undercut(r)).map(|(s, _)| *s).collect()
}

/// Blocks that a bin has at least, for a level by itself and for one that is known roughly.
const MANY: usize = 60;
const FEWEST: usize = 30;

/// Quantiles of bins of equal population along the exposure, of at least `fewest` blocks, none wider than a factor of 1.5.
fn bins(mut blocks: Vec<Sample>, quantile: &Quantile, fewest: usize) -> Vec<Sample> {
    blocks.sort_by(|a, b| a.exposure.total_cmp(&b.exposure));
    let mut samples = Vec::new();
    let mut i = 0;
    while i < blocks.len() {
        let end = blocks[i..].partition_point(|b| b.exposure <= 1.5 * blocks[i].exposure) + i;
        let end = end.min(i + (blocks.len() / 40).max(200));
        if end - i >= fewest {
            let part = &blocks[i..end];
            let mut v: Vec<f64> = part.iter().map(|b| b.variance).collect();
            v.sort_by(f64::total_cmp);
            let mean = |f: fn(&Sample) -> f64| part.iter().map(f).sum::<f64>() / part.len() as f64;
            let variance = v[(quantile.at * v.len() as f64) as usize] / quantile.of_noise;
            if variance > 0.0 {
                let (exposure, shots, reads) = (mean(|b| b.exposure), mean(|b| b.shots), mean(|b| b.reads));
                samples.push(Sample { exposure, shots, reads, variance, blocks: part.len() as f64 });
            }
        }
        i = end;
    }
    samples
}

/// Whether a pixel is clipped neither in black nor, for certain, in white.
fn clear(intensity: &Plane, i: usize, j: usize) -> bool {
    intensity.at(i, j) > 0.0 && intensity.at(i, j) < 0.95
}

/// High-pass variance of the blocks that no clipping touches, of [`ENOUGH`] that are spread over the frame where it has more.
fn collect_blocks(source: &Source, lag: usize, quantum: &(impl Fn(f64) -> f64 + Sync)) -> Vec<Sample> {
    let (w, h) = source.exposure.size();
    let step = BLOCK * (w * h / (BLOCK * BLOCK)).div_ceil(ENOUGH).isqrt().max(1);
    let row = |by: usize| {
        let mut blocks = Vec::new();
        for bx in (lag..w.saturating_sub(BLOCK + lag - 1)).step_by(step) {
            let mut around = (by - lag..by + BLOCK + lag).flat_map(|j| (bx - lag..bx + BLOCK + lag).map(move |i| (i, j)));
            let usable = |(i, j): (usize, usize)| clear(source.intensity, i, j) && source.less.is_none_or(|l| clear(l.0, i, j));
            if !around.all(usable) {
                continue;
            }
            let value = |x: usize, y: usize| {
                let own = f64::from(source.exposure.at(x, y));
                source.less.map_or(own, |(_, longer, ratio)| own - ratio * f64::from(longer.at(x, y)))
            };
            let (mut sum, mut square) = (0.0, 0.0);
            for j in by..by + BLOCK {
                for i in bx..bx + BLOCK {
                    let at = |dx: usize, dy: usize| value(i + dx * lag - lag, j + dy * lag - lag);
                    let corners = at(0, 0) + at(2, 0) + at(0, 2) + at(2, 2);
                    let sides = at(1, 0) + at(0, 1) + at(2, 1) + at(1, 2);
                    square += (corners - 2.0 * sides + 4.0 * at(1, 1)).powi(2) / 36.0;
                    sum += f64::from(source.exposure.at(i, j));
                }
            }
            let n = (BLOCK * BLOCK) as f64;
            let (exposure, square) = (sum / n, square / n);
            let ratio = source.less.map_or(0.0, |l| l.2);
            blocks.push(Sample::new(exposure, ratio, (square - rounding(quantum, exposure, ratio)).max(0.0)));
        }
        blocks
    };
    let rows = h.saturating_sub(BLOCK + 2 * lag - 1).div_ceil(step);
    (0..rows).into_par_iter().flat_map_iter(|n| row(lag + n * step)).collect()
}

/// Part of the flattest blocks' samples that the fitted line passes above: texture lifts samples, and only samples of few blocks fall below.
const BELOW: f64 = 0.15;

/// Quantile regression of variance = shot · x + read in logarithms, by search over both parameters, each step finer.
///
/// `below`: part of the samples that the line passes above.
fn fit(samples: &[Sample], below: f64) -> Option<NoiseModel> {
    if samples.is_empty() {
        return None;
    }
    let loss = |shot: f64, read: f64| -> f64 {
        samples
            .iter()
            .map(|s| {
                let r = (s.variance / s.of(&NoiseModel { shot, read })).ln();
                s.blocks * if r > 0.0 { below * r } else { (below - 1.0) * r }
            })
            .sum()
    };
    // Full wells of 100 to 10⁷ e⁻; read noise from that of a perfect sensor to a tenth of white.
    let (mut shot, mut read) = ((1e-7f64.ln(), 1e-2f64.ln()), (1e-10f64.ln(), 1e-2f64.ln()));
    let mut best = (f64::INFINITY, 0.0, 0.0);
    for _ in 0..4 {
        const STEPS: usize = 48;
        let at = |range: (f64, f64), i: usize| range.0 + (range.1 - range.0) * i as f64 / STEPS as f64;
        for i in 0..=STEPS {
            for j in 0..=STEPS {
                let (a, b) = (at(shot, i), at(read, j));
                let l = loss(a.exp(), b.exp());
                if l < best.0 {
                    best = (l, a, b);
                }
            }
        }
        let around = |range: (f64, f64), c: f64| {
            let half = 3.0 * (range.1 - range.0) / STEPS as f64;
            (c - half, c + half)
        };
        (shot, read) = (around(shot, best.1), around(read, best.2));
    }
    Some(NoiseModel { shot: best.1.exp(), read: best.2.exp() })
}
