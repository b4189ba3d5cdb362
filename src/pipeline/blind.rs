//! The stage for brackets without a sharp frame: what [`crate::blind`] needs of the run, and whether its answer is believed.

use super::{Event, Run, Settings};
use crate::blind::{self, Doubted, Frame, Joint, Lack, Look, PatchSetup, Start};
use crate::error::{Error, Result};
use crate::image::{Channels, Plane, Rgb};
use crate::mask;
use crate::merge;
use crate::psf::{self, Patch, Psf};
use crate::triage::Verdict;
use crate::tsf::{self, Tsf};
use glam::DVec2;
use serde_json::{Value, json};

/// What is done when no frame is sharp.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Blind {
    /// [`Blind::Joint`] when no frame is sharp, and when none is surely sharp and the estimate finds that all of them moved.
    #[default]
    Auto,
    /// Irradiance and the TSFs of all frames together, whatever the triage says of the frames.
    Joint,
    /// The paper's path (section III-B), whatever the triage says of the frames: PSFs of pairs of patches, aligned; TSFs from them.
    Patches,
    /// The frames are merged without deblurring when none is sharp.
    Off,
}

/// Irradiance to start from and one TSF for each of the frames used.
#[derive(Clone)]
pub(super) struct Found {
    pub start: Rgb,
    pub tsfs: Vec<Tsf>,
    pub reference: usize,
    /// Whether the TSFs were estimated at a smaller size than the frame's.
    pub reduced: bool,
}

/// A look at some frames.
struct Seen {
    frames: Vec<usize>,
    look: Look,
    /// Whether it was at the frames as a whole.
    whole: bool,
}

impl Seen {
    /// Those of `frames` whose blurs are longer than `extent` pixels.
    fn beyond(&self, frames: &[usize], extent: f64) -> Vec<usize> {
        let found = self.frames.iter().zip(self.look.extents());
        found.filter(|(i, e)| frames.contains(i) && *e > extent).map(|(i, _)| *i).collect()
    }

    fn all_moved(&self) -> bool {
        self.beyond(&self.frames, SHAKEN).len() == self.frames.len()
    }
}

/// What became of a bracket without a frame that is surely sharp.
#[derive(Clone)]
pub(super) enum AllBlurs {
    /// All blurs were found.
    Found(Found),
    /// These frames are sharp.
    Sharp(Vec<usize>),
    /// Nothing is to be deblurred by: what had to be said has been said.
    Unexplained,
}

/// Frames that may be sharp, of which none surely is.
pub(super) struct Doubt {
    frames: Vec<usize>,
    /// Those of them that pass for sharp.
    passing: Vec<usize>,
    /// Those of them whose edges are softer in one direction than across it.
    uneven: Vec<usize>,
    /// Whether the edges of all of them are equally soft in all directions.
    even: bool,
    /// How alike in their fine structure they are, [`Verdict::alike`], along the chain of them by which they are most so; 0 of one or two: two blurs
    /// may be alike by chance.
    alike: f64,
}

impl Doubt {
    /// Whether the frames stood still because they show the same: no two shakes are alike, let alone three, while a soft lens or scene is the same for all.
    fn show_the_same(&self) -> bool {
        self.alike > ALIKE
    }

    /// Whether that holds for motions of a pixel or two as well.
    pub fn show_surely_the_same(&self) -> bool {
        self.alike > SURELY_ALIKE
    }

    /// Whether it is about one frame without steep edges, as soft in all directions as a lens makes them.
    fn is_about_a_soft_one(&self) -> bool {
        self.passing.is_empty() && self.frames.len() == 1 && self.even
    }

    /// Growth of the residuals, when the frames `still` are held, up to which they did not move.
    fn most_growth(&self, still: &[usize]) -> f64 {
        match still {
            [one] if self.uneven.contains(one) => STOOD_STILL.uneven,
            [_] => STOOD_STILL.alone,
            _ => STOOD_STILL.together,
        }
    }

    /// Whether the frames `still` did not move, if residuals grow by `growth` when they are held.
    fn stands(&self, growth: f64, still: &[usize]) -> bool {
        growth < self.most_growth(still)
    }

    /// Whether a look by which the frames in doubt stood still, residuals growing by `growth` if they are held, does not settle it: one frame alone can
    /// be held still beside the others' motion whatever it did itself, and at half its size it hardly shows. Where standing explains more, it stood,
    /// unless its edges say otherwise.
    fn leaves_open(&self, growth: f64) -> bool {
        self.frames.len() == 1 && !self.passing.is_empty() && (growth > 1.0 || !self.uneven.is_empty())
    }
}

/// Held-out χ² of the joint estimate over that of the merge below which it is believed.
const EXPLAINED: f64 = 0.25;
/// The same where the joint estimate leaves little more than noise, and how much that is: a slight blur is worth undoing as well.
const SLIGHTLY: (f64, f64) = (0.8, 4.0);
/// Weight of the faintest frame's mask in the merge that is returned instead.
const LEAST_DETAIL: f64 = 0.1;

