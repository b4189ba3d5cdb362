//! TSFs from whole frames, on input whose answer is planted.

use crate::support::{noise as numbers, texture};
use glam::{DMat3, DVec2};
use unshaken::image::Plane;
use unshaken::pose::{Pose, PoseGrid};
use unshaken::psf::{self, Patch};
use unshaken::tsf::{self, Estimate, Interpolation, Model, Search, TapSet, Tsf, WholeFrame};

const SIZE: (usize, usize) = (160, 120);
const PAD: usize = 16;
const KERNEL: Interpolation = Interpolation::Bicubic;
/// Standard deviation of the noise: the texture's is about 0.15.
const NOISE: f32 = 0.01;

/// The frame that `tsf` makes of `latent` (which surrounds it by `pad`), by direct summation over poses, cubic convolution.
fn blur(latent: &Plane, pad: usize, tsf: &Tsf, size: (usize, usize)) -> Plane {
    let centre = glam::DVec2::new((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
    let mut out = Plane::filled(size.0, size.1, 0.0);
    for pose in &tsf.poses {
        let inverse = pose.homography(tsf.focal_px).inverse();
        for y in 0..size.1 {
            for x in 0..size.0 {
                let p = unshaken::pose::project(&inverse, glam::DVec2::new(x as f64, y as f64) - centre) + centre + pad as f64;
                let (i, j) = (p.x.floor(), p.y.floor());
                let mut value = 0.0;
                for b in -1..=2isize {
                    for a in -1..=2isize {
                        let k = KERNEL.weight(a as f64 - (p.x - i)) * KERNEL.weight(b as f64 - (p.y - j));
                        value += k as f32 * latent.clamped(i as isize + a, j as isize + b);
                    }
                }
                out.data[y * size.0 + x] += pose.weight as f32 * value;
            }
        }
    }
    out
}

/// Root mean square difference of two blurs of the same scene over that of the blur and the scene, away from the border.
fn operator_error(latent: &Plane, pad: usize, found: &Tsf, truth: &Tsf, size: (usize, usize)) -> f64 {
    let b = 8;
    let (p, q, e) = (blur(latent, pad, found, size), blur(latent, pad, truth, size), blur(latent, pad, &Tsf::identity(), size));
    let inner = |f: &dyn Fn(usize) -> f64| -> f64 {
        (b..size.1 - b).flat_map(|y| (b..size.0 - b).map(move |x| y * size.0 + x)).map(f).sum::<f64>().sqrt()
    };
    inner(&|i| f64::from(p.data[i] - q.data[i]).powi(2)) / inner(&|i| f64::from(p.data[i] - e.data[i]).powi(2))
}

/// Texture as a lens leaves it: nothing as fine as the pixels.
fn seen(width: usize, height: usize) -> Plane {
    let sharp = texture(width, height);
    Plane::from_fn(width, height, |x, y| {
        let at = |i: isize, j: isize| sharp.clamped(x as isize + i, y as isize + j);
        (at(0, 0) * 4.0 + 2.0 * (at(1, 0) + at(-1, 0) + at(0, 1) + at(0, -1)) + at(1, 1) + at(-1, 1) + at(1, -1) + at(-1, -1)) / 16.0
    })
}

/// A camera path as a TSF: `at` of equal steps of time from -1/2 to 1/2.
fn path(focal_px: f64, at: impl Fn(f64) -> Pose) -> Tsf {
    Tsf::new(focal_px, (0..60).map(|i| at((f64::from(i) + 0.5) / 60.0 - 0.5)).collect()).unwrap()
}

/// A frame blurred by `truth`, with noise, and its inverse variance.
fn shaken(latent: &Plane, pad: usize, truth: &Tsf, size: (usize, usize)) -> (Plane, Plane) {
    let n = numbers(77, size.0 * size.1);
    let mut blurred = blur(latent, pad, truth, size);
    // Uniform numbers of -1..1 have a variance of 1/3.
    blurred.data.iter_mut().zip(&n).for_each(|(b, n)| *b += NOISE * 3f32.sqrt() * n);
    (blurred, Plane::filled(size.0, size.1, 1.0 / (NOISE * NOISE)))
}

fn search(model: Model, focal_px: Option<f64>) -> Search {
    Search { model, focal_px, stop: None }
}

#[test]
fn every_model_finds_motion_between_the_poses_of_a_grid() {
    let latent = seen(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let f = 100.0;
    let bend = |t: f64| (3.0 * t).sin();
    for (model, truth) in [
        (Model::Translation, path(f, |t| Pose::planar(6.0 * t + 0.3, 2.0 * bend(t), 0.0, 1.0))),
        (Model::Rigid, path(f, |t| Pose::planar(4.0 * t + 0.3, 2.0 * bend(t) - 0.6, 1.5 * t, 1.0))),
        (Model::Rotation, path(f, |t| Pose { theta_y_deg: 4.0 * t, theta_x_deg: 2.0 * bend(t), theta_z_deg: t, ..Pose::IDENTITY })),
        (Model::Full, path(f, |t| Pose { theta_y_deg: 4.0 * t, theta_z_deg: t, ..Pose::planar(-3.0 * t, 2.0 * t * t, 0.0, 1.0) })),
    ] {
        let (blurred, weight) = shaken(&latent, PAD, &truth, SIZE);
        let frame = WholeFrame { latent: &latent, pad: PAD, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
        let found = frame.estimate(&search(model, Some(f))).expect("texture determines it");
        let error = operator_error(&latent, PAD, &found.tsf, &truth, SIZE);
        assert!(error < 0.12, "{}: operator error {error:.3}, residual {:.2}", model.name(), found.residual);
        assert!(found.is_sound(), "{}: evidence {:.1}", model.name(), found.evidence);
        assert!((0.7..4.0).contains(&found.residual), "{}: residual {:.2} of the noise", model.name(), found.residual);
        assert!((found.tsf.poses.iter().map(|p| p.weight).sum::<f64>() - 1.0).abs() < 1e-9);
        // A narrower model does not reach this: the test can tell them apart.
        if model != Model::Translation {
            let narrow = frame.estimate(&search(Model::Translation, Some(f))).expect("translations explain a part");
            let worse = operator_error(&latent, PAD, &narrow.tsf, &truth, SIZE);
            assert!(worse > 2.0 * error, "{}: {error:.3}, translations {worse:.3}", model.name());
        }
        let none = |v: f64| v.abs() < 1e-9;
        for p in &found.tsf.poses {
            match model {
                Model::Translation => assert!(none(p.theta_x_deg) && none(p.theta_y_deg) && none(p.theta_z_deg)),
                Model::Rigid => assert!(none(p.theta_x_deg) && none(p.theta_y_deg)),
                Model::Rotation => assert!(none(p.t_x) && none(p.t_y)),
                _ => {}
            }
        }
    }
}

#[test]
fn a_blur_explains_parts_that_it_was_not_fitted_to_and_none_of_another_scene() {
    let latent = seen(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let truth = path(100.0, |t| Pose::planar(7.0 * t, 3.0 * t * t, t, 1.0));
    let (blurred, weight) = shaken(&latent, PAD, &truth, SIZE);
    let other = Plane { data: blurred.data.iter().rev().copied().collect(), ..blurred.clone() };
    for model in [Model::Rigid, Model::Auto] {
        let of = |blurred: &Plane| {
            let frame = WholeFrame { latent: &latent, pad: PAD, blurred, weight: &weight, base: DMat3::IDENTITY };
            frame.estimate(&search(model, Some(100.0)))
        };
        let right = of(&blurred).expect("texture determines it");
        assert!(right.still_worse_by > 1.0 && right.blank_worse_by > 1.0, "{}: {right:#?}", model.name());
        let wrong = of(&other).map_or(f64::NEG_INFINITY, |found| found.blank_worse_by);
        assert!(wrong < 0.15, "{}: of another scene {wrong:.2}", model.name());
    }
}

#[test]
fn the_simplest_model_that_explains_the_frame_is_taken() {
    let latent = seen(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let f = 100.0;
    for (expected, truth) in [
        (&[Model::Translation][..], path(f, |t| Pose::planar(6.0 * t, 3.0 * t * t, 0.0, 1.0))),
        (&[Model::Rigid], path(f, |t| Pose::planar(4.0 * t, 3.0 * t * t, 2.0 * t, 1.0))),
        // The focal length is among those tried (0.6 times the longer side is 96 px).
        (&[Model::Rotation, Model::Full], path(96.0, |t| Pose { theta_y_deg: 5.0 * t, theta_x_deg: 5.0 * t * t, ..Pose::IDENTITY })),
    ] {
        let (blurred, weight) = shaken(&latent, PAD, &truth, SIZE);
        let frame = WholeFrame { latent: &latent, pad: PAD, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
        let found = frame.estimate(&search(Model::Auto, None)).expect("texture determines it");
        assert!(expected.contains(&found.model), "{:?}, expected {expected:?}: {:#?}", found.model, found.trials);
        if found.model == Model::Rotation {
            // The default would be 192 px.
            assert!(found.focal == "found" && found.tsf.focal_px < 150.0, "{} {}", found.focal, found.tsf.focal_px);
        }
    }
}

#[test]
fn lamps_in_a_chain_do_not_widen_the_blur() {
    // A lamp that the noisy sharp frame shows too bright or too dark is made up for by a pose that takes a neighbour's light there.
    let (size, pad) = ((224, 160), 24);
    let (w, h) = (size.0 + 2 * pad, size.1 + 2 * pad);
    let brightness = numbers(5, 64);
    let mut scene = Plane::filled(w, h, 0.05);
    for row in 0..3usize {
        for i in 0..w / 14 {
            let (x, y) = (14.0 * i as f64 + 5.0, (pad + 40 + 40 * row) as f64 + 3.0 * (0.35 * i as f64 + row as f64).sin());
            let b = 1.0 + 0.8 * brightness[20 * row + i];
            for (j, v) in scene.data.iter_mut().enumerate() {
                let d = DVec2::new((j % w) as f64 - x, (j / w) as f64 - y).length_squared();
                *v += b * (-d / 1.3).exp() as f32;
            }
        }
    }
    let truth = path(300.0, |t| Pose::planar(4.0 * t, 6.0 * (1.0 - 4.0 * t * t), 0.4 * t, 1.0));
    let (blurred, weight) = shaken(&scene, pad, &truth, size);
    let noise = numbers(9, w * h);
    let latent = Plane { data: scene.data.iter().zip(&noise).map(|(v, n)| v * (1.0 + 0.5 * n) + 0.02 * n).collect(), ..scene.clone() };
    let frame = WholeFrame { latent: &latent, pad, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
    let found = frame.estimate(&search(Model::Rigid, Some(300.0))).expect("lamps determine it");
    let (wide, error) = (tsf::extent(&found.tsf, size.0, size.1), operator_error(&scene, pad, &found.tsf, &truth, size));
    let expected = tsf::extent(&truth, size.0, size.1);
    assert!(wide < expected + 4.0, "{wide:.1} px, in truth {expected:.1}; operator error {error:.3}");
    assert!(error < 0.08, "operator error {error:.3}");
}

/// Where little but lamps tells the blur, and the sharp frame shows them otherwise than they are, far poses explain a coarse level as well.
#[test]
fn a_slight_blur_beside_lamps_is_found_where_it_is_looked_for() {
    let (size, pad) = ((256, 160), 24);
    let (w, h) = (size.0 + 2 * pad, size.1 + 2 * pad);
    let truth = path(300.0, |t| Pose::planar(1.4 * t, 1.4 * (1.0 - 4.0 * t * t), 0.1 * t, 1.0));
    let mut mistaken = 0;
    for (seed, lamps, wrong) in [(2, 8, 0.0), (3, 30, 0.6), (4, 8, 0.3), (6, 30, 0.3), (7, 8, 0.3), (9, 8, 0.0)] {
        let (mut scene, mut latent) = (Plane::filled(w, h, 0.05), Plane::filled(w, h, 0.05));
        for lamp in numbers(seed, 3 * lamps).chunks(3) {
            let lies = DVec2::new((0.5 + f64::from(lamp[0])) * w as f64, (0.5 + f64::from(lamp[1])) * h as f64);
            let bright = 2.0f32.powf(6.0 * lamp[2]);
            let seen_as = bright * (1.0 + wrong * (lamp[0] + lamp[1])) / (1.0 + wrong);
            for j in 0..w * h {
                let d = (DVec2::new((j % w) as f64, (j / w) as f64) - lies).length_squared();
                scene.data[j] += bright * (-d / 0.8).exp() as f32;
                latent.data[j] += seen_as * (-d / (0.8 + f64::from(wrong))).exp() as f32;
            }
        }
        let (blurred, weight) = shaken(&scene, pad, &truth, size);
        let frame = WholeFrame { latent: &latent, pad, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
        let error = |found: &Estimate| operator_error(&scene, pad, &found.tsf, &truth, size);
        let slight = error(&frame.estimate_slight(&search(Model::Rigid, Some(300.0))).expect("lamps determine it"));
        let any = error(&frame.estimate(&search(Model::Rigid, Some(300.0))).expect("lamps determine it"));
        println!("{lamps} lamps (seed {seed}): operator error {slight:.3}, by the general search {any:.3}");
        assert!(slight < 0.35, "{lamps} lamps (seed {seed}): operator error {slight:.3}, by the general search {any:.3}");
        mistaken += i32::from(any > 0.6);
    }
    assert!(mistaken > 0, "the general search finds all of them: nothing is shown");
}

#[test]
fn a_stray_pose_is_part_of_the_extent_and_hardly_of_the_stroke() {
    let line = path(300.0, |t| Pose::planar(9.0 * t, 0.0, 0.0, 1.0));
    let measured = |t: &Tsf| (tsf::stroke(t, SIZE.0, SIZE.1), tsf::extent(t, SIZE.0, SIZE.1));
    let (stroke, extent) = measured(&line);
    assert!((stroke - 9.0).abs() < 0.01 && (extent - 9.0).abs() < 0.3, "{stroke}, {extent}");
    let poses = vec![Pose::planar(-0.5, 0.0, 0.0, 0.49), Pose::planar(0.5, 0.0, 0.0, 0.49), Pose::planar(0.0, 8.0, 0.0, 0.02)];
    let stray = Tsf::new(300.0, poses).unwrap();
    let (stroke, extent) = measured(&stray);
    assert!(stroke < 4.0 && extent > 7.9, "{stroke}, {extent}");
    // A roll moves the corners alone.
    let roll = path(300.0, |t| Pose::planar(0.0, 0.0, 2.0 * t, 1.0));
    let corner = 0.5 * (SIZE.0 as f64 - 1.0);
    let expected = 2f64.to_radians() * corner;
    assert!((measured(&roll).0 - expected).abs() < 0.01 * expected, "{}, {expected}", measured(&roll).0);
}

#[test]
fn blur_of_three_and_of_sixty_pixels_is_found() {
    let (size, pad) = ((224, 176), 48);
    // Structure at all scales: a long blur leaves nothing of the finest.
    let fine = texture(size.0 + 2 * pad, size.1 + 2 * pad);
    let coarse = texture(40, 40);
    let latent = Plane::from_fn(fine.width, fine.height, |x, y| fine.at(x, y) + 2.0 * coarse.at(x / 8, y / 8));
    for (extent, limit) in [(3.0, 0.06), (60.0, 0.06)] {
        let truth = path(300.0, |t| Pose::planar(extent * t, 0.5 * extent * t * t, 0.3 * t, 1.0));
        let (blurred, weight) = shaken(&latent, pad, &truth, size);
        let frame = WholeFrame { latent: &latent, pad, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
        let found = frame.estimate(&search(Model::Rigid, None)).expect("texture determines it");
        let error = operator_error(&latent, pad, &found.tsf, &truth, size);
        assert!(error < limit, "{extent} px: operator error {error:.3}");
        let wide = tsf::extent(&found.tsf, size.0, size.1);
        assert!((0.7 * extent..1.4 * extent + 2.0).contains(&wide), "{extent} px: found {wide:.1}");
    }
}

#[test]
fn a_frame_that_lies_elsewhere_is_searched_from_there() {
    let pad = 40;
    let latent = seen(SIZE.0 + 2 * pad, SIZE.1 + 2 * pad);
    let base = Pose::planar(21.0, -17.0, 3.0, 1.0).homography(200.0);
    let moving = path(200.0, |t| Pose::planar(5.0 * t, 2.0 * t, 0.5 * t, 1.0));
    // Γ A for a planar A is planar: its translation is what Γ makes of A's.
    let composed: Vec<Pose> = moving
        .poses
        .iter()
        .map(|p| {
            let t = p.apply(200.0, DVec2::new(21.0, -17.0));
            Pose::planar(t.x, t.y, p.theta_z_deg + 3.0, p.weight)
        })
        .collect();
    let (blurred, weight) = shaken(&latent, pad, &Tsf::new(200.0, composed).unwrap(), SIZE);
    let frame = WholeFrame { latent: &latent, pad, blurred: &blurred, weight: &weight, base };
    let found = frame.estimate(&search(Model::Rigid, None)).expect("texture determines it");
    let error = operator_error(&latent, pad, &found.tsf, &moving, SIZE);
    assert!(error < 0.05, "operator error {error:.3}");
}

#[test]
fn refinement_brings_a_rough_tsf_home() {
    let latent = seen(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let truth = path(200.0, |t| Pose::planar(5.0 * t + 0.4, 3.0 * t * t, t, 1.0));
    let (blurred, weight) = shaken(&latent, PAD, &truth, SIZE);
    let frame = WholeFrame { latent: &latent, pad: PAD, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
    let grid = PoseGrid::new(SIZE.0, SIZE.1, 8, 1.5, 1.0);
    let rough = frame.fit_grid(&grid, None).expect("something fits");
    let fine = frame.refine(&rough, 8);
    let error = |t: &Tsf| operator_error(&latent, PAD, t, &truth, SIZE);
    let (a, b) = (error(&rough), error(&fine));
    assert!(b < 0.05 && b < 0.5 * a, "operator error {a:.3} on the grid, {b:.3} refined");
    // Whatever the poses, the taps keep the brightness.
    let taps = TapSet::new(&fine, SIZE.0, SIZE.1, Interpolation::Bilinear);
    assert!((taps.taps.iter().map(|t| t.weight).sum::<f64>() - 1.0).abs() < 1e-9);
}

#[test]
fn without_texture_there_is_no_sound_tsf() {
    let latent = Plane::filled(SIZE.0, SIZE.1, 2.0);
    let (blurred, weight) = shaken(&latent, 0, &path(200.0, |t| Pose::planar(5.0 * t, 0.0, 0.0, 1.0)), SIZE);
    // The sharp frames are noisy as well.
    let n = numbers(5, SIZE.0 * SIZE.1);
    let noisy = Plane { data: n.iter().map(|n| 2.0 + NOISE * n).collect(), ..latent };
    let frame = WholeFrame { latent: &noisy, pad: 0, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
    let found = frame.estimate(&search(Model::Rigid, None));
    assert!(!found.as_ref().is_some_and(tsf::Estimate::is_sound), "evidence {:.1}", found.unwrap().evidence);
}

#[test]
fn a_psf_knows_its_error() {
    let latent = texture(SIZE.0, SIZE.1);
    let taps = [(-4isize, 2isize, 0.25f32), (-2, 1, 0.25), (0, 0, 0.25), (3, -3, 0.25)];
    let blurred =
        Plane::from_fn(SIZE.0, SIZE.1, |x, y| taps.iter().map(|t| t.2 * latent.clamped(x as isize - t.0, y as isize - t.1)).sum());
    let patch = Patch { x: 40, y: 30, size: 64, score: 1.0 };
    let n = numbers(9, SIZE.0 * SIZE.1);
    let mut last = 0.0;
    for sigma in [0.002f32, 0.02, 0.2] {
        let noisy = Plane { data: blurred.data.iter().zip(&n).map(|(b, n)| b + sigma * 3f32.sqrt() * n).collect(), ..blurred };
        let weight = Plane::filled(SIZE.0, SIZE.1, 1.0 / (sigma * sigma));
        let m = psf::estimate_within(&latent, 0, &noisy, &weight, &patch, 5, &|u, v| u.abs() < 5 && v.abs() < 5).expect("rows are there");
        let value = |x: isize, y: isize| m.psf.values.at((x + 5) as usize, (y + 5) as usize);
        let (mut error, mut all) = (0.0f32, 0.0f32);
        for y in -5..=5 {
            for x in -5..=5 {
                let want = taps.iter().find(|t| (t.0, t.1) == (x, y)).map_or(0.0, |t| t.2);
                error += (value(x, y) - want).powi(2);
                all += want * want;
                assert!(value(x, y) == 0.0 || x.abs() < 5 && y.abs() < 5, "outside the support");
            }
        }
        let actual = f64::from((error / all).sqrt());
        // Differences share pixels, so that their noise is not quite white; the L1 term adds its bias.
        assert!((0.2..5.0).contains(&(m.expected_error / actual)), "noise {sigma}: expected {:.4}, actual {actual:.4}", m.expected_error);
        assert!(m.expected_error > 2.0 * last, "noise {sigma}: expected error {:.4} after {last:.4}", m.expected_error);
        last = m.expected_error;
    }
}

#[test]
fn a_patch_around_a_pixel_stays_inside() {
    let latent = texture(SIZE.0, SIZE.1);
    let weight = Plane::filled(SIZE.0, SIZE.1, 1.0);
    for ((x, y), corner) in [((0, 0), (0, 0)), ((159, 119), (112, 72)), ((80, 60), (56, 36))] {
        let p = psf::around(&latent, &weight, x, y, 48);
        assert_eq!((p.x, p.y, p.size), (corner.0, corner.1, 48));
        assert!(p.score > 0.0);
    }
}

#[test]
fn the_covariance_of_a_motion_is_that_of_its_path() {
    let poses = [(1.0, 2.0, 1.0), (3.0, 2.0, 1.0), (2.0, 5.0, 2.0)].map(|(x, y, w)| Pose::planar(x, y, 0.7 * x, w));
    let found = Tsf::new(200.0, poses.to_vec()).unwrap().covariance();
    // About (2, 3.5), weights of a quarter, a quarter and a half.
    let truth = glam::DMat2::from_cols_array(&[0.5, 0.0, 0.0, 2.25]);
    assert!(found.abs_diff_eq(truth, 1e-12), "{found:?}");
    let turned = [(0.0, 0.0), (1.0, 1.0)].map(|(x, y)| Pose::planar(x, y, 0.0, 1.0));
    let found = Tsf::new(200.0, turned.to_vec()).unwrap().covariance();
    assert!(found.abs_diff_eq(glam::DMat2::from_cols_array(&[0.25; 4]), 1e-12), "{found:?}");
    assert_eq!(Tsf::identity().covariance(), glam::DMat2::ZERO);
}
