//! Data weights and residuals of one frame: how much each pixel counts and how far the estimate is from it.

use super::Channels;
use crate::gpu::{Gpu, Kernel, Step, grid_1d};

pub(super) const WEIGHTS: &str = concat!(
    include_str!("../../shaders/common/plane.wgsl"),
    include_str!("../../shaders/common/noise.wgsl"),
    include_str!("../../shaders/weights.wgsl")
);
pub(super) const MISFIT: &str = concat!(
    include_str!("../../shaders/common/plane.wgsl"),
    include_str!("../../shaders/common/noise.wgsl"),
    include_str!("../../shaders/misfit.wgsl")
);
pub(super) const GAUSS: &str = concat!(include_str!("../../shaders/common/plane.wgsl"), include_str!("../../shaders/gauss.wgsl"));
pub(super) const RESIDUAL: &str = include_str!("../../shaders/residual.wgsl");

/// Samples of a noise curve: standard deviation of the exposure at equal steps of √exposure from 0 to 1.
pub const NOISE_STEPS: usize = 256;

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct WeightParams {
    size: [i32; 2],
    predicted_offset: [i32; 2],
    predicted_stride: i32,
    _pad0: i32,
    out_offset: [i32; 2],
    out_stride: i32,
    exposure_time: f32,
    robust: f32,
    black_clipped: u32,
    accumulate: u32,
    _pad1: [u32; 3],
    noise: [f32; NOISE_STEPS],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct MisfitParams {
    size: [i32; 2],
    predicted_offset: [i32; 2],
    predicted_stride: i32,
    exposure_time: f32,
    black_clipped: u32,
    _pad: u32,
    noise: [f32; 3 * NOISE_STEPS],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct GaussParams {
    size: [i32; 2],
    step: [i32; 2],
    sigma: f32,
    _pad: f32,
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ResidualParams {
    count: u32,
    partial: u32,
    row: u32,
    _pad: u32,
}

pub(super) fn params_sizes() -> Vec<(&'static str, usize)> {
    vec![
        ("weights", size_of::<WeightParams>()),
        ("misfit", size_of::<MisfitParams>()),
        ("gauss", size_of::<GaussParams>()),
        ("residual", size_of::<ResidualParams>()),
    ]
}

/// The compiled kernels of the data term.
pub struct DataKernels {
    weights: Kernel,
    misfit: Kernel,
    gauss: Kernel,
    residual: Kernel,
}

/// One frame's observations and where its prediction lies.
pub struct MisfitSource<'a> {
    /// (width, height) of the frame.
    pub size: (usize, usize),
    /// Predicted irradiance K E.
    pub predicted: &'a Channels,
    /// Pixel of the prediction at which the frame begins, in x and in y.
    pub predicted_offset: usize,
    /// Pixels per row of the prediction.
    pub predicted_stride: usize,
    /// Exposure f⁻¹(Z), 1 = white.
    pub exposure: &'a Channels,
    /// Mask of eq. (8), the same for all channels.
    pub mask: &'a wgpu::Buffer,
    /// Exposure time in seconds.
    pub exposure_time: f32,
    /// Whether noise is clipped at black.
    pub black_clipped: bool,
    /// Noise curves of the three channels.
    pub noise: &'a [Vec<f32>; 3],
}

/// Where weights and weighted observations go.
pub struct WeightTarget<'a> {
    /// W.
    pub weight: &'a Channels,
    /// W B.
    pub observation: &'a Channels,
    /// Pixel at which the frame begins, in x and in y.
    pub offset: usize,
    /// Pixels per row.
    pub stride: usize,
    /// Whether to add to what is there.
    pub accumulate: bool,
}

impl DataKernels {
    /// Compiles them.
    pub fn new(gpu: &Gpu) -> Self {
        Self {
            weights: Kernel::new(gpu, "weights", WEIGHTS, &[]),
            misfit: Kernel::new(gpu, "misfit", MISFIT, &[]),
            gauss: Kernel::new(gpu, "gauss", GAUSS, &[]),
            residual: Kernel::new(gpu, "residual", RESIDUAL, &[]),
        }
    }

    /// Steps of: `misfit` receives the local sums of (χ², pixels) with a Gaussian of 2 px; `scratch` is as large.
    pub fn misfit(&self, gpu: &Gpu, from: &MisfitSource, misfit: &wgpu::Buffer, scratch: &wgpu::Buffer) -> Vec<Step> {
        let mut noise = [0.0; 3 * NOISE_STEPS];
        for (c, n) in from.noise.iter().enumerate() {
            noise[c * NOISE_STEPS..(c + 1) * NOISE_STEPS].copy_from_slice(n);
        }
        let size = [from.size.0 as i32, from.size.1 as i32];
        let params = MisfitParams {
            size,
            predicted_offset: [from.predicted_offset as i32; 2],
            predicted_stride: from.predicted_stride as i32,
            exposure_time: from.exposure_time,
            black_clipped: u32::from(from.black_clipped),
            _pad: 0,
            noise,
        };
        let (p, x) = (from.predicted, from.exposure);
        let gauss = |step: [i32; 2], input: &wgpu::Buffer, output: &wgpu::Buffer| {
            self.gauss.step_2d(gpu, &GaussParams { size, step, sigma: 2.0, _pad: 0.0 }, &[input, output], from.size, 1)
        };
        vec![
            self.misfit.step_2d(gpu, &params, &[&p[0], &p[1], &p[2], &x[0], &x[1], &x[2], from.mask, misfit], from.size, 1),
            gauss([1, 0], misfit, scratch),
            gauss([0, 1], scratch, misfit),
        ]
    }

    /// Steps of: weights and weighted observations of one frame at its prediction; `robust` is the strength of the
    /// residual-driven weights (0: none).
    pub fn weights(&self, gpu: &Gpu, from: &MisfitSource, misfit: &wgpu::Buffer, robust: f32, to: &WeightTarget) -> Vec<Step> {
        (0..3)
            .map(|c| {
                let params = WeightParams {
                    size: [from.size.0 as i32, from.size.1 as i32],
                    predicted_offset: [from.predicted_offset as i32; 2],
                    predicted_stride: from.predicted_stride as i32,
                    _pad0: 0,
                    out_offset: [to.offset as i32; 2],
                    out_stride: to.stride as i32,
                    exposure_time: from.exposure_time,
                    robust,
                    black_clipped: u32::from(from.black_clipped),
                    accumulate: u32::from(to.accumulate),
                    _pad1: [0; 3],
                    noise: std::array::from_fn(|i| from.noise[c][i]),
                };
                let buffers = [&from.predicted[c], &from.exposure[c], from.mask, misfit, &to.weight[c], &to.observation[c]];
                self.weights.step_2d(gpu, &params, &buffers, from.size, 1)
            })
            .collect()
    }

    /// Step of: `residual = observation - weight * predicted` of one channel, its part of the data term as partial sums
    /// from `partial` on.
    pub fn residual(
        &self,
        gpu: &Gpu,
        predicted: &wgpu::Buffer,
        weight: &wgpu::Buffer,
        observation: &wgpu::Buffer,
        residual: &wgpu::Buffer,
        partials: &wgpu::Buffer,
        partial: usize,
        count: usize,
    ) -> Step {
        let params = ResidualParams { count: count as u32, partial: partial as u32, row: grid_1d(count).0, _pad: 0 };
        self.residual.step_1d(gpu, &params, &[predicted, weight, observation, residual, partials], count)
    }
}
