//! Brackets without a sharp frame, on scenes and shakes that are planted.

use crate::oracle::blur as oracle;
use crate::support::{assert_close, f64s, noise, uniform};
use unshaken::blind::{self, FittedTo, Frame, Known, Lack, Operator, PatchSetup, Stage, Start, fix_warp};
use unshaken::image::Plane;
use unshaken::pose::{Pose, PoseGrid};
use unshaken::psf::{self, Patch, Psf};
use unshaken::tsf::{self, Interpolation, TapSet, Tsf};

/// A path of `n` poses from `from` to `to` (x, y, degrees), bent in the middle by `bend` pixels.
fn path(n: usize, from: [f64; 3], to: [f64; 3], bend: f64) -> Tsf {
    let poses = (0..n)
        .map(|i| {
            let t = i as f64 / (n - 1) as f64;
            let at = |k: usize| from[k] + (to[k] - from[k]) * t;
            Pose::planar(at(0), at(1) + bend * (4.0 * t * (1.0 - t) - 0.66), at(2), 1.0)
        })
        .collect();
    Tsf::new(150.0, poses).unwrap()
}

#[test]
fn the_blur_of_a_plane_and_its_adjoint_are_the_matrix() {
    // Wider than a block of the rows, and not by whole blocks.
    let (size, pad) = ((43, 8), 4);
    let yaw =
        Tsf::new(40.0, vec![Pose { theta_y_deg: 2.0, ..Pose::planar(0.3, -0.8, 1.0, 0.5) }, Pose::planar(-1.2, 0.6, -2.0, 0.5)]).unwrap();
    // So far turned that a block passes several rows.
    let turned = path(3, [0.5, 0.0, 8.0], [-0.5, 0.3, 9.0], 0.2);
    for tsf in [path(7, [-2.0, 1.0, -3.0], [1.5, -1.2, 4.0], 0.7), yaw, turned] {
        let taps = TapSet::shifted(&tsf, size.0, size.1, Interpolation::Bicubic);
        let k = oracle::of_taps(&taps, Interpolation::Bicubic, size, pad);
        let operator = Operator::new(&tsf, size.0, size.1, pad);
        let (e, r) = (uniform(1, k.columns, 0.1, 2.0), noise(2, size.0 * size.1));
        // Where K looks beyond the latent grid the matrix sees part of a pixel, the operator none of it; both are masked.
        let inside = operator.inside();
        assert!(inside.iter().filter(|i| **i).count() > 30, "most of the frame is inside");
        let masked: Vec<f32> = r.iter().zip(&inside).map(|(v, i)| if *i { *v } else { 0.0 }).collect();
        let expected = k.apply(&f64s(&e));
        // f32 sums of some dozens of weights of at most 1.
        assert_close("K E", &operator.forward(&e), &expected, |q| if inside[q] { 3e-6 } else { f64::INFINITY });
        assert_close("K^T r", &operator.adjoint(&masked), &k.transposed(&f64s(&masked)), |_| 3e-6);
    }
}

#[test]
fn fixing_the_warp_moves_every_point_as_before() {
    let mut tsfs = vec![path(5, [1.0, 2.0, 0.3], [3.0, -1.0, 0.9], 0.5), path(4, [-3.0, 0.0, -0.5], [2.0, 5.0, 0.2], 0.0)];
    let before = tsfs.clone();
    let m = fix_warp(&mut tsfs, 0);
    let mean = tsfs[0].mean();
    assert!(mean.theta_z_deg.abs() < 1e-12 && mean.t_x.hypot(mean.t_y) < 0.02, "the reference rests: {mean:?}");
    for (new, old) in tsfs.iter().zip(&before) {
        for (p, q) in new.poses.iter().zip(&old.poses) {
            let x = glam::DVec2::new(70.0, -40.0);
            let moved = p.apply(150.0, m.apply(150.0, x));
            assert!((moved - q.apply(150.0, x)).length() < 1e-9, "{moved} is not {}", q.apply(150.0, x));
        }
    }
}

