//! Camera raw files (feature `raw`, through rawler) into linear frames in the camera's own colours.
//!
//! The frame stays in camera RGB, each channel 1 where it saturates: what the solver sees is what the sensor recorded, shot noise and
//! saturation included. White balance and the camera's matrix belong to the result and come along as one matrix.

mod directories;
mod notes;

use super::metadata::{self, Metadata};
use crate::colour::{self, Matrix, Primaries};
use crate::image::{Plane, Rgb};
use crate::mask::CLIPPED;
use rawler::decoders::{Decoder, Orientation, RawDecodeParams, WellKnownIFD};
use rawler::formats::tiff::Value;
use rawler::imgop::develop::{Intermediate, ProcessingStep, RawDevelop};
use rawler::imgop::sensor::xtrans::markesteijn::XTransMarkesteijnDemosaic;
use rawler::imgop::sensor::{Demosaic, SensorType};
use rawler::imgop::xyz::Illuminant;
use rawler::pixarray::{Color2D, PixF32};
use rawler::rawimage::RawPhotometricInterpretation as Photometric;
use rawler::rawsource::RawSource;
use rawler::tags::{DngTag, TiffCommonTag};
use rawler::{RawImage, RawImageData};
use rayon::prelude::*;
use std::cell::Cell;
use std::panic::{self, AssertUnwindSafe};
use std::sync::Once;

/// A developed raw file.
pub struct Raw {
    /// Camera RGB, linear, black 0, saturation 1; saturated sites and what was interpolated from them are 1. Upright.
    pub intensity: Rgb,
    /// Camera RGB to XYZ relative to D50, as-shot white balance included; the least amplified channel's saturation is white.
    pub to_xyz: Matrix,
    /// What the file notes.
    pub metadata: Metadata,
}

/// Whether rawler knows files whose names end so (without point). TIFF and JPEG files are not raw, whatever they hold besides.
pub fn is_raw_name(ending: &str) -> bool {
    let known = rawler::decoders::supported_extensions().iter().any(|e| e.eq_ignore_ascii_case(ending));
    known && !["tif", "tiff", "jpg", "jpeg", "png"].contains(&ending.to_ascii_lowercase().as_str())
}

/// Develops the bytes of a raw file.
///
/// # Errors
/// Why it cannot be, with the remedy, in words that follow the file's name.
pub fn read(bytes: Vec<u8>) -> Result<Raw, String> {
    // rawler looks for pixels in JPEG files, and in a truncated one for ever.
    if bytes.starts_with(b"\xff\xd8") {
        return Err("is a JPEG file, whatever its name says; rename it".into());
    }
    directories::check(&bytes)?;
    let noted = metadata::read_bytes(&bytes);
    quietly(move || {
        let source = RawSource::new_from_shared_vec(bytes.into());
        let decoder = rawler::get_decoder(&source).map_err(|e| reason(&e))?;
        let params = RawDecodeParams::default();
        check_size(decoder.as_ref(), source.buf().len())?;
        let raw = decoder.raw_image(&source, &params, false).map_err(|e| reason(&e))?;
        let mut metadata = match decoder.raw_metadata(&source, &params) {
            Ok(m) => noted.or(metadata::of_fields(&notes::fields(&m))),
            Err(_) => noted,
        };
        metadata.noise = noise_profile(decoder.as_ref());
        develop(raw, metadata)
    })
    .unwrap_or_else(|| Err("is damaged, or of a kind that cannot be developed; copy it again from the camera, or convert it to DNG".into()))
}

/// Pixels per byte that no compression of raw files reaches.
const LEAST_DENSE: usize = 64;

