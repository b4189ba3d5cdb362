//! Frame-to-frame alignment: the motion of each frame against the reference, from translation to homography by evidence. Knows nothing of
//! TSFs.
//!
//! All frames are compared as logarithmic luminance irradiance with its noise, so that exposure times do not matter and noise and clipped
//! pixels do not mislead. Each is registered against the merge of all sharp frames registered before it, nearest exposure time first:
//! frames whose exposures have no shade in common meet through those between.
//!
//! 1. A rough motion from SIFT features and RANSAC; where these fail (noise, blur, little structure) from correlation over all
//!    shifts and rolls.
//! 2. Coarse to fine, a direct alignment: Gauss-Newton on the weighted difference of the pictures. Sharp frames go to full detail; for shaken
//!    ones the reference is blurred until it looks like them, and detail finer than the blur is not looked at: what is found is the
//!    blur's centroid.
//! 3. The simplest of [`Model`] that the evidence allows (Bayesian information criterion). Frames that stood still stay exactly
//!    where they are.
//! 4. A verdict: part of the frame after part must correlate better under the motion than under neighbouring ones; a frame that does not is
//!    left out, never merged askew.

mod correlate;
mod direct;
mod features;
mod motion;
mod picture;

pub use features::{Consensus, Pair, consensus};
pub use motion::{Model, distance};

use crate::exposure::Frame;
use crate::image::Rgb;
use glam::{DMat3, DVec2};
use picture::{Picture, Tone};
use serde::Serialize;

/// How one frame lies against the reference.
#[derive(Clone, Debug, Serialize)]
pub struct Registration {
    /// Whether the motion can be relied on; otherwise the frame must not be merged.
    pub registered: bool,
    /// Whether a frame that is not registered may all the same lie where the motion says: a long blur leaves no part that tells by itself.
    pub doubtful: bool,
    /// Whether nothing in the frame tells where it lies, so that it is taken to lie as what it was registered against.
    pub assumed: bool,
    /// Kind of motion that the evidence asks for.
    pub model: Model,
    /// Homography from the reference to the frame, row by row: pixels, centres at integers, origin at the frame's centre.
    pub homography: [[f64; 3]; 3],
    /// How the motion was first found: `reference`, `features`, `correlation`, `still` or `skipped`.
    pub method: &'static str,
    /// SIFT matches between the frame and those registered before.
    pub matches: usize,
    /// How many of them agree with the motion.
    pub inliers: usize,
    /// Share of the frame's parts (those with structure) that correlate best under this motion, 0..=1; a wrong motion has up to 0.25.
    pub agreement: f64,
    /// Median motion of the frame's parts that is left, pixels.
    pub rms_px: f64,
    /// Why, in words.
    pub reason: String,
}

impl Registration {
    /// A frame taken as it lies.
    fn in_place(method: &'static str, reason: &str) -> Self {
        Self {
            registered: true,
            doubtful: false,
            assumed: false,
            model: Model::Identity,
            homography: rows(&DMat3::IDENTITY),
            method,
            matches: 0,
            inliers: 0,
            agreement: 1.0,
            rms_px: 0.0,
            reason: reason.into(),
        }
    }

    /// A frame that nobody looked at.
    pub fn skipped() -> Self {
        Self::in_place("skipped", "not looked at")
    }

    /// Γ from the reference to the frame, centred pixels.
    pub fn motion(&self) -> DMat3 {
        let h = self.homography;
        DMat3::from_cols_array_2d(&[[h[0][0], h[1][0], h[2][0]], [h[0][1], h[1][1], h[2][1]], [h[0][2], h[1][2], h[2][2]]])
    }
}

/// The motion to the same frame from another reference, `back` being the way from that to the old one; exactly the identity where nothing
/// moves.
pub fn rebased(motion: &DMat3, back: &DMat3, width: usize, height: usize) -> DMat3 {
    let new = motion::normalised(*motion * *back);
    if distance(&new, &DMat3::IDENTITY, width, height).0 < STILL { DMat3::IDENTITY } else { new }
}

/// Row by row.
pub fn rows(h: &DMat3) -> [[f64; 3]; 3] {
    h.transpose().to_cols_array_2d()
}

