//! Collaborative filtering: against f64, and what it must remove and keep.

use crate::oracle::collaborative as oracle;
use crate::support::{f64s, noise};
use glam::{DMat3, DVec2};
use unshaken::collaborative::{Between, Patch, Power, Precision, filtered};
use unshaken::image::{Plane, Rgb};

fn planes(image: &Rgb) -> oracle::Planes {
    oracle::Planes { width: image.width(), height: image.height(), values: image.0.iter().map(|p| f64s(&p.data)).collect() }
}

/// Stripes, an edge and colours, with noise of `sigma`.
fn scene(width: usize, height: usize, sigma: f32) -> Rgb {
    Rgb(std::array::from_fn(|c| {
        let n = noise(40 + c as u64, width * height);
        Plane::from_fn(width, height, |x, y| {
            let edge = if x + 2 * y > width { 1.0 } else { -0.5 };
            edge + 0.3 * (0.9 * x as f32 + c as f32).sin() + sigma * 3f32.sqrt() * n[y * width + x]
        })
    }))
}

fn ramp(width: usize, height: usize, low: f32, high: f32) -> Rgb {
    let one = |c: usize| Plane::from_fn(width, height, |x, y| low + (high - low) * ((x + y + 3 * c) as f32 / (width + height + 6) as f32));
    Rgb([one(0), one(1), one(2)])
}

fn compare(width: usize, height: usize) {
    let log = scene(width, height, 0.15);
    // Inverse variances from none to plenty, a blur that passes low frequencies alone, and a frame that a turn displaces by other fractions everywhere.
    let power: Patch = std::array::from_fn(|k| 1.0 / (1.0 + (k % 8 + k / 8) as f32).powi(2));
    let (mut white, through, displaced) =
        (ramp(width, height, 10.0, 90.0), ramp(width, height, 400.0, 0.0), ramp(width, height, 30.0, 60.0));
    white.0[1].data[0] = 0.0;
    let passed = |step: usize, u: usize| 1.0 / (1 + (step % 4) * u) as f32;
    let motion = DMat3::from_translation(DVec2::new(-2.3, 1.6)) * DMat3::from_angle(0.06);
    let wanted = {
        let same = f64s(&power);
        let between = move |x: usize, y: usize| {
            // The fourth of a pixel nearest to where the patch's middle lies in the frame, from where it would lie a whole number of pixels away.
            let (x, y) = (x as f64 + 3.5, y as f64 + 3.5);
            let there = (x * 0.06f64.cos() - y * 0.06f64.sin() - 2.3, x * 0.06f64.sin() + y * 0.06f64.cos() + 1.6);
            let fourth = |d: f64| (4.0 * d).round().rem_euclid(4.0) as usize;
            let (i, j) = (fourth(there.0 - x), fourth(there.1 - y));
            (0..64).map(|k| f64::from(passed(i, k % 8)) * f64::from(passed(j, k / 8))).collect()
        };
        let blurred: Vec<(oracle::Planes, oracle::Power)> =
            vec![(planes(&through), Box::new(move |_, _| same.clone())), (planes(&displaced), Box::new(between))];
        oracle::filtered(&planes(&log), oracle::Precision { white: planes(&white), blurred }, 0.9)
    };
    let between = Between { motion, axis: (0..4).map(|step| std::array::from_fn(|u| passed(step, u))).collect() };
    let blurred = vec![(through, Power::Same(power)), (displaced, Power::Between(between))];
    let got = filtered(&log, &Precision { white, blurred }, 0.9, &mut |_| true).unwrap();
    assert_eq!(got.size(), (width, height));
    for c in 0..3 {
        for (i, (a, b)) in got.0[c].data.iter().zip(&wanted.values[c]).enumerate() {
            assert!((f64::from(*a) - b).abs() < 2e-5, "{width} x {height}, channel {c}, pixel {i}: {a}, not {b}");
        }
    }
}

#[test]
fn the_filter_is_its_oracle() {
    for (width, height) in [(1, 1), (1, 9), (8, 8), (9, 5), (13, 10), (31, 22)] {
        compare(width, height);
    }
}

/// The root mean square of `a` - `b` away from edges.
fn distance(a: &Rgb, b: &Rgb) -> f32 {
    let squares: f32 = a.0.iter().zip(&b.0).map(|(a, b)| a.data.iter().zip(&b.data).map(|(a, b)| (a - b) * (a - b)).sum::<f32>()).sum();
    (squares / (3 * a.0[0].data.len()) as f32).sqrt()
}

#[test]
fn noise_goes_and_repeated_detail_stays() {
    let (w, h, sigma) = (72, 56, 0.1);
    let (clean, noisy) = (scene(w, h, 0.0), scene(w, h, sigma));
    let known = |sigma: f32| Precision { white: Rgb::filled(w, h, 1.0 / (sigma * sigma)), blurred: Vec::new() };
    let got = filtered(&noisy, &known(sigma), 1.0, &mut |_| true).unwrap();
    let (before, after) = (distance(&noisy, &clean), distance(&got, &clean));
    assert!(after < 0.4 * before, "{after} left of {before}");
    // Without noise to speak of nothing is touched.
    let same = filtered(&noisy, &known(1e-4), 1.0, &mut |_| true).unwrap();
    assert!(distance(&same, &noisy) < 1e-4);
}

#[test]
fn the_number_of_processors_changes_nothing() {
    let log = scene(40, 70, 0.2);
    let precision = Precision { white: ramp(40, 70, 5.0, 50.0), blurred: Vec::new() };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| filtered(&log, &precision, 1.0, &mut |_| true).unwrap())
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn a_filter_can_be_stopped() {
    let precision = Precision { white: Rgb::filled(20, 20, 1.0), blurred: Vec::new() };
    assert!(filtered(&scene(20, 20, 0.1), &precision, 1.0, &mut |_| false).is_none());
}
