//! The window's state, and what its parts do to it.

use super::canvas::{self, Canvas, Shown, Side, View};
use super::device::Device;
use super::session::{History, Recent, Session, Shot};
use super::shortcuts::{self, Action};
use super::worker::{Failure, News, Overlay, OverlayKey, OverlayKind, Picture, Ready, Request, Solved, Thumbnail, Toned, Toning, Workers};
use super::{Chosen, Options, Program, blur, controls, export, strip, words};
use crate::kernels::{DisplayParams, Place};
use crate::pipeline::Estimate;
use crate::tonemap::{Light, Operator};
use egui::{Color32, RichText, Vec2};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Instant;

/// What outlives the window when its device is lost.
#[derive(Default)]
pub struct Kept {
    /// Whether the window is to be opened again.
    pub again: bool,
    /// What was being edited.
    pub session: Option<(Session, Option<PathBuf>)>,
    /// Why the program ends with an error.
    pub failed: Option<String>,
    /// How often the device was lost.
    pub losses: usize,
}

/// Devices that may be lost one after the other before it is no use.
const LOSSES: usize = 3;
/// A toned picture's RGB is that of the screen.
const SAME: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
/// Seconds after an edit that the solver waits for the next.
const REST: f64 = 0.35;

/// What one side of the view shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// A frame, in the units of the result.
    Frame(usize),
    /// The frames' plain merge.
    Merge,
    /// The result, or as far as it is.
    Result,
}

/// What lies over the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Over {
    /// Nothing.
    Nothing,
    /// Where the chosen frame is clipped.
    FrameClipped,
    /// Where all frames are clipped.
    AllClipped,
    /// The chosen frame's mask.
    Mask,
    /// The chosen frame's residual.
    Residual,
}

impl Over {
    /// All, in the order of the menu.
    pub const ALL: [Self; 5] = [Self::Nothing, Self::FrameClipped, Self::AllClipped, Self::Mask, Self::Residual];

    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nothing => "None",
            Self::FrameClipped => "Clipped in the frame",
            Self::AllClipped => "Clipped in all frames",
            Self::Mask => "Mask of the frame",
            Self::Residual => "Residual of the frame",
        }
    }

    fn kind(self) -> Option<(OverlayKind, u32)> {
        match self {
            Self::Nothing => None,
            Self::FrameClipped => Some((OverlayKind::FrameClipped, 3)),
            Self::AllClipped => Some((OverlayKind::AllClipped, 3)),
            Self::Mask => Some((OverlayKind::Mask, 1)),
            Self::Residual => Some((OverlayKind::Residual, 2)),
        }
    }
}

/// A file of the strip.
pub struct Thumb {
    /// Its small picture.
    pub texture: egui::TextureHandle,
    /// Full size in pixels.
    pub size: (usize, usize),
    /// Exposure time in seconds that the file notes.
    pub exposure_time: Option<f64>,
}

/// A request that is being solved.
pub struct Running {
    /// Its number.
    pub serial: u64,
    stop: Arc<AtomicBool>,
    /// Stage in words.
    pub stage: String,
    /// Part of the present size that is done.
    pub fraction: f32,
    /// The number that the present size is one over.
    pub divisor: usize,
    /// When the present size began.
    pub began: Instant,
    /// What is being solved.
    pub session: Session,
}

/// A message in the window.
pub struct Message {
    /// What happened, and what to do.
    pub text: String,
    /// Whether it is an error; a warning otherwise.
    pub error: bool,
    /// What a button offers.
    pub offer: Option<Offer>,
    /// Whether the next solution makes it obsolete.
    pub passing: bool,
}

/// What a message's button does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offer {
    /// Solve at one over this number of the full size.
    Smaller(usize),
    /// Open the device again.
    Reopen,
}

/// What the exports are to be.
pub struct ExportForm {
    /// Whether the window is open.
    pub open: bool,
    /// The linear result.
    pub path: String,
    /// A picture beside it.
    pub picture: bool,
    /// A report beside it.
    pub report: bool,
    /// A report page beside it.
    pub page: bool,
    /// 16 bits.
    pub half: bool,
    /// Replace what exists.
    pub overwrite: bool,
    /// How the last one went.
    pub last: Option<Result<String, String>>,
    /// Whether one is being written.
    pub busy: bool,
}

impl Default for ExportForm {
    fn default() -> Self {
        let path = "result.exr".into();
        Self { open: false, path, picture: true, report: true, page: false, half: false, overwrite: false, last: None, busy: false }
    }
}

/// The window.
pub struct App {
    pub(super) program: Arc<dyn Program>,
    pub(super) workers: Workers,
    inbox: mpsc::Receiver<News>,
    device: Device,
    kept: Arc<Mutex<Kept>>,
    screenshot: Option<PathBuf>,
    /// The picture of the window, when it has come.
    taken: Arc<Mutex<Option<Arc<egui::ColorImage>>>>,
    /// Frames of the window since there was nothing left to wait for.
    settled: usize,

