//! The window: hears the workers and the device, draws its parts, and does what the user asks, once per frame.

use super::blur::Drawn;
use super::canvas::{Canvas, Layout};
use super::device::Device;
use super::program::Program;
use super::session::{Recent, Session};
use super::shortcuts::{self, Action};
use super::state::{Offer, Over, Running, State, Thumb};
use super::worker::{Chosen, Failure, News, Solved, Thumbnail, Workers};
use super::{controls, export, main_view, messages, strip, words};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
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
    /// How often the device was lost since anything was solved.
    pub losses: usize,
}

/// Devices that may be lost one after the other before it is no use.
const LOSSES: usize = 3;
/// Seconds after an edit that the solver waits for the next.
const REST: f64 = 0.35;

/// How the window starts.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Frames, or one session file.
    pub files: Vec<PathBuf>,
    /// Save a picture of the window here once the full-size solution is shown, and close it.
    pub screenshot: Option<PathBuf>,
    /// Window in points; `None`: the usual size.
    pub size: Option<(f32, f32)>,
    /// Begin with the blur.
    pub blur: bool,
    /// Light instead of what the system says.
    pub light: Option<bool>,
    /// Where recent files are remembered; `None`: nowhere.
    pub recent: Option<PathBuf>,
}

/// Takes in what was heard.
fn hear(state: &mut State, news: News, ctx: &egui::Context) {
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
                state.say(text.clone(), true, None);
            }
            state.thumbs.insert(path, found);
        }
        News::Ready(serial, ready) => {
            // Even when it was stopped meanwhile: the frames are these.
            if serial == state.serial {
                if state.ready.as_ref().is_none_or(|r| !Arc::ptr_eq(r, &ready)) {
                    state.pictures.forget();
                }
                state.ready = Some(ready);
            }
        }
        News::Progress { serial, stage, fraction, divisor } => {
            if let Some(running) = state.running.as_mut().filter(|r| r.serial == serial) {
                if running.divisor != divisor || fraction < running.fraction {
                    running.began = Instant::now();
                }
                (running.stage, running.fraction, running.divisor) = (stage, fraction, divisor);
                state.heard += 1;
            }
        }
        News::Warning(serial, text) => {
            if current(serial, &state.running) {
                state.say_of_solution(text, false, None);
            }
        }
        News::Estimate(serial, estimate) => {
            // Smaller than what is shown already, it would be a step back.
            let (w, known) = (estimate.width, state.solved.as_ref().map_or(0, |s| s.bracket.size().0));
            if current(serial, &state.running) && w >= known {
                state.estimate = Some(estimate);
                state.heard += 1;
            }
        }
        News::Solved(serial, solved) => {
            if let Some(running) = state.running.as_mut().filter(|r| r.serial == serial) {
                (running.fraction, running.began) = (0.0, Instant::now());
                state.solved = Some(solved);
                state.estimate = None;
                state.solutions += 1;
                state.pictures.forget_overlays();
            }
        }
        News::Ended(serial, failure) => {
            if current(serial, &state.running) {
                state.running = None;
                state.estimate = None;
                if let Some(failure) = failure {
                    let offer = match &failure {
                        Failure::OutOfMemory(_) => Some(Offer::Smaller(2 * state.session.parameters.divisor)),
                        Failure::Lost(_) => Some(Offer::Reopen),
                        Failure::Other(_) => None,
                    };
                    state.say_of_solution(failure.text().to_string(), true, offer);
                }
            }
        }
        News::Frame(of, i, picture) => {
            // Other frames may have been opened since it was asked for.
            if state.ready.as_ref().is_some_and(|ready| Arc::ptr_eq(ready, &of)) {
                state.pictures.hear_frame(i, picture);
            }
        }
        News::Overlay(key, overlay) => state.pictures.hear_overlay(key, overlay),
        News::Toned(Ok(toned)) => state.pictures.hear_toned(toned),
        News::Toned(Err(text)) => state.say_of_solution(text, true, None),
        News::Written(outcome) => {
            state.form.busy = false;
            state.form.last = Some(outcome.map_err(|text| words::in_window(&text)));
        }
        News::Chosen(Chosen::Open(files)) => state.open(files),
        News::Chosen(Chosen::Add(files)) => state.add(files),
        News::Chosen(Chosen::Session(path)) => state.save_to(&path),
        News::Chosen(Chosen::Export(path)) => state.form.path = path.display().to_string(),
    }
}

