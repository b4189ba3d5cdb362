//! From files to exposures: exposure times that the pixels contradict, f⁻¹(Z), noise, gain and black of each frame.

use super::engine::Memo;
use super::{Run, Settings};
use crate::error::Result;
use crate::exposure::{Bracket, Frame};
use crate::hot;
use crate::image::Rgb;
use crate::noise::{self, FrameNoise};
use crate::photometry;
use crate::response::{self, Response};

/// EV by which the pixels have to contradict a noted exposure for it to be replaced, and in standard deviations: what is less is found with the photometry, on registered
/// pixels.
const CONTRADICTED: (f64, f64) = (1.0, 4.0);
/// Relative error of an exposure that no noise explains: curve, flare, interpolation. It keeps a frame without noise from outvoting all others.
const MODEL: f64 = 0.01;

/// Exposures and what is known of them before the frames are placed.
#[derive(Clone)]
pub(super) struct Prepared {
    /// The bracket with other exposure times, where the pixels contradict those of the files.
    pub corrected: Option<Bracket>,
    pub exposures: Vec<Rgb>,
    pub noise: Vec<FrameNoise>,
    pub curves: Vec<[Vec<f32>; 3]>,
    pub exposure_errors: Vec<(f64, f64)>,
}

/// Whether an exposure's error, EV and its standard deviation, is such that the noted time is replaced.
fn contradicted((ev, deviation): &(f64, f64)) -> bool {
    ev.abs() > CONTRADICTED.0 && ev.abs() > CONTRADICTED.1 * deviation
}

/// Exposures of `bracket` and their noise, found or remembered.
pub(super) fn prepared(memo: &mut Memo, bracket: &Bracket, response: &Response, settings: &Settings) -> Prepared {
    if let Some((found, _)) = memo.recall::<Prepared>("exposures") {
        return found;
    }
    let frames = bracket.frames();
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, response)).collect();
    let noise = noise::estimate(frames, &exposures, response);
    let exposure_errors = response::exposure_errors(bracket, response, &noise);
    let corrected = exposure_errors.iter().any(contradicted).then(|| {
        let time = |(f, e): (&Frame, &(f64, f64))| f.exposure_time * if contradicted(e) { e.0.exp2() } else { 1.0 };
        bracket.with_exposure_times(frames.iter().zip(&exposure_errors).map(time))
    });
    let noise = settings.noise.map_or(noise, |given| noise::alike(frames.len(), given));
    let curves = with_model(noise::curves(frames, response, &noise));
    let found = Prepared { corrected, exposures, noise, curves, exposure_errors };
    let pixels: usize = found.exposures.iter().map(|e| e.width() * e.height()).sum();
    memo.keep("exposures", &found, 0, 12 * pixels);
    found
}

/// Standard deviations with the model's own error.
fn with_model(mut curves: Vec<[Vec<f32>; 3]>) -> Vec<[Vec<f32>; 3]> {
    for curve in curves.iter_mut().flatten() {
        let last = (curve.len() - 1) as f64;
        for (k, s) in curve.iter_mut().enumerate() {
            let x = (k as f64 / last).powi(2);
            *s = f64::from(*s).hypot(MODEL * x) as f32;
        }
    }
    curves
}

impl Run<'_> {
    /// Says which exposure times were replaced.
    pub(super) fn tell_of_exposures(&mut self) -> Result<()> {
        let texts: Vec<String> = self
            .exposure_errors
            .iter()
            .zip(self.bracket.frames())
            .filter(|(error, _)| contradicted(error))
            .map(|((ev, _), f)| format!("{} {ev:+.1} EV", f.name))
            .collect();
        if texts.is_empty() {
            return Ok(());
        }
        self.warn(format!("the frames' pixels contradict the noted exposures: {}; they are merged as the pixels have it", texts.join(", ")))
    }

    /// Noise of the exposures as the files have them, by what the frames `ids`, where they lie, leave of each other; as given where the user gave it.
    pub(super) fn noise_beside_each_other(&self, ids: &[usize]) -> Vec<FrameNoise> {
        if self.settings.noise.is_some() {
            return self.noise.clone();
        }
        noise::estimate_registered(self.bracket.frames(), &self.exposures, self.response, (ids, &self.motions), &self.noise)
    }

    /// Standard deviations of the exposures by noise and rounding alone.
    pub(super) fn curves_of_noise(&self) -> Vec<[Vec<f32>; 3]> {
        self.curves_under(&self.noise)
    }

    /// Standard deviations of the exposures as they are by `noise` and rounding.
    fn curves_under(&self, noise: &[FrameNoise]) -> Vec<[Vec<f32>; 3]> {
        let gains: Vec<[f64; 3]> = self.photometry.iter().map(photometry::FramePhotometry::factors).collect();
        noise::curves_of(self.bracket.frames(), self.response, noise, &gains)
    }

    /// [`Run::curves_of_detail`] of frame `i` alone.
    pub(super) fn curve_of_detail(&self, i: usize) -> [Vec<f32>; 3] {
        let (noise, gain) = (self.noise[i].of_detail(), self.photometry[i].factors());
        noise::curves_of(&self.bracket.frames()[i..=i], self.response, &[noise], &[gain]).remove(0)
    }

    /// Standard deviations of the exposures' noise as pixels show it against their neighbours.
    pub(super) fn curves_of_detail(&self) -> Vec<[Vec<f32>; 3]> {
        self.curves_under(&self.noise.iter().map(FrameNoise::of_detail).collect::<Vec<_>>())
    }

    /// Replaces what the hot pixels at `places` spoil, once: exposures are as the files have them again.
    pub(super) fn take_hot_pixels(&mut self, places: &[usize]) -> Result<()> {
        if places.is_empty() || self.repaired.get().is_some() {
            return Ok(());
        }
        let repaired = hot::repaired(self.bracket, places)?;
        self.bracket = self.repaired.get_or_init(|| repaired);
        self.exposures = self.bracket.frames().iter().map(|f| noise::exposure(f, self.response)).collect();
        self.hot_pixels = hot::sites(places, self.bracket.size().0);
        Ok(())
    }

    /// `noise` and `found` as noise and photometry of exposures that are as the files have them; from here on gain and black are taken off these.
    pub(super) fn take_photometry(&mut self, noise: Vec<FrameNoise>, found: Vec<photometry::FramePhotometry>) {
        self.noise = noise;
        for (i, one) in found.iter().enumerate() {
            if *one != photometry::FramePhotometry::AS_NOTED {
                self.exposures[i] = one.corrected(&self.exposures[i]);
                self.noise[i] = self.noise[i].scaled(one.factors());
            }
        }
        self.photometry = found;
        self.curves = with_model(self.curves_of_noise());
    }
}
