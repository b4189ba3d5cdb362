//! Noise of an exposure x = f⁻¹(Z) (1 = white), estimated from each frame by itself: variance = shot · x + read + (slope of f⁻¹ · step)²/12.
//!
//! What counts for everything that averages pixels is the noise *density*: the variance of a mean of n pixels times n. A demosaiced pixel shares its noise with
//! its neighbours, and a camera's engine smooths it further; the density stays what the sensor made it, while the variance of differences between
//! neighbours falls to a tenth (green of a converter's file), to a three hundredth (JPEG). So the density is measured on means of squares of [`MIDDLE`] and
//! [`COARSE`] pixels as well as on pixels.
//!
//! Texture passes for noise where no part of a picture is flat. Once the frames are placed it is told by the others, which show it as well ([`estimate_registered`]).

use crate::exposure::Frame;
use crate::image::{Channels, Plane, Rgb};
use crate::kernels::NOISE_STEPS;
use crate::response::Response;
use beside::Shown;
use glam::DMat3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::Range;

mod beside;

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

    /// About how much the mean of exposures `x` rises where their noise is clipped at black (an upper bound: 0.40 σ at 0, 0.15 σ at one σ, where it is 0.08).
    pub fn clipping_bias(&self, x: f64) -> f64 {
        let deviation = self.variance(x).sqrt();
        0.4 * deviation * (-x.max(0.0) / deviation.max(f64::MIN_POSITIVE)).exp()
    }

    /// So many times the variance.
    fn times(&self, factor: f64) -> Self {
        Self { shot: factor * self.shot, read: factor * self.read }
    }

    /// Variance of the exposure `x` without quantisation.
    pub fn variance(&self, x: f64) -> f64 {
        self.shot * x.max(0.0) + self.read
    }

    /// Standard deviation, quantisation of `levels` steps through the response included, at [`NOISE_STEPS`] equal steps of
    /// √exposure from 0 to 1.
    pub fn curve(&self, response: &Response, channel: usize, levels: u32) -> Vec<f32> {
        self.curve_times(1.0, response, channel, levels)
    }

    /// [`NoiseModel::curve`] of exposures that were multiplied by `gain`, whose noise this is.
    fn curve_times(&self, gain: f64, response: &Response, channel: usize, levels: u32) -> Vec<f32> {
        let quantum = quantisation(response, channel, levels);
        (0..NOISE_STEPS)
            .map(|i| {
                let x = (i as f64 / (NOISE_STEPS - 1) as f64).powi(2);
                (self.variance(x) + gain * gain * quantum(x / gain)).sqrt() as f32
            })
            .collect()
    }
}

/// Noise of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameNoise {
    /// Of red, green and blue: the density, as the variance that a pixel of white noise would have.
    pub channels: [NoiseModel; 3],
    /// The same of the mean of the three.
    pub luminance: NoiseModel,
    /// The luminance's density over what its finest structure shows of it: 1 where the noise is white.
    pub correlation: f64,
}

impl FrameNoise {
    /// White noise, alike in all channels.
    pub fn white(model: NoiseModel) -> Self {
        let luminance = NoiseModel { shot: model.shot / 3.0, read: model.read / 3.0 };
        Self { channels: [model; 3], luminance, correlation: 1.0 }
    }

    /// That of the exposures times `factors`, one per channel.
    #[must_use]
    pub fn scaled(&self, factors: [f64; 3]) -> Self {
        let scaled = |NoiseModel { shot, read }: NoiseModel, s: f64| NoiseModel { shot: s * shot, read: s * s * read };
        Self {
            channels: std::array::from_fn(|c| scaled(self.channels[c], factors[c])),
            luminance: scaled(self.luminance, factors.iter().sum::<f64>() / 3.0),
            ..*self
        }
    }

    /// Part of the density that differences over `scale` pixels of means of `scale` × `scale` pixels show. White noise behind a Gaussian whose standard deviation makes the
    /// finest second differences show a part 1/c of the density shows c^-0.60, c^-0.255 and c^-0.112 of it at 1, 2 and 4 pixels (c from 3 to 2000, computed from the
    /// spectra, within a tenth).
    pub fn share(&self, scale: usize) -> f64 {
        let power = match scale {
            1 => -FINEST,
            2 | 3 => -0.255,
            _ => -0.112,
        };
        self.correlation.powf(power)
    }

