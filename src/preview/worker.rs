//! What takes time, on three threads beside the window's: one solves, one tones, one does everything else. All tell [`News`].

use super::program::{Opened, Program};
use super::session::Session;
use crate::baseline;
use crate::colour::{self, Matrix};
use crate::error::Error;
use crate::exposure::Bracket;
use crate::gpu::{Gate, Gpu, read};
use crate::image::{Channels, Plane, Rgb};
use crate::io::input;
use crate::kernels::{DeviceRgb, Place};
use crate::layers;
use crate::mask;
use crate::noise;
use crate::pipeline::{self, Engine, Estimate, Event, Outcome};
use crate::response::{self, Response};
use crate::tonemap::{Light, Operator};
use crate::tsf::{Tsf, TsfEntry, TsfFile};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Instant;

/// Most pixels of the first, reduced solution on a software rasteriser: a few seconds on two cores.
const FIRST_CPU: usize = 40_000;
/// On a GPU: a second or two.
const FIRST_GPU: usize = 400_000;
/// How many times smaller each reduced solution is than the next, at most.
const STEP: usize = 2;
/// Longer side of a thumbnail, pixels.
const THUMBNAIL: u32 = 224;
/// Bins of the histogram per stop.
pub const BINS_PER_STOP: usize = 4;

/// A picture on the device, irradiance E in its planes.
#[derive(Clone, PartialEq)]
pub struct Picture {
    /// The planes.
    pub planes: DeviceRgb,
    /// Where in them.
    pub place: Place,
    /// Differs when what the planes hold does.
    pub version: u64,
}

/// A plane on the device.
#[derive(Clone, PartialEq)]
pub struct Overlay {
    /// Its values.
    pub plane: wgpu::Buffer,
    /// Where in it.
    pub place: Place,
}

/// A small picture of a file, and what the file notes.
pub struct Thumbnail {
    /// sRGB pixels.
    pub picture: image::RgbaImage,
    /// Full size.
    pub size: (usize, usize),
    /// Exposure time in seconds.
    pub exposure_time: Option<f64>,
}

/// The frames, read.
pub struct Ready {
    /// As the program read them.
    pub opened: Opened,
    /// Their plain merge, irradiance E.
    pub merge: Picture,
    /// Its light, for the automatic exposure.
    pub light: Light,
    /// Its histogram.
    pub histogram: Histogram,
}

/// A solution.
pub struct Solved {
    /// What the pipeline found.
    pub outcome: Outcome,
    /// The frames that it was found from, perhaps reduced.
    pub bracket: Arc<Bracket>,
    /// The frames as they were read.
    pub opened: Opened,
    /// What was said.
    pub warnings: Vec<String>,
    /// The number that the size is one over.
    pub divisor: usize,
    /// The session that it answers.
    pub session: Session,
    /// The irradiance on the device.
    pub picture: Picture,
    /// Its light.
    pub light: Light,
    /// Its histogram.
    pub histogram: Histogram,
    /// Stages that ran for it.
    pub ran: Vec<String>,
    /// Seconds that it took.
    pub seconds: f64,
}

impl Solved {
    /// The TSF of frame `i`, on frames of this solution's size; `None` for sharp frames and those left out.
    pub fn tsf(&self, i: usize) -> Option<Tsf> {
        let entry: TsfEntry = serde_json::from_value(self.outcome.report["frames"][i]["tsf"].clone()).ok()?;
        let (name, (w, h)) = (entry.frame.clone(), self.bracket.size());
        TsfFile::new(vec![entry]).find(&name, w, h).ok().flatten().filter(|t| t.single().is_none())
    }
}

/// How many pixels have how much light.
#[derive(Clone, Debug, PartialEq)]
pub struct Histogram {
    /// log2 of the irradiance at which the first bin begins.
    pub first: f32,
    /// Share of the pixels per bin, each channel.
    pub bins: [Vec<f32>; 3],
}

impl Histogram {
    /// Of an image in irradiance E; what is black is not counted.
    pub fn of(image: &Rgb) -> Self {
        let logs = |p: &Plane| p.data.iter().filter(|v| **v > 0.0 && v.is_finite()).map(|v| v.log2()).collect::<Vec<f32>>();
        let all: [Vec<f32>; 3] = std::array::from_fn(|c| logs(&image.0[c]));
        let top = all.iter().flatten().copied().fold(f32::MIN, f32::max);
        // Twenty stops are more than any camera's bracket holds.
        let low = all.iter().flatten().copied().fold(f32::MAX, f32::min).max(top - 20.0);
        let first = if low <= top { low.floor() } else { 0.0 };
        let count = if low <= top { ((top - first) as usize + 1) * BINS_PER_STOP } else { 1 };
        let bins = std::array::from_fn(|c| {
            let mut bins = vec![0f32; count];
            for v in all[c].iter().filter(|v| **v >= first) {
                let i = ((v - first) * BINS_PER_STOP as f32) as usize;
                bins[i.min(count - 1)] += 1.0 / image.0[c].data.len() as f32;
            }
            bins
        });
        Self { first, bins }
    }
}

