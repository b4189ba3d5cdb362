//! The stages in order: a bracket in, irradiance and report out. No mathematics, no files, no printing.

use crate::channels;
use crate::deblur::{self, Observation, Prior, Solution};
use crate::error::{Error, Result};
use crate::exposure::Bracket;
use crate::ghosts;
use crate::gpu::Gpu;
use crate::image::{Channels, Plane, Rgb};
use crate::kernels::{Kernels, STILL, UNSEEN};
use crate::mask;
use crate::merge;
use crate::noise::{self, NoiseModel};
use crate::pose::project;
use crate::psf;
use crate::register::{self, Registrar, Registration};
use crate::response::Response;
use crate::triage::{self, Verdict};
use crate::tsf::{self, Model, Search, Tsf, TsfEntry, TsfFile, WholeFrame};
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::borrow::Cow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

mod blind;
mod engine;

pub use blind::Blind;
use blind::{AllBlurs, SetFree};
pub use engine::Engine;
use engine::Memo;

/// What a user can set about a merge. `Default` is what the program uses when nothing is said.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Frame (0-based) on whose pixel grid the result lies; `None`: the longest sharp frame.
    pub reference: Option<usize>,
    /// Frames (0-based) that are sharp; `None`: found out.
    pub sharp: Option<Vec<usize>>,
    /// Frames (0-based) to leave out.
    pub exclude: Vec<usize>,
    /// Whether frames are registered; otherwise they are taken as they lie.
    pub align: bool,
    /// α of the Tukey window, 0..=1.
    pub alpha: f64,
    /// How the camera may move during a shaken frame.
    pub model: Model,
    /// Focal length in pixels; `None`: found or held at its default.
    pub focal_px: Option<f64>,
    /// Pixels (x, y) at which to look at the blur; empty: chosen.
    pub patches: Vec<(usize, usize)>,
    /// Largest distance in pixels, per axis, to which a local PSF reaches; `None`: as far as the frame's TSF moves the patch, and a little (12
    /// for [`Blind::Patches`], where it is at most a quarter of the patch).
    pub psf_radius: Option<usize>,
    /// Side in pixels of the patches of [`Blind::Patches`]; `None`: 120.
    pub patch_size: Option<usize>,
    /// Noise level of the frames; `None`: estimated from them.
    pub noise: Option<NoiseModel>,
    /// What to do when no frame is sharp.
    pub blind: Blind,
    /// Whether one sharp frame alone counts where sharp frames show something that moved between them ([`ghosts`]).
    pub deghost: bool,
    /// Whether what displaced sharp frames show of structure finer than the pixels is looked for ([`deblur::aliasing`]).
    pub between_pixels: bool,
    /// The solver's settings.
    pub deblur: deblur::Settings,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            reference: None,
            sharp: None,
            exclude: Vec::new(),
            align: true,
            alpha: 0.3,
            model: Model::Auto,
            focal_px: None,
            patches: Vec::new(),
            psf_radius: None,
            patch_size: None,
            noise: None,
            blind: Blind::default(),
            deghost: true,
            between_pixels: true,
            deblur: deblur::Settings::default(),
        }
    }
}

impl Settings {
    /// The same for frames whose sides are divided by `divisor`: lengths in pixels shrink with them, and a smaller size is to be quick.
    #[must_use]
    pub fn reduced(&self, divisor: usize) -> Self {
        let squares = (divisor * divisor) as f64;
        Self {
            focal_px: self.focal_px.map(|f| f / divisor as f64),
            patches: self.patches.iter().map(|&(x, y)| (x / divisor, y / divisor)).collect(),
            psf_radius: self.psf_radius.map(|r| r.div_ceil(divisor)),
            patch_size: self.patch_size.map(|s| s.div_ceil(divisor)),
            // Means of squares of pixels have less noise than the pixels.
            noise: self.noise.map(|n| NoiseModel { shot: n.shot / squares, read: n.read / squares }),
            between_pixels: self.between_pixels && divisor == 1,
            ..self.clone()
        }
    }
}

/// What a running merge tells its caller.
#[derive(Clone, Debug)]
pub enum Event {
    /// Work goes on: `stage` is what is being done, `fraction` how much of the whole merge is done, 0..=1.
    Progress {
        /// Stage in words.
        stage: String,
        /// Part of the whole, 0..=1.
        fraction: f32,
    },
    /// Something the user should know; the merge goes on.
    Warning(String),
    /// Irradiance as the solver has it, to be looked at while it works.
    Estimate(Estimate),
}

/// The solver's own irradiance on the device: it changes with every iteration.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// Red, green, blue: (width + 2 pad) x (height + 2 pad) values each, row by row, irradiance E.
    pub planes: [wgpu::Buffer; 3],
    /// Pixels per row of the frame.
    pub width: usize,
    /// Rows of the frame.
    pub height: usize,
    /// Pixels that surround the frame on every side.
    pub pad: usize,
    /// Exposure time in seconds of the reference frame: E times it is the unit of [`Outcome::irradiance`].
    pub scale: f64,
}

/// Result of a merge.
#[derive(Clone)]
pub struct Outcome {
    /// Irradiance E times the reference frame's exposure time: 1.0 is that frame's white. Finite, not negative.
    pub irradiance: Rgb,
    /// Index (0-based, in command-line order) of the reference frame.
    pub reference: usize,
    /// Names of frames that the program, not the user, left out, and why.
    pub left_out: Vec<(String, String)>,
    /// Why the result is less than was asked for, a sentence each: frames that had to be left out, and a merge where nothing could be
    /// deblurred. Empty where all is as it should be.
    pub degraded: Vec<String>,
    /// Each frame's place: the motion from the reference frame, centred pixels; of shaken frames that of their mean pose.
    pub places: Vec<DMat3>,
    /// Masks m by which the frames counted, eq. (8), each on its own pixels: by the channels that are not clipped there.
    pub masks: Vec<Plane>,
    /// Local χ² of each frame (squared residual over what noise explains, 1 is perfect) on its own pixels; `None` for frames left out.
    pub misfit: Vec<Option<Plane>>,
    /// Everything that was estimated, as JSON (`format` "unshaken-report", `version` 1).
    pub report: Value,
}

/// Most pixels by which the latent grid surrounds the frame, as a part of the frame's longer side.
const LARGEST_PAD: f64 = 0.15;
/// Rounds of TSFs refined against the deblurred irradiance and irradiance solved again.
const ROUNDS: usize = 2;
/// Iterations of that refinement.
const REFINED: usize = 8;
/// Squared residual over noise variance up to which a blurred frame is believed whatever else holds: true TSFs reach 1 to 2 on noisy
/// frames, more on clean ones, where the interpolation's own error shows.
const HOPELESS: f64 = 8.0;
/// Squares along the longer side over which that is judged, their least side in pixels, and how many have to speak.
const SQUARES: usize = 48;
const LEAST_SQUARE: usize = 8;
const FEWEST_SQUARES: usize = 6;
/// Beyond, its blur must explain all but this part of what the sharp frames alone, unblurred, leave unexplained.
const UNEXPLAINED: f64 = 0.25;
/// Length in pixels ([`tsf::stroke`]) from which it has to: a shorter blur leaves as much more of it as it is shorter, since lamps and edges as hard
/// as a pixel show what the warps cannot (under one of 1.5 px half of it and more).
const LONG: f64 = 12.0;
/// Extent in pixels below which a blur is slight: without it the deblurred scene explains its frame nearly as well, so that it is not judged by that.
const SLIGHT: f64 = 4.0;
/// Outer iterations for the sharp frames alone. Where they are displaced they get as many as shaken ones: the start was resampled, which
/// smooths, and the residual-driven weights come late.
const SHARP_OUTER: usize = 3;
/// Relative error of a merge that was resampled.
const AT_THE_BORDER: f32 = 0.04;
/// Outer iterations of the rounds before the last.
const FIRST_OUTER: usize = 2;
/// Local PSFs per blurred frame.
const PATCHES: usize = 9;
/// Side of a patch in pixels.
const PATCH_SIZE: usize = 96;
/// Pixels around the path of a blur at a patch in which its PSF is looked for.
const PSF_MARGIN: isize = 3;

