//! One test binary, so that wgpu is linked once.

mod support;

/// The program as a user runs it: outputs, messages, exit codes.
mod cli;
/// Files: frames, exposure times, OpenEXR, outputs.
mod io;
/// Response: calibration against truth and against OpenCV, response files.
mod response;
