//! Direct alignment: Gauss-Newton on the difference of two logarithmic pictures, weighted by inverse variance, robust, blind to
//! anything that changes slowly over the frame (a wrong exposure time or response, vignetting).

use super::motion::{Model, fields, normalised};
use super::picture::Tone;
use crate::image::Plane;
use glam::{DMat3, DVec2};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Contrast (natural logarithm) that is never explained: interpolation, response. Where noise is below it, all pixels count alike.
const CONTRAST_ERROR: f32 = 0.03;
/// Radius in pixels of the squares whose mean difference is taken off.
const LOCAL: usize = 12;
/// Residuals beyond this many standard deviations lose their say (Cauchy).
const ROBUST: f32 = 2.5;
/// Variance of the mean gradient of both pictures over the sum of their variances: central differences of noise that the binomial filter
/// has correlated, and a fifth less, so that an overestimated noise level does not make a step endless.
const GRADIENT_NOISE: f32 = 0.8 * 1.67 / 16.0;
/// Pixels over which noise and interpolation error of neighbouring residuals are alike: so many pixels are one piece of evidence.
const CORRELATED: f64 = 30.0;
/// Tiles across and down in which the result is checked.
pub(super) const TILES: (usize, usize) = (8, 6);

/// How well a motion explains a frame.
pub(super) struct Fit {
    /// Frame from reference, in the picture's centred pixels.
    pub motion: DMat3,
    /// Robust mean of the squared residual over variance.
    pub cost: f64,
    /// Pixels that both see.
    pub count: f64,
    /// Motion that is left in each tile, pixels, and its weight (gradient energy).
    pub tiles: Vec<(DVec2, f64)>,
    /// Whether the reference's tone was usable at all.
    pub usable: bool,
}

/// Difference of the reference and the frame seen from its grid, local means taken off, and its weight.
struct Difference {
    residual: Plane,
    weight: Plane,
    seen: Tone,
}

fn difference(reference: &Tone, frame: &Tone, motion: &DMat3) -> Difference {
    let seen = frame.on_reference(motion);
    let tau = CONTRAST_ERROR * CONTRAST_ERROR;
    let n = reference.value.data.len();
    let mut weight = Plane { data: vec![0.0; n], ..reference.value.clone() };
    let mut residual = weight.clone();
    for i in 0..n {
        if reference.valid.data[i] > 0.0 && seen.valid.data[i] > 0.0 {
            weight.data[i] = 1.0 / (reference.variance.data[i] + seen.variance.data[i] + tau);
            residual.data[i] = weight.data[i] * (reference.value.data[i] - seen.value.data[i]);
        }
    }
    let (sums, totals) = (residual.box_sum(LOCAL), weight.box_sum(LOCAL));
    for i in 0..n {
        if weight.data[i] > 0.0 {
            residual.data[i] = residual.data[i] / weight.data[i] - sums.data[i] / totals.data[i].max(f32::MIN_POSITIVE);
        }
    }
    Difference { residual, weight, seen }
}

/// Standard deviation of the weighted residuals by the median of their absolute values.
fn spread(d: &Difference) -> f32 {
    let step = (d.residual.data.len() / 40_000).max(1) | 1;
    let mut all: Vec<f32> = (0..d.residual.data.len())
        .step_by(step)
        .filter(|&i| d.weight.data[i] > 0.0)
        .map(|i| d.residual.data[i].abs() * d.weight.data[i].sqrt())
        .collect();
    if all.len() < 16 {
        return 1.0;
    }
    let middle = all.len() / 2;
    (1.4826 * *all.select_nth_unstable_by(middle, f32::total_cmp).1).max(1e-3)
}

/// Normal equations of the eight parameters and of each tile's own shift.
struct Normal {
    matrix: [[f64; 8]; 8],
    bias: [[f64; 8]; 8],
    right: [f64; 8],
    tiles: Vec<[f64; 5]>,
    cost: f64,
    count: f64,
}

impl Normal {
    fn empty() -> Self {
        Self {
            matrix: [[0.0; 8]; 8],
            bias: [[0.0; 8]; 8],
            right: [0.0; 8],
            tiles: vec![[0.0; 5]; TILES.0 * TILES.1],
            cost: 0.0,
            count: 0.0,
        }
    }

