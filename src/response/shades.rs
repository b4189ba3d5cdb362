//! Shades that all frames agree on however blurred they are: mean exposures of blocks whose surroundings are as bright as they.

use crate::exposure::Frame;
use crate::mask::CLIPPED;
use rayon::prelude::*;
use std::collections::HashMap;

/// A frame's longer side holds so many blocks: 8 px of a frame of 360 px, 62 px of one of 2816 px, as blur in pixels grows with a
/// frame's resolution.
const BLOCKS: usize = 45;
/// A block has at least so many pixels a side, for its mean to be less noisy than a pixel and for blur not to reach across it; where nothing moved, so many.
const LEAST_SIDE: usize = 8;
const LEAST_STILL: usize = 4;
/// Of large frames every so-manyth pixel is looked at, that a row has about so many.
const SAMPLED: usize = 1000;
/// A block of which more than this part is cut off at black hides its mean.
const BLACK: f64 = 0.01;
/// Shades below 4 of 255 say more about the black level than about the curve.
pub(super) const DARKEST: f64 = 4.0 / 255.0;
/// Blur and misalignment move a block's content by about this part of the block's side.
const DISPLACEMENT: f64 = 0.4;
/// Shades are told apart in so many steps of intensity, for their weights.
const CELLS: f64 = 32.0;
/// So many blocks of one shade count in full.
pub(super) const CROWD: f64 = 20.0;
/// And so many blocks of one shade are kept.
const KEPT: usize = 12;
/// Standard deviation of the mean intensity of a block in which nothing moves (noise, compression): one code and a half of 255.
const STILL: f64 = 1.5 / 255.0;

/// What differs from frame to frame beside the exposure.
pub(super) enum Motion {
    /// Nothing: the frames show one scene in one place, unblurred.
    None,
    /// Blur, and where the scene lies: the frames' [`displacements`](super::displacement::displacements), where blocks are compared.
    Shaken(Vec<(isize, isize)>),
}

/// One channel of one block in the frames that show it well.
pub(super) struct Shade {
    /// 0 red, 1 green, 2 blue.
    pub channel: usize,
    /// Column and row of the block in the grid of largest blocks; every fold of a cross-validation is a set of these.
    pub block: (usize, usize),
    /// How much it counts: a shade that a hundred blocks have does not outvote the others.
    pub weight: f64,
    /// The frames; at least two.
    pub seen: Vec<Seen>,
}

/// A block's mean in one frame.
pub(super) struct Seen {
    /// Index of the frame.
    pub frame: usize,
    /// Intensity whose exposure is the mean exposure of the block.
    pub z: f64,
    /// Standard deviation of `z`: noise, and what blur and misalignment may have moved into the block.
    pub deviation: f64,
}

/// Blocks of `frames` that at least two frames show neither clipped nor black, averaged in exposures under f⁻¹ = `inverse`(channel, z).
///
/// Blur averages exposures; so a block's mean *exposure* survives it where the neighbouring blocks are as bright, whatever
/// texture is inside. Where they are not, the difference to the neighbours becomes the uncertainty `Seen::deviation`, if there is `motion`.
pub(super) fn collect(frames: &[Frame], motion: &Motion, inverse: &(dyn Fn(usize, f64) -> f64 + Sync)) -> Vec<Shade> {
    let Some(first) = frames.first() else { return Vec::new() };
    let (width, height) = first.intensity.size();
    let reach = (width.max(height) / BLOCKS).max(LEAST_SIDE);
    let least = if matches!(motion, Motion::None) { LEAST_STILL } else { LEAST_SIDE };
    // Smaller blocks see smaller objects; blur moves as many pixels into them.
    let sides = [reach, reach / 2, reach / 4].into_iter().filter(|&s| s == reach || s >= least);
    let mut shades: Vec<Shade> = sides.flat_map(|side| of_size(frames, motion, inverse, side, reach)).collect();
    let cell = |s: &Shade| (s.channel, s.seen.iter().map(|v| (v.frame, (v.z * CELLS) as usize)).collect::<Vec<_>>());
    let mut population: HashMap<_, usize> = HashMap::new();
    for s in &shades {
        *population.entry(cell(s)).or_default() += 1;
    }
    let mut met: HashMap<_, usize> = HashMap::new();
    shades.retain_mut(|s| {
        let (all, k) = (population[&cell(s)], met.entry(cell(s)).or_default());
        // Evenly among those of the cell.
        let kept = all.min(KEPT);
        let keep = *k * kept / all != (*k + 1) * kept / all;
        *k += 1;
        s.weight = all as f64 / (1.0 + all as f64 / CROWD) / kept as f64;
        keep
    });
    shades
}

