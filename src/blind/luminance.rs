//! Latent luminance from all frames and their TSFs: what the colour solver does, for a single plane on the CPU, for the many solves
//! between which the TSFs change.
//!
//! In log luminance u each outer iteration solves `[E Σ KᵀWK E + Dᵀ w D] δu = E Σ KᵀW (B - K E) - Dᵀ w D u` with
//! w = λ/√(|∇u|² + ε²) by preconditioned conjugate gradients and steps to E (1 + δu) where δu > 0 and to
//! E exp(δu) elsewhere (at most fourfold, at least 1/e).

use super::operator::Operator;
use crate::image::{Channels, Plane, Rgb};
use crate::tsf::Tsf;

/// One frame's luminance at one size.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Irradiance.
    pub blurred: Plane,
    /// Variance of the irradiance by noise alone.
    pub variance: Plane,
    /// 0..=1: how much a pixel counts.
    pub mask: Plane,
    /// Where the file is clipped: there `blurred` is a lower bound.
    pub clipped: Vec<bool>,
}

/// How hard to solve, and how smooth.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// Weight λ of total variation per unit of log luminance.
    pub lambda: f32,
    /// Gauss-Newton steps.
    pub outer: usize,
    /// Conjugate-gradient iterations of each.
    pub inner: usize,
    /// Standard deviation of the operator's own error, as a part of the mean absolute gradient around a pixel of the frame.
    pub model_error: f32,
}

/// Differences of log luminance below this are smoothed quadratically.
const EPSILON: f32 = 0.01;

/// Exposure of a masked pixel above which it is masked for clipping.
const CLIPPED: f32 = 0.5;

/// Mean of squared residuals over noise variance of a frame at `latent`, over the pixels where `chosen` is true.
pub fn chi_squared(frame: &Frame, operator: &Operator, latent: &Plane, chosen: &[bool]) -> f64 {
    let predicted = operator.forward(&latent.data);
    let inside = operator.inside();
    let (mut sum, mut count) = (0.0f64, 0.0f64);
    for p in (0..predicted.len()).filter(|&p| chosen[p] && inside[p] && frame.mask.data[p] > 0.0) {
        sum += f64::from((frame.blurred.data[p] - predicted[p]).powi(2) / frame.variance.data[p]);
        count += 1.0;
    }
    if count > 0.0 { sum / count } else { f64::NAN }
}

