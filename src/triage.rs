//! Which frames are sharp: fine structure of each frame, noise taken off, against that of the others.

use crate::exposure::Frame;
use crate::image::{Channels, Plane, Rgb};
use crate::mask;
use crate::noise;
use crate::pose::nearest_pixel;
use glam::DMat3;
use rayon::prelude::*;
use serde::Serialize;
use std::borrow::Cow;

/// What the triage found about one frame.
#[derive(Clone, Debug, Serialize)]
pub struct Verdict {
    /// Whether the frame counts as sharp.
    pub sharp: bool,
    /// Energy of one-pixel differences over that of the frame with most of it, relative to the same ratio of coarse differences, worst
    /// direction, where both see the same light: 1 for equally sharp frames.
    pub detail: f64,
    /// Whether fine structure of it or of another frame stood clear of the noise of both where they see the same light: else `detail` says
    /// nothing.
    pub compared: bool,
    /// Whether that leads to this frame, by frames each of which clearly has as much as the one before, from the shortest of those with as much as any,
    /// or from two of which each clearly has as much as the other.
    pub linked: bool,
    /// Energy of one-pixel over that of two-pixel differences, worst direction: about 0.5 where edges are one pixel wide, 0.25 where
    /// they are ramps.
    pub steepness: f64,
    /// Least over most of that ratio among directions at right angles, the worse pair of them: a lens softens edges of all directions alike, a hand's
    /// motion those across it. 1 where nothing tells.
    pub evenness: f64,
    /// For each frame, the lesser of the parts that this one has of its fine structure and it of this one's, as they measure without any error, in the
    /// direction in which they differ most: 1 for blurs alike; `None` where nothing tells.
    #[serde(skip)]
    pub alike: Vec<Option<f64>>,
    /// Why, in words.
    pub reason: String,
}

impl Verdict {
    /// Whether the frame is as sharp as any: sharp, or of a scene (or a lens) without steep edges, or blurred like all others.
    pub fn is_alike(&self) -> bool {
        self.sharp || (self.compared && self.detail >= DETAIL)
    }
}

/// Below this share of another frame's fine structure a frame is blurred: a blur of 2 px halves the energy of one-pixel differences
/// across its direction. In place, sharp frames measure 0.74 and more, shaken ones 0.71 and less.
const DETAIL: f64 = 0.72;
/// Share of the fine structure of a frame that is sharp, as it measures without any error, from which another is as well. In place, sharp frames
/// measure 0.73 and more where scenes are real, 0.98 and more where they are drawn; shaken ones that few pixels speak for 0.5 to 0.8.
const LIKELY: f64 = 0.65;
/// Below this no edge is steep: even the best frame is blurred.
const STEEPNESS: f64 = 0.335;
/// Relative error of the noise level that is taken off the energies.
const NOISE_ERROR: f64 = 0.2;
/// Most that the noise model may be off by: it takes the channels' noise for independent, and JPEG files rather have the same in all three.
const MOST_EXCESS: f64 = 3.0;
/// Side in pixels of the squares of which the flattest tell the noise, as large a part of them as [`FLAT`].
const SMALL: usize = 8;
/// See [`SMALL`].
const FLAT: f64 = 0.02;
/// What that part of squares of pure noise measures, of its variance.
const FLATTEST: f64 = 0.75;
/// Lags in pixels of the differences by which two frames are found to differ by noise alone.
const NEAR: [usize; 3] = [1, 2, 4];
/// Standard deviations by which their cross energy is more than nothing.
const CERTAIN: f64 = 5.0;
/// The noise of the mean of three channels over what the model says that it may be, and the ratio of the two frames' levels.
const LEVELS: std::ops::Range<f64> = 0.8..6.0;
/// See [`LEVELS`].
const RATIOS: std::ops::Range<f64> = 0.75..1.5;
/// Lag in pixels of the differences that tell contrast.
const COARSE: usize = 24;
/// Directions in which differences are taken.
const DIRECTIONS: [(usize, usize, bool); 4] = [(1, 0, false), (0, 1, false), (1, 1, false), (1, 1, true)];
/// Side in pixels of the squares whose structure is compared.
const BLOCK: usize = 16;
/// Fewest pixels that both see from which anything is told.
const FEW: usize = BLOCK * BLOCK;
/// Radius in pixels of the squares over which light is compared.
const LOCAL: usize = 4;
/// Relative difference up to which two frames see the same light there: blur moves light within the square, and a lamp's trail brings in
/// light from beyond it.
const SAME: f32 = 0.1;
/// Common ratio of two frames' light that an exposure time or response which is not quite true explains.
const MISTAKEN: f32 = 1.4;

