//! K and Kᵀ a tile at a time in workgroup memory: the design for GPUs, see shaders/common/tile.wgsl.

use super::blur::{BASES, Blur, BlurKernels, Group, Scratch, TABLE, append_runs, grid, rows_of};
use crate::gpu::{Gpu, Kernel, Step};
use std::ops::Range;

pub(super) const BLUR_TILE: &str = source!("common/plane", "common/pose", "common/tile", "common/keep", "blur_tile");
pub(super) const BLUR_TILE_ADJOINT: &str = source!("common/plane", "common/pose", "common/tile", "common/keep", "blur_tile_adjoint");

/// Pixels along either side of what a workgroup makes (K) or sums shifts for (Kᵀ).
const SIDE: usize = 32;
/// Rows that a column of shaders/common/tile.wgsl may read beyond what its shifts reach, with weight 0.
const BEYOND: usize = 2;
/// Smallest side of a tile of the latent grid with which this design pays.
const LEAST_SIDE: usize = 12;

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct TileParams {
    in_size: [i32; 2],
    in_rows: [i32; 2],
    offset: [i32; 2],
    out_size: [i32; 2],
    rows: [i32; 2],
    centre: [f32; 2],
    in_first: i32,
    out_first: i32,
    groups: i32,
    _pad: i32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct TileAdjointParams {
    in_size: [i32; 2],
    in_rows: [i32; 2],
    out_size: [i32; 2],
    rows: [i32; 2],
    pad: [i32; 2],
    centre: [f32; 2],
    in_first: i32,
    out_first: i32,
    groups: i32,
    side: i32,
    factor: f32,
    _pad: [f32; 3],
}

pub(super) fn params_sizes() -> Vec<(&'static str, usize)> {
    vec![("blur_tile", size_of::<TileParams>()), ("blur_tile_adjoint", size_of::<TileAdjointParams>())]
}

/// The compiled kernels.
pub(super) struct TileKernels {
    /// Overwriting, adding.
    forward: [Kernel; 2],
    adjoint: Kernel,
}

impl TileKernels {
    /// Those of one interpolation, for so many channels; `planar` where no base warp foreshortens.
    fn new(gpu: &Gpu, support: usize, channels: usize, planar: bool, held: usize) -> Self {
        let constants =
            [("SUPPORT", support as f64), ("CHANNELS", channels as f64), ("PLANAR", f64::from(u8::from(planar))), ("HELD", held as f64)];
        let forward = |add: f64| Kernel::new(gpu, "blur_tile", BLUR_TILE, &[&constants[..], &[("ACCUMULATE", add)]].concat());
        Self { forward: [forward(0.0), forward(1.0)], adjoint: Kernel::new(gpu, "blur_tile_adjoint", BLUR_TILE_ADJOINT, &constants) }
    }
}

/// Pixels that workgroup memory may hold, of three `f32` each: 16, 20 or 24 KiB, the least that is enough. What a workgroup takes, others that
/// could run beside it do not have: on an H200, 24 KiB take 1.15 times as long as 16, and 32 KiB 1.8 times.
pub(super) const HELD: [usize; 3] = [1365, 1706, 2048];

/// What an operator needs to run by tiles.
pub(super) struct Tiles {
    /// Pixels along either side of a tile of the latent grid.
    side: usize,
    planar: bool,
    /// Which of [`HELD`].
    held: usize,
    parts: Vec<Part>,
}

/// Groups of shifts whose table is bound together.
struct Part {
    /// Base warp from which on 512 are bound.
    first_base: usize,
    groups: usize,
    forward: wgpu::Buffer,
    adjoint: wgpu::Buffer,
}

/// Smallest and largest of `values`.
fn range(values: impl Iterator<Item = i32>) -> (i32, i32) {
    values.fold((i32::MAX, i32::MIN), |(a, b), v| (a.min(v), b.max(v)))
}

/// Columns and rows that the shifts of `group` read for a tile, and the smallest and the largest shift.
struct Reach {
    size: (usize, usize),
    x: (i32, i32),
    y: (i32, i32),
}

impl Reach {
    fn of(group: &Group) -> Self {
        let (x, y) = (range(group.iter().map(|t| t.0)), range(group.iter().map(|t| t.1)));
        Self { size: (SIDE + (x.1 - x.0) as usize, SIDE + (y.1 - y.0) as usize), x, y }
    }

    fn pixels(&self) -> usize {
        self.size.0 * (self.size.1 + BEYOND)
    }
}

/// `group`, sorted, in parts whose boxes have no more than `most` pixels and whose entries fit a table.
fn split(group: Group, most: usize, out: &mut Vec<Group>) {
    let reach = Reach::of(&group);
    if reach.pixels() <= most && group.len() <= super::blur::GROUP_TAPS {
        return out.push(group);
    }
    let across = reach.size.0 >= reach.size.1;
    let middle = if across { (reach.x.0 + reach.x.1).div_euclid(2) } else { (reach.y.0 + reach.y.1).div_euclid(2) };
    let (low, high): (Group, Group) = group.into_iter().partition(|t| if across { t.0 <= middle } else { t.1 <= middle });
    split(low, most, out);
    split(high, most, out);
}

/// The table of shaders/common/tile.wgsl for `groups`, each a base warp and its shifts.
fn table(groups: &[(usize, Group)], adjoint: bool) -> Vec<[i32; 4]> {
    let mut table = vec![[0i32; 4]; 2 * groups.len()];
    for (g, (base, taps)) in groups.iter().enumerate() {
        let reach = Reach::of(taps);
        let first = table.len() as i32;
        // K reads base warps at p - shift, Kᵀ the frame at q + shift; both from the corner that the farthest shift reaches.
        let corner = if adjoint {
            let places: Group = taps.iter().map(|t| (t.0 - reach.x.0, t.1 - reach.y.0, t.2)).collect();
            append_runs(&places, reach.size.0, &mut table);
            [reach.x.0, reach.y.0]
        } else {
            let places: Group = taps.iter().rev().map(|t| (reach.x.1 - t.0, reach.y.1 - t.1, t.2)).collect();
            append_runs(&places, reach.size.0, &mut table);
            [-reach.x.1, -reach.y.1]
        };
        let last = groups.get(g + 1).is_none_or(|next| next.0 != *base);
        table[2 * g] = [corner[0], corner[1], reach.size.0 as i32, reach.size.1 as i32];
        table[2 * g + 1] = [first, table.len() as i32, (base % BASES) as i32, i32::from(last)];
    }
    table
}

impl Tiles {
    /// For base warps that spread a unit square to `spread` pixels at most, with their `groups` of shifts; `None` where tiles do not pay.
    pub fn new(gpu: &Gpu, support: usize, spread: f64, planar: bool, groups: &[Group]) -> Option<Self> {
        // The targets of a tile, which reach `spread` times half its side and the interpolation's half-width beyond its middle's target,
        // lie within half of SIDE - 1 of that, less half a pixel that rounding takes.
        let half = (SIDE as f64 - 1.0) / 2.0 - 0.5;
        let side = (1.0 + 2.0 * (half / spread - support as f64) - 1e-3).floor();
        let sizes = HELD.iter().filter(|h| 3 * **h <= gpu.max_workgroup());
        let most = *sizes.last().filter(|_| side >= LEAST_SIDE as f64)?;
        let mut all = Vec::new();
        for (base, group) in groups.iter().enumerate() {
            let mut parts = Vec::new();
            split(group.clone(), most, &mut parts);
            all.extend(parts.into_iter().map(|g| (base, g)));
        }
        let largest = all.iter().map(|(_, g)| Reach::of(g).pixels()).max().unwrap_or(0);
        let held = HELD.iter().position(|h| *h >= largest)?;
        let (mut parts, mut first) = (Vec::new(), 0);
        while first < all.len() {
            let fits = |end: usize| {
                all[end].0 / BASES == all[first].0 / BASES
                    && table(&all[first..=end], false).len().max(table(&all[first..=end], true).len()) <= TABLE
            };
            let mut end = first + 1;
            while end < all.len() && fits(end) {
                end += 1;
            }
            let upload = |adjoint: bool| {
                let mut t = table(&all[first..end], adjoint);
                t.resize(TABLE, [0; 4]);
                gpu.uniform("shifts", bytemuck::cast_slice(&t))
            };
            parts.push(Part { first_base: all[first].0, groups: end - first, forward: upload(false), adjoint: upload(true) });
            first = end;
        }
        Some(Self { side: side as usize, planar, held, parts })
    }
}

impl BlurKernels {
    fn tiles(&self, gpu: &Gpu, channels: usize, tiles: &Tiles) -> &TileKernels {
        let kernels = &self.tiles[usize::from(channels > 1)][usize::from(tiles.planar)][tiles.held];
        kernels.get_or_init(|| TileKernels::new(gpu, self.support, channels, tiles.planar, HELD[tiles.held]))
    }
}

impl Blur {
    /// Rows of the latent grid whose values K uses for the frame's rows `rows`.
    fn rows_read(&self, rows: &Range<usize>) -> Range<usize> {
        let read = self.latent_rows(rows.start as i32 - self.shift_y.1, rows.end as i32 - self.shift_y.0, 0);
        read.start as usize..read.end as usize
    }

    /// Rows of the frame whose values Kᵀ uses for the rows `rows` of the latent grid.
    fn rows_seen(&self, rows: &Range<usize>) -> Range<usize> {
        let (c, pad) = (self.centre(), self.pad as f64);
        let x = (-pad - c.x, self.latent.0 as f64 - pad - c.x);
        let y = (rows.start as f64 - pad - c.y, rows.end as f64 - pad - c.y);
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for h in &self.homographies {
            let (a, b) = rows_of(h, x, y).unwrap_or((-1e9, 1e9));
            (low, high) = (low.min(a), high.max(b));
        }
        // Other targets weigh nothing, whatever their shifts' sums are.
        let beyond = self.support as f64 + 2.0;
        let last = self.frame.1 as f64;
        let low = (low + c.y - beyond + f64::from(self.shift_y.0)).clamp(0.0, last - 1.0) as usize;
        let high = (high + c.y + beyond + f64::from(self.shift_y.1)).clamp(0.0, last) as usize;
        low..high.max(low + 1)
    }

    /// Frame rows of K, latent rows of Kᵀ that one dispatch may make: multiples of a tile's.
    fn tile_rows(&self, gpu: &Gpu, tiles: &Tiles) -> (usize, usize) {
        let warps = self.homographies.len() as f64 * crate::tsf::WARP_COST * (2 * self.support).pow(2) as f64;
        let budget = gpu.dispatch_budget / ((self.taps as f64 + warps) * self.latent.0 as f64);
        let cut = |side: usize, all: usize, fits: &dyn Fn(Range<usize>) -> bool| {
            let mut rows = (budget as usize).min(all.next_multiple_of(side)) / side * side;
            rows = rows.max(side);
            while rows > side && !(0..all).step_by(rows).all(|y| fits(y..(y + rows).min(all))) {
                rows = (rows / 2).next_multiple_of(side);
            }
            rows
        };
        let forward =
            cut(SIDE, self.frame.1, &|r| gpu.rows_fit(r.len(), self.frame) && gpu.rows_fit(self.rows_read(&r).len(), self.latent));
        let adjoint =
            cut(tiles.side, self.latent.1, &|r| gpu.rows_fit(r.len(), self.latent) && gpu.rows_fit(self.rows_seen(&r).len(), self.frame));
        (forward, adjoint)
    }

    /// Rows of either grid that the lowest bands bind at once.
    pub(super) fn tile_rows_at_once(&self, tiles: &Tiles) -> usize {
        let read = (0..self.frame.1).step_by(SIDE).map(|y| self.rows_read(&(y..(y + SIDE).min(self.frame.1))).len());
        let seen = (0..self.latent.1).step_by(tiles.side).map(|y| self.rows_seen(&(y..(y + tiles.side).min(self.latent.1))).len());
        read.chain(seen).fold(SIDE, usize::max)
    }

    /// [`Blur::forward`] by tiles.
    pub(super) fn forward_tiles(
        &self,
        gpu: &Gpu,
        kernels: &BlurKernels,
        tiles: &Tiles,
        scratch: &Scratch,
        latent: &[wgpu::Buffer],
        frame: &[wgpu::Buffer],
    ) -> Vec<Step> {
        let kernels = kernels.tiles(gpu, scratch.channels(), tiles);
        let at_once = self.tile_rows(gpu, tiles).0;
        let mut steps = Vec::new();
        for from in (0..self.frame.1).step_by(at_once) {
            let rows = from..(from + at_once).min(self.frame.1);
            let read = self.rows_read(&rows);
            let ([r, g, b], in_first) = scratch.rows(gpu, latent, self.latent, read.clone(), false);
            let ([x, y, z], out_first) = scratch.rows(gpu, frame, self.frame, rows.clone(), true);
            for (p, part) in tiles.parts.iter().enumerate() {
                let params = TileParams {
                    in_size: [self.latent.0 as i32, self.latent.1 as i32],
                    in_rows: [read.start as i32, read.end as i32],
                    offset: [self.pad as i32; 2],
                    out_size: [self.frame.0 as i32, self.frame.1 as i32],
                    rows: [rows.start as i32, rows.end as i32],
                    centre: self.centre().as_vec2().to_array(),
                    in_first,
                    out_first,
                    groups: part.groups as i32,
                    _pad: 0,
                };
                let bound = [
                    self.bases(part.first_base),
                    part.forward.as_entire_binding(),
                    x.clone(),
                    y.clone(),
                    z.clone(),
                    r.clone(),
                    g.clone(),
                    b.clone(),
                ];
                let groups = grid([self.frame.0 as i32, rows.len() as i32], (SIDE, SIDE), 1);
                steps.push(kernels.forward[usize::from(p > 0)].step_parts(gpu, &params, &bound, groups));
            }
        }
        steps
    }

    /// [`Blur::adjoint`] by tiles.
    pub(super) fn adjoint_tiles(
        &self,
        gpu: &Gpu,
        kernels: &BlurKernels,
        tiles: &Tiles,
        scratch: &Scratch,
        frame: &[wgpu::Buffer],
        latent: &[wgpu::Buffer],
        factor: f32,
    ) -> Vec<Step> {
        let kernels = kernels.tiles(gpu, scratch.channels(), tiles);
        let at_once = self.tile_rows(gpu, tiles).1;
        let mut steps = Vec::new();
        for from in (0..self.latent.1).step_by(at_once) {
            let rows = from..(from + at_once).min(self.latent.1);
            let seen = self.rows_seen(&rows);
            let ([r, g, b], in_first) = scratch.rows(gpu, frame, self.frame, seen.clone(), false);
            let ([x, y, z], out_first) = scratch.rows(gpu, latent, self.latent, rows.clone(), true);
            for part in &tiles.parts {
                let params = TileAdjointParams {
                    in_size: [self.frame.0 as i32, self.frame.1 as i32],
                    in_rows: [seen.start as i32, seen.end as i32],
                    out_size: [self.latent.0 as i32, self.latent.1 as i32],
                    rows: [rows.start as i32, rows.end as i32],
                    pad: [self.pad as i32; 2],
                    centre: self.centre().as_vec2().to_array(),
                    in_first,
                    out_first,
                    groups: part.groups as i32,
                    side: tiles.side as i32,
                    factor,
                    _pad: [0.0; 3],
                };
                let bound = [
                    self.bases(part.first_base),
                    part.adjoint.as_entire_binding(),
                    x.clone(),
                    y.clone(),
                    z.clone(),
                    r.clone(),
                    g.clone(),
                    b.clone(),
                ];
                let groups = grid([self.latent.0 as i32, rows.len() as i32], (tiles.side, tiles.side), 1);
                steps.push(kernels.adjoint.step_parts(gpu, &params, &bound, groups));
            }
        }
        steps
    }
}
