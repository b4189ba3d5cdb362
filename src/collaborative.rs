//! Collaborative filtering of an image: K. Dabov, A. Foi, V. Katkovnik and K. Egiazarian, "Image Denoising by Sparse 3-D
//! Transform-Domain Collaborative Filtering", IEEE Transactions on Image Processing 16(8), 2007 (BM3D), for noise whose level is known pixel
//! by pixel and frequency by frequency.
//!
//! Patches that look alike are stacked, transformed in three dimensions (DCT in the patch, Haar along the stack), shrunk, transformed back
//! and averaged where they overlap; first by a threshold, then by the Wiener filter that the first result suggests. Detail that repeats, or
//! that stands out of its noise, stays; total variation, which only knows that edges are few, cannot tell fine texture from noise.
//!
//! The variance of a coefficient is `1 / (p + Σ_i p_i P_i)`: p is the inverse variance that sharp frames give, p_i what shaken frame i gives
//! where its blur passes all ([`Precision`]), P_i its blur's power at the coefficient's frequency. Channels are filtered in an orthonormal
//! opponent space, in stacks that the sum of the channels chooses.

use crate::image::{Plane, Rgb};
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
/// Tasks whose results are held at once.
const BATCH: usize = 8;

/// Inverse variance of the values, pixel by pixel.
pub struct Precision {
    /// What frames give that no blur affects.
    pub white: Rgb,
    /// For each shaken frame, what it gives at frequency 0, and the power of its PSF at the frequencies of the patch transform.
    pub shaken: Vec<(Rgb, Patch)>,
}

/// Orthonormal DCT-II of one dimension: row k is frequency k.
fn dct() -> [[f32; SIDE]; SIDE] {
    let n = SIDE as f64;
    std::array::from_fn(|k| {
        let a = if k == 0 { 1.0 / n } else { 2.0 / n };
        std::array::from_fn(|i| (a.sqrt() * (std::f64::consts::PI * (i as f64 + 0.5) * k as f64 / n).cos()) as f32)
    })
}

/// `m p mᵀ`.
fn transform(m: &[[f32; SIDE]; SIDE], p: &Patch) -> Patch {
    let (mut rows, mut out) = ([0f32; VALUES], [0f32; VALUES]);
    for y in 0..SIDE {
        for i in 0..SIDE {
            for x in 0..SIDE {
                rows[y * SIDE + x] += m[y][i] * p[i * SIDE + x];
            }
        }
    }
    for y in 0..SIDE {
        for i in 0..SIDE {
            for x in 0..SIDE {
                out[y * SIDE + x] += rows[y * SIDE + i] * m[x][i];
            }
        }
    }
    out
}

