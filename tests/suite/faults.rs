//! What must not spoil a merge: a wrong TSF, another scene, something that moved, noise of any level, light beyond white, a soft lens.

use crate::support::files::shared;
use std::sync::OnceLock;
use unshaken::deblur::{self, Prior};
use unshaken::exposure::{Bracket, Frame};
use unshaken::image::{Plane, Rgb};
use unshaken::io::{ldr, metadata};
use unshaken::mask;
use unshaken::metrics::{self, Judge};
use unshaken::noise::NoiseModel;
use unshaken::pipeline::{self, Blind, Outcome, Settings};
use unshaken::pose::{self, Pose};
use unshaken::response::{self, Response};
use unshaken::synth::{self, Camera, Drawn, SyntheticBracket, Tremor};
use unshaken::tsf::{Tsf, TsfEntry, TsfFile};

const SIZE: (usize, usize) = (160, 120);

/// Two sharp frames and a shaken one that holds most of the light.
fn bracket(full_well: f64, median: f64) -> SyntheticBracket {
    let scene = synth::room(SIZE.0, SIZE.1, 24, 5);
    let tremor = Tremor { extent_px: 8.0, roll_deg: 0.8, offset_px: 0.5, offset_deg: 0.0 };
    let camera = Camera { full_well, ..Camera::default() };
    synth::capture(&scene, &camera, &[(1.0 / 30.0, None), (1.0 / 8.0, None), (1.0, Some(tremor))], median, 5).unwrap()
}

/// The TSFs of `made`, that of the shaken frame changed by `change`.
fn tsfs(made: &SyntheticBracket, change: impl Fn(&Pose) -> Pose) -> TsfFile {
    let entries = made.bracket.frames().iter().zip(&made.tsfs).enumerate().map(|(i, (f, t))| {
        let mut t = t.clone();
        if i == 2 {
            t.poses = t.poses.iter().map(&change).collect();
        }
        TsfEntry::new(&f.name, SIZE.0, SIZE.1, &t)
    });
    TsfFile::new(entries.collect())
}

fn with_frame(made: &SyntheticBracket, change: impl Fn(usize, &Plane) -> Plane) -> Bracket {
    let mut frames: Vec<Frame> = made.bracket.frames().to_vec();
    frames[2].intensity = Rgb(std::array::from_fn(|c| change(c, &frames[2].intensity.0[c])));
    Bracket::new(frames).unwrap()
}

fn settings() -> Settings {
    Settings { noise: Some(NoiseModel::from_electrons(4000.0, 8.0)), ..Settings::default() }
}

fn merge(bracket: &Bracket, settings: &Settings, given: Option<&TsfFile>) -> Outcome {
    pipeline::merge(bracket, &Response::Srgb, settings, given, &mut |_| true).unwrap()
}

/// PU21-PSNR of `found`, whose 1 is white after `time` seconds.
fn decibels(found: &Outcome, bracket: &Bracket, truth: &Rgb) -> f64 {
    let time = bracket.frames()[found.reference].exposure_time as f32;
    let limit = Some(0.98 / bracket.frames()[0].exposure_time as f32);
    let irradiance = found.irradiance.map_planes(|p| p.map(|v| v / time));
    metrics::score(&irradiance, truth, &Judge { limit, ..Judge::default() }).unwrap().pu_psnr
}

/// The bracket, and what is reached without its shaken frame and with it.
fn sound() -> &'static (SyntheticBracket, f64, f64) {
    static SOUND: OnceLock<(SyntheticBracket, f64, f64)> = OnceLock::new();
    SOUND.get_or_init(|| {
        let made = bracket(4000.0, 0.15);
        let without = merge(&made.bracket, &Settings { exclude: vec![2], ..settings() }, None);
        let with = merge(&made.bracket, &settings(), Some(&tsfs(&made, |p| *p)));
        let (without, with) = (decibels(&without, &made.bracket, &made.truth), decibels(&with, &made.bracket, &made.truth));
        assert!(with > without + 1.0, "the shaken frame brings something: {without:.2} to {with:.2} dB");
        (made, without, with)
    })
}

