//! What the window knows and how that changes: what is being edited, what was found of it, and what of that is looked at. The parts of the
//! window show it and change it; it knows none of them, and draws nothing.

use super::canvas::View;
use super::pictures::Pictures;
use super::program::Program;
use super::session::{History, Recent, Session, Shot};
use super::words;
use super::worker::{OverlayKind, Ready, Request, Solved, Workers};
use crate::pipeline::Estimate;
use crate::tonemap::{Light, Operator};
use egui::Vec2;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

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

    /// What the workers call it, and what draws it: see [`crate::kernels::DisplayParams::overlay_kind`].
    pub(super) fn kind(self) -> Option<(OverlayKind, u32)> {
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

/// How the blur view shows what it shows.
pub struct BlurView {
    /// Whether it is open.
    pub open: bool,
    /// Patches and their measured PSFs.
    pub patches: bool,
    /// The grid of PSFs.
    pub grid: bool,
    /// The camera's path at five points.
    pub path: bool,
    /// Times that paths and PSFs are drawn larger than they are.
    pub magnified: f32,
    /// Turn of the plot, radians: about the vertical, and up.
    pub turn: (f32, f32),
}

impl BlurView {
    /// The view, open or not.
    pub fn new(open: bool) -> Self {
        Self { open, patches: true, grid: true, path: false, magnified: 3.0, turn: (0.7, 0.45) }
    }
}

/// All of it.
pub struct State {
    pub(super) program: Arc<dyn Program>,
    pub(super) workers: Workers,

    pub(super) session: Session,
    pub(super) history: History,
    pub(super) saved: Option<PathBuf>,
    pub(super) recent: Recent,
    pub(super) thumbs: HashMap<PathBuf, Result<Thumb, String>>,

    pub(super) serial: u64,
    pub(super) running: Option<Running>,
    /// Since when an edit waits to be solved.
    pub(super) waiting: Option<f64>,
    /// Solve after each edit by itself.
    pub(super) live: bool,
    pub(super) ready: Option<Arc<Ready>>,
    pub(super) solved: Option<Arc<Solved>>,
    pub(super) estimate: Option<Estimate>,
    /// Counts what was heard of the solver: its irradiance is another each time.
    pub(super) heard: u64,
    /// Counts the solutions, for what is derived from them.
    pub(super) solutions: u64,
    pub(super) pictures: Pictures,
    /// The last operator that treats all pixels alike.
    pub(super) plain: Operator,
    /// Says that a toned picture is being computed.
    pub(super) toning: Option<String>,

    pub(super) view: View,
    pub(super) before: Source,
    pub(super) after: Source,
    pub(super) over: Over,
    pub(super) extremes: bool,
    /// The chosen frame.
    pub(super) frame: usize,
    pub(super) blur: BlurView,
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

impl State {
    /// Nothing is open yet.
    pub fn new(program: Arc<dyn Program>, workers: Workers, recent: Recent, blur: bool) -> Self {
        Self {
            program,
            workers,
            session: Session::default(),
            history: History::default(),
            saved: None,
            recent,
            thumbs: HashMap::new(),
            serial: 0,
            running: None,
            waiting: None,
            live: true,
            ready: None,
            solved: None,
            estimate: None,
            heard: 0,
            solutions: 0,
            pictures: Pictures::default(),
            plain: Operator::default(),
            toning: None,
            view: View::default(),
            before: Source::Merge,
            after: Source::Result,
            over: Over::Nothing,
            extremes: false,
            frame: 0,
            blur: BlurView::new(blur),
            form: ExportForm::default(),
            messages: Vec::new(),
            help: false,
            probe: None,
            typed: HashMap::new(),
            typed_response: String::new(),
            typed_memory: String::new(),
        }
    }

    /// Whether something is being solved, or about to be.
    pub fn is_busy(&self) -> bool {
        self.running.is_some() || self.waiting.is_some()
    }

    pub(super) fn say(&mut self, text: impl Into<String>, error: bool, offer: Option<Offer>) {
        self.put(Message { text: text.into(), error, offer, passing: false });
    }

    /// Says what the next solution makes obsolete.
    pub(super) fn say_of_solution(&mut self, text: String, error: bool, offer: Option<Offer>) {
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
        self.typed.clear();
        self.ready = None;
        self.solved = None;
        self.estimate = None;
        self.frame = 0;
        (self.before, self.after, self.over) = (Source::Merge, Source::Result, Over::Nothing);
        self.view = View { divided: self.view.divided, ..View::default() };
        self.pictures.forget();
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
    pub(super) fn looked_at(&self) -> bool {
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

    pub(super) fn start(&mut self) {
        self.waiting = None;
        if let Some(running) = self.running.take() {
            running.stop.store(true, Ordering::Relaxed);
        }
        self.serial += 1;
        let stop = Arc::new(AtomicBool::new(false));
        self.running = Some(Running {
            serial: self.serial,
            stop: stop.clone(),
            stage: "reading frames".into(),
            fraction: 0.0,
            divisor: 1,
            began: Instant::now(),
        });
        self.messages.retain(|m| !m.passing);
        self.workers.solve(Request { serial: self.serial, session: self.session.clone(), noted: self.noted(), stop });
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

    /// The light that the automatic exposure looks at.
    pub(super) fn light(&self) -> Option<Light> {
        self.solved.as_ref().map(|s| s.light).or(self.ready.as_ref().map(|r| r.light))
    }

    /// Size of the full frame in pixels.
    pub(super) fn size(&self) -> Option<Vec2> {
        let (w, h) = self.ready.as_ref()?.opened.bracket.size();
        Some(Vec2::new(w as f32, h as f32))
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

    /// Chooses frame `i`: for overlays, the blur view, and the left of the divider where that shows a frame.
    pub(super) fn choose(&mut self, i: usize) {
        self.frame = i;
        if matches!(self.before, Source::Frame(_)) {
            self.before = Source::Frame(i);
        }
    }

    /// Goes to a state of the history.
    pub(super) fn restore(&mut self, session: Session, now: f64) {
        let question = !Self::same_question(&session, &self.session);
        self.session = session;
        self.typed.clear();
        self.frame = self.frame.min(self.session.shots.len().saturating_sub(1));
        if question && self.live {
            self.waiting = Some(now);
        }
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
    pub(super) fn note_edits(&mut self, before: Session, now: f64) {
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
}
