//! How close an irradiance image is to the truth, and how sharp a picture is without one. Reads images only; nothing here is
//! tone-mapped.

mod align;
mod phase;
mod sharpness;
mod ssim;

pub use align::{Align, Moved, align};
pub use sharpness::{cpbd, cpbd_of};

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
/// PSNRs of equal images are infinite.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Score {
    /// PSNR of PU21-encoded values, dB.
    pub pu_psnr: f64,
    /// Structural similarity of PU21-encoded grey values (Z. Wang et al., "Image quality assessment: from error visibility to structural
    /// similarity", 2004; squares of 7 px, K1 = 0.01, K2 = 0.03), mean over the judged pixels.
    pub pu_ssim: f64,
    /// PU21-PSNR of the darker half of the judged pixels, dB.
    pub pu_dark: f64,
    /// PU21-PSNR from there to the brightest tenth, dB.
    pub pu_mid: f64,
    /// PU21-PSNR of the brightest tenth of the judged pixels, dB.
    pub pu_bright: f64,
    /// PSNR after μ-law compression, log(1 + μx)/log(1 + μ) with μ = 5000 (N. K. Kalantari and R. Ramamoorthi, "Deep High Dynamic Range
    /// Imaging of Dynamic Scenes", 2017), 1 being the truth's 99.9th percentile, dB.
    pub mu_psnr: f64,
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

/// Estimate and truth made comparable: one gain, the crop, which pixels count, and the display's luminance of a unit of irradiance.
struct Pair {
    estimate: Rgb,
    truth: Rgb,
    ok: Vec<bool>,
    nits: f64,
}

impl Pair {
    fn new(estimate: &Rgb, truth: &Rgb, judge: &Judge) -> Result<Self> {
        check(estimate, truth)?;
        let (width, height) = truth.size();
        // One-sided differences need two pixels, structural similarity a square of seven.
        if width.min(height) < 2 * judge.crop + ssim::SIDE {
            return Err(Error::Input(format!("{width} x {height} pixels leave nothing inside a crop of {}", judge.crop)));
        }
        let gain = gain(estimate, truth);
        let inner = |image: &Rgb, gain: f64| {
            image.map_planes(|p| {
                p.crop(judge.crop, judge.crop, width - 2 * judge.crop, height - 2 * judge.crop).map(|v| (f64::from(v) * gain) as f32)
            })
        };
        let (estimate, truth) = (inner(estimate, gain), inner(truth, 1.0));
        let ok = judged(&truth, judge.limit);
        if (ok.iter().filter(|&&v| v).count() as f64) < 0.05 * ok.len() as f64 {
            return Err(Error::Input("the bracket leaves less than 5 % of the scene recoverable".into()));
        }
        let nits = judge.peak_nits / percentile(truth.mean().data, 99.5).max(f64::MIN_POSITIVE);
        Ok(Self { estimate, truth, ok, nits })
    }

    /// PU21-encoded image.
    fn encoded(&self, image: &Rgb) -> Rgb {
        image.map_planes(|p| p.map(|v| pu21(f64::from(v) * self.nits) as f32))
    }
}

/// Refuses images that cannot be compared.
fn check(estimate: &Rgb, truth: &Rgb) -> Result<()> {
    if estimate.size() != truth.size() {
        return Err(Error::Input(format!("the estimate is {:?} pixels, the truth {:?}", estimate.size(), truth.size())));
    }
    if estimate.0.iter().chain(&truth.0).any(|p| p.data.iter().any(|v| !(v.is_finite() && *v >= 0.0))) {
        return Err(Error::Input("an image to judge holds negative values or values that are not finite".into()));
    }
    Ok(())
}