#[test]
fn a_tsf_turned_by_half_a_degree_does_no_harm() {
    let (made, without, _) = sound();
    let turned = tsfs(made, |p| Pose { theta_z_deg: p.theta_z_deg + 0.5, ..*p });
    let got = decibels(&merge(&made.bracket, &settings(), Some(&turned)), &made.bracket, &made.truth);
    assert!(got > without - 0.3, "{got:.2} dB, without the frame {without:.2}");
}

#[test]
#[ignore = "with a TSF given nothing looks for another scene"]
fn a_frame_of_another_scene_does_no_harm() {
    let (made, without, _) = sound();
    // The same frame upside down: as bright, as sharp, and nothing in common.
    let other = with_frame(made, |_, p| Plane::from_fn(p.width, p.height, |x, y| p.at(p.width - 1 - x, p.height - 1 - y)));
    for given in [Some(tsfs(made, |p| *p)), None] {
        let found = merge(&other, &settings(), given.as_ref());
        let got = decibels(&found, &other, &made.truth);
        assert!(got > without - 0.3, "TSF given: {}: {got:.2} dB, without the frame {without:.2}", given.is_some());
        // With a TSF it may count, by what of it fits.
        assert!(given.is_some() || found.left_out.iter().any(|l| l.0 == "frame3.png"), "{:?}", found.left_out);
    }
}

/// Which of three frames of a room are shaken, with the noise that the program finds.
#[test]
fn shaken_frames_are_told_from_sharp_ones() {
    let scene = synth::room(192, 144, 24, 3);
    let tremor = Tremor { extent_px: 6.0, roll_deg: 0.5, offset_px: 1.0, offset_deg: 0.0 };
    for shaken in [[false, false, false], [false, false, true], [false, true, true]] {
        let times: Vec<_> = [0.05, 0.2, 0.8].into_iter().zip(shaken).map(|(t, s)| (t, s.then(|| tremor.clone()))).collect();
        let made = synth::capture(&scene, &Camera::default(), &times, 0.2, 11).unwrap();
        let quick = deblur::Settings { outer: 1, prior: Prior::Tv, ..deblur::Settings::default() };
        let found = merge(&made.bracket, &Settings { deblur: quick, ..Settings::default() }, None);
        let moved: Vec<bool> = judgements(&found).iter().map(|j| j["kind"] == "moved").collect();
        assert_eq!(moved, shaken, "{:?}", judgements(&found));
    }
}

/// Large frames are judged by a part of them, wherever the others lie.
#[test]
fn frames_larger_than_the_window_are_judged_by_a_part_of_them() {
    let scene = synth::room(840, 560, 60, 3);
    let displaced = |extent_px: f64, roll_deg: f64| Tremor { extent_px, roll_deg, offset_px: 18.0, offset_deg: 0.3 };
    let times = [(0.05, None), (0.2, Some(displaced(0.0, 0.0))), (0.8, Some(displaced(7.0, 0.3)))];
    let made = synth::capture(&scene, &Camera::default(), &times, 0.2, 11).unwrap();
    let quick = deblur::Settings { outer: 1, prior: Prior::Tv, ..deblur::Settings::default() };
    let found = merge(&made.bracket, &Settings { deblur: quick, between_pixels: false, ..Settings::default() }, None);
    let moved: Vec<bool> = judgements(&found).iter().map(|j| j["kind"] == "moved").collect();
    assert_eq!(moved, [false, false, true], "{:?}", judgements(&found));
}

#[test]
fn what_moved_in_the_shaken_frame_does_no_harm() {
    let (made, without, with) = sound();
    // A dark thing of 24 pixels stands where the room was.
    let thing = |x: usize, y: usize| (60..84).contains(&x) && (50..74).contains(&y);
    let moved =
        with_frame(made, |c, p| Plane::from_fn(p.width, p.height, |x, y| if thing(x, y) { 0.2 + 0.1 * c as f32 } else { p.at(x, y) }));
    let got = decibels(&merge(&moved, &settings(), Some(&tsfs(made, |p| *p))), &moved, &made.truth);
    assert!(got > without.max(with - 1.0) - 0.3, "{got:.2} dB, sound {with:.2}, without the frame {without:.2}");
}

