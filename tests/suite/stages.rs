//! The estimators, each on input whose answer is planted.

use crate::support::noise as numbers;
use crate::support::texture;
use glam::{DMat3, DVec2};
use unshaken::channels;
use unshaken::exposure::Frame;
use unshaken::image::{Channels, Plane, Rgb};
use unshaken::mask;
use unshaken::noise;
use unshaken::pose::{Pose, PoseGrid};
use unshaken::psf::{self, Patch, Psf};
use unshaken::response::Response;
use unshaken::synth::{self, Camera, Drawn, Tremor};
use unshaken::triage;
use unshaken::tsf::{self, Tsf};

const SIZE: (usize, usize) = (128, 96);

fn planted(poses: &[(f64, f64, f64, f64)]) -> Tsf {
    Tsf::new(1.2 * SIZE.0 as f64, poses.iter().map(|p| Pose::planar(p.0, p.1, p.2, p.3)).collect()).unwrap()
}

/// `count` sums of twelve uniforms of variance 1/3: standard normal times 2.
fn twelve(seed: u64, count: usize) -> Vec<f32> {
    (0..12).map(|k| numbers(seed + k, count)).fold(vec![0.0; count], |s, v| s.iter().zip(&v).map(|(a, b)| a + b).collect())
}

#[test]
fn the_noise_level_is_found_within_a_fifth() {
    // Flat fields with shot and read noise beside hard texture, which must not pass for noise.
    for (full_well, read_noise) in [(2000.0, 6.0), (8000.0, 5.0), (30000.0, 12.0)] {
        let truth = noise::NoiseModel::from_electrons(full_well, read_noise);
        let (w, h) = (256, 256);
        let n = twelve(100, w * h);
        let value = |x: usize, y: usize| {
            let level = 0.01 + 0.8 * ((x / 16) as f64 / 16.0).powi(2);
            if (y / 64) % 2 == 1 { level * if (x + y).is_multiple_of(2) { 0.8 } else { 1.1 } } else { level }
        };
        let plane = Plane::from_fn(w, h, |x, y| {
            let e = value(x, y);
            let z = e + truth.variance(e).sqrt() * f64::from(n[y * w + x]) / 2.0;
            (z.clamp(0.0, 1.0) * 65535.0).round() as f32 / 65535.0
        });
        let frame = Frame {
            name: "flat".into(),
            intensity: Rgb([plane.clone(), plane.clone(), plane]),
            levels: 65535,
            chroma_subsampled: false,
            lossy: false,
            exposure_time: 1.0,
        };
        let exposure = noise::exposure(&frame, &Response::Linear);
        let found = noise::estimate(&[frame], &[exposure], &Response::Linear);
        for x in [0.02, 0.1, 0.5] {
            let ratio = found.variance(x) / truth.variance(x);
            assert!((0.8..1.2).contains(&ratio), "{full_well} e-, {read_noise} e-: variance at {x} is {ratio:.2} times the truth");
        }
    }
}

#[test]
fn texture_that_two_frames_share_is_no_noise() {
    // Texture everywhere, which no frame alone tells from noise.
    let truth = noise::NoiseModel::from_electrons(4000.0, 8.0);
    let (w, h) = (256, 192);
    let grain = numbers(7, w * h);
    let frame = |exposure_time: f64, seed: u64| {
        let n = twelve(seed, w * h);
        let plane = Plane::from_fn(w, h, |x, y| {
            let level = 0.02 + 0.5 * ((x / 16) as f64 / 16.0).powi(2);
            let e = exposure_time * level * (1.0 + 0.3 * f64::from(grain[y * w + x]));
            let z = e + truth.variance(e).sqrt() * f64::from(n[y * w + x]) / 2.0;
            (z.clamp(0.0, 1.0) * 65535.0).round() as f32 / 65535.0
        });
        Frame {
            name: "grain".into(),
            intensity: Rgb([plane.clone(), plane.clone(), plane]),
            levels: 65535,
            chroma_subsampled: false,
            lossy: false,
            exposure_time,
        }
    };
    let frames = [frame(1.0, 300), frame(0.4, 400)];
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
    let found = noise::estimate(&frames, &exposures, &Response::Linear);
    for x in [0.02, 0.1, 0.3] {
        let ratio = found.variance(x) / truth.variance(x);
        assert!((0.8..1.2).contains(&ratio), "variance at {x} is {ratio:.2} times the truth");
    }
}

