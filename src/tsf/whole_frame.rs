//! TSF from the whole frame: the blurred frame against the latent irradiance, `B = Σ_k h_k Γ_k E` over all valid pixels.
//!
//! First on a grid of poses (sparse, gradients by FFT correlation), then with continuous poses. Both work on x and y differences of
//! the frame, weighted by inverse variance, so that a wrong mean level does not matter.

use super::Tsf;
use super::active_set::ActiveSet;
use super::continuous::Evidence;
use super::from_psfs::nominal_focal;
use super::model::{Chart, Model};
use super::taps::Interpolation;
use crate::fft::{Fft2, Spectrum};
use crate::image::Plane;
use crate::nonnegative::gram;
use crate::pose::{Pose, PoseGrid, project};
use glam::{DMat3, DVec2};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use std::collections::HashMap;

/// One blurred frame and the latent irradiance that should explain it.
pub struct WholeFrame<'a> {
    /// Latent irradiance on the frame's grid plus `pad` pixels on every side.
    pub latent: &'a Plane,
    /// Pad in pixels.
    pub pad: usize,
    /// Irradiance of the blurred frame.
    pub blurred: &'a Plane,
    /// Inverse variance of the frame's pixels, model error included; 0: masked.
    pub weight: &'a Plane,
    /// Where the frame lies on the latent grid before it moves (frame from latent, centred pixels): every pose comes after it.
    pub base: DMat3,
}

/// A weighted difference of two neighbouring pixels.
#[derive(Clone, Copy)]
pub(super) struct Row {
    pub x: u32,
    pub y: u32,
    vertical: bool,
    pub weight: f32,
}

impl Row {
    pub fn other(&self) -> (usize, usize) {
        let v = usize::from(self.vertical);
        (self.x as usize + 1 - v, self.y as usize + v)
    }
}