    /// Noise as structure of about two pixels shows it: what registration and searches for blur look at.
    #[must_use]
    pub fn of_detail(&self) -> Self {
        let share = self.share(2);
        let less = |NoiseModel { shot, read }: NoiseModel| NoiseModel { shot: share * shot, read: share * read };
        Self { channels: self.channels.map(less), luminance: less(self.luminance), correlation: 1.0 }
    }

    /// That in the middle of several on a logarithmic scale; `None` of none.
    fn geometric_mean(of: &[Self]) -> Option<Self> {
        let middle =
            |value: &dyn Fn(&Self) -> f64| mean(&of.iter().map(|n| value(n).max(f64::MIN_POSITIVE).ln()).collect::<Vec<_>>()).map(f64::exp);
        let model = |m: &dyn Fn(&Self) -> NoiseModel| Some(NoiseModel { shot: middle(&|n| m(n).shot)?, read: middle(&|n| m(n).read)? });
        let [red, green, blue] = std::array::from_fn(|c| model(&|n| n.channels[c]));
        Some(Self { channels: [red?, green?, blue?], luminance: model(&|n| n.luminance)?, correlation: middle(&|n| n.correlation)? })
    }

    /// Variance of the mean of `channels`, each of which has the exposure `x`, without quantisation.
    pub fn variance_of_mean(&self, channels: Channels, x: f64) -> f64 {
        if channels == Channels::ALL {
            return self.luminance.variance(x);
        }
        let n = channels.count() as f64;
        channels.indices().map(|c| self.channels[c].variance(x)).sum::<f64>() / (n * n)
    }
}

/// `model` as the white noise of so many frames.
pub fn alike(frames: usize, model: NoiseModel) -> Vec<FrameNoise> {
    vec![FrameNoise::white(model); frames]
}

/// Standard deviation of the exposures of each frame's channels, see [`NoiseModel::curve`]; `gains`: what the exposures were multiplied by.
pub fn curves_of(frames: &[Frame], response: &Response, noise: &[FrameNoise], gains: &[[f64; 3]]) -> Vec<[Vec<f32>; 3]> {
    let one = |(f, (n, gain)): (&Frame, (&FrameNoise, &[f64; 3]))| {
        std::array::from_fn(|c| n.channels[c].curve_times(gain[c], response, c, f.levels))
    };
    frames.iter().zip(noise.iter().zip(gains)).map(one).collect()
}

/// [`curves_of`] exposures as they are.
pub fn curves(frames: &[Frame], response: &Response, noise: &[FrameNoise]) -> Vec<[Vec<f32>; 3]> {
    curves_of(frames, response, noise, &vec![[1.0; 3]; frames.len()])
}

/// What a [`NoiseModel::curve`] says at the exposure `x`: the sample below.
pub fn at(curve: &[f32], x: f32) -> f32 {
    curve[((x.clamp(0.0, 1.0).sqrt() * (NOISE_STEPS - 1) as f32) as usize).min(NOISE_STEPS - 1)]
}

/// Curve of the variance of the mean of `channels`, where all have the same exposure.
pub fn of_mean_of(curves: &[Vec<f32>; 3], channels: Channels) -> Vec<f32> {
    let n = channels.count() as f32;
    (0..NOISE_STEPS).map(|i| channels.indices().map(|c| curves[c][i] * curves[c][i]).sum::<f32>() / (n * n)).collect()
}