#[test]
fn fixing_the_warp_moves_displaced_frames_as_before() {
    let base = glam::DMat3::from_translation(glam::DVec2::new(12.0, -7.0)) * glam::DMat3::from_rotation_z(0.01);
    let mut tsfs = vec![path(5, [1.0, 2.0, 0.3], [3.0, -1.0, 0.9], 0.5), path(4, [-3.0, 0.0, -0.5], [2.0, 5.0, 0.2], 0.0).about(base)];
    let before = tsfs.clone();
    let m = fix_warp(&mut tsfs, 0).homography(150.0);
    assert_eq!(tsfs[1].poses, before[1].poses, "its poses stay about its base");
    let x = glam::DVec2::new(70.0, -40.0);
    let moved = unshaken::pose::project(&tsfs[1].base, unshaken::pose::project(&m, x));
    let old = unshaken::pose::project(&base, x);
    assert!((moved - old).length() < 1e-9, "{moved} is not {old}");
}

/// Tiles of random brightness with a little texture: edges in all places, two decades.
fn tiles(width: usize, height: usize) -> Plane {
    let levels = uniform(5, 4096, -1.5, 1.5);
    let grain = noise(6, width * height);
    Plane::from_fn(width, height, |x, y| {
        let (u, v) = ((x + y / 3) / 9, (y + 400 - x / 5) / 7);
        (levels[(u * 61 + v * 17) % 4096] + 0.03 * grain[y * width + x]).exp()
    })
}

const SIZE: (usize, usize) = (72, 60);
const PAD: usize = 20;

/// Three frames of `tiles` under `tsfs`, noise of half a per cent.
fn frames(latent: &Plane, tsfs: &[Tsf]) -> Vec<Frame> {
    frames_of(SIZE, latent, tsfs, 50)
}

fn frames_of(size: (usize, usize), latent: &Plane, tsfs: &[Tsf], seed: u64) -> Vec<Frame> {
    let frame = |(k, tsf): (usize, &Tsf)| {
        let clean = Operator::new(tsf, size.0, size.1, PAD).forward(&latent.data);
        // The sum of twelve uniform numbers, less their mean, is close to a normal one.
        let draws = uniform(seed + k as u64, 12 * clean.len(), 0.0, 1.0);
        let noisy = clean.iter().enumerate().map(|(p, v)| v + 0.005 * (draws[12 * p..12 * p + 12].iter().sum::<f32>() - 6.0));
        let of = |value: f32| Plane::filled(size.0, size.1, value);
        let blurred = Plane { data: noisy.collect(), ..of(0.0) };
        Frame { blurred, variance: of(0.005 * 0.005), mask: of(1.0), clipped: vec![false; size.0 * size.1] }
    };
    tsfs.iter().enumerate().map(frame).collect()
}

/// Root mean square difference of logarithms away from the border.
fn difference(a: &Plane, b: &Plane) -> f64 {
    let inner: Vec<usize> = (12..SIZE.1 - 12).flat_map(|y| (12..SIZE.0 - 12).map(move |x| y * SIZE.0 + x)).collect();
    (inner.iter().map(|&p| f64::from((a.data[p] / b.data[p]).ln()).powi(2)).sum::<f64>() / inner.len() as f64).sqrt()
}

fn mean(frames: &[Frame]) -> Plane {
    let n = frames.len() as f32;
    Plane {
        data: (0..SIZE.0 * SIZE.1).map(|p| frames.iter().map(|f| f.blurred.data[p]).sum::<f32>() / n).collect(),
        ..frames[0].blurred.clone()
    }
}

fn as_placed<'a>(scene: &'a Plane, tsfs: &'a [Tsf]) -> Known<'a> {
    Known { scene, tsfs, first: None }
}

fn still() -> Vec<Tsf> {
    vec![Tsf::identity(); 3]
}

fn shakes() -> Vec<Tsf> {
    let mut tsfs = vec![
        path(9, [-1.5, 0.5, -0.3], [1.5, -0.5, 0.3], 0.8),
        path(11, [2.0, -2.5, 0.4], [-1.0, 2.0, -0.2], 1.0),
        path(13, [-4.0, -1.0, 0.2], [3.5, 2.0, 0.8], -2.0),
    ];
    fix_warp(&mut tsfs, 0);
    tsfs
}

