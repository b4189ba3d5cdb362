//! Which of red, green and blue to look at where a blur is estimated. A pixel says nothing there once one of them is clipped, and what no frame
//! knows adds unknown light to the pixels around it; in a scene lit by lamps red clips long before blue, before a blue sky it is the other way round.

use crate::exposure::Frame;
use crate::image::{Channels, Rgb};
use crate::mask;
use crate::merge::gradient_level;
use crate::noise::FrameNoise;
use rayon::prelude::*;

/// Error of an operator as a part of the structure around a pixel: structure beyond its inverse, in units of the noise, tells no more.
const MODEL_ERROR: f64 = 0.1;
/// Radius in pixels over which structure is averaged.
const AROUND: usize = 4;
/// Squared mean gradient of white noise of variance 1.
const NOISE_GRADIENT: f64 = std::f64::consts::PI;
/// Part of a frame that some channels have to see beyond what all three see for these to be looked at.
const SEEN: f64 = 0.02;
/// Information per frame, in parts of that of all three channels, that a choice of fewer has to bring: fewer are noisier, and less like the luminance.
const GAIN: f64 = 1.15;
/// The same where a file holds colour more coarsely than brightness: by themselves its channels show a blur that no camera made.
const SUBSAMPLED_GAIN: f64 = 4.0;

/// Pixels apart from those that all of `frames`, as they lie, clip in `channels`.
fn known<'a>(frames: impl Iterator<Item = &'a Frame>, size: (usize, usize), channels: Channels) -> Vec<bool> {
    let mut lost = vec![true; size.0 * size.1];
    for frame in frames {
        lost.iter_mut().zip(mask::clipped(frame, channels)).for_each(|(l, c)| *l &= c);
    }
    mask::apart(&lost, size, mask::UNKNOWN)
}

/// What the mean of `channels` of an exposure (1 = white) tells about its blur: the sum over the pixels `seen` of squared gradients in units of the
/// noise, as far as they count.
fn information(exposure: &Rgb, channels: Channels, noise: &FrameNoise, seen: impl Fn(usize) -> bool + Sync) -> f64 {
    let mean = exposure.mean_of(channels);
    let structure = gradient_level(&mean, AROUND);
    let one = |p: usize| {
        let variance = noise.variance_of_mean(channels, f64::from(mean.data[p]));
        let signal = (f64::from(structure.data[p]).powi(2) - NOISE_GRADIENT * variance).max(0.0);
        signal / (variance + MODEL_ERROR.powi(2) * signal)
    };
    let row = |y: usize| -> f64 { (y * mean.width..(y + 1) * mean.width).filter(|&p| seen(p)).map(one).sum() };
    (0..mean.height).into_par_iter().map(row).collect::<Vec<f64>>().into_iter().sum()
}

/// The channels whose mean tells most about the blurs of the frames `blurred` (no frame's is bought with another's), the scene being known from
/// the frames `by`: indices into `frames`, whose exposures (1 = white) are `exposures`. All three channels where they clip together.
pub fn most_telling(frames: &[Frame], exposures: &[Rgb], blurred: &[usize], by: &[usize], noise: &[FrameNoise]) -> Channels {
    let gain = if blurred.iter().chain(by).any(|&i| frames[i].chroma_subsampled) { SUBSAMPLED_GAIN } else { GAIN };
    let clipped = |c: Channels| -> Vec<Vec<bool>> { blurred.iter().map(|&i| mask::clipped(&frames[i], c)).collect() };
    let recorded = |clipped: &[Vec<bool>]| clipped.iter().flatten().filter(|c| !**c).count();
    let all = clipped(Channels::ALL);
    let pixels: usize = all.iter().map(Vec::len).sum();
    let least = recorded(&all) + (SEEN * pixels as f64) as usize;
    let others: Vec<_> = Channels::choices().skip(1).map(|c| (c, clipped(c))).filter(|o| recorded(&o.1) > least).collect();
    if others.is_empty() {
        return Channels::ALL;
    }
    let told = |channels: Channels, clipped: &[Vec<bool>]| {
        let known = known(by.iter().map(|&k| &frames[k]), frames[0].intensity.size(), channels);
        let of = |(&i, clipped): (&usize, &Vec<bool>)| information(&exposures[i], channels, &noise[i], |p| known[p] && !clipped[p]);
        blurred.iter().zip(clipped).map(|b| (1.0 + of(b)).ln()).sum::<f64>()
    };
    let mut best = (told(Channels::ALL, &all) + blurred.len() as f64 * gain.ln(), Channels::ALL);
    for (channels, clipped) in &others {
        let value = told(*channels, clipped);
        if value > best.0 {
            best = (value, *channels);
        }
    }
    best.1
}
