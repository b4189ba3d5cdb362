//! What displaced sharp frames show of structure finer than the latent grid: against the frames that a scene four times as fine gives.

use crate::oracle::blur;
use crate::support::gpu::{gpu, kernels};
use crate::support::{f64s, noise};
use glam::DVec2;
use unshaken::deblur::{Observation, Settings, TILE, aliasing, on_own_pixels, solve};
use unshaken::image::{Plane, Rgb};
use unshaken::kernels::{NOISE_STEPS, STILL, UNSEEN};
use unshaken::metrics::{self, Judge};
use unshaken::noise::NoiseModel;
use unshaken::pipeline;
use unshaken::pose::{Pose, project};
use unshaken::response::Response;
use unshaken::synth::{self, Camera, Drawn, Motion, Scene};
use unshaken::tsf::{TapSet, Tsf};

const SIZE: (usize, usize) = (112, 80);
/// Standard deviation of the exposures: eight bits' worth.
const NOISE: f32 = 2e-3;
/// The exposures of all frames.
const TIME: f64 = 0.5;

fn scaled(image: &Rgb, gain: f32) -> Rgb {
    image.map_planes(|p| p.map(|v| v * gain))
}

/// A frame of `irradiance` with its noise; what is beyond white is masked.
fn observe(irradiance: &Rgb, tsf: Tsf, seed: u64) -> Observation {
    let exposure = Rgb(std::array::from_fn(|c| {
        let n = noise(seed + c as u64, SIZE.0 * SIZE.1);
        let seen = irradiance.0[c].data.iter().zip(n).map(|(v, n)| (v * TIME as f32 + 3f32.sqrt() * NOISE * n).clamp(0.0, 1.0));
        Plane::from_vec(SIZE.0, SIZE.1, seen.collect()).unwrap()
    }));
    let mask = Plane::from_fn(SIZE.0, SIZE.1, |x, y| if exposure.0.iter().all(|p| p.at(x, y) < 0.97) { 1.0 } else { 0.0 });
    let noise = std::array::from_fn(|_| vec![NOISE; NOISE_STEPS]);
    Observation { exposure, mask, exposure_time: TIME, noise, black_clipped: false, tsf }
}

fn place(t_x: f64, t_y: f64, theta_z_deg: f64) -> Tsf {
    let pose = Pose::planar(t_x, t_y, theta_z_deg, 1.0);
    Tsf::still(pose.homography(Tsf::identity().focal_px))
}

/// A frame in place, two displaced ones and a shaken one; and what the displaced ones show beyond the truth's own interpolation, by the oracle's K.
fn bracket(scene: &Scene) -> (Vec<Observation>, Vec<Plane>) {
    let still = synth::expose(scene, &Tsf::identity());
    let mut levels = still.mean().data;
    levels.sort_by(f32::total_cmp);
    let gain = 0.6 / levels[levels.len() * 95 / 100];
    let truth = scaled(&still, gain);
    let places = [place(3.4, -5.3, 0.5), place(-7.7, 2.45, -0.4)];
    let shaken = Tsf::new(1000.0, vec![Pose::planar(-1.0, 0.0, 0.0, 0.5), Pose::planar(1.0, 0.0, 0.0, 0.5)]).unwrap();
    let seen = |tsf: &Tsf| scaled(&synth::expose(scene, tsf), gain);
    let beyond = |tsf: &Tsf| {
        let matrix = blur::of_taps(&TapSet::new(tsf, SIZE.0, SIZE.1, STILL), STILL, SIZE, 0);
        let made = matrix.apply(&f64s(&truth.0[1].data));
        let shown = seen(tsf);
        Plane { data: shown.0[1].data.iter().zip(made).map(|(s, m)| ((f64::from(*s) - m) * TIME) as f32).collect(), ..shown.0[1].clone() }
    };
    let wanted = places.iter().map(beyond).collect();
    let mut frames = vec![observe(&truth, Tsf::identity(), 1)];
    frames.extend(places.iter().zip([10, 20]).map(|(t, seed)| observe(&seen(t), t.clone(), seed)));
    frames.push(observe(&seen(&shaken), shaken, 30));
    (frames, wanted)
}