/// Why something did not work.
#[derive(Clone, Debug, PartialEq)]
pub enum Failure {
    /// Memory ran out: a smaller scale may fit.
    OutOfMemory(String),
    /// The device is gone: another has to be opened.
    Lost(String),
    /// Anything else; the text says what to do.
    Other(String),
}

impl Failure {
    fn of(e: &anyhow::Error) -> Option<Self> {
        match e.downcast_ref::<Error>() {
            Some(Error::Cancelled) => None,
            Some(Error::OutOfMemory(_)) => Some(Self::OutOfMemory(e.to_string())),
            Some(Error::DeviceLost(_)) => Some(Self::Lost(e.to_string())),
            _ => Some(Self::Other(format!("{e:#}"))),
        }
    }

    /// What to tell.
    pub fn text(&self) -> &str {
        match self {
            Self::OutOfMemory(t) | Self::Lost(t) | Self::Other(t) => t,
        }
    }
}

/// What was chosen in a dialog.
#[derive(Clone, Debug)]
pub enum Chosen {
    /// Frames, or a session, to open.
    Open(Vec<PathBuf>),
    /// Frames to add to those that are open.
    Add(Vec<PathBuf>),
    /// Where to save the session.
    Session(PathBuf),
    /// Where to export to.
    Export(PathBuf),
}

/// What the window hears.
pub enum News {
    /// A file was looked at.
    Thumbnail(PathBuf, Result<Box<Thumbnail>, String>),
    /// The frames of a request are read.
    Ready(u64, Arc<Ready>),
    /// A request goes on.
    Progress {
        /// The request.
        serial: u64,
        /// Stage in words.
        stage: String,
        /// Part of this solution that is done.
        fraction: f32,
        /// The number that its size is one over.
        divisor: usize,
    },
    /// Something the user should know.
    Warning(u64, String),
    /// The solver's present irradiance.
    Estimate(u64, Estimate),
    /// A solution, perhaps a reduced one.
    Solved(u64, Arc<Solved>),
    /// A request is done, or stopped, or failed.
    Ended(u64, Option<Failure>),
    /// A picture of frame `i` of these frames.
    Frame(Arc<Ready>, usize, Picture),
    /// An overlay that was asked for.
    Overlay(OverlayKey, Overlay),
    /// A picture that was asked for, toned, or why not.
    Toned(Result<Toned, String>),
    /// Something was written, or why not.
    Written(Result<String, String>),
    /// Files were chosen in a dialog.
    Chosen(Chosen),
}

/// What an overlay shows, and of which frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum OverlayKind {
    /// The frame's mask of eq. (8).
    Mask,
    /// The frame's local χ².
    Residual,
    /// Where the frame is clipped.
    FrameClipped,
    /// Part of the frames that are clipped.
    AllClipped,
}

/// An overlay of frame `frame` in the solution of request `serial` at one over `divisor`.
pub type OverlayKey = (OverlayKind, usize, u64, usize);

/// A request to tone pictures by an operator that looks at a pixel's surroundings.
#[derive(Clone)]
pub struct Toning {
    /// The operator.
    pub operator: Operator,
    /// The pictures, irradiance E.
    pub pictures: Vec<Picture>,
    /// Their RGB to Rec. 709.
    pub to_display: Matrix,
}

/// A picture that was toned.
pub struct Toned {
    /// The operator.
    pub operator: Operator,
    /// The picture that it was.
    pub of: Picture,
    /// What the screen shows, linear Rec. 709; 1 is white.
    pub picture: Picture,
}

/// A request to solve.
pub struct Request {
    /// Number by which news refer to it.
    pub serial: u64,
    /// What is wanted.
    pub session: Session,
    /// Exposure times that the files note.
    pub noted: Vec<Option<f64>>,
    /// Set to stop it.
    pub stop: Arc<AtomicBool>,
}

type Task = Box<dyn FnOnce(&Gpu, &dyn Fn(News)) + Send>;

/// The three threads. They end with this.
pub struct Workers {
    solve: mpsc::Sender<Request>,
    toning: mpsc::Sender<Toning>,
    tasks: mpsc::Sender<Task>,
    tell: Arc<dyn Fn(News) + Send + Sync>,
}

