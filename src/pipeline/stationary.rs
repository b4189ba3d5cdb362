//! Which frames were not moved while they were exposed.
//!
//! Frames are compared in pairs, both ways round: how much better a motion explains the one from the other, denoised, than one pose does. What noise, lens, mosaic and engine make
//! of the two is much the same both ways and cancels; a motion is not.

use super::Run;
use super::judge::{Judgement, Kind, Pair};
use super::plan::State;
use crate::deblur::Solution;
use crate::error::Result;
use crate::image::Rgb;

/// Frames that are taken for the first stationary one in turn, at most: another frame may show that it moved.
const FIRSTS: usize = 3;

impl Run<'_> {
    /// Which frames are stationary, and what they show; `None` where another scene is known.
    pub(super) fn stationary_frames(&mut self, state: &mut State) -> Result<Option<Solution>> {
        if state.latent.is_some() {
            self.lay_out(state)?;
            return Ok(None);
        }
        if !state.still.is_empty() {
            return self.solve_base(state).map(Some);
        }
        let used = state.all();
        let placed: Vec<usize> = used.iter().copied().filter(|&i| !self.registrations[i].doubtful).collect();
        let first = self.first_reference(&placed).unwrap_or(used[0]);
        let own = format!("{used:?}");
        let (judgements, still, motions, registrations) = self.remembered(
            "stationary frames",
            &own,
            |_| 0,
            |run| {
                run.judge_in_pairs(state, first, &placed)?;
                Ok((state.judgements.clone(), state.still.clone(), run.motions.clone(), run.registrations.clone()))
            },
        )?;
        (self.motions, self.registrations) = (motions, registrations);
        (state.judgements, state.still) = (judgements, still);
        state.shaken = used.into_iter().filter(|i| !state.still.contains(i)).collect();
        self.solve_base(state).map(Some)
    }

    /// Judgements of the frames `placed`, and those that are stationary, placed anew beside the first of them.
    fn judge_in_pairs(&mut self, state: &mut State, first: usize, placed: &[usize]) -> Result<()> {
        let used = state.all();
        let first = self.within_window(placed, |run| run.compare_in_pairs(state, first, placed))?;
        let stationary = |i: &usize| state.judgements[*i].as_ref().is_some_and(|j| j.kind == Kind::Stationary);
        let still: Vec<usize> = placed.iter().copied().filter(stationary).collect();
        (state.still, state.shaken) = (vec![first], used.iter().copied().filter(|&i| i != first).collect());
        self.lay_out(state)?;
        let joined: Vec<usize> = still.iter().copied().filter(|&i| i != first).collect();
        if !joined.is_empty() {
            self.place_stationary(state, &joined)?;
        }
        Ok(())
    }

    /// Judgements of the frames `placed`: `first`, which shows enough, is stationary, and each other one unless a motion explains it beside the one of these that is nearest in exposure. Where it
    /// shows that this one moved, it is the first itself. That is returned.
    fn compare_in_pairs(&mut self, state: &mut State, mut first: usize, placed: &[usize]) -> Result<usize> {
        let used = state.all();
        let mut scenes: Vec<Option<Rgb>> = vec![None; self.bracket.frames().len()];
        for attempt in 1..=FIRSTS {
            state.judgements[first] = Some(Judgement::first());
            let mut still = vec![first];
            let mut sharper = None;
            for i in self.by_exposure_from(first, placed) {
                if state.judgements[i].as_ref().is_some_and(|j| j.kind == Kind::Moved) {
                    continue;
                }
                let Some(&beside) = self.by_exposure_from(i, &still).first() else { break };
                self.progress("looking which frames moved", 0.04 + 0.05 * i as f32 / placed.len() as f32)?;
                let pair = self.compared(state, &used, &mut scenes, i, beside)?;
                if attempt < FIRSTS
                    && let Some(moved) = pair.other_moved()
                {
                    state.judgements[beside] = Some(moved);
                    sharper = Some(i);
                    break;
                }
                let judgement = pair.judgement();
                if judgement.as_ref().is_some_and(|j| j.kind == Kind::Stationary) {
                    still.push(i);
                }
                // Nothing in it tells that it moved: its light counts where it lies.
                state.judgements[i] = Some(judgement.unwrap_or_else(Judgement::untold));
            }
            let Some(i) = sharper else { break };
            first = i;
        }
        Ok(first)
    }

    /// The frames `ids` but `i`, the nearest in exposure time to it first.
    fn by_exposure_from(&self, i: usize, ids: &[usize]) -> Vec<usize> {
        let distance = |k: usize| (self.bracket.frames()[k].exposure_time / self.bracket.frames()[i].exposure_time).ln().abs();
        let mut others: Vec<usize> = ids.iter().copied().filter(|&k| k != i).collect();
        others.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)));
        others
    }

    /// The frame `i` beside the frame `other`: each looked at from what the other shows alone. `scenes`: what frames show alone, as far as that is known.
    fn compared(&mut self, state: &mut State, used: &[usize], scenes: &mut [Option<Rgb>], i: usize, other: usize) -> Result<Pair> {
        let mut look = |run: &mut Self, seen: usize, by: usize| -> Result<_> {
            (state.still, state.shaken) = (vec![by], used.iter().copied().filter(|&k| k != by).collect());
            let scene = match scenes[by].take() {
                Some(scene) => {
                    run.lay_out(state)?;
                    scene
                }
                None => run.solve_base(state)?.cropped(),
            };
            let found = run.looked_at(seen, &scene, by);
            scenes[by] = Some(scene);
            Ok(found)
        };
        let (forward, backward) = (look(self, i, other)?, look(self, other, i)?);
        let (forward, backward) = rayon::join(|| forward.evidence(), || backward.evidence());
        Ok(Pair { forward, backward })
    }
}