/// Most pixels of a frame that are looked at: of larger ones, squares of [`TILE`] pixels spread over the frame, as many as that.
const ENOUGH: usize = 6_000_000;
/// Side in pixels of those squares.
const TILE: usize = 256;

/// The pixels of a frame that are looked at, as planes of their own.
struct Looked {
    /// Of the frame.
    whole: (usize, usize),
    /// Upper left corners of squares of [`TILE`] pixels, which lie below each other in the planes; none: the whole frame is looked at.
    tiles: Vec<(usize, usize)>,
}

impl Looked {
    /// At most `enough` pixels, but a square, of frames of `whole` = (width, height) pixels.
    fn at(whole: (usize, usize), enough: usize) -> Self {
        let (columns, rows) = (whole.0 / TILE, whole.1 / TILE);
        let every = (columns * rows).div_ceil((enough / (TILE * TILE)).max(1));
        let tiles = if whole.0 * whole.1 <= enough || every <= 1 {
            Vec::new()
        } else {
            // Each row of squares begins elsewhere, so that they do not make stripes.
            let chosen = |&(i, j): &(usize, usize)| (i + j * every.isqrt()).is_multiple_of(every);
            (0..rows).flat_map(|j| (0..columns).map(move |i| (i, j))).filter(chosen).map(|(i, j)| (TILE * i, TILE * j)).collect()
        };
        Self { whole, tiles }
    }

    fn is_whole(&self) -> bool {
        self.tiles.is_empty()
    }

    /// Width and height of the planes.
    fn size(&self) -> (usize, usize) {
        if self.is_whole() { self.whole } else { (TILE, TILE * self.tiles.len()) }
    }

    /// The frame's pixel at (x, y) of the planes.
    fn pixel(&self, x: usize, y: usize) -> (usize, usize) {
        if self.is_whole() {
            (x, y)
        } else {
            let (left, top) = self.tiles[y / TILE];
            (left + x, top + y % TILE)
        }
    }

    /// Whether a pixel of row `y` of the planes counts: at the end of each square some rows do not, so that no difference reaches into the next.
    fn counts(&self, y: usize) -> bool {
        self.is_whole() || y % TILE < TILE - COARSE
    }
}

#[derive(Clone)]
struct Luminance {
    value: Plane,    // irradiance
    variance: Plane, // of it
    valid: Vec<bool>,
    /// Relative error of `variance`.
    noise_error: f64,
    /// `variance` over what the noise model says.
    excess: f64,
    /// See [`Frame::lossy`].
    lossy: bool,
}

