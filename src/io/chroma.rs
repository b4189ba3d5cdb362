//! Colour of JPEG files that hold it at a lower resolution than brightness (4:2:0, 4:2:2), brought back by the guide of the brightness.
//!
//! Decoders interpolate such colour, and it runs over every edge. Most edges are edges of both: within a few pixels colour is a linear function of brightness
//! (He, Sun & Tang 2013, *Guided image filtering*). Its slope is found where the file tells both, on the coarse grid, and what brightness has between that grid's points is
//! added to the colour with that slope. Where brightness says nothing of colour the slope is 0, and the colour stays as it was decoded.

use crate::image::Plane;
use rayon::prelude::*;
use std::array::from_fn;

/// Rounds in which the interpolation of decoders is undone, to find the colour that the file holds.
const ROUNDS: usize = 2;
/// Variance, in codes², of what JPEG and noise leave of brightness on the coarse grid: less than that tells no slope.
const FAINT: f32 = 16.0;

/// The coarse grid of an image along one side: a point in the middle of each block of pixels.
struct Side {
    /// Pixels of a block.
    block: usize,
    /// Points.
    points: usize,
    /// For each pixel the point at or before it, the next one, and the part that this has in a linear interpolation, as decoders do it.
    between: Vec<(usize, usize, f32)>,
}

impl Side {
    fn new(pixels: usize, block: usize) -> Self {
        let points = pixels.div_ceil(block);
        let place = |i: usize| ((i as f32 + 0.5) / block as f32 - 0.5).clamp(0.0, (points - 1) as f32);
        let between = (0..pixels).map(|i| (place(i) as usize, (place(i) as usize + 1).min(points - 1), place(i).fract())).collect();
        Self { block, points, between }
    }

    /// What the mean over a block of interpolated points has of the point before, its own and the next.
    fn blurred(&self) -> [f32; 3] {
        let part = (0..self.block).map(|i| ((i as f32 + 0.5) / self.block as f32 - 0.5).abs()).sum::<f32>() / (2 * self.block) as f32;
        [part, 1.0 - 2.0 * part, part]
    }
}

/// Mean over each block of brightness and of both colours of `raw`.
fn means(raw: &[u8], across: &Side, down: &Side) -> [Plane; 3] {
    let (width, height) = (across.between.len(), down.between.len());
    let cell = |k: usize| {
        let (left, top) = (k % across.points * across.block, k / across.points * down.block);
        let (right, bottom) = ((left + across.block).min(width), (top + down.block).min(height));
        let mut sum = [0.0; 3];
        for y in top..bottom {
            for pixel in raw[3 * (y * width + left)..3 * (y * width + right)].chunks_exact(3) {
                sum.iter_mut().zip(luma_and_chroma(pixel)).for_each(|(s, v)| *s += v);
            }
        }
        sum.map(|s| s / ((right - left) * (bottom - top)) as f32)
    };
    let cells: Vec<[f32; 3]> = (0..across.points * down.points).into_par_iter().map(cell).collect();
    from_fn(|c| Plane { width: across.points, height: down.points, data: cells.iter().map(|v| v[c]).collect() })
}

/// `plane` under a window of three by three, of these weights across and down, continued by its border.
fn window(plane: &Plane, across: [f32; 3], down: [f32; 3]) -> Plane {
    let (width, height) = plane.size();
    let beside = Plane::from_rows(width, height, |y, out| {
        let row = plane.row(y);
        let [before, own, after] = across;
        for (x, v) in out.iter_mut().enumerate() {
            *v = before * row[x.saturating_sub(1)] + own * row[x] + after * row[(x + 1).min(width - 1)];
        }
    });
    Plane::from_rows(width, height, |y, out| {
        let rows = [y.saturating_sub(1), y, (y + 1).min(height - 1)].map(|j| beside.row(j));
        for (x, v) in out.iter_mut().enumerate() {
            *v = down[0] * rows[0][x] + down[1] * rows[1][x] + down[2] * rows[2][x];
        }
    })
}

/// Slopes of `colours` over `brightness` around each point, by least squares.
fn slopes(brightness: &Plane, colours: &[Plane; 2]) -> [Plane; 2] {
    let mean = |p: &Plane| window(p, [0.25, 0.5, 0.25], [0.25, 0.5, 0.25]);
    let b = mean(brightness);
    let variance = mean(&brightness.map(|b| b * b)).zip(&b, |m, b| (m - b * b).max(0.0) + FAINT);
    colours.each_ref().map(|colour| {
        let products = b.zip(&mean(colour), |b, c| b * c);
        let covariance = mean(&brightness.zip(colour, |b, c| b * c)).zip(&products, |m, p| m - p);
        window(&covariance.zip(&variance, |c, v| c / v), [1.0 / 3.0; 3], [1.0 / 3.0; 3])
    })
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
    // The conversion keeps within 0 and 255.
    [r, g, b].map(|v| (v + 0.5) as u8)
}

/// Brings back the colour of `raw`, red, green and blue codes one pixel after another, of an image of `size` = (width, height) pixels whose file holds one
/// colour for each block of `block` = (across, down) pixels. Brightness stays, but for rounding.
pub fn restore(raw: &mut [u8], size: (usize, usize), block: (usize, usize)) {
    let (across, down) = (Side::new(size.0, block.0), Side::new(size.1, block.1));
    let [brightness, blue, red] = means(raw, &across, &down);
    let held = [blue, red].map(|decoded| {
        // Means of what was interpolated are blurred.
        let mut held = decoded.clone();
        for _ in 0..ROUNDS {
            let again = window(&held, across.blurred(), down.blurred());
            held = held.zip(&decoded.zip(&again, |d, a| d - a), |h, missing| h + missing);
        }
        held
    });
    let slopes = slopes(&brightness, &held);
    let planes = [&brightness, &held[0], &held[1], &slopes[0], &slopes[1]];
    raw.par_chunks_exact_mut(3 * size.0).enumerate().for_each(|(y, row)| {
        let (above, below, part) = down.between[y];
        let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
        let rows = planes.map(|p| p.row(above).iter().zip(p.row(below)).map(|(a, b)| mix(*a, *b, part)).collect::<Vec<f32>>());
        for (pixel, &(left, right, part)) in row.chunks_exact_mut(3).zip(&across.between) {
            let own = luma_and_chroma(pixel)[0];
            let [coarse, blue, red, of_blue, of_red] = rows.each_ref().map(|r| mix(r[left], r[right], part));
            pixel.copy_from_slice(&codes([own, blue + of_blue * (own - coarse), red + of_red * (own - coarse)]));
        }
    });
}
