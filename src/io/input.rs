//! One frame from a file of any kind that the program reads: pixels, what they mean, and what the file notes.

use super::icc::{self, Profile};
use super::metadata::{self, Metadata};
use super::{exr, ldr};
use crate::colour::{self, Matrix, Primaries};
use crate::error::{Error, Result};
use crate::image::Rgb;
use crate::response::Response;
use std::path::Path;

/// How the pixels of a file follow from light.
#[derive(Clone, Debug, PartialEq)]
pub enum Encoding {
    /// The camera's own curve, of which the file says nothing, or only that it looks right as sRGB.
    Camera,
    /// The curve that the ICC profile of this name states.
    Profile(String, Response),
    /// Proportional to light: raw, OpenEXR, Radiance HDR, floating-point TIFF.
    Linear,
}

/// One file as a frame.
#[derive(Clone, Debug)]
pub struct Input {
    /// Intensity Z, 0..=1, 1 is white or clipped. Upright.
    pub intensity: Rgb,
    /// Number of intensity steps.
    pub levels: u32,
    /// See [`crate::exposure::Frame::chroma_subsampled`].
    pub chroma_subsampled: bool,
    /// See [`crate::exposure::Frame::lossy`].
    pub lossy: bool,
    /// How intensity follows from light.
    pub encoding: Encoding,
    /// Linear RGB of this frame to XYZ relative to D50, white balance included.
    pub to_xyz: Matrix,
    /// What the file notes.
    pub metadata: Metadata,
    /// Whether this is a camera raw file: its pixels do not depend on the white balance that `to_xyz` holds.
    pub raw: bool,
}

/// Whether what the file notes is not to be had without decoding it.
pub fn notes_need_pixels(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    !["jpg", "jpeg", "png", "tif", "tiff"].contains(&extension.as_str())
}

/// Whether an ending (without point) is of camera raw files that this build reads.
pub fn is_raw_name(ending: &str) -> bool {
    #[cfg(feature = "raw")]
    return super::raw::is_raw_name(ending);
    #[cfg(not(feature = "raw"))]
    {
        let _ = ending;
        false
    }
}

/// What a file notes of itself, without its pixels where its kind allows.
///
/// # Errors
/// As [`read`].
pub fn notes(path: &Path) -> Result<Metadata> {
    let noted = metadata::read(path)?;
    if noted.exposure_time.is_some() || !notes_need_pixels(path) {
        return Ok(noted);
    }
    read(path, 1.0).map(|i| i.metadata)
}

/// Reads a frame. `white`: the value of a floating-point file at and above which it is clipped (1 unless said).
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened; [`Error::Format`] when it is damaged, of an unsupported kind, or holds NaN, with the
/// remedy.
pub fn read(path: &Path, white: f32) -> Result<Input> {
    decode(path, super::read_bytes(path)?, white)
}

/// [`read`] of bytes that are read already; `path` tells the kind of camera raw files by its ending, and is named in errors.
///
/// # Errors
/// [`Error::Format`] as [`read`].
pub fn decode(path: &Path, bytes: Vec<u8>, white: f32) -> Result<Input> {
    let refuse = |reason: String| Error::Format { path: path.into(), reason };
    if bytes.starts_with(&[0x76, 0x2f, 0x31, 0x01]) {
        let file = exr::decode(path, bytes)?;
        return linear(path, file.image, white, file.to_xyz, file.metadata);
    }
    if bytes.starts_with(b"#?") {
        let (image, to_xyz) = radiance(&bytes).map_err(refuse)?;
        return linear(path, image, white, to_xyz, Metadata::default());
    }
    let extension = super::output::ending(path);
    #[cfg(feature = "raw")]
    if super::raw::is_raw_name(&extension) {
        let raw = super::raw::read(bytes).map_err(refuse)?;
        return Ok(Input {
            intensity: raw.intensity,
            levels: 65535,
            chroma_subsampled: false,
            lossy: false,
            encoding: Encoding::Linear,
            to_xyz: raw.to_xyz,
            metadata: raw.metadata,
            raw: true,
        });
    }
    #[cfg(not(feature = "raw"))]
    if ["dng", "cr2", "cr3", "nef", "arw", "raf", "orf", "rw2"].contains(&extension.as_str()) {
        return Err(refuse("is a camera raw file, which this build cannot read; build the program with the feature 'raw'".into()));
    }
    let picture = ldr::decode(path, &bytes)?;
    let mut metadata = metadata::read_bytes(&bytes);
    // Applied already.
    metadata.orientation = None;
    let profile = picture.icc.as_deref().map(icc::parse).transpose().map_err(refuse)?;
    if picture.float {
        let to_xyz = profile.map_or_else(|| Primaries::Rec709.to_xyz(), |p| p.to_xyz);
        return linear(path, picture.intensity, white, to_xyz, metadata);
    }
    let (encoding, to_xyz) = match profile {
        // A camera's JPEG in sRGB looks right as sRGB; that its curve is sRGB's is another matter.
        None => (Encoding::Camera, Primaries::Rec709.to_xyz()),
        Some(Profile { response: Response::Srgb, to_xyz, .. }) => (Encoding::Camera, to_xyz),
        Some(Profile { name, response, to_xyz }) => (Encoding::Profile(name, response), to_xyz),
    };
    Ok(Input {
        intensity: picture.intensity,
        levels: picture.levels,
        chroma_subsampled: picture.chroma_subsampled,
        lossy: picture.lossy,
        encoding,
        to_xyz,
        metadata,
        raw: false,
    })
}

