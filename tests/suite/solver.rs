//! The solver against dense algebra on a bracket of a hundred pixels, and what it promises: descent, stopping, cancelling.

use crate::oracle::blur;
use crate::oracle::solver::{Frame, Planes, Problem, Weights, advance};
use crate::support::gpu::{gpu, kernels};
use crate::support::{f64s, noise};
use glam::DMat3;
use unshaken::deblur::{Observation, Prior, Settings, Solution, Stop, pad_for, solve};
use unshaken::error::Error;
use unshaken::image::{Plane, Rgb};
use unshaken::kernels::{NOISE_STEPS, UNSEEN};
use unshaken::pose::{Pose, project};
use unshaken::tsf::{Interpolation, TapSet, Tsf};

const SIZE: (usize, usize) = (12, 9);
const INTERPOLATION: Interpolation = Interpolation::Bicubic;

fn shaken() -> Tsf {
    let poses = vec![Pose::planar(0.3, -0.4, 0.0, 0.4), Pose::planar(1.6, 0.7, 2.0, 0.35), Pose::planar(-0.8, 1.2, -1.0, 0.25)];
    Tsf::new(40.0, poses).expect("valid")
}

/// Irradiance with an edge, a gradient and different colours.
fn truth(pad: usize) -> Rgb {
    let (w, h) = (SIZE.0 + 2 * pad, SIZE.1 + 2 * pad);
    Rgb(std::array::from_fn(|c| {
        Plane::from_fn(w, h, |x, y| {
            let (x, y) = (x as f32 - pad as f32, y as f32 - pad as f32);
            let edge = if x + 0.5 * y > 8.0 { 1.1 } else { 0.25 };
            edge * (1.0 + 0.2 * c as f32) * (0.2 * x - 0.31 * y + c as f32).sin().mul_add(0.2, 1.0)
        })
    }))
}

fn curves() -> [Vec<f32>; 3] {
    std::array::from_fn(|c| (0..NOISE_STEPS).map(|i| (2e-5 + 4e-4 * (i as f32 / 255.0).powi(2)).sqrt() * (1.0 + 0.1 * c as f32)).collect())
}

/// K of a TSF on this bracket's grid.
fn matrix(tsf: &Tsf, pad: usize) -> blur::Matrix {
    if tsf.is_identity() {
        return blur::of_poses(&[(DMat3::IDENTITY, 1.0)], INTERPOLATION, SIZE, pad);
    }
    blur::of_taps(&TapSet::new(tsf, SIZE.0, SIZE.1, INTERPOLATION), INTERPOLATION, SIZE, pad)
}

/// What stands for it in the matrix of a step.
fn rough(tsf: &Tsf, pad: usize) -> blur::Matrix {
    match TapSet::new(tsf, SIZE.0, SIZE.1, INTERPOLATION).rougher(tsf, SIZE.0, SIZE.1, INTERPOLATION) {
        Some(taps) if !tsf.is_identity() => blur::of_taps(&taps, INTERPOLATION, SIZE, pad),
        _ => matrix(tsf, pad),
    }
}

/// A frame of the truth under `tsf` with its noise.
fn observe(tsf: Tsf, exposure_time: f64, pad: usize, seed: u64) -> Observation {
    let (truth, matrix, noise_curves) = (truth(pad), matrix(&tsf, pad), curves());
    let exposure = Rgb(std::array::from_fn(|c| {
        let n = noise(seed + c as u64, SIZE.0 * SIZE.1);
        let clean = matrix.apply(&f64s(&truth.0[c].data));
        // Uniform noise of the curve's variance.
        let seen = |i: usize| {
            let x = clean[i] * exposure_time;
            let s = noise_curves[c][(x.clamp(0.0, 1.0).sqrt() * 255.0) as usize];
            let seen = (x as f32 + 3f32.sqrt() * s * n[i]).clamp(0.0, 1.0);
            // Some of red and of blue are clipped.
            if c != 1 && i % 7 == c { UNSEEN } else { seen }
        };
        Plane::from_vec(SIZE.0, SIZE.1, (0..clean.len()).map(seen).collect()).expect("the frame's size")
    }));
    let mask = Plane::from_fn(SIZE.0, SIZE.1, |x, y| match (x, y) {
        (3, 4) => 0.0,
        (x, _) if x % 5 == 0 => 0.6,
        _ => 1.0,
    });
    Observation { exposure, mask, exposure_time, noise: noise_curves, black_clipped: true, tsf }
}

