//! PSFs of a patch that no frame shows sharp: two frames of it, blurred differently, eq. (12) (after Šroubek and Flusser 2005).
//!
//! `Θ(E, h¹, h²) = ½ Σ_n ‖h^n * E - B^n‖² + λ_TV ∫|∇E| + ½ λ_h ‖h² * B¹ - h¹ * B²‖²` is minimised in turn over E (half-quadratic total
//! variation, conjugate gradients) and over the PSFs (accelerated projected gradients; each PSF is non-negative with sum 1). The terms with
//! PSFs are taken on x and y differences, because the mean level would stall everything; λ_TV falls from round to round, so that strong edges
//! come first.
//!
//! E and both PSFs may be shifted against each other without any change in Θ: [`crate::tsf`] aligns them.

use super::Psf;
use crate::fft::{Fft2, Spectrum};
use crate::image::Plane;
use rayon::prelude::*;

/// What can be set about the estimate of a pair.
#[derive(Clone, Copy, Debug)]
pub struct Setup {
    /// Largest |u| of the PSFs in pixels, at most a quarter of the patch: 12 makes them 25 x 25.
    pub radius: usize,
    /// Rounds of latent patch and PSFs.
    pub rounds: usize,
    /// λ_TV of the last round, for patches of mean 1; the first round has thirty times as much.
    pub smoothness: f32,
    /// λ_h.
    pub cross: f32,
}

impl Default for Setup {
    fn default() -> Self {
        Self { radius: 12, rounds: 12, smoothness: 1e-3, cross: 1.0 }
    }
}

/// What a pair of patches says.
#[derive(Clone, Debug)]
pub struct Pair {
    /// Latent patch and `radius` pixels on every side, in the first patch's units.
    pub latent: Plane,
    /// PSF of each of the two.
    pub psfs: [Psf; 2],
}

/// λ_TV of the first round over that of the last.
const STRONG: f32 = 30.0;
/// Differences below this part of the mean are smoothed quadratically.
const EPSILON: f32 = 3e-3;
/// Half-quadratic steps and conjugate-gradient iterations of each, per round.
const LATENT: (usize, usize) = (2, 12);
/// Projected gradient steps per round.
const STEPS: usize = 25;

/// Convolutions of a patch with kernels of one radius; all arrays are `side + 2 radius` wide, PSFs wrap around the origin.
struct Convolution {
    fft: Fft2,
    /// Pixels per row of an array.
    wide: usize,
    radius: usize,
}

impl Convolution {
    fn new(side: usize, radius: usize) -> Self {
        let wide = side + 2 * radius;
        Self { fft: Fft2::new(wide, wide), wide, radius }
    }

    fn spectrum(&self, array: &[f32]) -> Spectrum {
        self.fft.forward(array, self.wide)
    }

    /// Spectrum of a kernel of (2 radius + 1)² values.
    fn of_kernel(&self, h: &[f32]) -> Spectrum {
        let (w, r) = (self.fft.width, self.radius);
        let mut image = vec![0.0; w * self.fft.height];
        for (i, v) in h.iter().enumerate() {
            let (x, y) = (i % (2 * r + 1), i / (2 * r + 1));
            image[(y + self.fft.height - r) % self.fft.height * w + (x + w - r) % w] = *v;
        }
        self.fft.forward(&image, w)
    }

    /// Array of the product of two spectra.
    fn convolve(&self, a: &Spectrum, b: &Spectrum) -> Vec<f32> {
        self.cut(self.fft.inverse(a.iter().zip(b).map(|(x, y)| x * y).collect()))
    }

    /// Array of `a` correlated with the kernel `k`.
    fn correlate(&self, a: &Spectrum, k: &Spectrum) -> Vec<f32> {
        self.cut(self.fft.inverse(a.iter().zip(k).map(|(x, y)| x * y.conj()).collect()))
    }

    fn cut(&self, image: Vec<f32>) -> Vec<f32> {
        image.chunks_exact(self.fft.width).take(self.wide).flat_map(|row| row[..self.wide].iter().copied()).collect()
    }

