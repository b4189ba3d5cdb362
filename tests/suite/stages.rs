//! The estimators, each on input whose answer is planted.

use crate::support::noise as numbers;
use crate::support::texture;
use glam::DMat3;
use unshaken::channels;
use unshaken::exposure::Frame;
use unshaken::image::{Channels, Plane, Rgb};
use unshaken::mask;
use unshaken::noise;
use unshaken::pose::{Pose, PoseGrid};
use unshaken::psf::{self, Patch, Psf};
use unshaken::response::Response;
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
            speed: None,
            exposure_time: 1.0,
        };
        let exposure = noise::exposure(&frame, &Response::Linear);
        let found = noise::estimate(&[frame], &[exposure], &Response::Linear)[0].channels[1];
        for x in [0.02, 0.1, 0.5] {
            let ratio = found.variance(x) / truth.variance(x);
            assert!((0.8..1.2).contains(&ratio), "{full_well} e-, {read_noise} e-: variance at {x} is {ratio:.2} times the truth");
        }
    }
}

/// A frame of linear 16-bit values: flat fields of 16 levels under `noise`, drawn for each channel from `seed` on and passed through
/// `engine`.
fn flat_fields(noise: &noise::NoiseModel, seed: u64, engine: impl Fn(Plane) -> Plane) -> Frame {
    let (w, h) = (576, 384);
    let plane = |c: u64| {
        let n = twelve(seed + 20 * c, w * h);
        let noisy = Plane::from_fn(w, h, |x, y| {
            let e = 0.03 + 0.6 * ((x / 36) as f64 / 16.0).powi(2);
            (e + noise.variance(e).sqrt() * f64::from(n[y * w + x]) / 2.0) as f32
        });
        engine(noisy).map(|z| (z.clamp(0.0, 1.0) * 65535.0).round() / 65535.0)
    };
    Frame {
        name: "flat".into(),
        intensity: Rgb([plane(0), plane(1), plane(2)]),
        levels: 65535,
        chroma_subsampled: false,
        lossy: false,
        speed: None,
        exposure_time: 1.0,
    }
}

fn noise_of(frames: &[Frame]) -> Vec<noise::FrameNoise> {
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
    noise::estimate(frames, &exposures, &Response::Linear)
}

/// Frames of one bracket at two ISO speeds: each has its own noise, no mean of both.
#[test]
fn frames_of_different_iso_speeds_have_noise_of_their_own() {
    let speeds = [(300.0, 3.0), (10_000.0, 5.0)].map(|(full_well, read)| noise::NoiseModel::from_electrons(full_well, read));
    let frames = [flat_fields(&speeds[0], 100, |p| p), flat_fields(&speeds[1], 200, |p| p)];
    for (found, truth) in noise_of(&frames).iter().zip(&speeds) {
        for channel in &found.channels {
            let ratio = channel.shot / truth.shot;
            println!("shot noise {ratio:.2} times the truth");
            assert!((0.5..2.0).contains(&ratio), "shot noise is {ratio:.2} times the truth: {found:?}");
        }
    }
}

/// Noise reduction takes the noise of single pixels, not that of means of many: the density stays.
#[test]
fn smoothed_noise_keeps_its_density() {
    let truth = noise::NoiseModel::from_electrons(1000.0, 5.0);
    let smoothed = |radius: isize, weight: &(dyn Fn(isize, isize) -> f32 + Sync), p: &Plane| {
        let around: Vec<_> = (-radius..=radius).flat_map(|y| (-radius..=radius).map(move |x| (x, y))).collect();
        let sum: f32 = around.iter().map(|&(x, y)| weight(x, y)).sum();
        Plane::from_fn(p.width, p.height, |x, y| {
            around.iter().map(|&(i, j)| weight(i, j) * p.clamped(x as isize + i, y as isize + j)).sum::<f32>() / sum
        })
    };
    let frames = [
        flat_fields(&truth, 300, |p| p),
        flat_fields(&truth, 400, |p| smoothed(1, &|_, _| 1.0, &p)),
        flat_fields(&truth, 500, |p| smoothed(3, &|x, y| (-0.5 * (x * x + y * y) as f32 / 0.64).exp(), &p)),
    ];
    let found = noise_of(&frames);
    for (name, found) in ["white", "means of 3 x 3 pixels", "Gaussian of 0.8 px"].iter().zip(&found) {
        for x in [0.1, 0.4] {
            let ratios = found.channels.map(|c| c.variance(x) / truth.variance(x));
            let luminance = 3.0 * found.luminance.variance(x) / truth.variance(x);
            println!("{name}: {ratios:.2?}, luminance {luminance:.2}, correlation {:.1}", found.correlation);
            let near = |r: f64| (1.0 / 3.0..3.0).contains(&r);
            assert!(
                ratios.into_iter().all(near) && near(luminance),
                "{name}: {ratios:.2?} and {luminance:.2} times the true density at {x}"
            );
        }
    }
    assert_eq!(found[0].correlation, 1.0);
    assert!(found[1..].iter().all(|f| f.correlation > 4.0), "{found:?}");
}

