//! Objective (9) in log irradiance and its Gauss-Newton step, dense: weights pixel by pixel, the matrix written out,
//! solved by Cholesky.

use super::blur::Matrix;
use super::data::{Pixel, gauss};
use super::linear::{apply, differences, lengths, smoothness};
use nalgebra::{DMatrix, DVector};

pub type Planes = [Vec<f64>; 3];

/// One frame: what it saw, and the matrix from the latent grid to it.
pub struct Frame {
    pub matrix: Matrix,
    /// The one that stands for it on the left of a step's equation.
    pub rough: Matrix,
    /// Where the channel counts.
    pub exposure: [Vec<Option<f64>>; 3],
    pub mask: Vec<f64>,
    pub exposure_time: f64,
    pub noise: [Vec<f32>; 3],
    pub black_clipped: bool,
    /// A blurred frame: its weights follow its residuals, its border is masked.
    pub moving: bool,
}

pub struct Problem {
    pub frames: Vec<Frame>,
    pub frame: (usize, usize),
    pub latent: (usize, usize),
    pub lambda: f64,
    pub epsilon: f64,
    pub robust: f64,
}

/// W and W B of one frame.
pub struct Weights {
    pub weight: Planes,
    pub observation: Planes,
}

impl Frame {
    /// Mask, less the pixels that see beyond the latent grid.
    fn valid(&self) -> Vec<f64> {
        let ones = self.matrix.apply(&vec![1.0; self.matrix.columns]);
        self.mask.iter().zip(ones).map(|(&m, s)| if !self.moving || (s - 1.0).abs() < 1e-3 { m } else { 0.0 }).collect()
    }

    fn pixel(&self, c: usize, i: usize, mask: f64, predicted: &Planes) -> Pixel<'_> {
        Pixel {
            predicted: predicted[c][i],
            exposure: self.exposure[c][i],
            mask,
            exposure_time: self.exposure_time,
            black_clipped: self.black_clipped,
            noise: &self.noise[c],
        }
    }

    /// (χ², 1) / 3 of each valid pixel, summed over the channels that count there.
    pub fn misfit(&self, irradiance: &Planes) -> Vec<[f64; 2]> {
        let predicted = irradiance.each_ref().map(|e| self.matrix.apply(e));
        let chi = |(i, &m): (usize, &f64)| {
            let shown = (0..3).filter(|&c| m > 0.0 && self.exposure[c][i].is_some());
            shown.fold([0.0, 0.0], |sum, c| [sum[0] + self.pixel(c, i, m, &predicted).chi_squared().0 / 3.0, sum[1] + 1.0 / 3.0])
        };
        self.valid().iter().enumerate().map(chi).collect()
    }
}

impl Problem {
    pub fn weights(&self, irradiance: &Planes) -> Vec<Weights> {
        let of_frame = |f: &Frame| {
            let predicted = irradiance.each_ref().map(|e| f.matrix.apply(e));
            let valid = f.valid();
            let local = gauss(&f.misfit(irradiance), self.frame, 2.0);
            let mut w = Weights { weight: Default::default(), observation: Default::default() };
            for c in 0..3 {
                for (i, &m) in valid.iter().enumerate() {
                    let around = (f.moving && local[i][1] > 0.0).then_some((local[i][0], local[i][1]));
                    let (weight, observation, _) = f.pixel(c, i, m, &predicted).weight(around, self.robust);
                    w.weight[c].push(weight);
                    w.observation[c].push(observation);
                }
            }
            w
        };
        self.frames.iter().map(of_frame).collect()
    }

