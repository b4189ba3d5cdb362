//! Linear OpenEXR: results, frames, and truth for tests.

use super::metadata::Metadata;
use crate::colour::{self, Matrix, Primaries};
use crate::error::{Error, Result};
use crate::image::{Plane, Rgb};
use ::exr::prelude::*;
use std::io::{Seek, Write};
use std::path::Path;

/// Name of the float attribute that holds the factor between irradiance and pixel value.
pub const FACTOR_ATTRIBUTE: &str = "unshakenReferenceExposureTime";

/// Rule by which irradiance E became pixel values: value = E × `exposure_time`.
#[derive(Clone, Debug, PartialEq)]
pub struct Radiometry {
    /// Exposure time Δt of the reference frame, seconds.
    pub exposure_time: f64,
    /// Name of the reference frame.
    pub frame: String,
}

/// How a result is written, beside the rule of its scale.
#[derive(Clone, Debug, Default)]
pub struct Style {
    /// What R, G and B are.
    pub primaries: Primaries,
    /// 16-bit instead of 32-bit floating point.
    pub half: bool,
    /// What the camera noted of the reference frame.
    pub metadata: Metadata,
    /// `Some`: pixels are luminances, cd/m² = value; the number is that of the reference frame's white.
    pub absolute: Option<f64>,
    /// Exposures are relative, 2^EV instead of seconds: no exposure time is written but the one that the camera noted.
    pub relative: bool,
    /// Further channels, each with its name, such as `confidence.Y`.
    pub layers: Vec<(String, Plane)>,
}

/// Largest number that 16-bit floating point holds.
const LARGEST_HALF: f32 = 65504.0;

/// Writes `image` (linear, Rec. 709 primaries, white D65) as 32-bit float RGB with lossless ZIP compression. The rule
/// stands in the attributes: `comments` in words, [`FACTOR_ATTRIBUTE`] and `expTime` as numbers.
///
/// # Errors
/// A reason for a pixel that is NaN, infinite or negative (nothing is written then), and for what `to` refuses.
pub fn write(to: impl Write + Seek, image: &Rgb, radiometry: &Radiometry) -> std::result::Result<(), String> {
    write_styled(to, image, radiometry, &Style::default())
}

