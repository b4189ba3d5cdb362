//! The synthetic brackets against the physics that they claim.

use crate::support::files::shared;
use unshaken::image::{Plane, Rgb};
use unshaken::pose::Pose;
use unshaken::random::Random;
use unshaken::response::Response;
use unshaken::synth::{self, Camera, Drawn, GyroRecord, Motion, Scene, Shake, Tremor, Wobble};
use unshaken::tsf::Tsf;

fn tremor() -> Tremor {
    Tremor { extent_px: 9.0, roll_deg: 2.0, offset_px: 1.5, offset_deg: 0.3 }
}

/// A latent scene without edges, in centred frame coordinates, asymmetric in every way.
fn waves(x: f64, y: f64) -> f64 {
    ((0.27 * x + 0.11 * y).sin() + 0.8 * (0.31 * y - 0.07 * x).cos() + 0.02 * x).exp()
}

/// The blurred frame written out from the pose convention, not through `Pose`, and from the formula of the scene, not its
/// samples: `p_frame = R(θ) p_scene + t` about the centre, x right, y down. `signs` multiplies t_x, t_y and θ, to see what a
/// wrong convention would give.
fn blur(width: usize, height: usize, poses: &[Pose], signs: [f64; 3]) -> Plane {
    let (cx, cy) = ((width - 1) as f64 / 2.0, (height - 1) as f64 / 2.0);
    Plane::from_fn(width, height, |x, y| {
        let at = |p: &Pose| {
            let (sin, cos) = (signs[2] * p.theta_z_deg).to_radians().sin_cos();
            let (dx, dy) = (x as f64 - cx - signs[0] * p.t_x, y as f64 - cy - signs[1] * p.t_y);
            p.weight * waves(cos * dx + sin * dy, -sin * dx + cos * dy)
        };
        poses.iter().map(at).sum::<f64>() as f32
    })
}

/// Relative error of log irradiance in the interior, where nothing from beyond the frame comes in.
fn error(a: &Plane, b: &Plane) -> f64 {
    let (mut sum, mut n) = (0.0, 0);
    for y in 16..a.height - 16 {
        for x in 16..a.width - 16 {
            sum += f64::from(a.at(x, y) / b.at(x, y)).ln().powi(2);
            n += 1;
        }
    }
    (sum / f64::from(n)).sqrt()
}

#[test]
fn the_tsf_explains_the_blurred_frame_and_no_mirrored_one_does() {
    let (width, height, margin) = (160, 120, 24);
    let place = |i: usize, n: usize| (i as f64 - 0.5) / 2.0 - margin as f64 - (n - 1) as f64 / 2.0;
    let samples =
        Plane::from_fn(2 * (width + 2 * margin), 2 * (height + 2 * margin), |i, j| waves(place(i, width), place(j, height)) as f32);
    let scene = Scene { samples: Rgb([samples.clone(), samples.clone(), samples]), margin, oversampling: 2 };
    let tsf = tremor().tsf(width, height, 0.5, 7, 1).unwrap();
    let frame = synth::expose(&scene, &tsf).0[1].clone();
    let right = error(&blur(width, height, &tsf.poses, [1.0; 3]), &frame);
    // The pixel's box and the interpolation between samples damp waves of 20 px by half a percent.
    assert!(right < 0.01, "relative error {right}");
    for signs in [[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]] {
        let wrong = error(&blur(width, height, &tsf.poses, signs), &frame);
        assert!(wrong > 10.0 * right, "signs {signs:?}: {wrong}, right: {right}");
    }
}

#[test]
fn one_pose_moves_the_scene_right_and_down() {
    let scene = synth::room(96, 80, 16, 3);
    let truth = synth::expose(&scene, &synth::identity(96));
    let moved = synth::expose(&scene, &Tsf::new(115.0, vec![Pose::planar(3.0, 2.0, 0.0, 1.0)]).unwrap());
    for (a, b) in truth.0.iter().zip(&moved.0) {
        let (a, b) = (a.crop(10, 10, 60, 50), b.crop(13, 12, 60, 50));
        assert!(a.data.iter().zip(&b.data).all(|(a, b)| (a / b - 1.0).abs() < 1e-4));
    }
}

