//! Colour of JPEG files that hold it at a lower resolution than brightness (4:2:0, 4:2:2), brought back by the guide of the brightness.
//!
//! Decoders interpolate such colour, and it runs over every edge. Most edges are edges of both: within a few pixels colour is a linear function of brightness
//! (He, Sun & Tang 2013, *Guided image filtering*). Its slope is found where the file tells both, on the coarse grid, and what brightness has between that grid's points is
//! added to the colour with that slope. Where brightness says nothing of colour the slope is 0, and the colour stays as it was decoded.

use crate::image::Plane;
use rayon::prelude::*;
use std::array::from_fn;

/// Rounds in which the interpolation of decoders is undone, to find the colour that the file holds.
const ROUNDS: usize = 3;
/// Variance, in codes², of what JPEG and noise leave of brightness on the coarse grid: less than that tells no slope.
const FAINT: f32 = 16.0;

/// The coarse grid of an image: a point in the middle of each block of pixels.
struct Grid {
    /// Pixels of a block across and down.
    block: (usize, usize),
    /// Points across and down.
    size: (usize, usize),
    /// Pixels of the image across and down.
    image: (usize, usize),
    /// For each column of the image the point at or before it, the next one, and the part that this has.
    columns: Vec<(usize, usize, f32)>,
    rows: Vec<(usize, usize, f32)>,
}

impl Grid {
    fn new(image: (usize, usize), block: (usize, usize)) -> Self {
        let size = (image.0.div_ceil(block.0), image.1.div_ceil(block.1));
        let between = |pixels: usize, block: usize, points: usize| -> Vec<(usize, usize, f32)> {
            let place = |i: usize| ((i as f32 + 0.5) / block as f32 - 0.5).clamp(0.0, (points - 1) as f32);
            (0..pixels).map(|i| (place(i) as usize, (place(i) as usize + 1).min(points - 1), place(i).fract())).collect()
        };
        Self { block, size, image, columns: between(image.0, block.0, size.0), rows: between(image.1, block.1, size.1) }
    }

    /// Mean over each block of the pixels' values.
    fn means(&self, value: impl Fn(usize, usize) -> f32 + Sync) -> Plane {
        let (across, down) = self.block;
        Plane::from_fn(self.size.0, self.size.1, |i, j| {
            let (left, top) = (i * across, j * down);
            let (right, bottom) = ((left + across).min(self.image.0), (top + down).min(self.image.1));
            let sum: f32 = (top..bottom).flat_map(|y| (left..right).map(move |x| (x, y))).map(|(x, y)| value(x, y)).sum();
            sum / ((right - left) * (bottom - top)) as f32
        })
    }

    /// `points` interpolated linearly, as decoders do, at the pixel (x, y).
    fn at(&self, points: &Plane, x: usize, y: usize) -> f32 {
        let ((a, b, t), (c, d, u)) = (self.columns[x], self.rows[y]);
        let row = |j: usize| (1.0 - t) * points.at(a, j) + t * points.at(b, j);
        (1.0 - u) * row(c) + u * row(d)
    }
}

/// `plane` under a window of three by three of these weights, continued by its border.
fn window(plane: &Plane, weights: [f32; 3]) -> Plane {
    let over = |plane: &Plane, (dx, dy): (isize, isize)| {
        Plane::from_fn(plane.width, plane.height, |x, y| {
            let tap = |k: usize| weights[k] * plane.clamped(x as isize + (k as isize - 1) * dx, y as isize + (k as isize - 1) * dy);
            tap(0) + tap(1) + tap(2)
        })
    };
    over(&over(plane, (1, 0)), (0, 1))
}

/// Slope of `colour` over `brightness` around each point, by least squares.
fn slopes(brightness: &Plane, colour: &Plane) -> Plane {
    let mean = |p: &Plane| window(p, [0.25, 0.5, 0.25]);
    let (b, c) = (mean(brightness), mean(colour));
    let covariance = mean(&brightness.zip(colour, |b, c| b * c)).zip(&b.zip(&c, |b, c| b * c), |m, p| m - p);
    let variance = mean(&brightness.map(|b| b * b)).zip(&b, |m, b| m - b * b);
    window(&covariance.zip(&variance, |c, v| c / (v.max(0.0) + FAINT)), [1.0 / 3.0; 3])
}

/// Brightness Y and colours C_B, C_R (both around 0) of a pixel's codes, as in JFIF.
fn luma_and_chroma(pixel: &[u8]) -> [f32; 3] {
    let [r, g, b] = from_fn(|c| f32::from(pixel[c]));
    let y = 0.299 * r + 0.587 * g + 0.114 * b;
    [y, (b - y) / 1.772, (r - y) / 1.402]
}

/// Back from [`luma_and_chroma`].
fn codes([y, blue, red]: [f32; 3]) -> [u8; 3] {
    let (r, b) = (y + 1.402 * red, y + 1.772 * blue);
    let g = (y - 0.299 * r - 0.114 * b) / 0.587;
    [r, g, b].map(|v| v.round().clamp(0.0, 255.0) as u8)
}

/// Brings back the colour of `raw`, red, green and blue codes one pixel after another, of an image of `size` = (width, height) pixels whose file holds one
/// colour for each block of `block` = (across, down) pixels. Brightness stays, but for rounding.
pub fn restore(raw: &mut [u8], size: (usize, usize), block: (usize, usize)) {
    let grid = Grid::new(size, block);
    let decoded = |x: usize, y: usize| luma_and_chroma(&raw[3 * (y * size.0 + x)..]);
    let brightness = grid.means(|x, y| decoded(x, y)[0]);
    let held: [Plane; 2] = from_fn(|k| {
        let mut held = grid.means(|x, y| decoded(x, y)[k + 1]);
        for _ in 0..ROUNDS {
            let missing = grid.means(|x, y| decoded(x, y)[k + 1] - grid.at(&held, x, y));
            held = held.zip(&missing, |h, m| h + m);
        }
        held
    });
    let slopes = held.each_ref().map(|held| slopes(&brightness, held));
    raw.par_chunks_exact_mut(3 * size.0).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let own = luma_and_chroma(pixel)[0];
            let detail = own - grid.at(&brightness, x, y);
            let [blue, red] = from_fn(|k| grid.at(&held[k], x, y) + grid.at(&slopes[k], x, y) * detail);
            pixel.copy_from_slice(&codes([own, blue, red]));
        }
    });
}
