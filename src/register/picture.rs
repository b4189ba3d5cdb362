//! What registration looks at: luminance irradiance with its noise, at several sizes, on a logarithmic scale.

use crate::exposure::Frame;
use crate::image::{Channels, Plane, Rgb};
use crate::mask;
use crate::noise;
use crate::pose::project;
use crate::sampling::bilinear;
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Luminance irradiance, its variance, and which pixels count.
#[derive(Clone)]
pub(super) struct Picture {
    pub irradiance: Plane,
    pub variance: Plane,
    /// 1 where the pixel is not clipped, 0 elsewhere.
    pub valid: Plane,
    /// Variance of a black pixel.
    pub black: f64,
    /// Pixels of the frame per pixel of this picture, and the frame's position (centred) of this picture's centre.
    pub scale: f64,
    pub origin: DVec2,
}

impl Picture {
    /// The whole frame.
    pub(super) fn of(frame: &Frame, exposure: &Rgb, curves: &[Vec<f32>; 3]) -> Self {
        let dt = frame.exposure_time;
        let mean = exposure.mean();
        let clipped = mask::clipped(frame, Channels::ALL);
        // Rounding included: in the shadows of 8-bit files it is larger than the noise itself.
        let noise = noise::of_mean(curves);
        let variance = |x: f32| f64::from(noise::at(&noise, x)) / (dt * dt);
        Self {
            variance: mean.map(|v| variance(v) as f32),
            valid: Plane { data: clipped.iter().map(|&c| if c { 0.0 } else { 1.0 }).collect(), ..mean },
            black: variance(0.0),
            irradiance: mean.map(|v| (f64::from(v) / dt) as f32),
            scale: 1.0,
            origin: DVec2::ZERO,
        }
    }

    pub(super) fn size(&self) -> (usize, usize) {
        self.irradiance.size()
    }

    /// Half the size, means of 2 x 2 pixels.
    pub(super) fn halved(&self) -> Self {
        let (w, h) = self.size();
        let (w2, h2) = ((w / 2).max(1), (h / 2).max(1));
        let four = |p: &Plane, x: usize, y: usize| {
            [p.at(2 * x, 2 * y), p.at(2 * x + 1, 2 * y), p.at(2 * x, 2 * y + 1), p.at(2 * x + 1, 2 * y + 1)]
        };
        let mean = |p: &Plane, k: f32| Plane::from_fn(w2, h2, |x, y| k * four(p, x, y).iter().sum::<f32>());
        let centre = DVec2::new(w2 as f64 - 0.5 * w as f64, h2 as f64 - 0.5 * h as f64);
        Self {
            irradiance: mean(&self.irradiance, 0.25),
            variance: mean(&self.variance, 1.0 / 16.0),
            valid: Plane::from_fn(w2, h2, |x, y| if four(&self.valid, x, y).contains(&0.0) { 0.0 } else { 1.0 }),
            black: 0.25 * self.black,
            scale: 2.0 * self.scale,
            origin: self.origin + self.scale * centre,
        }
    }

    /// `a` (frame from frame, centred pixels of the whole frame) in this picture's centred pixels.
    pub(super) fn local(&self, a: &DMat3) -> DMat3 {
        let s = self.to_frame();
        s.inverse() * *a * s
    }

    /// The other way round.
    pub(super) fn global(&self, a: &DMat3) -> DMat3 {
        let s = self.to_frame();
        s * *a * s.inverse()
    }

    fn to_frame(&self) -> DMat3 {
        DMat3::from_cols(DVec3::new(self.scale, 0.0, 0.0), DVec3::new(0.0, self.scale, 0.0), self.origin.extend(1.0))
    }

    /// The picture as seen from the reference's grid, `a` being the motion from there to here in this picture's pixels.
    pub(super) fn on_reference(&self, a: &DMat3) -> Self {
        let (w, h) = self.size();
        let mut out = self.clone();
        let centre = DVec2::new(0.5 * (w as f64 - 1.0), 0.5 * (h as f64 - 1.0));
        for y in 0..h {
            for x in 0..w {
                let q = project(a, DVec2::new(x as f64, y as f64) - centre) + centre;
                let i = y * w + x;
                out.valid.data[i] = if all_valid(&self.valid, q) { 1.0 } else { 0.0 };
                out.irradiance.data[i] = bilinear(&self.irradiance, q);
                out.variance.data[i] = nearest(&self.variance, q);
            }
        }
        out
    }

    /// Adds another picture on the same grid: inverse-variance mean.
    pub(super) fn add(&mut self, other: &Self) {
        for i in 0..self.irradiance.data.len() {
            let (a, b) = (self.valid.data[i] > 0.0, other.valid.data[i] > 0.0);
            if !b {
                continue;
            }
            if !a {
                self.irradiance.data[i] = other.irradiance.data[i];
                self.variance.data[i] = other.variance.data[i];
                self.valid.data[i] = 1.0;
                continue;
            }
            let (v, u) = (self.variance.data[i], other.variance.data[i]);
            self.irradiance.data[i] = (self.irradiance.data[i] * u + other.irradiance.data[i] * v) / (u + v);
            self.variance.data[i] = u * v / (u + v);
        }
        // Where one of the two does not see, the better of them still does.
        self.black = self.black.min(other.black);
    }