/// [`of_mean_of`] all channels.
pub fn of_mean(curves: &[Vec<f32>; 3]) -> Vec<f32> {
    of_mean_of(curves, Channels::ALL)
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

/// Exposures f⁻¹(Z) of a frame.
pub fn exposure(frame: &Frame, response: &Response) -> Rgb {
    // Few distinct intensities: one table instead of a power per pixel.
    let n = frame.levels as usize;
    Rgb(std::array::from_fn(|c| {
        let table: Vec<f32> = (0..=n).map(|i| response.inverse(c, i as f64 / n as f64) as f32).collect();
        frame.intensity.0[c].map(|z| table[((z * n as f32).round() as usize).min(n)])
    }))
}

/// Whether an intensity is not, for certain, clipped in white.
fn is_clear(z: f32) -> bool {
    z < 0.95
}

/// Part of a block's pixels that may read 0: noise clipped at black has lost little of its variance up to there, and a frame so noisy that every block holds some has no other.
const BLACK: f64 = 0.2;

/// Side of the blocks whose variance is measured: of pixels, and of means of squares of [`MIDDLE`] and of [`COARSE`] pixels.
const BLOCK: usize = 8;
const MIDDLE_BLOCK: usize = 4;
const COARSE_BLOCK: usize = 3;
/// Side in pixels of the squares whose means show the density of correlated noise: demosaicing and engines reach over about four pixels. On 24 random cameras
/// the density of green comes out right in the median (a quarter of it to three times), at a side of 2 ten times too low.
const COARSE: usize = 4;
/// Side of those by which the correlation is told: texture weighs less there, a tenth on textured scenes, and demosaiced noise shows about half of its density.
const MIDDLE: usize = 2;
/// Powers of c, the density of white noise behind a Gaussian over what second differences of pixels show of it, that second differences of means of [`MIDDLE`]² pixels show: of the density,
/// and over those of pixels (c from 5 to 300, computed from the spectra, within a tenth).
const SHOWN: f64 = -0.37;
const GROWTH: f64 = 1.0 + SHOWN;
/// Power of 1/c that pixels' differences show of the density.
const FINEST: f64 = 0.60;
/// Ratio of the two densities up to which noise counts as white: texture lifts the coarse one by up to that; demosaiced noise has ten.
const WHITE: f64 = 4.0;
/// Blocks of one channel that are enough to tell the noise by, about.
const ENOUGH: usize = 60_000;
/// Quantile of blocks that is taken for noise alone, as texture only ever adds.
const FLATTEST: f64 = 0.05;
/// That quantile of the mean square of so many squared samples of filtered white noise over its expectation (10⁶ simulated blocks).
const OF_NOISE: [(usize, f64); 3] = [(BLOCK, 0.555), (MIDDLE_BLOCK, 0.311), (COARSE_BLOCK, 0.214)];
/// Most that correlation is believed to be: beyond, the finest structure is what compression left of it. With it, the density of green at [`MIDDLE`] is right in the median on files of
/// random cameras' engines.
const MOST_CORRELATED: f64 = 300.0;
/// Blocks that a bin has at least.
const FEWEST: usize = 30;
/// Least variance at black as a part of that of the darkest blocks: nothing darker is free of clipping at black, so that a line through the samples may end
/// anywhere below.
const AT_BLACK: f64 = 0.2;
/// Most that the variance at black may be, times the shot noise's at white: read noise of 9 electrons beside a full well of 270. What the darkest blocks show beyond is texture.
const MOST_AT_BLACK: f64 = 0.3;
/// Least read noise, electrons, the full well being one over the shot noise's variance: where every dark block is clipped at black the samples do not show it.
const LEAST_READ: f64 = 2.0;
/// What is assumed where no frame has a usable block: full well and read noise of a small sensor at a middle speed, electrons.
const ASSUMED: (f64, f64) = (2000.0, 5.0);

/// Noise of each of `frames`, from the high-pass variance of its own flattest blocks at each exposure; what the frames of a bracket have in common counts for
/// each ([`reconciled`]).
///
/// The high-pass is the difference of two Laplacians (Immerkær 1996), which removes planes. It is taken of pixels and of means of [`MIDDLE`]² and [`COARSE`]² pixels; where
/// both others show a density more than [`WHITE`] times that of the first in three quarters of the exposures, neighbours share their noise. The density is then the lower one of what the
/// second shows, over the part that it shows of it, and of what the third shows: texture lifts either. Red and blue
/// sites are half as many as green ones and their gain is higher: where noise is correlated their density is at least green's, as chroma
/// is smoothed over more pixels than a square has.
pub fn estimate(frames: &[Frame], exposures: &[Rgb], response: &Response) -> Vec<FrameNoise> {
    let own = |i: usize| of_frame(Shown { frame: &frames[i], exposure: &exposures[i] }, &[], response);
    reconciled((0..frames.len()).into_par_iter().map(own).collect())
}

/// [`estimate`] of the frames `ids`, which lie at `motions` from the reference (centred pixels), by what the others of
/// them leave of each as well: texture is in all of them. `known`: what [`estimate`] found, which stays of a frame that
/// no other one lies beside.
pub fn estimate_registered(
    frames: &[Frame],
    exposures: &[Rgb],
    response: &Response,
    (ids, motions): (&[usize], &[DMat3]),
    known: &[FrameNoise],
) -> Vec<FrameNoise> {
    let mut found = known.to_vec();
    if ids.len() < 2 {
        return found;
    }
    let shown = |i: usize| Shown { frame: &frames[i], exposure: &exposures[i] };
    let own = |&i: &usize| {
        let back = motions[i].inverse();
        let others: Vec<_> = ids.iter().filter(|&&k| k != i).map(|&k| (shown(k), motions[k] * back)).collect();
        of_frame(shown(i), &others, response)
    };
    let estimates = reconciled(ids.par_iter().map(own).collect());
    for (&i, one) in ids.iter().zip(estimates) {
        found[i] = one;
    }
    found
}

/// What one frame's blocks show of its noise.
struct Estimated {
    noise: FrameNoise,
    /// Lowest and highest exposure of the samples that it was fitted to.
    exposures: (f64, f64),
    lossy: bool,
    /// ISO speed, where it is known.
    speed: Option<f64>,
}

impl Estimated {
    /// Red, green, blue and three times their mean's: alike where the channels' noise is independent and equal.
    fn models(&self) -> [NoiseModel; 4] {
        let [red, green, blue] = self.noise.channels;
        [red, green, blue, self.noise.luminance.times(3.0)]
    }
}

/// Standard deviation of the logarithm of a frame's noise at one exposure over that of the others of its bracket, where ISO speeds are not known: half of all random brackets are of one, in the
/// others they differ by up to 32 times.
const BETWEEN: f64 = 0.7;
/// The same over what the ISO speeds say, where all are known: a third of a stop in the speed, and what an engine smooths more at a high one.
const BEYOND_SPEED: f64 = 0.3;
/// Standard deviation of the error of one estimate's logarithm beside the bracket's other ones, of files that keep all detail and of those that do not (116 frames of random brackets, the truth from
/// pairs of files that differ in noise alone): texture lifts it, compression lowers it.
const ERROR: [f64; 2] = [0.45, 0.9];
/// Exposures at which estimates are compared, a quarter of a stop apart, below white.
const GRID: usize = 64;
/// Rounds of [`Levels::of`]: frames whose exposures meet in few places take some.
const ROUNDS: usize = 30;

/// The noise of a bracket's frames where each of its estimates is worth as much as it errs. What one channel's has in one frame beside the other channels is error: the sensor and the
/// engine are the same. What a frame has beside the other frames is moved towards theirs (the posterior mean of its logarithm). And the variance of the mean of three channels is between a third of
/// theirs and all of it: what is outside is half the one's error and half the other's.
fn reconciled(estimates: Vec<Option<Estimated>>) -> Vec<FrameNoise> {
    let found: Vec<&Estimated> = estimates.iter().flatten().collect();
    let models: Vec<[NoiseModel; 4]> = found.iter().map(|e| e.models()).collect();
    let of = |q: usize| Levels::of(&found.iter().zip(&models).map(|(e, m)| (m[q], e.exposures)).collect::<Vec<_>>());
    let levels: [Levels; 4] = std::array::from_fn(of);
    // Of three times the luminance over the mean channel.
    let over = |k: usize| {
        let [red, green, blue, luminance] = std::array::from_fn(|q| levels[q].common[k]);
        Some(luminance? - ((red?.exp() + green?.exp() + blue?.exp()) / 3.0).ln())
    };
    let over = mean(&(0..=GRID).filter_map(over).collect::<Vec<_>>()).unwrap_or(0.0);
    // 0 where the channels' noise is independent, ln 3 where it is the same in all.
    let half = 0.5 * (over - over.clamp(0.0, 3f64.ln()));
    let speeds: Option<Vec<f64>> = found.iter().map(|e| e.speed.map(f64::ln)).collect();
    let middle = speeds.as_ref().and_then(|s| mean(s)).unwrap_or(0.0);
    let one = |(i, e): (usize, &&Estimated)| {
        let (expected, between) = speeds.as_ref().map_or((0.0, BETWEEN), |s| (s[i] - middle, BEYOND_SPEED));
        let own = between.powi(2) / (between.powi(2) + ERROR[usize::from(e.lossy)].powi(2));
        let level = expected + own * (mean(&levels.each_ref().map(|l| l.frames[i])).unwrap_or(0.0) - expected);
        let factor = |q: usize| (level - levels[q].frames[i] + if q < 3 { half } else { -half }).exp();
        FrameNoise {
            channels: std::array::from_fn(|c| e.noise.channels[c].times(factor(c))),
            luminance: e.noise.luminance.times(factor(3)),
            // The finest structure shows what it did.
            correlation: (e.noise.correlation * factor(3).powf(1.0 / FINEST)).clamp(1.0, MOST_CORRELATED),
        }
    };
    let known: Vec<FrameNoise> = found.iter().enumerate().map(one).collect();
    // What a frame that shows nothing by itself is taken to have.
    let usual = FrameNoise::geometric_mean(&known).unwrap_or_else(|| FrameNoise::white(NoiseModel::from_electrons(ASSUMED.0, ASSUMED.1)));
    let mut known = known.into_iter();
    estimates.iter().map(|e| e.as_ref().and_then(|_| known.next()).unwrap_or(usual)).collect()
}

fn mean(v: &[f64]) -> Option<f64> {
    (!v.is_empty()).then(|| v.iter().sum::<f64>() / v.len() as f64)
}

/// Logarithms of variances as a sum of what all frames have in common at an exposure and a level of each frame.
struct Levels {
    /// Of each frame; their mean is 0.
    frames: Vec<f64>,
    /// At each exposure of the grid; `None` where no frame was estimated.
    common: Vec<Option<f64>>,
}

impl Levels {
    /// By least squares over the exposures between which each model was estimated: levels and what is common in turn.
    fn of(models: &[(NoiseModel, (f64, f64))]) -> Self {
        let grid: Vec<f64> = (0..=GRID).map(|k| (-0.25 * (GRID - k) as f64).exp2()).collect();
        let at = |&(model, (least, most)): &(NoiseModel, (f64, f64))| -> Vec<Option<f64>> {
            grid.iter().map(|&x| (x >= least && x <= most).then(|| model.variance(x).ln())).collect()
        };
        let known: Vec<Vec<Option<f64>>> = models.iter().map(at).collect();
        let mut frames = vec![0.0; models.len()];
        let mut common = Vec::new();
        for _ in 0..ROUNDS {
            let left = |k: usize| known.iter().zip(&frames).filter_map(|(v, l)| v[k].map(|v| v - l)).collect::<Vec<_>>();
            common = (0..grid.len()).map(|k| mean(&left(k))).collect();
            let above = |v: &Vec<Option<f64>>| mean(&v.iter().zip(&common).filter_map(|(v, c)| Some((*v)? - (*c)?)).collect::<Vec<_>>());
            frames = known.iter().map(|v| above(v).unwrap_or(0.0)).collect();
            let middle = mean(&frames).unwrap_or(0.0);
            frames.iter_mut().for_each(|l| *l -= middle);
        }
        Self { frames, common }
    }
}

/// `None` where no block is usable.
fn of_frame(shown: Shown, others: &[(Shown, DMat3)], response: &Response) -> Option<Estimated> {
    let Shown { frame, exposure } = shown;
    let planes = &frame.intensity.0;
    let all = |test: &(dyn Fn(usize, f32) -> bool + Sync), c: Range<usize>| -> Vec<bool> {
        (0..planes[0].data.len()).into_par_iter().map(|p| c.clone().all(|c| test(c, planes[c].data[p]))).collect()
    };
    let black = [0, 1, 2].map(|c| frame.black(c));
    let counts = |c: Range<usize>| Counts { clear: all(&|_, z| is_clear(z), c.clone()), black: all(&|c, z| z <= black[c], c) };
    let own: [Counts; 3] = std::array::from_fn(|c| counts(c..c + 1));
    let of_all = counts(0..3);
    let quantum: [_; 3] = std::array::from_fn(|c| quantisation(response, c, frame.levels));
    let mean = exposure.mean();
    // Rounding is independent in the channels.
    let rounding = |x: f64| quantum.iter().map(|q| q(x)).sum::<f64>() / 9.0;
    let beside_others = |channels: Range<usize>, side: usize, quantum: &(dyn Fn(f64) -> f64 + Sync)| -> Vec<Vec<Sample>> {
        let &(_, block, of_noise) = beside::BLOCKS.iter().find(|b| b.0 == side).expect("a side that is looked at");
        let one = |(other, motion): &(Shown, DMat3)| {
            bins(beside::blocks(&shown, other, motion, &channels, (side, block), &quantum), beside::FLATTEST, of_noise)
        };
        others.iter().map(one).collect()
    };
    let of_channel = |c: usize, side: usize, block: usize| {
        lowest(samples(&exposure.0[c], &own[c], side, block, &quantum[c]), &beside_others(c..c + 1, side, &quantum[c]))
    };
    let of_mean =
        |side: usize, block: usize| lowest(samples(&mean, &of_all, side, block, &rounding), &beside_others(0..3, side, &rounding));
    let model = |s: &[Sample]| fit(s, BELOW).map(|m| floored(m, s));
    let estimated = |noise: FrameNoise, samples: &[Sample]| {
        let exposures = samples.iter().fold((f64::INFINITY, 0.0f64), |(least, most), s| (least.min(s.exposure), most.max(s.exposure)));
        Estimated { noise, exposures, lossy: frame.lossy, speed: frame.speed }
    };
    let [fine, middle, coarse] = [of_mean(1, BLOCK), of_mean(MIDDLE, MIDDLE_BLOCK), of_mean(COARSE, COARSE_BLOCK)];
    let white = model(&fine);
    let lower_quartile = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v.get(v.len() / 4).copied()
    };
    let over_fine = |s: &[Sample]| white.and_then(|m| lower_quartile(s.iter().map(|s| s.variance / m.variance(s.exposure)).collect()));
    let told = |s: &[Sample]| over_fine(s).map_or(1.0, |r: f64| r.max(1.0));
    let correlation = told(&coarse).min(told(&middle).powf(1.0 / GROWTH)).min(MOST_CORRELATED);
    if correlation < WHITE {
        let channels: [Option<NoiseModel>; 3] = std::array::from_fn(|c| model(&of_channel(c, 1, BLOCK)));
        let any = channels.iter().flatten().next().copied()?;
        let channels = channels.map(|w| w.unwrap_or(any));
        return Some(estimated(FrameNoise { channels, luminance: white.unwrap_or(any.times(1.0 / 3.0)), correlation: 1.0 }, &fine));
    }
    // Texture lifts either.
    let shown = correlation.powf(SHOWN);
    let density = |middle: &[Sample], coarse: &[Sample]| {
        let middle: Vec<Sample> = middle.iter().map(|s| Sample { variance: s.variance / shown, ..*s }).collect();
        [model(&middle), model(coarse)].into_iter().flatten().min_by(|a, b| level(a, coarse).total_cmp(&level(b, coarse)))
    };
    let channels: [Option<NoiseModel>; 3] =
        std::array::from_fn(|c| density(&of_channel(c, MIDDLE, MIDDLE_BLOCK), &of_channel(c, COARSE, COARSE_BLOCK)));
    let green = channels[1].or(channels[0]).or(channels[2])?;
    let luminance = density(&middle, &coarse).unwrap_or(green.times(1.0 / 3.0));
    let channels = channels.map(|d| d.map_or(green, |d| NoiseModel { shot: d.shot.max(green.shot), read: d.read.max(green.read) }));
    Some(estimated(FrameNoise { channels, luminance, correlation }, &coarse))
}

