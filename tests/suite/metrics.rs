//! The quality measures against stored values of an independent implementation, and their behaviour on plain cases.

use unshaken::image::{Plane, Rgb};
use unshaken::metrics::{Align, Judge, Moved, Score, align, cpbd, error_map, pu21, score};

/// Truth and estimate, 160 x 120, from a formula that Python repeats (`python3` in the folder of the benchmark's `metrics.py`, which shares no
/// code with the program: NumPy, OpenCV 5.0, scikit-image):
///
/// ```python
/// import numpy as np, metrics
/// limit = None  # then 100
/// y, x, c = np.mgrid[0:120, 0:160, 0:3].astype(float)
/// t = np.exp(3 * np.sin(0.11 * x + 0.3 * c) * np.cos(0.07 * y) + 2 * np.sin(0.9 * x) * np.sin(0.8 * y))
/// e = 1.7 * t * (1 + 0.2 * np.sin(1.3 * x + 0.7 * y + c)) + 0.01
/// s = metrics.score(e.astype(np.float32), t.astype(np.float32), limit=limit); print(s)
/// ```
fn pair() -> (Rgb, Rgb) {
    let truth =
        |x: f64, y: f64, c: f64| (3.0 * (0.11 * x + 0.3 * c).sin() * (0.07 * y).cos() + 2.0 * (0.9 * x).sin() * (0.8 * y).sin()).exp();
    let estimate = |x: f64, y: f64, c: f64| 1.7 * truth(x, y, c) * (1.0 + 0.2 * (1.3 * x + 0.7 * y + c).sin()) + 0.01;
    (image(&estimate), image(&truth))
}

/// 160 x 120 pixels of a formula of (x, y, channel).
fn image(f: &(dyn Fn(f64, f64, f64) -> f64 + Sync)) -> Rgb {
    Rgb(std::array::from_fn(|c| Plane::from_fn(160, 120, |x, y| f(x as f64, y as f64, c as f64) as f32)))
}

/// (limit, pu_psnr, pu_ssim, pu_dark, mu_psnr, edge_ratio) as printed by the lines above (NumPy, scikit-image's structural_similarity).
const STORED: [(Option<f32>, [f64; 5]); 2] = [
    (None, [35.087072131409315, 0.995466947555542, 37.548901177645234, 35.9210601021701, 1.0185661315917969]),
    (Some(100.0), [35.57834816271845, 0.9954655766487122, 38.00697166151547, 35.54788396745292, 1.017935872077942]),
];

#[track_caller]
fn assert_agrees(what: &str, s: &Score, [psnr, ssim, dark, mu, edge]: [f64; 5], decibel: f64) {
    assert!((s.pu_psnr - psnr).abs() < decibel, "{what}: PSNR {} dB, stored {psnr}", s.pu_psnr);
    assert!((s.pu_ssim - ssim).abs() < 1e-4, "{what}: SSIM {}, stored {ssim}", s.pu_ssim);
    assert!((s.pu_dark - dark).abs() < decibel, "{what}: dark {} dB, stored {dark}", s.pu_dark);
    assert!((s.mu_psnr - mu).abs() < decibel, "{what}: mu-law {} dB, stored {mu}", s.mu_psnr);
    assert!((s.edge_ratio / edge - 1.0).abs() < 3e-3, "{what}: edge ratio {}, stored {edge}", s.edge_ratio);
}

#[test]
fn agrees_with_the_independent_implementation() {
    let (estimate, truth) = pair();
    for (limit, stored) in STORED {
        let s = score(&estimate, &truth, &Judge { limit, ..Judge::default() }).unwrap();
        assert_agrees(&format!("{limit:?}"), &s, stored, 0.005);
    }
}