    fn add(mut self, other: Self) -> Self {
        for i in 0..8 {
            for j in 0..8 {
                self.matrix[i][j] += other.matrix[i][j];
                self.bias[i][j] += other.bias[i][j];
            }
            self.right[i] += other.right[i];
        }
        for (a, b) in self.tiles.iter_mut().zip(other.tiles) {
            a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        }
        self.cost += other.cost;
        self.count += other.count;
        self
    }
}

fn normal(reference: &Tone, d: &Difference, sigma: f32, freedom: usize, scale: f64) -> Normal {
    let noise = GRADIENT_NOISE * (sigma * sigma).min(1.0);
    let (w, h) = reference.size();
    let centre = DVec2::new(0.5 * (w as f64 - 1.0), 0.5 * (h as f64 - 1.0));
    let rows: Vec<usize> = (1..h.saturating_sub(1)).collect();
    rows.par_chunks(16)
        .map(|rows| {
            let mut n = Normal::empty();
            for &y in rows {
                for x in 1..w.saturating_sub(1) {
                    let i = y * w + x;
                    let weight = d.weight.data[i];
                    if weight == 0.0 || [i - 1, i + 1, i - w, i + w].iter().any(|&k| d.weight.data[k] == 0.0) {
                        continue;
                    }
                    let r = d.residual.data[i];
                    let z = r * r * weight / (sigma * sigma * ROBUST * ROBUST);
                    n.cost += f64::from(ROBUST * ROBUST * z.ln_1p());
                    n.count += 1.0;
                    let (t, s) = (&reference.value.data, &d.seen.value.data);
                    // The mean of both gradients makes the step exact to second order.
                    let gx = 0.25 * (t[i + 1] - t[i - 1] + s[i + 1] - s[i - 1]);
                    let gy = 0.25 * (t[i + w] - t[i - w] + s[i + w] - s[i - w]);
                    let k = f64::from(weight / (1.0 + z));
                    let inflation = k * f64::from(noise * (reference.variance.data[i] + d.seen.variance.data[i]));
                    let (gx, gy, r) = (f64::from(gx), f64::from(gy), f64::from(r));
                    let p = DVec2::new(x as f64, y as f64) - centre;
                    let f = fields(p, scale);
                    let mut j = [0.0; 8];
                    for (j, f) in j.iter_mut().zip(&f[..freedom]) {
                        *j = gx * f.x + gy * f.y;
                    }
                    for a in 0..freedom {
                        n.right[a] += k * j[a] * r;
                        for b in a..freedom {
                            // Noise in the gradients makes the matrix too large, and each step too short.
                            n.matrix[a][b] += k * j[a] * j[b];
                            n.bias[a][b] += inflation * f[a].dot(f[b]);
                        }
                    }
                    let tile = &mut n.tiles[(y * TILES.1 / h) * TILES.0 + x * TILES.0 / w];
                    for (t, v) in tile.iter_mut().zip([k * gx * gx, k * gx * gy, k * gy * gy, k * gx * r, k * gy * r]) {
                        *t += v;
                    }
                }
            }
            n
        })
        .collect::<Vec<_>>()
        .into_iter()
        // In order: the same frames are placed alike whichever thread was first.
        .fold(Normal::empty(), Normal::add)
}

