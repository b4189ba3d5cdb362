//! Latent luminance from all frames and their TSFs: what the colour solver does, for a single plane on the CPU, for the many solves
//! between which the TSFs change.
//!
//! In log luminance u each outer iteration solves `[E Σ KᵀWK E + Dᵀ w D] δu = E Σ KᵀW (B - K E) - Dᵀ w D u` with
//! w = λ/√(|∇u|² + ε²) by preconditioned conjugate gradients and steps to E (1 + δu) where δu > 0 and to
//! E exp(δu) elsewhere (at most fourfold, at least 1/e). Where there is a lens, K is its blur and then the motion's.

use super::lens::behind_lens;
use super::operator::Operator;
use crate::image::{Channels, Plane, Rgb};
use crate::random::Random;
use crate::tsf::{Tsf, Unseen};
use std::borrow::Cow;

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
    /// Standard deviation in pixels of the Gaussian by which a lens blurs the luminance before any motion does; 0 for none.
    pub lens_px: f32,
}

/// Differences of log luminance below this are smoothed quadratically.
const EPSILON: f32 = 0.01;

/// Residuals of unseen pixels, in standard deviations, from which their absolute value counts and not their square.
const OUTLYING: f32 = 3.0;

/// Exposure of a masked pixel above which it is masked for clipping.
const CLIPPED: f32 = 0.5;

/// So many pixels, or this part of all of them, decide nothing by themselves.
const FEW: usize = 5;
const FEW_OF: usize = 500;

/// Mean of `squares`, of which the few largest count as the largest of the others: where an unseen pixel lies alone beside a burnt-out one its residual may
/// be a hundred times the noise, whatever the blur.
fn mean_without_outliers(mut squares: Vec<f32>) -> f64 {
    let n = squares.len();
    let few = FEW.max(n / FEW_OF);
    if n > few {
        let (_, most, _) = squares.select_nth_unstable_by(n - 1 - few, f32::total_cmp);
        let most = *most;
        squares.iter_mut().for_each(|s| *s = s.min(most));
    }
    squares.iter().copied().map(f64::from).sum::<f64>() / n as f64
}

/// Mean of squared residuals over noise variance of a frame at `latent`, over the pixels where `chosen` is true; no few of them decide it. NaN where there
/// is none.
pub fn chi_squared(frame: &Frame, operator: &Operator, latent: &Plane, chosen: &[bool]) -> f64 {
    let predicted = operator.forward(&latent.data);
    let inside = operator.inside();
    let counts = |p: &usize| chosen[*p] && inside[*p] && frame.mask.data[*p] > 0.0;
    let square = |p: usize| (frame.blurred.data[p] - predicted[p]).powi(2) / frame.variance.data[p];
    mean_without_outliers((0..predicted.len()).filter(counts).map(square).collect())
}

/// The frames and what is known of their blurs.
struct Data<'a> {
    frames: &'a [Frame],
    operators: &'a [Operator],
    insides: Vec<Vec<bool>>,
    /// Variance of each frame that the error of its operator adds.
    models: Vec<Plane>,
    held: &'a [bool],
    /// Of the latent grid.
    size: (usize, usize),
    lambda: f32,
    lens_px: f32,
}

/// The normal equations of one step in log luminance.
struct System<'a> {
    data: &'a Data<'a>,
    e: Vec<f32>,
    weights: Vec<Vec<f32>>,
    /// Of each frame: the observation less what the luminance predicts.
    residuals: Vec<Vec<f32>>,
    edge: Vec<f32>,
    preconditioner: Vec<f32>,
}

impl<'a> Data<'a> {
    fn new(frames: &'a [Frame], operators: &'a [Operator], held: &'a [bool], size: (usize, usize), effort: &Effort) -> Self {
        let model = |f: &Frame| crate::merge::gradient_level(&f.blurred, 4).map(|v| (effort.model_error * v).powi(2));
        Self {
            frames,
            operators,
            insides: operators.iter().map(Operator::inside).collect(),
            models: frames.iter().map(model).collect(),
            held,
            size,
            lambda: effort.lambda,
            lens_px: effort.lens_px,
        }
    }