/// Steepness of the sharpest edges up to which a frame that passes for sharp may be blurred by some pixels: frames blurred by 4 px and more
/// measure up to 0.57, sharp ones of scenes with hard edges 0.58 and more, of soft scenes from 0.39 on. Being asked costs a sharp frame time alone.
const SURELY_STEEP: f64 = 0.60;
/// Detail up to which a frame that passes for sharp may be blurred, though another frame is surely sharp: most sharp ones measure more. At night, where
/// little but lamps can be seen, blurred ones may do so too.
const SURELY_DETAILED: f64 = 0.85;
/// How alike three frames or more are in their fine structure that stood still: sharp ones measure 0.92 and more in place and 0.77 and more displaced, two
/// shaken ones that are in doubt up to 0.76.
const ALIKE: f64 = 0.78;
/// The same where motions of a pixel or two are out of the question, too: beside a sharp frame 1.5 px leave 0.76 and less.
const SURELY_ALIKE: f64 = 0.92;
/// Least extent of the reference frame's blur in pixels for a bracket whose triage was in doubt to count as shaken throughout.
pub(super) const SHAKEN: f64 = 1.5;
/// No frame may have stood still.
pub(super) const ALL_MOVED: Doubted = Doubted { frames: &[], at_most: 0.0 };
/// Growth of the residuals, if frames did not move, up to which they did not.
struct StoodStill {
    /// Of one frame whose edges are uneven.
    uneven: f64,
    /// Of one frame.
    alone: f64,
    /// Of several.
    together: f64,
}

/// Sharp frames in place and displaced measure up to 1.3 alone and 1.5 together, frames blurred by 4 px and more from 1.5 and 2.9 on, and 1.25 where
/// what the others did contains the one's motion.
const STOOD_STILL: StoodStill = StoodStill { uneven: 1.2, alone: 1.5, together: 2.0 };
/// Evenness up to which edges are softer in one direction than across it: sharp frames without a surely steep edge measure 0.89 and more (of those
/// with one, a bridge over water 0.84), shaken ones 0.77 to 1.0.
const UNEVEN: f64 = 0.86;
/// Evenness from which the edges of one frame alone, none of them steep, may be a lens's.
const EVEN: f64 = 0.95;
/// Growth at the look above which the frames as they are, which tell more, need not be asked.
const CLEAR: f64 = 5.0;
/// Extent from which one of several frames that pass for sharp counts as shaken beside others that stand still: sharp ones that are noisy
/// measure up to 1.6.
pub(super) const SURELY_SHAKEN: f64 = 3.0;
/// Extent beside the frames that stand still, as they are, from which that is confirmed: between the two, since their noise widens it.
const CONFIRMED: f64 = 2.25;

/// Growth of the residuals behind the lens that all frames share up to which one that is held there stood still: sharp ones measure up to 1.11, frames shaken by 6
/// px and more 1.31 and more.
const HELD: f64 = 1.2;
/// Detail below which a frame that passes for sharp may have moved by a pixel or two, though an edge of it or of another is surely steep: sharp ones in
/// place mostly measure 1. Being asked costs a sharp frame time alone.
const LESS_DETAILED: f64 = 0.9;

/// Longer and shorter side at most, in pixels, of the part of the frames that is looked at in doubt. Blur that leaves a doubt is a few
/// pixels long, whatever the frame's size.
const WINDOW: (usize, usize) = (360, 240);
/// Displacement in pixels of a frame's window that the search covers.
const DISPLACED: f64 = 4.0;

/// The frames that may be sharp, where none is surely so.
pub(super) fn doubted(verdicts: &[Verdict], sharp: &[bool], used: &[usize]) -> Option<Doubt> {
    let frames: Vec<usize> = used.iter().copied().filter(|&i| sharp[i] || verdicts[i].is_alike()).collect();
    if frames.is_empty() || frames.iter().any(|&i| verdicts[i].steepness >= SURELY_STEEP) {
        return None;
    }
    let of = |is: &dyn Fn(usize) -> bool| frames.iter().copied().filter(|&i| is(i)).collect();
    let alike = if frames.len() > 2 { chained(verdicts, &frames) } else { 0.0 };
    Some(Doubt {
        passing: of(&|i| sharp[i]),
        uneven: of(&|i| verdicts[i].evenness < UNEVEN),
        even: frames.iter().all(|&i| verdicts[i].evenness > EVEN),
        alike,
        frames,
    })
}

/// The least [`Verdict::alike`] along the chain of `frames` along which it is greatest.
fn chained(verdicts: &[Verdict], frames: &[usize]) -> f64 {
    let (mut reached, mut others) = (vec![frames[0]], frames[1..].to_vec());
    let mut least = f64::INFINITY;
    while !others.is_empty() {
        let nearest = |k: usize| reached.iter().filter_map(|&i| verdicts[i].alike[others[k]]).fold(0.0, f64::max);
        let next = (0..others.len()).max_by(|&a, &b| nearest(a).total_cmp(&nearest(b))).expect("some are left");
        least = least.min(nearest(next));
        reached.push(others.swap_remove(next));
    }
    least
}

/// Frames that pass for sharp with little to spare, and the others that do, where one of those surely is: a steep edge of one frame says nothing
/// of the next, and the trail of a lamp has steep edges of its own.
pub(super) fn unsure_beside(verdicts: &[Verdict], sharp: &[bool], used: &[usize]) -> (Vec<usize>, Vec<usize>) {
    let passing = used.iter().copied().filter(|&i| sharp[i]);
    let little = |i: &usize| verdicts[*i].compared && verdicts[*i].detail < SURELY_DETAILED;
    let (unsure, sure): (Vec<usize>, Vec<usize>) = passing.partition(little);
    if sure.iter().any(|&i| verdicts[i].steepness >= SURELY_STEEP) { (unsure, sure) } else { (Vec::new(), Vec::new()) }
}

/// Frames that pass for sharp though none of them can be compared with another, an edge of one being steep, which may be a lamp's trail: all but the one with the
/// `shortest` exposure time, which is the least likely to have moved. Without a steep edge that is a doubt about all of them.
pub(super) fn untold(verdicts: &[Verdict], sharp: &[bool], used: &[usize], shortest: impl Fn(&[usize]) -> Option<usize>) -> Vec<usize> {
    let passing: Vec<usize> = used.iter().copied().filter(|&i| sharp[i]).collect();
    if passing.iter().any(|&i| verdicts[i].compared) || !passing.iter().any(|&i| verdicts[i].steepness >= SURELY_STEEP) {
        return Vec::new();
    }
    without(&passing, &shortest(&passing).into_iter().collect::<Vec<_>>())
}

