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
mod main_view;
mod messages;
mod pictures;
mod program;
pub mod session;
pub mod shortcuts;
pub mod state;
pub mod strip;
pub mod words;
pub mod worker;

pub use app::{App, Options};
pub use program::{Opened, Program};
pub use worker::Chosen;

use crate::gpu;
use std::sync::{Arc, Mutex};

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
