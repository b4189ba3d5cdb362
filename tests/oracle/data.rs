//! Noise of an observation, data weights, misfit: scalars, one pixel at a time.

/// How a pixel was observed.
pub struct Pixel<'a> {
    /// Predicted irradiance.
    pub predicted: f64,
    /// Exposure f⁻¹(Z), where the channel counts.
    pub exposure: Option<f64>,
    pub mask: f64,
    pub exposure_time: f64,
    pub black_clipped: bool,
    /// Standard deviation of the exposure at equal steps of its square root from 0 to 1.
    pub noise: &'a [f32],
}

/// Mean of what is recorded, its derivative by the exposure, and its variance.
pub struct Moments {
    pub mean: f64,
    pub slope: f64,
    pub variance: f64,
}

/// Standard deviation at an exposure: the curve's straight line between the two samples around √exposure.
pub fn deviation(noise: &[f32], exposure: f64) -> f64 {
    let s = exposure.clamp(0.0, 1.0).sqrt();
    let last = noise.len() - 1;
    let mut below = 0;
    while below + 1 < last && (below + 1) as f64 / last as f64 <= s {
        below += 1;
    }
    let (a, b) = (f64::from(noise[below]), f64::from(noise[below + 1]));
    a + (b - a) * (s * last as f64 - below as f64)
}

/// Integral of `f` by Simpson's rule.
fn integral(from: f64, to: f64, f: impl Fn(f64) -> f64) -> f64 {
    let n = 400;
    let h = (to - from) / f64::from(n);
    let weight = |i: i32| {
        if i == 0 || i == n {
            1.0
        } else if i % 2 == 1 {
            4.0
        } else {
            2.0
        }
    };
    (0..=n).map(|i| weight(i) * f(from + f64::from(i) * h)).sum::<f64>() * h / 3.0
}

/// Moments of x + s n, or of max(0, x + s n), n standard normal, by quadrature over the n that are not clipped.
pub fn moments(x: f64, s: f64, clipped: bool) -> Moments {
    if !clipped {
        return Moments { mean: x, slope: 1.0, variance: s * s };
    }
    let density = |n: f64| (-0.5 * n * n).exp() / (2.0 * std::f64::consts::PI).sqrt();
    let from = (-x / s).max(-9.0);
    let over = |f: &dyn Fn(f64) -> f64| integral(from, 9.0, |n| f(x + s * n) * density(n));
    let mean = over(&|v| v);
    // About the mean, not E[v²] - mean²; the clipped values sit at 0.
    let clipped_share = 1.0 - over(&|_| 1.0);
    let variance = over(&|v| (v - mean) * (v - mean)) + clipped_share * mean * mean;
    Moments { mean, slope: over(&|_| 1.0), variance }
}

impl Pixel<'_> {
    fn moments(&self) -> Moments {
        let x = self.predicted.max(0.0) * self.exposure_time;
        moments(x, deviation(self.noise, x), self.black_clipped)
    }

    /// Squared residual over variance, 0 of what does not count, and a bound of its f32 error: |r| carries a few roundings of the exposures and the
    /// distribution function's 1.5e-7, the variance 2e-5.
    pub fn chi_squared(&self) -> (f64, f64) {
        let Some(exposure) = self.exposure else { return (0.0, 0.0) };
        let m = self.moments();
        let r = exposure - m.mean;
        let chi = r * r / m.variance;
        let dr = 5e-7 * (exposure.abs() + m.mean + m.variance.sqrt());
        (chi, 2.0 * r.abs() * dr / m.variance + dr * dr / m.variance + 2e-5 * chi)
    }

    /// Data weight W at a local misfit, the weighted observation W B, and the size of the terms that W B is a sum of.
    pub fn weight(&self, local: Option<(f64, f64)>, robust: f64) -> (f64, f64, f64) {
        let Some(exposure) = self.exposure else { return (0.0, 0.0, 0.0) };
        let m = self.moments();
        let excess = local.map_or(0.0, |(chi, count)| (chi / count - 1.0).max(0.0));
        // Inverse variance of the irradiance estimate B = E + (recorded - mean)/(d mean / d E).
        let gain = self.exposure_time * m.slope;
        let w = self.mask.powi(2) / (m.variance / gain.powi(2)) / (1.0 + robust * excess);
        let e = self.predicted.max(0.0);
        (w, w * (e + (exposure - m.mean) / gain), w * (e + (exposure + m.mean) / gain))
    }
}

/// Sum of pairs over the plane with weights exp(-r²/2σ²), within 6 pixels in x and in y.
pub fn gauss(pairs: &[[f64; 2]], size: (usize, usize), sigma: f64) -> Vec<[f64; 2]> {
    let mut out = vec![[0.0; 2]; pairs.len()];
    // Scatter in two dimensions at once.
    for (i, pair) in pairs.iter().enumerate() {
        let (x, y) = ((i % size.0) as i64, (i / size.0) as i64);
        for v in (y - 6).max(0)..=(y + 6).min(size.1 as i64 - 1) {
            for u in (x - 6).max(0)..=(x + 6).min(size.0 as i64 - 1) {
                let w = (-0.5 * ((u - x).pow(2) + (v - y).pow(2)) as f64 / sigma.powi(2)).exp();
                let o = &mut out[v as usize * size.0 + u as usize];
                *o = [o[0] + w * pair[0], o[1] + w * pair[1]];
            }
        }
    }
    out
}