impl Workers {
    /// Starts them on a device that the window draws on, to which they submit while `gate` is open; `tell` is called from all.
    pub fn start(
        adapter: &wgpu::Adapter,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        gate: &Arc<Gate>,
        program: Arc<dyn Program>,
        tell: Arc<dyn Fn(News) + Send + Sync>,
    ) -> Self {
        let gpu = || Gpu::shared(adapter, device.clone(), queue.clone(), gate.clone());
        let (solve, requests) = mpsc::channel::<Request>();
        let (tasks, orders) = mpsc::channel::<Task>();
        let software = adapter.get_info().device_type == wgpu::DeviceType::Cpu;
        let mut solver = Solver {
            engine: Engine::remembering(gpu()),
            program,
            first: if software { FIRST_CPU } else { FIRST_GPU },
            opened: None,
            reduced: BTreeMap::new(),
            tell: tell.clone(),
        };
        std::thread::spawn(move || {
            while let Ok(mut request) = requests.recv() {
                // Only the latest matters.
                while let Ok(later) = requests.try_recv() {
                    (solver.tell)(News::Ended(request.serial, None));
                    request = later;
                }
                let serial = request.serial;
                let failure = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| solver.run(&request)));
                let failure = match failure {
                    Ok(Ok(())) => None,
                    Ok(Err(e)) => Failure::of(&e),
                    Err(_) => {
                        solver.engine.forget();
                        let text = "the solver stopped on an error of its own; please report it with the frames, if you can";
                        Some(Failure::Other(text.into()))
                    }
                };
                (solver.tell)(News::Ended(serial, failure));
            }
        });
        let (own, hear) = (gpu(), tell.clone());
        std::thread::spawn(move || {
            while let Ok(task) = orders.recv() {
                // A task that fails badly takes only itself along.
                let _ = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| task(&own, &|news| hear(news))));
            }
        });
        let (toning, wanted) = mpsc::channel::<Toning>();
        let (own, hear) = (gpu(), tell.clone());
        std::thread::spawn(move || {
            let mut next = wanted.recv().ok();
            while let Some(request) = next.take() {
                for picture in &request.pictures {
                    // Only the latest matters.
                    next = wanted.try_iter().last();
                    if next.is_some() {
                        break;
                    }
                    let toned = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| toned(&own, &request, picture)));
                    let failed =
                        || format!("tone mapping, {}: stopped on an error of its own; choose another tone curve", request.operator.name());
                    hear(News::Toned(toned.map_or_else(|_| Err(failed()), |t| t.map_err(|e| e.to_string()))));
                }
                if next.is_none() {
                    next = wanted.recv().ok();
                }
            }
        });
        Self { solve, toning, tasks, tell }
    }

    /// Asks for a solution.
    pub fn solve(&self, request: Request) {
        // The thread lives as long as this.
        let _ = self.solve.send(request);
    }

    /// Asks for toned pictures, in place of those that were asked for before.
    pub fn tone(&self, toning: Toning) {
        let _ = self.toning.send(toning);
    }

    /// Looks at a file.
    pub fn thumbnail(&self, path: PathBuf) {
        self.task(move |_, tell| {
            let found = thumbnail(&path).map(Box::new);
            tell(News::Thumbnail(path, found));
        });
    }

    /// Makes a picture of frame `i`, irradiance E.
    pub fn frame(&self, ready: Arc<Ready>, i: usize) {
        self.task(move |gpu, tell| {
            let frame = &ready.opened.bracket.frames()[i];
            let dt = frame.exposure_time as f32;
            let image = noise::exposure(frame, &ready.opened.response).map_planes(|p| p.map(|v| v / dt));
            if let Ok(picture) = upload(gpu, &image) {
                tell(News::Frame(ready, i, picture));
            }
        });
    }

    /// Makes an overlay for `solved`.
    pub fn overlay(&self, key: OverlayKey, solved: Arc<Solved>) {
        self.task(move |gpu, tell| {
            let Some(plane) = overlay(key.0, key.1, &solved) else { return };
            if let Ok(buffer) = gpu.upload("overlay", &plane.data) {
                tell(News::Overlay(key, Overlay { plane: buffer, place: Place::padded(plane.width, plane.height, 0) }));
            }
        });
    }

    /// Writes the outputs that `session` and the targets ask for.
    pub fn write(&self, program: Arc<dyn Program>, arguments: Vec<std::ffi::OsString>, solved: Arc<Solved>) {
        self.task(move |_, tell| {
            let written = program.write(&arguments, &solved.opened, &solved.bracket, &solved.outcome, &solved.warnings);
            tell(News::Written(written.map_err(|e| format!("{e:#}"))));
        });
    }

    /// Something else that takes time.
    pub fn task(&self, task: impl FnOnce(&Gpu, &dyn Fn(News)) + Send + 'static) {
        let _ = self.tasks.send(Box::new(task));
    }

    /// Something that waits for the user, beside everything else.
    pub fn beside(&self, task: impl FnOnce(&dyn Fn(News)) + Send + 'static) {
        let tell = self.tell.clone();
        std::thread::spawn(move || task(&|news| tell(news)));
    }
}

