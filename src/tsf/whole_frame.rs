//! TSF from the whole frame: the blurred frame against the latent irradiance, `B = Σ_k h_k Γ_k E` over all valid pixels.
//!
//! First on a grid of poses ([`super::grid_search`]), then with continuous poses ([`super::continuous`]). Both work on x and y differences of
//! the frame, weighted by inverse variance, so that a wrong mean level does not matter.

use super::taps::Interpolation;
use crate::image::Plane;
use crate::pose::project;
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
    /// Motion of the frame as a whole, about which the poses are looked for (see [`super::Tsf::base`]).
    pub base: DMat3,
}

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
pub(super) fn warp(latent: &Plane, pad: usize, size: (usize, usize), margin: usize, h: &DMat3, interpolation: Interpolation) -> Plane {
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
}
