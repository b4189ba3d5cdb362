//! Noise of a frame's blocks by what another frame of the same scene leaves of them.
//!
//! Both frames show the texture, and each has its own noise. Within a block of means of squares of pixels the frame is
//! a linear function of the other one's squares around the same place: gain, black, a displacement by part of a square,
//! sharpening and blur are all such functions. What least squares leave is the frame's noise, some of the other's, and
//! texture that the other does not show: never less than the frame's noise.

use super::{BLACK, COARSE, MIDDLE, Sample, is_clear};
use crate::exposure::Frame;
use crate::image::Rgb;
use crate::pose::project;
use glam::{DMat3, DVec2};
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;
use std::ops::Range;

/// Unknowns of a block: 3 x 3 squares of the other frame, a constant and slopes along x and y.
const UNKNOWNS: usize = 12;
/// Blocks of one channel that are looked at, about: bins have a few hundred each. With as many, six pairs of frames of
/// a megapixel take 2.8 s.
const ENOUGH: usize = 6_000;
/// Added to the diagonal of the normal equations of unit regressors: what the other frame shows nothing of stays 0.
const RIDGE: f64 = 1e-9;
/// Quantile of blocks that is taken for noise alone: higher than that of a frame by itself, as less texture is left.
pub(super) const FLATTEST: f64 = 0.2;
/// Pixels along a square, squares along a block, and the quantile [`FLATTEST`] of the mean square of its residuals over
/// its expectation, for white noise: that of χ² over its degrees of freedom, (squares of a block) - [`UNKNOWNS`].
pub(super) const BLOCKS: [(usize, usize, f64); 3] = [(1, 12, 0.895), (MIDDLE, 8, 0.835), (COARSE, 6, 0.753)];

/// A frame and its exposures.
#[derive(Clone, Copy)]
pub(super) struct Shown<'a> {
    pub frame: &'a Frame,
    pub exposure: &'a Rgb,
}

impl Shown<'_> {
    /// Mean of `channels` over the square of `side` pixels whose first is (x, y).
    fn mean(&self, channels: &Range<usize>, side: usize, x: usize, y: usize) -> f64 {
        let mut sum = 0.0;
        for plane in &self.exposure.0[channels.clone()] {
            for j in y..y + side {
                sum += plane.data[j * plane.width + x..][..side].iter().map(|v| f64::from(*v)).sum::<f64>();
            }
        }
        sum / (channels.len() * side * side) as f64
    }

    /// Pixels of the rectangle of `w` x `h` pixels whose first is (x, y) in which `test` holds for all of `channels`.
    fn count(&self, channels: &Range<usize>, (x, y): (usize, usize), (w, h): (usize, usize), test: impl Fn(f32) -> bool) -> usize {
        let planes = &self.frame.intensity.0[channels.clone()];
        (y..y + h).map(|j| (x..x + w).filter(|i| planes.iter().all(|p| test(p.data[j * p.width + i]))).count()).sum()
    }
}

/// Variance, as a density, of the blocks of `of` that `other`, at `motion` from it (centred pixels), shows as well and
/// that no clipping touches; `channels`: those whose mean is looked at; `side`, `block`: as in [`BLOCKS`].
pub(super) fn blocks(
    of: &Shown,
    other: &Shown,
    motion: &DMat3,
    channels: &Range<usize>,
    (side, block): (usize, usize),
    quantum: &(impl Fn(f64) -> f64 + Sync),
) -> Vec<Sample> {
    let (w, h) = of.exposure.size();
    let pixels = side * block;
    if w < pixels || h < pixels {
        return Vec::new();
    }
    let step = (pixels / 2) * (4 * w * h / (pixels * pixels)).div_ceil(ENOUGH).isqrt().max(1);
    let centre = 0.5 * DVec2::new(w as f64 - 1.0, h as f64 - 1.0);
    let one = |x: usize, y: usize| -> Option<Sample> {
        let middle = DVec2::new(x as f64, y as f64) + 0.5 * (pixels as f64 - 1.0);
        // Where the first square of those around the block lies in the other frame.
        let there = (project(motion, middle - centre) + centre - 0.5 * (pixels as f64 - 1.0) - side as f64).round();
        let around = pixels + 2 * side;
        if there.x < 0.0 || there.y < 0.0 || there.x as usize + around > w || there.y as usize + around > h {
            return None;
        }
        let (i, j) = (there.x as usize, there.y as usize);
        let all = pixels * pixels;
        let black = of.count(channels, (x, y), (pixels, pixels), |z| z <= 0.0);
        if black as f64 > BLACK * all as f64
            || of.count(channels, (x, y), (pixels, pixels), is_clear) < all
            || other.count(channels, (i, j), (around, around), is_clear) < around * around
        {
            return None;
        }
        let wide = block + 2;
        let shown: Vec<f64> = (0..wide * wide).map(|k| other.mean(channels, side, i + k % wide * side, j + k / wide * side)).collect();
        let own: Vec<f64> = (0..block * block).map(|k| of.mean(channels, side, x + k % block * side, y + k / block * side)).collect();
        let exposure = own.iter().sum::<f64>() / own.len() as f64;
        let variance = residual(&own, &shown, block)?;
        Some(Sample { exposure, variance: ((side * side) as f64 * variance - quantum(exposure)).max(0.0), blocks: 1.0 })
    };
    let (rows, columns) = ((h - pixels) / step + 1, (w - pixels) / step + 1);
    (0..rows).into_par_iter().flat_map_iter(|r| (0..columns).filter_map(move |c| one(c * step, r * step))).collect()
}

