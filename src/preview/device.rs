//! What the device says that window and solver share: that it is lost, or could not configure the window's surface.

use crate::gpu::Gate;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// What wgpu says when it cannot configure a surface because another thread has submitted something in the meantime.
const BUSY: &str = "wait for GPU to come idle before reconfiguring the Surface";
/// What it says of anything that was made on a lost device, or with something that could not be made.
const CONSEQUENCE: &str = "is invalid";

/// Hears the device. Configures the window's surface again where that was refused while the solver submitted: for a new size, most often.
pub struct Device {
    device: wgpu::Device,
    lost: Arc<AtomicBool>,
    told: bool,
    refused: Arc<AtomicBool>,
    gate: Arc<Gate>,
    /// The window's frame for which the gate was shut.
    held: Option<u64>,
}

impl Device {
    /// Listens to `device`. Errors that are no consequence of others are the program's own and end it.
    pub fn heard(device: &wgpu::Device, context: &egui::Context) -> Self {
        let (lost, refused) = (Arc::<AtomicBool>::default(), Arc::<AtomicBool>::default());
        let (flag, ctx) = (lost.clone(), context.clone());
        device.set_device_lost_callback(move |_, _| {
            flag.store(true, Ordering::Relaxed);
            ctx.request_repaint();
        });
        let (flag, gone, ctx) = (refused.clone(), lost.clone(), context.clone());
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let text = error.to_string();
            if text.contains(BUSY) {
                flag.store(true, Ordering::Relaxed);
                ctx.request_repaint();
            } else if !gone.load(Ordering::Relaxed) {
                assert!(text.contains(CONSEQUENCE), "wgpu error: {text}");
                // Of a lost device whose loss has not been told yet, most likely; if nothing else follows, this says what is wrong.
                eprintln!("wgpu: {text}");
            }
        }));
        Self { device: device.clone(), lost, told: false, refused, gate: Arc::default(), held: None }
    }

    /// What the solver's submissions pass.
    pub fn gate(&self) -> &Arc<Gate> {
        &self.gate
    }

    /// Whether the device is lost; told once.
    pub fn is_lost(&mut self) -> bool {
        // Of a device that nobody submits to any more this is how the callback comes; what it answers is the callback's to say.
        let _ = self.device.poll(wgpu::PollType::Poll);
        self.lost.load(Ordering::Relaxed) && !std::mem::replace(&mut self.told, true)
    }

    /// Before each frame of the window: where the surface was refused, the solver is held back for this frame and the surface marked to
    /// be configured before it is painted.
    pub fn configure_surface(&mut self, frame: &mut eframe::Frame, context: &egui::Context) {
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