/// Refuses sizes that cannot be before memory is asked for them: that would end the program.
fn check_size(decoder: &dyn Decoder, bytes: usize) -> Result<(), String> {
    let Ok(Some(directory)) = decoder.ifd(WellKnownIFD::Raw) else { return Ok(()) };
    let number = |tag: TiffCommonTag| directory.get_entry(tag).map_or(1, |e| e.force_usize(0));
    let samples = [TiffCommonTag::ImageWidth, TiffCommonTag::ImageLength, TiffCommonTag::SamplesPerPixel].map(number);
    let product = samples.into_iter().try_fold(1usize, |a, n| a.checked_mul(n));
    if product.is_none_or(|n| n > LEAST_DENSE * bytes) {
        return Err(format!("claims {} x {} pixels, more than it can hold; copy it again from the camera", samples[0], samples[1]));
    }
    Ok(())
}

/// NoiseProfile of a DNG file (DNG 1.4, tag 51041): pairs S, O for all colours or one for each, of which the mean is taken.
fn noise_profile(decoder: &dyn Decoder) -> Option<[f64; 2]> {
    let of = |place| match &decoder.ifd(place).ok()??.get_entry(DngTag::NoiseProfile)?.value {
        Value::Double(v) => Some(v.clone()),
        _ => None,
    };
    let values = of(WellKnownIFD::Raw).or_else(|| of(WellKnownIFD::Root))?;
    let pairs: Vec<&[f64]> = values.chunks_exact(2).collect();
    let sound = !pairs.is_empty() && pairs.iter().all(|p| p[0] > 0.0 && p[0] < 1.0 && p[1] >= 0.0 && p[1] < 1.0);
    let mean = |k: usize| pairs.iter().map(|p| p[k]).sum::<f64>() / pairs.len() as f64;
    // A black pixel without any noise would count without bound: a ten-thousandth of white is as good as none.
    sound.then(|| [mean(0), mean(1).max(1e-8)])
}

fn reason(e: &rawler::RawlerError) -> String {
    match e {
        rawler::RawlerError::Unsupported { what, model, make, .. } if make.trim().is_empty() && model.trim().is_empty() => {
            let what = printable(what);
            format!(
                "is damaged, holds no picture, or is of a kind that is not supported ({what}); copy it again from the camera, or convert it to DNG"
            )
        }
        rawler::RawlerError::Unsupported { what, model, make, .. } => {
            let [make, model, what] = [make, model, what].map(|t| printable(t));
            format!("is of a camera that is not supported ({make} {model}: {what}); convert it to DNG")
        }
        rawler::RawlerError::DecoderFailed(text) => {
            format!("is truncated or damaged ({}); copy it again from the camera", printable(text))
        }
    }
}

/// Words of a damaged file for a terminal: no control characters, and not more than thirty of them.
fn printable(text: &str) -> String {
    let plain: String = text.chars().map(|c| if c.is_control() || c == char::REPLACEMENT_CHARACTER { ' ' } else { c }).collect();
    plain.split_whitespace().take(30).collect::<Vec<_>>().join(" ")
}

thread_local!(static QUIET: Cell<bool> = const { Cell::new(false) });

/// Runs `f`; `None` when it panics, which decoders of a hundred formats do on damaged files, and without the panic's message.
fn quietly<T>(f: impl FnOnce() -> T) -> Option<T> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let before = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            if !QUIET.get() {
                before(info);
            }
        }));
    });
    QUIET.set(true);
    let out = panic::catch_unwind(AssertUnwindSafe(f)).ok();
    QUIET.set(false);
    out
}

