//! Irradiance and blurs in turn, from the sharp frames on.

use super::free::SetFree;
use super::shaken::{LONG, SLIGHT, UNEXPLAINED, for_estimates, for_first_round};
use super::{Estimate, Event, Outcome, Run};
use crate::deblur::{self, Observation, Solution};
use crate::error::{Error, Result};
use crate::ghosts;
use crate::image::{Plane, Rgb};
use crate::noise::NoiseModel;
use crate::triage::Verdict;
use crate::tsf::{self, Tsf};
use glam::DMat3;
use serde_json::Value;

/// Rounds of TSFs refined against the deblurred irradiance and irradiance solved again.
const ROUNDS: usize = 2;
/// Outer iterations for the sharp frames alone. Where they are displaced they get as many as shaken ones: the start was resampled, which
/// smooths, and the residual-driven weights come late.
const SHARP_OUTER: usize = 3;

/// How a frame that passed for shaken shows that it lay still.
struct Lay {
    /// Part of another frame's fine structure that it has, at least, if that can be told.
    detail: f64,
    /// How much worse it is explained by having lain still than by its blur, at most: mean logarithm of squared residuals.
    worse: f64,
    /// The same where its fine structure cannot be told.
    uncompared: f64,
    /// Extent of its blur in pixels below which that is none, however much worse the same place without it is.
    extent: f64,
}

/// Whatever its blur explains. Sharp frames measure -0.04 to 0.007, one of 1.5 px 0.24; where their fine structure cannot be told sharp ones up to 0.19 and blurs of 6 px and
/// more from 0.43 on. A sharp frame was found with an extent of 0 px, half a pixel from where registration had it
/// (0.19); frames of 1.5 px have 1.45 and more.
const AS_WELL: Lay = Lay { detail: 0.5, worse: 0.05, uncompared: 0.28, extent: 1.0 };
/// Where its blur does not explain it. Displaced sharp frames that are softer than the reference measure 0.70 and 0.42, blurs of 4 px and more less than 0.5 and
/// 1.3 and more.
const NEARLY: Lay = Lay { detail: 0.6, worse: 0.8, uncompared: 0.1, extent: 0.0 };

/// How much worse a frame that no part of it places has to be explained by showing nothing than by its blur, at least: mean logarithm of squared residuals.
/// Frames blurred by 21 to 32 px, of 192 and 300, measure 0.53 to 2.6; mirrored, turned or 65 px elsewhere at most -0.1, and texture
/// turned 0.05.
const SHOWN: f64 = 0.25;

impl Lay {
    /// Whether a frame of which `verdict` and `detail` tell lay still.
    fn holds(&self, verdict: &Verdict, detail: &Value) -> bool {
        let most = if !verdict.compared {
            self.uncompared
        } else if verdict.detail >= self.detail {
            self.worse
        } else {
            return false;
        };
        let below = |what: &str, most: f64| detail[what].as_f64().is_some_and(|v| v < most);
        below("still_worse_by", most) || below("extent_px", self.extent)
    }
}

/// Whether the only frame that passed for sharp and one that was taken for shaken have changed places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turned {
    /// No; they may.
    Not,
    /// Yes; if no blur explains this one either, which passed for sharp, they change back.
    About(usize),
    /// And back: it stays so.
    Back,
}

/// A bracket of which it is known which frames are sharp.
pub(super) struct Sorted {
    pub(super) verdicts: Vec<Verdict>,
    /// Whether a TSF was given.
    pub(super) known: Vec<bool>,
    pub(super) used: Vec<usize>,
    pub(super) sharp: Vec<bool>,
    pub(super) tsfs: Vec<Option<Tsf>>,
    /// Where no frame shows the scene: what to start from instead.
    pub(super) scene: Option<Rgb>,
    pub(super) centre: Option<usize>,
    /// Whether the TSFs of all frames come from a smaller size.
    pub(super) reduced: bool,
    /// Whether the frames are merged as they are.
    pub(super) unexplained: bool,
    /// Whether sharp frames may have moved by a pixel or two all the same.
    pub(super) may_have_moved: bool,
    /// Whether two frames have changed places.
    pub(super) turned: Turned,
}

