//! The yardstick: K and Kᵀ of eq. (4) by the same algorithm (rotate once per angle, then shifted sums) on the CPU, in f32.
//!
//! Bands of rows run in parallel. A band's rotated rows stay in the cache while all taps of that angle are summed from them, and both
//! inner loops run over contiguous pixels, so that the compiler makes vector instructions of them: along a row of a rotation the whole
//! part of the displacement is constant for tens of pixels.

use glam::{DMat3, DVec2};
use rayon::prelude::*;
use unshaken::pose::project;
use unshaken::tsf::TapSet;

/// Rows of a band: the rotated rows of one channel (300 KB at 1024 px) fit the second-level cache.
const BAND: usize = 64;

struct Angle {
    inverse: DMat3,
    /// (dx, dy, weight).
    taps: Vec<(i32, i32, f32)>,
}

/// K of affine base warps with bilinear interpolation from a grid to the same grid; zero outside.
pub struct RotateShift {
    width: usize,
    height: usize,
    angles: Vec<Angle>,
    /// Largest shift, pixels.
    reach: i32,
}

/// Pixels of a row whose source has one whole displacement.
struct Segment {
    from: usize,
    to: usize,
    /// Source of pixel `from`, less the fraction.
    x: i32,
    y: i32,
}

/// A row's segments and fractions.
#[derive(Default)]
struct Row {
    fx: Vec<f32>,
    fy: Vec<f32>,
    segments: Vec<Segment>,
}

impl Row {
    /// Sources of the `count` pixels from (`x0`, `y`) on.
    fn trace(&mut self, inverse: &DMat3, centre: DVec2, x0: i32, y: i32, count: usize) {
        let q = DVec2::new(f64::from(x0), f64::from(y)) - centre;
        let d = project(inverse, q) - q;
        let (step_x, step_y) = ((inverse.x_axis.x - 1.0) as f32, inverse.x_axis.y as f32);
        let (d_x, d_y) = (d.x as f32, d.y as f32);
        self.fx.clear();
        self.fy.clear();
        self.segments.clear();
        self.fx.extend((0..count).map(|i| d_x + step_x * i as f32));
        self.fy.extend((0..count).map(|i| d_y + step_y * i as f32));
        let mut from = 0;
        while from < count {
            let (wx, wy) = (self.fx[from].floor(), self.fy[from].floor());
            // The displacement is linear in x: the segment ends where either part leaves its interval.
            let steps = |v: f32, w: f32, step: f32| {
                let left = if step > 0.0 { w + 1.0 - v } else { w - v };
                if step == 0.0 { f32::INFINITY } else { left / step }
            };
            let run = steps(self.fx[from], wx, step_x).min(steps(self.fy[from], wy, step_y)).min(count as f32) as usize;
            let mut to = (from + run.max(1)).min(count);
            while to > from + 1 && (self.fx[to - 1].floor() != wx || self.fy[to - 1].floor() != wy) {
                to -= 1;
            }
            for i in from..to {
                self.fx[i] -= wx;
                self.fy[i] -= wy;
            }
            self.segments.push(Segment { from, to, x: x0 + from as i32 + wx as i32, y: y + wy as i32 });
            from = to;
        }
    }
}

impl RotateShift {
    pub fn new(taps: &TapSet, width: usize, height: usize) -> Self {
        let angles = taps.bases.iter().enumerate().map(|(b, h)| Angle {
            inverse: h.inverse(),
            taps: taps.taps.iter().filter(|t| t.base == b).map(|t| (t.dx, t.dy, t.weight as f32)).collect(),
        });
        let reach = taps.taps.iter().map(|t| t.dx.abs().max(t.dy.abs())).max().unwrap_or(0);
        Self { width, height, angles: angles.collect(), reach }
    }

    fn centre(&self) -> DVec2 {
        DVec2::new(self.width as f64 - 1.0, self.height as f64 - 1.0) / 2.0
    }

