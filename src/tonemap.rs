//! Irradiance to display: for eyes, never feeds a stage.
//!
//! Contrast of large areas is compressed and detail is kept (F. Durand and J. Dorsey, "Fast Bilateral Filtering for the Display
//! of High-Dynamic-Range Images", 2002), with the bilateral filter on a coarse grid of position and log luminance (S. Paris and
//! F. Durand, "A Fast Approximation of the Bilateral Filter", 2006); then a shoulder (E. Reinhard et al., "Photographic Tone
//! Reproduction for Digital Images", 2002, eq. 4) and the sRGB curve.

mod fattal;
mod filter;
mod operator;

pub use operator::{Curve, Light, Operator};

use crate::image::{Plane, Rgb};
use rayon::prelude::*;

/// Luminance of the middle of the picture, white being 1.
const KEY: f32 = 0.18;
/// Decades that large areas may span after compression.
const DECADES: f32 = 2.1;
/// Width of the bilateral filter in decades: what differs by more is another area.
const RANGE: f32 = 0.35;

/// Exposure and compression, fitted to one image and applicable to others, so that pictures can be compared.
#[derive(Clone, Copy, Debug)]
pub struct ToneMap {
    /// Smallest luminance that counts.
    floor: f32,
    /// Largest luminance that counts.
    ceiling: f32,
    /// log10 luminance that becomes [`KEY`].
    middle: f32,
    /// Slope of the log luminance of large areas, at most 1.
    slope: f32,
    /// Display luminance that becomes white.
    white: f32,
}

/// Picture of `irradiance` (any unit), tone-mapped by itself.
pub fn preview(irradiance: &Rgb) -> image::RgbImage {
    ToneMap::fit(irradiance).apply(irradiance)
}

/// What is a picture already: values 0..=1 as 8-bit codes, without any curve.
pub fn codes(intensity: &Rgb) -> image::RgbImage {
    let (width, height) = intensity.size();
    image::RgbImage::from_fn(width as u32, height as u32, |x, y| {
        image::Rgb(intensity.pixel(y as usize * width + x as usize).map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8))
    })
}

impl ToneMap {
    /// Chooses exposure and compression for `irradiance`.
    pub fn fit(irradiance: &Rgb) -> Self {
        let mut lum: Vec<f32> = luminance(irradiance).data;
        lum.sort_unstable_by(f32::total_cmp);
        let at = |q: f32| lum.get(((lum.len().max(1) - 1) as f32 * q) as usize).copied().unwrap_or(0.0);
        let ceiling = at(1.0).max(1e-30);
        let top = at(0.995).max(1e-6 * ceiling);
        // Six decades below the highlights nothing is told apart from black.
        let floor = (1e-6 * top).max(1e-36);
        let (low, high) = (at(0.02).max(floor).log10(), top.log10());
        let slope = (DECADES / (high - low).max(1e-3)).min(1.0);
        let logs = lum.iter().map(|&v| f64::from(v.max(floor).log10().max(low)));
        let middle = (logs.sum::<f64>() / lum.len().max(1) as f64) as f32;
        let white = (KEY * 10f32.powf(slope * (ceiling.log10().min(high + 1.0) - middle))).max(1.0);
        Self { floor, ceiling, middle, slope, white }
    }

    /// Picture of `irradiance`; values that are not finite or are negative show as black.
    pub fn apply(&self, irradiance: &Rgb) -> image::RgbImage {
        let lum = luminance(irradiance);
        let log = lum.map(|v| v.clamp(self.floor, self.ceiling.max(self.floor)).log10());
        let base = bilateral(&log, (0.02 * lum.width.max(lum.height) as f32).max(4.0), RANGE);
        let (width, height) = lum.size();
        let rows: Vec<u8> = (0..width * height)
            .into_par_iter()
            .flat_map_iter(|i| {
                let target = self.slope * (base.data[i] - self.middle) + (log.data[i] - base.data[i]);
                let l = KEY * 10f32.powf(target.clamp(-12.0, 12.0));
                let l = l * (1.0 + l / (self.white * self.white)) / (1.0 + l) * (1.0 + 1.0 / (self.white * self.white)).recip();
                let l = l * (1.0 + KEY);
                let black = lum.data[i] <= self.floor;
                irradiance.pixel(i).map(|v| {
                    let v = if v.is_finite() && v > 0.0 { v } else { 0.0 };
                    let ratio = (v / lum.data[i].max(self.floor)).min(20.0);
                    // A little less saturation where much was compressed, or colours glow.
                    srgb_code(if black { 0.0 } else { l * ratio.powf(0.6 + 0.4 * self.slope) })
                })
            })
            .collect();
        image::RgbImage::from_raw(width as u32, height as u32, rows).expect("three bytes per pixel")
    }
}