#[test]
fn texture_that_most_blocks_show_is_no_noise() {
    // Bright texture nearly everywhere: blocks of single frames outnumber those of the difference, which shows none.
    let truth = noise::NoiseModel::from_electrons(4000.0, 8.0);
    let (w, h) = (360, 240);
    let grain = numbers(8, w * h);
    let frame = |exposure_time: f64, seed: u64| {
        let plane = |c: u64| {
            let n = twelve(seed + 20 * c, w * h);
            Plane::from_fn(w, h, |x, y| {
                let level = (0.02 + 0.9 * (x as f64 / w as f64).sqrt()) * (1.0 + 0.12 * f64::from(grain[y * w + x]));
                let e = exposure_time * level;
                let z = e + truth.variance(e).sqrt() * f64::from(n[y * w + x]) / 2.0;
                (z.clamp(0.0, 1.0) * 65535.0).round() as f32 / 65535.0
            })
        };
        Frame {
            name: "grain".into(),
            intensity: Rgb([plane(0), plane(1), plane(2)]),
            levels: 65535,
            chroma_subsampled: false,
            lossy: false,
            exposure_time,
        }
    };
    let frames = [frame(1.0, 1000), frame(0.1, 2000)];
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
    let found = noise::estimate(&frames, &exposures, &Response::Linear);
    let ratios = [0.002, 0.02, 0.1, 0.3].map(|x| found.variance(x) / truth.variance(x));
    // Next to black only the few blocks of the difference tell the read noise.
    assert!(ratios[0] > 0.6 && ratios[1..].iter().all(|r| (0.8..1.2).contains(r)), "{ratios:.2?} times the true variance");
}

/// The frame that shows `picture`, which was a JPEG file of this `quality` if one is given.
fn through_jpeg(picture: &image::RgbImage, quality: Option<u8>, exposure_time: f64) -> Frame {
    let decoded = quality.map(|quality| {
        let mut file = Vec::new();
        picture.write_with_encoder(image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, quality)).expect("encodes");
        image::load_from_memory(&file).expect("decodes").to_rgb8()
    });
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    let picture = decoded.as_ref().unwrap_or(picture);
    let plane = |c: usize| Plane::from_fn(w, h, |x, y| f32::from(picture.get_pixel(x as u32, y as u32).0[c]) / 255.0);
    Frame {
        name: "grey".into(),
        intensity: Rgb([plane(0), plane(1), plane(2)]),
        levels: 255,
        chroma_subsampled: false,
        lossy: quality.is_some(),
        exposure_time,
    }
}

#[test]
fn noise_that_jpeg_has_smoothed_is_found_by_the_means_of_squares() {
    struct Film {
        noise: noise::NoiseModel,
        gamma: f64,
        dark: f64,
    }
    let day = Film { noise: noise::NoiseModel::from_electrons(1000.0, 6.0), gamma: 1.0, dark: 0.85 };
    let night = Film { noise: noise::NoiseModel::from_electrons(3000.0, 4.0), gamma: 2.2, dark: 0.4 };
    let (w, h) = (320, 240);
    // What both frames show: steps of 5 pixels, too fine for a square to be without.
    let level = |x: f64, y: f64, dark: f64| {
        let step = ((x / 5.0).floor() + (y / 5.0).floor()) as i64;
        (0.06 + 0.5 * (x / w as f64).powi(2)) * if step % 2 == 0 { 1.0 } else { dark }
    };
    // Means over the pixels, `moved` by some.
    let frame = |exposure_time: f64, seed: u64, quality: Option<u8>, moved: (f64, f64), camera: &Film| {
        let n = twelve(seed, 3 * w * h);
        let inside = |x: usize, y: usize| {
            let parts = [0.125, 0.375, 0.625, 0.875]
                .map(|v| [0.125, 0.375, 0.625, 0.875].map(|u| (x as f64 + u - moved.0, y as f64 + v - moved.1)));
            parts.as_flattened().iter().map(|&(x, y)| level(x, y, camera.dark)).sum::<f64>() / 16.0
        };
        let coded = |c: usize, x: usize, y: usize| {
            let e = exposure_time * inside(x, y);
            let z = e + camera.noise.variance(e).sqrt() * f64::from(n[3 * (y * w + x) + c]) / 2.0;
            (z.clamp(0.0, 1.0).powf(1.0 / camera.gamma) * 255.0).round() as u8
        };
        let picture = image::RgbImage::from_fn(w as u32, h as u32, |x, y| image::Rgb([0, 1, 2].map(|c| coded(c, x as usize, y as usize))));
        through_jpeg(&picture, quality, exposure_time)
    };
    for (quality, smoothed) in [(Some(75), true), (Some(90), true), (None, false)] {
        let frames = [frame(0.4, 500, quality, (0.0, 0.0), &day), frame(1.0, 600, quality, (0.0, 0.0), &day)];
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
        let first = noise::estimate(&frames, &exposures, &Response::Linear);
        let still = [DMat3::IDENTITY; 2];
        let again = noise::of_squares(&frames, &exposures, &Response::Linear, &[1, 0], &still, true, &first);
        let ratio = |model: &noise::NoiseModel| model.variance(0.1) / day.noise.variance(0.1);
        assert_eq!(again.is_some(), smoothed, "{quality:?}: {:.2} -> {:?}", ratio(&first), again.map(|m| ratio(&m)));
        if let Some(again) = again {
            assert!(ratio(&first) < 0.6, "{quality:?}: {:.2}", ratio(&first));
            assert!((0.8..1.8).contains(&ratio(&again)), "{quality:?}: {:.2}", ratio(&again));
        }
        assert_eq!(
            noise::of_squares(&frames, &exposures, &Response::Linear, &[0], &still, true, &first),
            None,
            "one frame has no difference"
        );
    }
    // In the dark of displaced frames as well, where they lie, and nowhere else.
    let (moved, gamma) = ((3.4, -2.7), Response::Gamma(night.gamma));
    let frames = [frame(0.2, 500, Some(90), (0.0, 0.0), &night), frame(0.8, 600, Some(90), moved, &night)];
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &gamma)).collect();
    let first = noise::NoiseModel { shot: 0.4 * night.noise.shot, read: 0.4 * night.noise.read };
    let found = [moved, (0.0, 0.0)].map(|(x, y)| {
        let motions = [DMat3::IDENTITY, DMat3::from_translation(DVec2::new(x, y))];
        let again = noise::of_squares(&frames, &exposures, &gamma, &[0, 1], &motions, true, &first);
        again.map(|m| m.variance(0.015) / night.noise.variance(0.015))
    });
    let none = noise::NoiseModel { shot: 1e-4 * night.noise.shot, read: 1e-4 * night.noise.read };
    let motions = [DMat3::IDENTITY, DMat3::from_translation(DVec2::new(moved.0, moved.1))];
    let limited =
        noise::of_squares(&frames, &exposures, &gamma, &[0, 1], &motions, true, &none).map(|m| m.variance(0.015) / none.variance(0.015));
    assert!(limited.is_some_and(|r| (r - 50.0).abs() < 1e-6), "{limited:.2?}: no format takes so much of the noise, something moved");
    assert!(found[0].is_some_and(|r| (0.8..1.5).contains(&r)), "{found:.2?}");
    assert!(found[1].is_some_and(|r| r > 2.0), "{found:.2?}: beside each other they show different things");
}

