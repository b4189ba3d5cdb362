//! TSFs by cross-validation: one step towards explaining pixels of the frames that the latent irradiance has not seen.
//!
//! Fitted to a latent irradiance that was solved from the same pixels, TSFs make up for what that irradiance has of the smoothness that is asked of
//! it, and it for them: from the true TSFs the two wander away. Pixels that it has not seen are not explained by that, and how their squared
//! residuals change with the poses, everything that the irradiance does then included, costs one more solve (the adjoint state of
//! [`crate::blind`]'s luminance).

use super::Tsf;
use super::continuous::{Evidence, SUM, normal};
use super::estimate::{gathered, model_of};
use super::model::{Chart, Coordinates};
use crate::image::Plane;
use crate::pose::Pose;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// What the pixels of one frame that the latent irradiance has not seen say about the frame's blur K: half the sum of their weighted squared residuals
/// changes by `-<dK E, direct> - <dK P, through>`.
pub struct Unseen {
    /// W r there, less what follows from it where the irradiance is known from: W K P. On the frame's grid.
    pub direct: Plane,
    /// W r at the pixels that the irradiance was solved from.
    pub through: Plane,
    /// W at the pixels that it was not: the inverse variance, 0 elsewhere.
    pub weight: Plane,
}

/// The latent irradiance E of a step, and the sensitivity P of the residuals to it, both on the frame's grid plus `pad` pixels on every side.
pub struct Latent<'a> {
    /// E.
    pub irradiance: &'a Plane,
    /// P.
    pub sensitivity: &'a Plane,
    /// Pad in pixels.
    pub pad: usize,
}

/// Poses that a TSF has at least before its first step: fewer cannot lie along a path of some length as finely as a frame tells.
const FINE: usize = 40;
/// Farthest that the halves of a pose are put from where it was, in pixels.
const APART: f64 = 0.4;
/// Part of the step that a Hessian of the unseen pixels proposes, and of the last step that is kept.
const RATE: f64 = 0.2;
const MOMENTUM: f64 = 0.8;
/// Factors on a stride when the residuals still fall the way that the last step went, when they do not any more, and when they have risen.
const LONGER: f64 = 1.15;
const SHORTER: f64 = 0.7;
const SHORTENED: f64 = 0.3;
/// Damping as a part of the Hessian's diagonal.
const DAMPING: f64 = 0.1;
/// Farthest that a pose goes in one step, in pixels.
const STEP: f64 = 0.3;

/// `tsf` on frames of `size` in so many poses that they can follow what a frame tells: heavy ones are halved along the way to their nearest neighbours.
pub fn divided(tsf: &Tsf, size: (usize, usize)) -> Tsf {
    let chart = Chart::new(model_of(tsf), tsf.focal_px, size.0, size.1);
    let Some(few) = gathered(tsf, &chart) else { return tsf.clone() };
    let mut poses: Vec<(Coordinates, f64)> = few.poses.iter().map(|p| (chart.coordinates(p), p.weight)).collect();
    while poses.len() < FINE && poses.len() > 1 {
        let distance = |a: &Coordinates, b: &Coordinates| a.iter().zip(b).map(|(x, y)| (x - y).powi(2)).sum::<f64>().sqrt();
        let halves = |(i, (c, w)): (usize, &(Coordinates, f64))| {
            let others = poses.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, o)| o.0);
            let near = others.min_by(|a, b| distance(a, c).total_cmp(&distance(b, c))).unwrap_or(*c);
            let d = distance(&near, c);
            let part = if d > 0.0 { (0.25 * d).min(APART) / d } else { 0.0 };
            [part, -part].map(|f| (std::array::from_fn(|k| c[k] + f * (near[k] - c[k])), 0.5 * w))
        };
        poses = poses.iter().enumerate().flat_map(halves).collect();
    }
    let poses = poses.iter().map(|(c, w)| chart.pose(c, *w)).collect();
    Tsf::new(tsf.focal_px, poses).map_or_else(|_| tsf.clone(), |t| t.about(tsf.base))
}

/// How the TSF of a frame goes on.
pub struct Stride {
    /// The last step: coordinates and weight of each pose; empty at first.
    velocity: Vec<f64>,
    /// Part of a full step, 0..=1.
    rate: f64,
}

impl Stride {
    /// From rest, so much of a full step (0..=1) at first.
    pub fn new(rate: f64) -> Self {
        Self { velocity: Vec::new(), rate }
    }

    /// From rest again, and slower.
    pub fn shorten(&mut self) {
        self.velocity.clear();
        self.rate *= SHORTENED;
    }
}

