//! What displaced sharp frames show of structure finer than the latent grid.
//!
//! A pixel is the mean of the light on its square. A frame that lies between the pixels of another one has means over other squares, and where the
//! scene is harder than the pixels are fine no interpolation of the one gives the other: at bright edges they differ by ten times the
//! noise and more. An irradiance on a grid twice as fine, whose squares of four the frames saw, explains both. It is solved for from the sharp
//! frames alone, and what they show of it beyond what K makes of its means on the latent grid is taken off their exposures
//! (a deferred correction): the solver of the latent grid is left with frames that it can explain.

use super::{Observation, Prior, Settings, pad_for, solve};
use crate::error::Result;
use crate::gpu::Gpu;
use crate::image::{Plane, Rgb};
use crate::kernels::{Kernels, STILL};
use crate::pose::{Pose, Projection, project};
use crate::tsf::{Interpolation, Tsf};
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Side in pixels of the squares of the latent grid that are solved at a time unless something else is asked for: large pictures need no more
/// memory than small ones.
pub const TILE: usize = 448;
/// Pixels around such a square that are solved with it. Of a frame that is turned by more than 4° the corners of squares lie farther off: nothing is taken off
/// there.
const MARGIN: usize = 16;
/// What is found counts as noise up to so many of the frame's standard deviations, in squares of side 2 r + 1 around a pixel for this r.
const NOISE: f32 = 0.4;
const AROUND: usize = 2;
/// One in so many pixels of displaced frames is kept from the solution, to tell whether what is found is there.
const KEPT_BACK: u64 = 8;
/// Those in squares of side 2 r + 1 around a pixel decide, for this r.
const WITNESSES: usize = 24;
/// Part of what was found that they have to confirm for all of it to be believed: between the pixels that were solved for it is less sure than at them.
const ENOUGH: f32 = 0.3;

/// A part of the latent grid, and the same part of a frame as nearly as whole pixels go.
struct Window {
    /// First pixel on the latent grid.
    corner: (usize, usize),
    size: (usize, usize),
    /// From the middle of the latent grid to that of the window.
    middle: DVec2,
}

impl Window {
    /// The square of side `tile` whose first pixel is `core`, and what surrounds it, on a grid of `size` pixels.
    fn around(core: (usize, usize), tile: usize, size: (usize, usize)) -> Self {
        let first = |a: usize| a.saturating_sub(MARGIN);
        let last = |a: usize, n: usize| (a + tile + MARGIN).min(n);
        let corner = (first(core.0), first(core.1));
        let own = (last(core.0, size.0) - corner.0, last(core.1, size.1) - corner.1);
        let middle = |a: usize, n: usize, all: usize| a as f64 + 0.5 * (n as f64 - all as f64);
        Self { corner, size: own, middle: DVec2::new(middle(corner.0, own.0, size.0), middle(corner.1, own.1, size.1)) }
    }

    /// Whole pixels by which a frame at `motion` (from the latent grid, centred pixels) lies off it here.
    fn shift(&self, motion: &DMat3) -> DVec2 {
        (project(motion, self.middle) - self.middle).round()
    }

    /// `motion` from the window to that of the frame, [`Window::shift`] further on, both centred.
    fn motion(&self, motion: &DMat3) -> DMat3 {
        DMat3::from_translation(-self.middle - self.shift(motion)) * *motion * DMat3::from_translation(self.middle)
    }

    /// From its first pixel to its middle.
    fn half(&self) -> DVec2 {
        0.5 * DVec2::new(self.size.0 as f64 - 1.0, self.size.1 as f64 - 1.0)
    }

    /// The window, `shift` further on and `pad` wider on every side, of `plane`; outside, the nearest pixel's value or `beyond`.
    fn cut(&self, plane: &Plane, shift: DVec2, pad: usize, beyond: Option<f32>) -> Plane {
        let at = |a: usize, first: usize, by: f64| (a + first) as isize - pad as isize + by as isize;
        let inside = |a: isize, n: usize| a >= 0 && a < n as isize;
        Plane::from_fn(self.size.0 + 2 * pad, self.size.1 + 2 * pad, |x, y| {
            let (i, j) = (at(x, self.corner.0, shift.x), at(y, self.corner.1, shift.y));
            match beyond {
                Some(value) if !(inside(i, plane.width) && inside(j, plane.height)) => value,
                _ => plane.clamped(i, j),
            }
        })
    }
}

