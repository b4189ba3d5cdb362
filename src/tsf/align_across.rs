//! Alignment of a frame's PSFs to the reference frame's TSF (section III-B): the shift of each that makes the cross-blur error
//! `‖h_l² * B_l^ref - h_l^ref * B_l²‖²` smallest, with `h_l^ref = M_l h_T^ref`.

use super::Tsf;
use super::align_within::psf_at;
use super::taps::Interpolation;
use crate::image::Plane;
use crate::psf::{Patch, Psf};
use rayon::prelude::*;

/// Whole pixels within which a PSF's shift is looked for.
const REACH: i32 = 6;

/// `plane` blurred by `h`: `Σ_u h(u) plane(y - u)`, the nearest pixel beyond the border.
pub fn blurred(plane: &Plane, h: &Psf) -> Plane {
    let r = h.radius as isize;
    let taps: Vec<(isize, isize, f32)> = (-r..=r)
        .flat_map(|v| (-r..=r).map(move |u| (u, v)))
        .map(|(u, v)| (u, v, h.values.at((u + r) as usize, (v + r) as usize)))
        .filter(|t| t.2 > 1e-6)
        .collect();
    Plane::from_fn(plane.width, plane.height, |x, y| taps.iter().map(|&(u, v, w)| w * plane.clamped(x as isize - u, y as isize - v)).sum())
}

/// Shifts (x, y) in pixels, multiples of a half, that make the PSFs of the frame `frame` agree with the TSF `reference` of the frame `reference_frame`
/// (irradiances of one size; `weights` 0 where either is masked).
pub fn align_across(
    psfs: &[(Patch, Psf)],
    reference: &Tsf,
    (reference_frame, frame): (&Plane, &Plane),
    weights: &Plane,
) -> Vec<(f64, f64)> {
    psfs.par_iter()
        .map(|(patch, h)| {
            let cut = |p: &Plane| p.crop(patch.x, patch.y, patch.size.min(p.width - patch.x), patch.size.min(p.height - patch.y));
            let there = psf_at(reference, patch.centred(frame.size()), h.radius);
            let (own, other, seen) = (blurred(&cut(reference_frame), h), blurred(&cut(frame), &there), cut(weights));
            best_shift(&own, &other, &seen, h.radius)
        })
        .collect()
}

/// The shift s, whole pixels first, then half ones, that makes `‖own(y - s) - other(y)‖²` smallest, on x and y differences; away from the border by as much as
/// PSFs and shifts reach.
fn best_shift(own: &Plane, other: &Plane, seen: &Plane, radius: usize) -> (f64, f64) {
    let margin = (radius + REACH as usize + 2).min(own.width.min(own.height) / 3) as isize;
    let (w, h) = (own.width as isize, own.height as isize);
    let error = |s: (f64, f64)| -> f64 {
        let (ix, iy) = (s.0.floor(), s.1.floor());
        let weights = |f: f64| -> [f32; 4] { std::array::from_fn(|k| Interpolation::Bicubic.weight(k as f64 - 1.0 - f) as f32) };
        let (wx, wy) = (weights(s.0 - ix), weights(s.1 - iy));
        let difference = |x: isize, y: isize| {
            let mut sum = 0.0;
            for (j, b) in wy.iter().enumerate().filter(|b| *b.1 != 0.0) {
                for (i, a) in wx.iter().enumerate().filter(|a| *a.1 != 0.0) {
                    sum += a * b * own.clamped(x - ix as isize - (i as isize - 1), y - iy as isize - (j as isize - 1));
                }
            }
            sum - other.clamped(x, y)
        };
        let (mut sum, mut count) = (0.0f64, 0.0f64);
        for y in margin..h - margin {
            for x in margin..w - margin {
                if seen.at(x as usize, y as usize) > 0.0 {
                    let d = difference(x, y);
                    let (a, b) = (difference(x + 1, y) - d, difference(x, y + 1) - d);
                    sum += f64::from(a * a + b * b);
                    count += 1.0;
                }
            }
        }
        if count > 0.0 { sum / count } else { 0.0 }
    };
    let smallest = |at: (f64, f64), reach: i32, step: f64| {
        (-reach..=reach)
            .flat_map(|j| (-reach..=reach).map(move |i| (at.0 + step * f64::from(i), at.1 + step * f64::from(j))))
            .map(|s| (error(s), s))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map_or(at, |found| found.1)
    };
    smallest(smallest((0.0, 0.0), REACH, 1.0), 1, 0.5)
}
