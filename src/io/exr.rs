//! Linear OpenEXR: the result, and truth for tests.

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

/// Writes `image` (linear, Rec. 709 primaries, white D65) as 32-bit float RGB with lossless ZIP compression. The rule
/// stands in the attributes: `comments` in words, [`FACTOR_ATTRIBUTE`] and `expTime` as numbers.
///
/// # Errors
/// A reason for a pixel that is NaN, infinite or negative (nothing is written then), and for what `to` refuses.
pub fn write(to: impl Write + Seek, image: &Rgb, radiometry: &Radiometry) -> std::result::Result<(), String> {
    let names = ["red", "green", "blue"];
    for (plane, name) in image.0.iter().zip(names) {
        if let Some(i) = plane.data.iter().position(|v| !(v.is_finite() && *v >= 0.0)) {
            let (x, y) = (i % plane.width, i / plane.width);
            return Err(format!(
                "{name} at pixel ({x}, {y}) is {}, but irradiance is finite and not negative; this is a fault of the program",
                plane.data[i]
            ));
        }
    }
    let [r, g, b] = &image.0;
    let width = image.width();
    let channels = SpecificChannels::rgb(|Vec2(x, y)| {
        let i = y * width + x;
        (r.data[i], g.data[i], b.data[i])
    });
    let attributes = LayerAttributes {
        software_name: Some(concat!("unshaken ", env!("CARGO_PKG_VERSION")).into()),
        comments: Text::new_or_none(format!(
            "1.0 is the white of the reference frame {}: value = irradiance x its exposure time ({} s)",
            radiometry.frame.chars().map(|c| if c.is_ascii() { c } else { '?' }).collect::<String>(),
            radiometry.exposure_time
        )),
        exposure: Some(radiometry.exposure_time as f32),
        other: [(FACTOR_ATTRIBUTE.into(), AttributeValue::F32(radiometry.exposure_time as f32))].into_iter().collect(),
        ..LayerAttributes::default()
    };
    let mut picture = Image::from_layer(Layer::new(image.size(), attributes, Encoding::SMALL_LOSSLESS, channels));
    picture.attributes.chromaticities = Some(::exr::meta::attribute::Chromaticities {
        red: Vec2(0.64, 0.33),
        green: Vec2(0.30, 0.60),
        blue: Vec2(0.15, 0.06),
        white: Vec2(0.3127, 0.3290),
    });
    picture.write().to_buffered(to).map_err(|e| e.to_string())
}

/// Reads the R, G and B channels of the first layer (half, float or integer), with the factor if it is noted.
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened, [`Error::Format`] when it is no OpenEXR file with R, G and B.
pub fn read(path: &Path) -> Result<(Rgb, Option<f64>)> {
    let bytes = super::read_bytes(path)?;
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
        .map_err(|e| Error::Format { path: path.into(), reason: format!("is not an OpenEXR file with R, G and B channels ({e})") })?;
    let factor = match image.layer_data.attributes.other.get(&Text::from(FACTOR_ATTRIBUTE)) {
        Some(AttributeValue::F32(v)) => Some(f64::from(*v)),
        _ => None,
    };
    Ok((image.layer_data.channel_data.pixels, factor))
}