/// TSF on the fine grid of a frame at `motion` whose pixels stand on the first of the four fine ones that they are the mean of.
fn doubled(motion: &DMat3) -> Tsf {
    let twice = DMat3::from_diagonal(DVec3::new(2.0, 2.0, 1.0));
    let poses = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].map(|(x, y)| Pose::planar(-x, -y, 0.0, 0.25));
    Tsf { poses: poses.to_vec(), ..Tsf::identity() }.about(twice * *motion * twice.inverse())
}

/// `plane` on a grid twice as fine: bilinear, the means of four are about the pixels.
fn finer(plane: &Plane) -> Plane {
    let side = |v: usize| if v.is_multiple_of(2) { -1 } else { 1 };
    Plane::from_fn(2 * plane.width, 2 * plane.height, |x, y| {
        let (i, j, a, b) = ((x / 2) as isize, (y / 2) as isize, side(x), side(y));
        let at = |a: isize, b: isize| plane.clamped(i + a, j + b);
        0.5625 * at(0, 0) + 0.1875 * (at(a, 0) + at(0, b)) + 0.0625 * at(a, b)
    })
}

/// Means of four.
fn coarser(plane: &Plane) -> Plane {
    Plane::from_fn(plane.width / 2, plane.height / 2, |x, y| {
        let at = |a: usize, b: usize| plane.at(2 * x + a, 2 * y + b);
        0.25 * (at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1))
    })
}

/// `image` at (x, y), its nearest pixels beyond it.
fn sample(image: &Rgb, kind: Interpolation, at: DVec2) -> [f64; 3] {
    let support = kind.support() as isize;
    let (fx, fy) = (at.x.floor(), at.y.floor());
    let mut sum = [0.0; 3];
    for j in 1 - support..=support {
        let wy = kind.weight(j as f64 - (at.y - fy));
        for i in 1 - support..=support {
            let weight = wy * kind.weight(i as f64 - (at.x - fx));
            for (s, plane) in sum.iter_mut().zip(&image.0) {
                *s += weight * f64::from(plane.clamped(fx as isize + i, fy as isize + j));
            }
        }
    }
    sum
}

/// One window solved for on the fine grid.
struct Fine {
    window: Window,
    /// Pixels of the latent grid around the window.
    pad: usize,
    irradiance: Rgb,
    /// Its means on the latent grid.
    means: Rgb,
}

impl Fine {
    /// `start`: irradiance on the frames' grid plus so many pixels.
    fn solve(
        gpu: &Gpu,
        kernels: &Kernels,
        sharp: &[(&Observation, DMat3)],
        window: Window,
        start: (&Rgb, usize),
        settings: &Settings,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Self> {
        let own: Vec<(DVec2, DMat3)> = sharp.iter().map(|(_, m)| (window.shift(m), window.motion(m))).collect();
        let still: Vec<Tsf> = own.iter().map(|(_, m)| Tsf::still(*m)).collect();
        let pad = pad_for(&still.iter().collect::<Vec<_>>(), window.size.0, window.size.1, MARGIN);
        let twice = |p: &Plane, f: fn(&Plane, usize, usize) -> f32| Plane::from_fn(2 * p.width, 2 * p.height, |x, y| f(p, x, y));
        let counting = |o: &Observation, shift: DVec2| {
            let mask = window.cut(&o.mask, shift, 0, Some(0.0));
            let on_frame = |a: usize, first: usize, by: f64| ((a + first) as isize + by as isize) as usize;
            let counts =
                |x, y| o.tsf.is_identity() || !kept_back(on_frame(x, window.corner.0, shift.x), on_frame(y, window.corner.1, shift.y));
            Plane::from_fn(mask.width, mask.height, |x, y| if counts(x, y) { mask.at(x, y) } else { 0.0 })
        };
        let seen = |((o, _), (shift, motion)): (&(&Observation, DMat3), &(DVec2, DMat3))| Observation {
            exposure: o.exposure.map_planes(|p| twice(&window.cut(p, *shift, 0, None), |p, x, y| p.at(x / 2, y / 2))),
            mask: twice(&counting(o, *shift), |p, x, y| if (x | y).is_multiple_of(2) { p.at(x / 2, y / 2) } else { 0.0 }),
            exposure_time: o.exposure_time,
            noise: o.noise.clone(),
            black_clipped: o.black_clipped,
            tsf: doubled(motion),
        };
        let seen: Vec<Observation> = sharp.iter().zip(&own).map(seen).collect();
        let start = start.0.map_planes(|p| finer(&window.cut(p, DVec2::splat(start.1 as f64), pad, None)));
        let irradiance = solve(gpu, kernels, &seen, &start, 2 * pad, settings, progress)?.irradiance;
        let means = irradiance.map_planes(coarser);
        Ok(Self { window, pad, irradiance, means })
    }

    /// What the pixel at `q` of a frame shows of the irradiance, and what K makes of its means; `back`: from there to the latent grid, both centred on the
    /// window.
    fn shown(&self, back: &Projection, q: DVec2) -> ([f64; 3], [f64; 3]) {
        let middle = self.window.half() + DVec2::splat(self.pad as f64);
        let mut finer = [0.0; 3];
        for (x, y) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
            let at = back.of(q + DVec2::new(x, y)) + middle;
            let seen = sample(&self.irradiance, Interpolation::Bilinear, 2.0 * at + DVec2::splat(0.5));
            finer.iter_mut().zip(seen).for_each(|(o, v)| *o += 0.25 * v);
        }
        (finer, sample(&self.means, STILL, back.of(q) + middle))
    }

