//! Continuous poses: translations, angles and weights move freely until the frame is explained (Levenberg-Marquardt).
//!
//! The latent irradiance is sampled where each pose looks from each of some thousand pixels, chosen for what they tell: the cost grows
//! with the length of the camera's path and not with the frame.

use super::Tsf;
use super::model::{Chart, Coordinates};
use super::whole_frame::{Row, WholeFrame};
use crate::image::Plane;
use crate::nonnegative::{coordinate_descent, gram};
use crate::pose::{Pose, Projection, project};
use crate::sampling::{cubic, cubic_with_gradient, wide};
use glam::{DMat3, DVec2};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use std::collections::HashMap;

/// A frame's differences that count, and the pixels between which they are taken.
pub(super) struct Evidence<'a> {
    latent: &'a Plane,
    /// From frame to latent pixels, for a point that a pose has taken back: A⁻¹ in centred pixels.
    back: DMat3,
    origin: DVec2,
    pixels: Vec<DVec2>,
    /// (pixel, pixel, √weight); the difference is second minus first.
    rows: Vec<(u32, u32, f32)>,
    targets: Vec<f32>,
}

/// √weight of the row that says that weights sum to 1, as a part of the root mean square of the columns: exposures are known to a per cent or
/// better, and an operator that is off by a per cent in brightness is off everywhere.
pub(super) const SUM: f64 = 30.0;
/// Standard deviation, in pixels at the frame's sides, that the perspective of pitch and yaw is expected to have where the frame does
/// not say.
const PERSPECTIVE: f64 = 2.0;

/// Mean of the squares of `values`.
pub(super) fn mean_square(values: &[f32]) -> f64 {
    values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() / values.len().max(1) as f64
}

