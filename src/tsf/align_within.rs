//! Alignment of one frame's PSFs to each other (section III-B). Each PSF of a blind estimate comes with a shift of its own: the latent patch
//! is shifted the opposite way.
//!
//! The paper searches all shifts of all PSFs for those under which one TSF explains them best, `Σ_l ‖h_l - M_l h_T‖²`: exponential in their
//! number. Here the same objective falls by coordinate descent over half pixels, from PSFs centred on their centroids.

use super::Tsf;
use super::from_psfs::from_psfs;
use crate::image::Plane;
use crate::pose::{PoseGrid, project};
use crate::psf::{Patch, Psf};
use glam::DVec2;

/// PSFs that one TSF explains.
#[derive(Clone, Debug)]
pub struct Within {
    /// The TSF of eq. (6) from the aligned PSFs.
    pub tsf: Tsf,
    /// Shift (x, y) in pixels that each PSF was given, multiples of a half.
    pub shifts: Vec<(f64, f64)>,
    /// `Σ_l ‖h_l - M_l h_T‖²` over `Σ_l ‖h_l‖²`.
    pub error: f64,
}

/// Half pixels around its place within which a PSF is looked for in one step.
const REACH: i32 = 5;
/// Sweeps over all PSFs at most.
const SWEEPS: usize = 6;

/// `psf` moved by `shift` (x, y) in pixels, cubic convolution; what leaves the square is lost.
pub fn shifted(psf: &Psf, shift: (f64, f64)) -> Psf {
    let (ix, iy) = (shift.0.floor(), shift.1.floor());
    let kernel = super::Interpolation::Bicubic;
    let weights = |f: f64| -> [f32; 4] { std::array::from_fn(|k| kernel.weight(k as f64 - 1.0 - f) as f32) };
    let (wx, wy) = (weights(shift.0 - ix), weights(shift.1 - iy));
    let side = psf.values.width as isize;
    let at = |x: isize, y: isize| if x < 0 || y < 0 || x >= side || y >= side { 0.0 } else { psf.values.at(x as usize, y as usize) };
    let moved = Plane::from_fn(side as usize, side as usize, |x, y| {
        let (x, y) = (x as isize - ix as isize, y as isize - iy as isize);
        let mut sum = 0.0;
        for (j, b) in wy.iter().enumerate() {
            for (i, a) in wx.iter().enumerate() {
                sum += a * b * at(x - (i as isize - 1), y - (j as isize - 1));
            }
        }
        sum.max(0.0)
    });
    let sum: f32 = moved.data.iter().sum();
    let scale = if sum > 0.0 { 1.0 / sum } else { 1.0 };
    Psf { radius: psf.radius, values: moved.map(|v| v * scale) }
}

/// `M_l h_T` of eq. (5): the PSF that `tsf` makes at the centred frame point `p`, of this radius; what leaves the square is lost.
pub fn psf_at(tsf: &Tsf, p: DVec2, radius: usize) -> Psf {
    let side = 2 * radius + 1;
    let mut values = Plane::filled(side, side, 0.0);
    for pose in &tsf.poses {
        let u = p - project(&(pose.homography(tsf.focal_px) * tsf.base).inverse(), p);
        let (fx, fy) = (u.x.floor(), u.y.floor());
        for (j, b) in [(0, 1.0 - (u.y - fy)), (1, u.y - fy)] {
            for (i, a) in [(0, 1.0 - (u.x - fx)), (1, u.x - fx)] {
                let (x, y) = (fx as isize + i + radius as isize, fy as isize + j + radius as isize);
                if x >= 0 && y >= 0 && x < side as isize && y < side as isize {
                    values.data[y as usize * side + x as usize] += (a * b * pose.weight) as f32;
                }
            }
        }
    }
    Psf { radius, values }
}

/// Squared difference of two PSFs of one radius.
pub(super) fn distance(a: &Psf, b: &Psf) -> f64 {
    a.values.data.iter().zip(&b.values.data).map(|(x, y)| f64::from(x - y).powi(2)).sum()
}

/// Aligns the PSFs of one `width` x `height` frame, all of one radius, with poses on `grid`. The PSF nearest to the frame's centre stays on its
/// centroid, to the half pixel: any common shift of all of them is free. `None` without PSFs or when no pose explains them.
pub fn align_within(psfs: &[(Patch, Psf)], grid: &PoseGrid, width: usize, height: usize) -> Option<Within> {
    let size = (width, height);
    let half = |v: f64| (2.0 * v).round() / 2.0;
    let mut shifts: Vec<(f64, f64)> = psfs
        .iter()
        .map(|(_, h)| {
            let c = h.centroid();
            (half(-c.0), half(-c.1))
        })
        .collect();
    let mut order: Vec<usize> = (0..psfs.len()).collect();
    order.sort_by(|&a, &b| psfs[a].0.centred(size).length().total_cmp(&psfs[b].0.centred(size).length()));
    let fixed = *order.first()?;
    let moved = |l: usize, s: (f64, f64)| (psfs[l].0, shifted(&psfs[l].1, s));
    let fit = |of: &[usize], shifts: &[(f64, f64)]| {
        let list: Vec<(Patch, Psf)> = of.iter().map(|&l| moved(l, shifts[l])).collect();
        from_psfs(&list, grid, width, height)
    };
    // One PSF after the other joins those that are aligned, from the centre outwards.
    let mut tsf = fit(&[fixed], &shifts)?;
    for k in 1..order.len() {
        let l = order[k];
        shifts[l] = best(&psfs[l], &tsf, shifts[l], size);
        tsf = fit(&order[..=k], &shifts)?;
    }
    for _ in 0..SWEEPS {
        let before = shifts.clone();
        for &l in order.iter().filter(|&&l| l != fixed) {
            // Against what the others say: its own part of the TSF holds it where it is.
            let others: Vec<usize> = order.iter().copied().filter(|&k| k != l).collect();
            shifts[l] = best(&psfs[l], &fit(&others, &shifts)?, shifts[l], size);
        }
        if shifts == before {
            break;
        }
    }
    let tsf = fit(&order, &shifts)?;
    let (mut wrong, mut all) = (0.0, 0.0);
    for (l, &s) in shifts.iter().enumerate() {
        let (patch, h) = moved(l, s);
        wrong += distance(&h, &psf_at(&tsf, patch.centred(size), h.radius));
        all += h.values.data.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
    }
    Some(Within { tsf, shifts, error: wrong / all })
}

/// The half-pixel shift around `from` under which `tsf` explains the PSF best.
fn best((patch, h): &(Patch, Psf), tsf: &Tsf, from: (f64, f64), size: (usize, usize)) -> (f64, f64) {
    let model = psf_at(tsf, patch.centred(size), h.radius);
    let near = |k: i32| f64::from(k) / 2.0;
    let candidates = (-REACH..=REACH).flat_map(|j| (-REACH..=REACH).map(move |i| (from.0 + near(i), from.1 + near(j))));
    candidates.map(|s| (distance(&shifted(h, s), &model), s)).min_by(|a, b| a.0.total_cmp(&b.0)).map_or(from, |found| found.1)
}
