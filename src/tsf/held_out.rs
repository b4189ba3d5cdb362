//! How well a blur explains differences of a frame that it was not fitted to.

use super::Tsf;
use super::continuous::Evidence;
use super::whole_frame::{Row, WholeFrame};
use crate::image::Plane;
use nalgebra::{DMatrix, DVector};
use std::collections::BTreeMap;

/// Sides of the blocks that are held out, as a part of the longer side.
const BLOCKS: usize = 14;
/// Radii in pixels of the squares whose means stand for what differs between two pictures that no motion made: edges softened or sharpened by lens, noise reduction and engine, the
/// first two; veiling glare around what is bright, the third.
const RADII: [usize; 3] = [1, 2, 8];
/// Shares that these may have: the first two may sharpen as well, glare takes some per cent of a light at most.
const SHARES: [(f64, f64); 3] = [(-1.0, 1.0), (-1.0, 1.0), (0.0, 0.1)];

/// Gains of a block over the frame's.
const GAINS: (f64, f64) = (0.25, 4.0);

/// Differences of a frame to fit to and, in every fifth block of it, to judge by.
pub(super) struct HeldOut {
    pub inside: Vec<Row>,
    pub outside: Vec<Row>,
    block: usize,
}

impl HeldOut {
    pub fn of(rows: &[Row], size: (usize, usize)) -> Self {
        let block = size.0.max(size.1).div_ceil(BLOCKS);
        let (outside, inside) = rows.iter().partition(|r| (r.x as usize / block * 7 + r.y as usize / block * 13).is_multiple_of(5));
        Self { inside, outside, block }
    }

    /// Two halves, like the fields of a chessboard, each held out once.
    pub fn halves(rows: &[Row], size: (usize, usize)) -> [Self; 2] {
        let block = size.0.max(size.1).div_ceil(BLOCKS);
        let (even, odd): (Vec<Row>, Vec<Row>) = rows.iter().partition(|r| (r.x as usize / block + r.y as usize / block).is_multiple_of(2));
        [Self { inside: even.clone(), outside: odd.clone(), block }, Self { inside: odd, outside: even, block }]
    }

    /// The same where each block has the gain that suits it best, within [`GAINS`]: a wrong camera curve, light that changed and vignetting scale what a part of a frame shows.
    pub fn blocks_with_gains(&self, targets: &[f32], residual: &[f32]) -> Vec<(usize, f64)> {
        let mut products: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
        let rows = || self.outside.iter().zip(targets.iter().zip(residual));
        for (row, (t, r)) in rows() {
            let predicted = f64::from(t - r);
            let sum = products.entry(self.block(row)).or_default();
            *sum = (sum.0 + f64::from(*t) * predicted, sum.1 + predicted * predicted);
        }
        rows()
            .map(|(row, (t, r))| {
                let (tp, pp) = products[&self.block(row)];
                let gain = if pp > 0.0 { (tp / pp).clamp(GAINS.0, GAINS.1) } else { 1.0 };
                (self.block(row), (f64::from(*t) - gain * f64::from(t - r)).powi(2))
            })
            .collect()
    }

    fn block(&self, row: &Row) -> usize {
        row.y as usize / self.block * 1000 + row.x as usize / self.block
    }

    /// The block and the square of each residual of the differences held out.
    pub fn blocks(&self, residual: &[f32]) -> Vec<(usize, f64)> {
        self.outside.iter().zip(residual).map(|(o, v)| (self.block(o), f64::from(*v).powi(2))).collect()
    }
}

/// How much worse a model explains held-out differences than another: the mean over blocks of the logarithm of the ratio of their squared
/// residuals (a sum over the frame would speak of its brightest edges alone), and that in standard errors.
#[derive(Clone, Copy)]
pub(super) struct Worse {
    pub by: f64,
    errors: f64,
}

impl Worse {
    pub fn than(a: &[(usize, f64)], b: &[(usize, f64)]) -> Self {
        let mut blocks: BTreeMap<usize, (f64, f64, f64)> = BTreeMap::new();
        for (x, y) in a.iter().zip(b) {
            let block = blocks.entry(x.0).or_default();
            *block = (block.0 + x.1, block.1 + y.1, block.2 + 1.0);
        }
        // A tenth of the noise: blocks that are explained better than that say nothing more.
        let ratios: Vec<f64> = blocks.values().filter(|b| b.2 >= 8.0).map(|b| ((b.0 + 0.1 * b.2) / (b.1 + 0.1 * b.2)).ln()).collect();
        let n = ratios.len() as f64;
        if n < 2.0 {
            return Self { by: 0.0, errors: 0.0 };
        }
        let mean = ratios.iter().sum::<f64>() / n;
        let variance = ratios.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
        Self { by: mean, errors: if variance > 0.0 { mean / (variance / n).sqrt() } else { 0.0 } }
    }

