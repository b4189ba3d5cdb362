//! One bracket with known truth and everything that was made of it.

use super::Joint;
use crate::baseline;
use crate::error::{Error, Result};
use crate::exposure::{Bracket, Frame};
use crate::image::{Plane, Rgb};
use crate::metrics::{self, Align, Judge, Score};
use crate::pipeline::{Blind, Event, Settings};
use crate::random::Random;
use crate::response::{self, Response};
use crate::synth::{self, Camera, Drawn, Motion, Scene, Shake, SyntheticBracket, Tremor, Wobble};
use crate::tonemap::{ToneMap, codes};
use std::cell::OnceCell;

pub(super) type Events<'a> = &'a mut dyn FnMut(Event) -> bool;

/// Content beyond the frame, pixels.
pub(super) const MARGIN: usize = 40;

/// Which of the paper's brackets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Exposures {
    /// Figure 5: three sharp frames, two shaken.
    Sharp3,
    /// Figure 6: three frames, all shaken.
    Shaken3,
    /// Figure 8: two short frames and one long, as JPEG from a camera with a curve of its own, a little displaced.
    Jpeg,
    /// Figure 9: all shaken, as JPEG from such a camera.
    JpegShaken,
    /// Figure 10: two sharp frames and two shaken, far apart.
    Apart,
}

/// Numbers of an [`Exposures`].
struct Plan {
    times: Vec<f64>,
    /// The first shaken frame.
    shaken: usize,
    /// Median luminance of the scene: this part of white after 1 s.
    median: f64,
    /// Largest displacement of a frame from the first, as a part of the frame's width.
    apart: f64,
    /// JPEG of a camera with a curve that nobody states.
    jpeg: bool,
}

impl Plan {
    /// Content beyond frames of `width` pixels that shake and displacement can bring in, pixels.
    fn margin(&self, width: usize) -> usize {
        MARGIN.max(width / 6) + (1.5 * self.apart * width as f64) as usize
    }
}

impl Exposures {
    fn plan(self) -> Plan {
        let plan = Plan { times: vec![1.0 / 30.0, 1.0 / 8.0, 1.0 / 5.0, 1.0 / 2.0, 2.0], shaken: 3, median: 0.05, apart: 0.0, jpeg: false };
        match self {
            Self::Sharp3 => plan,
            Self::Shaken3 => Plan { times: vec![1.0 / 30.0, 1.0 / 8.0, 1.0], shaken: 0, median: 0.6, ..plan },
            Self::Jpeg => Plan { times: vec![1.0 / 100.0, 1.0 / 50.0, 1.0 / 2.0], shaken: 2, median: 1.0, apart: 0.01, jpeg: true },
            Self::JpegShaken => Plan { times: vec![1.0 / 6.0, 1.0 / 2.0, 2.0], shaken: 0, median: 0.2, jpeg: true, ..plan },
            Self::Apart => Plan { times: vec![1.0 / 40.0, 1.0 / 15.0, 1.0 / 4.0, 1.0], shaken: 2, median: 0.6, apart: 0.1, ..plan },
        }
    }
}

/// An exposure time as photographers write it.
pub(super) fn seconds(time: f64) -> String {
    if time < 0.4 { format!("1/{:.0} S", 1.0 / time) } else { format!("{time} S") }
}

/// How the shaken frames are shaken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Shaking {
    /// TSFs on the paper's grid.
    Grid,
    /// Smooth tremor, off every grid.
    Tremor,
    /// Tremor in six degrees of freedom.
    SixD,
    /// Mostly turning, as a hand does.
    Turning,
}

impl Shaking {
    /// Shake of frames of `width` pixels: a hand at 2 s moves the picture by a few hundredths of its width, and turns it by up to the three degrees
    /// that the paper allows, which move the corners by as much again.
    fn shake(self, width: usize, focal_px: f64) -> Shake {
        let extent = 0.028 * width as f64;
        let tremor = Tremor { extent_px: extent, roll_deg: 2.4, offset_px: 1.0, offset_deg: 0.1 };
        let wobble = Wobble { shift_m: extent * 0.8 * 2.0 / focal_px, nearing_m: 0.002, tilt_deg: 0.6, roll_deg: 1.8, depth_m: 2.0 };
        match self {
            Self::Grid => Shake::Grid(tremor),
            Self::Tremor => Shake::Tremor(tremor),
            Self::SixD => Shake::SixD(wobble),
            Self::Turning => {
                let tilt_deg = (extent / focal_px).to_degrees();
                Shake::SixD(Wobble { shift_m: 0.1 * wobble.shift_m, nearing_m: 0.0, tilt_deg, roll_deg: 2.4, ..wobble })
            }
        }
    }
}