/// One frame in place, one shaken.
fn bracket(pad: usize) -> Vec<Observation> {
    vec![observe(Tsf::identity(), 0.1, pad, 1), observe(shaken(), 0.5, pad, 10)]
}

/// A start that is 10 % too bright and rough.
fn start(pad: usize) -> Rgb {
    let mut seed = 30;
    truth(pad).map_planes(|p| {
        seed += 1;
        let n = noise(seed, p.data.len());
        p.zip(&Plane { data: n, ..p.clone() }, |v, n| v * (1.1 + 0.1 * n))
    })
}

fn settings() -> Settings {
    let standard = Settings::default();
    Settings {
        lambda: 2.0,
        epsilon: 0.05,
        settled: f64::INFINITY,
        reduction: 0.0,
        interpolation: INTERPOLATION,
        prior: Prior::Tv,
        ..standard
    }
}

fn run(observations: &[Observation], initial: &Rgb, pad: usize, settings: &Settings) -> Solution {
    solve(gpu(), kernels(), observations, initial, pad, settings, &mut |_| true).expect("solves")
}

fn problem(observations: &[Observation], pad: usize, settings: &Settings) -> Problem {
    let frame = |o: &Observation| Frame {
        matrix: matrix(&o.tsf, pad),
        rough: rough(&o.tsf, pad),
        exposure: o.exposure.0.each_ref().map(|p| p.data.iter().map(|&e| (e != UNSEEN).then_some(f64::from(e))).collect()),
        mask: f64s(&o.mask.data),
        exposure_time: o.exposure_time,
        noise: o.noise.clone(),
        black_clipped: o.black_clipped,
        moving: !o.tsf.is_identity(),
    };
    Problem {
        frames: observations.iter().map(frame).collect(),
        frame: SIZE,
        latent: (SIZE.0 + 2 * pad, SIZE.1 + 2 * pad),
        lambda: f64::from(settings.lambda),
        epsilon: f64::from(settings.epsilon),
        robust: f64::from(settings.robust),
    }
}

fn planes(image: &Rgb) -> Planes {
    image.0.each_ref().map(|p| f64s(&p.data))
}

fn logs(image: &Rgb) -> Planes {
    planes(image).map(|p| p.into_iter().map(f64::ln).collect())
}

fn near(a: f64, b: f64, relative: f64) -> bool {
    (a - b).abs() <= relative * a.abs().max(b.abs())
}

#[test]
fn the_oracle_descends_its_own_objective() {
    let (set, initial) = (settings(), start(2));
    let problem = problem(&bracket(2), 2, &set);
    let (log, weights) = (logs(&initial), problem.weights(&planes(&initial)));
    for (c, pixel) in [(0, 0), (1, 57), (2, 100), (0, 207)] {
        let (slope, right) = (problem.slope(&log, &weights, c, pixel), problem.right_side(&log, &weights, c)[pixel]);
        assert!((slope + right).abs() <= 1e-4 * (1.0 + right.abs()), "channel {c}, pixel {pixel}: {slope} {right}");
    }
}

