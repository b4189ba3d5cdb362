//! One device for the whole test binary. Without an adapter the tests fail: none is skipped.

use std::sync::OnceLock;
use unshaken::gpu::{self, Gpu, Step};
use unshaken::kernels::{DeviceRgb, Kernels};

/// What every output buffer holds before a kernel that overwrites it.
pub const POISON: f32 = -12345.0;

/// The device.
pub fn gpu() -> &'static Gpu {
    static GPU: OnceLock<Gpu> = OnceLock::new();
    GPU.get_or_init(|| Gpu::new().unwrap_or_else(|e| panic!("the tests need a GPU adapter: {e}")))
}

/// The kernels.
pub fn kernels() -> &'static Kernels {
    static KERNELS: OnceLock<Kernels> = OnceLock::new();
    KERNELS.get_or_init(|| Kernels::new(gpu()))
}

/// The device, and the kernels, as a software rasteriser's and as a GPU's: designs and kinds of scratch that only one of them would use.
pub fn kinds() -> &'static [(Gpu, Kernels); 2] {
    static KINDS: OnceLock<[(Gpu, Kernels); 2]> = OnceLock::new();
    KINDS.get_or_init(|| {
        [true, false].map(|software| {
            let gpu = gpu().treated_as(software);
            let kernels = Kernels::new(&gpu);
            (gpu, kernels)
        })
    })
}

/// A buffer that holds `values`.
pub fn buffer(values: &[f32]) -> wgpu::Buffer {
    gpu().upload("test", values).expect("finite values that fit")
}

/// Three buffers.
pub fn planes(values: &[Vec<f32>; 3]) -> DeviceRgb {
    values.each_ref().map(|v| buffer(v))
}

/// A buffer of `count` values that a kernel has to overwrite.
pub fn poisoned(count: usize) -> wgpu::Buffer {
    buffer(&vec![POISON; count])
}

pub fn run(steps: &[Step]) {
    gpu().submit(steps);
}

/// The first `count` values of a buffer.
pub fn read(buffer: &wgpu::Buffer, count: usize) -> Vec<f32> {
    gpu::read(gpu(), buffer, count).expect("the device answers")
}
