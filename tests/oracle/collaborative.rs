//! Collaborative filtering in f64: every distance in full, one 64 n x 64 n transform per stack written as sums of products of basis
//! functions, coefficients one by one.

use std::f64::consts::PI;

const SIDE: usize = 8;
const STEP: usize = 3;
const REACH: i64 = 12;

/// Planes of one size.
#[derive(Clone)]
pub struct Planes {
    pub width: usize,
    pub height: usize,
    /// Channel, then pixel.
    pub values: Vec<Vec<f64>>,
}

impl Planes {
    fn at(&self, c: usize, x: usize, y: usize) -> f64 {
        self.values[c][y.min(self.height - 1) * self.width + x.min(self.width - 1)]
    }
}

/// Power of a frame at the 64 frequencies of the patch whose first pixel is (x, y).
pub type Power = Box<dyn Fn(usize, usize) -> Vec<f64>>;

/// Inverse variances: of what is seen sharp and in place; of each other frame with its power.
pub struct Precision {
    pub white: Planes,
    pub blurred: Vec<(Planes, Power)>,
}

const MIX: [[f64; 3]; 3] = [[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]];

fn mix(c: usize, i: usize) -> f64 {
    MIX[c][i] / [3f64, 2.0, 6.0][c].sqrt()
}

fn cosine(k: usize, i: usize) -> f64 {
    let a: f64 = if k == 0 { 0.125 } else { 0.25 };
    a.sqrt() * (PI * (2 * i + 1) as f64 * k as f64 / 16.0).cos()
}

fn cosines() -> Vec<Vec<f64>> {
    (0..8).map(|k| (0..8).map(|i| cosine(k, i)).collect()).collect()
}

/// Value at `i` of the Haar function `k` on `n` places: 0 the mean, 1 the coarsest difference, then ever finer ones.
fn haar(n: usize, k: usize, i: usize) -> f64 {
    if k == 0 {
        return 1.0 / (n as f64).sqrt();
    }
    let level = k.ilog2();
    let (long, which) = (n >> level, k - (1 << level));
    if i / long != which {
        return 0.0;
    }
    let sign = if i % long < long / 2 { 1.0 } else { -1.0 };
    sign / (long as f64).sqrt()
}

/// I₀ by its integral.
fn bessel(x: f64) -> f64 {
    let n = 2000;
    (0..n).map(|i| (x * (PI * (f64::from(i) + 0.5) / f64::from(n)).cos()).exp()).sum::<f64>() / f64::from(n)
}

fn kaiser(i: usize) -> f64 {
    let r = (2.0 * i as f64 - 7.0) / 7.0;
    bessel(2.0 * (1.0 - r * r).max(0.0).sqrt()) / bessel(2.0)
}

fn starts(length: usize) -> Vec<usize> {
    (0..=length - SIDE).filter(|s| s % STEP == 0 || *s == length - SIDE).collect()
}

/// Coefficients of a stack: index (frequency of the stack, vertical, horizontal).
fn analyse(stack: &[Vec<f64>]) -> Vec<f64> {
    let n = stack.len();
    let mut out = Vec::new();
    let cosines = cosines();
    // The DCT of each patch first: the sums over all three dimensions at once would take hours.
    let patches: Vec<Vec<f64>> = stack
        .iter()
        .map(|p| (0..64).map(|k| (0..64).map(|i| cosines[k / 8][i / 8] * cosines[k % 8][i % 8] * p[i]).sum()).collect())
        .collect();
    for h in 0..n {
        out.extend((0..64).map(|k| patches.iter().enumerate().map(|(i, p)| haar(n, h, i) * p[k]).sum::<f64>()));
    }
    out
}

fn synthesise(coefficients: &[f64]) -> Vec<Vec<f64>> {
    let n = coefficients.len() / 64;
    let cosines = cosines();
    (0..n)
        .map(|i| {
            let patch: Vec<f64> = (0..64).map(|k| (0..n).map(|h| haar(n, h, i) * coefficients[64 * h + k]).sum()).collect();
            (0..64).map(|p| (0..64).map(|k| cosines[k / 8][p / 8] * cosines[k % 8][p % 8] * patch[k]).sum()).collect()
        })
        .collect()
}

