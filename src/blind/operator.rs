//! Blur K of one luminance plane and its exact adjoint Kᵀ on the CPU: `frame(q) = Σ_taps weight · (Warp_base E)(q - shift)`.
//!
//! The joint estimate applies K some thousand times to single planes that change their TSF after every few applications; there a
//! few rows of multiply-adds are through before a GPU has compiled, uploaded and waited.
//!
//! Its warps are cubic, as the TSFs' fits are. Bilinear warps blur by themselves: the luminance then makes up for it by edges too steep, the
//! fit of the TSFs against that luminance by wider ones, and the two drive each other on, round by round.

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
        let set = TapSet::shifted(tsf, width, height, Interpolation::Bicubic);
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
        let lw = self.latent().0;
        let warped: Vec<Vec<f32>> = self
            .bases
            .iter()
            .map(|base| {
                let wide = w + 2 * base.margin;
                let mut warped = vec![0.0f32; wide * (h + 2 * base.margin)];
                warped.par_chunks_exact_mut(wide).enumerate().for_each(|(j, row)| {
                    self.walk(base, j, |i, at, wx, wy| {
                        let along = |k: usize| {
                            let v = &latent[at + k * lw..][..4];
                            wx[0] * v[0] + wx[1] * v[1] + wx[2] * v[2] + wx[3] * v[3]
                        };
                        row[i] = wy[0] * along(0) + wy[1] * along(1) + wy[2] * along(2) + wy[3] * along(3);
                    });
                });
                warped
            })
            .collect();
        let mut out = vec![0.0f32; w * h];
        // Row by row: a row stays in the cache while all taps add to it.
        out.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
            for (base, warped) in self.bases.iter().zip(&warped) {
                let m = base.margin as i32;
                for &(dx, dy, weight) in &base.taps {
                    let from = &warped[(y + (m - dy) as usize) * (w + 2 * base.margin) + (m - dx) as usize..][..w];
                    row.iter_mut().zip(from).for_each(|(o, v)| *o += weight * v);
                }
            }
        });
        out
    }

    /// Kᵀ `frame`, on the latent grid.
    pub fn adjoint(&self, frame: &[f32]) -> Vec<f32> {
        let (w, h) = self.frame;
        let lw = self.latent().0;
        let n = lw * self.latent().1;
        self.bases
            .par_iter()
            .map(|base| {
                let m = base.margin;
                let wide = w + 2 * m;
                let mut warped = vec![0.0f32; wide * (h + 2 * m)];
                warped.par_chunks_exact_mut(wide).enumerate().for_each(|(j, to)| {
                    for &(dx, dy, weight) in &base.taps {
                        let (ox, y) = ((m as i32 - dx) as usize, j as i32 - (m as i32 - dy));
                        if y >= 0 && y < h as i32 {
                            let row = &frame[y as usize * w..][..w];
                            to[ox..ox + w].iter_mut().zip(row).for_each(|(o, v)| *o += weight * v);
                        }
                    }
                });
                let mut out = vec![0.0f32; n];
                for (j, row) in warped.chunks_exact(wide).enumerate() {
                    self.walk(base, j, |i, at, wx, wy| {
                        for (k, share) in wy.iter().enumerate() {
                            let v = share * row[i];
                            out[at + k * lw..][..4].iter_mut().zip(wx).for_each(|(o, x)| *o += x * v);
                        }
                    });
                }
                out
            })
            .reduce(|| vec![0.0; n], add)
    }

    /// Calls `f(i, index, weights along x, along y)` for the pixels of row `j` of a base's array whose 4 x 4 neighbours, the first of which is
    /// at `index`, the latent grid holds.
    #[inline]
    fn walk(&self, base: &Base, j: usize, mut f: impl FnMut(usize, usize, [f32; 4], [f32; 4])) {
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
            if x < 1.0 || y < 1.0 || x + 2.0 >= lw as f64 || y + 2.0 >= lh as f64 {
                continue;
            }
            f(i, (y as usize - 1) * lw + x as usize - 1, cubic((p.x - x) as f32), cubic((p.y - y) as f32));
        }
    }

    /// Pixels of the frame that see nothing beyond the latent grid. The sum of the weights does not tell: cubic ones have both signs.
    pub fn inside(&self) -> Vec<bool> {
        let (w, h) = self.frame;
        let mut inside = vec![true; w * h];
        for base in &self.bases {
            let (m, wide) = (base.margin as i32, w + 2 * base.margin);
            let mut seen = vec![false; wide * (h + 2 * base.margin)];
            for (j, row) in seen.chunks_exact_mut(wide).enumerate() {
                self.walk(base, j, |i, _, _, _| row[i] = true);
            }
            inside.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
                for &(dx, dy, _) in &base.taps {
                    let from = &seen[(y + (m - dy) as usize) * wide + (m - dx) as usize..][..w];
                    row.iter_mut().zip(from).for_each(|(o, v)| *o &= v);
                }
            });
        }
        inside
    }

    /// [`Operator::forward`] of a plane.
    pub fn blur(&self, latent: &Plane) -> Plane {
        Plane { width: self.frame.0, height: self.frame.1, data: self.forward(&latent.data) }
    }
}

/// Weights of cubic convolution (Keys 1981, a = -1/2) at fraction `t`.
#[inline]
fn cubic(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t3 + 2.0 * t2 - t), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (-3.0 * t3 + 4.0 * t2 + t), 0.5 * (t3 - t2)]
}

fn add(mut a: Vec<f32>, b: Vec<f32>) -> Vec<f32> {
    a.iter_mut().zip(&b).for_each(|(x, y)| *x += y);
    a
}