/// A smoother scene, and an estimate of it that lies (2.3, -1.6) px and 0.6° off; in Python as above, with
///
/// ```python
/// def scene(x, y, c): return np.exp(2.2*np.sin(0.11*x+0.3*c)*np.cos(0.07*y) + np.sin(0.37*x+0.05*y)*np.sin(0.31*y))
/// a = np.deg2rad(0.6); u, v = x - 79.5, y - 59.5
/// X, Y = np.cos(a)*u - np.sin(a)*v + 2.3 + 79.5, np.sin(a)*u + np.cos(a)*v - 1.6 + 59.5
/// e = 1.7 * scene(X, Y, c) * (1 + 0.1 * np.sin(1.3*x + 0.7*y + c)); t = scene(x, y, c)   # score(..., rigid=True)
/// ```
fn moved_pair() -> (Rgb, Rgb) {
    let scene = |x: f64, y: f64, c: f64| {
        (2.2 * (0.11 * x + 0.3 * c).sin() * (0.07 * y).cos() + (0.37 * x + 0.05 * y).sin() * (0.31 * y).sin()).exp()
    };
    let (sin, cos) = 0.6f64.to_radians().sin_cos();
    let estimate = |x: f64, y: f64, c: f64| {
        let (u, v) = (x - 79.5, y - 59.5);
        let at = scene(cos * u - sin * v + 2.3 + 79.5, sin * u + cos * v - 1.6 + 59.5, c);
        1.7 * at * (1.0 + 0.1 * (1.3 * x + 0.7 * y + c).sin())
    };
    (image(&estimate), image(&scene))
}

#[test]
fn a_moved_estimate_is_judged_as_the_independent_implementation_does() {
    let (estimate, truth) = moved_pair();
    let judge = Judge::default();
    let unmoved = score(&estimate, &truth, &judge).unwrap();
    assert_agrees(
        "as it lies",
        &unmoved,
        [21.930048970645963, 0.7009026408195496, 22.710399035897343, 24.06684258917087, 1.0403050184249878],
        0.005,
    );
    let (still, moved) = align(&estimate, &truth, Align::None).unwrap();
    assert!(still == truth && moved == Moved::default());
    let (truth_there, moved) = align(&estimate, &truth, Align::Rigid).unwrap();
    let off = (moved.x - 2.3).abs().max((moved.y + 1.6).abs()).max((moved.roll_deg - 0.6).abs());
    assert!(off < 0.02, "{moved:?}");
    let s = score(&estimate, &truth_there, &judge).unwrap();
    // OpenCV's interpolation knows positions to 1/32 px only.
    assert_agrees("rigid", &s, [39.4809363140846, 0.9929471611976624, 40.406207109588436, 41.64481500846285, 1.0400046110153198], 0.05);
    let (truth_there, moved) = align(&estimate, &truth, Align::Shift).unwrap();
    assert!((moved.x - 2.3).abs() < 0.3 && (moved.y + 1.6).abs() < 0.3 && moved.roll_deg == 0.0, "{moved:?}");
    let shifted = score(&estimate, &truth_there, &judge).unwrap();
    assert!(shifted.pu_psnr > unmoved.pu_psnr + 3.0 && shifted.pu_psnr < s.pu_psnr - 3.0, "{shifted:?}");
}

/// The smoother scene with finer detail, and an estimate that a camera smeared over 9 px while it turned by 1.5 degrees, (x, y) px and `deg` off;
/// in Python as above, with
///
/// ```python
/// def scene(x, y, c): return np.exp(2.2*np.sin(0.11*x+0.3*c)*np.cos(0.07*y) + np.sin(0.37*x+0.05*y)*np.sin(0.31*y)
///                                   + 0.8*np.sin(0.9*x+0.2*y)*np.sin(0.7*y-0.1*x))
/// e = 0
/// for k in range(11):
///     s = k / 10 - 0.35; a = np.deg2rad(deg + 1.5 * s)
///     X, Y = np.cos(a)*u - np.sin(a)*v + dx + 9*s + 79.5, np.sin(a)*u + np.cos(a)*v + dy + 5.4*s*s + 59.5
///     e = e + 1.7 / 11 * scene(X, Y, c)
/// ```
fn smeared_pair((dx, dy, deg): (f64, f64, f64)) -> (Rgb, Rgb) {
    let scene = |x: f64, y: f64, c: f64| {
        let smooth = 2.2 * (0.11 * x + 0.3 * c).sin() * (0.07 * y).cos() + (0.37 * x + 0.05 * y).sin() * (0.31 * y).sin();
        (smooth + 0.8 * (0.9 * x + 0.2 * y).sin() * (0.7 * y - 0.1 * x).sin()).exp()
    };
    let estimate = |x: f64, y: f64, c: f64| {
        let (u, v) = (x - 79.5, y - 59.5);
        let at = |k: i32| {
            let s = f64::from(k) / 10.0 - 0.35;
            let (sin, cos) = (deg + 1.5 * s).to_radians().sin_cos();
            scene(cos * u - sin * v + dx + 9.0 * s + 79.5, sin * u + cos * v + dy + 5.4 * s * s + 59.5, c)
        };
        (0..11).map(|k| 1.7 / 11.0 * at(k)).sum()
    };
    (image(&estimate), image(&scene))
}