/// Pixels of the finest picture that is looked at: more do not make the motion truer by what they cost.
const MOST_PIXELS: usize = 1_600_000;
/// Pixels that suffice to tell the kinds of motion from each other.
const ENOUGH_PIXELS: usize = 420_000;
/// Longest side of the picture for features, pixels.
const FEATURE_SIDE: usize = 640;
/// Longest side of the picture for correlation over all shifts.
const SEARCH_SIDE: usize = 160;
/// Largest shift that the correlation looks for, as a part of the longer side.
const SEARCH_REACH: f64 = 0.25;
/// Largest displacement of any pixel, as a part of the longer side.
const LARGEST_MOTION: f64 = 0.3;
/// Matches that must agree before the correlation is not needed.
const ENOUGH_INLIERS: usize = 12;
/// Motion in pixels, rms over the frame, that counts as none.
const STILL: f64 = 0.05;
/// Share of the parts that must agree.
const AGREEMENT: f64 = 0.45;
/// Parts with structure that there must be.
const LEAST_TILES: usize = 5;
/// Share of the parts that agree with a wrong motion by chance.
const CHANCE: f64 = 0.12;
/// Share of the pixels that noise must explain for a frame without structure to stay where it is, and how many there must be.
const SMOOTH: f64 = 0.9;
const SMOOTH_PIXELS: usize = 200;
/// Most that parts may be left displaced, as a part of the frame's longer side.
const LARGEST_RESIDUE: f64 = 0.004;

/// Registers the frames of a bracket one after another.
pub struct Registrar<'a> {
    frames: &'a [Frame],
    exposures: &'a [Rgb],
    curves: &'a [[Vec<f32>; 3]],
    /// Merge of the sharp frames so far on the reference's grid, fine to coarse.
    merged: Vec<Picture>,
    reference: usize,
}

impl<'a> Registrar<'a> {
    /// Starts from frame `reference`. `exposures`: f⁻¹(Z) of each frame; `curves`: its noise, see [`crate::noise::NoiseModel::curve`].
    pub fn new(frames: &'a [Frame], exposures: &'a [Rgb], curves: &'a [[Vec<f32>; 3]], reference: usize) -> Self {
        let mut registrar = Self { frames, exposures, curves, merged: Vec::new(), reference };
        registrar.merged = pyramid(registrar.picture(reference));
        registrar
    }

    /// The order in which the frames `used` are best registered: sharp ones first, nearest exposure time to the reference first.
    pub fn order(&self, used: &[usize], sharp: &[bool]) -> Vec<usize> {
        let far = |i: usize| (self.frames[i].exposure_time / self.frames[self.reference].exposure_time).ln().abs();
        let mut order: Vec<usize> = used.iter().copied().filter(|&i| i != self.reference).collect();
        order.sort_by(|&a, &b| sharp[b].cmp(&sharp[a]).then(far(a).total_cmp(&far(b))));
        order
    }

    /// What is said of the reference itself.
    pub fn of_reference(&self) -> Registration {
        Registration::in_place("reference", "the reference")
    }

    fn picture(&self, i: usize) -> Picture {
        let mut picture = Picture::of(&self.frames[i], &self.exposures[i], &self.curves[i]);
        while picture.size().0 * picture.size().1 > MOST_PIXELS {
            picture = picture.halved();
        }
        picture
    }

    /// Registers frame `i`; a sharp one that is found joins the merge against which later ones are registered.
    pub fn register(&mut self, i: usize, sharp: bool) -> Registration {
        let levels = pyramid(self.picture(i));
        let found = self.find(&levels, sharp);
        if found.registered && sharp {
            let motion = levels[0].local(&found.motion());
            let mut all = self.merged[0].clone();
            all.add(&levels[0].on_reference(&motion));
            self.merged = pyramid(all);
        }
        found
    }

    /// SIFT features of frame `i` that match those registered before, and how many of the matches agree with one motion. Nothing is registered.
    pub fn matches(&self, i: usize, sharp: bool) -> (usize, usize) {
        let (levels, fits) = (pyramid(self.picture(i)), |p: &Picture| p.size().0.max(p.size().1) <= FEATURE_SIDE);
        let at = levels.iter().position(fits).unwrap_or(levels.len() - 1);
        let black = levels[at].black.max(self.merged[at].black);
        let reference = self.merged[at].tone(black);
        let pairs = features::matches(&reference, &levels[at].tone(black));
        let scale = 0.5 * (reference.size().0 as f64).hypot(reference.size().1 as f64);
        let most = if sharp { Model::Homography } else { Model::Rigid };
        (pairs.len(), consensus(&pairs, scale, most).map_or(0, |c| c.inliers))
    }

