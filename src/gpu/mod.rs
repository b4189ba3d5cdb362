//! Device, buffers, dispatch. Knows no image, pose or solver.

mod kernel;
mod readback;

pub use kernel::{Kernel, Step, grid_1d};
pub use readback::read;

use crate::error::{Error, Result};

/// What to install when no adapter is found, per system.
const ADVICE: &str = "Linux: install your GPU's Vulkan driver, or the software one (Debian/Ubuntu: apt-get install mesa-vulkan-drivers libvulkan1; \
Fedora: dnf install mesa-vulkan-drivers; Arch: pacman -S vulkan-swrast); macOS 11+: Metal is built in; Windows: update the graphics driver (DirectX 12)";

/// One adapter as [`list_adapters`] shows it.
#[derive(Clone, Debug)]
pub struct AdapterDescription {
    /// Name, backend, kind and driver in one line.
    pub description: String,
    /// Whether [`Gpu::new`] would use it.
    pub chosen: bool,
}

/// The open device and its queue: the only GPU context there is.
pub struct Gpu {
    /// The device.
    pub device: wgpu::Device,
    /// Its queue.
    pub queue: wgpu::Queue,
    /// Name, backend and driver in one line.
    pub description: String,
}

fn describe(info: &wgpu::AdapterInfo) -> String {
    format!("{} ({:?}, {:?}, {} {})", info.name, info.backend, info.device_type, info.driver, info.driver_info)
}

/// All adapters, best first: real GPUs before software; `WGPU_ADAPTER_NAME` (part of the name) puts its own first.
fn adapters() -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    let mut all = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    let wanted = std::env::var("WGPU_ADAPTER_NAME").unwrap_or_default().to_lowercase();
    all.sort_by_key(|a| {
        let info = a.get_info();
        let named = !wanted.is_empty() && info.name.to_lowercase().contains(&wanted);
        let kind = match info.device_type {
            wgpu::DeviceType::DiscreteGpu => 0,
            wgpu::DeviceType::IntegratedGpu => 1,
            wgpu::DeviceType::VirtualGpu => 2,
            wgpu::DeviceType::Other => 3,
            wgpu::DeviceType::Cpu => 4,
        };
        (!named, kind)
    });
    all
}

/// The adapters of this machine in order of preference.
///
/// # Errors
/// [`Error::Adapter`] when there is none; the message says what to install.
pub fn list_adapters() -> Result<Vec<AdapterDescription>> {
    let all = adapters();
    if all.is_empty() {
        return Err(Error::Adapter(format!("no GPU adapter found. {ADVICE}")));
    }
    Ok(all.iter().enumerate().map(|(i, a)| AdapterDescription { description: describe(&a.get_info()), chosen: i == 0 }).collect())
}

impl Gpu {
    /// Opens the best adapter (see [`list_adapters`]).
    ///
    /// # Errors
    /// [`Error::Adapter`] when there is none or it refuses a device.
    pub fn new() -> Result<Self> {
        let adapter = adapters().into_iter().next().ok_or_else(|| Error::Adapter(format!("no GPU adapter found. {ADVICE}")))?;
        let info = adapter.get_info();
        let available = adapter.limits();
        let limits = wgpu::Limits {
            max_storage_buffer_binding_size: available.max_storage_buffer_binding_size,
            max_buffer_size: available.max_buffer_size,
            ..wgpu::Limits::default()
        };
        let descriptor = wgpu::DeviceDescriptor { label: Some("unshaken"), required_limits: limits, ..Default::default() };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| Error::Adapter(format!("{}: refuses a device ({e}). {ADVICE}", describe(&info))))?;
        Ok(Self { device, queue, description: describe(&info) })
    }

    /// Largest number of `f32` that one storage binding may hold.
    pub fn max_plane(&self) -> usize {
        let limits = self.device.limits();
        (limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) / 4) as usize
    }

    /// A storage buffer of `count` zeros.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] when the buffer is larger than the device allows.
    pub fn plane(&self, label: &str, count: usize) -> Result<wgpu::Buffer> {
        if count > self.max_plane() {
            return Err(Error::OutOfMemory(format!("{label}: {count} values are more than one binding of this adapter holds")));
        }
        Ok(self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: (count.max(2) * 4) as u64,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        }))
    }

    /// A storage buffer that holds `values`.
    ///
    /// # Errors
    /// [`Error::Input`] for NaN or infinity, which no kernel may see; otherwise as [`Gpu::plane`].
    pub fn upload(&self, label: &str, values: &[f32]) -> Result<wgpu::Buffer> {
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            return Err(Error::Input(format!("{label}: value {i} is {}; NaN and infinity are refused", values[i])));
        }
        let buffer = self.plane(label, values.len())?;
        self.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(values));
        Ok(buffer)
    }

    /// A read-only storage buffer that holds `values` of a plain type.
    pub fn table<T: bytemuck::Pod>(&self, label: &str, values: &[T]) -> wgpu::Buffer {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: (bytes.len().max(16).next_multiple_of(4)) as u64,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.queue.write_buffer(&buffer, 0, bytes);
        buffer
    }

    /// A uniform buffer that holds `bytes`.
    pub fn uniform(&self, label: &str, bytes: &[u8]) -> wgpu::Buffer {
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes.len() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.queue.write_buffer(&buffer, 0, bytes);
        buffer
    }

    /// Runs steps and waits for none of them.
    pub fn submit(&self, steps: &[Step]) {
        // A submission is bounded so that a slow driver's watchdog does not fire.
        for part in steps.chunks(4096) {
            let mut encoder = self.device.create_command_encoder(&Default::default());
            kernel::record(part, &mut encoder);
            self.queue.submit([encoder.finish()]);
        }
    }
}