    fn behind_lens<'v>(&self, v: impl Into<Cow<'v, [f32]>>) -> Cow<'v, [f32]> {
        behind_lens(v, self.size, self.lens_px)
    }

    /// The weight of pixel `p` of frame `k` where it counts `m`, 0..=1: its inverse variance, that of the operator's error included.
    fn weight(&self, k: usize, p: usize, m: f32) -> f32 {
        m * m / (self.frames[k].variance.data[p] + self.models[k].data[p])
    }

    /// The weights of frame `k` where its residual is `residual`.
    fn weights(&self, k: usize, residual: &[f32]) -> Vec<f32> {
        let (frame, inside) = (&self.frames[k], &self.insides[k]);
        let usable = |p: usize| if inside[p] && !self.held[p] { frame.mask.data[p] } else { 0.0 };
        // A clipped pixel says that its irradiance is not below what clips: it counts while the estimate is.
        let bounded = |p: usize| frame.clipped[p] && inside[p] && residual[p] > 0.0;
        let weight = |p: usize| {
            let m = if bounded(p) { 1.0 } else { usable(p) };
            if m == 0.0 { 0.0 } else { self.weight(k, p, m) }
        };
        (0..residual.len()).map(weight).collect()
    }

    /// The step from the log luminance `u`.
    fn system(&'a self, u: &[f32]) -> System<'a> {
        let (w, h) = self.size;
        let n = w * h;
        let e: Vec<f32> = u.iter().map(|v| v.exp()).collect();
        let seen = self.behind_lens(&e);
        let (mut weights, mut residuals) = (Vec::new(), Vec::new());
        let mut diagonal = vec![0.0f32; n];
        for (k, (frame, operator)) in self.frames.iter().zip(self.operators).enumerate() {
            let predicted = operator.forward(&seen);
            let residual: Vec<f32> = frame.blurred.data.iter().zip(&predicted).map(|(b, p)| b - p).collect();
            let weight = self.weights(k, &residual);
            let spread = operator.adjoint(&weight);
            // Cubic weights have negative lobes; a preconditioner may not.
            diagonal.iter_mut().zip(&spread).for_each(|(a, b)| *a += operator.energy() * b.max(0.0));
            weights.push(weight);
            residuals.push(residual);
        }
        let diagonal = self.behind_lens(diagonal);
        let edge: Vec<f32> = (0..n)
            .map(|p| {
                let (x, y) = (p % w, p / w);
                let dx = if x + 1 < w { u[p + 1] - u[p] } else { 0.0 };
                let dy = if y + 1 < h { u[p + w] - u[p] } else { 0.0 };
                self.lambda / (dx * dx + dy * dy + EPSILON * EPSILON).sqrt()
            })
            .collect();
        let preconditioner: Vec<f32> = (0..n)
            .map(|p| {
                let (x, y) = (p % w, p / w);
                let mut d = e[p] * e[p] * diagonal[p];
                d += if x + 1 < w { edge[p] } else { 0.0 } + if y + 1 < h { edge[p] } else { 0.0 };
                d += if x > 0 { edge[p - 1] } else { 0.0 } + if y > 0 { edge[p - w] } else { 0.0 };
                1.0 / d.max(1e-20)
            })
            .collect();
        System { data: self, e, weights, residuals, edge, preconditioner }
    }
}