#[test]
fn masks_fall_towards_clipping_and_vanish_where_a_channel_clips() {
    for (z, expected) in [(0.0, 0.0), (0.075, 0.5), (0.15, 1.0), (0.5, 1.0), (0.85, 1.0), (0.925, 0.5), (1.0, 0.0)] {
        assert!((mask::tukey(z, 0.3) - expected).abs() < 1e-5, "Tukey window at {z}: {}", mask::tukey(z, 0.3));
    }
    let frame = |rgb: [f32; 3], exposure_time: f64| Frame {
        name: "one".into(),
        intensity: Rgb(rgb.map(|v| Plane::filled(1, 1, v))),
        levels: 255,
        chroma_subsampled: false,
        lossy: false,
        exposure_time,
    };
    let one = |frames: &[Frame], sharp: &[bool]| {
        mask::masks(frames, sharp, 0.3, &vec![DMat3::IDENTITY; frames.len()], Channels::ALL).iter().map(|m| m.data[0]).collect::<Vec<f32>>()
    };
    // A clipped red has a grey of 0.3, in the flat part of the window.
    assert_eq!(one(&[frame([1.0, 0.0, 0.0], 1.0)], &[true]), [0.0]);
    // The low taper applies only where a longer frame, at least as sharp, covers the pixel well.
    let (dark, longer) = (frame([0.05; 3], 0.1), frame([0.4; 3], 1.0));
    assert!(one(&[dark.clone(), longer.clone()], &[true, true])[0] < 0.5);
    assert_eq!(one(&[dark.clone(), longer], &[true, false]), [1.0, 1.0]);
    assert_eq!(one(&[dark, frame([1.0; 3], 1.0)], &[true, true]), [1.0, 0.0]);

    // Covered is judged where the longer frame has the same point of the scene: here one pixel to the right.
    let row = |values: [f32; 3], exposure_time| Frame {
        intensity: Rgb([(); 3].map(|()| Plane { width: 3, height: 1, data: values.to_vec() })),
        ..frame([0.0; 3], exposure_time)
    };
    let motions = [DMat3::IDENTITY, DMat3::from_translation(glam::DVec2::new(1.0, 0.0))];
    let found = mask::masks(&[row([0.05; 3], 0.1), row([0.0, 0.4, 0.0], 1.0)], &[true, true], 0.3, &motions, Channels::ALL);
    assert!(found[0].data[0] < 0.5 && found[0].data[1..] == [1.0, 1.0], "{found:?}");
}

#[test]
fn what_is_clipped_in_some_channels_counts_by_the_grey_of_all() {
    let pixels = [[0.5, 0.5, 0.5], [1.0, 0.5, 0.5], [1.0, 1.0, 0.5], [1.0; 3], [0.0; 3], [1.0, 0.99, 0.2]];
    let intensity = Rgb([0, 1, 2].map(|c| Plane { width: pixels.len(), height: 1, data: pixels.iter().map(|p| p[c]).collect() }));
    let frame = Frame { name: "one".into(), intensity, levels: 255, chroma_subsampled: false, lossy: false, exposure_time: 1.0 };
    let mask = Plane { width: pixels.len(), height: 1, data: vec![0.8, 0.0, 0.0, 0.0, 0.0, 0.0] };
    let found = mask::with_partly_clipped(&mask, &frame, &mask::spoilt_channels(&frame), 0.3, |_| 0.5).data;
    // Greys of 0.65, 0.943 and 0.903: the first in the flat part of the window, the others 0.057 and 0.097 from its end.
    let taper = |z: f32| 0.5 * 0.5 * (1.0 - (2.0 * std::f32::consts::PI * z / 0.3).cos());
    for (got, expected) in found.iter().zip([0.8, 0.5, taper(0.057), 0.0, 0.0, taper(0.097)]) {
        assert!((got - expected).abs() < 1e-3, "{found:?}");
    }
}