#[test]
fn one_smoothing_serves_dim_frames_and_clean_ones() {
    for full_well in [1000.0, 5000.0, 25_000.0] {
        let made = bracket(full_well, 1.0);
        let noise = Some(NoiseModel::from_electrons(full_well, 8.0));
        let reached = |factor: f32| {
            let mut set = Settings { noise, ..settings() };
            set.deblur.lambda *= factor;
            decibels(&merge(&made.bracket, &set, Some(&tsfs(&made, |p| *p))), &made.bracket, &made.truth)
        };
        let (less, usual, more) = (reached(0.4), reached(1.0), reached(2.5));
        assert!(usual > less.max(more) - 0.3, "{full_well} electrons: {less:.2}, {usual:.2} by default, {more:.2} dB");
    }
}

#[test]
fn a_channel_that_clips_leaves_the_others_their_light() {
    // Under a red lamp: the long frame's red is clipped nearly everywhere, and its green and blue hold the least noise.
    let mut scene = synth::room(SIZE.0, SIZE.1, 24, 5);
    scene.samples.0[0].data.iter_mut().for_each(|v| *v *= 6.0);
    let made =
        synth::capture(&scene, &Camera { full_well: 4000.0, ..Camera::default() }, &[(1.0 / 30.0, None), (0.5, None)], 0.25, 5).unwrap();
    let frames = made.bracket.frames();
    let alone = |p: usize| {
        let z = frames[1].intensity.pixel(p);
        z[0] >= mask::CLIPPED && z[1].max(z[2]) < 0.8 && frames[0].intensity.0[0].data[p] < 0.8
    };
    let judged: Vec<usize> = (0..SIZE.0 * SIZE.1).filter(|&p| alone(p)).collect();
    assert!(judged.len() > 2000, "{} pixels", judged.len());
    let error = |settings: &Settings, c: usize| {
        let found = merge(&made.bracket, settings, None);
        let time = frames[found.reference].exposure_time as f32;
        let off = |&p: &usize| f64::from((found.irradiance.0[c].data[p] / time / made.truth.0[c].data[p]).max(1e-3).ln());
        (judged.iter().map(|p| off(p).powi(2)).sum::<f64>() / judged.len() as f64).sqrt()
    };
    let short = Settings { exclude: vec![1], ..settings() };
    for (c, most) in [(0, 1.02), (1, 0.6), (2, 0.6)] {
        let (with, without) = (error(&settings(), c), error(&short, c));
        assert!(with < most * without, "channel {c}: {with:.4}, of the short frame alone {without:.4}");
    }
}

#[test]
fn light_beyond_white_goes_on_smoothly() {
    let made = bracket(4000.0, 12.0);
    let found = merge(&made.bracket, &settings(), Some(&tsfs(&made, |p| *p)));
    let (shortest, time) = (&made.bracket.frames()[0], made.bracket.frames()[found.reference].exposure_time as f32);
    let white = time / shortest.exposure_time as f32;
    let lost = |x: usize, y: usize| shortest.intensity.0.iter().all(|p| p.at(x, y) >= 1.0);
    let mut count = 0;
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            let v = found.irradiance.pixel(y * SIZE.0 + x);
            assert!(v.iter().all(|v| v.is_finite() && *v >= 0.0));
            if lost(x, y) {
                count += 1;
                assert!(v.iter().all(|v| *v >= 0.97 * white), "({x}, {y}): {v:?} is below what clips, {white}");
            }
            // Well inside: no steps of brightness, no colour that nobody saw.
            let inside = x > 0 && y > 0 && x + 1 < SIZE.0 && y + 1 < SIZE.1 && (0..9).all(|k| lost(x + k % 3 - 1, y + k / 3 - 1));
            if inside {
                let next = found.irradiance.pixel(y * SIZE.0 + x + 1);
                for c in 0..3 {
                    assert!((v[c] / next[c]).ln().abs() < 0.7, "a step at ({x}, {y}), {v:?} to {next:?}");
                }
                let (lo, hi) = v.iter().fold((f32::MAX, 0.0f32), |(lo, hi), v| (lo.min(*v), hi.max(*v)));
                assert!(hi < 3.0 * lo, "a coloured hole at ({x}, {y}): {v:?}");
            }
        }
    }
    assert!(count > 50, "the scene holds light beyond white: {count} pixels");
}

