//! Blurs of shaken frames against the irradiance that others show: their TSFs and their PSFs.

use super::Run;
use super::judge::BlurEvidence;
use super::plan::evidence;
use crate::channels;
use crate::deblur::{self, Prior};
use crate::image::{Channels, Plane, Rgb};
use crate::merge;
use crate::noise;
use crate::pose::{nearest_pixel, project};
use crate::psf;
use crate::register;
use crate::tsf::{self, Search, Tsf, WholeFrame};
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use serde_json::{Value, json};

/// Iterations of [`Run::refine`].
const REFINED: usize = 8;
/// Outer iterations of the rounds before the last.
const FIRST_OUTER: usize = 2;
/// Local PSFs per blurred frame.
const PATCHES: usize = 9;
/// Side of a patch in pixels.
const PATCH_SIZE: usize = 96;
/// Pixels around the path of a blur at a patch in which its PSF is looked for.
const PSF_MARGIN: isize = 3;
/// Pixels of a blur's path at a patch beyond which its PSF is not described: some thousand unknowns would take longer than everything else.
const LONGEST_PATH: usize = 80;
/// Sizes at which a frame is looked at for whether it moved: 1, 1/2, 1/4.
const LOOKED_AT: usize = 3;
/// Displacement in pixels of a blurred frame that the search for its poses covers by itself.
const SEARCHED: f64 = 3.0;
/// Standard deviation of the operator's own error, as a part of the mean absolute gradient around a pixel.
const MODEL_ERROR: f32 = 0.03;

/// What the blur of a frame is looked for in: see [`Run::luminances`].
pub(super) struct Luminances {
    latent: Plane,
    seen: Plane,
    blurred: Plane,
    weight: Plane,
}

impl Luminances {
    fn frame(&self, base: DMat3) -> WholeFrame<'_> {
        WholeFrame { latent: &self.latent, pad: 0, blurred: &self.blurred, weight: &self.weight, base }
    }
}

/// A frame that is looked at for whether it moved.
pub(super) struct Looked {
    luminances: Luminances,
    base: DMat3,
    search: Search,
}

impl Looked {
    /// What motions in the image plane tell of it at 1, 1/2, 1/4 of the size; `None` where there is too little texture to tell.
    pub(super) fn evidence(&self) -> Vec<Option<BlurEvidence>> {
        let found = self.luminances.frame(self.base).estimates(&self.search, LOOKED_AT);
        found.into_iter().map(|e| e.filter(tsf::Estimate::is_sound).map(|e| evidence(&e, self.luminances.latent.size()))).collect()
    }
}