/// [`write()`] in other primaries, as half floats, with the camera's notes and further channels. `whiteLuminance` is the luminance in cd/m² of
/// the value 1 where the camera's notes tell it ([`Metadata::white_luminance`]).
///
/// # Errors
/// As [`write()`]; and for values that half floats do not hold.
pub fn write_styled(to: impl Write + Seek, image: &Rgb, radiometry: &Radiometry, style: &Style) -> std::result::Result<(), String> {
    let names = ["red", "green", "blue"];
    for (plane, name) in image.0.iter().zip(names) {
        if let Some(i) = plane.data.iter().position(|v| !(v.is_finite() && *v >= 0.0)) {
            let (x, y) = (i % plane.width, i / plane.width);
            return Err(format!(
                "{name} at pixel ({x}, {y}) is {}, but irradiance is finite and not negative; this is a fault of the program",
                plane.data[i]
            ));
        }
        if let Some(v) = plane.data.iter().find(|v| style.half && **v > LARGEST_HALF) {
            return Err(format!("{name} reaches {v}, half floats only {LARGEST_HALF}; write it without --half"));
        }
    }
    let planes = image.0.iter().zip(["R", "G", "B"]).map(|(p, n)| (n, p)).chain(style.layers.iter().map(|(n, p)| (n.as_str(), p)));
    let channels = planes.map(|(name, plane)| {
        let samples = if style.half {
            FlatSamples::F16(plane.data.iter().map(|v| f16::from_f32(v.clamp(-LARGEST_HALF, LARGEST_HALF))).collect())
        } else {
            FlatSamples::F32(plane.data.clone())
        };
        AnyChannel::new(name, samples)
    });
    let channels = AnyChannels::sort(channels.collect());
    let noted = &style.metadata;
    let words = |t: &Option<String>| t.as_deref().and_then(|t| Text::new_or_none(ascii(t)));
    let (exposure, seconds) = match style.relative {
        true => (format!("exposure (2^EV = {})", radiometry.exposure_time), None),
        false => (format!("exposure time ({} s)", radiometry.exposure_time), Some(radiometry.exposure_time)),
    };
    let rule = match style.absolute {
        Some(white) => format!(
            "value = luminance in cd/m2, from aperture, ISO speed and exposure time of the reference frame {} (white {white:.4} cd/m2); \
             irradiance x its {exposure} = value / {white}",
            ascii(&radiometry.frame)
        ),
        None => format!("1.0 is the white of the reference frame {}: value = irradiance x its {exposure}", ascii(&radiometry.frame)),
    };
    let text = |name: &str, value: &Option<String>| Some((Text::from(name), AttributeValue::Text(words(value)?)));
    let factor = (radiometry.exposure_time / style.absolute.unwrap_or(1.0)) as f32;
    let mut other: Vec<(Text, AttributeValue)> = vec![
        (FACTOR_ATTRIBUTE.into(), AttributeValue::F32(factor)),
        // Programs that pay no heed to chromaticities know this (OpenEXR 3.4).
        ("colorInteropID".into(), AttributeValue::Text(Text::from(style.primaries.interop_id()))),
    ];
    other.extend(
        [
            text("cameraMake", &noted.make),
            text("cameraModel", &noted.model),
            text("cameraSerialNumber", &noted.serial),
            text("lensModel", &noted.lens),
            text("artist", &noted.artist),
            text("copyright", &noted.copyright),
            noted.focal_mm.map(|v| ("nominalFocalLength".into(), AttributeValue::F32(v as f32))),
        ]
        .into_iter()
        .flatten(),
    );
    let attributes = LayerAttributes {
        software_name: Some(concat!("unshaken ", env!("CARGO_PKG_VERSION")).into()),
        comments: Text::new_or_none(rule),
        exposure: noted.exposure_time.filter(|t| *t > 0.0).or(seconds).map(|t| t as f32),
        aperture: noted.f_number.map(|v| v as f32),
        iso_speed: noted.iso.map(|v| v as f32),
        capture_date: noted
            .taken
            .as_deref()
            .map(|t| t.split('.').next().unwrap_or(t).to_string())
            .as_deref()
            .and_then(|t| Text::new_or_none(ascii(t))),
        owner: words(&noted.copyright).or_else(|| words(&noted.artist)),
        latitude: noted.latitude.map(|v| v as f32),
        longitude: noted.longitude.map(|v| v as f32),
        altitude: noted.altitude.map(|v| v as f32),
        white_luminance: match style.absolute {
            Some(_) => Some(1.0),
            None => noted.white_luminance().map(|v| v as f32),
        },
        other: other.into_iter().collect(),
        ..LayerAttributes::default()
    };
    let mut picture = Image::from_layer(Layer::new(image.size(), attributes, Encoding::SMALL_LOSSLESS, channels));
    let [red, green, blue, white] = style.primaries.chromaticities().map(|[x, y]| Vec2(x as f32, y as f32));
    picture.attributes.chromaticities = Some(::exr::meta::attribute::Chromaticities { red, green, blue, white });
    picture.write().to_buffered(to).map_err(|e| e.to_string())
}

/// Attributes hold ASCII.
fn ascii(text: &str) -> String {
    text.chars().map(|c| if c.is_ascii() && !c.is_ascii_control() { c } else { '?' }).collect()
}

/// What an OpenEXR file holds.
pub struct File {
    /// R, G and B of the first layer that has them.
    pub image: Rgb,
    /// [`FACTOR_ATTRIBUTE`].
    pub factor: Option<f64>,
    /// Linear RGB to XYZ relative to D50, by the file's chromaticities; Rec. 709 where it notes none.
    pub to_xyz: Matrix,
    /// Exposure time, aperture, ISO speed, date and people.
    pub metadata: Metadata,
}

