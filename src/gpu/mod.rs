//! Device, buffers, dispatch. Knows no image, pose or solver.

mod gate;
mod kernel;
mod readback;

pub use gate::Gate;
pub use kernel::{Kernel, Step, grid_1d};
pub use readback::read;

use crate::error::{Error, Result};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

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
    /// Whether the adapter is a software rasteriser: it loads from textures faster than from buffers, and gains nothing by workgroup memory.
    pub software: bool,
    /// Pixels times taps that one dispatch may compute: bounds its time, so that a slow driver's watchdog does not fire.
    pub dispatch_budget: f64,
    /// Most bytes that one binding may hold.
    binding_limit: u64,
    /// Most bytes of planes at a time.
    memory_limit: u64,
    /// Bytes of planes made since [`Gpu::start_count`].
    counted: AtomicU64,
    /// Bytes of uploads since the device was waited for.
    uploading: AtomicU64,
    /// Where others draw on the same device.
    turns: Option<Turns>,
}

/// Small submissions, of which two are under way.
struct Turns {
    /// What they pass.
    gate: Arc<Gate>,
    /// Steps of the next.
    steps: AtomicUsize,
    /// The last, when it was made, and its steps.
    last: Mutex<Option<(wgpu::SubmissionIndex, Instant, usize)>>,
}

/// An array of pixels, which kernels write and read.
pub enum Texels {
    /// On GPUs.
    Buffer(wgpu::Buffer),
    /// On software rasterisers, wrapped at rows of [`TEXEL_ROW`]; see shaders/common/texels.wgsl.
    Texture(wgpu::TextureView),
}

impl Texels {
    /// The array as a kernel's input or output.
    pub fn binding(&self) -> wgpu::BindingResource<'_> {
        match self {
            Self::Buffer(buffer) => buffer.as_entire_binding(),
            Self::Texture(view) => wgpu::BindingResource::TextureView(view),
        }
    }
}

/// Some rows of an image in a buffer, as a dispatch sees them.
pub struct Rows<'a> {
    /// The part of the buffer.
    pub binding: wgpu::BindingResource<'a>,
    /// Row of the image that comes first in it.
    pub first: usize,
}

/// Pixels per row of a texture that holds an array; shaders/common/texels.wgsl shifts by its logarithm.
const TEXEL_ROW: usize = 4096;
/// Workgroup memory that is asked for: with more, fewer workgroups run beside each other (src/kernels/tiles.rs).
const WORKGROUP_BYTES: u32 = 24 << 10;
/// Rows at whose multiples a part of an image may begin: 64 rows of `f32` are a multiple of 256 bytes whatever their length, the
/// alignment that every adapter accepts.
const ROW_STEP: usize = 64;
/// Length of a submission on a device on which others draw. Two are under way at a time, so that the device does not wait for the host.
const TURN: Duration = Duration::from_millis(15);
/// Steps of a submission at least, however long it seems to take: on a busy machine most of that is waiting for a processor.
const FEWEST: usize = 24;
/// Beyond this it is the steps themselves that take long.
const LONG: Duration = Duration::from_millis(250);
/// Bytes up to which memory for small buffers is taken at once. Larger ones have memory of their own: in the blocks of 256 MiB that are usual, two planes of
/// 96 MiB find room and a third does not, so that a plan for 6.1 GB took 8.3.
const MEMORY_BLOCK: u64 = 4 << 20;
/// Bytes of uploads under way at a time: until the device has fetched them they take memory of their own, of the device's where that is mapped.
const UPLOADS: u64 = 64 << 20;
/// [`Gpu::dispatch_budget`] of a software rasteriser: lavapipe on two cores makes about 1e9 pixels times taps per second; 0.4 s.
const BUDGET_CPU: f64 = 4e8;
/// Of a GPU: the slowest integrated ones make about 2e10; 50 ms.
const BUDGET_GPU: f64 = 1e9;

fn describe(info: &wgpu::AdapterInfo) -> String {
    format!("{} ({:?}, {:?}, {} {})", info.name, info.backend, info.device_type, info.driver, info.driver_info)
}

/// All adapters, best first.
fn adapters() -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    let mut all = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    rank(&mut all);
    all
}

/// Orders adapters, best first: real GPUs before software; `WGPU_ADAPTER_NAME` (part of the name) puts its own first.
pub fn rank(all: &mut [wgpu::Adapter]) {
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
}