#[test]
fn known_tsfs_give_the_scene() {
    let latent = tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let truth = latent.crop(PAD, PAD, SIZE.0, SIZE.1);
    let tsfs = shakes();
    let frames = frames(&latent, &tsfs);
    let merged = mean(&frames);
    let found = blind::luminance_of(&frames, &tsfs, &merged, 14).crop(14, 14, SIZE.0, SIZE.1);
    let (start, end) = (difference(&merged, &truth), difference(&found, &truth));
    assert!(end < 0.2 * start, "the blurred merge is {start:.3} off, the solution {end:.3}");
}

#[test]
fn scene_and_shakes_are_found_together() {
    let latent = tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let truth = latent.crop(PAD, PAD, SIZE.0, SIZE.1);
    let frames = frames(&latent, &shakes());
    let merged = mean(&frames);
    let starts = [Start { reference: 0, luminance: frames[0].blurred.clone() }];
    let mut last = 0.0;
    let found = blind::estimate(&frames, &starts, None, &as_placed(&merged, &still()), &mut |s| {
        assert!(s.fraction >= last && s.fraction <= 1.001, "progress goes on: {last} to {}", s.fraction);
        last = s.fraction;
        true
    })
    .unwrap();
    let (single, end) = (difference(&frames[0].blurred, &truth), difference(&found.luminance, &truth));
    assert!(end < 0.6 * single, "the least blurred frame is {single:.3} off, the estimate {end:.3}");
    assert!(found.tsfs[0].mean().t_x.hypot(found.tsfs[0].mean().t_y) < 0.05, "the reference frame rests");
    for (joint, alone) in found.held_out.iter().zip(&found.held_out_merge) {
        assert!(*joint < 0.25 * alone, "held-out residuals {joint:.1}, those of a merge {alone:.1}");
    }
}

/// Texture of all sizes down to a pixel, as in nature.
fn texture(width: usize, height: usize) -> Plane {
    let grain = |radius: usize, seed: u64| {
        let side = (2 * radius + 1) as f32;
        Plane { width, height, data: noise(seed, width * height) }.box_sum(radius).map(|v| 0.4 * v / side)
    };
    let scales: Vec<Plane> = [0, 1, 2, 5, 12].into_iter().zip(90..).map(|(radius, seed)| grain(radius, seed)).collect();
    Plane::from_fn(width, height, |x, y| 0.3 * scales.iter().map(|p| p.at(x, y)).sum::<f32>().exp())
}

/// `hard` as a lens shows it whose blur has a standard deviation of `sigma` pixels.
fn behind_lens(hard: &Plane, sigma: f32) -> Plane {
    let weight = |x: isize, y: isize| (-0.5 * (x * x + y * y) as f32 / (sigma * sigma)).exp();
    let around: Vec<(isize, isize)> = (-4..=4).flat_map(|y| (-4..=4).map(move |x| (x, y))).collect();
    let sum: f32 = around.iter().map(|&(x, y)| weight(x, y)).sum();
    Plane::from_fn(hard.width, hard.height, |x, y| {
        let at = |(i, j): (isize, isize)| {
            hard.at(x.saturating_add_signed(i).min(hard.width - 1), y.saturating_add_signed(j).min(hard.height - 1))
        };
        around.iter().map(|&(i, j)| weight(i, j) * at((i, j))).sum::<f32>() / sum
    })
}

