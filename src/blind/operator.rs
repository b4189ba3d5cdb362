//! Blur K of one luminance plane and its exact adjoint Kᵀ on the CPU: `frame(q) = Σ_taps weight · (Warp_base E)(q - shift)`.
//!
//! The joint estimate applies K some thousand times to single planes that change their TSF after every few applications; there a
//! few rows of multiply-adds are through before a GPU has compiled, uploaded and waited.
//!
//! Its warps are cubic, as the TSFs' fits are. Bilinear warps blur by themselves: the luminance then makes up for it by edges too steep, the
//! fit of the TSFs against that luminance by wider ones, and the two drive each other on, round by round.

use crate::image::Plane;
use crate::sampling::{split, weights, wide};
use crate::tsf::{Interpolation, TapSet, Tsf};
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use std::sync::Mutex;

/// K of one TSF between a latent grid (frame plus `pad` pixels on every side) and a frame.
pub struct Operator {
    frame: (usize, usize),
    pad: usize,
    bases: Vec<Base>,
    energy: f32,
    /// Vectors to be used again.
    spare: Mutex<Vec<Vec<f32>>>,
}

/// dx, dy, weight.
type Tap = (isize, isize, f32);

/// One warp and its shifts, the warp's array reaching `margin` pixels beyond the frame.
struct Base {
    inverse: DMat3,
    margin: usize,
    taps: Vec<Tap>,
}

