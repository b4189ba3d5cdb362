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
use crate::sampling::bilinear;
use crate::tsf::{Interpolation, Tsf};
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Side in pixels of the squares of the latent grid that are solved at a time unless something else is asked for: large pictures need no more
/// memory than small ones.
pub const TILE: usize = 448;
/// Pixels around such a square that are solved with it. Of a frame that is turned by more than 4° the corners of squares lie farther off: nothing is taken off
/// there.
const MARGIN: usize = 16;
/// Outer and inner iterations at most: what is found settles before the irradiance does.
const OUTER: usize = 3;
const INNER: usize = 10;
/// What is found counts as noise up to so many of the frame's standard deviations, in squares of side 2 r + 1 around a pixel for this r.
const NOISE: f32 = 0.4;
const AROUND: usize = 2;
/// Side in pixels of the squares over which it is looked at what sharp frames differ by where nothing is finer than the pixels, and how many pixels (of one in
/// four) have to tell.
const SQUARE: usize = 32;
const FEWEST: usize = 64;
/// Those pixels: the quantile of the squared difference over noise variance, mean of three channels, and what noise alone makes of it.
const QUIETEST: f64 = 0.25;
const OF_NOISE: f32 = 0.404;

/// A sharp frame, its place from the latent grid (centred pixels), and by how much less than its noise says it is believed at a pixel, 0..=1.
struct Sharp<'a> {
    frame: &'a Observation,
    motion: DMat3,
    trust: Plane,
}

impl<'a> Sharp<'a> {
    /// `None` for a shaken frame. `start`: irradiance on the frames' grid plus so many pixels. What nobody knows of a tone curve, and noise that a file
    /// format has made smooth, would otherwise be taken for structure between the pixels, which explains any difference.
    fn of(frame: &'a Observation, start: (&Rgb, usize)) -> Option<Self> {
        let motion = frame.tsf.single()?;
        let (w, h) = frame.mask.size();
        let back = Projection::new(motion.inverse());
        let middle = 0.5 * DVec2::new(w as f64 - 1.0, h as f64 - 1.0);
        let off = |x: usize, y: usize| -> Option<f32> {
            let p = y * w + x;
            if frame.mask.data[p] <= 0.0 || frame.exposure.0.iter().any(|e| e.data[p] < 0.0) {
                return None;
            }
            let seen = sample(start.0, STILL, back.of(DVec2::new(x as f64, y as f64) - middle) + middle + DVec2::splat(start.1 as f64));
            let mut sum = 0.0;
            for (c, seen) in seen.iter().enumerate() {
                let exposure = frame.exposure.0[c].data[p];
                sum += ((exposure - (seen * frame.exposure_time) as f32) / deviation(frame, c, exposure)).powi(2) / 3.0;
            }
            Some(sum)
        };
        let trusted = |k: usize| {
            let (x, y) = (k % w.div_ceil(SQUARE) * SQUARE, k / w.div_ceil(SQUARE) * SQUARE);
            let pixels = (y..(y + SQUARE).min(h)).step_by(2).flat_map(|j| (x..(x + SQUARE).min(w)).step_by(2).map(move |i| (i, j)));
            let mut found: Vec<f32> = pixels.filter_map(|(i, j)| off(i, j)).collect();
            if found.len() < FEWEST {
                return 1.0;
            }
            let at = (QUIETEST * found.len() as f64) as usize;
            let quiet = *found.select_nth_unstable_by(at, f32::total_cmp).1;
            (OF_NOISE / quiet.max(OF_NOISE)).sqrt()
        };
        let (across, down) = (w.div_ceil(SQUARE), h.div_ceil(SQUARE));
        let squares = Plane { width: across, height: down, data: (0..across * down).into_par_iter().map(trusted).collect() };
        // Between the squares' middles: a step would show.
        let middle = |a: usize| (a as f64 + 0.5) / SQUARE as f64 - 0.5;
        let trust = Plane::from_fn(w, h, |x, y| bilinear(&squares, DVec2::new(middle(x), middle(y))));
        Some(Self { frame, motion, trust })
    }
}

