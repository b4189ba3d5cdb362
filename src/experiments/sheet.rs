//! Pictures of experiments: labelled cells in rows.

use crate::image::Plane;
use crate::synth::font;
use image::{RgbImage, imageops};

/// Space between cells and height of a label's capitals, pixels.
const GAP: u32 = 6;
const LABEL: u32 = 11;

/// Rows of (label, picture), each picture scaled to `cell` pixels of width.
pub(super) fn sheet(rows: &[Vec<(String, RgbImage)>], cell: u32) -> RgbImage {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let high = |(_, p): &(String, RgbImage)| (p.height() * cell).div_ceil(p.width().max(1));
    let heights: Vec<u32> = rows.iter().map(|r| r.iter().map(high).max().unwrap_or(0) + LABEL + 2 * GAP).collect();
    let mut out = RgbImage::from_pixel(columns * (cell + GAP) + GAP, heights.iter().sum::<u32>() + GAP, image::Rgb([24, 24, 26]));
    let mut y = GAP;
    for (row, height) in rows.iter().zip(heights) {
        for (i, entry) in row.iter().enumerate() {
            let x = GAP + i as u32 * (cell + GAP);
            font::write(&mut out, &entry.0, x as f32 + 1.0, y as f32, LABEL as f32);
            let filter = if entry.1.width() * 2 <= cell { imageops::FilterType::Nearest } else { imageops::FilterType::CatmullRom };
            let scaled = imageops::resize(&entry.1, cell, high(entry), filter);
            imageops::replace(&mut out, &scaled, i64::from(x), i64::from(y + LABEL + GAP));
        }
        y += height;
    }
    out
}

/// The part of `picture` whose upper left corner is at these fractions of its size, a quarter as wide and high.
pub(super) fn close_up(picture: &RgbImage, (x, y): (f32, f32)) -> RgbImage {
    let (w, h) = picture.dimensions();
    imageops::crop_imm(picture, (x * w as f32) as u32, (y * h as f32) as u32, w / 4, h / 4).to_image()
}

/// A plane of non-negative values, its largest white.
pub(super) fn grey(plane: &Plane) -> RgbImage {
    let most = plane.data.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    RgbImage::from_fn(plane.width as u32, plane.height as u32, |x, y| {
        // The root shows what is faint as well.
        image::Rgb([((plane.at(x as usize, y as usize).max(0.0) / most).sqrt() * 255.0) as u8; 3])
    })
}

/// Curves over time, red, green and blue, on one scale with zero in the middle.
pub(super) fn graph(curves: &[Vec<f64>]) -> RgbImage {
    const COLOURS: [[u8; 3]; 3] = [[235, 90, 80], [90, 200, 100], [100, 140, 255]];
    let (w, h) = (256u32, 120u32);
    let mut out = RgbImage::from_pixel(w, h, image::Rgb([44, 44, 48]));
    for x in 0..w {
        out.put_pixel(x, h / 2, image::Rgb([110; 3]));
    }
    let most = curves.iter().flatten().fold(1e-9f64, |m, v| m.max(v.abs()));
    for (curve, colour) in curves.iter().zip(COLOURS) {
        let place = |x: u32| {
            let v = curve[(x as usize * curve.len() / w as usize).min(curve.len() - 1)];
            (f64::from(h) * (0.5 - 0.47 * v / most)).clamp(0.0, f64::from(h - 1)) as u32
        };
        for x in 0..w.min(if curve.is_empty() { 0 } else { w }) {
            let (a, b) = (place(x), place(x.saturating_sub(1)));
            for y in a.min(b)..=a.max(b) {
                out.put_pixel(x, y, image::Rgb(colour));
            }
        }
    }
    out
}
