//! The camera: frames from a scene and the poses that it went through, with shot and read noise, clipping, response and
//! 8-bit quantisation.

use super::random::Random;
use super::scene::Scene;
use super::shake::{Tremor, identity};
use crate::error::Result;
use crate::exposure::{Bracket, Frame};
use crate::image::{Plane, Rgb};
use crate::response::Response;
use crate::tsf::Tsf;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Sensor and response.
#[derive(Clone, Debug)]
pub struct Camera {
    /// Electrons at white.
    pub full_well: f64,
    /// Standard deviation of the read noise, electrons.
    pub read_noise: f64,
    /// Response f; its inverse places the thresholds between the 8-bit codes.
    pub response: Response,
}

impl Default for Camera {
    /// A small sensor: 4000 e-, 8 e-, sRGB.
    fn default() -> Self {
        Self { full_well: 4000.0, read_noise: 8.0, response: Response::Srgb }
    }
}

impl Camera {
    /// The frame that this camera makes of `irradiance` (1 is white after 1 s) in `exposure_time` seconds.
    pub fn photograph(&self, name: &str, irradiance: &Rgb, exposure_time: f64, seed: u64, stream: u64) -> Frame {
        let planes = std::array::from_fn(|c| {
            // Z = k/255 between the thresholds f⁻¹((k ± 1/2)/255), so that the response needs its inverse only.
            let thresholds: Vec<f64> = (0..255).map(|k| self.response.inverse(c, (f64::from(k) + 0.5) / 255.0)).collect();
            let plane = &irradiance.0[c];
            let data: Vec<f32> = (0..plane.height)
                .into_par_iter()
                .flat_map_iter(|y| {
                    let mut random = Random::new(seed, ((stream * 3 + c as u64) << 32) | y as u64);
                    let thresholds = &thresholds;
                    (0..plane.width).map(move |x| {
                        // Far above white only "clipped" matters.
                        let electrons = (f64::from(plane.at(x, y)) * exposure_time).clamp(0.0, 50.0) * self.full_well;
                        let signal = random.poisson(electrons) + self.read_noise * random.normal();
                        let exposure = (signal / self.full_well).clamp(0.0, 1.0);
                        thresholds.partition_point(|&t| t <= exposure) as f32 / 255.0
                    })
                })
                .collect();
            Plane { width: plane.width, height: plane.height, data }
        });
        Frame { name: name.into(), intensity: Rgb(planes), levels: 255, exposure_time }
    }
}

/// A bracket and everything that an estimator would have to find.
pub struct SyntheticBracket {
    /// The frames, `frame1.png` and so on.
    pub bracket: Bracket,
    /// The latent irradiance on the reference grid: 1 is white after 1 s.
    pub truth: Rgb,
    /// The TSF of each frame; the sharp frames' are the identity.
    pub tsfs: Vec<Tsf>,
    /// Which frames are sharp.
    pub sharp: Vec<bool>,
}

/// Photographs `scene` once per entry of `frames`: an exposure time in seconds and the tremor during it, `None` on a tripod.
/// The scene is lit so that its median luminance is `median` of white after 1 s.
///
/// # Errors
/// Those of [`Bracket::new`] and [`Tremor::tsf`].
pub fn capture(scene: &Scene, camera: &Camera, frames: &[(f64, Option<Tremor>)], median: f64, seed: u64) -> Result<SyntheticBracket> {
    let (width, height) = scene.frame_size();
    let still = expose(scene, &identity(width));
    let mut levels = still.mean().data;
    let middle = levels.len() / 2;
    let gain = median as f32 / levels.select_nth_unstable_by(middle, f32::total_cmp).1.max(f32::MIN_POSITIVE);
    let scaled = |image: &Rgb| image.map_planes(|p| p.map(|v| v * gain));
    let truth = scaled(&still);
    let (mut out, mut tsfs) = (Vec::new(), Vec::new());
    for (i, (time, tremor)) in frames.iter().enumerate() {
        let name = format!("frame{}.png", i + 1);
        let stream = i as u64 + 1;
        let tsf = match tremor {
            Some(t) => t.tsf(width, height, *time, seed, stream)?,
            None => identity(width),
        };
        let blurred = tremor.as_ref().map(|_| scaled(&expose(scene, &tsf)));
        out.push(camera.photograph(&name, blurred.as_ref().unwrap_or(&truth), *time, seed, stream));
        tsfs.push(tsf);
    }
    Ok(SyntheticBracket { bracket: Bracket::new(out)?, truth, tsfs, sharp: frames.iter().map(|f| f.1.is_none()).collect() })
}