#[test]
fn the_path_is_smooth_short_stepped_and_as_large_as_asked() {
    for seed in 0..5 {
        let tsf = tremor().tsf(160, 120, 2.0, seed, 1).unwrap();
        let weights: f64 = tsf.poses.iter().map(|p| p.weight).sum();
        assert!((weights - 1.0).abs() < 1e-9);
        for w in tsf.poses.windows(2) {
            let step = (w[1].t_x - w[0].t_x).hypot(w[1].t_y - w[0].t_y) + (w[1].theta_z_deg - w[0].theta_z_deg).abs().to_radians() * 100.0;
            assert!(step < 0.26, "seed {seed}: step {step} px");
        }
        let range = |f: &dyn Fn(&Pose) -> f64| {
            let v: Vec<f64> = tsf.poses.iter().map(f).collect();
            v.iter().copied().fold(f64::MIN, f64::max) - v.iter().copied().fold(f64::MAX, f64::min)
        };
        let extent = range(&|p| p.t_x).max(range(&|p| p.t_y));
        assert!((extent - 9.0).abs() < 0.2, "seed {seed}: {extent} px");
        assert!((range(&|p| p.theta_z_deg) - 2.0).abs() < 0.1);
        let mean = tsf.mean();
        assert!(mean.t_x.abs() <= 1.5 && mean.t_y.abs() <= 1.5 && mean.theta_z_deg.abs() <= 0.3, "{mean:?}");
        assert!(tsf.poses.iter().all(|p| (p.t_x - p.t_x.round()).abs() > 1e-9), "on the grid");
    }
}

#[test]
fn noise_has_the_variance_of_shot_read_and_quantisation() {
    let camera = Camera { full_well: 900.0, read_noise: 5.0, response: Response::Linear, ..Camera::default() };
    for level in [0.05f64, 0.2, 0.7] {
        let frame = camera.photograph("flat", &Rgb::filled(300, 300, level as f32 * 4.0), 0.25, 5, 1);
        for plane in &frame.intensity.0 {
            let n = plane.data.len() as f64;
            let mean = plane.data.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
            let variance = plane.data.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
            let expected = level / 900.0 + (5.0f64 / 900.0).powi(2) + 1.0 / (12.0 * 255.0 * 255.0);
            // 90000 samples: the variance scatters by sqrt(2 / n) = 0.5 %, the mean by sqrt(expected / n).
            assert!((variance / expected - 1.0).abs() < 0.025, "level {level}: variance {variance}, expected {expected}");
            assert!((mean - level).abs() < 5.0 * (expected / n).sqrt(), "level {level}: mean {mean}");
        }
        let [r, g, _] = &frame.intensity.0;
        assert_ne!(r, g, "channels have noise of their own");
    }
}

#[test]
fn poisson_counts_have_their_moments() {
    let mut random = Random::new(9, 9);
    for mean in [0.3, 4.0, 12.0, 40.0, 3000.0] {
        let n = 100_000;
        let draws: Vec<f64> = (0..n).map(|_| random.poisson(mean)).collect();
        let average = draws.iter().sum::<f64>() / f64::from(n);
        let moment = |k: i32| draws.iter().map(|v| (v - average).powi(k)).sum::<f64>() / f64::from(n);
        assert!((average - mean).abs() < 5.0 * (mean / f64::from(n)).sqrt(), "mean {mean}: {average}");
        assert!((moment(2) / mean - 1.0).abs() < 5.0 * ((2.0 + 1.0 / mean) / f64::from(n)).sqrt(), "mean {mean}: variance {}", moment(2));
        // The third central moment of a Poisson is its mean; its estimate scatters by about sqrt(15 / n) σ³ (more for small means).
        let scatter = ((15.0 + 40.0 / mean) / f64::from(n)).sqrt() * mean.powf(1.5);
        assert!((moment(3) - mean).abs() < 5.0 * scatter, "mean {mean}: third moment {}", moment(3));
    }
    assert_eq!(random.poisson(0.0), 0.0);
}

