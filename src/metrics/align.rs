//! Alignment of the truth to an estimate: what an all-blurred bracket yields may lie a few pixels and a fraction of a degree off.

use super::{check, percentile, phase};
use crate::error::Result;
use crate::image::{Plane, Rgb};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// What may be aligned before judging.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    /// Nothing: both lie on one grid.
    None,
    /// A shift.
    Shift,
    /// A shift and a rotation in the plane.
    Rigid,
}

/// Where a pixel of the estimate lies in the truth, in pixels and degrees about the image's centre.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Moved {
    /// To the right, pixels.
    pub x: f64,
    /// Down, pixels.
    pub y: f64,
    /// Clockwise on the screen, degrees.
    pub roll_deg: f64,
}

/// Iterations at most.
const ITERATIONS: usize = 300;
/// Change of the correlation below which the climb ends.
const TOLERANCE: f64 = 1e-7;
/// Standard deviation in pixels of the Gaussian before alignment: noise must not attract.
const SMOOTHING: f64 = 1.1;

/// The truth resampled onto the grid of `estimate`, so that the estimate is judged as it is, and the motion found. Candidates are staying,
/// the shift of phase correlation, and what a climb from either finds that maximises the correlation of log luminance (G. Evangelidis
/// and E. Psarakis, "Parametric Image Alignment Using Enhanced Correlation Coefficient Maximization", 2008); the one under which the
/// whole pictures correlate best is taken, staying before any other. Resampled by Lanczos with four lobes, edge pixels repeated.
///
/// # Errors
/// [`crate::error::Error::Input`] for sizes that differ and for values that are negative or not finite.
pub fn align(estimate: &Rgb, truth: &Rgb, mode: Align) -> Result<(Rgb, Moved)> {
    check(estimate, truth)?;
    if mode == Align::None {
        return Ok((truth.clone(), Moved::default()));
    }
    let (a, b) = (log_luminance(estimate), log_luminance(truth));
    let (x, y) = phase::shift(&a, &b);
    let (smooth_a, smooth_b) = (smooth(&a), smooth(&b));
    let likeness = |m: Moved| correlation(&a, &resampled(&b, m, bilinear));
    let mut best = (likeness(Moved::default()), Moved::default());
    for start in [Moved::default(), Moved { x, y, roll_deg: 0.0 }] {
        for m in [Some(start), climb(&smooth_a, &smooth_b, start, mode)].into_iter().flatten() {
            let k = likeness(m);
            if k > best.0 {
                best = (k, m);
            }
        }
    }
    let motion = best.1;
    if motion == Moved::default() {
        return Ok((truth.clone(), motion));
    }
    let least = truth.0.iter().flat_map(|p| p.data.iter().copied()).fold(f32::INFINITY, f32::min);
    Ok((truth.map_planes(|p| resampled(p, motion, lanczos).map(|v| v.max(least))), motion))
}

/// Natural logarithm of the mean of the channels, lifted by a thousandth of its 99th percentile.
fn log_luminance(image: &Rgb) -> Plane {
    let mean = image.mean();
    let floor = 1e-3 * percentile(mean.data.clone(), 99.0) + 1e-12;
    mean.map(|v| (f64::from(v) + floor).ln() as f32)
}

/// Gaussian of [`SMOOTHING`] on 5 x 5 pixels.
fn smooth(p: &Plane) -> Plane {
    let taps: Vec<f32> = (-2i32..=2).map(|d| (-f64::from(d * d) / (2.0 * SMOOTHING * SMOOTHING)).exp() as f32).collect();
    let sum: f32 = taps.iter().sum();
    let pass = |p: &Plane, dx: isize, dy: isize| {
        Plane::from_fn(p.width, p.height, |x, y| {
            let tap = |(k, t): (usize, &f32)| t * p.clamped(x as isize + dx * (k as isize - 2), y as isize + dy * (k as isize - 2));
            taps.iter().enumerate().map(tap).sum::<f32>() / sum
        })
    };
    pass(&pass(p, 1, 0), 0, 1)
}

