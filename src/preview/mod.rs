//! The window: open frames, see, nudge, export. Feature `preview`.
//!
//! It never estimates: it asks the pipeline, hears the same events as the command line, and shows the solver's own planes through
//! [`crate::kernels::Display`] on the device that both share. What is edited ([`session`]) is at any time a command line of `merge`, and
//! goes through the same code; [`Program`] is that code, handed in by whoever opens the window. No engine call runs on the window's thread
//! ([`worker`]).

pub mod app;
pub mod blur;
pub mod canvas;
mod controls;
mod device;
mod export;
pub mod session;
pub mod shortcuts;
pub mod strip;
pub mod words;
pub mod worker;

pub use app::App;

use crate::colour::Matrix;
use crate::exposure::Bracket;
use crate::gpu;
use crate::pipeline::{Event, Outcome, Settings};
use crate::response::Response;
use std::any::Any;
use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

/// Frames as the program read them.
#[derive(Clone)]
pub struct Opened {
    /// The frames.
    pub bracket: Arc<Bracket>,
    /// Their response.
    pub response: Response,
    /// Their linear RGB to Rec. 709.
    pub to_display: Matrix,
    /// Whatever else the program needs to write results.
    pub more: Arc<dyn Any + Send + Sync>,
}

/// `unshaken merge`, without its output on a terminal. Arguments are those of `merge`, without the word itself.
pub trait Program: Send + Sync {
    /// Reads the frames that the arguments name and finds their response.
    ///
    /// # Errors
    /// What `merge` refuses, in its words.
    fn open(&self, arguments: &[OsString], events: &mut dyn FnMut(Event) -> bool) -> anyhow::Result<Opened>;

    /// The settings for frames of full size that the arguments ask for.
    ///
    /// # Errors
    /// What `merge` refuses.
    fn settings(&self, arguments: &[OsString], opened: &Opened) -> anyhow::Result<Settings>;

    /// Writes the outputs that the arguments ask for, of the merge of `bracket`; returns what was written, in words.
    ///
    /// # Errors
    /// As `merge`.
    fn write(
        &self,
        arguments: &[OsString],
        opened: &Opened,
        bracket: &Bracket,
        outcome: &Outcome,
        warnings: &[String],
    ) -> anyhow::Result<String>;
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

/// Title of the window.
const TITLE: &str = "unshaken";

/// The device that the window and the solver share: the adapter and the limits of [`gpu::Gpu::new`].
pub fn setup() -> egui_wgpu::WgpuSetup {
    let mut setup = egui_wgpu::WgpuSetupCreateNew::without_display_handle();
    setup.instance_descriptor.backends = wgpu::Backends::PRIMARY;
    setup.native_adapter_selector = Some(Arc::new(|adapters: &[wgpu::Adapter], surface: Option<&wgpu::Surface<'_>>| {
        let mut able: Vec<wgpu::Adapter> = adapters.iter().filter(|a| surface.is_none_or(|s| a.is_surface_supported(s))).cloned().collect();
        gpu::rank(&mut able);
        able.into_iter().next().ok_or_else(|| "no GPU adapter can draw on this screen; install its driver".into())
    }));
    setup.device_descriptor = Arc::new(|adapter: &wgpu::Adapter| {
        let mut descriptor = gpu::device_descriptor(adapter);
        // Pictures are textures while they are drawn.
        descriptor.required_limits.max_texture_dimension_2d = adapter.limits().max_texture_dimension_2d;
        descriptor
    });
    setup.into()
}

/// Opens the window and returns when it is closed. A device that is lost is opened anew, with the session as it was.
///
/// # Errors
/// When there is no screen, or no adapter that can draw on it.
pub fn run(options: &Options, program: Arc<dyn Program>) -> anyhow::Result<()> {
    let kept: Arc<Mutex<app::Kept>> = Arc::default();
    loop {
        let size = options.size.unwrap_or((1440.0, 900.0));
        let viewport = egui::ViewportBuilder::default()
            .with_title(TITLE)
            .with_app_id(TITLE)
            .with_drag_and_drop(true)
            .with_inner_size([size.0, size.1])
            .with_min_inner_size([640.0, 480.0]);
        let native = eframe::NativeOptions {
            viewport,
            renderer: eframe::Renderer::Wgpu,
            wgpu_options: egui_wgpu::WgpuConfiguration { wgpu_setup: setup(), ..Default::default() },
            ..Default::default()
        };
        let (own, program, keep) = (options.clone(), program.clone(), kept.clone());
        let make = move |context: &eframe::CreationContext<'_>| -> Result<Box<dyn eframe::App>, Box<dyn std::error::Error + Send + Sync>> {
            let render = context.wgpu_render_state.as_ref().ok_or("it has no wgpu device")?;
            Ok(Box::new(App::new(&context.egui_ctx, render, &own, program, keep)))
        };
        eframe::run_native(TITLE, native, Box::new(make))
            .map_err(|e| anyhow::anyhow!("the window cannot be opened ({e}); run it on a desktop, or use 'unshaken merge' without one"))?;
        let mut kept = kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(failed) = kept.failed.take() {
            anyhow::bail!("{failed}");
        }
        if !std::mem::take(&mut kept.again) {
            return Ok(());
        }
    }
}