/// Whether one of the frames `used` that passes for sharp has a little less fine structure than another: those that do not may have moved a little as well.
pub(super) fn less_detailed(verdicts: &[Verdict], used: &[usize]) -> bool {
    used.iter().map(|&i| &verdicts[i]).any(|v| v.sharp && v.compared && v.detail < LESS_DETAILED)
}

/// Those of the frames `passing` that are asked about as they are, after a look by which residuals grow by `growth` if all of `alike` are held: none
/// where that is clear, unless others were held with them, whose motion says nothing of theirs.
fn asked<'a>(growth: f64, alike: &[usize], passing: &'a [usize]) -> &'a [usize] {
    if growth < CLEAR || passing.len() < alike.len() { passing } else { &[] }
}

/// Positions of `some` among `frames`.
pub(super) fn places(some: &[usize], frames: &[usize]) -> Vec<usize> {
    (0..frames.len()).filter(|&k| some.contains(&frames[k])).collect()
}

/// Those of the frames at `places` that stood still behind the lens that the joint estimate `found`, and the growth of the residuals of all if each is held there.
/// Where motion alone explains a lens's blur, one that stood still cannot be held.
pub(super) fn stood_behind_lens(found: &Joint, places: &[usize]) -> (Vec<usize>, Vec<f64>) {
    let growth: Vec<f64> = places.iter().map(|&k| found.if_held(&[k])).collect();
    (can_be_held(places, &growth), growth)
}

/// Those of `places` that can be held behind the lens, since residuals hardly grow.
fn can_be_held(places: &[usize], growth: &[f64]) -> Vec<usize> {
    places.iter().zip(growth).filter(|(_, growth)| **growth < HELD).map(|(k, _)| *k).collect()
}

/// `frames` without those of `others`.
fn without(frames: &[usize], others: &[usize]) -> Vec<usize> {
    frames.iter().copied().filter(|i| !others.contains(i)).collect()
}

impl Settings {
    /// How [`Blind::Patches`] looks at the patches.
    pub(crate) fn patch_setup(&self) -> PatchSetup {
        let usual = PatchSetup::default();
        let side = self.patch_size.unwrap_or(usual.side);
        let radius = self.psf_radius.unwrap_or(usual.pair.radius).clamp(1, (side / 4).max(1));
        PatchSetup { side, pair: psf::Setup { radius, ..usual.pair }, ..usual }
    }
}