/// Hand-held frames through a soft lens: no edge is steep, and no two frames lie on the same pixels. The sharp ones are still sharp.
#[test]
#[ignore = "a sharp frame behind a soft lens is judged moved by 3.5 px beside a denoised one"]
fn a_soft_lens_is_not_taken_for_shake() {
    let mut scene = synth::room(SIZE.0, SIZE.1, 32, 5);
    for _ in 0..5 {
        scene.samples = scene.samples.map_planes(|p| p.box_sum(2).map(|v| v / 25.0));
    }
    let displaced = Tremor { extent_px: 0.0, roll_deg: 0.0, offset_px: 6.0, offset_deg: 0.2 };
    let shaken = Tremor { extent_px: 8.0, roll_deg: 0.8, ..displaced };
    let frames = [(1.0 / 30.0, None), (1.0 / 8.0, Some(displaced)), (1.0, Some(shaken))];
    let made = synth::capture(&scene, &Camera::default(), &frames, 0.15, 5).unwrap();
    let found = merge(&made.bracket, &settings(), None);
    let sharp: Vec<bool> = (0..3).map(|i| found.report["frames"][i]["sharp"].as_bool().unwrap()).collect();
    assert_eq!(sharp, [true, true, false], "{:?}", judgements(&found));
    assert!(found.left_out.is_empty(), "{:?}", found.left_out);
}

/// The frame whose pixels the result is to lie on is black: the others are placed beside each other all the same, and count.
#[test]
fn a_black_reference_does_not_misplace_the_others() {
    let displaced = |offset_px: f64| Some(Tremor { extent_px: 0.0, roll_deg: 0.0, offset_px, offset_deg: 0.0 });
    let frames = [(1.0 / 4000.0, None), (1.0 / 8.0, displaced(9.0)), (0.4, displaced(7.0))];
    let made = synth::capture(&synth::room(192, 144, 32, 5), &Camera::default(), &frames, 0.15, 5).unwrap();
    let found = merge(&made.bracket, &Settings { reference: Some(0), ..settings() }, None);
    let frames = found.report["frames"].as_array().unwrap();
    assert!(frames[1]["sharp"] == true && frames[2]["sharp"] == true, "{:?}", judgements(&found));
    let between = |places: [glam::DMat3; 2]| pose::project(&(places[1] * places[0].inverse()), glam::DVec2::ZERO);
    let off = between([found.places[1], found.places[2]]) - between([made.tsfs[1].centre(), made.tsfs[2].centre()]);
    assert!(off.length() < 0.5, "the second frame lies {off} px off beside the first: {:?}", frames[1]["registration"]);
}

/// What the program took each frame for.
fn judgements(found: &Outcome) -> Vec<&serde_json::Value> {
    found.report["frames"].as_array().unwrap().iter().map(|f| &f["judgement"]).collect()
}