fn luminance(frame: &Frame, x: &Rgb, curves: &[Vec<f32>; 3]) -> Luminance {
    let clipped = mask::clipped(frame, Channels::ALL);
    let dt = frame.exposure_time;
    let mean = x.mean();
    let counts = Plane { data: clipped.iter().map(|c| if *c { 0.0 } else { 1.0 }).collect(), ..mean.clone() };
    // What the pixels around say is free of the pixel's own noise, by which it must not be chosen or weighted.
    let around = mean.zip(&counts, |v, k| v * k).box_sum(LOCAL).zip(&counts.box_sum(LOCAL), |s, n| if n > 0.5 { s / n } else { 0.0 });
    let noise = noise::of_mean(curves);
    // Below three standard deviations of a channel, noise clipped at black is no longer symmetric.
    let floor = 3.0 * (3.0 * noise[0]).sqrt();
    let valid = around.data.iter().zip(&clipped).map(|(&v, &c)| !c && v > floor).collect();
    let variance = around.map(|v| noise::at(&noise, v) / (dt * dt) as f32);
    Luminance {
        value: mean.map(|v| (f64::from(v) / dt) as f32),
        variance,
        valid,
        noise_error: NOISE_ERROR,
        excess: 1.0,
        lossy: frame.lossy,
    }
}

impl Luminance {
    /// Variance of the flattest squares over what the noise model says, where it is more: that of JPEG files can be far off, and what it leaves
    /// would pass for fine structure.
    fn excess(&self) -> f64 {
        let columns = self.value.width.div_ceil(SMALL);
        let mut sums = vec![[0.0f64; 3]; columns * self.value.height.div_ceil(SMALL)];
        for_differences(self.value.size(), &self.valid, (1, 0, false), 1, |x, y, i, j| {
            let [count, sum, noise] = &mut sums[y / SMALL * columns + x / SMALL];
            *count += 1.0;
            *sum += f64::from(self.value.data[i] - self.value.data[j]).powi(2);
            *noise += f64::from(self.variance.data[i] + self.variance.data[j]);
        });
        let whole = sums.iter().filter(|s| s[0] > 0.5 * (SMALL * SMALL) as f64);
        let mut ratios: Vec<f64> = whole.map(|s| s[1] / s[2]).collect();
        let flat = (FLAT * ratios.len() as f64) as usize;
        if ratios.is_empty() { 1.0 } else { (*ratios.select_nth_unstable_by(flat, f64::total_cmp).1 / FLATTEST).clamp(1.0, MOST_EXCESS) }
    }

    /// Variance as the frame itself shows it, where that is more than what the noise model says.
    fn correct(&mut self, looked: &Looked) {
        let excess = self.part(looked).excess();
        self.variance = self.variance.map(|v| v * excess as f32);
        self.noise_error += 1.0 - 1.0 / excess;
        self.excess = excess;
    }

    /// As the pixels of another frame that are `looked` at see it, `motion` being the way from there to here: the nearest pixel, since
    /// interpolation would take fine structure away.
    fn seen(&self, motion: &DMat3, looked: &Looked) -> Self {
        let (w, h) = self.value.size();
        let (width, height) = looked.size();
        let still = *motion == DMat3::IDENTITY;
        let sources: Vec<Option<usize>> = (0..width * height)
            .into_par_iter()
            .map(|p| {
                let (x, y) = looked.pixel(p % width, p / width);
                if !looked.counts(p / width) {
                    None
                } else if still {
                    Some(y * w + x)
                } else {
                    nearest_pixel(motion, w, h, x, y)
                }
            })
            .collect();
        let plane = |from: &Plane| {
            let data = sources.par_iter().map(|q| q.map_or(0.0, |q| from.data[q])).collect();
            Plane { width, height, data }
        };
        let valid = sources.par_iter().map(|q| q.is_some_and(|q| self.valid[q])).collect();
        Self { value: plane(&self.value), variance: plane(&self.variance), valid, ..*self }
    }

