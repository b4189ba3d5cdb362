//! Blurs of shaken frames against the irradiance that others show: their TSFs, their PSFs, and whether they explain them.

use super::Run;
use crate::channels;
use crate::deblur::{self, Prior};
use crate::error::Result;
use crate::image::{Channels, Plane, Rgb};
use crate::merge;
use crate::pose::project;
use crate::psf;
use crate::register;
use crate::tsf::{self, Search, Tsf, WholeFrame};
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use serde_json::{Value, json};

/// Iterations of [`Run::refine`].
const REFINED: usize = 8;
/// Squared residual over noise variance up to which a blurred frame is believed whatever else holds: true TSFs reach 1 to 2 on noisy
/// frames, more on clean ones, where the interpolation's own error shows.
const HOPELESS: f64 = 8.0;
/// Squares along the longer side over which that is judged, their least side in pixels, and how many have to speak.
const SQUARES: usize = 48;
const LEAST_SQUARE: usize = 8;
const FEWEST_SQUARES: usize = 6;
/// Where a frame's blur leaves far more than noise, it must explain all but this part of what the sharp frames alone, unblurred, leave unexplained.
pub(super) const UNEXPLAINED: f64 = 0.25;
/// Length in pixels ([`tsf::stroke`]) from which it has to: a shorter blur leaves as much more of it as it is shorter, since lamps and edges as hard
/// as a pixel show what the warps cannot (under one of 1.5 px half of it and more).
pub(super) const LONG: f64 = 12.0;
/// Extent in pixels below which a blur is slight: without it the deblurred scene explains its frame nearly as well, so that it is not judged by that.
pub(super) const SLIGHT: f64 = 4.0;
/// Outer iterations of the rounds before the last.
const FIRST_OUTER: usize = 2;
/// Local PSFs per blurred frame.
const PATCHES: usize = 9;
/// Side of a patch in pixels.
const PATCH_SIZE: usize = 96;
/// Pixels around the path of a blur at a patch in which its PSF is looked for.
const PSF_MARGIN: isize = 3;
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

