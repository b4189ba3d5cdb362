//! What K maps where: its two grids, the base warps between them, how far the shifts reach, and which rows of one grid depend on which of
//! the other. Pure arithmetic for every design of K; knows neither the device nor a kernel.

use crate::pose::project;
use crate::tsf::{TapSet, WARP_COST};
use glam::{DMat3, DVec2};
use std::ops::Range;

/// Grids, base warps and shifts of one K.
pub(super) struct Geometry {
    /// Width and height of the latent grid.
    pub latent: (usize, usize),
    /// The same of the frame, in the latent grid's middle.
    pub frame: (usize, usize),
    /// Pixels by which the latent grid surrounds the frame on every side.
    pub pad: usize,
    /// Half-width of the interpolation.
    pub support: usize,
    /// Smallest and largest shift in x and in y.
    pub shift_x: (i32, i32),
    pub shift_y: (i32, i32),
    /// Homographies scene to frame, by entry of the base table.
    pub homographies: Vec<DMat3>,
    /// How many taps there are.
    pub taps: usize,
}

/// How far base warps spread what they map.
pub(super) struct Spread {
    /// The largest number of pixels that a unit square spreads to, along either axis.
    pub largest: f64,
    /// Whether they turn and stretch so little that the targets that weigh in any pixel one invocation of an adjoint makes lie in a window
    /// about the target of the middle of them.
    pub near: bool,
}

/// Smallest and largest of `values`.
pub(super) fn range(values: impl Iterator<Item = i32>) -> (i32, i32) {
    values.fold((i32::MAX, i32::MIN), |(a, b), v| (a.min(v), b.max(v)))
}

/// Workgroups that each make `tile` pixels, for `depth` images of `size`.
pub(super) fn grid(size: [i32; 2], tile: (usize, usize), depth: usize) -> [u32; 3] {
    [(size[0] as usize).div_ceil(tile.0) as u32, (size[1] as usize).div_ceil(tile.1) as u32, depth as u32]
}

/// Rows that `h` maps the rectangle of `x` by `y` (centred pixels) to; `None` when part of it lies behind the camera.
fn rows_of(h: &DMat3, x: (f64, f64), y: (f64, f64)) -> Option<(f64, f64)> {
    let mut rows = (f64::INFINITY, f64::NEG_INFINITY);
    for p in [DVec2::new(x.0, y.0), DVec2::new(x.1, y.0), DVec2::new(x.0, y.1), DVec2::new(x.1, y.1)] {
        let q = *h * p.extend(1.0);
        // A projective map with positive denominators takes the rectangle to the hull of its corners.
        if q.z <= 1e-3 * h.z_axis.z.abs() {
            return None;
        }
        rows = (rows.0.min(q.y / q.z), rows.1.max(q.y / q.z));
    }
    Some(rows)
}

/// The rows that any of `maps` takes the rectangle of `x` by `y` (centred pixels) to; all there may be where one cannot say.
fn rows_of_all(maps: impl Iterator<Item = DMat3>, x: (f64, f64), y: (f64, f64)) -> (f64, f64) {
    maps.map(|h| rows_of(&h, x, y).unwrap_or((-1e9, 1e9))).fold((f64::INFINITY, f64::NEG_INFINITY), |r, h| (r.0.min(h.0), r.1.max(h.1)))
}

impl Geometry {
    /// Of `taps` from a latent grid, which surrounds the frame by `pad` pixels on every side, to a frame of `frame` pixels, with the
    /// homographies of the base table.
    pub fn new(taps: &TapSet, homographies: Vec<DMat3>, frame: (usize, usize), pad: usize, support: usize) -> Self {
        Self {
            latent: (frame.0 + 2 * pad, frame.1 + 2 * pad),
            frame,
            pad,
            support,
            shift_x: range(taps.taps.iter().map(|t| t.dx)),
            shift_y: range(taps.taps.iter().map(|t| t.dy)),
            homographies,
            taps: taps.taps.len(),
        }
    }

    /// Columns and rows by which the shifts widen a plane.
    pub fn shifts(&self) -> (usize, usize) {
        ((self.shift_x.1 - self.shift_x.0) as usize, (self.shift_y.1 - self.shift_y.0) as usize)
    }

    /// Columns and rows of a base warp: what the shifts make of the frame.
    pub fn shifted(&self) -> (usize, usize) {
        (self.frame.0 + self.shifts().0, self.frame.1 + self.shifts().1)
    }

    /// The frame's centre, from which homographies count pixels.
    pub fn centre(&self) -> DVec2 {
        DVec2::new(self.frame.0 as f64 - 1.0, self.frame.1 as f64 - 1.0) / 2.0
    }