#[test]
fn the_response_and_the_white_point_are_the_cameras() {
    let camera = Camera { full_well: 1e9, read_noise: 0.0, ..Camera::default() };
    for (exposure, code) in [(0.0, 0.0f32), (0.002, 7.0), (0.214_041, 128.0), (0.5, 188.0), (1.5, 255.0)] {
        let frame = camera.photograph("flat", &Rgb::filled(3, 2, exposure / 0.5), 0.5, 1, 1);
        let got = frame.intensity.0[2].data[0] * 255.0;
        assert!((got - code).abs() <= 0.01, "{exposure}: code {got}, expected {code}");
    }
}

#[test]
fn seeds_reproduce() {
    let scene = synth::room(64, 48, 20, 3);
    let make = |seed| synth::capture(&scene, &Camera::default(), &[(0.1, None), (0.5, Some(tremor()))], 0.05, seed).unwrap();
    let (a, b, c) = (make(1), make(1), make(2));
    for i in 0..2 {
        assert_eq!(a.bracket.frames()[i].intensity, b.bracket.frames()[i].intensity);
        assert_ne!(a.bracket.frames()[i].intensity, c.bracket.frames()[i].intensity);
    }
    assert_eq!(a.tsfs, b.tsfs);
    assert_ne!(a.tsfs[1], c.tsfs[1]);
    assert_eq!(a.sharp, [true, false]);
    assert!(a.tsfs[0].is_identity());
    assert_eq!(a.truth, c.truth, "the scene does not depend on the shake");
    assert_eq!(synth::room(64, 48, 20, 3).samples, scene.samples);
    assert_ne!(synth::room(64, 48, 20, 4).samples, scene.samples);
}

#[test]
fn the_room_spans_almost_five_decades() {
    let truth = synth::expose(&synth::room(256, 192, 16, 1), &synth::identity(256));
    assert_eq!(truth.size(), (256, 192));
    let mut lum = truth.mean().data;
    assert!(lum.iter().all(|v| v.is_finite() && *v > 0.0));
    lum.sort_by(f32::total_cmp);
    assert!(lum[lum.len() - 1] / lum[0] > 5e4, "{} .. {}", lum[0], lum[lum.len() - 1]);
}

/// A dark scene with one bright point: samples of the pixel (x, y) of a `width` x `height` frame.
fn point(width: usize, height: usize, margin: usize, oversampling: usize, (x, y): (usize, usize)) -> Scene {
    let n = oversampling;
    let inside = |i: usize, k: usize| i / n == k + margin;
    let samples =
        Plane::from_fn(n * (width + 2 * margin), n * (height + 2 * margin), |i, j| if inside(i, x) && inside(j, y) { 1.0 } else { 0.0 });
    Scene { samples: Rgb([samples.clone(), samples.clone(), samples]), margin, oversampling }
}

/// Part of a box of width 1 smeared along 0..`length` that falls into the pixel at `u`: the trapezium of the two boxes' convolution,
/// integrated over the pixel.
fn smeared(u: f64, length: f64) -> f64 {
    // Density at v of box(1) * box(length): overlap of [v - 1/2, v + 1/2] with [0, length], over length.
    let density = |v: f64| ((v + 0.5).min(length) - (v - 0.5).max(0.0)).max(0.0) / length;
    let n = 2000;
    (0..n).map(|k| density(u - 0.5 + (f64::from(k) + 0.5) / f64::from(n))).sum::<f64>() / f64::from(n)
}

#[test]
fn a_straight_motion_smears_a_point_by_the_analytic_psf() {
    let (width, height) = (41, 31);
    for (oversampling, tolerance) in [(2, 0.02), (4, 0.006), (7, 0.004)] {
        let scene = point(width, height, 4, oversampling, (12, 15));
        // Straight to the right through 7.3 px at even speed, 1/20 px apart.
        let n = 146;
        let poses = (0..n).map(|k| Pose::planar(7.3 * (f64::from(k) + 0.5) / f64::from(n), 0.0, 0.0, 1.0)).collect();
        let image = synth::expose(&scene, &Tsf::new(50.0, poses).unwrap());
        let got = |x: usize, y: usize| f64::from(image.0[0].at(x, y));
        // A pixel-wide box, integrated by a pixel-wide sensor: rows beside the point's get nothing.
        let total: f64 = (0..width).map(|x| got(x, 15)).sum();
        assert!((total - 1.0).abs() < 1e-4, "{oversampling}: {total}");
        assert!((0..width).all(|x| got(x, 14).abs() < 1e-6 && got(x, 16).abs() < 1e-6));
        for x in 0..width {
            let expected = smeared(x as f64 - 12.0, 7.3);
            assert!((got(x, 15) - expected).abs() < tolerance * 0.5, "{oversampling} samples: {} at {x}, analytic {expected}", got(x, 15));
        }
    }
}

