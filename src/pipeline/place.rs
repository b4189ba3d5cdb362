//! Where the frames lie and what their exposures are.

use super::Run;
use crate::error::Result;
use crate::hot;
use crate::image::{Channels, Rgb};
use crate::mask;
use crate::noise::FrameNoise;
use crate::photometry::{self, FramePhotometry};
use crate::register::{self, Registrar, Registration};
use glam::DMat3;
use std::collections::BTreeMap;

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

    /// Where the frames `used` lie, from the longest of those that are `sharp`, else from the first that shows enough. The frame whose pixels the
    /// result is to lie on may be black: it is placed like any other, unless TSFs are `known`, which are about it, or as many frames fit it as fit any other.
    fn registered(&mut self, used: &[usize], sharp: &[bool], known: &[bool]) -> Result<Vec<Registration>> {
        let best = |run: &Self, of: &[usize]| {
            let still: Vec<usize> = of.iter().copied().filter(|&i| sharp[i]).collect();
            run.bracket.longest(&still).or_else(|| run.first_reference(of))
        };
        let from = |run: &mut Self, first: usize| {
            if sharp.contains(&true) || known.contains(&true) {
                run.register_on(first, used, sharp, known)
            } else {
                run.register_through(first, used)
            }
        };
        let wanted = self.settings.reference.filter(|_| known.contains(&true));
        let first = wanted.or_else(|| best(self, used)).unwrap_or(0);
        let mut found = from(self, first)?;
        let misfits = |r: &[Registration]| used.iter().filter(|&&i| !r[i].registered).count();
        // If the frame on whose pixels the result is to lie does not fit, those that fit it may be what is asked for.
        if let Some(asked) = self.settings.reference.filter(|&i| used.contains(&i) && !found[i].registered) {
            let other = from(self, asked)?;
            if misfits(&other) <= misfits(&found) {
                found = other;
            }
        }
        // If most do not fit the first reference, it may be the one that is not of the scene.
        if self.settings.reference.is_none() && used.len() > 2 && 2 * misfits(&found) >= used.len() {
            let rest: Vec<usize> = used.iter().copied().filter(|&i| i != first).collect();
            if let Some(second) = best(self, &rest) {
                let other = from(self, second)?;
                if misfits(&other) < misfits(&found) {
                    return Ok(other);
                }
            }
        }
        Ok(found)
    }

    /// Where the frames `used` lie, from the frame `first`, of which none is known to be sharp: each beside the placed one that is nearest in exposure, or, where it does not fit
    /// that, beside the next. Frames that share no shade, or of which one is too noisy or blurred, meet through those between them.
    fn register_through(&mut self, first: usize, used: &[usize]) -> Result<Vec<Registration>> {
        self.beside_exposures(|run, exposures| run.registered_through(exposures, first, used))
    }

    fn registered_through(&mut self, exposures: &[Rgb], first: usize, used: &[usize]) -> Result<Vec<Registration>> {
        let frames = self.bracket.frames();
        let (w, h) = self.bracket.size();
        let curves = self.curves_of_detail();
        let registrar = |of: usize| Registrar::new(frames, exposures, &curves, of);
        let mut placed = BTreeMap::from([(first, registrar(first))]);
        let mut found = vec![Registration::skipped(); frames.len()];
        found[first] = placed[&first].of_reference();
        let distance = |a: usize, b: usize| (frames[a].exposure_time / frames[b].exposure_time).ln().abs();
        let mut tried: Vec<(usize, usize)> = Vec::new();
        loop {
            let next = used
                .iter()
                .filter(|i| !placed.contains_key(i))
                .flat_map(|&i| placed.keys().map(move |&by| (i, by)))
                .filter(|pair| !tried.contains(pair))
                .min_by(|a, b| distance(a.0, a.1).total_cmp(&distance(b.0, b.1)));
            let Some((i, by)) = next else { return Ok(found) };
            self.progress(&format!("registering {}", frames[i].name), 0.02)?;
            let beside = placed.get_mut(&by).expect("a frame that is placed").register(i, false);
            let worth = |r: &Registration| (r.registered && !r.assumed, r.registered, r.doubtful, r.agreement);
            if !tried.iter().any(|t| t.0 == i) || worth(&beside) > worth(&found[i]) {
                let motion = register::rebased(&beside.motion(), &found[by].motion(), w, h);
                found[i] = Registration { homography: register::rows(&motion), ..beside };
            }
            tried.push((i, by));
            if found[i].registered && !found[i].assumed {
                placed.insert(i, registrar(i));
            }
        }
    }

    /// Where the frames `used` lie, from the frame `reference`.
    pub(super) fn register_on(&mut self, reference: usize, used: &[usize], sharp: &[bool], known: &[bool]) -> Result<Vec<Registration>> {
        self.beside_exposures(|run, exposures| {
            let frames = run.bracket.frames();
            let mut found = vec![Registration::skipped(); frames.len()];
            let curves = run.curves_of_detail();
            let mut registrar = Registrar::new(frames, exposures, &curves, reference);
            found[reference] = registrar.of_reference();
            for i in registrar.order(used, sharp).into_iter().filter(|&i| !known[i]) {
                run.progress(&format!("registering {}", frames[i].name), 0.02)?;
                found[i] = registrar.register(i, sharp[i]);
            }
            Ok(found)
        })
    }

    /// What `f` makes of the exposures, which a registrar reads while the run tells how far it is: until it is done the run has none.
    fn beside_exposures<T>(&mut self, f: impl FnOnce(&mut Self, &[Rgb]) -> T) -> T {
        let exposures = std::mem::take(&mut self.exposures);
        let out = f(self, &exposures);
        self.exposures = exposures;
        out
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
