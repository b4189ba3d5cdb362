//! Where the frames lie and what their exposures are.

use super::Run;
use crate::error::Result;
use crate::hot;
use crate::image::Channels;
use crate::mask;
use crate::noise::FrameNoise;
use crate::photometry::{self, FramePhotometry};
use crate::register::{self, Registrar, Registration};
use glam::DMat3;

/// Part of the pixels that the best frame shows clear of noise and clipping which a frame has to show to be the first reference.
const VISIBLE: f64 = 0.6;
/// Standard deviations of its noise above which a pixel is clear of it.
const CLEAR: f64 = 4.0;
/// Pixels that are looked at for that, about.
const SAMPLED: usize = 100_000;

/// What placing the frames found.
#[derive(Clone)]
pub(super) struct Placed {
    pub excluded: Vec<bool>,
    pub motions: Vec<DMat3>,
    pub registrations: Vec<Registration>,
    /// Places of hot pixels.
    pub hot: Vec<usize>,
    pub noise: Vec<FrameNoise>,
    pub photometry: Vec<FramePhotometry>,
    pub left_out: Vec<(String, String)>,
    pub degraded: Vec<String>,
}

impl Run<'_> {
    /// Registers the frames `used` and matches their exposures. `known`: frames whose place the user gave, in [`Run::motions`].
    pub(super) fn place(&mut self, used: &[usize], excluded: &[bool], known: &[bool]) -> Result<Placed> {
        let n = excluded.len();
        let sharp: Vec<bool> = (0..n).map(|i| self.settings.sharp.as_ref().is_some_and(|s| s.contains(&i))).collect();
        let mut found = vec![Registration::skipped(); n];
        if self.settings.align && used.iter().any(|&i| !known[i]) {
            found = self.registered(used, &sharp, known)?;
            for (i, one) in found.iter().enumerate().filter(|(i, _)| !known[*i]) {
                self.motions[i] = one.motion();
            }
        }
        let placed: Vec<usize> = used.iter().copied().filter(|&i| found[i].registered).collect();
        let hot = hot::find(&self.exposures, &self.curves, &placed, &self.motions);
        self.take_hot_pixels(&hot)?;
        let noise = self.noise_beside_each_other(&placed);
        let photometry = photometry::photometry(self.bracket.frames(), &self.exposures, &noise, &placed, &self.motions);
        let mut excluded = excluded.to_vec();
        for &i in used.iter().filter(|&&i| !found[i].registered) {
            if !found[i].doubtful {
                self.leave_out(i, &found[i].reason)?;
            }
            excluded[i] = true;
        }
        Ok(Placed {
            excluded,
            motions: self.motions.clone(),
            registrations: found,
            hot,
            noise,
            photometry,
            left_out: self.left_out.clone(),
            degraded: self.degraded.clone(),
        })
    }

    /// The shortest of the frames `used` that shows enough: it is the least likely to have moved.
    pub(super) fn first_reference(&self, used: &[usize]) -> Option<usize> {
        let visible = |i: usize| {
            let (frame, mean) = (&self.bracket.frames()[i], self.exposures[i].mean());
            let clipped = mask::clipped(frame, Channels::ALL);
            let step = (clipped.len() / SAMPLED).max(1);
            let noise = |x: f64| self.noise[i].variance_of_mean(Channels::ALL, x).sqrt();
            let clear = |p: &usize| !clipped[*p] && f64::from(mean.data[*p]) > CLEAR * noise(f64::from(mean.data[*p]));
            (0..clipped.len()).step_by(step).filter(clear).count() as f64
        };
        let seen: Vec<(usize, f64)> = used.iter().map(|&i| (i, visible(i))).collect();
        let most = seen.iter().fold(0.0f64, |m, s| m.max(s.1));
        let enough: Vec<usize> = seen.into_iter().filter(|s| s.1 >= VISIBLE * most).map(|s| s.0).collect();
        self.bracket.shortest(&enough)
    }

    /// Where the frames `used` lie, by the longest of those that are `sharp` or, if most do not fit that, by the next.
    fn registered(&mut self, used: &[usize], sharp: &[bool], known: &[bool]) -> Result<Vec<Registration>> {
        let best = |run: &Self, of: &[usize]| {
            let still: Vec<usize> = of.iter().copied().filter(|&i| sharp[i]).collect();
            run.bracket.longest(&still).or_else(|| run.first_reference(of))
        };
        let first = self.settings.reference.or_else(|| best(self, used)).unwrap_or(0);
        let found = self.register_on(first, used, sharp, known)?;
        // If most do not fit the first reference, it may be the one that is not of the scene.
        let misfits = |r: &[Registration]| used.iter().filter(|&&i| !r[i].registered).count();
        if self.settings.reference.is_none() && used.len() > 2 && 2 * misfits(&found) >= used.len() {
            let rest: Vec<usize> = used.iter().copied().filter(|&i| i != first).collect();
            if let Some(second) = best(self, &rest) {
                let other = self.register_on(second, used, sharp, known)?;
                if misfits(&other) < misfits(&found) {
                    return Ok(other);
                }
            }
        }
        Ok(found)
    }

    /// Where the frames `used` lie, from the frame `reference`.
    pub(super) fn register_on(&mut self, reference: usize, used: &[usize], sharp: &[bool], known: &[bool]) -> Result<Vec<Registration>> {
        let frames = self.bracket.frames();
        let mut found = vec![Registration::skipped(); frames.len()];
        let exposures = std::mem::take(&mut self.exposures);
        let curves = self.curves_of_detail();
        let mut registrar = Registrar::new(frames, &exposures, &curves, reference);
        found[reference] = registrar.of_reference();
        let mut going = Ok(());
        for i in registrar.order(used, sharp).into_iter().filter(|&i| !known[i]) {
            going = self.progress(&format!("registering {}", frames[i].name), 0.02);
            if going.is_err() {
                break;
            }
            found[i] = registrar.register(i, sharp[i]);
        }
        self.exposures = exposures;
        going.map(|()| found)
    }

    /// Motions from the frame `reference` instead.
    pub(super) fn rebase(&mut self, reference: usize) {
        if self.motions[reference] == DMat3::IDENTITY {
            return;
        }
        let (w, h) = self.bracket.size();
        let back = self.motions[reference].inverse();
        for (motion, found) in self.motions.iter_mut().zip(&mut self.registrations) {
            *motion = register::rebased(motion, &back, w, h);
            found.homography = register::rows(motion);
        }
    }
}
