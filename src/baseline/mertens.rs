//! Exposure fusion (T. Mertens, J. Kautz and F. Van Reeth, "Exposure Fusion", 2007): a picture from the frames' intensities, without
//! irradiance and without any notion of blur.

use crate::exposure::Bracket;
use crate::image::{Plane, Rgb};

/// Width of the bell of well-exposedness about the middle of the range (the paper's σ).
const SIGMA: f32 = 0.2;

/// Fuses the frames of `bracket` that `frames` (0-based) names; a picture with values 0..=1, to be shown as it is.
///
/// # Panics
/// When `frames` is empty or names a frame that the bracket does not have.
pub fn fuse(bracket: &Bracket, frames: &[usize]) -> Rgb {
    let images: Vec<&Rgb> = frames.iter().map(|&i| &bracket.frames()[i].intensity).collect();
    fuse_images(&images)
}

/// Fuses pictures of one size with values 0..=1: contrast, saturation and well-exposedness with exponent 1 each, blended in Laplacian
/// pyramids down to a single pixel; the result is clamped to 0..=1.
///
/// # Panics
/// When there is no picture, or sizes differ.
pub fn fuse_images(images: &[&Rgb]) -> Rgb {
    let (width, height) = images[0].size();
    let mut weights: Vec<Plane> = images.iter().map(|i| weight(i)).collect();
    for p in 0..width * height {
        let sum: f32 = weights.iter().map(|w| w.data[p]).sum();
        weights.iter_mut().for_each(|w| w.data[p] /= sum);
    }
    let levels = width.min(height).max(1).ilog2() as usize;
    let mut blended: Vec<Rgb> = Vec::new();
    for (image, weight) in images.iter().zip(weights) {
        let weights = gaussian(weight, levels);
        for c in 0..3 {
            let steps = gaussian(image.0[c].clone(), levels);
            for (l, w) in weights.iter().enumerate() {
                let detail = match steps.get(l + 1) {
                    Some(coarse) => steps[l].zip(&enlarged(coarse, steps[l].size()), |a, b| a - b),
                    None => steps[l].clone(),
                };
                if blended.len() <= l {
                    blended.push(Rgb::filled(w.width, w.height, 0.0));
                }
                for ((out, d), w) in blended[l].0[c].data.iter_mut().zip(&detail.data).zip(&w.data) {
                    *out += d * w;
                }
            }
        }
    }
    let mut result = blended.pop().expect("one level at least");
    while let Some(fine) = blended.pop() {
        let size = fine.size();
        result = Rgb(std::array::from_fn(|c| fine.0[c].zip(&enlarged(&result.0[c], size), |a, b| a + b)));
    }
    result.map_planes(|p| p.map(|v| v.clamp(0.0, 1.0)))
}

/// How well each pixel is recorded: contrast times saturation times well-exposedness, never quite zero.
fn weight(image: &Rgb) -> Plane {
    let (width, height) = image.size();
    let [r, g, b] = &image.0;
    let grey = Plane::from_fn(width, height, |x, y| 0.299 * r.at(x, y) + 0.587 * g.at(x, y) + 0.114 * b.at(x, y));
    Plane::from_fn(width, height, |x, y| {
        let (i, j) = (x as isize, y as isize);
        let around = |dx, dy| mirrored(&grey, i + dx, j + dy);
        let contrast = (around(1, 0) + around(-1, 0) + around(0, 1) + around(0, -1) - 4.0 * grey.at(x, y)).abs();
        let pixel = image.pixel(y * width + x);
        let mean = pixel.iter().sum::<f32>() / 3.0;
        let saturation = pixel.iter().map(|v| (v - mean).powi(2)).sum::<f32>().sqrt();
        let exposed: f32 = pixel.iter().map(|v| (-(v - 0.5).powi(2) / (2.0 * SIGMA * SIGMA)).exp()).product();
        contrast * saturation * exposed + 1e-12
    })
}

/// Value at (x, y), mirrored beyond the border without repeating the edge pixel.
fn mirrored(p: &Plane, x: isize, y: isize) -> f32 {
    let inside = |i: isize, n: usize| {
        let last = n as isize - 1;
        let i = i.abs();
        (if i > last { 2 * last - i } else { i }).clamp(0, last)
    };
    p.at(inside(x, p.width) as usize, inside(y, p.height) as usize)
}

/// Weights of the pyramid's filter (P. Burt and E. Adelson, 1983, a = 3/8).
const TAPS: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];

/// The plane and `levels` ever coarser ones, each half the size (rounded up) of the one before.
fn gaussian(plane: Plane, levels: usize) -> Vec<Plane> {
    let mut out = vec![plane];
    for _ in 0..levels {
        let fine = &out[out.len() - 1];
        let rows = Plane::from_fn(fine.width.div_ceil(2), fine.height, |x, y| {
            (0..5).map(|k| TAPS[k] * mirrored(fine, 2 * x as isize + k as isize - 2, y as isize)).sum()
        });
        let coarse = Plane::from_fn(rows.width, fine.height.div_ceil(2), |x, y| {
            (0..5).map(|k| TAPS[k] * mirrored(&rows, x as isize, 2 * y as isize + k as isize - 2)).sum()
        });
        out.push(coarse);
    }
    out
}

/// `coarse` enlarged to `size`: its pixels are put on every second place and the gaps filled by the pyramid's filter.
fn enlarged(coarse: &Plane, (width, height): (usize, usize)) -> Plane {
    // Of the five taps those at places that hold a pixel: three at even places, two between. Beyond the border the last pixel repeats.
    let pass = |at: &dyn Fn(isize) -> f32, i: usize| {
        let k = (i / 2) as isize;
        if i.is_multiple_of(2) { (at(k - 1) + 6.0 * at(k) + at(k + 1)) / 8.0 } else { (at(k) + at(k + 1)) / 2.0 }
    };
    let last = |n: usize| move |i: isize| i.abs().min(n as isize - 1).max(0) as usize;
    let (in_x, in_y) = (last(coarse.width), last(coarse.height));
    let rows = Plane::from_fn(width, coarse.height, |x, y| pass(&|i| coarse.at(in_x(i), y), x));
    Plane::from_fn(width, height, |x, y| pass(&|i| rows.at(x, in_y(i)), y))
}
