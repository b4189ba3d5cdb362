//! The plain merge on frames whose irradiance is known.

use unshaken::baseline::merge;
use unshaken::exposure::{Bracket, Frame};
use unshaken::image::Rgb;
use unshaken::response::Response;

/// Flat frames of the given intensities, at 1/10, 1 and 4 s.
fn bracket(levels: [f32; 3]) -> Bracket {
    let frame =
        |(level, exposure_time): (f32, f64)| Frame { name: "flat".into(), intensity: Rgb::filled(3, 2, level), levels: 255, exposure_time };
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
