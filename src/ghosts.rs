//! Ghosts: where sharp frames do not show the same scene because something in it moved. One of them then counts alone. No irradiance, no solver.
//!
//! Exposures of the same scene may differ by what nobody knows of a camera's tone curve, and do in every JPEG; its structure does not. So two frames are
//! compared over small squares, by what is left of the contrast of one that the other, times a factor near 1, does not explain.

use crate::exposure::Frame;
use crate::image::{Plane, Rgb};
use crate::mask;
use crate::noise::{self, FrameNoise};
use crate::pose::project;
use crate::sampling::bilinear;
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Squares of the frame of so many pixels a side are one where frames are compared, or more for frames of more than [`MOST`] of them: what moved is larger, and
/// what pixels alias is not.
const LEAST_SIDE: usize = 2;
/// Pixels of the frame below which its pixels themselves are compared.
const SMALL: usize = 64;
const MOST: usize = 1_000_000;
/// Radius, in squares, over which they are smoothed: what pixels alias, and what is interpolated between them, is finer.
const SMOOTH: usize = 1;
/// Radius, in squares, of the surroundings that contrast is looked at in; and the part of them that has to be seen by both frames.
const AROUND: usize = 2;
const SEEN: f32 = 0.3;
/// Radius in squares over which it is decided which frame counts.
const REGION: usize = 8;
/// What a place that a frame does not see costs it, and one of which it tells nothing; one that it clips costs 1.
const NOT_SEEN: f32 = 2.0;
const NOTHING: f32 = 1.5;
/// What a relative standard deviation of 1 costs.
const OF_DEVIATION: f32 = 3.0;
/// Steps of a file's values that its exposures are not believed, beside their noise: JPEG files drop what is finer.
const STEPS: f32 = 2.0;
/// Relative variance of an exposure from which it tells nothing.
const UNKNOWN: f32 = 0.12;
/// Part of its pixels that are black from which it tells nothing: noise below black is lost, and what is left of it looks too bright, and too even.
const BLACK: f32 = 0.025;
/// Contrast (of ln E) that may always be left, and the part of the contrast that there is and of the noise.
const CONTRAST: f32 = 0.06;
const OF_CONTRAST: f32 = 0.4;
const OF_NOISE: f32 = 0.5;
/// By what tone curves differ, as the exponent of one irradiance in the other.
const EXPONENT: (f32, f32) = (0.67, 1.5);
/// Part of what is too much from which a ghost goes on around where it is too much, difference of ln E likewise, and how many squares of too much begin one.
const GOES_ON: f32 = 0.4;
const DIFFERENT: f32 = 0.35;
const FEWEST: usize = 8;
/// Ghosts of less than one in so many squares are each shown by one frame; larger ones, a sea, may need another one here and there.
const SMALL_THING: usize = 10;
/// Squares by which a ghost is widened, and over which it fades.
const WIDER: usize = 3;
const FADES: usize = 2;

/// What is known of the frames that are compared.
pub struct Sharp<'a> {
    /// All frames of the bracket.
    pub frames: &'a [Frame],
    /// Their exposures f⁻¹(Z), 1 = white.
    pub exposures: &'a [Rgb],
    /// Their noise, as [`noise::curves`] has it, and without what rounding adds.
    pub curves: &'a [[Vec<f32>; 3]],
    /// Likewise.
    pub noise: &'a [FrameNoise],
    /// Each frame's place, from the reference, centred pixels.
    pub motions: &'a [DMat3],
    /// The sharp ones.
    pub ids: &'a [usize],
}

/// A frame on the reference's grid, squares of pixels.
struct Shown {
    /// ln E, NaN where it is clipped, too dark to tell, or not seen.
    log: Rgb,
    /// Relative variance of E.
    variance: Rgb,
    /// How little it is worth at a square, and around it: by what is clipped, and by its relative standard deviation.
    cost: Plane,
    cost_around: Plane,
    clipped: Plane,
}

/// Squares of `side` pixels of frames of `size`.
#[derive(Clone, Copy)]
struct Grid {
    size: (usize, usize),
    side: usize,
}

impl Grid {
    fn of(size: (usize, usize)) -> Self {
        let mut side = if size.0.min(size.1) < SMALL { 1 } else { LEAST_SIDE };
        while (size.0 / side) * (size.1 / side) > MOST {
            side += 1;
        }
        Self { size, side }
    }

