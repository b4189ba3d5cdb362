//! The quality measures against stored values of an independent implementation, and their behaviour on plain cases.

use unshaken::image::{Plane, Rgb};
use unshaken::metrics::{Judge, pu21, score};

/// Truth and estimate, 160 x 120, from a formula that Python repeats:
///
/// ```python
/// y, x, c = np.mgrid[0:120, 0:160, 0:3].astype(float)
/// t = np.exp(3 * np.sin(0.11 * x + 0.3 * c) * np.cos(0.07 * y) + 2 * np.sin(0.9 * x) * np.sin(0.8 * y))
/// e = 1.7 * t * (1 + 0.2 * np.sin(1.3 * x + 0.7 * y + c)) + 0.01
/// s = metrics.score(e.astype(np.float32), t.astype(np.float32), limit=limit); print(s["pu_psnr"], s["edge_ratio"])
/// ```
fn pair() -> (Rgb, Rgb) {
    let truth =
        |x: f64, y: f64, c: f64| (3.0 * (0.11 * x + 0.3 * c).sin() * (0.07 * y).cos() + 2.0 * (0.9 * x).sin() * (0.8 * y).sin()).exp();
    let image = |f: &dyn Fn(f64, f64, f64) -> f64| {
        Rgb(std::array::from_fn(|c| Plane::from_fn(160, 120, |x, y| f(x as f64, y as f64, c as f64) as f32)))
    };
    let estimate = |x: f64, y: f64, c: f64| 1.7 * truth(x, y, c) * (1.0 + 0.2 * (1.3 * x + 0.7 * y + c).sin()) + 0.01;
    (image(&estimate), image(&truth))
}

/// (limit, pu_psnr, edge_ratio) as printed by the lines above.
const STORED: [(Option<f32>, f64, f64); 2] =
    [(None, 35.087072131409315, 1.0185661315917969), (Some(100.0), 35.57834816271845, 1.017935872077942)];

#[test]
fn agrees_with_the_independent_implementation() {
    let (estimate, truth) = pair();
    for (limit, psnr, edge) in STORED {
        let s = score(&estimate, &truth, &Judge { limit, ..Judge::default() }).unwrap();
        assert!((s.pu_psnr - psnr).abs() < 0.05, "{limit:?}: {} dB, stored {psnr}", s.pu_psnr);
        assert!((s.edge_ratio / edge - 1.0).abs() < 2e-3, "{limit:?}: edge ratio {}, stored {edge}", s.edge_ratio);
    }
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
