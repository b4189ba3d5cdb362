//! One test binary, so that wgpu is linked once.

mod support;

/// The plain merge on frames whose irradiance is known.
mod baseline;
/// The program as a user runs it: outputs, messages, exit codes.
mod cli;
/// The demo's bracket and its before/after picture.
mod demo;
/// Files: frames, exposure times, OpenEXR, outputs.
mod io;
/// Quality measures against stored values of an independent implementation.
mod metrics;
/// Response: calibration against truth and against OpenCV, response files.
mod response;
/// Synthetic brackets against the physics that they claim.
mod synth;
/// Tone mapping: degenerate images, shadows and highlights together, no halos.
mod tonemap;
