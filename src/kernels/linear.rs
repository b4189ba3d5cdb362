//! Smoothness term, normal equations and conjugate gradients in log irradiance, one channel per step.

use crate::gpu::{Gpu, Kernel, Step, grid_1d};

pub(super) const EDGE_WEIGHT: &str =
    concat!(include_str!("../../shaders/common/plane.wgsl"), include_str!("../../shaders/edge_weight.wgsl"));
pub(super) const NORMAL: &str = concat!(
    include_str!("../../shaders/common/plane.wgsl"),
    include_str!("../../shaders/common/smoothness.wgsl"),
    include_str!("../../shaders/normal.wgsl")
);
pub(super) const RIGHT_SIDE: &str = concat!(
    include_str!("../../shaders/common/plane.wgsl"),
    include_str!("../../shaders/common/smoothness.wgsl"),
    include_str!("../../shaders/right_side.wgsl")
);
pub(super) const SCALE: &str = include_str!("../../shaders/scale.wgsl");
pub(super) const MULTIPLY: &str = include_str!("../../shaders/multiply.wgsl");
pub(super) const CG_START: &str = include_str!("../../shaders/cg_start.wgsl");
pub(super) const CG_STEP: &str = include_str!("../../shaders/cg_step.wgsl");
pub(super) const CG_DIRECTION: &str = include_str!("../../shaders/cg_direction.wgsl");
pub(super) const CG_SCALARS: &str = include_str!("../../shaders/cg_scalars.wgsl");
pub(super) const UPDATE: &str = include_str!("../../shaders/update.wgsl");

