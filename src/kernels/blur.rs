//! The blur K of eq. (4) and its exact adjoint Kᵀ, three channels, as base warps and shifts (see [`TapSet`]).

use super::Channels;
use crate::error::Result;
use crate::gpu::{Gpu, Kernel, Step};
use crate::tsf::{Interpolation, TapSet};
use glam::{DMat3, DVec2};

pub(super) const WARP: &str = concat!(
    include_str!("../../shaders/common/plane.wgsl"),
    include_str!("../../shaders/common/pose.wgsl"),
    include_str!("../../shaders/warp.wgsl")
);
pub(super) const WARP_ADJOINT: &str = concat!(
    include_str!("../../shaders/common/plane.wgsl"),
    include_str!("../../shaders/common/pose.wgsl"),
    include_str!("../../shaders/warp_adjoint.wgsl")
);
pub(super) const TAP_SUM: &str = include_str!("../../shaders/tap_sum.wgsl");

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct WarpParams {
    size: [i32; 2],
    scratch_size: [i32; 2],
    scratch_origin: [i32; 2],
    pad: [i32; 2],
    centre: [f32; 2],
    first_base: u32,
    bases: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct WarpAdjointParams {
    warp: WarpParams,
    reach: i32,
    factor: f32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct TapParams {
    in_size: [i32; 2],
    out_size: [i32; 2],
    origin: [i32; 2],
    accumulate: u32,
    first_group: u32,
    span: u32,
    first_plane: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct BaseTable {
    abc: [f32; 4],
    def: [f32; 4],
    abc_inverse: [f32; 4],
    def_inverse: [f32; 4],
}

pub(super) fn params_sizes() -> Vec<(&'static str, usize)> {
    vec![("warp", size_of::<WarpParams>()), ("warp_adjoint", size_of::<WarpAdjointParams>()), ("tap_sum", size_of::<TapParams>())]
}

pub(super) fn table_sizes() -> Vec<(&'static str, &'static str, usize)> {
    vec![("warp", "Base", size_of::<BaseTable>()), ("warp_adjoint", "Base", size_of::<BaseTable>())]
}

/// The compiled kernels of K and Kᵀ.
pub struct BlurKernels {
    warp: Kernel,
    warp_adjoint: Kernel,
    tap_sum: Kernel,
    support: usize,
}

impl BlurKernels {
    /// Compiles them for one interpolation.
    pub fn new(gpu: &Gpu, interpolation: Interpolation) -> Self {
        let support = interpolation.support();
        let constants = [("SUPPORT", support as f64)];
        Self {
            warp: Kernel::new(gpu, "warp", WARP, &constants),
            warp_adjoint: Kernel::new(gpu, "warp_adjoint", WARP_ADJOINT, &constants),
            tap_sum: Kernel::new(gpu, "tap_sum", TAP_SUM, &[]),
            support,
        }
    }
}

/// Displacement `H p - p` in the form of shaders/common/pose.wgsl.
fn displacement_table(h: &DMat3) -> ([f32; 4], [f32; 4]) {
    let h = *h * (1.0 / h.z_axis.z);
    let (x, y, z) = (h.x_axis, h.y_axis, h.z_axis);
    ([(x.x - 1.0) as f32, y.x as f32, z.x as f32, x.z as f32], [x.y as f32, (y.y - 1.0) as f32, z.y as f32, y.z as f32])
}

/// Largest absolute row sum of the Jacobian of `h` over a frame's corners and centre: how far a unit square spreads.
fn spread(h: &DMat3, half: DVec2) -> f64 {
    let mut worst = 0.0f64;
    for s in [DVec2::ZERO, DVec2::new(1.0, 1.0), DVec2::new(-1.0, 1.0), DVec2::new(1.0, -1.0), DVec2::new(-1.0, -1.0)] {
        let p = s * half;
        let (a, e) = (crate::pose::project(h, p), 0.5);
        let dx = (crate::pose::project(h, p + DVec2::new(e, 0.0)) - a) / e;
        let dy = (crate::pose::project(h, p + DVec2::new(0.0, e)) - a) / e;
        worst = worst.max(dx.x.abs() + dy.x.abs()).max(dx.y.abs() + dy.y.abs());
    }
    worst
}

/// Scratch planes for the base warps, shared by all operators of one solver.
pub struct Scratch {
    planes: Channels,
    capacity: usize,
}

impl Scratch {
    /// Scratch of `capacity` values per channel.
    ///
    /// # Errors
    /// As [`Gpu::plane`].
    pub fn new(gpu: &Gpu, capacity: usize) -> Result<Self> {
        Ok(Self { planes: super::channels(gpu, "base warps", capacity)?, capacity })
    }
}

/// K of one frame, which maps the latent grid to the frame, and Kᵀ back.
pub struct Blur {
    latent: (usize, usize),
    frame: (usize, usize),
    pad: usize,
    scratch_size: (usize, usize),
    origin: [i32; 2],
    bases: usize,
    reach: i32,
    base_table: wgpu::Buffer,
    chunks: Vec<Chunk>,
}

/// Appends the runs of consecutive shifts in x of taps sorted by (dy, dx), in the layout of shaders/tap_sum.wgsl.
fn append_runs(taps: &[(i32, i32, f64)], plane: i32, table: &mut Vec<[i32; 4]>) {
    for run in taps.chunk_by(|a, b| a.0 == b.0 && a.1 + 1 == b.1) {
        // Load m is at p - dx with dx descending: weight t[m] belongs to the m-th largest shift.
        let (dy, dx) = (run[0].0, run[run.len() - 1].1);
        let blocks = (run.len() + 7).div_ceil(4);
        table.push([plane, blocks as i32, -dy, -dx]);
        let weight = |m: usize| run.len().checked_sub(m + 1).map_or(0, |i| (run[i].2 as f32).to_bits() as i32);
        table.extend((0..blocks).map(|b| std::array::from_fn(|c| weight(4 * b + c))));
    }
}

/// `vec4i` of a tap table: what 64 KiB, the least that every adapter binds as a uniform, hold.
const TABLE: usize = 4096;
/// Taps of one group at most, so that even taps without neighbours (three entries each) fit a table.
const GROUP_TAPS: usize = 1300;

/// Shifts (dy, dx, weight) of one base warp, sorted.
type Group = Vec<(i32, i32, f64)>;

/// Taps of consecutive base warps that share one table.
struct Chunk {
    first: usize,
    count: usize,
    forward: wgpu::Buffer,
    adjoint: wgpu::Buffer,
}

/// Group index and runs of `groups`, whose first is base warp `first`; the adjoint's taps are mirrored and read the frame.
fn tap_table(groups: &[Group], first: usize, adjoint: bool) -> Vec<[i32; 4]> {
    let mut table = vec![[0i32; 4]; (groups.len() + 1).div_ceil(4)];
    for (g, taps) in groups.iter().enumerate() {
        table[g / 4][g % 4] = table.len() as i32;
        if adjoint {
            let mirrored: Group = taps.iter().rev().map(|t| (-t.0, -t.1, t.2)).collect();
            append_runs(&mirrored, 0, &mut table);
        } else {
            append_runs(taps, (first + g) as i32, &mut table);
        }
    }
    let (n, end) = (groups.len(), table.len() as i32);
    table[n / 4][n % 4] = end;
    table
}

/// As few chunks as hold all groups.
fn chunks(gpu: &Gpu, groups: &[Group]) -> Vec<Chunk> {
    let (mut out, mut first) = (Vec::new(), 0);
    while first < groups.len() {
        let mut count = 1;
        while first + count < groups.len() && tap_table(&groups[first..=first + count], first, false).len() <= TABLE {
            count += 1;
        }
        let table = |adjoint: bool| {
            let mut t = tap_table(&groups[first..first + count], first, adjoint);
            t.resize(TABLE, [0; 4]);
            gpu.uniform("taps", bytemuck::cast_slice(&t))
        };
        out.push(Chunk { first, count, forward: table(false), adjoint: table(true) });
        first += count;
    }
    out
}

impl Blur {
    /// The operator of `taps` from a latent grid, which surrounds the frame by `pad` pixels on every side, to a frame of
    /// `frame` = (width, height) pixels. Irradiance beyond the latent grid counts as 0.
    pub fn new(gpu: &Gpu, kernels: &BlurKernels, taps: &TapSet, frame: (usize, usize), pad: usize) -> Self {
        let range = |f: fn(&crate::tsf::Tap) -> i32| taps.taps.iter().map(f).fold((i32::MAX, i32::MIN), |(a, b), v| (a.min(v), b.max(v)));
        let ((x0, x1), (y0, y1)) = (range(|t| t.dx), range(|t| t.dy));
        let scratch_size = (frame.0 + (x1 - x0) as usize, frame.1 + (y1 - y0) as usize);
        let half = DVec2::new(scratch_size.0 as f64, scratch_size.1 as f64) * 0.5;
        let reach = taps.bases.iter().map(|h| (kernels.support as f64 * spread(h, half) + 0.5).floor() as i32).max().unwrap_or(0);
        // A base warp with more taps than a table holds stands there several times.
        let (mut table, mut groups) = (Vec::new(), Vec::new());
        for (b, h) in taps.bases.iter().enumerate() {
            let ((abc, def), (abc_inverse, def_inverse)) = (displacement_table(&h.inverse()), displacement_table(h));
            let mut own: Group = taps.taps.iter().filter(|t| t.base == b).map(|t| (t.dy, t.dx, t.weight)).collect();
            own.sort_by_key(|t| (t.0, t.1));
            for part in own.chunks(GROUP_TAPS) {
                table.push(BaseTable { abc, def, abc_inverse, def_inverse });
                groups.push(part.to_vec());
            }
        }
        Self {
            latent: (frame.0 + 2 * pad, frame.1 + 2 * pad),
            frame,
            pad,
            scratch_size,
            origin: [-x1, -y1],
            bases: groups.len(),
            reach,
            base_table: gpu.table("base warps", &table),
            chunks: chunks(gpu, &groups),
        }
    }

    /// Values of scratch per channel that let all base warps run in one pass.
    pub fn scratch_wanted(&self) -> usize {
        self.bases * self.scratch_size.0 * self.scratch_size.1
    }

    /// Values of scratch per channel without which the operator cannot run.
    pub fn scratch_needed(&self) -> usize {
        self.scratch_size.0 * self.scratch_size.1
    }

    /// (tap tables, first base, number of bases) of the passes that the scratch allows.
    fn passes(&self, scratch: &Scratch) -> Vec<(&Chunk, usize, usize)> {
        let at_once = (scratch.capacity / self.scratch_needed()).max(1);
        let of_chunk = |c: &'_ Chunk| (c.first..c.first + c.count).step_by(at_once).map(move |b| (b, at_once)).collect::<Vec<_>>();
        self.chunks.iter().flat_map(|c| of_chunk(c).into_iter().map(move |(b, n)| (c, b, n.min(c.first + c.count - b)))).collect()
    }

    fn warp_params(&self, first: usize, bases: usize) -> WarpParams {
        WarpParams {
            size: [self.latent.0 as i32, self.latent.1 as i32],
            scratch_size: [self.scratch_size.0 as i32, self.scratch_size.1 as i32],
            scratch_origin: self.origin,
            pad: [self.pad as i32; 2],
            centre: [(self.frame.0 as f32 - 1.0) / 2.0, (self.frame.1 as f32 - 1.0) / 2.0],
            first_base: first as u32,
            bases: bases as u32,
        }
    }

    /// Steps of `frame = K latent`.
    pub fn forward(&self, gpu: &Gpu, kernels: &BlurKernels, scratch: &Scratch, latent: &Channels, frame: &Channels) -> Vec<Step> {
        let mut steps = Vec::new();
        for (chunk, first, n) in self.passes(scratch) {
            let s = &scratch.planes;
            let buffers = [&self.base_table, &latent[0], &latent[1], &latent[2], &s[0], &s[1], &s[2]];
            steps.push(kernels.warp.step_2d(gpu, &self.warp_params(first, n), &buffers, self.scratch_size, n));
            let params = TapParams {
                in_size: [self.scratch_size.0 as i32, self.scratch_size.1 as i32],
                out_size: [self.frame.0 as i32, self.frame.1 as i32],
                origin: [-self.origin[0], -self.origin[1]],
                accumulate: u32::from(first > 0),
                first_group: (first - chunk.first) as u32,
                span: n as u32,
                first_plane: first as u32,
            };
            let buffers = [&chunk.forward, &s[0], &s[1], &s[2], &frame[0], &frame[1], &frame[2]];
            steps.push(kernels.tap_sum.step_2d(gpu, &params, &buffers, (self.frame.0.div_ceil(8), self.frame.1), 1));
        }
        steps
    }

    /// Steps of `latent += factor Kᵀ frame`.
    pub fn adjoint(
        &self,
        gpu: &Gpu,
        kernels: &BlurKernels,
        scratch: &Scratch,
        frame: &Channels,
        latent: &Channels,
        factor: f32,
    ) -> Vec<Step> {
        let mut steps = Vec::new();
        for (chunk, first, n) in self.passes(scratch) {
            let s = &scratch.planes;
            let params = TapParams {
                in_size: [self.frame.0 as i32, self.frame.1 as i32],
                out_size: [self.scratch_size.0 as i32, self.scratch_size.1 as i32],
                origin: self.origin,
                accumulate: 0,
                first_group: (first - chunk.first) as u32,
                span: 1,
                first_plane: 0,
            };
            let buffers = [&chunk.adjoint, &frame[0], &frame[1], &frame[2], &s[0], &s[1], &s[2]];
            steps.push(kernels.tap_sum.step_2d(gpu, &params, &buffers, (self.scratch_size.0.div_ceil(8), self.scratch_size.1), n));
            let params = WarpAdjointParams { warp: self.warp_params(first, n), reach: self.reach, factor };
            let buffers = [&self.base_table, &s[0], &s[1], &s[2], &latent[0], &latent[1], &latent[2]];
            steps.push(kernels.warp_adjoint.step_2d(gpu, &params, &buffers, self.latent, 1));
        }
        steps
    }
}