/// What is photographed, and how: what tells one study from another.
pub(super) type Key = (&'static str, Exposures, Shaking);

pub(super) struct Study {
    /// The scene, in its own units.
    pub scene: Scene,
    pub made: SyntheticBracket,
    pub motions: Vec<Motion>,
    pub tripod: Bracket,
    pub response: Response,
    /// What is said of the camera and the frames.
    pub camera: String,
    pub joint: Joint,
    pub tone: ToneMap,
    settings: Settings,
    judge: Judge,
    denoised: OnceCell<Rgb>,
    naive: OnceCell<Rgb>,
    uniform: OnceCell<Rgb>,
}

/// A way to make an irradiance image of a study's bracket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Method {
    /// All frames merged, blurred ones too.
    Merge,
    /// The sharp frames merged.
    Sharp,
    /// The program on the sharp frames alone: merged and denoised.
    Denoised,
    /// Each shaken frame deblurred by itself, then merged.
    Naive,
    /// All frames together, the blur the same everywhere.
    Uniform,
    /// The program.
    Unshaken,
    /// The same exposures from a tripod, merged.
    Tripod,
}

impl Method {
    pub fn name(self) -> &'static str {
        match self {
            Self::Merge => "all frames merged",
            Self::Sharp => "sharp frames merged",
            Self::Denoised => "sharp frames, denoised",
            Self::Naive => "each deblurred, merged",
            Self::Uniform => "uniform blur only",
            Self::Unshaken => "unshaken",
            Self::Tripod => "tripod merged",
        }
    }
}

/// A film-like curve: toe, gamma, shoulder.
fn film() -> Response {
    // f of x = s², sampled densely and inverted where the table wants it.
    let curve = |x: f64| {
        let g = x.powf(1.0 / 2.2);
        0.6 * g + 0.4 * g * g * (3.0 - 2.0 * g)
    };
    let table: Vec<f64> = (0..=1023)
        .map(|k| {
            let z = f64::from(k) / 1023.0;
            let (mut a, mut b) = (0.0f64, 1.0f64);
            for _ in 0..60 {
                let m = 0.5 * (a + b);
                if curve(m) < z { a = m } else { b = m }
            }
            if k == 1023 { 1.0 } else { 0.5 * (a + b) }
        })
        .collect();
    Response::Table([table.clone(), table.clone(), table])
}

/// Quality of the frames' JPEG.
const JPEG: u8 = 95;

/// The frame after a JPEG file.
fn through_jpeg(frame: &Frame) -> Result<Frame> {
    let refuse = |e: image::ImageError| Error::Input(format!("{}: cannot be made a JPEG ({e})", frame.name));
    let mut file = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, JPEG).encode_image(&codes(&frame.intensity)).map_err(refuse)?;
    let picture = image::load_from_memory_with_format(&file, image::ImageFormat::Jpeg).map_err(refuse)?.to_rgb8();
    let (w, h) = frame.intensity.size();
    let plane = |c: usize| Plane::from_fn(w, h, |x, y| f32::from(picture.get_pixel(x as u32, y as u32).0[c]) / 255.0);
    Ok(Frame { intensity: Rgb(std::array::from_fn(plane)), ..frame.clone() })
}

/// The curve of a camera with `response` as it is calibrated off-line, from a bracket of a chart on a tripod.
fn calibrated(response: &Response, seed: u64) -> Result<Response> {
    let scene = Drawn::Chart.draw(128, 96, 8, 2, seed);
    let frames: Vec<(f64, Motion)> = (0..9).map(|k| (2f64.powi(k - 7), Shake::none(128))).collect();
    let camera = Camera { response: response.clone(), ..Camera::default() };
    let made = synth::photograph(&scene, &camera, &frames, 0.5, seed, false)?.0;
    let frames = made.bracket.frames().iter().map(through_jpeg).collect::<Result<Vec<_>>>()?;
    response::calibrate(&Bracket::new(frames)?)
}