/// What is known of a bracket while irradiance and blurs are looked for in turn.
struct Known {
    verdicts: Vec<Verdict>,
    /// Whether a TSF was given.
    given: Vec<bool>,
    reference: usize,
    sharp: Vec<bool>,
    still: Vec<usize>,
    shaken: Vec<usize>,
    /// Shaken frames whose blur is slight.
    slight: Vec<usize>,
    /// Shaken frames whose TSFs are looked for.
    estimated: Vec<usize>,
    tsfs: Vec<Option<Tsf>>,
    /// What the report says of each frame's blur.
    details: Vec<Value>,
    /// The irradiance as it is known.
    latent: Rgb,
    /// What the sharp frames gave.
    base: Option<Solution>,
    /// Whether the TSFs of all frames come from a smaller size.
    reduced: bool,
    /// Whether two frames have changed places.
    turned: Turned,
}

impl Known {
    fn all(&self) -> Vec<usize> {
        self.still.iter().chain(&self.shaken).copied().collect()
    }
}

/// What came of [`Run::rounds`].
enum Rounds {
    /// The irradiance; `None` where no shaken frame is left.
    Solved(Option<Box<Solution>>),
    /// Frames that lay still after all.
    Lay(Vec<usize>),
    /// The frame that is to be the sharp one instead.
    Turn(usize),
}

/// How much steeper than the sharp frame's the edges of a frame that no blur explains are, at least, for the two to change places.
const STEEPER: f64 = 0.05;

/// How the sharp frames alone (where none is, all) are solved for.
struct SharpAlone {
    frames: Vec<usize>,
    placed: Vec<Option<Tsf>>,
    initial: Rgb,
    pad: usize,
    settings: deblur::Settings,
    /// Whether that has been done, with these settings.
    converged: bool,
}