/// Orthonormal Haar transform along a stack of a power of two of patches, or its inverse; `spare` is as long as the stack.
fn haar(stack: &mut [Patch], spare: &mut [Patch], inverse: bool) {
    let mut lengths: Vec<usize> = std::iter::successors(Some(stack.len()), |n| Some(n / 2)).take_while(|n| *n >= 2).collect();
    if inverse {
        lengths.reverse();
    }
    for n in lengths {
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
    dct: [[f32; SIDE]; SIDE],
    inverse: [[f32; SIDE]; SIDE],
    opponent: [[f32; 3]; 3],
    window: Patch,
}

impl Pass<'_> {
    /// Variances of the coefficients of the patch at `at`, by opponent channel.
    fn variances(&self, at: (usize, usize)) -> [Patch; 3] {
        let mean = |plane: &Plane| patch(plane, at).iter().sum::<f32>() / VALUES as f32;
        let channels: [Patch; 3] = std::array::from_fn(|c| {
            let mut precision = [mean(&self.precision.white.0[c]); VALUES];
            for (given, power) in &self.precision.shaken {
                let given = mean(&given.0[c]);
                precision.iter_mut().zip(power).for_each(|(p, power)| *p += given * power);
            }
            precision.map(|p| self.strength * self.strength / p.max(1.0 / (UNKNOWN * UNKNOWN)))
        });
        self.opponent.map(|row| std::array::from_fn(|k| (0..3).map(|c| row[c] * row[c] * channels[c][k]).sum()))
    }

    /// Places of the patches most like that at `at`, the likest first: that itself, and a power of two of them.
    fn alike(&self, at: (usize, usize)) -> Vec<(usize, usize)> {
        let plane = &self.basic.unwrap_or(self.noisy).0[0];
        let most = STACK[usize::from(self.basic.is_some())];
        let own = patch(plane, at);
        let mut best: Vec<(f32, (usize, usize))> = vec![(0.0, at)];
        for y in at.1.saturating_sub(REACH)..=(at.1 + REACH).min(plane.height - SIDE) {
            for x in at.0.saturating_sub(REACH)..=(at.0 + REACH).min(plane.width - SIDE) {
                if (x, y) == at {
                    continue;
                }
                let limit = if best.len() < most { f32::INFINITY } else { best[most - 1].0 };
                let mut difference = 0.0;
                // In two halves: most patches are too different after the first.
                for half in [0, SIDE / 2] {
                    let mut squares = [0f32; SIDE];
                    for j in half..half + SIDE / 2 {
                        let row = &plane.data[(y + j) * plane.width + x..][..SIDE];
                        for i in 0..SIDE {
                            squares[i] += (row[i] - own[j * SIDE + i]).powi(2);
                        }
                    }
                    difference += squares.iter().sum::<f32>();
                    if difference >= limit {
                        break;
                    }
                }
                if difference < limit {
                    best.truncate(most - 1);
                    best.insert(best.partition_point(|b| b.0 <= difference), (difference, (x, y)));
                }
            }
        }
        best.truncate(1 << best.len().ilog2());
        best.into_iter().map(|b| b.1).collect()
    }

    /// Shrinks the coefficients of a stack, by those of `known` when it is not empty; returns the variance that is left in it.
    fn shrink(stack: &mut [Patch], known: &[Patch], variance: &Patch) -> f32 {
        let mut left = 0.0;
        for (n, patch) in stack.iter_mut().enumerate() {
            for k in 0..VALUES {
                let gain = match known.get(n) {
                    Some(known) => known[k] * known[k] / (known[k] * known[k] + variance[k]),
                    // The mean of the stack is always kept.
                    None => f32::from(patch[k] * patch[k] > THRESHOLD * THRESHOLD * variance[k] || (n, k) == (0, 0)),
                };
                patch[k] *= gain;
                left += gain * gain * variance[k];
            }
        }
        left
    }

    fn band(&self, rows: &[usize], columns: &[usize]) -> Sums {
        let (width, height) = self.noisy.size();
        let mut sums = Sums::new(width, rows[0].saturating_sub(REACH)..(rows[rows.len() - 1] + REACH + SIDE).min(height));
        let mut spare = vec![[0f32; VALUES]; STACK[1]];
        for at in rows.iter().flat_map(|&y| columns.iter().map(move |&x| (x, y))) {
            let places = self.alike(at);
            let variances = self.variances(at);
            for (c, variance) in variances.iter().enumerate() {
                let mut transformed = |plane: &Plane| {
                    let mut stack: Vec<Patch> = places.iter().map(|&p| transform(&self.dct, &patch(plane, p))).collect();
                    haar(&mut stack, &mut spare, false);
                    stack
                };
                let mut stack = transformed(&self.noisy.0[c]);
                let known = self.basic.map_or(Vec::new(), |b| transformed(&b.0[c]));
                let weight = 1.0 / Self::shrink(&mut stack, &known, variance).max(f32::MIN_POSITIVE);
                haar(&mut stack, &mut spare, true);
                for (&(x, y), coefficients) in places.iter().zip(&stack) {
                    let p = transform(&self.inverse, coefficients);
                    for j in 0..SIDE {
                        let row = (y + j - sums.first) * width + x;
                        for i in 0..SIDE {
                            let w = weight * self.window[j * SIDE + i];
                            sums.values.0[c].data[row + i] += w * p[j * SIDE + i];
                            sums.weights.0[c].data[row + i] += w;
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
        for (n, batch) in rows.chunks(BAND * BATCH).enumerate() {
            let parts: Vec<Sums> = batch.par_chunks(BAND).map(|band| self.band(band, &columns)).collect();
            parts.iter().for_each(|part| sums.add(part));
            if !progress(((n + 1) * BAND * BATCH) as f32 / rows.len() as f32) {
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
        let shaken = precision.shaken.iter().map(|(p, power)| (larger(p), *power)).collect();
        let precision = Precision { white: larger(&precision.white), shaken };
        return filtered(&larger(image), &precision, strength, progress).map(|f| f.map_planes(|p| p.crop(0, 0, width, height)));
    }
    let (dct, opponent) = (dct(), opponent());
    let noisy = mixed(image, &opponent);
    let inverse = std::array::from_fn(|i| std::array::from_fn(|k| dct[k][i]));
    let mut pass = Pass { noisy: &noisy, basic: None, precision, strength, dct, inverse, opponent, window: window() };
    let basic = pass.run(&mut |f| progress(0.4 * f.min(1.0)))?;
    pass.basic = Some(&basic);
    let filtered = pass.run(&mut |f| progress(0.4 + 0.6 * f.min(1.0)))?;
    Some(mixed(&filtered, &std::array::from_fn(|c| std::array::from_fn(|i| opponent[i][c]))))
}