    /// What a pixel of a base warp costs, in taps.
    pub fn warp_cost(&self) -> f64 {
        WARP_COST * (2 * self.support).pow(2) as f64
    }

    /// How far `bases` spread what they map; `made`: the pixels that one invocation of an adjoint makes, by design.
    pub fn spread(&self, bases: &[DMat3], made: &[(usize, usize)]) -> Spread {
        let s = self.support as f64;
        let all: Vec<(f64, f64)> = bases.iter().map(|h| self.spread_of(h, made)).collect();
        Spread {
            largest: all.iter().map(|d| d.0).fold(0.0, f64::max),
            // The window's centre is within half a pixel of the target of the middle of a tile, the targets of each of whose pixels lie
            // within `s` times the row sum of its own; together less than the next whole pixel.
            near: all.iter().all(|d| s * d.0 + 0.5 + d.1 < s + 0.99),
        }
    }

    /// Over a base warp's corners and centre: the largest absolute row sum of the Jacobian of `h` (how far a unit square spreads), and the
    /// largest change of the displacement `h p - p` from the middle of the pixels that one invocation makes to any of them.
    fn spread_of(&self, h: &DMat3, made: &[(usize, usize)]) -> (f64, f64) {
        let (mut worst, mut drift) = (0.0f64, 0.0f64);
        let half = 0.5 * DVec2::new(self.shifted().0 as f64, self.shifted().1 as f64);
        for s in [DVec2::ZERO, DVec2::new(1.0, 1.0), DVec2::new(-1.0, 1.0), DVec2::new(1.0, -1.0), DVec2::new(-1.0, -1.0)] {
            let p = s * half;
            let (a, e) = (project(h, p), 0.5);
            let dx = (project(h, p + DVec2::new(e, 0.0)) - a) / e;
            let dy = (project(h, p + DVec2::new(0.0, e)) - a) / e;
            worst = worst.max(dx.x.abs() + dy.x.abs()).max(dx.y.abs() + dy.y.abs());
            for t in made.iter().map(|m| DVec2::new(m.0 as f64 - 1.0, m.1 as f64 - 1.0) / 2.0) {
                drift = drift.max(t.x * (dx.x - 1.0).abs() + t.y * dy.x.abs()).max(t.x * dx.y.abs() + t.y * (dy.y - 1.0).abs());
            }
        }
        (worst, drift)
    }

    /// Latent rows, as rows of the grid with `margin` more above and below, that K reads for the base warps' rows `from..to` (frame pixels).
    pub fn latent_rows(&self, from: i32, to: i32, margin: usize) -> Range<i32> {
        let (c, s) = (self.centre(), self.support as f64);
        let x = (f64::from(-self.shift_x.1) - c.x - 1.0, f64::from(-self.shift_x.1) + self.shifted().0 as f64 - c.x);
        let y = (f64::from(from) - c.y, f64::from(to) - 1.0 - c.y);
        let (low, high) = rows_of_all(self.homographies.iter().map(DMat3::inverse), x, y);
        let (low, high) = (low + c.y + self.pad as f64 - s - 1.0, high + c.y + self.pad as f64 + s + 2.0);
        let (first, last) = (-(margin as i32), (self.latent.1 + margin) as i32);
        // Never less than an interpolation's rows: beyond the grid these are the margin, where all is zero.
        let least = 2 * self.support as i32;
        let low = (low.floor().max(-1e8) as i32).clamp(first, (last - least).max(first));
        let high = (high.ceil().min(1e8) as i32).clamp(low.min(last) + least.min(last - low), last);
        low..high
    }

    /// [`Geometry::latent_rows`] for the frame's rows `rows`.
    pub fn rows_read(&self, rows: &Range<usize>, margin: usize) -> Range<i32> {
        self.latent_rows(rows.start as i32 - self.shift_y.1, rows.end as i32 - self.shift_y.0, margin)
    }

    /// Rows of the frame whose values Kᵀ uses for the rows `rows` of the latent grid.
    pub fn rows_seen(&self, rows: &Range<usize>) -> Range<usize> {
        let (c, pad) = (self.centre(), self.pad as f64);
        let x = (-pad - c.x, self.latent.0 as f64 - pad - c.x);
        let y = (rows.start as f64 - pad - c.y, rows.end as f64 - pad - c.y);
        let (low, high) = rows_of_all(self.homographies.iter().copied(), x, y);
        // Other targets weigh nothing, whatever their shifts' sums are.
        let beyond = self.support as f64 + 2.0;
        let last = self.frame.1 as f64;
        let low = (low + c.y - beyond + f64::from(self.shift_y.0)).clamp(0.0, last - 1.0) as usize;
        let high = (high + c.y + beyond + f64::from(self.shift_y.1)).clamp(0.0, last) as usize;
        low..high.max(low + 1)
    }
}