    /// Standard error of `by`.
    pub fn error(self) -> f64 {
        if self.errors == 0.0 { 0.0 } else { (self.by / self.errors).abs() }
    }

    /// Whether the simpler model may be taken all the same: less than a per cent is nothing, up to 8 % if it may be chance.
    pub fn forgivable(self) -> bool {
        self.by < 0.01 || self.by < 0.08 && self.errors < 2.0
    }
}

/// The latent irradiance under filters that are the same in all directions: what two sharp pictures of a scene differ by. Whether a frame moved is asked beside these, so
/// that softness alone is no motion.
pub(super) struct Filters([Plane; RADII.len()]);

impl Filters {
    pub fn of(frame: &WholeFrame) -> Self {
        let count = frame.latent.map(|_| 1.0);
        Self(RADII.map(|r| frame.latent.box_sum(r).zip(&count.box_sum(r), |sum, n| sum / n)))
    }

    /// Residuals of the differences held out where `tsf` blurs the latent irradiance and the gain and the filters' shares suit the others best.
    pub fn residual(&self, frame: &WholeFrame, held: &HeldOut, tsf: &Tsf) -> Vec<f32> {
        let [first, second, glare] = &self.0;
        let columns = |rows: &[Row]| -> [Vec<f32>; 1 + RADII.len()] {
            let mut columns = Evidence::new(frame, rows).predicted(&[frame.latent, first, second, glare], tsf);
            let [sharp, filtered @ ..] = &mut columns;
            for column in filtered {
                column.iter_mut().zip(&*sharp).for_each(|(f, s)| *f -= s);
            }
            columns
        };
        let shares = shares(&columns(&held.inside), &frame.targets(&held.inside));
        let mut residual = frame.targets(&held.outside);
        for (column, share) in columns(&held.outside).iter().zip(&shares) {
            residual.iter_mut().zip(column).for_each(|(r, v)| *r -= *share as f32 * v);
        }
        residual
    }
}

