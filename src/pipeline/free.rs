//! Whether frames that were taken for sharp moved all the same: a pixel or two, or farther behind a soft lens.

use super::blind::{ALL_MOVED, Found, SHAKEN, SURELY_SHAKEN, places, stood_behind_lens};
use super::window::Window;
use super::{Event, Run};
use crate::blind::{self, Frame, Joint, Start};
use crate::error::{Error, Result};
use crate::image::{Channels, Plane, Rgb};
use crate::pose::Pose;
use crate::tsf::Tsf;
use serde_json::json;

/// What frames did that were taken for sharp, where one of them at least moved by a pixel or two.
#[derive(Clone)]
pub(super) enum SetFree {
    /// All of them moved.
    All(Found),
    /// These stood still.
    Beside(Vec<usize>),
}

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
/// What frames that seem to have moved as far, but show less, have to show to be asked behind a lens: sharp ones behind one differ by 0.09 at most, one that is beside one
/// that moved by 10 px by 0.17.
const ASKED_BEHIND_LENS: Shown = Shown { left: 0.72, unlike: 0.12 };
/// Extent in pixels up to which a frame stood still, once those that were taken for sharp may move and another did, slightly: sharp frames beside one of 1.5
/// px measure up to 0.9, frames of 1.5 px from 1.45 on. What JPEG makes of lamps seems to move by more.
const STILL: f64 = 1.2;

/// Longer and shorter side at most, in pixels, of the part of large frames in which frames that pass for sharp are set free.
const FREE_WINDOW: (usize, usize) = (540, 360);

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

/// Whether frames set free, the longest blur of which has the extent `longest`, may have moved that far behind a soft lens, whatever else they show; `coarse`: see
/// [`to_be_shown`].
fn may_be_far(shown: &Shown, longest: f64, coarse: bool) -> bool {
    longest > TOO_FAR.0 && !coarse && shown.reaches(&ASKED_BEHIND_LENS)
}

/// What may be left of frames that agree about a motion, in units of the noise, whose shot noise has the variance `shot` at white.
fn agreed(shot: f64) -> f64 {
    AGREED.min(AGREED_BY_NOISE / shot)
}

/// What is looked at: the frames in use, or a part of them.
struct View {
    frames: Vec<Frame>,
    /// The scene as it is known while the frames in question stand.
    luminance: Plane,
    /// The TSFs that follow.
    known: Vec<Tsf>,
    /// Place among the frames of the one about which the scene lies.
    centre: usize,
    window: Option<Window>,
    channels: Channels,
}

/// What the blurs of all frames are once those in question may move.
struct Blurs {
    tsfs: Vec<Tsf>,
    luminance: Plane,
    scale: usize,
    /// [`Joint::lens_px`] where that was looked for.
    lens_px: Option<f32>,
}

/// The frames in question, by their places among those in use.
enum Moved {
    /// All of them moved.
    All(Blurs),
    /// All but these.
    But(Vec<usize>),
}

