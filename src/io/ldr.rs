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
    /// Whether the file holds colour more coarsely than brightness (JPEG).
    pub chroma_subsampled: bool,
    /// See [`crate::exposure::Frame::lossy`].
    pub lossy: bool,
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
    let jpeg = (reader.format() == Some(ImageFormat::Jpeg)).then(|| jpeg_segments(bytes).collect::<Vec<_>>());
    // The JPEG decoder fills what is missing with grey and reports success.
    if jpeg.as_ref().is_some_and(|segments| segments.iter().all(|s| s.0 != END_OF_IMAGE)) {
        return Err(format("is truncated; copy it again from the camera".into()));
    }
    let lossy = jpeg.is_some();
    let colour_block = jpeg.and_then(|segments| colour_block(&segments));
    let chroma_subsampled = colour_block.is_some();
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
        if let (Some(block), DynamicImage::ImageRgb8(codes)) = (colour_block, &mut picture) {
            let size = (codes.width() as usize, codes.height() as usize);
            super::chroma::restore(codes, size, block);
        }
        picture.apply_orientation(orientation);
        Ok((picture, icc))
    };
    let (picture, icc) = decode().map_err(|e| format(reason(&e)))?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    match &picture {
        DynamicImage::ImageLuma8(_) | DynamicImage::ImageLumaA8(_) | DynamicImage::ImageRgb8(_) | DynamicImage::ImageRgba8(_) => {
            let raw = picture.into_rgb8().into_raw();
            Ok(Picture { intensity: planes(&raw, width, height, 255.0), levels: 255, chroma_subsampled, lossy, float: false, icc })
        }
        DynamicImage::ImageLuma16(_) | DynamicImage::ImageLumaA16(_) | DynamicImage::ImageRgb16(_) | DynamicImage::ImageRgba16(_) => {
            let raw = picture.into_rgb16().into_raw();
            Ok(Picture { intensity: planes(&raw, width, height, 65535.0), levels: 65535, chroma_subsampled, lossy, float: false, icc })
        }
        _ => {
            let raw = picture.into_rgb32f().into_raw();
            Ok(Picture { intensity: planes(&raw, width, height, 1.0), levels: FLOAT_LEVELS, chroma_subsampled, lossy, float: true, icc })
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

/// Marker of a JPEG's last segment.
const END_OF_IMAGE: u8 = 0xD9;

/// Markers of a JPEG's segments and what they hold, up to the end-of-image marker. Walks from one to the next, because thumbnails inside the metadata have
/// markers of their own and cameras append data behind the last one.
fn jpeg_segments(bytes: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    let mut at = 2; // behind the start-of-image marker, by which the format was told
    std::iter::from_fn(move || {
        // The next marker: 0xFF, then neither 0 (a stuffed data byte), nor 0xFF (padding), nor RST0..RST7.
        let marker = loop {
            let (&a, &b) = (bytes.get(at)?, bytes.get(at + 1)?);
            if a == 0xFF && b != 0 && b != 0xFF && !(0xD0..=0xD7).contains(&b) {
                break b;
            }
            at += 1;
        };
        if marker == END_OF_IMAGE {
            at = bytes.len();
            return Some((marker, &[][..]));
        }
        let (&high, &low) = (bytes.get(at + 2)?, bytes.get(at + 3)?);
        let (first, last) = (at + 4, at + 2 + usize::from(u16::from_be_bytes([high, low])));
        at = last;
        Some((marker, bytes.get(first..last).unwrap_or_default()))
    })
}

/// Pixels across and down for which a JPEG holds one colour, by its frame header; `None` where that is one pixel.
fn colour_block(segments: &[(u8, &[u8])]) -> Option<(usize, usize)> {
    // SOF0..SOF15 without DHT, JPG and DAC: precision, height, width, number of components; of each its name, samples across and down, table.
    let header = segments.iter().find(|(marker, _)| (0xC0..=0xCF).contains(marker) && ![0xC4, 0xC8, 0xCC].contains(marker));
    let samples = |component: &[u8]| (usize::from(component[1] >> 4).max(1), usize::from(component[1] & 15).max(1));
    let mut components = header?.1.get(6..)?.chunks_exact(3).map(samples);
    let brightness = components.next()?;
    // Where colours are held unlike, the coarsest.
    let block = components.map(|c| (brightness.0 / c.0, brightness.1 / c.1)).fold((1, 1), |a, b| (a.0.max(b.0), a.1.max(b.1)));
    (block != (1, 1)).then_some(block)
}