/// Mean square of what least squares leave of `own`, a block of `block` x `block` values, by the values around each of `shown`, which has one more on every side.
fn residual(own: &[f64], shown: &[f64], block: usize) -> Option<f64> {
    let wide = block + 2;
    let mean = shown.iter().sum::<f64>() / shown.len() as f64;
    let spread = (shown.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / shown.len() as f64).sqrt().max(f64::MIN_POSITIVE);
    let row = |k: usize| -> SVector<f64, UNKNOWNS> {
        let (x, y) = (k % block, k / block);
        let place = |a: usize| (2 * a + 1) as f64 / block as f64 - 1.0;
        SVector::from_fn(|u, _| match u {
            0..9 => (shown[(y + u / 3) * wide + x + u % 3] - mean) / spread,
            9 => 1.0,
            10 => place(x),
            _ => place(y),
        })
    };
    let (mut a, mut b) = (SMatrix::<f64, UNKNOWNS, UNKNOWNS>::identity() * (RIDGE * own.len() as f64), SVector::<f64, UNKNOWNS>::zeros());
    let scale = own.iter().map(|v| v * v).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
    for (k, v) in own.iter().enumerate() {
        let r = row(k);
        a += r * r.transpose();
        b += r * (v / scale);
    }
    let found = a.cholesky()?.solve(&b);
    let left: f64 = own.iter().enumerate().map(|(k, v)| (v / scale - row(k).dot(&found)).powi(2)).sum();
    Some(left * scale * scale / (own.len() - UNKNOWNS) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// So many numbers of mean 0 and variance 1.
    fn normal(random: &mut Random, n: usize) -> Vec<f64> {
        (0..n).map(|_| random.normal()).collect()
    }

    #[test]
    fn quantiles_of_blocks_are_those_of_white_noise() {
        for (side, block, of_noise) in BLOCKS {
            let mut random = Random::new(7, side as u64);
            let mut draw = |n: usize| normal(&mut random, n);
            let count = 3000;
            let one = |_| residual(&draw(block * block), &draw((block + 2) * (block + 2)), block).unwrap();
            let mut found: Vec<f64> = (0..count).map(one).collect();
            found.sort_by(f64::total_cmp);
            let (mean, quantile) = (found.iter().sum::<f64>() / count as f64, found[(FLATTEST * count as f64) as usize]);
            println!("squares of {side}: mean {mean:.3}, quantile {quantile:.3} for {of_noise}");
            assert!((mean - 1.0).abs() < 0.02 && (quantile - of_noise).abs() < 0.02, "{mean} and {quantile}");
        }
    }

    #[test]
    fn what_the_other_frame_shows_is_gone_and_a_flat_one_takes_nothing_off() {
        let (block, wide) = (6, 8);
        let shown = normal(&mut Random::new(7, 0), wide * wide);
        let at = |k: usize, dx: usize, dy: usize| shown[(k / block + dy) * wide + k % block + dx];
        let own = |k: usize| 0.3 + 1.4 * at(k, 1, 1) - 0.6 * at(k, 2, 0) + 0.1 * (k % block) as f64;
        let own: Vec<f64> = (0..block * block).map(own).collect();
        assert!(residual(&own, &shown, block).unwrap() < 1e-9);
        let left = residual(&own, &vec![0.5; wide * wide], block).unwrap();
        assert!(left > 1.0 && left.is_finite(), "{left}");
    }
}