/// Relative luminance (Rec. 709), 0 where it is not a finite positive number.
fn luminance(image: &Rgb) -> Plane {
    let (w, h) = image.size();
    Plane::from_fn(w, h, |x, y| {
        let [r, g, b] = image.pixel(y * w + x).map(|v| if v.is_finite() { v.clamp(0.0, 1e30) } else { 0.0 });
        0.2126 * r + 0.7152 * g + 0.0722 * b
    })
}

fn srgb_code(x: f32) -> u8 {
    let x = x.clamp(0.0, 1.0);
    let z = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
    (z * 255.0).round() as u8
}

/// Bilateral filter of `log` with a Gaussian of `sigma` pixels and `range` in value, on a grid of that spacing.
fn bilateral(log: &Plane, sigma: f32, range: f32) -> Plane {
    let (low, high) = log.data.iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
    if log.data.is_empty() {
        return log.clone();
    }
    let pad = 2;
    let cells = |n: f32, step: f32| (n / step) as usize + 2 + 2 * pad;
    let (nx, ny, nz) = (cells(log.width as f32, sigma), cells(log.height as f32, sigma), cells(high - low, range));
    // (sum of values, count) of each cell; linear in space and value, so that cell borders do not show.
    let mut grid = vec![[0f32; 2]; nx * ny * nz];
    let place = |x: usize, y: usize, v: f32| (x as f32 / sigma + pad as f32, y as f32 / sigma + pad as f32, (v - low) / range + pad as f32);
    for y in 0..log.height {
        for x in 0..log.width {
            let v = log.at(x, y);
            let (gx, gy, gz) = place(x, y, v);
            let cell = ((gz + 0.5) as usize * ny + (gy + 0.5) as usize) * nx + (gx + 0.5) as usize;
            grid[cell][0] += v;
            grid[cell][1] += 1.0;
        }
    }
    for (stride, n) in [(1, nx), (nx, ny), (nx * ny, nz)] {
        let source = grid.clone();
        for (i, cell) in grid.iter_mut().enumerate() {
            let k = i / stride % n;
            *cell = std::array::from_fn(|c| {
                let tap = |d: isize| {
                    let j = k as isize + d;
                    if j < 0 || j >= n as isize { 0.0 } else { source[(i as isize + d * stride as isize) as usize][c] }
                };
                (tap(-2) + 4.0 * tap(-1) + 6.0 * tap(0) + 4.0 * tap(1) + tap(2)) / 16.0
            });
        }
    }
    let slice = |(i, &v): (usize, &f32)| {
        let (gx, gy, gz) = place(i % log.width, i / log.width, v);
        let (x, y, z) = (gx as usize, gy as usize, gz as usize);
        let (a, b, c) = (gx - x as f32, gy - y as f32, gz - z as f32);
        let (mut sum, mut count) = (0.0, 0.0);
        for (dz, wz) in [(0, 1.0 - c), (1, c)] {
            for (dy, wy) in [(0, 1.0 - b), (1, b)] {
                for (dx, wx) in [(0, 1.0 - a), (1, a)] {
                    let cell = grid[((z + dz) * ny + y + dy) * nx + x + dx];
                    sum += wx * wy * wz * cell[0];
                    count += wx * wy * wz * cell[1];
                }
            }
        }
        if count > 1e-12 { sum / count } else { v }
    };
    Plane { width: log.width, height: log.height, data: log.data.par_iter().enumerate().map(slice).collect() }
}