/// Judges `estimate` against `truth`, both linear and of one size.
///
/// # Errors
/// [`Error::Input`] for sizes that differ, an image that the crop leaves nothing of, values that are negative or not finite, and a
/// limit that leaves less than 5 % of the pixels.
pub fn score(estimate: &Rgb, truth: &Rgb, judge: &Judge) -> Result<Score> {
    let pair = Pair::new(estimate, truth, judge)?;
    let (e, t, ok) = (&pair.estimate, &pair.truth, &pair.ok);
    let (pe, pt) = (pair.encoded(e), pair.encoded(t));
    let mean = t.mean();
    let floor = 1e-3 * percentile(mean.data.clone(), 99.0) + 1e-12;
    let judged = |p: &Plane| ok.iter().zip(&p.data).filter(|(ok, _)| **ok).map(|(_, v)| *v).collect::<Vec<f32>>();
    let lum = judged(&mean);
    let (half, tenth) = (percentile(lum.clone(), 50.0), percentile(lum, 90.0));
    let white = percentile(t.0.iter().flat_map(judged).collect(), 99.9).max(f64::MIN_POSITIVE);
    let mu = |v: f64| (5000.0 * (v / white).clamp(0.0, 1.0)).ln_1p() / 5000f64.ln_1p();
    let (mut squares, mut log_squares, mut mu_squares) = ([0.0; 3], 0.0, 0.0);
    let mut counts = [0usize; 3];
    for (i, _) in ok.iter().enumerate().filter(|(_, ok)| **ok) {
        let lum = f64::from(mean.data[i]);
        let zone = usize::from(lum >= half) + usize::from(lum >= tenth);
        counts[zone] += 3;
        for c in 0..3 {
            squares[zone] += f64::from(pe.0[c].data[i] - pt.0[c].data[i]).powi(2);
            let (a, b) = (f64::from(e.0[c].data[i]), f64::from(t.0[c].data[i]));
            log_squares += ((a + floor) / (b + floor)).ln().powi(2);
            mu_squares += (mu(a) - mu(b)).powi(2);
        }
    }
    let n = counts.iter().sum::<usize>() as f64;
    let range = pu21(judge.peak_nits);
    let psnr = |squares: f64, n: f64| 10.0 * (range.powi(2) / (squares / n.max(1.0))).log10();
    Ok(Score {
        pu_psnr: psnr(squares.iter().sum(), n),
        pu_ssim: ssim::mean(&pe.mean(), &pt.mean(), range, ok),
        pu_dark: psnr(squares[0], counts[0] as f64),
        pu_mid: psnr(squares[1], counts[1] as f64),
        pu_bright: psnr(squares[2], counts[2] as f64),
        mu_psnr: -10.0 * (mu_squares / n).log10(),
        log_rmse: (log_squares / n).sqrt(),
        edge_ratio: edges(e, ok) / edges(t, ok).max(f64::MIN_POSITIVE),
    })
}

/// PU21 units at which [`error_map`] is at full colour: about 5 % of white at 100 cd/m², clearly visible.
const FULL_COLOUR: f32 = 25.0;

/// Picture of the error inside the crop: mean PU21 difference of the channels; red where the estimate is too bright, blue where too dark,
/// black where it is right, grey where it is not judged.
///
/// # Errors
/// Those of [`score`].
pub fn error_map(estimate: &Rgb, truth: &Rgb, judge: &Judge) -> Result<image::RgbImage> {
    let pair = Pair::new(estimate, truth, judge)?;
    let (e, t) = (pair.encoded(&pair.estimate).mean(), pair.encoded(&pair.truth).mean());
    Ok(image::RgbImage::from_fn(e.width as u32, e.height as u32, |x, y| {
        let i = y as usize * e.width + x as usize;
        if !pair.ok[i] {
            return image::Rgb([60; 3]);
        }
        let d = ((e.data[i] - t.data[i]) / FULL_COLOUR).clamp(-2.0, 2.0);
        // Full colour at one, then towards white.
        let (full, white) = ((d.abs().min(1.0) * 255.0) as u8, ((d.abs() - 1.0).max(0.0) * 255.0) as u8);
        image::Rgb(if d > 0.0 { [full, white, white] } else { [white, white.max(full / 3), full] })
    }))
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
