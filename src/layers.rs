//! What a result rests on, pixel by pixel: for the further channels of the OpenEXR file and for the report.

use crate::exposure::Bracket;
use crate::image::Plane;
use crate::mask::CLIPPED;
use crate::pipeline::Outcome;
use crate::pose::nearest_pixel;
use crate::response::Response;
use glam::DMat3;
use rayon::prelude::*;

/// What a result rests on, each plane on the pixels of the result.
#[derive(Clone, Debug)]
pub struct Grounds {
    /// Of each used frame (its index), 1 over the variance of what it says of the irradiance, in units of the result (1 = the reference
    /// frame's white), green channel; 0 where the frame is clipped or does not reach.
    pub information: Vec<(usize, Plane)>,
    /// Part of the used frames that reach a pixel and are clipped there, 0..=1.
    pub saturation: Plane,
}

/// Information and saturation of the frames that `outcome` used, looked up where registration places them (nearest pixel; of shaken frames
/// the mean pose).
pub fn grounds(bracket: &Bracket, response: &Response, outcome: &Outcome) -> Grounds {
    let frames = bracket.frames();
    let (width, height) = bracket.size();
    let used: Vec<usize> = (0..frames.len()).filter(|&i| outcome.misfit[i].is_some()).collect();
    let scale = frames[outcome.reference].exposure_time;
    let result = &outcome.irradiance.0[1].data;
    let clipped = |i: usize, p: usize| there(outcome, i, p).map(|q| frames[i].intensity.0.iter().any(|plane| plane.data[q] >= CLIPPED));
    let information = used
        .iter()
        .map(|&i| {
            // From the result's unit to the frame's exposure.
            let gain = frames[i].exposure_time / scale;
            let curve = outcome.noise[i].channels[1].curve(response, 1, frames[i].levels);
            let last = (curve.len() - 1) as f64;
            let data = (0..width * height)
                .into_par_iter()
                .map(|p| {
                    if clipped(i, p) != Some(false) {
                        return 0.0;
                    }
                    let x = (f64::from(result[p]) * gain).clamp(0.0, 1.0);
                    let deviation = f64::from(curve[(x.sqrt() * last) as usize]) / gain;
                    (1.0 / (deviation * deviation)) as f32
                })
                .collect();
            (i, Plane { width, height, data })
        })
        .collect();
    let share = |p: usize| {
        let seen: Vec<bool> = used.iter().filter_map(|&i| clipped(i, p)).collect();
        seen.iter().filter(|c| **c).count() as f32 / seen.len().max(1) as f32
    };
    let saturation = (0..width * height).into_par_iter().map(share).collect();
    Grounds { information, saturation: Plane { width, height, data: saturation } }
}

/// Pixel of frame `i` that sees the result's pixel `p`; `None` beyond the frame's border.
fn there(outcome: &Outcome, i: usize, p: usize) -> Option<usize> {
    let (place, (w, h)) = (&outcome.places[i], outcome.irradiance.size());
    if *place == DMat3::IDENTITY { Some(p) } else { nearest_pixel(place, w, h, p % w, p / w) }
}

/// The further channels: `confidence.Y`, E/(E + its standard deviation) by what noise allows, 0..=1; `saturation.Y`, the part of the used
/// frames that are clipped there; `residual.Y`, the largest local χ² of the frames (1 is what noise explains); `weight.frameN`, the part of the
/// information that comes from frame N.
pub fn layers(bracket: &Bracket, response: &Response, outcome: &Outcome) -> Vec<(String, Plane)> {
    let grounds = grounds(bracket, response, outcome);
    let (width, height) = bracket.size();
    let count = width * height;
    let mut total = vec![0f32; count];
    for (_, plane) in &grounds.information {
        total.iter_mut().zip(&plane.data).for_each(|(t, v)| *t += v);
    }
    let of = |f: &(dyn Fn(usize) -> f32 + Sync)| Plane { width, height, data: (0..count).into_par_iter().map(f).collect() };
    let result = &outcome.irradiance.0[1].data;
    let confidence = of(&|p| if total[p] > 0.0 { result[p] / (result[p] + total[p].sqrt().recip()) } else { 0.0 });
    let residual = of(&|p| {
        let of_frame = |(i, m): (usize, &Option<Plane>)| Some(m.as_ref()?.data[there(outcome, i, p)?]).filter(|v| v.is_finite());
        outcome.misfit.iter().enumerate().filter_map(of_frame).fold(0.0, f32::max)
    });
    let mut layers = vec![
        ("confidence.Y".to_string(), confidence),
        ("saturation.Y".to_string(), grounds.saturation),
        ("residual.Y".to_string(), residual),
    ];
    for (i, plane) in grounds.information {
        layers.push((format!("weight.frame{}", i + 1), of(&|p| if total[p] > 0.0 { plane.data[p] / total[p] } else { 0.0 })));
    }
    layers
}
