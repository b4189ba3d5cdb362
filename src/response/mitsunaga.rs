//! The camera's response as a polynomial, and the exposure ratios with it: T. Mitsunaga and S. Nayar, "Radiometric Self
//! Calibration", CVPR 1999.

use super::Response;
use super::calibrate::make_monotone;
use crate::error::{Error, Result};
use crate::exposure::{Bracket, Frame};
use nalgebra::{Cholesky, DMatrix, DVector};
use rayon::prelude::*;

/// What [`mitsunaga`] finds.
#[derive(Clone, Debug)]
pub struct Polynomial {
    /// The curve, as a table.
    pub response: Response,
    /// Exposure time of each frame as the pixels have it, seconds: the given ones where they agree.
    pub exposure_times: Vec<f64>,
    /// Degree of the polynomials.
    pub degree: usize,
}

/// Degrees that are tried.
const DEGREES: std::ops::RangeInclusive<usize> = 2..=MOST;
/// Highest degree.
const MOST: usize = 8;
/// A higher degree must lower the error by this part.
const WORTH_IT: f64 = 0.03;
/// Codes at which noise is cut off, or the sensor clips, tell nothing.
const CODES: std::ops::RangeInclusive<usize> = 6..=246;
/// Pairs of neighbouring frames with fewer pixels inside [`CODES`] tell no ratio.
const MIN_OVERLAP: f64 = 64.0;
/// Alternations of polynomial and ratios at most, and change of ln ratio at which they end.
const ROUNDS: usize = 60;
/// See [`ROUNDS`].
const SETTLED: f64 = 1e-4;
/// A code is uncertain by so much (quantisation and noise), of 1.
const CODE_DEVIATION: f64 = 1.5 / 255.0;

/// Response f of the camera that took `bracket`, and the frames' true exposure times. The frames must show one scene without motion
/// or blur.
///
/// Per channel f⁻¹(Z) = Σ_n c_n Zⁿ, n = 1..=N, with f⁻¹(0) = 0 and f⁻¹(1) = 1. For neighbouring frames q, q + 1 in order of exposure time with ratio
/// R_q = Δt_q/Δt_(q+1), the polynomials minimise
///
/// Σ_q Σ_(a,b) H_q(a, b) (f⁻¹(a) − R_q f⁻¹(b))² / σ_q(a, b)²
///
/// where H_q counts the pixels of code a in the one and b in the other frame (so the work does not depend on the frames' size), and σ is what an
/// error of one code and a half does. Then each R_q becomes what the polynomials say, and so on until nothing changes. The
/// degree (2 to 8) is the lowest that explains the frames nearly as well as the best.
///
/// f⁻¹ to a power with R_q to the same power explains the frames as well. So the ratios are brought back to the given exposure times by the
/// power with the least sum of absolute differences of ln Δt: single wrong times are found, a whole list to a power is not; nor which of two
/// frames is wrong, and of three the middle one is blamed.
///
/// # Errors
/// [`Error::Bracket`] when neighbouring frames share too few well-exposed pixels, or no rising polynomial explains them.
pub fn mitsunaga(bracket: &Bracket) -> Result<Polynomial> {
    let frames = bracket.frames();
    let mut order: Vec<usize> = (0..frames.len()).collect();
    order.sort_by(|&a, &b| frames[a].exposure_time.total_cmp(&frames[b].exposure_time));
    let given: Vec<f64> = order.iter().map(|&i| frames[i].exposure_time.ln()).collect();
    let mut counts = Vec::new();
    for w in order.windows(2) {
        let pair: [Vec<Joint>; 3] = std::array::from_fn(|c| joint(&frames[w[0]], &frames[w[1]], c));
        let shared = pair.iter().map(|h| h.iter().map(|j| j.count).sum::<f64>()).fold(f64::INFINITY, f64::min);
        if shared < MIN_OVERLAP {
            return Err(Error::Bracket(format!(
                "{} and {}: too few pixels ({shared:.0}) are well exposed in both; take frames whose exposure times are closer",
                frames[w[0]].name, frames[w[1]].name
            )));
        }
        counts.push(pair);
    }
    let mut best: Option<(f64, Solution, usize)> = None;
    let solutions: Vec<_> = DEGREES.into_par_iter().map(|degree| (degree, solve(&counts, &given, degree))).collect();
    for (degree, solution) in solutions {
        let Some(solution) = solution else { continue };
        if best.as_ref().is_none_or(|(e, ..)| solution.error < (1.0 - WORTH_IT) * e) {
            best = Some((solution.error, solution, degree));
        }
    }
    let Some((_, solution, degree)) = best else {
        return Err(Error::Bracket(format!("{}: no rising polynomial explains the frames; use --method debevec", frames[0].name)));
    };
    let mut exposure_times = vec![0.0; frames.len()];
    for (&i, t) in order.iter().zip(&solution.times) {
        exposure_times[i] = t.exp();
    }
    let response = Response::Table(std::array::from_fn(|c| {
        let p = |z: f64| value(&solution.coefficients[c], z);
        let mut g: Vec<f64> = (0..256).map(|z| p(f64::from(z.max(1)) / 255.0).max(1e-9).ln()).collect();
        make_monotone(&mut g[1..]);
        let white = g[255];
        let mut x: Vec<f64> = g.iter().map(|v| (v - white).exp()).collect();
        x[0] = 0.0;
        x
    }));
    Ok(Polynomial { response, exposure_times, degree })
}