/// Colour that is stored for squares of four pixels reaches to their neighbours.
#[test]
fn subsampled_colour_is_spoilt_beside_clipped_pixels() {
    let (w, h) = (9, 8);
    let lamp = Plane::from_fn(w, h, |x, y| if (x, y) == (3, 1) { 1.0 } else { 0.4 });
    let intensity = Rgb([lamp, Plane::filled(w, h, 0.4), Plane::filled(w, h, 0.4)]);
    let frame = |chroma_subsampled| Frame {
        name: "one".into(),
        intensity: intensity.clone(),
        levels: 255,
        chroma_subsampled,
        lossy: true,
        exposure_time: 1.0,
    };
    for (subsampled, reach) in [(false, 0), (true, 1)] {
        let found = mask::spoilt_channels(&frame(subsampled));
        for (p, red) in found[0].iter().enumerate() {
            assert_eq!(*red, (p % w).abs_diff(3).max((p / w).abs_diff(1)) <= reach, "{subsampled}: {} {}", p % w, p / w);
        }
        assert!(found[1..].iter().flatten().all(|c| !c));
        assert_eq!(found[0], mask::spoilt(&frame(subsampled), Channels::ALL));
        assert_eq!(mask::clipped(&frame(subsampled), Channels::ALL).iter().filter(|c| **c).count(), 1);
    }
}

#[test]
fn pixels_apart_from_what_is_lost_are_those_beyond_the_radius() {
    let (w, h) = (11, 7);
    let lost: Vec<bool> = (0..w * h).map(|p| p == 2 * w + 3 || p == 6 * w + 10).collect();
    for (p, apart) in mask::apart(&lost, (w, h), 2).into_iter().enumerate() {
        let (x, y) = ((p % w) as isize, (p / w) as isize);
        let far = |a: isize, b: isize| (x - a).abs().max((y - b).abs()) > 2;
        assert_eq!(apart, far(3, 2) && far(10, 6), "at {x}, {y}");
    }
}

#[test]
fn a_blur_is_looked_for_in_the_channels_that_tell_of_it() {
    let (w, h) = (120, 90);
    let grain = numbers(3, w * h);
    let level = noise::NoiseModel::from_electrons(4000.0, 8.0);
    // Texture in the colour `tint`; lamps of ten times its light over a twelfth of the picture.
    let bracket = |tint: [f32; 3], lamps: f32, times: [f64; 2]| -> Vec<Frame> {
        let frame = |exposure_time: f64| {
            let plane = |c: usize| {
                Plane::from_fn(w, h, |x, y| {
                    let lamp = if x % 30 < 10 && y % 30 < 8 { lamps } else { 1.0 };
                    let e = tint[c] * lamp * (1.0 + 0.6 * grain[(y / 3) * w + x / 3]);
                    (e * exposure_time as f32).min(1.0)
                })
            };
            Frame {
                name: "tinted".into(),
                intensity: Rgb([0, 1, 2].map(plane)),
                levels: 65535,
                chroma_subsampled: false,
                lossy: false,
                exposure_time,
            }
        };
        times.map(frame).to_vec()
    };
    let chosen = |frames: &[Frame], blurred: &[usize], by: &[usize]| {
        let exposures: Vec<Rgb> = frames.iter().map(|f| f.intensity.clone()).collect();
        channels::most_telling(frames, &exposures, blurred, by, &level).names()
    };
    let warm = [0.4, 0.2, 0.04];
    assert_eq!(chosen(&bracket(warm, 1.0, [0.5, 1.0]), &[0, 1], &[0, 1]), ["red", "green", "blue"], "nothing clips");
    // The long frame has its red and green clipped nearly everywhere.
    let long = bracket(warm, 1.0, [0.5, 8.0]);
    assert_eq!(chosen(&long, &[1], &[0]), ["blue"], "where the long frame alone is blurred");
    assert_eq!(chosen(&long, &[0], &[0, 1]), ["red", "green", "blue"], "the short one clips nothing");
    // Lamps whose red no frame knows, and little is far from them; blue is known everywhere.
    let lamps = bracket([0.3, 0.05, 0.05], 10.0, [1.0, 1.1]);
    assert_eq!(chosen(&lamps, &[0, 1], &[0, 1]), ["green", "blue"], "lamps of unknown red");
    // A file that holds colour coarsely blurs channels by themselves: one of them is looked at only where the mean of all shows next to nothing.
    let coarse = |frames: Vec<Frame>| -> Vec<Frame> { frames.into_iter().map(|f| Frame { chroma_subsampled: true, ..f }).collect() };
    assert_eq!(chosen(&coarse(lamps), &[0, 1], &[0, 1]), ["red", "green", "blue"], "lamps of unknown red, colour coarse");
    assert_eq!(chosen(&coarse(long), &[1], &[0]), ["blue"], "all but blue clipped, colour coarse");
}

