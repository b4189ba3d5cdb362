//! The stage for brackets without a sharp frame: what [`crate::blind`] needs of the run, and whether its answer is believed.

use super::{Event, Run, Settings};
use crate::blind::{self, Doubted, Frame, Lack, Look, PatchSetup, Start};
use crate::error::{Error, Result};
use crate::image::{Channels, Plane, Rgb};
use crate::mask;
use crate::merge;
use crate::pose::{Pose, project};
use crate::psf::{self, Patch, Psf};
use crate::triage::Verdict;
use crate::tsf::{self, Tsf};
use glam::{DMat3, DVec2};
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

/// A part of some frames that lies on the same part of the scene in all of them, to the pixel.
struct Window {
    /// Its upper left corner in the reference frame, pixels.
    at: (usize, usize),
    /// Its width and height in pixels.
    size: (usize, usize),
    /// Its centre in the reference frame, centred pixels.
    centre: DVec2,
    /// How far it lies from there in each of the frames, whole pixels.
    shifts: Vec<DVec2>,
}

impl Window {
    /// Its upper left corner in the frame `k` of them.
    fn place(&self, k: usize) -> (usize, usize) {
        ((self.at.0 as f64 + self.shifts[k].x) as usize, (self.at.1 as f64 + self.shifts[k].y) as usize)
    }

    /// What it shows of `plane`, the frame `k`'s.
    fn crop(&self, plane: &Plane, k: usize) -> Plane {
        let (x, y) = self.place(k);
        plane.crop(x, y, self.size.0, self.size.1)
    }

    /// The `frames` within it.
    fn cut(&self, frames: &[Frame]) -> Vec<Frame> {
        frames.iter().enumerate().map(|(k, f)| f.crop(self.place(k), self.size)).collect()
    }

    /// `tsf` of the frame `k` as the window sees it: exact where it has no rotations out of the image plane, else true at its centre.
    fn seen(&self, k: usize, tsf: &Tsf) -> Tsf {
        let here = self.centre + self.shifts[k];
        tsf.around(here).about(DMat3::from_translation(-here) * tsf.base * DMat3::from_translation(self.centre))
    }

    /// The way back: `tsf` that was found in the window of the frame `k`, on the frame.
    fn on_frame(&self, k: usize, tsf: &Tsf) -> Tsf {
        let here = self.centre + self.shifts[k];
        tsf.around(-here).about(DMat3::from_translation(here) * tsf.base * DMat3::from_translation(-self.centre))
    }

