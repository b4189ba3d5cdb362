//! Reading a plane between its pixels, bilinearly and by cubic convolution (Keys 1981, a = -1/2), as the estimators do some hundred million times.

use crate::image::Plane;
use glam::DVec2;

/// What `f` returns, with the widest vector instructions that this processor has for its loops: the program is built for the oldest. Only what is
/// inlined into it gets them, so `f` and all that it calls in its loops has to be `#[inline(always)]`, and its loops written out: `collect` is not inlined.
#[inline]
pub fn wide<R>(f: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(f)
}

/// `v` as a whole number that is not greater, and the rest. `f64::floor` is a call of a library function on processors that are not known to round.
#[inline(always)]
pub fn split(v: f64) -> (isize, f32) {
    let towards_zero = v as isize;
    let whole = towards_zero - isize::from(v < towards_zero as f64);
    (whole, (v - whole as f64) as f32)
}

/// Value at `q` (pixels from the first one), bilinear, the nearest pixel's outside; NaN beside one.
pub fn bilinear(p: &Plane, q: DVec2) -> f32 {
    let (x, y) = (q.x.floor(), q.y.floor());
    let (u, v) = ((q.x - x) as f32, (q.y - y) as f32);
    let at = |i: isize, j: isize| p.clamped(x as isize + i, y as isize + j);
    (1.0 - v) * ((1.0 - u) * at(0, 0) + u * at(1, 0)) + v * ((1.0 - u) * at(0, 1) + u * at(1, 1))
}

/// c0 + c1 t + c2 t² + c3 t³ in each of four lanes.
#[inline(always)]
fn polynomials(c: &[[f32; 4]; 4], t: f32) -> [f32; 4] {
    let mut v = c[3];
    for c in [&c[2], &c[1], &c[0]] {
        for (v, c) in v.iter_mut().zip(c) {
            *v = *v * t + c;
        }
    }
    v
}

/// Weights of the four pixels around fraction `t`.
#[inline(always)]
pub fn weights(t: f32) -> [f32; 4] {
    polynomials(&[[0.0, 1.0, 0.0, 0.0], [-0.5, 0.0, 0.5, 0.0], [1.0, -2.5, 2.0, -0.5], [-0.5, 1.5, -1.5, 0.5]], t)
}

/// Their derivatives.
#[inline(always)]
pub fn slopes(t: f32) -> [f32; 4] {
    polynomials(&[[-0.5, 0.0, 0.5, 0.0], [2.0, -5.0, 4.0, -1.0], [-1.5, 4.5, -4.5, 1.5], [0.0; 4]], t)
}

#[inline(always)]
fn dot(a: &[f32; 4], b: &[f32; 4]) -> f32 {
    (a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3])
}

/// `sum` += `w` times `row`, lane by lane.
#[inline(always)]
fn add(sum: &mut [f32; 4], w: f32, row: &[f32; 4]) {
    for (s, r) in sum.iter_mut().zip(row) {
        *s += w * r;
    }
}

/// Calls `f` with each of the four rows of four pixels around pixel (`x`, `y`), the nearest edge pixel outside.
#[inline(always)]
fn rows(plane: &Plane, x: isize, y: isize, mut f: impl FnMut(usize, &[f32; 4])) {
    let (x, y) = (x - 1, y - 1);
    if x >= 0 && y >= 0 && x + 4 <= plane.width as isize && y + 4 <= plane.height as isize {
        let first = y as usize * plane.width + x as usize;
        for j in 0..4 {
            let row = &plane.data[first + j * plane.width..][..4];
            f(j, row.try_into().expect("four pixels"));
        }
    } else {
        for j in 0..4 {
            f(j, &std::array::from_fn(|i| plane.clamped(x + i as isize, y + j as isize)));
        }
    }
}

/// Each of `planes`, which are of one size, at `p` (pixels).
#[inline(always)]
pub fn cubic<const N: usize>(planes: &[&Plane; N], p: DVec2) -> [f32; N] {
    let ((x, u), (y, v)) = (split(p.x), split(p.y));
    let (wx, wy) = (weights(u), weights(v));
    let mut out = [0.0; N];
    for (out, plane) in out.iter_mut().zip(planes) {
        let mut columns = [0.0; 4];
        rows(plane, x, y, |j, row| add(&mut columns, wy[j], row));
        *out = dot(&wx, &columns);
    }
    out
}

/// `plane` at `p` (pixels) and its gradient.
#[inline(always)]
pub fn cubic_with_gradient(plane: &Plane, p: DVec2) -> (f32, [f32; 2]) {
    let ((x, u), (y, v)) = (split(p.x), split(p.y));
    let (wx, wy, sx, sy) = (weights(u), weights(v), slopes(u), slopes(v));
    let (mut columns, mut steps) = ([0.0; 4], [0.0; 4]);
    rows(plane, x, y, |j, row| {
        add(&mut columns, wy[j], row);
        add(&mut steps, sy[j], row);
    });
    (dot(&wx, &columns), [dot(&sx, &columns), dot(&wx, &steps)])
}