/// Mean logarithm of the variance of `model` at the exposures of `samples`.
fn level(model: &NoiseModel, samples: &[Sample]) -> f64 {
    let blocks: f64 = samples.iter().map(|s| s.blocks).sum();
    samples.iter().map(|s| s.blocks * model.variance(s.exposure).ln()).sum::<f64>() / blocks.max(1.0)
}

/// Which pixels are clear of white, and which are cut off at black.
struct Counts {
    clear: Vec<bool>,
    black: Vec<bool>,
}

/// Samples of means of squares of `side` pixels of `x`, by blocks of `block` such squares.
fn samples(x: &Plane, counts: &Counts, side: usize, block: usize, quantum: &(impl Fn(f64) -> f64 + Sync)) -> Vec<Sample> {
    let (x, counts) = reduced(x, counts, side);
    let of_noise = OF_NOISE.iter().find(|o| o.0 == block).expect("a block that was simulated").1;
    bins(collect_blocks(&x, &counts, block, side, quantum), FLATTEST, of_noise)
}

/// `own` with the lowest variance that any of `beside` has at the same exposure, between two of its samples: texture lifts each.
fn lowest(own: Vec<Sample>, beside: &[Vec<Sample>]) -> Vec<Sample> {
    let at = |samples: &[Sample], x: f64| -> Option<f64> {
        let k = samples.partition_point(|s| s.exposure < x);
        let (below, above) = (samples.get(k.checked_sub(1)?)?, samples.get(k)?);
        let part = (x / below.exposure).ln() / (above.exposure / below.exposure).ln();
        Some((below.variance.ln() * (1.0 - part) + above.variance.ln() * part).exp())
    };
    let least = |s: Sample| beside.iter().filter_map(|b| at(b, s.exposure)).fold(s.variance, f64::min);
    own.into_iter().map(|s| Sample { variance: least(s), ..s }).collect()
}

