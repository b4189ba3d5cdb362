//! Irradiance from frames whose blurs are known, and what sharp frames do not agree about.

use super::shaken::for_estimates;
use super::{Estimate, Event, Run};
use crate::deblur::{self, Observation, Solution};
use crate::error::{Error, Result};
use crate::ghosts;
use crate::image::{Plane, Rgb};
use crate::tsf::Tsf;
use glam::DMat3;

impl Run<'_> {
    /// Solves for the frames `ids`; progress runs from `from` to `to`.
    pub(super) fn solve(
        &mut self,
        ids: &[usize],
        tsfs: &[Option<Tsf>],
        initial: &Rgb,
        pad: usize,
        settings: &deblur::Settings,
        from: f32,
        to: f32,
    ) -> Result<Solution> {
        let (w, h) = self.bracket.size();
        // Displaced sharp frames that need no operator are read at the reference's pixels; where they lie.
        let observed = |&i: &usize| {
            let own = self.observation(i, tsfs[i].clone().unwrap_or_else(Tsf::identity));
            let read = own.tsf.single().filter(|_| !self.pixel_sharp && !own.tsf.is_identity());
            (if let Some(motion) = &read { own.in_place(motion) } else { own }, read)
        };
        let (mut observations, read): (Vec<Observation>, Vec<Option<DMat3>>) = ids.iter().map(observed).unzip();
        if pad == 0 {
            observations.extend(self.at_the_border(ids, &observations));
        }
        let moving = observations.iter().any(|o| !o.tsf.is_identity());
        let stage = if moving { "deblurring" } else { "merging the sharp frames" };
        self.progress(stage, from)?;
        let events = std::cell::RefCell::new(&mut self.events);
        let mut watch = |planes: &[wgpu::Buffer; 3]| {
            let estimate = Estimate { planes: planes.clone(), width: w, height: h, pad, scale: self.scale };
            events.borrow_mut()(Event::Estimate(estimate));
        };
        let mut hear = |f: f32| events.borrow_mut()(Event::Progress { stage: stage.into(), fraction: from + (to - from) * f });
        let mut solved = deblur::solve_watched(self.gpu, self.kernels, &observations, initial, pad, settings, &mut watch, &mut hear)?;
        solved.misfit.truncate(ids.len());
        for (misfit, motion) in solved.misfit.iter_mut().zip(&read) {
            if let Some(motion) = motion {
                *misfit = deblur::on_own_pixels(misfit, motion);
            }
        }
        solved.report.chi_squared.truncate(ids.len());
        if solved.report.memory.reduced {
            self.warn("the GPU's memory is short: the work is done in smaller pieces, which takes longer".into())?;
        }
        Ok(solved)
    }

    /// Where the sharp frames `still` do not show the same scene, and which of them counts there.
    pub(super) fn find_ghosts(&mut self, still: &[usize]) -> Result<()> {
        if !self.settings.deghost || still.len() < 2 {
            return Ok(());
        }
        let bytes = |found: &Vec<Option<Plane>>| found.iter().flatten().map(|f| 4 * f.data.len()).sum();
        let found = self.remembered("ghosts", &format!("{still:?}"), bytes, |run| {
            let Run { exposures, noise, motions, .. } = &*run;
            let curves = &run.curves_of_noise();
            Ok(ghosts::Sharp { frames: run.bracket.frames(), exposures, curves, noise, motions, ids: still }.shares())
        })?;
        for (&i, share) in still.iter().zip(found) {
            self.ghosts[i] = share;
        }
        Ok(())
    }

    /// What the displaced ones of the sharp frames `still` show of structure finer than the latent grid, unless that is known. `latent`: irradiance as it
    /// is known. Progress runs from `from` to `to`.
    pub(super) fn find_aliasing(&mut self, still: &[usize], shaken: &[usize], latent: &Rgb, from: f32, to: f32) -> Result<()> {
        if !self.pixel_sharp || !self.settings.between_pixels || still.len() < 2 || self.aliasing.iter().any(Option::is_some) {
            return Ok(());
        }
        let settings = for_estimates(&self.settings.deblur);
        let bytes = |found: &Vec<Option<Rgb>>| found.iter().flatten().map(|f| 12 * f.width() * f.height()).sum();
        let found = self.remembered("aliasing", &format!("{shaken:?} {settings:?}"), bytes, |run| {
            let observations: Vec<Observation> = still.iter().map(|&i| run.observation(i, Tsf::still(run.motions[i]))).collect();
            let pad = run.pad(observations.iter().map(|o| &o.tsf));
            let start = run.surrounded(latent, 0, pad, still, shaken);
            let mut hear = |f: f32| {
                (run.events)(Event::Progress {
                    stage: "looking between the pixels of displaced frames".into(),
                    fraction: from + (to - from) * f,
                })
            };
            match deblur::aliasing(run.gpu, run.kernels, &observations, &start, pad, &settings, deblur::TILE, &mut hear) {
                Err(Error::OutOfMemory(_) | Error::Adapter(_)) => {
                    run.warn(
                        "the GPU's memory is too short to look between the pixels of displaced frames: hard edges come out softer".into(),
                    )?;
                    Ok(vec![None; still.len()])
                }
                found => found,
            }
        })?;
        for (&i, found) in still.iter().zip(found) {
            self.aliasing[i] = found;
        }
        Ok(())
    }
}