    pub(super) session: Session,
    pub(super) history: History,
    pub(super) saved: Option<PathBuf>,
    pub(super) recent: Recent,
    pub(super) thumbs: HashMap<PathBuf, Result<Thumb, String>>,
    asked_thumbs: BTreeSet<PathBuf>,

    serial: u64,
    pub(super) running: Option<Running>,
    /// Since when an edit waits to be solved.
    waiting: Option<f64>,
    /// Solve after each edit by itself.
    pub(super) live: bool,
    pub(super) ready: Option<Arc<Ready>>,
    pub(super) solved: Option<Arc<Solved>>,
    estimate: Option<Estimate>,
    /// Counts what was heard of the solver: its irradiance is another each time.
    heard: u64,
    frames: BTreeMap<usize, Picture>,
    asked_frames: BTreeSet<usize>,
    overlays: BTreeMap<OverlayKey, Overlay>,
    asked_overlays: BTreeSet<OverlayKey>,
    /// The pictures shown, as the operator tones them that looks at surroundings.
    tones: Vec<Toned>,
    asked_tones: Option<Toning>,
    /// Says that one is being computed.
    toning: Option<String>,
    /// The last operator that treats all pixels alike.
    plain: Operator,
    /// Counts the solutions, for what is derived from them.
    pub(super) solutions: u64,

    pub(super) view: View,
    pub(super) before: Source,
    pub(super) after: Source,
    pub(super) over: Over,
    pub(super) extremes: bool,
    /// The chosen frame.
    pub(super) frame: usize,
    pub(super) blur: blur::State,
    pub(super) form: ExportForm,
    pub(super) messages: Vec<Message>,
    pub(super) help: bool,
    /// Pixel of the full frame under the pointer.
    pub(super) probe: Option<(usize, usize)>,
    /// Text of exposure times while they are being typed.
    pub(super) typed: HashMap<PathBuf, String>,
    /// The same of the response and of the memory: each is taken when it is complete.
    pub(super) typed_response: String,
    pub(super) typed_memory: String,
}