    /// Σ_y a(y) x(y - u) for |u| up to the radius.
    fn lags(&self, a: &Spectrum, x: &Spectrum) -> Vec<f32> {
        let (w, h, r) = (self.fft.width, self.fft.height, self.radius);
        let g = self.fft.inverse(a.iter().zip(x).map(|(p, q)| p * q.conj()).collect());
        let n = 2 * r + 1;
        (0..n * n).map(|i| g[(i / n + h - r) % h * w + (i % n + w - r) % w]).collect()
    }
}

/// Nearest point of the simplex (non-negative, sum 1) to `h`.
fn simplex(h: &mut [f32]) {
    let mut sorted = h.to_vec();
    sorted.sort_by(|a, b| b.total_cmp(a));
    let (mut sum, mut shift) = (0.0f32, 0.0f32);
    for (k, v) in sorted.iter().enumerate() {
        sum += v;
        let t = (sum - 1.0) / (k + 1) as f32;
        if *v > t {
            shift = t;
        }
    }
    h.iter_mut().for_each(|v| *v = (*v - shift).max(0.0));
}

/// Differences to the right or downwards, 0 at the last column or row.
fn difference(a: &[f32], wide: usize, down: bool) -> Vec<f32> {
    let n = a.len();
    let step = if down { wide } else { 1 };
    let inside = |p: usize| if down { p + wide < n } else { !(p + 1).is_multiple_of(wide) };
    (0..n).map(|p| if inside(p) { a[p + step] - a[p] } else { 0.0 }).collect()
}

/// Both PSFs of a square patch that two frames show, B¹ = `first` and B² = `second` (irradiance, one size), `weights` their inverse variances (0:
/// masked). `None` for a patch that is too small for the PSFs, dark throughout or masked by more than half in either frame.
pub fn estimate_pair(first: &Plane, second: &Plane, weights: [&Plane; 2], setup: &Setup) -> Option<Pair> {
    let (side, r) = (first.width, setup.radius);
    let square = [first, second, weights[0], weights[1]].iter().all(|p| p.size() == (side, side));
    let seen = |w: &Plane| w.data.iter().filter(|v| **v > 0.0).count();
    if !square || side < 4 * r || weights.iter().any(|w| 2 * seen(w) < side * side) {
        return None;
    }
    let both = [first, second];
    let mean = both.iter().map(|b| b.data.iter().sum::<f32>()).sum::<f32>() / (2 * side * side) as f32;
    if !(mean.is_finite() && mean > 0.0) {
        return None;
    }
    let convolution = Convolution::new(side, r);
    let wide = convolution.wide;
    // The frames on the latent grid; beyond them the nearest pixel.
    let wrapped = |p: &Plane| p.padded(r).data;
    let blurred = both.map(|b| wrapped(b).iter().map(|v| v / mean).collect::<Vec<f32>>());
    let masks: [Vec<f32>; 2] = std::array::from_fn(|n| {
        let within = |p: usize| (r..side + r).contains(&(p % wide)) && (r..side + r).contains(&(p / wide));
        let padded = wrapped(weights[n]);
        (0..wide * wide).map(|p| if within(p) && padded[p] > 0.0 { 1.0 } else { 0.0 }).collect()
    });
    // Where neither frame is masked as far as the PSFs reach.
    let whole = {
        let lost: Vec<f32> = (0..wide * wide).map(|p| 1.0 - masks[0][p] * masks[1][p]).collect();
        let all = vec![1.0; (2 * r + 1) * (2 * r + 1)];
        let near = convolution.convolve(&convolution.spectrum(&lost), &convolution.of_kernel(&all));
        let within = |p: usize| (2 * r..side).contains(&(p % wide)) && (2 * r..side).contains(&(p / wide));
        (0..wide * wide).map(|p| if within(p) && near[p] < 0.5 { 1.0 } else { 0.0 }).collect::<Vec<f32>>()
    };
    let steps = [false, true].map(|down| blurred.each_ref().map(|b| difference(b, wide, down)));
    let spectra = steps.each_ref().map(|d| d.each_ref().map(|b| convolution.spectrum(b)));
    let taps = (2 * r + 1) * (2 * r + 1);
    let mut psfs = [vec![0.0f32; taps], vec![0.0f32; taps]];
    psfs.iter_mut().for_each(|h| h[taps / 2] = 1.0);
    let mut latent = blurred[0].clone();
    for round in 0..setup.rounds {
        let t = round as f32 / (setup.rounds.max(2) - 1) as f32;
        let smoothness = setup.smoothness * STRONG.powf(1.0 - t);
        fit_psfs(&convolution, &latent, (&steps, &spectra), (&masks, &whole), setup.cross, &mut psfs);
        fit_latent(&convolution, &mut latent, &blurred, &masks, &psfs, smoothness);
    }
    fit_psfs(&convolution, &latent, (&steps, &spectra), (&masks, &whole), setup.cross, &mut psfs);
    let of = |h: &[f32]| Psf { radius: r, values: Plane { width: 2 * r + 1, height: 2 * r + 1, data: h.to_vec() } };
    let latent = Plane { width: wide, height: wide, data: latent.iter().map(|v| v * mean).collect() };
    Some(Pair { latent, psfs: [of(&psfs[0]), of(&psfs[1])] })
}

