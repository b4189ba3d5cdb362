//! Bytes to frames and back: files stop here, and so do the error types of the crates that read them.
//!
//! * [`ldr`] reads the frames (PNG, JPEG, TIFF; 8 or 16 bits), [`metadata`] their exposure times;
//! * [`exif`] writes frames with their exposure time;
//! * [`exr`] writes and reads linear OpenEXR;
//! * [`output`] writes every result beside its target and renames it, so that nothing is ever half-written.

pub mod exif;
pub mod exr;
pub mod ldr;
pub mod metadata;
pub mod output;

use crate::error::{Error, Result};
use std::path::Path;

/// The text of a (JSON) file.
///
/// # Errors
/// [`Error::Read`] when it cannot be opened, [`Error::Format`] when it is not UTF-8 text.
pub fn read_text(path: &Path) -> Result<String> {
    String::from_utf8(read_bytes(path)?)
        .map_err(|_| Error::Format { path: path.into(), reason: "is not a text file; expected JSON".into() })
}

/// The bytes of a file.
fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    if path.is_dir() {
        return Err(Error::Format { path: path.into(), reason: "is a folder; name a file in it".into() });
    }
    std::fs::read(path).map_err(|e| Error::Read { path: path.into(), reason: plain(&e) })
}

/// What the system said, without "(os error 2)".
pub(crate) fn plain(e: &std::io::Error) -> String {
    let text = e.to_string();
    text.split(" (os error").next().unwrap_or(&text).to_lowercase()
}
