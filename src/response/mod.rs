//! Camera response f and its inverse: irradiance B = f⁻¹(Z)/Δt (section II-A). No blur.

mod automatic;
mod calibrate;
mod displacement;
mod file;
mod mitsunaga;
mod posterior;
mod prior;
mod reduce;
mod shades;

pub use automatic::{
    Automatic, DISAGREEMENT_EV, ExposureCheck, OfStillFrames, automatic, check_exposures, exposure_errors, of_still_frames,
};
pub use calibrate::calibrate;
pub use file::{InverseTables, Provenance, ResponseFile};
pub use mitsunaga::{Polynomial, mitsunaga};
pub use reduce::reduced;

use crate::error::{Error, Result};

/// Camera response f, per channel, normalised so that f(0) = 0 and f(1) = 1.
#[derive(Clone, Debug, PartialEq)]
pub enum Response {
    /// The sRGB curve.
    Srgb,
    /// Intensity is proportional to irradiance.
    Linear,
    /// Z = x^(1/γ).
    Gamma(f64),
    /// f⁻¹ sampled at equal steps of Z from 0 to 1, one non-decreasing table per channel, last value 1.
    Table([Vec<f64>; 3]),
}

impl Response {
    /// The response that `word` names: `srgb`, `linear` or `gamma:2.2`; `None` for other words (names of files).
    ///
    /// # Errors
    /// [`Error::Input`] for a γ that is not a number from 0.1 to 10.
    pub fn named(word: &str) -> Result<Option<Self>> {
        match word {
            "srgb" => Ok(Some(Self::Srgb)),
            "linear" => Ok(Some(Self::Linear)),
            _ => {
                let Some(number) = word.strip_prefix("gamma:") else { return Ok(None) };
                match number.parse::<f64>() {
                    Ok(g) if (0.1..=10.0).contains(&g) => Ok(Some(Self::Gamma(g))),
                    _ => Err(Error::Input(format!("{number:?} is not a gamma; give a number from 0.1 to 10, such as gamma:2.2"))),
                }
            }
        }
    }

    /// What it is called: `srgb`, `linear`, `gamma:2.2`, or `table` for a calibrated one.
    pub fn name(&self) -> String {
        match self {
            Self::Srgb => "srgb".into(),
            Self::Linear => "linear".into(),
            Self::Gamma(g) => format!("gamma:{g}"),
            Self::Table(_) => "table".into(),
        }
    }

    /// f⁻¹: relative exposure x = E Δt (1 is white) of intensity `z` in 0..=1.
    pub fn inverse(&self, channel: usize, z: f64) -> f64 {
        let z = z.clamp(0.0, 1.0);
        match self {
            Self::Srgb if z <= 0.04045 => z / 12.92,
            // Not the machine's own power: synthetic brackets are to be the same everywhere.
            Self::Srgb => libm::pow((z + 0.055) / 1.055, 2.4),
            Self::Linear => z,
            Self::Gamma(g) => libm::pow(z, *g),
            Self::Table(t) => {
                let t = &t[channel];
                let s = z * (t.len() - 1) as f64;
                let i = (s as usize).min(t.len() - 2);
                t[i] + (t[i + 1] - t[i]) * (s - i as f64)
            }
        }
    }

    /// Slope of f⁻¹ at `z` by central difference of width `step`.
    pub fn inverse_slope(&self, channel: usize, z: f64, step: f64) -> f64 {
        let (a, b) = ((z - step).max(0.0), (z + step).min(1.0));
        (self.inverse(channel, b) - self.inverse(channel, a)) / (b - a)
    }
}
