//! Scenes drawn by the program, or made of a linear photograph: radiance on a grid finer than the frame's, with content round it.

mod canvas;
mod chart;
mod foliage;
mod lamps;
mod room;
mod window;

use crate::error::{Error, Result};
use crate::image::{Plane, Rgb};
use rayon::prelude::*;

/// Linear radiance on a grid finer than the frame's, with real content round the frame.
pub struct Scene {
    /// `n (width + 2 margin)` x `n (height + 2 margin)` samples, n being `oversampling`; samples n k to n k + n - 1 make pixel
    /// `k - margin` of the frame.
    pub samples: Rgb,
    /// Pixels of content beyond each side of the frame.
    pub margin: usize,
    /// Samples per pixel and direction, 1 or more.
    pub oversampling: usize,
}

/// The scenes that the program draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drawn {
    /// A room at night: lamp, window, books, eye chart, plant.
    Room,
    /// A chart of text, star and gratings, half in lamplight and half in shadow.
    Chart,
    /// Lamps, a sign and a screen in a dark room.
    Lamps,
    /// Leaves before a bright sky, deep shade behind.
    Foliage,
    /// A sunlit window in a dark wall.
    Window,
}

impl Drawn {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Room, Self::Chart, Self::Lamps, Self::Foliage, Self::Window];

    /// The word that names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Room => "room",
            Self::Chart => "chart",
            Self::Lamps => "lamps",
            Self::Foliage => "foliage",
            Self::Window => "window",
        }
    }

    /// The scene called `name`.
    ///
    /// # Errors
    /// [`Error::Input`] with the names there are.
    pub fn named(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|s| s.name() == name).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|s| s.name()).collect();
            Error::Input(format!("there is no scene {name:?}; choose one of {}", names.join(", ")))
        })
    }

    /// The scene for frames of `width` x `height` pixels with `margin` pixels more on every side and `oversampling` samples per pixel and
    /// direction. Deterministic in `seed`, on every machine.
    pub fn draw(self, width: usize, height: usize, margin: usize, oversampling: usize, seed: u64) -> Scene {
        let draw = match self {
            Self::Room => room::room,
            Self::Chart => chart::chart,
            Self::Lamps => lamps::lamps,
            Self::Foliage => foliage::foliage,
            Self::Window => window::window,
        };
        draw(width, height, margin, oversampling.max(1), seed)
    }
}

/// The room, for frames of `width` x `height` pixels with `margin` pixels more on every side. Deterministic in `seed`.
pub fn room(width: usize, height: usize, margin: usize, seed: u64) -> Scene {
    Drawn::Room.draw(width, height, margin, 2, seed)
}

impl Scene {
    /// Size of the frame, without margin: (width, height) in pixels.
    pub fn frame_size(&self) -> (usize, usize) {
        let (w, h) = self.samples.size();
        (w / self.oversampling - 2 * self.margin, h / self.oversampling - 2 * self.margin)
    }

    /// A scene from a linear photograph, for frames `width` pixels wide (`None`: as wide as the photograph allows at `oversampling`
    /// samples per pixel) with `margin` pixels of it left on every side. Larger photographs are reduced by area; values below a third of
    /// the 0.5th percentile are raised to it, since no scene is black.
    ///
    /// # Errors
    /// [`Error::Input`] for a photograph that is too small, or that holds negative or non-finite values or nothing but black.
    pub fn photograph(image: &Rgb, width: Option<usize>, margin: usize, oversampling: usize) -> Result<Self> {
        let n = oversampling.max(1);
        let (w, h) = image.size();
        if image.0.iter().any(|p| p.data.iter().any(|v| !v.is_finite() || *v < 0.0)) {
            return Err(Error::Input("the scene holds values that are negative or not finite".into()));
        }
        let largest = (w / n).saturating_sub(2 * margin);
        let width = width.unwrap_or(largest);
        if width < 16 || width > largest {
            return Err(Error::Input(format!(
                "a scene {w} pixels wide gives frames of 16 to {largest} pixels at {n} samples per pixel with a margin of {margin}; choose such a width, a smaller margin or a larger scene"
            )));
        }
        let factor = (n * (width + 2 * margin)) as f64 / w as f64;
        let rows = ((h as f64 * factor) as usize / n * n).max(n);
        if rows / n < 2 * margin + 16 {
            return Err(Error::Input(format!(
                "a scene of {w} x {h} pixels is too flat for frames {width} pixels wide with a margin of {margin}; choose a smaller margin"
            )));
        }
        let size = (n * (width + 2 * margin), rows);
        let mut lum: Vec<f32> = image.mean().data.into_iter().filter(|v| *v > 0.0).collect();
        if lum.is_empty() {
            return Err(Error::Input("the scene is black".into()));
        }
        let at = lum.len() / 200;
        let floor = 0.3 * *lum.select_nth_unstable_by(at, f32::total_cmp).1;
        let samples = image.map_planes(|p| by_area(&p.map(|v| v.max(floor)), size, factor));
        Ok(Self { samples, margin, oversampling: n })
    }
}

/// `plane` scaled by `factor` (at most 1) to `size`: each new pixel is the mean over the area that it covers.
fn by_area(plane: &Plane, (width, height): (usize, usize), factor: f64) -> Plane {
    // Old pixels and weights of each new one, in one direction.
    let spans = |n: usize, old: usize| -> Vec<Vec<(usize, f32)>> {
        (0..n)
            .map(|i| {
                let (a, b) = (i as f64 / factor, ((i + 1) as f64 / factor).min(old as f64));
                let first = (a as usize).min(old - 1);
                let parts = (first..old)
                    .take_while(|k| (*k as f64) < b.max(a + 1e-9))
                    .map(|k| (k, (b.min(k as f64 + 1.0) - a.max(k as f64)).max(0.0)));
                let parts: Vec<_> = parts.collect();
                let sum: f64 = parts.iter().map(|p| p.1).sum();
                parts.into_iter().map(|(k, w)| (k, (w / sum.max(1e-12)) as f32)).collect()
            })
            .collect()
    };
    let (columns, lines) = (spans(width, plane.width), spans(height, plane.height));
    let data = lines
        .par_iter()
        .flat_map_iter(|line| {
            let mut row = vec![0f32; plane.width];
            for &(y, w) in line {
                for (r, v) in row.iter_mut().zip(&plane.data[y * plane.width..(y + 1) * plane.width]) {
                    *r += w * v;
                }
            }
            columns.iter().map(move |c| c.iter().map(|&(x, w)| w * row[x]).sum::<f32>()).collect::<Vec<_>>()
        })
        .collect();
    Plane { width, height, data }
}