/// Does what a key or the menu asks; `layout`: where the frame lies.
fn act(state: &mut State, action: Action, ui: &egui::Ui, layout: Option<Layout>) {
    let ctx = ui.ctx();
    let frames = state.session.shots.len();
    match action {
        Action::Open => export::choose_frames(state, false),
        Action::Save => export::save(state),
        Action::Export => state.form.open = !state.form.open,
        Action::CopyCommand => ctx.copy_text(state.session.command_line(&state.noted(), Path::new(&state.form.path))),
        Action::Undo => {
            if let Some(session) = state.history.undo(&state.session) {
                state.restore(session, ctx.input(|i| i.time));
            }
        }
        Action::Redo => {
            if let Some(session) = state.history.redo(&state.session) {
                state.restore(session, ctx.input(|i| i.time));
            }
        }
        Action::Solve => state.solve(),
        Action::Cancel => {
            if state.help || state.form.open {
                (state.help, state.form.open) = (false, false);
            } else {
                state.cancel();
            }
        }
        Action::Fit => state.view.zoom = None,
        Action::Actual => {
            if let Some(layout) = layout {
                state.view.zoom_by(1.0 / (ctx.pixels_per_point() * layout.zoom), layout.rect.center(), &layout);
            }
        }
        Action::ZoomIn | Action::ZoomOut => {
            if let Some(layout) = layout {
                let factor = if action == Action::ZoomIn { 1.5 } else { 1.0 / 1.5 };
                state.view.zoom_by(factor, layout.rect.center(), &layout);
            }
        }
        Action::Divide => state.view.divided = !state.view.divided,
        Action::Blur => state.blur.open = !state.blur.open,
        Action::Overlay => {
            let at = Over::ALL.iter().position(|o| *o == state.over).unwrap_or(0);
            state.over = Over::ALL[(at + 1) % Over::ALL.len()];
        }
        Action::Extremes => state.extremes = !state.extremes,
        Action::Brighter => state.session.look.exposure = (state.session.look.exposure + 0.5).min(10.0),
        Action::Darker => state.session.look.exposure = (state.session.look.exposure - 0.5).max(-10.0),
        Action::Next if frames > 0 => state.choose((state.frame + 1) % frames),
        Action::Previous if frames > 0 => state.choose((state.frame + frames - 1) % frames),
        Action::Exclude if state.frame < frames => {
            let shot = &mut state.session.shots[state.frame];
            shot.excluded = !shot.excluded;
        }
        Action::Sharp if state.frame < frames => {
            let shot = &mut state.session.shots[state.frame];
            shot.sharp = !shot.sharp;
        }
        Action::Next | Action::Previous | Action::Exclude | Action::Sharp => {}
        Action::Theme => {
            ctx.set_theme(if ctx.theme() == egui::Theme::Dark { egui::Theme::Light } else { egui::Theme::Dark });
        }
        Action::Help => state.help = !state.help,
    }
}