/// Gain and shares by which `columns` come closest to `targets`, each share within [`SHARES`].
fn shares(columns: &[Vec<f32>], targets: &[f32]) -> Vec<f64> {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    let n = columns.len();
    let mut fixed: Vec<Option<f64>> = vec![None; n];
    loop {
        let free: Vec<usize> = (0..n).filter(|&i| fixed[i].is_none()).collect();
        let known = |k: usize| (0..n).filter_map(|i| fixed[i].map(|v| v * dot(&columns[k], &columns[i]))).sum::<f64>();
        let a = DMatrix::from_fn(free.len(), free.len(), |i, k| {
            dot(&columns[free[i]], &columns[free[k]]) * if i == k { 1.0 + 1e-6 } else { 1.0 }
        });
        let b = DVector::from_fn(free.len(), |i, _| dot(&columns[free[i]], targets) - known(free[i]));
        let Some(found) = a.cholesky().map(|c| c.solve(&b)) else { return std::iter::once(1.0).chain(SHARES.map(|_| 0.0)).collect() };
        // The share that is farthest beyond its bounds stays at them.
        let beyond = |(i, &k): (usize, &usize)| {
            let (least, most) = *SHARES.get(k.wrapping_sub(1))?;
            let bound = found[i].clamp(least, most);
            (bound != found[i]).then_some((k, bound, (bound - found[i]).abs()))
        };
        match free.iter().enumerate().filter_map(beyond).max_by(|a, b| a.2.total_cmp(&b.2)) {
            Some((k, bound, _)) => fixed[k] = Some(bound),
            None => {
                let mut out: Vec<f64> = fixed.iter().map(|v| v.unwrap_or(0.0)).collect();
                free.iter().enumerate().for_each(|(i, &k)| out[k] = found[i]);
                return out;
            }
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::pose::Pose;
    use crate::tsf::Interpolation;
    use crate::tsf::whole_frame::warp;
    use glam::DMat3;

    /// Numbers of mean 0 and standard deviation 1, evenly distributed, by a hash of their place.
    pub fn scattered(seed: u32, i: usize) -> f32 {
        let mut v = (i as u32).wrapping_mul(0x9E37_79B9) ^ seed.wrapping_mul(0x85EB_CA6B);
        for _ in 0..2 {
            v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
        }
        ((v >> 8) as f32 / (1u32 << 23) as f32 - 1.0) * 3f32.sqrt()
    }

    #[test]
    fn shares_are_those_that_columns_were_mixed_with_within_their_bounds() {
        let columns: Vec<Vec<f32>> = (0..4).map(|k| (0..400).map(|i| scattered(k, i)).collect()).collect();
        let mixed = |by: [f32; 4]| -> Vec<f32> { (0..400).map(|i| (0..4).map(|k| by[k] * columns[k][i]).sum()).collect() };
        for (by, expected) in [
            ([1.1, -0.4, 0.2, 0.05], [1.1, -0.4, 0.2, 0.05]),
            ([0.9, 0.3, 0.1, 0.4], [0.9, 0.3, 0.1, 0.1]),
            ([1.0, -1.6, 0.0, -0.3], [1.0, -1.0, 0.0, 0.0]),
        ] {
            let found = shares(&columns, &mixed(by));
            // The columns are not quite at right angles: what a bound keeps back goes into the others.
            let tolerance = if by == expected { 1e-4 } else { 0.1 };
            assert!(found.iter().zip(expected).all(|(f, e)| (f - f64::from(e)).abs() < tolerance), "{found:?} for {expected:?}");
            assert!(found[1..].iter().zip(SHARES).all(|(f, (least, most))| (least..=most).contains(f)), "{found:?}");
        }
    }

    #[test]
    fn blocks_that_differ_by_a_gain_alone_are_explained() {
        let (w, h) = (140, 98);
        let scene = Plane::from_fn(w, h, |x, y| 1.0 + scattered(5, y * w + x));
        let weight = scene.map(|_| 1.0);
        // Blocks of ten pixels.
        let gain = |x: usize, y: usize| [0.5, 1.0, 1.7][(x / 10 + 2 * (y / 10)) % 3];
        let blurred = Plane::from_fn(w, h, |x, y| gain(x, y) * scene.at(x, y));
        let frame = WholeFrame { latent: &scene, pad: 0, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
        let [mut half, _] = HeldOut::halves(&frame.rows(100_000, 2), (w, h));
        // Differences across the border of two blocks have no gain.
        half.outside.retain(|r| (r.other().0 / 10, r.other().1 / 10) == (r.x as usize / 10, r.y as usize / 10));
        let targets = frame.targets(&half.outside);
        let residual = |factor: f32| -> Vec<f32> {
            let predicted = Evidence::new(&frame, &half.outside).predicted(&[&scene], &Tsf::identity());
            targets.iter().zip(&predicted[0]).map(|(t, p)| t - factor * p).collect()
        };
        let sum = |blocks: &[(usize, f64)]| blocks.iter().map(|b| b.1).sum::<f64>();
        let (with, without) = (sum(&half.blocks_with_gains(&targets, &residual(1.0))), sum(&half.blocks(&residual(1.0))));
        assert!(with < 1e-6 * without, "{with} with gains, {without} without");
        // What is not there at any gain stays.
        let (with, all) =
            (sum(&half.blocks_with_gains(&targets, &residual(0.05))), targets.iter().map(|t| f64::from(*t).powi(2)).sum::<f64>());
        assert!(with > 0.5 * all, "a gain of more than {}: {with} of {all}", GAINS.1);
    }

    #[test]
    fn softness_is_explained_and_a_stroke_is_not() {
        let (w, h) = (150, 120);
        let levels: Vec<f32> = (0..256).map(|i| (0.6 * scattered(11, i)).exp()).collect();
        let scene = Plane::from_fn(w, h, |x, y| levels[((x + y / 3) / 7 * 61 + (y + 100 - x / 5) / 6 * 17) % 256]);
        let stroke =
            |n: i32| Tsf::new(180.0, (0..n).map(|i| Pose::planar(f64::from(i) - 0.5 * f64::from(n - 1), 0.0, 0.0, 1.0)).collect()).unwrap();
        let seen = |tsf: &Tsf| {
            let mut sum = scene.map(|_| 0.0);
            for pose in &tsf.poses {
                let moved = warp(&scene, 0, (w, h), 0, &pose.homography(tsf.focal_px), Interpolation::SixPoint);
                sum = sum.zip(&moved, |s, v| s + pose.weight as f32 * v);
            }
            sum
        };
        let weight = scene.map(|_| 1.0 / 1e-4);
        // How much better a stroke of five pixels explains what is seen than no motion does.
        let gain = |clean: Plane| {
            let blurred = Plane::from_fn(w, h, |x, y| clean.at(x, y) + 0.01 * scattered(12, y * w + x));
            let frame = WholeFrame { latent: &scene, pad: 0, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
            let filters = Filters::of(&frame);
            let [half, _] = HeldOut::halves(&frame.rows(6000, 8), (w, h));
            let left = |tsf: &Tsf| half.blocks(&filters.residual(&frame, &half, tsf));
            Worse::than(&left(&stroke(1)), &left(&stroke(5))).by
        };
        let soft = gain(scene.box_sum(1).map(|v| v / 9.0).zip(&scene, |f, s| 0.7 * f + 0.3 * s));
        let moved = gain(seen(&stroke(5)));
        assert!(soft < 0.0, "softness is taken for a motion: {soft:.2}");
        assert!(moved > 1.0, "a motion is taken for softness: {moved:.2}");
    }
}