#[test]
fn a_psf_is_found_from_a_patch_and_its_sharp_counterpart() {
    let e = texture(SIZE.0, SIZE.1);
    let taps = [(-4, 2, 0.2f32), (-2, 1, 0.3), (0, 0, 0.3), (3, -3, 0.2)];
    let blurred = Plane::from_fn(SIZE.0, SIZE.1, |x, y| taps.iter().map(|t| t.2 * e.clamped(x as isize - t.0, y as isize - t.1)).sum());
    let weight = Plane::filled(SIZE.0, SIZE.1, 1e4);
    let patch = Patch { x: 20, y: 16, size: 64, score: 1.0 };
    let h = psf::estimate(&e, 0, &blurred, &weight, &patch, 6).expect("texture determines it");
    assert!(h.values.data.iter().all(|v| *v >= 0.0));
    assert!((h.values.data.iter().sum::<f32>() - 1.0).abs() < 1e-5);
    for (dx, dy, w) in taps {
        let found = h.values.at((dx + 6) as usize, (dy + 6) as usize);
        assert!((found - w).abs() < 0.03, "h({dx}, {dy}) is {found}, planted {w}");
    }
    // Masked pixels have no say.
    let spoilt = Plane::from_fn(SIZE.0, SIZE.1, |x, y| if x % 9 == 0 { 50.0 } else { blurred.at(x, y) });
    let holes = Plane::from_fn(SIZE.0, SIZE.1, |x, _| if x % 9 == 0 { 0.0 } else { 1e4 });
    let g = psf::estimate(&e, 0, &spoilt, &holes, &patch, 6).expect("enough is left");
    assert!(g.values.data.iter().zip(&h.values.data).all(|(a, b)| (a - b).abs() < 0.03));
}

#[test]
fn patches_lie_where_there_is_structure_in_both_directions_and_are_spread() {
    // Left half flat, upper right stripes (one direction only), lower right texture.
    let t = texture(256, 256);
    let e = Plane::from_fn(256, 256, |x, y| match (x < 128, y < 128) {
        (true, _) => 2.0,
        (false, true) => 2.0 + (x % 8 / 4) as f32,
        (false, false) => t.at(x, y),
    });
    let chosen = psf::choose(&e, &Plane::filled(256, 256, 1.0), 48, 4);
    assert_eq!(chosen.len(), 4);
    assert!(chosen[0].x >= 96 && chosen[0].y >= 96, "{:?}", chosen[0]);
    for (i, a) in chosen.iter().enumerate() {
        for b in &chosen[..i] {
            assert!((a.x, a.y) != (b.x, b.y));
        }
    }
}

#[test]
fn the_tsf_of_exact_psfs_is_the_planted_one() {
    let truth = planted(&[(0.0, 0.0, 0.0, 0.4), (3.0, 1.0, 1.0, 0.3), (-2.0, 4.0, -1.0, 0.3)]);
    let grid = PoseGrid { radius: 6, angles_deg: vec![-1.0, -0.5, 0.0, 0.5, 1.0] };
    let centre = glam::DVec2::new((SIZE.0 as f64 - 1.0) / 2.0, (SIZE.1 as f64 - 1.0) / 2.0);
    let psfs: Vec<(Patch, Psf)> = [(0, 0), (96, 0), (0, 64), (96, 64), (48, 32)]
        .into_iter()
        .map(|(x, y)| {
            let patch = Patch { x, y, size: 32, score: 1.0 };
            let mut values = Plane::filled(19, 19, 0.0);
            for pose in &truth.poses {
                let p = glam::DVec2::new(patch.centre().0, patch.centre().1) - centre;
                let u = p - unshaken::pose::project(&pose.homography(truth.focal_px).inverse(), p);
                for (j, wy) in [(u.y.floor(), 1.0 - u.y.fract().rem_euclid(1.0)), (u.y.floor() + 1.0, u.y.rem_euclid(1.0))] {
                    for (i, wx) in [(u.x.floor(), 1.0 - u.x.rem_euclid(1.0)), (u.x.floor() + 1.0, u.x.rem_euclid(1.0))] {
                        values.data[(j + 9.0) as usize * 19 + (i + 9.0) as usize] += (pose.weight * wx * wy) as f32;
                    }
                }
            }
            (patch, Psf { radius: 9, values })
        })
        .collect();
    let found = tsf::from_psfs(&psfs, &grid, SIZE.0, SIZE.1).expect("poses explain the PSFs");
    for want in &truth.poses {
        let weight: f64 = found
            .poses
            .iter()
            .filter(|p| (p.t_x - want.t_x).abs() + (p.t_y - want.t_y).abs() < 0.1 && (p.theta_z_deg - want.theta_z_deg).abs() < 0.1)
            .map(|p| p.weight)
            .sum();
        assert!((weight - want.weight).abs() < 0.08, "{want:?} has weight {weight:.3}");
    }
}