impl Run<'_> {
    /// Whether some of the frames `still` among those `used`, which were taken for sharp in doubt, moved: if that explains all frames
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
        let known: Vec<Tsf> = used.iter().map(|&i| tsfs[i].clone().expect("frames without were left out")).collect();
        let view = self.view(used, &known, latent, centre);
        let places = places(still, used);
        let moved = self.moved(used, &places, &view)?;
        self.blind["set_free"]["believed"] = json!(moved.is_some());
        let found = match moved {
            None => return Ok(None),
            Some(Moved::But(stood)) => return Ok(Some(SetFree::Beside(stood.iter().map(|&k| used[k]).collect()))),
            Some(Moved::All(found)) => found,
        };
        self.blind["believed"] = json!(true);
        if let Some(lens_px) = found.lens_px {
            self.blind["lens_px"] = json!(lens_px);
        }
        if let Some(window) = view.window {
            // What the window tells of those set free is refined on the frame, with the others. A roll far from the frame's centre is a shift there, and
            // hardly told from one.
            let level = |tsf: &Tsf| {
                let theta_z_deg = tsf.mean().theta_z_deg;
                Tsf { poses: tsf.poses.iter().map(|p| Pose { theta_z_deg, ..*p }).collect(), ..tsf.clone() }
            };
            let lifted = |k: usize| if places.contains(&k) { window.on_frame(k, &level(&found.tsfs[k])) } else { known[k].clone() };
            let tsfs: Vec<Tsf> = (0..used.len()).map(lifted).collect();
            for (&i, tsf) in used.iter().zip(&tsfs) {
                self.motions[i] = tsf.centre();
            }
            return Ok(Some(SetFree::All(Found { start: latent.clone(), tsfs, reference, reduced: true })));
        }
        let start = self.scene(used, &found.tsfs, &found.luminance, view.channels);
        Ok(Some(SetFree::All(Found { start, tsfs: found.tsfs, reference, reduced: found.scale > 1 })))
    }

    /// The frames `used` in the channels that tell most of their blurs, beside the scene `latent` and the TSFs `known`; of large ones a part: at half the size a
    /// slight motion does not show.
    fn view(&self, used: &[usize], known: &[Tsf], latent: &Rgb, centre: usize) -> View {
        let channels = self.most_telling(used, used);
        let (frames, luminance) = (self.luminance_frames(used, channels), latent.mean_of(channels));
        let mut view = View { frames, luminance, known: known.to_vec(), centre, window: None, channels };
        if !blind::fits(view.luminance.size())
            && let Some(window) = self.window(used, &view.frames, FREE_WINDOW)
        {
            view.frames = window.cut(&view.frames);
            view.luminance = view.luminance.crop(window.at.0, window.at.1, window.size.0, window.size.1);
            view.known = known.iter().enumerate().map(|(k, t)| window.seen(k, t)).collect();
            view.window = Some(window);
        }
        view
    }

    /// Which of the frames at the `places` among those `used` moved; `None` where nothing says that one did.
    fn moved(&mut self, used: &[usize], places: &[usize], view: &View) -> Result<Option<Moved>> {
        let events = &mut self.events;
        let found = blind::freed(&view.frames, &view.luminance, &view.known, places, view.centre, &mut |s| {
            let stage = "looking whether frames that seem sharp moved a little".into();
            events(Event::Progress { stage, fraction: 0.38 + 0.02 * s.fraction })
        })
        .ok_or(Error::Cancelled)?;
        let coarse = used.iter().any(|&i| self.bracket.frames()[i].chroma_subsampled);
        let longest = places.iter().map(|&k| found.extents[k]).fold(0.0, f64::max);
        let shown = Shown { left: found.left, unlike: found.unlike };
        let agree = found.held_out < agreed(self.noise.shot);
        let growth = (agree && show_motion(&shown, longest, places.len(), coarse)).then(|| found.if_still());
        let show = growth.is_some_and(|growth| growth > COSTS);
        if self.blind.is_null() {
            // No look was taken before: one frame at least has surely steep edges.
            self.blind = json!({ "method": "joint", "believed": false, "in_doubt": true });
        }
        self.blind["set_free"] = json!({
            "held_out_chi_squared": found.held_out,
            "residual_left": found.left,
            "unlike": found.unlike,
            "residual_if_still": growth,
            "extent_px": found.extents,
            "window_px": view.window.as_ref().map(Window::report),
        });
        let asked = agree && may_be_far(&shown, longest, coarse);
        if !show && !asked {
            return Ok(None);
        }
        let (stood, moved) = places.iter().partition::<Vec<usize>, _>(|&&k| found.extents[k] < STILL);
        if !stood.is_empty() && moved.iter().all(|&k| found.extents[k] < super::shaken::SLIGHT) {
            return Ok(Some(Moved::But(stood)));
        }
        let all = if longest > SURELY_SHAKEN { Some(self.estimated_at_once(used, view)?) } else { None };
        let all = all.filter(|all| blind::geometric_mean(&all.held_out) < found.held_out);
        let Some(all) = all else {
            let found = Blurs { tsfs: found.tsfs, luminance: found.luminance, scale: found.scale, lens_px: None };
            return Ok(show.then_some(Moved::All(found)));
        };
        if all.lens_px > 0.0 {
            let (stood, growth) = stood_behind_lens(&all, places);
            self.blind["set_free"]["residual_if_held_behind_lens"] = json!(growth);
            if !stood.is_empty() {
                return Ok((stood.len() < places.len()).then_some(Moved::But(stood)));
            }
        } else if !show {
            return Ok(None);
        }
        Ok(Some(Moved::All(Blurs { tsfs: all.tsfs, luminance: all.luminance, scale: all.scale, lens_px: Some(all.lens_px) })))
    }

    /// The joint estimate of what is looked at of the frames `used`. A blur of some pixels comes out too long beside a scene that was taken for sharp, and too thick
    /// where a lens is soft, which is how it passed for none.
    fn estimated_at_once(&mut self, used: &[usize], view: &View) -> Result<Joint> {
        let own = self.alone(used[view.centre], view.channels);
        let own = if let Some(window) = &view.window { window.crop(&own, view.centre) } else { own };
        let starts = [Start { reference: view.centre, luminance: own }];
        let events = &mut self.events;
        let all = blind::estimate(&view.frames, &starts, None, &ALL_MOVED, (&view.luminance, &view.known), &mut |s| {
            let stage = "frames that seem sharp may have moved: estimating all blurs".into();
            events(Event::Progress { stage, fraction: 0.40 + 0.10 * s.fraction })
        })
        .ok_or(Error::Cancelled)?;
        self.blind["set_free"]["held_out_chi_squared_of_all"] = json!(blind::geometric_mean(&all.held_out));
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn frames_that_seem_to_have_moved_far_are_asked_behind_a_lens() {
        let asked = |left: f64, unlike: f64, longest: f64, coarse: bool| may_be_far(&Shown { left, unlike }, longest, coarse);
        assert!(asked(0.44, 0.17, 10.0, false), "a sharp frame beside one shaken by 6 px, both thick by the lens");
        assert!(!asked(0.44, 0.17, 10.0, true), "lamps in JPEG files");
        assert!(!asked(0.63, 0.07, 7.0, false) && !asked(0.39, 0.06, 7.0, false), "sharp ones behind a lens");
        assert!(!asked(0.44, 0.17, 5.9, false), "nearer, what they show decides");
    }

    #[test]
    fn what_aliasing_leaves_is_allowed_by_the_noise() {
        assert!(agreed(1.0 / 4000.0) > 9.0, "aliasing at a full well of 4000 electrons");
        assert!(agreed(1.0 / 17_500.0) < 295.0, "flare and a fountain, photographed at night");
        assert!((agreed(1.0 / 8000.0) / agreed(1.0 / 4000.0) - 2.0).abs() < 1e-9, "half the variance, twice as much");
        assert!((agreed(1e-9) - 300.0).abs() < 1e-9, "whatever the noise");
    }
}