/// The device that [`Gpu::new`] asks of an adapter, for those who open it themselves and share it by [`Gpu::shared`].
pub fn device_descriptor(adapter: &wgpu::Adapter) -> wgpu::DeviceDescriptor<'static> {
    let available = adapter.limits();
    let limits = wgpu::Limits {
        max_storage_buffer_binding_size: available.max_storage_buffer_binding_size,
        max_buffer_size: available.max_buffer_size,
        max_texture_dimension_2d: available.max_texture_dimension_2d,
        max_compute_workgroup_storage_size: available.max_compute_workgroup_storage_size.min(WORKGROUP_BYTES),
        ..wgpu::Limits::default()
    };
    let memory_hints = wgpu::MemoryHints::Manual { suballocated_device_memory_block_size: MEMORY_BLOCK..MEMORY_BLOCK };
    wgpu::DeviceDescriptor { label: Some("unshaken"), required_limits: limits, memory_hints, ..Default::default() }
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

/// Refuses what no kernel may see.
///
/// # Errors
/// [`Error::Input`], naming `label`, for NaN or infinity.
pub fn finite(label: &str, values: &[f32]) -> Result<()> {
    match values.iter().position(|v| !v.is_finite()) {
        Some(i) => Err(Error::Input(format!("{label}: value {i} is {}; NaN and infinity are refused", values[i]))),
        None => Ok(()),
    }
}

impl Gpu {
    /// Opens the best adapter (see [`list_adapters`]).
    ///
    /// # Errors
    /// [`Error::Adapter`] when there is none or it refuses a device.
    pub fn new() -> Result<Self> {
        let adapter = adapters().into_iter().next().ok_or_else(|| Error::Adapter(format!("no GPU adapter found. {ADVICE}")))?;
        let (device, queue) = pollster::block_on(adapter.request_device(&device_descriptor(&adapter)))
            .map_err(|e| Error::Adapter(format!("{}: refuses a device ({e}). {ADVICE}", describe(&adapter.get_info()))))?;
        Ok(Self::on(&adapter, device, queue))
    }

    fn on(adapter: &wgpu::Adapter, device: wgpu::Device, queue: wgpu::Queue) -> Self {
        let info = adapter.get_info();
        let software = info.device_type == wgpu::DeviceType::Cpu;
        let dispatch_budget = if software { BUDGET_CPU } else { BUDGET_GPU };
        let limits = device.limits();
        let binding_limit = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let description = describe(&info);
        Self {
            device,
            queue,
            description,
            software,
            dispatch_budget,
            binding_limit,
            memory_limit: u64::MAX,
            counted: AtomicU64::new(0),
            uploading: AtomicU64::new(0),
            turns: None,
        }
    }

    /// A device that others draw on as well. Work is submitted in small turns, two at a time, so that what they draw
    /// comes in between, and only while `gate` is open; results are those of [`Gpu::new`].
    pub fn shared(adapter: &wgpu::Adapter, device: wgpu::Device, queue: wgpu::Queue, gate: Arc<Gate>) -> Self {
        let turns = Turns { gate, steps: AtomicUsize::new(FEWEST), last: Mutex::new(None) };
        Self { turns: Some(turns), ..Self::on(adapter, device, queue) }
    }

    /// The same device, used as if it were a software rasteriser or as if it were none: each way of working runs on either.
    pub fn treated_as(&self, software: bool) -> Self {
        Self {
            device: self.device.clone(),
            queue: self.queue.clone(),
            description: self.description.clone(),
            software,
            counted: AtomicU64::new(0),
            uploading: AtomicU64::new(0),
            turns: None,
            ..*self
        }
    }

    /// The same with `bytes` of memory for planes at most, as on an adapter that has no more.
    pub fn with_memory_limit(self, bytes: u64) -> Self {
        Self { memory_limit: bytes, ..self }
    }

    /// Forgets the planes made so far, which whoever made them has given back.
    pub fn start_count(&self) {
        self.counted.store(0, Ordering::Relaxed);
    }

    /// Bytes that the device has given for everything that is alive, where the backend tells (Vulkan and Direct3D 12 do).
    pub fn taken(&self) -> Option<u64> {
        self.device.generate_allocator_report().map(|report| report.total_reserved_bytes)
    }

    /// Bytes of planes made since [`Gpu::start_count`].
    pub fn counted(&self) -> u64 {
        self.counted.load(Ordering::Relaxed)
    }

    /// The same with bindings of at most `bytes`, as on an adapter that allows no more.
    pub fn with_binding_limit(self, bytes: u64) -> Self {
        Self { binding_limit: self.binding_limit.min(bytes), ..self }
    }

