//! Irradiance to display.

use crate::image::Rgb;

/// Placeholder: clips and encodes.
pub fn preview(irradiance: &Rgb) -> ::image::RgbImage {
    ::image::RgbImage::from_fn(irradiance.width() as u32, irradiance.height() as u32, |x, y| {
        let i = y as usize * irradiance.width() + x as usize;
        ::image::Rgb(irradiance.pixel(i).map(|v| (v.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8))
    })
}