/// Burnt-out lamps draw trails over the dark beside them: structure that the sharp frames lack. And frames of a room beside its window have little in
/// common that both see clearly.
#[test]
fn trails_of_lamps_are_not_taken_for_fine_structure() {
    let times = [1.0 / 30.0, 0.125, 0.2, 0.5, 2.0];
    let (mut shaken, mut passed) = (0, Vec::new());
    for (extent_px, seed) in [6.0, 12.0].into_iter().flat_map(|extent| (1..=8).map(move |seed| (extent, seed))) {
        let tremor = Tremor { extent_px, roll_deg: 0.4 * extent_px, offset_px: 1.0, offset_deg: 0.1 };
        for scene in [Drawn::Lamps, Drawn::Window, Drawn::Foliage] {
            let frames: Vec<_> = times.iter().map(|&t| (t, (t > 0.25).then(|| tremor.clone()))).collect();
            let made = synth::capture(&scene.draw(192, 144, 40, 2, seed), &Camera::default(), &frames, 0.05, seed).unwrap();
            let frames = made.bracket.frames();
            let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Srgb)).collect();
            let level = noise::estimate(frames, &exposures, &Response::Srgb);
            let curves = noise::curves(frames, &Response::Srgb, &level);
            let found = triage::triage(frames, &exposures, &curves, &[false; 5], None, &[DMat3::IDENTITY; 5]);
            for (verdict, sharp) in found.into_iter().zip(made.sharp) {
                assert!(verdict.sharp || !sharp, "{}, seed {seed}, {extent_px} px: {verdict:?}", scene.name());
                shaken += usize::from(!sharp);
                if verdict.sharp && !sharp {
                    passed.push((scene.name(), seed, extent_px, verdict));
                }
            }
        }
    }
    assert_eq!(shaken, 96);
    assert!(passed.len() <= 3 && passed.iter().all(|p| p.2 < 12.0), "{passed:?}");
}

/// Before it is known which frames are sharp: a shaken one, beside a sharp one that JPEG has smoothed, differs from it by its blur where there is texture.
#[test]
fn smoothed_noise_is_found_beside_a_shaken_frame() {
    let camera = noise::NoiseModel::from_electrons(3000.0, 4.0);
    let (w, h) = (320, 240);
    // On either side the same levels from above to below: blocks of texture, which the shake smooths away, and half of the picture as good as
    // flat.
    let block = |x: usize, y: usize| if (x / 12 + y / 12).is_multiple_of(2) { 1.3 } else { 0.7 };
    let level = |x: usize, y: usize| (0.05 + 0.05 * y as f64 / h as f64) * if x < w / 2 { block(x, y) } else { 1.0 };
    let frame = |exposure_time: f64, seed: u64, shake: usize| {
        let n = twelve(seed, 3 * w * h);
        let picture = image::RgbImage::from_fn(w as u32, h as u32, |x, y| {
            let (x, y) = (x as usize, y as usize);
            let e = exposure_time * (0..shake).map(|i| level((x + i).min(w - 1), y)).sum::<f64>() / shake as f64;
            image::Rgb([0, 1, 2].map(|c| {
                let z = e + camera.variance(e).sqrt() * f64::from(n[3 * (y * w + x) + c]) / 2.0;
                (z.clamp(0.0, 1.0).sqrt() * 255.0).round() as u8
            }))
        });
        through_jpeg(&picture, Some(90), exposure_time)
    };
    let response = Response::Gamma(2.0);
    let frames = [frame(0.25, 700, 1), frame(1.0, 800, 24)];
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &response)).collect();
    let first = noise::NoiseModel { shot: 0.2 * camera.shot, read: 0.2 * camera.read };
    let found = [false, true].map(|sharp| {
        let again = noise::of_squares(&frames, &exposures, &response, &[0, 1], &[DMat3::IDENTITY; 2], sharp, &first);
        again.map(|m| m.variance(0.015) / camera.variance(0.015))
    });
    assert!(found[0].is_some_and(|r| (0.7..1.6).contains(&r)), "{found:.2?}");
    assert!(found[1].is_some_and(|r| r > 2.0), "{found:.2?}: taken for sharp, its blur passes for noise");
}