/// Standard deviation of channel `c` of `frame` at an exposure.
fn deviation(frame: &Observation, c: usize, exposure: f32) -> f32 {
    let last = (frame.noise[c].len() - 1) as f32;
    frame.noise[c][(exposure.clamp(0.0, 1.0).sqrt() * last) as usize]
}

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
        sharp: &[Sharp],
        window: Window,
        start: (&Rgb, usize),
        settings: &Settings,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Self> {
        let own: Vec<(DVec2, DMat3)> = sharp.iter().map(|s| (window.shift(&s.motion), window.motion(&s.motion))).collect();
        let still: Vec<Tsf> = own.iter().map(|(_, m)| Tsf::still(*m)).collect();
        let pad = pad_for(&still.iter().collect::<Vec<_>>(), window.size.0, window.size.1, MARGIN);
        let twice = |p: &Plane, f: fn(&Plane, usize, usize) -> f32| Plane::from_fn(2 * p.width, 2 * p.height, |x, y| f(p, x, y));
        let seen = |(Sharp { frame: o, trust, .. }, (shift, motion)): (&Sharp, &(DVec2, DMat3))| Observation {
            exposure: o.exposure.map_planes(|p| twice(&window.cut(p, *shift, 0, None), |p, x, y| p.at(x / 2, y / 2))),
            mask: twice(&window.cut(&o.mask, *shift, 0, Some(0.0)).zip(&window.cut(trust, *shift, 0, None), |m, t| m * t), |p, x, y| {
                if (x | y).is_multiple_of(2) { p.at(x / 2, y / 2) } else { 0.0 }
            }),
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

    /// What the pixel at `q` of a frame shows of the irradiance less what K makes of its means; `back`: from there to the latent grid, both centred on the
    /// window.
    fn difference(&self, back: &Projection, q: DVec2) -> [f64; 3] {
        let middle = self.window.half() + DVec2::splat(self.pad as f64);
        let mut out = sample(&self.means, STILL, back.of(q) + middle).map(|v| -v);
        for (x, y) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
            let at = back.of(q + DVec2::new(x, y)) + middle;
            let seen = sample(&self.irradiance, Interpolation::Bilinear, 2.0 * at + DVec2::splat(0.5));
            out.iter_mut().zip(seen).for_each(|(o, v)| *o += 0.25 * v);
        }
        out
    }

    /// Writes into `out` what a frame at `motion` with that exposure time shows of the square of side `tile` whose first pixel is `core`.
    fn write(&self, motion: &DMat3, exposure_time: f64, core: (usize, usize), tile: usize, out: &mut Rgb) {
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
            let at = || on_frame.y as usize * w + on_frame.x as usize;
            (seen && inside).then(|| (at(), self.difference(&back, q).map(|v| (v * exposure_time) as f32)))
        };
        let found: Vec<(usize, [f32; 3])> = (0..self.window.size.0 * self.window.size.1).into_par_iter().filter_map(one).collect();
        for (at, values) in found {
            out.0.iter_mut().zip(values).for_each(|(p, v)| p.data[at] = v);
        }
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
    let sharp: Vec<Sharp> = observations.iter().filter_map(|o| Sharp::of(o, (start, pad))).collect();
    // Residual-driven weights are for what no grid explains.
    let (outer, inner) = (settings.outer.min(OUTER), settings.inner.min(INNER));
    let settings = Settings { prior: Prior::Tv, robust: 0.0, outer, inner, ..settings.clone() };
    let displaced = |o: &&Observation| o.tsf.single().is_some() && !o.tsf.is_identity();
    let mut found: Vec<Option<Rgb>> = observations.iter().map(|o| Some(o).filter(displaced).map(|_| Rgb::filled(w, h, 0.0))).collect();
    let cores: Vec<(usize, usize)> = (0..h).step_by(tile).flat_map(|y| (0..w).step_by(tile).map(move |x| (x, y))).collect();
    for (k, &core) in cores.iter().enumerate() {
        let window = Window::around(core, tile, (w, h));
        let mut hear = |f: f32| progress((k as f32 + f) / cores.len() as f32);
        let fine = Fine::solve(gpu, kernels, &sharp, window, (start, pad), &settings, &mut hear)?;
        for (o, out) in observations.iter().zip(&mut found) {
            if let (Some(out), Some(motion)) = (out, o.tsf.single()) {
                fine.write(&motion, o.exposure_time, core, tile, out);
            }
        }
    }
    let trust = |o: &Observation| sharp.iter().find(|s| std::ptr::eq(s.frame, o)).map(|s| &s.trust);
    let certain = |(o, out): (&Observation, Option<Rgb>)| Some(less_uncertain(&out?, o, trust(o)?));
    Ok(observations.iter().zip(found).map(certain).collect())
}

/// `found` less what the noise of the frame, believed as `trust` has it, may have made of it: by the part of its mean square around a pixel that noise explains
/// (Wiener).
fn less_uncertain(found: &Rgb, frame: &Observation, trust: &Plane) -> Rgb {
    let significance = |c: usize| found.0[c].zip(&frame.exposure.0[c], |f, x| (f / deviation(frame, c, x)).powi(2));
    let squares = Rgb(std::array::from_fn(significance)).mean().zip(trust, |s, t| s * t * t).box_sum(AROUND);
    let all = ((2 * AROUND + 1) * (2 * AROUND + 1)) as f32;
    let part = squares.map(|s| (1.0 - all * NOISE * NOISE / s.max(f32::MIN_POSITIVE)).max(0.0));
    found.map_planes(|p| p.zip(&part, |f, k| f * k))
}