impl App {
    /// A window whose contents `render` draws.
    pub fn new(
        context: &egui::Context,
        render: &egui_wgpu::RenderState,
        options: &Options,
        program: Arc<dyn Program>,
        kept: Arc<Mutex<Kept>>,
    ) -> Self {
        render.renderer.write().callback_resources.insert(Canvas::new(&render.device, render.target_format));
        let device = Device::heard(&render.device, context);
        let (sender, inbox) = mpsc::channel();
        let ctx = context.clone();
        let tell = Arc::new(move |news| {
            // Nobody listens once the window is closed.
            let _ = sender.send(news);
            ctx.request_repaint();
        });
        let workers = Workers::start(&render.adapter, &render.device, &render.queue, device.gate(), program.clone(), tell);
        if let Some(light) = options.light {
            context.set_theme(if light { egui::Theme::Light } else { egui::Theme::Dark });
        }
        let session = kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner).session.take();
        let mut app = Self {
            program,
            workers,
            inbox,
            device,
            kept,
            screenshot: options.screenshot.clone(),
            taken: Arc::default(),
            settled: 0,
            session: Session::default(),
            history: History::default(),
            saved: None,
            recent: Recent::load(options.recent.clone()),
            thumbs: HashMap::new(),
            asked_thumbs: BTreeSet::new(),
            serial: 0,
            running: None,
            waiting: None,
            live: true,
            ready: None,
            solved: None,
            estimate: None,
            heard: 0,
            frames: BTreeMap::new(),
            asked_frames: BTreeSet::new(),
            overlays: BTreeMap::new(),
            asked_overlays: BTreeSet::new(),
            tones: Vec::new(),
            asked_tones: None,
            toning: None,
            plain: Operator::default(),
            solutions: 0,
            view: View::default(),
            before: Source::Merge,
            after: Source::Result,
            over: Over::Nothing,
            extremes: false,
            frame: 0,
            blur: blur::State::new(options.blur),
            form: ExportForm::default(),
            messages: Vec::new(),
            help: false,
            probe: None,
            typed: HashMap::new(),
            typed_response: String::new(),
            typed_memory: String::new(),
        };
        match session {
            Some((session, saved)) => {
                app.session = session;
                app.saved = saved;
                app.waiting = Some(0.0);
                app.say("the GPU was lost and has been opened again; everything is as it was", false, None);
            }
            None if !options.files.is_empty() => app.open(options.files.clone()),
            None => {}
        }
        app
    }

    /// What the user has said so far.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// The latest solution.
    pub fn solution(&self) -> Option<&Arc<Solved>> {
        self.solved.as_ref()
    }

    /// Whether something is being solved, or about to be.
    pub fn is_busy(&self) -> bool {
        self.running.is_some() || self.waiting.is_some()
    }

    /// The messages that are shown.
    pub fn texts(&self) -> Vec<&str> {
        self.messages.iter().map(|m| m.text.as_str()).collect()
    }

    /// Where the divider is, 0..=1 of the view's width.
    pub fn divider(&self) -> f32 {
        self.view.split
    }

    /// Points per pixel of the frame; `None` while the whole frame fits.
    pub fn zoom(&self) -> Option<f32> {
        self.view.zoom
    }

    /// Pixel of the full frame under the pointer.
    pub fn probed(&self) -> Option<(usize, usize)> {
        self.probe
    }

    /// The overlay that is chosen.
    pub fn overlay(&self) -> Over {
        self.over
    }

    pub(super) fn say(&mut self, text: impl Into<String>, error: bool, offer: Option<Offer>) {
        self.put(Message { text: text.into(), error, offer, passing: false });
    }

    /// Says what the next solution makes obsolete.
    fn say_of_solution(&mut self, text: String, error: bool, offer: Option<Offer>) {
        self.put(Message { text, error, offer, passing: true });
    }

    fn put(&mut self, message: Message) {
        let text = words::in_window(&message.text);
        if !self.messages.iter().any(|m| m.text == text) {
            self.messages.push(Message { text, ..message });
        }
    }

    /// Opens frames, or one session file, in place of what is open.
    pub fn open(&mut self, files: Vec<PathBuf>) {
        let session = match files.as_slice() {
            [one] if one.extension().is_some_and(|e| e == "json") => match Session::open(one) {
                Ok(session) => {
                    self.saved = Some(one.clone());
                    session
                }
                Err(e) => return self.say(e.to_string(), true, None),
            },
            _ => {
                self.saved = None;
                let mut all: Vec<PathBuf> = Vec::new();
                for path in &files {
                    if !all.contains(path) {
                        all.push(path.clone());
                    }
                }
                Session { look: self.session.look.clone(), ..Session::of(all) }
            }
        };
        self.recent.add(files);
        self.messages.clear();
        self.cancel();
        self.serial += 1;
        self.history = History::default();
        self.session = session;
        self.ready = None;
        self.solved = None;
        self.estimate = None;
        self.frame = 0;
        (self.before, self.after, self.over) = (Source::Merge, Source::Result, Over::Nothing);
        self.view = View { divided: self.view.divided, ..View::default() };
        self.forget_pictures();
        self.waiting = Some(0.0);
    }

    /// Adds frames to those that are open.
    pub(super) fn add(&mut self, files: Vec<PathBuf>) {
        let session = files.len() == 1 && files[0].extension().is_some_and(|e| e == "json");
        if self.session.shots.is_empty() || session {
            return self.open(files);
        }
        for path in files {
            if !self.session.shots.iter().any(|s| s.path == path) {
                self.session.shots.push(Shot::of(path));
            }
        }
    }

    fn forget_pictures(&mut self) {
        self.frames.clear();
        self.asked_frames.clear();
        self.overlays.clear();
        self.asked_overlays.clear();
        self.tones.clear();
        self.asked_tones = None;
    }

    /// Exposure times that the files note.
    pub(super) fn noted(&self) -> Vec<Option<f64>> {
        let time = |s: &Shot| self.thumbs.get(&s.path).and_then(|t| t.as_ref().ok()).and_then(|t| t.exposure_time);
        self.session.shots.iter().map(time).collect()
    }

    /// What keeps the frames from being solved, in words.
    pub(super) fn lacking(&self) -> Option<String> {
        if self.session.shots.len() < 2 {
            return Some("a bracket needs two frames or more, with different exposure times; open them together".into());
        }
        let without: Vec<String> = self
            .session
            .shots
            .iter()
            .zip(self.noted())
            .filter(|(s, noted)| s.exposure_time.is_none() && noted.is_none())
            .filter(|(s, _)| matches!(self.thumbs.get(&s.path), Some(Ok(_))))
            .map(|(s, _)| s.name())
            .collect();
        if let Some(name) = without.first() {
            let more = if without.len() > 1 { format!(" and {} more", without.len() - 1) } else { String::new() };
            return Some(format!("{name}{more}: the file notes no exposure time; type it below the thumbnail, such as 1/30"));
        }
        None
    }

    /// Whether every file has been looked at.
    fn looked_at(&self) -> bool {
        self.session.shots.iter().all(|s| self.thumbs.contains_key(&s.path))
    }

    /// What of two sessions the solver answers.
    fn same_question(a: &Session, b: &Session) -> bool {
        (&a.shots, &a.parameters, &a.patches) == (&b.shots, &b.parameters, &b.patches)
    }

    /// Whether the solution is of the size and the settings that are wanted.
    pub(super) fn is_final(&self) -> bool {
        self.solved.as_ref().is_some_and(|s| s.divisor == self.session.parameters.divisor && Self::same_question(&s.session, &self.session))
    }

    /// Stops what is being solved. It answers no more, whatever its thread still does.
    pub(super) fn cancel(&mut self) {
        if let Some(running) = self.running.take() {
            running.stop.store(true, Ordering::Relaxed);
        }
        self.waiting = None;
        self.estimate = None;
    }

    /// Solves as soon as it can be.
    pub(super) fn solve(&mut self) {
        self.cancel();
        self.waiting = Some(0.0);
    }

    fn start(&mut self) {
        self.waiting = None;
        if let Some(running) = self.running.take() {
            running.stop.store(true, Ordering::Relaxed);
        }
        self.serial += 1;
        let stop = Arc::new(AtomicBool::new(false));
        let session = self.session.clone();
        self.running = Some(Running {
            serial: self.serial,
            stop: stop.clone(),
            stage: "reading frames".into(),
            fraction: 0.0,
            divisor: 1,
            began: Instant::now(),
            session: session.clone(),
        });
        self.messages.retain(|m| !m.passing);
        self.workers.solve(Request { serial: self.serial, session, noted: self.noted(), stop });
    }

    fn hear(&mut self, news: News, ctx: &egui::Context) {
        let current = |s: u64, running: &Option<Running>| running.as_ref().is_some_and(|r| r.serial == s);
        match news {
            News::Thumbnail(path, found) => {
                let found = found.map(|t| {
                    let Thumbnail { picture, size, exposure_time } = *t;
                    let (w, h) = (picture.width() as usize, picture.height() as usize);
                    let pixels = egui::ColorImage::from_rgba_unmultiplied([w, h], picture.as_raw());
                    let texture = ctx.load_texture(path.to_string_lossy(), pixels, egui::TextureOptions::LINEAR);
                    Thumb { texture, size, exposure_time }
                });
                if let Err(text) = &found {
                    self.say(text.clone(), true, None);
                }
                self.thumbs.insert(path, found);
            }
            News::Ready(serial, ready) => {
                // Even when it was stopped meanwhile: the frames are these.
                if serial == self.serial {
                    if self.ready.as_ref().is_none_or(|r| !Arc::ptr_eq(r, &ready)) {
                        self.forget_pictures();
                    }
                    self.ready = Some(ready);
                }
            }
            News::Progress { serial, stage, fraction, divisor } => {
                if let Some(running) = self.running.as_mut().filter(|r| r.serial == serial) {
                    if running.divisor != divisor || fraction < running.fraction {
                        running.began = Instant::now();
                    }
                    (running.stage, running.fraction, running.divisor) = (stage, fraction, divisor);
                    self.heard += 1;
                }
            }
            News::Warning(serial, text) => {
                if current(serial, &self.running) {
                    self.say_of_solution(text, false, None);
                }
            }
            News::Estimate(serial, estimate) => {
                // Smaller than what is shown already, it would be a step back.
                let (w, known) = (estimate.width, self.solved.as_ref().map_or(0, |s| s.bracket.size().0));
                if current(serial, &self.running) && w >= known {
                    self.estimate = Some(estimate);
                    self.heard += 1;
                }
            }
            News::Solved(serial, solved) => {
                if let Some(running) = self.running.as_mut().filter(|r| r.serial == serial) {
                    (running.fraction, running.began) = (0.0, Instant::now());
                    self.solved = Some(solved);
                    self.estimate = None;
                    self.solutions += 1;
                    self.overlays.clear();
                    self.asked_overlays.clear();
                }
            }
            News::Ended(serial, failure) => {
                if current(serial, &self.running) {
                    self.running = None;
                    self.estimate = None;
                    if let Some(failure) = failure {
                        let offer = match &failure {
                            Failure::OutOfMemory(_) => Some(Offer::Smaller(2 * self.session.parameters.divisor)),
                            Failure::Lost(_) => Some(Offer::Reopen),
                            Failure::Other(_) => None,
                        };
                        self.say_of_solution(failure.text().to_string(), true, offer);
                    }
                }
            }
            News::Frame(i, picture) => {
                self.frames.insert(i, picture);
            }
            News::Overlay(key, overlay) => {
                if self.asked_overlays.contains(&key) {
                    self.overlays.insert(key, overlay);
                }
            }
            News::Toned(Ok(toned)) => {
                self.tones.retain(|t| t.of != toned.of);
                self.tones.push(toned);
            }
            News::Toned(Err(text)) => self.say_of_solution(text, true, None),
            News::Written(outcome) => {
                self.form.busy = false;
                self.form.last = Some(outcome.map_err(|text| words::in_window(&text)));
            }
            News::Chosen(Chosen::Open(files)) => self.open(files),
            News::Chosen(Chosen::Add(files)) => self.add(files),
            News::Chosen(Chosen::Session(path)) => self.save_to(&path),
            News::Chosen(Chosen::Export(path)) => self.form.path = path.display().to_string(),
        }
    }

    pub(super) fn save_to(&mut self, path: &Path) {
        match self.session.save(path) {
            Ok(()) => {
                self.saved = Some(path.to_path_buf());
                self.recent.add(vec![path.to_path_buf()]);
            }
            Err(e) => self.say(e.to_string(), true, None),
        }
    }

    /// The picture of a source, as far as it is there; asked for where it is not.
    fn picture(&mut self, source: Source) -> Option<Picture> {
        let ready = self.ready.clone()?;
        match source {
            Source::Merge => Some(ready.merge.clone()),
            Source::Result => {
                if let Some(e) = &self.estimate {
                    let place = Place::padded(e.width, e.height, e.pad);
                    return Some(Picture { planes: e.planes.clone(), place, version: self.heard });
                }
                Some(self.solved.as_ref().map_or_else(|| ready.merge.clone(), |s| s.picture.clone()))
            }
            Source::Frame(i) => {
                if i < ready.opened.bracket.frames().len() && self.asked_frames.insert(i) {
                    self.workers.frame(ready, i);
                }
                self.frames.get(&i).cloned()
            }
        }
    }

    fn overlay_picture(&mut self) -> Option<(Overlay, u32)> {
        let ((kind, code), solved) = (self.over.kind()?, self.solved.clone()?);
        let frame = if kind == OverlayKind::AllClipped { 0 } else { self.frame };
        let key = (kind, frame, self.solutions, solved.divisor);
        if self.asked_overlays.insert(key) {
            self.workers.overlay(key, solved);
        }
        self.overlays.get(&key).map(|o| (o.clone(), code))
    }

    /// The light that the automatic exposure looks at.
    pub(super) fn light(&self) -> Option<Light> {
        self.solved.as_ref().map(|s| s.light).or(self.ready.as_ref().map(|r| r.light))
    }

    /// Size of the full frame in pixels.
    pub(super) fn size(&self) -> Option<Vec2> {
        let (w, h) = self.ready.as_ref()?.opened.bracket.size();
        Some(Vec2::new(w as f32, h as f32))
    }

    fn shown(&mut self, background: f32) -> Option<Shown> {
        let ready = self.ready.clone()?;
        let operator = Operator::parse(&self.session.look.words()).unwrap_or_default();
        let light = self.light()?;
        let local = operator.curve(&light).is_none();
        if !local {
            self.plain = operator.clone();
        }
        // Until the other is there.
        let curve = self.plain.curve(&light)?;
        let overlay = self.overlay_picture();
        // Half precision is finest about 1.
        let (m, unit) = (&ready.opened.to_display, ready.light.middle);
        let column = |c: usize| [m[0][c], m[1][c], m[2][c], 0.0].map(|v| v as f32 / unit);
        let matrix = [column(0), column(1), column(2)];
        let pictures = [self.before, self.after].map(|source| self.picture(source));
        self.toning = local.then(|| self.tone(&operator, &pictures, &ready)).flatten();
        let sides = pictures.map(|picture| {
            let picture = picture?;
            // Toned with other parameters it is still closer than what treats all pixels alike.
            let toned = self.tones.iter().find(|t| local && t.of == picture && t.operator.name() == operator.name());
            Some(match toned {
                Some(toned) => Side { picture: toned.picture.clone(), matrix: SAME, curve: 2 },
                None => Side { picture, matrix, curve: u32::from(curve.filmic) },
            })
        });
        let params = DisplayParams {
            gain: curve.gain * unit,
            white: curve.white,
            saturation: curve.saturation,
            overlay_kind: overlay.as_ref().map_or(0, |o| o.1),
            extremes: self.extremes,
            background,
            ..DisplayParams::default()
        };
        Some(Shown { params, sides, overlay: overlay.map(|o| o.0) })
    }

    /// Asks for those of `pictures` that are not toned by `operator` yet; says so where there are any.
    fn tone(&mut self, operator: &Operator, pictures: &[Option<Picture>; 2], ready: &Ready) -> Option<String> {
        let shown: Vec<&Picture> = pictures.iter().flatten().collect();
        self.tones.retain(|t| shown.contains(&&t.of));
        // What the solver works on is another before it could be toned.
        let (still, changing): (Vec<&Picture>, Vec<&Picture>) = shown.into_iter().partition(|p| p.version == 0);
        let done = |p: &Picture| self.tones.iter().any(|t| t.of == *p && t.operator == *operator);
        let mut wanted: Vec<Picture> = still.into_iter().filter(|p| !done(p)).cloned().collect();
        wanted.dedup();
        let name = operator.name();
        if wanted.is_empty() {
            return (!changing.is_empty()).then(|| format!("{name} follows when it is solved; until then {}", self.plain.name()));
        }
        let asked = self.asked_tones.as_ref().is_some_and(|a| a.operator == *operator && wanted.iter().all(|p| a.pictures.contains(p)));
        if !asked {
            let toning = Toning { operator: operator.clone(), pictures: wanted, to_display: ready.opened.to_display };
            self.asked_tones = Some(toning.clone());
            self.workers.tone(toning);
        }
        Some(format!("{name} is being computed ..."))
    }

    pub(super) fn source_name(&self, source: Source) -> String {
        match source {
            Source::Merge => "Plain merge".into(),
            Source::Result if self.solved.is_none() && self.estimate.is_none() => "Plain merge (not solved yet)".into(),
            Source::Result => {
                let (w, full) = (self.solved.as_ref().map_or(0, |s| s.bracket.size().0), self.size().map_or(0, |s| s.x as usize));
                let now = self.estimate.as_ref().map_or(w, |e| e.width);
                let solving = if self.estimate.is_some() { ", being solved" } else { "" };
                if now < full { format!("Result at 1/{} of the size{solving}", full / now.max(1)) } else { format!("Result{solving}") }
            }
            Source::Frame(i) => format!("Frame {}", i + 1),
        }
    }

    fn act(&mut self, action: Action, ui: &egui::Ui, layout: Option<canvas::Layout>) {
        let ctx = ui.ctx();
        let frames = self.session.shots.len();
        match action {
            Action::Open => export::choose_frames(self, false),
            Action::Save => export::save(self),
            Action::Export => self.form.open = !self.form.open,
            Action::CopyCommand => ctx.copy_text(self.session.command_line(&self.noted(), Path::new(&self.form.path))),
            Action::Undo => {
                if let Some(state) = self.history.undo(&self.session) {
                    self.restore(state, ctx);
                }
            }
            Action::Redo => {
                if let Some(state) = self.history.redo(&self.session) {
                    self.restore(state, ctx);
                }
            }
            Action::Solve => self.solve(),
            Action::Cancel => {
                if self.help || self.form.open {
                    (self.help, self.form.open) = (false, false);
                } else {
                    self.cancel();
                }
            }
            Action::Fit => self.view.zoom = None,
            Action::Actual => {
                if let Some(layout) = layout {
                    self.view.zoom_by(1.0 / (ctx.pixels_per_point() * layout.zoom), layout.rect.center(), &layout);
                }
            }
            Action::ZoomIn | Action::ZoomOut => {
                if let Some(layout) = layout {
                    let factor = if action == Action::ZoomIn { 1.5 } else { 1.0 / 1.5 };
                    self.view.zoom_by(factor, layout.rect.center(), &layout);
                }
            }
            Action::Divide => self.view.divided = !self.view.divided,
            Action::Blur => self.blur.open = !self.blur.open,
            Action::Overlay => {
                let at = Over::ALL.iter().position(|o| *o == self.over).unwrap_or(0);
                self.over = Over::ALL[(at + 1) % Over::ALL.len()];
            }
            Action::Extremes => self.extremes = !self.extremes,
            Action::Brighter => self.session.look.exposure = (self.session.look.exposure + 0.5).min(10.0),
            Action::Darker => self.session.look.exposure = (self.session.look.exposure - 0.5).max(-10.0),
            Action::Next if frames > 0 => self.choose((self.frame + 1) % frames),
            Action::Previous if frames > 0 => self.choose((self.frame + frames - 1) % frames),
            Action::Exclude if self.frame < frames => {
                let shot = &mut self.session.shots[self.frame];
                shot.excluded = !shot.excluded;
            }
            Action::Sharp if self.frame < frames => {
                let shot = &mut self.session.shots[self.frame];
                shot.sharp = !shot.sharp;
            }
            Action::Next | Action::Previous | Action::Exclude | Action::Sharp => {}
            Action::Theme => {
                ctx.set_theme(if ctx.theme() == egui::Theme::Dark { egui::Theme::Light } else { egui::Theme::Dark });
            }
            Action::Help => self.help = !self.help,
        }
    }

    /// Goes to a state of the history.
    fn restore(&mut self, state: Session, ctx: &egui::Context) {
        let question = !Self::same_question(&state, &self.session);
        self.session = state;
        self.typed.clear();
        self.frame = self.frame.min(self.session.shots.len().saturating_sub(1));
        if question && self.live {
            self.waiting = Some(ctx.input(|i| i.time));
        }
    }

    /// Chooses frame `i`: for overlays, the blur view, and the left of the divider where that shows a frame.
    pub(super) fn choose(&mut self, i: usize) {
        self.frame = i;
        if matches!(self.before, Source::Frame(_)) {
            self.before = Source::Frame(i);
        }
    }

    /// Keeps the session for the window that is opened instead.
    fn reopen(&mut self, ctx: &egui::Context) {
        self.cancel();
        let mut kept = self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        kept.session = Some((self.session.clone(), self.saved.clone()));
        kept.losses += 1;
        if kept.losses > LOSSES {
            kept.failed =
                Some("the GPU was lost again and again; update its driver or choose the CPU adapter (WGPU_ADAPTER_NAME=llvmpipe)".into());
        }
        kept.again = true;
        ctx.send_viewport_cmd(egui::ViewportCommand::Close);
    }

    fn offer(&mut self, offer: Offer, ctx: &egui::Context) {
        match offer {
            Offer::Smaller(divisor) => self.session.parameters.divisor = divisor,
            Offer::Reopen => self.reopen(ctx),
        }
    }

    /// Floats over the upper edge of the view `rect`, which stays where it is.
    fn show_messages(&mut self, ui: &egui::Ui, rect: egui::Rect) {
        if self.messages.is_empty() {
            return;
        }
        // Below what names the pictures.
        let place = rect.shrink2(Vec2::new(8.0, 0.0)).with_min_y(rect.top() + 44.0);
        let area = egui::Area::new(egui::Id::unique("messages")).fixed_pos(place.min).constrain_to(rect);
        area.show(ui.ctx(), |ui| {
            ui.set_width(place.width());
            self.messages_in(ui);
        });
    }

    fn messages_in(&mut self, ui: &mut egui::Ui) {
        let (mut gone, mut offered) = (None, None);
        for (i, message) in self.messages.iter().enumerate() {
            let (fill, sign) =
                if message.error { (Color32::from_rgb(120, 28, 28), "Error") } else { (Color32::from_rgb(104, 74, 8), "Note") };
            egui::Frame::new().fill(fill).inner_margin(6).corner_radius(4).show(ui, |ui| {
                ui.horizontal(|ui| {
                    ui.label(RichText::new(sign).strong().color(Color32::WHITE));
                    ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                        if ui.button("Dismiss").clicked() {
                            gone = Some(i);
                        }
                        if let Some(offer) = message.offer {
                            let text = match offer {
                                Offer::Smaller(d) => format!("Solve at 1/{d} of the size"),
                                Offer::Reopen => "Open the GPU again".into(),
                            };
                            if ui.button(text).clicked() {
                                offered = Some((i, offer));
                            }
                        }
                        ui.with_layout(egui::Layout::left_to_right(egui::Align::Center), |ui| {
                            ui.add(egui::Label::new(RichText::new(&message.text).color(Color32::WHITE)).wrap());
                        });
                    });
                });
            });
        }
        if let Some((i, offer)) = offered {
            self.messages.remove(i);
            self.offer(offer, ui.ctx());
        } else if let Some(i) = gone {
            self.messages.remove(i);
        }
    }

    fn main_view(&mut self, ui: &mut egui::Ui) -> Option<canvas::Layout> {
        let (rect, response) = ui.allocate_exact_size(ui.available_size(), egui::Sense::click_and_drag());
        response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, "Main view"));
        let dark = ui.visuals().dark_mode;
        let background = if dark { Color32::from_gray(18) } else { Color32::from_gray(200) };
        let Some(size) = self.size() else {
            ui.painter().rect_filled(rect, 0.0, background);
            let text = if self.session.shots.is_empty() {
                "Drop the frames of a bracket here, or open them (Ctrl+O)".to_string()
            } else {
                self.lacking().unwrap_or_else(|| "Reading the frames ...".into())
            };
            ui.painter().text(
                rect.center(),
                egui::Align2::CENTER_CENTER,
                text,
                egui::FontId::proportional(18.0),
                ui.visuals().text_color(),
            );
            return None;
        };
        let layout = self.view.layout(rect, size);
        let over_patch = self.blur.open && blur::wants_pointer(self, ui, &response, &layout);
        self.view.listen(ui, &response, &layout, !over_patch);
        let layout = self.view.layout(rect, size);
        self.probe = response.hover_pos().map(|p| layout.to_frame(p)).and_then(|q| {
            let inside = q.x >= 0.0 && q.y >= 0.0 && q.x < size.x && q.y < size.y;
            inside.then_some((q.x as usize, q.y as usize))
        });
        match self.shown(f32::from(background.r()) / 255.0) {
            Some(shown) => {
                let split = if self.view.divided { self.view.split } else { 0.0 };
                canvas::draw(ui, &layout, size, split, shown);
            }
            None => drop(ui.painter().rect_filled(rect, 0.0, background)),
        }
        if self.blur.open {
            blur::over_picture(self, ui, &response, &layout);
        }
        if self.view.divided {
            self.view.divider(ui, rect);
            canvas::tag(ui, rect, egui::Align2::LEFT_TOP, &self.source_name(self.before));
        }
        canvas::tag(ui, rect, egui::Align2::RIGHT_TOP, &self.source_name(self.after));
        if let Some(sign) = &self.toning {
            let place = canvas::tag(ui, rect, egui::Align2::RIGHT_BOTTOM, sign);
            let response = ui.interact(place, ui.scope_id().with("toning"), egui::Sense::hover());
            response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Label, true, sign));
        }
        Some(layout)
    }

    /// What of the session changed, in words by which edits are told apart.
    fn what_changed(a: &Session, b: &Session) -> &'static str {
        let p = (&a.parameters, &b.parameters);
        match () {
            () if a.shots != b.shots => "frames",
            () if a.patches != b.patches => "patches",
            () if p.0.lambda != p.1.lambda => "lambda",
            () if p.0.robust != p.1.robust => "robust",
            () if p.0.alpha != p.1.alpha => "alpha",
            () if p.0.psf_radius != p.1.psf_radius => "psf radius",
            () if p.0 != p.1 => "parameters",
            () if a.look.exposure != b.look.exposure => "exposure",
            () if a.look.saturation != b.look.saturation => "saturation",
            () if a.look.key != b.look.key => "key",
            () => "look",
        }
    }

    /// Edits since `before` go into the history and to the solver.
    fn note_edits(&mut self, before: Session, now: f64) {
        if before == self.session {
            return;
        }
        let question = !Self::same_question(&before, &self.session);
        let about = Self::what_changed(&before, &self.session);
        // Marks are single clicks: each is an edit of its own.
        let about = if about == "frames" || about == "patches" { format!("{about} {now}") } else { about.to_string() };
        self.history.edited(before, &about, now);
        if question && self.live {
            self.waiting = Some(now);
        }
    }

    /// Saves the picture of the window that has arrived, and asks for one when everything is there.
    fn take_screenshot(&mut self, ctx: &egui::Context) {
        let Some(path) = self.screenshot.clone() else { return };
        let taken = self.taken.lock().unwrap_or_else(std::sync::PoisonError::into_inner).take();
        if let Some(taken) = taken {
            let pixels: Vec<u8> = taken.pixels.iter().flat_map(|p| [p.r(), p.g(), p.b()]).collect();
            let size = taken.size;
            let saved = image::RgbImage::from_raw(size[0] as u32, size[1] as u32, pixels)
                .ok_or_else(|| "the picture of the window is not whole".to_string())
                .and_then(|p| {
                    let output = crate::io::output::Output::check(&path, true).map_err(|e| e.to_string())?;
                    output.stage_png(&p).and_then(|s| s.commit()).map_err(|e| e.to_string())
                });
            if let Err(text) = saved {
                self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner).failed = Some(text);
            }
            self.screenshot = None;
            ctx.send_viewport_cmd(egui::ViewportCommand::Close);
            return;
        }
        let done = self.looked_at() && !self.is_busy() && (self.is_final() || self.messages.iter().any(|m| m.error));
        self.settled = if done { self.settled + 1 } else { 0 };
        // Pictures that the first frame asks for have time to come.
        if self.settled == 12 {
            let (place, again) = (self.taken.clone(), ctx.clone());
            ctx.request_screenshot(move |picture| {
                *place.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(picture);
                again.request_repaint();
            });
        }
        ctx.request_repaint_after(std::time::Duration::from_millis(50));
    }
}