/// The scene averaged over the poses of `tsf`: what the sensor integrates, without noise, in the scene's own units.
///
/// A pixel integrates a 1 px box, which turns with the scene (the roll is a degree or two; the difference to a box fixed on the
/// sensor is of second order in the angle). Box and interpolation commute, so the 2x samples are box-filtered once and each
/// pose costs one bilinear sample per pixel.
pub fn expose(scene: &Scene, tsf: &Tsf) -> Rgb {
    let (width, height) = scene.frame_size();
    let (sw, sh) = scene.samples.size();
    let boxed: Vec<[f32; 4]> = (0..sh)
        .into_par_iter()
        .flat_map_iter(|y| {
            let below = (y + 1).min(sh - 1);
            (0..sw).map(move |x| {
                let right = (x + 1).min(sw - 1);
                let mean = |p: &Plane| 0.25 * (p.at(x, y) + p.at(right, y) + p.at(x, below) + p.at(right, below));
                let [r, g, b] = &scene.samples.0;
                [mean(r), mean(g), mean(b), 0.0]
            })
        })
        .collect();
    let centre = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let last = ((sw - 2) as f64, (sh - 2) as f64);
    let to_scene: Vec<_> = tsf.poses.iter().map(|p| (p.homography(tsf.focal_px).inverse(), p.weight as f32)).collect();
    let mut pixels = vec![[0f32; 4]; width * height];
    pixels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (h, weight) in &to_scene {
            // Homogeneous sample position of the row's first pixel and its step per pixel. Sample 2k and 2k + 1 make pixel k,
            // so the boxed sample at 2k is the pixel itself.
            let origin = 2.0 * DVec2::new(centre.0 + scene.margin as f64, centre.1 + scene.margin as f64);
            let to_samples = |q: DVec3| DVec3::new(2.0 * q.x + origin.x * q.z, 2.0 * q.y + origin.y * q.z, q.z);
            let first = to_samples(*h * DVec3::new(-centre.0, y as f64 - centre.1, 1.0));
            let step = to_samples(h.x_axis);
            let flat = step.z == 0.0;
            for (x, out) in row.iter_mut().enumerate() {
                let q = first + step * x as f64;
                let q = if flat { q.truncate() / first.z } else { q.truncate() / q.z };
                let (u, v) = (q.x.clamp(0.0, last.0), q.y.clamp(0.0, last.1));
                let (i, j) = (u as u32 as usize, v as u32 as usize);
                let (a, b) = ((u - i as f64) as f32, (v - j as f64) as f32);
                let at = j * sw + i;
                let (p, q) = (&boxed[at..at + 2], &boxed[at + sw..at + sw + 2]);
                let w = [(1.0 - a) * (1.0 - b) * weight, a * (1.0 - b) * weight, (1.0 - a) * b * weight, a * b * weight];
                for c in 0..4 {
                    out[c] += w[0] * p[0][c] + w[1] * p[1][c] + w[2] * q[0][c] + w[3] * q[1][c];
                }
            }
        }
    });
    Rgb(std::array::from_fn(|c| Plane { width, height, data: pixels.iter().map(|p| p[c]).collect() }))
}