struct Solver {
    engine: Engine,
    program: Arc<dyn Program>,
    first: usize,
    /// The frames that are open, and what about the session they depend on.
    opened: Option<(String, Arc<Ready>)>,
    reduced: BTreeMap<usize, Arc<Bracket>>,
    tell: Arc<dyn Fn(News) + Send + Sync>,
}

impl Solver {
    fn run(&mut self, request: &Request) -> anyhow::Result<()> {
        let Request { serial, session, noted, stop } = request;
        let arguments = session.arguments(noted, Path::new("result.exr"));
        let going = || !stop.load(Ordering::Relaxed);
        let tell = self.tell.clone();
        self.engine.stops_at(stop.clone());
        let frames: Vec<_> = session.shots.iter().map(|s| (&s.path, s.exposure_time)).collect();
        let name = format!("{frames:?} {} {noted:?}", session.parameters.response);
        if self.opened.as_ref().is_none_or(|o| o.0 != name) {
            self.opened = None;
            self.reduced.clear();
            self.engine.forget();
            let opened = self.program.open(&arguments, &mut |event| hear(&*tell, *serial, 1, event) && going())?;
            let all: Vec<usize> = (0..opened.bracket.frames().len()).collect();
            let merged = baseline::merge(&opened.bracket, &opened.response, &all);
            let (light, histogram) = (light(&merged, &opened), Histogram::of(&merged));
            let merge = upload(self.engine.gpu(), &merged)?;
            self.opened = Some((name.clone(), Arc::new(Ready { opened, merge, light, histogram })));
        }
        let ready = self.opened.as_ref().expect("opened above").1.clone();
        (self.tell)(News::Ready(*serial, ready.clone()));
        let settings = self.program.settings(&arguments, &ready.opened)?;
        for divisor in divisors(ready.opened.bracket.size(), session.parameters.divisor, self.first) {
            if !going() {
                return Err(Error::Cancelled.into());
            }
            let bracket = match self.reduced.get(&divisor) {
                Some(found) => found.clone(),
                None if divisor == 1 => ready.opened.bracket.clone(),
                None => Arc::new(response::reduced(&ready.opened.bracket, &ready.opened.response, divisor)?),
            };
            self.reduced.insert(divisor, bracket.clone());
            let start = Instant::now();
            let mut warnings = Vec::new();
            self.engine.forget_run();
            let mut settings = settings.reduced(divisor);
            if divisor > session.parameters.divisor.max(1) {
                // Reduced frames have less noise and shorter blurs: half the iterations show what there is to see.
                settings.deblur.inner = settings.deblur.inner.div_ceil(2);
                settings.deblur.outer = settings.deblur.outer.div_ceil(2);
            }
            let outcome = pipeline::merge_with(
                &mut self.engine,
                &format!("{name} 1/{divisor}"),
                &bracket,
                &ready.opened.response,
                &settings,
                None,
                &mut |event| {
                    if let Event::Warning(text) = &event {
                        warnings.push(text.clone());
                    }
                    hear(&*tell, *serial, divisor, event) && going()
                },
            )?;
            let time = bracket.frames()[outcome.reference].exposure_time as f32;
            let irradiance = outcome.irradiance.map_planes(|p| p.map(|v| v / time));
            let solved = Solved {
                picture: upload(self.engine.gpu(), &irradiance)?,
                light: light(&irradiance, &ready.opened),
                histogram: Histogram::of(&irradiance),
                outcome,
                bracket,
                opened: ready.opened.clone(),
                warnings,
                divisor,
                session: session.clone(),
                ran: self.engine.ran().to_vec(),
                seconds: start.elapsed().as_secs_f64(),
            };
            (self.tell)(News::Solved(*serial, Arc::new(solved)));
        }
        Ok(())
    }
}

/// Passes an event of the pipeline on.
fn hear(tell: &dyn Fn(News), serial: u64, divisor: usize, event: Event) -> bool {
    tell(match event {
        Event::Progress { stage, fraction } => News::Progress { serial, stage, fraction, divisor },
        Event::Warning(text) => News::Warning(serial, text),
        Event::Estimate(estimate) => News::Estimate(serial, estimate),
    });
    true
}