/// Neighbouring pixels of a row of a base's array that see neighbouring pixels of the latent grid.
struct Run<'a> {
    /// First pixel in the row, and their number.
    first: usize,
    count: usize,
    /// First of the 4 x 4 pixels of the latent grid around the first one.
    at: usize,
    /// Weights of the neighbours' columns and rows.
    x: [&'a [f32]; 4],
    y: [&'a [f32]; 4],
}

/// Coordinates of the pixels of a block along one axis: pixel k of it sees `from` + `whole[k]` + `rest[k]`, and k more along the row.
struct Cells {
    from: isize,
    whole: [f32; BLOCK],
    rest: [f32; BLOCK],
}

impl Default for Cells {
    fn default() -> Self {
        Self { from: 0, whole: [0.0; BLOCK], rest: [0.0; BLOCK] }
    }
}

impl Cells {
    /// From the coordinate of the first pixel of the block, and how it and the denominator, 1 there, grow from one pixel to the next: pixel k sees
    /// (`first` + `step` k) / (1 + `turn` k), from which `slope` k is taken.
    #[inline(always)]
    fn fill(&mut self, first: f64, step: f64, turn: f64, slope: f64) {
        let (from, rest) = split(first);
        self.from = from;
        // Displacements are small, so that f32 holds them.
        let (step, bend, turn) = ((step - slope - turn * from as f64) as f32, (-slope * turn) as f32, turn as f32);
        let at = |k: usize| (rest + (step + bend * k as f32) * k as f32) / (1.0 + turn * k as f32);
        let near = at(BLOCK - 1) - rest;
        if turn == 0.0 && near.abs() < 1.0 {
            self.each(|k| rest + step * k as f32, next_to);
        } else if near.abs() < 0.5 && turn.abs() * (BLOCK as f32) < 0.05 {
            // Between its ends a block bulges by less than another half.
            self.each(at, next_to);
        } else {
            self.each(at, below);
        }
    }

    /// From `at(k)`, the displacement of each pixel, and the whole number `whole(t)` that is not greater.
    #[inline(always)]
    fn each(&mut self, at: impl Fn(usize) -> f32, whole: impl Fn(f32) -> f32) {
        for k in 0..BLOCK {
            let t = at(k);
            self.whole[k] = whole(t);
            self.rest[k] = t - self.whole[k];
        }
    }
}

/// The whole number that is not greater than `t`, of -1 and more and less than 2.
#[inline(always)]
fn next_to(t: f32) -> f32 {
    f32::from(u8::from(t >= 1.0)) - f32::from(u8::from(t < 0.0))
}

/// The same of any `t`.
#[inline(always)]
fn below(t: f32) -> f32 {
    let towards_zero = (t as i32) as f32;
    towards_zero - f32::from(u8::from(t < towards_zero))
}

impl Operator {
    /// K of `tsf` for frames of `width` x `height` pixels and a latent grid that is larger by `pad` on every side.
    pub fn new(tsf: &Tsf, width: usize, height: usize, pad: usize) -> Self {
        let set = TapSet::shifted(tsf, width, height, Interpolation::Bicubic);
        let energy = set.energy() as f32;
        let bases = set
            .bases
            .iter()
            .enumerate()
            .filter_map(|(b, h)| {
                let own = set.taps.iter().filter(|t| t.base == b);
                let taps: Vec<Tap> = own.map(|t| (t.dx as isize, t.dy as isize, t.weight as f32)).collect();
                let margin = taps.iter().map(|t| t.0.unsigned_abs().max(t.1.unsigned_abs())).max()?;
                Some(Base { inverse: h.inverse(), margin, taps })
            })
            .collect();
        Self { frame: (width, height), pad, bases, energy, spare: Mutex::default() }
    }

    /// Sum of the squared weights of the blur at the frame's centre: the scale of KᵀK's diagonal.
    pub fn energy(&self) -> f32 {
        self.energy
    }

    /// (width, height) of the latent grid.
    pub fn latent(&self) -> (usize, usize) {
        (self.frame.0 + 2 * self.pad, self.frame.1 + 2 * self.pad)
    }

    /// K `latent`, on the frame's grid. What lies beyond the latent grid counts as 0.
    pub fn forward(&self, latent: &[f32]) -> Vec<f32> {
        let (w, h) = self.frame;
        let mut out = vec![0.0f32; w * h];
        for base in &self.bases {
            let (m, length) = (base.margin, w + 2 * base.margin);
            let mut warped = self.zeros(length * (h + 2 * m));
            warped.par_chunks_exact_mut(length).enumerate().for_each(|(j, to)| {
                wide(
                    #[inline(always)]
                    || self.warp_row(base, latent, j, to),
                );
            });
            out.par_chunks_exact_mut(w).enumerate().for_each(|(y, to)| {
                wide(
                    #[inline(always)]
                    || add_taps(to, &warped, &base.taps, |dx, dy| (y + m).strict_add_signed(-dy) * length + m.strict_add_signed(-dx)),
                );
            });
            self.done(warped);
        }
        out
    }

    /// Kᵀ `frame`, on the latent grid.
    pub fn adjoint(&self, frame: &[f32]) -> Vec<f32> {
        let (w, h) = self.frame;
        let lw = self.latent().0;
        let n = lw * self.latent().1;
        // Zeros around the frame, so that every tap reads whole rows.
        let zeros = 2 * self.bases.iter().map(|b| b.margin).max().unwrap_or(0);
        let wide_frame = w + 2 * zeros;
        let mut around = self.zeros(wide_frame * (h + 2 * zeros));
        for (row, to) in frame.chunks_exact(w).zip(around[zeros * wide_frame..].chunks_exact_mut(wide_frame)) {
            to[zeros..zeros + w].copy_from_slice(row);
        }
        let each = |base: &Base| {
            let (m, length) = (base.margin, w + 2 * base.margin);
            let (mut warped, mut out) = (self.zeros(length * (h + 2 * m)), self.zeros(n));
            let at = |v: usize, d: isize| (v + zeros - m).strict_add_signed(d);
            warped.par_chunks_exact_mut(length).enumerate().for_each(|(j, to)| {
                wide(
                    #[inline(always)]
                    || add_taps(to, &around, &base.taps, |dx, dy| at(j, dy) * wide_frame + at(0, dx)),
                );
            });
            for (j, from) in warped.chunks_exact(length).enumerate() {
                wide(
                    #[inline(always)]
                    || self.spread_row(base, from, j, &mut out),
                );
            }
            self.done(warped);
            out
        };
        // One after another, so that the same frames give the same sum whichever thread was first.
        let mut sum = vec![0.0f32; n];
        for part in self.bases.par_iter().map(each).collect::<Vec<_>>() {
            sum.iter_mut().zip(&part).for_each(|(a, b)| *a += b);
            self.done(part);
        }
        self.done(around);
        sum
    }

    /// Row `j` of a base's array += what the warp sees of `latent`.
    #[inline(always)]
    fn warp_row(&self, base: &Base, latent: &[f32], j: usize, row: &mut [f32]) {
        let lw = self.latent().0;
        self.walk(
            base,
            j,
            #[inline(always)]
            |run| {
                let to = &mut row[run.first..][..run.count];
                for b in 0..4 {
                    let from = &latent[run.at + b * lw..][..run.count + 3];
                    for a in 0..4 {
                        let weights = run.x[a].iter().zip(run.y[b]);
                        to.iter_mut().zip(weights).zip(&from[a..]).for_each(|((t, (x, y)), v)| *t += x * y * v);
                    }
                }
            },
        );
    }

    /// `latent` += the adjoint of [`Operator::warp_row`] of the row.
    #[inline(always)]
    fn spread_row(&self, base: &Base, row: &[f32], j: usize, latent: &mut [f32]) {
        let lw = self.latent().0;
        self.walk(
            base,
            j,
            #[inline(always)]
            |run| {
                let from = &row[run.first..][..run.count];
                for b in 0..4 {
                    let to = &mut latent[run.at + b * lw..][..run.count + 3];
                    for a in 0..4 {
                        let weights = run.x[a].iter().zip(run.y[b]);
                        to[a..].iter_mut().zip(weights).zip(from).for_each(|((t, (x, y)), v)| *t += x * y * v);
                    }
                }
            },
        );
    }

    /// A vector to use until [`Operator::done`]: memory that is fresh from the system costs more than what is done with it.
    fn zeros(&self, count: usize) -> Vec<f32> {
        let mut vector = self.spare.lock().expect("no holder panics").pop().unwrap_or_default();
        vector.clear();
        vector.resize(count, 0.0);
        vector
    }

    fn done(&self, vector: Vec<f32>) {
        self.spare.lock().expect("no holder panics").push(vector);
    }

    /// Calls `f` with the runs of row `j` of a base's array whose 4 x 4 neighbours the latent grid holds.
    #[inline(always)]
    fn walk(&self, base: &Base, j: usize, mut f: impl FnMut(&Run)) {
        let (w, h) = self.frame;
        let (lw, lh) = (self.latent().0 as isize, self.latent().1 as isize);
        let centre = DVec2::new((w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0);
        let shift = centre + DVec2::splat(self.pad as f64);
        let (inverse, start) = (&base.inverse, DVec2::new(0.0, j as f64) - DVec2::splat(base.margin as f64) - centre);
        let length = w + 2 * base.margin;
        let (mut along, mut down) = (Cells::default(), Cells::default());
        let (mut x, mut y) = ([[0.0f32; BLOCK]; 4], [[0.0f32; BLOCK]; 4]);
        for block in (0..length).step_by(BLOCK) {
            let count = BLOCK.min(length - block);
            let seen = *inverse * (start + DVec2::new(block as f64, 0.0)).extend(1.0);
            let (first, turn) = (seen.truncate() / seen.z + shift, inverse.x_axis.z / seen.z);
            let step = inverse.x_axis.truncate() / seen.z + shift * turn;
            along.fill(first.x, step.x, turn, 1.0);
            down.fill(first.y, step.y, turn, 0.0);
            for k in 0..BLOCK {
                let (u, v) = (weights(along.rest[k]), weights(down.rest[k]));
                for a in 0..4 {
                    (x[a][k], y[a][k]) = (u[a], v[a]);
                }
            }
            let mut k = 0;
            while k < count {
                let (dx, dy) = (along.whole[k], down.whole[k]);
                let mut end = k + 1;
                while end < count && along.whole[end] == dx && down.whole[end] == dy {
                    end += 1;
                }
                // Pixel k + dx of row dy, and one before it and two behind, have to be there.
                let (column, row) = (along.from + dx as isize, down.from + dy as isize);
                let from = (k as isize).max(1 - column);
                let to = (end as isize).min(lw - 2 - column);
                if from < to && row >= 1 && row + 2 < lh {
                    let part = from as usize..to as usize;
                    f(&Run {
                        first: block + part.start,
                        count: part.len(),
                        at: ((row - 1) * lw + column + from - 1) as usize,
                        x: x.each_ref().map(|x| &x[part.clone()]),
                        y: y.each_ref().map(|y| &y[part.clone()]),
                    });
                }
                k = end;
            }
        }
    }

    /// Pixels of the frame that see nothing beyond the latent grid. The sum of the weights does not tell: cubic ones have both signs.
    pub fn inside(&self) -> Vec<bool> {
        let (w, h) = self.frame;
        let mut inside = vec![true; w * h];
        for base in &self.bases {
            let (m, wide) = (base.margin, w + 2 * base.margin);
            let mut seen = vec![false; wide * (h + 2 * base.margin)];
            for (j, row) in seen.chunks_exact_mut(wide).enumerate() {
                self.walk(base, j, |run| row[run.first..][..run.count].fill(true));
            }
            inside.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
                for &(dx, dy, _) in &base.taps {
                    let from = &seen[(y + m).strict_add_signed(-dy) * wide + m.strict_add_signed(-dx)..][..w];
                    row.iter_mut().zip(from).for_each(|(o, v)| *o &= v);
                }
            });
        }
        inside
    }

    /// [`Operator::forward`] of a plane.
    pub fn blur(&self, latent: &Plane) -> Plane {
        Plane { width: self.frame.0, height: self.frame.1, data: self.forward(&latent.data) }
    }
}

/// Values of a row that stay in registers while taps add to them.
const BLOCK: usize = 32;

/// `row` += Σ weight · `from[at(dx, dy)..]` over `taps`.
#[inline(always)]
fn add_taps(row: &mut [f32], from: &[f32], taps: &[Tap], at: impl Fn(isize, isize) -> usize) {
    let (blocks, rest) = row.as_chunks_mut::<BLOCK>();
    let done = blocks.len() * BLOCK;
    for (k, block) in blocks.iter_mut().enumerate() {
        let mut sum = *block;
        for &(dx, dy, weight) in taps {
            let values: &[f32; BLOCK] = from[at(dx, dy) + k * BLOCK..][..BLOCK].try_into().expect("a block");
            sum.iter_mut().zip(values).for_each(|(s, v)| *s += weight * v);
        }
        *block = sum;
    }
    for &(dx, dy, weight) in taps {
        rest.iter_mut().zip(&from[at(dx, dy) + done..]).for_each(|(s, v)| *s += weight * v);
    }
}
