//! What the camera noted: exposure, time, place and people in a file's EXIF data, and the exposures of a bracket from it.

use crate::error::{Error, Result};
use exif::{Exif, Field, In, Tag, Value};
use std::io::{BufRead, Cursor, Seek};
use std::path::{Path, PathBuf};

/// What a file notes of itself. Every field is absent where the file does not hold it or it is no number that can be.
#[derive(Clone, Debug, Default)]
pub struct Metadata {
    /// Exposure time in seconds: ExposureTime, else 2^-ShutterSpeedValue. The camera's word: it can be 0.
    pub exposure_time: Option<f64>,
    /// f-number; lenses that the camera does not know note 0, which counts as absent.
    pub f_number: Option<f64>,
    /// ISO speed.
    pub iso: Option<f64>,
    /// ExposureBiasValue in EV.
    pub exposure_bias: Option<f64>,
    /// Orientation, 1 to 8; 1 is upright.
    pub orientation: Option<u32>,
    /// When it was taken, `YYYY:MM:DD hh:mm:ss`, with a fraction where noted.
    pub taken: Option<String>,
    /// Camera make.
    pub make: Option<String>,
    /// Camera model.
    pub model: Option<String>,
    /// Serial number of the camera.
    pub serial: Option<String>,
    /// Lens model.
    pub lens: Option<String>,
    /// Who took it.
    pub artist: Option<String>,
    /// Copyright notice.
    pub copyright: Option<String>,
    /// Degrees north.
    pub latitude: Option<f64>,
    /// Degrees east.
    pub longitude: Option<f64>,
    /// Metres above sea level.
    pub altitude: Option<f64>,
    /// Focal length in millimetres.
    pub focal_mm: Option<f64>,
    /// Noise of the sensor at this speed (NoiseProfile of DNG files): [S, O], variance = S x + O of a value x whose white is 1.
    pub noise: Option<[f64; 2]>,
    /// The fields that a result inherits from its reference frame ([`CARRIED`], and all of the GPS block).
    pub(super) carried: Vec<Field>,
}

/// Fields that stay true of a merged picture. What speaks of the file's geometry (size, orientation, resolution, thumbnail) does not.
pub const CARRIED: [Tag; 27] = [
    Tag::ImageDescription,
    Tag::Make,
    Tag::Model,
    Tag::Artist,
    Tag::Copyright,
    Tag::DateTime,
    Tag::DateTimeOriginal,
    Tag::DateTimeDigitized,
    Tag::OffsetTime,
    Tag::OffsetTimeOriginal,
    Tag::OffsetTimeDigitized,
    Tag::SubSecTime,
    Tag::SubSecTimeOriginal,
    Tag::SubSecTimeDigitized,
    Tag::ExposureTime,
    Tag::FNumber,
    Tag::PhotographicSensitivity,
    Tag::FocalLength,
    Tag::FocalLengthIn35mmFilm,
    Tag::LensMake,
    Tag::LensModel,
    Tag::LensSpecification,
    Tag::LensSerialNumber,
    Tag::BodySerialNumber,
    Tag::CameraOwnerName,
    Tag::WhiteBalance,
    Tag::Flash,
];

/// Largest number of values of a field that is carried over: maker's blobs stay behind.
const MOST_BYTES: usize = 4096;

/// Exposure time Δt in seconds from the EXIF data of a JPEG, TIFF or PNG file; see [`Metadata::exposure_time`].
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened.
pub fn exposure_time(path: &Path) -> Result<Option<f64>> {
    Ok(read(path)?.exposure_time)
}

/// Focal length in mm that would give the same view on 35 mm film (FocalLengthIn35mmFilm); `None` when the file does not say, or says 0,
/// which stands for unknown.
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened.
pub fn focal_length_35mm(path: &Path) -> Result<Option<f64>> {
    let file = std::fs::File::open(path).map_err(|e| Error::Read { path: path.into(), reason: super::plain(&e) })?;
    let exif = exif_of(&mut std::io::BufReader::new(file));
    Ok(exif.and_then(|exif| number(&exif, Tag::FocalLengthIn35mmFilm)).filter(|v| *v > 0.0))
}