    fn squares(self) -> (usize, usize) {
        (self.size.0 / self.side, self.size.1 / self.side)
    }

    /// From the first pixel to the frame's middle.
    fn middle(self) -> DVec2 {
        0.5 * DVec2::new(self.size.0 as f64 - 1.0, self.size.1 as f64 - 1.0)
    }

    /// Squares, from the first one, of a place in centred pixels.
    fn at(self, place: DVec2) -> DVec2 {
        (place + self.middle() - 0.5 * (self.side as f64 - 1.0)) / self.side as f64
    }
}

/// Mean over squares around.
fn around(plane: &Plane, r: usize) -> Plane {
    let count = |a: usize, n: usize| ((a + r).min(n - 1) + 1 - a.saturating_sub(r)) as f32;
    let (w, h) = plane.size();
    let sum = plane.box_sum(r);
    Plane::from_fn(w, h, |x, y| sum.at(x, y) / (count(x, w) * count(y, h)))
}

impl Sharp<'_> {
    /// Frame `i` where the reference sees it.
    fn shown(&self, i: usize, grid: Grid) -> Shown {
        let (frame, motion) = (&self.frames[i], &self.motions[i]);
        let (w, h) = grid.squares();
        // A plane of which `f` says what it is at a place of the frame, pixels from the first one: means over squares.
        let means = |f: &(dyn Fn(DVec2) -> f32 + Sync)| {
            let pixels = grid.side * grid.side;
            let at = |x: usize, y: usize, k: usize| {
                let pixel = DVec2::new((x * grid.side + k % grid.side) as f64, (y * grid.side + k / grid.side) as f64);
                f(if *motion == DMat3::IDENTITY { pixel } else { project(motion, pixel - grid.middle()) + grid.middle() })
            };
            Plane::from_fn(w, h, |x, y| (0..pixels).map(|k| at(x, y, k)).sum::<f32>() / pixels as f32)
        };
        let last = DVec2::new(grid.size.0 as f64 - 1.0, grid.size.1 as f64 - 1.0);
        let outside = means(&|at| f32::from(at.min_element() < 0.0 || at.x > last.x || at.y > last.y));
        let smooth = |c: usize| around(&means(&|at| bilinear(&self.exposures[i].0[c], at)), SMOOTH);
        let exposure: [Plane; 3] = std::array::from_fn(smooth);
        // Of the pixels of a square, those that are lost.
        let part = |lost: &dyn Fn(usize) -> bool| {
            let (w, h) = grid.size;
            let lost = Plane { width: w, height: h, data: (0..w * h).map(|p| f32::from(lost(p))).collect() };
            means(&|at| bilinear(&lost, at))
        };
        // As whole numbers, which sums keep as they are.
        let burnt = mask::spoilt_channels(frame).map(|clipped| part(&|p| clipped[p]).map(f32::ceil).box_sum(SMOOTH));
        let black: [Plane; 3] = std::array::from_fn(|c| around(&part(&|p| frame.intensity.0[c].data[p] <= 0.0), SMOOTH));
        let averaged = ((2 * SMOOTH + 1) * grid.side).pow(2) as f32;
        // Frames of 8 bits that were reduced have finer steps, but what their file dropped did not come back.
        let coarser = if frame.levels % 255 == 0 && frame.levels < 65535 { frame.levels as f32 / 255.0 } else { 1.0 };
        let relative = |c: usize, x: f32| {
            let (all, captured) = (noise::at(&self.curves[i][c], x).powi(2), self.noise[i].channels[c].variance(f64::from(x)) as f32);
            // Rounding makes a twelfth of a step's square.
            let rounding = 12.0 * (all - captured).max(0.0) * STEPS * STEPS * coarser * coarser;
            (captured / averaged + rounding) / (x * x).max(f32::MIN_POSITIVE)
        };
        let variance = Rgb(std::array::from_fn(|c| exposure[c].map(|x| relative(c, x))));
        let time = frame.exposure_time as f32;
        let log = |c: usize| {
            let lost = burnt[c].zip(&outside, |b, o| b + o);
            let known = |x: usize, y: usize| black[c].at(x, y) <= BLACK && variance.0[c].at(x, y) <= UNKNOWN;
            let tells = |x: usize, y: usize| lost.at(x, y) <= 0.0 && known(x, y);
            Plane::from_fn(w, h, |x, y| if tells(x, y) { (exposure[c].at(x, y) / time).ln() } else { f32::NAN })
        };
        let clipped = burnt[0].zip(&burnt[1], f32::max).zip(&burnt[2], f32::max);
        let worth = |v: f32, black: f32| if v > UNKNOWN || black > BLACK { NOTHING } else { OF_DEVIATION * v.sqrt() };
        let noisy = Rgb(std::array::from_fn(|c| variance.0[c].zip(&black[c], worth))).mean();
        let seen = |cost: Plane| cost.zip(&outside, |c, o| if o > 0.0 { NOT_SEEN } else { c });
        let cost = seen(clipped.zip(&noisy, |c, n| if c > 0.0 { 1.0 } else { n }));
        let cost_around = seen(around(&cost, REGION));
        Shown { log: Rgb(std::array::from_fn(log)), variance, cost, cost_around, clipped }
    }

    /// Part of its weight that each of the sharp frames keeps at each of its pixels, 0..=1; `None` for one that keeps all of it.
    pub fn shares(&self) -> Vec<Option<Plane>> {
        let grid = Grid::of(self.frames[self.ids[0]].intensity.size());
        let shown: Vec<Shown> = self.ids.iter().map(|&i| self.shown(i, grid)).collect();
        let (w, h) = grid.squares();
        let cheapest = |cost: &dyn Fn(usize) -> f64| {
            let costs: Vec<f64> = (0..shown.len()).map(cost).collect();
            (0..shown.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0)
        };
        let first: Vec<usize> = (0..w * h).map(|p| cheapest(&|k| f64::from(shown[k].cost_around.data[p]))).collect();
        let ghosts = |keeper: &[usize]| -> Vec<Option<Plane>> { shown.iter().map(|s| s.ghost(&shown, keeper)).collect() };
        let mut found = ghosts(&first);
        // Who walks by is shown by one frame from head to foot, a sea by what is best here and there. What stood still beside it has no say in either.
        let any: Vec<bool> = (0..w * h).map(|p| found.iter().flatten().any(|g| g.data[p] > 0.0)).collect();
        let mask = Plane::from_fn(w, h, |x, y| f32::from(any[y * w + x]));
        let among = mask.box_sum(REGION);
        let costs: Vec<Plane> =
            shown.iter().map(|s| s.cost.zip(&mask, |c, m| c * m).box_sum(REGION).zip(&among, |c, n| c / n.max(1.0))).collect();
        let mut keeper = first.clone();
        for whole in wholes(&any, (w, h)) {
            if whole.len() < w * h / SMALL_THING {
                let one = cheapest(&|k| whole.iter().map(|&q| f64::from(shown[k].cost.data[q])).sum());
                whole.into_iter().for_each(|q| keeper[q] = one);
            } else {
                whole.into_iter().for_each(|q| keeper[q] = cheapest(&|k| f64::from(costs[k].data[q])));
            }
        }
        if keeper != first {
            found = ghosts(&keeper);
        }
        // Where the frame that counts is clipped, or tells nothing, any other tells more.
        let silent = Plane::from_fn(w, h, |x, y| {
            let keeper = &shown[keeper[y * w + x]];
            f32::from(keeper.clipped.at(x, y) > 0.0 || keeper.log.0.iter().any(|p| p.at(x, y).is_nan()))
        });
        let own = |k: usize| {
            let ghost = around(found[k].as_ref()?, FADES);
            let gone = Plane::from_fn(w, h, |x, y| if keeper[y * w + x] == k || silent.at(x, y) > 0.0 { 0.0 } else { ghost.at(x, y) });
            let back = self.motions[self.ids[k]].inverse();
            let (w, h) = grid.size;
            Some(Plane::from_fn(w, h, |x, y| {
                let place = DVec2::new(x as f64, y as f64) - grid.middle();
                1.0 - bilinear(&gone, grid.at(project(&back, place)))
            }))
        };
        (0..shown.len()).map(own).collect()
    }
}