    /// Writes into `out` what a `frame` at `motion` shows of the square of side `tile` whose first pixel is `core`, and into `told` what its pixels that
    /// were kept back say of that.
    fn write(&self, frame: &Observation, motion: &DMat3, core: (usize, usize), tile: usize, out: &mut Rgb, told: &mut Told) {
        let (shift, back) = (self.window.shift(motion), Projection::new(self.window.motion(motion).inverse()));
        let (w, h) = out.size();
        let first = DVec2::new(core.0 as f64, core.1 as f64) - 0.5;
        let corner = DVec2::new(self.window.corner.0 as f64, self.window.corner.1 as f64);
        let one = |k: usize| {
            let here = DVec2::new((k % self.window.size.0) as f64, (k / self.window.size.0) as f64);
            let on_frame = here + corner + shift;
            let q = here - self.window.half();
            let there = back.of(q) + self.window.half() + corner - first;
            let seen = on_frame.min_element() >= 0.0 && on_frame.x < w as f64 && on_frame.y < h as f64;
            let inside = there.min_element() >= 0.0 && there.max_element() < tile as f64;
            (seen && inside).then(|| {
                let at = on_frame.y as usize * w + on_frame.x as usize;
                let (finer, coarse) = self.shown(&back, q);
                let light = |v: [f64; 3]| v.map(|v| (v * frame.exposure_time) as f32);
                let found = light(std::array::from_fn(|c| finer[c] - coarse[c]));
                let said = kept_back(on_frame.x as usize, on_frame.y as usize).then(|| frame.says(at, light(coarse), found));
                (at, found, said.unwrap_or_default())
            })
        };
        let found: Vec<(usize, [f32; 3], [f32; 2])> =
            (0..self.window.size.0 * self.window.size.1).into_par_iter().filter_map(one).collect();
        for (at, values, said) in found {
            out.0.iter_mut().zip(values).for_each(|(p, v)| p.data[at] = v);
            (told.agreement.data[at], told.power.data[at]) = (said[0], said[1]);
        }
    }
}

