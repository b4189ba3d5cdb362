//! Blur K of one luminance plane and its exact adjoint Kᵀ on the CPU: `frame(q) = Σ_taps weight · (Warp_base E)(q - shift)`.
//!
//! The joint estimate applies K some thousand times to single planes that change their TSF after every few applications; there a
//! few rows of multiply-adds are through before a GPU has compiled, uploaded and waited.

use crate::image::Plane;
use crate::pose::project;
use crate::tsf::{Interpolation, TapSet, Tsf};
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// K of one TSF between a latent grid (frame plus `pad` pixels on every side) and a frame.
pub struct Operator {
    frame: (usize, usize),
    pad: usize,
    bases: Vec<Base>,
    energy: f32,
}

/// One warp and its shifts, the warp's array reaching `margin` pixels beyond the frame.
struct Base {
    inverse: DMat3,
    margin: usize,
    taps: Vec<(i32, i32, f32)>,
}

impl Operator {
    /// K of `tsf` for frames of `width` x `height` pixels and a latent grid that is larger by `pad` on every side.
    pub fn new(tsf: &Tsf, width: usize, height: usize, pad: usize) -> Self {
        let set = TapSet::shifted(tsf, width, height, Interpolation::Bilinear);
        let energy = set.energy() as f32;
        let bases = set
            .bases
            .iter()
            .enumerate()
            .filter_map(|(b, h)| {
                let taps: Vec<(i32, i32, f32)> = set.taps.iter().filter(|t| t.base == b).map(|t| (t.dx, t.dy, t.weight as f32)).collect();
                let margin = taps.iter().map(|t| t.0.unsigned_abs().max(t.1.unsigned_abs())).max()? as usize;
                Some(Base { inverse: h.inverse(), margin, taps })
            })
            .collect();
        Self { frame: (width, height), pad, bases, energy }
    }

    /// Sum of the squared weights of the blur at the frame's centre: the scale of KᵀK's diagonal.
    pub fn energy(&self) -> f32 {
        self.energy
    }

    /// (width, height) of the latent grid.
    pub fn latent(&self) -> (usize, usize) {
        (self.frame.0 + 2 * self.pad, self.frame.1 + 2 * self.pad)
    }

    /// K `latent`, on the frame's grid. What lies beyond the latent grid counts as 0.
    pub fn forward(&self, latent: &[f32]) -> Vec<f32> {
        let (w, h) = self.frame;
        self.bases
            .par_iter()
            .map(|base| {
                let m = base.margin;
                let wide = w + 2 * m;
                let mut warped = vec![0.0f32; wide * (h + 2 * m)];
                for (j, row) in warped.chunks_exact_mut(wide).enumerate() {
                    self.walk(base, j, |i, at, f| {
                        row[i] = f[0] * latent[at[0]] + f[1] * latent[at[1]] + f[2] * latent[at[2]] + f[3] * latent[at[3]];
                    });
                }
                let mut out = vec![0.0f32; w * h];
                for &(dx, dy, weight) in &base.taps {
                    let (ox, oy) = ((m as i32 - dx) as usize, (m as i32 - dy) as usize);
                    for (y, row) in out.chunks_exact_mut(w).enumerate() {
                        let from = &warped[(y + oy) * wide + ox..][..w];
                        row.iter_mut().zip(from).for_each(|(o, v)| *o += weight * v);
                    }
                }
                out
            })
            .reduce(|| vec![0.0; w * h], add)
    }

    /// Kᵀ `frame`, on the latent grid.
    pub fn adjoint(&self, frame: &[f32]) -> Vec<f32> {
        let (w, h) = self.frame;
        let n = self.latent().0 * self.latent().1;
        self.bases
            .par_iter()
            .map(|base| {
                let m = base.margin;
                let wide = w + 2 * m;
                let mut warped = vec![0.0f32; wide * (h + 2 * m)];
                for &(dx, dy, weight) in &base.taps {
                    let (ox, oy) = ((m as i32 - dx) as usize, (m as i32 - dy) as usize);
                    for (y, row) in frame.chunks_exact(w).enumerate() {
                        let to = &mut warped[(y + oy) * wide + ox..][..w];
                        to.iter_mut().zip(row).for_each(|(o, v)| *o += weight * v);
                    }
                }
                let mut out = vec![0.0f32; n];
                for (j, row) in warped.chunks_exact(wide).enumerate() {
                    self.walk(base, j, |i, at, f| {
                        for (a, share) in at.iter().zip(f) {
                            out[*a] += share * row[i];
                        }
                    });
                }
                out
            })
            .reduce(|| vec![0.0; n], add)
    }

    /// Calls `f(i, indices, weights)` for the pixels of row `j` of a base's array whose bilinear neighbours the latent grid holds.
    #[inline]
    fn walk(&self, base: &Base, j: usize, mut f: impl FnMut(usize, [usize; 4], [f32; 4])) {
        let (w, h) = self.frame;
        let (lw, lh) = self.latent();
        let centre = DVec2::new((w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0);
        let shift = centre + DVec2::splat(self.pad as f64);
        let affine = base.inverse.x_axis.z == 0.0 && base.inverse.y_axis.z == 0.0;
        let q = |i: usize| DVec2::new(i as f64, j as f64) - DVec2::splat(base.margin as f64) - centre;
        let (first, step) = (project(&base.inverse, q(0)) + shift, DVec2::new(base.inverse.x_axis.x, base.inverse.x_axis.y));
        for i in 0..w + 2 * base.margin {
            let p = if affine { first + i as f64 * step } else { project(&base.inverse, q(i)) + shift };
            let (x, y) = (p.x.floor(), p.y.floor());
            let (fx, fy) = ((p.x - x) as f32, (p.y - y) as f32);
            // On the last row or column the neighbour beyond has no weight.
            if x < 0.0 || y < 0.0 || x >= lw as f64 || y >= lh as f64 {
                continue;
            }
            let (x, y) = (x as usize, y as usize);
            if (x + 1 == lw && fx > 0.0) || (y + 1 == lh && fy > 0.0) {
                continue;
            }
            let at = y * lw + x;
            let (right, down) = (usize::from(x + 1 < lw), if y + 1 < lh { lw } else { 0 });
            let (gx, gy) = (1.0 - fx, 1.0 - fy);
            f(i, [at, at + right, at + down, at + down + right], [gx * gy, fx * gy, gx * fy, fx * fy]);
        }
    }

    /// Pixels of the frame that see nothing beyond the latent grid.
    pub fn inside(&self) -> Vec<bool> {
        self.forward(&vec![1.0; self.latent().0 * self.latent().1]).iter().map(|v| (v - 1.0).abs() < 1e-3).collect()
    }

    /// [`Operator::forward`] of a plane.
    pub fn blur(&self, latent: &Plane) -> Plane {
        Plane { width: self.frame.0, height: self.frame.1, data: self.forward(&latent.data) }
    }
}

fn add(mut a: Vec<f32>, b: Vec<f32>) -> Vec<f32> {
    a.iter_mut().zip(&b).for_each(|(x, y)| *x += y);
    a
}
