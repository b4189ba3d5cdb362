//! What camera curves look like: mean and covariance of ln f⁻¹ over a family of tone curves.
//!
//! A camera's JPEG engine lifts the middle, compresses highlights and adds contrast on top of an encoding with an exponent of about 2.2. The family
//! crosses these three: sRGB, which JPEG files are encoded for, thrice as often as power laws of 2.0 and 2.2; exposure lifted before the encoding by 0 to 0.5 EV
//! with a shoulder that keeps white at white; an S-curve (smoothstep) mixed in by 0 to 0.6. A free curve is found only up to a common power of curve and exposure times
//! (M. Grossberg and S. Nayar, PAMI 2003): this prior and that of the exposure times decide that power, and what frames do not show.

use super::Response;
use nalgebra::{DMatrix, DVector};

/// Powers of the polynomial.
pub(super) const POWERS: usize = 5;
/// Coefficients of a curve: ln f⁻¹(z) = s ln sRGB⁻¹(z) + a ln z + Σ_k c_k (z^k − 1); the first tells a linear toe from a power law.
pub(super) const COEFFICIENTS: usize = POWERS + 2;
/// Encodings of the family, by how often they occur: exponents; 0 is sRGB.
const EXPONENTS: [f64; 5] = [0.0, 0.0, 0.0, 2.2, 2.0];
/// Slope of the exposure at black over that without lift: a x / (1 + (a − 1) x).
const LIFTS: [f64; 4] = [1.0, 1.0, 1.15, 1.4];
/// Parts of the S-curve 3 g² − 2 g³.
const CONTRASTS: [f64; 4] = [0.0, 0.2, 0.4, 0.6];
/// Variance of ln f⁻¹ that no member of the family has: real curves differ by some per cent from any parametric family.
const BEYOND: f64 = 0.03 * 0.03;
/// Intensities, from 4 of 255 to white, at which curves are compared.
const NODES: usize = 64;

/// Gaussian prior of the coefficients.
pub(super) struct CurvePrior {
    pub mean: DVector<f64>,
    /// Inverse covariance.
    pub precision: DMatrix<f64>,
}

/// ln z, z − 1, z² − 1, ...
pub(super) fn basis(z: f64, powers: usize) -> Vec<f64> {
    std::iter::once(z.ln()).chain((1..=powers).map(|k| z.powi(k as i32) - 1.0)).collect()
}

/// What the coefficients of a curve multiply.
pub(super) fn terms(z: f64) -> Vec<f64> {
    std::iter::once(of_srgb(z).0).chain(basis(z, POWERS)).collect()
}

/// ln f⁻¹ of sRGB and its slope.
pub(super) fn of_srgb(z: f64) -> (f64, f64) {
    if z <= 0.040_45 {
        (z.max(1e-6).ln() - 12.92f64.ln(), 1.0 / z.max(1e-6))
    } else {
        (2.4 * ((z + 0.055) / 1.055).ln(), 2.4 / (z + 0.055))
    }
}

fn nodes() -> impl Iterator<Item = f64> {
    let first = 4.0 / 255.0;
    (0..NODES).map(move |k| first + (1.0 - first) * k as f64 / (NODES - 1) as f64)
}

/// f of one member of the family.
fn encoded(x: f64, exponent: f64, lift: f64, contrast: f64) -> f64 {
    let x = lift * x / (1.0 + (lift - 1.0) * x);
    let g = if exponent > 0.0 {
        x.powf(1.0 / exponent)
    } else if x <= 0.003_130_8 {
        12.92 * x
    } else {
        1.055 * x.powf(1.0 / 2.4) - 0.055
    };
    (1.0 - contrast) * g + contrast * g * g * (3.0 - 2.0 * g)
}

/// ln f⁻¹ of that member at `z`, by bisection: f rises.
fn log_inverse(z: f64, exponent: f64, lift: f64, contrast: f64) -> f64 {
    let (mut low, mut high) = (-25.0f64, 0.0f64);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if encoded(middle.exp(), exponent, lift, contrast) < z { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

impl CurvePrior {
    /// The prior of cameras' curves.
    pub fn of_cameras() -> Self {
        let z: Vec<f64> = nodes().collect();
        let rows = DMatrix::from_fn(z.len(), COEFFICIENTS, |i, k| terms(z[i])[k]);
        let members: Vec<DVector<f64>> = EXPONENTS
            .iter()
            .flat_map(|e| LIFTS.iter().flat_map(move |l| CONTRASTS.iter().map(move |c| (*e, *l, *c))))
            .map(|(e, l, c)| DVector::from_iterator(z.len(), z.iter().map(|&z| log_inverse(z, e, l, c))))
            .collect();
        let n = members.len() as f64;
        let mean = members.iter().fold(DVector::zeros(z.len()), |sum, m| sum + m) / n;
        // What the family spans, and a smooth remainder of half a range's correlation length that it does not.
        let mut covariance = DMatrix::from_fn(z.len(), z.len(), |i, j| BEYOND * (-0.5 * ((z[i] - z[j]) / 0.25).powi(2)).exp());
        for m in &members {
            let d = m - &mean;
            covariance += &d * d.transpose() / n;
        }
        // In the coefficients: generalised least squares of the mean, and the precision Aᵀ Σ⁻¹ A.
        let ridge = DMatrix::identity(z.len(), z.len()) * 1e-6;
        let inverse = (covariance + ridge).cholesky().expect("a covariance with a ridge").inverse();
        let precision = rows.transpose() * &inverse * &rows;
        let mean = precision.clone().cholesky().expect("as many nodes as coefficients").solve(&(rows.transpose() * inverse * mean));
        Self { mean, precision }
    }

    /// The curve in the middle of the family.
    pub fn middle(&self) -> Response {
        response(self.mean.as_slice())
    }
}

/// The curve of `coefficients`, white at 1.
pub(super) fn response(coefficients: &[f64]) -> Response {
    let log = |z: f64| terms(z).iter().zip(coefficients).map(|(b, c)| b * c).sum::<f64>();
    let mut g: Vec<f64> = (0..256).map(|k| log(f64::from(k.max(1)) / 255.0)).collect();
    super::calibrate::make_monotone(&mut g[1..]);
    let mut x: Vec<f64> = g.iter().map(|v| (v - g[255]).exp()).collect();
    x[0] = 0.0;
    Response::Table([x.clone(), x.clone(), x])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_family_holds_srgb_within_its_spread() {
        let prior = CurvePrior::of_cameras();
        let covariance = prior.precision.clone().cholesky().unwrap().inverse();
        for z in [0.1, 0.3, 0.5, 0.8] {
            let b = DVector::from_vec(terms(z));
            let (mean, deviation) = (b.dot(&prior.mean), (b.transpose() * &covariance * &b)[0].sqrt());
            let srgb = log_inverse(z, 0.0, 1.0, 0.0);
            assert!((srgb - mean).abs() < 2.0 * deviation, "z = {z}: sRGB {srgb:.3}, family {mean:.3} ± {deviation:.3}");
            assert!(deviation < 0.7, "z = {z}: a prior that says something, {deviation:.3}");
        }
    }
}