/// All frames behind a lens of 0.8 px: without one of its own the estimate would have a harder scene and TSFs that are thicker by it, and
/// explain the frames less well.
#[test]
fn what_a_lens_does_is_no_motion() {
    let hard = texture(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let tsfs = shakes();
    let spread = |t: &Tsf| t.covariance().col(0).x + t.covariance().col(1).y;
    let found = |latent: &Plane| {
        let frames = frames(latent, &tsfs);
        let starts = [Start { reference: 0, luminance: frames[0].blurred.clone() }];
        let found = blind::estimate(&frames, &starts, None, &as_placed(&mean(&frames), &still()), &mut |_| true).unwrap();
        let truth = latent.crop(PAD, PAD, SIZE.0, SIZE.1);
        let off = difference(&found.luminance, &truth) / difference(&frames[0].blurred, &truth);
        let thicker: Vec<f64> = found.tsfs.iter().zip(&tsfs).map(|(f, t)| spread(f) - spread(t)).collect();
        println!("lens {} px, {off:.2} of the first frame's error, thicker by {thicker:.2?} px^2, {:?}", found.lens_px, found.ways);
        (found.lens_px, off, thicker)
    };
    let soft = behind_lens(&hard, 0.8);
    let (lens_px, off, thicker) = found(&soft);
    assert!((0.5..1.2).contains(&lens_px), "{lens_px} px");
    assert!(off < 0.6, "{off:.2} of the first frame's error");
    assert!(thicker.iter().all(|t| *t < 0.64), "thicker by {thicker:.2?} px^2 where the lens has 1.28");
    assert_eq!(found(&hard).0, 0.0, "hard edges are behind no lens");
}

/// Whichever comes first.
#[test]
fn of_two_starts_the_one_that_explains_more_goes_on() {
    let frames = frames(&tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD), &shakes());
    let merged = mean(&frames);
    let residual = |references: &[usize]| {
        let starts: Vec<Start> =
            references.iter().map(|&reference| Start { reference, luminance: frames[reference].blurred.clone() }).collect();
        let found = blind::estimate(&frames, &starts, None, &as_placed(&merged, &still()), &mut |_| true).unwrap();
        (found.reference, blind::geometric_mean(&found.held_out))
    };
    let alone = [residual(&[0]), residual(&[2])];
    let better = if alone[0].1 < alone[1].1 { alone[0] } else { alone[1] };
    println!("{alone:?}");
    assert!((alone[0].1 / alone[1].1).ln().abs() > 0.05, "the starts differ: {alone:?}");
    assert_eq!(residual(&[0, 2]), better);
    assert_eq!(residual(&[2, 0]), better);
}

#[test]
fn a_still_bracket_is_explained_as_well_by_a_merge() {
    let latent = tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let frames = frames(&latent, &[Tsf::identity(), Tsf::identity(), Tsf::identity()]);
    let merged = mean(&frames);
    let found =
        blind::estimate(&frames, &[Start { reference: 0, luminance: merged.clone() }], None, &as_placed(&merged, &still()), &mut |_| true)
            .unwrap();
    for (joint, alone) in found.held_out.iter().zip(&found.held_out_merge) {
        assert!(*joint > 0.8 * alone, "nothing is left to win: {joint} against {alone}");
    }
}

/// A frame of more than 250 px has a second level.
#[test]
fn cross_validated_tsfs_explain_pixels_that_were_not_seen_better() {
    let size = (264, 48);
    let frames = frames_of(size, &tiles(size.0 + 2 * PAD, size.1 + 2 * PAD), &shakes(), 50);
    let starts = [Start { reference: 0, luminance: frames[0].blurred.clone() }];
    let merged = &frames[1].blurred;
    let mut last = Stage { scale: 2, fraction: 0.0 };
    let found = blind::estimate(&frames, &starts, None, &as_placed(merged, &still()), &mut |s| {
        assert!(s.fraction > last.fraction && s.scale <= last.scale, "progress goes on: {last:?} to {s:?}");
        last = s;
        true
    })
    .unwrap();
    assert!(last.scale == 1 && (last.fraction - 1.0).abs() < 1e-3, "the end is announced as {last:?}");
    assert!(
        [FittedTo::Best, FittedTo::Drawn, FittedTo::Unseen].iter().all(|f| found.ways.iter().any(|w| w.fitted_to == *f)),
        "{:?}",
        found.ways
    );
    let (best, next) = (found.ways[0], found.ways[1]);
    assert!(found.ways.len() == 3 && found.ways[2].held_out >= next.held_out, "{:?}", found.ways);
    assert!(best.fitted_to == FittedTo::Unseen && best.held_out < 0.8 * next.held_out, "{:?}", found.ways);
    // The second level is the last one here.
    let end = blind::geometric_mean(&found.held_out);
    assert!((end - best.held_out).abs() < 1e-9 * end, "{:?} and in the end {end}", found.ways);
    let merge = blind::geometric_mean(&found.held_out_merge);
    assert!(end < 0.25 * merge, "{end}, the merge {merge}");
}

#[test]
fn the_joint_estimate_can_be_cancelled() {
    let frames = frames(&tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD), &shakes());
    let starts = [Start { reference: 0, luminance: frames[0].blurred.clone() }];
    let mut calls = 0;
    let found = blind::estimate(&frames, &starts, None, &as_placed(&mean(&frames), &still()), &mut |_| {
        calls += 1;
        calls < 2
    });
    assert!(found.is_none() && calls == 2);
}