/// What the blur of a frame is looked for in: see [`Run::luminances`].
struct Luminances {
    latent: Plane,
    seen: Plane,
    blurred: Plane,
    weight: Plane,
}

impl Luminances {
    fn frame(&self, base: DMat3) -> WholeFrame<'_> {
        WholeFrame { latent: &self.latent, pad: 0, blurred: &self.blurred, weight: &self.weight, base }
    }
}

struct Run<'a> {
    gpu: &'a Gpu,
    kernels: &'a Kernels,
    memo: &'a mut Memo,
    stop: Option<Arc<AtomicBool>>,
    bracket: &'a Bracket,
    response: &'a Response,
    settings: &'a Settings,
    exposures: Vec<Rgb>,
    masks: Vec<Plane>,
    /// What part of its weight each sharp frame keeps where others show something else, on its own pixels; `None`: all of it.
    ghosts: Vec<Option<Plane>>,
    /// What each frame's mask has been lessened to.
    shares: Vec<f32>,
    /// The channels in which each frame's blur is looked for, and its mask by them where they are not all.
    looks: Vec<(Channels, Option<Plane>)>,
    noise: NoiseModel,
    curves: Vec<[Vec<f32>; 3]>,
    /// Where each frame lies, from the reference (centred pixels), and how that was found.
    motions: Vec<DMat3>,
    registrations: Vec<Registration>,
    left_out: Vec<(String, String)>,
    degraded: Vec<String>,
    events: &'a mut dyn FnMut(Event) -> bool,
    timings: Vec<(String, f64)>,
    blind: Value,
    /// What each displaced sharp frame shows of structure finer than the latent grid, taken off its exposure; none before it is known.
    aliasing: Vec<Option<Rgb>>,
    /// Exposure time of the reference frame, once it is chosen.
    scale: f64,
}

/// Reconstructs the irradiance of `bracket`. `given`: TSFs to use instead of estimating them. `events` is called from
/// the calling thread; returning `false` cancels.
///
/// # Errors
/// [`Error::Input`] for settings or TSFs that do not fit the bracket, `Cancelled`, and the GPU's errors.
pub fn merge(
    bracket: &Bracket,
    response: &Response,
    settings: &Settings,
    given: Option<&TsfFile>,
    events: &mut dyn FnMut(Event) -> bool,
) -> Result<Outcome> {
    check(bracket, settings)?;
    merge_with(&mut Engine::new(Gpu::new()?), "", bracket, response, settings, given, events)
}

/// [`merge`] on an open device that remembers: a stage whose settings are those of an earlier merge is not run again, and the result is the
/// same as if it were. `name`: whoever gives a name again promises the same frames and response.
///
/// # Errors
/// As [`merge`].
pub fn merge_with(
    engine: &mut Engine,
    name: &str,
    bracket: &Bracket,
    response: &Response,
    settings: &Settings,
    given: Option<&TsfFile>,
    events: &mut dyn FnMut(Event) -> bool,
) -> Result<Outcome> {
    let frames = bracket.frames();
    let excluded = check(bracket, settings)?;
    let stop = engine.stop.clone();
    let (gpu, kernels, memo) = engine.parts();
    let start = Instant::now();
    // TSFs that are given decide about every stage.
    memo.begin(if given.is_some() { None } else { Some(format!("{name} {:?}", settings.noise)) });
    let (exposures, noise) = memo.prepared(|| {
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, response)).collect();
        let noise = settings.noise.unwrap_or_else(|| noise::estimate(frames, &exposures, response));
        (exposures, noise)
    });
    let curves = noise::curves(frames, response, &noise);
    let motions = vec![DMat3::IDENTITY; frames.len()];
    let verdicts = triage::triage(frames, &exposures, &curves, &excluded, settings.sharp.as_deref(), &motions);
    let mut run = Run {
        gpu,
        kernels,
        memo,
        stop,
        bracket,
        response,
        settings,
        exposures,
        masks: Vec::new(),
        ghosts: vec![None; frames.len()],
        shares: vec![1.0; frames.len()],
        looks: Vec::new(),
        noise,
        curves,
        motions,
        registrations: vec![Registration::skipped(); frames.len()],
        left_out: Vec::new(),
        degraded: Vec::new(),
        events,
        timings: Vec::new(),
        blind: Value::Null,
        aliasing: vec![None; frames.len()],
        scale: 1.0,
    };
    run.timings.push(("noise and triage".into(), start.elapsed().as_secs_f64()));
    run.reconstruct(verdicts, excluded, given)
}

fn check(bracket: &Bracket, settings: &Settings) -> Result<Vec<bool>> {
    let n = bracket.frames().len();
    let listed = settings.exclude.iter().chain(settings.sharp.iter().flatten()).chain(settings.reference.iter());
    for &i in listed {
        if i >= n {
            return Err(Error::Input(format!("frame {} does not exist: the bracket has {n} frames, counted from 1", i + 1)));
        }
    }
    let excluded: Vec<bool> = (0..n).map(|i| settings.exclude.contains(&i)).collect();
    if excluded.iter().all(|e| *e) {
        return Err(Error::Input("every frame is excluded; leave at least one".into()));
    }
    if let Some(r) = settings.reference
        && excluded[r]
    {
        return Err(Error::Input(format!("{}: is the reference frame and excluded; choose another reference", bracket.frames()[r].name)));
    }
    let (w, h) = bracket.size();
    if let Some((x, y)) = settings.patches.iter().find(|p| p.0 >= w || p.1 >= h) {
        return Err(Error::Input(format!("patch {x},{y} lies outside the frames, which are {w} x {h} pixels counted from 0,0")));
    }
    Ok(excluded)
}

/// A bracket of which it is known which frames are sharp.
struct Sorted {
    verdicts: Vec<Verdict>,
    /// Whether a TSF was given.
    known: Vec<bool>,
    used: Vec<usize>,
    sharp: Vec<bool>,
    tsfs: Vec<Option<Tsf>>,
    /// Where no frame shows the scene: what to start from instead.
    scene: Option<Rgb>,
    centre: Option<usize>,
    /// Whether the TSFs of all frames come from a smaller size.
    reduced: bool,
    /// Whether the frames are merged as they are.
    unexplained: bool,
    /// Whether sharp frames may have moved by a pixel or two all the same.
    may_have_moved: bool,
}