impl Shown {
    /// By how much of what `other` shows around each square too much is left that this frame does not, and the same of the level: 1 is too much.
    fn differences(&self, other: &Self) -> Vec<[f32; 2]> {
        let (w, h) = self.cost.size();
        let mut all = vec![[0.0f32; 2]; w * h];
        for c in 0..3 {
            let (a, b) = (&other.log.0[c], &self.log.0[c]);
            let counts = a.zip(b, |a, b| f32::from(a.is_finite() && b.is_finite()));
            let seen = around(&counts, AROUND);
            // Of differences from one value in the middle: f32 holds their squares.
            let values = || counts.data.iter().zip(&a.data).filter(|(n, _)| **n > 0.0).map(|(_, v)| f64::from(*v));
            let middle = (values().sum::<f64>() / values().count().max(1) as f64) as f32;
            let mean = |f: &(dyn Fn(usize) -> f32 + Sync)| {
                let at = |x: usize, y: usize| if counts.at(x, y) > 0.0 { f(y * w + x) } else { 0.0 };
                around(&Plane::from_fn(w, h, at), AROUND).zip(&seen, |sum, n| sum / n.max(1e-6))
            };
            let (va, vb) = (|p: usize| a.data[p] - middle, |p: usize| b.data[p] - middle);
            let (ma, mb) = (mean(&va), mean(&vb));
            let (aa, bb, ab) = (mean(&|p| va(p) * va(p)), mean(&|p| vb(p) * vb(p)), mean(&|p| va(p) * vb(p)));
            let noise = mean(&|p| other.variance.0[c].data[p] + self.variance.0[c].data[p]);
            let found = |p: usize| {
                if seen.data[p] < SEEN {
                    return [0.0; 2];
                }
                let (ma, mb, noise) = (ma.data[p], mb.data[p], noise.data[p]);
                let (aa, bb, ab) = ((aa.data[p] - ma * ma).max(0.0), (bb.data[p] - mb * mb).max(0.0), ab.data[p] - ma * mb);
                let k = (ab / aa.max(1e-9)).clamp(EXPONENT.0, EXPONENT.1);
                let rest = bb - 2.0 * k * ab + k * k * aa - noise;
                let much = CONTRAST * CONTRAST + OF_NOISE * noise + OF_CONTRAST * aa.max(bb);
                [rest / much, (ma - mb).abs() / (DIFFERENT + 2.0 * noise.sqrt())]
            };
            all.par_iter_mut().enumerate().for_each(|(p, most)| {
                let [left, level] = found(p);
                *most = [left.max(most[0]), level.max(most[1])];
            });
        }
        all
    }