/// Half-pixel shifts of up to `most` pixels.
fn planted(seed: u64, count: usize, most: f32) -> Vec<(f64, f64)> {
    let numbers = uniform(seed, 2 * count, -2.0 * most, 2.0 * most);
    numbers.chunks(2).map(|s| (f64::from(s[0].round()) / 2.0, f64::from(s[1].round()) / 2.0)).collect()
}

/// Nine patches over a `size` frame.
fn nine(size: (usize, usize), side: usize) -> Vec<Patch> {
    let at = |k: usize, n: usize| k * (n - side) / 2;
    (0..9).map(|i| Patch { x: at(i % 3, size.0), y: at(i / 3, size.1), size: side, score: 1.0 }).collect()
}

fn centred(p: &Patch, size: (usize, usize)) -> glam::DVec2 {
    let c = p.centre();
    glam::DVec2::new(c.0 - (size.0 as f64 - 1.0) / 2.0, c.1 - (size.1 as f64 - 1.0) / 2.0)
}

/// What is left of `shifts` once the shift and the small rotation of all that explain most of them are taken off, pixels: neither changes
/// what a TSF can explain.
fn left_over(shifts: &[(f64, f64)], places: &[glam::DVec2]) -> f64 {
    let n = shifts.len() as f64;
    let mean = shifts.iter().fold(glam::DVec2::ZERO, |s, v| s + glam::DVec2::new(v.0, v.1)) / n;
    let centre = places.iter().copied().sum::<glam::DVec2>() / n;
    let apart = || shifts.iter().zip(places).map(|(s, p)| (glam::DVec2::new(s.0, s.1) - mean, *p - centre));
    let angle = apart().map(|(s, p)| p.perp_dot(s)).sum::<f64>() / apart().map(|(_, p)| p.length_squared()).sum::<f64>();
    apart().map(|(s, p)| (s - angle * p.perp()).abs().max_element()).fold(0.0, f64::max)
}

#[test]
fn psfs_of_a_frame_find_back_from_planted_shifts() {
    let size = (200, 160);
    let truth = path(40, [-3.0, 1.0, -0.8], [2.5, -1.5, 0.9], 2.0);
    let patches = nine(size, 40);
    let places: Vec<glam::DVec2> = patches.iter().map(|p| centred(p, size)).collect();
    let shifts = planted(7, 9, 2.0);
    let psfs: Vec<(Patch, Psf)> =
        patches.iter().zip(&places).zip(&shifts).map(|((p, at), s)| (*p, tsf::shifted(&tsf::psf_at(&truth, *at, 10), *s))).collect();
    let found = tsf::align_within(&psfs, &PoseGrid::new(size.0, size.1, 8, 1.5, 1.0), size.0, size.1).unwrap();
    let whole: Vec<(f64, f64)> = shifts.iter().zip(&found.shifts).map(|(a, b)| (a.0 + b.0, a.1 + b.1)).collect();
    let (before, after) = (left_over(&shifts, &places), left_over(&whole, &places));
    assert!(before > 1.2, "the planted shifts are {before:.2} px");
    assert!(after <= 0.5, "PSFs are left {after:.2} px apart");
    assert!(found.error < 0.1, "the TSF leaves {:.2} of the PSFs unexplained", found.error);
}

#[test]
fn psfs_across_frames_find_back_from_planted_shifts() {
    let latent = tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let tsfs = shakes();
    let frames = frames(&latent, &tsfs);
    let patches: Vec<Patch> = nine(SIZE, 48).into_iter().filter(|p| p.x != 12 && p.y != 6).collect();
    let shifts = planted(9, patches.len(), 2.0);
    let psfs: Vec<(Patch, Psf)> =
        patches.iter().zip(&shifts).map(|(p, s)| (*p, tsf::shifted(&tsf::psf_at(&tsfs[1], centred(p, SIZE), 8), *s))).collect();
    let everywhere = Plane::filled(SIZE.0, SIZE.1, 1.0);
    let found = tsf::align_across(&psfs, &tsfs[0], (&frames[0].blurred, &frames[1].blurred), &everywhere);
    assert_eq!(found.len(), 4);
    for (s, f) in shifts.iter().zip(&found) {
        assert!((s.0 + f.0).abs() <= 0.5 && (s.1 + f.1).abs() <= 0.5, "planted {s:?}, found {f:?}");
    }
}

