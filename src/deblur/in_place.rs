//! Displaced sharp frames that need no operator: read at the pixels of the latent grid.
//!
//! Behind a lens and a colour mosaic a frame has so little structure as fine as its pixels that an interpolation loses next to nothing of it. Read at the latent grid's pixels, by cubic convolution, it
//! counts as one that lies there, and a bracket of sharp frames is a weighted mean of pixels. Frames that are sharp to the pixel need K instead.

use super::Observation;
use crate::image::{Plane, Rgb};
use crate::kernels::UNSEEN;
use crate::pose::project;
use crate::sampling::{bilinear, split, weights};
use crate::tsf::Tsf;
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Least exposure that is read between pixels, part of white: the interpolation's negative lobes reach -0.28 of an exposure beside black, which may be several times white where a frame's gain is taken off,
/// and what is below -0.5 stands for an unseen channel. No frame shows less than -0.05.
const LEAST: f32 = -0.1;

fn centre((w, h): (usize, usize)) -> DVec2 {
    0.5 * DVec2::new(w as f64 - 1.0, h as f64 - 1.0)
}

impl Observation {
    /// The frame, sharp and at `motion` (frame from latent grid, centred pixels), read at the pixels of a latent grid of its own size. A channel is unseen where one of the sixteen pixels around
    /// does not show it; the mask is the least of the four pixels around, and 0 beyond the frame.
    #[must_use]
    pub fn in_place(self, motion: &DMat3) -> Self {
        let size = self.mask.size();
        let (w, h) = size;
        let mut pixels = vec![[UNSEEN, UNSEEN, UNSEEN, 0.0]; w * h];
        pixels.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                let q = project(motion, DVec2::new(x as f64, y as f64) - centre(size)) + centre(size);
                if q.x < 0.0 || q.y < 0.0 || q.x > w as f64 - 1.0 || q.y > h as f64 - 1.0 {
                    continue;
                }
                let ((i, u), (j, v)) = (split(q.x), split(q.y));
                let (right, below) = (isize::from(u > 0.0), isize::from(v > 0.0));
                let around = [(0, 0), (right, 0), (0, below), (right, below)];
                pixel[3] = around.map(|(a, b)| self.mask.clamped(i + a, j + b)).into_iter().fold(1.0, f32::min);
                let (across, down) = (weights(u), weights(v));
                for (value, plane) in pixel.iter_mut().zip(&self.exposure.0) {
                    let tap = |k: usize| (across[k % 4] * down[k / 4], plane.clamped(i - 1 + (k % 4) as isize, j - 1 + (k / 4) as isize));
                    let taps = (0..16).map(tap).filter(|(weight, _)| *weight != 0.0);
                    let (sum, seen) = taps.fold((0.0, true), |(sum, seen), (weight, e)| (sum + weight * e, seen && e != UNSEEN));
                    *value = if seen { sum.max(LEAST) } else { UNSEEN };
                }
            }
        });
        let plane = |c: usize| Plane { width: w, height: h, data: pixels.iter().map(|v| v[c]).collect() };
        Self { exposure: Rgb([plane(0), plane(1), plane(2)]), mask: plane(3), tsf: Tsf::identity(), ..self }
    }
}

/// `plane`, on the latent grid, at the pixels of a frame of that size at `motion` (frame from latent grid, centred pixels): bilinear, the nearest pixel's beyond.
pub fn on_own_pixels(plane: &Plane, motion: &DMat3) -> Plane {
    let (size, back) = (plane.size(), motion.inverse());
    Plane::from_rows(size.0, size.1, |y, out| {
        for (x, v) in out.iter_mut().enumerate() {
            *v = bilinear(plane, project(&back, DVec2::new(x as f64, y as f64) - centre(size)) + centre(size));
        }
    })
}