/// Where a displaced frame shows what the frame in place does, 12 px from the border, and light that the latter records.
fn judged(frame: &Observation) -> Vec<bool> {
    let back = frame.tsf.single().unwrap().inverse();
    let half = 0.5 * DVec2::new(SIZE.0 as f64 - 1.0, SIZE.1 as f64 - 1.0);
    let unmasked = |x: usize, y: usize| (0..9).all(|k| frame.mask.clamped(x as isize + k % 3 - 1, y as isize + k / 3 - 1) > 0.0);
    let one = |k: usize| {
        let (x, y) = (k % SIZE.0, k / SIZE.0);
        let at = blur::transform(&back, DVec2::new(x as f64, y as f64) - half).abs() - half;
        at.max_element() < -12.0 && unmasked(x, y)
    };
    (0..SIZE.0 * SIZE.1).map(one).collect()
}

fn rms(of: impl Iterator<Item = f32>) -> f64 {
    let (sum, count) = of.fold((0.0, 0usize), |(s, n), v| (s + f64::from(v * v), n + 1));
    (sum / count as f64).sqrt()
}

fn find(frames: &[Observation], tile: usize) -> Vec<Option<Rgb>> {
    let start = frames[0].exposure.map_planes(|p| p.map(|v| (v / TIME as f32).max(1e-3)));
    aliasing(gpu(), kernels(), frames, &start, 0, &Settings::default(), tile, &mut |_| true).unwrap()
}

#[test]
fn what_lies_between_the_pixels_is_found_from_displaced_frames() {
    let (frames, wanted) = bracket(&Drawn::Chart.draw(SIZE.0, SIZE.1, 24, 4, 3));
    let found = find(&frames, TILE);
    assert!(found[0].is_none() && found[3].is_none(), "frames in place and shaken ones show nothing that is asked for");
    for ((frame, wanted), found) in frames[1..].iter().zip(&wanted).zip(&found[1..]) {
        let (judged, found) = (judged(frame), &found.as_ref().unwrap().0[1]);
        let over = |f: &dyn Fn(usize) -> f32| rms((0..judged.len()).filter(|&p| judged[p]).map(f));
        let (before, after) = (over(&|p| wanted.data[p]), over(&|p| wanted.data[p] - found.data[p]));
        println!("{before:.5} {after:.5}");
        assert!(before > 3.0 * f64::from(NOISE), "the scene is harder than its pixels: {before}");
        assert!(after < 0.6 * before, "{after} is left of {before}");
    }
}

/// Brightness that changes over many pixels.
fn smooth() -> Scene {
    let wave = |c: usize, x: f32, y: f32| 0.5 + 0.2 * (0.17 * x + c as f32).sin() + 0.2 * (0.11 * x - 0.19 * y).cos();
    Scene {
        samples: Rgb(std::array::from_fn(|c| {
            Plane::from_fn(4 * (SIZE.0 + 48), 4 * (SIZE.1 + 48), |x, y| wave(c, x as f32 / 4.0, y as f32 / 4.0))
        })),
        margin: 24,
        oversampling: 4,
    }
}

/// Half a pixel too far, and there would be differences everywhere.
#[test]
fn nothing_lies_between_the_pixels_of_a_smooth_scene() {
    let (frames, wanted) = bracket(&smooth());
    for ((frame, wanted), found) in frames[1..].iter().zip(&wanted).zip(&find(&frames, TILE)[1..]) {
        let (judged, found) = (judged(frame), &found.as_ref().unwrap().0[1]);
        let inside = |p: &Plane| rms((0..judged.len()).filter(|&k| judged[k]).map(|k| p.data[k]));
        println!("{:.6} {:.6}", inside(wanted), inside(found));
        assert!(inside(wanted) < 0.2 * f64::from(NOISE) && inside(found) < 0.8 * f64::from(NOISE), "{} {}", inside(wanted), inside(found));
    }
}