fn develop(mut raw: RawImage, mut metadata: Metadata) -> Result<Raw, String> {
    if raw.fuji_rotation_width.is_some() {
        return Err("is of a sensor whose rows run diagonally, which is not supported; convert it to 16-bit TIFF".into());
    }
    match &raw.photometric {
        Photometric::Cfa(c) if c.cfa.is_rgb() => {}
        Photometric::LinearRaw if raw.cpp == 3 => {}
        Photometric::Cfa(_) => {
            return Err("has a colour filter other than red, green and blue; convert it to a linear DNG or 16-bit TIFF".into());
        }
        _ => return Err("is monochrome or of an odd kind; convert it to 16-bit TIFF".into()),
    }
    scale(&mut raw)?;
    let to_xyz = camera_matrix(&raw)?;
    let saturated = saturated_sites(&raw);
    let (pixels, reach) = demosaic(&raw)?;
    let crop = raw.crop_area.or(raw.active_area);
    let corner = crop.map_or((0, 0), |c| (c.p.x, c.p.y));
    let (width, height) = (pixels.width, pixels.height);
    let data = pixels.into_inner();
    let planes: [Plane; 3] = std::array::from_fn(|c| {
        let mut plane =
            Plane { width, height, data: data.iter().map(|p| if p[c].is_finite() { p[c].clamp(0.0, 1.0) } else { 0.0 }).collect() };
        spread(&mut plane, &saturated, c as u8, corner, (raw.width, raw.height), reach);
        plane
    });
    // Of most formats the decoder leaves the orientation to the notes, which are applied here.
    let noted = metadata.orientation.take().unwrap_or(1);
    let orientation = match raw.orientation {
        Orientation::Unknown | Orientation::Normal => noted,
        o => u32::from(o.to_u16()),
    };
    let intensity = super::upright(&Rgb(planes), orientation);
    Ok(Raw { intensity, to_xyz, metadata })
}

/// Pixel values become 0 at black, 1 at white; what noise pushes below black is 0.
fn scale(raw: &mut RawImage) -> Result<(), String> {
    let (black, white) = (raw.blacklevel.as_vec(), raw.whitelevel.as_vec());
    let (wide, high) = (raw.blacklevel.width.max(1), raw.blacklevel.height.max(1));
    let (columns, samples) = (raw.width, raw.cpp);
    // Levels are of single sites, of the four sites of 2 x 2, of colours, or of all.
    let levels = |x: usize, y: usize, c: usize| {
        let low = black.get(samples * (wide * (y % high) + x % wide) + c).or(black.first()).copied().unwrap_or(0.0);
        let place = if samples == 1 && white.len() == 4 { 2 * (y % 2) + x % 2 } else { c };
        (low, white.get(place).or(white.first()).copied().unwrap_or(0.0))
    };
    let mut places = (0..high.max(2)).flat_map(|y| (0..wide.max(2)).map(move |x| (x, y)));
    let sound = |(low, top): &(f32, f32)| top > low;
    if let Some((low, top)) = places.find_map(|(x, y)| (0..samples).map(|c| levels(x, y, c)).find(|l| !sound(l))) {
        return Err(format!("notes a white level ({top}) that is not above its black level ({low}); the file is damaged"));
    }
    let mut pixels = raw.data.as_f32().into_owned();
    pixels.par_chunks_mut((columns * samples).max(1)).enumerate().for_each(|(y, row)| {
        for (i, v) in row.iter_mut().enumerate() {
            let (low, top) = levels(i / samples, y, i % samples);
            *v = ((*v - low) / (top - low)).max(0.0);
        }
    });
    raw.data = RawImageData::Float(pixels);
    Ok(())
}

/// The three colours of each pixel of the cropped frame, and how many sites away from a saturated one they are not to be trusted.
fn demosaic(raw: &RawImage) -> Result<(Color2D<f32, 3>, usize), String> {
    if let Photometric::Cfa(config) = &raw.photometric
        && config.sensor == SensorType::Xtrans
    {
        // The decoder's own choice for X-Trans is the mean over 5 x 5 sites: a blur that no motion explains.
        let sites = PixF32::new_with(raw.data.as_f32().into_owned(), raw.width, raw.height);
        let area = raw.active_area.unwrap_or_else(|| sites.rect());
        let pixels = XTransMarkesteijnDemosaic::new_pass_3().demosaic(&sites, &config.cfa, &config.colors, area);
        let crop = raw.crop_area.unwrap_or(area);
        let inside = crop.adapt(&area);
        return Ok((if inside.d == pixels.dim() { pixels } else { pixels.crop(inside) }, 2));
    }
    let steps = [ProcessingStep::Demosaic, ProcessingStep::CropActiveArea, ProcessingStep::CropDefault];
    match RawDevelop::new_with(&steps).develop_intermediate(raw).map_err(|e| reason(&e))? {
        Intermediate::ThreeColor(pixels) => Ok((pixels, 1)),
        _ => Err("has not three colours; convert it to 16-bit TIFF".into()),
    }
}