impl eframe::App for App {
    fn clear_color(&self, visuals: &egui::Visuals) -> [f32; 4] {
        visuals.panel_fill.to_normalized_gamma_f32()
    }

    fn logic(&mut self, ctx: &egui::Context, _frame: &mut eframe::Frame) {
        self.think(ctx);
    }

    fn ui(&mut self, ui: &mut egui::Ui, frame: &mut eframe::Frame) {
        self.device.configure_surface(frame, ui.ctx());
        self.show(ui);
    }
}

impl App {
    /// Hears what has happened and asks for what is wanted. Draws nothing.
    pub fn think(&mut self, ctx: &egui::Context) {
        while let Ok(news) = self.inbox.try_recv() {
            self.hear(news, ctx);
        }
        for shot in &self.session.shots {
            if self.asked_thumbs.insert(shot.path.clone()) {
                self.workers.thumbnail(shot.path.clone());
            }
        }
        if self.device.is_lost() {
            self.reopen(ctx);
        }
        let now = ctx.input(|i| i.time);
        if let Some(since) = self.waiting {
            if self.session.shots.is_empty() {
                self.waiting = None;
            } else if self.looked_at() {
                if self.lacking().is_some() {
                    self.waiting = None;
                } else if since == 0.0 || now - since > REST {
                    self.start();
                } else {
                    ctx.request_repaint_after(std::time::Duration::from_millis(100));
                }
            }
        }
        self.take_screenshot(ctx);
    }

