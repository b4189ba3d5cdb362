//! The most probable curve and exposures of a bracket, given its shades: one curve for all channels under [`CurvePrior`], exposures near those that
//! the files note.

use super::Response;
use super::prior::{COEFFICIENTS, CurvePrior, of_srgb, terms};
use super::shades::{CROWD, Shade};
use crate::noise::FrameNoise;
use crate::robust::precision;
use nalgebra::{Cholesky, DMatrix, DVector};

/// Standard deviation of ln Δt about what is noted: shutters keep the series of powers of two, cameras note 1/30 for 1/32 (0.09 EV).
const NOMINAL: f64 = 0.07 * std::f64::consts::LN_2;
/// The same of one channel's gain: white balance that drifts from frame to frame.
const BALANCE: f64 = 0.1 * std::f64::consts::LN_2;
/// Standard deviation of ln f⁻¹ that all blocks of one shade have in common: flare, an engine that maps tones by place, black that is not 0. However
/// many blocks show a shade, they tell it no better: all blocks of one shade together count as one.
const COMMON: f64 = 0.04;
/// Standard deviation of the black level that all frames share, and of what each frame's engine makes of it; parts of white.
const BLACK: f64 = 2e-3;
const OWN_BLACK: f64 = 4e-4;
/// What noise that is cut off at black may add to a mean, in standard deviations of the noise at black that is left. At black itself it is 0.4 of the sensor's, but engines smooth noise after it was
/// cut off, and what it added fades with the sensor's noise, not with what is left of that.
const CUT_OFF: f64 = 2.0;
/// Exposures below count as this one where the black level is taken off.
const LEAST: f64 = 1e-3;
/// Reweighting rounds.
const ROUNDS: usize = 12;

/// Curve and exposures, and how well they are known.
pub(super) struct Posterior {
    /// Of ln f⁻¹, see [`terms`]; none where the curve was known.
    pub coefficients: Vec<f64>,
    /// Standard deviation of ln f⁻¹(0.5), half of white's code; 0 where the curve was known.
    pub deviation: f64,
    /// By how much each frame's ln Δt is more than what is noted.
    pub exposures: Vec<f64>,
    /// Standard deviation of each.
    pub deviations: Vec<f64>,
    /// Negative logarithm of the curve's prior, but for a constant: how unlike the curve of a camera it is. 0 where the curve was known.
    pub unlikely: f64,
}

/// One frame's equation of a shade: its standard deviation, its coefficients by unknown, its right-hand side, and ln E by the values found so far.
type Row = (f64, Vec<(usize, f64)>, f64, f64);

/// What is known of the curve.
pub(super) enum Curve<'a> {
    Unknown(&'a CurvePrior),
    Known(&'a Response),
}

impl Curve<'_> {
    /// ln f⁻¹ of `channel` at `z` and its slope, where the unknown curve has these `coefficients`.
    fn log(&self, coefficients: &[f64], channel: usize, z: f64) -> (f64, f64) {
        match self {
            Self::Unknown(_) => log(&coefficients[..COEFFICIENTS], z),
            Self::Known(response) => {
                let x = response.inverse(channel, z).max(1e-9);
                (x.ln(), (response.inverse_slope(channel, z, 2.0 / 255.0) / x).max(1e-3))
            }
        }
    }
}

fn log(coefficients: &[f64], z: f64) -> (f64, f64) {
    let value = terms(z).iter().zip(coefficients).map(|(b, c)| b * c).sum();
    let slope = coefficients[0] * of_srgb(z).1
        + coefficients[1] / z
        + coefficients[2..].iter().enumerate().map(|(k, c)| c * (k + 1) as f64 * z.powi(k as i32)).sum::<f64>();
    (value, slope.max(1e-3))
}

