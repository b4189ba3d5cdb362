//! Gradient-domain compression: gradients attenuated at all scales, then the picture whose gradients come closest.

use crate::image::Plane;
use rayon::prelude::*;

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
        let mean = (gradient.par_iter().map(|v| f64::from(*v)).sum::<f64>() / gradient.len() as f64) as f32;
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

/// Sums of 2 x 2 pixels, of those that there are.
fn gathered(p: &Plane) -> Plane {
    let (w, h) = p.size();
    let (nw, nh) = (w.div_ceil(2), h.div_ceil(2));
    let sum = |i: usize| {
        let (x, y) = (2 * (i % nw), 2 * (i / nw));
        (y..(y + 2).min(h)).map(|y| (x..(x + 2).min(w)).map(|x| p.at(x, y)).sum::<f32>()).sum()
    };
    Plane { width: nw, height: nh, data: (0..nw * nh).into_par_iter().map(sum).collect() }
}

/// Value of the next coarser level at a pixel of the finer one, bilinear between cell centres.
fn interpolated(coarse: &Plane, x: usize, y: usize) -> f32 {
    let (w, h) = coarse.size();
    let neighbour = |i: usize, n: usize| if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(n - 1) };
    let (a, b) = ((x / 2).min(w - 1), (y / 2).min(h - 1));
    let (c, d) = (neighbour(x, w), neighbour(y, h));
    0.5625 * coarse.at(a, b) + 0.1875 * (coarse.at(c, b) + coarse.at(a, d)) + 0.0625 * coarse.at(c, d)
}

/// Cycles after which nothing changes that 8 bits would show.
const CYCLES: usize = 6;

/// Solves Δu = `f` without flow over the border, by multigrid V-cycles.
pub(super) fn poisson(f: &Plane) -> Plane {
    let mut u = Plane::filled(f.width, f.height, 0.0);
    // The border lets nothing out: what flows in sums to zero but for rounding.
    let f = without_mean(f);
    for _ in 0..CYCLES {
        cycle(&mut u, &f);
    }
    u
}

fn without_mean(p: &Plane) -> Plane {
    let mean = (p.data.par_iter().map(|v| f64::from(*v)).sum::<f64>() / p.data.len() as f64) as f32;
    Plane { width: p.width, height: p.height, data: p.data.par_iter().map(|v| v - mean).collect() }
}

fn cycle(u: &mut Plane, f: &Plane) {
    let (w, h) = f.size();
    if w.min(h) < 4 {
        // A few pixels one way may be many the other; relaxation alone reaches only so far, and what is left is invisible.
        for _ in 0..(4 * w.max(h)).min(400) {
            relax(u, f);
        }
        return;
    }
    for _ in 0..2 {
        relax(u, f);
    }
    let residual = residual(u, f);
    // The flow into a coarse cell is the sum of the flows into its pixels, so that nothing is lost at odd borders; at twice the spacing
    // the stencil's 1/h² is a quarter, and four pixels are one cell.
    let coarse = without_mean(&gathered(&residual));
    let mut correction = Plane::filled(coarse.width, coarse.height, 0.0);
    cycle(&mut correction, &coarse);
    u.data.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
        for (x, v) in row.iter_mut().enumerate() {
            *v += interpolated(&correction, x, y);
        }
    });
    for _ in 0..2 {
        relax(u, f);
    }
}

/// Number of neighbours and their sum.
#[inline]
fn around(u: &[f32], w: usize, h: usize, x: usize, y: usize) -> (f32, f32) {
    let i = y * w + x;
    let (mut n, mut sum) = (0.0, 0.0);
    if x > 0 {
        (n, sum) = (n + 1.0, sum + u[i - 1]);
    }
    if x + 1 < w {
        (n, sum) = (n + 1.0, sum + u[i + 1]);
    }
    if y > 0 {
        (n, sum) = (n + 1.0, sum + u[i - w]);
    }
    if y + 1 < h {
        (n, sum) = (n + 1.0, sum + u[i + w]);
    }
    (n, sum)
}

/// One damped Jacobi step; 0.8 damps what the coarse grid cannot see best.
fn relax(u: &mut Plane, f: &Plane) {
    let (w, h) = f.size();
    let before = u.data.clone();
    u.data.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
        for (x, v) in row.iter_mut().enumerate() {
            let (n, sum) = around(&before, w, h, x, y);
            if n > 0.0 {
                *v += 0.8 * ((sum - f.data[y * w + x]) / n - *v);
            }
        }
    });
}

fn residual(u: &Plane, f: &Plane) -> Plane {
    let (w, h) = f.size();
    let mut out = Plane::filled(w, h, 0.0);
    out.data.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
        for (x, v) in row.iter_mut().enumerate() {
            let (n, sum) = around(&u.data, w, h, x, y);
            *v = f.data[y * w + x] - (sum - n * u.data[y * w + x]);
        }
    });
    out
}
