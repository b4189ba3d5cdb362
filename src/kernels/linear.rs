//! Smoothness term, normal equations and conjugate gradients in log irradiance, one channel per step.

use crate::gpu::{Gpu, Kernel, Step, grid_1d};
use std::ops::Range;

pub(super) const EDGE_WEIGHT: &str = source!("common/plane", "common/vector", "edge_weight");
pub(super) const NORMAL: &str = source!("common/plane", "common/vector", "common/smoothness", "normal");
pub(super) const RIGHT_SIDE: &str = source!("common/plane", "common/smoothness", "right_side");
pub(super) const SCALE: &str = source!("common/vector", "scale");
pub(super) const MULTIPLY: &str = source!("common/vector", "multiply");
pub(super) const CG_START: &str = source!("common/vector", "cg_start");
pub(super) const CG_STEP: &str = source!("common/vector", "cg_step");
pub(super) const CG_DIRECTION: &str = source!("common/vector", "cg_direction");
pub(super) const CG_SCALARS: &str = source!("cg_scalars");
pub(super) const UPDATE: &str = source!("common/vector", "update");

/// Scalar of a channel: ⟨r, z⟩.
pub const SLOT_ENERGY: usize = 0;
/// Scalar of a channel: ⟨p, A p⟩.
pub const SLOT_CURVATURE: usize = 1;
/// Scalar of a channel: data term of the objective.
pub const SLOT_DATA: usize = 3;
/// Scalars of a channel.
pub const SLOTS: usize = 4;
/// Scalar: smoothness term of the objective.
pub const SLOT_SMOOTHNESS: usize = 3 * SLOTS;
/// Scalars in all.
pub const SCALARS: usize = SLOT_SMOOTHNESS + 1;
/// Rows above and below that the kernels of the smoothness term read.
pub const HALO: usize = 1;

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct EdgeParams {
    size: [i32; 2],
    rows: [i32; 2],
    first: i32,
    partial: u32,
    row: u32,
    lambda: f32,
    epsilon: f32,
    _pad: f32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct NormalParams {
    size: [i32; 2],
    rows: [i32; 2],
    first: i32,
    partial: u32,
    row: u32,
    _pad: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct RightSideParams {
    size: [i32; 2],
    rows: [i32; 2],
    first: i32,
    _pad: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct VectorParams {
    count: u32,
    row: u32,
    scalars: u32,
    _pad: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct SumParams {
    count: u32,
    partial: u32,
    row: u32,
    scalars: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ScalarParams {
    first: u32,
    count: u32,
    slot: u32,
    shift: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct UpdateParams {
    count: u32,
    row: u32,
    step: f32,
    darkest: f32,
}

pub(super) fn params_sizes() -> Vec<(&'static str, usize)> {
    let (vector, sum) = (size_of::<VectorParams>(), size_of::<SumParams>());
    vec![
        ("edge_weight", size_of::<EdgeParams>()),
        ("normal", size_of::<NormalParams>()),
        ("right_side", size_of::<RightSideParams>()),
        ("scale", vector),
        ("multiply", vector),
        ("cg_start", sum),
        ("cg_step", sum),
        ("cg_direction", vector),
        ("cg_scalars", size_of::<ScalarParams>()),
        ("update", size_of::<UpdateParams>()),
    ]
}

/// Partial sums of a kernel over an image of `size`.
pub fn partials_2d(gpu: &Gpu, size: (usize, usize)) -> usize {
    bands(gpu, size, 0).iter().map(Band::partials).sum()
}

/// Partial sums of a kernel over `count` values.
pub fn partials_1d(gpu: &Gpu, count: usize) -> usize {
    parts(gpu, count, 0).iter().map(Part::partials).sum()
}

/// Workgroups of 16 x 8 for the rows `rows` of an image of `size`.
pub(super) fn grid_2d(size: (usize, usize), rows: &Range<usize>) -> [u32; 3] {
    [size.0.div_ceil(16) as u32, rows.len().div_ceil(8) as u32, 1]
}

/// Values that one invocation makes, in kernels on vectors and in those that sum over an image: shaders/common/vector.wgsl.
const EACH: usize = 8;
/// Values that a workgroup makes.
const GROUP: usize = 128 * EACH;

/// A part of one vector for each of the kernel's bindings.
pub(super) struct Part {
    values: Range<usize>,
    /// First partial sum.
    pub partial: u32,
    /// Workgroups per row.
    pub row: u32,
    /// Rows of workgroups.
    rows: u32,
}

/// The parts in which `count` values can be bound, with partial sums from `partial` on.
pub(super) fn parts(gpu: &Gpu, count: usize, partial: usize) -> Vec<Part> {
    let mut next = partial;
    let part = |values: Range<usize>| {
        let (row, rows) = grid_1d(values.len().div_ceil(EACH));
        let part = Part { values, partial: next as u32, row, rows };
        next += part.partials();
        part
    };
    gpu.parts(count, GROUP).map(part).collect()
}

impl Part {
    pub fn count(&self) -> u32 {
        self.values.len() as u32
    }

    fn partials(&self) -> usize {
        self.row as usize * self.rows as usize
    }

    fn vector(&self, scalars: usize) -> VectorParams {
        VectorParams { count: self.count(), row: self.row, scalars: scalars as u32, _pad: 0 }
    }

    fn sum(&self, scalars: usize) -> SumParams {
        SumParams { count: self.count(), partial: self.partial, row: self.row, scalars: scalars as u32 }
    }

    /// A dispatch on this part of `vectors`, which stand between `before` and `after` among the bindings.
    pub fn step<P: bytemuck::Pod>(
        &self,
        gpu: &Gpu,
        kernel: &Kernel,
        params: &P,
        before: &[&wgpu::Buffer],
        vectors: &[&wgpu::Buffer],
        after: &[&wgpu::Buffer],
    ) -> Step {
        let mut bound: Vec<wgpu::BindingResource> = before.iter().map(|b| b.as_entire_binding()).collect();
        bound.extend(vectors.iter().map(|b| Gpu::part(b, &self.values)));
        bound.extend(after.iter().map(|b| b.as_entire_binding()));
        kernel.step_parts(gpu, params, &bound, [self.row, self.rows, 1])
    }
}

/// Some rows of planes of one size, which all are bound from the same row on.
struct Band {
    rows: Range<usize>,
    partial: u32,
    /// Workgroups of the kernels that sum.
    groups: [u32; 3],
}

/// The bands in which planes of `size` can be bound, with partial sums from `partial` on.
fn bands(gpu: &Gpu, size: (usize, usize), partial: usize) -> Vec<Band> {
    let mut next = partial;
    let band = |rows: Range<usize>| {
        let groups = [size.0.div_ceil(16) as u32, rows.len().div_ceil(8 * EACH) as u32, 1];
        let band = Band { groups, partial: next as u32, rows };
        next += band.partials();
        band
    };
    gpu.bands(size.1, HALO, size).map(band).collect()
}

impl Band {
    fn partials(&self) -> usize {
        self.groups[0] as usize * self.groups[1] as usize
    }

    /// Bindings of the band and its neighbours in `planes`, and the row that comes first in them.
    fn bind<'a>(&self, gpu: &Gpu, planes: &[&'a wgpu::Buffer], size: (usize, usize)) -> (Vec<wgpu::BindingResource<'a>>, i32) {
        let seen = self.rows.start.saturating_sub(HALO)..(self.rows.end + HALO).min(size.1);
        let bound: Vec<_> = planes.iter().map(|b| gpu.rows(b, size, seen.clone())).collect();
        let first = bound[0].first as i32;
        (bound.into_iter().map(|b| b.binding).collect(), first)
    }

    fn rows(&self) -> [i32; 2] {
        [self.rows.start as i32, self.rows.end as i32]
    }
}

/// The compiled kernels.
pub struct LinearKernels {
    edge_weight: Kernel,
    normal: Kernel,
    right_side: Kernel,
    scale: Kernel,
    multiply: Kernel,
    cg_start: Kernel,
    cg_step: Kernel,
    cg_direction: Kernel,
    cg_scalars: Kernel,
    update: Kernel,
}

impl LinearKernels {
    /// Compiles them.
    pub fn new(gpu: &Gpu) -> Self {
        let kernel = |label, source| Kernel::new(gpu, label, source, &[]);
        Self {
            edge_weight: kernel("edge_weight", EDGE_WEIGHT),
            normal: kernel("normal", NORMAL),
            right_side: kernel("right_side", RIGHT_SIDE),
            scale: kernel("scale", SCALE),
            multiply: kernel("multiply", MULTIPLY),
            cg_start: kernel("cg_start", CG_START),
            cg_step: kernel("cg_step", CG_STEP),
            cg_direction: kernel("cg_direction", CG_DIRECTION),
            cg_scalars: kernel("cg_scalars", CG_SCALARS),
            update: kernel("update", UPDATE),
        }
    }

    /// `edge` = half-quadratic weights of total variation of the logarithm of the three planes `irradiance`; smoothness term as partial sums.
    pub fn edge_weight(
        &self,
        gpu: &Gpu,
        irradiance: &super::DeviceRgb,
        edge: &wgpu::Buffer,
        partials: &wgpu::Buffer,
        lambda: f32,
        epsilon: f32,
        size: (usize, usize),
    ) -> Vec<Step> {
        let [r, g, b] = irradiance;
        let step = |band: Band| {
            let (mut bound, first) = band.bind(gpu, &[r, g, b, edge], size);
            bound.push(partials.as_entire_binding());
            let params = EdgeParams {
                size: [size.0 as i32, size.1 as i32],
                rows: band.rows(),
                first,
                partial: band.partial,
                row: band.groups[0],
                lambda,
                epsilon,
                _pad: 0.0,
            };
            self.edge_weight.step_parts(gpu, &params, &bound, band.groups)
        };
        bands(gpu, size, 0).into_iter().map(step).collect()
    }

    /// `product` = E `back` + Dᵀ w D `direction`; ⟨direction, product⟩ as partial sums.
    pub fn normal(
        &self,
        gpu: &Gpu,
        irradiance: &wgpu::Buffer,
        back: &wgpu::Buffer,
        edge: &wgpu::Buffer,
        direction: &wgpu::Buffer,
        product: &wgpu::Buffer,
        partials: &wgpu::Buffer,
        partial: usize,
        size: (usize, usize),
    ) -> Vec<Step> {
        let step = |band: Band| {
            let (mut bound, first) = band.bind(gpu, &[irradiance, back, edge, direction, product], size);
            bound.push(partials.as_entire_binding());
            let params = NormalParams {
                size: [size.0 as i32, size.1 as i32],
                rows: band.rows(),
                first,
                partial: band.partial,
                row: band.groups[0],
                _pad: 0,
            };
            self.normal.step_parts(gpu, &params, &bound, band.groups)
        };
        bands(gpu, size, partial).into_iter().map(step).collect()
    }

    /// `right_side` = E `back` - Dᵀ w D u, and the Jacobi preconditioner.
    pub fn right_side(
        &self,
        gpu: &Gpu,
        irradiance: &wgpu::Buffer,
        back: &wgpu::Buffer,
        edge: &wgpu::Buffer,
        data_diagonal: &wgpu::Buffer,
        right_side: &wgpu::Buffer,
        diagonal: &wgpu::Buffer,
        size: (usize, usize),
    ) -> Vec<Step> {
        let step = |band: Band| {
            let (bound, first) = band.bind(gpu, &[irradiance, back, edge, data_diagonal, right_side, diagonal], size);
            let params = RightSideParams { size: [size.0 as i32, size.1 as i32], rows: band.rows(), first, _pad: 0 };
            self.right_side.step_parts(gpu, &params, &bound, grid_2d(size, &band.rows))
        };
        bands(gpu, size, 0).into_iter().map(step).collect()
    }

    /// `scaled` = E `direction`, `back` = `weight` `scaled`.
    pub fn scale(
        &self,
        gpu: &Gpu,
        irradiance: &wgpu::Buffer,
        direction: &wgpu::Buffer,
        weight: &wgpu::Buffer,
        scaled: &wgpu::Buffer,
        back: &wgpu::Buffer,
        count: usize,
    ) -> Vec<Step> {
        let vectors = [irradiance, direction, weight, scaled, back];
        parts(gpu, count, 0).iter().map(|p| p.step(gpu, &self.scale, &p.vector(0), &[], &vectors, &[])).collect()
    }

    /// `values` *= `factors`.
    pub fn multiply(&self, gpu: &Gpu, factors: &wgpu::Buffer, values: &wgpu::Buffer, count: usize) -> Vec<Step> {
        parts(gpu, count, 0).iter().map(|p| p.step(gpu, &self.multiply, &p.vector(0), &[], &[factors, values], &[])).collect()
    }

    /// x = 0, p = r / diagonal; ⟨r, p⟩ as partial sums.
    pub fn cg_start(
        &self,
        gpu: &Gpu,
        residual: &wgpu::Buffer,
        diagonal: &wgpu::Buffer,
        solution: &wgpu::Buffer,
        direction: &wgpu::Buffer,
        partials: &wgpu::Buffer,
        partial: usize,
        count: usize,
    ) -> Vec<Step> {
        let vectors = [residual, diagonal, solution, direction];
        parts(gpu, count, partial).iter().map(|p| p.step(gpu, &self.cg_start, &p.sum(0), &[], &vectors, &[partials])).collect()
    }

    /// x += α p, r -= α q of `channel`; ⟨r, r / diagonal⟩ as partial sums.
    pub fn cg_step(
        &self,
        gpu: &Gpu,
        scalars: &wgpu::Buffer,
        channel: usize,
        direction: &wgpu::Buffer,
        product: &wgpu::Buffer,
        diagonal: &wgpu::Buffer,
        solution: &wgpu::Buffer,
        residual: &wgpu::Buffer,
        partials: &wgpu::Buffer,
        partial: usize,
        count: usize,
    ) -> Vec<Step> {
        let vectors = [direction, product, diagonal, solution, residual];
        let step = |p: &Part| p.step(gpu, &self.cg_step, &p.sum(SLOTS * channel), &[scalars], &vectors, &[partials]);
        parts(gpu, count, partial).iter().map(step).collect()
    }

    /// p = r / diagonal + β p of `channel`.
    pub fn cg_direction(
        &self,
        gpu: &Gpu,
        scalars: &wgpu::Buffer,
        channel: usize,
        residual: &wgpu::Buffer,
        diagonal: &wgpu::Buffer,
        direction: &wgpu::Buffer,
        count: usize,
    ) -> Vec<Step> {
        let vectors = [residual, diagonal, direction];
        let step = |p: &Part| p.step(gpu, &self.cg_direction, &p.vector(SLOTS * channel), &[scalars], &vectors, &[]);
        parts(gpu, count, 0).iter().map(step).collect()
    }

    /// Scalar `slot` of each of `channels` = sum of `count` partial sums, one channel's after another's; `shift` keeps the old ⟨r, z⟩ for β.
    pub fn sum(
        &self,
        gpu: &Gpu,
        partials: &wgpu::Buffer,
        scalars: &wgpu::Buffer,
        channels: Range<usize>,
        count: usize,
        slot: usize,
        shift: bool,
    ) -> Step {
        let params = ScalarParams { first: 0, count: count as u32, slot: (slot + SLOTS * channels.start) as u32, shift: u32::from(shift) };
        self.cg_scalars.step(gpu, &params, &[partials, scalars], [channels.len() as u32, 1, 1])
    }

    /// E = `old` · (1 + x) where x = `step` · `solution` is positive (at most fourfold), · exp(x) elsewhere (at least 1 / e), never below `darkest`.
    pub fn update(
        &self,
        gpu: &Gpu,
        old: &wgpu::Buffer,
        solution: &wgpu::Buffer,
        irradiance: &wgpu::Buffer,
        step: f32,
        darkest: f32,
        count: usize,
    ) -> Vec<Step> {
        let params = |p: &Part| UpdateParams { count: p.count(), row: p.row, step, darkest };
        parts(gpu, count, 0).iter().map(|p| p.step(gpu, &self.update, &params(p), &[], &[old, solution, irradiance], &[])).collect()
    }
}
