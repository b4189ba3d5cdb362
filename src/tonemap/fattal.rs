//! Gradient-domain compression: gradients attenuated at all scales, then the picture whose gradients come closest.

use super::filter::transposed;
use crate::image::Plane;
use rayon::prelude::*;
use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use std::sync::Arc;

/// Smallest side of the coarsest level.
const COARSEST: usize = 32;

/// Log luminance (natural) compressed: the gradients of `log` times Φ = Π over scales of (α/|∇|)·(|∇|/α)^β, α being `alpha` times the
/// scale's mean gradient; up to a constant.
pub(super) fn compress(log: &Plane, alpha: f32, beta: f32) -> Plane {
    let (w, h) = log.size();
    if w < 2 || h < 2 {
        return log.clone();
    }
    let attenuation = attenuation(log, alpha, beta);
    // ∇·(Φ ∇H) with the attenuation of an edge between two pixels the mean of theirs; no flow over the border.
    let mut divergence = Plane::filled(w, h, 0.0);
    divergence.data.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
        for (x, d) in row.iter_mut().enumerate() {
            let i = y * w + x;
            let flow = |j: usize| 0.5 * (attenuation.data[i] + attenuation.data[j]) * (log.data[j] - log.data[i]);
            *d = if x + 1 < w { flow(i + 1) } else { 0.0 }
                + if x > 0 { flow(i - 1) } else { 0.0 }
                + if y + 1 < h { flow(i + w) } else { 0.0 }
                + if y > 0 { flow(i - w) } else { 0.0 };
        }
    });
    poisson(&divergence)
}

/// Φ at every pixel, from the coarsest scale up.
fn attenuation(log: &Plane, alpha: f32, beta: f32) -> Plane {
    let mut pyramid = vec![log.clone()];
    while let Some(last) = pyramid.last()
        && last.width.min(last.height) >= 2 * COARSEST
    {
        let next = halved(last);
        pyramid.push(next);
    }
    let mut product: Option<Plane> = None;
    for (k, level) in pyramid.iter().enumerate().rev() {
        let (w, h) = level.size();
        let scale = 0.5f32.powi(k as i32 + 1);
        let gradient: Vec<f32> = (0..w * h)
            .into_par_iter()
            .map(|i| {
                let (x, y) = (i % w, i / w);
                let at = |x: usize, y: usize| level.data[y * w + x];
                let dx = at((x + 1).min(w - 1), y) - at(x.saturating_sub(1), y);
                let dy = at(x, (y + 1).min(h - 1)) - at(x, y.saturating_sub(1));
                scale * dx.hypot(dy)
            })
            .collect();
        let mean = (gradient.iter().map(|v| f64::from(*v)).sum::<f64>() / gradient.len() as f64) as f32;
        let a = (alpha * mean).max(1e-6);
        // Gradients far below α would be lifted without bound, and noise with them.
        let phi = |g: f32| (g.max(0.1 * a) / a).powf(beta - 1.0);
        let coarser = product.as_ref();
        let data = (0..w * h).into_par_iter().map(|i| phi(gradient[i]) * coarser.map_or(1.0, |p| interpolated(p, i % w, i / w))).collect();
        product = Some(Plane { width: w, height: h, data });
    }
    product.expect("at least one level")
}

/// Means of 2 x 2 pixels; a last odd row or column counts twice.
fn halved(p: &Plane) -> Plane {
    let (w, h) = p.size();
    let (nw, nh) = (w.div_ceil(2), h.div_ceil(2));
    let data = (0..nw * nh)
        .into_par_iter()
        .map(|i| {
            let (x, y) = (2 * (i % nw), 2 * (i / nw));
            let (x1, y1) = ((x + 1).min(w - 1), (y + 1).min(h - 1));
            0.25 * (p.at(x, y) + p.at(x1, y) + p.at(x, y1) + p.at(x1, y1))
        })
        .collect();
    Plane { width: nw, height: nh, data }
}

/// Value of the next coarser level at a pixel of the finer one, bilinear between cell centres.
fn interpolated(coarse: &Plane, x: usize, y: usize) -> f32 {
    let (w, h) = coarse.size();
    let neighbour = |i: usize, n: usize| if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(n - 1) };
    let (a, b) = ((x / 2).min(w - 1), (y / 2).min(h - 1));
    let (c, d) = (neighbour(x, w), neighbour(y, h));
    0.5625 * coarse.at(a, b) + 0.1875 * (coarse.at(c, b) + coarse.at(a, d)) + 0.0625 * coarse.at(c, d)
}

