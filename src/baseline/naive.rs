//! Each shaken frame deblurred by itself, then merged as if it had been sharp: what the frames could tell each other is lost.

use super::merge;
use crate::deblur::{self, Observation, Settings};
use crate::error::Result;
use crate::exposure::{Bracket, Frame};
use crate::gpu::Gpu;
use crate::image::{Channels, Rgb};
use crate::kernels::Kernels;
use crate::mask;
use crate::merge as start;
use crate::noise;
use crate::response::Response;
use crate::tsf::Tsf;
use glam::DMat3;

/// Deblurs every frame whose TSF in `tsfs` is not the identity (a displaced sharp one is put in place) by itself, with the solver and the settings that deblur all frames
/// together, and merges the results with the sharp frames by [`merge`]; in irradiance per second. The TSFs may have been estimated
/// with the sharp frames' help, which favours this method: a blind deconvolution of one frame knows less.
///
/// # Errors
/// The GPU's; `Cancelled` when `progress` returns `false`.
pub fn deblur_each(
    bracket: &Bracket,
    response: &Response,
    tsfs: &[Tsf],
    settings: &Settings,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Rgb> {
    let frames = bracket.frames();
    let (width, height) = bracket.size();
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, response)).collect();
    let level = noise::estimate(frames, &exposures, response);
    let curves = noise::curves(frames, response, &level);
    // Without a low taper no frame looks at another, and where they lie does not matter.
    let masks = mask::masks(frames, &vec![false; frames.len()], 0.0, &vec![DMat3::IDENTITY; frames.len()], Channels::ALL);
    let shaken: Vec<usize> = (0..frames.len()).filter(|&i| !tsfs[i].is_identity()).collect();
    let gpu = Gpu::new()?;
    let kernels = Kernels::new(&gpu);
    let mut restored: Vec<Frame> = frames.to_vec();
    for (k, &i) in shaken.iter().enumerate() {
        let pad = deblur::pad_for(&[&tsfs[i]], width, height, width.max(height) / 6);
        let blurred = start::irradiance(bracket, &exposures, &masks, &curves, &[i]);
        let observation = Observation {
            exposure: exposures[i].clone(),
            mask: masks[i].clone(),
            exposure_time: frames[i].exposure_time,
            noise: curves[i].clone(),
            black_clipped: true,
            tsf: tsfs[i].clone(),
        };
        let mut part = |f: f32| progress((k as f32 + f) / shaken.len() as f32);
        let solved = deblur::solve(&gpu, &kernels, &[observation], &blurred.map_planes(|p| p.padded(pad)), pad, settings, &mut part)?;
        let dt = frames[i].exposure_time as f32;
        // What the frame clipped stays clipped in the merge; elsewhere the restored exposure takes the place of the intensity.
        let clipped = mask::clipped(&frames[i], Channels::ALL);
        let mut exposure = solved.cropped().map_planes(|p| p.map(|v| (v * dt).clamp(0.0, 0.999)));
        for p in exposure.0.iter_mut() {
            p.data.iter_mut().zip(&clipped).filter(|(_, c)| **c).for_each(|(v, _)| *v = 1.0);
        }
        restored[i].intensity = exposure;
    }
    // Restored frames hold exposures: the sharp ones are made to hold them too, and the merge sees a linear camera.
    for (i, frame) in restored.iter_mut().enumerate() {
        if tsfs[i].is_identity() {
            frame.intensity = exposures[i].clone();
        }
    }
    let all: Vec<usize> = (0..frames.len()).collect();
    Ok(merge(&Bracket::new(restored)?, &Response::Linear, &all))
}