/// Texture that fills the picture, soft as a lens leaves it, is nearly all that means of 4 x 4 pixels show; noise shows at 2 x 2 already.
#[test]
fn texture_everywhere_is_not_taken_for_correlated_noise() {
    let truth = noise::NoiseModel::from_electrons(20_000.0, 4.0);
    let engine = |p: Plane| {
        // What is left of noise between the sites of a mosaic.
        let weight = |d: isize| if d == 0 { 0.5 } else { 0.25 };
        Plane::from_fn(p.width, p.height, |x, y| {
            let around = (-1..=1).flat_map(|j| (-1..=1).map(move |i| (i, j)));
            let mean: f32 = around.map(|(i, j)| weight(i) * weight(j) * p.clamped(x as isize + i, y as isize + j)).sum();
            let (x, y) = (x as f32, y as f32);
            mean * (1.0 + 0.1 * ((0.55 * x + 0.2 * y).sin() + (0.5 * y - 0.25 * x).sin()))
        })
    };
    let found = noise_of(&[flat_fields(&truth, 600, engine)])[0];
    let ratio = found.channels[1].variance(0.3) / truth.variance(0.3);
    println!("{ratio:.1} times the true density, correlation {:.1}", found.correlation);
    assert!((0.3..4.0).contains(&ratio), "{ratio:.1} times the true density: {found:?}");
}

/// Texture that fills the picture, with no flat part at all, is in both frames of a bracket: what the other frame shows of it is not noise. The frames lie apart by parts of a pixel, one of
/// them is blurred, and their gains differ.
#[test]
fn texture_that_another_frame_shows_is_not_noise() {
    let (w, h) = (288, 216);
    let truth = [(3000.0, 6.0), (12_000.0, 4.0), (1500.0, 6.0)].map(|(full_well, read)| noise::NoiseModel::from_electrons(full_well, read));
    let waves: Vec<[f32; 4]> = numbers(700, 40 * 4).chunks(4).map(|c| [1.2 * c[0], 1.2 * c[1], 10.0 * c[2], c[3]]).collect();
    let scene = |x: f32, y: f32| {
        let texture: f32 = waves.iter().map(|w| 0.02 * (w[0] * x + w[1] * y + w[2]).sin()).sum();
        (0.1 + 0.3 * x / w as f32) * (1.0 + texture).max(0.2)
    };
    // Displacement, gain, and length of a stroke along x.
    let frame = |k: usize, (dx, dy): (f32, f32), gain: f32, stroke: i32| {
        let plane = |c: u64| {
            let n = twelve(800 + 100 * k as u64 + 20 * c, w * h);
            Plane::from_fn(w, h, |x, y| {
                let at = |i: i32| scene(x as f32 + dx + i as f32 - 0.5 * (stroke - 1) as f32, y as f32 + dy);
                let e = gain * (0..stroke).map(at).sum::<f32>() / stroke as f32;
                (e + truth[k].variance(f64::from(e)).sqrt() as f32 * n[y * w + x] / 2.0).clamp(0.0, 1.0)
            })
        };
        let intensity = Rgb([plane(0), plane(1), plane(2)]);
        Frame {
            name: k.to_string(),
            intensity,
            levels: 65535,
            chroma_subsampled: false,
            lossy: false,
            speed: None,
            exposure_time: f64::from(gain),
        }
    };
    let places = [(0.0f32, 0.0f32), (5.5, -3.25), (-4.3, 2.6)];
    let frames = [frame(0, places[0], 1.0, 1), frame(1, places[1], 1.4, 1), frame(2, places[2], 1.2, 6)];
    let motions = places.map(|(x, y)| DMat3::from_translation(-glam::DVec2::new(f64::from(x), f64::from(y))));
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
    let alone = noise_of(&frames);
    let beside = noise::estimate_registered(&frames, &exposures, &Response::Linear, (&[0, 1, 2], &motions), &alone);
    let ratio = |k: usize, n: &noise::FrameNoise| n.channels[1].variance(0.25) / truth[k].variance(0.25);
    for k in 0..3 {
        println!("frame {k}: {:.2} times the truth alone, {:.2} beside the others", ratio(k, &alone[k]), ratio(k, &beside[k]));
    }
    assert!(ratio(0, &alone[0]) > 3.0, "the texture has to pass for noise in a frame alone");
    for k in [0, 2] {
        assert!((0.7..1.6).contains(&ratio(k, &beside[k])), "frame {k}: {:.2} times the true noise", ratio(k, &beside[k]));
    }
    // Beside noisier frames some texture is left of the cleanest.
    assert!(ratio(1, &beside[1]) < 0.4 * ratio(1, &alone[1]), "{:.2} times the true noise", ratio(1, &beside[1]));
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
        speed: None,
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
    let frame =
        Frame { name: "one".into(), intensity, levels: 255, chroma_subsampled: false, lossy: false, speed: None, exposure_time: 1.0 };
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
        speed: None,
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
                speed: None,
                exposure_time,
            }
        };
        times.map(frame).to_vec()
    };
    let chosen = |frames: &[Frame], blurred: &[usize], by: &[usize]| {
        let exposures: Vec<Rgb> = frames.iter().map(|f| f.intensity.clone()).collect();
        channels::most_telling(frames, &exposures, blurred, by, &noise::alike(frames.len(), level)).names()
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
    // A file that holds colour coarsely blurs channels by themselves: one of them is looked at only where the mean of all shows next to
    // nothing.
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
