//! One test binary, so that wgpu is linked once.

/// f64 oracles of the kernels and the solver.
#[path = "../oracle/mod.rs"]
mod oracle;
/// The shared device, fixed-seed numbers, comparison.
mod support;

/// K, Kᵀ and the taps of a TSF.
mod adjoint;
/// The plain merge on frames whose irradiance is known.
mod baseline;
/// The demo's bracket and its before/after picture.
mod demo;
/// Every other kernel against its oracle.
mod kernels;
/// Who may import whom.
mod layers;
/// Quality measures against stored values of an independent implementation.
mod metrics;
/// What naga says of the shaders, without a GPU.
mod shaders;
/// The solver against dense algebra, and what it promises.
mod solver;
/// Synthetic brackets against the physics that they claim.
mod synth;
/// Tone mapping: degenerate images, shadows and highlights together, no halos.
mod tonemap;
