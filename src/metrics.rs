//! How close an irradiance image is to the truth. Reads images only; nothing here is tone-mapped.

use crate::error::{Error, Result};
use crate::image::{Plane, Rgb};

/// How [`score`] judges.
#[derive(Clone, Copy, Debug)]
pub struct Judge {
    /// Pixels left out at each side of the image.
    pub crop: usize,
    /// Luminance in cd/m² that the 99.5th percentile of the truth is shown at.
    pub peak_nits: f64,
    /// Irradiance of the truth from which on not even the shortest frame recorded it: such pixels and those within 4 px
    /// are not judged. `None`: all are.
    pub limit: Option<f32>,
}

impl Default for Judge {
    /// 24 px, 1000 cd/m², everything recorded.
    fn default() -> Self {
        Self { crop: 24, peak_nits: 1000.0, limit: None }
    }
}

/// Closeness of an estimate to the truth after one gain, the same for all channels: the absolute scale is free, a cast is not.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Score {
    /// PSNR of PU21-encoded values, dB.
    pub pu_psnr: f64,
    /// Root mean square difference of the natural logarithm of irradiance; below a thousandth of the truth's 99th percentile
    /// differences fade out.
    pub log_rmse: f64,
    /// 99th percentile of the gradient of log luminance, relative to the truth's: below 1 is blurred, above 1 noisy or ringing.
    pub edge_ratio: f64,
}

/// PU21 encoding of a luminance in cd/m² (R. Mantiuk and M. Azimi, "PU21: A novel perceptually uniform encoding for adapting
/// existing quality metrics for HDR", 2021; the variant for banding and glare).
pub fn pu21(luminance: f64) -> f64 {
    const P: [f64; 7] =
        [0.353_487_901, 0.373_465_862_9, 8.277_049_286e-5, 0.906_256_262_7, 0.091_503_031_66, 0.909_951_720_4, 596.314_814_2];
    let y = luminance.clamp(0.005, 10_000.0).powf(P[3]);
    (P[6] * (((P[0] + P[1] * y) / (1.0 + P[2] * y)).powf(P[4]) - P[5])).max(0.0)
}

/// Judges `estimate` against `truth`, both linear and of one size.
///
/// # Errors
/// [`Error::Input`] for sizes that differ, an image that the crop leaves nothing of, values that are negative or not finite, and a
/// limit that leaves less than 5 % of the pixels.
pub fn score(estimate: &Rgb, truth: &Rgb, judge: &Judge) -> Result<Score> {
    let (width, height) = truth.size();
    if estimate.size() != (width, height) {
        return Err(Error::Input(format!("the estimate is {:?} pixels, the truth {:?}", estimate.size(), truth.size())));
    }
    // One-sided differences need two pixels.
    if width.min(height) < 2 * judge.crop + 2 {
        return Err(Error::Input(format!("{width} x {height} pixels leave nothing inside a crop of {}", judge.crop)));
    }
    if estimate.0.iter().chain(&truth.0).any(|p| p.data.iter().any(|v| !(v.is_finite() && *v >= 0.0))) {
        return Err(Error::Input("an image to judge holds negative values or values that are not finite".into()));
    }
    let gain = gain(estimate, truth);
    let inner = |image: &Rgb, gain: f64| {
        image.map_planes(|p| {
            p.crop(judge.crop, judge.crop, width - 2 * judge.crop, height - 2 * judge.crop).map(|v| (f64::from(v) * gain) as f32)
        })
    };
    let (e, t) = (inner(estimate, gain), inner(truth, 1.0));
    let ok = judged(&t, judge.limit);
    let count = ok.iter().filter(|&&v| v).count();
    if (count as f64) < 0.05 * ok.len() as f64 {
        return Err(Error::Input("the bracket leaves less than 5 % of the scene recoverable".into()));
    }
    let mean = t.mean();
    let nits = judge.peak_nits / percentile(mean.data.clone(), 99.5).max(f64::MIN_POSITIVE);
    let floor = 1e-3 * percentile(mean.data, 99.0) + 1e-12;
    let (mut squares, mut log_squares) = (0.0, 0.0);
    for (i, _) in ok.iter().enumerate().filter(|(_, ok)| **ok) {
        for c in 0..3 {
            let (a, b) = (f64::from(e.0[c].data[i]), f64::from(t.0[c].data[i]));
            squares += (pu21(a * nits) - pu21(b * nits)).powi(2);
            log_squares += ((a + floor) / (b + floor)).ln().powi(2);
        }
    }
    let n = 3.0 * count as f64;
    Ok(Score {
        pu_psnr: 10.0 * (pu21(judge.peak_nits).powi(2) / (squares / n)).log10(),
        log_rmse: (log_squares / n).sqrt(),
        edge_ratio: edges(&e, &ok) / edges(&t, &ok).max(f64::MIN_POSITIVE),
    })
}

