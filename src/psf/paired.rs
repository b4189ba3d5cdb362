//! PSF of a patch whose sharp counterpart is known: eq. (11), non-negative.

use super::{Patch, Psf};
use crate::image::Plane;
use crate::nonnegative::{coordinate_descent, gram};
use nalgebra::DMatrix;

/// Rows of the least-squares system at most: the differences with most noise-weighted structure.
const ROWS: usize = 6000;

/// A PSF and how far it can be trusted.
#[derive(Clone, Debug)]
pub struct Measured {
    /// The PSF.
    pub psf: Psf,
    /// Expected ‖error‖ / ‖h‖: the noise that the patch's noise-weighted Gram matrix lets through to the values that are not zero.
    pub expected_error: f64,
}

impl Measured {
    /// 1 for a PSF without error, 1/2 where the expected error is as large as the PSF.
    pub fn confidence(&self) -> f64 {
        1.0 / (1.0 + self.expected_error * self.expected_error)
    }
}

/// PSF of `patch` with |u| up to `radius`: minimises the noise-weighted squared error of the patch's x and y differences
/// (differences, because the mean level would stall everything) over h ≥ 0, then normalises h to sum 1.
///
/// `latent` is the sharp irradiance on the frame's grid plus `pad` pixels on every side, `blurred` the frame's irradiance,
/// `weight` its inverse variance (0: masked). `None` when the patch determines nothing.
pub fn estimate(latent: &Plane, pad: usize, blurred: &Plane, weight: &Plane, patch: &Patch, radius: usize) -> Option<Psf> {
    estimate_within(latent, pad, blurred, weight, patch, radius, &|_, _| true).map(|m| m.psf)
}

/// As [`estimate`], with values only at those u = (u_x, u_y) where `support` holds: a blur of 60 px has as many unknowns as the path that it
/// follows has pixels, not as the square around it.
pub fn estimate_within(
    latent: &Plane,
    pad: usize,
    blurred: &Plane,
    weight: &Plane,
    patch: &Patch,
    radius: usize,
    support: &dyn Fn(isize, isize) -> bool,
) -> Option<Measured> {
    let side = 2 * radius + 1;
    let r = radius as isize;
    let offsets: Vec<(isize, isize)> = (-r..=r).flat_map(|v| (-r..=r).map(move |u| (u, v))).filter(|&(u, v)| support(u, v)).collect();
    let n = offsets.len();
    let e = |x: isize, y: isize| latent.clamped(x + pad as isize, y + pad as isize);
    // (strength, x, y, vertical)
    let mut rows: Vec<(f32, f32, usize, usize, bool)> = Vec::new();
    for y in patch.y..(patch.y + patch.size).min(blurred.height) - 1 {
        for x in patch.x..(patch.x + patch.size).min(blurred.width) - 1 {
            for vertical in [false, true] {
                let (i, j) = if vertical { (x, y + 1) } else { (x + 1, y) };
                let (a, b) = (weight.at(x, y), weight.at(i, j));
                if a > 0.0 && b > 0.0 {
                    let k = a * b / (a + b);
                    let d = blurred.at(i, j) - blurred.at(x, y);
                    let s = e(i as isize, j as isize) - e(x as isize, y as isize);
                    rows.push((k * (d * d + s * s), k, x, y, vertical));
                }
            }
        }
    }
    if n == 0 || rows.len() < n {
        return None;
    }
    rows.sort_by(|a, b| b.0.total_cmp(&a.0));
    rows.truncate(ROWS);
    let mut a = DMatrix::<f32>::zeros(rows.len(), n);
    let mut b = vec![0.0f32; rows.len()];
    for (r, &(_, k, x, y, vertical)) in rows.iter().enumerate() {
        let (i, j) = if vertical { (x, y + 1) } else { (x + 1, y) };
        let k = k.sqrt();
        b[r] = k * (blurred.at(i, j) - blurred.at(x, y));
        for (c, &(dx, dy)) in offsets.iter().enumerate() {
            a[(r, c)] = k * (e(i as isize - dx, j as isize - dy) - e(x as isize - dx, y as isize - dy));
        }
    }
    let gram: Vec<f64> = gram(&a).iter().map(|&v| f64::from(v)).collect();
    let c: Vec<f64> = (0..n).map(|i| a.column(i).iter().zip(&b).map(|(p, q)| f64::from(*p) * f64::from(*q)).sum()).collect();
    let largest = c.iter().fold(0.0f64, |m, v| m.max(*v));
    if largest <= 0.0 {
        return None;
    }
    let mut h = vec![0.0f64; n];
    coordinate_descent(&gram, &c, 1e-3 * largest, &mut h, 300, 1e-4);
    let sum: f64 = h.iter().sum();
    if sum <= 0.0 {
        return None;
    }
    let expected_error = expected_error(&gram, &h);
    let mut values = Plane::filled(side, side, 0.0);
    for (&(u, v), h) in offsets.iter().zip(&h) {
        values.data[(v + r) as usize * side + (u + r) as usize] = (h / sum) as f32;
    }
    Some(Measured { psf: Psf { radius, values }, expected_error })
}

/// √trace(G⁻¹) / ‖h‖ over the entries of `h` that are not zero: G is the inverse covariance of what they were fitted to.
fn expected_error(gram: &[f64], h: &[f64]) -> f64 {
    let n = h.len();
    let active: Vec<usize> = (0..n).filter(|&i| h[i] > 0.0).collect();
    let part = DMatrix::from_fn(active.len(), active.len(), |i, j| gram[active[i] * n + active[j]] * if i == j { 1.0 + 1e-9 } else { 1.0 });
    let norm = h.iter().map(|v| v * v).sum::<f64>().sqrt();
    part.cholesky().map_or(f64::INFINITY, |c| c.inverse().trace().max(0.0).sqrt() / norm)
}