impl Run<'_> {
    fn progress(&mut self, stage: &str, fraction: f32) -> Result<()> {
        if (self.events)(Event::Progress { stage: stage.into(), fraction }) { Ok(()) } else { Err(Error::Cancelled) }
    }

    fn warn(&mut self, text: String) -> Result<()> {
        self.memo.hear(&text);
        if (self.events)(Event::Warning(text)) { Ok(()) } else { Err(Error::Cancelled) }
    }

    /// A warning of a result that is less than was asked for.
    fn degrade(&mut self, text: String) -> Result<()> {
        self.degraded.push(text.clone());
        self.warn(text)
    }

    fn timed<T>(&mut self, what: &str, f: impl FnOnce(&mut Self) -> Result<T>) -> Result<T> {
        let start = Instant::now();
        let out = f(self)?;
        self.timings.push((what.into(), start.elapsed().as_secs_f64()));
        Ok(out)
    }

    /// [`Run::timed`], unless an earlier merge has been here with the same settings: then what it found, and what it said. `more`: what it
    /// depends on besides all that came before; `bytes`: size of what is found.
    fn remembered<T: Clone + Send + 'static>(
        &mut self,
        name: &str,
        more: &str,
        bytes: fn(&T) -> usize,
        f: impl FnOnce(&mut Self) -> Result<T>,
    ) -> Result<T> {
        let stage = format!("{name} {more}");
        if let Some((found, said)) = self.memo.recall::<T>(&stage) {
            for text in said {
                self.warn(text)?;
            }
            return Ok(found);
        }
        let before = self.memo.said();
        let found = self.timed(name, f)?;
        // What was stopped half-way is nothing to remember.
        if self.stop.as_ref().is_some_and(|s| s.load(Ordering::Relaxed)) {
            return Err(Error::Cancelled);
        }
        self.memo.keep(&stage, &found, before, bytes(&found));
        Ok(found)
    }

    /// [`Run::remembered`] of a stage that solves with `settings`.
    fn solved(
        &mut self,
        name: &str,
        more: &str,
        settings: &deblur::Settings,
        f: impl FnOnce(&mut Self) -> Result<Solution>,
    ) -> Result<Solution> {
        let bytes =
            |s: &Solution| 4 * (3 * s.irradiance.width() * s.irradiance.height() + s.misfit.iter().map(|m| m.data.len()).sum::<usize>());
        self.remembered(name, &format!("{more} {settings:?}"), bytes, f)
    }

    /// A frame is left out because of what was found about it.
    fn leave_out(&mut self, i: usize, why: &str) -> Result<()> {
        let name = self.bracket.frames()[i].name.clone();
        self.degrade(format!("{name}: {why}; it is left out"))?;
        self.left_out.push((name, why.into()));
        Ok(())
    }

    /// Registers the frames against each other, leaves out those that cannot be, and looks again which are sharp, pixel by pixel of the
    /// scene. `known`: frames whose place the user gave.
    fn align(&mut self, mut verdicts: Vec<Verdict>, excluded: &mut [bool], known: &[bool]) -> Result<Vec<Verdict>> {
        let frames = self.bracket.frames();
        let used: Vec<usize> = (0..frames.len()).filter(|&i| !excluded[i]).collect();
        let sharp: Vec<bool> = verdicts.iter().map(|v| v.sharp).collect();
        let still: Vec<usize> = used.iter().copied().filter(|&i| sharp[i]).collect();
        let first = self.settings.reference.or_else(|| self.bracket.longest(&still)).or_else(|| self.bracket.shortest(&used)).unwrap_or(0);
        let mut found = self.register_on(first, &used, &sharp, known)?;
        // If most do not fit the first reference, it may be the one that is not of the scene.
        let misfits = |r: &[Registration]| used.iter().filter(|&&i| !r[i].registered).count();
        if self.settings.reference.is_none() && used.len() > 2 && 2 * misfits(&found) >= used.len() {
            let rest: Vec<usize> = used.iter().copied().filter(|&i| i != first).collect();
            let still: Vec<usize> = rest.iter().copied().filter(|&i| sharp[i]).collect();
            if let Some(second) = self.bracket.longest(&still).or_else(|| self.bracket.shortest(&rest)) {
                let other = self.register_on(second, &used, &sharp, known)?;
                if misfits(&other) < misfits(&found) {
                    found = other;
                }
            }
        }
        for &i in &used {
            if !found[i].registered {
                self.leave_out(i, &found[i].reason)?;
                excluded[i] = true;
            }
        }
        self.motions = found.iter().map(Registration::motion).collect();
        self.registrations = found;
        let moved = self.motions.iter().any(|m| *m != DMat3::IDENTITY);
        if moved || !self.left_out.is_empty() {
            let given = self.settings.sharp.as_deref();
            verdicts = triage::triage(frames, &self.exposures, &self.curves, excluded, given, &self.motions);
        }
        Ok(verdicts)
    }

    fn register_on(&mut self, reference: usize, used: &[usize], sharp: &[bool], known: &[bool]) -> Result<Vec<Registration>> {
        let frames = self.bracket.frames();
        let mut found = vec![Registration::skipped(); frames.len()];
        let (exposures, curves) = (std::mem::take(&mut self.exposures), std::mem::take(&mut self.curves));
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
        (self.exposures, self.curves) = (exposures, curves);
        going.map(|()| found)
    }

    /// The noise level again, now that it is known that the frames `still` show the scene as it is: what a file format has made smooth could not be told
    /// before.
    fn measure_noise(&mut self, still: &[usize]) -> Result<()> {
        if self.settings.noise.is_some() || still.len() < 2 {
            return Ok(());
        }
        let frames = self.bracket.frames();
        let noise = self.remembered(
            "noise of sharp frames",
            &format!("{still:?}"),
            |_| 0,
            |run| {
                let alike: Vec<usize> = still.iter().copied().filter(|&i| run.motions[i] == run.motions[still[0]]).collect();
                Ok(noise::of_squares(frames, &run.exposures, run.response, &alike, &run.noise))
            },
        )?;
        if let Some(noise) = noise {
            self.take_noise(noise);
        }
        Ok(())
    }

    /// `noise` as the noise level of the frames, from here on.
    fn take_noise(&mut self, noise: NoiseModel) {
        self.curves = noise::curves(self.bracket.frames(), self.response, &noise);
        self.noise = noise;
    }

    /// Motions from the frame `reference` instead.
    fn rebase(&mut self, reference: usize) {
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

    fn reconstruct(mut self, verdicts: Vec<Verdict>, mut excluded: Vec<bool>, given: Option<&TsfFile>) -> Result<Outcome> {
        let frames = self.bracket.frames();
        let (w, h) = self.bracket.size();
        let used: Vec<usize> = (0..frames.len()).filter(|&i| !excluded[i]).collect();
        let mut tsfs: Vec<Option<Tsf>> = vec![None; frames.len()];
        if let Some(file) = given {
            for &i in &used {
                tsfs[i] = file.find(&frames[i].name, w, h)?;
                if tsfs[i].is_none() {
                    self.warn(format!("{}: the TSF file does not hold it; its TSF is estimated", frames[i].name))?;
                }
            }
        }
        let known: Vec<bool> = tsfs.iter().map(Option::is_some).collect();
        let verdicts = if self.settings.align && used.iter().any(|&i| !known[i]) {
            self.memo.depends(&(&self.settings.exclude, &self.settings.sharp, self.settings.reference, self.settings.align));
            let (verdicts, found, motions, registrations, left_out, degraded) = self.remembered(
                "registration",
                "",
                |_| 0,
                |run| {
                    let verdicts = run.align(verdicts, &mut excluded, &known)?;
                    Ok((
                        verdicts,
                        excluded.clone(),
                        run.motions.clone(),
                        run.registrations.clone(),
                        run.left_out.clone(),
                        run.degraded.clone(),
                    ))
                },
            )?;
            (excluded, self.motions, self.registrations) = (found, motions, registrations);
            (self.left_out, self.degraded) = (left_out, degraded);
            verdicts
        } else {
            self.memo.depends(&(&self.settings.exclude, &self.settings.sharp, self.settings.reference, self.settings.align));
            verdicts
        };
        self.memo.depends(&(self.settings.alpha, self.settings.deghost, self.settings.blind, self.settings.deblur.interpolation));
        let used: Vec<usize> = used.into_iter().filter(|&i| !excluded[i]).collect();
        for (motion, tsf) in self.motions.iter_mut().zip(&tsfs) {
            if let Some(tsf) = tsf {
                *motion = tsf.centre();
            }
        }
        let mut sharp: Vec<bool> =
            (0..frames.len()).map(|i| !excluded[i] && tsfs[i].as_ref().map_or(verdicts[i].sharp, |t| t.single().is_some())).collect();
        let all_known = used.iter().all(|&i| tsfs[i].is_some());
        let (mut scene, mut centre, mut reduced) = (None, None, false);
        let forced = matches!(self.settings.blind, Blind::Joint | Blind::Patches) && given.is_none();
        let may_doubt = given.is_none() && self.settings.sharp.is_none() && self.settings.blind == Blind::Auto;
        let doubt = may_doubt.then(|| blind::doubted(&verdicts, &sharp, &used)).flatten();
        if may_doubt {
            let (unsure, sure) = blind::unsure_beside(&verdicts, &sharp, &used);
            if !unsure.is_empty() {
                self.progress("looking whether frames that seem sharp moved", 0.02)?;
                // Which frames count as sharp, and all that follows, now depends on the blurs found.
                self.memo.depends(&(self.settings.model, self.settings.focal_px));
                for i in self.remembered("frames that seem sharp", "", |_| 0, |run| run.confirmed(unsure, &sure))? {
                    sharp[i] = false;
                }
            }
        }
        let merged_only = !forced && !all_known && !sharp.contains(&true) && self.settings.blind == Blind::Off;
        let mut unexplained = merged_only;
        if merged_only {
            self.degrade("no frame is sharp: the frames are merged without deblurring; --blind auto tries to find all blurs".into())?;
        } else if forced || doubt.is_some() || (!all_known && !sharp.contains(&true)) {
            if self.settings.blind == Blind::Patches {
                self.memo.depends(&(self.settings.psf_radius, self.settings.patch_size));
            }
            let (found, motions, blind, degraded) = self.remembered(
                "all blurs",
                "",
                |_| 0,
                |run| {
                    let found = run.all_blurs(&used, doubt.as_ref(), 0.03, 0.60)?;
                    Ok((found, run.motions.clone(), run.blind.clone(), run.degraded.clone()))
                },
            )?;
            (self.motions, self.blind, self.degraded) = (motions, blind, degraded);
            match found {
                AllBlurs::Found(found) => {
                    scene = Some(found.start);
                    centre = Some(found.reference);
                    reduced = found.reduced;
                    for (&i, tsf) in used.iter().zip(found.tsfs) {
                        sharp[i] = false;
                        tsfs[i] = Some(tsf);
                    }
                }
                AllBlurs::Sharp(still) => sharp.iter_mut().enumerate().for_each(|(i, s)| *s = still.contains(&i)),
                AllBlurs::Unexplained => unexplained = true,
            }
        } else if !sharp.contains(&true) {
            scene = Some(self.timed("luminance", |run| run.start_from_tsfs(&used, &tsfs))?);
        }
        if unexplained {
            for &i in &used {
                sharp[i] = true;
            }
        }
        let may_have_moved = match &doubt {
            Some(doubt) => !doubt.show_surely_the_same(),
            None => may_doubt && blind::less_detailed(&verdicts, &used),
        };
        self.deblurred(Sorted { verdicts, known, used, sharp, tsfs, scene, centre, reduced, unexplained, may_have_moved })
    }

    /// The irradiance of a bracket that is `sorted`.
    fn deblurred(mut self, sorted: Sorted) -> Result<Outcome> {
        let Sorted { verdicts, known, used, mut sharp, mut tsfs, scene, centre, mut reduced, unexplained, may_have_moved } = sorted;
        let frames = self.bracket.frames();
        let (w, h) = self.bracket.size();
        let mut still: Vec<usize> = used.iter().copied().filter(|&i| sharp[i]).collect();
        let noise = self.noise;
        // Blurred frames that are merged as they are differ by their blurs as well.
        if !unexplained {
            self.measure_noise(&still)?;
        }
        let shaken: Vec<usize> = used.iter().copied().filter(|&i| !sharp[i]).collect();
        let found = self.bracket.longest(&still).or_else(|| self.bracket.shortest(&used));
        let reference = self.settings.reference.or(centre).or(found).unwrap_or(0);
        self.scale = frames[reference].exposure_time;
        if scene.is_some() {
            for (motion, tsf) in self.motions.iter_mut().zip(&tsfs) {
                *motion = tsf.as_ref().map_or(*motion, Tsf::centre);
            }
        } else if known.iter().all(|k| !k) {
            self.rebase(reference);
        }
        if !unexplained {
            self.find_ghosts(&still)?;
        }
        self.weigh(&sharp, &used);
        if unexplained {
            self.prefer_detail(|i| verdicts[i].detail);
        }
        let mut details: Vec<Value> = vec![Value::Null; frames.len()];

        // The sharp frames alone: start of the solver, reference of the PSFs, and the result when nothing else helps.
        let start_frames = if still.is_empty() { shaken.clone() } else { still.clone() };
        self.progress("merging the sharp frames", 0.03)?;
        let (initial, _) = self.start(&start_frames, 0);
        for &i in &still {
            tsfs[i] = Some(Tsf::still(self.motions[i]));
        }
        let placed: Vec<Option<Tsf>> = self.motions.iter().map(|m| Some(Tsf::still(*m))).collect();
        // Without blur an iteration costs next to nothing: this solution may converge.
        let alone = deblur::Settings {
            outer: if start_frames.iter().any(|&i| self.motions[i] != DMat3::IDENTITY) { self.settings.deblur.outer } else { SHARP_OUTER },
            ..self.settings.deblur.clone()
        };
        let first = if shaken.is_empty() { alone.clone() } else { for_estimates(&alone) };
        let pad = self.pad(start_frames.iter().filter_map(|&i| placed[i].as_ref()));
        let initial = self.surrounded(&initial, 0, pad, &still, &shaken);
        let (mut base, mut latent) = match scene {
            Some(scene) => (None, scene),
            None => {
                let found =
                    self.solved("sharp frames", "", &first, |run| run.solve(&start_frames, &placed, &initial, pad, &first, 0.05, 0.10))?;
                let latent = found.cropped();
                (Some(found), latent)
            }
        };
        let mut estimated: Vec<usize> = shaken.iter().copied().filter(|&i| tsfs[i].is_none()).collect();
        for (k, &i) in estimated.iter().enumerate() {
            self.progress(&format!("estimating the blur of {}", frames[i].name), 0.10 + 0.30 * k as f32 / estimated.len() as f32)?;
            let own = format!("{i} {:?} {:?}", self.settings.model, self.settings.focal_px);
            let (tsf, detail) =
                self.remembered("blur", &own, |_| 0, |run| Ok(run.estimate(i, &latent, |frame, search| frame.estimate(search))))?;
            if tsf.is_none() {
                self.leave_out(
                    i,
                    "too little texture that both it and the sharp frames see clearly to find its blur (a sharp frame with a longer exposure \
                     time, or more detail where this frame is not clipped, would help)",
                )?;
            }
            tsfs[i] = tsf;
            details[i] = detail;
        }
        self.memo.depends(&(self.settings.model, self.settings.focal_px));
        let mut shaken: Vec<usize> = shaken.into_iter().filter(|&i| tsfs[i].is_some()).collect();
        let mut slight = Vec::new();
        if may_have_moved && base.is_some() && !unexplained && still.len() + shaken.len() > 1 {
            let all: Vec<usize> = still.iter().chain(&shaken).copied().collect();
            let (found, blind) = self.remembered(
                "slight blur",
                "",
                |_| 0,
                |run| {
                    let found = run.set_free(&all, &still, &tsfs, &latent, reference)?;
                    Ok((found, run.blind.clone()))
                },
            )?;
            self.blind = blind;
            if let Some(SetFree::Beside(stood)) = found {
                // Once more from these alone, without what was found beside the others.
                self.memo.depends(&stood);
                self.take_noise(noise);
                for &i in &all {
                    (sharp[i], tsfs[i]) = (stood.contains(&i), None);
                }
                return self.deblurred(Sorted {
                    verdicts,
                    known,
                    used: all,
                    sharp,
                    tsfs,
                    scene: None,
                    centre: None,
                    reduced: false,
                    unexplained: false,
                    may_have_moved: false,
                });
            }
            if let Some(SetFree::All(found)) = found {
                (latent, reduced, base) = (found.start, found.reduced, None);
                for (&i, tsf) in all.iter().zip(found.tsfs) {
                    if tsf::extent(&tsf, w, h) < SLIGHT {
                        slight.push(i);
                    }
                    self.motions[i] = tsf.centre();
                    sharp[i] = false;
                    tsfs[i] = Some(tsf);
                }
                (shaken, still, estimated) = (all, Vec::new(), Vec::new());
                self.weigh(&sharp, &shaken);
            }
        }
        let mut all: Vec<usize> = still.iter().chain(&shaken).copied().collect();
        let start = latent.clone();
        let mut solution = None;
        let estimated = if reduced { shaken.clone() } else { estimated };
        let mut looked_at_twice: Vec<usize> = Vec::new();
        let (mut validating, mut fitted) = (true, Vec::new());
        let rounds = if estimated.is_empty() { 1 } else { ROUNDS };
        let mut round = 0;
        // TSFs that were given took no time.
        let begun = if estimated.is_empty() { 0.0 } else { 0.40 };
        while round < rounds && !shaken.is_empty() {
            let at = |part: f32| begun + (0.98 - begun) * (round as f32 + part) / rounds as f32;
            if round > 0 {
                self.progress("refining the blur", at(0.0))?;
                for &i in estimated.iter().filter(|i| shaken.contains(i)) {
                    let now = format!("{i} {round} {shaken:?} {looked_at_twice:?} {validating}");
                    tsfs[i] = self.remembered("refinement", &now, |_| 0, |run| Ok(run.refine(i, &latent, tsfs[i].as_ref())))?;
                }
                fitted.clone_from(&tsfs);
                if validating {
                    let now = format!("{round} {shaken:?} {looked_at_twice:?}");
                    // Those that were given are what they are.
                    let held: Vec<usize> = all.iter().copied().filter(|i| !estimated.contains(i)).collect();
                    tsfs = self.remembered(
                        "cross-validation",
                        &now,
                        |_| 0,
                        |run| run.cross_validated(&all, &held, &tsfs, &latent, reference, (at(0.05), at(0.2))),
                    )?;
                }
            }
            if round + 1 == rounds {
                self.find_aliasing(&still, &shaken, &latent, at(0.2), at(0.3))?;
            }
            let pad = self.pad(all.iter().filter_map(|&i| tsfs[i].as_ref()));
            let from = match solution.as_ref().or(base.as_ref()) {
                Some(found) => self.surrounded(&found.irradiance, found.pad, pad, &still, &shaken),
                None => self.surrounded(&latent, 0, pad, &still, &shaken),
            };
            // The first round only has to be better than the sharp frames alone, for the TSFs to be refined against it.
            let settings = if round + 1 < rounds { for_first_round(&self.settings.deblur) } else { self.settings.deblur.clone() };
            let now = format!("{round} {shaken:?} {looked_at_twice:?} {validating}");
            let solved =
                self.solved("irradiance", &now, &settings, |run| run.solve(&all, &tsfs, &from, pad, &settings, at(0.3), at(1.0)))?;
            let misfit = |i: usize| all.iter().position(|&k| k == i).map(|p| &solved.misfit[p]);
            let judge = |&i: &usize| {
                let length = tsf::stroke(tsfs[i].as_ref()?, w, h);
                Some((i, self.unexplained(i, misfit(i)?, &start, (UNEXPLAINED * LONG / length).clamp(UNEXPLAINED, 1.0))?))
            };
            // TSFs of a smaller size err by pixels of the frame's: they are judged once they have been refined.
            let rough = reduced && round + 1 < rounds;
            let hopeless: Vec<(usize, f64)> = shaken.iter().filter(|i| !rough && !slight.contains(i)).filter_map(judge).collect();
            if hopeless.is_empty() {
                latent = solved.cropped();
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
            if self.look_for_slight(&ids, &start, &mut tsfs, &mut details, at(1.0))? {
                continue;
            }
            // Deblurring with a blur that does not explain its frame can only harm: without that frame, again.
            for (i, chi) in hopeless {
                let what = if known[i] { "the TSF that was given does not explain it" } else { "no camera shake explains it" };
                self.leave_out(i, &format!("{what} (its residual is {chi:.1} times its noise)"))?;
                shaken.retain(|&k| k != i);
                all.retain(|&k| k != i);
            }
        }
        if shaken.is_empty() && !unexplained {
            self.find_aliasing(&still, &shaken, &latent, 0.80, 0.90)?;
        }
        let solution = match (solution, base) {
            (Some(found), _) => found,
            (None, Some(base)) if first == alone && self.aliasing.iter().all(Option::is_none) => base,
            // No shaken frame is left: the sharp ones alone, as the user wants them, from what they were for the estimates.
            (None, base) => {
                let from = base.map_or(initial, |found| found.irradiance);
                self.solved("sharp frames", "alone", &alone, |run| run.solve(&start_frames, &placed, &from, pad, &alone, 0.90, 0.98))?
            }
        };
        self.progress("finishing", 0.99)?;
        // For people to look at: patches and their PSFs, eq. (11), against the sharp frames.
        for &i in &shaken {
            if details[i].is_null() {
                continue;
            }
            let own = format!("{i} {:?} {:?}", self.settings.patches, self.settings.psf_radius);
            let tsf = tsfs[i].as_ref().expect("frames without were left out");
            details[i]["patches"] = self.remembered("PSFs", &own, |_| 0, |run| Ok(run.local_psfs(i, &start, tsf)))?;
        }
        self.finish(solution, reference, &verdicts, &sharp, &all, &tsfs, details)
    }

    /// Solves for the frames `ids`; progress runs from `from` to `to`.
    fn solve(
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

    /// What displaced ones of the sharp frames `ids` (`observations`, in that order) show of the pixels next to the border of the latent grid, merged as they
    /// lie, where no frame in place shows them: the warp of a frame that lies between them reaches beyond the border, so that it does not count there, and
    /// what is left of it two pixels farther in, a hundredth of their light, would tell any nonsense of them.
    fn at_the_border(&self, ids: &[usize], observations: &[Observation]) -> Option<Observation> {
        let (w, h) = self.bracket.size();
        let reach = STILL.support();
        let (in_place, displaced): (Vec<usize>, Vec<usize>) =
            (0..ids.len()).filter(|&k| observations[k].tsf.single().is_some()).partition(|&k| observations[k].tsf.is_identity());
        let displaced: Vec<usize> = displaced.into_iter().map(|k| ids[k]).collect();
        if displaced.is_empty() {
            return None;
        }
        let masks: Vec<&Plane> = in_place.into_iter().map(|k| &self.masks[ids[k]]).collect();
        let lost = |p: usize| masks.iter().all(|m| m.data[p] == 0.0);
        let edge = |a: usize, n: usize| a < reach || a + reach >= n;
        let counts = |x: usize, y: usize| (edge(x, w) || edge(y, h)) && lost(y * w + x);
        let mask = Plane::from_fn(w, h, |x, y| f32::from(counts(x, y)));
        if !mask.data.contains(&1.0) {
            return None;
        }
        let (merged, _) = self.start(&displaced, 0);
        let brightest = (0..w * h).filter(|&p| mask.data[p] > 0.0).flat_map(|p| merged.pixel(p)).fold(0.0, f32::max);
        if brightest <= 0.0 {
            return None;
        }
        let steps = self.curves[ids[0]][0].len();
        let noise = (0..steps).map(|k| AT_THE_BORDER * (k as f32 / (steps - 1) as f32).powi(2).max(1e-6)).collect::<Vec<_>>();
        Some(Observation {
            exposure: merged.map_planes(|p| p.map(|v| (v / brightest).min(1.0))),
            mask,
            exposure_time: 1.0 / f64::from(brightest),
            noise: std::array::from_fn(|_| noise.clone()),
            black_clipped: false,
            tsf: Tsf::identity(),
        })
    }

    /// Pixels by which the latent grid surrounds frames under `tsfs`.
    fn pad<'t>(&self, tsfs: impl Iterator<Item = &'t Tsf>) -> usize {
        let (w, h) = self.bracket.size();
        deblur::pad_for(&tsfs.collect::<Vec<_>>(), w, h, (LARGEST_PAD * w.max(h) as f64) as usize)
    }

    /// The mask by which frame `i` counts in the solver. `clipped`: its [`mask::spoilt_channels`].
    fn counting(&self, i: usize, clipped: &[Vec<bool>; 3]) -> Plane {
        let (all, kept) = (self.shares[i], self.ghosts[i].as_ref());
        let share = |p: usize| all * kept.map_or(1.0, |k| k.data[p]);
        mask::with_partly_clipped(&self.masks[i], &self.bracket.frames()[i], clipped, self.settings.alpha as f32, share)
    }

    /// Frame `i`, every channel that is not clipped by itself.
    fn observation(&self, i: usize, tsf: Tsf) -> Observation {
        let frame = &self.bracket.frames()[i];
        let mut exposure = self.exposures[i].clone();
        let clipped = mask::spoilt_channels(frame);
        for (plane, clipped) in exposure.0.iter_mut().zip(&clipped) {
            plane.data.iter_mut().zip(clipped).filter(|(_, clipped)| **clipped).for_each(|(e, _)| *e = UNSEEN);
        }
        if let Some(finer) = &self.aliasing[i] {
            for (e, f) in exposure.0.iter_mut().zip(&finer.0) {
                *e = e.zip(f, |e, f| if e == UNSEEN { e } else { e - f });
            }
        }
        Observation {
            exposure,
            mask: self.counting(i, &clipped),
            exposure_time: frame.exposure_time,
            noise: self.curves[i].clone(),
            black_clipped: true,
            tsf,
        }
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

    /// Exposures and masks of the frames `ids` as registration places them, on the reference's grid plus `pad` pixels on every side; of
    /// the others as they are. Nothing is copied where nothing moves.
    fn placed<'m>(&'m self, ids: &[usize], masks: &'m [Plane], pad: usize) -> (Cow<'m, [Rgb]>, Cow<'m, [Plane]>) {
        let moves = |i: usize| pad > 0 || self.motions[i] != DMat3::IDENTITY;
        if !ids.iter().any(|&i| moves(i)) {
            return (Cow::Borrowed(&self.exposures), Cow::Borrowed(masks));
        }
        let placed = (0..masks.len()).map(|i| {
            if ids.contains(&i) && moves(i) {
                merge::resampled(&self.exposures[i], &masks[i], &self.motions[i], pad)
            } else {
                (self.exposures[i].clone(), masks[i].clone())
            }
        });
        let (exposures, masks): (Vec<Rgb>, Vec<Plane>) = placed.unzip();
        (Cow::Owned(exposures), Cow::Owned(masks))
    }

    /// Merge of the frames `ids`, placed but not deblurred, on the reference's grid plus `pad` pixels on every side, and where any of
    /// them is not masked.
    fn start(&self, ids: &[usize], pad: usize) -> (Rgb, Plane) {
        let (exposures, masks) = self.placed(ids, &self.masks, pad);
        let merged = merge::irradiance(self.bracket, &exposures, &masks, &self.curves, ids);
        let (w, h) = merged.size();
        (merged, Plane::from_fn(w, h, |x, y| ids.iter().map(|&i| masks[i].data[y * w + x]).fold(0.0, f32::max)))
    }

    /// `image`, which lies on the reference's grid plus `own` pixels on every side, on that plus `pad` pixels. What it lacks is what
    /// the frames show that see it: the sharp ones, where none the others; and beyond all of them the nearest pixel.
    fn surrounded(&self, image: &Rgb, own: usize, pad: usize, still: &[usize], shaken: &[usize]) -> Rgb {
        let (w, h) = self.bracket.size();
        let nearest = |x: usize, y: usize| ((x + own) as isize - pad as isize, (y + own) as isize - pad as isize);
        let displaced = |ids: &[usize]| -> Option<(Rgb, Plane)> {
            let moved = ids.iter().any(|&i| self.motions[i] != DMat3::IDENTITY);
            (pad > own && moved).then(|| self.start(ids, pad))
        };
        let around = [displaced(still), displaced(shaken)];
        let within = |a: isize, n: usize| a >= 0 && (a as usize) < n + 2 * own;
        Rgb(std::array::from_fn(|c| {
            Plane::from_fn(w + 2 * pad, h + 2 * pad, |x, y| {
                let (i, j) = nearest(x, y);
                let beyond = !(within(i, w) && within(j, h));
                let other = around.iter().flatten().find(|(_, seen)| beyond && seen.data[y * seen.width + x] > 0.0);
                other.map_or_else(|| image.0[c].clamped(i, j), |(shown, seen)| shown.0[c].data[y * seen.width + x])
            })
        }))
    }

    /// Whether the blur of frame `i` fails to explain it: `misfit` is the local χ² with it, `start` the irradiance before the frame counted.
    /// Judged over squares of the frame in which one or the other is far above the noise, by the one in the middle: what moved, or a lamp
    /// that blur spreads beyond white, is a part of the frame and not its shake. It fails where it leaves more than `most` of what is left without; the χ² of
    /// the square in the middle, where it does.
    fn unexplained(&self, i: usize, misfit: &Plane, start: &Rgb, most: f64) -> Option<f64> {
        let without = self.unblurred(i, start);
        let (w, h) = misfit.size();
        let side = (w.max(h) / SQUARES).max(LEAST_SQUARE);
        let mut squares: Vec<(f64, f64)> = Vec::new();
        for y in (0..h).step_by(side) {
            for x in (0..w).step_by(side) {
                let (mut with_blur, mut unblurred, mut count) = (0.0, 0.0, 0);
                for p in (y..(y + side).min(h)).flat_map(|y| (x..(x + side).min(w)).map(move |x| y * w + x)) {
                    if without.data[p].is_finite() {
                        with_blur += f64::from(misfit.data[p]);
                        unblurred += f64::from(without.data[p]);
                        count += 1;
                    }
                }
                let (c, u) = (with_blur / f64::from(count), unblurred / f64::from(count));
                if count as usize >= side * side / 4 && c.max(u) > HOPELESS {
                    squares.push((c, c / u));
                }
            }
        }
        if squares.len() < FEWEST_SQUARES {
            return None;
        }
        let middle = |mut v: Vec<f64>| {
            v.sort_by(f64::total_cmp);
            v[v.len() / 2]
        };
        let chi = middle(squares.iter().map(|s| s.0).collect());
        let left = middle(squares.iter().map(|s| s.1).collect());
        (chi > HOPELESS && left > most).then_some(chi)
    }

    /// Squared residual over variance of frame `i` against the irradiance `latent`, moved but not blurred; NaN where it is masked.
    fn unblurred(&self, i: usize, latent: &Rgb) -> Plane {
        let (exposure, mask) = (&self.exposures[i], &self.masks[i]);
        let (seen, inside) = self.seen(latent, &self.motions[i]);
        let mask = mask.zip(&inside, |m, k| m * k);
        merge::misfit(&seen, exposure, &mask, &self.curves[i], self.bracket.frames()[i].exposure_time)
    }

    /// Motion about which the poses of the blurred frame `i` are looked for: the search covers what is left.
    fn base(&self, i: usize) -> DMat3 {
        let (w, h) = self.bracket.size();
        let motion = self.motions[i];
        if register::distance(&motion, &DMat3::IDENTITY, w, h).1 < SEARCHED {
            return DMat3::IDENTITY;
        }
        // Whole pixels need no interpolation.
        let centre = project(&motion, DVec2::ZERO);
        let shift = DMat3::from_translation(centre.round());
        let whole = DMat3::from_translation(centre.round() - centre) * motion;
        if register::distance(&whole, &shift, w, h).1 < 0.5 * SEARCHED { shift } else { whole }
    }

    /// The channels whose mean tells most about the blurs of the frames `blurred` of a scene known from the frames `by`.
    fn most_telling(&self, blurred: &[usize], by: &[usize]) -> Channels {
        channels::most_telling(self.bracket.frames(), &self.exposures, blurred, by, &self.noise)
    }

    /// Masks of all frames, of which `sharp` are sharp, and how the blurs of the others of the frames `used` are looked at.
    fn weigh(&mut self, sharp: &[bool], used: &[usize]) {
        let masks = |c| mask::masks(self.bracket.frames(), sharp, self.settings.alpha as f32, &self.motions, c);
        let (still, moved): (Vec<usize>, Vec<usize>) = used.iter().partition(|&&i| sharp[i]);
        let by = if still.is_empty() { &moved } else { &still };
        let look = |i: usize| {
            let channels = if moved.contains(&i) { self.most_telling(&[i], by) } else { Channels::ALL };
            (channels, (channels != Channels::ALL).then(|| masks(channels).swap_remove(i)))
        };
        self.looks = (0..sharp.len()).map(look).collect();
        self.masks = masks(Channels::ALL);
        // Of a frame that turned out to be shaken nothing of the kind is known.
        self.ghosts.iter_mut().zip(sharp).for_each(|(ghost, sharp)| *ghost = ghost.take().filter(|_| *sharp));
        for (mask, kept) in self.masks.iter_mut().zip(&self.ghosts) {
            if let Some(kept) = kept {
                *mask = mask.zip(kept, |m, k| m * k);
            }
        }
    }

    /// Luminances, the mean of the channels in which the blur of frame `i` is looked for, of the irradiance `latent` and of what the frame at
    /// `motion` sees of it; of the frame itself; and the frame's inverse variance, model error included.
    fn luminances(&self, i: usize, latent: &Rgb, motion: &DMat3) -> Luminances {
        let frame = &self.bracket.frames()[i];
        let dt = frame.exposure_time as f32;
        let (channels, mask) = (self.looks[i].0, self.looks[i].1.as_ref().unwrap_or(&self.masks[i]));
        let count = channels.count() as f32;
        let (seen, inside) = self.seen(latent, motion);
        let seen = seen.mean_of(channels);
        let exposure = self.exposures[i].mean_of(channels);
        let local = merge::gradient_level(&seen, 4);
        let weight = Plane {
            data: (0..exposure.data.len())
                .map(|p| {
                    let m = mask.data[p];
                    // An operator is never true to better than some per cent of the structure around a pixel.
                    let variance =
                        self.noise.variance(f64::from(exposure.data[p])) as f32 / count / (dt * dt) + (MODEL_ERROR * local.data[p]).powi(2);
                    m * m / variance * inside.data[p]
                })
                .collect(),
            ..exposure
        };
        Luminances { latent: latent.mean_of(channels), seen, blurred: exposure.map(|v| v / dt), weight }
    }

    /// TSF of frame `i` against the sharp irradiance, about where the frame lies, and what is known of it.
    fn estimate(&self, i: usize, latent: &Rgb, how: impl Fn(&WholeFrame, &Search) -> Option<tsf::Estimate>) -> (Option<Tsf>, Value) {
        let base = self.base(i);
        let luminances = self.luminances(i, latent, &base);
        let frame = luminances.frame(base);
        let search = Search { model: self.settings.model, focal_px: self.settings.focal_px, stop: self.stop.clone() };
        let Some(found) = how(&frame, &search).filter(tsf::Estimate::is_sound) else { return (None, Value::Null) };
        let detail = json!({
            "model": found.model,
            "focal_px": found.tsf.focal_px,
            "focal_length": found.focal,
            "models_tried": found.trials,
            "estimated_at_scale": found.scale,
            "extent_px": tsf::extent(&found.tsf, latent.width(), latent.height()),
            "residual": found.residual,
            "channels": self.looks[i].0.names(),
        });
        (Some(found.tsf), detail)
    }

    /// Those of the frames `ids` whose blur seems long are looked at once more, as if it were slight: beside lamps far poses answer to what the sharp
    /// frames lack, and a blur of a pixel or two passes for a long one. Whether any has another TSF now. `start`: irradiance before the frames counted.
    fn look_for_slight(
        &mut self,
        ids: &[usize],
        start: &Rgb,
        tsfs: &mut [Option<Tsf>],
        details: &mut [Value],
        fraction: f32,
    ) -> Result<bool> {
        let (w, h) = self.bracket.size();
        let mut any = false;
        for &i in ids {
            if tsfs[i].as_ref().is_none_or(|t| tsf::extent(t, w, h) <= SLIGHT) {
                continue;
            }
            self.progress(&format!("looking whether the blur of {} is slight", self.bracket.frames()[i].name), fraction)?;
            let own = format!("slight {i} {:?} {:?}", self.settings.model, self.settings.focal_px);
            let look = |run: &mut Self| Ok(run.estimate(i, start, |frame, search| frame.estimate_slight(search)));
            if let (Some(tsf), detail) = self.remembered("blur", &own, |_| 0, look)? {
                (tsfs[i], details[i], any) = (Some(tsf), detail, true);
            }
        }
        Ok(any)
    }

    /// Patches of frame `i` and their PSFs, as the report has them.
    fn local_psfs(&self, i: usize, latent: &Rgb, tsf: &Tsf) -> Value {
        let luminances = self.luminances(i, latent, &tsf.base);
        let psfs = self.psfs(&luminances.seen, &luminances.blurred, &luminances.weight, tsf);
        json!(
            psfs.iter()
                .map(|(p, m)| json!({
                    "x": p.x, "y": p.y, "size": p.size, "score": p.score, "confidence": m.confidence(), "expected_error": m.expected_error,
                    "psf": { "radius": m.psf.radius, "extent_px": m.psf.extent(), "values": m.psf.values.data },
                }))
                .collect::<Vec<_>>()
        )
    }

    /// PSFs of chosen or given patches, looked for around where `tsf` passes.
    fn psfs(&self, seen: &Plane, blurred: &Plane, weight: &Plane, tsf: &Tsf) -> Vec<(psf::Patch, psf::Measured)> {
        let (w, h) = seen.size();
        let reach = tsf::extent(tsf, w, h).ceil() as usize;
        let size = PATCH_SIZE.max(3 * reach / 2).min(w / 2).min(h / 2).max(16);
        let patches = if self.settings.patches.is_empty() {
            psf::choose(seen, weight, size, PATCHES)
        } else {
            self.settings.patches.iter().map(|&(x, y)| psf::around(seen, weight, x, y, size)).collect()
        };
        let wanted = self.settings.psf_radius;
        let measure = |p: &psf::Patch| {
            let path = tsf::path_at(tsf, p.centre(), (w, h));
            let reach = path.iter().map(|u| u.0.abs().max(u.1.abs())).max()? + PSF_MARGIN;
            let radius = wanted.map_or(reach, |r| r as isize);
            let near = |x: isize, y: isize| path.iter().any(|u| (u.0 - x).abs() <= PSF_MARGIN && (u.1 - y).abs() <= PSF_MARGIN);
            Some((*p, psf::estimate_within(seen, 0, blurred, weight, p, radius as usize, &near)?))
        };
        patches.par_iter().filter_map(measure).collect()
    }

    /// The irradiance `latent` on the grid of a frame at `motion`, and 1 where it reaches.
    fn seen<'r>(&self, latent: &'r Rgb, motion: &DMat3) -> (Cow<'r, Rgb>, Plane) {
        let everywhere = self.masks[0].map(|_| 1.0);
        if *motion == DMat3::IDENTITY {
            return (Cow::Borrowed(latent), everywhere);
        }
        let (seen, inside) = merge::resampled(latent, &everywhere, &motion.inverse(), 0);
        (Cow::Owned(seen), inside)
    }

    fn refine(&self, i: usize, latent: &Rgb, tsf: Option<&Tsf>) -> Option<Tsf> {
        tsf.map(|t| self.luminances(i, latent, &t.base).frame(t.base).refine(t, REFINED))
    }

    fn finish(
        mut self,
        solution: Solution,
        reference: usize,
        verdicts: &[Verdict],
        sharp: &[bool],
        all: &[usize],
        tsfs: &[Option<Tsf>],
        details: Vec<Value>,
    ) -> Result<Outcome> {
        let frames = self.bracket.frames();
        let (w, h) = self.bracket.size();
        let mut irradiance = solution.cropped();
        // What a blurred frame clips, blur has spread: it bounds nothing.
        let unblurred: Vec<usize> = all.iter().copied().filter(|&i| tsfs[i].as_ref().is_none_or(|t| t.single().is_some())).collect();
        merge::raise_to_lower_bound(&mut irradiance, self.bracket, &self.exposures, &unblurred, &self.motions);
        let scale = frames[reference].exposure_time as f32;
        let irradiance = irradiance.map_planes(|p| p.map(|v| v * scale));
        let entries: Vec<Value> = (0..frames.len())
            .map(|i| {
                let position = all.iter().position(|&k| k == i);
                json!({
                    "frame": frames[i].name,
                    "exposure_time_s": frames[i].exposure_time,
                    "used": position.is_some(),
                    "sharp": sharp[i],
                    "triage": verdicts[i],
                    "registration": self.registrations[i],
                    "chi_squared": position.map(|p| solution.report.chi_squared[p]),
                    "ghosts": self.ghosts[i].as_ref().map(|g| 1.0 - g.data.iter().map(|v| f64::from(*v)).sum::<f64>() / g.data.len() as f64),
                    "aliasing_rms": self.aliasing[i].as_ref().map(root_mean_square),
                    "blur": details[i],
                    "tsf": tsfs[i].as_ref().map(|t| TsfEntry::new(&frames[i].name, w, h, t)),
                })
            })
            .collect();
        let blind = self.blind_report();
        let report = json!({
            "format": "unshaken-report",
            "version": 1,
            "program": concat!("unshaken ", env!("CARGO_PKG_VERSION")),
            "adapter": self.gpu.description,
            "size": [w, h],
            "reference": frames[reference].name,
            "scale": { "rule": "value = irradiance * exposure time of the reference frame", "factor_s": scale },
            "noise": self.noise,
            "blind": blind,
            "frames": entries,
            "degraded": self.degraded,
            "left_out": self.left_out.iter().map(|(frame, why)| json!({ "frame": frame, "reason": why })).collect::<Vec<_>>(),
            "solver": solution.report,
            "timings_s": std::mem::take(&mut self.timings),
        });
        let mut misfit: Vec<Option<Plane>> = vec![None; frames.len()];
        for (&i, plane) in all.iter().zip(solution.misfit) {
            misfit[i] = Some(plane);
        }
        let places = (0..frames.len()).map(|i| tsfs[i].as_ref().map_or(self.motions[i], Tsf::centre)).collect();
        let masks = (0..frames.len()).map(|i| self.counting(i, &mask::spoilt_channels(&frames[i]))).collect();
        let Self { left_out, degraded, .. } = self;
        Ok(Outcome { irradiance, reference, left_out, degraded, places, masks, misfit, report })
    }
}

/// Over all values of all channels.
fn root_mean_square(image: &Rgb) -> f64 {
    let squares = image.0.iter().flat_map(|p| &p.data).map(|v| f64::from(v * v));
    (squares.sum::<f64>() / (3 * image.width() * image.height()) as f64).sqrt()
}

/// The settings with the default smoothing and weights: what is estimated of the blur does not follow the taste in results.
fn for_estimates(settings: &deblur::Settings) -> deblur::Settings {
    let standard = deblur::Settings::default();
    deblur::Settings { lambda: standard.lambda, prior: Prior::Tv, robust: standard.robust, ..settings.clone() }
}

/// [`for_estimates`], quick: enough to refine TSFs against, or to see whether they explain their frames.
fn for_first_round(settings: &deblur::Settings) -> deblur::Settings {
    for_estimates(&deblur::Settings { inner: settings.inner * 3 / 8, outer: FIRST_OUTER, ..settings.clone() })
}

/// Displacement in pixels of a blurred frame that the search for its poses covers by itself.
const SEARCHED: f64 = 3.0;
/// Standard deviation of the operator's own error, as a part of the mean absolute gradient around a pixel.
const MODEL_ERROR: f32 = 0.03;
