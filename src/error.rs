//! The library's error type: one variant per thing a caller can act on.

use std::path::PathBuf;

/// Result of every fallible public function.
pub type Result<T> = std::result::Result<T, Error>;

/// What went wrong, where, and what to do about it. Each message is one line.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file cannot be opened or read.
    #[error("{path}: cannot be read ({reason}); check the name and the permissions")]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// A file is read but is not what it should be (truncated, unsupported kind, damaged).
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong with it and what would mend it.
        reason: String,
    },
    /// An output cannot be written.
    #[error("{path}: cannot be written ({reason})")]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said and what would mend it.
        reason: String,
    },
    /// The frames do not make a bracket (sizes, exposure times, number).
    #[error("{0}")]
    Bracket(String),
    /// A TSF, response or setting that the program cannot use.
    #[error("{0}")]
    Input(String),
    /// No usable GPU adapter, or one that lacks what the solver needs.
    #[error("{0}")]
    Adapter(String),
    /// The device ran out of memory.
    #[error("the GPU ran out of memory ({0}); raise --memory-limit if you set it, or reduce the frames with --scale")]
    OutOfMemory(String),
    /// The device was lost or did not answer in time.
    #[error("the GPU stopped answering ({0}); update its driver or choose the CPU adapter (WGPU_ADAPTER_NAME=llvmpipe)")]
    DeviceLost(String),
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
}