/// Sizes at which frames of `size` are solved, as numbers that they are one over: from `first` pixels or fewer to one over `last`.
pub fn divisors(size: (usize, usize), last: usize, first: usize) -> Vec<usize> {
    let last = last.max(1);
    let mut all = vec![last];
    let pixels = |d: usize| (size.0 / d) * (size.1 / d);
    while pixels(all[0]) > first && size.0.min(size.1) / (STEP * all[0]) >= 48 {
        all.insert(0, STEP * all[0]);
    }
    all
}

/// The light of an irradiance image as it is displayed.
fn light(irradiance: &Rgb, opened: &Opened) -> Light {
    let mut image = irradiance.clone();
    colour::convert(&mut image, &opened.to_display);
    Light::of(&image)
}

/// An image's planes on the device.
fn upload(gpu: &Gpu, image: &Rgb) -> crate::error::Result<Picture> {
    let (w, h) = image.size();
    let plane = |c: usize| gpu.upload("picture", &image.0[c].data);
    Ok(Picture { planes: [plane(0)?, plane(1)?, plane(2)?], place: Place::padded(w, h, 0), version: 0 })
}

fn toned(gpu: &Gpu, toning: &Toning, of: &Picture) -> crate::error::Result<Toned> {
    let Place { size, stride, first } = of.place;
    let [width, height] = size.map(|n| n as usize);
    let plane = |c: usize| {
        let values = read(gpu, &of.planes[c], (of.planes[c].size() / 4) as usize)?;
        let rows = values[first as usize..].chunks(stride as usize).take(height);
        Ok::<_, Error>(Plane { width, height, data: rows.flat_map(|row| &row[..width]).copied().collect() })
    };
    let mut image = Rgb([plane(0)?, plane(1)?, plane(2)?]);
    colour::convert(&mut image, &toning.to_display);
    let codes = toning.operator.apply(&image);
    let light: [f32; 256] = std::array::from_fn(|code| Response::Srgb.inverse(0, code as f64 / 255.0) as f32);
    let linear = |c: usize| Plane { width, height, data: codes.pixels().map(|p| light[p.0[c] as usize]).collect() };
    let picture = upload(gpu, &Rgb([linear(0), linear(1), linear(2)]))?;
    Ok(Toned { operator: toning.operator.clone(), of: of.clone(), picture })
}

fn thumbnail(path: &Path) -> Result<Thumbnail, String> {
    let input = input::read(path, 1.0).map_err(|e| e.to_string())?;
    let (w, h) = input.intensity.size();
    let linear = input.encoding == input::Encoding::Linear;
    let picture = if linear { crate::tonemap::preview(&input.intensity) } else { crate::tonemap::codes(&input.intensity) };
    let (tw, th) = (THUMBNAIL.min(w as u32), (THUMBNAIL as usize * h / w.max(1)).clamp(1, h.max(1)) as u32);
    let small = image::imageops::thumbnail(&picture, tw.max(1), th);
    let picture = image::DynamicImage::ImageRgb8(small).to_rgba8();
    Ok(Thumbnail { picture, size: (w, h), exposure_time: input.metadata.exposure_time.filter(|t| *t > 0.0) })
}

fn overlay(kind: OverlayKind, i: usize, solved: &Solved) -> Option<Plane> {
    let frames = solved.bracket.frames();
    let (width, height) = solved.bracket.size();
    match kind {
        OverlayKind::Residual => solved.outcome.misfit.get(i)?.clone(),
        OverlayKind::FrameClipped => {
            let clipped = mask::clipped(frames.get(i)?, Channels::ALL);
            Some(Plane { width, height, data: clipped.iter().map(|&c| f32::from(u8::from(c))).collect() })
        }
        OverlayKind::AllClipped => {
            let all = layers::grounds(&solved.bracket, &solved.opened.response, &solved.outcome).saturation;
            Some(all.map(|v| f32::from(u8::from(v > 0.999))))
        }
        OverlayKind::Mask => Some(masks(solved).swap_remove(i)),
    }
}

/// The masks of the frames under this solution's marks, each on its own pixels.
pub fn masks(solved: &Solved) -> Vec<Plane> {
    let report = &solved.outcome.report["frames"];
    let frames = solved.bracket.frames();
    let sharp: Vec<bool> = (0..frames.len()).map(|i| report[i]["sharp"] == true).collect();
    let still = vec![glam::DMat3::IDENTITY; frames.len()];
    mask::counting(frames, &sharp, solved.session.parameters.alpha as f32, &still)
}