    /// The pixels that are `looked` at, nothing being copied where these are all.
    fn part(&self, looked: &Looked) -> Cow<'_, Self> {
        if looked.is_whole() { Cow::Borrowed(self) } else { Cow::Owned(self.seen(&DMat3::IDENTITY, looked)) }
    }

    /// The pixels at which this frame and `other` see the same light around: structure that a lamp's trail draws over the dark beside it is
    /// none of the scene's.
    fn shared(&self, other: &Self) -> Vec<bool> {
        let counts =
            Plane { data: self.valid.iter().zip(&other.valid).map(|(a, b)| f32::from(u8::from(*a && *b))).collect(), ..self.value.clone() };
        let sum = |plane: &Plane| plane.zip(&counts, |v, k| v * k).box_sum(LOCAL);
        let (mine, theirs) = (sum(&self.value), sum(&other.value));
        let noise = sum(&self.variance.zip(&other.variance, |a, b| a + b));
        let both = |p: &usize| counts.data[*p] > 0.0 && mine.data[*p] > 0.0 && theirs.data[*p] > 0.0;
        let mut ratios: Vec<f32> = (0..counts.data.len()).filter(both).map(|p| theirs.data[p] / mine.data[p]).collect();
        let middle = ratios.len() / 2;
        let ratio = if ratios.is_empty() { 1.0 } else { *ratios.select_nth_unstable_by(middle, f32::total_cmp).1 };
        let ratio = if (1.0 / MISTAKEN..MISTAKEN).contains(&ratio) { ratio } else { 1.0 };
        let same = |p: usize| {
            let (a, b) = (ratio * mine.data[p], theirs.data[p]);
            (a - b).abs() < 0.5 * SAME * (a + b) + 3.0 * noise.data[p].max(0.0).sqrt()
        };
        (0..counts.data.len()).map(|p| both(&p) && same(p)).collect()
    }
}

/// Calls `f` with the place and the indices of the two pixels of each difference over `lag` pixels in `direction` between pixels that count.
fn for_differences(
    (w, h): (usize, usize),
    counts: &[bool],
    direction: (usize, usize, bool),
    lag: usize,
    mut f: impl FnMut(usize, usize, usize, usize),
) {
    let (dx, dy) = (direction.0 * lag, direction.1 * lag);
    for y in 0..h.saturating_sub(dy) {
        for x in 0..w.saturating_sub(dx) {
            let (i, j) = if direction.2 { (y * w + x + dx, (y + dy) * w + x) } else { (y * w + x, (y + dy) * w + x + dx) };
            if counts[i] && counts[j] {
                f(x, y, i, j);
            }
        }
    }
}

/// Differences of a frame over some pixels in one direction.
struct Energy {
    /// Noise-free, weighted.
    sum: f64,
    /// Two standard deviations, and the noise level's own error.
    error: f64,
    /// What of `sum` may be noise as well, where the frame itself shows more of it than the error of the noise level explains.
    doubtful: f64,
    /// Parts of `sum` by squares of [`BLOCK`] pixels.
    blocks: Vec<f64>,
}

/// [`Energy`] of differences over `lag` pixels in `direction` of `a`, between pixels that are `shared` with `b`; weighted by the larger variance
/// of the two, so that both sums of a pair speak of the same pixels in the same way.
fn energy(a: &Luminance, b: &Luminance, shared: &[bool], direction: (usize, usize, bool), lag: usize) -> Energy {
    let columns = a.value.width.div_ceil(BLOCK);
    let mut blocks = vec![0.0; columns * a.value.height.div_ceil(BLOCK)];
    let (mut scatter, mut noise) = (0.0, 0.0);
    for_differences(a.value.size(), shared, direction, lag, |x, y, i, j| {
        let own = f64::from(a.variance.data[i] + a.variance.data[j]);
        let weight = 1.0 / own.max(f64::from(b.variance.data[i] + b.variance.data[j]));
        let d = f64::from(a.value.data[i] - a.value.data[j]);
        blocks[y / BLOCK * columns + x / BLOCK] += weight * (d * d - own);
        noise += weight * own;
        // Variance of a squared difference of noise sigma^2: 2 sigma^4 + 4 d^2 sigma^2.
        scatter += weight * weight * (2.0 * own * own + 4.0 * (d * d - own).max(0.0) * own);
    });
    let doubtful = (a.noise_error - 2.0 * NOISE_ERROR).max(0.0) * noise;
    Energy { sum: blocks.iter().sum(), error: 2.0 * scatter.sqrt() + a.noise_error * noise, doubtful, blocks }
}

