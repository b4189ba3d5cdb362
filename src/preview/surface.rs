//! The window's surface on a device that the solver uses as well.

use crate::gpu::Gate;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// What wgpu says when it cannot configure a surface because another thread has submitted something in the meantime.
const BUSY: &str = "wait for GPU to come idle before reconfiguring the Surface";

/// Configures the window's surface again where that was refused while the solver submitted: a new size, most often.
pub struct Surface {
    refused: Arc<AtomicBool>,
    gate: Arc<Gate>,
    /// The window's frame for which the gate was shut.
    held: Option<u64>,
}

impl Surface {
    /// Hears what `device` refuses. Any other of its errors is the program's own and ends it, as without this.
    pub fn on(device: &wgpu::Device, context: &egui::Context) -> Self {
        let refused = Arc::new(AtomicBool::new(false));
        let (flag, ctx) = (refused.clone(), context.clone());
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            assert!(error.to_string().contains(BUSY), "wgpu error: {error}");
            flag.store(true, Ordering::Relaxed);
            ctx.request_repaint();
        }));
        Self { refused, gate: Arc::default(), held: None }
    }

    /// What the solver's submissions pass.
    pub fn gate(&self) -> &Arc<Gate> {
        &self.gate
    }

    /// Before each frame of the window: where the surface was refused, the solver is held back for this frame and the surface marked to
    /// be configured before it is painted.
    pub fn configure(&mut self, frame: &mut eframe::Frame, context: &egui::Context) {
        let now = context.cumulative_frame_nr();
        if self.refused.swap(false, Ordering::Relaxed) {
            self.gate.shut();
            self.held = Some(now);
            // Only a configuration that differs is applied; the number of frames in the queue makes no visible difference.
            if let Some(mut config) = frame.wgpu_surface_config() {
                config.desired_maximum_frame_latency = if config.desired_maximum_frame_latency == Some(1) { Some(2) } else { Some(1) };
                frame.set_wgpu_surface_config(config);
            }
            context.request_repaint();
        } else if self.held.take_if(|held| *held != now).is_some() {
            self.gate.open();
        }
    }
}