impl Unseen {
    /// `tsf` one step on. The number of poses stays.
    pub fn step(&self, latent: &Latent, tsf: &Tsf, stride: &mut Stride) -> Tsf {
        let (w, h) = self.weight.size();
        let chart = Chart::new(model_of(tsf), tsf.focal_px, w, h);
        let (free, count) = (chart.free(), tsf.poses.len());
        let per = free + 1;
        let (descent, mut hessian) = self.slopes(latent, tsf, &chart);
        let mean = |of: &dyn Fn(usize) -> bool| {
            let all: Vec<f64> = (0..per * count).filter(|i| of(i % per)).map(|i| hessian[(i, i)]).collect();
            all.iter().sum::<f64>() / all.len() as f64
        };
        let (motion, weight) = (mean(&|k| k < free), mean(&|k| k == free));
        for i in 0..per * count {
            let level = if i % per < free { hessian[(i, i)] + motion } else { weight };
            hessian[(i, i)] += DAMPING * level + f64::MIN_POSITIVE;
            if i % per == free {
                for k in 0..count {
                    hessian[(i, per * k + free)] += SUM * weight;
                }
            }
        }
        let Some(proposed) = hessian.cholesky().map(|c| c.solve(&descent)) else { return tsf.clone() };
        if stride.velocity.is_empty() {
            stride.velocity.resize(per * count, 0.0);
        } else {
            let falls = stride.velocity.iter().zip(&descent).map(|(v, d)| v * d).sum::<f64>() > 0.0;
            stride.rate = (stride.rate * if falls { LONGER } else { SHORTER }).min(1.0);
        }
        for (v, p) in stride.velocity.iter_mut().zip(&proposed) {
            *v = MOMENTUM * *v + stride.rate * RATE * p;
        }
        let poses = tsf.poses.iter().zip(stride.velocity.chunks_exact_mut(per)).map(|(pose, v)| {
            let mut c = chart.coordinates(pose);
            c.iter_mut().zip(&*v).take(free).for_each(|(c, v)| *c += v.clamp(-STEP, STEP));
            // Not to nothing: it may come back.
            let least = 1e-3 / count as f64;
            if pose.weight + v[free] < least {
                v[free] = 0.0;
                return chart.pose(&c, least);
            }
            chart.pose(&c, pose.weight + v[free])
        });
        Tsf::new(tsf.focal_px, poses.collect()).map_or_else(|_| tsf.clone(), |t| t.about(tsf.base))
    }