/// The motion of kind `model` near `start` that takes the reference to the frame.
pub(super) fn align(reference: &Tone, frame: &Tone, start: &DMat3, model: Model, iterations: usize) -> Fit {
    let (w, h) = reference.size();
    let scale = 0.5 * (w as f64).hypot(h as f64);
    let mut motion = *start;
    let mut best: Option<Fit> = None;
    let mut idle = 0;
    for round in 0..=iterations {
        let d = difference(reference, frame, &motion);
        let sigma = spread(&d);
        let k = model.freedom();
        let n = normal(reference, &d, sigma, k, scale);
        // The spread is part of the cost: a worse fit must not look better because it made all residuals larger.
        let cost = if n.count > 0.0 { f64::from(sigma * sigma) * n.cost / n.count } else { f64::INFINITY };
        let better = best.as_ref().is_none_or(|b| cost < b.cost);
        if better {
            let tiles = n
                .tiles
                .iter()
                .map(|t| {
                    let (det, energy) = (t[0] * t[2] - t[1] * t[1], t[0] + t[2]);
                    // A tile with an edge in one direction only says nothing about the other.
                    if det > 0.02 * energy * energy {
                        (DVec2::new(t[2] * t[3] - t[1] * t[4], t[0] * t[4] - t[1] * t[3]) / det, det / energy)
                    } else {
                        (DVec2::ZERO, 0.0)
                    }
                })
                .collect();
            best = Some(Fit { motion, cost, count: n.count, tiles, usable: n.count > 64.0 });
        }
        if round == iterations || k == 0 || n.count < 64.0 {
            break;
        }
        let whole = DMatrix::from_fn(k, k, |i, j| n.matrix[i.min(j)][i.max(j)]);
        let bias = DMatrix::from_fn(k, k, |i, j| n.bias[i.min(j)][i.max(j)]);
        let ridge = DMatrix::identity(k, k) * (1e-6 * whole.diagonal().mean());
        // Where noise is nearly all there is, half of the matrix stays.
        let signal = (0..k).map(|i| 1.0 - bias[(i, i)] / whole[(i, i)].max(f64::MIN_POSITIVE)).fold(1.0, f64::min);
        let part = if signal > 0.5 { 1.0 } else { 0.5 / (1.0 - signal).max(0.5) };
        let cholesky = (&whole - bias * part + &ridge).cholesky().or_else(|| (whole + ridge).cholesky());
        let Some(cholesky) = cholesky else { break };
        let step = cholesky.solve(&DVector::from_column_slice(&n.right[..k]));
        let largest = step.amax();
        let step: Vec<f64> = step.iter().map(|v| v * (4.0 / largest.max(4.0))).collect();
        motion = normalised(motion * model.step(&step, scale));
        if largest < 4e-3 {
            break;
        }
        // Two steps in a row without gain: it has converged as far as the pictures allow.
        idle = if better { 0 } else { idle + 1 };
        if idle == 2 {
            break;
        }
    }
    best.expect("at least one round")
}

/// Which of the kinds of motion up to `most` the two pictures speak for, starting from `start`: the one with the smallest
/// Bayesian information criterion. `tolerance` (pixels): what moves by less, rms, is the simpler kind.
pub(super) fn choose(reference: &Tone, frame: &Tone, start: &DMat3, most: Model, tolerance: f64) -> (Model, Fit) {
    let (w, h) = reference.size();
    let mut chosen = (Model::Identity, align(reference, frame, &DMat3::IDENTITY, Model::Identity, 0));
    let mut from = *start;
    let mut fits = Vec::new();
    for model in Model::ALL.into_iter().filter(|m| *m > Model::Identity && *m <= most) {
        if model == Model::Translation {
            // The nearest pure shift: where the start takes the centre.
            from = DMat3::from_translation(crate::pose::project(start, DVec2::ZERO));
        } else if model == Model::Rigid {
            from = *start;
        }
        let fit = align(reference, frame, &from, model, 10);
        from = fit.motion;
        fits.push((model, fit));
    }
    // Residuals in units of what the richest motion leaves.
    let floor = fits.iter().map(|f| f.1.cost).fold(f64::INFINITY, f64::min).max(f64::MIN_POSITIVE);
    let criterion = |model: Model, fit: &Fit| {
        let n = fit.count / CORRELATED;
        n * fit.cost / floor + model.freedom() as f64 * n.max(2.0).ln()
    };
    for (model, fit) in fits {
        // Few pixels in common make any motion look good.
        let overlaps = fit.count > 0.25 * chosen.1.count;
        let same_count = Fit { count: chosen.1.count, motion: fit.motion, cost: fit.cost, tiles: Vec::new(), usable: fit.usable };
        let tolerance = if model > Model::Rigid { 2.0 * tolerance } else { tolerance };
        let moves = super::motion::distance(&fit.motion, &chosen.1.motion, w, h).0 > tolerance;
        if overlaps && moves && criterion(model, &same_count) < criterion(chosen.0, &chosen.1) {
            chosen = (model, fit);
        }
    }
    chosen
}

