//! The camera: frames from a scene and the poses that it went through, with shot and read noise, clipping, response and
//! quantisation.

use super::motion::Motion;
use super::scene::Scene;
use super::shake::{Tremor, identity};
use crate::error::Result;
use crate::exposure::{Bracket, Frame};
use crate::image::{Plane, Rgb};
use crate::random::Random;
use crate::response::Response;
use crate::tsf::Tsf;
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Sensor and response.
#[derive(Clone, Debug)]
pub struct Camera {
    /// Electrons at white.
    pub full_well: f64,
    /// Standard deviation of the read noise, electrons.
    pub read_noise: f64,
    /// Response f; its inverse places the thresholds between the codes.
    pub response: Response,
    /// Bits of an intensity code, 8 to 16.
    pub bits: u32,
}

impl Default for Camera {
    /// A small sensor: 4000 e-, 8 e-, sRGB, 8 bits.
    fn default() -> Self {
        Self { full_well: 4000.0, read_noise: 8.0, response: Response::Srgb, bits: 8 }
    }
}

impl Camera {
    /// The frame that this camera makes of `irradiance` (1 is white after 1 s) in `exposure_time` seconds.
    pub fn photograph(&self, name: &str, irradiance: &Rgb, exposure_time: f64, seed: u64, stream: u64) -> Frame {
        let levels = (1u32 << self.bits.clamp(8, 16)) - 1;
        let planes = std::array::from_fn(|c| {
            // Z = k/L between the thresholds f⁻¹((k ± 1/2)/L), so that the response needs its inverse only.
            let at = |k: u32| self.response.inverse(c, (f64::from(k) + 0.5) / f64::from(levels));
            let thresholds: Vec<f64> = (0..levels).map(at).collect();
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
                        thresholds.partition_point(|&t| t <= exposure) as f32 / levels as f32
                    })
                })
                .collect();
            Plane { width: plane.width, height: plane.height, data }
        });
        Frame { name: name.into(), intensity: Rgb(planes), levels, chroma_subsampled: false, lossy: false, speed: None, exposure_time }
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
    let motion = |(i, (time, tremor)): (usize, &(f64, Option<Tremor>))| -> Result<(f64, Motion)> {
        let tsf = match tremor {
            Some(t) => t.tsf(width, height, *time, seed, i as u64 + 1)?,
            None => identity(width),
        };
        Ok((*time, Motion::new(tsf, tremor.is_some())))
    };
    let frames = frames.iter().enumerate().map(motion).collect::<Result<Vec<_>>>()?;
    Ok(photograph(scene, camera, &frames, median, seed, false)?.0)
}

/// Photographs `scene` once per entry of `frames`: an exposure time in seconds and the camera's motion during it. As [`capture()`]
/// otherwise. With `tripod` also the frames that a camera that did not move would have taken, with noise of their own.
///
/// # Errors
/// Those of [`Bracket::new`], and a scene that is black where the frame looks.
pub fn photograph(
    scene: &Scene,
    camera: &Camera,
    frames: &[(f64, Motion)],
    median: f64,
    seed: u64,
    tripod: bool,
) -> Result<(SyntheticBracket, Option<Bracket>)> {
    let (width, _) = scene.frame_size();
    let still = expose(scene, &identity(width));
    let mut levels = still.mean().data;
    let middle = levels.len() / 2;
    let gain = median as f32 / levels.select_nth_unstable_by(middle, f32::total_cmp).1.max(f32::MIN_POSITIVE);
    let scaled = |image: &Rgb| image.map_planes(|p| p.map(|v| v * gain));
    let truth = scaled(&still);
    let (mut out, mut tsfs, mut steady) = (Vec::new(), Vec::new(), Vec::new());
    for (i, (time, motion)) in frames.iter().enumerate() {
        let name = format!("frame{}.png", i + 1);
        let stream = i as u64 + 1;
        let moved = !motion.tsf.is_identity();
        let seen = moved.then(|| scaled(&integrate(scene, &motion.homographies())));
        out.push(camera.photograph(&name, seen.as_ref().unwrap_or(&truth), *time, seed, stream));
        tsfs.push(motion.tsf.clone());
        if tripod {
            steady.push(camera.photograph(&format!("tripod{}.png", i + 1), &truth, *time, seed, TRIPOD_STREAMS + stream));
        }
    }
    let sharp = frames.iter().map(|f| !f.1.shaken).collect();
    let steady = if tripod { Some(Bracket::new(steady)?) } else { None };
    Ok((SyntheticBracket { bracket: Bracket::new(out)?, truth, tsfs, sharp }, steady))
}

