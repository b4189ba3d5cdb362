//! K and Kᵀ through scratch, in two designs that run on any device:
//!
//! * rotate-then-shift: every base warp into a scratch plane, then the sum of shifted planes. Loads little, needs scratch.
//! * direct: every pose warped straight into the sum. For a set whose taps shift nothing (a pose of its own per tap), above all for a
//!   frame with a single pose.
//!
//! Both run in bands of frame rows, as tall as scratch, bindings and the time that a dispatch may take allow. K computes a band of the
//! frame from the scratch rows that its shifts reach; Kᵀ adds to the latent grid what a band of scratch rows holds. What either reads is
//! copied with a margin of zeros first.

use super::geometry::{Geometry, Spread, grid};
use super::scratch::{Scratch, ScratchSize};
use super::tables::{BASES, BaseTable, Group, TABLE, append_group, upload};
use crate::gpu::{Gpu, Kernel, Step};
use std::ops::Range;
use std::sync::OnceLock;

/// How pixels of scratch are read and written, on GPUs and by software rasterisers.
const IMAGE: [&str; 2] = [source!("common/image"), source!("common/image_storage")];
const PLANES: [&str; 2] = [source!("common/planes"), source!("common/planes_storage")];
/// What stands for a pixel of three channels, and of one, in those sources: types that no constant changes.
const ONE_CHANNEL: [&[(&str, &str)]; 2] =
    [&[("array<vec4f>", "array<f32>"), ("vec4f(value, 0.0)", "value.x")], &[("rgba32float", "r32float")]];
pub(super) const PADDED: &str = source!("common/plane", "common/texels", "common/planes", "padded");
pub(super) const WARP: &str =
    source!("common/plane", "common/texels", "common/image", "common/planes", "common/pose", "common/warp", "warp");
pub(super) const WARP_DIRECT: &str =
    source!("common/plane", "common/texels", "common/image", "common/pose", "common/warp", "common/output", "warp_direct");
pub(super) const WARP_ADJOINT: &str =
    source!("common/plane", "common/texels", "common/image", "common/pose", "common/adjoint", "warp_adjoint");
pub(super) const WARP_ADJOINT_NEAR: &str =
    source!("common/plane", "common/texels", "common/image", "common/pose", "common/adjoint", "warp_adjoint_near");