    /// Draws the window and hears the user.
    pub fn show(&mut self, ui: &mut egui::Ui) {
        let before = self.session.clone();
        let history = (self.history.can_undo(), self.history.can_redo());
        let dropped: Vec<PathBuf> = ui.input(|i| i.raw.dropped_files.iter().map(|f| f.path().to_path_buf()).collect());
        if !dropped.is_empty() {
            self.add(dropped);
        }
        let actions = shortcuts::pressed(ui.ctx());
        let menu = controls::menu(self, ui, history);
        strip::status(self, ui);
        strip::strip(self, ui);
        controls::panel(self, ui);
        let layout = egui::CentralPanel::default()
            .frame(egui::Frame::new())
            .show(ui, |ui| {
                let rect = ui.available_rect_before_wrap();
                let layout = self.main_view(ui);
                self.show_messages(ui, rect);
                layout
            })
            .inner;
        export::window(self, ui.ctx());
        let mut help = self.help;
        shortcuts::sheet(ui.ctx(), &mut help);
        self.help = help;
        // What is opened or taken back is no edit.
        let edited = !actions.iter().chain(&menu).any(|a| matches!(a, Action::Undo | Action::Redo));
        for action in actions.into_iter().chain(menu) {
            self.act(action, ui, layout);
        }
        if edited && !before.shots.is_empty() {
            self.note_edits(before, ui.input(|i| i.time));
        }
        if self.running.is_some() {
            // The time left.
            ui.ctx().request_repaint_after(std::time::Duration::from_millis(250));
        }
    }
}