/// Fine structure of a frame as a part of another's.
#[derive(Clone, Copy)]
struct Share {
    likely: f64,
    /// With the error of its own and two standard errors of what the squares of the frame say, each by itself, since what a few of them say may be
    /// a trail's; without what is doubtful of the other's.
    most: f64,
}

/// `None` where the other's does not stand clear of noise, or squares disagree by so much that a frame without any would pass.
fn share(own: &Energy, other: &Energy) -> Option<Share> {
    if other.sum <= 3.0 * other.error || other.sum <= 3.0 * own.error {
        return None;
    }
    let likely = own.sum.max(0.0) / (other.sum - other.doubtful);
    let most = (own.sum + own.error).max(0.0) / (other.sum - other.doubtful);
    let scatter: f64 = own.blocks.iter().zip(&other.blocks).map(|(a, b)| (a - most * b).powi(2)).sum();
    let doubt = 2.0 * scatter.sqrt() / other.sum;
    (doubt < DETAIL).then_some(Share { likely, most: most + doubt })
}

/// Whether two frames that lie in one place differ by noise alone, whatever its level: with cross energy X, which noise does not enter, and energies A and B
/// of the noisier frame and the other, (A - X) / (B - X) is the ratio of their noise. Where the other lacks structure, B is less than X by far more than
/// its noise, and where it lies elsewhere X falls.
fn differ_by_noise(a: &Luminance, b: &Luminance, shared: &[bool]) -> bool {
    let along = |direction: (usize, usize, bool), lag: usize| {
        // Cross energy and its variance; of each frame the energy and the noise.
        let (mut cross, mut scatter, mut of) = (0.0, 0.0, [[0.0f64; 2]; 2]);
        for_differences(a.value.size(), shared, direction, lag, |_, _, i, j| {
            let noise = [a, b].map(|l| f64::from(l.variance.data[i] + l.variance.data[j]) / l.excess);
            let d = [a, b].map(|l| f64::from(l.value.data[i] - l.value.data[j]));
            let weight = 1.0 / noise[0].max(noise[1]);
            cross += weight * d[0] * d[1];
            scatter += (weight * d[0] * d[1]).powi(2);
            for k in 0..2 {
                of[k][0] += weight * d[k] * d[k];
                of[k][1] += weight * noise[k];
            }
        });
        of.sort_by(|p, q| q[1].total_cmp(&p[1]));
        let level = of.map(|[energy, noise]| (energy - cross) / noise);
        cross > CERTAIN * scatter.sqrt() && LEVELS.contains(&level[0]) && RATIOS.contains(&(level[1] / level[0]))
    };
    DIRECTIONS.par_iter().all(|&direction| NEAR.iter().all(|&lag| along(direction, lag)))
}

