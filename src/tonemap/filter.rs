//! Gaussians whose cost does not depend on their width.

use crate::image::Plane;
use rayon::prelude::*;

/// Below this a Gaussian is sampled; from it on three box filters in a row are as good (W. M. Wells, 1986) and faster.
const SAMPLED: f32 = 2.0;

/// `plane` under a Gaussian of `sigma` pixels, edge pixels repeated.
pub(super) fn gaussian(plane: &Plane, sigma: f32) -> Plane {
    if sigma < SAMPLED {
        let r = (3.0 * sigma).ceil() as usize;
        let mut taps: Vec<f32> = (0..=r).map(|i| (-0.5 * (i as f32 / sigma.max(1e-3)).powi(2)).exp()).collect();
        let sum = taps[0] + 2.0 * taps[1..].iter().sum::<f32>();
        taps.iter_mut().for_each(|t| *t /= sum);
        return transposed(&sampled(&transposed(&sampled(plane, &taps)), &taps));
    }
    let mut rows = plane.clone();
    let radii = radii(sigma);
    boxes(&mut rows, radii);
    let mut columns = transposed(&rows);
    boxes(&mut columns, radii);
    transposed(&columns)
}

/// Radii of three boxes whose variances sum to sigma².
fn radii(sigma: f32) -> [usize; 3] {
    // A box of side w has variance (w² - 1)/12. The sides are odd: the largest not above the ideal, and the next.
    let ideal = (4.0 * sigma * sigma + 1.0).sqrt();
    let small = (((ideal as usize).max(1) - 1) / 2 * 2 + 1) as f32;
    let small_count = ((12.0 * sigma * sigma - 3.0 * small * small - 12.0 * small - 9.0) / (-4.0 * small - 4.0)).round();
    let r = (small as usize - 1) / 2;
    std::array::from_fn(|i| if (i as f32) < small_count { r } else { r + 1 })
}

fn sampled(plane: &Plane, taps: &[f32]) -> Plane {
    let mut out = plane.clone();
    let (w, r) = (plane.width, taps.len() - 1);
    out.data.par_chunks_exact_mut(w.max(1)).zip(plane.data.par_chunks_exact(w.max(1))).for_each(|(out, row)| {
        for (x, v) in out.iter_mut().enumerate() {
            *v = taps[0] * row[x] + (1..=r).map(|k| taps[k] * (row[x.saturating_sub(k)] + row[(x + k).min(w - 1)])).sum::<f32>();
        }
    });
    out
}

/// Three box filters along each row.
fn boxes(plane: &mut Plane, radii: [usize; 3]) {
    let w = plane.width.max(1);
    plane.data.par_chunks_exact_mut(w).for_each_init(
        || vec![0f32; w],
        |before, row| {
            for r in radii {
                before.copy_from_slice(row);
                let at = |i: isize| f64::from(before[i.clamp(0, w as isize - 1) as usize]);
                let r = r as isize;
                let mut sum: f64 = (-r..=r).map(at).sum();
                let n = 1.0 / (2 * r + 1) as f64;
                for (x, v) in row.iter_mut().enumerate() {
                    *v = (sum * n) as f32;
                    sum += at(x as isize + 1 + r) - at(x as isize - r);
                }
            }
        },
    );
}

/// Rows become columns, by blocks that a cache holds.
pub(super) fn transposed(plane: &Plane) -> Plane {
    const BLOCK: usize = 32;
    let (w, h) = plane.size();
    let mut out = vec![0f32; w * h];
    out.par_chunks_mut((BLOCK * h).max(1)).enumerate().for_each(|(k, band)| {
        let x0 = k * BLOCK;
        let columns = band.len() / h.max(1);
        for y0 in (0..h).step_by(BLOCK) {
            for i in 0..columns {
                for y in y0..(y0 + BLOCK).min(h) {
                    band[i * h + y] = plane.data[y * w + x0 + i];
                }
            }
        }
    });
    Plane { width: h, height: w, data: out }
}