/// Median ratio of truth to estimate over the middle luminances (20th to 95th percentile of the truth); 1 without such pixels.
fn gain(estimate: &Rgb, truth: &Rgb) -> f64 {
    let (e, t) = (estimate.mean().data, truth.mean().data);
    let (low, high) = (percentile(t.clone(), 20.0), percentile(t.clone(), 95.0));
    let ratios: Vec<f32> =
        e.iter().zip(&t).filter(|(e, t)| f64::from(**t) > low && f64::from(**t) < high && **e > 0.0).map(|(e, t)| t / e).collect();
    if ratios.is_empty() { 1.0 } else { percentile(ratios, 50.0) }
}

/// Which pixels are farther than 4 px (in x or y) from all that reach `limit` in any channel.
fn judged(truth: &Rgb, limit: Option<f32>) -> Vec<bool> {
    let (width, height) = truth.size();
    let mut ok = vec![true; width * height];
    let Some(limit) = limit else { return ok };
    for i in 0..width * height {
        if truth.pixel(i).iter().any(|&v| v >= limit) {
            let (x, y) = (i % width, i / width);
            for v in y.saturating_sub(4)..(y + 5).min(height) {
                ok[v * width + x.saturating_sub(4)..v * width + (x + 5).min(width)].fill(false);
            }
        }
    }
    ok
}

/// 99th percentile of the gradient of log luminance over the judged pixels: central differences, one-sided at the border.
fn edges(image: &Rgb, ok: &[bool]) -> f64 {
    let mean = image.mean();
    let floor = 1e-3 * percentile(mean.data.clone(), 99.0) + 1e-12;
    let log = mean.map(|v| (f64::from(v) + floor).ln() as f32);
    let difference = |low: (usize, usize), high: (usize, usize)| {
        let steps = (high.0 - low.0 + high.1 - low.1) as f32;
        (log.at(high.0, high.1) - log.at(low.0, low.1)) / steps
    };
    let (width, height) = log.size();
    let gradient = Plane::from_fn(width, height, |x, y| {
        let dx = difference((x.saturating_sub(1), y), ((x + 1).min(width - 1), y));
        dx.hypot(difference((x, y.saturating_sub(1)), (x, (y + 1).min(height - 1))))
    });
    percentile(gradient.data.iter().zip(ok).filter(|(_, ok)| **ok).map(|(&v, _)| v).collect(), 99.0)
}

/// The `q`-th percentile (0..=100), interpolated between neighbours. `values` is not empty.
fn percentile(mut values: Vec<f32>, q: f64) -> f64 {
    values.sort_unstable_by(f32::total_cmp);
    let place = q / 100.0 * (values.len() - 1) as f64;
    let i = place as usize;
    let (a, b) = (f64::from(values[i]), f64::from(values[(i + 1).min(values.len() - 1)]));
    a + (b - a) * (place - i as f64)
}