/// Beside a sharp frame a blur of four pixels is found.
#[test]
fn a_slightly_shaken_frame_is_found_beside_a_sharp_one() {
    let slight = Tremor { extent_px: 4.0, roll_deg: 0.4, offset_px: 0.5, offset_deg: 0.0 };
    let shaken = Tremor { extent_px: 10.0, roll_deg: 0.8, ..slight.clone() };
    let frames = [(1.0 / 50.0, None), (1.0 / 8.0, Some(slight)), (1.0, Some(shaken))];
    let made = synth::capture(&synth::Drawn::Window.draw(240, 176, 32, 2, 1), &Camera::default(), &frames, 0.02, 1).unwrap();
    let found = merge(&made.bracket, &settings(), None);
    let held = merge(&made.bracket, &Settings { sharp: Some(vec![0, 1]), ..settings() }, None);
    let second = &found.report["frames"][1];
    let (free, held) = (decibels(&found, &made.bracket, &made.truth), decibels(&held, &made.bracket, &made.truth));
    println!("{free:.2} dB, {held:.2} taken for sharp; {}", second["judgement"]);
    assert_eq!(second["sharp"], false, "it moved: {}", second["judgement"]);
    assert_eq!(second["used"], true, "{:?}", found.left_out);
    assert!(free > held + 1.0, "{free:.2} dB, {held:.2} taken for sharp");
}

/// A room beside its window: the long frame burns it out and shows more of the dark room than the short one, blurred as it is.
#[test]
#[ignore = "the motion is found four times too long: 0.8 dB below the sharp frame alone"]
fn a_shaken_frame_that_shows_more_is_not_taken_for_the_sharp_one() {
    let tremor = Tremor { extent_px: 12.0, roll_deg: 1.0, offset_px: 1.5, offset_deg: 0.1 };
    let scene = Drawn::Window.draw(192, 144, 48, 2, 1);
    let made = synth::capture(&scene, &Camera::default(), &[(1.0 / 30.0, None), (0.5, Some(tremor))], 0.05, 1).unwrap();
    let settings = Settings { reference: Some(0), ..Settings::default() };
    let found = merge(&made.bracket, &settings, None);
    let alone = merge(&made.bracket, &Settings { exclude: vec![1], ..settings }, None);
    let (got, alone) = (decibels(&found, &made.bracket, &made.truth), decibels(&alone, &made.bracket, &made.truth));
    let frames = &found.report["frames"];
    println!("{got:.2} dB, {alone:.2} without the shaken frame; {}, {}", frames[0]["judgement"], frames[1]["judgement"]);
    assert_eq!(
        (&frames[0]["sharp"], &frames[1]["sharp"]),
        (&true.into(), &false.into()),
        "{} {}",
        frames[0]["judgement"],
        frames[1]["judgement"]
    );
    assert!(found.left_out.is_empty(), "{:?}", found.left_out);
    assert!(got > alone - 0.3, "{got:.2} dB, {alone:.2} without the shaken frame");
}

/// A blur so long that few parts of the frame match the sharp one's does not keep it from being placed; a frame of another scene, turned, is not.
#[test]
fn a_frame_shaken_far_is_placed_and_one_of_another_scene_is_not() {
    let tremor = Tremor { extent_px: 24.0, roll_deg: 1.0, offset_px: 2.0, offset_deg: 0.1 };
    let scene = Drawn::Room.draw(192, 144, 64, 2, 1);
    let made = synth::capture(&scene, &Camera::default(), &[(1.0 / 30.0, None), (0.5, Some(tremor))], 0.05, 1).unwrap();
    let settings = Settings { reference: Some(0), ..Settings::default() };
    let found = merge(&made.bracket, &settings, None);
    let alone = merge(&made.bracket, &Settings { exclude: vec![1], ..settings.clone() }, None);
    let (got, alone) = (decibels(&found, &made.bracket, &made.truth), decibels(&alone, &made.bracket, &made.truth));
    let second = &found.report["frames"][1];
    println!("{got:.2} dB, {alone:.2} without the shaken frame; {}, {}", second["registration"], second["blur"]["blank_worse_by"]);
    assert_eq!(second["used"], true, "{:?}", found.left_out);
    assert!(got > alone + 2.0, "{got:.2} dB, {alone:.2} without the shaken frame");

    let mut frames = made.bracket.frames().to_vec();
    let turned = |p: &Plane| Plane::from_fn(p.width, p.height, |x, y| p.at(p.width - 1 - x, p.height - 1 - y));
    frames[1].intensity = frames[1].intensity.map_planes(turned);
    let other = merge(&Bracket::new(frames).unwrap(), &settings, None);
    assert_eq!(other.left_out.len(), 1, "{}", other.report["frames"][1]);
    assert!(other.left_out[0].1.contains("shows something else"), "{:?}", other.left_out);
    let other = decibels(&other, &made.bracket, &made.truth);
    assert!(other > alone - 0.3, "{other:.2} dB, {alone:.2} without the frame");
}

