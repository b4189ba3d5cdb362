//! The synthetic brackets against the physics that they claim.

use unshaken::image::{Plane, Rgb};
use unshaken::pose::Pose;
use unshaken::response::Response;
use unshaken::synth::random::Random;
use unshaken::synth::{self, Camera, Scene, Tremor};
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
    let scene = Scene { samples: Rgb([samples.clone(), samples.clone(), samples]), margin };
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
    let camera = Camera { full_well: 900.0, read_noise: 5.0, response: Response::Linear };
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
    let camera = Camera { full_well: 1e9, read_noise: 0.0, response: Response::Srgb };
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