    /// Row `y` of a plane, `None` outside.
    fn row<'a>(&self, plane: &'a [f32], y: i32) -> Option<&'a [f32]> {
        (y >= 0 && y < self.height as i32).then(|| &plane[y as usize * self.width..][..self.width])
    }

    /// K of each channel.
    pub fn forward(&self, latent: &[Vec<f32>; 3], out: &mut [Vec<f32>; 3]) {
        let (w, r) = (self.width, self.reach);
        let wide = w + 2 * r as usize;
        let [red, green, blue] = out;
        let bands = red.par_chunks_mut(BAND * w).zip(green.par_chunks_mut(BAND * w)).zip(blue.par_chunks_mut(BAND * w));
        bands.enumerate().for_each_init(
            || (Row::default(), [0; 3].map(|_| vec![0.0f32; wide * (BAND + 2 * r as usize)])),
            |(row, rotated), (band, ((red, green), blue))| {
                let mut out = [red, green, blue];
                let (y0, rows) = ((band * BAND) as i32, out[0].len() / w);
                out.iter_mut().for_each(|o| o.fill(0.0));
                for angle in &self.angles {
                    for j in 0..rows + 2 * r as usize {
                        row.trace(&angle.inverse, self.centre(), -r, y0 - r + j as i32, wide);
                        for (c, rotated) in rotated.iter_mut().enumerate() {
                            self.rotate(&latent[c], row, &mut rotated[j * wide..][..wide]);
                        }
                    }
                    for (out, rotated) in out.iter_mut().zip(&*rotated) {
                        for (j, target) in out.chunks_exact_mut(w).enumerate() {
                            let sources =
                                |t: &(i32, i32, f32)| (&rotated[(j as i32 + r - t.1) as usize * wide + (r - t.0) as usize..][..w], t.2);
                            sum_rows(&angle.taps, sources, target);
                        }
                    }
                }
            },
        );
    }

    /// One row of a rotated channel.
    fn rotate(&self, plane: &[f32], row: &Row, target: &mut [f32]) {
        let w = self.width as i32;
        for s in &row.segments {
            let (target, fx, fy) = (&mut target[s.from..s.to], &row.fx[s.from..s.to], &row.fy[s.from..s.to]);
            let n = target.len();
            if s.x >= 0 && s.x + (n as i32) < w && s.y >= 0 && s.y + 1 < self.height as i32 {
                let i = s.y as usize * self.width + s.x as usize;
                let (a, b) = (&plane[i..][..n + 1], &plane[i + self.width..][..n + 1]);
                for k in 0..n {
                    let top = a[k] + fx[k] * (a[k + 1] - a[k]);
                    let bottom = b[k] + fx[k] * (b[k + 1] - b[k]);
                    target[k] = top + fy[k] * (bottom - top);
                }
            } else {
                let at = |x: i32, y: i32| if x >= 0 && x < w { self.row(plane, y).map_or(0.0, |r| r[x as usize]) } else { 0.0 };
                for k in 0..n {
                    let (x, y) = (s.x + k as i32, s.y);
                    let top = at(x, y) + fx[k] * (at(x + 1, y) - at(x, y));
                    let bottom = at(x, y + 1) + fx[k] * (at(x + 1, y + 1) - at(x, y + 1));
                    target[k] = top + fy[k] * (bottom - top);
                }
            }
        }
    }

    /// Kᵀ of each channel.
    pub fn adjoint(&self, frame: &[Vec<f32>; 3], out: &mut [Vec<f32>; 3]) {
        let (w, h, r) = (self.width, self.height, self.reach);
        let wide = w + 2 * r as usize;
        // Rows that the rotations carry beyond a band.
        let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(i, j)| DVec2::new(i, j) * (self.centre() + f64::from(r)));
        let spread = self.angles.iter().flat_map(|a| corners.map(|q| (project(&a.inverse, q) - q).y.abs()));
        let halo = spread.fold(0.0, f64::max).ceil() as usize + 2;
        let tall = BAND + 2 * halo;
        let first = -r;
        let bands = (h + 2 * r as usize).div_ceil(BAND);
        let parts: Vec<[Vec<f32>; 3]> = (0..bands)
            .into_par_iter()
            .map_init(
                || (Row::default(), vec![0.0f32; wide]),
                |(row, shifted), band| {
                    let y0 = first + (band * BAND) as i32;
                    let rows = BAND.min(h + 2 * r as usize - band * BAND);
                    let mut part = [0; 3].map(|_| vec![0.0f32; w * tall]);
                    for angle in &self.angles {
                        for y in y0..y0 + rows as i32 {
                            row.trace(&angle.inverse, self.centre(), -r, y, wide);
                            for (frame, part) in frame.iter().zip(&mut part) {
                                shifted.fill(0.0);
                                for &(dx, dy, weight) in &angle.taps {
                                    if let Some(source) = self.row(frame, y + dy) {
                                        let target = &mut shifted[(r - dx) as usize..][..w];
                                        for (t, s) in target.iter_mut().zip(source) {
                                            *t += weight * s;
                                        }
                                    }
                                }
                                self.scatter(shifted, row, part, y0 - halo as i32);
                            }
                        }
                    }
                    part
                },
            )
            .collect();
        for (c, out) in out.iter_mut().enumerate() {
            out.par_chunks_mut(w).enumerate().for_each(|(y, target)| {
                target.fill(0.0);
                for (band, part) in parts.iter().enumerate() {
                    let j = y as i32 - (first + (band * BAND) as i32 - halo as i32);
                    if j >= 0 && (j as usize) < tall {
                        for (t, s) in target.iter_mut().zip(&part[c][j as usize * w..][..w]) {
                            *t += s;
                        }
                    }
                }
            });
        }
    }

    /// Adds one row's transposed rotation to a part whose first row is `first`.
    fn scatter(&self, source: &[f32], row: &Row, part: &mut [f32], first: i32) {
        let w = self.width as i32;
        for s in &row.segments {
            let (source, fx, fy) = (&source[s.from..s.to], &row.fx[s.from..s.to], &row.fy[s.from..s.to]);
            let n = source.len();
            for (y, lower) in [(s.y, false), (s.y + 1, true)] {
                if y < 0 || y >= self.height as i32 {
                    continue;
                }
                let line = &mut part[(y - first) as usize * self.width..][..self.width];
                let weight = |k: usize| if lower { fy[k] } else { 1.0 - fy[k] };
                if s.x >= 0 && s.x + (n as i32) < w {
                    let line = &mut line[s.x as usize..][..n + 1];
                    for k in 0..n {
                        line[k] += weight(k) * (1.0 - fx[k]) * source[k];
                    }
                    for k in 0..n {
                        line[k + 1] += weight(k) * fx[k] * source[k];
                    }
                } else {
                    for k in 0..n {
                        for (x, f) in [(s.x + k as i32, 1.0 - fx[k]), (s.x + k as i32 + 1, fx[k])] {
                            if x >= 0 && x < w {
                                line[x as usize] += weight(k) * f * source[k];
                            }
                        }
                    }
                }
            }
        }
    }
}

/// `target += Σ weight * source`, four sources at a time so that the target is read and written a quarter as often.
fn sum_rows<'a>(taps: &[(i32, i32, f32)], source: impl Fn(&(i32, i32, f32)) -> (&'a [f32], f32), target: &mut [f32]) {
    let mut rest = taps;
    while let [a, b, c, d, tail @ ..] = rest {
        let [(a, wa), (b, wb), (c, wc), (d, wd)] = [a, b, c, d].map(&source);
        for (i, t) in target.iter_mut().enumerate() {
            *t += wa * a[i] + wb * b[i] + wc * c[i] + wd * d[i];
        }
        rest = tail;
    }
    for (s, w) in rest.iter().map(source) {
        for (t, s) in target.iter_mut().zip(s) {
            *t += w * s;
        }
    }
}