impl System<'_> {
    /// Adds Dᵀ f(w, D v) to `out`.
    fn differences(&self, v: &[f32], out: &mut [f32], mut f: impl FnMut(f32, f32) -> f32) {
        let (w, h) = self.data.size;
        for y in 0..h {
            for x in 0..w {
                let p = y * w + x;
                if x + 1 < w {
                    let d = f(self.edge[p], v[p + 1] - v[p]);
                    out[p] -= d;
                    out[p + 1] += d;
                }
                if y + 1 < h {
                    let d = f(self.edge[p], v[p + w] - v[p]);
                    out[p] -= d;
                    out[p + w] += d;
                }
            }
        }
    }

    /// The negative gradient at the log luminance `u` that the system was made at.
    fn descent(&self, u: &[f32]) -> Vec<f32> {
        let mut right = vec![0.0f32; u.len()];
        for (operator, (residual, weight)) in self.data.operators.iter().zip(self.residuals.iter().zip(&self.weights)) {
            let back = operator.adjoint(&residual.iter().zip(weight).map(|(r, w)| r * w).collect::<Vec<f32>>());
            right.iter_mut().zip(&back).for_each(|(a, b)| *a += b);
        }
        let mut right = self.data.behind_lens(right).into_owned();
        let mut smoothness = vec![0.0f32; u.len()];
        self.differences(u, &mut smoothness, |w, d| w * d);
        right.iter_mut().zip(self.e.iter().zip(&smoothness)).for_each(|(r, (e, s))| *r = e * *r - s);
        right
    }

    fn product(&self, v: &[f32]) -> Vec<f32> {
        let scaled: Vec<f32> = v.iter().zip(&self.e).map(|(a, b)| a * b).collect();
        let scaled = self.data.behind_lens(scaled);
        let mut out = vec![0.0f32; v.len()];
        for (operator, weight) in self.data.operators.iter().zip(&self.weights) {
            let mut f = operator.forward(&scaled);
            f.iter_mut().zip(weight).for_each(|(a, b)| *a *= b);
            let back = operator.adjoint(&f);
            out.iter_mut().zip(&back).for_each(|(a, b)| *a += b);
        }
        let mut out = self.data.behind_lens(out).into_owned();
        out.iter_mut().zip(&self.e).for_each(|(a, b)| *a *= b);
        self.differences(v, &mut out, |w, d| w * d);
        out
    }

    /// What `iterations` of preconditioned conjugate gradients make of the system with the right-hand side `right`.
    fn step(&self, right: Vec<f32>, iterations: usize) -> Vec<f32> {
        let mut residual = right;
        let mut step = vec![0.0f32; residual.len()];
        let mut z: Vec<f32> = residual.iter().zip(&self.preconditioner).map(|(a, b)| a * b).collect();
        let mut direction = z.clone();
        let mut energy = dot(&residual, &z);
        let first = energy;
        for _ in 0..iterations {
            if energy <= 1e-8 * first {
                break;
            }
            let ad = self.product(&direction);
            let curvature = dot(&direction, &ad);
            if curvature <= 0.0 {
                break;
            }
            let alpha = (energy / curvature) as f32;
            step.iter_mut().zip(&direction).for_each(|(a, b)| *a += alpha * b);
            residual.iter_mut().zip(&ad).for_each(|(a, b)| *a -= alpha * b);
            z.iter_mut().zip(residual.iter().zip(&self.preconditioner)).for_each(|(z, (r, p))| *z = r * p);
            let next = dot(&residual, &z);
            let beta = (next / energy) as f32;
            energy = next;
            direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + beta * *d);
        }
        step
    }

    /// A right-hand side whose solution is normal with the inverse of the matrix for its covariance: what the data and the smoothness leave open.
    fn perturbation(&self, random: &mut Random) -> Vec<f32> {
        let mut out = vec![0.0f32; self.e.len()];
        for (operator, weight) in self.data.operators.iter().zip(&self.weights) {
            let noise: Vec<f32> = weight.iter().map(|w| w.sqrt() * random.normal() as f32).collect();
            out.iter_mut().zip(&operator.adjoint(&noise)).for_each(|(a, b)| *a += b);
        }
        let mut out = self.data.behind_lens(out).into_owned();
        out.iter_mut().zip(&self.e).for_each(|(a, b)| *a *= b);
        self.differences(&vec![0.0; self.e.len()], &mut out, |w, _| w.sqrt() * random.normal() as f32);
        out
    }
}

/// Latent luminance (positive; grid of the frames plus `pad`) from `frames` under `tsfs`, started at `latent`. Pixels whose `held` is true
/// are kept out of the data term.
pub fn solve(frames: &[Frame], operators: &[Operator], latent: &Plane, held: &[bool], effort: &Effort) -> Plane {
    let (width, height) = latent.size();
    let data = Data::new(frames, operators, held, (width, height), effort);
    let mut u = logarithm(latent);
    for _ in 0..effort.outer {
        let system = data.system(&u);
        let step = system.step(system.descent(&u), effort.inner);
        // The data term is quadratic in E: upwards the step is E (1 + δu), at most fourfold.
        u.iter_mut().zip(&step).for_each(|(u, s)| *u += if *s > 0.0 { s.min(3.0).ln_1p() } else { s.max(-1.0) });
    }
    Plane { width, height, data: u.iter().map(|v| v.exp()).collect() }
}