/// Two frames that see the left half clearly, and a long one that sees it white and the right half, which is noise to the others.
#[test]
fn a_frame_that_none_can_be_compared_with_is_not_taken_for_sharp() {
    let level = noise::NoiseModel::from_electrons(4000.0, 8.0);
    let (w, h) = (128, 96);
    let grain = numbers(3, w * h);
    let light = |x: usize, y: usize| (1.0 + 0.4 * f64::from(grain[y * w + x])) * if x < w / 2 { 1.0 } else { 5e-4 };
    let frame = |exposure_time: f64, seed: u64| {
        let n = twelve(seed, w * h);
        let plane = Plane::from_fn(w, h, |x, y| {
            let e = exposure_time * light(x, y);
            (e + level.variance(e).sqrt() * f64::from(n[y * w + x]) / 2.0).clamp(0.0, 1.0) as f32
        });
        Frame {
            name: String::new(),
            intensity: Rgb([plane.clone(), plane.clone(), plane]),
            levels: 65535,
            chroma_subsampled: false,
            lossy: false,
            exposure_time,
        }
    };
    let sharp = |times: &[f64]| {
        let frames: Vec<Frame> = times.iter().zip([10, 30, 50]).map(|(t, seed)| frame(*t, seed)).collect();
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
        let still = vec![DMat3::IDENTITY; times.len()];
        let found = triage::triage(
            &frames,
            &exposures,
            &noise::curves(&frames, &Response::Linear, &level),
            &vec![false; times.len()],
            None,
            &still,
        );
        found.iter().map(|v| (v.sharp, v.compared)).collect::<Vec<_>>()
    };
    assert_eq!(sharp(&[0.25, 0.5, 400.0]), [(true, true), (true, true), (false, false)]);
    // A pair of which nothing can be told has the benefit of the doubt.
    assert_eq!(sharp(&[0.25, 400.0]), [(true, false), (true, false)]);
}

/// A night that fills the lowest codes of the shorter frame, by a camera whose curve starts as a line: there a code is much more than the noise. And
/// noise that a file format has made the same in all channels.
#[test]
fn codes_of_a_dark_frame_and_noise_of_all_channels_alike_are_no_fine_structure() {
    let (w, h) = (192, 144);
    let toe = |z: f64| (z / 3.0).max(z * z);
    let response = Response::Table(std::array::from_fn(|_| (0..256).map(|i| toe(f64::from(i) / 255.0)).collect()));
    let code = |x: f64| (255.0 * (3.0 * x).min(x.max(0.0).sqrt())).round().clamp(0.0, 255.0) as f32 / 255.0;
    let scene = texture(w, h);
    // Three times the variance in the mean of the channels that independent noise has.
    let frame = |level: &noise::NoiseModel, exposure_time: f64, light: f64, seed: u64, softness: isize| {
        let n = twelve(seed, w * h);
        let soft = |x: usize, y: usize| {
            let around = (-softness..=softness).flat_map(|j| (-softness..=softness).map(move |i| (i, j)));
            let sum: f32 = around.map(|(i, j)| scene.clamped(x as isize + i, y as isize + j)).sum();
            f64::from(sum) / ((2 * softness + 1) * (2 * softness + 1)) as f64
        };
        let plane = Plane::from_fn(w, h, |x, y| {
            let e = exposure_time * light * soft(x, y);
            code(e + level.variance(e).sqrt() * f64::from(n[y * w + x]) / 2.0)
        });
        Frame {
            name: String::new(),
            intensity: Rgb([plane.clone(), plane.clone(), plane]),
            levels: 255,
            chroma_subsampled: false,
            lossy: false,
            exposure_time,
        }
    };
    let verdicts = |full_well: f64, light: f64, softness: isize| {
        let level = noise::NoiseModel::from_electrons(full_well, 2.0);
        let frames = [frame(&level, 0.125, light, 100, 0), frame(&level, 1.0, light, 200, softness)];
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &response)).collect();
        triage::triage(&frames, &exposures, &noise::curves(&frames, &response, &level), &[false; 2], None, &[DMat3::IDENTITY; 2])
    };
    for full_well in [20_000.0, 500_000.0] {
        for light in [0.01, 0.02, 0.05, 0.4] {
            let found = verdicts(full_well, light, 0);
            assert!(found.iter().all(|v| v.sharp), "{full_well} e-, light {light}: {found:?}");
        }
        // It is not that nothing tells.
        let found = verdicts(full_well, 0.4, 2);
        assert!(found[0].sharp && !found[1].sharp, "{full_well} e-: {found:?}");
    }
}

