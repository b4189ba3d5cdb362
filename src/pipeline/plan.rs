//! The stages in order: places, what the frames are, blurs and irradiance in turn.

use super::blind::{Blind, Found};
use super::judge::{self, BlurEvidence, Judgement, Kind};
use super::place::Placed;
use super::shaken::{for_estimates, for_first_round};
use super::{Outcome, Run};
use crate::blind::Begun;
use crate::deblur::{self, Solution};
use crate::error::Result;
use crate::image::Rgb;
use crate::register;
use crate::tsf::{self, Tsf, TsfFile};
use glam::DMat3;
use serde_json::Value;

/// Rounds of TSFs refined against the deblurred irradiance and irradiance solved again.
const ROUNDS: usize = 2;
/// Outer iterations for stationary frames alone that lie in one place or are read there. Where they are displaced and sharp to the pixel they get as many as shaken ones: the start was
/// resampled, which smooths, and the residual-driven weights come late.
const STATIONARY_OUTER: usize = 3;

/// What is known of a bracket while irradiance and blurs are looked for in turn.
pub(super) struct State {
    pub reference: usize,
    pub judgements: Vec<Option<Judgement>>,
    /// Frames that count as they lie.
    pub still: Vec<usize>,
    /// Frames that count by their blur.
    pub shaken: Vec<usize>,
    pub tsfs: Vec<Option<Tsf>>,
    /// What the report says of each frame's blur.
    pub details: Vec<Value>,
    /// Whether a TSF was given.
    given: Vec<bool>,
    /// The irradiance as it is known.
    pub latent: Option<Rgb>,
    /// Whether the TSFs of all frames come from a smaller size than the frames'.
    reduced: bool,
    /// Whether a frame has joined the stationary ones since these were solved for.
    joined: bool,
    /// Whether what the stationary ones show was solved for with the settings of the result.
    as_result: bool,
}

/// Why a frame is left out whose blur is looked for beside sharp ones that the user named.
const NO_TEXTURE: &str = "too little texture that both it and the sharp frames see clearly to find its blur (a sharp frame with a longer exposure \
                          time, or more detail where this frame is not clipped, would help)";

impl State {
    /// Frames that count.
    pub fn all(&self) -> Vec<usize> {
        self.still.iter().chain(&self.shaken).copied().collect()
    }

    fn count_as_it_lies(&mut self, i: usize) {
        self.shaken.retain(|&k| k != i);
        self.still.push(i);
        self.still.sort_unstable();
        (self.tsfs[i], self.details[i]) = (None, Value::Null);
    }
}