    /// The negative gradient by coordinates and weight of each pose of `tsf`, and the Hessian (Gauss-Newton) of the unseen pixels, the irradiance held.
    fn slopes(&self, latent: &Latent, tsf: &Tsf, chart: &Chart) -> (DVector<f64>, DMatrix<f64>) {
        let (w, h) = self.weight.size();
        let free = chart.free();
        let scene = Evidence::of_pixels(latent.irradiance, latent.pad, tsf.base, (w, h));
        let sensitivity = Evidence::of_pixels(latent.sensitivity, latent.pad, tsf.base, (w, h));
        let unseen: Vec<(usize, f32)> =
            (0..w * h).filter(|&p| self.weight.data[p] > 0.0).map(|p| (p, self.weight.data[p].sqrt())).collect();
        let of = |pose: &Pose| {
            let ((e, along), (s, through)) = (scene.look(chart, pose), sensitivity.look(chart, pose));
            let pulls = self.direct.data.iter().zip(&self.through.data);
            let mut descent = vec![0.0f64; free + 1];
            for (((a, b), (e, along)), (s, through)) in pulls.zip(e.iter().zip(&along)).zip(s.iter().zip(&through)) {
                for k in 0..free {
                    descent[k] += pose.weight * f64::from(a * along[k] + b * through[k]);
                }
                descent[free] += f64::from(a * e + b * s);
            }
            let weight = pose.weight as f32;
            let mut columns: Vec<f32> =
                (0..free).flat_map(|k| unseen.iter().map(move |&(p, s)| (k, p, s))).map(|(k, p, s)| s * weight * along[p][k]).collect();
            columns.extend(unseen.iter().map(|&(p, s)| s * e[p]));
            (descent, columns)
        };
        let (descents, columns): (Vec<Vec<f64>>, Vec<Vec<f32>>) = tsf.poses.par_iter().map(of).unzip();
        let jacobian = DMatrix::from_vec(unseen.len(), (free + 1) * tsf.poses.len(), columns.concat());
        let (hessian, _) = normal(&jacobian, &vec![0.0; unseen.len()]);
        (DVector::from_vec(descents.concat()), hessian)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    /// Against what the poses, a little to each side, make of scene and sensitivity where these are known between pixels too.
    #[test]
    fn slopes_are_those_of_the_blurred_scene() {
        let (size, pad) = ((40, 31), 8);
        let (w, h) = (size.0 + 2 * pad, size.1 + 2 * pad);
        let wave = |x: f64, y: f64, a: f64, b: f64| 1.0 + 0.5 * (a * x).sin() * (b * y + 0.1 * x).cos();
        let scene = |x: f64, y: f64| wave(x, y, 0.5, 0.4);
        let sensitivity = |x: f64, y: f64| wave(x, y, 0.3, 0.6) - 1.0;
        let sampled = |of: &(dyn Fn(f64, f64) -> f64 + Sync)| Plane::from_fn(w, h, |x, y| of(x as f64, y as f64) as f32);
        let inner = |x: usize, y: usize| x >= 6 && y >= 6 && x + 6 < size.0 && y + 6 < size.1;
        let plane =
            |f: &(dyn Fn(usize, usize) -> f32 + Sync)| Plane::from_fn(size.0, size.1, |x, y| if inner(x, y) { f(x, y) } else { 0.0 });
        let unseen = Unseen {
            direct: plane(&|x, y| ((x * 7 + y * 3) % 5) as f32 - 2.0),
            through: plane(&|x, y| ((x * 3 + y * 5) % 7) as f32 - 3.0),
            weight: plane(&|x, y| f32::from(u8::from((2 * x + y) % 5 == 0))),
        };
        let tsf = Tsf::new(60.0, vec![Pose::planar(-1.3, 0.4, 0.8, 0.4), Pose::planar(0.7, -0.6, -0.5, 0.6)]).unwrap();
        let chart = Chart::new(model_of(&tsf), tsf.focal_px, size.0, size.1);
        let latent = Latent { irradiance: &sampled(&scene), sensitivity: &sampled(&sensitivity), pad };
        let (descent, hessian) = unseen.slopes(&latent, &tsf, &chart);
        let places: Vec<(Coordinates, f64)> = tsf.poses.iter().map(|p| (chart.coordinates(p), p.weight)).collect();
        let step = 0.05;
        // The pose `i`, its number `k` moved by `by`; a weight alone, whatever the sum.
        let blurred = |i: usize, k: usize, by: f64, of: &dyn Fn(f64, f64) -> f64| -> Vec<f64> {
            let mut sum = vec![0.0; size.0 * size.1];
            for (j, (mut c, mut weight)) in places.iter().copied().enumerate() {
                if i == j && k < 3 {
                    c[k] += by;
                } else if i == j {
                    weight += by;
                }
                let pose = chart.pose(&c, 1.0);
                let (sin, cos) = pose.theta_z_deg.to_radians().sin_cos();
                let centre = DVec2::new((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
                for (n, s) in sum.iter_mut().enumerate() {
                    let q = DVec2::new((n % size.0) as f64, (n / size.0) as f64) - centre - DVec2::new(pose.t_x, pose.t_y);
                    let p = DVec2::new(cos * q.x + sin * q.y, cos * q.y - sin * q.x) + centre + DVec2::splat(pad as f64);
                    *s += weight * of(p.x, p.y);
                }
            }
            sum
        };
        let slope = |i: usize, k: usize, of: &dyn Fn(f64, f64) -> f64| -> Vec<f64> {
            let (ahead, behind) = (blurred(i, k, step, of), blurred(i, k, -step, of));
            ahead.iter().zip(&behind).map(|(a, b)| (a - b) / (2.0 * step)).collect()
        };
        let dot = |a: &[f64], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * f64::from(*b)).sum::<f64>();
        let largest = descent.amax();
        for (n, (i, k)) in (0..2).flat_map(|i| (0..4).map(move |k| (i, k))).enumerate() {
            let (e, s) = (slope(i, k, &scene), slope(i, k, &sensitivity));
            let expected = dot(&e, &unseen.direct.data) + dot(&s, &unseen.through.data);
            assert!((descent[n] - expected).abs() < 0.02 * largest, "pose {i}, number {k}: {} for {expected}", descent[n]);
            let curvature: f64 = e.iter().zip(&unseen.weight.data).map(|(e, w)| e * e * f64::from(*w)).sum();
            assert!((hessian[(n, n)] - curvature).abs() < 0.08 * curvature, "pose {i}, number {k}: {} for {curvature}", hessian[(n, n)]);
        }
    }

    #[test]
    fn a_divided_tsf_blurs_as_before() {
        let size = (200, 150);
        let path = |t: f64| Pose::planar(6.0 * t, 2.0 * (3.0 * t).sin(), 0.3 * t, 1.0);
        let tsf = Tsf::new(240.0, (0..9).map(|i| path(f64::from(i) / 4.0 - 1.0)).collect()).unwrap();
        let fine = divided(&tsf, size);
        assert!(fine.poses.len() >= FINE, "{} poses", fine.poses.len());
        let (a, b) = (tsf.mean(), fine.mean());
        assert!((a.t_x - b.t_x).hypot(a.t_y - b.t_y) < 0.05, "{a:?} and {b:?}");
        let (a, b) = (tsf.covariance(), fine.covariance());
        assert!((a - b).to_cols_array().iter().all(|d| d.abs() < 0.5), "{a} and {b}");
        // One pose has no neighbour to be halved towards.
        assert_eq!(divided(&Tsf::identity(), size).poses.len(), 1);
    }
}
