//! Smaller frames for previews: means of whole squares of pixels, taken in irradiance.

use super::Response;
use crate::error::{Error, Result};
use crate::exposure::{Bracket, Frame};
use crate::image::{Plane, Rgb};

/// Smallest side of a reduced frame, pixels.
const SMALLEST: usize = 16;
/// Steps of the table of f.
const STEPS: usize = 4096;

/// The bracket with squares of `divisor` x `divisor` pixels made one: f of the mean of f⁻¹(Z), or 1 where any of them is clipped.
/// Columns and rows that fill no square are left out, on both sides alike. Its intensities are finer than the frames' own steps, so that
/// `levels` grows by the divisor.
///
/// # Errors
/// [`Error::Bracket`] when less than 16 pixels would be left of a side.
pub fn reduced(bracket: &Bracket, response: &Response, divisor: usize) -> Result<Bracket> {
    let (width, height) = bracket.size();
    let (w, h) = (width / divisor, height / divisor);
    if w.min(h) < SMALLEST {
        return Err(Error::Bracket(format!(
            "frames of {width} x {height} pixels would become {w} x {h}; a side needs {SMALLEST} pixels at least: use a larger --scale"
        )));
    }
    let (left, top) = ((width - w * divisor) / 2, (height - h * divisor) / 2);
    let frames = bracket.frames().iter().map(|f| {
        let intensity = Rgb(std::array::from_fn(|c| {
            let curve: Vec<f64> = (0..=STEPS).map(|i| response.inverse(c, i as f64 / STEPS as f64)).collect();
            let inverse: Vec<f64> = (0..=f.levels).map(|i| response.inverse(c, f64::from(i) / f64::from(f.levels))).collect();
            let plane = &f.intensity.0[c];
            Plane::from_fn(w, h, |x, y| {
                let mut sum = 0.0;
                for j in 0..divisor {
                    let row = (top + y * divisor + j) * width + left + x * divisor;
                    for &z in &plane.data[row..row + divisor] {
                        if z >= 1.0 {
                            return 1.0;
                        }
                        sum += inverse[(z * f.levels as f32).round() as usize];
                    }
                }
                forward(&curve, sum / (divisor * divisor) as f64) as f32
            })
        }));
        Frame {
            name: f.name.clone(),
            intensity,
            levels: (f.levels * divisor as u32).min(65535),
            chroma_subsampled: f.chroma_subsampled && divisor == 1,
            lossy: f.lossy,
            speed: f.speed,
            exposure_time: f.exposure_time,
        }
    });
    Bracket::new(frames.collect())
}

/// f(x) from its inverse at equal steps: below 1, since nothing that it is asked for is clipped.
fn forward(inverse: &[f64], x: f64) -> f64 {
    let i = inverse.partition_point(|&v| v <= x).clamp(1, inverse.len() - 1);
    let (a, b) = (inverse[i - 1], inverse[i]);
    let part = if b > a { ((x - a) / (b - a)).clamp(0.0, 1.0) } else { 0.0 };
    ((i - 1) as f64 + part) / (inverse.len() - 1) as f64
}
