//! The prior: total variation inside the iteration, collaborative filtering behind it.

use super::Solver;
use crate::collaborative::{self, Between, Patch, Power, Precision, SIDE, VALUES};
use crate::error::{Error, Result};
use crate::gpu::{self, Step};
use crate::image::{Plane, Rgb};
use crate::kernels::DeviceRgb;
use crate::tsf::Interpolation;
use glam::{DMat3, DVec2};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// What irradiance is taken to look like before a frame is seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Prior {
    /// Little total variation while the frames are deblurred, then [`crate::collaborative`] filtering of what is left of the noise:
    /// 0.5 to 1.8 dB above total variation alone.
    #[default]
    Collaborative,
    /// Total variation alone, as in eq. (9).
    Tv,
}

/// Part of λ that total variation keeps when the filter follows: enough for the deblurring not to run away where the blurs pass nothing.
const SHARE: f32 = 0.28;
/// Strength of the filter at the default λ: that of the noise is 1, and part of it has gone by total variation.
const STRENGTH: f32 = 0.9;

impl Prior {
    /// Weight of total variation for λ.
    pub fn smoothness(self, lambda: f32) -> f32 {
        match self {
            Self::Collaborative => SHARE * lambda,
            Self::Tv => lambda,
        }
    }
}

/// Where around a frequency of the patch transform power is looked at.
const AROUND: [f64; 2] = [-0.25, 0.25];

/// Power of a PSF (x, y, weight) around the frequencies of the patch transform, over both signs of the vertical one, which that does not
/// tell apart.
fn power(psf: &[(f64, f64, f64)]) -> Patch {
    let at = |fx: f64, fy: f64| {
        let (re, im) = psf.iter().fold((0.0, 0.0), |(re, im), (x, y, w)| {
            let (sin, cos) = (std::f64::consts::PI * (fx * x + fy * y)).sin_cos();
            (re + w * cos, im + w * sin)
        });
        re * re + im * im
    };
    std::array::from_fn::<f32, VALUES, _>(|k| {
        let (u, v) = ((k % SIDE) as f64, (k / SIDE) as f64);
        let around = AROUND.iter().flat_map(|a| AROUND.map(|b| (u + a, v + b)));
        let sum: f64 = around.flat_map(|(u, v)| [1.0, -1.0].map(|s| at(u / SIDE as f64, s * v / SIDE as f64))).sum();
        (sum / (2 * AROUND.len() * AROUND.len()) as f64) as f32
    })
}

/// Fractions of a pixel that are told apart.
const FRACTIONS: usize = 16;

/// Power along one axis of reading `fraction` of a pixel beside the pixels, around the frequencies of the patch transform.
fn axis_power(kind: Interpolation, fraction: f64) -> [f32; SIDE] {
    let support = kind.support() as isize;
    let at = |f: f64| {
        let (re, im) = (1 - support..=support).fold((0.0, 0.0), |(re, im), k| {
            let (weight, (sin, cos)) = (kind.weight(k as f64 - fraction), (std::f64::consts::PI * f * k as f64).sin_cos());
            (re + weight * cos, im + weight * sin)
        });
        re * re + im * im
    };
    std::array::from_fn(|u| (AROUND.iter().map(|a| at((u as f64 + a) / SIDE as f64)).sum::<f64>() / AROUND.len() as f64) as f32)
}

/// What the filter adds to irradiance before the logarithm, in standard deviations of the darkest pixels' irradiance: below it values are
/// compared by their differences, above by their ratios. Means of logarithms of what is mostly noise would be too dark.
const OFFSET: f32 = 20.0;

/// `OFFSET` standard deviations of irradiance where it is known best: the hundredth part of the largest of `weights`, by a sample.
fn offset(weights: &Precision) -> f32 {
    let n = weights.white.0[0].data.len();
    let blurred: Vec<(&Rgb, f32)> = weights.blurred.iter().map(|(given, power)| (given, power.mean())).collect();
    let mut sample = Vec::new();
    for c in 0..3 {
        sample.extend((0..n).step_by(n.div_ceil(100_000)).map(|i| {
            let through = |(given, power): &(&Rgb, f32)| given.0[c].data[i] * power;
            weights.white.0[c].data[i] + blurred.iter().map(through).sum::<f32>()
        }));
    }
    sample.retain(|w| *w > 0.0);
    sample.sort_by(f32::total_cmp);
    sample.get(sample.len() * 99 / 100).map_or(0.0, |w| OFFSET / w.sqrt())
}

