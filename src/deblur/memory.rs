//! Device memory of a solve: what it needs, and what stays on the host when that is too much.
//!
//! Bytes, with n pixels of the latent grid (the frame and its pad), m of the frame, F frames, S of them shaken:
//!
//! `124 n + 16 m + 16 F m + (12 + 24 S) m [when S > 0] + 12 scratch + partial sums`
//!
//! 124 n: irradiance, its logarithm, the five vectors of the conjugate gradients, preconditioner, weights and weighted observations of the
//! sharp frames (three channels each), edge weights. Vectors that are never alive together share buffers. 16 m: local misfits. 16 F m:
//! exposures and masks, needed only when the weights are made; when memory is short they stay on the host and travel then, through buffers
//! that are free at that time. 12 m: prediction; 24 m: weights and weighted observations of a shaken frame.

use crate::error::{Error, Result};
use crate::kernels::ScratchSize;
use serde::Serialize;

/// Where a solve keeps what.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Memory {
    /// Bytes of planes on the device.
    pub bytes: u64,
    /// Whether exposures and masks stay on the host.
    pub streamed: bool,
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
    fn bytes(&self, scratch: ScratchSize, streamed: bool) -> u64 {
        let (n, m) = (self.latent as u64, self.frame as u64);
        let shaken = if self.shaken > 0 { (12 + 24 * self.shaken as u64) * m } else { 24 };
        let frames = if streamed { 0 } else { 16 * self.frames as u64 * m };
        124 * n + 16 * m + frames + shaken + scratch.bytes() + 4 * (self.partials + 8) as u64
    }

    /// The first of: everything on the device; smaller scratch; exposures on the host; both, that fits `limit` bytes.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], with the bytes that are needed, when none fits.
    pub fn plan(&self, limit: u64) -> Result<Plan> {
        let small = |part: usize| ScratchSize {
            planes: (self.scratch_wanted.planes / part).max(self.scratch_needed.planes),
            copy: (self.scratch_wanted.copy / part).max(self.scratch_needed.copy),
        };
        for streamed in [false, true] {
            for part in [1, 4, 16, 64, usize::MAX] {
                let bytes = self.bytes(small(part), streamed);
                if bytes <= limit {
                    return Ok(Plan { memory: Memory { bytes, streamed, reduced: false }, scratch: small(part) });
                }
            }
        }
        let least = self.bytes(small(usize::MAX), true).div_ceil(1 << 20);
        Err(Error::OutOfMemory(format!("needs {least} MiB of device memory at least")))
    }
}