impl<'a> Evidence<'a> {
    pub fn new(frame: &WholeFrame<'a>, rows: &[Row]) -> Self {
        let (w, h) = frame.size();
        let mut index: HashMap<(u32, u32), u32> = HashMap::with_capacity(2 * rows.len());
        let mut pixels = Vec::new();
        let centre = DVec2::new((w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0);
        let mut id = |x: u32, y: u32| {
            *index.entry((x, y)).or_insert_with(|| {
                pixels.push(DVec2::new(f64::from(x), f64::from(y)) - centre);
                pixels.len() as u32 - 1
            })
        };
        let list = rows
            .iter()
            .map(|r| {
                let (i, j) = r.other();
                (id(r.x, r.y), id(i as u32, j as u32), r.weight.sqrt())
            })
            .collect();
        Self {
            latent: frame.latent,
            back: frame.base.inverse(),
            origin: centre + DVec2::splat(frame.pad as f64),
            pixels,
            rows: list,
            targets: frame.targets(rows),
        }
    }

    /// All pixels of a frame of `size`, and no differences.
    pub fn of_pixels(latent: &'a Plane, pad: usize, base: DMat3, size: (usize, usize)) -> Self {
        let centre = DVec2::new((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
        let pixels = (0..size.0 * size.1).map(|p| DVec2::new((p % size.0) as f64, (p / size.0) as f64) - centre).collect();
        Self { latent, back: base.inverse(), origin: centre + DVec2::splat(pad as f64), pixels, rows: Vec::new(), targets: Vec::new() }
    }

    /// Weighted differences that `pose` makes of the latent irradiance: its column of A.
    fn column(&self, pose: &Pose, focal: f64) -> Vec<f32> {
        let [column] = self.columns(&[self.latent], pose, focal);
        column
    }

    /// [`Evidence::column`] of each of `planes`, which are as large as the latent irradiance.
    fn columns<const N: usize>(&self, planes: &[&Plane; N], pose: &Pose, focal: f64) -> [Vec<f32>; N] {
        let turn = Projection::new(self.back * pose.rotation(focal).inverse());
        let t = DVec2::new(pose.t_x, pose.t_y);
        let mut values = vec![[0.0; N]; self.pixels.len()];
        wide(
            #[inline(always)]
            || {
                for (v, q) in values.iter_mut().zip(&self.pixels) {
                    *v = cubic(planes, turn.of(*q - t) + self.origin);
                }
            },
        );
        std::array::from_fn(|n| self.rows.iter().map(|&(a, b, k)| k * (values[b as usize][n] - values[a as usize][n])).collect())
    }

    /// Weighted differences that `tsf` makes of each of `planes`, which are as large as the latent irradiance.
    pub fn predicted<const N: usize>(&self, planes: &[&Plane; N], tsf: &Tsf) -> [Vec<f32>; N] {
        let columns: Vec<[Vec<f32>; N]> = tsf.poses.par_iter().map(|p| self.columns(planes, p, tsf.focal_px)).collect();
        let mut sums: [Vec<f32>; N] = std::array::from_fn(|_| vec![0.0; self.rows.len()]);
        for (columns, p) in columns.iter().zip(&tsf.poses) {
            let w = p.weight as f32;
            for (sum, column) in sums.iter_mut().zip(columns) {
                sum.iter_mut().zip(column).for_each(|(s, v)| *s += w * v);
            }
        }
        sums
    }

    /// Weighted differences of the frame.
    pub fn targets(&self) -> &[f32] {
        &self.targets
    }

    /// Weighted residual of `tsf` at each difference.
    pub fn residual(&self, tsf: &Tsf) -> Vec<f32> {
        let [predicted] = self.predicted(&[self.latent], tsf);
        self.targets.iter().zip(predicted).map(|(t, p)| t - p).collect()
    }

    /// Mean square of [`Evidence::residual`].
    pub fn misfit(&self, tsf: &Tsf) -> f64 {
        mean_square(&self.residual(tsf))
    }

    /// Sparse non-negative weights of `poses` (eq. 6 against the frame instead of PSFs). λ is the level that the gradient of noise alone
    /// does not exceed among so many poses: `√(2 ln n)` times a column's length, times the standard deviation `noise` of the weighted
    /// differences (1 for what their variances say).
    pub fn weigh(&self, poses: &[Pose], focal: f64, noise: f64) -> Option<Tsf> {
        let n = poses.len();
        let columns: Vec<Vec<f32>> = poses.par_iter().map(|p| self.column(p, focal)).collect();
        let rows = self.targets.len();
        let flat: Vec<f32> = columns.concat();
        drop(columns);
        let a = DMatrix::from_vec(rows, n, flat);
        let (g, c) = normal(&a, &self.targets);
        let g: Vec<f64> = g.iter().copied().collect();
        let mut lengths: Vec<f64> = (0..n).map(|i| g[i * n + i].sqrt()).collect();
        lengths.sort_by(f64::total_cmp);
        let lambda = noise * (2.0 * (n as f64).ln()).sqrt() * lengths[n / 2];
        let mut h = vec![0.0; n];
        coordinate_descent(&g, c.as_slice(), lambda, &mut h, 200, 1e-4);
        Tsf::new(focal, poses.iter().zip(&h).map(|(p, w)| Pose { weight: *w, ..*p }).collect()).ok()
    }

    /// Poses and weights of `tsf` moved within `chart`'s model until the weighted squared residual no longer falls, or `iterations`.
    pub fn refine(&self, tsf: &Tsf, chart: &Chart, iterations: usize) -> Tsf {
        let free = chart.free();
        let per = free + 1;
        let mut particles: Vec<(Coordinates, f64)> = tsf.poses.iter().map(|p| (chart.coordinates(p), p.weight)).collect();
        let rows = self.rows.len();
        let predict = |particles: &[(Coordinates, f64)]| -> (Vec<f32>, f64) {
            let columns: Vec<Vec<f32>> = particles
                .par_iter()
                .map(|(c, w)| {
                    let mut v = self.column(&chart.pose(c, 1.0), chart.focal);
                    let w = *w as f32;
                    v.iter_mut().for_each(|x| *x *= w);
                    v
                })
                .collect();
            let mut r = self.targets.clone();
            for c in &columns {
                for (r, v) in r.iter_mut().zip(c) {
                    *r -= v;
                }
            }
            let loss = 0.5 * r.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
            (r, loss)
        };
        // What is added to the loss: the sum of weights, and perspective where nothing speaks for it.
        let extra = |particles: &[(Coordinates, f64)], stiffness: f64| -> f64 {
            let sum: f64 = particles.iter().map(|p| p.1).sum();
            let ridge: f64 = particles.iter().map(|(c, _)| c[3] * c[3] + c[4] * c[4]).sum::<f64>() / (PERSPECTIVE * PERSPECTIVE);
            0.5 * stiffness * (sum - 1.0).powi(2) + 0.5 * ridge
        };
        let mut damping = 1e-3;
        let mut stiffness = 0.0;
        let (mut r, mut data) = predict(&particles);
        for _ in 0..iterations {
            let m = particles.len();
            let columns: Vec<Vec<f32>> = particles
                .par_iter()
                .map(|(c, w)| {
                    let pose = chart.pose(c, 1.0);
                    let (values, motions) = self.look(chart, &pose);
                    let mut out = Vec::with_capacity(rows * per);
                    let w = *w as f32;
                    let along = |k: usize, i: u32| motions[i as usize][k];
                    for k in 0..free {
                        out.extend(self.rows.iter().map(|&(a, b, s)| s * w * (along(k, b) - along(k, a))));
                    }
                    out.extend(self.rows.iter().map(|&(a, b, s)| s * (values[b as usize] - values[a as usize])));
                    out
                })
                .collect();
            let j = DMatrix::from_vec(rows, per * m, columns.concat());
            let (mut hessian, mut gradient) = normal(&j, &r);
            if stiffness == 0.0 {
                // Fixed at the first iteration: one objective for all.
                let mean = (0..m).map(|i| hessian[(per * i + free, per * i + free)]).sum::<f64>() / m as f64;
                stiffness = SUM * mean;
            }
            let sum: f64 = particles.iter().map(|p| p.1).sum();
            for i in 0..m {
                let a = per * i + free;
                gradient[a] -= stiffness * (sum - 1.0);
                for k in 0..m {
                    hessian[(a, per * k + free)] += stiffness;
                }
                for k in 3..free {
                    let v = 1.0 / (PERSPECTIVE * PERSPECTIVE);
                    gradient[per * i + k] -= v * particles[i].0[k];
                    hessian[(per * i + k, per * i + k)] += v;
                }
            }
            let loss = data + extra(&particles, stiffness);
            let mean = hessian.diagonal().mean();
            let mut improved = false;
            for _ in 0..5 {
                let mut a = hessian.clone();
                for i in 0..per * m {
                    a[(i, i)] += damping * a[(i, i)] + 1e-9 * mean;
                }
                let Some(cholesky) = a.cholesky() else {
                    damping *= 10.0;
                    continue;
                };
                let d = cholesky.solve(&gradient);
                let trial: Vec<(Coordinates, f64)> = particles
                    .iter()
                    .enumerate()
                    .map(|(i, (c, w))| {
                        let mut c = *c;
                        for (k, v) in c.iter_mut().enumerate().take(free) {
                            *v += d[per * i + k].clamp(-0.7, 0.7);
                        }
                        (c, (w + d[per * i + free]).max(0.0))
                    })
                    .collect();
                let (next, value) = predict(&trial);
                let total = value + extra(&trial, stiffness);
                if total < loss {
                    improved = loss - total > 3e-4 * loss;
                    particles = trial;
                    (r, data) = (next, value);
                    damping = (damping * 0.3).max(1e-7);
                    break;
                }
                damping *= 6.0;
            }
            particles.retain(|p| p.1 > 1e-6);
            if !improved || particles.is_empty() {
                break;
            }
        }
        let poses = particles.iter().map(|(c, w)| chart.pose(c, *w)).collect();
        Tsf::new(chart.focal, poses).unwrap_or_else(|_| tsf.clone())
    }

    /// Latent irradiance under every pixel as the pose sees it, and its derivatives by the chart's coordinates.
    pub fn look(&self, chart: &Chart, pose: &Pose) -> (Vec<f32>, Vec<[f32; 5]>) {
        let inverse = pose.rotation(chart.focal).inverse();
        let (turn, inverse) = (Projection::new(self.back * inverse), Projection::new(inverse));
        let base = linear_part(&self.back);
        let t = DVec2::new(pose.t_x, pose.t_y);
        let (mut values, mut slopes) = (vec![0.0; self.pixels.len()], vec![[0.0; 5]; self.pixels.len()]);
        wide(
            #[inline(always)]
            || {
                for ((value, slope), q) in values.iter_mut().zip(&mut slopes).zip(&self.pixels) {
                    let (v, g) = cubic_with_gradient(self.latent, turn.of(*q - t) + self.origin);
                    let g = DVec2::new(f64::from(g[0]), f64::from(g[1]));
                    let (gx, gy) = (g.dot(base[0]), g.dot(base[1]));
                    *value = v;
                    // Where the pose moves to, the point that a pixel looks at moves away from.
                    for (s, m) in slope.iter_mut().zip(chart.motion(inverse.of(*q - t))) {
                        *s = (-(gx * m.x + gy * m.y)) as f32;
                    }
                }
            },
        );
        (values, slopes)
    }
}

/// Columns of the derivative of `h` at the centre.
fn linear_part(h: &DMat3) -> [DVec2; 2] {
    let o = project(h, DVec2::ZERO);
    [project(h, DVec2::X) - o, project(h, DVec2::Y) - o]
}

/// `aᵀ a` and `aᵀ b`, in parallel over blocks of rows.
pub(super) fn normal(a: &DMatrix<f32>, b: &[f32]) -> (DMatrix<f64>, DVector<f64>) {
    let n = a.ncols();
    let starts: Vec<usize> = (0..a.nrows()).step_by(2048).collect();
    let part = |s: usize| {
        let count = 2048.min(a.nrows() - s);
        let part = a.rows(s, count).clone_owned();
        let b = DVector::from_column_slice(&b[s..s + count]);
        (gram(&part), part.tr_mul(&b))
    };
    let parts: Vec<(DMatrix<f32>, DVector<f32>)> = starts.into_par_iter().map(part).collect();
    // One after another: the sum does not depend on which thread was first.
    let mut sum = (DMatrix::zeros(n, n), DVector::zeros(n));
    for (g, c) in parts {
        sum.0 += g.cast::<f64>();
        sum.1 += c.cast::<f64>();
    }
    sum
}
