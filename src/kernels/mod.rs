//! The solver's operators on the GPU, one file per group of shaders. Knows no algorithm.

/// Whole source of a kernel: its common parts, then its own file.
macro_rules! source {
    ($($file:literal),+) => { concat!($(include_str!(concat!("../../shaders/", $file, ".wgsl"))),+) };
}

mod bands;
mod blur;
mod data;
mod display;
mod geometry;
mod linear;
mod scratch;
mod tables;
mod tiles;

pub use blur::{Blur, BlurKernels};
pub use data::{DataKernels, Misfit, MisfitSource, NOISE_STEPS, REACH, UNSEEN, WeightTarget};
pub use display::{Display, DisplayParams, Part, Place};
pub use linear::{HALO, LinearKernels, SCALARS, SLOT_CURVATURE, SLOT_DATA, SLOT_ENERGY, SLOT_SMOOTHNESS, SLOTS, partials_1d, partials_2d};
pub use scratch::{Scratch, ScratchSize};

use crate::gpu::Gpu;
use crate::tsf::Interpolation;

/// Three buffers of one size: red, green, blue.
pub type DeviceRgb = [wgpu::Buffer; 3];

/// Three planes of `count` zeros.
///
/// # Errors
/// As [`Gpu::plane`].
pub fn channels(gpu: &Gpu, label: &str, count: usize) -> crate::error::Result<DeviceRgb> {
    Ok([gpu.plane(label, count)?, gpu.plane(label, count)?, gpu.plane(label, count)?])
}

/// Interpolation of the one warp of a displaced sharp frame, whatever that of the blurred ones. Their poses are refined under their own
/// interpolation, which makes up for part of its error; one pose cannot.
pub const STILL: Interpolation = Interpolation::SixPoint;

/// All kernels, compiled once per device.
pub struct Kernels {
    /// K and Kᵀ, by the half-width of the interpolation.
    blur: [BlurKernels; 3],
    /// Data weights and residuals.
    pub data: DataKernels,
    /// Smoothness and conjugate gradients.
    pub linear: LinearKernels,
}

impl Kernels {
    /// Compiles everything but K and Kᵀ.
    pub fn new(gpu: &Gpu) -> Self {
        let blur = [Interpolation::Bilinear, Interpolation::Bicubic, Interpolation::SixPoint].map(BlurKernels::new);
        Self { blur, data: DataKernels::new(gpu), linear: LinearKernels::new(gpu) }
    }

    /// K and Kᵀ under `interpolation`.
    pub fn blur(&self, interpolation: Interpolation) -> &BlurKernels {
        &self.blur[interpolation.support() - 1]
    }
}

/// Every shader of the program as (name, whole source), for validation without a GPU.
pub const SHADERS: &[(&str, &str)] = &[
    ("padded", bands::PADDED),
    ("warp", bands::WARP),
    ("warp_direct", bands::WARP_DIRECT),
    ("warp_adjoint", bands::WARP_ADJOINT),
    ("warp_adjoint_near", bands::WARP_ADJOINT_NEAR),
    ("tap_sum", bands::TAP_SUM),
    ("tap_adjoint", bands::TAP_ADJOINT),
    ("blur_tile", tiles::BLUR_TILE),
    ("blur_tile_adjoint", tiles::BLUR_TILE_ADJOINT),
    ("weights", data::WEIGHTS),
    ("misfit", data::MISFIT),
    ("gauss", data::GAUSS),
    ("residual", data::RESIDUAL),
    ("edge_weight", linear::EDGE_WEIGHT),
    ("normal", linear::NORMAL),
    ("right_side", linear::RIGHT_SIDE),
    ("scale", linear::SCALE),
    ("multiply", linear::MULTIPLY),
    ("cg_start", linear::CG_START),
    ("cg_step", linear::CG_STEP),
    ("cg_direction", linear::CG_DIRECTION),
    ("cg_scalars", linear::CG_SCALARS),
    ("update", linear::UPDATE),
    ("picture", display::PICTURE),
    ("shrink", display::SHRINK),
    ("display", display::DISPLAY),
];

/// Sizes of the Rust mirrors of the shaders' `Params` as (shader, bytes), to be compared with what naga lays out.
pub fn params_sizes() -> Vec<(&'static str, usize)> {
    [bands::params_sizes(), tiles::params_sizes(), data::params_sizes(), linear::params_sizes(), display::params_sizes()].concat()
}

/// Sizes of the Rust mirrors of the shaders' table entries as (shader, structure, bytes), likewise.
pub fn table_sizes() -> Vec<(&'static str, &'static str, usize)> {
    tables::table_sizes()
}