/// Shares of two frames in each other's fine structure, in the direction in which they are least, as a whole and the pixels of each that are
/// `looked` at, `motion` being the way from the first's pixels to the second's; `None` where nothing tells.
fn details(whole: [&Luminance; 2], [a, b]: [&Luminance; 2], motion: &DMat3, looked: &Looked) -> [Option<Share>; 2] {
    // Each of the two on its own pixels, of which those count that the other sees as well.
    let apart = *motion != DMat3::IDENTITY;
    let (b_seen, a_seen) = (apart.then(|| whole[1].seen(motion, looked)), apart.then(|| whole[0].seen(&motion.inverse(), looked)));
    let (b_seen, a_seen) = (b_seen.as_ref().unwrap_or(b), a_seen.as_ref().unwrap_or(a));
    let on_a = a.shared(b_seen);
    let on_b = if apart { b.shared(a_seen) } else { on_a.clone() };
    if [&on_a, &on_b].iter().any(|on| on.iter().filter(|s| **s).count() < FEW) {
        return [None; 2];
    }
    if (a.lossy || b.lossy) && differ_by_noise(a, b_seen, &on_a) {
        return [Some(Share { likely: 1.0, most: 1.0 }); 2];
    }
    let along = |&direction: &(usize, usize, bool)| {
        let of = |lag| [energy(a, b_seen, &on_a, direction, lag), energy(b, a_seen, &on_b, direction, lag)];
        let (fine, coarse) = (of(1), of(COARSE));
        // A response or exposure time that is not quite true changes structure of all sizes alike; blur takes the finest.
        let known = coarse[0].sum > 0.0 && coarse[1].sum > 0.0;
        let contrast = |i: usize, j: usize| if known { (coarse[i].sum / coarse[j].sum).min(1.0) } else { 1.0 };
        let of = |(i, j): (usize, usize)| {
            let contrast = contrast(i, j);
            share(&fine[i], &fine[j]).map(|s| Share { likely: s.likely / contrast, most: s.most / contrast })
        };
        [(0, 1), (1, 0)].map(of)
    };
    let least = |a: Option<Share>, b: Option<Share>| {
        a.into_iter().chain(b).reduce(|a, b| Share { likely: a.likely.min(b.likely), most: a.most.min(b.most) })
    };
    DIRECTIONS.par_iter().map(along).reduce(|| [None; 2], |x, y| [least(x[0], y[0]), least(x[1], y[1])])
}

/// Those of `frames` to which no way leads, by frames each of which `is_like` the one before, from the one to `begin` with, nor from any two that are
/// each like the other.
fn unreached(frames: &[usize], begin: Option<usize>, is_like: impl Fn(usize, usize) -> bool) -> Vec<usize> {
    let is_one_of_two = |i: usize| frames.iter().any(|&j| j != i && is_like(i, j) && is_like(j, i));
    let (mut reached, mut others): (Vec<usize>, Vec<usize>) = frames.iter().partition(|&&i| Some(i) == begin || is_one_of_two(i));
    let mut next = 0;
    while next < reached.len() {
        let (like, rest): (Vec<usize>, Vec<usize>) = others.into_iter().partition(|&i| is_like(i, reached[next]));
        reached.extend(like);
        others = rest;
        next += 1;
    }
    others
}

/// [`Verdict::steepness`] and [`Verdict::evenness`].
fn steepness(a: &Luminance) -> (f64, f64) {
    let along = |&d: &(usize, usize, bool)| {
        let (one, two) = (energy(a, a, &a.valid, d, 1), energy(a, a, &a.valid, d, 2));
        (two.sum > 3.0 * two.error).then(|| one.sum.max(0.0) / two.sum)
    };
    let steep: Vec<Option<f64>> = DIRECTIONS.par_iter().map(along).collect();
    let least = steep.iter().flatten().copied().reduce(f64::min);
    // The axes, and the diagonals: a pixel across is not a diagonal of one.
    let even = steep.chunks(2).filter_map(|pair| match *pair {
        [Some(a), Some(b)] if a.max(b) > 0.0 => Some(a.min(b) / a.max(b)),
        _ => None,
    });
    (least.unwrap_or(0.5), even.fold(1.0, f64::min))
}