/// Maximum a posteriori of `shades` seen by frames whose noted ln Δt are `times` and whose noise is `noise`; `None`
/// where no equation is regular. `start`: errors of ln Δt to begin at, as there may be more than one optimum.
///
/// Unknown are the curve's coefficients c, the error e_i of each frame's noted exposure, the gain w_ic of each of its channels, and the black level o:
/// ln(f⁻¹(z) − o) − (ln Δt_i + e_i + w_ic) − ln E = 0 for every block of radiance E.
pub(super) fn posterior(shades: &[Shade], times: &[f64], noise: &[FrameNoise], curve: &Curve, start: Option<&[f64]>) -> Option<Posterior> {
    let frames = times.len();
    let (mean, first): (&[f64], usize) = match curve {
        Curve::Unknown(prior) => (prior.mean.as_slice(), COEFFICIENTS),
        Curve::Known(_) => (&[], 0),
    };
    // Coefficients, exposures, gains of channels, black level.
    let black = first + 4 * frames;
    let n = black + 1;
    let mut found: Vec<f64> = mean.iter().copied().chain(std::iter::repeat_n(0.0, 4 * frames + 1)).collect();
    if let Some(start) = start {
        found[first..first + frames].copy_from_slice(start);
    }
    let (mut deviation, mut deviations, mut unlikely) = (0.0, Vec::new(), 0.0);
    for _ in 0..ROUNDS {
        let mut matrix = DMatrix::<f64>::zeros(n, n);
        let mut right = DVector::<f64>::zeros(n);
        unlikely = 0.0;
        for shade in shades {
            // At most n rows: one per frame that sees it.
            let mut rows: Vec<Row> = Vec::with_capacity(shade.seen.len());
            for s in &shade.seen {
                let (value, slope) = curve.log(&found, shade.channel, s.z);
                let columns = [first + s.frame, first + frames + 3 * s.frame + shade.channel];
                let exposure = times[s.frame] + columns.iter().map(|&k| found[k]).sum::<f64>();
                let shape = if first > 0 { terms(s.z) } else { Vec::new() };
                // ln(x - o) is about ln x - o / x.
                let over = -1.0 / value.exp().max(LEAST);
                let row = shape.into_iter().enumerate().chain(columns.map(|k| (k, -1.0))).chain([(black, over)]).collect();
                let target = if first > 0 { times[s.frame] } else { times[s.frame] - value };
                rows.push((
                    COMMON
                        .hypot(slope * s.deviation)
                        .hypot(OWN_BLACK.hypot(CUT_OFF * noise[s.frame].channels[shade.channel].read.sqrt()) * over),
                    row,
                    target,
                    value + over * found[black] - exposure,
                ));
            }
            let total: f64 = rows.iter().map(|r| r.0.powi(-2)).sum();
            let radiance = rows.iter().map(|r| r.3 * r.0.powi(-2)).sum::<f64>() / total;
            let weights: Vec<f64> = rows.iter().map(|r| shade.weight / CROWD * precision(r.3 - radiance, r.0)).collect();
            let sum: f64 = weights.iter().sum();
            let (mut mean, mut mean_y) = (vec![0.0; n], 0.0);
            for ((_, row, y, _), w) in rows.iter().zip(&weights) {
                for &(i, a) in row {
                    for &(j, b) in row {
                        matrix[(i, j)] += w * a * b;
                    }
                    right[i] += w * a * y;
                    mean[i] += w * a;
                }
                mean_y += w * y;
            }
            // Minimised over ln E.
            let touched: Vec<usize> = (0..n).filter(|&i| mean[i] != 0.0).collect();
            for &i in &touched {
                for &j in &touched {
                    matrix[(i, j)] -= mean[i] * mean[j] / sum;
                }
                right[i] -= mean[i] * mean_y / sum;
            }
        }
        if let Curve::Unknown(prior) = curve {
            for i in 0..COEFFICIENTS {
                for j in 0..COEFFICIENTS {
                    matrix[(i, j)] += prior.precision[(i, j)];
                    right[i] += prior.precision[(i, j)] * prior.mean[j];
                    unlikely += 0.5 * prior.precision[(i, j)] * (found[i] - prior.mean[i]) * (found[j] - prior.mean[j]);
                }
            }
        }
        for k in 0..4 * frames {
            matrix[(first + k, first + k)] += precision(found[first + k], if k < frames { NOMINAL } else { BALANCE });
        }
        matrix[(black, black)] += BLACK.powi(-2);
        let cholesky = Cholesky::new(matrix)?;
        found = cholesky.solve(&right).as_slice().to_vec();
        let spread = |b: DVector<f64>| b.dot(&cholesky.solve(&b)).sqrt();
        if first > 0 {
            deviation = spread(DVector::from_iterator(n, terms(0.5).into_iter().chain(std::iter::repeat_n(0.0, 4 * frames + 1))));
        }
        deviations = (0..frames).map(|i| spread(DVector::from_fn(n, |k, _| f64::from(k == first + i)))).collect();
    }
    Some(Posterior {
        coefficients: found[..first].to_vec(),
        deviation,
        exposures: found[first..first + frames].to_vec(),
        deviations,
        unlikely,
    })
}
