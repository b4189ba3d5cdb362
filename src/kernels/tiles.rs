//! K and Kᵀ a tile at a time: rotate-then-shift in workgroup memory, the design for GPUs; see shaders/common/tile.wgsl. Needs no scratch but
//! what stands for channels that are not there; for warps that turn and stretch little.

use super::geometry::{Geometry, grid, range};
use super::scratch::Scratch;
use super::tables::{BASES, BaseTable, GROUP_TAPS, Group, TABLE, append_group, upload};
use crate::gpu::{Gpu, Kernel, Step};
use std::ops::Range;
use std::sync::OnceLock;

pub(super) const BLUR_TILE: &str = source!("common/plane", "common/pose", "common/output", "common/tile", "common/keep", "blur_tile");
pub(super) const BLUR_TILE_ADJOINT: &str =
    source!("common/plane", "common/pose", "common/output", "common/tile", "common/keep", "blur_tile_adjoint");

/// Pixels along either side of what a workgroup makes (K) or sums shifts for (Kᵀ).
const SIDE: usize = 32;
/// Rows that a column of shaders/common/tile.wgsl may read beyond what its shifts reach, with weight 0.
const BEYOND: usize = 2;
/// Smallest side of a tile of the latent grid with which this design pays.
const LEAST_SIDE: usize = 12;
/// Pixels that one invocation of shaders/blur_tile_adjoint.wgsl makes.
pub(super) const COLUMN: (usize, usize) = (1, 4);

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct TileParams {
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
    ["blur_tile", "blur_tile_adjoint"].map(|s| (s, size_of::<TileParams>())).to_vec()
}

/// Pixels that workgroup memory may hold, of three `f32` each: 16, 20 or 24 KiB, the least that is enough. What a workgroup takes, others that
/// could run beside it do not have: on an H200, 24 KiB take 1.15 times as long as 16, and 32 KiB 1.8 times.
const HELD: [usize; 3] = [1365, 1706, 2048];

/// The compiled kernels, for one channel and for three, each for any base warps and for those that do not foreshorten, by the workgroup memory
/// they take.
#[derive(Default)]
pub(super) struct TileKernels([[[OnceLock<Compiled>; HELD.len()]; 2]; 2]);

impl TileKernels {
    /// Those for `channels` channels at a time that `tiles` need, of an interpolation `support` pixels to either side.
    fn compiled(&self, gpu: &Gpu, support: usize, channels: usize, tiles: &Tiles) -> &Compiled {
        let kernels = &self.0[usize::from(channels > 1)][usize::from(tiles.planar)][tiles.held];
        kernels.get_or_init(|| Compiled::new(gpu, support, channels, tiles.planar, HELD[tiles.held]))
    }
}

struct Compiled {
    /// Overwriting, adding.
    forward: [Kernel; 2],
    adjoint: Kernel,
}

impl Compiled {
    /// Those of one interpolation, for so many channels; `planar` where no base warp foreshortens.
    fn new(gpu: &Gpu, support: usize, channels: usize, planar: bool, held: usize) -> Self {
        let constants =
            [("SUPPORT", support as f64), ("CHANNELS", channels as f64), ("PLANAR", f64::from(u8::from(planar))), ("HELD", held as f64)];
        let kernel = |label, source, add: f64| Kernel::new(gpu, label, source, &[&constants[..], &[("ACCUMULATE", add)]].concat());
        let forward = [0.0, 1.0].map(|add| kernel("blur_tile", BLUR_TILE, add));
        Self { forward, adjoint: kernel("blur_tile_adjoint", BLUR_TILE_ADJOINT, 1.0) }
    }
}

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
    if reach.pixels() <= most && group.len() <= GROUP_TAPS {
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
        append_group(taps, reach.x, reach.y, reach.size.0, adjoint, &mut table);
        let corner = if adjoint { [reach.x.0, reach.y.0] } else { [-reach.x.1, -reach.y.1] };
        let last = groups.get(g + 1).is_none_or(|next| next.0 != *base);
        table[2 * g] = [corner[0], corner[1], reach.size.0 as i32, reach.size.1 as i32];
        table[2 * g + 1] = [first, table.len() as i32, (base % BASES) as i32, i32::from(last)];
    }
    table
}

