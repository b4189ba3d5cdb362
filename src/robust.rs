//! Weights of least squares that outliers lose.

/// Deviations beyond so many standard deviations lose their say.
const TAIL: f64 = 2.5;

/// Inverse variance that a deviation `d` counts with where its standard deviation is `sigma` but for a heavy tail (Cauchy), in the unit of `sigma`⁻².
pub(super) fn precision(d: f64, sigma: f64) -> f64 {
    1.0 / (sigma * sigma * (1.0 + (d / (TAIL * sigma)).powi(2)))
}
