//! Shift between two pictures by phase correlation (C. Kuglin and D. Hines, "The Phase Correlation Image Alignment Method", 1975).

use crate::image::Plane;
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;

/// Pixels on each side of the peak that its centroid is taken over.
const NEAR: usize = 2;

/// Where `a` lies in `b`, pixels to the right and down: the peak of the correlation of their phases under a Hann window, placed between
/// pixels by its centroid. Planes of one size.
pub(super) fn shift(a: &Plane, b: &Plane) -> (f64, f64) {
    let (width, height) = a.size();
    let (w, h) = (smooth(width), smooth(height));
    let hann = |i: usize, n: usize| 0.5 * (1.0 - (std::f64::consts::TAU * i as f64 / (n.max(2) - 1) as f64).cos());
    let spectrum = |p: &Plane| {
        let mut out = vec![Complex::new(0.0, 0.0); w * h];
        for y in 0..height {
            for x in 0..width {
                out[y * w + x].re = f64::from(p.at(x, y)) * (hann(x, width) * hann(y, height)).sqrt();
            }
        }
        transform(&mut out, w, h, false);
        out
    };
    let mut cross = spectrum(a);
    for (p, q) in cross.iter_mut().zip(spectrum(b)) {
        let product = *p * q.conj();
        // Only the phase counts; what no frequency holds has none.
        *p = product * (product.norm() / (product.norm_sqr() + f64::EPSILON));
    }
    transform(&mut cross, w, h, true);
    // No shift lies at the origin: as at the middle, so that the peak has neighbours on all sides.
    let at = |x: usize, y: usize| cross[(y + h - h / 2) % h * w + (x + w - w / 2) % w].re;
    let cells = (0..w * h).map(|i| (i % w, i / w));
    let Some((px, py)) = cells.max_by(|p, q| at(p.0, p.1).total_cmp(&at(q.0, q.1))) else { return (0.0, 0.0) };
    let (mut sum, mut cx, mut cy) = (f64::EPSILON, 0.0, 0.0);
    for y in py.saturating_sub(NEAR)..=(py + NEAR).min(h - 1) {
        for x in px.saturating_sub(NEAR)..=(px + NEAR).min(w - 1) {
            let v = at(x, y);
            (sum, cx, cy) = (sum + v, cx + v * x as f64, cy + v * y as f64);
        }
    }
    let found = ((w / 2) as f64 - cx / sum, (h / 2) as f64 - cy / sum);
    if found.0.is_finite() && found.1.is_finite() { found } else { (0.0, 0.0) }
}

/// The next number without prime factors above 5.
fn smooth(n: usize) -> usize {
    let rest = |mut m: usize| {
        for p in [2, 3, 5] {
            while m.is_multiple_of(p) {
                m /= p;
            }
        }
        m
    };
    (n.max(1)..).find(|&m| rest(m) == 1).unwrap_or(n)
}

/// Two-dimensional transform in place, not scaled.
fn transform(data: &mut [Complex<f64>], w: usize, h: usize, back: bool) {
    let mut planner = FftPlanner::new();
    let mut plan = |n: usize| if back { planner.plan_fft_inverse(n) } else { planner.plan_fft_forward(n) };
    plan(w).process(data);
    let columns = plan(h);
    let mut column = vec![Complex::new(0.0, 0.0); h];
    for x in 0..w {
        for (y, v) in column.iter_mut().enumerate() {
            *v = data[y * w + x];
        }
        columns.process(&mut column);
        for (y, v) in column.iter().enumerate() {
            data[y * w + x] = *v;
        }
    }
}
