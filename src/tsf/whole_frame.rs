//! TSF from the whole frame: the blurred frame against the latent irradiance, `B = Σ_k h_k Γ_k E` over all valid pixels.
//!
//! First on a grid of poses (sparse, gradients by FFT correlation), then with continuous poses. Both work on x and y differences of
//! the frame, weighted by inverse variance, so that a wrong mean level does not matter.

use super::Tsf;
use super::active_set::ActiveSet;
use super::continuous::Evidence;
use super::from_psfs::nominal_focal;
use super::taps::Interpolation;
use crate::fft::{Fft2, Spectrum};
use crate::image::Plane;
use crate::pose::{Pose, PoseGrid, project};
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// One blurred frame and the latent irradiance that should explain it.
pub struct WholeFrame<'a> {
    /// Latent irradiance on the frame's grid plus `pad` pixels on every side.
    pub latent: &'a Plane,
    /// Pad in pixels.
    pub pad: usize,
    /// Irradiance of the blurred frame.
    pub blurred: &'a Plane,
    /// Inverse variance of the frame's pixels, model error included; 0: masked.
    pub weight: &'a Plane,
    /// Motion of the frame as a whole, about which the poses are looked for (see [`Tsf::base`]).
    pub base: DMat3,
}

/// Differences that a search of a grid of poses looks at, from nothing and from a start.
const ROWS: (usize, usize) = (40_000, 14_000);

/// A weighted difference of two neighbouring pixels.
#[derive(Clone, Copy)]
pub(super) struct Row {
    pub x: u32,
    pub y: u32,
    vertical: bool,
    pub weight: f32,
}

impl Row {
    pub fn other(&self) -> (usize, usize) {
        let v = usize::from(self.vertical);
        (self.x as usize + 1 - v, self.y as usize + v)
    }
}

/// `latent` warped by `h` (scene to frame, centred pixels) on the frame's grid plus `margin` pixels on every side.
fn warp(latent: &Plane, pad: usize, size: (usize, usize), margin: usize, h: &DMat3, interpolation: Interpolation) -> Plane {
    let (w, hgt) = (size.0 + 2 * margin, size.1 + 2 * margin);
    let inverse = h.inverse();
    let centre = DVec2::new((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
    let s = interpolation.support() as isize;
    let mut data = vec![0.0f32; w * hgt];
    data.par_chunks_exact_mut(w).enumerate().for_each(|(j, row)| {
        let mut wx = [0.0f32; 6];
        let mut wy = [0.0f32; 6];
        for (i, out) in row.iter_mut().enumerate() {
            let q = DVec2::new(i as f64 - margin as f64, j as f64 - margin as f64) - centre;
            let p = project(&inverse, q) + centre + DVec2::splat(pad as f64);
            let (fx, fy) = (p.x.floor(), p.y.floor());
            for k in 0..2 * s {
                wx[k as usize] = interpolation.weight((k - s + 1) as f64 - (p.x - fx)) as f32;
                wy[k as usize] = interpolation.weight((k - s + 1) as f64 - (p.y - fy)) as f32;
            }
            let mut sum = 0.0;
            for b in 0..2 * s {
                for a in 0..2 * s {
                    sum += wx[a as usize] * wy[b as usize] * latent.clamped(fx as isize + a - s + 1, fy as isize + b - s + 1);
                }
            }
            *out = sum;
        }
    });
    Plane { width: w, height: hgt, data }
}

impl WholeFrame<'_> {
    pub(super) fn size(&self) -> (usize, usize) {
        self.blurred.size()
    }

    /// The `count` differences, at least `margin` pixels from the border, with most noise-weighted structure.
    pub(super) fn rows(&self, count: usize, margin: usize) -> Vec<Row> {
        let (w, h) = self.size();
        let mut rows: Vec<(f32, Row)> = Vec::new();
        let moved = (self.base != DMat3::IDENTITY).then(|| warp(self.latent, self.pad, (w, h), 0, &self.base, Interpolation::Bilinear));
        let latent = |x: usize, y: usize| moved.as_ref().map_or_else(|| self.latent.at(x + self.pad, y + self.pad), |m| m.at(x, y));
        for y in margin..h.saturating_sub(margin) {
            for x in margin..w.saturating_sub(margin) {
                for vertical in [false, true] {
                    let row = Row { x: x as u32, y: y as u32, vertical, weight: 0.0 };
                    let (i, j) = row.other();
                    if i >= w || j >= h {
                        continue;
                    }
                    let (a, b) = (self.weight.at(x, y), self.weight.at(i, j));
                    if a > 0.0 && b > 0.0 {
                        let k = a * b / (a + b);
                        let e = latent(i, j) - latent(x, y);
                        let d = self.blurred.at(i, j) - self.blurred.at(x, y);
                        rows.push((k * (e * e + d * d), Row { weight: k, ..row }));
                    }
                }
            }
        }
        if rows.len() > count {
            rows.select_nth_unstable_by(count, |a, b| b.0.total_cmp(&a.0));
            rows.truncate(count);
        }
        let mut rows: Vec<Row> = rows.into_iter().map(|r| r.1).collect();
        rows.sort_by_key(|r| (r.y, r.x, r.vertical));
        rows
    }

    pub(super) fn targets(&self, rows: &[Row]) -> Vec<f32> {
        rows.iter()
            .map(|r| {
                let (i, j) = r.other();
                r.weight.sqrt() * (self.blurred.at(i, j) - self.blurred.at(r.x as usize, r.y as usize))
            })
            .collect()
    }

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
