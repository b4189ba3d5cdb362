//! The stages in order: a bracket in, irradiance and report out. No mathematics, no files, no printing.

use crate::deblur::{self, Solution};
use crate::error::{Error, Result};
use crate::exposure::Bracket;
use crate::gpu::Gpu;
use crate::image::{Channels, Plane, Rgb};
use crate::kernels::Kernels;
use crate::mask;
use crate::merge;
use crate::noise::{self, NoiseModel};
use crate::register::{self, Registrar, Registration};
use crate::response::Response;
use crate::triage::{self, Verdict};
use crate::tsf::{Model, Tsf, TsfEntry, TsfFile};
use glam::DMat3;
use serde_json::{Value, json};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

mod blind;
mod engine;
mod free;
mod observed;
mod progress;
mod rounds;
mod shaken;
mod window;

use blind::AllBlurs;
pub use blind::Blind;
pub use engine::Engine;
use engine::Memo;
use progress::Progress;
use rounds::{Sorted, Turned};

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
    /// Work goes on: `stage` is what is being done, `fraction` how much of the whole merge is done, 0..=1, never less than before.
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
    let mut progress = Progress::default();
    let events = &mut |event| {
        events(match event {
            Event::Progress { stage, fraction } => Event::Progress { stage, fraction: progress.at(fraction) },
            other => other,
        })
    };
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
        let used: Vec<usize> = (0..excluded.len()).filter(|&i| !excluded[i]).collect();
        let sharp: Vec<bool> = verdicts.iter().map(|v| v.sharp).collect();
        let mut found = self.registered(&used, &sharp, known)?;
        if let Some(again) = self.triaged_in_place(&found, &used, excluded) {
            let now: Vec<bool> = again.iter().zip(&found).map(|(v, r)| v.sharp && r.registered).collect();
            verdicts = again;
            // Frames that lie elsewhere pass for shaken; now that they show to be sharp, they are placed as such, and show more of the scene to the others.
            if used.iter().any(|&i| now[i] && !sharp[i]) {
                found = self.registered(&used, &now, known)?;
                verdicts = self.triaged_in_place(&found, &used, excluded).unwrap_or(verdicts);
            }
        }
        for &i in &used {
            if !found[i].registered {
                if !found[i].doubtful {
                    self.leave_out(i, &found[i].reason)?;
                }
                excluded[i] = true;
            }
        }
        self.motions = found.iter().map(Registration::motion).collect();
        self.registrations = found;
        Ok(verdicts)
    }

    /// Which of the frames `used` are sharp where they lie, those that could not be registered left out; `None` where none moved and their noise is what it seemed: it
    /// is known.
    fn triaged_in_place(&self, found: &[Registration], used: &[usize], excluded: &[bool]) -> Option<Vec<Verdict>> {
        let mut excluded = excluded.to_vec();
        for &i in used {
            excluded[i] |= !found[i].registered;
        }
        let motions: Vec<DMat3> = found.iter().map(Registration::motion).collect();
        let moved = motions.iter().any(|m| *m != DMat3::IDENTITY) || used.iter().any(|&i| excluded[i]);
        let placed: Vec<usize> = used.iter().copied().filter(|&i| !excluded[i]).collect();
        let noise = self.smoothed_noise(&placed, &motions);
        if !moved && noise.is_none() {
            return None;
        }
        let frames = self.bracket.frames();
        let curves = noise.map(|noise| noise::curves(frames, self.response, &noise));
        let given = self.settings.sharp.as_deref();
        Some(triage::triage(frames, &self.exposures, curves.as_ref().unwrap_or(&self.curves), &excluded, given, &motions))
    }

    /// The noise level of the frames `ids`, placed by `motions`, if a file format has made it smoother than it is; whether they are sharp is not known.
    fn smoothed_noise(&self, ids: &[usize], motions: &[DMat3]) -> Option<NoiseModel> {
        let frames = self.bracket.frames();
        if self.settings.noise.is_some() || !ids.iter().any(|&i| frames[i].lossy) {
            return None;
        }
        noise::of_squares(frames, &self.exposures, self.response, ids, motions, false, &self.noise)
    }

    /// Where the frames `used` lie, by the longest of those that are `sharp` or, if most do not fit that, by the next.
    fn registered(&mut self, used: &[usize], sharp: &[bool], known: &[bool]) -> Result<Vec<Registration>> {
        let best = |run: &Self, of: &[usize]| {
            let still: Vec<usize> = of.iter().copied().filter(|&i| sharp[i]).collect();
            run.bracket.longest(&still).or_else(|| run.bracket.shortest(of))
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
                // Of files that keep their noise the first estimate is right, and what a registration that is not quite true leaves would pass for more.
                let tells = |&i: &usize| frames[i].lossy || run.motions[i] == run.motions[still[0]];
                let told: Vec<usize> = still.iter().copied().filter(tells).collect();
                Ok(noise::of_squares(frames, &run.exposures, run.response, &told, &run.motions, true, &run.noise))
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
        let mut verdicts = if self.settings.align && used.iter().any(|&i| !known[i]) {
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
        let mut used: Vec<usize> = used.into_iter().filter(|&i| !excluded[i]).collect();
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
            for i in blind::untold(&verdicts, &sharp, &used, |ids| self.bracket.shortest(ids)) {
                sharp[i] = false;
                verdicts[i].reason = "nothing that another frame sees clearly as well tells whether it is sharp".into();
            }
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
        // What no part of a frame tells, its blur may, beside sharp frames.
        let beside = !unexplained && scene.is_none() && sharp.contains(&true);
        let doubtful: Vec<usize> = (0..frames.len()).filter(|&i| self.registrations[i].doubtful).collect();
        for i in doubtful {
            if beside {
                used.push(i);
                verdicts[i].reason = "shaken so far that no part of it tells by itself where it lies".into();
            } else {
                self.leave_out(i, &self.registrations[i].reason.clone())?;
            }
        }
        used.sort_unstable();
        let may_have_moved = match &doubt {
            Some(doubt) => !doubt.show_surely_the_same(),
            None => may_doubt && blind::less_detailed(&verdicts, &used),
        };
        self.deblurred(Sorted {
            verdicts,
            known,
            used,
            sharp,
            tsfs,
            scene,
            centre,
            reduced,
            unexplained,
            may_have_moved,
            turned: Turned::Not,
        })
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