impl Run<'_> {
    /// Motion about which the poses of the blurred frame `i` are looked for: the search covers what is left.
    fn base(&self, i: usize) -> DMat3 {
        let (w, h) = self.bracket.size();
        let motion = self.motions[i];
        if register::distance(&motion, &DMat3::IDENTITY, w, h).1 < SEARCHED {
            return DMat3::IDENTITY;
        }
        // Whole pixels need no interpolation.
        let centre = project(&motion, DVec2::ZERO);
        let shift = DMat3::from_translation(centre.round());
        let whole = DMat3::from_translation(centre.round() - centre) * motion;
        if register::distance(&whole, &shift, w, h).1 < 0.5 * SEARCHED { shift } else { whole }
    }

    /// The channels whose mean tells most about the blurs of the frames `blurred` of a scene known from the frames `by`.
    pub(super) fn most_telling(&self, blurred: &[usize], by: &[usize]) -> Channels {
        channels::most_telling(self.bracket.frames(), &self.exposures, blurred, by, &self.noise)
    }

    /// Luminances, the mean of the channels in which the blur of frame `i` is looked for, of the irradiance `latent` and of what the frame at
    /// `motion` sees of it; of the frame itself; and the frame's inverse variance, model error included.
    fn luminances(&self, i: usize, latent: &Rgb, motion: &DMat3) -> Luminances {
        let frame = &self.bracket.frames()[i];
        let dt = frame.exposure_time as f32;
        let (channels, mask) = (self.looks[i].0, self.looks[i].1.as_ref().unwrap_or(&self.masks[i]));
        let noise = noise::of_mean_of(&self.curve_of_detail(i), channels);
        let (seen, inside) = self.seen(latent, motion);
        let seen = seen.mean_of(channels);
        let exposure = self.exposures[i].mean_of(channels);
        let local = merge::gradient_level(&seen, 4);
        let weight = Plane {
            data: (0..exposure.data.len())
                .map(|p| {
                    let m = mask.data[p];
                    // An operator is never true to better than some per cent of the structure around a pixel.
                    let variance = noise::at(&noise, exposure.data[p]) / (dt * dt) + (MODEL_ERROR * local.data[p]).powi(2);
                    m * m / variance * inside.data[p]
                })
                .collect(),
            ..exposure
        };
        Luminances { latent: latent.mean_of(channels), seen, blurred: exposure.map(|v| v / dt), weight }
    }

    /// TSF of frame `i` against the sharp irradiance, about where the frame lies, what the report says of it, and what it says of whether the frame moved.
    pub(super) fn estimate(
        &self,
        i: usize,
        latent: &Rgb,
        how: impl Fn(&WholeFrame, &Search) -> Option<tsf::Estimate>,
    ) -> (Option<Tsf>, Value, Option<BlurEvidence>) {
        let base = self.base(i);
        let luminances = self.luminances(i, latent, &base);
        let frame = luminances.frame(base);
        let search = Search { model: self.settings.model, focal_px: self.settings.focal_px, stop: self.stop.clone() };
        let Some(found) = how(&frame, &search).filter(tsf::Estimate::is_sound) else { return (None, Value::Null, None) };
        let detail = json!({
            "model": found.model,
            "focal_px": found.tsf.focal_px,
            "focal_length": found.focal,
            "models_tried": found.trials,
            "still_worse_by": found.still_worse_by,
            "still_error": found.still_error,
            "blank_worse_by": found.blank_worse_by,
            "estimated_at_scale": found.scale,
            "extent_px": tsf::extent(&found.tsf, latent.width(), latent.height()),
            "residual": found.residual,
            "channels": self.looks[i].0.names(),
        });
        let evidence = evidence(&found, latent.size());
        (Some(found.tsf), detail, Some(evidence))
    }

    /// What [`Looked::evidence`] is found from: the frame `i` beside the irradiance `latent`, which the frame `by` shows.
    pub(super) fn looked_at(&self, i: usize, latent: &Rgb, by: usize) -> Looked {
        let search = Search { model: tsf::Model::Rigid, focal_px: self.settings.focal_px, stop: self.stop.clone() };
        let base = self.base(i);
        let mut luminances = self.luminances(i, latent, &base);
        self.forget_unshown(&mut luminances.weight, by, &base);
        Looked { luminances, base, search }
    }

    /// Sets the `weight` of a frame at `motion` to 0 where the frame `by`, in place, does not show what it sees.
    fn forget_unshown(&self, weight: &mut Plane, by: usize, motion: &DMat3) {
        let (w, h) = weight.size();
        let back = motion.inverse();
        for (p, v) in weight.data.iter_mut().enumerate() {
            let shown = nearest_pixel(&back, w, h, p % w, p / w).is_some_and(|q| self.masks[by].data[q] > 0.0);
            *v = if shown { *v } else { 0.0 };
        }
    }

    /// Patches of frame `i` and their PSFs, as the report has them.
    pub(super) fn local_psfs(&self, i: usize, latent: &Rgb, tsf: &Tsf) -> Value {
        let luminances = self.luminances(i, latent, &tsf.base);
        let psfs = self.psfs(&luminances.seen, &luminances.blurred, &luminances.weight, tsf);
        json!(
            psfs.iter()
                .map(|(p, m)| json!({
                    "x": p.x, "y": p.y, "size": p.size, "score": p.score, "confidence": m.confidence(), "expected_error": m.expected_error,
                    "psf": { "radius": m.psf.radius, "extent_px": m.psf.extent(), "values": m.psf.values.data },
                }))
                .collect::<Vec<_>>()
        )
    }

    /// PSFs of chosen or given patches, looked for around where `tsf` passes.
    fn psfs(&self, seen: &Plane, blurred: &Plane, weight: &Plane, tsf: &Tsf) -> Vec<(psf::Patch, psf::Measured)> {
        let (w, h) = seen.size();
        let reach = tsf::extent(tsf, w, h).ceil() as usize;
        let size = PATCH_SIZE.max(3 * reach / 2).min(w / 2).min(h / 2).max(16);
        let patches = if self.settings.patches.is_empty() {
            psf::choose(seen, weight, size, PATCHES)
        } else {
            self.settings.patches.iter().map(|&(x, y)| psf::around(seen, weight, x, y, size)).collect()
        };
        let wanted = self.settings.psf_radius;
        let measure = |p: &psf::Patch| {
            let path = tsf::path_at(tsf, p.centre(), (w, h));
            let reach = path.iter().map(|u| u.0.abs().max(u.1.abs())).max()? + PSF_MARGIN;
            let radius = wanted.map_or(reach, |r| r as isize);
            if path.len() > LONGEST_PATH {
                return None;
            }
            let near = |x: isize, y: isize| path.iter().any(|u| (u.0 - x).abs() <= PSF_MARGIN && (u.1 - y).abs() <= PSF_MARGIN);
            Some((*p, psf::estimate_within(seen, 0, blurred, weight, p, radius as usize, &near)?))
        };
        patches.par_iter().filter_map(measure).collect()
    }

    pub(super) fn refine(&self, i: usize, latent: &Rgb, tsf: Option<&Tsf>) -> Option<Tsf> {
        tsf.map(|t| self.luminances(i, latent, &t.base).frame(t.base).refine(t, REFINED))
    }
}

/// The settings with the default smoothing and weights: what is estimated of the blur does not follow the taste in results.
pub(super) fn for_estimates(settings: &deblur::Settings) -> deblur::Settings {
    let standard = deblur::Settings::default();
    deblur::Settings { lambda: standard.lambda, prior: Prior::Tv, robust: standard.robust, ..settings.clone() }
}

/// [`for_estimates`], quick: enough to refine TSFs against, or to see whether they explain their frames.
pub(super) fn for_first_round(settings: &deblur::Settings) -> deblur::Settings {
    for_estimates(&deblur::Settings { inner: settings.inner * 3 / 8, outer: FIRST_OUTER, ..settings.clone() })
}