/// Pixels of intensity `a` in the shorter and `b` in the longer frame.
struct Joint {
    a: f64,
    b: f64,
    count: f64,
}

fn joint(shorter: &Frame, longer: &Frame, channel: usize) -> Vec<Joint> {
    let mut table = vec![0u32; 256 * 256];
    let code = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as usize;
    for (&a, &b) in shorter.intensity.0[channel].data.iter().zip(&longer.intensity.0[channel].data) {
        let (a, b) = (code(a), code(b));
        if CODES.contains(&a) && CODES.contains(&b) {
            table[a * 256 + b] += 1;
        }
    }
    let filled = table.iter().enumerate().filter(|(_, n)| **n > 0);
    // A pair of codes that few pixels have is an edge, or noise: the work is in the many that are left out.
    let least = (shorter.intensity.width() * shorter.intensity.height()) as u32 / 200_000;
    filled
        .filter(|(_, n)| **n > least)
        .map(|(k, &n)| Joint { a: (k / 256) as f64 / 255.0, b: (k % 256) as f64 / 255.0, count: f64::from(n) })
        .collect()
}

struct Solution {
    coefficients: [Vec<f64>; 3],
    /// ln Δt in order of exposure time.
    times: Vec<f64>,
    error: f64,
}

/// Σ c_n zⁿ, n from 1.
fn value(c: &[f64], z: f64) -> f64 {
    c.iter().rev().fold(0.0, |sum, c| (sum + c) * z)
}

fn slope(c: &[f64], z: f64) -> f64 {
    c.iter().enumerate().rev().fold(0.0, |sum, (n, c)| sum * z + c * (n + 1) as f64)
}

/// Polynomials of one degree and ratios in turn; `None` where a polynomial does not rise.
fn solve(counts: &[[Vec<Joint>; 3]], given: &[f64], degree: usize) -> Option<Solution> {
    let mut ratios: Vec<f64> = given.windows(2).map(|w| w[0] - w[1]).collect();
    let mut coefficients: [Vec<f64>; 3] = std::array::from_fn(|_| {
        // z²: a curve to begin with.
        let mut c = vec![0.0; degree];
        c[1] = 1.0;
        c
    });
    let mut times = given.to_vec();
    for _ in 0..ROUNDS {
        for (c, curve) in coefficients.iter_mut().enumerate() {
            *curve = polynomial(counts, &ratios, c, curve)?;
        }
        let refined: Vec<f64> = counts.iter().zip(&ratios).map(|(pair, &r)| ratio(pair, &coefficients, r)).collect();
        let mut free = vec![0.0];
        for r in &refined {
            free.push(free[free.len() - 1] - r);
        }
        // In every round, lest the power drift.
        times = anchored(&free, given);
        let next: Vec<f64> = times.windows(2).map(|w| w[0] - w[1]).collect();
        let change = next.iter().zip(&ratios).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        ratios = next;
        if change < SETTLED {
            break;
        }
    }
    let (mut error, mut n) = (0.0, 0.0);
    for (pair, r) in counts.iter().zip(&ratios) {
        for (c, h) in pair.iter().enumerate() {
            for j in h {
                let (e, variance) = residual(j, &coefficients[c], r.exp());
                error += j.count * e * e / variance;
                n += j.count;
            }
        }
    }
    let rises = coefficients.iter().all(|c| CODES.clone().all(|z| slope(c, z as f64 / 255.0) > 0.0));
    rises.then_some(Solution { coefficients, times, error: error / n })
}