/// (x, y, deg) and what `metrics.score(e, t, rigid=True)` prints (OpenCV 5.0.0: phaseCorrelate, findTransformECC).
const SMEARED: [((f64, f64, f64), [f64; 5]); 2] = [
    ((1.3, -0.6, 0.3), [21.817157974706596, 0.4604995846748352, 21.651870949234073, 23.631901493155883, 0.5816664099693298]),
    ((14.0, -11.0, 0.2), [21.86406330694944, 0.45753881335258484, 21.751062401635984, 23.759213398594667, 0.5884908437728882]),
];

#[test]
fn a_blurred_estimate_is_judged_as_the_independent_implementation_does() {
    // Blurred, the pictures correlate along a flat ridge: where on it the climb ends is a matter of its steps, which must be the same.
    for (moved, stored) in SMEARED {
        let (estimate, truth) = smeared_pair(moved);
        let (there, _) = align(&estimate, &truth, Align::Rigid).unwrap();
        let s = score(&estimate, &there, &Judge::default()).unwrap();
        let got = [s.pu_psnr, s.pu_ssim, s.pu_dark, s.mu_psnr, s.edge_ratio];
        for ((got, stored), tolerance) in got.into_iter().zip(stored).zip([0.05, 4e-3, 0.05, 0.05, 4e-3]) {
            assert!((got - stored).abs() < tolerance, "{moved:?}: {got}, stored {stored}");
        }
    }
}

#[test]
fn nothing_moves_where_nothing_is_displaced() {
    let (_, truth) = moved_pair();
    let (there, moved) = align(&truth, &truth, Align::Rigid).unwrap();
    assert_eq!((there, moved), (truth, Moved::default()));
    let flat = Rgb::filled(96, 80, 0.5);
    assert_eq!(align(&flat, &flat, Align::Rigid).unwrap().1, Moved::default());
}

/// Grey picture of 256 x 192 pixels whose edges are the sharper the larger `s` is.
fn picture(s: f64) -> Plane {
    Plane::from_fn(256, 192, |x, y| {
        let (x, y) = (x as f64, y as f64);
        let edge = ((0.19 * x + 0.01 * y + 0.02 * y).sin() * s).tanh() * (0.03 * y).cos();
        (128.0 + 100.0 * edge + 12.0 * (2.1 * x).sin() * (1.7 * y).sin()).clamp(0.0, 255.0).round_ties_even() as f32
    })
}

#[test]
fn sharpness_agrees_with_the_published_program() {
    // pip package cpbd 1.0.7, cpbd.compute(np.round(np.clip(128 + 100*np.tanh(np.sin(0.19*x+0.01*y+0.02*y)*s)*np.cos(0.03*y)
    //     + 12*np.sin(2.1*x)*np.sin(1.7*y), 0, 255))) with y, x = np.mgrid[0:192, 0:256].
    for (s, stored) in [(1.0, 0.7180743423154755), (4.0, 0.15468506565768975), (12.0, 0.4775776159448064)] {
        let got = cpbd(&picture(s));
        assert!((got - stored).abs() < 0.005, "{s}: {got}, stored {stored}");
    }
}

#[test]
fn blur_lowers_sharpness_and_a_flat_picture_has_none() {
    // Steps of one pixel are no edges to Sobel's thinning: two neighbours are equally steep.
    let bar = |x: usize| if x.is_multiple_of(16) { 125.0 } else { [210.0, 40.0][x / 16 % 2] };
    let bars = Plane::from_fn(192, 192, |x, _| bar(x));
    let blurred = |n: isize| {
        Plane::from_fn(192, 192, |x, y| (-n..=n).map(|d| bars.clamped(x as isize + d, y as isize)).sum::<f32>() / (2 * n + 1) as f32)
    };
    let (sharp, soft, softer) = (cpbd(&bars), cpbd(&blurred(1)), cpbd(&blurred(4)));
    assert!(sharp > 0.95 && softer < 0.05 && soft <= sharp && soft >= softer, "{sharp} {soft} {softer}");
    assert_eq!(cpbd(&Plane::filled(128, 128, 90.0)), 0.0);
}