/// One outer iteration with enough inner ones against the dense step from the same start.
fn check_step(pad: usize, robust: f32, black_clipped: bool) {
    let mut bracket = bracket(pad);
    bracket.iter_mut().for_each(|o| o.black_clipped = black_clipped);
    let set = Settings { outer: 1, inner: 200, robust, ..settings() };
    let (initial, problem) = (start(pad), problem(&bracket, pad, &set));
    let got = run(&bracket, &initial, pad, &set);
    let (log, weights) = (logs(&initial), problem.weights(&planes(&initial)));
    let iteration = &got.report.history[0];
    assert_eq!(got.irradiance.size(), initial.size());
    assert!(iteration.step > 0.0 && iteration.reduction < 1e-6, "{iteration:?}");
    let step = problem.step(&log, &weights);
    let largest = step.iter().flatten().fold(0.0f64, |a, v| a.max(v.abs()));
    assert!(largest > 0.05, "the start leaves nothing to do: {largest}");
    let expected: Planes =
        std::array::from_fn(|c| log[c].iter().zip(&step[c]).map(|(u, d)| advance(*u, f64::from(iteration.step) * d)).collect());
    for (c, got) in logs(&got.irradiance).iter().enumerate() {
        for (i, (got, expected)) in got.iter().zip(&expected[c]).enumerate() {
            // f32 conjugate gradients at a condition of 1e3 after the preconditioner, and weights good to 2e-5.
            assert!((got - expected).abs() <= 3e-4 * largest, "channel {c}, pixel {i}: {got}, expected {expected}; largest step {largest}");
        }
    }
    let (before, after) = (problem.objective(&log, &weights), problem.objective(&logs(&got.irradiance), &weights));
    assert!(near(iteration.before, before, 1e-4), "objective {}, expected {before}", iteration.before);
    assert!(near(iteration.after, after, 1e-4), "objective {}, expected {after}", iteration.after);
    for (i, frame) in problem.frames.iter().enumerate() {
        let misfit = frame.misfit(&planes(&got.irradiance));
        let sum = misfit.iter().fold([0.0; 2], |a, m| [a[0] + m[0], a[1] + m[1]]);
        assert!(near(got.report.chi_squared[i], sum[0] / sum[1], 1e-4), "frame {i}: χ² {}, expected {sum:?}", got.report.chi_squared[i]);
        for (p, m) in crate::oracle::data::gauss(&misfit, SIZE, 2.0).iter().enumerate() {
            let (local, expected) = (f64::from(got.misfit[i].data[p]), if m[1] > 1e-3 { m[0] / m[1] } else { 0.0 });
            assert!(near(local, expected, 1e-3), "frame {i}, pixel {p}: local χ² {local}, expected {expected}");
        }
    }
}

#[test]
fn one_step_equals_the_dense_solve() {
    check_step(0, 2.0, true);
    check_step(0, 0.0, false);
}

#[test]
fn one_step_equals_the_dense_solve_with_a_padded_latent_grid() {
    check_step(4, 2.0, true);
}

