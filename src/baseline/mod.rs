//! What a photographer would do instead of deblurring all frames together: the plain weighted merge, exposure fusion, and each frame
//! deblurred by itself.

mod mertens;
mod naive;

pub use mertens::{fuse, fuse_images};
pub use naive::deblur_each;

use crate::exposure::Bracket;
use crate::image::{Plane, Rgb};
use crate::response::Response;

/// Weighted mean of the frames' irradiances (P. Debevec and J. Malik, "Recovering High Dynamic Range Radiance Maps from
/// Photographs", 1997, eq. 6, without the logarithm), each weighted by its exposure time and a hat over its largest channel; in
/// irradiance per second. `frames` (0-based) chooses which frames take part. What all of them clip is taken from the shortest, what is
/// black in all from the longest.
///
/// # Panics
/// When `frames` is empty or names a frame that the bracket does not have.
pub fn merge(bracket: &Bracket, response: &Response, frames: &[usize]) -> Rgb {
    let chosen: Vec<_> = frames.iter().map(|&i| &bracket.frames()[i]).collect();
    let shortest = bracket.shortest(frames).expect("frames to merge");
    let longest = bracket.longest(frames).expect("frames to merge");
    let (width, height) = bracket.size();
    let mut out = Rgb(std::array::from_fn(|_| Plane::filled(width, height, 0.0)));
    for i in 0..width * height {
        let (mut sum, mut total) = ([0f64; 3], 0f64);
        for (frame, &number) in chosen.iter().zip(frames) {
            let z = frame.intensity.pixel(i);
            let level = z.into_iter().fold(0.0, f32::max);
            let weight = if level >= 1.0 {
                if number == shortest { 1e-9 } else { 0.0 }
            } else if level <= 0.0 {
                if number == longest { 1e-9 } else { 0.0 }
            } else {
                f64::from((4.0 * level.min(1.0 - level)).clamp(1e-3, 1.0)) * frame.exposure_time
            };
            for (c, sum) in sum.iter_mut().enumerate() {
                *sum += weight * response.inverse(c, f64::from(z[c])) / frame.exposure_time;
            }
            total += weight;
        }
        for (plane, sum) in out.0.iter_mut().zip(sum) {
            plane.data[i] = (sum / total.max(1e-30)) as f32;
        }
    }
    out
}
