//! The blur K of eq. (4) and its exact adjoint Kᵀ, of three channels or one, as warps and shifts (see [`TapSet`]), in three designs:
//!
//! * rotate-then-shift: every base warp into a scratch plane, then the sum of shifted planes. Loads little, needs scratch.
//! * direct: every pose warped straight into the sum. For a set whose taps shift nothing (a pose of its own per tap), above all for a
//!   frame with a single pose.
//! * by tiles, on GPUs: rotate-then-shift in workgroup memory (src/kernels/tiles.rs). Needs no scratch; for warps that turn and stretch little.
//!
//! The first two run in bands of frame rows, as tall as scratch, bindings and the time that a dispatch may take allow. K computes a band of the
//! frame from the scratch rows that its shifts reach; Kᵀ adds to the latent grid what a band of scratch rows holds. What either reads is
//! copied with a margin of zeros first.

use super::tiles::{HELD, TileKernels, Tiles};
use crate::error::Result;
use crate::gpu::{Gpu, Kernel, Step, Texels};
use crate::tsf::{Interpolation, TapSet};
use bytemuck::Zeroable;
use glam::{DMat3, DVec2};
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

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct BaseTable {
    abc: [f32; 4],
    def: [f32; 4],
    abc_inverse: [f32; 4],
    def_inverse: [f32; 4],
    weight: [f32; 4],
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

pub(super) fn table_sizes() -> Vec<(&'static str, &'static str, usize)> {
    ["warp", "warp_direct", "warp_adjoint", "warp_adjoint_near", "blur_tile", "blur_tile_adjoint"]
        .map(|s| (s, "Base", size_of::<BaseTable>()))
        .to_vec()
}

/// The compiled kernels of K and Kᵀ.
pub struct BlurKernels {
    pub(super) support: usize,
    /// For one channel and for three.
    compiled: [OnceLock<Compiled>; 2],
    /// For one channel and for three, each for any base warps and for those that do not foreshorten, by the workgroup memory they take.
    pub(super) tiles: [[[OnceLock<TileKernels>; HELD.len()]; 2]; 2],
}

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

impl BlurKernels {
    /// Those of one interpolation, compiled when first used.
    pub fn new(interpolation: Interpolation) -> Self {
        Self { support: interpolation.support(), compiled: Default::default(), tiles: Default::default() }
    }

    /// The kernels for `channels` channels at a time.
    fn compiled(&self, gpu: &Gpu, channels: usize) -> &Compiled {
        self.compiled[usize::from(channels > 1)].get_or_init(|| {
            let (support, together) = (("SUPPORT", self.support as f64), ("CHANNELS", channels as f64));
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

/// Displacement `H p - p` in the form of shaders/common/pose.wgsl.
fn displacement_table(h: &DMat3) -> ([f32; 4], [f32; 4]) {
    let h = *h * (1.0 / h.z_axis.z);
    let (x, y, z) = (h.x_axis, h.y_axis, h.z_axis);
    ([(x.x - 1.0) as f32, y.x as f32, z.x as f32, x.z as f32], [x.y as f32, (y.y - 1.0) as f32, z.y as f32, y.z as f32])
}

/// Over a frame's corners and centre: the largest absolute row sum of the Jacobian of `h` (how far a unit square spreads), and the largest
/// change of the displacement `h p - p` from the middle of the pixels that one invocation of an adjoint makes to any of them.
fn spread(h: &DMat3, half: DVec2) -> (f64, f64) {
    let (mut worst, mut drift) = (0.0f64, 0.0f64);
    // What one invocation makes there, and of shaders/blur_tile_adjoint.wgsl.
    let halves = [DVec2::new(NEAR.0 as f64 - 1.0, NEAR.1 as f64 - 1.0) / 2.0, DVec2::new(0.0, 1.5)];
    for s in [DVec2::ZERO, DVec2::new(1.0, 1.0), DVec2::new(-1.0, 1.0), DVec2::new(1.0, -1.0), DVec2::new(-1.0, -1.0)] {
        let p = s * half;
        let (a, e) = (crate::pose::project(h, p), 0.5);
        let dx = (crate::pose::project(h, p + DVec2::new(e, 0.0)) - a) / e;
        let dy = (crate::pose::project(h, p + DVec2::new(0.0, e)) - a) / e;
        worst = worst.max(dx.x.abs() + dy.x.abs()).max(dx.y.abs() + dy.y.abs());
        for t in halves {
            drift = drift.max(t.x * (dx.x - 1.0).abs() + t.y * dy.x.abs()).max(t.x * dx.y.abs() + t.y * (dy.y - 1.0).abs());
        }
    }
    (worst, drift)
}

/// Rows that `h` maps the rectangle of `x` by `y` (centred pixels) to; `None` when part of it lies behind the camera.
pub(super) fn rows_of(h: &DMat3, x: (f64, f64), y: (f64, f64)) -> Option<(f64, f64)> {
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

/// Pixels of the two parts of a [`Scratch`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ScratchSize {
    /// Planes of the base warps.
    pub planes: usize,
    /// Copy with margin of what an operator reads.
    pub copy: usize,
}

impl ScratchSize {
    /// The larger of each part.
    pub fn max(self, other: Self) -> Self {
        Self { planes: self.planes.max(other.planes), copy: self.copy.max(other.copy) }
    }

    /// The smaller of each part.
    pub fn min(self, other: Self) -> Self {
        Self { planes: self.planes.min(other.planes), copy: self.copy.min(other.copy) }
    }

    /// Bytes for `channels` channels.
    pub fn bytes(self, channels: usize) -> u64 {
        Gpu::texel_bytes(self.planes, channels) + Gpu::texel_bytes(self.copy, channels) + (3 * 4 * UNUSED) as u64
    }
}

/// Values of a buffer that stands for the channels that are not there.
const UNUSED: usize = 2;

/// Scratch planes for copies and base warps, shared by all operators of one solver.
pub struct Scratch {
    planes: Texels,
    copy: Texels,
    channels: usize,
    /// Bound for the channels that are not there: for inputs, for the second output, for the third.
    unused: [wgpu::Buffer; 3],
    size: ScratchSize,
}

impl Scratch {
    /// Scratch of `size` for operators on `channels` channels at a time, 1 or 3.
    ///
    /// # Errors
    /// As [`Gpu::plane`].
    pub fn new(gpu: &Gpu, size: ScratchSize, channels: usize) -> Result<Self> {
        let unused = [gpu.plane("unused input", UNUSED)?, gpu.plane("unused output", UNUSED)?, gpu.plane("unused output", UNUSED)?];
        let (planes, copy) = (gpu.texels("base warps", size.planes, channels)?, gpu.texels("copy with margin", size.copy, channels)?);
        Ok(Self { planes, copy, channels, unused, size })
    }

    /// Channels at a time: 1 or 3.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// The rows `rows` of one or three images of `size` as the kernels' bindings of inputs or outputs, and the row that comes first in them.
    pub(super) fn rows<'a>(
        &'a self,
        gpu: &Gpu,
        images: &'a [wgpu::Buffer],
        size: (usize, usize),
        rows: Range<usize>,
        output: bool,
    ) -> ([wgpu::BindingResource<'a>; 3], i32) {
        let unused = |c: usize| self.unused[if output { c } else { 0 }].as_entire_binding();
        let part = |b: &'a wgpu::Buffer| gpu.rows(b, size, rows.clone());
        let first = part(&images[0]).first as i32;
        (std::array::from_fn(|c| images.get(c).map_or_else(|| unused(c), |b| part(b).binding)), first)
    }
}

/// K of one frame, which maps the latent grid to the frame, and Kᵀ back.
pub struct Blur {
    pub(super) latent: (usize, usize),
    pub(super) frame: (usize, usize),
    pub(super) pad: usize,
    pub(super) support: usize,
    /// Smallest and largest shift in x and in y.
    shift_x: (i32, i32),
    pub(super) shift_y: (i32, i32),
    /// Homographies scene to frame, by entry of the base table.
    pub(super) homographies: Vec<DMat3>,
    pub(super) taps: usize,
    near: bool,
    reach: i32,
    direct: bool,
    base_table: wgpu::Buffer,
    /// None in the direct design, or by tiles.
    chunks: Vec<Chunk>,
    tiles: Option<Tiles>,
}

/// How an operator is cut: frame (or scratch) rows per band, bases per pass.
#[derive(Clone, Copy, Debug)]
struct Cut {
    rows: usize,
    bases: usize,
}

/// Entries of the base table that are bound together: 40 KiB, and a multiple of every alignment.
pub(super) const BASES: usize = 512;
/// `vec4i` of a tap table: what 64 KiB, the least that every adapter binds as a uniform, hold.
pub(super) const TABLE: usize = 4096;
/// Taps of one group at most, so that even taps without neighbours (one entry each) fit a table.
pub(super) const GROUP_TAPS: usize = 3000;
/// Pixels of a column that one invocation of shaders/common/taps.wgsl makes.
const TALL: usize = 16;
/// Pixels that one workgroup of shaders/warp.wgsl makes.
const WARP_TILE: (usize, usize) = (256, 4);
/// Pixels that one invocation of shaders/warp_adjoint_near.wgsl makes.
const NEAR: (usize, usize) = (4, 2);
/// Zeros around the copy of the latent grid: at least the width of an interpolation.
const MARGIN: usize = 8;
/// Zero columns on either side of the adjoint's planes: at least the window of shaders/warp_adjoint_near.wgsl.
const SIDE: usize = 12;

/// Shifts (dx, dy, weight) of one base warp, sorted.
pub(super) type Group = Vec<(i32, i32, f64)>;

/// Taps of consecutive base warps that share one table.
struct Chunk {
    first: usize,
    count: usize,
    forward: wgpu::Buffer,
    adjoint: wgpu::Buffer,
}

/// Appends the runs of consecutive places in y of `taps` (x, y, weight), sorted, in the layout of shaders/common/taps.wgsl: three taps to an entry.
pub(super) fn append_runs(taps: &[(i32, i32, f64)], stride: usize, table: &mut Vec<[i32; 4]>) {
    for run in taps.chunk_by(|a, b| a.0 == b.0 && a.1 + 1 == b.1) {
        table.extend(run.chunks(3).map(|part| {
            let weight = |m: usize| part.get(m).map_or(0, |t| (t.2 as f32).to_bits() as i32);
            [part[0].1 * stride as i32 + part[0].0, weight(0), weight(1), weight(2)]
        }));
    }
}

/// Workgroups that each make `tile` pixels, for `depth` images of `size`.
pub(super) fn grid(size: [i32; 2], tile: (usize, usize), depth: usize) -> [u32; 3] {
    [(size[0] as usize).div_ceil(tile.0) as u32, (size[1] as usize).div_ceil(tile.1) as u32, depth as u32]
}

impl Blur {
    /// The operator of `taps` from a latent grid, which surrounds the frame by `pad` pixels on every side, to a frame of
    /// `frame` = (width, height) pixels. Irradiance beyond the latent grid counts as 0. Direct when every tap has a base of its own
    /// and shifts nothing.
    pub fn new(gpu: &Gpu, kernels: &BlurKernels, taps: &TapSet, frame: (usize, usize), pad: usize) -> Self {
        let range = |f: fn(&crate::tsf::Tap) -> i32| taps.taps.iter().map(f).fold((i32::MAX, i32::MIN), |(a, b), v| (a.min(v), b.max(v)));
        let (shift_x, shift_y) = (range(|t| t.dx), range(|t| t.dy));
        let direct = taps.is_direct();
        let half = 0.5 * DVec2::new(frame.0 as f64 + f64::from(shift_x.1 - shift_x.0), frame.1 as f64 + f64::from(shift_y.1 - shift_y.0));
        let s = kernels.support as f64;
        let spreads: Vec<(f64, f64)> = taps.bases.iter().map(|h| spread(h, half)).collect();
        let reach = spreads.iter().map(|d| (s * d.0 + 0.5).floor() as i32).max().unwrap_or(0);
        // The window's centre is within half a pixel of the target of the middle of a tile, the targets of each of whose pixels lie within
        // `s` times the row sum of its own; together less than the next whole pixel.
        let near = spreads.iter().all(|d| s * d.0 + 0.5 + d.1 < s + 0.99);
        let mut blur = Self {
            latent: (frame.0 + 2 * pad, frame.1 + 2 * pad),
            frame,
            pad,
            support: kernels.support,
            shift_x,
            shift_y,
            homographies: Vec::new(),
            taps: taps.taps.len(),
            near,
            reach,
            direct,
            base_table: gpu.uniform("base warps", bytemuck::bytes_of(&BaseTable::zeroed())),
            chunks: Vec::new(),
            tiles: None,
        };
        // A base warp with more taps than a table holds stands there several times; one without any, not at all.
        let (mut table, mut groups) = (Vec::new(), Vec::new());
        for (b, h) in taps.bases.iter().enumerate() {
            let ((abc, def), (abc_inverse, def_inverse)) = (displacement_table(&h.inverse()), displacement_table(h));
            let mut own: Group = taps.taps.iter().filter(|t| t.base == b).map(|t| (t.dx, t.dy, t.weight)).collect();
            own.sort_by_key(|t| (t.0, t.1));
            for part in own.chunks(GROUP_TAPS) {
                let weight = if direct { part[0].2 as f32 } else { 1.0 };
                table.push(BaseTable { abc, def, abc_inverse, def_inverse, weight: [weight, 0.0, 0.0, 0.0] });
                blur.homographies.push(*h);
                groups.push(part.to_vec());
            }
        }
        table.resize(table.len().next_multiple_of(BASES), BaseTable::zeroed());
        blur.base_table = gpu.uniform("base warps", bytemuck::cast_slice(&table));
        if !direct && near && !gpu.software {
            let spread = spreads.iter().map(|s| s.0).fold(1.0, f64::max);
            let planar = table.iter().all(|b| [b.abc[3], b.def[3], b.abc_inverse[3], b.def_inverse[3]] == [0.0; 4]);
            blur.tiles = Tiles::new(gpu, kernels.support, spread, planar, &groups);
        }
        if !direct && blur.tiles.is_none() {
            blur.chunks = blur.tables(gpu, &groups);
        }
        blur
    }

    /// Group index and runs of `groups`.
    fn tap_table(&self, groups: &[Group], adjoint: bool) -> Vec<[i32; 4]> {
        let mut table = vec![[0i32; 4]; (groups.len() + 1).div_ceil(4)];
        for (g, taps) in groups.iter().enumerate() {
            table[g / 4][g % 4] = table.len() as i32;
            // K reads its planes at p - shift, Kᵀ the frame at q + shift; both from the corner that the farthest shift reaches.
            if adjoint {
                let places: Group = taps.iter().map(|t| (t.0 - self.shift_x.0, t.1 - self.shift_y.0, t.2)).collect();
                append_runs(&places, self.copy_width(), &mut table);
            } else {
                let places: Group = taps.iter().rev().map(|t| (self.shift_x.1 - t.0, self.shift_y.1 - t.1, t.2)).collect();
                append_runs(&places, self.width(false), &mut table);
            }
        }
        let (n, end) = (groups.len(), table.len() as i32);
        table[n / 4][n % 4] = end;
        table
    }

    /// As few chunks as hold all groups.
    fn tables(&self, gpu: &Gpu, groups: &[Group]) -> Vec<Chunk> {
        let (mut out, mut first) = (Vec::new(), 0);
        while first < groups.len() {
            let mut count = 1;
            while first + count < groups.len() && self.tap_table(&groups[first..=first + count], false).len() <= TABLE {
                count += 1;
            }
            let table = |adjoint: bool| {
                let mut t = self.tap_table(&groups[first..first + count], adjoint);
                t.resize(TABLE, [0; 4]);
                gpu.uniform("taps", bytemuck::cast_slice(&t))
            };
            out.push(Chunk { first, count, forward: table(false), adjoint: table(true) });
            first += count;
        }
        out
    }

    /// Columns and rows by which the shifts widen a plane.
    fn shifts(&self) -> (usize, usize) {
        ((self.shift_x.1 - self.shift_x.0) as usize, (self.shift_y.1 - self.shift_y.0) as usize)
    }

    /// Pixels per row of a plane of base warps.
    fn width(&self, adjoint: bool) -> usize {
        self.frame.0 + self.shifts().0 + if adjoint { 2 * SIDE } else { 0 }
    }

    /// Pixels per row of the copy that the adjoint reads.
    fn copy_width(&self) -> usize {
        if self.direct { self.frame.0 + 2 * SIDE } else { self.width(true) + self.shifts().0 }
    }

    /// Rows of scratch in all: what the shifts make of the frame.
    fn scratch_rows(&self) -> usize {
        self.frame.1 + self.shifts().1
    }

    pub(super) fn centre(&self) -> DVec2 {
        DVec2::new(self.frame.0 as f64 - 1.0, self.frame.1 as f64 - 1.0) / 2.0
    }

    /// Latent rows, as rows of the grid with `margin` more above and below, that K reads for the planes' rows `from..to` (frame pixels).
    pub(super) fn latent_rows(&self, from: i32, to: i32, margin: usize) -> Range<i32> {
        let (c, s) = (self.centre(), self.support as f64);
        let x = (f64::from(-self.shift_x.1) - c.x - 1.0, f64::from(-self.shift_x.1) + self.width(false) as f64 - c.x);
        let y = (f64::from(from) - c.y, f64::from(to) - 1.0 - c.y);
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for h in &self.homographies {
            let (a, b) = rows_of(&h.inverse(), x, y).unwrap_or((-1e9, 1e9));
            (low, high) = (low.min(a), high.max(b));
        }
        let (low, high) = (low + c.y + self.pad as f64 - s - 1.0, high + c.y + self.pad as f64 + s + 2.0);
        let (first, last) = (-(margin as i32), (self.latent.1 + margin) as i32);
        // Never less than an interpolation's rows: beyond the grid these are the margin, where all is zero.
        let least = 2 * self.support as i32;
        let low = (low.floor().max(-1e8) as i32).clamp(first, (last - least).max(first));
        let high = (high.ceil().min(1e8) as i32).clamp(low.min(last) + least.min(last - low), last);
        low..high
    }

    /// Pixels of the copy that K reads for `rows` rows of the frame, at most.
    fn forward_copy(&self, rows: usize) -> usize {
        let bands = (0..self.frame.1).step_by(rows).map(|y| self.forward_band(y, (y + rows).min(self.frame.1)).len());
        bands.max().unwrap_or(0) * (self.latent.0 + 2 * MARGIN)
    }

    /// [`Blur::latent_rows`] of the frame's rows `from..to`.
    fn forward_band(&self, from: usize, to: usize) -> Range<i32> {
        self.latent_rows(from as i32 - self.shift_y.1, to as i32 - self.shift_y.0, MARGIN)
    }

    /// Scratch for bands of `rows` rows and `bases` bases at once.
    fn scratch_for(&self, cut: Cut) -> ScratchSize {
        let shifts = self.shifts().1;
        let copy = self.forward_copy(cut.rows).max((cut.rows + shifts) * self.copy_width());
        if self.tiles.is_some() {
            return ScratchSize::default();
        }
        if self.direct {
            return ScratchSize { planes: 0, copy };
        }
        ScratchSize { planes: cut.bases * ((cut.rows + shifts) * self.width(false)).max(cut.rows * self.width(true)), copy }
    }

    /// Scratch that lets the operator run in one pass.
    pub fn scratch_wanted(&self) -> ScratchSize {
        self.scratch_for(Cut { rows: self.scratch_rows(), bases: self.homographies.len() })
    }

    /// Scratch without which the operator cannot run.
    pub fn scratch_needed(&self) -> ScratchSize {
        self.scratch_for(Cut { rows: 1, bases: 1 })
    }

    /// Rows of the latent grid or of the frame that the lowest band reads or adds to at once: fewer cannot be bound.
    pub fn rows_at_once(&self) -> usize {
        if let Some(tiles) = &self.tiles {
            return self.tile_rows_at_once(tiles);
        }
        (self.forward_copy(1) / (self.latent.0 + 2 * MARGIN)).max(self.adjoint_rows(1)).max(1 + self.shifts().1)
    }

    /// Bands and passes that scratch, bindings and the time of a dispatch allow.
    fn cut(&self, gpu: &Gpu, scratch: &Scratch) -> Cut {
        let all = self.homographies.len();
        let width = self.width(true).max(self.latent.0);
        // A base costs its warp or its taps, whichever dispatch takes longer.
        let cost = (self.taps as f64 / all as f64).max(crate::tsf::WARP_COST * (2 * self.support).pow(2) as f64) * width as f64;
        let budget = gpu.dispatch_budget / cost;
        // Shifts make neighbouring bands compute the same rows twice: rather fewer bases at once than low bands.
        let least = (2 * self.shifts().1 + 64).min(self.scratch_rows());
        let rows = ((budget / all as f64) as usize).clamp(least, self.scratch_rows());
        let mut cut = Cut { rows, bases: ((budget / rows as f64) as usize).clamp(1, all) };
        let fits = |cut: Cut| {
            let need = self.scratch_for(cut);
            need.planes <= scratch.size.planes
                && need.copy <= scratch.size.copy
                && gpu.rows_fit(self.forward_copy(cut.rows) / (self.latent.0 + 2 * MARGIN), self.latent)
                && gpu.rows_fit(self.adjoint_rows(cut.rows), self.latent)
                && gpu.rows_fit(cut.rows + self.shifts().1, self.frame)
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

    /// Most latent rows that a band of `rows` scratch rows adds to.
    fn adjoint_rows(&self, rows: usize) -> usize {
        (0..self.scratch_rows()).step_by(rows).map(|y| self.adjoint_band(y, (y + rows).min(self.scratch_rows())).len()).max().unwrap_or(0)
    }

    /// Latent rows that the scratch rows `from..to` add to.
    fn adjoint_band(&self, from: usize, to: usize) -> Range<i32> {
        let first = -self.shift_y.1;
        self.latent_rows(first + from as i32, first + to as i32, 0)
    }

    /// (tap table, first base, number of bases) of the passes that do `at_once` bases each.
    fn passes(&self, at_once: usize) -> Vec<(Option<&Chunk>, usize, usize)> {
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
            cut(None, 0, self.homographies.len());
        }
        for c in &self.chunks {
            cut(Some(c), c.first, c.first + c.count);
        }
        passes
    }

    /// The entries of the base table that hold entry `first`, which is entry `first % BASES` of them.
    pub(super) fn bases(&self, first: usize) -> wgpu::BindingResource<'_> {
        let bytes = (BASES * size_of::<BaseTable>()) as u64;
        let offset = (first / BASES) as u64 * bytes;
        wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer: &self.base_table, offset, size: std::num::NonZero::new(bytes) })
    }

    /// Copies the rows `rows` of `from` (an image of `size`) and the columns from `first` on, `width` of them, into the scratch.
    fn copy(
        &self,
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

    /// Steps of `frame = K latent`, of one channel or three: as many as `scratch` is for.
    pub fn forward(
        &self,
        gpu: &Gpu,
        kernels: &BlurKernels,
        scratch: &Scratch,
        latent: &[wgpu::Buffer],
        frame: &[wgpu::Buffer],
    ) -> Vec<Step> {
        if let Some(tiles) = &self.tiles {
            return self.by_tiles(gpu, kernels, tiles, scratch, false, latent, frame, 1.0);
        }
        let kernels = kernels.compiled(gpu, scratch.channels());
        let cut = self.cut(gpu, scratch);
        let mut steps = Vec::new();
        for from in (0..self.frame.1).step_by(cut.rows) {
            let to = (from + cut.rows).min(self.frame.1);
            let rows = self.forward_band(from, to);
            let copy_width = self.latent.0 + 2 * MARGIN;
            steps.push(self.copy(gpu, kernels, scratch, latent, self.latent, -(MARGIN as i32), copy_width, &rows));
            let (target, first_row) = scratch.rows(gpu, frame, self.frame, from..to, true);
            let out_first = from as i32 - first_row;
            for (chunk, first, n) in self.passes(cut.bases) {
                let [x, y, z] = target.clone();
                let (table, copy, planes) = (self.bases(first), scratch.copy.binding(), scratch.planes.binding());
                let (width, height) = (self.width(false), to - from + self.shifts().1);
                let mut params = WarpParams {
                    in_size: [copy_width as i32, rows.len() as i32],
                    offset: [(self.pad + MARGIN) as i32, self.pad as i32 - rows.start],
                    out_size: [width as i32, height as i32],
                    out_origin: [-self.shift_x.1, from as i32 - self.shift_y.1],
                    centre: [(self.frame.0 as f32 - 1.0) / 2.0, (self.frame.1 as f32 - 1.0) / 2.0],
                    out_first: 0,
                    first_base: (first % BASES) as u32,
                    span: 1,
                    _pad: [0; 3],
                };
                let Some(chunk) = chunk else {
                    params.out_size = [self.frame.0 as i32, (to - from) as i32];
                    params.out_origin = [0, from as i32];
                    params.out_first = out_first;
                    params.span = n as u32;
                    let kernel = &kernels.warp_direct[usize::from(first > 0)];
                    steps.push(kernel.step_parts(gpu, &params, &[table, copy, x, y, z], grid(params.out_size, (16, 8), 1)));
                    continue;
                };
                steps.push(kernels.warp.step_parts(gpu, &params, &[table, copy, planes.clone()], grid(params.out_size, WARP_TILE, n)));
                let params = TapParams {
                    out_size: [self.frame.0 as i32, (to - from) as i32],
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

    /// Steps of `latent += factor Kᵀ frame`, of one channel or three: as many as `scratch` is for.
    pub fn adjoint(
        &self,
        gpu: &Gpu,
        kernels: &BlurKernels,
        scratch: &Scratch,
        frame: &[wgpu::Buffer],
        latent: &[wgpu::Buffer],
        factor: f32,
    ) -> Vec<Step> {
        if let Some(tiles) = &self.tiles {
            return self.by_tiles(gpu, kernels, tiles, scratch, true, frame, latent, factor);
        }
        let kernels = kernels.compiled(gpu, scratch.channels());
        let cut = self.cut(gpu, scratch);
        let mut steps = Vec::new();
        let copy_width = self.copy_width();
        // Frame row of the first scratch row, and frame column of the planes' first column.
        let (top, left) = (-self.shift_y.1, -self.shift_x.1 - SIDE as i32);
        for from in (0..self.scratch_rows()).step_by(cut.rows) {
            let to = (from + cut.rows).min(self.scratch_rows());
            let rows = self.adjoint_band(from, to);
            if rows.is_empty() {
                continue;
            }
            let read = top + from as i32 + self.shift_y.0..top + to as i32 + self.shift_y.1;
            steps.push(self.copy(gpu, kernels, scratch, frame, self.frame, left + self.shift_x.0, copy_width, &read));
            let (target, out_first) = scratch.rows(gpu, latent, self.latent, rows.start as usize..rows.end as usize, true);
            for (chunk, first, n) in self.passes(cut.bases) {
                let (width, height) = (self.width(true), to - from);
                let mut params = WarpAdjointParams {
                    size: [self.latent.0 as i32, self.latent.1 as i32],
                    in_size: [width as i32, height as i32],
                    in_origin: [left, top + from as i32],
                    pad: [self.pad as i32; 2],
                    centre: [(self.frame.0 as f32 - 1.0) / 2.0, (self.frame.1 as f32 - 1.0) / 2.0],
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
                let parts = [self.bases(first), source, x, y, z];
                steps.push(kernel.step_parts(gpu, &params, &parts, grid([params.size[0], rows.len() as i32], tile, 1)));
            }
        }
        steps
    }
}