/// One of the latent luminances that the data and the smoothness allow around the best, `latent`, drawn with `spread` times their deviation from it:
/// normal in log luminance with the inverse of the normal equations for its covariance, by solving them for a perturbed right-hand side
/// (G. Papandreou and A. Yuille, "Gaussian Sampling by Local Perturbations", NIPS 2010).
pub fn drawn(
    frames: &[Frame],
    operators: &[Operator],
    latent: &Plane,
    held: &[bool],
    effort: &Effort,
    spread: f32,
    random: &mut Random,
) -> Plane {
    let data = Data::new(frames, operators, held, latent.size(), effort);
    let system = data.system(&logarithm(latent));
    let step = system.step(system.perturbation(random), effort.inner);
    Plane { data: latent.data.iter().zip(&step).map(|(e, s)| e * (spread * s).clamp(-1.0, 1.0).exp()).collect(), ..latent.clone() }
}

/// What pixels that a latent luminance has not seen say about the blurs.
pub struct CrossValidation {
    /// Of each frame.
    pub unseen: Vec<Unseen>,
    /// P = E ∘ (the inverse of the normal equations) E ∘ Σ KᵀW r, the sum over the unseen pixels: the adjoint state, on the latent grid,
    /// behind the lens.
    pub sensitivity: Plane,
    /// Weighted mean of the squared residuals of the unseen pixels.
    pub misfit: f64,
}

/// What the pixels `unseen` say about the blurs, `latent` being solved from the others that `held` leaves (`unseen` are held as well): how their residuals change
/// with each K, and with the luminance that follows from it (implicit differentiation of the solve; the weights of the smoothness are held).
pub fn cross_validated(
    frames: &[Frame],
    operators: &[Operator],
    latent: &Plane,
    (held, unseen): (&[bool], &[bool]),
    effort: &Effort,
) -> CrossValidation {
    let data = Data::new(frames, operators, held, latent.size(), effort);
    let system = data.system(&logarithm(latent));
    // Linear where a residual is far beyond what is expected: a few pixels that nothing explains would decide.
    let weights: Vec<Vec<f32>> = (0..frames.len())
        .map(|k| {
            let (f, residual) = (&frames[k], &system.residuals[k]);
            let weight = |p: usize| {
                let w = data.weight(k, p, f.mask.data[p]);
                w * (OUTLYING / (residual[p].abs() * w.sqrt()).max(OUTLYING))
            };
            (0..unseen.len()).map(|p| if unseen[p] && data.insides[k][p] { weight(p) } else { 0.0 }).collect()
        })
        .collect();
    let times = |a: &[f32], b: &[f32]| -> Vec<f32> { a.iter().zip(b).map(|(a, b)| a * b).collect() };
    let mut right = vec![0.0f32; latent.data.len()];
    let (mut sum, mut count) = (0.0, 0.0);
    for ((operator, residual), weight) in operators.iter().zip(&system.residuals).zip(&weights) {
        let pull = times(residual, weight);
        sum += dot(residual, &pull);
        count += weight.iter().filter(|w| **w > 0.0).count() as f64;
        right.iter_mut().zip(&operator.adjoint(&pull)).for_each(|(a, b)| *a += b);
    }
    let step = system.step(times(&data.behind_lens(right), &system.e), effort.inner);
    let sensitivity = Plane { data: data.behind_lens(times(&step, &system.e)).into_owned(), ..latent.clone() };
    let (width, height) = frames[0].blurred.size();
    let plane = |data| Plane { width, height, data };
    let unseen = (0..frames.len()).zip(weights).map(|(k, weight)| {
        let residual = &system.residuals[k];
        let through = times(residual, &system.weights[k]);
        let known = times(&operators[k].forward(&sensitivity.data), &system.weights[k]);
        let direct = times(residual, &weight).iter().zip(&known).map(|(a, b)| a - b).collect();
        Unseen { direct: plane(direct), through: plane(through), weight: plane(weight) }
    });
    CrossValidation { unseen: unseen.collect(), misfit: if count > 0.0 { sum / count } else { f64::NAN }, sensitivity }
}