#[test]
fn a_turn_about_the_centre_smears_a_point_along_its_arc() {
    let (width, height) = (81, 61);
    let scene = point(width, height, 4, 4, (70, 30));
    let n = 200;
    let poses = (0..n).map(|k| Pose::planar(0.0, 0.0, 8.0 * (f64::from(k) + 0.5) / f64::from(n), 1.0)).collect();
    let image = synth::expose(&scene, &Tsf::new(97.0, poses).unwrap());
    // 30 px right of the centre, clockwise on the screen by 8 degrees: down by 30 sin 8°, mean at half of it.
    let (mut sum, mut cx, mut cy) = (0.0, 0.0, 0.0);
    for y in 0..height {
        for x in 0..width {
            let v = f64::from(image.0[1].at(x, y));
            (sum, cx, cy) = (sum + v, cx + v * (x as f64 - 40.0), cy + v * (y as f64 - 30.0));
        }
    }
    let a = 8f64.to_radians();
    assert!((sum - 1.0).abs() < 0.01);
    assert!(
        (cx / sum - 30.0 * a.sin() / a).abs() < 0.02 && (cy / sum - 30.0 * (1.0 - a.cos()) / a).abs() < 0.02,
        "({}, {})",
        cx / sum,
        cy / sum
    );
}

#[test]
fn motion_towards_the_scene_enlarges_it_by_equation_2() {
    // Eq. (2) by hand: (v (R p / v + T / d))_xy over its third component.
    let shake = Shake::SixD(Wobble { shift_m: 0.004, nearing_m: 0.05, tilt_deg: 0.6, roll_deg: 1.0, depth_m: 1.5 });
    let motion = shake.motion(200, 150, 240.0, 0.7, 1.0, 0.25, 4, 2).unwrap();
    assert_eq!(motion.nearing.len(), motion.tsf.poses.len());
    let range = motion.nearing.iter().copied().fold(f64::MIN, f64::max) - motion.nearing.iter().copied().fold(f64::MAX, f64::min);
    assert!((range - 0.05 / 1.5).abs() < 1e-3, "T_Z / d spans {range}");
    let shift = |f: fn(&Pose) -> f64| {
        let v: Vec<f64> = motion.tsf.poses.iter().map(f).collect();
        v.iter().copied().fold(f64::MIN, f64::max) - v.iter().copied().fold(f64::MAX, f64::min)
    };
    assert!((shift(|p| p.t_x).max(shift(|p| p.t_y)) - 240.0 * 0.004 / 1.5).abs() < 0.02);
    for ((h, _), (pose, nearing)) in motion.homographies().into_iter().zip(motion.tsf.poses.iter().zip(&motion.nearing)).step_by(37) {
        // The centre goes where the TSF's pose takes it; what is off centre is enlarged.
        let centre = h * glam::DVec3::new(0.0, 0.0, 1.0);
        let by_tsf = pose.apply(240.0, glam::DVec2::ZERO);
        assert!((centre.x / centre.z - by_tsf.x).abs() < 1e-9 && (centre.y / centre.z - by_tsf.y).abs() < 1e-9);
        let spread = |p: f64| {
            let (a, b) = (h * glam::DVec3::new(p, 0.0, 1.0), h * glam::DVec3::new(-p, 0.0, 1.0));
            ((a.x / a.z - b.x / b.z).powi(2) + (a.y / a.z - b.y / b.z).powi(2)).sqrt() / (2.0 * p)
        };
        assert!((spread(1.0) * (1.0 + nearing) - 1.0).abs() < 2e-4, "{} at T_Z / d = {nearing}", spread(1.0));
    }
}

