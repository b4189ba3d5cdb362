//! What moved between sharp frames: found, and only that; and what becomes of it in the merge.

use crate::support::noise as numbers;
use glam::{DMat3, DVec2};
use unshaken::exposure::{Bracket, Frame};
use unshaken::ghosts::Sharp;
use unshaken::image::{Plane, Rgb};
use unshaken::noise::{self, NoiseModel};
use unshaken::pipeline::{self, Settings};
use unshaken::pose::{Pose, project};
use unshaken::response::Response;
use unshaken::synth::{self, Camera, Drawn, Motion};

const SIZE: (usize, usize) = (200, 140);
const NOISE: NoiseModel = NoiseModel { shot: 1.0 / 12000.0, read: 2.5e-7 };
const TIMES: [f64; 3] = [0.1, 0.3, 0.9];
/// Side of what moves, and where each frame shows it (its first pixel, on the reference's grid).
const THING: f64 = 36.0;
const PLACES: [(f64, f64); 3] = [(40.0, 30.0), (52.0, 40.0), (60.0, 60.0)];

/// Smooth texture of some pixels' grain, in units that 1 s exposes to the middle of the range.
fn texture(seed: f64, p: DVec2, c: usize) -> f64 {
    let waves = [(0.31, 0.17), (-0.23, 0.29), (0.11, -0.41), (0.47, 0.05)];
    let sum: f64 = waves.iter().enumerate().map(|(k, (a, b))| (a * p.x + b * p.y + seed * (k as f64 + 1.3) + 0.3 * c as f64).sin()).sum();
    0.16 * (0.3 * sum).exp()
}

/// The scene at a place on the reference's grid as frame `i` finds it: with the thing, if it `moves`, before it.
fn light(p: DVec2, i: usize, moves: bool, c: usize) -> f64 {
    let at = p - DVec2::from(PLACES[i]);
    if moves && at.min_element() >= 0.0 && at.max_element() < THING { texture(9.0, at, 2 - c) * 1.4 } else { texture(1.0, p, c) }
}

fn frames(motions: &[DMat3], moves: bool, bend: impl Fn(usize, f64) -> f64 + Sync) -> Vec<Frame> {
    photographed(motions, |p, i, c| light(p, i, moves, c), bend)
}

/// Frames at `motions` of what `light` says of a place, a frame and a channel, in linear steps of 4096 with noise, whose tone curves `bend` what the camera
/// records.
fn photographed(
    motions: &[DMat3],
    light: impl Fn(DVec2, usize, usize) -> f64 + Sync,
    bend: impl Fn(usize, f64) -> f64 + Sync,
) -> Vec<Frame> {
    let half = 0.5 * DVec2::new(SIZE.0 as f64 - 1.0, SIZE.1 as f64 - 1.0);
    let frame = |i: usize| {
        let back = motions[i].inverse();
        let plane = |c: usize| {
            let n = numbers(100 * i as u64 + c as u64, SIZE.0 * SIZE.1);
            Plane::from_fn(SIZE.0, SIZE.1, |x, y| {
                let p = project(&back, DVec2::new(x as f64, y as f64) - half) + half;
                let exposure = bend(i, TIMES[i] * light(p, i, c));
                let noisy = exposure + (3.0 * NOISE.variance(exposure)).sqrt() * f64::from(n[y * SIZE.0 + x]);
                ((noisy.clamp(0.0, 1.0) * 4095.0).round() / 4095.0) as f32
            })
        };
        Frame {
            name: format!("{i}.tif"),
            intensity: Rgb(std::array::from_fn(plane)),
            levels: 4095,
            chroma_subsampled: false,
            lossy: false,
            speed: None,
            exposure_time: TIMES[i],
        }
    };
    (0..motions.len()).map(frame).collect()
}

fn shares(frames: &[Frame], motions: &[DMat3]) -> Vec<Option<Plane>> {
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
    let level = noise::alike(frames.len(), NOISE);
    let curves = noise::curves(frames, &Response::Linear, &level);
    let ids: Vec<usize> = (0..frames.len()).collect();
    Sharp { frames, exposures: &exposures, curves: &curves, noise: &level, motions, ids: &ids }.shares()
}

fn displaced() -> [DMat3; 3] {
    [DMat3::IDENTITY, Pose::planar(3.4, -2.2, 0.4, 1.0).homography(1000.0), Pose::planar(-5.3, 6.5, -0.3, 1.0).homography(1000.0)]
}