/// What the file notes; nothing where it has no readable EXIF data.
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened.
pub fn read(path: &Path) -> Result<Metadata> {
    let file = std::fs::File::open(path).map_err(|e| Error::Read { path: path.into(), reason: super::plain(&e) })?;
    Ok(read_from(&mut std::io::BufReader::new(file)))
}

/// What the bytes of a file (JPEG, PNG, TIFF and what is built like it) note.
pub fn read_bytes(bytes: &[u8]) -> Metadata {
    read_from(&mut Cursor::new(bytes))
}

/// What fields that were read by other means note.
pub(super) fn of_fields(fields: &[Field]) -> Metadata {
    let read = |block| exif::Reader::new().read_raw(block).ok();
    written(fields.iter()).and_then(read).map(|exif| of(&exif)).unwrap_or_default()
}

/// Fields as EXIF data; `None` when one cannot be written (an odd type).
fn written<'a>(fields: impl Iterator<Item = &'a Field>) -> Option<Vec<u8>> {
    let mut writer = exif::experimental::Writer::new();
    fields.for_each(|field| writer.push_field(field));
    let mut block = Cursor::new(Vec::new());
    writer.write(&mut block, false).ok()?;
    Some(block.into_inner())
}

fn read_from(from: &mut (impl BufRead + Seek)) -> Metadata {
    exif_of(from).map(|exif| of(&exif)).unwrap_or_default()
}

/// The EXIF data, if any can be read.
fn exif_of(from: &mut (impl BufRead + Seek)) -> Option<Exif> {
    let mut reader = exif::Reader::new();
    reader.continue_on_error(true);
    reader.read_from_container(from).or_else(|e| e.distill_partial_result(|_| ())).ok()
}

fn of(exif: &Exif) -> Metadata {
    let positive = |tag| number(exif, tag).filter(|v| *v > 0.0);
    let degrees = |tag, reference, negative: &str| {
        let Value::Rational(v) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
        let [d, m, s] = v.as_slice() else { return None };
        let value = d.to_f64() + m.to_f64() / 60.0 + s.to_f64() / 3600.0;
        let sign = if text(exif, reference)?.eq_ignore_ascii_case(negative) { -1.0 } else { 1.0 };
        Some(sign * value).filter(|v| v.is_finite())
    };
    let fraction = text(exif, Tag::SubSecTimeOriginal).filter(|s| s.bytes().all(|b| b.is_ascii_digit()));
    let below_sea = exif.get_field(Tag::GPSAltitudeRef, In::PRIMARY).and_then(|f| f.value.get_uint(0)) == Some(1);
    Metadata {
        exposure_time: number(exif, Tag::ExposureTime)
            .or_else(|| number(exif, Tag::ShutterSpeedValue).filter(|v| v.abs() <= 40.0).map(|v| (-v).exp2())),
        f_number: positive(Tag::FNumber),
        // 65535 stands for a speed that does not fit.
        iso: positive(Tag::PhotographicSensitivity).filter(|v| *v < 65535.0).or_else(|| positive(Tag::ISOSpeed)),
        // No camera compensates by more; and powers of more are no times.
        exposure_bias: number(exif, Tag::ExposureBiasValue).filter(|v| v.abs() <= 40.0),
        orientation: number(exif, Tag::Orientation).map(|v| v as u32).filter(|v| (1..=8).contains(v)),
        taken: text(exif, Tag::DateTimeOriginal)
            .or_else(|| text(exif, Tag::DateTime))
            .map(|t| fraction.map_or(t.clone(), |f| format!("{t}.{f}"))),
        make: text(exif, Tag::Make),
        model: text(exif, Tag::Model),
        serial: text(exif, Tag::BodySerialNumber),
        lens: text(exif, Tag::LensModel),
        artist: text(exif, Tag::Artist),
        copyright: text(exif, Tag::Copyright),
        latitude: degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, "S"),
        longitude: degrees(Tag::GPSLongitude, Tag::GPSLongitudeRef, "W"),
        altitude: number(exif, Tag::GPSAltitude).map(|v| if below_sea { -v } else { v }),
        focal_mm: positive(Tag::FocalLength),
        noise: None,
        carried: exif
            .fields()
            .filter(|f| f.ifd_num == In::PRIMARY && (CARRIED.contains(&f.tag) || f.tag.context() == exif::Context::Gps))
            .filter(|f| !matches!(&f.value, Value::Unknown(..)) && size(&f.value) <= MOST_BYTES)
            // A tag that comes twice counts once, here as above.
            .filter(|f| exif.get_field(f.tag, In::PRIMARY).is_some_and(|first| std::ptr::eq(first, *f)))
            .cloned()
            .collect(),
    }
}