    /// Logarithmic picture; `black` is the variance below which the scale is linear.
    pub(super) fn tone(&self, black: f64) -> Tone {
        let (w, h) = self.size();
        let (smooth, valid) = binomial(&self.irradiance, &self.valid);
        let s2 = (4.0 * black * BINOMIAL_NOISE) as f32;
        let s = s2.sqrt();
        let value = smooth.map(|e| (e / s).asinh());
        let variance = Plane {
            data: (0..w * h).map(|i| self.variance.data[i] * BINOMIAL_NOISE as f32 / (smooth.data[i] * smooth.data[i] + s2)).collect(),
            ..value
        };
        Tone { value, variance, valid }
    }
}

/// Sum of the squared weights of the 3 x 3 binomial filter.
const BINOMIAL_NOISE: f64 = 0.140_625;

/// 3 x 3 binomial mean over valid pixels; valid where all nine are (at the edge, those that exist).
fn binomial(plane: &Plane, valid: &Plane) -> (Plane, Plane) {
    let w = plane.width;
    let mut out = plane.clone();
    let mut sure = valid.clone();
    out.data.par_chunks_exact_mut(w).zip(sure.data.par_chunks_exact_mut(w)).enumerate().for_each(|(y, (row, sure))| {
        for x in 0..w {
            let (mut sum, mut total, mut all) = (0.0, 0.0, true);
            for (j, b) in [(-1isize, 1.0f32), (0, 2.0), (1, 1.0)] {
                for (i, a) in [(-1isize, 1.0f32), (0, 2.0), (1, 1.0)] {
                    let v = valid.clamped(x as isize + i, y as isize + j);
                    all &= v > 0.0;
                    sum += a * b * v * plane.clamped(x as isize + i, y as isize + j);
                    total += a * b * v;
                }
            }
            if total > 0.0 {
                row[x] = sum / total;
            }
            sure[x] = if all { 1.0 } else { 0.0 };
        }
    });
    (out, sure)
}

/// A picture on a logarithmic scale, with the variance of it.
#[derive(Clone)]
pub(super) struct Tone {
    pub value: Plane,
    pub variance: Plane,
    pub valid: Plane,
}

impl Tone {
    pub(super) fn size(&self) -> (usize, usize) {
        self.value.size()
    }

    /// This picture, means over squares of side 2 r + 1.
    pub(super) fn softened(&self, r: usize) -> Self {
        let ones = self.value.map(|_| 1.0);
        let value = self.value.box_sum(r).zip(&ones.box_sum(r), |s, n| s / n);
        Self { value, ..self.clone() }
    }

    /// This picture as seen from the reference's grid (bicubic: bilinear smooths noise where a shift is half a pixel, which draws
    /// the search there).
    pub(super) fn on_reference(&self, a: &DMat3) -> Self {
        let (w, h) = self.size();
        let centre = DVec2::new(0.5 * (w as f64 - 1.0), 0.5 * (h as f64 - 1.0));
        let mut out = self.clone();
        let planes = out.value.data.par_chunks_exact_mut(w).zip(out.variance.data.par_chunks_exact_mut(w));
        planes.zip(out.valid.data.par_chunks_exact_mut(w)).enumerate().for_each(|(y, ((value, variance), valid))| {
            for x in 0..w {
                let q = project(a, DVec2::new(x as f64, y as f64) - centre) + centre;
                if all_valid(&self.valid, q) {
                    value[x] = bicubic(&self.value, q);
                    variance[x] = nearest(&self.variance, q);
                    valid[x] = 1.0;
                } else {
                    valid[x] = 0.0;
                }
            }
        });
        out
    }
}

/// Whether the four pixels around `q` exist and are valid.
fn all_valid(valid: &Plane, q: DVec2) -> bool {
    let (w, h) = valid.size();
    if !(q.x >= 0.0 && q.y >= 0.0 && q.x <= w as f64 - 1.0 && q.y <= h as f64 - 1.0) {
        return false;
    }
    let (x, y) = (q.x as usize, q.y as usize);
    let (r, d) = ((x + 1).min(w - 1), (y + 1).min(h - 1));
    valid.at(x, y) > 0.0 && valid.at(r, y) > 0.0 && valid.at(x, d) > 0.0 && valid.at(r, d) > 0.0
}

fn nearest(p: &Plane, q: DVec2) -> f32 {
    p.clamped(q.x.round() as isize, q.y.round() as isize)
}

/// Keys' cubic convolution, a = -1/2.
fn bicubic(p: &Plane, q: DVec2) -> f32 {
    let (x, y) = (q.x.floor(), q.y.floor());
    let weights = |t: f32| {
        [((-0.5 * t + 1.0) * t - 0.5) * t, (1.5 * t - 2.5) * t * t + 1.0, ((-1.5 * t + 2.0) * t + 0.5) * t, (0.5 * t - 0.5) * t * t]
    };
    let (wx, wy) = (weights((q.x - x) as f32), weights((q.y - y) as f32));
    let mut sum = 0.0;
    for (j, b) in wy.iter().enumerate() {
        for (i, a) in wx.iter().enumerate() {
            sum += a * b * p.clamped(x as isize + i as isize - 1, y as isize + j as isize - 1);
        }
    }
    sum
}