/// Scalar ⟨r, z⟩.
pub const SLOT_ENERGY: u32 = 0;
/// Scalar ⟨p, A p⟩.
pub const SLOT_CURVATURE: u32 = 1;
/// Scalar: data term of the objective.
pub const SLOT_DATA: u32 = 3;
/// Scalar: smoothness term of the objective.
pub const SLOT_SMOOTHNESS: u32 = 4;

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct EdgeParams {
    size: [i32; 2],
    lambda: f32,
    epsilon: f32,
    partial: u32,
    row: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ImageParams {
    size: [i32; 2],
    partial: u32,
    row: u32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct VectorParams {
    count: u32,
    row: u32,
    _pad: [u32; 2],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct SumParams {
    count: u32,
    partial: u32,
    row: u32,
    _pad: u32,
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
    _pad: u32,
}

pub(super) fn params_sizes() -> Vec<(&'static str, usize)> {
    let vector = size_of::<VectorParams>();
    vec![
        ("edge_weight", size_of::<EdgeParams>()),
        ("normal", size_of::<ImageParams>()),
        ("right_side", size_of::<ImageParams>()),
        ("scale", vector),
        ("multiply", vector),
        ("cg_start", size_of::<SumParams>()),
        ("cg_step", size_of::<SumParams>()),
        ("cg_direction", vector),
        ("cg_scalars", size_of::<ScalarParams>()),
        ("update", size_of::<UpdateParams>()),
    ]
}

/// Partial sums of a kernel over an image of `size`.
pub fn partials_2d(size: (usize, usize)) -> usize {
    size.0.div_ceil(16) * size.1.div_ceil(8)
}

/// Partial sums of a kernel over `count` values.
pub fn partials_1d(count: usize) -> usize {
    let (row, rows) = grid_1d(count);
    row as usize * rows as usize
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

fn image_params(size: (usize, usize), partial: usize) -> ImageParams {
    ImageParams { size: [size.0 as i32, size.1 as i32], partial: partial as u32, row: size.0.div_ceil(16) as u32 }
}

fn vector_params(count: usize) -> VectorParams {
    VectorParams { count: count as u32, row: grid_1d(count).0, _pad: [0; 2] }
}

fn sum_params(count: usize, partial: usize) -> SumParams {
    SumParams { count: count as u32, partial: partial as u32, row: grid_1d(count).0, _pad: 0 }
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

    /// `edge` = half-quadratic weights of total variation of the three planes `log`; smoothness term as partial sums.
    pub fn edge_weight(
        &self,
        gpu: &Gpu,
        log: &super::Channels,
        edge: &wgpu::Buffer,
        partials: &wgpu::Buffer,
        lambda: f32,
        epsilon: f32,
        size: (usize, usize),
    ) -> Step {
        let params = EdgeParams { size: [size.0 as i32, size.1 as i32], lambda, epsilon, partial: 0, row: size.0.div_ceil(16) as u32 };
        self.edge_weight.step_2d(gpu, &params, &[&log[0], &log[1], &log[2], edge, partials], size, 1)
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
    ) -> Step {
        self.normal.step_2d(gpu, &image_params(size, partial), &[irradiance, back, edge, direction, product, partials], size, 1)
    }

    /// `right_side` = E `back` - Dᵀ w D u, and the Jacobi preconditioner.
    pub fn right_side(
        &self,
        gpu: &Gpu,
        irradiance: &wgpu::Buffer,
        back: &wgpu::Buffer,
        edge: &wgpu::Buffer,
        log: &wgpu::Buffer,
        data_diagonal: &wgpu::Buffer,
        right_side: &wgpu::Buffer,
        diagonal: &wgpu::Buffer,
        size: (usize, usize),
    ) -> Step {
        let buffers = [irradiance, back, edge, log, data_diagonal, right_side, diagonal];
        self.right_side.step_2d(gpu, &image_params(size, 0), &buffers, size, 1)
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
    ) -> Step {
        self.scale.step_1d(gpu, &vector_params(count), &[irradiance, direction, weight, scaled, back], count)
    }

    /// `values` *= `factors`.
    pub fn multiply(&self, gpu: &Gpu, factors: &wgpu::Buffer, values: &wgpu::Buffer, count: usize) -> Step {
        self.multiply.step_1d(gpu, &vector_params(count), &[factors, values], count)
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
    ) -> Step {
        self.cg_start.step_1d(gpu, &sum_params(count, partial), &[residual, diagonal, solution, direction, partials], count)
    }

    /// x += α p, r -= α q; ⟨r, r / diagonal⟩ as partial sums.
    pub fn cg_step(
        &self,
        gpu: &Gpu,
        scalars: &wgpu::Buffer,
        direction: &wgpu::Buffer,
        product: &wgpu::Buffer,
        diagonal: &wgpu::Buffer,
        solution: &wgpu::Buffer,
        residual: &wgpu::Buffer,
        partials: &wgpu::Buffer,
        partial: usize,
        count: usize,
    ) -> Step {
        let buffers = [scalars, direction, product, diagonal, solution, residual, partials];
        self.cg_step.step_1d(gpu, &sum_params(count, partial), &buffers, count)
    }

    /// p = r / diagonal + β p.
    pub fn cg_direction(
        &self,
        gpu: &Gpu,
        scalars: &wgpu::Buffer,
        residual: &wgpu::Buffer,
        diagonal: &wgpu::Buffer,
        direction: &wgpu::Buffer,
        count: usize,
    ) -> Step {
        self.cg_direction.step_1d(gpu, &vector_params(count), &[scalars, residual, diagonal, direction], count)
    }

    /// `scalars[slot]` = sum of the first `count` partial sums; `shift` keeps the old ⟨r, z⟩ for β.
    pub fn sum(&self, gpu: &Gpu, partials: &wgpu::Buffer, scalars: &wgpu::Buffer, count: usize, slot: u32, shift: bool) -> Step {
        let params = ScalarParams { first: 0, count: count as u32, slot, shift: u32::from(shift) };
        self.cg_scalars.step(gpu, &params, &[partials, scalars], [1, 1, 1])
    }

    /// E = exp(`old`) · (1 + x) where x = `step` · `solution` is positive (at most fourfold), · exp(x) elsewhere (at least 1 / e); u = ln E.
    pub fn update(
        &self,
        gpu: &Gpu,
        old: &wgpu::Buffer,
        solution: &wgpu::Buffer,
        log: &wgpu::Buffer,
        irradiance: &wgpu::Buffer,
        step: f32,
        count: usize,
    ) -> Step {
        let params = UpdateParams { count: count as u32, row: grid_1d(count).0, step, _pad: 0 };
        self.update.step_1d(gpu, &params, &[old, solution, log, irradiance], count)
    }
}
