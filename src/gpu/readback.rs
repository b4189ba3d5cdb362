//! Buffers back to the host: the only place that waits for the device.

use super::Gpu;
use crate::error::{Error, Result};
use std::sync::mpsc;
use std::time::Duration;

/// Longest wait for the device. A software rasteriser on two cores needs tens of seconds for the largest submissions.
pub(super) const TIMEOUT: Duration = Duration::from_secs(600);

/// The first `count` values of `buffer`, after everything submitted so far.
///
/// # Errors
/// [`Error::DeviceLost`] when the device is lost or does not answer within ten minutes.
pub fn read(gpu: &Gpu, buffer: &wgpu::Buffer, count: usize) -> Result<Vec<f32>> {
    let bytes = (count * 4) as u64;
    let staging = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("readback"),
        size: bytes,
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, bytes);
    let index = gpu.pass(Some(encoder.finish()));
    let (sender, receiver) = mpsc::channel();
    staging.map_async(wgpu::MapMode::Read, .., move |r| {
        // The receiver is gone only when the wait below has failed already.
        let _ = sender.send(r);
    });
    gpu.device
        .poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: Some(TIMEOUT) })
        .map_err(|e| Error::DeviceLost(e.to_string()))?;
    receiver.recv_timeout(TIMEOUT).map_err(|e| Error::DeviceLost(e.to_string()))?.map_err(|e| Error::DeviceLost(e.to_string()))?;
    let view = staging.get_mapped_range(..).map_err(|e| Error::DeviceLost(e.to_string()))?;
    Ok(bytemuck::pod_collect_to_vec(&view))
}