impl Solver<'_> {
    /// Inverse variance of irradiance that the frames give at the present estimate.
    fn precision(&self) -> Result<Precision> {
        self.gpu.submit(&self.weigh(self.settings.robust));
        let white = self.read(&self.state.weight)?;
        let to = &self.state.product;
        let mut blurred = Vec::new();
        for m in self.moving() {
            let mut planes = Vec::new();
            for group in self.groups() {
                let mut steps: Vec<Step> = to.iter().map(|b| Step::Clear(b.clone())).collect();
                steps.extend(m.adjoint(self, &m.weight[group], to, 1.0));
                self.gpu.submit(&steps);
                for plane in to {
                    // The interpolation has negative lobes.
                    planes.push(self.read_plane(plane)?.map(|w| w.max(0.0)));
                }
            }
            let given = Rgb(planes.try_into().expect("three channels"));
            let power = match &m.operator.still {
                Some(motion) => Power::Between(self.between(motion, m.operator.interpolation)),
                None => Power::Same(power(&m.operator.psf)),
            };
            blurred.push((given, power));
        }
        Ok(Precision { white, blurred })
    }

    /// Of a displaced frame.
    fn between(&self, motion: &DMat3, interpolation: Interpolation) -> Between {
        let middle = |(w, h): (usize, usize)| 0.5 * DVec2::new(w as f64 - 1.0, h as f64 - 1.0);
        let motion = DMat3::from_translation(middle(self.frame)) * *motion * DMat3::from_translation(-middle(self.latent));
        Between { motion, axis: (0..FRACTIONS).map(|k| axis_power(interpolation, k as f64 / FRACTIONS as f64)).collect() }
    }

    fn read_plane(&self, plane: &wgpu::Buffer) -> Result<Plane> {
        Plane::from_vec(self.latent.0, self.latent.1, gpu::read(self.gpu, plane, self.latent.0 * self.latent.1)?)
    }

    pub(super) fn read(&self, planes: &DeviceRgb) -> Result<Rgb> {
        Ok(Rgb([self.read_plane(&planes[0])?, self.read_plane(&planes[1])?, self.read_plane(&planes[2])?]))
    }

    /// Replaces the estimate by what collaborative filtering makes of it.
    ///
    /// # Errors
    /// `Cancelled`; a lost device.
    pub(super) fn filter(&self, progress: &mut dyn FnMut(f32) -> bool) -> Result<()> {
        let strength = STRENGTH * self.settings.lambda / super::Settings::default().lambda;
        let (mut precision, irradiance) = (self.precision()?, self.read(&self.state.irradiance)?);
        let offset = offset(&precision);
        for given in precision.blurred.iter_mut().map(|s| &mut s.0).chain([&mut precision.white]) {
            for (weights, irradiance) in given.0.iter_mut().zip(&irradiance.0) {
                weights.data.iter_mut().zip(&irradiance.data).for_each(|(w, e)| *w *= (e + offset).powi(2));
            }
        }
        let log = irradiance.map_planes(|p| p.map(|e| (e + offset).ln()));
        let filtered = collaborative::filtered(&log, &precision, strength, progress).ok_or(Error::Cancelled)?;
        let floor = (1e-3 * offset).max(super::DARKEST);
        let irradiance = filtered.map_planes(|p| p.map(|g| (g.exp() - offset).max(floor)));
        let put = |(plane, to): (Plane, &wgpu::Buffer)| Step::Upload(Arc::new(plane.data), to.clone());
        self.gpu.submit(&irradiance.0.into_iter().zip(&self.state.irradiance).map(put).collect::<Vec<_>>());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Along each axis by itself, and of the taps of both: the same.
    #[test]
    fn an_interpolation_has_the_power_of_its_taps() {
        for kind in [Interpolation::Bilinear, Interpolation::Bicubic, Interpolation::SixPoint] {
            for (fx, fy) in [(0.0, 0.0), (0.5, 0.0), (0.25, 0.9), (0.5, 0.5)] {
                let support = kind.support() as i32;
                let taps = || (1 - support..=support).map(f64::from);
                let weight = |x: f64, y: f64| kind.weight(x - fx) * kind.weight(y - fy);
                let psf: Vec<_> = taps().flat_map(|y| taps().map(move |x| (x, y))).map(|(x, y)| (x, y, weight(x, y))).collect();
                let (whole, across, down) = (power(&psf), axis_power(kind, fx), axis_power(kind, fy));
                for (k, p) in whole.iter().enumerate() {
                    let product = across[k % SIDE] * down[k / SIDE];
                    assert!((p - product).abs() < 1e-5, "{kind:?} at ({fx}, {fy}), coefficient {k}: {p}, not {product}");
                }
            }
        }
        // Nothing of the finest structure passes half-way between two pixels, and all of it on one.
        let (half, on) = (axis_power(Interpolation::SixPoint, 0.5), axis_power(Interpolation::SixPoint, 0.0));
        assert!(half[SIDE - 1] < 0.2 && half[0] > 0.99 && on.iter().all(|p| (p - 1.0).abs() < 1e-6), "{half:?}, {on:?}");
    }
}
