//! Seeded random numbers: uniform, normal, Poisson.

use crate::maths::Portable;
use rand::RngExt;
use rand_pcg::Pcg64;

/// A reproducible source of random numbers.
#[derive(Clone)]
pub struct Random(Pcg64);

impl Random {
    /// Source number `stream` of `seed`; different streams are independent.
    pub fn new(seed: u64, stream: u64) -> Self {
        Self(Pcg64::new(u128::from(seed) ^ 0x9e37_79b9_7f4a_7c15_f39c_c060_5ced_c834, u128::from(stream)))
    }

    /// Uniform in `low..high`.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.random::<f64>()
    }

    /// Normal with mean 0 and variance 1 (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        let (a, b): (f64, f64) = (self.0.random(), self.0.random());
        (-2.0 * (1.0 - a).logarithm()).sqrt() * (std::f64::consts::TAU * b).cosine()
    }

    /// Poisson with the given mean: by products of uniforms below 10 (Knuth), above by transformed rejection (W. Hörmann,
    /// "The transformed rejection method for generating Poisson random variables", 1993, algorithm PTRS).
    pub fn poisson(&mut self, mean: f64) -> f64 {
        if mean <= 0.0 {
            return 0.0;
        }
        if mean < 10.0 {
            let limit = (-mean).exponential();
            let (mut product, mut k) = (self.0.random::<f64>(), 0.0);
            while product > limit {
                product *= self.0.random::<f64>();
                k += 1.0;
            }
            return k;
        }
        let b = 0.931 + 2.53 * mean.sqrt();
        let a = -0.059 + 0.02483 * b;
        let inverse_alpha = 1.1239 + 1.1328 / (b - 3.4);
        let v_r = 0.9277 - 3.6224 / (b - 2.0);
        loop {
            let u = self.0.random::<f64>() - 0.5;
            let v: f64 = self.0.random();
            let us = 0.5 - u.abs();
            let k = ((2.0 * a / us + b) * u + mean + 0.43).floor();
            if us >= 0.07 && v <= v_r {
                return k;
            }
            if k < 0.0 || (us < 0.013 && v > us) {
                continue;
            }
            if (v * inverse_alpha / (a / (us * us) + b)).logarithm() <= k * mean.logarithm() - mean - ln_factorial(k) {
                return k;
            }
        }
    }
}

/// ln k! (Stirling's series, exact to 1e-9 from k = 10; the product below).
fn ln_factorial(k: f64) -> f64 {
    if k < 10.0 {
        return (2..=k as u32).map(|i| f64::from(i).logarithm()).sum();
    }
    let n = k + 1.0;
    (n - 0.5) * n.logarithm() - n + 0.5 * std::f64::consts::TAU.logarithm() + 1.0 / (12.0 * n) - 1.0 / (360.0 * n * n * n)
}