/// By exposures that are a few per cent off frames differ everywhere, and a light finer than the pixels could explain it.
#[test]
fn a_tone_curve_that_is_a_little_off_is_no_structure() {
    let (mut frames, _) = bracket(&smooth());
    for (frame, off) in frames[1..3].iter_mut().zip([1.04, 0.97]) {
        frame.exposure = scaled(&frame.exposure, off);
    }
    for (frame, found) in frames[1..].iter().zip(&find(&frames, TILE)[1..3]) {
        let (judged, found) = (judged(frame), &found.as_ref().unwrap().0[1]);
        let found = rms((0..judged.len()).filter(|&k| judged[k]).map(|k| found.data[k]));
        println!("{found:.6}");
        assert!(found < 0.3 * f64::from(NOISE), "{found}");
    }
}

#[test]
fn squares_of_any_size_give_the_same() {
    let (frames, _) = bracket(&Drawn::Chart.draw(SIZE.0, SIZE.1, 24, 4, 3));
    let (whole, parts) = (find(&frames, TILE), find(&frames, 48));
    for (whole, parts) in whole.iter().zip(&parts) {
        let (Some(whole), Some(parts)) = (whole, parts) else { continue };
        for (w, p) in whole.0.iter().zip(&parts.0) {
            let (all, apart) = (rms(w.data.iter().copied()), rms(w.zip(p, |a, b| a - b).data.into_iter()));
            println!("{all:.5} {apart:.5}");
            assert!(all > f64::from(NOISE) && apart < 0.1 * all, "{apart} of {all}");
        }
    }
}

/// The whole program: sharp frames off each other's pixels, before edges harder than those.
#[test]
fn displaced_frames_of_hard_edges_agree() {
    let scene = Drawn::Chart.draw(SIZE.0, SIZE.1, 24, 4, 3);
    let still = Motion::new(synth::identity(SIZE.0), false);
    let frames =
        [(1.0 / 30.0, still.clone()), (1.0 / 8.0, still.clone().displaced(3.4, -5.3, 0.5)), (0.5, still.displaced(-7.7, 2.45, -0.4))];
    let made = synth::photograph(&scene, &Camera::default(), &frames, 0.15, 3, false).unwrap().0;
    let settings = pipeline::Settings {
        reference: Some(0),
        sharp: Some(vec![0, 1, 2]),
        noise: Some(NoiseModel::from_electrons(4000.0, 8.0)),
        ..pipeline::Settings::default()
    };
    let found = pipeline::merge(&made.bracket, &Response::Srgb, &settings, None, &mut |_| true).unwrap();
    let irradiance = scaled(&found.irradiance, 30.0);
    let judge = Judge { limit: Some(0.98 * 30.0), ..Judge::default() };
    let score = metrics::score(&irradiance, &made.truth, &judge).unwrap().pu_psnr;
    let rms: Vec<Option<f64>> = (0..3).map(|i| found.report["frames"][i]["aliasing_rms"].as_f64()).collect();
    println!("{score:.2} {rms:?}");
    assert!(settings.reduced(1).between_pixels && !settings.reduced(2).between_pixels, "a quick look does without");
    assert!(rms[0].is_none() && rms[1..].iter().all(|r| r.is_some_and(|r| r > 1e-3)), "{rms:?}");
    assert!(score > 36.0, "34.1 without: {score}");
}

#[test]
fn looking_between_the_pixels_can_be_cancelled() {
    let (frames, _) = bracket(&Drawn::Chart.draw(SIZE.0, SIZE.1, 24, 4, 3));
    let start = frames[0].exposure.map_planes(|p| p.map(|v| v.max(1e-3)));
    let mut heard = 0;
    let mut stop = |f: f32| {
        heard += 1;
        assert!((0.0..=1.0).contains(&f), "{f}");
        heard < 3
    };
    let found = aliasing(gpu(), kernels(), &frames, &start, 0, &Settings::default(), 48, &mut stop);
    assert!(matches!(found, Err(unshaken::error::Error::Cancelled)));
}

