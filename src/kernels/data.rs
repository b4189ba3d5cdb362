//! Data weights and residuals of one frame: how much each pixel counts and how far the estimate is from it.

use super::linear::{Part, grid_2d, parts};
use crate::gpu::{Gpu, Kernel, Rows, Step};
use std::ops::Range;

pub(super) const WEIGHTS: &str = source!("common/plane", "common/noise", "weights");
pub(super) const MISFIT: &str = source!("common/plane", "common/noise", "misfit");
pub(super) const GAUSS: &str = source!("common/plane", "gauss");
pub(super) const RESIDUAL: &str = source!("common/vector", "residual");

/// Exposure that marks a channel as clipped at a pixel: it does not count there, whatever the mask. The kernels take all below half of it for
/// that; noise about black does not reach there.
pub const UNSEEN: f32 = -1.0;

/// Samples of a noise curve: standard deviation of the exposure at equal steps of √exposure from 0 to 1.
pub const NOISE_STEPS: usize = 256;

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct WeightParams {
    size: [i32; 2],
    rows: [i32; 2],
    predicted_offset: [i32; 2],
    out_offset: [i32; 2],
    predicted_stride: i32,
    predicted_first: i32,
    out_stride: i32,
    out_first: i32,
    first: i32,
    exposure_time: f32,
    robust: f32,
    black_clipped: u32,
    accumulate: u32,
    _pad: [u32; 3],
    noise: [f32; NOISE_STEPS],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct MisfitParams {
    size: [i32; 2],
    rows: [i32; 2],
    predicted_offset: [i32; 2],
    predicted_stride: i32,
    predicted_first: i32,
    first: i32,
    exposure_time: f32,
    black_clipped: u32,
    accumulate: u32,
    noise: [f32; NOISE_STEPS],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct GaussParams {
    size: [i32; 2],
    rows: [i32; 2],
    step: [i32; 2],
    first: i32,
    sigma: f32,
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

/// One channel of a frame's observations, and where its prediction lies.
pub struct MisfitSource<'a> {
    /// (width, height) of the frame.
    pub size: (usize, usize),
    /// Predicted irradiance K E.
    pub predicted: &'a wgpu::Buffer,
    /// Pixel of the prediction at which the frame begins, in x and in y.
    pub predicted_offset: usize,
    /// (width, height) of the prediction.
    pub predicted_size: (usize, usize),
    /// Exposure f⁻¹(Z), 1 = white; [`UNSEEN`] where the channel does not count.
    pub exposure: &'a wgpu::Buffer,
    /// Mask of eq. (8), the same for all channels.
    pub mask: &'a wgpu::Buffer,
    /// Exposure time in seconds.
    pub exposure_time: f32,
    /// Whether noise is clipped at black.
    pub black_clipped: bool,
    /// Noise curve of the channel.
    pub noise: &'a [f32],
}

/// χ² of a frame's pixels, a third for each channel, and how many pixels it stands for, a third for each channel that counts.
pub struct Misfit {
    /// Sum of χ².
    pub sum: wgpu::Buffer,
    /// Pixels.
    pub counted: wgpu::Buffer,
}

/// Where weights and weighted observations of a channel go.
pub struct WeightTarget<'a> {
    /// W.
    pub weight: &'a wgpu::Buffer,
    /// W B.
    pub observation: &'a wgpu::Buffer,
    /// Pixel at which the frame begins, in x and in y.
    pub offset: usize,
    /// (width, height).
    pub size: (usize, usize),
    /// Whether to add to what is there.
    pub accumulate: bool,
}

/// Standard deviation in pixels of the Gaussian that makes misfits local.
const SIGMA: f32 = 2.0;
/// Rows above and below that it reads.
pub const REACH: usize = 6;

fn ints(v: (usize, usize)) -> [i32; 2] {
    [v.0 as i32, v.1 as i32]
}

impl MisfitSource<'_> {
    /// The rows of the prediction that the frame's rows `rows` compare with, and which of them comes first in the binding.
    fn predicted(&self, gpu: &Gpu, rows: &Range<usize>) -> Rows<'_> {
        let seen = rows.start + self.predicted_offset..rows.end + self.predicted_offset;
        gpu.rows(self.predicted, self.predicted_size, seen)
    }

    /// Bands of the frame of which a kernel can bind its part of the prediction and of an output of size `out`.
    fn bands(&self, gpu: &Gpu, out: (usize, usize)) -> Vec<Range<usize>> {
        let (w, h) = self.predicted_size;
        gpu.bands(self.size.1, 0, (w.max(out.0), h.max(out.1))).collect()
    }
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

    /// Steps of: `misfit` receives a third of χ² of each pixel of a channel; `accumulate`: adds it to that of the channels before.
    pub fn misfit(&self, gpu: &Gpu, from: &MisfitSource, misfit: &Misfit, accumulate: bool) -> Vec<Step> {
        let step = |rows: Range<usize>| {
            let predicted = from.predicted(gpu, &rows);
            let own = [from.exposure, from.mask, &misfit.sum, &misfit.counted].map(|b| gpu.rows(b, from.size, rows.clone()));
            let params = MisfitParams {
                size: ints(from.size),
                rows: ints((rows.start, rows.end)),
                predicted_offset: [from.predicted_offset as i32; 2],
                predicted_stride: from.predicted_size.0 as i32,
                predicted_first: predicted.first as i32,
                first: own[0].first as i32,
                exposure_time: from.exposure_time,
                black_clipped: u32::from(from.black_clipped),
                accumulate: u32::from(accumulate),
                noise: std::array::from_fn(|i| from.noise[i]),
            };
            let [exposure, mask, sum, counted] = own.map(|r| r.binding);
            self.misfit.step_parts(gpu, &params, &[predicted.binding, exposure, mask, sum, counted], grid_2d(from.size, &rows))
        };
        from.bands(gpu, from.size).into_iter().map(step).collect()
    }

    /// Steps of: `misfit` becomes local by sums with a Gaussian of 2 px; `scratch` is as large.
    pub fn local(&self, gpu: &Gpu, misfit: &Misfit, scratch: &Misfit, size: (usize, usize)) -> Vec<Step> {
        let gauss = |direction: [i32; 2], from: &Misfit, to: &Misfit| -> Vec<Step> {
            let step = |rows: Range<usize>| {
                let seen = rows.start.saturating_sub(REACH)..(rows.end + REACH).min(size.1);
                let planes = [&from.sum, &from.counted, &to.sum, &to.counted].map(|b| gpu.rows(b, size, seen.clone()));
                let (rows_of, first) = (ints((rows.start, rows.end)), planes[0].first as i32);
                let params = GaussParams { size: ints(size), rows: rows_of, step: direction, first, sigma: SIGMA };
                self.gauss.step_parts(gpu, &params, &planes.map(|r| r.binding), grid_2d(size, &rows))
            };
            gpu.bands(size.1, REACH, size).map(step).collect()
        };
        [gauss([1, 0], misfit, scratch), gauss([0, 1], scratch, misfit)].concat()
    }

    /// Steps of: weights and weighted observations of one channel of a frame at its prediction; `robust` is the strength of the
    /// residual-driven weights by the local `misfit` (0: none).
    pub fn weights(&self, gpu: &Gpu, from: &MisfitSource, misfit: &Misfit, robust: f32, to: &WeightTarget) -> Vec<Step> {
        let step = |rows: Range<usize>| {
            let predicted = from.predicted(gpu, &rows);
            let own = [from.exposure, from.mask, &misfit.sum, &misfit.counted].map(|b| gpu.rows(b, from.size, rows.clone()));
            let written = rows.start + to.offset..rows.end + to.offset;
            let out = [to.weight, to.observation].map(|b| gpu.rows(b, to.size, written.clone()));
            let params = WeightParams {
                size: ints(from.size),
                rows: ints((rows.start, rows.end)),
                predicted_offset: [from.predicted_offset as i32; 2],
                out_offset: [to.offset as i32; 2],
                predicted_stride: from.predicted_size.0 as i32,
                predicted_first: predicted.first as i32,
                out_stride: to.size.0 as i32,
                out_first: out[0].first as i32,
                first: own[0].first as i32,
                exposure_time: from.exposure_time,
                robust,
                black_clipped: u32::from(from.black_clipped),
                accumulate: u32::from(to.accumulate),
                _pad: [0; 3],
                noise: std::array::from_fn(|i| from.noise[i]),
            };
            let ([exposure, mask, sum, counted], [weight, observation]) = (own.map(|r| r.binding), out.map(|r| r.binding));
            let bound = [predicted.binding, exposure, mask, sum, counted, weight, observation];
            self.weights.step_parts(gpu, &params, &bound, grid_2d(from.size, &rows))
        };
        from.bands(gpu, to.size).into_iter().map(step).collect()
    }

    /// Steps of: `residual = observation - weight * predicted` of one channel, its part of the data term as partial sums
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
    ) -> Vec<Step> {
        let step = |p: &Part| {
            let params = ResidualParams { count: p.count(), partial: p.partial, row: p.row, _pad: 0 };
            p.step(gpu, &self.residual, &params, &[], &[predicted, weight, observation, residual], &[partials])
        };
        parts(gpu, count, partial).iter().map(step).collect()
    }
}