    /// Most `f32` that one storage binding may hold.
    pub fn max_binding(&self) -> usize {
        (self.binding_limit / 4) as usize
    }

    /// Most `f32` that workgroup memory may hold.
    pub fn max_workgroup(&self) -> usize {
        (self.device.limits().max_compute_workgroup_storage_size / 4) as usize
    }

    /// Most `f32` that one buffer may hold.
    pub fn max_plane(&self) -> usize {
        (self.device.limits().max_buffer_size / 4) as usize
    }

    /// Whether [`Gpu::rows`] can bind any `rows` consecutive rows of an image of `size` = (width, height) `f32`.
    pub fn rows_fit(&self, rows: usize, size: (usize, usize)) -> bool {
        (rows + ROW_STEP).min(size.1) * size.0 <= self.max_binding()
    }

    /// The rows `rows` of an image of `size` = (width, height) at the start of `buffer`: the whole buffer where one binding holds the image,
    /// else a part that begins at or a little before `rows`, at the same row for all images of this size.
    pub fn rows<'a>(&self, buffer: &'a wgpu::Buffer, size: (usize, usize), rows: std::ops::Range<usize>) -> Rows<'a> {
        let (width, last) = size;
        if width * last <= self.max_binding() {
            let binding =
                if buffer.size() <= self.binding_limit { buffer.as_entire_binding() } else { Self::part(buffer, &(0..width * last)) };
            return Rows { binding, first: 0 };
        }
        let first = rows.start.min(last.saturating_sub(1)) / ROW_STEP * ROW_STEP;
        let end = rows.end.clamp(first + 1, last);
        debug_assert!((end - first) * width <= self.max_binding(), "callers ask rows_fit");
        Rows { binding: Self::part(buffer, &(first * width..end * width)), first }
    }

    /// Bands of `count` rows of which [`Gpu::rows`] can bind each, with `halo` rows more above and below, in an image of at most
    /// `size` = (width, height); where it can bind one row like this ([`Gpu::rows_fit`]).
    pub fn bands(&self, count: usize, halo: usize, size: (usize, usize)) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let mut rows = count.max(1);
        while rows > 1 && !self.rows_fit(rows + 2 * halo, size) {
            rows = rows.div_ceil(2);
        }
        (0..count).step_by(rows).map(move |y| y..(y + rows).min(count))
    }

    /// Parts of `count` values of which one binding each holds, of a multiple of `step` (a power of two, 64 at least) but for the last.
    pub fn parts(&self, count: usize, step: usize) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let most = (self.max_binding() / step * step).max(step);
        (0..count).step_by(most).map(move |i| i..(i + most).min(count))
    }

    /// The values `values` of a buffer, of which the first is a multiple of 64.
    pub fn part<'a>(buffer: &'a wgpu::Buffer, values: &std::ops::Range<usize>) -> wgpu::BindingResource<'a> {
        let size = std::num::NonZero::new(((values.end - values.start) * 4) as u64);
        wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer, offset: (values.start * 4) as u64, size })
    }

    /// A storage buffer of `count` zeros.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] when the buffer is larger than the device allows, or finds no room.
    pub fn plane(&self, label: &str, count: usize) -> Result<wgpu::Buffer> {
        if count > self.max_plane() {
            return Err(Error::OutOfMemory(format!("{label}: {count} values are more than one buffer of this adapter holds")));
        }
        let size = (count.max(2) * 4) as u64;
        self.allocate(label, size, || self.storage(label, size))
    }

    fn storage(&self, label: &str, size: u64) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    /// What `make` makes, of `size` bytes, if there is room for it.
    fn allocate<T>(&self, label: &str, size: u64, make: impl FnOnce() -> T) -> Result<T> {
        let full = || Error::OutOfMemory(format!("{label}: {size} bytes"));
        if self.counted.fetch_add(size, Ordering::Relaxed) + size > self.memory_limit {
            return Err(full());
        }
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let made = make();
        pollster::block_on(scope.pop()).map_or(Ok(made), |_| Err(full()))
    }

    /// Most pixels that [`Gpu::texels`] may hold.
    pub fn max_texels(&self) -> usize {
        if self.software {
            TEXEL_ROW * self.device.limits().max_texture_dimension_2d as usize
        } else {
            self.max_binding() / 4 / TEXEL_ROW * TEXEL_ROW
        }
    }

    /// Bytes of [`Gpu::texels`] of `count` pixels of `channels` channels, one or three: whole rows, and four values where there are three.
    pub fn texel_bytes(count: usize, channels: usize) -> u64 {
        (count.max(1).next_multiple_of(TEXEL_ROW) * if channels > 1 { 16 } else { 4 }) as u64
    }

    /// An array of `count` pixels of `channels` channels, one or three, that kernels write and read: a buffer on GPUs, a storage texture on
    /// software rasterisers.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] when there are more than [`Gpu::max_texels`], or there is no room.
    pub fn texels(&self, label: &str, count: usize, channels: usize) -> Result<Texels> {
        if count > self.max_texels() {
            return Err(Error::OutOfMemory(format!("{label}: {count} pixels are more than this adapter binds at once")));
        }
        let bytes = Self::texel_bytes(count, channels);
        if !self.software {
            return self.allocate(label, bytes, || self.storage(label, bytes)).map(Texels::Buffer);
        }
        let texture = self.allocate(label, bytes, || {
            self.device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: wgpu::Extent3d { width: TEXEL_ROW as u32, height: count.max(1).div_ceil(TEXEL_ROW) as u32, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: if channels > 1 { wgpu::TextureFormat::Rgba32Float } else { wgpu::TextureFormat::R32Float },
                usage: wgpu::TextureUsages::STORAGE_BINDING,
                view_formats: &[],
            })
        })?;
        Ok(Texels::Texture(texture.create_view(&wgpu::TextureViewDescriptor::default())))
    }

    /// A storage buffer that holds `values`.
    ///
    /// # Errors
    /// [`Error::Input`] for NaN or infinity, which no kernel may see; otherwise as [`Gpu::plane`].
    pub fn upload(&self, label: &str, values: &[f32]) -> Result<wgpu::Buffer> {
        finite(label, values)?;
        let buffer = self.plane(label, values.len())?;
        self.write(&buffer, values);
        Ok(buffer)
    }

    /// Puts `values` at the start of `buffer`, in pieces, and waits for the device before more than [`UPLOADS`] are under way.
    fn write(&self, buffer: &wgpu::Buffer, values: &[f32]) {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        for (n, piece) in bytes.chunks(UPLOADS as usize).enumerate() {
            let size = piece.len() as u64;
            if self.uploading.fetch_add(size, Ordering::Relaxed) + size > UPLOADS {
                self.uploading.store(size, Ordering::Relaxed);
                self.wait(self.pass(None));
            }
            self.queue.write_buffer(buffer, n as u64 * UPLOADS, piece);
        }
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
        // A submission is bounded so that a slow driver's watchdog does not fire. Uploads stand between submissions.
        for run in steps.chunk_by(|a, b| matches!(a, Step::Upload(..)) == matches!(b, Step::Upload(..))) {
            let mut rest = run;
            while !rest.is_empty() {
                let (part, later) = rest.split_at(self.turns.as_ref().map_or(1024, |t| t.steps.load(Ordering::Relaxed)).min(rest.len()));
                rest = later;
                let mut encoder = self.device.create_command_encoder(&Default::default());
                kernel::record(part, &mut encoder);
                for step in part {
                    if let Step::Upload(values, buffer) = step {
                        self.write(buffer, values);
                    }
                }
                let index = self.pass(Some(encoder.finish()));
                if let Some(turns) = &self.turns {
                    self.next_turn(turns, part.len(), index);
                }
            }
        }
    }

    fn pass(&self, commands: Option<wgpu::CommandBuffer>) -> wgpu::SubmissionIndex {
        let _held = self.turns.as_ref().map(|t| t.gate.pass());
        self.queue.submit(commands)
    }

    /// Waits for a submission. A device that does not answer is noticed, and told, where results are read.
    fn wait(&self, index: wgpu::SubmissionIndex) {
        let _ = self.device.poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: Some(readback::TIMEOUT) });
    }

    /// Waits for the turn before the one that was just submitted, and makes the next as long as a turn should be.
    fn next_turn(&self, turns: &Turns, steps: usize, index: wgpu::SubmissionIndex) {
        let mut last = turns.last.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let before = last.replace((index, Instant::now(), steps));
        let Some((index, start, steps)) = before else { return };
        self.wait(index);
        let took = start.elapsed();
        let fits = (steps as f64 * TURN.as_secs_f64() / took.as_secs_f64().max(1e-6)) as usize;
        let (now, fewest) = (turns.steps.load(Ordering::Relaxed), if took > LONG { 1 } else { FEWEST });
        turns.steps.store(fits.clamp(now / 2, 2 * now).clamp(fewest, 1024), Ordering::Relaxed);
    }
}
