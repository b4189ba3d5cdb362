//! What the camera noted: the exposure time in a file's EXIF data.

use crate::error::{Error, Result};
use exif::{Exif, In, Tag, Value};
use std::io::BufReader;
use std::path::Path;

/// Exposure time Δt in seconds from the EXIF data of a JPEG, TIFF or PNG file: ExposureTime, else 2^-ShutterSpeedValue.
/// `None` when the file holds neither (or no readable EXIF data). The value is the camera's: it can be 0.
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened.
pub fn exposure_time(path: &Path) -> Result<Option<f64>> {
    let Some(exif) = read(path)? else { return Ok(None) };
    Ok(number(&exif, Tag::ExposureTime).or_else(|| number(&exif, Tag::ShutterSpeedValue).map(|v| (-v).exp2())))
}

/// Focal length in mm that would give the same view on 35 mm film (FocalLengthIn35mmFilm); `None` when the file does not say, or says 0,
/// which stands for unknown.
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened.
pub fn focal_length_35mm(path: &Path) -> Result<Option<f64>> {
    let Some(exif) = read(path)? else { return Ok(None) };
    let value = exif.get_field(Tag::FocalLengthIn35mmFilm, In::PRIMARY).and_then(|f| f.value.get_uint(0));
    Ok(value.filter(|v| *v > 0).map(f64::from))
}

/// The EXIF data of a file, if any can be read.
fn read(path: &Path) -> Result<Option<Exif>> {
    let file = std::fs::File::open(path).map_err(|e| Error::Read { path: path.into(), reason: super::plain(&e) })?;
    let mut reader = exif::Reader::new();
    reader.continue_on_error(true);
    match reader.read_from_container(&mut BufReader::new(file)) {
        Ok(exif) => Ok(Some(exif)),
        Err(e) => Ok(e.distill_partial_result(|_| ()).ok()),
    }
}

/// First value of a rational field; 0/0 counts as absent.
fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    let v = match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(v) => v.first()?.to_f64(),
        Value::SRational(v) => v.first()?.to_f64(),
        Value::Float(v) => f64::from(*v.first()?),
        Value::Double(v) => *v.first()?,
        _ => return None,
    };
    v.is_finite().then_some(v)
}
