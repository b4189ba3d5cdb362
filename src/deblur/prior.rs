//! The prior: total variation inside the iteration, collaborative filtering behind it.

use super::Solver;
use crate::collaborative::{self, Patch, Precision, SIDE, VALUES};
use crate::error::{Error, Result};
use crate::gpu::{self, Step};
use crate::image::{Plane, Rgb};
use crate::kernels::DeviceRgb;
use serde::{Deserialize, Serialize};
use std::ops::Range;
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
    const AROUND: [(f64, f64); 4] = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)];
    std::array::from_fn::<f32, VALUES, _>(|k| {
        let (u, v) = ((k % SIDE) as f64, (k / SIDE) as f64);
        let sum: f64 = AROUND.iter().flat_map(|(a, b)| [1.0, -1.0].map(|s| at((u + a) / SIDE as f64, s * (v + b) / SIDE as f64))).sum();
        (sum / (2 * AROUND.len()) as f64) as f32
    })
}

/// What the filter adds to irradiance before the logarithm, in standard deviations of the darkest pixels' irradiance: below it values are
/// compared by their differences, above by their ratios. Means of logarithms of what is mostly noise would be too dark.
const OFFSET: f32 = 20.0;

/// `OFFSET` standard deviations of irradiance where it is known best: the hundredth part of the largest of `weights`, by a sample.
fn offset(weights: &Precision) -> f32 {
    let n = weights.white.0[0].data.len();
    let mut sample = Vec::new();
    for c in 0..3 {
        sample.extend((0..n).step_by(n.div_ceil(100_000)).map(|i| {
            let through = |(given, power): &(Rgb, Patch)| given.0[c].data[i] * power.iter().sum::<f32>() / VALUES as f32;
            weights.white.0[c].data[i] + weights.shaken.iter().map(through).sum::<f32>()
        }));
    }
    sample.retain(|w| *w > 0.0);
    sample.sort_by(f32::total_cmp);
    sample.get(sample.len() * 99 / 100).map_or(0.0, |w| OFFSET / w.sqrt())
}

impl Solver<'_> {
    /// Inverse variance of irradiance that the frames give at the present estimate.
    fn precision(&self) -> Result<Precision> {
        let to = &self.state.product;
        self.gpu.submit(&self.weigh(self.settings.robust));
        // What `steps` of each group of channels leave in `product`. The interpolation has negative lobes.
        let given = |steps: &dyn Fn(&Range<usize>) -> Vec<Step>| {
            let mut planes = Vec::new();
            for group in self.groups() {
                self.gpu.submit(&steps(&group));
                for plane in to {
                    planes.push(self.read_plane(plane)?.map(|w| w.max(0.0)));
                }
            }
            Ok::<_, Error>(Rgb(planes.try_into().expect("three channels")))
        };
        let white = given(&|group| self.diagonal(group, |m| m.operator.still))?;
        let mut shaken = Vec::new();
        for m in self.moving().filter(|m| !m.operator.still) {
            let own = given(&|group| {
                let mut steps: Vec<Step> = to.iter().map(|b| Step::Clear(b.clone())).collect();
                steps.extend(m.adjoint(self, &m.weight[group.clone()], to, 1.0));
                steps
            })?;
            shaken.push((own, power(&m.operator.psf)));
        }
        Ok(Precision { white, shaken })
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
        for given in precision.shaken.iter_mut().map(|s| &mut s.0).chain([&mut precision.white]) {
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