#[test]
fn grid_motion_lies_on_the_papers_grid() {
    let tremor = Tremor { extent_px: 40.0, roll_deg: 5.0, offset_px: 3.0, offset_deg: 0.2 };
    let motion = Shake::Grid(tremor).motion(160, 120, 192.0, 1.0, 1.0, 0.25, 9, 1).unwrap();
    assert!(motion.tsf.poses.len() > 20 && motion.shaken);
    for p in &motion.tsf.poses {
        assert!(p.t_x.fract() == 0.0 && p.t_y.fract() == 0.0 && (4.0 * p.theta_z_deg).fract() == 0.0, "{p:?}");
        assert!(p.t_x.abs() <= 12.0 && p.t_y.abs() <= 12.0 && p.theta_z_deg.abs() <= 1.5, "{p:?}");
    }
    let sum: f64 = motion.tsf.poses.iter().map(|p| p.weight).sum();
    assert!((sum - 1.0).abs() < 1e-9);
}

#[test]
fn a_gyroscopes_record_becomes_rotations() {
    // A steady turn of 0.02 rad/s about y, and 0.01 rad/s about z.
    let lines: String = (0..50).map(|k| format!("{} 0 0.02 0.01\n", k * 20_000_000)).collect();
    let record = GyroRecord::parse(&format!("50\n123\n{lines}capture timestamp 5\n")).unwrap();
    assert!((record.duration() - 0.98).abs() < 1e-9);
    let motion = Shake::Gyro { record: record.clone(), strength: 1.0 }.motion(300, 200, 360.0, 0.1, 1.0, 0.05, 3, 1).unwrap();
    let yaw: Vec<f64> = motion.tsf.poses.iter().map(|p| p.theta_y_deg).collect();
    let range = yaw.iter().copied().fold(f64::MIN, f64::max) - yaw.iter().copied().fold(f64::MAX, f64::min);
    // The record may turn back once within the exposure.
    assert!(range <= 0.02f64.to_degrees() * 0.1 + 1e-9 && range > 0.02f64.to_degrees() * 0.04, "{range}");
    assert!(motion.tsf.poses.iter().all(|p| p.t_x == 0.0 && p.t_y == 0.0 && (p.theta_z_deg - 0.5 * p.theta_y_deg).abs() < 1e-9));
    // 360 px times 0.002 rad is 0.72 px, plus the roll: in steps of at most 0.05 px.
    assert!(motion.tsf.poses.len() >= 14, "{} poses", motion.tsf.poses.len());
    assert!((record.at(0.3)[1] - 0.02f64.to_degrees() * 0.3).abs() < 1e-9 && (record.at(1.5)[1] - record.at(0.46)[1]).abs() < 1e-9);
    for bad in ["", "1 2 3 4", "5 0 0 0\n4 0 0 0", "1 0 0 0\n2 0 inf 0"] {
        assert!(GyroRecord::parse(bad).is_err(), "{bad:?}");
    }
    let Some(path) = shared("data/shake/gyro_tremor.txt") else { return };
    let real = GyroRecord::parse(&std::fs::read_to_string(path).unwrap()).unwrap();
    assert!((0.5..2.0).contains(&real.duration()), "{}", real.duration());
}

#[test]
fn a_displaced_frame_is_sharp_and_elsewhere() {
    let scene = Drawn::Chart.draw(64, 48, 24, 2, 1);
    let frames = [(0.1, Shake::none(64)), (0.5, Shake::none(64).displaced(5.0, -3.0, 0.0))];
    let camera = Camera { full_well: 1e7, read_noise: 0.0, ..Camera::default() };
    let (made, tripod) = synth::photograph(&scene, &camera, &frames, 0.3, 1, true).unwrap();
    assert_eq!(made.sharp, [true, true]);
    let (moved, still) = (&made.bracket.frames()[1].intensity.0[1], &tripod.unwrap().frames()[1].intensity.0[1].clone());
    assert!((0..30).all(|i| (moved.at(20 + i, 10) - still.at(15 + i, 13)).abs() < 0.02));
    let motion: &Motion = &frames[1].1;
    assert_eq!((motion.tsf.poses.len(), motion.tsf.poses[0].t_x), (1, 5.0));
}