/// [`collect`] of blocks of one size, without weights; blur, if there is any, reaches over `reach` pixels.
fn of_size(frames: &[Frame], motion: &Motion, inverse: &(dyn Fn(usize, f64) -> f64 + Sync), side: usize, reach: usize) -> Vec<Shade> {
    let (width, height) = frames[0].intensity.size();
    let (columns, rows) = (width / side, height / side);
    let jobs: Vec<(usize, usize)> = (0..3).flat_map(|c| (0..frames.len()).map(move |i| (c, i))).collect();
    let maps: Vec<Vec<Option<Seen>>> =
        jobs.par_iter().map(|&(c, i)| means(&frames[i], i, motion, c, side, reach, columns, rows, inverse)).collect();
    let mut shades = Vec::new();
    let mut maps = maps.into_iter();
    for channel in 0..3 {
        let mut per_frame: Vec<_> = maps.by_ref().take(frames.len()).map(Vec::into_iter).collect();
        for k in 0..columns * rows {
            let seen: Vec<Seen> = per_frame.iter_mut().filter_map(|m| m.next().flatten()).collect();
            if seen.len() >= 2 {
                shades.push(Shade { channel, block: (k % columns * side / reach, k / columns * side / reach), weight: 1.0, seen });
            }
        }
    }
    shades
}

fn means(
    frame: &Frame,
    index: usize,
    motion: &Motion,
    channel: usize,
    side: usize,
    reach: usize,
    columns: usize,
    rows: usize,
    inverse: &(dyn Fn(usize, f64) -> f64 + Sync),
) -> Vec<Option<Seen>> {
    const STEPS: usize = 1020;
    let ((dx, dy), blur) = match motion {
        Motion::None => ((0, 0), 0),
        Motion::Shaken(displaced) => (displaced[index], reach),
    };
    let table: Vec<f64> = (0..=STEPS).map(|k| inverse(channel, k as f64 / STEPS as f64)).collect();
    let plane = &frame.intensity.0[channel];
    let stride = (plane.width.max(plane.height) / SAMPLED).max(1);
    let others = &frame.intensity.0;
    let cut_off = frame.black(channel);
    // Mean intensity of each block, and whether it is clipped or black.
    let mut blocks = Vec::with_capacity(columns * rows);
    for by in 0..rows {
        for bx in 0..columns {
            let (mut sum, mut black, mut white) = (0.0, 0usize, false);
            let mut n = 0.0;
            let inside = |at: usize, d: isize, n: usize| (at * side).checked_add_signed(d).is_some_and(|s| s + side <= n);
            if !(inside(bx, dx, plane.width) && inside(by, dy, plane.height)) {
                blocks.push((0.0, true, false));
                continue;
            }
            for y in (by * side..(by + 1) * side).step_by(stride) {
                for x in (bx * side..(bx + 1) * side).step_by(stride) {
                    let (x, y) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                    let z = plane.at(x, y);
                    n += 1.0;
                    sum += table[(z.clamp(0.0, 1.0) * STEPS as f32).round() as usize];
                    black += usize::from(z <= cut_off);
                    white |= others.iter().any(|p| p.at(x, y) >= CLIPPED);
                }
            }
            let mean = sum / n;
            let k = table.partition_point(|&t| t < mean).clamp(1, STEPS);
            let part = ((mean - table[k - 1]) / (table[k] - table[k - 1]).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            blocks.push(((k as f64 - 1.0 + part) / STEPS as f64, black as f64 > BLACK * n, white));
        }
    }
    let around = blur.div_ceil(side);
    let mut out = Vec::with_capacity(columns * rows);
    for by in 0..rows {
        for bx in 0..columns {
            let (z, black, _) = blocks[by * columns + bx];
            let mut usable = !black && z > DARKEST;
            let mut step = 0.0f64;
            for y in by.saturating_sub(around)..=(by + around).min(rows - 1) {
                for x in bx.saturating_sub(around)..=(bx + around).min(columns - 1) {
                    // What is clipped next door may have been smeared in here.
                    let (other, _, white) = blocks[y * columns + x];
                    usable &= !white;
                    if y.abs_diff(by) <= 1 && x.abs_diff(bx) <= 1 {
                        step = step.max((other - z).abs());
                    }
                }
            }
            let moved = DISPLACEMENT * step * blur as f64 / side as f64;
            out.push(usable.then(|| Seen { frame: index, z, deviation: STILL.hypot(moved) }));
        }
    }
    out
}
