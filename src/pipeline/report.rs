//! The outcome of a merge and its report: the only place that knows the report's keys.

use super::plan::State;
use super::{Outcome, Run};
use crate::deblur::Solution;
use crate::error::Result;
use crate::image::{Plane, Rgb};
use crate::mask;
use crate::merge;
use crate::tsf::{Tsf, TsfEntry};
use serde_json::{Value, json};

impl Run<'_> {
    /// The outcome of a merge that was solved.
    pub(super) fn finish(mut self, solution: Solution, state: State) -> Result<Outcome> {
        let all = state.all();
        let State { reference, judgements, still, tsfs, details, .. } = state;
        let frames = self.bracket.frames();
        let (w, h) = self.bracket.size();
        let mut irradiance = solution.cropped();
        // What a blurred frame clips, blur has spread: it bounds nothing.
        let unblurred: Vec<usize> = all.iter().copied().filter(|&i| tsfs[i].as_ref().is_none_or(|t| t.single().is_some())).collect();
        merge::raise_to_lower_bound(&mut irradiance, self.bracket, &self.exposures, &unblurred, &self.motions);
        let scale = frames[reference].exposure_time as f32;
        let irradiance = irradiance.map_planes(|p| p.map(|v| v * scale));
        let entries: Vec<Value> = (0..frames.len())
            .map(|i| {
                let position = all.iter().position(|&k| k == i);
                json!({
                    "frame": frames[i].name,
                    "exposure_time_s": frames[i].exposure_time,
                    "used": position.is_some(),
                    "sharp": still.contains(&i),
                    "judgement": judgements[i],
                    "noise": self.noise[i],
                    "photometry": self.photometry[i],
                    "exposure_difference_ev": self.exposure_errors[i].0,
                    "exposure_deviation_ev": self.exposure_errors[i].1,
                    "registration": self.registrations[i],
                    "chi_squared": position.map(|p| solution.report.chi_squared[p]),
                    "ghosts": self.ghosts[i].as_ref().map(|g| 1.0 - g.data.iter().map(|v| f64::from(*v)).sum::<f64>() / g.data.len() as f64),
                    "aliasing_rms": self.aliasing[i].as_ref().map(root_mean_square),
                    "blur": details[i],
                    "tsf": tsfs[i].as_ref().map(|t| TsfEntry::new(&frames[i].name, w, h, t)),
                })
            })
            .collect();
        let blind = self.blind_report();
        let report = json!({
            "format": "unshaken-report",
            "version": 2,
            "program": concat!("unshaken ", env!("CARGO_PKG_VERSION")),
            "adapter": self.gpu.description,
            "size": [w, h],
            "reference": frames[reference].name,
            "scale": { "rule": "value = irradiance * exposure time of the reference frame", "factor_s": scale },
            "blind": blind,
            "frames": entries,
            "hot_pixels": self.hot_pixels,
            "degraded": self.degraded,
            "left_out": self.left_out.iter().map(|(frame, why)| json!({ "frame": frame, "reason": why })).collect::<Vec<_>>(),
            "solver": solution.report,
            "timings_s": std::mem::take(&mut self.timings),
        });
        let mut misfit: Vec<Option<Plane>> = vec![None; frames.len()];
        for (&i, plane) in all.iter().zip(solution.misfit) {
            misfit[i] = Some(plane);
        }
        let places = (0..frames.len()).map(|i| tsfs[i].as_ref().map_or(self.motions[i], Tsf::centre)).collect();
        let masks = (0..frames.len()).map(|i| self.counting(i, &mask::spoilt_channels(&frames[i]))).collect();
        let Self { left_out, degraded, noise, .. } = self;
        Ok(Outcome { irradiance, reference, left_out, degraded, places, masks, misfit, noise, report })
    }
}

/// Over all values of all channels.
fn root_mean_square(image: &Rgb) -> f64 {
    let squares = image.0.iter().flat_map(|p| &p.data).map(|v| f64::from(v * v));
    (squares.sum::<f64>() / (3 * image.width() * image.height()) as f64).sqrt()
}
