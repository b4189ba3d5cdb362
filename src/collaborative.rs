//! Collaborative filtering of an image: K. Dabov, A. Foi, V. Katkovnik and K. Egiazarian, "Image Denoising by Sparse 3-D
//! Transform-Domain Collaborative Filtering", IEEE Transactions on Image Processing 16(8), 2007 (BM3D), for noise whose level is known pixel
//! by pixel and frequency by frequency.
//!
//! Patches that look alike are stacked, transformed in three dimensions (DCT in the patch, Haar along the stack), shrunk, transformed back
//! and averaged where they overlap; first by a threshold, then by the Wiener filter that the first result suggests. Detail that repeats, or
//! that stands out of its noise, stays; total variation, which only knows that edges are few, cannot tell fine texture from noise.
//!
//! The variance of a coefficient is `1 / (p + Σ_i p_i P_i)`: p is the inverse variance that sharp frames in place give, p_i what frame i, shaken or
//! displaced, gives where its blur or interpolation passes all ([`Precision`]), P_i the power of that at the coefficient's frequency. Channels are
//! filtered in an orthonormal opponent space, in stacks that the sum of the channels chooses.

use crate::image::{Plane, Rgb};
use crate::pose::project;
use crate::sampling::wide;
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Side of a patch in pixels.
pub const SIDE: usize = 8;
/// Values of a patch.
pub const VALUES: usize = SIDE * SIDE;
/// One patch, or one number for each coefficient of its transform: row-major, frequency 0 first.
pub type Patch = [f32; VALUES];

/// Distance in pixels between the patches that stacks are made for.
pub const STEP: usize = 3;
/// Greatest displacement in x and in y of a patch of a stack.
pub const REACH: usize = 12;
/// Patches of a stack of the first pass, of the second.
pub const STACK: [usize; 2] = [16, 32];
/// Coefficients below this many standard deviations are noise to the first pass.
pub const THRESHOLD: f32 = 2.7;
/// Standard deviation where nothing is measured, of values that are logarithms: more would mean that nothing at all is known about them.
pub const UNKNOWN: f32 = 1.0;
/// Rows of patches that one task filters: fixed, so that the sums do not depend on the number of processors.
const BAND: usize = 16;
/// Tasks of each thread whose results are held at once.
const EACH: usize = 2;

/// Inverse variance of the values, pixel by pixel.
pub struct Precision {
    /// What frames give that no blur affects.
    pub white: Rgb,
    /// For each frame that is shaken or displaced, what it gives at frequency 0, and its power at the others.
    pub blurred: Vec<(Rgb, Power)>,
}

/// Power of what a frame makes of the scene at the frequencies of the patch transform.
#[derive(Clone)]
pub enum Power {
    /// Of a PSF, the same everywhere.
    Same(Patch),
    /// Of an interpolation, by where the frame's pixels fall.
    Between(Between),
}

/// Power of the interpolation between the pixels by which a displaced frame is predicted.
#[derive(Clone)]
pub struct Between {
    /// From (x, y) on the grid of the values to the frame's pixels.
    pub motion: DMat3,
    /// Along one axis, at displacements by fractions of a pixel in equal steps from 0 to below 1.
    pub axis: Vec<[f32; SIDE]>,
}

impl Between {
    /// By the displacement of the middle of the patch whose first pixel is (x, y).
    fn at(&self, (x, y): (usize, usize)) -> Patch {
        let middle = DVec2::new(x as f64, y as f64) + 0.5 * (SIDE - 1) as f64;
        let displacement = project(&self.motion, middle) - middle;
        let n = self.axis.len();
        let along = |d: f64| &self.axis[(d.rem_euclid(1.0) * n as f64).round() as usize % n];
        let (across, down) = (along(displacement.x), along(displacement.y));
        std::array::from_fn(|k| across[k % SIDE] * down[k / SIDE])
    }
}

impl Power {
    /// Of the patch whose first pixel is `at`.
    fn at(&self, at: (usize, usize)) -> Patch {
        match self {
            Self::Same(power) => *power,
            Self::Between(between) => between.at(at),
        }
    }

    /// Mean over the frequencies, and over a frame where it differs.
    pub fn mean(&self) -> f32 {
        match self {
            Self::Same(power) => power.iter().sum::<f32>() / VALUES as f32,
            Self::Between(Between { axis, .. }) => (axis.iter().flatten().sum::<f32>() / (axis.len() * SIDE) as f32).powi(2),
        }
    }
}

