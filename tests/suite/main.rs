//! One test binary, so that wgpu is linked once.

/// f64 oracles of the kernels and the solver.
#[path = "../oracle/mod.rs"]
mod oracle;
/// The shared device, fixed-seed numbers, comparison, files.
mod support;

/// K, Kᵀ and the taps of a TSF.
mod adjoint;
/// What displaced frames show of structure finer than the latent grid.
mod aliasing;
/// The plain merge on frames whose irradiance is known.
mod baseline;
/// Many photographs: grouping, shards, resuming; configuration, voices, interruption.
mod batch;
/// Brackets without a sharp frame.
mod blind;
/// Colour that files hold coarsely.
mod chroma;
/// The program as a user runs it: outputs, messages, exit codes.
mod cli;
/// Collaborative filtering against its oracle, and what it must keep.
mod collaborative;
/// The demo's bracket and its before/after picture.
mod demo;
/// Pictures on a target: what a pixel of the screen shows of those of the frame.
mod display;
/// The paper's experiments, tiny.
mod experiments;
mod faults;
/// What moved between sharp frames.
mod ghosts;
/// Files: frames, exposure times, OpenEXR, outputs.
mod io;
/// Every other kernel against its oracle.
mod kernels;
/// Who may import whom.
mod layers;
/// Quality measures against stored values of an independent implementation.
mod metrics;
/// The report page in a real browser.
mod page;
/// Photographers' files: raw, notes, profiles, primaries; what results say of themselves.
mod photo;
/// Gain and black offset of each frame.
mod photometry;
/// Registration: motions planted in drawn scenes, what is refused.
mod register;
/// Response: calibration against truth and against OpenCV, response files.
mod response;
/// Memory, reduced size, refused input.
mod scale;
/// What naga says of the shaders, without a GPU.
mod shaders;
/// The solver against dense algebra, and what it promises.
mod solver;
/// Noise, masks, PSFs and TSFs on input whose answer is planted.
mod stages;
/// Synthetic brackets against the physics that they claim.
mod synth;
/// Tone mapping: degenerate images, shadows and highlights together, no halos.
mod tonemap;
/// TSFs from whole frames: models, extents, focal lengths.
mod tsf;