impl Study {
    pub fn new((scene, exposures, shaking): (Drawn, Exposures, Shaking), width: usize, seed: u64, events: Events) -> Result<Self> {
        events(Event::Progress { stage: format!("scene {}", scene.name()), fraction: 0.0 });
        let plan = exposures.plan();
        let (width, height) = (width, width * 3 / 4);
        let scene = scene.draw(width, height, plan.margin(width), 2, seed);
        let motions = motions(&plan, shaking, (width, height), seed)?;
        let camera = if plan.jpeg { Camera { response: film(), ..Camera::default() } } else { Camera::default() };
        Self::of(scene, &camera, plan, motions, seed, events)
    }

    /// The frames of a study alone.
    pub fn photographed((scene, exposures, shaking): (Drawn, Exposures, Shaking), width: usize, seed: u64) -> Result<SyntheticBracket> {
        let plan = exposures.plan();
        let (width, height) = (width, width * 3 / 4);
        let scene = scene.draw(width, height, plan.margin(width), 2, seed);
        let frames = plan.times.iter().copied().zip(motions(&plan, shaking, (width, height), seed)?).collect::<Vec<_>>();
        Ok(synth::photograph(&scene, &Camera::default(), &frames, plan.median, seed, false)?.0)
    }

    /// A study of a scene in irradiance per second, photographed by a camera with `response`; frames longer than `steady` seconds are shaken.
    pub fn of_scene(scene: Scene, response: Response, times: &[f64], steady: f64, seed: u64, events: Events) -> Result<Self> {
        let size = scene.frame_size();
        let mut still = synth::expose(&scene, &synth::identity(size.0)).mean().data;
        let middle = still.len() / 2;
        let median = f64::from(*still.select_nth_unstable_by(middle, f32::total_cmp).1);
        let mut times = times.to_vec();
        times.sort_by(f64::total_cmp);
        let shaken = times.iter().filter(|t| **t <= steady).count();
        let plan = Plan { times, shaken, median, apart: 0.0, jpeg: false };
        let motions = motions(&plan, Shaking::Tremor, size, seed)?;
        Self::of(scene, &Camera { response, ..Camera::default() }, plan, motions, seed, events)
    }

    fn of(scene: Scene, camera: &Camera, plan: Plan, motions: Vec<Motion>, seed: u64, events: Events) -> Result<Self> {
        let frames: Vec<(f64, Motion)> = plan.times.iter().copied().zip(motions).collect();
        let (mut made, tripod) = synth::photograph(&scene, camera, &frames, plan.median, seed, true)?;
        let mut tripod = tripod.expect("asked for");
        let mut response = camera.response.clone();
        if plan.jpeg {
            let all = |b: &Bracket| Bracket::new(b.frames().iter().map(through_jpeg).collect::<Result<Vec<_>>>()?);
            made.bracket = all(&made.bracket)?;
            tripod = all(&tripod)?;
            response = calibrated(&camera.response, seed)?;
        }
        let settings = Settings {
            blind: if plan.shaken == 0 { Blind::Joint } else { Blind::default() },
            // The truth lies on the first frame, which nothing displaces.
            reference: (plan.apart > 0.0).then_some(0),
            ..Settings::default()
        };
        let joint = Joint::new(&made.bracket, &response, &settings, None, events)?;
        let judge = Judge { limit: Some((0.98 / plan.times[0]) as f32), ..Judge::default() };
        let tone = ToneMap::fit(&made.truth);
        let (w, h) = made.bracket.size();
        let list = |t: &[f64]| t.iter().map(|t| seconds(*t).to_lowercase()).collect::<Vec<_>>().join(", ");
        let (sharp, shaken) = plan.times.split_at(plan.shaken);
        let camera = format!(
            "{w} x {h} pixels; {}{} shaken; full well {:.0} electrons, read noise {:.0}, {}",
            if sharp.is_empty() { String::new() } else { format!("{} sharp, ", list(sharp)) },
            list(shaken),
            camera.full_well,
            camera.read_noise,
            match (&camera.response, plan.jpeg) {
                (_, true) => format!(
                    "JPEG of quality {JPEG} under a film-like curve, calibrated beforehand from a tripod's bracket of a chart (Debevec and Malik 1997)"
                ),
                (Response::Table(_), _) => "8 bits under the camera's own curve".into(),
                _ => "8-bit sRGB".into(),
            }
        );
        let motions = frames.into_iter().map(|f| f.1).collect();
        Ok(Self {
            scene,
            made,
            motions,
            tripod,
            response,
            camera,
            joint,
            tone,
            settings,
            judge,
            denoised: OnceCell::new(),
            naive: OnceCell::new(),
            uniform: OnceCell::new(),
        })
    }