/// Rows of what K, or Kᵀ, reads whose values it uses for the rows `rows` of what it writes.
fn rows_used(geometry: &Geometry, rows: &Range<usize>, adjoint: bool) -> Range<usize> {
    if adjoint {
        return geometry.rows_seen(rows);
    }
    let read = geometry.rows_read(rows, 0);
    read.start as usize..read.end as usize
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
            // Kᵀ's table is as long: it has the same runs.
            let fits = |end: usize| all[end].0 / BASES == all[first].0 / BASES && table(&all[first..=end], false).len() <= TABLE;
            let mut end = first + 1;
            while end < all.len() && fits(end) {
                end += 1;
            }
            let table = |adjoint: bool| upload(gpu, "shifts", table(&all[first..end], adjoint));
            parts.push(Part { first_base: all[first].0, groups: end - first, forward: table(false), adjoint: table(true) });
            first = end;
        }
        Some(Self { side: side as usize, planar, held, parts })
    }

    /// Size of what K, or Kᵀ, reads, of what it writes, and the side of a tile of that.
    fn grids(&self, geometry: &Geometry, adjoint: bool) -> ((usize, usize), (usize, usize), usize) {
        if adjoint { (geometry.frame, geometry.latent, self.side) } else { (geometry.latent, geometry.frame, SIDE) }
    }

    /// The bands of `rows` rows of what it writes.
    fn bands(&self, geometry: &Geometry, adjoint: bool, rows: usize) -> impl Iterator<Item = Range<usize>> + use<> {
        let all = self.grids(geometry, adjoint).1.1;
        (0..all).step_by(rows).map(move |y| y..(y + rows).min(all))
    }

    /// Rows that one dispatch may make: a multiple of a tile's.
    fn rows(&self, gpu: &Gpu, geometry: &Geometry, adjoint: bool) -> usize {
        let warps = geometry.homographies.len() as f64 * geometry.warp_cost();
        let budget = gpu.dispatch_budget / ((geometry.taps as f64 + warps) * geometry.latent.0 as f64);
        let (input, output, side) = self.grids(geometry, adjoint);
        let fits = |r: Range<usize>| gpu.rows_fit(r.len(), output) && gpu.rows_fit(rows_used(geometry, &r, adjoint).len(), input);
        let mut rows = ((budget as usize).min(output.1.next_multiple_of(side)) / side * side).max(side);
        while rows > side && !self.bands(geometry, adjoint, rows).all(fits) {
            rows = (rows / 2).next_multiple_of(side);
        }
        rows
    }

    /// Rows of either grid that the lowest bands bind at once.
    pub fn rows_at_once(&self, geometry: &Geometry) -> usize {
        let used = |adjoint: bool| {
            let bands = self.bands(geometry, adjoint, self.grids(geometry, adjoint).2);
            bands.map(move |r| rows_used(geometry, &r, adjoint).len())
        };
        used(false).chain(used(true)).fold(SIDE, usize::max)
    }

    /// Steps of `frame = K latent`, or of `latent += factor Kᵀ frame`.
    pub fn steps(
        &self,
        gpu: &Gpu,
        kernels: &TileKernels,
        geometry: &Geometry,
        bases: &BaseTable,
        scratch: &Scratch,
        adjoint: bool,
        from: &[wgpu::Buffer],
        to: &[wgpu::Buffer],
        factor: f32,
    ) -> Vec<Step> {
        let kernels = kernels.compiled(gpu, geometry.support, scratch.channels(), self);
        let (input, output, side) = self.grids(geometry, adjoint);
        let pair = |size: (usize, usize)| [size.0 as i32, size.1 as i32];
        let mut steps = Vec::new();
        for rows in self.bands(geometry, adjoint, self.rows(gpu, geometry, adjoint)) {
            let used = rows_used(geometry, &rows, adjoint);
            let ([r, g, b], in_first) = scratch.rows(gpu, from, input, used.clone(), false);
            let ([x, y, z], out_first) = scratch.rows(gpu, to, output, rows.clone(), true);
            for (p, part) in self.parts.iter().enumerate() {
                let params = TileParams {
                    in_size: pair(input),
                    in_rows: pair((used.start, used.end)),
                    out_size: pair(output),
                    rows: pair((rows.start, rows.end)),
                    pad: [geometry.pad as i32; 2],
                    centre: geometry.centre().as_vec2().to_array(),
                    in_first,
                    out_first,
                    groups: part.groups as i32,
                    side: side as i32,
                    factor,
                    _pad: [0.0; 3],
                };
                let (kernel, table) =
                    if adjoint { (&kernels.adjoint, &part.adjoint) } else { (&kernels.forward[usize::from(p > 0)], &part.forward) };
                let table = table.as_entire_binding();
                let bound = [bases.around(part.first_base), table, x.clone(), y.clone(), z.clone(), r.clone(), g.clone(), b.clone()];
                steps.push(kernel.step_parts(gpu, &params, &bound, grid(pair((output.0, rows.len())), (side, side), 1)));
            }
        }
        steps
    }
}
