//! Structural similarity (Z. Wang et al. 2004) with uniform squares.

use crate::image::Plane;

/// Side of the squares, pixels.
pub(super) const SIDE: usize = 7;
const K1: f64 = 0.01;
const K2: f64 = 0.03;

/// Mean similarity of `a` and `b`, whose values span `range`, over the pixels that are `ok`. Beyond the border planes are mirrored;
/// variances are those of a sample (n - 1).
pub(super) fn mean(a: &Plane, b: &Plane, range: f64, ok: &[bool]) -> f64 {
    let values = |f: fn(f64, f64) -> f64| -> Vec<f64> {
        let products: Vec<f64> = a.data.iter().zip(&b.data).map(|(&x, &y)| f(f64::from(x), f64::from(y))).collect();
        squares_mean(&products, a.width, a.height)
    };
    let (ma, mb) = (values(|x, _| x), values(|_, y| y));
    let (aa, bb, ab) = (values(|x, _| x * x), values(|_, y| y * y), values(|x, y| x * y));
    let n = (SIDE * SIDE) as f64;
    let sample = n / (n - 1.0);
    let (c1, c2) = ((K1 * range).powi(2), (K2 * range).powi(2));
    let (mut sum, mut count) = (0.0, 0usize);
    for i in (0..ok.len()).filter(|&i| ok[i]) {
        let (va, vb) = (sample * (aa[i] - ma[i] * ma[i]), sample * (bb[i] - mb[i] * mb[i]));
        let cov = sample * (ab[i] - ma[i] * mb[i]);
        let above = (2.0 * ma[i] * mb[i] + c1) * (2.0 * cov + c2);
        sum += above / ((ma[i] * ma[i] + mb[i] * mb[i] + c1) * (va + vb + c2));
        count += 1;
    }
    sum / count.max(1) as f64
}

/// Means over squares of [`SIDE`], the plane mirrored beyond its border (the edge pixel twice).
fn squares_mean(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let r = (SIDE / 2) as isize;
    let mirror = |i: isize, n: usize| {
        let n = n as isize;
        (if i < 0 {
            -1 - i
        } else if i >= n {
            2 * n - 1 - i
        } else {
            i
        })
        .clamp(0, n - 1) as usize
    };
    let along = |values: &[f64], of_x: bool| -> Vec<f64> {
        let mut out = Vec::with_capacity(values.len());
        for y in 0..height {
            for x in 0..width {
                let at =
                    |d: isize| if of_x { y * width + mirror(x as isize + d, width) } else { mirror(y as isize + d, height) * width + x };
                out.push((-r..=r).map(|d| values[at(d)]).sum::<f64>() / SIDE as f64);
            }
        }
        out
    };
    along(&along(values, true), false)
}