    /// Left, top, width and height in the reference frame.
    fn report(&self) -> [usize; 4] {
        [self.at.0, self.at.1, self.size.0, self.size.1]
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

/// What frames did that were taken for sharp, where one of them at least moved by a pixel or two.
#[derive(Clone)]
pub(super) enum SetFree {
    /// All of them moved.
    All(Found),
    /// These stood still.
    Beside(Vec<usize>),
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
const SHAKEN: f64 = 1.5;
/// No frame may have stood still.
const ALL_MOVED: Doubted = Doubted { frames: &[], at_most: 0.0 };
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
const SURELY_SHAKEN: f64 = 3.0;
/// Extent beside the frames that stand still, as they are, from which that is confirmed: between the two, since their noise widens it.
const CONFIRMED: f64 = 2.25;

/// Detail below which a frame that passes for sharp may have moved by a pixel or two, though an edge of it or of another is surely steep: sharp ones in
/// place mostly measure 1. Being asked costs a sharp frame time alone.
const LESS_DETAILED: f64 = 0.9;

/// What frames show once those that were taken for sharp may move, or have to show for that to be believed.
struct Shown {
    /// Residuals over those before; at most.
    left: f64,
    /// [`blind::Freed::unlike`]; at least.
    unlike: f64,
}

impl Shown {
    fn reaches(&self, line: &Shown) -> bool {
        self.left < line.left && self.unlike > line.unlike
    }
}

/// Where one frame was taken for sharp. It shows what the scene's edges are for itself: sharp ones leave 0.84 and more, but for a soft lens, 0.65 and a
/// blur that is round (0.08); frames of 1.5 px 0.79 to 0.93.
const ONE_SET_FREE: Shown = Shown { left: 0.80, unlike: 0.25 };
/// Where several were: sharp ones leave 0.90 and more or, behind a soft lens, 0.39 and more, but blurs alike (0.06 at most); frames of 1.5 and 2 px leave up
/// to 0.84, differ by 0.14 and more, and cost 1.07 and more.
const SEVERAL_SET_FREE: Shown = Shown { left: 0.86, unlike: 0.12 };
/// [`Shown::left`] at most where files hold colour more coarsely than brightness: what JPEG takes from sharp frames differs from one to the next, and passes
/// for a blur that leaves 0.87 and more.
const LEFT_OF_JPEG: f64 = 0.80;
/// [`Shown::unlike`] at least there, for the same reason: sharp frames of such files differ by up to 0.14.
const UNLIKE_OF_JPEG: f64 = 0.2;
/// [`blind::Freed::held_out`] at most, whatever the noise: what the frames do not agree about beyond is no motion.
const AGREED: f64 = 300.0;
/// The same times the variance of shot noise at white: aliasing leaves up to 9 at a full well of 4000 electrons, and as much more as there is less noise.
const AGREED_BY_NOISE: f64 = 30.0 / 4000.0;
/// [`blind::Freed::if_still`], at least: what the others' TSFs gain by the way is no motion of theirs.
const COSTS: f64 = 1.05;

/// Extent in pixels from which a frame that passes for sharp did not move after all, since so long a blur would show in its fine structure, and what it takes for
/// it to have moved all the same: behind a lens that is soft by a pixel frames shaken by 6 and 9 px leave 0.40 to 0.69 and differ by 0.35 and more, while those
/// that stood still differ by 0.09 at most or leave 0.84. Not in files that hold colour coarsely: what JPEG makes of lamps passes for 7 px.
const TOO_FAR: (f64, Shown) = (6.0, Shown { left: 0.72, unlike: 0.25 });
/// Extent in pixels up to which a frame stood still, once those that were taken for sharp may move and another did, slightly: sharp frames beside one of 1.5
/// px measure up to 0.9, frames of 1.5 px from 1.45 on. What JPEG makes of lamps seems to move by more.
const STILL: f64 = 1.2;

/// Longer and shorter side at most, in pixels, of the part of large frames in which frames that pass for sharp are set free.
const FREE_WINDOW: (usize, usize) = (540, 360);
/// Longer and shorter side at most, in pixels, of the part of the frames that is looked at in doubt. Blur that leaves a doubt is a few
/// pixels long, whatever the frame's size.
const WINDOW: (usize, usize) = (360, 240);
/// Least side of it.
const LEAST_WINDOW: usize = 96;
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

/// What has to be shown where so `many` frames were taken for sharp; `coarse`: of files that hold colour more coarsely than brightness.
fn to_be_shown(many: usize, coarse: bool) -> Shown {
    let line = if many == 1 { ONE_SET_FREE } else { SEVERAL_SET_FREE };
    if coarse { Shown { left: line.left.min(LEFT_OF_JPEG), unlike: line.unlike.max(UNLIKE_OF_JPEG) } } else { line }
}

/// Whether so `many` frames set free, the longest blur of which has the extent `longest`, show enough for having moved; `coarse`: see [`to_be_shown`].
fn show_motion(shown: &Shown, longest: f64, many: usize, coarse: bool) -> bool {
    let not_too_far = longest < TOO_FAR.0 || (!coarse && shown.reaches(&TOO_FAR.1));
    longest > SHAKEN && not_too_far && shown.reaches(&to_be_shown(many, coarse))
}

/// What may be left of frames that agree about a motion, in units of the noise, whose shot noise has the variance `shot` at white.
fn agreed(shot: f64) -> f64 {
    AGREED.min(AGREED_BY_NOISE / shot)
}

/// Those of the frames `passing` that are asked about as they are, after a look by which residuals grow by `growth` if all of `alike` are held: none
/// where that is clear, unless others were held with them, whose motion says nothing of theirs.
fn asked<'a>(growth: f64, alike: &[usize], passing: &'a [usize]) -> &'a [usize] {
    if growth < CLEAR || passing.len() < alike.len() { passing } else { &[] }
}

/// Positions of `some` among `frames`.
fn places(some: &[usize], frames: &[usize]) -> Vec<usize> {
    (0..frames.len()).filter(|&k| some.contains(&frames[k])).collect()
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
    fn luminance_frames(&self, ids: &[usize], channels: Channels) -> Vec<Frame> {
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
    fn alone(&self, i: usize, channels: Channels) -> Plane {
        merge::irradiance(self.bracket, &self.exposures, &self.own_masks(i), &self.curves, &[i]).mean_of(channels)
    }

    /// How far the point `c` of the reference frame (centred pixels) lies from there in frame `i`: to the pixel.
    fn shift(&self, i: usize, c: DVec2) -> DVec2 {
        (project(&self.motions[i], c) - c).round()
    }

    /// The part with much texture of `frames`, whose luminances are `whole`, of `most` (longer and shorter side) pixels at most; `None` where there is none to be
    /// had.
    fn window(&self, frames: &[usize], whole: &[Frame], most: (usize, usize)) -> Option<Window> {
        let (w, h) = self.bracket.size();
        let corner = DVec2::new(0.5 * w as f64, 0.5 * h as f64);
        let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(x, y)| DVec2::new(x, y) * corner);
        let margin = frames.iter().flat_map(|&i| corners.map(|c| self.shift(i, c).abs())).fold(DVec2::ZERO, DVec2::max);
        let room = |n: usize, m: f64| n.saturating_sub(2 * m as usize);
        let (rw, rh) = (room(w, margin.x), room(h, margin.y));
        let longest = |n: usize, other: usize| n.min(if n >= other { most.0 } else { most.1 });
        let (ww, wh) = (longest(rw, rh), longest(rh, rw));
        if ww.min(wh) < LEAST_WINDOW {
            return None;
        }
        let (mx, my) = (margin.x as usize, margin.y as usize);
        let first = &whole[0];
        let weight = first.mask.zip(&first.variance, |m, v| m * m / v);
        let seen = |p: &Plane| p.crop(mx, my, rw, rh);
        let best = psf::choose(&seen(&first.blurred), &seen(&weight), ww.min(wh), 1).first().copied()?;
        let (x, y) = (mx + best.x.min(rw - ww), my + best.y.min(rh - wh));
        let centre = DVec2::new(x as f64 + 0.5 * (ww as f64 - w as f64), y as f64 + 0.5 * (wh as f64 - h as f64));
        Some(Window { at: (x, y), size: (ww, wh), centre, shifts: frames.iter().map(|&i| self.shift(i, centre)).collect() })
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
        let places = places(asked, used);
        let at_most = doubt.map_or(0.0, |doubt| doubt.most_growth(asked));
        let doubted = Doubted { frames: &places, at_most };
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
        let believed = explained && (!doubtful || (moved.len() == used.len() && !stood_still));
        self.blind = json!({
            "method": "joint",
            "reference": names[found.reference],
            "believed": believed,
            "in_doubt": doubtful,
            "channels": channels.names(),
            "extent_px": extents,
            "estimated_at_scale": found.scale,
            "residual_if_still": (!places.is_empty()).then_some(found.if_still),
            "held_out_chi_squared": found.held_out,
            "held_out_chi_squared_of_merge": found.held_out_merge,
            "lens_px": found.lens_px,
            "ways": found.ways,
        });
        if !believed && let Some(doubt) = doubt {
            let still = if stood_still {
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
    fn scene(&mut self, used: &[usize], tsfs: &[Tsf], luminance: &Plane, channels: Channels) -> Rgb {
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

    /// Whether some of the frames `still` among those `used`, which were taken for sharp in doubt, moved by a pixel or two: if that explains all frames
    /// better than the TSFs `tsfs` found while they stood, by more than a harder scene behind a softer lens, which blurs them alike.
    pub(super) fn set_free(
        &mut self,
        used: &[usize],
        still: &[usize],
        tsfs: &[Option<Tsf>],
        latent: &Rgb,
        reference: usize,
    ) -> Result<Option<SetFree>> {
        let Some(centre) = used.iter().position(|&i| i == reference) else { return Ok(None) };
        let channels = self.most_telling(used, used);
        let mut frames = self.luminance_frames(used, channels);
        let mut luminance = latent.mean_of(channels);
        let whole: Vec<Tsf> = used.iter().map(|&i| tsfs[i].clone().expect("frames without were left out")).collect();
        let mut known = whole.clone();
        let places = places(still, used);
        // At half the size as little does not show.
        let window = if blind::fits(luminance.size()) { None } else { self.window(used, &frames, FREE_WINDOW) };
        if let Some(window) = &window {
            (frames, luminance) = (window.cut(&frames), luminance.crop(window.at.0, window.at.1, window.size.0, window.size.1));
            known = known.iter().enumerate().map(|(k, t)| window.seen(k, t)).collect();
        }
        let events = &mut self.events;
        let found = blind::freed(&frames, &luminance, &known, &places, centre, &mut |s| {
            let stage = "looking whether frames that seem sharp moved a little".into();
            events(Event::Progress { stage, fraction: 0.38 + 0.02 * s.fraction })
        })
        .ok_or(Error::Cancelled)?;
        let coarse = used.iter().any(|&i| self.bracket.frames()[i].chroma_subsampled);
        let longest = places.iter().map(|&k| found.extents[k]).fold(0.0, f64::max);
        let shown = Shown { left: found.left, unlike: found.unlike };
        let likely = show_motion(&shown, longest, places.len(), coarse) && found.held_out < agreed(self.noise.shot);
        let growth = likely.then(|| found.if_still());
        let believed = growth.is_some_and(|growth| growth > COSTS);
        if self.blind.is_null() {
            // No look was taken before: one frame at least has surely steep edges.
            self.blind = json!({ "method": "joint", "believed": false, "in_doubt": true });
        }
        self.blind["set_free"] = json!({
            "believed": believed,
            "held_out_chi_squared": found.held_out,
            "residual_left": found.left,
            "unlike": found.unlike,
            "residual_if_still": growth,
            "extent_px": found.extents,
            "window_px": window.as_ref().map(Window::report),
        });
        if !believed {
            return Ok(None);
        }
        let (stood, moved) = places.iter().partition::<Vec<usize>, _>(|&&k| found.extents[k] < STILL);
        if !stood.is_empty() && moved.iter().all(|&k| found.extents[k] < super::shaken::SLIGHT) {
            return Ok(Some(SetFree::Beside(stood.iter().map(|&k| used[k]).collect())));
        }
        self.blind["believed"] = json!(true);
        let (mut tsfs, mut seen, mut scale) = (found.tsfs, found.luminance, found.scale);
        if longest > SURELY_SHAKEN {
            // So long a blur comes out too long beside a scene that was taken for sharp, and too thick where a lens is soft, which is how it passed for none.
            let own = self.alone(reference, channels);
            let own = if let Some(window) = &window { window.crop(&own, centre) } else { own };
            let starts = [Start { reference: centre, luminance: own }];
            let events = &mut self.events;
            let all = blind::estimate(&frames, &starts, None, &ALL_MOVED, (&luminance, &known), &mut |s| {
                let stage = "no frame is sharp after all: estimating all blurs".into();
                events(Event::Progress { stage, fraction: 0.40 + 0.10 * s.fraction })
            })
            .ok_or(Error::Cancelled)?;
            let held_out = blind::geometric_mean(&all.held_out);
            self.blind["set_free"]["held_out_chi_squared_of_all"] = json!(held_out);
            if held_out < found.held_out {
                self.blind["lens_px"] = json!(all.lens_px);
                (tsfs, seen, scale) = (all.tsfs, all.luminance, all.scale);
            }
        }
        if let Some(window) = window {
            // What the window tells of those set free is refined on the frame, with the others. A roll far from the frame's centre is a shift there, and
            // hardly told from one.
            let level = |tsf: &Tsf| {
                let theta_z_deg = tsf.mean().theta_z_deg;
                Tsf { poses: tsf.poses.iter().map(|p| Pose { theta_z_deg, ..*p }).collect(), ..tsf.clone() }
            };
            let lifted = |k: usize| if places.contains(&k) { window.on_frame(k, &level(&tsfs[k])) } else { whole[k].clone() };
            let tsfs: Vec<Tsf> = (0..used.len()).map(lifted).collect();
            for (&i, tsf) in used.iter().zip(&tsfs) {
                self.motions[i] = tsf.centre();
            }
            return Ok(Some(SetFree::All(Found { start: latent.clone(), tsfs, reference, reduced: true })));
        }
        let start = self.scene(used, &tsfs, &seen, channels);
        Ok(Some(SetFree::All(Found { start, tsfs, reference, reduced: scale > 1 })))
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
    fn sharp_frames_of_files_with_coarse_colour_are_not_set_free() {
        let frees = |left: f64, unlike: f64, coarse: bool| show_motion(&Shown { left, unlike }, 2.0, 2, coarse);
        // Two sharp JPEG frames each, of an office and of a still life.
        assert!(!frees(0.76, 0.138, true) && !frees(0.78, 0.130, true));
        assert!(frees(0.64, 0.37, true), "a slight blur in such files");
        assert!(frees(0.76, 0.138, false), "and one in others");
    }

    #[test]
    fn frames_seem_to_have_moved_far_only_if_they_show_much() {
        let frees = |left: f64, unlike: f64, longest: f64, many: usize| show_motion(&Shown { left, unlike }, longest, many, false);
        // Behind a lens that is soft by a pixel: shaken by up to 7 px, two frames and one.
        assert!(frees(0.40, 0.35, 9.2, 2) && frees(0.69, 0.56, 7.1, 1));
        assert!(!frees(0.63, 0.07, 7.0, 1) && !frees(0.66, 0.04, 7.0, 2), "sharp ones behind one");
        assert!(frees(0.79, 0.3, 5.9, 2) && !frees(0.79, 0.3, 6.1, 2), "so far that it would show");
        assert!(!show_motion(&Shown { left: 0.4, unlike: 0.35 }, 7.0, 2, true), "lamps in JPEG files");
        assert!(!frees(0.4, 0.35, 1.4, 2), "hardly at all");
    }

    #[test]
    fn what_aliasing_leaves_is_allowed_by_the_noise() {
        assert!(agreed(1.0 / 4000.0) > 9.0, "aliasing at a full well of 4000 electrons");
        assert!(agreed(1.0 / 17_500.0) < 295.0, "flare and a fountain, photographed at night");
        assert!((agreed(1.0 / 8000.0) / agreed(1.0 / 4000.0) - 2.0).abs() < 1e-9, "half the variance, twice as much");
        assert!((agreed(1e-9) - 300.0).abs() < 1e-9, "whatever the noise");
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
    fn a_window_sees_what_the_frame_sees() {
        let window =
            Window { at: (700, 90), size: (320, 240), centre: DVec2::new(360.5, -89.5), shifts: vec![DVec2::ZERO, DVec2::new(-7.0, 3.0)] };
        let base =
            DMat3::from_translation(DVec2::new(-6.8, 3.3)) * DMat3::from_angle(0.01) * DMat3::from_translation(DVec2::new(0.2, -0.1));
        let poses = vec![Pose::planar(1.5, -0.5, 0.3, 0.6), Pose::planar(-2.0, 1.0, -0.2, 0.4)];
        let tsf = Tsf::new(900.0, poses).unwrap().about(base);
        let seen = window.seen(1, &tsf);
        let corner = window.centre + window.shifts[1];
        for p in [DVec2::ZERO, DVec2::new(-150.0, 100.0), DVec2::new(120.5, -80.25)] {
            for (here, there) in seen.poses.iter().zip(&tsf.poses) {
                let found = here.apply(seen.focal_px, project(&seen.base, p));
                let want = there.apply(tsf.focal_px, project(&tsf.base, p + window.centre)) - corner;
                assert!((found - want).length() < 1e-9, "{p}: {found} for {want}");
            }
        }
        let back = window.on_frame(1, &seen);
        for (found, want) in back.poses.iter().zip(&tsf.poses) {
            assert!(
                (found.t_x - want.t_x).abs() + (found.t_y - want.t_y).abs() < 1e-9 && found.theta_z_deg == want.theta_z_deg,
                "{found:?}"
            );
        }
        assert!(back.base.abs_diff_eq(tsf.base, 1e-9), "{}", back.base);
        // Out of the image plane: true at the window's centre.
        let turned = Tsf::new(900.0, vec![Pose { theta_x_deg: 0.4, theta_y_deg: -0.3, ..Pose::planar(1.0, 2.0, 0.1, 1.0) }]).unwrap();
        let (found, pose) = (window.seen(0, &turned), turned.poses[0]);
        let centre = pose.apply(900.0, window.centre) - window.centre;
        assert!((found.poses[0].apply(900.0, DVec2::ZERO) - centre).length() < 1e-9, "{found:?}");
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