    /// Whether a hand may have moved the camera so between two frames: little of such a frame would be left on the reference.
    fn plausible(&self, motion: &DMat3) -> bool {
        let (w, h) = self.frames[self.reference].intensity.size();
        distance(motion, &DMat3::IDENTITY, w, h).1 < LARGEST_MOTION * w.max(h) as f64
    }

    fn find(&self, levels: &[Picture], sharp: bool) -> Registration {
        let tones: Vec<(Tone, Tone)> = levels
            .iter()
            .zip(&self.merged)
            .map(|(frame, merged)| {
                let black = frame.black.max(merged.black);
                (merged.tone(black), frame.tone(black))
            })
            .collect();
        let level_of = |side: usize| {
            let fits = |p: &Picture| p.size().0.max(p.size().1) <= side;
            levels.iter().position(fits).unwrap_or(levels.len() - 1)
        };
        let most = if sharp { Model::Homography } else { Model::Rigid };

        // Candidates: no motion, what features say, and where they say too little what correlation says.
        let at = level_of(FEATURE_SIDE);
        let (reference, frame) = &tones[at];
        let scale = 0.5 * (reference.size().0 as f64).hypot(reference.size().1 as f64);
        let pairs = features::matches(reference, frame);
        let agreed = consensus(&pairs, scale, most);
        let inliers = agreed.as_ref().map_or(0, |c| c.inliers);
        let mut candidates = vec![("still", DMat3::IDENTITY)];
        if let Some(c) = &agreed {
            candidates.push(("features", levels[at].global(&c.motion)));
        }
        let small = level_of(SEARCH_SIDE);
        if inliers < ENOUGH_INLIERS {
            let (reference, frame) = &tones[small];
            let reach = (SEARCH_REACH * reference.size().0.max(reference.size().1) as f64) as usize;
            for (_, motion) in correlate::search(reference, frame, reach, 3) {
                candidates.push(("correlation", levels[small].global(&motion)));
            }
        }
        // The one under which most parts agree at small size, where a shaken frame's blur is a few pixels.
        let (reference, frame) = &tones[small];
        let soft = (!sharp).then(|| reference.softened(1));
        let reference = soft.as_ref().unwrap_or(reference);
        let mut best: Option<(f64, &'static str, DMat3)> = None;
        for (method, start) in candidates {
            let fit = direct::align(reference, frame, &levels[small].local(&start), Model::Rigid, 10);
            let (share, tiles) = direct::agreement(reference, frame, &fit.motion, 4.0);
            let score = share * (tiles as f64 / 12.0).min(1.0) - 1e-3 * fit.cost;
            let motion = levels[small].global(&fit.motion);
            if best.as_ref().is_none_or(|b| score > b.0 && self.plausible(&motion)) {
                best = Some((score, method, motion));
            }
        }
        let (_, method, mut motion) = best.expect("no motion is always a candidate");

        // Coarse to fine. A blurred frame stops where its blur begins to show, all at the size that suffices to tell the kinds of motion.
        let enough = levels.iter().position(|p| p.size().0 * p.size().1 <= ENOUGH_PIXELS).unwrap_or(0).min(small);
        let (mut finest, mut soft) = (small, None);
        for level in (enough..=small).rev() {
            let (reference, frame) = &tones[level];
            let blurred = if sharp { None } else { blur_match(reference, frame, &levels[level].local(&motion)) };
            let reference = blurred.as_ref().map_or(reference, |b| &b.0);
            let fit = direct::align(reference, frame, &levels[level].local(&motion), Model::Rigid, 10);
            motion = levels[level].global(&fit.motion);
            finest = level;
            if let Some((tone, radius)) = blurred {
                soft = Some(tone);
                if radius >= 2 {
                    break;
                }
            } else {
                soft = None;
            }
        }
        let (reference, frame) = (soft.as_ref().unwrap_or(&tones[finest].0), &tones[finest].1);
        let local = levels[finest].local(&motion);
        let (model, mut fit) = direct::choose(reference, frame, &local, most, STILL / levels[finest].scale);
        motion = levels[finest].global(&fit.motion);
        if sharp && model > Model::Identity {
            for level in (0..finest).rev() {
                fit = direct::align(&tones[level].0, &tones[level].1, &levels[level].local(&motion), model, 3);
                motion = levels[level].global(&fit.motion);
                finest = level;
            }
        }
        let motion = motion::normalised(motion);
        let residue = residue(&fit.tiles) * levels[finest].scale;

        // The verdict, at more than one size: fine structure is precise, coarse structure is there in every frame.
        let check = |side: usize| {
            let level = level_of(side);
            let (reference, frame) = &tones[level];
            direct::agreement(reference, frame, &levels[level].local(&motion), 4.0)
        };
        let (mut agreement, mut parts) = (0.0, 0);
        for side in [200, 100, 400] {
            let (share, count) = check(side);
            let sure = share * count as f64 > CHANCE * count as f64 + 4.0 * (CHANCE * count as f64).sqrt();
            if count >= LEAST_TILES && (share > agreement && sure || parts == 0) {
                (agreement, parts) = (share, count);
            }
            if agreement > 0.8 {
                break;
            }
        }
        let (w, h) = self.frames[self.reference].intensity.size();
        let limit = (LARGEST_RESIDUE * w.max(h) as f64).max(1.0);
        // Without structure nothing can be told, nor can a shift be seen: a frame that shows the same smooth thing may stay where it is.
        let smooth = || {
            let (share, count) = direct::explained(&tones[small].0, &tones[small].1, &DMat3::IDENTITY);
            count > SMOOTH_PIXELS && share > SMOOTH
        };
        let (mut reason, mut doubtful, mut assumed) = (String::new(), false, false);
        let (mut model, mut motion) = (model, motion);
        if !fit.usable || parts < LEAST_TILES {
            if smooth() {
                (model, motion, assumed) = (Model::Identity, DMat3::IDENTITY, true);
            } else {
                reason =
                    "has too little structure in common with the other frames to be registered (--no-align takes it as it lies)".into();
            }
        } else if agreement < AGREEMENT || !self.plausible(&motion) {
            if smooth() {
                (model, motion, assumed) = (Model::Identity, DMat3::IDENTITY, true);
            } else {
                doubtful = !sharp && self.plausible(&motion);
                reason = format!(
                    "shows something else, or moved otherwise than as a whole: {:.0} % of its parts fit the other frames",
                    100.0 * agreement
                );
            }
        } else if sharp && residue > limit {
            reason = format!("does not move as a whole: its parts are {residue:.1} px from where they should be");
        }
        let registered = reason.is_empty();
        let moved = distance(&motion, &DMat3::IDENTITY, w, h).1;
        Registration {
            registered,
            doubtful,
            assumed,
            model,
            homography: rows(&motion),
            method,
            matches: pairs.len(),
            inliers: pairs.iter().filter(|p| (crate::pose::project(&levels[at].local(&motion), p.0) - p.1).length() < 2.0).count(),
            agreement,
            rms_px: residue,
            reason: if assumed {
                "shows too little to tell where it lies, and nothing that speaks against its lying in place".into()
            } else if registered {
                format!("moved by up to {moved:.2} px; {:.0} % of its parts agree", 100.0 * agreement)
            } else {
                reason
            },
        }
    }
}

/// Median length of the motion left in the tiles, heavy ones alone.
fn residue(tiles: &[(DVec2, f64)]) -> f64 {
    let heaviest = tiles.iter().fold(0.0f64, |m, t| m.max(t.1));
    let mut left: Vec<f64> = tiles.iter().filter(|t| t.1 > 0.05 * heaviest && t.1 > 0.0).map(|t| t.0.length()).collect();
    left.sort_by(f64::total_cmp);
    left.get(left.len() / 2).copied().unwrap_or(0.0)
}

/// The picture and its halves, fine to coarse, down to about 40 pixels.
fn pyramid(picture: Picture) -> Vec<Picture> {
    let mut levels = vec![picture];
    while let Some(last) = levels.last()
        && last.size().0.min(last.size().1) >= 80
    {
        levels.push(last.halved());
    }
    levels
}

/// The reference smoothed until it looks most like the blurred frame, and the number of smoothings; `None` when none helps.
fn blur_match(reference: &Tone, frame: &Tone, motion: &DMat3) -> Option<(Tone, usize)> {
    let mut best: Option<(f64, Tone, usize)> = None;
    let mut soft = reference.clone();
    for radius in 0..=3usize {
        if radius > 0 {
            soft = soft.softened(radius);
        }
        let fit = direct::align(&soft, frame, motion, Model::Translation, 2);
        if best.as_ref().is_none_or(|b| fit.cost < 0.97 * b.0) {
            best = Some((fit.cost, soft.clone(), radius));
        }
    }
    best.filter(|b| b.2 > 0).map(|b| (b.1, b.2))
}
