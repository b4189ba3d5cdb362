//! The tables that the kernels of K read as uniforms, whatever its design: base warps, and runs of shifts. Knows their layout in the shaders,
//! not where on the grids they reach.

use crate::gpu::Gpu;
use crate::tsf::TapSet;
use bytemuck::Zeroable;
use glam::DMat3;

/// Entries of the base table that are bound together: 40 KiB, and a multiple of every alignment.
pub(super) const BASES: usize = 512;
/// `vec4i` of a tap table: what 64 KiB, the least that every adapter binds as a uniform, hold.
pub(super) const TABLE: usize = 4096;
/// Taps of one group at most, so that even taps without neighbours (one entry each) fit a table.
pub(super) const GROUP_TAPS: usize = 3000;

/// Shifts (dx, dy, weight) of one base warp, sorted.
pub(super) type Group = Vec<(i32, i32, f64)>;

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Base {
    abc: [f32; 4],
    def: [f32; 4],
    abc_inverse: [f32; 4],
    def_inverse: [f32; 4],
    weight: [f32; 4],
}

/// Sizes of the mirrors, as [`super::table_sizes`].
pub(super) fn table_sizes() -> Vec<(&'static str, &'static str, usize)> {
    ["warp", "warp_direct", "warp_adjoint", "warp_adjoint_near", "blur_tile", "blur_tile_adjoint"]
        .map(|s| (s, "Base", size_of::<Base>()))
        .to_vec()
}

/// The homographies and the shifts of `taps`, by entry of the base table: a base warp with more taps than a tap table holds stands there
/// several times; one without any, not at all.
pub(super) fn by_entry(taps: &TapSet) -> (Vec<DMat3>, Vec<Group>) {
    let (mut homographies, mut groups) = (Vec::new(), Vec::new());
    for (b, h) in taps.bases.iter().enumerate() {
        let mut own: Group = taps.taps.iter().filter(|t| t.base == b).map(|t| (t.dx, t.dy, t.weight)).collect();
        own.sort_by_key(|t| (t.0, t.1));
        for part in own.chunks(GROUP_TAPS) {
            homographies.push(*h);
            groups.push(part.to_vec());
        }
    }
    (homographies, groups)
}

/// Displacement `H p - p` in the form of shaders/common/pose.wgsl.
fn displacement(h: &DMat3) -> ([f32; 4], [f32; 4]) {
    let h = *h * (1.0 / h.z_axis.z);
    let (x, y, z) = (h.x_axis, h.y_axis, h.z_axis);
    ([(x.x - 1.0) as f32, y.x as f32, z.x as f32, x.z as f32], [x.y as f32, (y.y - 1.0) as f32, z.y as f32, y.z as f32])
}

/// The table of base warps on the device.
pub(super) struct BaseTable {
    buffer: wgpu::Buffer,
    /// Whether no base warp foreshortens.
    pub planar: bool,
}

impl BaseTable {
    /// Of `homographies`, scene to frame, each with the weight that the direct design gives it.
    pub fn new(gpu: &Gpu, homographies: &[DMat3], weight: impl Fn(usize) -> f32) -> Self {
        let mut table: Vec<Base> = Vec::new();
        for (entry, h) in homographies.iter().enumerate() {
            let ((abc, def), (abc_inverse, def_inverse)) = (displacement(&h.inverse()), displacement(h));
            table.push(Base { abc, def, abc_inverse, def_inverse, weight: [weight(entry), 0.0, 0.0, 0.0] });
        }
        table.resize(table.len().next_multiple_of(BASES), Base::zeroed());
        let planar = table.iter().all(|b| [b.abc[3], b.def[3], b.abc_inverse[3], b.def_inverse[3]] == [0.0; 4]);
        Self { buffer: gpu.uniform("base warps", bytemuck::cast_slice(&table)), planar }
    }

    /// The entries that hold entry `first`, which is entry `first % BASES` of them.
    pub fn around(&self, first: usize) -> wgpu::BindingResource<'_> {
        let bytes = (BASES * size_of::<Base>()) as u64;
        let offset = (first / BASES) as u64 * bytes;
        wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer: &self.buffer, offset, size: std::num::NonZero::new(bytes) })
    }
}

/// Appends the runs of consecutive places in y of `taps` (x, y, weight), sorted, in the layout of shaders/common/taps.wgsl: three taps to an entry.
fn append_runs(taps: &[(i32, i32, f64)], stride: usize, table: &mut Vec<[i32; 4]>) {
    for run in taps.chunk_by(|a, b| a.0 == b.0 && a.1 + 1 == b.1) {
        table.extend(run.chunks(3).map(|part| {
            let weight = |m: usize| part.get(m).map_or(0, |t| (t.2 as f32).to_bits() as i32);
            [part[0].1 * stride as i32 + part[0].0, weight(0), weight(1), weight(2)]
        }));
    }
}

/// Appends the shifts of `group` as places in what K, or Kᵀ, reads, whose rows have `stride` pixels: K reads base warps at p - shift, Kᵀ the
/// frame at q + shift, both from the corner that the farthest of shifts between `x` and `y` (smallest, largest) reaches.
pub(super) fn append_group(
    group: &[(i32, i32, f64)],
    x: (i32, i32),
    y: (i32, i32),
    stride: usize,
    adjoint: bool,
    table: &mut Vec<[i32; 4]>,
) {
    let places: Group = if adjoint {
        group.iter().map(|t| (t.0 - x.0, t.1 - y.0, t.2)).collect()
    } else {
        group.iter().rev().map(|t| (x.1 - t.0, y.1 - t.1, t.2)).collect()
    };
    append_runs(&places, stride, table);
}

/// A tap table, of at most [`TABLE`] entries, on the device.
pub(super) fn upload(gpu: &Gpu, label: &str, mut table: Vec<[i32; 4]>) -> wgpu::Buffer {
    table.resize(TABLE, [0; 4]);
    gpu.uniform(label, bytemuck::cast_slice(&table))
}