/// A night of lamps, of which two frames share nothing that both see clearly, and the longer one's trails are the steepest edges of all.
#[test]
fn a_shaken_frame_that_cannot_be_compared_is_found() {
    let tremor = Tremor { extent_px: 6.0, roll_deg: 1.0, offset_px: 2.0, offset_deg: 0.1 };
    let scene = Drawn::Lamps.draw(192, 144, 48, 2, 2);
    let made = synth::capture(&scene, &Camera::default(), &[(1.0 / 30.0, None), (0.5, Some(tremor))], 0.05, 2).unwrap();
    let settings = Settings { reference: Some(0), ..Settings::default() };
    let found = merge(&made.bracket, &settings, None);
    let held = merge(&made.bracket, &Settings { sharp: Some(vec![0, 1]), ..settings }, None);
    let (free, held) = (decibels(&found, &made.bracket, &made.truth), decibels(&held, &made.bracket, &made.truth));
    let second = &found.report["frames"][1];
    println!("{free:.2} dB, {held:.2} taken for sharp; {}", second["judgement"]);
    assert_eq!(second["sharp"], false, "it moved: {}", second["judgement"]);
    assert_eq!(second["used"], true, "{:?}", found.left_out);
    assert!(free > held + 0.7, "{free:.2} dB, {held:.2} taken for sharp");
}

/// A room beside its window: nothing that both frames see clearly. Whether the longer one moved is asked; that it is half a pixel off, or
/// that some blur explains a little more of it, is no motion.
#[test]
fn sharp_frames_that_cannot_be_compared_stay_sharp() {
    for seed in [1, 4] {
        let scene = Drawn::Window.draw(192, 144, 48, 2, seed);
        let made = synth::capture(&scene, &Camera::default(), &[(1.0 / 30.0, None), (0.5, None)], 0.05, seed).unwrap();
        let found = merge(&made.bracket, &Settings { reference: Some(0), ..Settings::default() }, None);
        let second = &found.report["frames"][1];
        println!("seed {seed}: {}", second["judgement"]);
        assert_eq!(second["sharp"], true, "seed {seed}: {second}");
    }
}

/// The second frame lies elsewhere. The shaken one shares its shades with that frame alone.
#[test]
#[ignore = "frames are registered before it is known which are stationary: none joins the merge that others are placed by"]
fn a_displaced_frame_that_shows_to_be_sharp_helps_to_place_the_others() {
    let scene = Drawn::Foliage.draw(200, 150, 32, 2, 1);
    let tremor = |extent_px: f64, roll_deg: f64| Tremor { extent_px, roll_deg, offset_px: 8.0, offset_deg: 0.1 };
    let times = [(0.01, None), (0.04, Some(tremor(0.01, 0.0))), (0.3, Some(tremor(10.0, 0.5)))];
    let made = synth::capture(&scene, &Camera::default(), &times, 0.5, 1).unwrap();
    let found = merge(&made.bracket, &Settings::default(), None);
    assert!(found.left_out.is_empty(), "{:?}", found.left_out);
    let frames = found.report["frames"].as_array().unwrap();
    let sharp: Vec<bool> = frames.iter().map(|f| f["sharp"].as_bool().unwrap()).collect();
    assert_eq!(sharp, [true, true, false]);
}

/// Name of each frame, trace of the covariance of its blur's translations as it was found, and of the true one's, square pixels.
fn spreads(found: &Outcome, truths: &[Tsf]) -> Vec<(String, f64, f64)> {
    let spread = |t: &Tsf| t.covariance().col(0).x + t.covariance().col(1).y;
    let of = |(frame, truth): (&serde_json::Value, &Tsf)| {
        let entry: TsfEntry = serde_json::from_value(frame["tsf"].clone()).unwrap();
        let (found, true_one) = (spread(&Tsf::new(entry.focal_px, entry.poses).unwrap()), spread(truth));
        println!("{}: {found:.3} px^2 for {true_one:.3}", entry.frame);
        (entry.frame, found, true_one)
    };
    found.report["frames"].as_array().unwrap().iter().zip(truths).map(of).collect()
}

