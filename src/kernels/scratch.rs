//! Scratch memory that the operators of one solver share. Knows its size, not what is written to it.

use crate::error::Result;
use crate::gpu::{Gpu, Texels};
use std::ops::Range;

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
    pub(super) planes: Texels,
    pub(super) copy: Texels,
    channels: usize,
    /// Bound for the channels that are not there: for inputs, for the second output, for the third.
    unused: [wgpu::Buffer; 3],
    pub(super) size: ScratchSize,
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