impl Metadata {
    /// The EXIF block of a result: the carried fields and the program's name. `None` when there is none to carry.
    pub fn exif_block(&self) -> Option<Vec<u8>> {
        if self.carried.is_empty() {
            return None;
        }
        let software = Field {
            tag: Tag::Software,
            ifd_num: In::PRIMARY,
            value: Value::Ascii(vec![concat!("unshaken ", env!("CARGO_PKG_VERSION")).into()]),
        };
        // A field that cannot be written back costs the block, not the picture.
        written(self.carried.iter().chain([&software]))
    }

    /// This, and what `other` notes where this notes nothing.
    pub(super) fn or(mut self, other: Self) -> Self {
        let lacks = |f: &Field| self.carried.iter().all(|own| own.tag != f.tag);
        let more: Vec<Field> = other.carried.into_iter().filter(lacks).collect();
        self.carried.extend(more);
        Self {
            exposure_time: self.exposure_time.or(other.exposure_time),
            f_number: self.f_number.or(other.f_number),
            iso: self.iso.or(other.iso),
            exposure_bias: self.exposure_bias.or(other.exposure_bias),
            orientation: self.orientation.or(other.orientation),
            taken: self.taken.or(other.taken),
            make: self.make.or(other.make),
            model: self.model.or(other.model),
            serial: self.serial.or(other.serial),
            lens: self.lens.or(other.lens),
            artist: self.artist.or(other.artist),
            copyright: self.copyright.or(other.copyright),
            latitude: self.latitude.or(other.latitude),
            longitude: self.longitude.or(other.longitude),
            altitude: self.altitude.or(other.altitude),
            focal_mm: self.focal_mm.or(other.focal_mm),
            noise: self.noise.or(other.noise),
            carried: self.carried,
        }
    }

    /// Luminance in cd/m² that saturates the frame by the camera's ISO speed: 78/S lx s on the sensor (ISO 12232, saturation based) behind a
    /// lens that passes 0.65 (ISO 2721's q): 120 N² / (S t). `None` without aperture, speed or time.
    pub fn white_luminance(&self) -> Option<f64> {
        let (n, s, t) = (self.f_number?, self.iso?, self.exposure_time.filter(|t| *t > 0.0)?);
        Some(78.0 / 0.65 * n * n / (s * t)).filter(|v| v.is_finite())
    }
}

