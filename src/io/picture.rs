//! Results for display and for other programs: PNG and JPEG with an sRGB profile and the camera's notes, TIFF, Radiance HDR.

use super::metadata::Metadata;
use crate::colour::Primaries;
use crate::image::Rgb;
use ::image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
use ::image::{ImageEncoder, RgbImage};
use moxcms::ColorProfile;
use std::io::{Seek, Write};
use tiff::encoder::colortype::{RGB16, RGB32Float};
use tiff::encoder::{Compression, TiffEncoder, compression::DeflateLevel};
use tiff::tags::Tag;

/// The ICC profile of sRGB, a few hundred bytes.
fn srgb_profile() -> Option<Vec<u8>> {
    ColorProfile::new_srgb().encode().ok()
}

/// Gives an encoder the sRGB profile and the notes; an encoder that cannot hold one of them goes without.
fn describe(encoder: &mut impl ImageEncoder, noted: Option<&Metadata>) {
    if let Some(profile) = srgb_profile() {
        let _ = encoder.set_icc_profile(profile);
    }
    if let Some(block) = noted.and_then(Metadata::exif_block) {
        let _ = encoder.set_exif_metadata(block);
    }
}

/// Writes an 8-bit sRGB PNG.
///
/// # Errors
/// What `to` refuses.
pub fn write_png(to: impl Write, picture: &RgbImage, noted: Option<&Metadata>) -> Result<(), String> {
    let mut encoder = PngEncoder::new(to);
    describe(&mut encoder, noted);
    picture.write_with_encoder(encoder).map_err(|e| e.to_string())
}

/// Writes an 8-bit sRGB JPEG of `quality` 1..=100.
///
/// # Errors
/// What `to` refuses, and pictures of more than 65535 pixels a side.
pub fn write_jpeg(to: impl Write, picture: &RgbImage, quality: u8, noted: Option<&Metadata>) -> Result<(), String> {
    let mut encoder = JpegEncoder::new_with_quality(to, quality);
    describe(&mut encoder, noted);
    picture.write_with_encoder(encoder).map_err(|e| e.to_string())
}

/// Writes linear pixels as Radiance HDR (8-bit mantissas with a shared exponent: 1 % steps), Rec. 709.
///
/// # Errors
/// What `to` refuses.
pub fn write_radiance(mut to: impl Write, image: &Rgb) -> Result<(), String> {
    let pixels: Vec<::image::Rgb<f32>> = (0..image.width() * image.height()).map(|i| ::image::Rgb(image.pixel(i))).collect();
    let mut file = Vec::new();
    ::image::codecs::hdr::HdrEncoder::new(&mut file).encode(&pixels, image.width(), image.height()).map_err(|e| e.to_string())?;
    // Without this line the format means white of equal energy and another green: colours are 4 % off where that is heeded.
    let numbers = Primaries::Rec709.chromaticities().concat().iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let line = format!("PRIMARIES={numbers}\n");
    let behind = file.windows(2).position(|w| w == b"\n\n").ok_or("the header has no end")? + 1;
    [&file[..behind], line.as_bytes(), &file[behind..]].into_iter().try_for_each(|part| to.write_all(part)).map_err(|e| super::plain(&e))
}

/// Bits of a TIFF file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Depth {
    /// 16-bit integers, 65535 is 1.0; what is brighter is clipped.
    Sixteen,
    /// 32-bit floating point.
    Float,
}

/// Writes linear pixels as TIFF with a linear profile of `primaries`. Returns the share of the pixels that 16 bits clip.
///
/// # Errors
/// What `to` refuses.
pub fn write_tiff(to: impl Write + Seek, image: &Rgb, depth: Depth, primaries: Primaries, noted: &Metadata) -> Result<f64, String> {
    let (width, height) = (image.width() as u32, image.height() as u32);
    let text = |e: tiff::TiffError| e.to_string();
    let mut encoder = TiffEncoder::new(to).map_err(text)?.with_compression(Compression::Deflate(DeflateLevel::Fast));
    let values = || (0..image.width() * image.height()).flat_map(|i| image.pixel(i));
    let profile = linear_profile(primaries);
    macro_rules! tags {
        ($file:expr) => {{
            let directory = $file.encoder();
            directory.write_tag(Tag::Software, concat!("unshaken ", env!("CARGO_PKG_VERSION"))).map_err(text)?;
            for (tag, value) in [
                (Tag::Artist, &noted.artist),
                (Tag::Copyright, &noted.copyright),
                (Tag::Make, &noted.make),
                (Tag::Model, &noted.model),
                (Tag::DateTime, &noted.taken),
            ] {
                if let Some(value) = value.as_deref().filter(|v| v.is_ascii()) {
                    // Nineteen characters, without a fraction of the second.
                    let value = if tag == Tag::DateTime { value.split('.').next().unwrap_or(value) } else { value };
                    directory.write_tag(tag, value).map_err(text)?;
                }
            }
            if let Some(profile) = &profile {
                directory.write_tag(Tag::IccProfile, profile.as_slice()).map_err(text)?;
            }
        }};
    }
    match depth {
        Depth::Float => {
            let mut file = encoder.new_image::<RGB32Float>(width, height).map_err(text)?;
            tags!(file);
            file.write_data(&values().collect::<Vec<f32>>()).map_err(text)?;
            Ok(0.0)
        }
        Depth::Sixteen => {
            let clipped = values().filter(|v| *v > 1.0).count() as f64 / (3 * image.width() * image.height()).max(1) as f64;
            let mut file = encoder.new_image::<RGB16>(width, height).map_err(text)?;
            tags!(file);
            file.write_data(&values().map(|v| (v.clamp(0.0, 1.0) * 65535.0).round() as u16).collect::<Vec<_>>()).map_err(text)?;
            Ok(clipped)
        }
    }
}

/// The ICC profile of linear light in these primaries.
fn linear_profile(primaries: Primaries) -> Option<Vec<u8>> {
    let mut profile = ColorProfile::new_srgb();
    let m = primaries.to_xyz();
    let colorant = |c: usize| moxcms::Xyzd { x: m[0][c], y: m[1][c], z: m[2][c] };
    (profile.red_colorant, profile.green_colorant, profile.blue_colorant) = (colorant(0), colorant(1), colorant(2));
    // One value, as 8.8 fixed point: gamma 1.
    let line = moxcms::ToneReprCurve::Lut(vec![256]);
    (profile.red_trc, profile.green_trc, profile.blue_trc) = (Some(line.clone()), Some(line.clone()), Some(line));
    profile.cicp = None;
    profile.description = Some(moxcms::ProfileText::Localizable(vec![moxcms::LocalizableString::new(
        "en".into(),
        "US".into(),
        format!("linear {}", primaries.name()),
    )]));
    profile.encode().ok()
}