/// Whether a pixel of a displaced frame is kept from the solution.
fn kept_back(x: usize, y: usize) -> bool {
    let mixed = (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    (mixed ^ (mixed >> 29)).wrapping_mul(0x1656_67b1_9e37_79f9) >> 32 & (KEPT_BACK - 1) == 0
}

/// What the pixels that were kept back say: of what was found there, times what they show beyond the latent grid; and its square. In units of their noise.
struct Told {
    agreement: Plane,
    power: Plane,
}

impl Told {
    /// The part of what was found that they confirm, less where they do not say it clearly: 0..=1.
    fn confirmed(&self) -> Plane {
        let (agreement, power) = (self.agreement.box_sum(WITNESSES), self.power.box_sum(WITNESSES));
        let square = self.agreement.map(|a| a * a).box_sum(WITNESSES);
        let (w, h) = agreement.size();
        Plane::from_fn(w, h, |x, y| {
            let (a, p, s) = (agreement.at(x, y), power.at(x, y), square.at(x, y));
            // The variance of a sum of terms of either sign is the sum of their squares.
            if a > 0.0 && p > 0.0 { (a / (ENOUGH * p)).min(1.0) * (1.0 - s / (a * a)).max(0.0) } else { 0.0 }
        })
    }
}

impl Observation {
    /// What pixel `at` says of the light `found` beyond what K makes of the latent grid, `coarse`: see [`Told`].
    fn says(&self, at: usize, coarse: [f32; 3], found: [f32; 3]) -> [f32; 2] {
        let mut said = [0.0; 2];
        for c in 0..3 {
            let exposure = self.exposure.0[c].data[at];
            // A channel that is clipped says nothing.
            if self.mask.data[at] > 0.0 && exposure > -0.5 {
                let last = (self.noise[c].len() - 1) as f32;
                let noise = self.noise[c][(exposure.clamp(0.0, 1.0).sqrt() * last) as usize];
                said[0] += (exposure - coarse[c]) * found[c] / (noise * noise);
                said[1] += (found[c] / noise).powi(2);
            }
        }
        said
    }
}

/// What each of the sharp frames `observations` shows of structure finer than the latent grid, as a part of its exposure and on its own pixels: to be
/// taken off it before [`solve`]. `None` for a frame in place, or blurred. `start`: irradiance on the frames' grid plus `pad`. The latent grid
/// is worked on in squares of side `tile` ([`TILE`]); `progress` receives the fraction done; returning `false` cancels.
///
/// # Errors
/// As [`solve`].
pub fn aliasing(
    gpu: &Gpu,
    kernels: &Kernels,
    observations: &[Observation],
    start: &Rgb,
    pad: usize,
    settings: &Settings,
    tile: usize,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Vec<Option<Rgb>>> {
    let (w, h) = (start.width() - 2 * pad, start.height() - 2 * pad);
    let sharp: Vec<(&Observation, DMat3)> = observations.iter().filter_map(|o| Some((o, o.tsf.single()?))).collect();
    // Residual-driven weights are for what no grid explains.
    let settings = Settings { prior: Prior::Tv, robust: 0.0, ..settings.clone() };
    let displaced = |o: &&Observation| o.tsf.single().is_some() && !o.tsf.is_identity();
    let mut found: Vec<Option<Rgb>> = observations.iter().map(|o| Some(o).filter(displaced).map(|_| Rgb::filled(w, h, 0.0))).collect();
    let nothing = |_: &Rgb| Told { agreement: Plane::filled(w, h, 0.0), power: Plane::filled(w, h, 0.0) };
    let mut told: Vec<Option<Told>> = found.iter().map(|f| f.as_ref().map(nothing)).collect();
    let cores: Vec<(usize, usize)> = (0..h).step_by(tile).flat_map(|y| (0..w).step_by(tile).map(move |x| (x, y))).collect();
    for (k, &core) in cores.iter().enumerate() {
        let window = Window::around(core, tile, (w, h));
        let mut hear = |f: f32| progress((k as f32 + f) / cores.len() as f32);
        let fine = Fine::solve(gpu, kernels, &sharp, window, (start, pad), &settings, &mut hear)?;
        for ((o, out), told) in observations.iter().zip(&mut found).zip(&mut told) {
            if let (Some(out), Some(told), Some(motion)) = (out, told, o.tsf.single()) {
                fine.write(o, &motion, core, tile, out, told);
            }
        }
    }
    let certain = |((o, out), told): ((&Observation, Option<Rgb>), Option<Told>)| {
        let confirmed = told?.confirmed();
        Some(less_uncertain(&out?, o).map_planes(|p| p.zip(&confirmed, |f, k| f * k)))
    };
    Ok(observations.iter().zip(found).zip(told).map(certain).collect())
}

/// `found` less what the noise of the frame may have made of it: by the part of its mean square around a pixel that noise explains (Wiener).
fn less_uncertain(found: &Rgb, frame: &Observation) -> Rgb {
    let significance = |c: usize| {
        let last = (frame.noise[c].len() - 1) as f32;
        found.0[c].zip(&frame.exposure.0[c], |f, x| (f / frame.noise[c][(x.clamp(0.0, 1.0).sqrt() * last) as usize]).powi(2))
    };
    let squares = Rgb(std::array::from_fn(significance)).mean().box_sum(AROUND);
    let all = ((2 * AROUND + 1) * (2 * AROUND + 1)) as f32;
    let part = squares.map(|s| (1.0 - all * NOISE * NOISE / s.max(f32::MIN_POSITIVE)).max(0.0));
    found.map_planes(|p| p.zip(&part, |f, k| f * k))
}