    /// ½ Σ W (B - K E)² + λ Σ (√(|∇u|² + ε²) - ε) with the given weights.
    pub fn objective(&self, log: &Planes, weights: &[Weights]) -> f64 {
        let mut sum: f64 = lengths(log, self.epsilon, self.latent).iter().map(|l| self.lambda * (l - self.epsilon)).sum();
        for (f, w) in self.frames.iter().zip(weights) {
            for (c, u) in log.iter().enumerate() {
                let predicted = f.matrix.apply(&u.iter().map(|u| u.exp()).collect::<Vec<_>>());
                for (i, p) in predicted.iter().enumerate() {
                    let weight = w.weight[c][i];
                    if weight > 0.0 {
                        sum += 0.5 * weight * (w.observation[c][i] / weight - p).powi(2);
                    }
                }
            }
        }
        sum
    }

    /// δu of `[E Σ Kᵀ W K E + Dᵀ w D] δu = E Σ Kᵀ W (B - K E) - Dᵀ w D u`, K in brackets roughly.
    pub fn step(&self, log: &Planes, weights: &[Weights]) -> Planes {
        let n = self.latent.0 * self.latent.1;
        let edge: Vec<f64> = lengths(log, self.epsilon, self.latent).iter().map(|l| self.lambda / l).collect();
        let tv = smoothness(&edge, self.latent);
        std::array::from_fn(|c| {
            let e: Vec<f64> = log[c].iter().map(|u| u.exp()).collect();
            let mut a = DMatrix::<f64>::zeros(n, n);
            let mut b = DVector::from_vec(apply(&tv, &log[c])) * -1.0;
            for &(i, j, v) in &tv {
                a[(i, j)] += v;
            }
            for (f, w) in self.frames.iter().zip(weights) {
                for (i, row) in f.matrix.rows.iter().enumerate() {
                    let predicted: f64 = row.iter().map(|&(j, v)| v * e[j]).sum();
                    let residual = w.observation[c][i] - w.weight[c][i] * predicted;
                    for &(j, v) in row {
                        b[j] += e[j] * v * residual;
                    }
                }
                for (row, weight) in f.rough.rows.iter().zip(&w.weight[c]) {
                    for &(j, v) in row {
                        for &(k, t) in row {
                            a[(j, k)] += e[j] * v * weight * t * e[k];
                        }
                    }
                }
            }
            a.cholesky().expect("positive definite: the differences connect every pixel with data").solve(&b).as_slice().to_vec()
        })
    }

    /// Largest |∂ objective / ∂u| by central differences, of a few pixels: a check of this oracle by itself.
    pub fn slope(&self, log: &Planes, weights: &[Weights], channel: usize, pixel: usize) -> f64 {
        let moved = |d: f64| {
            let mut u = log.clone();
            u[channel][pixel] += d;
            self.objective(&u, weights)
        };
        (moved(1e-5) - moved(-1e-5)) / 2e-5
    }

    /// Gradient of the objective as the right-hand side has it (negative), one channel.
    pub fn right_side(&self, log: &Planes, weights: &[Weights], channel: usize) -> Vec<f64> {
        let lengths = lengths(log, self.epsilon, self.latent);
        let u = &log[channel];
        let e: Vec<f64> = u.iter().map(|u| u.exp()).collect();
        let mut b = vec![0.0; u.len()];
        for (i, j) in differences(self.latent) {
            let flow = self.lambda / lengths[i] * (u[j] - u[i]);
            b[i] += flow;
            b[j] -= flow;
        }
        for (f, w) in self.frames.iter().zip(weights) {
            let predicted = f.matrix.apply(&e);
            let residual: Vec<f64> =
                (0..predicted.len()).map(|i| w.observation[channel][i] - w.weight[channel][i] * predicted[i]).collect();
            for (b, (t, e)) in b.iter_mut().zip(f.matrix.transposed(&residual).iter().zip(&e)) {
                *b += t * e;
            }
        }
        b
    }
}

/// Log irradiance `u` after the step `d`: E (1 + d) upwards, at most fourfold; E exp(d) downwards, at least E / e.
pub fn advance(u: f64, d: f64) -> f64 {
    u + if d > 0.0 { (1.0 + d).min(4.0).ln() } else { d.max(-1.0) }
}
