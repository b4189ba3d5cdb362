//! One test binary, so that wgpu is linked once.

/// Synthetic brackets against the physics that they claim.
mod synth;
