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
    forward_taps: wgpu::Buffer,
    adjoint_taps: wgpu::Buffer,
}

/// Appends the runs of consecutive shifts in x of taps sorted by (dy, dx), in the layout of shaders/tap_sum.wgsl.
fn append_runs(taps: &[(i32, i32, f64)], plane: i32, table: &mut Vec<[i32; 4]>) {
    for run in taps.chunk_by(|a, b| a.0 == b.0 && a.1 + 1 == b.1) {
        // Load m is at p - dx with dx descending: weight t[m] belongs to the m-th largest shift.
        let (dy, dx) = (run[0].0, run[run.len() - 1].1);
        let blocks = (run.len() + 3).div_ceil(4);
        table.push([plane, blocks as i32, -dy, -dx]);
        let weight = |m: usize| run.len().checked_sub(m + 1).map_or(0, |i| (run[i].2 as f32).to_bits() as i32);
        table.extend((0..blocks).map(|b| std::array::from_fn(|c| weight(4 * b + c))));
    }
}

/// Group index and runs of all groups.
fn tap_table(groups: &[(i32, Vec<(i32, i32, f64)>)]) -> Vec<[i32; 4]> {
    let head = (groups.len() + 1).div_ceil(4);
    let mut table = vec![[0i32; 4]; head];
    for (g, (plane, taps)) in groups.iter().enumerate() {
        table[g / 4][g % 4] = table.len() as i32;
        append_runs(taps, *plane, &mut table);
    }
    let (n, end) = (groups.len(), table.len() as i32);
    table[n / 4][n % 4] = end;
    table
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
        let table: Vec<BaseTable> = taps
            .bases
            .iter()
            .map(|h| {
                let ((abc, def), (abc_inverse, def_inverse)) = (displacement_table(&h.inverse()), displacement_table(h));
                BaseTable { abc, def, abc_inverse, def_inverse }
            })
            .collect();
        let of_base = |b: usize, sign: i32| {
            let mut t: Vec<_> = taps.taps.iter().filter(|t| t.base == b).map(|t| (sign * t.dy, sign * t.dx, t.weight)).collect();
            t.sort_by_key(|t| (t.0, t.1));
            t
        };
        let groups =
            |sign: i32| -> Vec<_> { (0..taps.bases.len()).map(|b| (if sign > 0 { b as i32 } else { 0 }, of_base(b, sign))).collect() };
        Self {
            latent: (frame.0 + 2 * pad, frame.1 + 2 * pad),
            frame,
            pad,
            scratch_size,
            origin: [-x1, -y1],
            bases: taps.bases.len(),
            reach,
            base_table: gpu.table("base warps", &table),
            forward_taps: gpu.table("taps", &tap_table(&groups(1))),
            adjoint_taps: gpu.table("mirrored taps", &tap_table(&groups(-1))),
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

    /// (first base, number of bases) of the passes that the scratch allows.
    fn passes(&self, scratch: &Scratch) -> Vec<(usize, usize)> {
        let at_once = (scratch.capacity / self.scratch_needed()).clamp(1, self.bases);
        (0..self.bases).step_by(at_once).map(|b| (b, at_once.min(self.bases - b))).collect()
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
        for (first, n) in self.passes(scratch) {
            let s = &scratch.planes;
            let buffers = [&self.base_table, &latent[0], &latent[1], &latent[2], &s[0], &s[1], &s[2]];
            steps.push(kernels.warp.step_2d(gpu, &self.warp_params(first, n), &buffers, self.scratch_size, n));
            let params = TapParams {
                in_size: [self.scratch_size.0 as i32, self.scratch_size.1 as i32],
                out_size: [self.frame.0 as i32, self.frame.1 as i32],
                origin: [-self.origin[0], -self.origin[1]],
                accumulate: u32::from(first > 0),
                first_group: first as u32,
                span: n as u32,
                first_plane: first as u32,
            };
            let buffers = [&self.forward_taps, &s[0], &s[1], &s[2], &frame[0], &frame[1], &frame[2]];
            steps.push(kernels.tap_sum.step_2d(gpu, &params, &buffers, (self.frame.0.div_ceil(4), self.frame.1), 1));
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
        for (first, n) in self.passes(scratch) {
            let s = &scratch.planes;
            let params = TapParams {
                in_size: [self.frame.0 as i32, self.frame.1 as i32],
                out_size: [self.scratch_size.0 as i32, self.scratch_size.1 as i32],
                origin: self.origin,
                accumulate: 0,
                first_group: first as u32,
                span: 1,
                first_plane: 0,
            };
            let buffers = [&self.adjoint_taps, &frame[0], &frame[1], &frame[2], &s[0], &s[1], &s[2]];
            steps.push(kernels.tap_sum.step_2d(gpu, &params, &buffers, (self.scratch_size.0.div_ceil(4), self.scratch_size.1), n));
            let params = WarpAdjointParams { warp: self.warp_params(first, n), reach: self.reach, factor };
            let buffers = [&self.base_table, &s[0], &s[1], &s[2], &latent[0], &latent[1], &latent[2]];
            steps.push(kernels.warp_adjoint.step_2d(gpu, &params, &buffers, self.latent, 1));
        }
        steps
    }
}