/// f⁻¹(a) − R f⁻¹(b) and its variance.
fn residual(j: &Joint, c: &[f64], ratio: f64) -> (f64, f64) {
    let deviation = (slope(c, j.a).abs().max(0.05)).hypot(ratio * slope(c, j.b).abs().max(0.05)) * CODE_DEVIATION;
    (value(c, j.a) - ratio * value(c, j.b), deviation * deviation)
}

/// Least squares over c_1..=c_N with Σ c_n = 1.
fn polynomial(counts: &[[Vec<Joint>; 3]], ratios: &[f64], channel: usize, current: &[f64]) -> Option<Vec<f64>> {
    let degree = current.len();
    let n = degree - 1;
    let (mut matrix, mut right) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
    for (pair, ratio) in counts.iter().zip(ratios) {
        let ratio = ratio.exp();
        for j in &pair[channel] {
            let (e, variance) = residual(j, current, ratio);
            // Cauchy weights: edges that are not quite aligned.
            let w = j.count / (variance * (1.0 + e * e / (9.0 * variance)));
            // c_N = 1 − the others.
            let (mut a, mut b) = (1.0, 1.0);
            let terms: [f64; MOST] = std::array::from_fn(|_| {
                (a, b) = (a * j.a, b * j.b);
                a - ratio * b
            });
            let last = terms[degree - 1];
            let row = terms.map(|t| t - last);
            for (i, a) in row[..n].iter().enumerate() {
                for (k, b) in row[..n].iter().enumerate() {
                    matrix[(i, k)] += w * a * b;
                }
                right[i] -= w * a * last;
            }
        }
    }
    // High degrees are nearly dependent.
    let ridge = 1e-9 * matrix.trace() / n as f64;
    for i in 0..n {
        matrix[(i, i)] += ridge;
    }
    let mut c: Vec<f64> = Cholesky::new(matrix)?.solve(&right).iter().copied().collect();
    c.push(1.0 - c.iter().sum::<f64>());
    Some(c)
}

/// ln R: weighted mean of ln f⁻¹(a) − ln f⁻¹(b) of all channels.
fn ratio(pair: &[Vec<Joint>; 3], coefficients: &[Vec<f64>; 3], current: f64) -> f64 {
    let (mut sum, mut total) = (0.0, 0.0);
    for (h, c) in pair.iter().zip(coefficients) {
        for j in h {
            let (x, y) = (value(c, j.a), value(c, j.b));
            if x <= 1e-6 || y <= 1e-6 {
                continue;
            }
            let deviation = CODE_DEVIATION * (slope(c, j.a) / x).hypot(slope(c, j.b) / y);
            let away = ((x / y).ln() - current) / deviation;
            let w = j.count / (deviation * deviation * (1.0 + away * away / 9.0));
            sum += w * (x / y).ln();
            total += w;
        }
    }
    if total > 0.0 { sum / total } else { current }
}

/// `free` times u plus s with the least sum of absolute differences to `given`.
fn anchored(free: &[f64], given: &[f64]) -> Vec<f64> {
    let (u, s) = super::automatic::best_line(free, given, false);
    free.iter().map(|t| u * t + s).collect()
}
