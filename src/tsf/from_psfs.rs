//! TSF from local PSFs: h = M h_T of eq. (5), non-negative and sparse as in eq. (6).

use super::Tsf;
use super::active_set::ActiveSet;
use crate::pose::{Pose, PoseGrid, project};
use crate::psf::{Patch, Psf};
use glam::DVec2;

/// Focal length in pixels that stands in where nothing is known: it scales pitch and yaw only, which planar poses do not have.
pub(super) fn nominal_focal(width: usize, height: usize) -> f64 {
    1.2 * width.max(height) as f64
}

/// TSF over `grid` that best explains the PSFs of `patches` on a `width` x `height` frame; `None` when no pose helps.
///
/// Eq. (5): the PSF at p has weight h_T(Γ) at u = p - Γ⁻¹ p, split bilinearly on the PSF's pixels (a column of M).
pub fn from_psfs(patches: &[(Patch, Psf)], grid: &PoseGrid, width: usize, height: usize) -> Option<Tsf> {
    let focal = nominal_focal(width, height);
    let radius = patches.first()?.1.radius as isize;
    let side = (2 * radius + 1) as usize;
    let n = (2 * grid.radius + 1, 2 * grid.radius + 1, grid.angles_deg.len());
    let centre = DVec2::new((width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0);
    let pose = |id: usize| {
        let (x, y, a) = (id % n.0, id / n.0 % n.1, id / (n.0 * n.1));
        Pose::planar(x as f64 - grid.radius as f64, y as f64 - grid.radius as f64, grid.angles_deg[a], 1.0)
    };
    // (index into the stacked PSFs, weight) of a pose; None when it leaves a PSF.
    let entries = |id: usize| -> Option<Vec<(usize, f64)>> {
        let inverse = pose(id).homography(focal).inverse();
        let mut out = Vec::with_capacity(4 * patches.len());
        for (l, (patch, _)) in patches.iter().enumerate() {
            let c = patch.centre();
            let p = DVec2::new(c.0, c.1) - centre;
            let u = p - project(&inverse, p);
            let (fx, fy) = (u.x.floor(), u.y.floor());
            for (j, wy) in [(0, 1.0 - (u.y - fy)), (1, u.y - fy)] {
                for (i, wx) in [(0, 1.0 - (u.x - fx)), (1, u.x - fx)] {
                    if wx * wy > 1e-9 {
                        let (x, y) = (fx as isize + i + radius, fy as isize + j + radius);
                        if x < 0 || y < 0 || x >= side as isize || y >= side as isize {
                            return None;
                        }
                        out.push((l * side * side + y as usize * side + x as usize, wx * wy));
                    }
                }
            }
        }
        Some(out)
    };
    let columns: Vec<Option<Vec<(usize, f64)>>> = (0..n.0 * n.1 * n.2).map(entries).collect();
    let target: Vec<f32> = patches.iter().flat_map(|(_, h)| h.values.data.iter().copied()).collect();
    let gradient = |r: &[f32]| {
        columns.iter().map(|c| c.as_ref().map_or(0.0, |c| c.iter().map(|(i, v)| f64::from(r[*i]) * v).sum())).collect::<Vec<f64>>()
    };
    let column = |id: usize| {
        let mut dense = vec![0.0f32; target.len()];
        for (i, v) in columns[id].iter().flatten() {
            dense[*i] += *v as f32;
        }
        dense
    };
    let found = ActiveSet { shape: n, lambda: 1e-2, noise: 0.0, rounds: 30 }.solve(&[], &target, gradient, column);
    Tsf::new(focal, found.into_iter().map(|(id, w)| Pose { weight: w, ..pose(id) }).collect()).ok()
}
