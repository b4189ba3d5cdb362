//! Which of red, green and blue to look at where a blur is estimated. A pixel says nothing there once one of them is clipped, and what no frame
//! knows adds unknown light to the pixels around it; in a scene lit by lamps red clips long before blue, before a blue sky it is the other way round.

use crate::exposure::Frame;
use crate::image::{Channels, Rgb};
use crate::mask;
use crate::merge::gradient_level;
use crate::noise::NoiseModel;

/// Error of an operator as a part of the structure around a pixel: structure beyond its inverse, in units of the noise, tells no more.
const MODEL_ERROR: f64 = 0.1;
/// Radius in pixels over which structure is averaged.
const AROUND: isize = 4;
/// Squared mean gradient of white noise of variance 1.
const NOISE_GRADIENT: f64 = std::f64::consts::PI;
/// Part of a frame that some channels have to see beyond what all three see for these to be looked at.
const SEEN: f64 = 0.02;
/// Information per frame, in parts of that of all three channels, that a choice of fewer has to bring: fewer are noisier, and less like the luminance.
const GAIN: f64 = 1.15;
/// Distance in pixels from what no frame knows up to which its light is counted with.
const UNKNOWN: usize = 10;

/// A bracket in the channels that are looked at.
struct Look<'a> {
    frames: &'a [Frame],
    channels: Channels,
    /// Where each frame is clipped.
    clipped: Vec<Vec<bool>>,
}

impl<'a> Look<'a> {
    fn new(frames: &'a [Frame], channels: Channels) -> Self {
        Self { frames, channels, clipped: frames.iter().map(|f| mask::clipped(f, channels)).collect() }
    }

    /// Pixels that the frames `ids` record, added up.
    fn recorded(&self, ids: &[usize]) -> usize {
        ids.iter().flat_map(|&i| &self.clipped[i]).filter(|c| !**c).count()
    }

    /// Pixels apart from those that the frames `by` all clip, as they lie.
    fn known(&self, by: &[usize]) -> Vec<bool> {
        let size = self.frames[0].intensity.size();
        let lost: Vec<bool> = (0..size.0 * size.1).map(|p| by.iter().all(|&k| self.clipped[k][p])).collect();
        mask::apart(&lost, size, UNKNOWN)
    }

    /// What the mean of the channels of the frame `i` (`exposure`: 1 = white) tells about its blur: the sum over the pixels `known` that it does
    /// not clip of squared gradients in units of the noise, as far as they count.
    fn information(&self, i: usize, exposure: &Rgb, noise: &NoiseModel, known: &[bool]) -> f64 {
        let mean = exposure.mean_of(self.channels);
        let structure = gradient_level(&mean, AROUND);
        let one = |p: usize| {
            let variance = noise.variance(f64::from(mean.data[p])) / self.channels.count() as f64;
            let signal = (f64::from(structure.data[p]).powi(2) - NOISE_GRADIENT * variance).max(0.0);
            signal / (variance + MODEL_ERROR.powi(2) * signal)
        };
        (0..known.len()).filter(|&p| known[p] && !self.clipped[i][p]).map(one).sum()
    }
}

/// The channels whose mean tells most about the blurs of the frames `blurred` (no frame's is bought with another's), the scene being known from
/// the frames `by`: indices into `frames`, whose exposures (1 = white) are `exposures`. All three channels where they clip together.
pub fn most_telling(frames: &[Frame], exposures: &[Rgb], blurred: &[usize], by: &[usize], noise: &NoiseModel) -> Channels {
    let all = Look::new(frames, Channels::ALL);
    let pixels: usize = blurred.iter().map(|&i| all.clipped[i].len()).sum();
    let least = all.recorded(blurred) + (SEEN * pixels as f64) as usize;
    let others: Vec<Look> = Channels::choices().skip(1).map(|c| Look::new(frames, c)).filter(|l| l.recorded(blurred) > least).collect();
    if others.is_empty() {
        return Channels::ALL;
    }
    let told = |look: &Look| {
        let known = look.known(by);
        blurred.iter().map(|&i| (1.0 + look.information(i, &exposures[i], noise, &known)).ln()).sum::<f64>()
    };
    let mut best = (told(&all) + blurred.len() as f64 * GAIN.ln(), Channels::ALL);
    for look in &others {
        let value = told(look);
        if value > best.0 {
            best = (value, look.channels);
        }
    }
    best.1
}