/// Climbs from `start` towards the largest enhanced correlation coefficient of `a` and the moved `b`; `None` where they have nothing in
/// common.
fn climb(a: &Plane, b: &Plane, start: Moved, mode: Align) -> Option<Moved> {
    let n = if mode == Align::Rigid { 3 } else { 2 };
    let (width, height) = a.size();
    let (cx, cy) = centre(a);
    let (mut motion, mut last) = (start, f64::NEG_INFINITY);
    for _ in 0..ITERATIONS {
        let (sin, cos) = motion.roll_deg.to_radians().sin_cos();
        // (template, warped, gradient along the parameters) where the moved pixel lies inside.
        let rows: Vec<(f64, f64, [f64; 3])> = (0..height)
            .into_par_iter()
            .flat_map_iter(|y| {
                (0..width).filter_map(move |x| {
                    let (u, v) = (x as f64 - cx, y as f64 - cy);
                    let (p, q) = (cos * u - sin * v + motion.x + cx, sin * u + cos * v + motion.y + cy);
                    if p < 0.0 || q < 0.0 || p > width as f64 - 1.0 || q > height as f64 - 1.0 {
                        return None;
                    }
                    let gx = 0.5 * (bilinear(b, p + 1.0, q) - bilinear(b, p - 1.0, q));
                    let gy = 0.5 * (bilinear(b, p, q + 1.0) - bilinear(b, p, q - 1.0));
                    let turn = gx * (-sin * u - cos * v) + gy * (cos * u - sin * v);
                    Some((f64::from(a.at(x, y)), bilinear(b, p, q), [gx, gy, turn]))
                })
            })
            .collect();
        if rows.len() < 100 {
            return None;
        }
        let count = rows.len() as f64;
        let (ma, mb) = (rows.iter().map(|r| r.0).sum::<f64>() / count, rows.iter().map(|r| r.1).sum::<f64>() / count);
        let (mut hessian, mut ga, mut gb) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n), DVector::<f64>::zeros(n));
        let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
        for (ta, tb, g) in &rows {
            let (ta, tb) = (ta - ma, tb - mb);
            aa += ta * ta;
            bb += tb * tb;
            ab += ta * tb;
            for i in 0..n {
                ga[i] += g[i] * ta;
                gb[i] += g[i] * tb;
                for j in 0..n {
                    hessian[(i, j)] += g[i] * g[j];
                }
            }
        }
        let likeness = ab / (aa * bb).sqrt().max(1e-30);
        let inverse = hessian.try_inverse()?;
        let projected = &inverse * &gb;
        let above = bb - gb.dot(&projected);
        let below = ab - ga.dot(&projected);
        if below <= 0.0 {
            return None;
        }
        let step: DVector<f64> = &inverse * (ga * (above / below) - &gb);
        if !step.iter().all(|v| v.is_finite()) {
            return None;
        }
        motion.x += step[0];
        motion.y += step[1];
        if n == 3 {
            motion.roll_deg += step[2].to_degrees();
        }
        // The last step is taken as well: it costs nothing and leads upwards.
        if (likeness - last).abs() < TOLERANCE {
            break;
        }
        last = likeness;
    }
    Some(motion)
}

fn centre(p: &Plane) -> (f64, f64) {
    (0.5 * (p.width as f64 - 1.0), 0.5 * (p.height as f64 - 1.0))
}

/// `plane` on the grid of the estimate, by the interpolation `at`.
fn resampled(plane: &Plane, motion: Moved, at: fn(&Plane, f64, f64) -> f64) -> Plane {
    let (sin, cos) = motion.roll_deg.to_radians().sin_cos();
    let (cx, cy) = centre(plane);
    let data = (0..plane.width * plane.height)
        .into_par_iter()
        .map(|i| {
            let (u, v) = ((i % plane.width) as f64 - cx, (i / plane.width) as f64 - cy);
            at(plane, cos * u - sin * v + motion.x + cx, sin * u + cos * v + motion.y + cy) as f32
        })
        .collect();
    Plane { data, ..*plane }
}

fn bilinear(p: &Plane, x: f64, y: f64) -> f64 {
    let (i, j) = (x.floor(), y.floor());
    let (a, b) = (x - i, y - j);
    let at = |di: isize, dj: isize| f64::from(p.clamped(i as isize + di, j as isize + dj));
    (1.0 - b) * ((1.0 - a) * at(0, 0) + a * at(1, 0)) + b * ((1.0 - a) * at(0, 1) + a * at(1, 1))
}

/// Lanczos interpolation with four lobes, weights normalised.
fn lanczos(p: &Plane, x: f64, y: f64) -> f64 {
    let weights = |f: f64| -> [f64; 8] {
        let w: [f64; 8] = std::array::from_fn(|k| {
            let d = std::f64::consts::PI * (f + 3.0 - k as f64);
            if d.abs() < 1e-9 { 1.0 } else { 4.0 * d.sin() * (d / 4.0).sin() / (d * d) }
        });
        let sum: f64 = w.iter().sum();
        w.map(|v| v / sum)
    };
    let (i, j) = (x.floor(), y.floor());
    let (wx, wy) = (weights(x - i), weights(y - j));
    let row = |dj: usize| -> f64 {
        (0..8).map(|k| wx[k] * f64::from(p.clamped(i as isize + k as isize - 3, j as isize + dj as isize - 3))).sum()
    };
    (0..8).map(|k| wy[k] * row(k)).sum()
}

fn correlation(a: &Plane, b: &Plane) -> f64 {
    let mean = |p: &Plane| p.data.iter().map(|&v| f64::from(v)).sum::<f64>() / p.data.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
    for (&x, &y) in a.data.iter().zip(&b.data) {
        let (x, y) = (f64::from(x) - ma, f64::from(y) - mb);
        aa += x * x;
        bb += y * y;
        ab += x * y;
    }
    ab / (aa * bb).sqrt().max(1e-30)
}