#[test]
fn one_frame_alone_counts_where_something_moved() {
    let half = 0.5 * DVec2::new(SIZE.0 as f64 - 1.0, SIZE.1 as f64 - 1.0);
    for motions in [[DMat3::IDENTITY; 3], displaced()] {
        let found = shares(&frames(&motions, true, |_, x| x), &motions);
        let at = |i: usize, p: DVec2| {
            let q = (project(&motions[i], p - half) + half).round();
            found[i].as_ref().map_or(1.0, |s| s.clamped(q.x as isize, q.y as isize))
        };
        // Farther from every place of the thing than a ghost is widened and fades, all count; elsewhere those that show the same.
        let (mut apart, mut all) = (0, 0);
        for (x, y) in (12..SIZE.1 - 12).flat_map(|y| (12..SIZE.0 - 12).map(move |x| (x, y))) {
            let p = DVec2::new(x as f64, y as f64);
            let within =
                |by: f64| PLACES.map(|a| (p - DVec2::from(a)).min_element() >= by && (p - DVec2::from(a)).max_element() < THING - by);
            let counts = [0, 1, 2].map(|i| at(i, p));
            let shown = within(0.0);
            if within(-24.0) == [false; 3] {
                assert_eq!(counts, [1.0; 3], "nothing moved at {p}");
                all += 1;
            } else if within(4.0) == within(-4.0) && shown != [false; 3] {
                let first = (0..3).find(|&i| counts[i] == 1.0).unwrap_or_else(|| panic!("one counts at {p}: {counts:?}"));
                for i in 0..3 {
                    // The thing has one look in all frames, but another part of it at a place.
                    let same = i == first || !shown[i] && !shown[first];
                    assert!(counts[i] < 0.02 || same, "at {p} frames count {counts:?}");
                }
                apart += 1;
            }
        }
        println!("{apart} {all}");
        assert!(apart > 700 && all > 5000, "{apart} {all}");
    }
}

/// Who walks by in a white shirt and black trousers is not cut in two, whichever frames show shirt and trousers best.
#[test]
fn a_small_thing_is_shown_by_one_frame() {
    const WIDE: f64 = 10.0;
    const TALL: f64 = 80.0;
    let places = [(30.0, 28.0), (90.0, 30.0), (150.0, 32.0)];
    let walker = |p: DVec2, i: usize, c: usize| {
        let at = p - DVec2::from(places[i]);
        let seen = at.min_element() >= 0.0 && at.x < WIDE && at.y < TALL;
        let cloth = if at.y < 0.5 * TALL { 1.8 } else { 0.05 };
        if seen { cloth * (0.8 + 0.2 * (0.9 * at.x + 0.7 * at.y).sin()) } else { texture(1.0, p, c) }
    };
    let still = [DMat3::IDENTITY; 3];
    let found = shares(&photographed(&still, walker, |_, x| x), &still);
    for place in places {
        let at = |i: usize, y: f64| found[i].as_ref().map_or(1.0, |s| s.at((place.0 + 0.5 * WIDE) as usize, (place.1 + y) as usize));
        // In the middle of the shirt, and of the trousers. The longest frame's own shirt is burnt out, which is masked as it is.
        for i in (0..3).filter(|&i| i < 2 || place != places[2]) {
            assert_eq!(at(i, 0.25 * TALL), at(i, 0.75 * TALL), "frame {i} at {place:?}");
        }
        println!("{:?}", [0, 1, 2].map(|i| at(i, 0.25 * TALL)));
        assert!((0..3).any(|i| at(i, 0.75 * TALL) == 1.0) && (0..3).any(|i| at(i, 0.75 * TALL) == 0.0));
    }
}

/// Beside what longer frames burn out, the shortest one does not count alone for surroundings of which its file kept hardly more than a grey.
#[test]
fn a_dark_frame_does_not_speak_for_what_it_hardly_shows() {
    let bright = |p: DVec2| p.x >= 70.0 && p.x < 130.0 && p.y >= 40.0;
    let night = |p: DVec2, i: usize, c: usize| {
        let clouds = 1.0 + 0.6 * (0.7 * p.x + 0.4 * p.y).sin();
        match i {
            _ if bright(p) => 4.0,
            0 => 0.09,
            _ => [0.05, 0.08, 0.14][c] * clouds,
        }
    };
    let still = [DMat3::IDENTITY; 3];
    let mut frames = photographed(&still, night, |_, x| x);
    for frame in &mut frames {
        // 8 bits, four by four pixels averaged.
        frame.levels = 4 * 255;
        frame.intensity = frame.intensity.map_planes(|p| p.map(|v| (v * 1020.0).round() / 1020.0));
    }
    let found = shares(&frames, &still);
    for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
        let near = |by: f64| [-by, 0.0, by].iter().any(|d| bright(DVec2::new(x as f64 + d, y as f64 + by)));
        if !near(6.0) {
            let counts = [1, 2].map(|i| found[i].as_ref().map_or(1.0, |s| s.at(x, y)));
            assert_eq!(counts, [1.0; 2], "at {x}, {y}");
        }
    }
}

