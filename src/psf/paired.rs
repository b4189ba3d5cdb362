//! PSF of a patch whose sharp counterpart is known: eq. (11), non-negative.

use super::{Patch, Psf};
use crate::image::Plane;
use crate::nonnegative::{coordinate_descent, gram};
use nalgebra::DMatrix;

/// Rows of the least-squares system at most: the differences with most noise-weighted structure.
const ROWS: usize = 6000;

/// PSF of `patch` with |u| up to `radius`: minimises the noise-weighted squared error of the patch's x and y differences
/// (differences, because the mean level would stall everything) over h ≥ 0, then normalises h to sum 1.
///
/// `latent` is the sharp irradiance on the frame's grid plus `pad` pixels on every side, `blurred` the frame's irradiance,
/// `weight` its inverse variance (0: masked). `None` when the patch determines nothing.
pub fn estimate(latent: &Plane, pad: usize, blurred: &Plane, weight: &Plane, patch: &Patch, radius: usize) -> Option<Psf> {
    let side = 2 * radius + 1;
    let n = side * side;
    let e = |x: isize, y: isize| latent.clamped(x + pad as isize, y + pad as isize);
    // (strength, x, y, vertical)
    let mut rows: Vec<(f32, f32, usize, usize, bool)> = Vec::new();
    for y in patch.y..patch.y + patch.size - 1 {
        for x in patch.x..patch.x + patch.size - 1 {
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
    if rows.len() < n {
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
        for v in 0..side {
            for u in 0..side {
                let (dx, dy) = (u as isize - radius as isize, v as isize - radius as isize);
                let d = e(i as isize - dx, j as isize - dy) - e(x as isize - dx, y as isize - dy);
                a[(r, v * side + u)] = k * d;
            }
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
    let values = h.iter().map(|v| (v / sum) as f32).collect();
    Some(Psf { radius, values: Plane { width: side, height: side, data: values } })
}