/// Orthonormal DCT-II of one dimension: row k is frequency k.
fn dct() -> Patch {
    let n = SIDE as f64;
    std::array::from_fn(|p| {
        let (k, i) = (p / SIDE, p % SIDE);
        let a = if k == 0 { 1.0 / n } else { 2.0 / n };
        (a.sqrt() * (std::f64::consts::PI * (i as f64 + 0.5) * k as f64 / n).cos()) as f32
    })
}

/// The product of two square matrices.
#[inline(always)]
fn product(a: &Patch, b: &Patch) -> Patch {
    let mut out = [0f32; VALUES];
    for y in 0..SIDE {
        let mut row = [0f32; SIDE];
        for i in 0..SIDE {
            let factor = a[y * SIDE + i];
            for x in 0..SIDE {
                row[x] += factor * b[i * SIDE + x];
            }
        }
        out[y * SIDE..(y + 1) * SIDE].copy_from_slice(&row);
    }
    out
}

/// Orthonormal Haar transform along a stack of a power of two of patches, or its inverse; `spare` is as long as the stack.
#[inline(always)]
fn haar(stack: &mut [Patch], spare: &mut [Patch], inverse: bool) {
    let levels = stack.len().ilog2();
    for level in 0..levels {
        let n = if inverse { 2 << level } else { stack.len() >> level };
        for i in 0..n / 2 {
            let (from, to) = if inverse { ([i, n / 2 + i], [2 * i, 2 * i + 1]) } else { ([2 * i, 2 * i + 1], [i, n / 2 + i]) };
            for k in 0..VALUES {
                let (a, b) = (stack[from[0]][k], stack[from[1]][k]);
                spare[to[0]][k] = std::f32::consts::FRAC_1_SQRT_2 * (a + b);
                spare[to[1]][k] = std::f32::consts::FRAC_1_SQRT_2 * (a - b);
            }
        }
        stack[..n].copy_from_slice(&spare[..n]);
    }
}

/// Kaiser window of β = 2, by which patches fade towards their borders.
fn window() -> Patch {
    let bessel = |x: f64| {
        (1..20).fold((1.0, 1.0), |(sum, term), k| (sum + term * (x / f64::from(2 * k)).powi(2), term * (x / f64::from(2 * k)).powi(2))).0
    };
    let one: [f64; SIDE] = std::array::from_fn(|i| {
        let r = 2.0 * i as f64 / (SIDE - 1) as f64 - 1.0;
        bessel(2.0 * (1.0 - r * r).max(0.0).sqrt()) / bessel(2.0)
    });
    std::array::from_fn(|k| (one[k / SIDE] * one[k % SIDE]) as f32)
}

/// Orthonormal opponent space: sum, red against blue, green against both.
fn opponent() -> [[f32; 3]; 3] {
    [[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]].map(|row: [f64; 3]| {
        let length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
        row.map(|v| (v / length) as f32)
    })
}

/// `image` with each pixel multiplied by `m`.
fn mixed(image: &Rgb, m: &[[f32; 3]; 3]) -> Rgb {
    Rgb(m.map(|row| {
        let data = (0..image.width() * image.height()).map(|i| (0..3).map(|c| row[c] * image.0[c].data[i]).sum()).collect();
        Plane { width: image.width(), height: image.height(), data }
    }))
}

/// First pixels of the patches along `length` pixels: every third, and the last.
fn places(length: usize) -> Vec<usize> {
    let last = length - SIDE;
    (0..last).step_by(STEP).chain([last]).collect()
}

#[inline(always)]
fn patch(plane: &Plane, (x, y): (usize, usize)) -> Patch {
    let mut p = [0f32; VALUES];
    for (j, row) in p.chunks_exact_mut(SIDE).enumerate() {
        let at = (y + j) * plane.width + x;
        row.copy_from_slice(&plane.data[at..at + SIDE]);
    }
    p
}

/// Weighted patches and weights, summed from row `first` on.
struct Sums {
    first: usize,
    values: Rgb,
    weights: Rgb,
}

impl Sums {
    fn new(width: usize, rows: std::ops::Range<usize>) -> Self {
        let zero = Rgb::filled(width, rows.len(), 0.0);
        Self { first: rows.start, values: zero.clone(), weights: zero }
    }

    fn add(&mut self, part: &Self) {
        for (to, from) in [(&mut self.values, &part.values), (&mut self.weights, &part.weights)] {
            for (to, from) in to.0.iter_mut().zip(&from.0) {
                let at = (part.first - self.first) * to.width;
                to.data[at..].iter_mut().zip(&from.data).for_each(|(a, b)| *a += b);
            }
        }
    }
}

