//! The program's own result on a bracket, in the form that experiments and baselines need.

use crate::error::Result;
use crate::exposure::Bracket;
use crate::image::Rgb;
use crate::pipeline::{self, Event, Settings};
use crate::pose::Pose;
use crate::response::Response;
use crate::tsf::{Model, Tsf, TsfEntry, TsfFile};
use serde_json::Value;

/// What the program itself finds: irradiance per second, TSFs, the sharp frames.
pub struct Joint {
    /// Irradiance per second on the reference frame's grid.
    pub irradiance: Rgb,
    /// The TSF of each frame; the identity where none was found.
    pub tsfs: Vec<Tsf>,
    /// The frames (0-based) found to be sharp; without one the shortest.
    pub sharp: Vec<usize>,
    /// The merge's report.
    pub report: Value,
}

impl Joint {
    /// Runs the pipeline; arguments and errors are [`pipeline::merge`]'s.
    ///
    /// # Errors
    /// Those of the pipeline.
    pub fn new(
        bracket: &Bracket,
        response: &Response,
        settings: &Settings,
        tsf: Option<&TsfFile>,
        events: &mut dyn FnMut(Event) -> bool,
    ) -> Result<Self> {
        let outcome = pipeline::merge(bracket, response, settings, tsf, events)?;
        let seconds = bracket.frames()[outcome.reference].exposure_time as f32;
        let entries = outcome.report["frames"].as_array().cloned().unwrap_or_default();
        let found = |e: &Value| {
            let entry: Option<TsfEntry> = serde_json::from_value(e["tsf"].clone()).ok();
            let tsf = entry.map(|e| TsfFile::new(vec![e.clone()]).find(&e.frame, e.width, e.height));
            tsf.and_then(|t| t.ok().flatten()).unwrap_or_else(Tsf::identity)
        };
        let tsfs = entries.iter().map(found).collect();
        let sharp: Vec<usize> = (0..entries.len()).filter(|&i| entries[i]["sharp"].as_bool() == Some(true)).collect();
        // Without a sharp frame the shortest is the least shaken.
        let all: Vec<usize> = (0..entries.len()).collect();
        let sharp = if sharp.is_empty() { bracket.shortest(&all).into_iter().collect() } else { sharp };
        Ok(Self { irradiance: outcome.irradiance.map_planes(|p| p.map(|v| v / seconds)), tsfs, sharp, report: outcome.report })
    }

    /// The same bracket with blur that is the same everywhere, as P.-Y. Lu et al. ("High dynamic range image reconstruction from
    /// hand-held cameras", 2009) have it, whose program is not published: the program restricted to translations. Where no frame is sharp, the translations of the TSFs
    /// that were found with roll, which favours it.
    ///
    /// # Errors
    /// Those of the pipeline.
    pub fn uniform(
        &self,
        bracket: &Bracket,
        response: &Response,
        settings: &Settings,
        events: &mut dyn FnMut(Event) -> bool,
    ) -> Result<Self> {
        let settings = Settings { model: Model::Translation, ..settings.clone() };
        if self.tsfs.iter().any(|t| t.single().is_some()) {
            return Self::new(bracket, response, &settings, None, events);
        }
        let (w, h) = bracket.size();
        let entry = |(tsf, frame): (&Tsf, &crate::exposure::Frame)| {
            let shift = |p: &Pose| {
                let middle = p.apply(tsf.focal_px, glam::DVec2::ZERO);
                Pose::planar(middle.x, middle.y, 0.0, p.weight)
            };
            let poses = tsf.poses.iter().map(shift).collect();
            TsfEntry::new(&frame.name, w, h, &Tsf { poses, ..tsf.clone() })
        };
        let file = TsfFile::new(self.tsfs.iter().zip(bracket.frames()).map(entry).collect());
        Self::new(bracket, response, &settings, Some(&file), events)
    }
}