/// First stream of the tripod frames' noise, beyond those of any bracket's frames.
const TRIPOD_STREAMS: u64 = 1 << 20;

/// The scene averaged over the poses of `tsf`: what the sensor integrates, without noise, in the scene's own units.
pub fn expose(scene: &Scene, tsf: &Tsf) -> Rgb {
    let poses: Vec<_> = tsf.poses.iter().map(|p| (p.homography(tsf.focal_px) * tsf.base, p.weight)).collect();
    integrate(scene, &poses)
}

/// The scene averaged over `poses`: homographies frame ← scene in centred pixels, and weights. No noise, the scene's own units.
///
/// A pixel integrates a 1 px box, which turns with the scene (the roll is a degree or two; the difference to a box fixed on the
/// sensor is of second order in the angle). Box and interpolation commute, so the samples are box-filtered once and each
/// pose costs one bilinear sample per pixel.
pub fn integrate(scene: &Scene, poses: &[(DMat3, f64)]) -> Rgb {
    let (width, height) = scene.frame_size();
    let (sw, sh) = scene.samples.size();
    let n = scene.oversampling;
    let boxed = boxed(scene);
    let centre = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let last = ((sw - n) as f64, (sh - n) as f64);
    let to_scene: Vec<_> = poses.iter().map(|(h, weight)| (h.inverse(), *weight as f32)).collect();
    let mut pixels = vec![[0f32; 4]; width * height];
    let k = n as f64;
    pixels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (h, weight) in &to_scene {
            // Homogeneous sample position of the row's first pixel and its step per pixel. Samples n k to n k + n - 1 make pixel k,
            // so the boxed sample at n k is the pixel itself.
            let origin = k * DVec2::new(centre.0 + scene.margin as f64, centre.1 + scene.margin as f64);
            let to_samples = |q: DVec3| DVec3::new(k * q.x + origin.x * q.z, k * q.y + origin.y * q.z, q.z);
            let first = to_samples(*h * DVec3::new(-centre.0, y as f64 - centre.1, 1.0));
            let step = to_samples(h.x_axis);
            let flat = step.z == 0.0;
            for (x, out) in row.iter_mut().enumerate() {
                let q = first + step * x as f64;
                let q = if flat { q.truncate() / first.z } else { q.truncate() / q.z };
                let (u, v) = (q.x.clamp(0.0, last.0), q.y.clamp(0.0, last.1));
                let (i, j) = ((u as usize).min(sw - 2), (v as usize).min(sh - 2));
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

/// Means over the pixel-sized square whose first sample is (x, y), for each sample.
fn boxed(scene: &Scene) -> Vec<[f32; 4]> {
    let (sw, sh) = scene.samples.size();
    let n = scene.oversampling;
    (0..sh)
        .into_par_iter()
        .flat_map_iter(|y| {
            (0..sw).map(move |x| {
                let mut sum = [0f32; 4];
                for j in y..y + n {
                    for i in x..x + n {
                        let at = j.min(sh - 1) * sw + i.min(sw - 1);
                        for (sum, plane) in sum.iter_mut().zip(&scene.samples.0) {
                            *sum += plane.data[at];
                        }
                    }
                }
                sum.map(|v| v / (n * n) as f32)
            })
        })
        .collect()
}
