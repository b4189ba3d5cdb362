//! Frames with the exposure time in their EXIF data, as a camera writes them.

use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
use image::{DynamicImage, ImageEncoder};
use std::io::{Cursor, Write};

/// How a frame is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// PNG, lossless, of 8 or 16 bits as the picture has.
    Png,
    /// JPEG of quality 1..=100, 8 bits.
    Jpeg(u8),
}

/// Writes `picture` with an exposure time of `seconds`.
///
/// # Errors
/// The encoder's or the system's reason.
pub fn write(to: &mut impl Write, picture: &DynamicImage, format: Format, seconds: f64) -> Result<(), String> {
    let block = exposure_time(seconds)?;
    match format {
        Format::Png => {
            let mut encoder = PngEncoder::new(to);
            encoder.set_exif_metadata(block).map_err(|e| e.to_string())?;
            picture.write_with_encoder(encoder).map_err(|e| e.to_string())
        }
        Format::Jpeg(quality) => {
            let mut encoder = JpegEncoder::new_with_quality(to, quality);
            encoder.set_exif_metadata(block).map_err(|e| e.to_string())?;
            picture.write_with_encoder(encoder).map_err(|e| e.to_string())
        }
    }
}

/// EXIF data that hold the exposure time alone.
fn exposure_time(seconds: f64) -> Result<Vec<u8>, String> {
    let field = Field { tag: Tag::ExposureTime, ifd_num: In::PRIMARY, value: Value::Rational(vec![rational(seconds)]) };
    let mut writer = Writer::new();
    writer.push_field(&field);
    let mut block = Cursor::new(Vec::new());
    writer.write(&mut block, false).map_err(|e| e.to_string())?;
    Ok(block.into_inner())
}

/// `seconds` as cameras write it: 1/30 where it is one over a whole number, else in steps of a hundred thousandth or finer.
fn rational(seconds: f64) -> Rational {
    let inverse = (1.0 / seconds).round();
    if (1.0..4e9).contains(&inverse) && (inverse * seconds - 1.0).abs() < 1e-6 {
        return Rational { num: 1, denom: inverse as u32 };
    }
    let denom = if seconds < 4.0 { 1_000_000 } else { 100_000 };
    Rational { num: (seconds * f64::from(denom)).round() as u32, denom }
}
