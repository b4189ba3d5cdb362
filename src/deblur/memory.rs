//! Device memory of a solve: what it needs, and what stays on the host when that is too much.
//!
//! Bytes, with n pixels of the latent grid (the frame and its pad), m of the frame, F frames, S of them shaken, C channels solved together (3; 1
//! when memory is short):
//!
//! `(52 + 20 C) n + 16 F m + (4 C + 24 S) m [when S > 0] + T scratch + partial sums`, where T is 16 for three channels and 4 for one.
//!
//! 52 n: irradiance, the step, weights and weighted observations of the sharp frames (three channels each), edge weights. 20 C n: the vectors
//! of the conjugate gradients and the preconditioner. Vectors that are never alive together share buffers. 16 F m: exposures and masks, needed only when
//! the weights are made; when memory is short they stay on the host and travel then, through buffers that are free at that time. 4 C m: prediction; 24 m:
//! weights and weighted observations of a shaken frame.

use crate::error::{Error, Result};
use crate::kernels::{SCALARS, ScratchSize};
use serde::Serialize;

/// Where a solve keeps what.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Memory {
    /// Bytes of planes on the device.
    pub bytes: u64,
    /// Whether exposures and masks stay on the host.
    pub streamed: bool,
    /// Channels that are solved together: 3, or 1 when memory is short.
    pub channels_together: usize,
    /// Whether the device had less room than was planned with.
    pub reduced: bool,
}

/// What has to be kept.
#[derive(Clone, Copy, Debug)]
pub(super) struct Need {
    pub latent: usize,
    pub frame: usize,
    pub frames: usize,
    pub shaken: usize,
    /// Partial sums of one channel.
    pub partials: usize,
    pub scratch_wanted: ScratchSize,
    pub scratch_needed: ScratchSize,
}

/// A way to keep it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plan {
    pub memory: Memory,
    pub scratch: ScratchSize,
}

impl Need {
    /// Bytes of everything, given what is chosen.
    fn bytes(&self, scratch: ScratchSize, streamed: bool, channels: usize) -> u64 {
        let (n, m, c) = (self.latent as u64, self.frame as u64, channels as u64);
        let predicted = if self.shaken > 0 { 4 * c * m } else { 8 * c };
        let frames = if streamed { 0 } else { 16 * self.frames as u64 * m };
        let sums = 4 * (channels * self.partials + SCALARS) as u64;
        (52 + 20 * c) * n + frames + predicted + 24 * self.shaken as u64 * m + scratch.bytes(channels) + sums
    }

    /// The first of: everything on the device; smaller scratch; exposures on the host; both; and one channel after another, that fits
    /// `limit` bytes.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], with the bytes that are needed, when none fits.
    pub fn plan(&self, limit: u64) -> Result<Plan> {
        let small = |part: usize| ScratchSize {
            planes: (self.scratch_wanted.planes / part).max(self.scratch_needed.planes),
            copy: (self.scratch_wanted.copy / part).max(self.scratch_needed.copy),
        };
        for (streamed, channels_together) in [(false, 3), (true, 3), (true, 1)] {
            for part in [1, 4, 16, 64, usize::MAX] {
                let bytes = self.bytes(small(part), streamed, channels_together);
                if bytes <= limit {
                    return Ok(Plan { memory: Memory { bytes, streamed, channels_together, reduced: false }, scratch: small(part) });
                }
            }
        }
        let least = self.bytes(small(usize::MAX), true, 1).div_ceil(1 << 20);
        Err(Error::OutOfMemory(format!("needs {least} MiB of device memory at least")))
    }
}