/// One pass: by threshold, or by the Wiener filter of `basic`.
struct Pass<'a> {
    noisy: &'a Rgb,
    basic: Option<&'a Rgb>,
    precision: &'a Precision,
    strength: f32,
    dct: Patch,
    inverse: Patch,
    opponent: [[f32; 3]; 3],
    window: Patch,
}

impl Pass<'_> {
    /// Mean of the patch of `plane` at `at`.
    #[inline(always)]
    fn mean(plane: &Plane, at: (usize, usize)) -> f32 {
        let own = patch(plane, at);
        let mut columns = [0f32; SIDE];
        for row in own.chunks_exact(SIDE) {
            for i in 0..SIDE {
                columns[i] += row[i];
            }
        }
        columns.iter().sum::<f32>() / VALUES as f32
    }

    /// Variances of the coefficients of the patch at `at`, by opponent channel.
    #[inline(always)]
    fn variances(&self, at: (usize, usize)) -> [Patch; 3] {
        let mut channels: [Patch; 3] = std::array::from_fn(|c| [Self::mean(&self.precision.white.0[c], at); VALUES]);
        for (given, power) in &self.precision.blurred {
            let power = power.at(at);
            for (channel, given) in channels.iter_mut().zip(&given.0) {
                let given = Self::mean(given, at);
                for k in 0..VALUES {
                    channel[k] += given * power[k];
                }
            }
        }
        for value in channels.as_flattened_mut() {
            *value = self.strength * self.strength / value.max(1.0 / (UNKNOWN * UNKNOWN));
        }
        let mut mixed = [[0f32; VALUES]; 3];
        for (out, row) in mixed.iter_mut().zip(&self.opponent) {
            for k in 0..VALUES {
                out[k] = row[0] * row[0] * channels[0][k] + row[1] * row[1] * channels[1][k] + row[2] * row[2] * channels[2][k];
            }
        }
        mixed
    }

    /// Puts the places of the patches most like that at `at` into `best`, the likest first: that itself, and a power of two of them.
    #[inline(always)]
    fn alike(&self, at: (usize, usize), best: &mut Vec<(f32, (usize, usize))>) {
        let plane = &self.basic.unwrap_or(self.noisy).0[0];
        let most = STACK[usize::from(self.basic.is_some())];
        let own = patch(plane, at);
        best.clear();
        best.push((0.0, at));
        let mut limit = f32::INFINITY;
        for y in at.1.saturating_sub(REACH)..=(at.1 + REACH).min(plane.height - SIDE) {
            for x in at.0.saturating_sub(REACH)..=(at.0 + REACH).min(plane.width - SIDE) {
                if (x, y) == at {
                    continue;
                }
                let mut squares = [0f32; SIDE];
                let mut difference = 0.0;
                // In two halves: most patches are too different after the first.
                for half in [0, SIDE / 2] {
                    for j in half..half + SIDE / 2 {
                        let row = &plane.data[(y + j) * plane.width + x..][..SIDE];
                        for i in 0..SIDE {
                            let d = row[i] - own[j * SIDE + i];
                            squares[i] += d * d;
                        }
                    }
                    let [a, b, c, d, e, f, g, h] = squares;
                    difference = ((a + e) + (b + f)) + ((c + g) + (d + h));
                    if difference >= limit {
                        break;
                    }
                }
                if difference < limit {
                    best.truncate(most - 1);
                    best.insert(best.partition_point(|b| b.0 <= difference), (difference, (x, y)));
                    if best.len() == most {
                        limit = best[most - 1].0;
                    }
                }
            }
        }
        best.truncate(1 << best.len().ilog2());
    }

    /// Shrinks the coefficients of a stack, by those of `known` when it is not empty; returns the variance that is left in it.
    #[inline(always)]
    fn shrink(stack: &mut [Patch], known: &[Patch], variance: &Patch) -> f32 {
        // The mean of the stack is always kept.
        let (mean, mut gains) = (stack[0][0], [0f32; VALUES]);
        for (n, patch) in stack.iter_mut().enumerate() {
            for k in 0..VALUES {
                let gain = if known.is_empty() {
                    if patch[k] * patch[k] > THRESHOLD * THRESHOLD * variance[k] { 1.0 } else { 0.0 }
                } else {
                    known[n][k] * known[n][k] / (known[n][k] * known[n][k] + variance[k])
                };
                patch[k] *= gain;
                gains[k] += gain * gain;
            }
        }
        if known.is_empty() && stack[0][0] == 0.0 {
            stack[0][0] = mean;
            gains[0] += 1.0;
        }
        (0..VALUES).map(|k| gains[k] * variance[k]).sum()
    }

    /// The transform of the patches of `plane` at `places`.
    #[inline(always)]
    fn transformed(&self, plane: &Plane, places: &[(f32, (usize, usize))], stack: &mut [Patch], spare: &mut [Patch]) {
        for (patch_of, place) in stack.iter_mut().zip(places) {
            *patch_of = product(&product(&self.dct, &patch(plane, place.1)), &self.inverse);
        }
        haar(stack, spare, false);
    }

    #[inline(always)]
    fn band(&self, rows: &[usize], columns: &[usize]) -> Sums {
        let (width, height) = self.noisy.size();
        let mut sums = Sums::new(width, rows[0].saturating_sub(REACH)..(rows[rows.len() - 1] + REACH + SIDE).min(height));
        let [mut spare, mut stack, mut known] = [(); 3].map(|()| vec![[0f32; VALUES]; STACK[1]]);
        let mut places = Vec::with_capacity(STACK[1]);
        for &y in rows {
            for &x in columns {
                self.alike((x, y), &mut places);
                let stack = &mut stack[..places.len()];
                let known = &mut known[..if self.basic.is_some() { places.len() } else { 0 }];
                let variances = self.variances((x, y));
                for (c, variance) in variances.iter().enumerate() {
                    self.transformed(&self.noisy.0[c], &places, stack, &mut spare);
                    if let Some(basic) = self.basic {
                        self.transformed(&basic.0[c], &places, known, &mut spare);
                    }
                    let weight = 1.0 / Self::shrink(stack, known, variance).max(f32::MIN_POSITIVE);
                    haar(stack, &mut spare, true);
                    for (&(_, (x, y)), coefficients) in places.iter().zip(stack.iter()) {
                        let p = product(&product(&self.inverse, coefficients), &self.dct);
                        for j in 0..SIDE {
                            let row = (y + j - sums.first) * width + x;
                            let values = &mut sums.values.0[c].data[row..row + SIDE];
                            let weights = &mut sums.weights.0[c].data[row..row + SIDE];
                            for i in 0..SIDE {
                                let w = weight * self.window[j * SIDE + i];
                                values[i] += w * p[j * SIDE + i];
                                weights[i] += w;
                            }
                        }
                    }
                }
            }
        }
        sums
    }

    fn run(&self, progress: &mut dyn FnMut(f32) -> bool) -> Option<Rgb> {
        let (width, height) = self.noisy.size();
        let (rows, columns) = (places(height), places(width));
        let mut sums = Sums::new(width, 0..height);
        let batch = BAND * rayon::current_num_threads() * EACH;
        for (n, some) in rows.chunks(batch).enumerate() {
            let of = |band: &[usize]| {
                wide(
                    #[inline(always)]
                    || self.band(band, &columns),
                )
            };
            let parts: Vec<Sums> = some.par_chunks(BAND).map(of).collect();
            parts.iter().for_each(|part| sums.add(part));
            if !progress(((n + 1) * batch) as f32 / rows.len() as f32) {
                return None;
            }
        }
        Some(Rgb(std::array::from_fn(|c| sums.values.0[c].zip(&sums.weights.0[c], |v, w| v / w))))
    }
}