#[test]
fn what_stands_still_is_no_ghost() {
    for motions in [[DMat3::IDENTITY; 3], displaced()] {
        // Tone curves that nobody knows to a tenth and a fifth.
        for bend in [|_: usize, x: f64| x, |i: usize, x: f64| if i == 0 { 1.1 * x.powf(1.2) } else { x }] {
            assert!(shares(&frames(&motions, false, bend), &motions).iter().all(Option::is_none));
        }
    }
    // Noise that black cuts off, which makes one frame brighter than the next, and more of it than is known.
    let still = [DMat3::IDENTITY; 3];
    let mut frames = photographed(&still, |p, _, c| 0.02 * texture(1.0, p, c), |_, x| x);
    for (i, frame) in frames.iter_mut().enumerate() {
        for (c, plane) in frame.intensity.0.iter_mut().enumerate() {
            let n = numbers(1000 + 10 * i as u64 + c as u64, SIZE.0 * SIZE.1);
            plane.data.iter_mut().zip(n).for_each(|(v, n)| *v = ((*v + 3e-3 * n).max(0.0) * 4095.0).round() / 4095.0);
        }
    }
    assert!(shares(&frames, &still).iter().all(Option::is_none));
    // Edges harder than the pixels, half a pixel and more off each other's.
    let scene = Drawn::Chart.draw(112, 80, 24, 4, 3);
    let still = Motion::new(synth::identity(112), false);
    let shots =
        [(1.0 / 30.0, still.clone()), (1.0 / 8.0, still.clone().displaced(3.5, -5.5, 0.5)), (0.5, still.displaced(-7.7, 2.45, -0.4))];
    let made = synth::photograph(&scene, &Camera::default(), &shots, 0.15, 3, false).unwrap().0;
    let motions = [(0.0, 0.0, 0.0), (3.5, -5.5, 0.5), (-7.7, 2.45, -0.4)].map(|(x, y, z)| Pose::planar(x, y, z, 1.0).homography(1000.0));
    let frames = made.bracket.frames();
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Srgb)).collect();
    let level = noise::alike(frames.len(), NoiseModel::from_electrons(4000.0, 8.0));
    let curves = noise::curves(frames, &Response::Srgb, &level);
    let found = Sharp { frames, exposures: &exposures, curves: &curves, noise: &level, motions: &motions, ids: &[0, 1, 2] }.shares();
    assert!(found.iter().all(Option::is_none));
}

/// A frame that is not asked about does not matter, and a tiny one is no reason to fail.
#[test]
fn frames_of_any_size_are_compared() {
    for (w, h) in [(1, 1), (3, 1), (17, 9), (64, 65)] {
        let frame = |exposure_time: f64| Frame {
            name: "a".into(),
            intensity: Rgb::filled(w, h, (0.3 * exposure_time) as f32),
            levels: 255,
            chroma_subsampled: false,
            lossy: false,
            speed: None,
            exposure_time,
        };
        let frames = [frame(1.0), frame(2.0)];
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &Response::Linear)).collect();
        let level = noise::alike(frames.len(), NOISE);
        let curves = noise::curves(&frames, &Response::Linear, &level);
        let motions = [DMat3::IDENTITY, DMat3::from_translation(DVec2::new(0.3, 0.1))];
        let sharp = Sharp { frames: &frames, exposures: &exposures, curves: &curves, noise: &level, motions: &motions, ids: &[0, 1] };
        assert!(sharp.shares().iter().all(Option::is_none), "{w} x {h}");
    }
}

fn merged(frames: Vec<Frame>, deghost: bool) -> pipeline::Outcome {
    let settings = Settings {
        reference: Some(0),
        sharp: Some((0..frames.len()).collect()),
        noise: Some(NOISE),
        align: false,
        deghost,
        ..Settings::default()
    };
    pipeline::merge(&Bracket::new(frames).unwrap(), &Response::Linear, &settings, None, &mut |_| true).unwrap()
}