impl Run<'_> {
    pub(super) fn reconstruct(mut self, excluded: Vec<bool>, given: Option<&TsfFile>) -> Result<Outcome> {
        let mut state = self.begun(excluded, given)?;
        self.find_all_blurs(&mut state, given.is_some())?;
        let base = self.stationary_frames(&mut state)?;
        if let Some(found) = &base {
            state.latent = Some(found.cropped());
        }
        self.estimate_blurs(&mut state)?;
        self.doubt_the_stationary(&mut state)?;
        let base = self.base_again(&mut state, base)?;
        let solution = match self.rounds(&mut state, base.as_ref())? {
            Some(found) => found,
            None => self.stationary_alone(&mut state, base)?,
        };
        self.progress("finishing", 0.99)?;
        self.describe_blurs(&mut state)?;
        self.finish(solution, state)
    }

    /// Places and judgements of the frames that are not `excluded`, and TSFs that were given.
    fn begun(&mut self, excluded: Vec<bool>, given: Option<&TsfFile>) -> Result<State> {
        let frames = self.bracket.frames();
        let (n, (w, h)) = (frames.len(), self.bracket.size());
        let used: Vec<usize> = (0..n).filter(|&i| !excluded[i]).collect();
        let mut tsfs: Vec<Option<Tsf>> = vec![None; n];
        if let Some(file) = given {
            for &i in &used {
                tsfs[i] = file.find(&frames[i].name, w, h)?;
                match &tsfs[i] {
                    Some(tsf) => self.motions[i] = tsf.centre(),
                    None => self.warn(format!("{}: the TSF file does not hold it; its TSF is estimated", frames[i].name))?,
                }
            }
        }
        let known: Vec<bool> = tsfs.iter().map(Option::is_some).collect();
        let settings = self.settings;
        self.memo.depends(&(&settings.exclude, &settings.sharp, settings.reference, settings.align));
        let placed = self.remembered("registration", "", |_| 0, |run| run.place(&used, &excluded, &known))?;
        let Placed { excluded, motions, registrations, hot, noise, photometry, left_out, degraded } = placed;
        (self.motions, self.registrations, self.left_out, self.degraded) = (motions, registrations, left_out, degraded);
        self.take_hot_pixels(&hot)?;
        self.take_photometry(noise, photometry);
        self.memo.depends(&(settings.alpha, settings.deghost, settings.blind, settings.deblur.interpolation));
        let doubtful = |i: usize| self.registrations[i].doubtful;
        let used: Vec<usize> = used.into_iter().filter(|&i| !excluded[i] || doubtful(i)).collect();
        let is = |list: &[usize], i: usize| if list.contains(&i) { Kind::Stationary } else { Kind::Moved };
        let mut judgements: Vec<Option<Judgement>> = vec![None; n];
        for &i in &used {
            judgements[i] = match (&tsfs[i], &settings.sharp) {
                (Some(tsf), _) if tsf.single().is_some() => Some(Judgement::given(Kind::Stationary)),
                (Some(_), _) => Some(Judgement::given(Kind::Moved)),
                (None, Some(list)) => Some(Judgement::given(is(list, i))),
                (None, None) => None,
            };
        }
        let stationary = |i: usize| judgements[i].as_ref().is_some_and(|j| j.kind == Kind::Stationary);
        let still: Vec<usize> = used.iter().copied().filter(|&i| stationary(i)).collect();
        let shaken: Vec<usize> = used.iter().copied().filter(|i| !still.contains(i)).collect();
        for (i, judgement) in judgements.iter_mut().enumerate().filter(|(i, _)| !used.contains(i)) {
            *judgement = Some(if settings.exclude.contains(&i) {
                Judgement::given(Kind::Excluded)
            } else {
                Judgement { reason: self.registrations[i].reason.clone(), ..Judgement::given(Kind::OtherScene) }
            });
        }
        Ok(State {
            reference: 0,
            judgements,
            still,
            shaken,
            tsfs,
            details: vec![Value::Null; n],
            given: known,
            latent: None,
            reduced: false,
            joined: false,
            as_result: false,
        })
    }

    /// Where the user says so the TSFs of all frames and a scene to start from, without a look at which are stationary.
    fn find_all_blurs(&mut self, state: &mut State, given: bool) -> Result<()> {
        let used = state.all();
        if used.iter().all(|&i| state.given[i]) {
            if state.still.is_empty() {
                state.latent = Some(self.timed("luminance", |run| run.start_from_tsfs(&used, &state.tsfs))?);
            }
            return Ok(());
        }
        let none_sharp = state.still.is_empty() && self.settings.sharp.is_some() && self.settings.blind != Blind::Off;
        if given || !(none_sharp || matches!(self.settings.blind, Blind::Joint | Blind::Patches)) {
            return Ok(());
        }
        self.take_all_blurs(state, None)?;
        if state.latent.is_none() {
            self.degrade("camera shake does not explain the frames if all of them moved: they are judged beside the shortest".into())?;
        }
        Ok(())
    }

    /// The joint estimate of all frames' TSFs, or the paper's, if it explains them. `begun`: what a doubt left to go on from.
    fn take_all_blurs(&mut self, state: &mut State, begun: Option<&Begun>) -> Result<()> {
        let used = state.all();
        let (scene, tsfs) = (state.latent.take(), state.tsfs.clone());
        let known = scene.as_ref().zip(self.first_reference(&state.still)).map(|(scene, first)| (scene, tsfs.as_slice(), first));
        if self.settings.blind == Blind::Patches {
            self.memo.depends(&(self.settings.psf_radius, self.settings.patch_size));
        }
        let (found, motions, blind, degraded) = self.remembered(
            "all blurs",
            "",
            |_| 0,
            |run| {
                let found = if run.settings.blind == Blind::Patches {
                    run.patches(&used, 0.03, 0.60)?
                } else {
                    run.joint(&used, known, begun, 0.03, 0.60)?
                };
                Ok((found, run.motions.clone(), run.blind.clone(), run.degraded.clone()))
            },
        )?;
        (self.blind, self.degraded) = (blind, degraded);
        if let Some(Found { start, tsfs, reference, reduced }) = found {
            self.motions = motions;
            for (&i, tsf) in used.iter().zip(tsfs) {
                state.tsfs[i] = Some(tsf);
                state.judgements[i] = Some(Judgement {
                    reason: "no frame is sharp: all blurs were estimated together".into(),
                    ..Judgement::given(Kind::Moved)
                });
            }
            (state.still, state.shaken, state.reference) = (Vec::new(), used, reference);
            (state.latent, state.reduced) = (Some(start), reduced);
        } else {
            state.latent = scene;
        }
        Ok(())
    }

    /// Where the edges of all frames that are taken for stationary are soft and no two of them agree, all frames may have moved: the joint estimate of all blurs, if that explains held-out pixels
    /// better. No two frames of one hand are blurred alike.
    fn doubt_the_stationary(&mut self, state: &mut State) -> Result<()> {
        let Some(first) = self.first_reference(&state.still) else { return Ok(()) };
        let asked = self.settings.blind == Blind::Auto && self.settings.sharp.is_none() && !state.given.contains(&true);
        let explained = state.shaken.iter().all(|&i| state.tsfs[i].is_some());
        let agree = state.still.iter().any(|&i| state.judgements[i].as_ref().is_some_and(Judgement::agrees));
        let doubt = if asked && explained && !agree { self.doubt(first, &state.still, &state.all())? } else { None };
        let Some((doubt, begun)) = doubt else { return Ok(()) };
        state.judgements[first] = Some(judge::doubted(doubt.stroke_px, doubt.line_px, doubt.is_founded()));
        if doubt.is_founded() {
            self.take_all_blurs(state, begun.as_ref())?;
            if state.still.is_empty() {
                self.lay_out(state)?;
            }
        }
        Ok(())
    }

    /// Reference, places, ghosts and masks of the frames as `state` has them.
    pub(super) fn lay_out(&mut self, state: &mut State) -> Result<()> {
        let all = state.all();
        if state.latent.is_none() {
            let longest = self.bracket.longest(&state.still);
            state.reference = self.settings.reference.or(longest).or_else(|| self.bracket.shortest(&all)).unwrap_or(0);
            if state.given.iter().all(|k| !k) {
                self.rebase(state.reference);
            }
        } else {
            state.reference = self.settings.reference.unwrap_or(state.reference);
            for (motion, tsf) in self.motions.iter_mut().zip(&state.tsfs) {
                *motion = tsf.as_ref().map_or(*motion, Tsf::centre);
            }
        }
        self.scale = self.bracket.frames()[state.reference].exposure_time;
        self.pixel_sharp = self.is_pixel_sharp(&state.still);
        self.find_ghosts(&state.still)?;
        let sharp: Vec<bool> = (0..self.bracket.frames().len()).map(|i| state.still.contains(&i)).collect();
        self.weigh(&sharp, &all);
        Ok(())
    }

    /// What the stationary frames show: masks, ghosts and their solution.
    pub(super) fn solve_base(&mut self, state: &mut State) -> Result<Solution> {
        self.lay_out(state)?;
        let settings = self.stationary_settings();
        state.as_result = state.shaken.is_empty();
        let settings = if state.as_result { settings } else { for_estimates(&settings) };
        let own = format!("{:?} {:?}", state.still, state.shaken);
        let solved = self.solved("stationary frames", &own, &settings, |run| run.solve_stationary(state, None, &settings, (0.05, 0.10)))?;
        Ok(solved)
    }

    /// What the stationary frames show once it is final which these are: `base`, unless one joined them since.
    fn base_again(&mut self, state: &mut State, base: Option<Solution>) -> Result<Option<Solution>> {
        let Some(base) = base.filter(|_| !state.still.is_empty()) else { return Ok(None) };
        if state.joined && state.shaken.is_empty() {
            // No TSF is about the reference that was: it is chosen anew among all that are stationary now.
            state.latent = None;
        }
        let base = if state.joined { self.solve_base(state)? } else { base };
        state.latent = Some(base.cropped());
        Ok(Some(base))
    }

    fn stationary_settings(&self) -> deblur::Settings {
        let outer = if self.pixel_sharp { self.settings.deblur.outer } else { STATIONARY_OUTER };
        deblur::Settings { outer, ..self.settings.deblur.clone() }
    }

    /// The stationary frames alone, from `start` or their merge.
    fn solve_stationary(
        &mut self,
        state: &State,
        start: Option<&Solution>,
        settings: &deblur::Settings,
        at: (f32, f32),
    ) -> Result<Solution> {
        self.progress("merging the sharp frames", at.0)?;
        let placed: Vec<Option<Tsf>> = self.motions.iter().map(|m| Some(Tsf::still(*m))).collect();
        let pad = self.pad(state.still.iter().filter_map(|&i| placed[i].as_ref()));
        let initial = match start {
            Some(found) => self.surrounded(&found.irradiance, found.pad, pad, &state.still, &state.shaken),
            None => self.surrounded(&self.start(&state.still, 0).0, 0, pad, &state.still, &state.shaken),
        };
        self.solve(&state.still, &placed, &initial, pad, settings, at.0, at.1)
    }

    /// The result where no shaken frame counts: the stationary ones, what they show between the pixels taken off.
    fn stationary_alone(&mut self, state: &mut State, base: Option<Solution>) -> Result<Solution> {
        let latent = state.latent.clone().expect("a scene is known by now");
        self.find_aliasing(&state.still, &state.shaken, &latent, 0.80, 0.90)?;
        let base = match base {
            Some(solved) if state.as_result && self.aliasing.iter().all(Option::is_none) => return Ok(solved),
            base => base,
        };
        let settings = self.stationary_settings();
        let own = format!("alone {:?}", state.still);
        self.solved("stationary frames", &own, &settings, |run| run.solve_stationary(state, base.as_ref(), &settings, (0.90, 0.98)))
    }

    /// TSFs of the shaken frames of which none is known, beside what the stationary ones show. A frame of which no motion is found
    /// joins these; one of another scene, or whose blur cannot be told where the user named the sharp frames, is left out.
    fn estimate_blurs(&mut self, state: &mut State) -> Result<()> {
        if state.still.is_empty() {
            return Ok(());
        }
        let estimated: Vec<usize> = state.shaken.iter().copied().filter(|&i| !state.given[i]).collect();
        let may_join = self.settings.align && self.settings.sharp.is_none();
        let mut joined = Vec::new();
        let latent = state.latent.clone().expect("what the stationary frames show");
        for (k, &i) in estimated.iter().enumerate() {
            let part = k as f32 / estimated.len() as f32;
            self.progress(&format!("estimating the blur of {}", self.bracket.frames()[i].name), 0.10 + 0.30 * part)?;
            let own = format!("{i} {:?} {:?} {:?}", state.still, self.settings.model, self.settings.focal_px);
            let look = |run: &mut Self| Ok(run.estimate(i, &latent, |frame, search| frame.estimate(search)));
            let (tsf, detail, evidence) = self.remembered("blur", &own, |_| 0, look)?;
            (state.tsfs[i], state.details[i]) = (tsf, detail);
            let doubtful = std::mem::take(&mut self.registrations[i].doubtful);
            // A motion that explains no more than nothing does is none: deblurred by it, its frame would spoil what the others show.
            match evidence.filter(|e| !(doubtful || may_join) || !judge::explains_nothing(e)) {
                Some(e) => {
                    if doubtful {
                        self.registrations[i].registered = true;
                        self.registrations[i].reason = "no part of it tells by itself where it lies; its blur does".into();
                    }
                    if state.judgements[i].is_none() {
                        state.judgements[i] = Some(judge::blurred(&e));
                    }
                }
                // Nothing in it tells that it moved: its light counts where it lies.
                None if may_join && !doubtful => {
                    state.judgements[i] = Some(Judgement::untold());
                    joined.push(i);
                }
                _ => {
                    let why = if doubtful { self.registrations[i].reason.clone() } else { NO_TEXTURE.into() };
                    self.leave_out(i, &why)?;
                    state.judgements[i] = Some(Judgement { reason: why, ..Judgement::given(Kind::OtherScene) });
                    state.shaken.retain(|&k| k != i);
                }
            }
        }
        self.memo.depends(&(self.settings.model, self.settings.focal_px));
        state.joined = !joined.is_empty();
        if state.joined {
            self.place_stationary(state, &joined)?;
        }
        Ok(())
    }

    /// The frames `ids` count as they lie from here on: all stationary ones are placed anew, by all of their pixels and beside each other, from the one that shows enough.
    pub(super) fn place_stationary(&mut self, state: &mut State, ids: &[usize]) -> Result<()> {
        for &i in ids {
            state.count_as_it_lies(i);
        }
        if !self.settings.align {
            return Ok(());
        }
        let all = state.all();
        let sharp: Vec<bool> = (0..self.bracket.frames().len()).map(|i| state.still.contains(&i)).collect();
        let given = state.given.clone();
        let first = self.first_reference(&state.still).filter(|_| !given.contains(&true)).unwrap_or(state.reference);
        let own = format!("{first} {ids:?} {all:?}");
        let found = self.remembered("place", &own, |_| 0, |run| run.register_on(first, &all, &sharp, &given))?;
        let anew = |i: usize| state.still.contains(&i) && found[i].registered && !found[i].assumed && !given[i];
        let (w, h) = self.bracket.size();
        let back = self.motions[first].inverse();
        // From the first one; frames that are not placed anew lie beside it as before.
        let from_first = |i: usize| if anew(i) { found[i].motion() } else { self.motions[i] * back };
        let from_reference = from_first(state.reference).inverse();
        let motions: Vec<DMat3> = (0..sharp.len()).map(|i| register::rebased(&from_first(i), &from_reference, w, h)).collect();
        for i in (0..sharp.len()).filter(|&i| anew(i)) {
            self.registrations[i] = found[i].clone();
        }
        for (motion, registration) in motions.iter().zip(&mut self.registrations) {
            registration.homography = register::rows(motion);
        }
        self.motions = motions;
        Ok(())
    }

    /// Irradiance of all frames and their TSFs refined against it, in turn, from what the stationary frames gave (`base`); `None` where no shaken frame counts.
    fn rounds(&mut self, state: &mut State, base: Option<&Solution>) -> Result<Option<Solution>> {
        if state.shaken.is_empty() {
            return Ok(None);
        }
        let refined: Vec<usize> = state.shaken.iter().copied().filter(|&i| !state.given[i]).collect();
        for &i in &state.still {
            state.tsfs[i] = Some(Tsf::still(self.motions[i]));
        }
        let all = state.all();
        let rounds = if refined.is_empty() { 1 } else { ROUNDS };
        // TSFs that were given took no time.
        let begun = if refined.is_empty() { 0.0 } else { 0.40 };
        let mut latent = state.latent.clone().expect("a scene is known by now");
        let mut solution: Option<Solution> = None;
        for round in 0..rounds {
            let at = |part: f32| begun + (0.98 - begun) * (round as f32 + part) / rounds as f32;
            let own = format!("{round} {:?} {:?} {}", state.still, state.shaken, state.reduced);
            if round > 0 || state.reduced {
                self.progress("refining the blur", at(0.0))?;
                for &i in &refined {
                    let tsf = state.tsfs[i].clone();
                    state.tsfs[i] =
                        self.remembered("refinement", &format!("{i} {own}"), |_| 0, |run| Ok(run.refine(i, &latent, tsf.as_ref())))?;
                }
            }
            if round + 1 == rounds {
                self.find_aliasing(&state.still, &state.shaken, &latent, at(0.2), at(0.3))?;
            }
            let pad = self.pad(all.iter().filter_map(|&i| state.tsfs[i].as_ref()));
            let from = match solution.as_ref().or(base) {
                Some(found) => self.surrounded(&found.irradiance, found.pad, pad, &state.still, &state.shaken),
                None => self.surrounded(&latent, 0, pad, &state.still, &state.shaken),
            };
            // The first round only has to be better than the sharp frames alone, for the TSFs to be refined against it.
            let settings = if round + 1 < rounds { for_first_round(&self.settings.deblur) } else { self.settings.deblur.clone() };
            let solved =
                self.solved("irradiance", &own, &settings, |run| run.solve(&all, &state.tsfs, &from, pad, &settings, at(0.3), at(1.0)))?;
            latent = solved.cropped();
            solution = Some(solved);
        }
        Ok(solution)
    }

    /// For people to look at: patches of the shaken frames and their PSFs, eq. (11), against what the stationary ones show.
    fn describe_blurs(&mut self, state: &mut State) -> Result<()> {
        for &i in &state.shaken {
            let (Some(tsf), Some(latent)) = (&state.tsfs[i], &state.latent) else { continue };
            if state.details[i].is_null() {
                continue;
            }
            let own = format!("{i} {:?} {:?}", self.settings.patches, self.settings.psf_radius);
            state.details[i]["patches"] = self.remembered("PSFs", &own, |_| 0, |run| Ok(run.local_psfs(i, latent, tsf)))?;
        }
        let (w, h) = self.bracket.size();
        for (detail, tsf) in state.details.iter_mut().zip(&state.tsfs) {
            if let (true, Some(tsf)) = (detail.is_object(), tsf) {
                detail["extent_px"] = serde_json::json!(tsf::extent(tsf, w, h));
            }
        }
        Ok(())
    }
}

/// What an estimate says of whether its frame moved.
pub(super) fn evidence(found: &tsf::Estimate, size: (usize, usize)) -> BlurEvidence {
    BlurEvidence {
        still: found.still_worse_by,
        still_error: found.still_error,
        blank: found.blank_worse_by,
        stroke: tsf::stroke(&found.tsf, size.0, size.1),
    }
}