/// The step over E: `Σ_n h^n ⋆ m_n (h^n * E - B^n) + λ Dᵀ D E / |D E| = 0`.
fn fit_latent(c: &Convolution, latent: &mut [f32], blurred: &[Vec<f32>; 2], masks: &[Vec<f32>; 2], psfs: &[Vec<f32>; 2], lambda: f32) {
    let wide = c.wide;
    let n = latent.len();
    let kernels = psfs.each_ref().map(|h| c.of_kernel(h));
    for _ in 0..LATENT.0 {
        let (dx, dy) = (difference(latent, wide, false), difference(latent, wide, true));
        let edge: Vec<f32> = dx.iter().zip(&dy).map(|(x, y)| lambda / (x * x + y * y + EPSILON * EPSILON).sqrt()).collect();
        let normal = |v: &[f32]| -> Vec<f32> {
            let spectrum = c.spectrum(v);
            let mut out = vec![0.0f32; n];
            for (k, m) in kernels.iter().zip(masks) {
                let seen: Vec<f32> = c.convolve(&spectrum, k).iter().zip(m).map(|(a, b)| a * b).collect();
                out.iter_mut().zip(c.correlate(&c.spectrum(&seen), k)).for_each(|(o, v)| *o += v);
            }
            for down in [false, true] {
                let step = if down { wide } else { 1 };
                for (p, d) in difference(v, wide, down).iter().enumerate().filter(|(_, d)| **d != 0.0) {
                    out[p] -= edge[p] * d;
                    out[p + step] += edge[p] * d;
                }
            }
            out
        };
        let mut right = vec![0.0f32; n];
        for ((k, m), b) in kernels.iter().zip(masks).zip(blurred) {
            let seen: Vec<f32> = b.iter().zip(m).map(|(a, b)| a * b).collect();
            right.iter_mut().zip(c.correlate(&c.spectrum(&seen), k)).for_each(|(o, v)| *o += v);
        }
        let start = normal(latent);
        let mut residual: Vec<f32> = right.iter().zip(&start).map(|(a, b)| a - b).collect();
        let mut direction = residual.clone();
        let mut energy = dot(&residual, &residual);
        for _ in 0..LATENT.1 {
            let ad = normal(&direction);
            let curvature = dot(&direction, &ad);
            if curvature <= 0.0 || energy <= 0.0 {
                break;
            }
            let alpha = (energy / curvature) as f32;
            latent.iter_mut().zip(&direction).for_each(|(e, d)| *e += alpha * d);
            residual.iter_mut().zip(&ad).for_each(|(r, a)| *r -= alpha * a);
            let next = dot(&residual, &residual);
            let beta = (next / energy) as f32;
            energy = next;
            direction.iter_mut().zip(&residual).for_each(|(d, r)| *d = r + beta * *d);
        }
        latent.iter_mut().for_each(|e| *e = e.max(0.0));
    }
}