/// Exposures of a bracket from what its files note: exposure times in seconds, times (N₁/N)² and S/S₁ where aperture or ISO speed differ from
/// the first frame's, and notes that the user should see. Without times, 2^ExposureBiasValue.
///
/// # Errors
/// [`Error::Format`], naming the file and the remedy, for times that are missing or cannot be, and for apertures or speeds that some
/// frames note and others do not.
pub fn exposures(files: &[(PathBuf, &Metadata)]) -> Result<(Vec<f64>, Vec<String>)> {
    const REMEDY: &str = "give the times of all frames with --exposures";
    let refuse = |path: &Path, reason: String| Error::Format { path: path.into(), reason };
    let mut notes = Vec::new();
    let untimed = files.iter().find(|(_, m)| m.exposure_time.is_none());
    let mut times = Vec::new();
    match untimed {
        None => {
            for (path, m) in files {
                let t = m.exposure_time.unwrap_or_default();
                if !(t.is_finite() && t > 0.0) {
                    return Err(refuse(path, format!("EXIF notes an exposure time of {t} s, which cannot be; {REMEDY}")));
                }
                times.push(t);
            }
        }
        Some((path, _)) => {
            let biases: Vec<f64> = files.iter().filter_map(|(_, m)| m.exposure_bias).collect();
            let distinct = biases.iter().any(|b| (b - biases[0]).abs() > 0.01);
            let none_timed = files.iter().all(|(_, m)| m.exposure_time.is_none());
            if !(none_timed && biases.len() == files.len() && distinct) {
                return Err(refuse(path, format!("holds no exposure time (EXIF); {REMEDY}, or their steps in EV with --ev")));
            }
            let list = biases.iter().map(|b| format!("{b:+.1}")).collect::<Vec<_>>().join(", ");
            notes.push(format!("the frames note no exposure times; their exposure biases ({list} EV) are taken for relative exposures"));
            // The bias is the whole difference in exposure: aperture and speed are part of it.
            return Ok((biases.into_iter().map(f64::exp2).collect(), notes));
        }
    }
    type Noted = fn(&Metadata) -> Option<f64>;
    type Gain = fn(f64) -> f64;
    let varied: [(&str, Noted, Gain); 2] = [("aperture", |m| m.f_number, |ratio| ratio.powi(-2)), ("ISO speed", |m| m.iso, |ratio| ratio)];
    for (what, noted, gain) in varied {
        let values: Vec<Option<f64>> = files.iter().map(|(_, m)| noted(m)).collect();
        let Some(known) = values.iter().position(Option::is_some) else { continue };
        if let Some(missing) = values.iter().position(Option::is_none) {
            let other = files[known].0.display();
            return Err(refuse(
                &files[missing].0,
                format!("holds no {what} (EXIF) but {other} does, so their exposures cannot be compared; {REMEDY}"),
            ));
        }
        let values: Vec<f64> = values.into_iter().flatten().collect();
        if values.iter().any(|v| (v / values[0] - 1.0).abs() > 0.02) {
            let list = values.iter().map(|v| format!("{v}")).collect::<Vec<_>>().join(", ");
            notes.push(format!("the frames differ in {what} ({list}); exposures count as if all had the first frame's"));
            for (time, v) in times.iter_mut().zip(&values) {
                *time *= gain(v / values[0]);
            }
        }
    }
    Ok((times, notes))
}

/// First value of a field as a number; 0/0 counts as absent.
fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    let v = match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(v) => v.first()?.to_f64(),
        Value::SRational(v) => v.first()?.to_f64(),
        Value::Float(v) => f64::from(*v.first()?),
        Value::Double(v) => *v.first()?,
        other => f64::from(other.get_uint(0)?),
    };
    v.is_finite().then_some(v)
}

/// Text of a field, without what pads it; absent where it is empty.
fn text(exif: &Exif, tag: Tag) -> Option<String> {
    let Value::Ascii(parts) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
    let text = String::from_utf8_lossy(parts.first()?).trim_matches(|c: char| c == '\0' || c.is_whitespace()).to_string();
    (!text.is_empty()).then_some(text)
}

/// Bytes of a value, roughly.
fn size(value: &Value) -> usize {
    match value {
        Value::Ascii(parts) => parts.iter().map(Vec::len).sum(),
        Value::Undefined(bytes, _) | Value::Byte(bytes) => bytes.len(),
        Value::Rational(v) => 8 * v.len(),
        _ => 64,
    }
}

/// Seconds of an EXIF date `YYYY:MM:DD hh:mm:ss` with or without a fraction, since 1970 by the camera's clock; `None` for what is no date.
pub fn seconds(date: &str) -> Option<f64> {
    let (day, time) = date.trim().split_once(' ')?;
    let mut numbers = day.split([':', '-']).map(|n| n.parse::<i64>().ok());
    let (y, m, d) = (numbers.next()??, numbers.next()??, numbers.next()??);
    let mut parts = time.split(':');
    let (hour, minute) = (parts.next()?.parse::<f64>().ok()?, parts.next()?.parse::<f64>().ok()?);
    let second = parts.next()?.parse::<f64>().ok()?;
    if !(1..=12).contains(&m) || !(1..=31).contains(&d) || !(1..=9999).contains(&y) {
        return None;
    }
    // Days since 1970-01-01 in the Gregorian calendar, years counted from March.
    let (y, m) = if m > 2 { (y, m - 3) } else { (y - 1, m + 9) };
    let days = 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + d - 1 - 719_468;
    let seconds = days as f64 * 86_400.0 + hour * 3600.0 + minute * 60.0 + second;
    seconds.is_finite().then_some(seconds)
}