/// Reads the R, G and B channels of the first layer (half, float or integer), with the factor if it is noted.
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened, [`Error::Format`] when it is no OpenEXR file with R, G and B.
pub fn read(path: &Path) -> Result<(Rgb, Option<f64>)> {
    let file = read_file(path)?;
    Ok((file.image, file.factor))
}

/// [`read()`] with what the file notes.
///
/// # Errors
/// As [`read()`].
pub fn read_file(path: &Path) -> Result<File> {
    decode(path, super::read_bytes(path)?)
}

/// [`read_file`] of bytes that are read already; `path` is named in errors.
pub(super) fn decode(path: &Path, bytes: Vec<u8>) -> Result<File> {
    let format = |reason: String| Error::Format { path: path.into(), reason };
    let kind = |e: ::exr::error::Error| format(format!("is not an OpenEXR file with R, G and B channels ({e})"));
    let headers = ::exr::meta::MetaData::read_from_buffered(bytes.as_slice(), false).map_err(kind)?.headers;
    for header in &headers {
        super::check_size(header.layer_size.width(), header.layer_size.height(), bytes.len()).map_err(format)?;
    }
    let image = ::exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .rgb_channels(
            |size, _| Rgb(std::array::from_fn(|_| Plane::filled(size.width(), size.height(), 0.0))),
            |rgb: &mut Rgb, Vec2(x, y), (r, g, b): (f32, f32, f32)| {
                let i = y * rgb.0[0].width + x;
                (rgb.0[0].data[i], rgb.0[1].data[i], rgb.0[2].data[i]) = (r, g, b);
            },
        )
        .first_valid_layer()
        .all_attributes()
        .from_buffered(std::io::Cursor::new(bytes))
        .map_err(kind)?;
    let to_xyz = match &image.attributes.chromaticities {
        None => Primaries::Rec709.to_xyz(),
        Some(c) => {
            let pair = |v: Vec2<f32>| [f64::from(v.0), f64::from(v.1)];
            let matrix = colour::from_chromaticities([pair(c.red), pair(c.green), pair(c.blue), pair(c.white)]);
            matrix.ok_or_else(|| format("notes chromaticities that span no colours; correct or remove the attribute".into()))?
        }
    };
    let layer = image.layer_data;
    let a = &layer.attributes;
    let factor = match a.other.get(&Text::from(FACTOR_ATTRIBUTE)) {
        Some(AttributeValue::F32(v)) => Some(f64::from(*v)),
        _ => None,
    };
    let text = |t: &Option<Text>| t.as_ref().map(ToString::to_string).filter(|t| !t.is_empty());
    let other = |name: &str| match a.other.get(&Text::from(name)) {
        Some(AttributeValue::Text(t)) => text(&Some(t.clone())),
        _ => None,
    };
    let metadata = Metadata {
        exposure_time: a.exposure.map(f64::from),
        f_number: a.aperture.map(f64::from).filter(|v| *v > 0.0),
        iso: a.iso_speed.map(f64::from).filter(|v| *v > 0.0),
        taken: text(&a.capture_date),
        artist: other("artist"),
        copyright: other("copyright").or_else(|| text(&a.owner)),
        make: other("cameraMake"),
        model: other("cameraModel"),
        lens: other("lensModel"),
        focal_mm: match a.other.get(&Text::from("nominalFocalLength")) {
            Some(AttributeValue::F32(v)) => Some(f64::from(*v)),
            _ => None,
        },
        latitude: a.latitude.map(f64::from),
        longitude: a.longitude.map(f64::from),
        altitude: a.altitude.map(f64::from),
        ..Metadata::default()
    };
    Ok(File { image: layer.channel_data.pixels, factor, to_xyz, metadata })
}