/// JPEG files keep their noise beside texture and lose it where nothing else is. In the dark, where most of the fine structure of the short frame is noise, a noise level
/// by the flat squares leaves two thirds of that noise to pass for structure that the sharp longer frame lacks.
#[test]
fn noise_that_a_file_format_leaves_beside_texture_is_no_fine_structure() {
    let (w, h) = (256, 192);
    let level = noise::NoiseModel::from_electrons(4000.0, 8.0);
    let scene = texture(w, h);
    let flat = |x: usize| (x / 32).is_multiple_of(4);
    let frame = |exposure_time: f64, seed: u64, softness: isize| {
        let n = twelve(seed, w * h);
        let plane = Plane::from_fn(w, h, |x, y| {
            let around = (-softness..=softness).flat_map(|j| (-softness..=softness).map(move |i| (i, j)));
            let sum: f32 = around.map(|(i, j)| scene.clamped(x as isize + i, y as isize + j)).sum();
            let soft = f64::from(sum) / ((2 * softness + 1) * (2 * softness + 1)) as f64;
            let light = exposure_time * if flat(x) { 0.1 } else { 0.08 + 0.04 * soft };
            let kept = if flat(x) { 0.05 } else { 1.0 };
            // The same in all channels: three times the variance in their mean that independent noise has.
            let z = light + kept * level.variance(light).sqrt() * f64::from(n[y * w + x]) / 2.0;
            (z.clamp(0.0, 1.0) * 65535.0).round() as f32 / 65535.0
        });
        let intensity = Rgb([plane.clone(), plane.clone(), plane]);
        Frame { name: String::new(), intensity, levels: 65535, chroma_subsampled: true, lossy: true, exposure_time }
    };
    let sharp = |softness: isize| -> Vec<bool> {
        let frames = [frame(0.125, 100, 0), frame(0.5, 200, softness)];
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
        let curves = noise::curves(&frames, &Response::Linear, &level);
        let found = triage::triage(&frames, &exposures, &curves, &[false; 2], None, &[DMat3::IDENTITY; 2]);
        println!("{softness}: {found:?}");
        found.iter().map(|v| v.sharp).collect()
    };
    assert_eq!(sharp(0), [true, true]);
    assert_eq!(sharp(1), [true, false], "means of 3 x 3 pixels");
    assert_eq!(sharp(2), [true, false], "means of 5 x 5 pixels");
}

#[test]
fn shaken_frames_are_told_from_sharp_ones() {
    let scene = synth::room(192, 144, 24, 3);
    let tremor = Tremor { extent_px: 6.0, roll_deg: 0.5, offset_px: 1.0, offset_deg: 0.0 };
    for shaken in [[false, false, false], [false, false, true], [false, true, true]] {
        let times: Vec<_> = [0.05, 0.2, 0.8].into_iter().zip(shaken).map(|(t, s)| (t, s.then(|| tremor.clone()))).collect();
        let made = synth::capture(&scene, &Camera::default(), &times, 0.2, 11).unwrap();
        let frames = made.bracket.frames();
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Srgb)).collect();
        let level = noise::estimate(frames, &exposures, &Response::Srgb);
        let found =
            triage::triage(frames, &exposures, &noise::curves(frames, &Response::Srgb, &level), &[false; 3], None, &[DMat3::IDENTITY; 3]);
        assert_eq!(found.iter().map(|v| !v.sharp).collect::<Vec<_>>(), shaken, "{found:?}");
    }
}

/// Discs have edges of all directions. A lens softens them alike, a motion those across it.
#[test]
fn edges_are_even_behind_a_soft_lens_and_uneven_after_a_motion() {
    let level = noise::NoiseModel::from_electrons(1e6, 1.0);
    let (w, h) = (128, 96);
    let discs = numbers(5, 3 * 80);
    let scene = Plane::from_fn(w, h, |x, y| {
        let disc = discs.chunks(3).rposition(|d| {
            let (u, v) = (x as f32 - 64.0 * (1.0 + d[0]), y as f32 - 48.0 * (1.0 + d[1]));
            u * u + v * v < (9.0 + 6.0 * d[2]).powi(2)
        });
        0.1 + 0.01 * disc.unwrap_or(0) as f32
    });
    // Means over pixels away by (x, y).
    let mean = |plane: &Plane, at: &[(isize, isize)]| {
        let of = |x: usize, y: usize| at.iter().map(|(i, j)| plane.clamped(x as isize + i, y as isize + j)).sum::<f32>() / at.len() as f32;
        Plane::from_fn(w, h, of)
    };
    let along = |dx: isize, dy: isize, reach: isize| (-reach..=reach).map(|k| (dx * k, dy * k)).collect::<Vec<_>>();
    let soft = mean(&mean(&scene, &along(1, 0, 1)), &along(0, 1, 1));
    let moved = [(1, 0), (0, 1), (1, 1), (1, -1)].map(|(dx, dy)| mean(&scene, &along(dx, dy, 1)));
    let of = |plane: &Plane| {
        let intensity = Rgb([plane.clone(), plane.clone(), plane.clone()]);
        let frame = Frame { name: String::new(), intensity, levels: 65535, chroma_subsampled: false, lossy: false, exposure_time: 1.0 };
        let exposures = [noise::exposure(&frame, &Response::Linear)];
        let frames = [frame];
        let found =
            triage::triage(&frames, &exposures, &noise::curves(&frames, &Response::Linear, &level), &[false], None, &[DMat3::IDENTITY]);
        (found[0].evenness, found[0].steepness)
    };
    let (hard, soft) = (of(&scene), of(&soft));
    assert!(hard.0 > 0.92 && soft.0 > 0.92, "{hard:?} {soft:?}");
    assert!(soft.1 < 0.75 * hard.1, "the lens takes steepness all the same: {hard:?} {soft:?}");
    for moved in &moved {
        assert!(of(moved).0 < 0.82, "{:?}", of(moved));
    }
}
