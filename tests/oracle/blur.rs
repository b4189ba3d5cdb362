//! K of eq. (4) as an explicit sparse matrix: one row per frame pixel, built from the warps' homographies and shifts.

use glam::{DMat3, DVec2};
use unshaken::tsf::{Interpolation, Tap, TapSet};

/// Keys' kernels (1981) as coefficients of 1, t, t², t³ on each unit interval of t = |x|.
const LINEAR: &[[f64; 4]] = &[[1.0, -1.0, 0.0, 0.0]];
const CUBIC: &[[f64; 4]] = &[[1.0, 0.0, -5.0 / 2.0, 3.0 / 2.0], [2.0, -4.0, 5.0 / 2.0, -1.0 / 2.0]];
const SIX_POINT: &[[f64; 4]] =
    &[[1.0, 0.0, -7.0 / 3.0, 4.0 / 3.0], [5.0 / 2.0, -59.0 / 12.0, 3.0, -7.0 / 12.0], [-3.0 / 2.0, 7.0 / 4.0, -2.0 / 3.0, 1.0 / 12.0]];

fn pieces(interpolation: Interpolation) -> &'static [[f64; 4]] {
    match interpolation {
        Interpolation::Bilinear => LINEAR,
        Interpolation::Bicubic => CUBIC,
        Interpolation::SixPoint => SIX_POINT,
    }
}

/// Weight of a sample at distance `x`.
pub fn weight(interpolation: Interpolation, x: f64) -> f64 {
    let t = x.abs();
    pieces(interpolation).get(t as usize).map_or(0.0, |c| (0..4).map(|n| c[n] * t.powi(n as i32)).sum())
}

/// Pixels on either side that an interpolation reaches.
pub fn support(interpolation: Interpolation) -> f64 {
    pieces(interpolation).len() as f64
}

/// `h p` with the perspective division.
pub fn transform(h: &DMat3, p: DVec2) -> DVec2 {
    let v = *h * p.extend(1.0);
    v.truncate() / v.z
}

/// A sparse matrix by rows of (column, value).
pub struct Matrix {
    pub rows: Vec<Vec<(usize, f64)>>,
    pub columns: usize,
}

impl Matrix {
    pub fn apply(&self, x: &[f64]) -> Vec<f64> {
        self.rows.iter().map(|row| row.iter().map(|&(j, v)| v * x[j]).sum()).collect()
    }

    /// The transpose by scattering each row.
    pub fn transposed(&self, y: &[f64]) -> Vec<f64> {
        let mut x = vec![0.0; self.columns];
        for (row, &t) in self.rows.iter().zip(y) {
            for &(j, v) in row {
                x[j] += v * t;
            }
        }
        x
    }
}

/// Adds `factor` times the interpolation of a `size` grid at `at` to one dense row; marks the columns it touched.
fn interpolate(interpolation: Interpolation, at: DVec2, size: (usize, usize), factor: f64, row: &mut [f64], touched: &mut Vec<usize>) {
    let s = support(interpolation);
    let range = |v: f64, n: usize| ((v - s).ceil().max(0.0) as i64)..=((v + s).floor().min(n as f64 - 1.0) as i64);
    for y in range(at.y, size.1) {
        for x in range(at.x, size.0) {
            let i = y as usize * size.0 + x as usize;
            row[i] += factor * weight(interpolation, x as f64 - at.x) * weight(interpolation, y as f64 - at.y);
            touched.push(i);
        }
    }
}

/// The matrix whose row of frame pixel q is the sum over `terms` (homography scene to frame, shift, weight) of the
/// interpolation of the latent grid at H⁻¹(q - shift). The latent grid is the frame plus `pad` on every side; it is zero
/// beyond.
fn matrix(terms: &[(DMat3, DVec2, f64)], interpolation: Interpolation, frame: (usize, usize), pad: usize) -> Matrix {
    let latent = (frame.0 + 2 * pad, frame.1 + 2 * pad);
    let centre = DVec2::new(frame.0 as f64 - 1.0, frame.1 as f64 - 1.0) / 2.0;
    let inverses: Vec<_> = terms.iter().map(|t| (t.0.inverse(), t.1, t.2)).collect();
    let mut dense = vec![0.0; latent.0 * latent.1];
    let mut rows = Vec::new();
    for y in 0..frame.1 {
        for x in 0..frame.0 {
            let mut touched = Vec::new();
            for (inverse, shift, w) in &inverses {
                let at = transform(inverse, DVec2::new(x as f64, y as f64) - *shift - centre) + centre + DVec2::splat(pad as f64);
                interpolate(interpolation, at, latent, *w, &mut dense, &mut touched);
            }
            touched.sort_unstable();
            touched.dedup();
            rows.push(touched.into_iter().map(|i| (i, std::mem::take(&mut dense[i]))).collect());
        }
    }
    Matrix { rows, columns: latent.0 * latent.1 }
}

/// K of base warps and integer shifts.
pub fn of_taps(taps: &TapSet, interpolation: Interpolation, frame: (usize, usize), pad: usize) -> Matrix {
    let term = |t: &Tap| (taps.bases[t.base], DVec2::new(f64::from(t.dx), f64::from(t.dy)), t.weight);
    matrix(&taps.taps.iter().map(term).collect::<Vec<_>>(), interpolation, frame, pad)
}

/// K of poses (homography scene to frame, weight), each interpolated once: no base warps, no shifts.
pub fn of_poses(poses: &[(DMat3, f64)], interpolation: Interpolation, frame: (usize, usize), pad: usize) -> Matrix {
    matrix(&poses.iter().map(|p| (p.0, DVec2::ZERO, p.1)).collect::<Vec<_>>(), interpolation, frame, pad)
}