/// `model` with a variance at black that is not far below that of the darkest of `samples`.
fn floored(model: NoiseModel, samples: &[Sample]) -> NoiseModel {
    let darkest = samples.iter().min_by(|a, b| a.exposure.total_cmp(&b.exposure)).map_or(0.0, |s| s.variance);
    let least = (LEAST_READ * model.shot).powi(2);
    NoiseModel { read: model.read.max(AT_BLACK * darkest).min(MOST_AT_BLACK * model.shot).max(least), ..model }
}

/// Variance at an exposure.
#[derive(Clone, Copy)]
struct Sample {
    exposure: f64,
    variance: f64,
    blocks: f64,
}

/// Means of squares of `side` pixels of `x`, whether all pixels of each are clear of white, and what part of them reads 0.
fn reduced(x: &Plane, counts: &Counts, side: usize) -> (Plane, Vec<(bool, f32)>) {
    let (w, h) = (x.width / side, x.height / side);
    let n = (side * side) as f32;
    let within = |p: usize| {
        let (i, j) = (p % w * side, p / w * side);
        (j..j + side).flat_map(move |j| (i..i + side).map(move |i| j * x.width + i))
    };
    let of = |p: usize| (within(p).all(|q| counts.clear[q]), within(p).filter(|&q| counts.black[q]).count() as f32 / n);
    let counts = (0..w * h).into_par_iter().map(of).collect();
    let means = if side == 1 { x.clone() } else { Plane::from_fn(w, h, |i, j| within(j * w + i).map(|q| x.data[q]).sum::<f32>() / n) };
    (means, counts)
}

