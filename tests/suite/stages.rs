//! The estimators, each on input whose answer is planted.

use crate::support::noise as numbers;
use glam::DMat3;
use unshaken::exposure::Frame;
use unshaken::image::{Plane, Rgb};
use unshaken::mask;
use unshaken::noise;
use unshaken::pose::{Pose, PoseGrid};
use unshaken::psf::{self, Patch, Psf};
use unshaken::response::Response;
use unshaken::synth::{self, Camera, Tremor};
use unshaken::triage;
use unshaken::tsf::{self, Interpolation, TapSet, Tsf, WholeFrame};

const SIZE: (usize, usize) = (128, 96);

/// Texture that determines a blur: smoothed noise over a few scales, positive.
fn texture(width: usize, height: usize) -> Plane {
    let n = numbers(7, width * height);
    let fine = Plane { width, height, data: n };
    let at = |x: usize, y: usize, r: isize| {
        let mut sum = 0.0;
        for j in -r..=r {
            for i in -r..=r {
                sum += fine.clamped(x as isize + i, y as isize + j);
            }
        }
        sum / (2 * r + 1) as f32
    };
    Plane::from_fn(width, height, |x, y| 2.0 + 0.5 * at(x, y, 1) + 0.5 * at(x, y, 3))
}

/// The frame that `tsf` makes of `latent` (which surrounds it by `pad`), by direct summation over poses, bilinear.
fn blur(latent: &Plane, pad: usize, tsf: &Tsf, size: (usize, usize)) -> Plane {
    let centre = glam::DVec2::new((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
    let mut out = Plane::filled(size.0, size.1, 0.0);
    for pose in &tsf.poses {
        let inverse = pose.homography(tsf.focal_px).inverse();
        for y in 0..size.1 {
            for x in 0..size.0 {
                let p = unshaken::pose::project(&inverse, glam::DVec2::new(x as f64, y as f64) - centre) + centre + pad as f64;
                let (i, j) = (p.x.floor(), p.y.floor());
                let (u, v) = ((p.x - i) as f32, (p.y - j) as f32);
                let at = |a: isize, b: isize| latent.clamped(i as isize + a, j as isize + b);
                let value = (1.0 - v) * ((1.0 - u) * at(0, 0) + u * at(1, 0)) + v * ((1.0 - u) * at(0, 1) + u * at(1, 1));
                out.data[y * size.0 + x] += pose.weight as f32 * value;
            }
        }
    }
    out
}

/// Root mean square difference of two blurs of the same scene over that of the blur and the scene, away from the border.
fn operator_error(latent: &Plane, pad: usize, a: &Tsf, b: &Tsf, size: (usize, usize)) -> f64 {
    let (p, q, e) = (blur(latent, pad, a, size), blur(latent, pad, b, size), blur(latent, pad, &Tsf::identity(), size));
    let inner = |f: &dyn Fn(usize) -> f64| -> f64 {
        (8..size.1 - 8).flat_map(|y| (8..size.0 - 8).map(move |x| y * size.0 + x)).map(f).sum::<f64>().sqrt()
    };
    inner(&|i| f64::from(p.data[i] - q.data[i]).powi(2)) / inner(&|i| f64::from(p.data[i] - e.data[i]).powi(2))
}

fn planted(poses: &[(f64, f64, f64, f64)]) -> Tsf {
    Tsf::new(1.2 * SIZE.0 as f64, poses.iter().map(|p| Pose::planar(p.0, p.1, p.2, p.3)).collect()).unwrap()
}

#[test]
fn the_noise_level_is_found_within_a_fifth() {
    // Flat fields with shot and read noise beside hard texture, which must not pass for noise.
    for (full_well, read_noise) in [(2000.0, 6.0), (8000.0, 5.0), (30000.0, 12.0)] {
        let truth = noise::NoiseModel::from_electrons(full_well, read_noise);
        let (w, h) = (256, 256);
        let n: Vec<f32> =
            (0..12).map(|k| numbers(100 + k, w * h)).fold(vec![0.0; w * h], |s, v| s.iter().zip(&v).map(|(a, b)| a + b).collect());
        let value = |x: usize, y: usize| {
            let level = 0.01 + 0.8 * ((x / 16) as f64 / 16.0).powi(2);
            if (y / 64) % 2 == 1 { level * if (x + y).is_multiple_of(2) { 0.8 } else { 1.1 } } else { level }
        };
        // Sum of twelve uniforms of variance 1/3: standard normal times 2.
        let plane = Plane::from_fn(w, h, |x, y| {
            let e = value(x, y);
            let z = e + truth.variance(e).sqrt() * f64::from(n[y * w + x]) / 2.0;
            (z.clamp(0.0, 1.0) * 65535.0).round() as f32 / 65535.0
        });
        let frame = Frame { name: "flat".into(), intensity: Rgb([plane.clone(), plane.clone(), plane]), levels: 65535, exposure_time: 1.0 };
        let exposure = noise::exposure(&frame, &Response::Linear);
        let found = noise::estimate(&[frame], &[exposure], &Response::Linear);
        for x in [0.02, 0.1, 0.5] {
            let ratio = found.variance(x) / truth.variance(x);
            assert!((0.8..1.2).contains(&ratio), "{full_well} e-, {read_noise} e-: variance at {x} is {ratio:.2} times the truth");
        }
    }
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
        exposure_time,
    };
    let one = |frames: &[Frame], sharp: &[bool]| {
        mask::masks(frames, sharp, 0.3, &vec![DMat3::IDENTITY; frames.len()]).iter().map(|m| m.data[0]).collect::<Vec<f32>>()
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
    let found = mask::masks(&[row([0.05; 3], 0.1), row([0.0, 0.4, 0.0], 1.0)], &[true, true], 0.3, &motions);
    assert!(found[0].data[0] < 0.5 && found[0].data[1..] == [1.0, 1.0], "{found:?}");
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

#[test]
fn the_whole_frame_gives_the_tsf_on_the_grid_and_between() {
    let pad = 12;
    let latent = texture(SIZE.0 + 2 * pad, SIZE.1 + 2 * pad);
    let grid = PoseGrid::new(SIZE.0, SIZE.1, 8, 1.5, 1.0);
    let weight = Plane::filled(SIZE.0, SIZE.1, 1e5);
    for (name, truth, limit) in [
        ("on the grid", planted(&[(0.0, 0.0, 0.0, 0.5), (2.0, 1.0, 0.0, 0.3), (5.0, -2.0, 0.0, 0.2)]), 3e-4),
        ("between", planted(&[(0.3, -0.4, 0.1, 0.3), (1.4, 0.7, 0.3, 0.3), (2.6, 1.5, 0.55, 0.2), (3.5, 2.4, 0.8, 0.2)]), 0.05),
    ] {
        let blurred = blur(&latent, pad, &truth, SIZE);
        let frame = WholeFrame { latent: &latent, pad, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
        let coarse = frame.fit_grid(&grid, None).expect("something fits");
        let fine = frame.refine(&coarse, Interpolation::Bilinear, 2);
        let (a, b) = (operator_error(&latent, pad, &coarse, &truth, SIZE), operator_error(&latent, pad, &fine, &truth, SIZE));
        assert!(b < limit, "{name}: operator error {a:.4} on the grid, {b:.4} refined");
        assert!((fine.poses.iter().map(|p| p.weight).sum::<f64>() - 1.0).abs() < 1e-9);
        let (m, t) = (fine.mean(), truth.mean());
        assert!((m.t_x - t.t_x).abs() < 0.1 && (m.t_y - t.t_y).abs() < 0.1 && (m.theta_z_deg - t.theta_z_deg).abs() < 0.1, "{name}: {m:?}");
        // Whatever the poses, the taps keep the brightness.
        let taps = TapSet::new(&fine, SIZE.0, SIZE.1, Interpolation::Bilinear);
        assert!((taps.taps.iter().map(|t| t.weight).sum::<f64>() - 1.0).abs() < 1e-9);
    }
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
        let found = triage::triage(frames, &exposures, &level, &[false; 3], None, &[DMat3::IDENTITY; 3]);
        assert_eq!(found.iter().map(|v| !v.sharp).collect::<Vec<_>>(), shaken, "{found:?}");
    }
}