impl Run<'_> {
    /// Whether the blur of frame `i` fails to explain it: `misfit` is the local χ² with it, `start` the irradiance before the frame counted.
    /// Judged over squares of the frame in which one or the other is far above the noise, by the one in the middle: what moved, or a lamp
    /// that blur spreads beyond white, is a part of the frame and not its shake. It fails where it leaves more than `most` of what is left without; the χ² of
    /// the square in the middle, where it does.
    pub(super) fn unexplained(&self, i: usize, misfit: &Plane, start: &Rgb, most: f64) -> Option<f64> {
        let without = self.unblurred(i, start);
        let (w, h) = misfit.size();
        let side = (w.max(h) / SQUARES).max(LEAST_SQUARE);
        let mut squares: Vec<(f64, f64)> = Vec::new();
        for y in (0..h).step_by(side) {
            for x in (0..w).step_by(side) {
                let (mut with_blur, mut unblurred, mut count) = (0.0, 0.0, 0);
                for p in (y..(y + side).min(h)).flat_map(|y| (x..(x + side).min(w)).map(move |x| y * w + x)) {
                    if without.data[p].is_finite() {
                        with_blur += f64::from(misfit.data[p]);
                        unblurred += f64::from(without.data[p]);
                        count += 1;
                    }
                }
                let (c, u) = (with_blur / f64::from(count), unblurred / f64::from(count));
                if count as usize >= side * side / 4 && c.max(u) > HOPELESS {
                    squares.push((c, c / u));
                }
            }
        }
        if squares.len() < FEWEST_SQUARES {
            return None;
        }
        let middle = |mut v: Vec<f64>| {
            v.sort_by(f64::total_cmp);
            v[v.len() / 2]
        };
        let chi = middle(squares.iter().map(|s| s.0).collect());
        let left = middle(squares.iter().map(|s| s.1).collect());
        (chi > HOPELESS && left > most).then_some(chi)
    }

    /// Squared residual over variance of frame `i` against the irradiance `latent`, moved but not blurred; NaN where it is masked.
    fn unblurred(&self, i: usize, latent: &Rgb) -> Plane {
        let (exposure, mask) = (&self.exposures[i], &self.masks[i]);
        let (seen, inside) = self.seen(latent, &self.motions[i]);
        let mask = mask.zip(&inside, |m, k| m * k);
        merge::misfit(&seen, exposure, &mask, &self.curves[i], self.bracket.frames()[i].exposure_time)
    }

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
        let count = channels.count() as f32;
        let (seen, inside) = self.seen(latent, motion);
        let seen = seen.mean_of(channels);
        let exposure = self.exposures[i].mean_of(channels);
        let local = merge::gradient_level(&seen, 4);
        let weight = Plane {
            data: (0..exposure.data.len())
                .map(|p| {
                    let m = mask.data[p];
                    // An operator is never true to better than some per cent of the structure around a pixel.
                    let variance =
                        self.noise.variance(f64::from(exposure.data[p])) as f32 / count / (dt * dt) + (MODEL_ERROR * local.data[p]).powi(2);
                    m * m / variance * inside.data[p]
                })
                .collect(),
            ..exposure
        };
        Luminances { latent: latent.mean_of(channels), seen, blurred: exposure.map(|v| v / dt), weight }
    }

    /// TSF of frame `i` against the sharp irradiance, about where the frame lies, and what is known of it.
    pub(super) fn estimate(
        &self,
        i: usize,
        latent: &Rgb,
        how: impl Fn(&WholeFrame, &Search) -> Option<tsf::Estimate>,
    ) -> (Option<Tsf>, Value) {
        let base = self.base(i);
        let luminances = self.luminances(i, latent, &base);
        let frame = luminances.frame(base);
        let search = Search { model: self.settings.model, focal_px: self.settings.focal_px, stop: self.stop.clone() };
        let Some(found) = how(&frame, &search).filter(tsf::Estimate::is_sound) else { return (None, Value::Null) };
        let detail = json!({
            "model": found.model,
            "focal_px": found.tsf.focal_px,
            "focal_length": found.focal,
            "models_tried": found.trials,
            "still_worse_by": found.still_worse_by,
            "blank_worse_by": found.blank_worse_by,
            "estimated_at_scale": found.scale,
            "extent_px": tsf::extent(&found.tsf, latent.width(), latent.height()),
            "residual": found.residual,
            "channels": self.looks[i].0.names(),
        });
        (Some(found.tsf), detail)
    }

    /// Those of the frames `ids` whose blur seems long are looked at once more, as if it were slight: beside lamps far poses answer to what the sharp
    /// frames lack, and a blur of a pixel or two passes for a long one. Whether any has another TSF now. `start`: irradiance before the frames counted.
    pub(super) fn look_for_slight(
        &mut self,
        ids: &[usize],
        start: &Rgb,
        tsfs: &mut [Option<Tsf>],
        details: &mut [Value],
        fraction: f32,
    ) -> Result<bool> {
        let (w, h) = self.bracket.size();
        let mut any = false;
        for &i in ids {
            if tsfs[i].as_ref().is_none_or(|t| tsf::extent(t, w, h) <= SLIGHT) {
                continue;
            }
            self.progress(&format!("looking whether the blur of {} is slight", self.bracket.frames()[i].name), fraction)?;
            let own = format!("slight {i} {:?} {:?}", self.settings.model, self.settings.focal_px);
            let look = |run: &mut Self| Ok(run.estimate(i, start, |frame, search| frame.estimate_slight(search)));
            if let (Some(tsf), detail) = self.remembered("blur", &own, |_| 0, look)? {
                (tsfs[i], details[i], any) = (Some(tsf), detail, true);
            }
        }
        Ok(any)
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