type Steps<'a> = (&'a [[Vec<f32>; 2]; 2], &'a [[Spectrum; 2]; 2]);

/// The step over both PSFs.
fn fit_psfs(
    c: &Convolution,
    latent: &[f32],
    (steps, spectra): Steps,
    (masks, whole): (&[Vec<f32>; 2], &[f32]),
    cross: f32,
    psfs: &mut [Vec<f32>; 2],
) {
    let scene: Vec<Spectrum> = [false, true].iter().map(|&down| c.spectrum(&difference(latent, c.wide, down))).collect();
    // Gradient of the quadratic part at `h`; without the observations, the product with its matrix.
    let gradient = |h: &[Vec<f32>; 2], observed: bool| -> [Vec<f32>; 2] {
        let kernels = h.each_ref().map(|h| c.of_kernel(h));
        let parts: Vec<[Vec<f32>; 2]> = (0..2)
            .into_par_iter()
            .map(|d| {
                let apart: Vec<f32> = {
                    let (a, b) = (c.convolve(&spectra[d][0], &kernels[1]), c.convolve(&spectra[d][1], &kernels[0]));
                    a.iter().zip(&b).zip(whole).map(|((a, b), m)| cross * m * (a - b)).collect()
                };
                let apart = c.spectrum(&apart);
                std::array::from_fn(|n| {
                    let predicted = c.convolve(&scene[d], &kernels[n]);
                    let residual: Vec<f32> =
                        (0..predicted.len()).map(|p| masks[n][p] * (predicted[p] - if observed { steps[d][n][p] } else { 0.0 })).collect();
                    let mut g = c.lags(&c.spectrum(&residual), &scene[d]);
                    let sign = if n == 1 { 1.0 } else { -1.0 };
                    g.iter_mut().zip(c.lags(&apart, &spectra[d][1 - n])).for_each(|(g, v)| *g += sign * v);
                    g
                })
            })
            .collect();
        std::array::from_fn(|n| parts[0][n].iter().zip(&parts[1][n]).map(|(a, b)| a + b).collect())
    };
    // The largest eigenvalue bounds the step.
    let taps = psfs[0].len();
    let mut probe = [vec![0.0f32; taps], vec![0.0f32; taps]];
    for (n, h) in probe.iter_mut().enumerate() {
        h.iter_mut().enumerate().for_each(|(i, v)| *v = if (i + n).is_multiple_of(2) { 1.0 } else { 0.9 });
    }
    let mut largest = 0.0;
    for _ in 0..8 {
        let norm = (dot(&probe[0], &probe[0]) + dot(&probe[1], &probe[1])).sqrt() as f32;
        probe.iter_mut().flatten().for_each(|v| *v /= norm);
        probe = gradient(&probe, false);
        largest = (dot(&probe[0], &probe[0]) + dot(&probe[1], &probe[1])).sqrt() as f32;
    }
    if largest <= 0.0 {
        return;
    }
    let step = 1.0 / (1.2 * largest);
    let mut ahead = psfs.clone();
    let mut momentum = 1.0f32;
    for _ in 0..STEPS {
        let g = gradient(&ahead, true);
        let next = 0.5 * (1.0 + (1.0 + 4.0 * momentum * momentum).sqrt());
        for n in 0..2 {
            let mut moved: Vec<f32> = ahead[n].iter().zip(&g[n]).map(|(h, g)| h - step * g).collect();
            simplex(&mut moved);
            let push = (momentum - 1.0) / next;
            ahead[n] = moved.iter().zip(&psfs[n]).map(|(new, old)| new + push * (new - old)).collect();
            psfs[n] = moved;
        }
        momentum = next;
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
}