/// Latent luminance (positive; grid of the frames plus `pad`) from `frames` under `tsfs`, started at `latent`. Pixels whose `held` is true
/// are kept out of the data term.
pub fn solve(frames: &[Frame], operators: &[Operator], latent: &Plane, held: &[bool], effort: &Effort) -> Plane {
    let (w, h) = latent.size();
    let n = w * h;
    let mut u: Vec<f32> = latent.data.iter().map(|v| v.max(f32::MIN_POSITIVE).ln()).collect();
    let insides: Vec<Vec<bool>> = operators.iter().map(Operator::inside).collect();
    let models: Vec<Plane> =
        frames.iter().map(|f| crate::merge::gradient_level(&f.blurred, 4).map(|v| (effort.model_error * v).powi(2))).collect();
    for _ in 0..effort.outer {
        let e: Vec<f32> = u.iter().map(|v| v.exp()).collect();
        let mut weights: Vec<Vec<f32>> = Vec::new();
        let mut right = vec![0.0f32; n];
        let mut diagonal = vec![0.0f32; n];
        for (k, frame) in frames.iter().enumerate() {
            let predicted = operators[k].forward(&e);
            let residual: Vec<f32> = frame.blurred.data.iter().zip(&predicted).map(|(b, p)| b - p).collect();
            let usable = |p: usize| if insides[k][p] && !held[p] { frame.mask.data[p] } else { 0.0 };
            // A clipped pixel says that its irradiance is not below what clips: it counts while the estimate is.
            let bounded = |p: usize| frame.clipped[p] && insides[k][p] && residual[p] > 0.0;
            let weight: Vec<f32> = (0..predicted.len())
                .map(|p| {
                    let m = if bounded(p) { 1.0 } else { usable(p) };
                    if m == 0.0 {
                        return 0.0;
                    }
                    m * m / (frame.variance.data[p] + models[k].data[p])
                })
                .collect();
            let back = operators[k].adjoint(&residual.iter().zip(&weight).map(|(r, w)| r * w).collect::<Vec<f32>>());
            right.iter_mut().zip(&back).for_each(|(a, b)| *a += b);
            let spread = operators[k].adjoint(&weight);
            // Cubic weights have negative lobes; a preconditioner may not.
            diagonal.iter_mut().zip(&spread).for_each(|(a, b)| *a += operators[k].energy() * b.max(0.0));
            weights.push(weight);
        }
        let edge: Vec<f32> = (0..n)
            .map(|p| {
                let (x, y) = (p % w, p / w);
                let dx = if x + 1 < w { u[p + 1] - u[p] } else { 0.0 };
                let dy = if y + 1 < h { u[p + w] - u[p] } else { 0.0 };
                effort.lambda / (dx * dx + dy * dy + EPSILON * EPSILON).sqrt()
            })
            .collect();
        let stiffness = |v: &[f32], out: &mut [f32]| {
            for y in 0..h {
                for x in 0..w {
                    let p = y * w + x;
                    if x + 1 < w {
                        let d = edge[p] * (v[p + 1] - v[p]);
                        out[p] -= d;
                        out[p + 1] += d;
                    }
                    if y + 1 < h {
                        let d = edge[p] * (v[p + w] - v[p]);
                        out[p] -= d;
                        out[p + w] += d;
                    }
                }
            }
        };
        let mut smoothness = vec![0.0f32; n];
        stiffness(&u, &mut smoothness);
        let mut residual: Vec<f32> = (0..n).map(|p| e[p] * right[p] - smoothness[p]).collect();
        let preconditioner: Vec<f32> = (0..n)
            .map(|p| {
                let (x, y) = (p % w, p / w);
                let mut d = e[p] * e[p] * diagonal[p];
                d += if x + 1 < w { edge[p] } else { 0.0 } + if y + 1 < h { edge[p] } else { 0.0 };
                d += if x > 0 { edge[p - 1] } else { 0.0 } + if y > 0 { edge[p - w] } else { 0.0 };
                1.0 / d.max(1e-20)
            })
            .collect();
        let product = |v: &[f32]| {
            let scaled: Vec<f32> = v.iter().zip(&e).map(|(a, b)| a * b).collect();
            let mut out = vec![0.0f32; n];
            for (operator, weight) in operators.iter().zip(&weights) {
                let mut f = operator.forward(&scaled);
                f.iter_mut().zip(weight).for_each(|(a, b)| *a *= b);
                let back = operator.adjoint(&f);
                out.iter_mut().zip(&back).for_each(|(a, b)| *a += b);
            }
            out.iter_mut().zip(&e).for_each(|(a, b)| *a *= b);
            stiffness(v, &mut out);
            out
        };
        let mut step = vec![0.0f32; n];
        let mut z: Vec<f32> = residual.iter().zip(&preconditioner).map(|(a, b)| a * b).collect();
        let mut direction = z.clone();
        let mut energy = dot(&residual, &z);
        let first = energy;
        for _ in 0..effort.inner {
            if energy <= 1e-8 * first {
                break;
            }
            let ad = product(&direction);
            let curvature = dot(&direction, &ad);
            if curvature <= 0.0 {
                break;
            }
            let alpha = (energy / curvature) as f32;
            step.iter_mut().zip(&direction).for_each(|(a, b)| *a += alpha * b);
            residual.iter_mut().zip(&ad).for_each(|(a, b)| *a -= alpha * b);
            z.iter_mut().zip(residual.iter().zip(&preconditioner)).for_each(|(z, (r, p))| *z = r * p);
            let next = dot(&residual, &z);
            let beta = (next / energy) as f32;
            energy = next;
            direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + beta * *d);
        }
        // The data term is quadratic in E: upwards the step is E (1 + δu), at most fourfold.
        u.iter_mut().zip(&step).for_each(|(u, s)| *u += if *s > 0.0 { s.min(3.0).ln_1p() } else { s.max(-1.0) });
    }
    Plane { width: w, height: h, data: u.iter().map(|v| v.exp()).collect() }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
}