impl Run<'_> {
    /// Masks by which the mean of `channels` counts in a bracket of which the frames `still` alone are sharp.
    fn masks_with(&self, still: &[usize], channels: Channels) -> Vec<Plane> {
        let frames = self.bracket.frames();
        let sharp: Vec<bool> = (0..frames.len()).map(|i| still.contains(&i)).collect();
        mask::masks(frames, &sharp, self.settings.alpha as f32, &self.motions, channels)
    }

    /// Luminance of the frames `ids`: the mean of `channels`.
    pub(super) fn luminance_frames(&self, ids: &[usize], channels: Channels) -> Vec<Frame> {
        let masks = self.masks_with(&[], channels);
        let one = |&i: &usize| Frame::new(&self.exposures[i], &masks[i], &self.curves[i], self.bracket.frames()[i].exposure_time, channels);
        ids.iter().map(one).collect()
    }

    /// The frames `used` merged as they are placed, without deblurring.
    fn blurred_merge(&self, used: &[usize]) -> Rgb {
        let masks = self.masks_with(&[], Channels::ALL);
        let (aligned, seen) = self.placed(used, &masks, 0);
        merge::irradiance(self.bracket, &aligned, &seen, &self.curves, used)
    }

    /// `luminance`, the mean of `channels`, in the colours of `merged`: those of a blurred merge, but they change less across an edge than the
    /// luminance does.
    fn coloured(merged: &Rgb, luminance: &Plane, channels: Channels) -> Rgb {
        let mean = merged.mean_of(channels);
        merged.map_planes(|p| {
            let data =
                p.data.iter().zip(mean.data.iter().zip(&luminance.data)).map(|(c, (m, l))| c * l / m.max(f32::MIN_POSITIVE)).collect();
            Plane { width: p.width, height: p.height, data }
        })
    }

    /// Irradiance to start from where the TSFs of all of the frames `used` are known: no frame shows the scene, and the colour
    /// solver's iterations are dear.
    pub(super) fn start_from_tsfs(&mut self, used: &[usize], tsfs: &[Option<Tsf>]) -> Result<Rgb> {
        let channels = self.most_telling(used, used);
        let (frames, merged) = (self.luminance_frames(used, channels), self.blurred_merge(used));
        let (w, h) = self.bracket.size();
        let known: Vec<Tsf> = used.iter().map(|&i| tsfs[i].clone().unwrap_or_else(Tsf::identity)).collect();
        let pad = self.pad(known.iter());
        let luminance = blind::luminance_of(&frames, &known, &merged.mean_of(channels), pad);
        Ok(Self::coloured(&merged, &luminance.crop(pad, pad, w, h), channels))
    }

    /// The TSFs of all of the frames `used` and a scene to start from, unless a merge explains them as well or, where there is `doubt`, some of
    /// them are sharp. Progress runs from `from` to `to`.
    pub(super) fn all_blurs(&mut self, used: &[usize], doubt: Option<&Doubt>, from: f32, to: f32) -> Result<AllBlurs> {
        let at = |part: f32| from + part * (to - from);
        let or_merged = |found: Option<Found>| found.map_or(AllBlurs::Unexplained, AllBlurs::Found);
        if self.settings.blind == Blind::Patches {
            return Ok(or_merged(self.patches(used, from, to)?));
        }
        let Some(doubt) = doubt else { return Ok(or_merged(self.joint(used, None, None, &[], from, to)?.0)) };
        let Doubt { frames: alike, passing, .. } = doubt;
        if doubt.show_the_same() {
            self.blind = json!({ "method": "joint", "believed": false, "in_doubt": true, "alike": doubt.alike });
            return Ok(AllBlurs::Sharp(alike.clone()));
        }
        let frames = if alike.len() > 1 { alike } else { used };
        let mut seen = self.look(frames, from, at(0.2))?;
        let mut growth = 0.0;
        if let Some(seen) = &seen {
            growth = self.if_still(seen, alike);
            if doubt.stands(growth, alike) && !(seen.all_moved() && doubt.leaves_open(growth)) {
                return Ok(AllBlurs::Sharp(alike.clone()));
            }
            if doubt.is_about_a_soft_one() && self.if_still_behind_lens(seen, alike).is_some_and(|growth| doubt.stands(growth, alike)) {
                return Ok(AllBlurs::Sharp(alike.clone()));
            }
            let shaken = seen.beyond(alike, SURELY_SHAKEN);
            let still = without(alike, &shaken);
            // One alone stands still beside another's motion, whatever it did itself.
            let tells = still.len() > 1 || (still.len() == 1 && frames.len() == used.len());
            if !shaken.is_empty() && tells && doubt.stands(self.if_still(seen, &still), &still) {
                return self.settled(alike, shaken);
            }
        }
        let doubtful = !passing.is_empty();
        if doubtful {
            let shaken = seen.as_ref().map_or_else(Vec::new, |seen| seen.beyond(passing, SURELY_SHAKEN));
            let still = without(passing, &shaken);
            let mut none_still = seen.as_ref().is_some_and(Seen::all_moved);
            if !none_still && !shaken.is_empty() && still.len() == 1 && frames.len() < used.len() {
                // One alone stands still beside another's motion, whatever it did itself: the others tell.
                seen = self.look(used, at(0.2), at(0.3))?;
                none_still = match &seen {
                    Some(seen) => seen.all_moved() && !doubt.stands(self.if_still(seen, &still), &still),
                    None => false,
                };
            }
            if !none_still && (!still.is_empty() || passing.len() == 1) {
                return self.settled(passing, shaken);
            }
        }
        let look = seen.filter(|seen| seen.frames == used && seen.whole).map(|seen| seen.look);
        let (found, still) = self.joint(used, look, doubtful.then_some(doubt), asked(growth, alike, passing), at(0.3), to)?;
        if found.is_some() || !doubtful {
            return Ok(or_merged(found));
        }
        let moved = without(passing, &still);
        if moved.len() < passing.len() || passing.len() == 1 {
            return self.settled(passing, moved);
        }
        self.degrade(
            "every frame that could be sharp seems to have moved, and camera shake does not explain the frames: they are merged without \
             deblurring, the least blurred weighted most (--sharp names frames that are sharp)"
                .into(),
        )?;
        Ok(AllBlurs::Unexplained)
    }

    /// By how much the residuals of all frames looked at grow if the frames `still` of them did not move.
    fn if_still(&mut self, seen: &Seen, still: &[usize]) -> f64 {
        let places = places(still, &seen.frames);
        let growth = seen.look.if_still(&places);
        self.blind["residual_if_still"] = json!(growth);
        growth
    }

    /// The same behind a lens, if there is one.
    fn if_still_behind_lens(&mut self, seen: &Seen, still: &[usize]) -> Option<f64> {
        let growth = seen.look.if_still_behind_lens(&places(still, &seen.frames));
        self.blind["residual_if_still_behind_lens"] = json!(growth);
        growth
    }

    /// The frames that stay sharp of those that pass for it (`passing`), of which `moved` seem to have. One alone stays: that it moved is not
    /// believed either.
    fn settled(&mut self, passing: &[usize], moved: Vec<usize>) -> Result<AllBlurs> {
        let still = without(passing, &moved);
        Ok(AllBlurs::Sharp(if still.is_empty() { passing.to_vec() } else { without(passing, &self.confirmed(moved, &still)?) }))
    }

    /// Those of the frames `moved` that are blurred beside the frames `still`, too, and explained by that: a coarse look at frames that all are noisy
    /// errs by some pixels now and then, what JPEG files make of lamps passes for blur, and a sharp frame that counts as shaken is missed where the
    /// blurs of the others are estimated.
    pub(super) fn confirmed(&mut self, moved: Vec<usize>, still: &[usize]) -> Result<Vec<usize>> {
        if moved.is_empty() {
            return Ok(moved);
        }
        let sharp: Vec<bool> = (0..self.exposures.len()).map(|i| still.contains(&i)).collect();
        self.weigh(&sharp, &[still, &moved].concat());
        let (scene, _) = self.start(still, 0);
        let (w, h) = self.bracket.size();
        let mut tsfs: Vec<Option<Tsf>> = vec![None; self.exposures.len()];
        for &i in &moved {
            tsfs[i] = self.estimate(i, &scene, |frame, search| frame.estimate(search)).0;
        }
        let blurred = |i: &usize| tsfs[*i].as_ref().is_none_or(|t| tsf::extent(t, w, h) > CONFIRMED);
        let blurred: Vec<usize> = moved.into_iter().filter(blurred).collect();
        self.explained(blurred, still, tsfs, &scene)
    }

    /// Those of the frames `blurred` that their blurs explain beside the frames `still`, which show `scene`, and those without a TSF.
    fn explained(&mut self, blurred: Vec<usize>, still: &[usize], mut tsfs: Vec<Option<Tsf>>, scene: &Rgb) -> Result<Vec<usize>> {
        let judged: Vec<usize> = blurred.iter().copied().filter(|&i| tsfs[i].is_some()).collect();
        if judged.is_empty() {
            return Ok(blurred);
        }
        for &i in still {
            tsfs[i] = Some(Tsf::still(self.motions[i]));
        }
        let all = [still, &judged].concat();
        let settings = super::shaken::for_first_round(&self.settings.deblur);
        let pad = self.pad(all.iter().filter_map(|&i| tsfs[i].as_ref()));
        let from = self.surrounded(scene, 0, pad, still, &judged);
        let solved = self.solve(&all, &tsfs, &from, pad, &settings, 0.02, 0.02)?;
        let misfits = all.iter().zip(&solved.misfit).skip(still.len());
        let failing: Vec<usize> = misfits
            .filter(|(i, misfit)| self.unexplained(**i, misfit, scene, super::shaken::UNEXPLAINED).is_some())
            .map(|(i, _)| *i)
            .collect();
        Ok(without(&blurred, &failing))
    }

    /// Frame of `used` to start from, its luminance the mean of `channels`, and the next best: the shortest are nearly always the least blurred.
    fn starts(&self, used: &[usize], channels: Channels) -> Vec<Start> {
        let time = |k: usize| self.bracket.frames()[used[k]].exposure_time;
        let mut order: Vec<usize> = (0..used.len()).collect();
        order.sort_by(|&a, &b| time(a).total_cmp(&time(b)));
        if let Some(r) = self.settings.reference.and_then(|r| used.iter().position(|&i| i == r)) {
            order = vec![r];
        }
        order.into_iter().take(2).map(|k| Start { reference: k, luminance: self.alone(used[k], channels) }).collect()
    }

    /// Irradiance of the frame `i` alone, the mean of `channels`.
    pub(super) fn alone(&self, i: usize, channels: Channels) -> Plane {
        merge::irradiance(self.bracket, &self.exposures, &self.own_masks(i), &self.curves, &[i]).mean_of(channels)
    }

    /// A look at `frames`: the joint estimate of a part of the frame with much texture, at its coarsest level; `None` where there is none to be had.
    fn look(&mut self, frames: &[usize], from: f32, to: f32) -> Result<Option<Seen>> {
        if frames.len() < 2 {
            return Ok(None);
        }
        let channels = self.most_telling(frames, frames);
        let whole = self.luminance_frames(frames, channels);
        let Some(window) = self.window(frames, &whole, WINDOW) else { return Ok(None) };
        let (ww, wh) = window.size;
        // The look takes the frames for displaced by whole pixels alone.
        let turned = |(k, i): (usize, &usize)| {
            [(-1.0, -1.0), (1.0, 1.0)].iter().any(|&(a, b)| {
                let c = window.centre + 0.5 * DVec2::new(a * ww as f64, b * wh as f64);
                (self.shift(*i, c) - window.shifts[k]).abs().max_element() > DISPLACED
            })
        };
        if frames.iter().enumerate().any(turned) {
            return Ok(None);
        }
        let cut = window.cut(&whole);
        let starts: Vec<Start> =
            self.starts(frames, channels).into_iter().map(|s| Start { luminance: window.crop(&s.luminance, s.reference), ..s }).collect();
        let events = &mut self.events;
        let look = Look::at(&cut, &starts, &mut |s| {
            let stage = "no frame is surely sharp: looking whether all moved".into();
            events(Event::Progress { stage, fraction: from + (to - from) * s.fraction })
        })
        .ok_or(Error::Cancelled)?;
        let names: Vec<&str> = frames.iter().map(|&i| self.bracket.frames()[i].name.as_str()).collect();
        self.blind = json!({
            "method": "joint", "believed": false, "in_doubt": true, "looked_at": names, "window_px": window.report(), "extent_px": look.extents(),
        });
        Ok(Some(Seen { frames: frames.to_vec(), look, whole: (ww, wh) == self.bracket.size() }))
    }

    /// The paper's path (section III-B) over the frames `used`; `None` where patches lack texture.
    fn patches(&mut self, used: &[usize], from: f32, to: f32) -> Result<Option<Found>> {
        let frames = self.luminance_frames(used, self.most_telling(used, used));
        let times = |k: &usize| self.bracket.frames()[used[*k]].exposure_time;
        let shortest = (0..used.len()).min_by(|a, b| times(a).total_cmp(&times(b))).unwrap_or(0);
        let reference = self.settings.reference.and_then(|r| used.iter().position(|&i| i == r)).unwrap_or(shortest);
        let setup = self.settings.patch_setup();
        let events = &mut self.events;
        let found = blind::from_patches(&frames, reference, &setup, &mut |f| {
            events(Event::Progress { stage: "estimating the blurs of pairs of patches".into(), fraction: from + 0.9 * (to - from) * f })
        });
        let name = |k: usize| self.bracket.frames()[used[k]].name.clone();
        let found = match found {
            Ok(found) => found,
            Err(Lack::Cancelled) => return Err(Error::Cancelled),
            Err(Lack::Texture(k)) => {
                self.degrade(format!(
                    "{}: shares no patch of enough texture with {}, unclipped in both, to find its blur; the frames are merged without \
                     deblurring (--blind joint may find more)",
                    name(k),
                    name(reference)
                ))?;
                return Ok(None);
            }
        };
        let psfs = |k: usize| {
            let one = |(p, h): &(Patch, Psf)| json!({ "x": p.x, "y": p.y, "size": p.size, "radius": h.radius, "values": h.values.data });
            json!({ "frame": name(k), "psfs": found.psfs[k].iter().map(one).collect::<Vec<_>>() })
        };
        self.blind = json!({
            "method": "patches",
            "reference": name(reference),
            "believed": true,
            "reference_error": found.error,
            "patches": (0..used.len()).map(psfs).collect::<Vec<_>>(),
        });
        let mut tsfs = vec![None; self.bracket.frames().len()];
        for (&i, tsf) in used.iter().zip(&found.tsfs) {
            self.motions[i] = tsf.centre();
            tsfs[i] = Some(tsf.clone());
        }
        let start = self.start_from_tsfs(used, &tsfs)?;
        Ok(Some(Found { start, tsfs: found.tsfs, reference: used[reference], reduced: false }))
    }

    /// The joint estimate, after `look` at all of the frames where there was one. Where there is `doubt` whether all moved, it is believed only if it
    /// finds that they did, and that those `asked` about are not explained as well if they did not; otherwise the frames that hardly moved.
    fn joint(
        &mut self,
        used: &[usize],
        look: Option<Look>,
        doubt: Option<&Doubt>,
        asked: &[usize],
        from: f32,
        to: f32,
    ) -> Result<(Option<Found>, Vec<usize>)> {
        let channels = self.most_telling(used, used);
        let (frames, merged) = (self.luminance_frames(used, channels), self.blurred_merge(used));
        let names: Vec<String> = used.iter().map(|&i| self.bracket.frames()[i].name.clone()).collect();
        let starts = self.starts(used, channels);
        let asked_places = places(asked, used);
        let at_most = doubt.map_or(0.0, |doubt| doubt.most_growth(asked));
        let doubted = Doubted { frames: &asked_places, at_most };
        let doubtful = doubt.is_some();
        let why = if doubtful { "no frame is surely sharp" } else { "no frame is sharp" };
        let still: Vec<Tsf> = used.iter().map(|&i| Tsf::still(self.motions[i])).collect();
        let events = &mut self.events;
        let found = blind::estimate(&frames, &starts, look, &doubted, (&merged.mean_of(channels), &still), &mut |s| {
            let size = if s.scale > 1 { format!(" at 1/{} of the size", s.scale) } else { String::new() };
            events(Event::Progress { stage: format!("{why}: estimating all blurs{size}"), fraction: from + (to - from) * s.fraction })
        })
        .ok_or(Error::Cancelled)?;
        let (joint, alone) = (blind::geometric_mean(&found.held_out), blind::geometric_mean(&found.held_out_merge));
        let (w, h) = self.bracket.size();
        let extents: Vec<f64> = found.tsfs.iter().map(|t| tsf::extent(t, w, h)).collect();
        let explained = joint < EXPLAINED * alone || (joint < SLIGHTLY.0 * alone && joint < SLIGHTLY.1);
        let moved: Vec<usize> = used.iter().zip(&extents).filter(|(_, e)| **e > SHAKEN).map(|(i, _)| *i).collect();
        // The frames as they are tell more than a look at half their size.
        let stood_still = !asked.is_empty() && doubt.is_some_and(|doubt| doubt.stands(found.if_still, asked));
        let all_moved = explained && (!doubtful || (moved.len() == used.len() && !stood_still));
        let in_question = doubt.filter(|_| all_moved && found.lens_px > 0.0).map(|doubt| &doubt.passing);
        let held = in_question.map(|passing| stood_behind_lens(&found, &places(passing, used)));
        let believed = all_moved && held.as_ref().is_none_or(|(stood, _)| stood.is_empty());
        self.blind = json!({
            "method": "joint",
            "reference": names[found.reference],
            "believed": believed,
            "in_doubt": doubtful,
            "channels": channels.names(),
            "extent_px": extents,
            "estimated_at_scale": found.scale,
            "residual_if_still": (!asked_places.is_empty()).then_some(found.if_still),
            "held_out_chi_squared": found.held_out,
            "held_out_chi_squared_of_merge": found.held_out_merge,
            "lens_px": found.lens_px,
            "residual_if_held_behind_lens": held.as_ref().map(|(_, growth)| growth),
            "ways": found.ways,
        });
        if !believed && let Some(doubt) = doubt {
            let still = if let Some((stood, _)) = held {
                stood.iter().map(|&k| used[k]).collect()
            } else if stood_still {
                asked.to_vec()
            } else if explained {
                without(used, &moved)
            } else if joint > alone && doubt.passing.len() == used.len() {
                // Whatever the frames do not agree about, motion makes it worse: a response that is not quite theirs, flare, what moved by itself.
                used.to_vec()
            } else {
                Vec::new()
            };
            return Ok((None, still));
        }
        if !believed {
            self.degrade(format!(
                "no frame is sharp, and camera shake explains the frames no better than a merge (residuals {joint:.1} against {alone:.1} \
                 times the noise): they are merged without deblurring, the least blurred weighted most"
            ))?;
            return Ok((None, Vec::new()));
        }
        let start = self.scene(used, &found.tsfs, &found.luminance, channels);
        Ok((Some(Found { start, tsfs: found.tsfs, reference: used[found.reference], reduced: found.scale > 1 }), Vec::new()))
    }

    /// `luminance`, the mean of `channels`, in colour, the frames `used` as `tsfs` place them from now on.
    pub(super) fn scene(&mut self, used: &[usize], tsfs: &[Tsf], luminance: &Plane, channels: Channels) -> Rgb {
        for (&i, tsf) in used.iter().zip(tsfs) {
            self.motions[i] = tsf.centre();
        }
        Self::coloured(&self.blurred_merge(used), luminance, channels)
    }

    /// `tsfs`, those of the frames `used` but for `held` such that pixels of them that the scene has not seen are explained better, from the scene `latent`.
    /// Frames that the joint estimate would shrink keep theirs: the steps are many, and each is as dear as the frame is large.
    pub(super) fn cross_validated(
        &mut self,
        used: &[usize],
        held: &[usize],
        tsfs: &[Option<Tsf>],
        latent: &Rgb,
        reference: usize,
        (from, to): (f32, f32),
    ) -> Result<Vec<Option<Tsf>>> {
        let mut tsfs = tsfs.to_vec();
        if !blind::fits(latent.size()) {
            return Ok(tsfs);
        }
        let channels = self.most_telling(used, used);
        let frames = self.luminance_frames(used, channels);
        let known: Vec<Tsf> = used.iter().map(|&i| tsfs[i].clone().expect("frames without were left out")).collect();
        let centre = used.iter().position(|&i| i == reference).unwrap_or(0);
        let events = &mut self.events;
        let found = blind::cross_validated(&frames, &latent.mean_of(channels), &known, &places(held, used), centre, &mut |s| {
            events(Event::Progress { stage: "refining the blurs by pixels held out".into(), fraction: from + (to - from) * s.fraction })
        })
        .ok_or(Error::Cancelled)?;
        for (&i, tsf) in used.iter().zip(found) {
            tsfs[i] = Some(tsf);
        }
        Ok(tsfs)
    }

    /// Masks by which the frame `i` alone counts.
    fn own_masks(&self, i: usize) -> Vec<Plane> {
        self.masks_with(&[i], Channels::ALL)
    }

    /// Lessens the masks of the frames with less fine structure, for a merge of blurred frames, by the square of `detail` (0..=1 per frame): a long
    /// frame has so little noise that it would count most all the same.
    pub(super) fn prefer_detail(&mut self, detail: impl Fn(usize) -> f64) {
        self.shares = (0..self.masks.len()).map(|i| detail(i).powi(2).clamp(LEAST_DETAIL, 1.0) as f32).collect();
        for (mask, share) in self.masks.iter_mut().zip(&self.shares) {
            mask.data.iter_mut().for_each(|m| *m *= share);
        }
    }

    /// What the report says about a bracket without a sharp frame; null where there was one.
    pub(super) fn blind_report(&mut self) -> Value {
        std::mem::take(&mut self.blind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict(detail: f64, steepness: f64, sharp: bool) -> Verdict {
        Verdict { sharp, detail, compared: true, linked: true, steepness, evenness: 1.0, alike: vec![None; 5], reason: String::new() }
    }

    #[test]
    fn frames_with_little_to_spare_are_asked_beside_one_that_is_surely_sharp() {
        let of = |all: &[Verdict], used: &[usize]| unsure_beside(all, &all.iter().map(|v| v.sharp).collect::<Vec<_>>(), used);
        let mut all = [verdict(1.0, 0.7, true), verdict(0.71, 0.5, true), verdict(0.95, 0.5, true), verdict(0.2, 0.5, false)];
        assert_eq!(of(&all, &[0, 1, 2, 3]), (vec![1], vec![0, 2]));
        assert_eq!(of(&all, &[1, 2, 3]), (vec![], vec![]), "none of those in use is surely sharp: that is a doubt about all");
        all[1] = verdict(0.71, 0.6, true);
        assert_eq!(of(&all, &[0, 1, 2, 3]), (vec![1], vec![0, 2]), "trails of lamps have steep edges, too");
        all[1] = Verdict { compared: false, ..verdict(0.71, 0.5, true) };
        assert_eq!(of(&all, &[0, 1, 2, 3]), (vec![], vec![0, 1, 2]), "nothing says that it is less fine than another");
    }

    #[test]
    fn of_frames_that_nothing_can_be_compared_with_the_shortest_counts_as_sharp() {
        let shortest = |ids: &[usize]| ids.iter().copied().min_by_key(|i| [2, 1, 3][*i]);
        let of = |steep: [f64; 3], used: &[usize]| {
            let all = steep.map(|s| Verdict { compared: false, ..verdict(1.0, s, true) });
            untold(&all, &[true, true, true], used, shortest)
        };
        assert_eq!(of([0.7, 0.7, 0.7], &[0, 1, 2]), [0, 2]);
        assert_eq!(of([0.7, 0.5, 0.5], &[0, 1, 2]), [0, 2], "trails have steep edges, and noise hides others");
        assert_eq!(of([0.7, 0.5, 0.5], &[0, 2]), [2], "of those in use");
        assert_eq!(of([0.5, 0.5, 0.5], &[0, 1, 2]), [0; 0], "no edge is steep: that is a doubt about all");
        let mut all = [0.7, 0.7, 0.7].map(|s| Verdict { compared: false, ..verdict(1.0, s, true) });
        all[2].compared = true;
        assert_eq!(untold(&all, &[true, true, true], &[0, 1, 2], shortest), [0; 0], "something tells");
        assert_eq!(untold(&all, &[true, true, false], &[0, 1, 2], shortest), [0], "of those that pass");
    }

    #[test]
    fn a_frame_a_little_less_fine_than_another_may_have_moved_a_little() {
        let uncompared = Verdict { compared: false, ..verdict(0.5, 0.5, true) };
        let all = [verdict(1.0, 0.7, true), verdict(0.87, 0.7, true), uncompared, verdict(0.4, 0.3, false)];
        assert!(less_detailed(&all, &[0, 1]));
        assert!(!less_detailed(&all, &[0, 3]), "the other one does not pass for sharp");
        assert!(!less_detailed(&all, &[0]), "the other one is not in use");
        assert!(!less_detailed(&all, &[0, 2]), "nothing says that it is less fine than another");
    }

    #[test]
    fn three_frames_that_show_the_same_stood_still() {
        let of = |pairs: &[(usize, usize, f64)], count: usize| {
            let mut all: Vec<Verdict> = (0..count).map(|_| verdict(1.0, 0.5, true)).collect();
            for &(i, j, alike) in pairs {
                (all[i].alike[j], all[j].alike[i]) = (Some(alike), Some(alike));
            }
            let doubt = doubted(&all, &vec![true; count], &(0..count).collect::<Vec<_>>()).expect("no edge is surely steep");
            (doubt.alike, doubt.show_the_same(), doubt.show_surely_the_same())
        };
        assert_eq!(of(&[(0, 1, 0.99)], 2), (0.0, false, false), "two may be alike by chance");
        assert_eq!(of(&[(0, 1, 0.99), (1, 2, 0.95)], 3), (0.95, true, true));
        assert_eq!(of(&[(0, 1, 0.99), (0, 2, 0.5), (1, 2, 0.8)], 3), (0.8, true, false), "a chain by way of the second");
        assert_eq!(of(&[(0, 1, 0.99), (0, 2, 0.6), (1, 2, 0.7)], 3), (0.7, false, false));
        assert_eq!(of(&[(0, 1, 0.99), (2, 3, 0.99)], 4), (0.0, false, false), "nothing tells of one half beside the other");
    }

    #[test]
    fn one_frame_alone_is_asked_about_as_it_is() {
        let doubt = |frames: &[usize], passing: &[usize], uneven: &[usize]| Doubt {
            alike: 0.0,
            frames: frames.to_vec(),
            passing: passing.to_vec(),
            uneven: uneven.to_vec(),
            even: uneven.is_empty(),
        };
        assert!(doubt(&[0], &[0], &[]).leaves_open(1.3), "beside the others' motion it can be held whatever it did");
        assert!(!doubt(&[0], &[0], &[]).leaves_open(0.9), "standing explains more");
        assert!(doubt(&[0], &[0], &[0]).leaves_open(0.9), "edges of one direction are softer, all the same");
        assert!(!doubt(&[0, 1], &[0, 1], &[0]).leaves_open(1.3), "two hold each other");
        assert!(!doubt(&[0], &[], &[0]).leaves_open(1.3), "none passes for sharp");
    }

    #[test]
    fn a_frame_whose_edges_are_uneven_has_less_to_show_for_having_moved() {
        let doubt = Doubt { frames: vec![0, 1, 2], passing: vec![0, 1, 2], uneven: vec![1, 2], even: false, alike: 0.0 };
        assert!(doubt.stands(1.3, &[0]) && !doubt.stands(1.3, &[1]));
        assert!(doubt.stands(1.1, &[1]), "its residuals hardly grow");
        assert!(!doubt.stands(1.6, &[0]));
        assert!(doubt.stands(1.9, &[0, 1]) && doubt.stands(1.9, &[1, 2]) && !doubt.stands(2.1, &[0, 1]), "frames hold each other");
    }

    #[test]
    fn what_frames_held_with_them_did_says_nothing_of_the_passing_ones() {
        assert_eq!(asked(2.5, &[0, 1], &[0, 1]), [0, 1]);
        assert_eq!(asked(20.0, &[0, 1], &[0, 1]), [0; 0], "the look is clear about them");
        assert_eq!(asked(20.0, &[0, 1], &[0]), [0], "what moved may be the other one");
        assert_eq!(asked(20.0, &[0, 1], &[]), [0; 0]);
    }

    #[test]
    fn frames_that_can_be_held_behind_the_lens_stood_still() {
        // Soft scenes, one sharp frame and one that passes for it.
        assert_eq!(can_be_held(&[0, 1], &[1.061, 1.483]), [0]);
        assert_eq!(can_be_held(&[0, 1], &[1.112, 1.699]), [0]);
        assert_eq!(can_be_held(&[0, 2], &[1.9, 1.07]), [2]);
        // Frames that all moved.
        assert_eq!(can_be_held(&[0, 1], &[1.366, 4.413]), [0; 0]);
        assert_eq!(can_be_held(&[0], &[1.314]), [0; 0]);
    }

    #[test]
    fn doubt_is_about_frames_without_steep_edges() {
        let of = |all: &[Verdict], used: &[usize]| {
            let sharp: Vec<bool> = all.iter().map(|v| v.sharp).collect();
            doubted(all, &sharp, used).map(|d| (d.frames, d.passing))
        };
        let mut all = [verdict(1.0, 0.45, true), verdict(0.9, 0.5, true), verdict(0.3, 0.4, false)];
        assert_eq!(of(&all, &[0, 1, 2]), Some((vec![0, 1], vec![0, 1])));
        assert_eq!(of(&all, &[0, 2]), Some((vec![0], vec![0])), "frames that are left out do not count");
        all[0] = verdict(1.0, 0.3, false);
        assert_eq!(of(&all, &[0, 1, 2]), Some((vec![0, 1], vec![1])), "as fine as another, but softer than edges are");
        all[1] = verdict(1.0, 0.6, true);
        assert_eq!(of(&all, &[0, 1, 2]), None, "one is surely sharp");
        let uncompared = Verdict { compared: false, ..verdict(1.0, 0.3, false) };
        assert_eq!(of(&[uncompared, verdict(0.3, 0.4, false)], &[0, 1]), None, "nothing says that one is as fine as another");
    }
}
