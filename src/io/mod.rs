//! Bytes to frames and back: files stop here, and so do the error types of the crates that read them.
//!
//! * [`input`] reads a frame of any kind: [`ldr`] (PNG, JPEG, TIFF; [`chroma`]: colour that JPEG files hold coarsely), `raw` (camera raw
//!   files, feature `raw`), [`exr`], Radiance HDR;
//!   [`metadata`] what the camera noted, [`icc`] what an embedded profile says of its colours;
//! * [`exif`] writes frames with their exposure time;
//! * [`exr`], [`picture`] and [`gainmap`] write results, linear or for display;
//! * [`output`] writes every result beside its target and renames it, so that nothing is ever half-written.

pub mod chroma;
pub mod exif;
pub mod exr;
pub mod gainmap;
pub mod icc;
pub mod input;
pub mod ldr;
pub mod metadata;
pub mod output;
pub mod picture;
#[cfg(feature = "raw")]
pub mod raw;

use crate::error::{Error, Result};
#[cfg(feature = "raw")]
use crate::image::{Plane, Rgb};
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

/// Pixels per byte of a file that no compression of photographs reaches, nor of pictures that are even by a part.
const LEAST_DENSE: usize = 4096;
/// Pixels of the largest frame: 4 GiB of linear RGB.
const MOST_PIXELS: usize = (4 << 30) / 12;

/// Refuses a size that a damaged header claims before memory is asked for it, which would end the program. `bytes`: size of the file.
fn check_size(width: usize, height: usize, bytes: usize) -> std::result::Result<(), String> {
    let most = MOST_PIXELS.min(bytes.saturating_mul(LEAST_DENSE));
    match width.checked_mul(height) {
        Some(n) if n <= most && n > 0 => Ok(()),
        _ => Err(format!("claims {width} x {height} pixels, which it cannot hold; it is damaged or too large")),
    }
}

/// What the system said, without "(os error 2)".
pub(crate) fn plain(e: &std::io::Error) -> String {
    let text = e.to_string();
    text.split(" (os error").next().unwrap_or(&text).to_lowercase()
}

/// The picture turned and mirrored so that it is upright; `orientation` as EXIF counts it, 1 to 8.
#[cfg(feature = "raw")]
pub(crate) fn upright(image: &Rgb, orientation: u32) -> Rgb {
    let (w, h) = image.size();
    image.map_planes(|p| match orientation {
        2 => Plane::from_fn(w, h, |x, y| p.at(w - 1 - x, y)),
        3 => Plane::from_fn(w, h, |x, y| p.at(w - 1 - x, h - 1 - y)),
        4 => Plane::from_fn(w, h, |x, y| p.at(x, h - 1 - y)),
        5 => Plane::from_fn(h, w, |x, y| p.at(y, x)),
        6 => Plane::from_fn(h, w, |x, y| p.at(y, h - 1 - x)),
        7 => Plane::from_fn(h, w, |x, y| p.at(w - 1 - y, h - 1 - x)),
        8 => Plane::from_fn(h, w, |x, y| p.at(w - 1 - y, x)),
        _ => p.clone(),
    })
}