/// `image` less its noise, whose standard deviation is taken to be `strength` times what `precision` (same size) says;
/// `None` when `progress`, which receives the fraction done, returns `false`.
pub fn filtered(image: &Rgb, precision: &Precision, strength: f32, progress: &mut dyn FnMut(f32) -> bool) -> Option<Rgb> {
    let (width, height) = image.size();
    if width < SIDE || height < SIDE {
        // Smaller than a patch: with its last pixels repeated.
        let (w, h) = (width.max(SIDE), height.max(SIDE));
        let larger = |i: &Rgb| i.map_planes(|p| Plane::from_fn(w, h, |x, y| p.clamped(x as isize, y as isize)));
        let blurred = precision.blurred.iter().map(|(p, power)| (larger(p), power.clone())).collect();
        let precision = Precision { white: larger(&precision.white), blurred };
        return filtered(&larger(image), &precision, strength, progress).map(|f| f.crop(0, 0, width, height));
    }
    let (dct, opponent) = (dct(), opponent());
    let noisy = mixed(image, &opponent);
    let inverse = std::array::from_fn(|p| dct[p % SIDE * SIDE + p / SIDE]);
    let mut pass = Pass { noisy: &noisy, basic: None, precision, strength, dct, inverse, opponent, window: window() };
    let basic = pass.run(&mut |f| progress(0.4 * f.min(1.0)))?;
    pass.basic = Some(&basic);
    let filtered = pass.run(&mut |f| progress(0.4 + 0.6 * f.min(1.0)))?;
    Some(mixed(&filtered, &std::array::from_fn(|c| std::array::from_fn(|i| opponent[i][c]))))
}
