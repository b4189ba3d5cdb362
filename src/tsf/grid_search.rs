//! TSF of a whole frame on a grid of poses: sparse, gradients by FFT correlation.

use super::Tsf;
use super::active_set::ActiveSet;
use super::continuous::Evidence;
use super::from_psfs::nominal_focal;
use super::taps::Interpolation;
use super::whole_frame::{WholeFrame, warp};
use crate::fft::{Fft2, Spectrum};
use crate::image::Plane;
use crate::pose::{Pose, PoseGrid};
use rayon::prelude::*;

/// Differences that a search of a grid of poses looks at, from nothing and from a start.
const ROWS: (usize, usize) = (40_000, 14_000);

impl WholeFrame<'_> {
    /// TSF over the integer translations and the angles of `grid`, started from the poses of `start`; `None` when nothing fits. From a start λ
    /// follows what that leaves unexplained, as for [`WholeFrame::fit_around`].
    pub fn fit_grid(&self, grid: &PoseGrid, start: Option<&Tsf>) -> Option<Tsf> {
        let (w, h) = self.size();
        let focal = nominal_focal(w, h);
        let r = grid.radius;
        let n = 2 * r + 1;
        let rows = self.rows(if start.is_none() { ROWS.0 } else { ROWS.1 }, 0);
        let noise = start.map_or(0.0, |t| Evidence::new(self, &rows).misfit(t).sqrt());
        let targets = self.targets(&rows);
        let bases: Vec<Plane> = grid
            .angles_deg
            .iter()
            .map(|a| Pose::planar(0.0, 0.0, *a, 1.0).rotation(focal) * self.base)
            .map(|m| warp(self.latent, self.pad, (w, h), r, &m, Interpolation::Bicubic))
            .collect();
        let fft = Fft2::new(w + 2 * r, h + 2 * r);
        let spectra: Vec<Spectrum> = bases.par_iter().map(|b| fft.forward(&b.data, b.width)).collect();
        let column = |id: usize| -> Vec<f32> {
            let (sx, sy, a) = (id % n, id / n % n, id / (n * n));
            // Shift s = (sx - r, sy - r); pixel q - s of the base lies at q + 2 r - sx in its array.
            let b = &bases[a];
            rows.iter()
                .map(|row| {
                    let (i, j) = row.other();
                    let d = b.at(i + 2 * r - sx, j + 2 * r - sy) - b.at(row.x as usize + 2 * r - sx, row.y as usize + 2 * r - sy);
                    row.weight.sqrt() * d
                })
                .collect()
        };
        let gradient = |residual: &[f32]| -> Vec<f64> {
            let mut image = vec![0.0f32; w * h];
            for (row, v) in rows.iter().zip(residual) {
                let (i, j) = row.other();
                let v = v * row.weight.sqrt();
                image[j * w + i] += v;
                image[row.y as usize * w + row.x as usize] -= v;
            }
            let v = fft.forward(&image, w);
            let planes: Vec<Vec<f64>> = spectra
                .par_iter()
                .map(|e| {
                    let product = v.iter().zip(e).map(|(a, b)| a * b.conj()).collect();
                    let g = fft.inverse(product);
                    let mut out = Vec::with_capacity(n * n);
                    for sy in 0..n {
                        for sx in 0..n {
                            // Lag s - r, negative lags wrap.
                            let (lx, ly) = ((fft.width + sx - 2 * r) % fft.width, (fft.height + sy - 2 * r) % fft.height);
                            out.push(f64::from(g[ly * fft.width + lx]));
                        }
                    }
                    out
                })
                .collect();
            planes.concat()
        };
        let step = grid.step_deg();
        let start: Vec<usize> = start.map_or_else(Vec::new, |t| {
            let mut ids: Vec<usize> = t
                .poses
                .iter()
                .filter_map(|p| {
                    let (x, y) = (p.t_x.round() + r as f64, p.t_y.round() + r as f64);
                    let a = if step > 0.0 { ((p.theta_z_deg - grid.angles_deg[0]) / step).round() } else { 0.0 };
                    let inside = x >= 0.0 && y >= 0.0 && a >= 0.0 && x < n as f64 && y < n as f64 && a < grid.angles_deg.len() as f64;
                    inside.then_some((a as usize * n + y as usize) * n + x as usize)
                })
                .collect();
            ids.sort_unstable();
            ids.dedup();
            ids
        });
        let found =
            ActiveSet { shape: (n, n, grid.angles_deg.len()), lambda: 2e-3, noise, rounds: 20 }.solve(&start, &targets, gradient, column);
        let poses = found
            .into_iter()
            .map(|(id, weight)| {
                Pose::planar((id % n) as f64 - r as f64, (id / n % n) as f64 - r as f64, grid.angles_deg[id / (n * n)], weight)
            })
            .collect();
        Tsf::new(focal, poses).ok().map(|t| t.about(self.base))
    }
}