/// Smallest ‖S h - truth‖ / ‖truth‖ over shifts of half pixels.
fn up_to_shift(h: &Psf, truth: &Psf) -> f64 {
    let norm = |f: &dyn Fn(usize) -> f32| (0..truth.values.data.len()).map(|i| f64::from(f(i)).powi(2)).sum::<f64>().sqrt();
    let error = |s: (f64, f64)| {
        let moved = tsf::shifted(h, s);
        norm(&|i| moved.values.data[i] - truth.values.data[i]) / norm(&|i| truth.values.data[i])
    };
    let steps = || (-8..=8).map(|k| f64::from(k) / 2.0);
    steps().flat_map(|y| steps().map(move |x| (x, y))).map(error).fold(f64::INFINITY, f64::min)
}

/// Two frames of 64 x 64 pixels under translations.
fn pair() -> (Vec<Frame>, [Psf; 2]) {
    let latent = tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD);
    let moves = [path(9, [-1.5, 0.5, 0.0], [1.5, -0.5, 0.0], 0.8), path(15, [-2.0, -2.5, 0.0], [2.0, 2.0, 0.0], 1.5)];
    let psfs = moves.each_ref().map(|t| tsf::psf_at(t, glam::DVec2::ZERO, 5));
    (frames(&latent, &moves), psfs)
}

#[test]
fn a_pair_of_patches_tells_both_psfs() {
    let (frames, truth) = pair();
    let (cut, weight) = (|p: &Plane| p.crop(6, 0, 60, 60), Plane::filled(60, 60, 1.0));
    let setup = psf::Setup { radius: 5, ..psf::Setup::default() };
    let found = psf::estimate_pair(&cut(&frames[0].blurred), &cut(&frames[1].blurred), [&weight, &weight], &setup).unwrap();
    for (h, t) in found.psfs.iter().zip(&truth) {
        assert!((h.values.data.iter().sum::<f32>() - 1.0).abs() < 1e-3 && h.values.data.iter().all(|v| *v >= 0.0));
        let point = Psf { radius: 5, values: Plane::from_fn(11, 11, |x, y| if (x, y) == (5, 5) { 1.0 } else { 0.0 }) };
        let (error, none) = (up_to_shift(h, t), up_to_shift(&point, t));
        assert!(error < 0.6 * none, "the PSF is {error:.2} off, a point {none:.2}");
    }
}

#[test]
fn a_pair_without_measurements_tells_nothing() {
    let (frames, _) = pair();
    let (cut, dark) = (|p: &Plane| p.crop(6, 0, 60, 60), Plane::filled(60, 60, 0.0));
    let weight = dark.map(|_| 1.0);
    let estimate = |a: &Plane, b: &Plane, w: [&Plane; 2], radius: usize| {
        psf::estimate_pair(a, b, w, &psf::Setup { radius, rounds: 1, ..psf::Setup::default() })
    };
    let (a, b) = (cut(&frames[0].blurred), cut(&frames[1].blurred));
    assert!(estimate(&a, &b, [&weight, &dark], 5).is_none(), "masked");
    assert!(estimate(&dark, &dark, [&weight, &weight], 5).is_none(), "black");
    assert!(estimate(&a, &b, [&weight, &weight], 16).is_none(), "smaller than the PSF allows");
    assert!(estimate(&a, &b, [&weight, &weight], 5).is_some());
}

#[test]
fn patches_can_be_cancelled_and_say_which_frame_lacks_texture() {
    let mut frames = frames(&tiles(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD), &shakes());
    let pair = psf::Setup { radius: 4, rounds: 1, ..psf::Setup::default() };
    let setup = PatchSetup { count: 2, side: 40, pair };
    assert_eq!(blind::from_patches(&frames, 0, &setup, &mut |_| false).err(), Some(Lack::Cancelled));
    frames[2].mask = frames[2].mask.map(|_| 0.0);
    assert_eq!(blind::from_patches(&frames, 0, &setup, &mut |_| true).err(), Some(Lack::Texture(2)));
}