/// A linear image of any brightness.
pub struct Linear {
    /// The pixels, as they stand in the file.
    pub image: Rgb,
    /// Linear RGB to XYZ relative to D50.
    pub to_xyz: Matrix,
    /// What the file notes.
    pub metadata: Metadata,
}

/// Reads a linear image: OpenEXR, Radiance HDR, or a TIFF file of floating-point numbers (with the primaries of its profile).
///
/// # Errors
/// [`Error::Read`] when the file cannot be opened; [`Error::Format`] when it is damaged or of another kind.
pub fn read_linear(path: &Path) -> Result<Linear> {
    let bytes = super::read_bytes(path)?;
    let refuse = |reason: String| Error::Format { path: path.into(), reason };
    if bytes.starts_with(b"#?") {
        let (image, to_xyz) = radiance(&bytes).map_err(refuse)?;
        return Ok(Linear { image, to_xyz, metadata: Metadata::default() });
    }
    if bytes.starts_with(b"II") || bytes.starts_with(b"MM") {
        let picture = ldr::decode(path, &bytes)?;
        if !picture.float {
            return Err(refuse("holds integers, not linear floating-point numbers; give the OpenEXR file".into()));
        }
        let profile = picture.icc.as_deref().map(icc::parse).transpose().map_err(refuse)?;
        let to_xyz = profile.map_or_else(|| Primaries::Rec709.to_xyz(), |p| p.to_xyz);
        return Ok(Linear { image: picture.intensity, to_xyz, metadata: metadata::read_bytes(&bytes) });
    }
    let file = exr::decode(path, bytes)?;
    Ok(Linear { image: file.image, to_xyz: file.to_xyz, metadata: file.metadata })
}

/// A linear frame: values over `white`, clipped to 0..=1; NaN is refused.
fn linear(path: &Path, image: Rgb, white: f32, to_xyz: Matrix, metadata: Metadata) -> Result<Input> {
    for plane in &image.0 {
        if let Some(i) = plane.data.iter().position(|v| v.is_nan()) {
            let (x, y) = (i % plane.width, i / plane.width);
            return Err(Error::Format {
                path: path.into(),
                reason: format!("holds no number (NaN) at pixel ({x}, {y}); repair the frame or leave it out"),
            });
        }
    }
    let intensity = image.map_planes(|p| p.map(|v| (v / white).clamp(0.0, 1.0)));
    Ok(Input {
        intensity,
        levels: ldr::FLOAT_LEVELS,
        chroma_subsampled: false,
        lossy: false,
        encoding: Encoding::Linear,
        to_xyz,
        metadata,
        raw: false,
    })
}

/// Pixels of a Radiance HDR file, and their RGB to XYZ relative to D50: by its PRIMARIES, without them Rec. 709, which is what programs
/// write that write none.
fn radiance(bytes: &[u8]) -> std::result::Result<(Rgb, Matrix), String> {
    let damaged = |e: ::image::ImageError| format!("is a truncated or damaged Radiance HDR file ({e}); make it again");
    let decoder = ::image::codecs::hdr::HdrDecoder::new(std::io::Cursor::new(bytes)).map_err(damaged)?;
    let (width, height) = ::image::ImageDecoder::dimensions(&decoder);
    super::check_size(width as usize, height as usize, bytes.len())?;
    let primaries = decoder.metadata().custom_attributes.into_iter().rev().find(|(key, _)| key == "PRIMARIES");
    let to_xyz = match primaries {
        None => Primaries::Rec709.to_xyz(),
        Some((_, text)) => {
            let numbers: Option<Vec<f64>> = text.split_whitespace().map(|n| n.parse().ok()).collect();
            let pairs = numbers.filter(|n| n.len() == 8).map(|n| std::array::from_fn(|i| [n[2 * i], n[2 * i + 1]]));
            pairs
                .and_then(colour::from_chromaticities)
                .ok_or("notes PRIMARIES that are not eight numbers, or span no colours; correct or remove that line")?
        }
    };
    let picture = ::image::DynamicImage::from_decoder(decoder).map_err(damaged)?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    Ok((ldr::planes(&picture.into_rgb32f().into_raw(), width, height, 1.0f32), to_xyz))
}

/// Whether two frames' colours are the same to what an eye can tell.
pub fn same_colours(a: &Matrix, b: &Matrix) -> bool {
    colour::inverse(b).is_some_and(|inverse| {
        let m = colour::product(&inverse, a);
        (0..3).all(|i| (0..3).all(|j| (m[i][j] - f64::from(u8::from(i == j))).abs() < 0.01))
    })
}