/// The shorter frames moved by two pixels: where all blurs are asked for, these are undone as well.
#[test]
#[ignore = "the joint estimate is asked only where all other frames moved beside the first"]
fn a_slight_blur_of_all_frames_is_undone() {
    let (w, h) = (272, 192);
    let mut scene = synth::room(w, h, 32, 5);
    scene.samples = scene.samples.map_planes(|p| p.box_sum(1).map(|v| v / 9.0));
    let slight = Tremor { extent_px: 2.0, roll_deg: 0.15, offset_px: 0.5, offset_deg: 0.0 };
    let shaken = Tremor { extent_px: 10.0, roll_deg: 0.8, ..slight.clone() };
    let made = synth::capture(
        &scene,
        &Camera::default(),
        &[(1.0 / 30.0, Some(slight.clone())), (1.0 / 8.0, Some(slight)), (1.0, Some(shaken))],
        0.15,
        5,
    )
    .unwrap();
    let found = merge(&made.bracket, &Settings { blind: Blind::Joint, ..settings() }, None);
    let held = merge(&made.bracket, &Settings { sharp: Some(vec![0, 1]), ..settings() }, None);
    let (free, held) = (decibels(&found, &made.bracket, &made.truth), decibels(&held, &made.bracket, &made.truth));
    println!("{free:.2} dB, {held:.2} taken for sharp; {}", found.report["blind"]);
    assert_eq!(found.report["blind"]["believed"], true, "{}", found.report["blind"]);
    // Rounding alone moves it by a tenth.
    assert!(free > held + 0.3, "{free:.2} dB, {held:.2} taken for sharp");
}

/// Behind a lens that is soft by a pixel all edges are soft: blurs that are estimated together would be too thick if the lens were not told
/// from them.
#[test]
#[ignore = "the joint estimate is asked only where all other frames moved beside the first"]
fn frames_shaken_behind_a_soft_lens_are_all_estimated_behind_it() {
    let mut scene = Drawn::Foliage.draw(240, 180, 32, 2, 1);
    scene.samples = scene.samples.map_planes(|p| p.box_sum(2).box_sum(2).map(|v| v / 625.0));
    let tremor = |extent_px: f64, roll_deg: f64| Some(Tremor { extent_px, roll_deg, offset_px: 0.5, offset_deg: 0.0 });
    let frames = [(1.0 / 30.0, tremor(3.0, 0.3)), (1.0 / 8.0, tremor(5.1, 0.5)), (1.0, tremor(14.0, 1.0))];
    let made = synth::capture(&scene, &Camera::default(), &frames, 0.15, 1).unwrap();
    let quick = deblur::Settings { outer: 1, prior: Prior::Tv, ..deblur::Settings::default() };
    let found = merge(&made.bracket, &Settings { deblur: quick, blind: Blind::Joint, ..settings() }, None);
    let blind = &found.report["blind"];
    println!("{:.2} dB, {blind}", decibels(&found, &made.bracket, &made.truth));
    assert_eq!(blind["believed"], true, "{blind}");
    assert!((0.5..1.3).contains(&blind["lens_px"].as_f64().unwrap()), "a lens of one pixel: {blind}");
    for (name, found, true_one) in spreads(&found, &made.tsfs) {
        assert!((found - true_one).abs() < 0.6, "{name}: {found:.3} px^2 for {true_one:.3}, the lens has 2");
    }
}