/// Light that no pixel aliases at (x, y): soft edges and texture of five pixels and more.
fn band_limited(x: f64, y: f64) -> f64 {
    let edge = |d: f64| 0.5 + 0.5 * (d / 1.6).tanh();
    let grain = (1.1 * x + 0.4 * y).sin() * (0.3 * x - 0.9 * y).cos();
    let squares = edge((0.13 * x).sin() / 0.13) * edge((0.11 * y + 0.05 * x).sin() / 0.12);
    0.15 + 0.35 * squares + 0.06 * grain * edge(0.8 * x + 0.3 * y)
}

/// What frames are worth does not depend on where between the pixels they lie: the filter takes a frame's noise for what its interpolation makes of it.
#[test]
fn displaced_frames_denoise_as_those_in_place_do() {
    let at = |tsf: &Tsf| {
        let motion = tsf.single().unwrap();
        let middle = 0.5 * DVec2::new(SIZE.0 as f64 - 1.0, SIZE.1 as f64 - 1.0);
        let one = |c: usize| {
            Plane::from_fn(SIZE.0, SIZE.1, |x, y| {
                let q = unshaken::pose::project(&motion.inverse(), DVec2::new(x as f64, y as f64) - middle);
                (band_limited(q.x, q.y) * [1.0, 0.8, 0.6][c]) as f32
            })
        };
        Rgb([one(0), one(1), one(2)])
    };
    let truth = at(&Tsf::identity());
    let error = |places: [Tsf; 3]| {
        let observe = |(k, tsf): (usize, &Tsf)| {
            let (clean, sigma) = (at(tsf), [0.06f32, 0.02, 0.02][k]);
            let exposure = Rgb(std::array::from_fn(|c| {
                let n = noise(60 + 3 * k as u64 + c as u64, SIZE.0 * SIZE.1);
                let seen = clean.0[c].data.iter().zip(n).map(|(v, n)| v + 3f32.sqrt() * sigma * n);
                Plane::from_vec(SIZE.0, SIZE.1, seen.collect()).unwrap()
            }));
            let noise = std::array::from_fn(|_| vec![sigma; NOISE_STEPS]);
            let mask = Plane::filled(SIZE.0, SIZE.1, 1.0);
            Observation { exposure, mask, exposure_time: 1.0, noise, black_clipped: false, tsf: tsf.clone() }
        };
        let frames: Vec<Observation> = places.iter().enumerate().map(observe).collect();
        let start = frames[0].exposure.map_planes(|p| p.map(|v| v.max(0.01)));
        let found = solve(gpu(), kernels(), &frames, &start, 0, &Settings::default(), &mut |_| true).unwrap().cropped();
        let inner = |p: &Plane| p.crop(12, 12, SIZE.0 - 24, SIZE.1 - 24).data;
        let squares = found.0.iter().zip(&truth.0).map(|(f, t)| inner(f).iter().zip(inner(t)).map(|(f, t)| (f - t).powi(2)).sum::<f32>());
        squares.sum::<f32>().sqrt()
    };
    let in_place = error([Tsf::identity(), Tsf::identity(), Tsf::identity()]);
    let whole = error([Tsf::identity(), place(3.0, -5.0, 0.0), place(-6.0, 2.0, 0.0)]);
    let between = error([Tsf::identity(), place(3.5, -5.5, 0.0), place(-6.5, 2.5, 0.0)]);
    println!("{in_place:.3} in place, {whole:.3} whole pixels away, {between:.3} half-way between pixels");
    assert!((whole - in_place).abs() < 0.05 * in_place, "{whole} for {in_place}");
    // With the mean power for all frequencies it is three times as much. The interpolation's own losses are left.
    assert!(between < 1.6 * in_place, "{between} for {in_place}");
}

