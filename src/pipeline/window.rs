//! A part of the frames in place of all of them: what is judged from it takes the same time whatever the frames' size.

use super::engine::Memo;
use super::{Run, Settings};
use crate::error::Result;
use crate::image::Channels;
use crate::mask;
use crate::pose::project;
use crate::register;
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use std::cell::OnceCell;

/// Pixels of the window at most: some 130 of the blocks by which motions are judged, each as wide as the longest blur that the finest size tells.
const PIXELS: f64 = 400_000.0;
/// Side in pixels of the squares by which it is chosen.
const SQUARE: usize = 32;
/// Distance in pixels over which structure is looked at: an engine has smoothed noise over less.
const APART: usize = 2;
/// Relative error that a pixel has besides noise.
const RELATIVE: f64 = 0.05;

/// A rectangle of one size on the latent grid and in each frame.
struct Window {
    size: (usize, usize),
    /// First pixel on the latent grid.
    corner: (usize, usize),
    /// First pixel in each frame.
    corners: Vec<(usize, usize)>,
}

/// From the centre of a frame of the size `of` to that of a part of it.
fn offset(corner: (usize, usize), size: (usize, usize), of: (usize, usize)) -> DVec2 {
    let along = |corner: usize, n: usize, of: usize| corner as f64 + 0.5 * (n as f64 - of as f64);
    DVec2::new(along(corner.0, size.0, of.0), along(corner.1, size.1, of.1))
}

/// Size of the window of frames of this size; `None` where it is the frame, or would be no wider than a square.
fn window_size((w, h): (usize, usize)) -> Option<(usize, usize)> {
    let part = (PIXELS / (w * h) as f64).sqrt();
    let side = |n: usize| (part * n as f64) as usize;
    (part < 1.0 && side(w.min(h)) >= SQUARE).then(|| (side(w), side(h)))
}

/// First square of the rectangle of `size` squares whose sum is largest.
fn richest(values: &[f64], (across, down): (usize, usize), size: (usize, usize)) -> (usize, usize) {
    let row = |x: usize, y: usize| values[y * across + x..][..size.0].iter().sum::<f64>();
    let sum = |(x, y): (usize, usize)| (y..y + size.1).map(|y| row(x, y)).sum::<f64>();
    let places: Vec<(usize, usize)> = (0..=down - size.1).flat_map(|y| (0..=across - size.0).map(move |x| (x, y))).collect();
    let sums: Vec<f64> = places.par_iter().map(|&p| sum(p)).collect();
    (0..places.len()).max_by(|&a, &b| sums[a].total_cmp(&sums[b])).map_or((0, 0), |k| places[k])
}

impl Window {
    /// That of the frames `ids` of `run` that shows most texture.
    fn of(run: &Run, ids: &[usize], size: (usize, usize)) -> Self {
        let (w, h) = run.bracket.size();
        let (across, down) = (w / SQUARE, h / SQUARE);
        let mut told = vec![0.0; across * down];
        let middle = |x: usize, y: usize| SQUARE as f64 * DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - 0.5 * DVec2::new(w as f64, h as f64);
        for &i in ids {
            let texture = run.texture(i);
            for (k, sum) in told.iter_mut().enumerate() {
                let at = (project(&run.motions[i], middle(k % across, k / across)) + 0.5 * DVec2::new(w as f64, h as f64)) / SQUARE as f64;
                let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < across as f64 && at.y < down as f64;
                *sum += if inside { texture[at.y as usize * across + at.x as usize] } else { 0.0 };
            }
        }
        let squares = |n: usize, all: usize| n.div_ceil(SQUARE).min(all);
        let (x, y) = richest(&told, (across, down), (squares(size.0, across), squares(size.1, down)));
        let corner = ((x * SQUARE).min(w - size.0), (y * SQUARE).min(h - size.1));
        let centre = offset(corner, size, (w, h));
        let along = |corner: usize, shift: f64, n: usize, all: usize| (corner as f64 + shift).round().clamp(0.0, (all - n) as f64) as usize;
        let within = |motion: &DMat3| {
            let shift = project(motion, centre) - centre;
            (along(corner.0, shift.x, size.0, w), along(corner.1, shift.y, size.1, h))
        };
        Self { size, corner, corners: run.motions.iter().map(within).collect() }
    }

    /// `motion` of frame `i`, of a bracket whose frames have the size `of`, from the grid's window to the frame's.
    fn motion(&self, i: usize, motion: &DMat3, of: (usize, usize)) -> DMat3 {
        let shift = |corner| DMat3::from_translation(offset(corner, self.size, of));
        register::rebased(&(shift(self.corners[i]).inverse() * *motion), &shift(self.corner), self.size.0, self.size.1)
    }
}

