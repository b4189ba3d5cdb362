//! Irradiance of sharp frames by weighted mean: the start of everything else.

use crate::exposure::Bracket;
use crate::image::{Plane, Rgb};
use crate::mask;
use crate::noise;
use crate::pose::{nearest_pixel, project};
use glam::{DMat3, DVec2};

/// Inverse-variance mean of f⁻¹(Z)/Δt over the frames `ids`, positive everywhere. Variances are those of the locally smoothed exposure: a
/// pixel's own value would give more weight to what noise made darker.
pub fn irradiance(bracket: &Bracket, exposures: &[Rgb], masks: &[Plane], curves: &[[Vec<f32>; 3]], ids: &[usize]) -> Rgb {
    let frames = bracket.frames();
    let shortest = bracket.shortest(ids).unwrap_or(0);
    let (w, h) = exposures[shortest].size();
    let longest = ids.iter().map(|&i| frames[i].exposure_time).fold(0.0, f64::max) as f32;
    Rgb(std::array::from_fn(|c| {
        let smooth: Vec<Plane> = ids.iter().map(|&i| box_mean(&exposures[i].0[c], 2)).collect();
        // A tenth of the longest frame's noise at black: below it nothing is known, and log irradiance needs a floor.
        let floor = 0.1 * ids.iter().map(|&i| curves[i][c][0]).fold(f32::INFINITY, f32::min) / longest;
        Plane::from_fn(w, h, |x, y| {
            let p = y * w + x;
            let (mut num, mut den) = (0.0f64, 0.0f64);
            for (s, &i) in smooth.iter().zip(ids) {
                let dt = frames[i].exposure_time as f32;
                let noise = noise::at(&curves[i][c], s.data[p]);
                let m = masks[i].data[p];
                let weight = f64::from(m * m * dt * dt / (noise * noise));
                num += weight * f64::from(exposures[i].0[c].data[p] / dt);
                den += weight;
            }
            let value =
                if den > 0.0 { (num / den) as f32 } else { exposures[shortest].0[c].data[p] / frames[shortest].exposure_time as f32 };
            value.max(floor)
        })
    }))
}

/// `image` and its mask as seen from another grid of the same size plus `pad` pixels on every side, `motion` being the way from there to
/// the image (centred pixels): bilinear; the mask is 0 beyond the image. Good for a start, not for the solution: it smooths.
pub fn resampled(image: &Rgb, mask: &Plane, motion: &DMat3, pad: usize) -> (Rgb, Plane) {
    let (w, h) = image.size();
    let size = (w + 2 * pad, h + 2 * pad);
    let centre = DVec2::new(0.5 * (w as f64 - 1.0), 0.5 * (h as f64 - 1.0));
    let pad = DVec2::splat(pad as f64);
    let mut out = image.map_planes(|_| Plane::filled(size.0, size.1, 0.0));
    let mut seen = Plane::filled(size.0, size.1, 0.0);
    for y in 0..size.1 {
        for x in 0..size.0 {
            let q = project(motion, DVec2::new(x as f64, y as f64) - pad - centre) + centre;
            let (fx, fy) = (q.x.floor(), q.y.floor());
            let (u, v) = ((q.x - fx) as f32, (q.y - fy) as f32);
            let (i, j) = (fx as isize, fy as isize);
            for (o, p) in out.0.iter_mut().zip(&image.0) {
                let at = |a: isize, b: isize| p.clamped(i + a, j + b);
                o.data[y * size.0 + x] = (1.0 - v) * ((1.0 - u) * at(0, 0) + u * at(1, 0)) + v * ((1.0 - u) * at(0, 1) + u * at(1, 1));
            }
            let inside = q.x >= 0.0 && q.y >= 0.0 && q.x <= w as f64 - 1.0 && q.y <= h as f64 - 1.0;
            let at = |a: isize, b: isize| mask.clamped(i + a, j + b);
            seen.data[y * size.0 + x] = if inside { at(0, 0).min(at(1, 0)).min(at(0, 1)).min(at(1, 1)) } else { 0.0 };
        }
    }
    (out, seen)
}

/// Raises pixels that the shortest of the frames `ids` has clipped to the irradiance that clips it: the best lower bound there is.
///
/// `motions`: each frame's place, from the reference, centred pixels.
pub fn raise_to_lower_bound(irradiance: &mut Rgb, bracket: &Bracket, exposures: &[Rgb], ids: &[usize], motions: &[DMat3]) {
    let frames = bracket.frames();
    let Some(shortest) = bracket.shortest(ids) else { return };
    let (w, h) = bracket.size();
    let motion = motions[shortest];
    for c in 0..3 {
        let z = &frames[shortest].intensity.0[c];
        for (p, v) in irradiance.0[c].data.iter_mut().enumerate() {
            let there = if motion == DMat3::IDENTITY { Some(p) } else { nearest_pixel(&motion, w, h, p % w, p / w) };
            if let Some(q) = there.filter(|&q| z.data[q] >= mask::CLIPPED) {
                *v = v.max(exposures[shortest].0[c].data[q] / frames[shortest].exposure_time as f32);
            }
        }
    }
}

/// Squared difference over noise variance of a frame's exposure from what `irradiance`, unblurred, predicts, the mean of the channels at each
/// pixel; NaN where it is masked.
pub fn misfit(irradiance: &Rgb, exposure: &Rgb, mask: &Plane, curves: &[Vec<f32>; 3], exposure_time: f64) -> Plane {
    let (w, h) = mask.size();
    let one = |c: usize, p: usize| {
        let expected = irradiance.0[c].data[p] * exposure_time as f32;
        ((exposure.0[c].data[p] - expected) / noise::at(&curves[c], expected)).powi(2)
    };
    Plane::from_fn(w, h, |x, y| {
        let p = y * w + x;
        if mask.data[p] > 0.0 { (one(0, p) + one(1, p) + one(2, p)) / 3.0 } else { f32::NAN }
    })
}

/// Mean over squares of side 2 r + 1, edge pixels repeated.
fn box_mean(plane: &Plane, r: usize) -> Plane {
    let n = (2 * r + 1) as f32;
    let (w, h) = plane.size();
    let rows = Plane::from_rows(w, h, |y, out| {
        let row = plane.row(y);
        let padded = [vec![row[0]; r], row.to_vec(), vec![row[w - 1]; r]].concat();
        for k in 0..=2 * r {
            out.iter_mut().zip(&padded[k..]).for_each(|(o, v)| *o += v);
        }
        out.iter_mut().for_each(|o| *o /= n);
    });
    Plane::from_rows(w, h, |y, out| {
        for k in 0..=2 * r {
            out.iter_mut().zip(rows.row((y + k).saturating_sub(r).min(h - 1))).for_each(|(o, v)| *o += v);
        }
        out.iter_mut().for_each(|o| *o /= n);
    })
}

/// Mean absolute gradient of `plane` around each pixel, over squares of side 2 r + 1.
pub fn gradient_level(plane: &Plane, r: usize) -> Plane {
    let (w, h) = plane.size();
    let gradient = Plane::from_rows(w, h, |y, out| {
        let (row, below) = (plane.row(y), plane.row((y + 1).min(h - 1)));
        for x in 0..w {
            out[x] = (row[(x + 1).min(w - 1)] - row[x]).hypot(below[x] - row[x]);
        }
    });
    box_mean(&gradient, r)
}
