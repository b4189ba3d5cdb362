//! Frames: 8- and 16-bit PNG, JPEG and TIFF files into intensity Z; TIFF files of floating-point numbers, which are linear.

use crate::error::{Error, Result};
use crate::image::{Plane, Rgb};
use ::image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits};
use std::io::Cursor;
use std::path::Path;

/// Largest memory that one decoded file may take: a 16-bit RGB frame of 700 MP. Damaged headers can ask for more.
const MAX_DECODED_BYTES: u64 = 4 << 30;

/// Pixels of one file.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Intensity Z, 0..=1 with 1 the file's largest code. Grey files have three equal channels; alpha is dropped.
    pub intensity: Rgb,
    /// Number of intensity steps: 255 for 8 bits, 65535 for 16 bits, [`FLOAT_LEVELS`] for floating point.
    pub levels: u32,
    /// Whether the file holds floating-point numbers: those are linear, and may be above 1.
    pub float: bool,
    /// The ICC profile that the file embeds.
    pub icc: Option<Vec<u8>>,
}

/// Intensity steps that floating-point frames count as: far below any noise, yet a table of them is quickly made.
pub const FLOAT_LEVELS: u32 = 1 << 20;

/// Reads a frame, upright: the orientation that the camera noted is applied.
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened; [`Error::Format`] when it is empty, truncated, damaged, no picture,
/// or a picture of another kind (floating point, other file formats), with the remedy.
pub fn read(path: &Path) -> Result<Picture> {
    decode(path, &super::read_bytes(path)?)
}

/// [`read`] of bytes that are read already.
pub(super) fn decode(path: &Path, bytes: &[u8]) -> Result<Picture> {
    let format = |reason: String| Error::Format { path: path.into(), reason };
    if bytes.is_empty() {
        return Err(format("is empty; copy it again from the camera".into()));
    }
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().expect("memory is readable");
    match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::Tiff) => {}
        Some(other) => {
            return Err(format(format!("is a {} file; save the frame as PNG, JPEG or TIFF", other.extensions_str()[0])));
        }
        None => return Err(format("is not a picture that can be read; frames are 8- or 16-bit PNG, JPEG or TIFF files".into())),
    }
    // The JPEG decoder fills what is missing with grey and reports success.
    if reader.format() == Some(ImageFormat::Jpeg) && !jpeg_is_complete(bytes) {
        return Err(format("is truncated; copy it again from the camera".into()));
    }
    let mut decoder = reader.into_decoder().map_err(|e| format(reason(&e)))?;
    let (width, height) = decoder.dimensions();
    super::check_size(width as usize, height as usize, bytes.len()).map_err(format)?;
    let decode = || -> std::result::Result<(DynamicImage, Option<Vec<u8>>), ImageError> {
        let mut limits = Limits::default();
        limits.max_alloc = Some(MAX_DECODED_BYTES);
        decoder.set_limits(limits)?;
        let orientation = decoder.orientation()?;
        let icc = decoder.icc_profile()?;
        let mut picture = DynamicImage::from_decoder(decoder)?;
        picture.apply_orientation(orientation);
        Ok((picture, icc))
    };
    let (picture, icc) = decode().map_err(|e| format(reason(&e)))?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    match &picture {
        DynamicImage::ImageLuma8(_) | DynamicImage::ImageLumaA8(_) | DynamicImage::ImageRgb8(_) | DynamicImage::ImageRgba8(_) => {
            let raw = picture.into_rgb8().into_raw();
            Ok(Picture { intensity: planes(&raw, width, height, 255.0), levels: 255, float: false, icc })
        }
        DynamicImage::ImageLuma16(_) | DynamicImage::ImageLumaA16(_) | DynamicImage::ImageRgb16(_) | DynamicImage::ImageRgba16(_) => {
            let raw = picture.into_rgb16().into_raw();
            Ok(Picture { intensity: planes(&raw, width, height, 65535.0), levels: 65535, float: false, icc })
        }
        _ => {
            let raw = picture.into_rgb32f().into_raw();
            Ok(Picture { intensity: planes(&raw, width, height, 1.0), levels: FLOAT_LEVELS, float: true, icc })
        }
    }
}

/// Interleaved codes to planes of code / `largest`.
pub(super) fn planes<T: Copy + Into<f32>>(raw: &[T], width: usize, height: usize, largest: f32) -> Rgb {
    Rgb(std::array::from_fn(|c| Plane { width, height, data: raw.iter().skip(c).step_by(3).map(|&v| v.into() / largest).collect() }))
}

/// The decoder's complaint in words that name the remedy.
fn reason(e: &ImageError) -> String {
    match e {
        ImageError::Unsupported(u) => {
            format!("is of a kind that cannot be read ({}); save the frame as 8- or 16-bit PNG, JPEG or TIFF", one_line(&u.to_string()))
        }
        ImageError::Limits(_) => "claims a size that does not fit in memory; the file is damaged or too large".into(),
        e => format!("is truncated or damaged ({}); copy it again from the camera", one_line(&e.to_string())),
    }
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Whether a JPEG's last scan ends with the end-of-image marker. Walks the segments, because thumbnails inside the
/// metadata have end markers of their own and cameras append data behind the last one.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut at = 2; // behind the start-of-image marker, by which the format was told
    loop {
        // The next marker: 0xFF, then neither 0 (a stuffed data byte), nor 0xFF (padding), nor RST0..RST7.
        let marker = loop {
            let (Some(&a), Some(&b)) = (bytes.get(at), bytes.get(at + 1)) else { return false };
            if a == 0xFF && b != 0 && b != 0xFF && !(0xD0..=0xD7).contains(&b) {
                break b;
            }
            at += 1;
        };
        if marker == 0xD9 {
            return true;
        }
        let (Some(&high), Some(&low)) = (bytes.get(at + 2), bytes.get(at + 3)) else { return false };
        at += 2 + usize::from(u16::from_be_bytes([high, low]));
    }
}