    /// 1 where this frame and that of `shown` which `keeper` names do not show the same; `None` if nowhere.
    fn ghost(&self, shown: &[Self], keeper: &[usize]) -> Option<Plane> {
        let (w, h) = self.cost.size();
        let mut much = vec![[0.0; 2]; w * h];
        for (i, other) in shown.iter().enumerate() {
            if !std::ptr::eq(self, other) && keeper.contains(&i) {
                let found = self.differences(other);
                (0..w * h).filter(|&p| keeper[p] == i).for_each(|p| much[p] = found[p]);
            }
        }
        let part: Vec<bool> = much.iter().map(|[left, level]| *left > GOES_ON || *level > 1.0).collect();
        let mut ghost = Plane::filled(w, h, 0.0);
        let mut found = false;
        for whole in wholes(&part, (w, h)) {
            if whole.iter().filter(|&&q| much[q][0] > 1.0).count() >= FEWEST {
                found = true;
                whole.iter().for_each(|&q| ghost.data[q] = 1.0);
            }
        }
        found.then(|| ghost.box_sum(WIDER).map(|n| f32::from(n > 0.5)))
    }
}

/// The pixels of `part`, those together that hang together by rows and columns.
fn wholes(part: &[bool], size: (usize, usize)) -> Vec<Vec<usize>> {
    let (w, h) = size;
    let mut looked = vec![false; w * h];
    let mut found = Vec::new();
    for from in 0..w * h {
        if looked[from] || !part[from] {
            continue;
        }
        let mut all = vec![from];
        looked[from] = true;
        let mut next = 0;
        while let Some(&p) = all.get(next) {
            next += 1;
            let (x, y) = (p % w, p / w);
            let neighbours = [(x > 0).then(|| p - 1), (x + 1 < w).then(|| p + 1), (y > 0).then(|| p - w), (y + 1 < h).then(|| p + w)];
            for q in neighbours.into_iter().flatten() {
                if part[q] && !looked[q] {
                    looked[q] = true;
                    all.push(q);
                }
            }
        }
        found.push(all);
    }
    found
}