/// Quantiles of bins along the exposure: as wide as a factor of 1.5, wider where that holds fewer than [`FEWEST`] blocks, of some hundred blocks at most. Within a bin
/// variances are compared as those of shot noise, which grow with the exposure.
fn bins(mut blocks: Vec<Sample>, quantile: f64, of_noise: f64) -> Vec<Sample> {
    blocks.retain(|b| b.exposure > 0.0);
    blocks.sort_by(|a, b| a.exposure.total_cmp(&b.exposure));
    let mut samples = Vec::new();
    let mut i = 0;
    while i + FEWEST <= blocks.len() {
        let end = blocks[i..].partition_point(|b| b.exposure <= 1.5 * blocks[i].exposure) + i;
        let mut end = end.max(i + FEWEST).min(i + (blocks.len() / 40).max(200));
        if blocks.len() - end < FEWEST {
            end = blocks.len();
        }
        let part = &blocks[i..end];
        let exposure = part.iter().map(|b| b.exposure).sum::<f64>() / part.len() as f64;
        let mut v: Vec<f64> = part.iter().map(|b| b.variance * exposure / b.exposure).collect();
        v.sort_by(f64::total_cmp);
        let variance = v[(quantile * v.len() as f64) as usize] / of_noise;
        if variance > 0.0 {
            samples.push(Sample { exposure, variance, blocks: part.len() as f64 });
        }
        i = end;
    }
    samples
}