/// For each site of the sensor, a bit for each channel that it records and that is saturated there.
fn saturated_sites(raw: &RawImage) -> Vec<u8> {
    let RawImageData::Float(values) = &raw.data else { return vec![0; raw.width * raw.height] };
    match &raw.photometric {
        Photometric::Cfa(config) => {
            let site = |i: usize| config.cfa.color_at(i / raw.width, i % raw.width).min(2);
            values.iter().enumerate().map(|(i, v)| if *v >= CLIPPED { 1 << site(i) } else { 0 }).collect()
        }
        _ => values.chunks_exact(3).map(|p| (0..3).fold(0, |bits, c| bits | (u8::from(p[c] >= CLIPPED) << c))).collect(),
    }
}

/// Sets pixels within `reach` sites of a saturated site of channel `c` to 1: what was interpolated from clipped values is not a measurement.
fn spread(plane: &mut Plane, saturated: &[u8], c: u8, corner: (usize, usize), (width, height): (usize, usize), reach: usize) {
    for y in 0..plane.height {
        for x in 0..plane.width {
            let (i, j) = (x + corner.0, y + corner.1);
            let hit = (j.saturating_sub(reach)..(j + reach + 1).min(height))
                .any(|b| (i.saturating_sub(reach)..(i + reach + 1).min(width)).any(|a| saturated[b * width + a] >> c & 1 == 1));
            if hit {
                plane.data[y * plane.width + x] = 1.0;
            }
        }
    }
}

/// As-shot white balance and the camera's matrix: camera RGB to XYZ relative to D50. The matrix is scaled so that what the white balance
/// calls neutral becomes D50 exactly, as dcraw does.
fn camera_matrix(raw: &RawImage) -> Result<Matrix, String> {
    const LIGHTS: [(Illuminant, colour::Chromaticity); 6] = [
        (Illuminant::D65, colour::D65),
        (Illuminant::D55, [0.3324, 0.3474]),
        (Illuminant::D50, colour::D50),
        (Illuminant::D75, [0.2990, 0.3149]),
        (Illuminant::C, [0.3101, 0.3162]),
        (Illuminant::A, [0.4476, 0.4074]),
    ];
    let found = LIGHTS.iter().find_map(|(light, white)| Some((raw.color_matrix.get(light)?, *white)));
    let any = || raw.color_matrix.values().next().map(|m| (m, colour::D65));
    let Some((flat, white)) = found.or_else(any).filter(|(m, _)| m.len() >= 9) else {
        return Err("holds no colour matrix, and its camera is not known; convert it to DNG or 16-bit TIFF".into());
    };
    let xyz_to_camera: Matrix = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(flat[3 * i + j])));
    // From D50, in which everything meets, to the light that the matrix was measured under.
    let adapted = colour::adaptation(colour::D50, white).expect("the lights are real ones");
    let rgb = Primaries::Rec709.to_xyz();
    let mut camera = colour::product(&xyz_to_camera, &colour::product(&adapted, &rgb));
    for row in &mut camera {
        let sum: f64 = row.iter().sum();
        *row = row.map(|v| v / sum);
    }
    let refuse = || "holds a colour matrix that cannot be inverted; convert it to 16-bit TIFF".to_string();
    let camera = colour::inverse(&camera).ok_or_else(refuse)?;
    let mut balance: [f64; 3] = std::array::from_fn(|c| f64::from(raw.wb_coeffs[c]));
    if balance.iter().any(|v| !(v.is_finite() && *v > 0.0)) {
        return Err("notes no white balance; convert it to DNG or 16-bit TIFF with one".into());
    }
    let least = balance.into_iter().fold(f64::INFINITY, f64::min);
    balance = balance.map(|v| v / least);
    Ok(colour::product(&rgb, &colour::product(&camera, &colour::diagonal(balance))))
}
