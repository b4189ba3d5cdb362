//! What a lens does to the luminance before any motion does.
//!
//! A lens blurs all frames alike, and so does a TSF that is thicker than its path: without a lens of its own the scene comes out harder than it is, and every TSF
//! thicker by what the lens does. A Gaussian commutes with rotations and shifts, so that it stands before all TSFs.

use std::borrow::Cow;

/// `plane` of the `size` (width, height) under a Gaussian of the standard deviation `px` in pixels, mirrored at the borders: an operator that is its own adjoint. 0
/// pixels leave all as it is.
pub(super) fn behind_lens<'a>(plane: impl Into<Cow<'a, [f32]>>, (w, h): (usize, usize), px: f32) -> Cow<'a, [f32]> {
    let plane = plane.into();
    if px == 0.0 {
        return plane;
    }
    let radius = (3.0 * px).ceil() as isize;
    let mut taps: Vec<f32> = (-radius..=radius).map(|d| (-0.5 * (d as f32 / px).powi(2)).exp()).collect();
    let sum: f32 = taps.iter().sum();
    taps.iter_mut().for_each(|t| *t /= sum);
    let mirrored = |i: isize, n: usize| {
        let i = i.rem_euclid(2 * n as isize) as usize;
        i.min(2 * n - 1 - i)
    };
    let mut rows = vec![0.0f32; w * h];
    for (row, from) in rows.chunks_mut(w).zip(plane.chunks(w)) {
        for (x, out) in row.iter_mut().enumerate() {
            *out = taps.iter().zip(-radius..).map(|(t, d)| t * from[mirrored(x as isize + d, w)]).sum();
        }
    }
    let mut out = vec![0.0f32; w * h];
    for (y, row) in out.chunks_mut(w).enumerate() {
        for (t, d) in taps.iter().zip(-radius..) {
            let from = &rows[mirrored(y as isize + d, h) * w..][..w];
            row.iter_mut().zip(from).for_each(|(o, v)| *o += t * v);
        }
    }
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Column by column, planes of one pixel and lenses wider than the plane included.
    #[test]
    fn a_lens_is_its_own_adjoint_and_keeps_the_light() {
        for (size, px) in [((1, 1), 0.8), ((2, 1), 1.4), ((7, 5), 0.7), ((3, 9), 2.0), ((11, 8), 0.0)] {
            let n = size.0 * size.1;
            let columns: Vec<Vec<f32>> = (0..n)
                .map(|i| behind_lens((0..n).map(|k| if k == i { 1.0 } else { 0.0 }).collect::<Vec<f32>>(), size, px).into_owned())
                .collect();
            for (i, column) in columns.iter().enumerate() {
                assert!((column.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{size:?}, {px} px: light of pixel {i}");
                for (k, v) in column.iter().enumerate() {
                    assert!((v - columns[k][i]).abs() < 1e-6, "{size:?}, {px} px: {i}, {k}");
                }
            }
        }
    }

    #[test]
    fn a_lens_has_the_width_that_was_asked_for() {
        let size = (31, 31);
        let mut plane = vec![0.0f32; 31 * 31];
        plane[15 * 31 + 15] = 1.0;
        for px in [0.7f32, 1.4, 2.8] {
            let seen = behind_lens(&plane, size, px);
            let second: f32 = seen.iter().enumerate().map(|(p, v)| v * ((p % 31) as f32 - 15.0).powi(2)).sum();
            assert!((second.sqrt() / px - 1.0).abs() < 0.02, "{} for {px}", second.sqrt());
        }
    }
}
