//! Gain and black offset of each frame on input whose answer is planted.

use crate::support::noise as numbers;
use glam::{DMat3, DVec2};
use unshaken::exposure::Frame;
use unshaken::image::{Plane, Rgb};
use unshaken::noise::{self, NoiseModel};
use unshaken::photometry::photometry;
use unshaken::response::Response;

const SIZE: (usize, usize) = (240, 180);
const NOISE: NoiseModel = NoiseModel { shot: 1.0 / 8000.0, read: 1e-6 };

/// Light of a slow scene with some texture, up to about 1 after 1 s, at a place in centred pixels.
fn light(p: DVec2, c: usize) -> f64 {
    let slow = (0.02 * p.x + 0.7 * c as f64).sin() + (0.027 * p.y - 0.011 * p.x).sin();
    0.12 * (0.9 * slow + 0.1 * (0.9 * p.x).sin() * (0.7 * p.y).sin()).exp()
}

/// A frame of linear 16-bit values whose content lies at `motion`; `changed`: what becomes of the exposure of a channel.
fn frame(exposure_time: f64, motion: DVec2, seed: u64, changed: impl Fn(usize, f64) -> f64 + Sync) -> Frame {
    let half = 0.5 * DVec2::new(SIZE.0 as f64 - 1.0, SIZE.1 as f64 - 1.0);
    let plane = |c: usize| {
        let n = numbers(seed + c as u64, SIZE.0 * SIZE.1);
        Plane::from_fn(SIZE.0, SIZE.1, |x, y| {
            let e = changed(c, exposure_time * light(DVec2::new(x as f64, y as f64) - half - motion, c));
            let noisy = e + (3.0 * NOISE.variance(e)).sqrt() * f64::from(n[y * SIZE.0 + x]);
            ((noisy.clamp(0.0, 1.0) * 65535.0).round() / 65535.0) as f32
        })
    };
    Frame {
        name: format!("{exposure_time}"),
        intensity: Rgb(std::array::from_fn(plane)),
        levels: 65535,
        chroma_subsampled: false,
        lossy: false,
        speed: None,
        exposure_time,
    }
}

/// The channel in which the short frame differs: by a gain of 1.10 and a black offset of 0.003.
const CHANGED: usize = 1;

#[test]
fn gain_and_black_offset_of_a_channel_are_found_between_displaced_frames() {
    let places = [DVec2::ZERO, DVec2::new(7.0, -4.0)];
    let frames = [frame(0.25, places[0], 10, |c, e| if c == CHANGED { 1.1 * e + 0.003 } else { e }), frame(1.0, places[1], 20, |_, e| e)];
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
    let motions = places.map(DMat3::from_translation);
    let found = photometry(&frames, &exposures, &noise::alike(2, NOISE), &[0, 1], &motions);
    println!("{found:?}");
    for c in 0..3 {
        let (gain, offset) = if c == CHANGED { (1.1, 0.003) } else { (1.0, 0.0) };
        // Two frames tell gain and offset of one beside the other: what both have in common cannot be seen.
        let between = found[0].gain[c] / found[1].gain[c];
        let beside = found[0].offset[c] - 0.25 * between * found[1].offset[c];
        assert!((between / gain - 1.0).abs() < 0.02, "channel {c}: a gain of {between:.4}, planted {gain}");
        assert!((beside - offset).abs() < 8e-4, "channel {c}: an offset of {beside:.5}, planted {offset}");
    }
    // Corrected, the frames show the same light.
    let long = noise::exposure(&frame(1.0, places[0], 20, |_, e| e), &Response::Linear);
    let corrected = [found[0].corrected(&exposures[0]), found[1].corrected(&long)];
    let [short, long] = corrected.map(|e| e.0[CHANGED].data.iter().map(|v| f64::from(*v)).sum::<f64>());
    let ratio = short / (0.25 * long);
    println!("{ratio:.4} of the light");
    assert!((ratio - 1.0).abs() < 0.02, "{ratio:.4} of the light");
}

/// One frame alone, and frames of which none was asked for, are as noted.
#[test]
fn a_frame_alone_is_as_noted() {
    use unshaken::photometry::FramePhotometry;
    let frames = [frame(0.25, DVec2::ZERO, 10, |_, e| 1.2 * e), frame(1.0, DVec2::ZERO, 20, |_, e| e)];
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
    for ids in [&[][..], &[0], &[1]] {
        let found = photometry(&frames, &exposures, &noise::alike(2, NOISE), ids, &[DMat3::IDENTITY; 2]);
        assert_eq!(found, [FramePhotometry::AS_NOTED; 2]);
    }
}