/// `latent` warped by `h` (scene to frame, centred pixels) on the frame's grid plus `margin` pixels on every side.
fn warp(latent: &Plane, pad: usize, size: (usize, usize), margin: usize, h: &DMat3, interpolation: Interpolation) -> Plane {
    let (w, hgt) = (size.0 + 2 * margin, size.1 + 2 * margin);
    let inverse = h.inverse();
    let centre = DVec2::new((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
    let s = interpolation.support() as isize;
    let mut data = vec![0.0f32; w * hgt];
    data.par_chunks_exact_mut(w).enumerate().for_each(|(j, row)| {
        let mut wx = [0.0f32; 6];
        let mut wy = [0.0f32; 6];
        for (i, out) in row.iter_mut().enumerate() {
            let q = DVec2::new(i as f64 - margin as f64, j as f64 - margin as f64) - centre;
            let p = project(&inverse, q) + centre + DVec2::splat(pad as f64);
            let (fx, fy) = (p.x.floor(), p.y.floor());
            for k in 0..2 * s {
                wx[k as usize] = interpolation.weight((k - s + 1) as f64 - (p.x - fx)) as f32;
                wy[k as usize] = interpolation.weight((k - s + 1) as f64 - (p.y - fy)) as f32;
            }
            let mut sum = 0.0;
            for b in 0..2 * s {
                for a in 0..2 * s {
                    sum += wx[a as usize] * wy[b as usize] * latent.clamped(fx as isize + a - s + 1, fy as isize + b - s + 1);
                }
            }
            *out = sum;
        }
    });
    Plane { width: w, height: hgt, data }
}

impl WholeFrame<'_> {
    pub(super) fn size(&self) -> (usize, usize) {
        self.blurred.size()
    }

    /// The `count` differences, at least `margin` pixels from the border, with most noise-weighted structure.
    pub(super) fn rows(&self, count: usize, margin: usize) -> Vec<Row> {
        let (w, h) = self.size();
        let mut rows: Vec<(f32, Row)> = Vec::new();
        for y in margin..h.saturating_sub(margin) {
            for x in margin..w.saturating_sub(margin) {
                for vertical in [false, true] {
                    let row = Row { x: x as u32, y: y as u32, vertical, weight: 0.0 };
                    let (i, j) = row.other();
                    if i >= w || j >= h {
                        continue;
                    }
                    let (a, b) = (self.weight.at(x, y), self.weight.at(i, j));
                    if a > 0.0 && b > 0.0 {
                        let k = a * b / (a + b);
                        let e = self.latent.at(i + self.pad, j + self.pad) - self.latent.at(x + self.pad, y + self.pad);
                        let d = self.blurred.at(i, j) - self.blurred.at(x, y);
                        rows.push((k * (e * e + d * d), Row { weight: k, ..row }));
                    }
                }
            }
        }
        if rows.len() > count {
            rows.select_nth_unstable_by(count, |a, b| b.0.total_cmp(&a.0));
            rows.truncate(count);
        }
        let mut rows: Vec<Row> = rows.into_iter().map(|r| r.1).collect();
        rows.sort_by_key(|r| (r.y, r.x, r.vertical));
        rows
    }

    pub(super) fn targets(&self, rows: &[Row]) -> Vec<f32> {
        rows.iter()
            .map(|r| {
                let (i, j) = r.other();
                r.weight.sqrt() * (self.blurred.at(i, j) - self.blurred.at(r.x as usize, r.y as usize))
            })
            .collect()
    }

    /// TSF over the integer translations and the angles of `grid`, started from the poses of `start`; `None` when nothing fits.
    pub fn fit_grid(&self, grid: &PoseGrid, start: Option<&Tsf>) -> Option<Tsf> {
        let (w, h) = self.size();
        let focal = nominal_focal(w, h);
        let r = grid.radius;
        let n = 2 * r + 1;
        let rows = self.rows(40_000, 0);
        let targets = self.targets(&rows);
        let bases: Vec<Plane> = grid
            .angles_deg
            .iter()
            .map(|a| {
                warp(
                    self.latent,
                    self.pad,
                    (w, h),
                    r,
                    &(Pose::planar(0.0, 0.0, *a, 1.0).rotation(focal) * self.base),
                    Interpolation::Bicubic,
                )
            })
            .collect();
        let fft = Fft2::new(w + 2 * r, h + 2 * r);
        let spectra: Vec<Spectrum> = bases.par_iter().map(|b| fft.forward(&b.data, b.width)).collect();
        let column = |id: usize| -> Vec<f32> {
            let (sx, sy, a) = (id % n, id / n % n, id / (n * n));
            // Shift s = (sx - r, sy - r); pixel q - s of the base lies at q + 2 r - sx in its array.
            let b = &bases[a];
            rows.iter()
                .map(|row| {
                    let (i, j) = row.other();
                    let d = b.at(i + 2 * r - sx, j + 2 * r - sy) - b.at(row.x as usize + 2 * r - sx, row.y as usize + 2 * r - sy);
                    row.weight.sqrt() * d
                })
                .collect()
        };
        let gradient = |residual: &[f32]| -> Vec<f64> {
            let mut image = vec![0.0f32; w * h];
            for (row, v) in rows.iter().zip(residual) {
                let (i, j) = row.other();
                let v = v * row.weight.sqrt();
                image[j * w + i] += v;
                image[row.y as usize * w + row.x as usize] -= v;
            }
            let v = fft.forward(&image, w);
            let planes: Vec<Vec<f64>> = spectra
                .par_iter()
                .map(|e| {
                    let product = v.iter().zip(e).map(|(a, b)| a * b.conj()).collect();
                    let g = fft.inverse(product);
                    let mut out = Vec::with_capacity(n * n);
                    for sy in 0..n {
                        for sx in 0..n {
                            // Lag s - r, negative lags wrap.
                            let (lx, ly) = ((fft.width + sx - 2 * r) % fft.width, (fft.height + sy - 2 * r) % fft.height);
                            out.push(f64::from(g[ly * fft.width + lx]));
                        }
                    }
                    out
                })
                .collect();
            planes.concat()
        };
        let step = grid.step_deg();
        let start: Vec<usize> = start.map_or_else(Vec::new, |t| {
            let mut ids: Vec<usize> = t
                .poses
                .iter()
                .filter_map(|p| {
                    let (x, y) = (p.t_x.round() + r as f64, p.t_y.round() + r as f64);
                    let a = if step > 0.0 { ((p.theta_z_deg - grid.angles_deg[0]) / step).round() } else { 0.0 };
                    let inside = x >= 0.0 && y >= 0.0 && a >= 0.0 && x < n as f64 && y < n as f64 && a < grid.angles_deg.len() as f64;
                    inside.then_some((a as usize * n + y as usize) * n + x as usize)
                })
                .collect();
            ids.sort_unstable();
            ids.dedup();
            ids
        });
        let found = ActiveSet { shape: (n, n, grid.angles_deg.len()), lambda: 2e-3, rounds: 20 }.solve(&start, &targets, gradient, column);
        let poses = found
            .into_iter()
            .map(|(id, weight)| {
                Pose::planar((id % n) as f64 - r as f64, (id / n % n) as f64 - r as f64, grid.angles_deg[id / (n * n)], weight)
            })
            .collect();
        Tsf::new(focal, poses).ok()
    }

    /// As [`WholeFrame::refine`], within `model`, without taps.
    pub fn refine_free(&self, tsf: &Tsf, model: Model, interpolation: Interpolation, count: usize, iterations: usize) -> Tsf {
        let (w, h) = self.size();
        let corner = 0.5 * (w as f64).hypot(h as f64);
        let step = (0.7 / corner).to_degrees();
        let mut particles: Vec<Particle> = tsf
            .poses
            .iter()
            .map(|p| Particle { x: p.t_x, y: p.t_y, beta: p.theta_z_deg / step, weight: p.weight, ..Default::default() })
            .collect();
        absorb(&mut particles);
        let chart = Chart::new(model, tsf.focal_px, w, h);
        let poses: Vec<Pose> = particles.iter().map(|p| Pose { weight: p.weight, ..Pose::planar(p.x, p.y, p.beta * step, 1.0) }).collect();
        let Ok(start) = Tsf::new(tsf.focal_px, poses) else { return tsf.clone() };
        let margin =
            tsf.poses.iter().fold(0.0f64, |m, p| m.max(p.t_x.abs()).max(p.t_y.abs()) + p.theta_z_deg.to_radians().abs() * corner * 0.0);
        let rows = self.rows(count, margin as usize + 4);
        Evidence::new(self, &rows, interpolation).refine(&start, &chart, iterations)
    }

    /// Continuous poses from `tsf`: translations, angles and weights move freely (Gauss-Newton with Levenberg damping), by at most 0.9 px in
    /// each of `rounds`.
    ///
    /// The blur is linear in the taps of a [`super::TapSet`], so that all of the frame's evidence about them is one Gram matrix over the
    /// taps near the poses; the poses enter only through how they splat on the taps.
    pub fn refine(&self, tsf: &Tsf, interpolation: Interpolation, rounds: usize) -> Tsf {
        let (w, h) = self.size();
        let corner = 0.5 * (w as f64).hypot(h as f64);
        let step = (0.7 / corner).to_degrees();
        let mut particles: Vec<Particle> = tsf
            .poses
            .iter()
            .map(|p| Particle { x: p.t_x, y: p.t_y, beta: p.theta_z_deg / step, weight: p.weight, ..Default::default() })
            .collect();
        absorb(&mut particles);
        for _ in 0..rounds {
            let low = particles.iter().fold(f64::INFINITY, |m, p| m.min(p.beta)).floor();
            for p in &mut particles {
                p.beta -= low;
                p.home = (p.x, p.y, p.beta.floor());
            }
            let problem = Taps::new(self, &particles, low * step, step, tsf.focal_px, interpolation);
            problem.minimise(&mut particles);
            for p in &mut particles {
                p.beta += low;
            }
            merge_close(&mut particles);
        }
        let poses = particles.iter().map(|p| Pose { weight: p.weight, ..Pose::planar(p.x, p.y, p.beta * step, 1.0) }).collect();
        Tsf::new(tsf.focal_px, poses).unwrap_or_else(|_| tsf.clone())
    }
}

/// A pose with its angle in steps of the base warps; `home` bounds how far it may move before the taps are chosen anew.
#[derive(Clone, Copy, Default)]
struct Particle {
    x: f64,
    y: f64,
    beta: f64,
    weight: f64,
    home: (f64, f64, f64),
}

/// Poses of a grid stand in groups for continuous ones between them: the heaviest take in their neighbours.
fn absorb(particles: &mut Vec<Particle>) {
    particles.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    let mut out: Vec<Particle> = Vec::new();
    for p in particles.iter() {
        let distance = |q: &Particle| ((q.home.0 - p.x).powi(2) + (q.home.1 - p.y).powi(2) + (q.home.2 - p.beta).powi(2)).sqrt();
        let near = out.iter_mut().map(|q| (distance(q), q)).min_by(|a, b| a.0.total_cmp(&b.0));
        match near {
            Some((d, q)) if d <= ABSORB => {
                let s = q.weight + p.weight;
                q.x = (q.x * q.weight + p.x * p.weight) / s;
                q.y = (q.y * q.weight + p.y * p.weight) / s;
                q.beta = (q.beta * q.weight + p.beta * p.weight) / s;
                q.weight = s;
            }
            _ => out.push(Particle { home: (p.x, p.y, p.beta), ..*p }),
        }
    }
    let total: f64 = out.iter().map(|p| p.weight).sum();
    out.retain(|p| p.weight > 2e-3 * total);
    out.truncate(MOST_PARTICLES);
    *particles = out;
}

/// Distance in pixels (angles in steps of the base warps) within which grid poses become one continuous pose.
const ABSORB: f64 = 1.4;
/// Continuous poses at most: beyond, the tap system grows too large for what more poses explain.
const MOST_PARTICLES: usize = 90;

/// Particles that came together act as one.
fn merge_close(particles: &mut Vec<Particle>) {
    let mut out: Vec<Particle> = Vec::new();
    for p in particles.iter().filter(|p| p.weight > 1e-5) {
        let near = out.iter_mut().find(|q| (q.x - p.x).abs() < 0.2 && (q.y - p.y).abs() < 0.2 && (q.beta - p.beta).abs() < 0.2);
        match near {
            Some(q) => {
                let s = q.weight + p.weight;
                q.x = (q.x * q.weight + p.x * p.weight) / s;
                q.y = (q.y * q.weight + p.y * p.weight) / s;
                q.beta = (q.beta * q.weight + p.beta * p.weight) / s;
                q.weight = s;
            }
            None => out.push(*p),
        }
    }
    *particles = out;
}

/// Quadratic form of the frame's evidence in the taps near the particles.
struct Taps {
    index: HashMap<(i32, i32, i32), usize>,
    gram: DMatrix<f64>,
    c: DVector<f64>,
    interpolation: Interpolation,
}

/// Rows of the tap system: enough that thousands of differences speak for each tap.
const TAP_ROWS: usize = 12_000;

impl Taps {
    fn new(frame: &WholeFrame, particles: &[Particle], first_deg: f64, step_deg: f64, focal: f64, interpolation: Interpolation) -> Self {
        let s = interpolation.support() as i32;
        let mut index: HashMap<(i32, i32, i32), usize> = HashMap::new();
        for p in particles {
            let (x, y, b) = (p.x.floor() as i32, p.y.floor() as i32, p.beta.floor() as i32);
            for base in b..=b + 1 {
                for dy in y - s..=y + s + 1 {
                    for dx in x - s..=x + s + 1 {
                        let n = index.len();
                        index.entry((base, dx, dy)).or_insert(n);
                    }
                }
            }
        }
        let n = index.len();
        let margin = index.keys().map(|k| k.1.abs().max(k.2.abs())).max().unwrap_or(0) as usize;
        let last = index.keys().map(|k| k.0).max().unwrap_or(0);
        let bases: Vec<Plane> = (0..=last)
            .map(|b| {
                let h = Pose::planar(0.0, 0.0, first_deg + f64::from(b) * step_deg, 1.0).rotation(focal);
                warp(frame.latent, frame.pad, frame.size(), margin, &(h * frame.base), interpolation)
            })
            .collect();
        let rows = frame.rows(TAP_ROWS, 0);
        let targets = frame.targets(&rows);
        let mut keys = vec![(0, 0, 0); n];
        for (k, i) in &index {
            keys[*i] = *k;
        }
        let (gram, c) = rows
            .par_chunks(1536)
            .zip(targets.par_chunks(1536))
            .map(|(rows, targets)| {
                let mut a = DMatrix::<f32>::zeros(rows.len(), n);
                for (k, &(base, dx, dy)) in keys.iter().enumerate() {
                    let b = &bases[base as usize];
                    let (mx, my) = (margin as i32 - dx, margin as i32 - dy);
                    for (r, row) in rows.iter().enumerate() {
                        let (i, j) = row.other();
                        let at = |x: usize, y: usize| b.at((x as i32 + mx) as usize, (y as i32 + my) as usize);
                        a[(r, k)] = row.weight.sqrt() * (at(i, j) - at(row.x as usize, row.y as usize));
                    }
                }
                let b = DVector::from_column_slice(targets);
                (gram(&a).cast::<f64>(), a.tr_mul(&b).cast::<f64>())
            })
            .reduce(|| (DMatrix::zeros(n, n), DVector::zeros(n)), |(g, c), (g2, c2)| (g + g2, c + c2));
        Self { index, gram, c, interpolation }
    }

    /// (tap, weight, d/dx, d/dy, d/dβ) of a particle of weight 1.
    fn splat(&self, p: &Particle) -> Vec<(usize, [f64; 4])> {
        let s = self.interpolation.support() as i32;
        let b = p.home.2;
        let f = p.beta - b;
        let (fx, fy) = (p.x.floor(), p.y.floor());
        let mut out = Vec::with_capacity(8 * (s * s) as usize);
        for (base, share, slope) in [(b as i32, 1.0 - f, -1.0), (b as i32 + 1, f, 1.0)] {
            for j in 1 - s..=s {
                let v = f64::from(j) - (p.y - fy);
                let (wy, gy) = (self.interpolation.weight(v), -self.interpolation.slope(v));
                for i in 1 - s..=s {
                    let u = f64::from(i) - (p.x - fx);
                    let (wx, gx) = (self.interpolation.weight(u), -self.interpolation.slope(u));
                    if let Some(&k) = self.index.get(&(base, fx as i32 + i, fy as i32 + j)) {
                        out.push((k, [share * wx * wy, share * gx * wy, share * wx * gy, slope * wx * wy]));
                    }
                }
            }
        }
        out
    }

    fn taps(&self, particles: &[Particle]) -> DVector<f64> {
        let mut h = DVector::zeros(self.c.len());
        for p in particles {
            for (k, v) in self.splat(p) {
                h[k] += p.weight * v[0];
            }
        }
        h
    }

    fn loss(&self, h: &DVector<f64>) -> f64 {
        0.5 * h.dot(&(&self.gram * h)) - self.c.dot(h)
    }

    /// Levenberg-Marquardt on (x, y, β, weight) of all particles.
    fn minimise(&self, particles: &mut Vec<Particle>) {
        let mut h = self.taps(particles);
        let mut loss = self.loss(&h);
        let mut damping = 1e-2;
        for _ in 0..25 {
            let m = particles.len();
            let splats: Vec<Vec<(usize, [f64; 4])>> = particles
                .iter()
                .map(|p| self.splat(p).into_iter().map(|(k, v)| (k, [p.weight * v[1], p.weight * v[2], p.weight * v[3], v[0]])).collect())
                .collect();
            let slack = &self.c - &self.gram * &h;
            let mut gradient = DVector::zeros(4 * m);
            let mut hessian = DMatrix::<f64>::zeros(4 * m, 4 * m);
            // Columns of G J for one particle at a time: J has a few dozen entries per column.
            let mut product = [vec![0.0f64; 0], Vec::new(), Vec::new(), Vec::new()];
            for (i, own) in splats.iter().enumerate() {
                for p in &mut product {
                    p.clear();
                    p.resize(self.c.len(), 0.0);
                }
                for (k, v) in own {
                    let column = self.gram.column(*k);
                    for (p, w) in product.iter_mut().zip(v) {
                        for (q, g) in p.iter_mut().zip(column.iter()) {
                            *q += w * g;
                        }
                    }
                    for (t, w) in v.iter().enumerate() {
                        gradient[4 * i + t] += w * slack[*k];
                    }
                }
                for (j, other) in splats.iter().enumerate().skip(i) {
                    for (k, v) in other {
                        for (t, w) in v.iter().enumerate() {
                            for (u, p) in product.iter().enumerate() {
                                hessian[(4 * j + t, 4 * i + u)] += w * p[*k];
                            }
                        }
                    }
                }
            }
            for i in 0..4 * m {
                for j in i + 1..4 * m {
                    hessian[(i, j)] = hessian[(j, i)];
                }
            }
            let mean = hessian.diagonal().mean();
            let mut improved = false;
            for _ in 0..6 {
                let mut a = hessian.clone();
                for i in 0..4 * m {
                    a[(i, i)] += damping * hessian[(i, i)] + 1e-9 * mean;
                }
                let Some(cholesky) = a.cholesky() else {
                    damping *= 10.0;
                    continue;
                };
                let d = cholesky.solve(&gradient);
                let trial: Vec<Particle> = particles
                    .iter()
                    .enumerate()
                    .map(|(i, p)| Particle {
                        x: (p.x + d[4 * i].clamp(-0.5, 0.5)).clamp(p.home.0 - 0.9, p.home.0 + 0.9),
                        y: (p.y + d[4 * i + 1].clamp(-0.5, 0.5)).clamp(p.home.1 - 0.9, p.home.1 + 0.9),
                        beta: (p.beta + d[4 * i + 2].clamp(-0.5, 0.5)).clamp(p.home.2, p.home.2 + 1.0),
                        weight: (p.weight + d[4 * i + 3]).max(0.0),
                        home: p.home,
                    })
                    .collect();
                let next = self.taps(&trial);
                let value = self.loss(&next);
                if value < loss {
                    improved = loss - value > 1e-5 * loss.abs();
                    *particles = trial;
                    h = next;
                    loss = value;
                    damping = (damping * 0.3).max(1e-6);
                    break;
                }
                damping *= 5.0;
            }
            particles.retain(|p| p.weight > 1e-6);
            if !improved {
                break;
            }
        }
    }
}