    /// The exposure times, seconds.
    pub fn times(&self) -> Vec<f64> {
        self.made.bracket.frames().iter().map(|f| f.exposure_time).collect()
    }

    /// The first shaken frame.
    pub fn shaken(&self) -> usize {
        self.made.sharp.iter().filter(|s| **s).count()
    }

    /// What `method` makes of the bracket; irradiance per second.
    ///
    /// # Errors
    /// The pipeline's.
    pub fn result(&self, method: Method, events: Events) -> Result<Rgb> {
        let bracket = &self.made.bracket;
        let all: Vec<usize> = (0..bracket.frames().len()).collect();
        let kept = |cell: &OnceCell<Rgb>, make: &mut dyn FnMut() -> Result<Rgb>| -> Result<Rgb> {
            if cell.get().is_none() {
                // Nobody else fills it: it was empty a line ago.
                let _ = cell.set(make()?);
            }
            Ok(cell.get().expect("filled").clone())
        };
        match method {
            Method::Merge => Ok(baseline::merge(bracket, &self.response, &all)),
            Method::Sharp => Ok(baseline::merge(bracket, &self.response, &all[..self.shaken().max(1)])),
            Method::Unshaken => Ok(self.joint.irradiance.clone()),
            Method::Tripod => Ok(baseline::merge(&self.tripod, &self.response, &all)),
            Method::Denoised => kept(&self.denoised, &mut || {
                let exclude = all[self.shaken().max(1)..].to_vec();
                let settings = Settings { exclude, ..self.settings.clone() };
                Joint::new(bracket, &self.response, &settings, None, events).map(|j| j.irradiance)
            }),
            Method::Naive => kept(&self.naive, &mut || {
                let mut hear = |f: f32| events(Event::Progress { stage: "deblurring each frame".into(), fraction: f });
                baseline::deblur_each(bracket, &self.response, &self.joint.tsfs, &self.settings.deblur, &mut hear)
            }),
            Method::Uniform => {
                kept(&self.uniform, &mut || self.joint.uniform(bracket, &self.response, &self.settings, events).map(|j| j.irradiance))
            }
        }
    }

    /// Judges `image` against the truth. Without a sharp frame the result may lie off by what no frame tells, and the truth is moved there.
    ///
    /// # Errors
    /// Those of [`metrics::score`].
    pub fn score(&self, method: Method, image: &Rgb) -> Result<Score> {
        let mode = if self.shaken() == 0 && method != Method::Tripod { Align::Rigid } else { Align::None };
        let (truth, _) = metrics::align(image, &self.made.truth, mode)?;
        metrics::score(image, &truth, &self.judge)
    }

    /// Frame `i` as a picture: its intensity.
    pub fn photo(&self, i: usize) -> image::RgbImage {
        codes(&self.made.bracket.frames()[i].intensity)
    }

    /// Exposure fusion of all frames.
    pub fn fused(&self) -> image::RgbImage {
        let all: Vec<usize> = (0..self.made.bracket.frames().len()).collect();
        codes(&baseline::fuse(&self.made.bracket, &all))
    }

    /// What the report says about itself being a merge: the blur was not found.
    pub fn fell_back(&self) -> bool {
        self.shaken() == 0 && self.joint.report["blind"]["believed"].as_bool() != Some(true)
    }
}

/// Motions of a plan's frames.
fn motions(plan: &Plan, shaking: Shaking, (width, height): (usize, usize), seed: u64) -> Result<Vec<Motion>> {
    let focal_px = 1.2 * width as f64;
    let shake = shaking.shake(width, focal_px);
    let longest = plan.times[plan.times.len() - 1];
    let mut displacement = Random::new(seed, u64::MAX);
    let motion = |(i, &time): (usize, &f64)| -> Result<Motion> {
        let motion = if i < plan.shaken {
            Shake::none(width)
        } else {
            shake.motion(width, height, focal_px, time, (time / longest).powf(0.35), 0.25, seed, i as u64 + 1)?
        };
        let mut draw = || displacement.uniform(-1.0, 1.0) * plan.apart;
        let (x, y, roll) = (draw(), draw(), draw());
        let to_px = width as f64;
        Ok(if i == 0 || plan.apart == 0.0 { motion } else { motion.displaced(x * to_px, y * to_px, roll * 10.0) })
    };
    plan.times.iter().enumerate().map(motion).collect()
}