#[test]
fn drawn_scenes_span_five_decades() {
    for drawn in Drawn::ALL {
        let truth = synth::expose(&drawn.draw(256, 192, 16, 2, 1), &synth::identity(256));
        let mut lum = truth.mean().data;
        assert!(lum.iter().all(|v| v.is_finite() && *v > 0.0), "{}", drawn.name());
        lum.sort_by(f32::total_cmp);
        let decades = (lum[lum.len() - 1] / lum[0]).log10();
        // The room is the demo's: lit so that it can be photographed from 1/30 to 2 s.
        let least = if drawn == Drawn::Room { 4.7 } else { 5.0 };
        assert!(decades > least, "{}: {decades}", drawn.name());
        assert_eq!(Drawn::named(drawn.name()).unwrap(), drawn);
    }
    assert!(Drawn::named("cellar").unwrap_err().to_string().contains("foliage"));
}

#[test]
fn a_photograph_becomes_a_scene_by_area() {
    let image = |w: usize, h: usize| Rgb(std::array::from_fn(|c| Plane::from_fn(w, h, |x, y| 1.0 + c as f32 + (x / 4 + y / 4) as f32)));
    let scene = Scene::photograph(&image(384, 288), Some(64), 16, 2).unwrap();
    assert_eq!((scene.frame_size(), scene.samples.size()), ((64, 40), (192, 144)));
    // Halved: each sample is the mean of 2 x 2, which lie in one cell of 4.
    assert!((scene.samples.0[1].at(9, 5) - 2.0 - 4.0 - 2.0).abs() < 1e-4, "{}", scene.samples.0[1].at(9, 5));
    let mean = |p: &Plane| p.data.iter().map(|v| f64::from(*v)).sum::<f64>() / p.data.len() as f64;
    let odd = Scene::photograph(&image(401, 299), Some(70), 10, 2).unwrap();
    assert!((mean(&odd.samples.0[0]) / mean(&image(401, 299).0[0]) - 1.0).abs() < 0.02);
    for (bad, width, margin) in [(image(100, 100), Some(90), 48), (image(400, 20), Some(100), 20), (Rgb::filled(200, 200, 0.0), None, 8)] {
        assert!(Scene::photograph(&bad, width, margin, 2).is_err());
    }
    let mut nan = image(200, 200);
    nan.0[0].data[3] = f32::NAN;
    assert!(Scene::photograph(&nan, None, 8, 2).is_err());
}

#[test]
fn more_bits_make_finer_steps() {
    let camera = Camera { full_well: 1e9, read_noise: 0.0, response: Response::Linear, bits: 12 };
    let frame = camera.photograph("flat", &Rgb::filled(3, 2, 0.3), 0.5, 1, 1);
    assert_eq!(frame.levels, 4095);
    assert!((frame.intensity.0[0].data[0] * 4095.0 - 614.0).abs() < 0.01, "{}", frame.intensity.0[0].data[0] * 4095.0);
}

/// FNV-1a of the frames' codes.
fn fingerprint(bracket: &unshaken::exposure::Bracket) -> u64 {
    let codes = bracket.frames().iter().flat_map(|f| f.intensity.0.iter()).flat_map(|p| &p.data).map(|z| (z * 255.0).round() as u8);
    codes.fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3))
}

#[test]
fn a_seed_makes_the_same_bracket_on_every_machine() {
    // Printed by this test when the values were stored; nothing in synth may depend on the machine's mathematical library.
    let stored: [(Drawn, u64); 5] = [
        (Drawn::Room, 0x0072_e2b1_5f2a_c9a1),
        (Drawn::Chart, 0x48d9_3046_d917_bbdb),
        (Drawn::Lamps, 0xc7cd_963c_dcf4_d5bc),
        (Drawn::Foliage, 0xe2a6_9734_0b40_c5dd),
        (Drawn::Window, 0xdcd6_b03e_aa02_202a),
    ];
    let mut got = Vec::new();
    for (drawn, _) in stored {
        let scene = drawn.draw(64, 48, 20, 2, 7);
        let bracket = synth::capture(&scene, &Camera::default(), &[(0.1, None), (0.5, Some(tremor()))], 0.05, 7).unwrap().bracket;
        got.push((drawn, fingerprint(&bracket)));
    }
    assert_eq!(got, stored, "{got:#x?}");
}