/// Share of the pixels that both see whose difference under `motion` is what noise explains (three standard deviations), and their number.
pub(super) fn explained(reference: &Tone, frame: &Tone, motion: &DMat3) -> (f64, usize) {
    let d = difference(reference, frame, motion);
    let both = d.weight.data.iter().zip(&d.residual.data).filter(|(w, _)| **w > 0.0);
    let (mut small, mut count) = (0usize, 0usize);
    for (w, r) in both {
        small += usize::from(r * r * w < 9.0);
        count += 1;
    }
    (small as f64 / count.max(1) as f64, count)
}

/// Share of the tiles with structure whose correlation under `motion` is higher than under each of a ring of other shifts by `radius`
/// pixels, and the number of those tiles. A wrong motion passes in one tile of nine or fewer by chance.
pub(super) fn agreement(reference: &Tone, frame: &Tone, motion: &DMat3, radius: f64) -> (f64, usize) {
    let (w, h) = reference.size();
    let shifts: Vec<DVec2> = std::iter::once(DVec2::ZERO)
        .chain(
            (0..16).map(|i| DVec2::from_angle(std::f64::consts::TAU * f64::from(i) / 16.0) * radius * if i % 2 == 0 { 1.0 } else { 1.5 }),
        )
        .collect();
    let scores: Vec<Vec<f64>> = shifts
        .par_iter()
        .map(|shift| {
            let seen = frame.on_reference(&(DMat3::from_translation(*shift) * *motion));
            correlations(reference, &seen)
        })
        .collect();
    let (mut pass, mut count) = (0usize, 0usize);
    for tile in 0..TILES.0 * TILES.1 {
        if !scores[0][tile].is_finite() || w.min(h) < 8 {
            continue;
        }
        count += 1;
        if scores[1..].iter().all(|s| s[tile].is_nan() || s[tile] < scores[0][tile]) {
            pass += 1;
        }
    }
    (pass as f64 / count.max(1) as f64, count)
}

/// Weighted correlation of each tile's detail; NaN where the two see too little of it together.
fn correlations(reference: &Tone, seen: &Tone) -> Vec<f64> {
    let (w, h) = reference.size();
    let tau = CONTRAST_ERROR * CONTRAST_ERROR;
    let n = w * h;
    let weight = Plane {
        data: (0..n)
            .map(|i| {
                let both = reference.valid.data[i] * seen.valid.data[i];
                both * tau / (reference.variance.data[i] + seen.variance.data[i] + tau)
            })
            .collect(),
        ..reference.value.clone()
    };
    let total = weight.box_sum(LOCAL);
    let detail = |p: &Plane| {
        let sum = p.zip(&weight, |v, k| v * k).box_sum(LOCAL);
        Plane {
            data: (0..n).map(|i| if weight.data[i] > 0.0 { p.data[i] - sum.data[i] / total.data[i].max(1e-20) } else { 0.0 }).collect(),
            ..p.clone()
        }
    };
    let (a, b) = (detail(&reference.value), detail(&seen.value));
    let mut sums = vec![[0.0f64; 7]; TILES.0 * TILES.1];
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            let k = f64::from(weight.data[i]);
            if k > 0.0 {
                let (u, v) = (f64::from(a.data[i]), f64::from(b.data[i]));
                let noise = [reference, seen].map(|t| k * f64::from(t.variance.data[i]));
                let s = &mut sums[(y * TILES.1 / h) * TILES.0 + x * TILES.0 / w];
                s.iter_mut().zip([k * u * v, k * u * u, k * v * v, k, noise[0], 1.0, noise[1]]).for_each(|(s, v)| *s += v);
            }
        }
    }
    let pixels = (n / (TILES.0 * TILES.1)) as f64;
    sums.iter()
        .map(|s| {
            // Half of the tile must be seen, and the structure of each be more than its noise: a part of which a short frame shows but
            // noise says nothing of its place.
            if s[5] > 0.4 * pixels && s[1] > 2.0 * s[3] * 1e-4 && s[1] > 2.0 * s[4] && s[2] > 2.0 * s[6] {
                s[0] / (s[1] * s[2]).sqrt().max(1e-30)
            } else {
                f64::NAN
            }
        })
        .collect()
}
