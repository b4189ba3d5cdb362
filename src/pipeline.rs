//! The stages in order: a bracket in, irradiance and report out. No mathematics, no files, no printing.

use crate::deblur::{self, Solution};
use crate::error::{Error, Result};
use crate::exposure::Bracket;
use crate::gpu::Gpu;
use crate::image::{Channels, Plane, Rgb};
use crate::kernels::Kernels;
use crate::noise::{FrameNoise, NoiseModel};
use crate::photometry::FramePhotometry;
use crate::register::Registration;
use crate::response::Response;
use crate::tsf::{Model, TsfFile};
use glam::DMat3;
use serde_json::Value;
use std::cell::OnceCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

mod blind;
mod engine;
mod judge;
mod observed;
mod place;
mod plan;
mod prepare;
mod progress;
mod report;
mod shaken;
mod solve;
mod stationary;
mod window;

pub use blind::Blind;
pub use engine::Engine;
use engine::Memo;
use prepare::Prepared;
use progress::Progress;

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
    /// Noise of the sensor, white and alike in all frames; `None`: estimated from each frame.
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
    /// Noise of each frame's exposures as the program estimated it.
    pub noise: Vec<FrameNoise>,
    /// Everything that was estimated, as JSON (`format` "unshaken-report", `version` 2).
    pub report: Value,
}

/// A merge under way.
struct Run<'a> {
    gpu: &'a Gpu,
    kernels: &'a Kernels,
    memo: &'a mut Memo,
    stop: Option<Arc<AtomicBool>>,
    bracket: &'a Bracket,
    /// The bracket without its hot pixels, once they are known.
    repaired: &'a OnceCell<Bracket>,
    response: &'a Response,
    settings: &'a Settings,
    events: &'a mut dyn FnMut(Event) -> bool,
    timings: Vec<(String, f64)>,
    /// Exposures f⁻¹(Z) as they would be if every frame's gain were 1 and its black 0.
    exposures: Vec<Rgb>,
    /// Noise of the exposures, and the standard deviations that the solver reads.
    noise: Vec<FrameNoise>,
    curves: Vec<[Vec<f32>; 3]>,
    photometry: Vec<FramePhotometry>,
    /// EV by which the pixels contradict what each file notes, and the standard deviation; times that are contradicted beyond doubt are replaced.
    exposure_errors: Vec<(f64, f64)>,
    masks: Vec<Plane>,
    /// What part of its weight each sharp frame keeps where others show something else, on its own pixels; `None`: all of it.
    ghosts: Vec<Option<Plane>>,
    /// The channels in which each frame's blur is looked for, and its mask by them where they are not all.
    looks: Vec<(Channels, Option<Plane>)>,
    /// Whether stationary frames that are displaced show structure as fine as their pixels, which an interpolation between them loses.
    pixel_sharp: bool,
    /// Where each frame lies, from the reference (centred pixels), and how that was found.
    motions: Vec<DMat3>,
    registrations: Vec<Registration>,
    left_out: Vec<(String, String)>,
    degraded: Vec<String>,
    /// Hot pixels that were replaced.
    hot_pixels: usize,
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
    let Prepared { corrected, exposures, noise, curves, exposure_errors } = prepare::prepared(memo, bracket, response, settings);
    let bracket = corrected.as_ref().unwrap_or(bracket);
    let repaired = OnceCell::new();
    let mut run = Run {
        stop,
        timings: vec![("exposures and noise".into(), start.elapsed().as_secs_f64())],
        exposures,
        noise,
        curves,
        exposure_errors,
        ..Run::of(gpu, kernels, memo, bracket, &repaired, response, settings, events)
    };
    run.tell_of_exposures()?;
    run.reconstruct(excluded, given)
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

impl<'a> Run<'a> {
    /// One in which nothing is known of the frames but their files.
    fn of(
        gpu: &'a Gpu,
        kernels: &'a Kernels,
        memo: &'a mut Memo,
        bracket: &'a Bracket,
        repaired: &'a OnceCell<Bracket>,
        response: &'a Response,
        settings: &'a Settings,
        events: &'a mut dyn FnMut(Event) -> bool,
    ) -> Self {
        let n = bracket.frames().len();
        Self {
            gpu,
            kernels,
            memo,
            stop: None,
            bracket,
            repaired,
            response,
            settings,
            events,
            timings: Vec::new(),
            exposures: Vec::new(),
            noise: Vec::new(),
            curves: Vec::new(),
            photometry: vec![FramePhotometry::AS_NOTED; n],
            exposure_errors: Vec::new(),
            masks: Vec::new(),
            ghosts: vec![None; n],
            looks: Vec::new(),
            pixel_sharp: false,
            motions: vec![DMat3::IDENTITY; n],
            registrations: vec![Registration::skipped(); n],
            left_out: Vec::new(),
            degraded: Vec::new(),
            hot_pixels: 0,
            blind: Value::Null,
            aliasing: vec![None; n],
            scale: 1.0,
        }
    }
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
}