/// A soft pattern of period 11 px and longer, at a place in pixels from the grid's centre.
fn soft(p: DVec2, c: usize) -> f64 {
    0.4 + 0.1 * (0.57 * p.x + c as f64).sin() * (0.41 * p.y - 0.1 * p.x).cos()
}

#[test]
fn a_soft_frame_is_read_at_the_pixels_of_the_latent_grid() {
    for size in [(61, 44), (40, 40), (1, 1)] {
        let middle = 0.5 * DVec2::new(size.0 as f64 - 1.0, size.1 as f64 - 1.0);
        let from_centre = |x: usize, y: usize| DVec2::new(x as f64, y as f64) - middle;
        for (x, y, turn) in [(0.0, 0.0, 0.0), (2.0, -3.0, 0.0), (3.3, -2.6, 1.5), (-0.5, 0.5, -2.0)] {
            let motion = place(x, y, turn).centre();
            let back = motion.inverse();
            let plane = |c: usize| Plane::from_fn(size.0, size.1, |x, y| soft(project(&back, from_centre(x, y)), c) as f32);
            let mut frame = Observation {
                exposure: Rgb([plane(0), plane(1), plane(2)]),
                mask: Plane::filled(size.0, size.1, 0.75),
                exposure_time: TIME,
                noise: std::array::from_fn(|_| vec![NOISE; NOISE_STEPS]),
                black_clipped: false,
                tsf: Tsf::still(motion),
            };
            let spoilt = (size.0 / 2, size.1 / 2);
            frame.exposure.0[1].data[spoilt.1 * size.0 + spoilt.0] = UNSEEN;
            let read = frame.in_place(&motion);
            assert!(read.tsf.is_identity());
            for j in 0..size.1 {
                for i in 0..size.0 {
                    let (k, q) = (j * size.0 + i, project(&motion, from_centre(i, j)) + middle);
                    let inside = q.x >= 0.0 && q.y >= 0.0 && q.x <= size.0 as f64 - 1.0 && q.y <= size.1 as f64 - 1.0;
                    assert_eq!(read.mask.data[k], if inside { 0.75 } else { 0.0 }, "mask at {i}, {j}");
                    // Pixels beyond the border are not what the pattern is there.
                    let far = |v: f64, n: usize| v >= 2.0 && v < n as f64 - 3.0;
                    if far(q.x, size.0) && far(q.y, size.1) {
                        for c in [0, 2] {
                            let error = f64::from(read.exposure.0[c].data[k]) - soft(from_centre(i, j), c);
                            assert!(error.abs() < 1.5e-3, "channel {c} at {i}, {j}: {error:.4} off");
                        }
                    }
                    // The tap of a whole number of pixels is one pixel.
                    let near = |v: f64, s: usize| v.fract() == 0.0 && v == s as f64 || v.fract() != 0.0 && (v - s as f64).abs() < 2.0;
                    let unseen = !inside || near(q.x, spoilt.0) && near(q.y, spoilt.1);
                    if (q - q.round()).abs().min_element() > 1e-6 || (q - q.round()).abs().max_element() == 0.0 {
                        assert_eq!(read.exposure.0[1].data[k] == UNSEEN, unseen, "unseen at {i}, {j}, from {q}");
                    }
                }
            }
        }
    }
}

#[test]
fn a_plane_of_the_latent_grid_is_seen_at_the_pixels_of_a_frame() {
    let (w, h) = (50, 41);
    let middle = 0.5 * DVec2::new(w as f64 - 1.0, h as f64 - 1.0);
    let motion = place(4.25, -2.5, 1.0).centre();
    let plane = Plane::from_fn(w, h, |x, y| (2.0 * x as f64 - 3.0 * y as f64) as f32);
    let own = on_own_pixels(&plane, &motion);
    for (x, y) in [(20, 20), (12, 30), (30, 9)] {
        let q = project(&motion.inverse(), DVec2::new(x as f64, y as f64) - middle) + middle;
        assert!((f64::from(own.at(x, y)) - (2.0 * q.x - 3.0 * q.y)).abs() < 1e-3, "at {x}, {y}");
    }
}
