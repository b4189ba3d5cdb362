//! The plain merge on frames whose irradiance is known, exposure fusion against OpenCV, each frame deblurred by itself.

use unshaken::baseline::{deblur_each, fuse_images, merge};
use unshaken::deblur;
use unshaken::exposure::{Bracket, Frame};
use unshaken::image::{Plane, Rgb};
use unshaken::metrics::{Judge, score};
use unshaken::response::Response;
use unshaken::synth::{self, Camera, Tremor};

/// Flat frames of the given intensities, at 1/10, 1 and 4 s.
fn bracket(levels: [f32; 3]) -> Bracket {
    let frame = |(level, exposure_time): (f32, f64)| Frame {
        name: "flat".into(),
        intensity: Rgb::filled(3, 2, level),
        levels: 255,
        chroma_subsampled: false,
        lossy: false,
        speed: None,
        exposure_time,
    };
    Bracket::new(levels.into_iter().zip([0.1, 1.0, 4.0]).map(frame).collect()).unwrap()
}

fn merged(levels: [f32; 3], frames: &[usize]) -> f32 {
    let image = merge(&bracket(levels), &Response::Linear, frames);
    assert_eq!(image.size(), (3, 2));
    assert!(image.0.iter().all(|p| p.data.iter().all(|v| *v == image.0[0].data[0])), "a flat image");
    image.0[0].data[0]
}

#[test]
fn frames_that_agree_give_their_irradiance() {
    assert!((merged([0.02, 0.2, 0.8], &[0, 1, 2]) - 0.2).abs() < 1e-6);
}

#[test]
fn weights_are_exposure_times_under_a_hat() {
    // Hat: 0.4 at 0.1, 1 at 0.5, 0.4 at 0.9.
    let expected = (0.4 * 0.1 * 1.0 + 1.0 * 0.5 + 0.4 * 4.0 * 0.225) / (0.4 * 0.1 + 1.0 + 0.4 * 4.0);
    assert!((merged([0.1, 0.5, 0.9], &[0, 1, 2]) - expected).abs() < 1e-5);
}

#[test]
fn clipped_and_black_frames_do_not_count() {
    assert!((merged([0.05, 0.5, 1.0], &[0, 1, 2]) - 0.5).abs() < 1e-6);
    assert!((merged([0.0, 0.5, 1.0], &[0, 1, 2]) - 0.5).abs() < 1e-6);
    assert!((merged([0.05, 0.5, 1.0], &[0, 2]) - 0.5).abs() < 1e-6);
}

#[test]
fn what_all_frames_clip_comes_from_the_shortest_and_black_from_the_longest() {
    assert!((merged([1.0, 1.0, 1.0 - 1e-7], &[0, 1]) - 10.0).abs() < 1e-5);
    assert_eq!(merged([0.0, 0.0, 0.5], &[0, 1]), 0.0);
}

/// Three exposures of a formula, 52 x 37 pixels, as 8-bit codes.
fn exposures() -> Vec<Rgb> {
    let level = |x: f64, y: f64, c: f64| {
        (1.5 * (0.21 * x + 0.4 * c).sin() * (0.17 * y).cos() + 0.8 * (0.9 * x + 0.3 * c).sin() * (0.7 * y).sin()).exp()
    };
    let code = |v: f64| ((v.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() / 255.0) as f32;
    let image = |g: f64| Rgb(std::array::from_fn(|c| Plane::from_fn(52, 37, |x, y| code(g * level(x as f64, y as f64, c as f64)))));
    [0.1, 0.35, 1.2].map(image).into()
}

#[test]
fn exposure_fusion_agrees_with_opencv() {
    // cv2.createMergeMertens(1, 1, 1).process(8-bit frames, RGB) of OpenCV 5.0.0, clipped to 0..1, at (x, y).
    let stored: [((usize, usize), [f32; 3]); 6] = [
        ((5, 7), [0.82654, 0.84999, 0.82871]),
        ((25, 18), [0.83742, 0.72687, 0.59551]),
        ((40, 30), [0.47263, 0.43874, 0.41681]),
        ((0, 0), [0.55174, 0.65933, 0.77466]),
        ((51, 36), [0.2038, 0.20431, 0.26264]),
        ((13, 33), [0.78508, 0.61417, 0.47629]),
    ];
    let images = exposures();
    let fused = fuse_images(&images.iter().collect::<Vec<_>>());
    for ((x, y), expected) in stored {
        let got = fused.pixel(y * 52 + x);
        for (g, e) in got.iter().zip(expected) {
            assert!((g - e).abs() < 2e-3, "({x}, {y}): {got:?}, OpenCV {expected:?}");
        }
    }
    let mean = fused.0.iter().flat_map(|p| &p.data).map(|v| f64::from(*v)).sum::<f64>() / (3.0 * 52.0 * 37.0);
    assert!((mean - 0.540_193_1).abs() < 5e-4, "{mean}");
}

#[test]
fn each_frame_deblurred_by_itself_is_sharper_than_the_plain_merge() {
    let scene = synth::room(96, 72, 24, 3);
    let tremor = Tremor { extent_px: 6.0, roll_deg: 0.5, offset_px: 0.5, offset_deg: 0.0 };
    let camera = Camera { full_well: 40_000.0, read_noise: 4.0, ..Camera::default() };
    let made = synth::capture(&scene, &camera, &[(0.05, None), (0.8, Some(tremor))], 0.2, 5).unwrap();
    let all = [0, 1];
    let naive = deblur_each(&made.bracket, &Response::Srgb, &made.tsfs, &deblur::Settings::default(), &mut |_| true).unwrap();
    let plain = merge(&made.bracket, &Response::Srgb, &all);
    let judge = Judge { crop: 12, limit: Some(0.98 / 0.05), ..Judge::default() };
    let of = |image: &Rgb| score(image, &made.truth, &judge).unwrap();
    let (naive, plain) = (of(&naive), of(&plain));
    assert!(naive.pu_psnr > plain.pu_psnr + 3.0 && naive.pu_ssim > plain.pu_ssim + 0.1, "naive {naive:?}, plain {plain:?}");
    assert!(deblur_each(&made.bracket, &Response::Srgb, &made.tsfs, &deblur::Settings::default(), &mut |_| false).is_err(), "cancelled");
}
