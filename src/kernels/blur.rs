//! The blur K of eq. (4) and its exact adjoint Kᵀ, of three channels or one, as warps and shifts (see [`TapSet`]). Chooses the design by
//! which they run: by tiles (src/kernels/tiles.rs) where device and warps allow, else in bands through scratch (src/kernels/bands.rs). Knows
//! no shader.

use super::bands::{self, BandKernels, Bands};
use super::geometry::Geometry;
use super::scratch::{Scratch, ScratchSize};
use super::tables::{self, BaseTable};
use super::tiles::{self, TileKernels, Tiles};
use crate::gpu::{Gpu, Step};
use crate::tsf::{Interpolation, TapSet};

/// The compiled kernels of K and Kᵀ.
pub struct BlurKernels {
    support: usize,
    bands: BandKernels,
    tiles: TileKernels,
}

impl BlurKernels {
    /// Those of one interpolation, compiled when first used.
    pub fn new(interpolation: Interpolation) -> Self {
        Self { support: interpolation.support(), bands: BandKernels::default(), tiles: TileKernels::default() }
    }
}

/// K of one frame, which maps the latent grid to the frame, and Kᵀ back.
pub struct Blur {
    geometry: Geometry,
    bases: BaseTable,
    design: Design,
}

enum Design {
    Bands(Bands),
    Tiles(Tiles),
}

impl Blur {
    /// The operator of `taps` from a latent grid, which surrounds the frame by `pad` pixels on every side, to a frame of
    /// `frame` = (width, height) pixels. Irradiance beyond the latent grid counts as 0. Direct when every tap has a base of its own
    /// and shifts nothing.
    pub fn new(gpu: &Gpu, kernels: &BlurKernels, taps: &TapSet, frame: (usize, usize), pad: usize) -> Self {
        let (homographies, groups) = tables::by_entry(taps);
        let geometry = Geometry::new(taps, homographies, frame, pad, kernels.support);
        let spread = geometry.spread(&taps.bases, &[bands::NEAR, tiles::COLUMN]);
        let direct = taps.is_direct();
        let bases = BaseTable::new(gpu, &geometry.homographies, |entry| if direct { groups[entry][0].2 as f32 } else { 1.0 });
        let tiled = !direct && spread.near && !gpu.software;
        let tiles = tiled.then(|| Tiles::new(gpu, geometry.support, spread.largest.max(1.0), bases.planar, &groups)).flatten();
        let design = tiles.map_or_else(|| Design::Bands(Bands::new(gpu, &geometry, &spread, direct, &groups)), Design::Tiles);
        Self { geometry, bases, design }
    }

    /// Scratch that lets the operator run in one pass.
    pub fn scratch_wanted(&self) -> ScratchSize {
        match &self.design {
            Design::Bands(bands) => bands.scratch_wanted(&self.geometry),
            Design::Tiles(_) => ScratchSize::default(),
        }
    }

    /// Scratch without which the operator cannot run.
    pub fn scratch_needed(&self) -> ScratchSize {
        match &self.design {
            Design::Bands(bands) => bands.scratch_needed(&self.geometry),
            Design::Tiles(_) => ScratchSize::default(),
        }
    }

    /// Rows of the latent grid or of the frame that the lowest band reads or adds to at once: fewer cannot be bound.
    pub fn rows_at_once(&self) -> usize {
        match &self.design {
            Design::Bands(_) => Bands::rows_at_once(&self.geometry),
            Design::Tiles(tiles) => tiles.rows_at_once(&self.geometry),
        }
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
        let (geometry, bases) = (&self.geometry, &self.bases);
        match &self.design {
            Design::Bands(bands) => bands.forward(gpu, &kernels.bands, geometry, bases, scratch, latent, frame),
            Design::Tiles(tiles) => tiles.steps(gpu, &kernels.tiles, geometry, bases, scratch, false, latent, frame, 1.0),
        }
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
        let (geometry, bases) = (&self.geometry, &self.bases);
        match &self.design {
            Design::Bands(bands) => bands.adjoint(gpu, &kernels.bands, geometry, bases, scratch, frame, latent, factor),
            Design::Tiles(tiles) => tiles.steps(gpu, &kernels.tiles, geometry, bases, scratch, true, frame, latent, factor),
        }
    }
}