/// The window.
pub struct App {
    state: State,
    drawn: Drawn,
    inbox: mpsc::Receiver<News>,
    device: Device,
    kept: Arc<Mutex<Kept>>,
    asked_thumbs: BTreeSet<PathBuf>,
    screenshot: Option<PathBuf>,
    /// The picture of the window, when it has come.
    taken: Arc<Mutex<Option<Arc<egui::ColorImage>>>>,
    /// Frames of the window since there was nothing left to wait for.
    settled: usize,
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
        let mut state = State::new(program, workers, Recent::load(options.recent.clone()), options.blur);
        match session {
            Some((session, saved)) => {
                state.session = session;
                state.saved = saved;
                state.waiting = Some(0.0);
                state.say("the GPU was lost and has been opened again; everything is as it was", false, None);
            }
            None if !options.files.is_empty() => state.open(options.files.clone()),
            None => {}
        }
        Self {
            state,
            drawn: Drawn::default(),
            inbox,
            device,
            kept,
            asked_thumbs: BTreeSet::new(),
            screenshot: options.screenshot.clone(),
            taken: Arc::default(),
            settled: 0,
        }
    }

    /// What the user has said so far.
    pub fn session(&self) -> &Session {
        &self.state.session
    }

    /// The latest solution.
    pub fn solution(&self) -> Option<&Arc<Solved>> {
        self.state.solved.as_ref()
    }

    /// Whether something is being solved, or about to be.
    pub fn is_busy(&self) -> bool {
        self.state.is_busy()
    }

    /// The messages that are shown.
    pub fn texts(&self) -> Vec<&str> {
        self.state.messages.iter().map(|m| m.text.as_str()).collect()
    }

    /// Where the divider is, 0..=1 of the view's width.
    pub fn divider(&self) -> f32 {
        self.state.view.split
    }

    /// Points per pixel of the frame; `None` while the whole frame fits.
    pub fn zoom(&self) -> Option<f32> {
        self.state.view.zoom
    }

    /// Pixel of the full frame under the pointer.
    pub fn probed(&self) -> Option<(usize, usize)> {
        self.state.probe
    }

    /// The overlay that is chosen.
    pub fn overlay(&self) -> Over {
        self.state.over
    }

    /// Keeps the session for the window that is opened instead.
    fn reopen(&mut self, ctx: &egui::Context) {
        self.state.cancel();
        let mut kept = self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        kept.session = Some((self.state.session.clone(), self.state.saved.clone()));
        kept.losses += 1;
        if kept.losses > LOSSES {
            kept.failed =
                Some("the GPU was lost again and again; update its driver or choose the CPU adapter (WGPU_ADAPTER_NAME=llvmpipe)".into());
        }
        kept.again = true;
        ctx.send_viewport_cmd(egui::ViewportCommand::Close);
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
        let done =
            self.state.looked_at() && !self.state.is_busy() && (self.state.is_final() || self.state.messages.iter().any(|m| m.error));
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
            if matches!(news, News::Solved(..)) {
                self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner).losses = 0;
            }
            hear(&mut self.state, news, ctx);
        }
        for shot in &self.state.session.shots {
            if self.asked_thumbs.insert(shot.path.clone()) {
                self.state.workers.thumbnail(shot.path.clone());
            }
        }
        if self.device.is_lost() {
            self.reopen(ctx);
        }
        let now = ctx.input(|i| i.time);
        if let Some(since) = self.state.waiting {
            if self.state.session.shots.is_empty() {
                self.state.waiting = None;
            } else if self.state.looked_at() {
                if self.state.lacking().is_some() {
                    self.state.waiting = None;
                } else if since == 0.0 || now - since > REST {
                    self.state.start();
                } else {
                    ctx.request_repaint_after(std::time::Duration::from_millis(100));
                }
            }
        }
        self.take_screenshot(ctx);
    }

    /// Draws the window and hears the user.
    pub fn show(&mut self, ui: &mut egui::Ui) {
        let before = self.state.session.clone();
        let history = (self.state.history.can_undo(), self.state.history.can_redo());
        let dropped: Vec<PathBuf> = ui.input(|i| i.raw.dropped_files.iter().map(|f| f.path().to_path_buf()).collect());
        if !dropped.is_empty() {
            self.state.add(dropped);
        }
        let actions = shortcuts::pressed(ui.ctx());
        let menu = controls::menu(&mut self.state, ui, history);
        strip::status(&mut self.state, ui);
        strip::strip(&mut self.state, ui);
        controls::panel(&mut self.state, ui);
        let (layout, offer) = egui::CentralPanel::default()
            .frame(egui::Frame::new())
            .show(ui, |ui| {
                let rect = ui.available_rect_before_wrap();
                let layout = main_view::show(&mut self.state, &mut self.drawn, ui);
                (layout, messages::show(&mut self.state, ui, rect))
            })
            .inner;
        match offer {
            Some(Offer::Smaller(divisor)) => self.state.session.parameters.divisor = divisor,
            Some(Offer::Reopen) => self.reopen(ui.ctx()),
            None => {}
        }
        export::window(&mut self.state, ui.ctx());
        let mut help = self.state.help;
        shortcuts::sheet(ui.ctx(), &mut help);
        self.state.help = help;
        // What is opened or taken back is no edit.
        let edited = !actions.iter().chain(&menu).any(|a| matches!(a, Action::Undo | Action::Redo));
        for action in actions.into_iter().chain(menu) {
            act(&mut self.state, action, ui, layout);
        }
        if edited && !before.shots.is_empty() {
            self.state.note_edits(before, ui.input(|i| i.time));
        }
        if self.state.running.is_some() {
            // The time left.
            ui.ctx().request_repaint_after(std::time::Duration::from_millis(250));
        }
    }
}