/// Three box means of 3 pixels: close to a Gaussian of 1.4 pixels.
fn smooth(plane: &Plane) -> Plane {
    let (w, h) = plane.size();
    let mut out = plane.clone();
    for _ in 0..3 {
        let mut rows = out.clone();
        for y in 0..h {
            for x in 0..w {
                let (a, b) = (x.saturating_sub(1), (x + 1).min(w - 1));
                rows.data[y * w + x] = (out.data[y * w + a] + out.data[y * w + x] + out.data[y * w + b]) / 3.0;
            }
        }
        for y in 0..h {
            let (a, b) = (y.saturating_sub(1), (y + 1).min(h - 1));
            for x in 0..w {
                out.data[y * w + x] = (rows.data[a * w + x] + rows.data[y * w + x] + rows.data[b * w + x]) / 3.0;
            }
        }
    }
    out
}

/// Operators of `tsfs`.
pub fn operators(tsfs: &[Tsf], size: (usize, usize), pad: usize) -> Vec<Operator> {
    tsfs.iter().map(|t| Operator::new(t, size.0, size.1, pad)).collect()
}

impl Frame {
    /// Luminance of one frame, the mean of `channels`, from its exposure (1 = white), their mask, noise curves per channel
    /// ([`crate::kernels::NOISE_STEPS`] values) and exposure time in seconds. The variance is that of the locally smoothed exposure: a pixel's own value would give more weight to
    /// what noise made darker.
    pub fn new(exposure: &Rgb, mask: &Plane, curves: &[Vec<f32>; 3], exposure_time: f64, channels: Channels) -> Self {
        let count = channels.count() as f32;
        let dt = exposure_time as f32;
        let mut variance = mask.map(|_| 0.0);
        for (plane, curve) in channels.indices().map(|c| (&exposure.0[c], &curves[c])) {
            let last = curve.len() - 1;
            for (v, x) in variance.data.iter_mut().zip(&smooth(plane).data) {
                let noise = curve[((x.clamp(0.0, 1.0).sqrt() * last as f32).round() as usize).min(last)];
                *v += noise * noise / (count * count * dt * dt);
            }
        }
        let clipped =
            (0..mask.data.len()).map(|p| mask.data[p] == 0.0 && channels.indices().any(|c| exposure.0[c].data[p] > CLIPPED)).collect();
        Self { blurred: exposure.mean_of(channels).map(|v| v / dt), variance, mask: mask.clone(), clipped }
    }

    /// The part of `size` pixels whose first is `at`.
    ///
    /// # Panics
    /// Where that reaches beyond the frame.
    #[must_use]
    pub fn crop(&self, at: (usize, usize), size: (usize, usize)) -> Self {
        let w = self.blurred.width;
        let part = |p: &Plane| p.crop(at.0, at.1, size.0, size.1);
        let clipped = (0..size.0 * size.1).map(|p| self.clipped[(at.1 + p / size.0) * w + at.0 + p % size.0]).collect();
        Self { blurred: part(&self.blurred), variance: part(&self.variance), mask: part(&self.mask), clipped }
    }
}

/// Latent luminance of `frames` under `tsfs` that are known, on the frame's grid plus `pad`, started at `merged` (frame's grid).
pub fn luminance_of(frames: &[Frame], tsfs: &[Tsf], merged: &Plane, pad: usize) -> Plane {
    let operators = operators(tsfs, merged.size(), pad);
    let held = vec![false; merged.data.len()];
    let effort = Effort { lambda: 3.0, outer: 8, inner: 15, model_error: 0.03 };
    solve(frames, &operators, &merged.padded(pad), &held, &effort)
}