fn pass(noisy: &Planes, basic: Option<&Planes>, precision: &Precision, strength: f64) -> Planes {
    let (w, h) = (noisy.width, noisy.height);
    let guide = basic.unwrap_or(noisy);
    let window: Vec<f64> = (0..8).map(kaiser).collect();
    let cut = |from: &Planes, c: usize, x: usize, y: usize| -> Vec<f64> { (0..64).map(|i| from.at(c, x + i % 8, y + i / 8)).collect() };
    let (mut sum, mut weights) = (vec![vec![0.0; w * h]; 3], vec![vec![0.0; w * h]; 3]);
    for y in starts(h) {
        for x in starts(w) {
            let own = cut(guide, 0, x, y);
            let mut found: Vec<(f64, usize, usize)> = Vec::new();
            for j in 0..=h - SIDE {
                for i in 0..=w - SIDE {
                    if (i as i64 - x as i64).abs() <= REACH && (j as i64 - y as i64).abs() <= REACH {
                        let d: f64 = cut(guide, 0, i, j).iter().zip(&own).map(|(a, b)| (a - b) * (a - b)).sum();
                        found.push((if (i, j) == (x, y) { -1.0 } else { d }, i, j));
                    }
                }
            }
            found.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut n = 1;
            while 2 * n <= found.len().min(if basic.is_some() { 32 } else { 16 }) {
                n *= 2;
            }
            found.truncate(n);
            for c in 0..3 {
                let mean = |p: &Planes, i: usize| cut(p, i, x, y).iter().sum::<f64>() / 64.0;
                let variance: Vec<f64> = (0..64)
                    .map(|k| {
                        let channel = |i: usize| {
                            let blurred = precision.blurred.iter().map(|(p, power)| mean(p, i) * power(x, y)[k]).sum::<f64>();
                            let p = mean(&precision.white, i) + blurred;
                            strength * strength / p.max(1.0)
                        };
                        (0..3).map(|i| mix(c, i).powi(2) * channel(i)).sum()
                    })
                    .collect();
                let stack = |from: &Planes| analyse(&found.iter().map(|&(_, i, j)| cut(from, c, i, j)).collect::<Vec<_>>());
                let mut coefficients = stack(noisy);
                let known = basic.map(stack);
                let mut left = 0.0;
                for (i, value) in coefficients.iter_mut().enumerate() {
                    let gain = match &known {
                        Some(known) => known[i].powi(2) / (known[i].powi(2) + variance[i % 64]),
                        None if i == 0 || value.abs() > 2.7 * variance[i % 64].sqrt() => 1.0,
                        None => 0.0,
                    };
                    *value *= gain;
                    left += gain * gain * variance[i % 64];
                }
                for (patch, &(_, i, j)) in synthesise(&coefficients).iter().zip(&found) {
                    for (k, value) in patch.iter().enumerate() {
                        let at = (j + k / 8) * w + i + k % 8;
                        let weight = window[k / 8] * window[k % 8] / left;
                        sum[c][at] += weight * value;
                        weights[c][at] += weight;
                    }
                }
            }
        }
    }
    let values = (0..3).map(|c| (0..w * h).map(|i| sum[c][i] / weights[c][i]).collect()).collect();
    Planes { width: w, height: h, values }
}

fn enlarged(p: &Planes) -> Planes {
    let (width, height) = (p.width.max(SIDE), p.height.max(SIDE));
    let values = (0..3).map(|c| (0..width * height).map(|i| p.at(c, i % width, i / width)).collect()).collect();
    Planes { width, height, values }
}

/// Both passes; images smaller than a patch with their last pixels repeated.
pub fn filtered(log: &Planes, precision: Precision, strength: f64) -> Planes {
    let large = enlarged(log);
    let blurred = precision.blurred.into_iter().map(|(p, power)| (enlarged(&p), power)).collect();
    let precision = Precision { white: enlarged(&precision.white), blurred };
    let n = large.width * large.height;
    let mixed: Vec<Vec<f64>> = (0..3).map(|c| (0..n).map(|i| (0..3).map(|k| mix(c, k) * large.values[k][i]).sum()).collect()).collect();
    let noisy = Planes { values: mixed, ..large };
    let basic = pass(&noisy, None, &precision, strength);
    let done = pass(&noisy, Some(&basic), &precision, strength);
    let back = |c: usize, x: usize, y: usize| (0..3).map(|k| mix(k, c) * done.at(k, x, y)).sum();
    let values = (0..3).map(|c| (0..log.width * log.height).map(|i| back(c, i % log.width, i / log.width)).collect()).collect();
    Planes { width: log.width, height: log.height, values }
}