/// High-pass variance, as a density, of the blocks that no clipping touches, of [`ENOUGH`] that are spread over the frame where it has more. `side`: pixels along
/// the sides of the squares that `x` has the means of.
fn collect_blocks(x: &Plane, counts: &[(bool, f32)], block: usize, side: usize, quantum: &(impl Fn(f64) -> f64 + Sync)) -> Vec<Sample> {
    let (w, h) = x.size();
    let step = block * (w * h / (block * block)).div_ceil(ENOUGH).isqrt().max(1);
    let area = (side * side) as f64;
    let row = |by: usize| {
        let mut blocks = Vec::new();
        for bx in (1..w.saturating_sub(block)).step_by(step) {
            let around = || (by - 1..=by + block).flat_map(|j| (bx - 1..=bx + block).map(move |i| counts[j * w + i]));
            let black = around().map(|c| f64::from(c.1)).sum::<f64>() / ((block + 2) * (block + 2)) as f64;
            if black > BLACK || !around().all(|c| c.0) {
                continue;
            }
            let (mut sum, mut square) = (0.0, 0.0);
            for j in by..by + block {
                for i in bx..bx + block {
                    let at = |dx: usize, dy: usize| f64::from(x.at(i + dx - 1, j + dy - 1));
                    let corners = at(0, 0) + at(2, 0) + at(0, 2) + at(2, 2);
                    let sides = at(1, 0) + at(0, 1) + at(2, 1) + at(1, 2);
                    square += (corners - 2.0 * sides + 4.0 * at(1, 1)).powi(2) / 36.0;
                    sum += at(1, 1);
                }
            }
            let n = (block * block) as f64;
            let exposure = sum / n;
            blocks.push(Sample { exposure, variance: (area * square / n - quantum(exposure)).max(0.0), blocks: 1.0 });
        }
        blocks
    };
    let rows = h.saturating_sub(block + 1).div_ceil(step);
    (0..rows).into_par_iter().flat_map_iter(|n| row(1 + n * step)).collect()
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
                let r = (s.variance / NoiseModel { shot, read }.variance(s.exposure)).ln();
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
                if b - a > MOST_AT_BLACK.ln() {
                    continue;
                }
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame of shot noise `shot` in each channel, estimated between these exposures.
    fn estimated(shot: f64, exposures: (f64, f64), speed: Option<f64>) -> Option<Estimated> {
        Some(Estimated { noise: FrameNoise::white(NoiseModel { shot, read: 1e-9 }), exposures, lossy: true, speed })
    }

    fn shots(found: &[FrameNoise]) -> Vec<f64> {
        found.iter().map(|n| n.channels[1].shot).collect()
    }

    #[test]
    fn an_estimate_far_from_the_others_is_moved_towards_them() {
        let found = shots(&reconciled(vec![
            estimated(1e-4, (0.01, 0.2), None),
            estimated(3e-3, (0.03, 0.4), None),
            estimated(1e-4, (0.1, 0.9), None),
        ]));
        let before = (3e-3f64 / 1e-4).ln();
        let after = (found[1] / found[0]).ln();
        let expected = before * BETWEEN.powi(2) / (BETWEEN.powi(2) + ERROR[1].powi(2));
        assert!((after - expected).abs() < 0.02, "{after} for {expected}");
        let middle = found.iter().map(|s| s.ln()).sum::<f64>();
        let was = [1e-4f64, 3e-3, 1e-4].iter().map(|s| s.ln()).sum::<f64>();
        assert!((middle - was).abs() < 0.05, "the level of the bracket stays");
    }

    #[test]
    fn known_speeds_say_how_the_frames_noise_differs() {
        let both = |speeds: [Option<f64>; 2]| {
            shots(&reconciled(vec![estimated(2e-3, (0.01, 0.3), speeds[0]), estimated(2e-3, (0.02, 0.8), speeds[1])]))
        };
        let unknown = both([Some(3200.0), None]);
        assert!((unknown[0] / unknown[1] - 1.0).abs() < 1e-6, "{unknown:?}");
        let known = both([Some(3200.0), Some(100.0)]);
        assert!((20.0..32.0).contains(&(known[0] / known[1])), "{known:?}");
    }

    #[test]
    fn three_channels_and_their_mean_tell_the_same_noise() {
        let mut frame = estimated(8e-4, (0.01, 0.5), None).unwrap();
        frame.noise.luminance = NoiseModel { shot: 8e-4 / 3.0 / 25.0, read: 1e-10 };
        let other = estimated(8e-4, (0.01, 0.5), None).unwrap();
        let mut alike = other.noise;
        alike.luminance = frame.noise.luminance;
        let found = reconciled(vec![Some(frame), Some(Estimated { noise: alike, ..other })])[0];
        assert!((found.channels[0].shot / (8e-4 / 5.0) - 1.0).abs() < 0.02, "{found:?}");
        assert!((3.0 * found.luminance.shot / found.channels[0].shot - 1.0).abs() < 0.02, "{found:?}");
    }

    #[test]
    fn a_frame_that_shows_nothing_has_what_the_others_have() {
        let found = shots(&reconciled(vec![None, estimated(1e-4, (0.01, 0.2), None), estimated(4e-4, (0.02, 0.4), None)]));
        assert!((found[0] / 2e-4 - 1.0).abs() < 0.02, "{found:?}");
        let assumed = reconciled(vec![None, None]);
        assert!((assumed[0].channels[0].shot - 1.0 / ASSUMED.0).abs() < 1e-12 && assumed.len() == 2);
    }
}