/// Two sharp frames behind a lens that is soft by a pixel or two, beside a shaken one: a harder scene and blur would explain them better,
/// but it is the same blur in both.
#[test]
#[ignore = "a sharp frame behind a soft lens is judged moved by 2.5 px beside a denoised one"]
fn a_soft_lens_is_no_motion() {
    let (w, h) = (272, 192);
    let mut scene = synth::room(w, h, 32, 5);
    scene.samples = scene.samples.map_planes(|p| p.box_sum(2).box_sum(2).map(|v| v / 625.0));
    let shaken = Tremor { extent_px: 10.0, roll_deg: 0.8, offset_px: 0.5, offset_deg: 0.0 };
    let frames = [(1.0 / 30.0, None), (1.0 / 8.0, None), (1.0, Some(shaken))];
    let made = synth::capture(&scene, &Camera::default(), &frames, 0.15, 5).unwrap();
    let found = merge(&made.bracket, &settings(), None);
    let held = merge(&made.bracket, &Settings { sharp: Some(vec![0, 1]), ..settings() }, None);
    let (free, held) = (decibels(&found, &made.bracket, &made.truth), decibels(&held, &made.bracket, &made.truth));
    println!("{free:.2} dB, {held:.2} taken for sharp; {:?}", judgements(&found));
    let sharp: Vec<bool> = (0..3).map(|i| found.report["frames"][i]["sharp"].as_bool().unwrap()).collect();
    assert_eq!(sharp, [true, true, false], "{:?}", judgements(&found));
    assert!((free - held).abs() < 0.3, "{free:.2} dB, {held:.2} taken for sharp");
}

/// A real bracket of a night, none of its frames shaken, at a sixth of its size. Its frames disagree by tens of times their noise (flare, a
/// fountain, what the camera made of the shadows), which motion explains a little, as it would anything.
#[test]
fn what_sharp_frames_do_not_agree_about_is_no_motion() {
    let Some(folder) = shared("data/brackets/arch") else { return };
    let read = |i: usize| {
        let path = folder.join(format!("img0{i}.jpg"));
        let picture = ldr::read(&path).unwrap();
        let exposure_time = metadata::exposure_time(&path).unwrap().unwrap();
        Frame {
            name: format!("img0{i}.jpg"),
            intensity: picture.intensity,
            levels: picture.levels,
            chroma_subsampled: picture.chroma_subsampled,
            lossy: picture.lossy,
            speed: None,
            exposure_time,
        }
    };
    let whole = Bracket::new((0..4).map(read).collect()).unwrap();
    let response = response::automatic(&whole).response;
    let small = response::reduced(&whole, &response, 6).unwrap();
    let found = pipeline::merge(&small, &response, &Settings::default(), None, &mut |_| true).unwrap();
    assert_eq!(found.degraded, Vec::<String>::new());
    for frame in found.report["frames"].as_array().unwrap() {
        assert_eq!((&frame["used"], &frame["sharp"]), (&true.into(), &true.into()), "{}: {}", frame["frame"], frame["judgement"]);
    }
}

/// A real pair: a frame of a phone drowned in noise beside a clean, shaken one. The clean frame counts: as it lies, as a blur that is found beside noise explains less
/// than nothing does, or by an estimate of both blurs that explains pixels it has not seen.
#[test]
fn a_clean_shaken_frame_counts_beside_noise() {
    let Some(folder) = shared("data/real") else { return };
    let read = |(name, exposure_time): (&str, f64)| {
        let picture = ldr::read(&folder.join(name)).unwrap();
        Frame {
            name: name.into(),
            intensity: picture.intensity,
            levels: picture.levels,
            chroma_subsampled: picture.chroma_subsampled,
            lossy: picture.lossy,
            speed: None,
            exposure_time,
        }
    };
    let bracket = Bracket::new(vec![read(("noisy_2.jpg", 0.0118)), read(("blurred_2.jpg", 0.278))]).unwrap();
    let found = pipeline::merge(&bracket, &response::automatic(&bracket).response, &Settings::default(), None, &mut |_| true).unwrap();
    assert_eq!(found.left_out, vec![]);
    let long = &found.report["frames"][1];
    assert_eq!(long["used"], true, "{}", long["judgement"]);
    assert!(long["sharp"] == true || found.report["blind"]["believed"] == true, "{}", long["judgement"]);
}