/// Starts that are bad: far too bright, far too dark, a chequerboard.
fn bad_starts(pad: usize) -> [(&'static str, Rgb); 3] {
    let t = truth(pad);
    let chequered = t.map_planes(|p| Plane::from_fn(p.width, p.height, |x, y| p.at(x, y) * if (x + y) % 2 == 0 { 30.0 } else { 0.02 }));
    [("bright", Rgb::filled(t.width(), t.height(), 40.0)), ("dark", Rgb::filled(t.width(), t.height(), 1e-4)), ("chequered", chequered)]
}

#[test]
fn with_frozen_weights_the_objective_never_rises() {
    let pad = 3;
    let (bracket, set) = (bracket(pad), Settings { outer: 14, inner: 15, reweight: false, tolerance: 0.0, ..settings() });
    for (name, initial) in bad_starts(pad).into_iter().chain([("good", start(pad))]) {
        let report = run(&bracket, &initial, pad, &set).report;
        for (k, it) in report.history.iter().enumerate() {
            // A step of 0 puts the start back, but for the rounding of ln and exp.
            assert!(it.after <= it.before * (1.0 + if it.step == 0.0 { 1e-5 } else { 0.0 }), "{name}, outer {k}: {it:?}");
        }
        for pair in report.history.windows(2) {
            assert!(near(pair[0].after, pair[1].before, 1e-5), "{name}: the weights are not frozen: {pair:?}");
        }
        let (first, last) = (report.history[0].before, report.history[report.history.len() - 1].after);
        assert!(last < first, "{name}: {first} {last}");
        // The same in f64 on what comes out after 1, 2, 3, ... outer iterations.
        let problem = problem(&bracket, pad, &set);
        let weights: Vec<Weights> = problem.weights(&planes(&initial));
        let mut before = problem.objective(&logs(&initial), &weights);
        for outer in [1, 2, 4, 8] {
            let got = run(&bracket, &initial, pad, &Settings { outer, ..set.clone() });
            let after = problem.objective(&logs(&got.irradiance), &weights);
            assert!(after <= before * (1.0 + 1e-6), "{name}, {outer} outer iterations: {before} -> {after}");
            before = after;
        }
    }
}

#[test]
fn with_frozen_weights_the_gradient_vanishes() {
    let (pad, set) = (2, Settings { outer: 40, inner: 60, reweight: false, tolerance: 0.0, ..settings() });
    let (bracket, initial) = (bracket(pad), start(pad));
    let problem = problem(&bracket, pad, &set);
    let weights = problem.weights(&planes(&initial));
    let got = run(&bracket, &initial, pad, &set);
    let size = |image: &Rgb| {
        let g = (0..3).map(|c| problem.right_side(&logs(image), &weights, c).iter().map(|v| v * v).sum::<f64>());
        g.sum::<f64>().sqrt()
    };
    let (before, after) = (size(&initial), size(&got.irradiance));
    assert!(after < 2e-3 * before, "gradient {before} -> {after}");
}

#[test]
fn reweighting_changes_the_objective_between_outer_iterations() {
    let set = Settings { outer: 3, tolerance: 0.0, ..settings() };
    let history = run(&bracket(2), &start(2), 2, &set).report.history;
    assert!(!near(history[0].after, history[1].before, 1e-4), "{history:?}");
}

#[test]
fn the_report_says_why_it_stopped() {
    let (bracket, initial) = (bracket(2), start(2));
    let limited = run(&bracket, &initial, 2, &Settings { outer: 2, tolerance: 0.0, ..settings() }).report;
    assert_eq!((limited.stop, limited.history.len()), (Stop::IterationLimit, 2));
    let set = Settings { outer: 60, inner: 30, tolerance: 1e-4, reweight: false, ..settings() };
    let converged = run(&bracket, &initial, 2, &set).report;
    assert_eq!(converged.stop, Stop::Converged);
    assert!(converged.history.len() < 60);
    let (last, rest) = converged.history.split_last().expect("not empty");
    assert!(last.before - last.after < 1e-4 * last.before && last.step > 0.0, "{last:?}");
    assert!(rest.iter().all(|i| i.before - i.after >= 1e-4 * i.before), "{rest:?}");
    // Nothing can be gained below the rounding of the objective: sooner or later no step lowers it.
    let broken = run(&bracket, &initial, 2, &Settings { outer: 60, inner: 30, tolerance: -1.0, reweight: false, ..settings() }).report;
    match broken.stop {
        Stop::Breakdown => assert_eq!(broken.history.last().expect("not empty").step, 0.0),
        Stop::IterationLimit => assert_eq!(broken.history.len(), 60),
        Stop::Converged => panic!("a tolerance below 0 is never met"),
    }
}

#[test]
fn cancelling_stops_and_progress_rises() {
    let (bracket, initial) = (bracket(2), start(2));
    for inner in [3, 12] {
        let set = Settings { inner, outer: 4, tolerance: 0.0, ..settings() };
        let mut seen = Vec::new();
        let mut all = |f: f32| {
            seen.push(f);
            true
        };
        solve(gpu(), kernels(), &bracket, &initial, 2, &set, &mut all).expect("solves");
        assert!(seen.len() >= 4 && seen.is_sorted() && seen.iter().all(|f| (0.0..=1.0).contains(f)), "inner {inner}: {seen:?}");
        let mut calls = 0;
        let mut cancel = |_: f32| {
            calls += 1;
            calls < 2
        };
        let result = solve(gpu(), kernels(), &bracket, &initial, 2, &set, &mut cancel);
        assert!(matches!(result, Err(Error::Cancelled)), "inner {inner}");
        assert_eq!(calls, 2, "inner {inner}: nothing runs after a refusal");
    }
}

#[test]
fn frames_in_place_give_their_weighted_mean() {
    // Without smoothness the minimum is Σ W B / Σ W, pixel by pixel.
    let bracket = vec![observe(Tsf::identity(), 0.1, 0, 1), observe(Tsf::identity(), 0.5, 0, 2)];
    let set = Settings { outer: 30, inner: 5, lambda: 1e-7, reweight: false, tolerance: 0.0, ..settings() };
    let initial = start(0);
    let problem = problem(&bracket, 0, &set);
    let weights = problem.weights(&planes(&initial));
    let got = run(&bracket, &initial, 0, &set);
    assert_eq!(got.cropped(), got.irradiance);
    for c in 0..3 {
        for i in 0..SIZE.0 * SIZE.1 {
            let (w, wb) = weights.iter().fold((0.0, 0.0), |a, f| (a.0 + f.weight[c][i], a.1 + f.observation[c][i]));
            if w > 0.0 {
                let e = f64::from(got.irradiance.0[c].data[i]);
                assert!(near(e, wb / w, 1e-4), "channel {c}, pixel {i}: {e}, expected {}", wb / w);
            }
        }
    }
    // Two frames, one unknown: what noise explains is shared by the frames, 1 in all.
    let chi: f64 = got.report.chi_squared.iter().sum();
    assert!(chi > 0.7 && chi < 1.4, "{:?}", got.report.chi_squared);
}

#[test]
fn a_bracket_of_one_shaken_frame_is_solved() {
    let pad = 4;
    let got = run(&[observe(shaken(), 0.5, pad, 10)], &start(pad), pad, &Settings { outer: 8, ..settings() });
    assert!(got.irradiance.0.iter().all(|p| p.data.iter().all(|v| v.is_finite() && *v > 0.0)));
    assert_eq!(got.cropped().size(), SIZE);
    assert_eq!(got.cropped().0[1].at(0, 0), got.irradiance.0[1].at(pad, pad));
}

#[test]
fn the_pad_holds_what_every_pose_sees() {
    let poses = vec![Pose::planar(7.3, -2.0, 1.5, 0.5), Pose { theta_y_deg: 0.6, ..Pose::planar(-9.0, 2.2, -1.0, 0.5) }];
    let tsf = Tsf::new(300.0, poses).expect("valid");
    let (w, h) = (120, 80);
    let pad = pad_for(&[&tsf, &Tsf::identity()], w, h, 1000);
    // Every border pixel of the frame, where it looks in the scene.
    let mut farthest = 0.0f64;
    for pose in &tsf.poses {
        let back = pose.homography(tsf.focal_px).inverse();
        for i in 0..w {
            for j in 0..h {
                let p = project(&back, glam::DVec2::new(i as f64 - 59.5, j as f64 - 39.5));
                farthest = farthest.max(p.x.abs() - 59.5).max(p.y.abs() - 39.5);
            }
        }
    }
    let support = 3.0;
    assert!(pad as f64 >= farthest + support - 1.0 && pad as f64 <= farthest + support + 1.0, "pad {pad}, farthest {farthest}");
    assert_eq!(pad_for(&[&tsf], w, h, 5), 5);
    assert_eq!(pad_for(&[&Tsf::identity()], w, h, 5), 0);
}

#[test]
fn numbers_that_are_none_are_refused() {
    let refused = |change: &dyn Fn(&mut Vec<Observation>, &mut Rgb)| {
        let (mut observations, mut initial) = (bracket(2), start(2));
        change(&mut observations, &mut initial);
        let result = solve(gpu(), kernels(), &observations, &initial, 2, &settings(), &mut |_| true);
        matches!(result, Err(Error::Input(_)))
    };
    assert!(!refused(&|_, _| {}));
    for bad in [f32::NAN, f32::INFINITY] {
        assert!(refused(&|o, _| o[1].exposure.0[2].data[5] = bad), "exposure {bad}");
        assert!(refused(&|o, _| o[0].mask.data[5] = bad), "mask {bad}");
        assert!(refused(&|o, _| o[1].mask.data[0] = bad), "mask of a shaken frame {bad}");
        assert!(refused(&|o, _| o[1].noise[0][17] = bad), "noise {bad}");
        assert!(refused(&|o, _| o[0].exposure_time = f64::from(bad)), "exposure time {bad}");
        assert!(refused(&|_, start| start.0[1].data[7] = bad), "start {bad}");
    }
    assert!(refused(&|o, _| o[1].noise[0][17] = 0.0), "noise of 0");
    assert!(refused(&|o, _| o[1].exposure_time = 0.0), "exposure time of 0");
}

#[test]
fn a_lamp_that_a_shaken_frame_sees_by_the_lobes_of_its_interpolation_alone_does_not_hold_the_gradients_up() {
    // Far above white in the long frame, which is dark and tells much around it.
    let (dark, lamp, pad) = (0.02, 400.0, 3);
    let scene = Rgb::filled(SIZE.0 + 2 * pad, SIZE.1 + 2 * pad, dark);
    let scene = scene
        .map_planes(|p| Plane::from_fn(p.width, p.height, |x, y| if (7..10).contains(&x) && (6..9).contains(&y) { lamp } else { dark }));
    let observed = |tsf: Tsf, exposure_time: f64| {
        let matrix = matrix(&tsf, pad);
        let seen = |v: f64| if v * exposure_time < 0.95 { (v * exposure_time) as f32 } else { UNSEEN };
        let exposure = scene.map_planes(|p| {
            let values = matrix.apply(&f64s(&p.data)).into_iter().map(seen).collect();
            Plane::from_vec(SIZE.0, SIZE.1, values).expect("the frame's size")
        });
        let mask = exposure.0[0].map(|v| if v == UNSEEN { 0.0 } else { 1.0 });
        Observation { exposure, mask, exposure_time, noise: curves(), black_clipped: true, tsf }
    };
    let bracket = [observed(Tsf::identity(), 0.002), observed(shaken(), 5.0)];
    assert!(bracket[0].mask.data.iter().all(|m| *m == 1.0) && bracket[1].mask.data.contains(&0.0));
    let mut initial = scene.clone();
    for (p, n) in initial.0.iter_mut().zip([31, 32, 33]) {
        p.data.iter_mut().zip(noise(n, SIZE.0 * SIZE.1 * 4)).for_each(|(v, n)| *v *= 1.0 + 0.3 * n);
    }
    let history = run(&bracket, &initial, pad, &Settings { outer: 3, ..settings() }).report.history;
    assert!(history.len() == 3 && history.iter().all(|i| i.step == 1.0 && i.reduction < 0.02), "{history:?}");
}

#[test]
fn the_gradients_end_where_enough_is_gained() {
    let (bracket, initial) = (bracket(2), start(2));
    let set = Settings { outer: 1, inner: 60, ..settings() };
    let whole = run(&bracket, &initial, 2, &set).report.history[0].clone();
    assert!(whole.inner == 60 && whole.reduction < 1e-6, "{whole:?}");
    let part = run(&bracket, &initial, 2, &Settings { reduction: 1e-2, ..set }).report.history[0].clone();
    assert!(part.inner < 60 && part.reduction > whole.reduction && part.reduction < 0.1, "{part:?}");
    assert!(part.before - part.after > 0.9 * (whole.before - whole.after), "{part:?}, {whole:?}");
}

#[test]
fn sharp_frames_that_do_not_agree_are_doubted_from_the_first() {
    let elsewhere = Tsf::still(DMat3::from_translation(glam::DVec2::new(0.4, -0.3)));
    let agreeing = [observe(Tsf::identity(), 0.1, 0, 1), observe(elsewhere.clone(), 0.2, 0, 10)];
    let mut other = observe(elsewhere, 0.2, 0, 10);
    // What moved into a half of the second frame.
    other.exposure = other.exposure.map_planes(|p| Plane::from_fn(SIZE.0, SIZE.1, |x, y| if x < 6 { 0.9 } else { p.at(x, y) }));
    let disagreeing = [observe(Tsf::identity(), 0.1, 0, 1), other];
    let first = |bracket: &[Observation], robust: f32| {
        let set = Settings { settled: 0.5, robust, outer: 2, ..settings() };
        run(bracket, &truth(0), 0, &set).report.history[0].before
    };
    assert_eq!(first(&agreeing, 1.0), first(&agreeing, 0.0), "what agrees is trusted at first");
    let (trusted, doubted) = (first(&disagreeing, 0.0), first(&disagreeing, 1.0));
    assert!(doubted < 0.3 * trusted, "{doubted} under the weights of frames that disagree, {trusted} without");
    // Beside a shaken frame it may be the start that is wrong.
    let [a, b] = disagreeing;
    let beside = [a, b, observe(shaken(), 0.5, 0, 20)];
    assert_eq!(first(&beside, 1.0), first(&beside, 0.0));
}

#[test]
fn a_step_that_would_raise_the_objective_is_halved() {
    // A shaken frame that averages neighbours and counts much, a frame in place that counts little, a start whose columns
    // alternate between twice the truth and almost nothing: its average is right. The step lowers the bright columns at
    // once but may raise the dark ones by e only, and so spoils the average. Halving after the clamp does not help: the
    // clamped direction itself goes up.
    let poses = vec![Pose::planar(0.0, 0.0, 0.0, 0.5), Pose::planar(1.0, 0.0, 0.0, 0.5)];
    let bracket = vec![observe(Tsf::identity(), 0.02, 1, 1), observe(Tsf::new(40.0, poses).expect("valid"), 0.5, 1, 10)];
    let initial = truth(1).map_planes(|p| Plane::from_fn(p.width, p.height, |x, y| p.at(x, y) * if x % 2 == 0 { 2.0 } else { 1e-3 }));
    let set = Settings { outer: 12, inner: 100, reweight: false, tolerance: 0.0, lambda: 1e-3, ..settings() };
    let history = run(&bracket, &initial, 1, &set).report.history;
    let k = history.iter().position(|i| i.step < 1.0).expect("an overshoot");
    assert!(history.iter().all(|i| i.after <= i.before && i.step > 0.0), "{history:?}");
    assert!(history[history.len() - 1].after < 0.1 * history[0].before, "{history:?}");
    // The same place in f64: the whole step goes up, the damped one down.
    let problem = problem(&bracket, 1, &set);
    let weights = problem.weights(&planes(&initial));
    let log = logs(&run(&bracket, &initial, 1, &Settings { outer: k, ..set.clone() }).irradiance);
    let step = problem.step(&log, &weights);
    let at = |s: f64| {
        let moved: Planes = std::array::from_fn(|c| log[c].iter().zip(&step[c]).map(|(u, d)| advance(*u, s * d)).collect());
        problem.objective(&moved, &weights)
    };
    let (whole, damped, before) = (at(1.0), at(f64::from(history[k].step)), at(0.0));
    assert!(whole > 1.001 * before && damped < before, "step {}: {before} -> {damped}, whole step {whole}", history[k].step);
}