/// Sorts the frames. `given` (from the user) overrides; the numbers are reported all the same. `motions`: each frame's place, from the
/// reference, centred pixels.
pub fn triage(
    frames: &[Frame],
    exposures: &[Rgb],
    curves: &[[Vec<f32>; 3]],
    excluded: &[bool],
    given: Option<&[usize]>,
    motions: &[DMat3],
) -> Vec<Verdict> {
    let looked = Looked::at(frames[0].intensity.size(), ENOUGH);
    let mut all: Vec<Luminance> = frames.par_iter().zip(exposures).zip(curves).map(|((f, x), c)| luminance(f, x, c)).collect();
    let verdict = |a: &Luminance| {
        let (steepness, evenness) = steepness(&a.part(&looked));
        Verdict {
            sharp: false,
            detail: 1.0,
            compared: false,
            linked: true,
            steepness,
            evenness,
            alike: vec![None; all.len()],
            reason: String::new(),
        }
    };
    let mut verdicts: Vec<Verdict> = all.par_iter().map(verdict).collect();
    // Not before: of a frame that is all texture, which passes for noise, steepness would say too little.
    all.par_iter_mut().for_each(|a| a.correct(&looked));
    let parts: Vec<Cow<Luminance>> = all.par_iter().map(|a| a.part(&looked)).collect();
    // A frame that is left out is measured against the others, not they against it. One pair after the other: each takes several planes.
    let pairs: Vec<(usize, usize)> =
        (0..all.len()).flat_map(|j| (0..j).map(move |i| (i, j))).filter(|&(i, j)| !(excluded[i] && excluded[j])).collect();
    let of = |&(i, j): &(usize, usize)| details([&all[i], &all[j]], [&parts[i], &parts[j]], &(motions[j] * motions[i].inverse()), &looked);
    let found: Vec<[Option<Share>; 2]> = pairs.iter().map(of).collect();
    for (&(i, j), detail) in pairs.iter().zip(&found) {
        let alike = detail[0].zip(detail[1]).map(|(a, b)| a.likely.min(b.likely));
        (verdicts[i].alike[j], verdicts[j].alike[i]) = (alike, alike);
        for (k, own, other) in [(0, i, j), (1, j, i)] {
            if !excluded[other]
                && let Some(detail) = detail[k]
            {
                verdicts[own].detail = verdicts[own].detail.min(detail.most);
                verdicts[own].compared = true;
                verdicts[other].compared = true;
            }
        }
    }
    let likely = |own: usize, other: usize| {
        let pair = pairs.iter().position(|&(i, j)| (i, j) == (own.min(other), own.max(other)))?;
        found[pair][usize::from(own > other)].map(|share| share.likely)
    };
    let passing: Vec<usize> = (0..all.len()).filter(|&i| !excluded[i] && verdicts[i].compared && verdicts[i].detail >= DETAIL).collect();
    let shortest = passing.iter().copied().min_by(|&i, &j| frames[i].exposure_time.total_cmp(&frames[j].exposure_time));
    for i in unreached(&passing, shortest, |own, other| likely(own, other).is_some_and(|share| share >= LIKELY)) {
        verdicts[i].linked = false;
    }
    for (i, v) in verdicts.iter_mut().enumerate() {
        if let Some(list) = given {
            v.sharp = list.contains(&i);
            v.reason = if v.sharp { "sharp by option" } else { "blurred by option" }.into();
        } else if excluded[i] {
            v.reason = "left out".into();
        } else if v.detail < DETAIL {
            v.reason = format!("has {:.0} % of another frame's fine structure", 100.0 * v.detail);
        } else if v.steepness < STEEPNESS {
            v.reason = format!("no steep edge in one direction (steepness {:.2})", v.steepness);
        } else {
            v.sharp = true;
            v.reason = format!("fine structure {:.0} % of the best frame's, steepness {:.2}", 100.0 * v.detail, v.steepness);
        }
    }
    // Taking a blurred frame for sharp spoils the picture; that a sharp one has no blur to be undone shows later.
    let tells = |v: &Verdict| v.compared && v.linked;
    if given.is_none() && verdicts.iter().any(|v| v.sharp && tells(v)) {
        for v in verdicts.iter_mut().filter(|v| v.sharp && !tells(v)) {
            v.sharp = false;
            v.reason = "shows no structure that a sharp frame sees clearly as well, to tell whether it is sharp".into();
        }
    }
    verdicts
}