#[test]
fn the_error_map_shows_the_sign() {
    let (_, truth) = pair();
    let mut wrong = truth.clone();
    for p in wrong.0.iter_mut() {
        for y in 0..p.height {
            for x in 0..p.width {
                let k = if x < 50 {
                    1.3
                } else if x > 110 {
                    0.7
                } else {
                    1.0
                };
                p.data[y * p.width + x] *= k;
            }
        }
    }
    let map = error_map(&wrong, &truth, &Judge { limit: Some(1e9), ..Judge::default() }).unwrap();
    assert_eq!(map.dimensions(), (112, 72));
    let sum = |x0: u32, x1: u32, c: usize| {
        (0..72).flat_map(|y| (x0..x1).map(move |x| (x, y))).map(|(x, y)| u64::from(map.get_pixel(x, y).0[c])).sum::<u64>()
    };
    assert!(sum(0, 24, 0) > 50_000 && sum(0, 24, 2) < sum(0, 24, 0) / 4, "too bright is red");
    assert!(sum(88, 112, 2) > 50_000 && sum(88, 112, 0) < sum(88, 112, 2) / 4, "too dark is blue");
    assert_eq!(sum(30, 84, 0) + sum(30, 84, 2), 0, "right is black");
}

#[test]
fn zones_are_judged_apart() {
    let (_, truth) = pair();
    let lum = truth.mean();
    let mut wrong = truth.clone();
    // An error in highlights alone.
    for p in wrong.0.iter_mut() {
        p.data.iter_mut().zip(&lum.data).filter(|(_, l)| **l > 40.0).for_each(|(v, _)| *v *= 1.2);
    }
    let s = score(&wrong, &truth, &Judge::default()).unwrap();
    assert!(s.pu_dark.is_infinite() && s.pu_bright < s.pu_mid, "{s:?}");
}

#[test]
fn a_gain_is_free_and_a_cast_is_not() {
    let (estimate, truth) = pair();
    let judge = Judge::default();
    let bright = estimate.map_planes(|p| p.map(|v| 16.0 * v));
    let (a, b) = (score(&estimate, &truth, &judge).unwrap(), score(&bright, &truth, &judge).unwrap());
    assert!((a.pu_psnr - b.pu_psnr).abs() < 1e-3 && (a.log_rmse - b.log_rmse).abs() < 1e-5, "{a:?} {b:?}");
    let mut red = truth.clone();
    red.0[0] = red.0[0].map(|v| 1.1 * v);
    let s = score(&red, &truth, &judge).unwrap();
    // The mean of the channels rises by about a thirtieth, which the gain takes away: ln 1.1 - 0.03 in red, -0.03 in the others.
    assert!(s.log_rmse > 0.03 && s.log_rmse < 0.06, "{s:?}");
}

#[test]
fn a_blurred_image_has_weaker_edges() {
    let (_, truth) = pair();
    let blurred = truth.map_planes(|p| {
        Plane::from_fn(p.width, p.height, |x, y| (-2..=2).map(|d| p.clamped(x as isize + d, y as isize)).sum::<f32>() / 5.0)
    });
    let s = score(&blurred, &truth, &Judge::default()).unwrap();
    assert!(s.edge_ratio < 0.8, "{s:?}");
}

#[test]
fn pu21_encodes_100_nits_near_256() {
    // The encoding's design point: 100 cd/m² is the white of an 8-bit display.
    assert!((pu21(100.0) - 256.0).abs() < 1.0, "{}", pu21(100.0));
    assert!(pu21(0.0) >= 0.0 && pu21(0.0) < 1e-3 + pu21(0.005));
}

#[test]
fn refuses_what_cannot_be_judged() {
    let (estimate, truth) = pair();
    let judge = Judge::default();
    let mut bad = estimate.clone();
    bad.0[1].data[7] = f32::NAN;
    assert!(score(&bad, &truth, &judge).is_err());
    bad.0[1].data[7] = -1.0;
    assert!(score(&bad, &truth, &judge).is_err());
    assert!(score(&Rgb::filled(4, 4, 1.0), &truth, &judge).is_err());
    assert!(score(&Rgb::filled(48, 48, 1.0), &Rgb::filled(48, 48, 1.0), &judge).is_err());
    assert!(score(&estimate, &truth, &Judge { limit: Some(0.0), ..judge }).is_err());
}