impl Run<'_> {
    /// What `f` finds in the part of the frames `ids` that shows most texture, as it lies in each of them. Nothing else that `f` changes of the run stays.
    pub(super) fn within_window<T>(&mut self, ids: &[usize], f: impl FnOnce(&mut Run) -> Result<T>) -> Result<T> {
        let Some(size) = window_size(self.bracket.size()) else { return f(self) };
        let window = Window::of(self, ids, size);
        let whole = self.bracket.size();
        let bracket = self.bracket.cropped(&window.corners, size);
        let (mut memo, repaired, settings) = (Memo::default(), OnceCell::new(), Settings { patches: Vec::new(), ..self.settings.clone() });
        let mut run = Run {
            stop: self.stop.clone(),
            exposures: self.exposures.iter().zip(&window.corners).map(|(e, c)| e.crop(c.0, c.1, size.0, size.1)).collect(),
            noise: self.noise.clone(),
            curves: self.curves.clone(),
            photometry: self.photometry.clone(),
            exposure_errors: self.exposure_errors.clone(),
            motions: self.motions.iter().enumerate().map(|(i, m)| window.motion(i, m, whole)).collect(),
            registrations: self.registrations.clone(),
            scale: self.scale,
            ..Run::of(self.gpu, self.kernels, &mut memo, &bracket, &repaired, self.response, &settings, &mut *self.events)
        };
        let found = f(&mut run)?;
        self.timings.append(&mut run.timings);
        Ok(found)
    }

    /// How much each square of frame `i`, row by row, shows of structure: the part of its pixels, each counted by how far it is clear of noise.
    fn texture(&self, i: usize) -> Vec<f64> {
        let (frame, noise) = (&self.bracket.frames()[i], self.noise[i].of_detail().luminance);
        let light = self.exposures[i].mean();
        let clipped = mask::clipped(frame, Channels::ALL);
        let (w, h) = light.size();
        let (across, down) = (w / SQUARE, h / SQUARE);
        let clear = |p: usize, q: usize| -> f64 {
            if clipped[p] || clipped[q] {
                return 0.0;
            }
            let (a, b) = (f64::from(light.data[p]), f64::from(light.data[q]));
            let middle = (0.5 * (a + b)).max(0.0);
            let error = 2.0 * noise.variance(middle) + (RELATIVE * middle).powi(2);
            let structure = ((a - b).powi(2) - error).max(0.0);
            structure / (structure + error).max(f64::MIN_POSITIVE)
        };
        let square = |k: usize| -> f64 {
            let (x, y) = (k % across * SQUARE, k / across * SQUARE);
            let pixels = (y..y + SQUARE).step_by(2).flat_map(|j| (x..x + SQUARE).step_by(2).map(move |i| (i, j)));
            let both = |(x, y): (usize, usize)| {
                let p = y * w + x;
                let beside = if x + APART < w { clear(p, p + APART) } else { 0.0 };
                beside + if y + APART < h { clear(p, p + APART * w) } else { 0.0 }
            };
            pixels.map(both).sum()
        };
        (0..across * down).into_par_iter().map(square).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_has_the_shape_of_the_frame_and_a_bounded_size() {
        assert_eq!(window_size((600, 400)), None);
        let (w, h) = window_size((6000, 4000)).unwrap();
        assert!((w * h) as f64 <= PIXELS && (w * h) as f64 > 0.99 * PIXELS && (2 * w).abs_diff(3 * h) <= 3, "{w} x {h}");
        assert_eq!(window_size((100_000, 40)), None, "a strip");
    }

    #[test]
    fn the_richest_rectangle_is_found() {
        let values: Vec<f64> =
            (0..12 * 7).map(|k| if (k % 12, k / 12) == (11, 3) || (k % 12, k / 12) == (9, 2) { 1.0 } else { 0.1 }).collect();
        assert_eq!(richest(&values, (12, 7), (3, 2)), (9, 2));
        assert_eq!(richest(&values, (12, 7), (12, 7)), (0, 0));
    }

    #[test]
    fn a_point_of_the_scene_lies_in_both_windows_where_the_motion_takes_it() {
        let of = (3000, 2000);
        let motion = DMat3::from_translation(DVec2::new(137.3, -42.8)) * DMat3::from_angle(0.01);
        let window = Window { size: (600, 400), corner: (1800, 900), corners: vec![(1931, 870)] };
        let inner = window.motion(0, &motion, of);
        let (grid, frame) = (offset(window.corner, window.size, of), offset(window.corners[0], window.size, of));
        for p in [DVec2::ZERO, DVec2::new(250.0, -120.0)] {
            let expected = project(&motion, p + grid) - frame;
            assert!((project(&inner, p) - expected).length() < 1e-9, "{p}");
        }
        let still = Window { corners: vec![window.corner], ..window };
        assert_eq!(still.motion(0, &DMat3::IDENTITY, of), DMat3::IDENTITY);
    }
}