/// Solves Δu = `f` (five-point stencil, no flow over the border) up to a constant, exactly: the cosines of the DCT-II are its
/// eigenvectors, of the eigenvalues 2 cos(π i/w) + 2 cos(π j/h) − 4. A mean of `f`, which has no solution, is left out.
fn poisson(f: &Plane) -> Plane {
    let (w, h) = f.size();
    let across = Cosines::new(w);
    let down = Cosines::new(h);
    let mut u = f.clone();
    across.forward(&mut u);
    let mut u = transposed(&u);
    down.forward(&mut u);
    let eigenvalues = |n: usize| (0..n).map(|i| 2.0 * (std::f64::consts::PI * i as f64 / n as f64).cos() - 2.0).collect::<Vec<f64>>();
    let (of_columns, of_rows) = (eigenvalues(w), eigenvalues(h));
    u.data.par_chunks_exact_mut(h).zip(&of_columns).for_each(|(column, own)| {
        for (v, other) in column.iter_mut().zip(&of_rows) {
            let value = own + other;
            *v = if value < 0.0 { (f64::from(*v) / value) as f32 } else { 0.0 };
        }
    });
    down.inverse(&mut u);
    let mut u = transposed(&u);
    across.inverse(&mut u);
    u
}

/// DCT-II of rows of one length, and its inverse, through a real FFT of that length (J. Makhoul, "A Fast Cosine Transform in One and Two
/// Dimensions", 1980).
struct Cosines {
    n: usize,
    to: Arc<dyn RealToComplex<f32>>,
    from: Arc<dyn ComplexToReal<f32>>,
    /// exp(−iπk/2n), k = 0..=n/2.
    turn: Vec<Complex<f32>>,
}

impl Cosines {
    fn new(n: usize) -> Self {
        let mut planner = RealFftPlanner::new();
        let angle = |k: usize| -std::f64::consts::PI * k as f64 / (2 * n) as f64;
        let turn = (0..=n / 2).map(|k| Complex::new(angle(k).cos() as f32, angle(k).sin() as f32)).collect();
        Self { n, to: planner.plan_fft_forward(n), from: planner.plan_fft_inverse(n), turn }
    }

    /// Rows x become C[k] = Σ x[m] cos(πk(2m + 1)/2n).
    fn forward(&self, plane: &mut Plane) {
        let n = self.n;
        let buffers = || (self.to.make_input_vec(), self.to.make_output_vec(), self.to.make_scratch_vec());
        plane.data.par_chunks_exact_mut(n).for_each_init(buffers, |(v, spectrum, scratch), row| {
            // The even samples, then the odd ones backwards.
            for (m, x) in row.iter().enumerate() {
                v[if m.is_multiple_of(2) { m / 2 } else { n - 1 - m / 2 }] = *x;
            }
            self.to.process_with_scratch(v, spectrum, scratch).expect("the buffers are the plan's own");
            for (k, (s, t)) in spectrum.iter().zip(&self.turn).enumerate() {
                let c = s * t;
                row[k] = c.re;
                if k > 0 {
                    row[n - k] = if 2 * k == n { c.re } else { -c.im };
                }
            }
        });
    }

    /// What [`Self::forward`] undoes.
    fn inverse(&self, plane: &mut Plane) {
        let n = self.n;
        let buffers = || (self.from.make_output_vec(), self.from.make_input_vec(), self.from.make_scratch_vec());
        plane.data.par_chunks_exact_mut(n).for_each_init(buffers, |(v, spectrum, scratch), row| {
            for (k, (s, t)) in spectrum.iter_mut().zip(&self.turn).enumerate() {
                *s = t.conj() * Complex::new(row[k], if k > 0 { -row[n - k] } else { 0.0 });
            }
            // Real but for rounding, which the transform refuses.
            spectrum[0].im = 0.0;
            if n.is_multiple_of(2) {
                spectrum[n / 2].im = 0.0;
            }
            self.from.process_with_scratch(spectrum, v, scratch).expect("the buffers are the plan's own, real where they must be");
            for (m, x) in row.iter_mut().enumerate() {
                *x = v[if m.is_multiple_of(2) { m / 2 } else { n - 1 - m / 2 }] / n as f32;
            }
        });
    }
}