/// Root mean square of ln(E / truth) over the pixels that `judged` names.
fn error(irradiance: &Rgb, truth: impl Fn(DVec2, usize) -> f64, judged: impl Fn(DVec2) -> bool) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
        let p = DVec2::new(x as f64, y as f64);
        if judged(p) {
            for c in 0..3 {
                sum += (f64::from(irradiance.0[c].at(x, y)) / truth(p, c)).ln().powi(2);
                count += 1;
            }
        }
    }
    (sum / f64::from(count)).sqrt()
}

/// Sharp frames of which one shows something else: with `Settings::deghost` the merge is that of one frame there, and elsewhere as if nothing had moved.
#[test]
fn the_merge_shows_what_moved_as_one_frame_does() {
    let still = [DMat3::IDENTITY; 3];
    let (quiet, ghostly, clean) = (
        merged(frames(&still, false, |_, x| x), true),
        merged(frames(&still, true, |_, x| x), false),
        merged(frames(&still, true, |_, x| x), true),
    );
    let ghosts = |o: &pipeline::Outcome| (0..3).map(|i| o.report["frames"][i]["ghosts"].as_f64()).collect::<Vec<_>>();
    assert_eq!(ghosts(&quiet), [None; 3], "nothing moved");
    assert_eq!(ghosts(&ghostly), [None; 3], "not looked for");
    assert!(ghosts(&clean)[..2].iter().all(|g| g.is_some_and(|g| (0.03..0.4).contains(&g))), "{:?}", ghosts(&clean));
    // The longest frame is clipped nowhere, and counts.
    let thing = |p: DVec2| (p - DVec2::from(PLACES[2])).min_element() >= 4.0 && (p - DVec2::from(PLACES[2])).max_element() < THING - 4.0;
    let gone =
        |p: DVec2| PLACES[..2].iter().any(|a| (p - DVec2::from(*a)).min_element() >= 0.0 && (p - DVec2::from(*a)).max_element() < THING);
    let apart =
        |p: DVec2| PLACES.iter().all(|a| (p - DVec2::from(*a)).min_element() < -24.0 || (p - DVec2::from(*a)).max_element() > THING + 24.0);
    let scale = TIMES[0];
    let of = |o: &pipeline::Outcome, judged: &dyn Fn(DVec2) -> bool| error(&o.irradiance, |p, c| scale * light(p, 2, true, c), judged);
    let moved = |p: DVec2| thing(p) || gone(p) && (p - DVec2::from(PLACES[2])).min_element() < -4.0;
    println!("{:.4} {:.4}; {:.4} {:.4}", of(&ghostly, &moved), of(&clean, &moved), of(&quiet, &apart), of(&clean, &apart));
    assert!(of(&ghostly, &moved) > 4.0 * of(&clean, &moved), "ghosts: {} and {}", of(&ghostly, &moved), of(&clean, &moved));
    assert!(of(&clean, &moved) < 0.03, "as one frame shows it: {}", of(&clean, &moved));
    // 0.3 dB.
    assert!(of(&clean, &apart) < 1.035 * of(&quiet, &apart), "{} and {}", of(&clean, &apart), of(&quiet, &apart));
}

/// A tone curve that is a little off, in frames that lie between the pixels of one that is clipped: what the warps cannot reach at the border would tell
/// any nonsense of it.
#[test]
fn the_border_of_a_clipped_frame_is_like_what_lies_beside_it() {
    let motions = [(0.07, 0.04), (0.17, -0.08), (0.0, 0.0)].map(|(x, y)| DMat3::from_translation(DVec2::new(x, y)));
    let bend = |i: usize, x: f64| match i {
        0 => 1.08 * x,
        2 => 1.0,
        _ => x,
    };
    let made = frames(&motions, false, bend);
    let file = unshaken::tsf::TsfFile::new(
        made.iter()
            .zip(&motions)
            .map(|(f, m)| {
                let tsf = unshaken::tsf::Tsf::new(1000.0, vec![Pose::planar(m.z_axis.x, m.z_axis.y, 0.0, 1.0)]).unwrap();
                unshaken::tsf::TsfEntry::new(&f.name, SIZE.0, SIZE.1, &tsf)
            })
            .collect(),
    );
    let settings = Settings { reference: Some(2), noise: Some(NOISE), ..Settings::default() };
    let found = pipeline::merge(&Bracket::new(made).unwrap(), &Response::Linear, &settings, Some(&file), &mut |_| true).unwrap();
    let edge = |p: DVec2| p.min_element() < 2.0 || p.x >= SIZE.0 as f64 - 2.0 || p.y >= SIZE.1 as f64 - 2.0;
    let error = error(&found.irradiance, |p, c| TIMES[2] * light(p, 0, false, c), edge);
    println!("{error:.4}");
    assert!(error < 0.12, "{error}");
}