pub(super) const TAP_SUM: &str = source!("common/texels", "common/image", "common/taps", "common/keep", "common/output", "tap_sum");
pub(super) const TAP_ADJOINT: &str = source!("common/texels", "common/image", "common/planes", "common/taps", "common/keep", "tap_adjoint");

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct PaddedParams {
    in_size: [i32; 2],
    out_size: [i32; 2],
    origin: [i32; 2],
    in_first: i32,
    _pad: i32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct WarpParams {
    in_size: [i32; 2],
    offset: [i32; 2],
    out_size: [i32; 2],
    out_origin: [i32; 2],
    centre: [f32; 2],
    out_first: i32,
    first_base: u32,
    span: u32,
    _pad: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct WarpAdjointParams {
    size: [i32; 2],
    in_size: [i32; 2],
    in_origin: [i32; 2],
    pad: [i32; 2],
    centre: [f32; 2],
    rows: [i32; 2],
    out_first: i32,
    plane: u32,
    first_base: u32,
    bases: u32,
    reach: i32,
    factor: f32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct TapParams {
    out_size: [i32; 2],
    in_stride: i32,
    in_plane: i32,
    first_group: u32,
    span: u32,
    out_first: i32,
    _pad: u32,
}

pub(super) fn params_sizes() -> Vec<(&'static str, usize)> {
    vec![
        ("padded", size_of::<PaddedParams>()),
        ("warp", size_of::<WarpParams>()),
        ("warp_direct", size_of::<WarpParams>()),
        ("warp_adjoint", size_of::<WarpAdjointParams>()),
        ("warp_adjoint_near", size_of::<WarpAdjointParams>()),
        ("tap_sum", size_of::<TapParams>()),
        ("tap_adjoint", size_of::<TapParams>()),
    ]
}

/// The compiled kernels, for one channel and for three.
#[derive(Default)]
pub(super) struct BandKernels([OnceLock<Compiled>; 2]);

struct Compiled {
    padded: Kernel,
    warp: Kernel,
    /// Overwriting, adding.
    warp_direct: [Kernel; 2],
    warp_adjoint: Kernel,
    warp_adjoint_near: Kernel,
    /// Overwriting, adding.
    tap_sum: [Kernel; 2],
    tap_adjoint: Kernel,
}

impl BandKernels {
    /// Those for `channels` channels at a time, of an interpolation `support` pixels to either side.
    fn compiled(&self, gpu: &Gpu, support: usize, channels: usize) -> &Compiled {
        self.0[usize::from(channels > 1)].get_or_init(|| {
            let (support, together) = (("SUPPORT", support as f64), ("CHANNELS", channels as f64));
            let kind = usize::from(gpu.software);
            let own = |source: &str| {
                let source = source.replace(IMAGE[0], IMAGE[kind]).replace(PLANES[0], PLANES[kind]);
                let pixel: &[_] = if channels == 1 { ONE_CHANNEL[kind] } else { &[] };
                pixel.iter().fold(source, |source, p| source.replace(p.0, p.1))
            };
            let kernel = |label, source: &str, constants: &[(&str, f64)]| Kernel::new(gpu, label, &own(source), constants);
            let adding = |label, source, constants: &[(&'static str, f64)]| {
                [0.0, 1.0].map(|add| kernel(label, source, &[constants, &[("ACCUMULATE", add)]].concat()))
            };
            Compiled {
                padded: kernel("padded", PADDED, &[together]),
                warp: kernel("warp", WARP, &[support]),
                warp_direct: adding("warp_direct", WARP_DIRECT, &[support, together]),
                warp_adjoint: kernel("warp_adjoint", WARP_ADJOINT, &[support, together]),
                warp_adjoint_near: kernel("warp_adjoint_near", WARP_ADJOINT_NEAR, &[support, together]),
                tap_sum: adding("tap_sum", TAP_SUM, &[together]),
                tap_adjoint: kernel("tap_adjoint", TAP_ADJOINT, &[]),
            }
        })
    }
}

/// How an operator is cut: frame (or scratch) rows per band, bases per pass.
#[derive(Clone, Copy, Debug)]
struct Cut {
    rows: usize,
    bases: usize,
}

/// Pixels of a column that one invocation of shaders/common/taps.wgsl makes.
const TALL: usize = 16;
/// Pixels that one workgroup of shaders/warp.wgsl makes.
const WARP_TILE: (usize, usize) = (256, 4);
/// Pixels that one invocation of shaders/warp_adjoint_near.wgsl makes.
pub(super) const NEAR: (usize, usize) = (4, 2);
/// Zeros around the copy of the latent grid: at least the width of an interpolation.
const MARGIN: usize = 8;
/// Zero columns on either side of the adjoint's planes: at least the window of shaders/warp_adjoint_near.wgsl.
const SIDE: usize = 12;

/// Taps of consecutive base warps that share one table.
struct Chunk {
    first: usize,
    count: usize,
    forward: wgpu::Buffer,
    adjoint: wgpu::Buffer,
}

/// What an operator needs to run in bands.
pub(super) struct Bands {
    near: bool,
    reach: i32,
    direct: bool,
    /// None in the direct design.
    chunks: Vec<Chunk>,
}

/// Pixels per row of a plane of base warps.
fn plane_width(geometry: &Geometry, adjoint: bool) -> usize {
    geometry.shifted().0 + if adjoint { 2 * SIDE } else { 0 }
}

/// Rows of the latent grid with its margin that K reads for the frame's rows `from..to`.
fn forward_band(geometry: &Geometry, from: usize, to: usize) -> Range<i32> {
    geometry.rows_read(&(from..to), MARGIN)
}

/// Most of them that a band of `rows` rows of the frame reads.
fn forward_rows(geometry: &Geometry, rows: usize) -> usize {
    let all = geometry.frame.1;
    (0..all).step_by(rows).map(|y| forward_band(geometry, y, (y + rows).min(all)).len()).max().unwrap_or(0)
}

/// Latent rows that the scratch rows `from..to` add to.
fn adjoint_band(geometry: &Geometry, from: usize, to: usize) -> Range<i32> {
    let first = -geometry.shift_y.1;
    geometry.latent_rows(first + from as i32, first + to as i32, 0)
}

/// Most of them that a band of `rows` scratch rows adds to.
fn adjoint_rows(geometry: &Geometry, rows: usize) -> usize {
    let all = geometry.shifted().1;
    (0..all).step_by(rows).map(|y| adjoint_band(geometry, y, (y + rows).min(all)).len()).max().unwrap_or(0)
}

/// Copies the rows `rows` of `from` (an image of `size`) and the columns from `first` on, `width` of them, into the scratch.
fn copy(
    gpu: &Gpu,
    kernels: &Compiled,
    scratch: &Scratch,
    from: &[wgpu::Buffer],
    size: (usize, usize),
    first: i32,
    width: usize,
    rows: &Range<i32>,
) -> Step {
    let inside = rows.start.clamp(0, size.1 as i32) as usize..rows.end.clamp(0, size.1 as i32) as usize;
    let ([r, g, b], in_first) = scratch.rows(gpu, from, size, inside, false);
    let params = PaddedParams {
        in_size: [size.0 as i32, size.1 as i32],
        out_size: [width as i32, rows.len() as i32],
        origin: [first, rows.start],
        in_first,
        _pad: 0,
    };
    let parts = [r, g, scratch.copy.binding(), b];
    kernels.padded.step_parts(gpu, &params, &parts, grid(params.out_size, (16, 8), 1))
}

impl Bands {
    /// For base warps that spread as `spread` says, with their `groups` of shifts; `direct` when each is a tap of its own that shifts nothing.
    pub fn new(gpu: &Gpu, geometry: &Geometry, spread: &Spread, direct: bool, groups: &[Group]) -> Self {
        let reach = (geometry.support as f64 * spread.largest + 0.5).floor() as i32;
        let mut bands = Self { near: spread.near, reach, direct, chunks: Vec::new() };
        if !direct {
            bands.chunks = bands.tables(gpu, geometry, groups);
        }
        bands
    }

    /// Group index and runs of `groups`.
    fn tap_table(&self, geometry: &Geometry, groups: &[Group], adjoint: bool) -> Vec<[i32; 4]> {
        let stride = if adjoint { self.copy_width(geometry) } else { plane_width(geometry, false) };
        let mut table = vec![[0i32; 4]; (groups.len() + 1).div_ceil(4)];
        for (g, group) in groups.iter().enumerate() {
            table[g / 4][g % 4] = table.len() as i32;
            append_group(group, geometry.shift_x, geometry.shift_y, stride, adjoint, &mut table);
        }
        let (n, end) = (groups.len(), table.len() as i32);
        table[n / 4][n % 4] = end;
        table
    }

    /// As few chunks as hold all groups.
    fn tables(&self, gpu: &Gpu, geometry: &Geometry, groups: &[Group]) -> Vec<Chunk> {
        let (mut out, mut first) = (Vec::new(), 0);
        while first < groups.len() {
            let mut count = 1;
            while first + count < groups.len() && self.tap_table(geometry, &groups[first..=first + count], false).len() <= TABLE {
                count += 1;
            }
            let table = |adjoint: bool| upload(gpu, "taps", self.tap_table(geometry, &groups[first..first + count], adjoint));
            out.push(Chunk { first, count, forward: table(false), adjoint: table(true) });
            first += count;
        }
        out
    }

    /// Pixels per row of the copy that the adjoint reads.
    fn copy_width(&self, geometry: &Geometry) -> usize {
        if self.direct { geometry.frame.0 + 2 * SIDE } else { plane_width(geometry, true) + geometry.shifts().0 }
    }

    /// Scratch for bands of `rows` rows and `bases` bases at once.
    fn scratch_for(&self, geometry: &Geometry, cut: Cut) -> ScratchSize {
        let read = cut.rows + geometry.shifts().1;
        let copy = (forward_rows(geometry, cut.rows) * (geometry.latent.0 + 2 * MARGIN)).max(read * self.copy_width(geometry));
        if self.direct {
            return ScratchSize { planes: 0, copy };
        }
        let plane = (read * plane_width(geometry, false)).max(cut.rows * plane_width(geometry, true));
        ScratchSize { planes: cut.bases * plane, copy }
    }

    /// Scratch that lets the operator run in one pass.
    pub fn scratch_wanted(&self, geometry: &Geometry) -> ScratchSize {
        self.scratch_for(geometry, Cut { rows: geometry.shifted().1, bases: geometry.homographies.len() })
    }

    /// Scratch without which the operator cannot run.
    pub fn scratch_needed(&self, geometry: &Geometry) -> ScratchSize {
        self.scratch_for(geometry, Cut { rows: 1, bases: 1 })
    }

    /// Rows of either grid that the lowest band binds at once.
    pub fn rows_at_once(geometry: &Geometry) -> usize {
        forward_rows(geometry, 1).max(adjoint_rows(geometry, 1)).max(1 + geometry.shifts().1)
    }

    /// Bands and passes that scratch, bindings and the time of a dispatch allow.
    fn cut(&self, gpu: &Gpu, geometry: &Geometry, scratch: &Scratch) -> Cut {
        let (all, scratch_rows) = (geometry.homographies.len(), geometry.shifted().1);
        let width = plane_width(geometry, true).max(geometry.latent.0);
        // A base costs its warp or its taps, whichever dispatch takes longer.
        let cost = (geometry.taps as f64 / all as f64).max(geometry.warp_cost()) * width as f64;
        let budget = gpu.dispatch_budget / cost;
        // Shifts make neighbouring bands compute the same rows twice: rather fewer bases at once than low bands.
        let least = (2 * geometry.shifts().1 + 64).min(scratch_rows);
        let rows = ((budget / all as f64) as usize).clamp(least, scratch_rows);
        let mut cut = Cut { rows, bases: ((budget / rows as f64) as usize).clamp(1, all) };
        let fits = |cut: Cut| {
            let need = self.scratch_for(geometry, cut);
            need.planes <= scratch.size.planes
                && need.copy <= scratch.size.copy
                && gpu.rows_fit(forward_rows(geometry, cut.rows), geometry.latent)
                && gpu.rows_fit(adjoint_rows(geometry, cut.rows), geometry.latent)
                && gpu.rows_fit(cut.rows + geometry.shifts().1, geometry.frame)
        };
        while !fits(cut) && (cut.bases > 1 || cut.rows > 1) {
            if cut.bases > 1 && (cut.rows <= least || cut.bases > all / 2) {
                cut.bases = cut.bases.div_ceil(2);
            } else {
                cut.rows = cut.rows.div_ceil(2);
            }
        }
        cut
    }

    /// (tap table, first base, number of bases) of the passes that do `at_once` bases each.
    fn passes(&self, geometry: &Geometry, at_once: usize) -> Vec<(Option<&Chunk>, usize, usize)> {
        let mut passes = Vec::new();
        let mut cut = |chunk, first: usize, end: usize| {
            let mut b = first;
            while b < end {
                let n = at_once.min(end - b).min(BASES - b % BASES);
                passes.push((chunk, b, n));
                b += n;
            }
        };
        if self.direct {
            cut(None, 0, geometry.homographies.len());
        }
        for c in &self.chunks {
            cut(Some(c), c.first, c.first + c.count);
        }
        passes
    }

    /// Steps of `frame = K latent`.
    pub fn forward(
        &self,
        gpu: &Gpu,
        kernels: &BandKernels,
        geometry: &Geometry,
        bases: &BaseTable,
        scratch: &Scratch,
        latent: &[wgpu::Buffer],
        frame: &[wgpu::Buffer],
    ) -> Vec<Step> {
        let kernels = kernels.compiled(gpu, geometry.support, scratch.channels());
        let cut = self.cut(gpu, geometry, scratch);
        let mut steps = Vec::new();
        for from in (0..geometry.frame.1).step_by(cut.rows) {
            let to = (from + cut.rows).min(geometry.frame.1);
            let rows = forward_band(geometry, from, to);
            let copy_width = geometry.latent.0 + 2 * MARGIN;
            steps.push(copy(gpu, kernels, scratch, latent, geometry.latent, -(MARGIN as i32), copy_width, &rows));
            let (target, first_row) = scratch.rows(gpu, frame, geometry.frame, from..to, true);
            let out_first = from as i32 - first_row;
            for (chunk, first, n) in self.passes(geometry, cut.bases) {
                let [x, y, z] = target.clone();
                let (table, copy, planes) = (bases.around(first), scratch.copy.binding(), scratch.planes.binding());
                let (width, height) = (plane_width(geometry, false), to - from + geometry.shifts().1);
                let mut params = WarpParams {
                    in_size: [copy_width as i32, rows.len() as i32],
                    offset: [(geometry.pad + MARGIN) as i32, geometry.pad as i32 - rows.start],
                    out_size: [width as i32, height as i32],
                    out_origin: [-geometry.shift_x.1, from as i32 - geometry.shift_y.1],
                    centre: geometry.centre().as_vec2().to_array(),
                    out_first: 0,
                    first_base: (first % BASES) as u32,
                    span: 1,
                    _pad: [0; 3],
                };
                let Some(chunk) = chunk else {
                    params.out_size = [geometry.frame.0 as i32, (to - from) as i32];
                    params.out_origin = [0, from as i32];
                    params.out_first = out_first;
                    params.span = n as u32;
                    let kernel = &kernels.warp_direct[usize::from(first > 0)];
                    steps.push(kernel.step_parts(gpu, &params, &[table, copy, x, y, z], grid(params.out_size, (16, 8), 1)));
                    continue;
                };
                steps.push(kernels.warp.step_parts(gpu, &params, &[table, copy, planes.clone()], grid(params.out_size, WARP_TILE, n)));
                let params = TapParams {
                    out_size: [geometry.frame.0 as i32, (to - from) as i32],
                    in_stride: width as i32,
                    in_plane: (width * height) as i32,
                    first_group: (first - chunk.first) as u32,
                    span: n as u32,
                    out_first,
                    _pad: 0,
                };
                let parts = [chunk.forward.as_entire_binding(), planes, x, y, z];
                let kernel = &kernels.tap_sum[usize::from(first > 0)];
                steps.push(kernel.step_parts(gpu, &params, &parts, grid(params.out_size, (32, 4 * TALL), 1)));
            }
        }
        steps
    }

    /// Steps of `latent += factor Kᵀ frame`.
    pub fn adjoint(
        &self,
        gpu: &Gpu,
        kernels: &BandKernels,
        geometry: &Geometry,
        bases: &BaseTable,
        scratch: &Scratch,
        frame: &[wgpu::Buffer],
        latent: &[wgpu::Buffer],
        factor: f32,
    ) -> Vec<Step> {
        let kernels = kernels.compiled(gpu, geometry.support, scratch.channels());
        let cut = self.cut(gpu, geometry, scratch);
        let mut steps = Vec::new();
        let copy_width = self.copy_width(geometry);
        // Frame row of the first scratch row, and frame column of the planes' first column.
        let (top, left) = (-geometry.shift_y.1, -geometry.shift_x.1 - SIDE as i32);
        for from in (0..geometry.shifted().1).step_by(cut.rows) {
            let to = (from + cut.rows).min(geometry.shifted().1);
            let rows = adjoint_band(geometry, from, to);
            if rows.is_empty() {
                continue;
            }
            let read = top + from as i32 + geometry.shift_y.0..top + to as i32 + geometry.shift_y.1;
            steps.push(copy(gpu, kernels, scratch, frame, geometry.frame, left + geometry.shift_x.0, copy_width, &read));
            let (target, out_first) = scratch.rows(gpu, latent, geometry.latent, rows.start as usize..rows.end as usize, true);
            for (chunk, first, n) in self.passes(geometry, cut.bases) {
                let (width, height) = (plane_width(geometry, true), to - from);
                let mut params = WarpAdjointParams {
                    size: [geometry.latent.0 as i32, geometry.latent.1 as i32],
                    in_size: [width as i32, height as i32],
                    in_origin: [left, top + from as i32],
                    pad: [geometry.pad as i32; 2],
                    centre: geometry.centre().as_vec2().to_array(),
                    rows: [rows.start, rows.end],
                    out_first,
                    plane: (width * height) as u32,
                    first_base: (first % BASES) as u32,
                    bases: n as u32,
                    reach: self.reach,
                    factor,
                };
                let source = if let Some(chunk) = chunk {
                    let params = TapParams {
                        out_size: [width as i32, height as i32],
                        in_stride: copy_width as i32,
                        in_plane: 0,
                        first_group: (first - chunk.first) as u32,
                        span: 1,
                        out_first: 0,
                        _pad: 0,
                    };
                    let parts = [chunk.adjoint.as_entire_binding(), scratch.copy.binding(), scratch.planes.binding()];
                    steps.push(kernels.tap_adjoint.step_parts(gpu, &params, &parts, grid(params.out_size, (32, 4 * TALL), n)));
                    scratch.planes.binding()
                } else {
                    params.in_size[0] = copy_width as i32;
                    params.plane = 0;
                    scratch.copy.binding()
                };
                let near = (16 * NEAR.0, 8 * NEAR.1);
                let (kernel, tile) = if self.near { (&kernels.warp_adjoint_near, near) } else { (&kernels.warp_adjoint, (16, 8)) };
                let [x, y, z] = target.clone();
                let parts = [bases.around(first), source, x, y, z];
                steps.push(kernel.step_parts(gpu, &params, &parts, grid([params.size[0], rows.len() as i32], tile, 1)));
            }
        }
        steps
    }
}