fn logarithm(latent: &Plane) -> Vec<f32> {
    latent.data.iter().map(|v| v.max(f32::MIN_POSITIVE).ln()).collect()
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
    /// ([`crate::kernels::NOISE_STEPS`] values) and exposure time in seconds. The variance is that of the locally smoothed exposure: a
    /// pixel's own value would give more weight to what noise made darker.
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
    let effort = Effort { lambda: 3.0, outer: 8, inner: 15, model_error: 0.03, lens_px: 0.0 };
    solve(frames, &operators, &merged.padded(pad), &held, &effort)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::Pose;
    use nalgebra::DMatrix;

    #[test]
    fn a_pixel_alone_decides_nothing() {
        let of = |outliers: &[f32]| {
            mean_without_outliers((0..1000 - outliers.len()).map(|i| 0.5 + i as f32 / 1000.0).chain(outliers.iter().copied()).collect())
        };
        assert!((of(&[]) - 1.0).abs() < 0.01);
        assert!((of(&[9000.0, 400.0, 80.0]) - 1.0).abs() < 0.01);
        // Ten do.
        assert!((of(&[100.0; 10]) - 2.0).abs() < 0.02);
        assert_eq!(mean_without_outliers(vec![4.0, 2.0]), 3.0);
        assert!(mean_without_outliers(Vec::new()).is_nan());
    }

    #[test]
    fn draws_scatter_as_the_inverse_of_the_normal_equations() {
        let (size, pad) = ((7, 5), 2);
        let tsf = Tsf::new(20.0, vec![Pose::planar(-1.0, 0.3, 2.0, 0.5), Pose::planar(1.2, -0.4, -1.0, 0.5)]).unwrap();
        let operators = operators(&[tsf], size, pad);
        let (w, h) = (size.0 + 2 * pad, size.1 + 2 * pad);
        let latent = Plane::from_fn(w, h, |x, y| 1.0 + 0.4 * ((x * 5 + y * 3) % 7) as f32 / 7.0);
        let blurred = Plane { width: size.0, height: size.1, data: operators[0].forward(&latent.data) };
        let frame = Frame {
            variance: blurred.map(|v| 0.002 * v),
            mask: Plane::from_fn(size.0, size.1, |x, _| if x == 3 { 0.0 } else { 1.0 }),
            clipped: vec![false; blurred.data.len()],
            blurred,
        };
        let (frames, held) = ([frame], vec![false; size.0 * size.1]);
        let effort = Effort { lambda: 20.0, outer: 1, inner: 80, model_error: 0.02, lens_px: 0.6 };
        // The matrix column by column, inverted.
        let n = w * h;
        let data = Data::new(&frames, &operators, &held, (w, h), &effort);
        let system = data.system(&logarithm(&latent));
        let column = |i: usize| system.product(&(0..n).map(|k| if k == i { 1.0 } else { 0.0 }).collect::<Vec<f32>>());
        let matrix = DMatrix::from_iterator(n, n, (0..n).flat_map(column).map(f64::from));
        let expected = matrix.try_inverse().expect("smoothness and data determine every pixel");
        let mut random = Random::new(1, 0);
        let draws = 3000;
        let mut found = DMatrix::<f64>::zeros(n, n);
        for _ in 0..draws {
            let one = drawn(&frames, &operators, &latent, &held, &effort, 0.5, &mut random);
            let deviation = |p: usize| 2.0 * f64::from((one.data[p] / latent.data[p]).ln());
            let v = DMatrix::from_iterator(n, 1, (0..n).map(deviation));
            found += &v * v.transpose() / f64::from(draws);
        }
        // A variance from so many draws is off by 2.6 %, the largest of a hundred by three times that.
        for p in 0..n {
            let ratio = found[(p, p)] / expected[(p, p)];
            assert!((ratio - 1.0).abs() < 0.1, "variance of pixel {p} is {ratio} times what it should be");
        }
        let off = (&found - &expected).norm() / expected.norm();
        assert!(off < 0.1, "the covariance is off by {off}");
    }

    /// Against differences of the residuals of scenes solved anew, the blur a little to each side. The scene is soft, so that the smoothness weighs its gradients as it
    /// weighs none, and the frame all but free of noise, so that the normal equations are the Hessian.
    #[test]
    fn unseen_residuals_change_with_the_blur_as_the_adjoint_state_says() {
        for lens_px in [0.0, 0.8] {
            unseen_residuals_change_behind(lens_px);
        }
    }

    fn unseen_residuals_change_behind(lens_px: f32) {
        let (size, pad) = ((18, 13), 3);
        let (w, h) = (size.0 + 2 * pad, size.1 + 2 * pad);
        let at = |t: f64| {
            let poses = vec![Pose::planar(-1.4 - 0.3 * t, 0.3, 1.0, 0.5 - 0.2 * t), Pose::planar(1.2, -0.4 + 0.5 * t, -1.0, 0.5 + 0.2 * t)];
            operators(&[Tsf::new(20.0, poses).unwrap()], size, pad)
        };
        let truth = Plane::from_fn(w, h, |x, y| (0.002 * ((0.5 * x as f32).sin() + (0.4 * y as f32 + 0.2 * x as f32).cos())).exp());
        // Under another blur than those around which the residuals are looked at.
        let blurred = Plane { width: size.0, height: size.1, data: at(0.8)[0].forward(&behind_lens(&truth.data, (w, h), lens_px)) };
        let of = |v: f32| blurred.map(|_| v);
        let frame = Frame { variance: of(1e-6), mask: of(1.0), clipped: vec![false; blurred.data.len()], blurred: blurred.clone() };
        let frames = [frame];
        let fold: Vec<bool> = (0..size.0 * size.1).map(|p| (p % size.0 * 2 + p / size.0) % 5 == 2).collect();
        let effort = Effort { lambda: 3.0, outer: 12, inner: 300, model_error: 0.0, lens_px };
        let found = |t: f64| {
            let operators = at(t);
            let latent = solve(&frames, &operators, &truth, &fold, &effort);
            let validated = cross_validated(&frames, &operators, &latent, (&fold, &fold), &effort);
            (latent, validated)
        };
        let unseen = |v: &CrossValidation| v.unseen[0].weight.data.iter().filter(|w| **w > 0.0).count() as f64;
        let loss = |t: f64| {
            let v = found(t).1;
            0.5 * v.misfit * unseen(&v)
        };
        let (latent, validated) = found(0.0);
        let step = 0.02;
        let measured = (loss(step) - loss(-step)) / (2.0 * step);
        let moved = |plane: &Plane| -> Vec<f32> {
            let (ahead, behind) = (at(step)[0].forward(&plane.data), at(-step)[0].forward(&plane.data));
            ahead.iter().zip(&behind).map(|(a, b)| (a - b) / (2.0 * step as f32)).collect()
        };
        let (direct, through) = (&validated.unseen[0].direct.data, &validated.unseen[0].through.data);
        let seen = Plane { data: behind_lens(&latent.data, (w, h), lens_px).into_owned(), ..latent };
        let said = -dot(&moved(&seen), direct) - dot(&moved(&validated.sensitivity), through);
        let predicted = at(0.0)[0].forward(&seen.data);
        let residual = frames[0].blurred.data.iter().zip(&predicted).map(|(b, p)| b - p);
        let pull: Vec<f32> = residual.zip(&validated.unseen[0].weight.data).map(|(r, w)| r * w).collect();
        let held = -dot(&moved(&seen), &pull);
        println!("lens of {lens_px} px: {said:.3} for {measured:.3}, the scene held {held:.3}");
        // Behind a lens the scene follows so far that little is left.
        let most = 0.08 * measured.abs() + if lens_px > 0.0 { 0.1 * held.abs() } else { 0.0 };
        assert!((said - measured).abs() < most, "{said} for {measured}");
        assert!((held - measured).abs() > 0.3 * measured.abs(), "what the scene does counts: {held} for {measured}");
    }
}
