//! One test binary, so that wgpu is linked once.

/// The plain merge on frames whose irradiance is known.
mod baseline;
/// The demo's bracket and its before/after picture.
mod demo;
/// Quality measures against stored values of an independent implementation.
mod metrics;
/// Synthetic brackets against the physics that they claim.
mod synth;
/// Tone mapping: degenerate images, shadows and highlights together, no halos.
mod tonemap;