impl Run<'_> {
    /// The irradiance of a bracket that is `sorted`.
    pub(super) fn deblurred(mut self, sorted: Sorted) -> Result<Outcome> {
        let noise = self.noise;
        let (unexplained, may_have_moved) = (sorted.unexplained, sorted.may_have_moved);
        let reference = self.laid_out(&sorted)?;
        let (mut bracket, sharp_alone) = self.sharp_frames(sorted, reference)?;
        self.estimate_blurs(&mut bracket)?;
        let untold = |i: &usize| bracket.shaken.contains(i) && bracket.tsfs[*i].is_none();
        let lay = |i: &usize| untold(i) || self.lay_still(&AS_WELL, &bracket.still, &bracket.verdicts[*i], &bracket.details[*i]);
        let lay: Vec<usize> = bracket.estimated.iter().copied().filter(lay).collect();
        if let Turned::About(first) = bracket.turned
            && lay.contains(&first)
        {
            return self.turned(bracket, first, noise);
        }
        if !lay.is_empty() {
            return self.counted_as_sharp(bracket, &lay, noise, may_have_moved);
        }
        if may_have_moved
            && bracket.base.is_some()
            && !unexplained
            && bracket.all().len() > 1
            && let Some(stood) = self.ask_sharp_frames(&mut bracket)?
        {
            return self.once_more(bracket, &stood, noise, false);
        }
        let start = bracket.latent.clone();
        let solution = match self.rounds(&mut bracket, &start)? {
            Rounds::Solved(found) => found.map(|found| *found),
            Rounds::Lay(ids) => return self.counted_as_sharp(bracket, &ids, noise, false),
            Rounds::Turn(i) => return self.turned(bracket, i, noise),
        };
        if bracket.shaken.is_empty() && !unexplained {
            self.find_aliasing(&bracket.still, &bracket.shaken, &bracket.latent, 0.80, 0.90)?;
        }
        let solution = match (solution, bracket.base.take()) {
            (Some(found), _) => found,
            (None, Some(base)) if sharp_alone.converged && self.aliasing.iter().all(Option::is_none) => base,
            // No shaken frame is left: the sharp ones alone, as the user wants them, from what they were for the estimates.
            (None, base) => {
                let SharpAlone { frames, placed, initial, pad, settings, .. } = sharp_alone;
                let from = base.map_or(initial, |found| found.irradiance);
                self.solved("sharp frames", "alone", &settings, |run| run.solve(&frames, &placed, &from, pad, &settings, 0.90, 0.98))?
            }
        };
        self.progress("finishing", 0.99)?;
        // For people to look at: patches and their PSFs, eq. (11), against the sharp frames.
        for &i in &bracket.shaken {
            if bracket.details[i].is_null() {
                continue;
            }
            let own = format!("{i} {:?} {:?}", self.settings.patches, self.settings.psf_radius);
            let tsf = bracket.tsfs[i].as_ref().expect("frames without were left out");
            bracket.details[i]["patches"] = self.remembered("PSFs", &own, |_| 0, |run| Ok(run.local_psfs(i, &start, tsf)))?;
        }
        let all = bracket.all();
        self.finish(solution, reference, &bracket.verdicts, &bracket.sharp, &all, &bracket.tsfs, bracket.details)
    }

    /// Whether a frame of which `verdict` and `detail` tell lay still, by `line`, beside the sharp frames `still`: one that registration has found, as no blur explains more
    /// than none of another scene either. Nobody asks where it was said which frames are sharp.
    fn lay_still(&self, line: &Lay, still: &[usize], verdict: &Verdict, detail: &Value) -> bool {
        self.may_lie(still) && line.holds(verdict, detail)
    }

    /// Whether a frame that passed for shaken may count as it lies beside the sharp frames `still`.
    fn may_lie(&self, still: &[usize]) -> bool {
        self.settings.align && self.settings.sharp.is_none() && !still.is_empty()
    }

    /// The irradiance of a bracket of which the frames `ids` are sharp after all. Such a frame is placed by all of its pixels, a shaken one by the middle of its blur.
    fn counted_as_sharp(mut self, mut bracket: Known, ids: &[usize], noise: NoiseModel, may_have_moved: bool) -> Result<Outcome> {
        for &i in ids {
            bracket.sharp[i] = true;
            bracket.verdicts[i].reason += ", but no camera shake explains more of it than none: it counts as it lies";
        }
        let used = bracket.all();
        let own = format!("{ids:?} {used:?}");
        let found =
            self.remembered("place", &own, |_| 0, |run| run.register_on(bracket.reference, &used, &bracket.sharp, &bracket.given))?;
        for &i in ids.iter().filter(|&&i| found[i].registered) {
            self.motions[i] = found[i].motion();
            self.registrations[i] = found[i].clone();
        }
        let sharp = [bracket.still.as_slice(), ids].concat();
        self.once_more(bracket, &sharp, noise, may_have_moved)
    }

    /// The irradiance of a bracket whose frame `i` is the sharp one, and the one that passed for it shaken: a long frame that burns out what is bright shows
    /// more of the dark than a short one, blurred as it is.
    fn turned(mut self, mut bracket: Known, i: usize, noise: NoiseModel) -> Result<Outcome> {
        bracket.turned = if bracket.turned == Turned::Not { Turned::About(bracket.still[0]) } else { Turned::Back };
        for (k, what) in [(i, "sharp"), (bracket.still[0], "shaken")] {
            bracket.verdicts[k].reason += &match bracket.turned {
                Turned::About(_) => format!(", but as no camera shake explains the steeper of the two it counts as {what}"),
                _ => format!(", and as that explains no more either it counts as {what} after all"),
            };
        }
        self.progress("looking whether the steeper frame is the sharp one", 0.03)?;
        self.once_more(bracket, &[i], noise, false)
    }

    /// The frame that should be the sharp one, if no blur explains any of the frames `hopeless` and nothing but the one frame that passed for sharp is left: that one again
    /// if the two have changed places, else one whose edges are steeper and whose exposure time is shorter.
    fn to_turn(&self, bracket: &Known, hopeless: &[usize]) -> Option<usize> {
        let [still] = bracket.still[..] else { return None };
        match bracket.turned {
            Turned::Not => {
                let all = bracket.shaken.iter().all(|i| hopeless.contains(i));
                if !all || !self.may_lie(&bracket.still) || bracket.all().iter().any(|&i| bracket.given[i]) {
                    return None;
                }
                let (frames, verdicts) = (self.bracket.frames(), &bracket.verdicts);
                let better = |&&i: &&usize| {
                    frames[i].exposure_time < frames[still].exposure_time && verdicts[i].steepness > verdicts[still].steepness + STEEPER
                };
                hopeless.iter().find(better).copied()
            }
            Turned::About(first) => hopeless.contains(&first).then_some(first),
            Turned::Back => None,
        }
    }

    /// The irradiance of a bracket of which the frames `sharp` alone are sharp after all, without what was found beside the others. `noise`: its level before it
    /// was measured by the frames that were taken for sharp.
    fn once_more(mut self, bracket: Known, sharp: &[usize], noise: NoiseModel, may_have_moved: bool) -> Result<Outcome> {
        self.memo.depends(&sharp.to_vec());
        self.take_noise(noise);
        self.aliasing.fill(None);
        let used = bracket.all();
        let Known { verdicts, given, sharp: mut flags, mut tsfs, turned, .. } = bracket;
        for &i in used.iter().filter(|&&i| !given[i]) {
            (flags[i], tsfs[i]) = (sharp.contains(&i), None);
        }
        self.deblurred(Sorted {
            verdicts,
            known: given,
            used,
            sharp: flags,
            tsfs,
            scene: None,
            centre: None,
            reduced: false,
            unexplained: false,
            may_have_moved,
            turned,
        })
    }

    /// Noise level, places, ghosts and masks of a bracket that is `sorted`; the reference frame.
    fn laid_out(&mut self, sorted: &Sorted) -> Result<usize> {
        let Sorted { verdicts, known, used, sharp, tsfs, scene, centre, unexplained, .. } = sorted;
        let still: Vec<usize> = used.iter().copied().filter(|&i| sharp[i]).collect();
        // Blurred frames that are merged as they are differ by their blurs as well.
        if !unexplained {
            self.measure_noise(&still)?;
        }
        let found = self.bracket.longest(&still).or_else(|| self.bracket.shortest(used));
        let reference = self.settings.reference.or(*centre).or(found).unwrap_or(0);
        self.scale = self.bracket.frames()[reference].exposure_time;
        if scene.is_some() {
            for (motion, tsf) in self.motions.iter_mut().zip(tsfs) {
                *motion = tsf.as_ref().map_or(*motion, Tsf::centre);
            }
        } else if known.iter().all(|k| !k) {
            self.rebase(reference);
        }
        if !unexplained {
            self.find_ghosts(&still)?;
        }
        self.weigh(sharp, used);
        if *unexplained {
            self.prefer_detail(|i| verdicts[i].detail);
        }
        Ok(reference)
    }

    /// The sharp frames alone, where no other scene is known: start of the solver, reference of the PSFs, and the result when nothing else helps.
    fn sharp_frames(&mut self, sorted: Sorted, reference: usize) -> Result<(Known, SharpAlone)> {
        let Sorted { verdicts, known, used, sharp, mut tsfs, scene, reduced, turned, .. } = sorted;
        let (still, shaken): (Vec<usize>, Vec<usize>) = used.into_iter().partition(|&i| sharp[i]);
        let frames = if still.is_empty() { shaken.clone() } else { still.clone() };
        self.progress("merging the sharp frames", 0.03)?;
        let (initial, _) = self.start(&frames, 0);
        for &i in &still {
            tsfs[i] = Some(Tsf::still(self.motions[i]));
        }
        let placed: Vec<Option<Tsf>> = self.motions.iter().map(|m| Some(Tsf::still(*m))).collect();
        // Without blur an iteration costs next to nothing: this solution may converge.
        let settings = deblur::Settings {
            outer: if frames.iter().any(|&i| self.motions[i] != DMat3::IDENTITY) { self.settings.deblur.outer } else { SHARP_OUTER },
            ..self.settings.deblur.clone()
        };
        let first = if shaken.is_empty() { settings.clone() } else { for_estimates(&settings) };
        let pad = self.pad(frames.iter().filter_map(|&i| placed[i].as_ref()));
        let initial = self.surrounded(&initial, 0, pad, &still, &shaken);
        let (base, latent) = match scene {
            Some(scene) => (None, scene),
            None => {
                let found =
                    self.solved("sharp frames", "", &first, |run| run.solve(&frames, &placed, &initial, pad, &first, 0.05, 0.10))?;
                let latent = found.cropped();
                (Some(found), latent)
            }
        };
        let estimated = shaken.iter().copied().filter(|&i| tsfs[i].is_none()).collect();
        let details = vec![Value::Null; sharp.len()];
        let slight = Vec::new();
        let converged = first == settings;
        let known = Known {
            verdicts,
            given: known,
            reference,
            sharp,
            still,
            shaken,
            slight,
            estimated,
            tsfs,
            details,
            latent,
            base,
            reduced,
            turned,
        };
        Ok((known, SharpAlone { frames, placed, initial, pad, settings, converged }))
    }

    /// TSFs of the shaken frames of which none is known, against the sharp ones. A frame of which none is found is left out, unless nothing told whether it is sharp either: then it
    /// has little in common with the others, and what it alone shows, such as the light of a window that they burn out, would be lost.
    fn estimate_blurs(&mut self, bracket: &mut Known) -> Result<()> {
        for (k, &i) in bracket.estimated.iter().enumerate() {
            let part = k as f32 / bracket.estimated.len() as f32;
            self.progress(&format!("estimating the blur of {}", self.bracket.frames()[i].name), 0.10 + 0.30 * part)?;
            let own = format!("{i} {:?} {:?}", self.settings.model, self.settings.focal_px);
            let look = |run: &mut Self| Ok(run.estimate(i, &bracket.latent, |frame, search| frame.estimate(search)));
            let (tsf, detail) = self.remembered("blur", &own, |_| 0, look)?;
            if std::mem::take(&mut self.registrations[i].doubtful) {
                if tsf.is_none() || detail["blank_worse_by"].as_f64().is_none_or(|v| v < SHOWN) {
                    self.leave_out(i, &self.registrations[i].reason.clone())?;
                    bracket.shaken.retain(|&k| k != i);
                    continue;
                }
                self.registrations[i].registered = true;
                self.registrations[i].reason = "no part of it tells by itself where it lies; its blur does".into();
            }
            let untold = !bracket.verdicts[i].compared && self.may_lie(&bracket.still);
            if tsf.is_none() && !untold && bracket.turned != Turned::About(i) {
                self.leave_out(
                    i,
                    "too little texture that both it and the sharp frames see clearly to find its blur (a sharp frame with a longer exposure \
                     time, or more detail where this frame is not clipped, would help)",
                )?;
                bracket.shaken.retain(|&k| k != i);
            }
            (bracket.tsfs[i], bracket.details[i]) = (tsf, detail);
        }
        self.memo.depends(&(self.settings.model, self.settings.focal_px));
        Ok(())
    }

    /// Whether frames that seem sharp have moved by a pixel or two: those that stood still, if only these may count as sharp. Where none stood, all are
    /// shaken from here on, by the TSFs that were found.
    fn ask_sharp_frames(&mut self, bracket: &mut Known) -> Result<Option<Vec<usize>>> {
        let all = bracket.all();
        let Known { still, tsfs, latent, reference, .. } = &*bracket;
        let (found, blind) = self.remembered(
            "slight blur",
            "",
            |_| 0,
            |run| {
                let found = run.set_free(&all, still, tsfs, latent, *reference)?;
                Ok((found, run.blind.clone()))
            },
        )?;
        self.blind = blind;
        match found {
            None => Ok(None),
            Some(SetFree::Beside(stood)) => Ok(Some(stood)),
            Some(SetFree::All(found)) => {
                let (w, h) = self.bracket.size();
                (bracket.latent, bracket.reduced, bracket.base) = (found.start, found.reduced, None);
                for (&i, tsf) in all.iter().zip(found.tsfs) {
                    if tsf::extent(&tsf, w, h) < SLIGHT {
                        bracket.slight.push(i);
                    }
                    self.motions[i] = tsf.centre();
                    (bracket.sharp[i], bracket.tsfs[i]) = (false, Some(tsf));
                }
                self.weigh(&bracket.sharp, &all);
                (bracket.shaken, bracket.still, bracket.estimated) = (all, Vec::new(), Vec::new());
                Ok(None)
            }
        }
    }

    /// Irradiance of all frames and their TSFs refined against it, in turn; frames that no blur explains are left out. `start`: irradiance before the
    /// shaken frames counted.
    fn rounds(&mut self, bracket: &mut Known, start: &Rgb) -> Result<Rounds> {
        let (w, h) = self.bracket.size();
        let mut solution = None;
        let estimated = if bracket.reduced { bracket.shaken.clone() } else { std::mem::take(&mut bracket.estimated) };
        let mut looked_at_twice: Vec<usize> = Vec::new();
        let (mut validating, mut fitted) = (true, Vec::new());
        let rounds = if estimated.is_empty() { 1 } else { ROUNDS };
        let mut round = 0;
        // TSFs that were given took no time.
        let begun = if estimated.is_empty() { 0.0 } else { 0.40 };
        while round < rounds && !bracket.shaken.is_empty() {
            let all = bracket.all();
            let Known { verdicts, reference, still, shaken, slight, tsfs, details, latent, base, reduced, turned, .. } = &mut *bracket;
            let at = |part: f32| begun + (0.98 - begun) * (round as f32 + part) / rounds as f32;
            if round > 0 {
                self.progress("refining the blur", at(0.0))?;
                for &i in estimated.iter().filter(|i| shaken.contains(i)) {
                    let now = format!("{i} {round} {shaken:?} {looked_at_twice:?} {validating}");
                    tsfs[i] = self.remembered("refinement", &now, |_| 0, |run| Ok(run.refine(i, latent, tsfs[i].as_ref())))?;
                }
                fitted.clone_from(tsfs);
                if validating {
                    let now = format!("{round} {shaken:?} {looked_at_twice:?}");
                    // Those that were given are what they are.
                    let held: Vec<usize> = all.iter().copied().filter(|i| !estimated.contains(i)).collect();
                    let look = |run: &mut Self| run.cross_validated(&all, &held, tsfs, latent, *reference, (at(0.05), at(0.2)));
                    *tsfs = self.remembered("cross-validation", &now, |_| 0, look)?;
                }
            }
            if round + 1 == rounds {
                self.find_aliasing(still, shaken, latent, at(0.2), at(0.3))?;
            }
            let pad = self.pad(all.iter().filter_map(|&i| tsfs[i].as_ref()));
            let from = match solution.as_ref().or(base.as_ref()) {
                Some(found) => self.surrounded(&found.irradiance, found.pad, pad, still, shaken),
                None => self.surrounded(latent, 0, pad, still, shaken),
            };
            // The first round only has to be better than the sharp frames alone, for the TSFs to be refined against it.
            let settings = if round + 1 < rounds { for_first_round(&self.settings.deblur) } else { self.settings.deblur.clone() };
            let now = format!("{round} {shaken:?} {looked_at_twice:?} {validating}");
            let solved =
                self.solved("irradiance", &now, &settings, |run| run.solve(&all, tsfs, &from, pad, &settings, at(0.3), at(1.0)))?;
            let misfit = |i: usize| all.iter().position(|&k| k == i).map(|p| &solved.misfit[p]);
            let judge = |&i: &usize| {
                let length = tsf::stroke(tsfs[i].as_ref()?, w, h);
                Some((i, self.unexplained(i, misfit(i)?, start, (UNEXPLAINED * LONG / length).clamp(UNEXPLAINED, 1.0))?))
            };
            // TSFs of a smaller size err by pixels of the frame's: they are judged once they have been refined.
            let rough = *reduced && round + 1 < rounds;
            let hopeless: Vec<(usize, f64)> = shaken.iter().filter(|i| !rough && !slight.contains(i)).filter_map(judge).collect();
            if hopeless.is_empty() {
                *latent = solved.cropped();
                solution = Some(solved);
                round += 1;
                continue;
            }
            solution = None;
            // Beside what clips everywhere no pixel is held out: what is wrong there is not seen before the frames are solved for.
            if round > 0 && validating {
                validating = false;
                tsfs.clone_from(&fitted);
                continue;
            }
            let ids: Vec<usize> = hopeless.iter().map(|h| h.0).filter(|i| !looked_at_twice.contains(i) && !details[*i].is_null()).collect();
            looked_at_twice.extend(&ids);
            if self.look_for_slight(&ids, start, tsfs, details, at(1.0))? {
                continue;
            }
            let lay = |i: &usize| *turned == Turned::Not && self.lay_still(&NEARLY, still, &verdicts[*i], &details[*i]);
            let lay: Vec<usize> = hopeless.iter().map(|h| h.0).filter(lay).collect();
            if !lay.is_empty() {
                return Ok(Rounds::Lay(lay));
            }
            let ids: Vec<usize> = hopeless.iter().map(|h| h.0).collect();
            if let Some(i) = self.to_turn(bracket, &ids) {
                return Ok(Rounds::Turn(i));
            }
            // Deblurring with a blur that does not explain its frame can only harm: without that frame, again.
            for (i, chi) in hopeless {
                let what = if bracket.given[i] { "the TSF that was given does not explain it" } else { "no camera shake explains it" };
                self.leave_out(i, &format!("{what} (its residual is {chi:.1} times its noise)"))?;
                bracket.shaken.retain(|&k| k != i);
            }
        }
        Ok(Rounds::Solved(solution.map(Box::new)))
    }

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
        let mut observations: Vec<Observation> =
            ids.iter().map(|&i| self.observation(i, tsfs[i].clone().unwrap_or_else(Tsf::identity))).collect();
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
        solved.report.chi_squared.truncate(ids.len());
        if solved.report.memory.reduced {
            self.warn("the GPU's memory is short: the work is done in smaller pieces, which takes longer".into())?;
        }
        Ok(solved)
    }

    /// Where the sharp frames `still` do not show the same scene, and which of them counts there.
    fn find_ghosts(&mut self, still: &[usize]) -> Result<()> {
        if !self.settings.deghost || still.len() < 2 {
            return Ok(());
        }
        let bytes = |found: &Vec<Option<Plane>>| found.iter().flatten().map(|f| 4 * f.data.len()).sum();
        let found = self.remembered("ghosts", &format!("{still:?}"), bytes, |run| {
            let Run { exposures, curves, noise, motions, .. } = &*run;
            Ok(ghosts::Sharp { frames: run.bracket.frames(), exposures, curves, noise, motions, ids: still }.shares())
        })?;
        for (&i, share) in still.iter().zip(found) {
            self.ghosts[i] = share;
        }
        Ok(())
    }

    /// What the displaced ones of the sharp frames `still` show of structure finer than the latent grid, unless that is known. `latent`: irradiance as it
    /// is known. Progress runs from `from` to `to`.
    fn find_aliasing(&mut self, still: &[usize], shaken: &[usize], latent: &Rgb, from: f32, to: f32) -> Result<()> {
        let displaced = still.iter().any(|&i| self.motions[i] != DMat3::IDENTITY);
        if !self.settings.between_pixels || still.len() < 2 || !displaced || self.aliasing.iter().any(Option::is_some) {
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

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_frame_that_lay_still_shows_nearly_as_much_and_its_blur_explains_little() {
        let of = |line: &Lay, detail: f64, compared: bool, worse: Value| {
            let verdict = Verdict {
                sharp: false,
                detail,
                compared,
                linked: true,
                steepness: 0.5,
                evenness: 1.0,
                alike: vec![],
                reason: String::new(),
            };
            line.holds(&verdict, &json!({ "still_worse_by": worse }))
        };
        assert!(of(&NEARLY, 0.70, true, json!(0.42)), "sharp, displaced, a little softer than the reference");
        assert!(!of(&AS_WELL, 0.70, true, json!(0.24)), "a blur of 1.5 px, if it explains its frame");
        assert!(!of(&NEARLY, 0.44, true, json!(0.42)), "it lacks what another shows");
        assert!(!of(&NEARLY, 0.70, true, json!(1.3)), "its blur explains far more, though not all");
        assert!(of(&AS_WELL, 0.57, true, json!(0.002)), "its blur explains nothing");
        assert!(!of(&NEARLY, 1.0, false, json!(0.42)), "nothing says how fine it is");
        assert!(of(&AS_WELL, 1.0, false, json!(0.007)), "but its blur explains nothing");
        assert!(!of(&AS_WELL, 0.70, true, Value::Null), "nothing was tried: the TSF was given");
    }
}
