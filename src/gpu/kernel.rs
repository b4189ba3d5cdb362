//! A compute pipeline and its dispatches.

use super::Gpu;
use std::sync::Arc;

/// One compiled kernel: binding 0 is its uniform `Params`, buffers and textures follow in order.
pub struct Kernel {
    label: &'static str,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

/// One recorded piece of work: made once, submitted as often as needed.
#[derive(Clone)]
pub enum Step {
    /// A kernel's dispatch.
    Dispatch {
        /// The kernel.
        pipeline: wgpu::ComputePipeline,
        /// Its parameters and buffers.
        bindings: wgpu::BindGroup,
        /// Workgroups.
        groups: [u32; 3],
    },
    /// A buffer's content copied to another of the same size.
    Copy(wgpu::Buffer, wgpu::Buffer),
    /// A buffer filled with zeros.
    Clear(wgpu::Buffer),
    /// Values from the host, to the start of a buffer: what does not stay on the device all the time.
    Upload(Arc<Vec<f32>>, wgpu::Buffer),
}

/// Workgroups for `count` invocations of kernels with 128 lanes, as (per row, rows): one dimension holds 65 535 at most.
pub fn grid_1d(count: usize) -> (u32, u32) {
    let groups = count.div_ceil(128).max(1) as u32;
    let row = groups.min(4096);
    (row, groups.div_ceil(row))
}

impl Kernel {
    /// Compiles `source`, whose entry point is `main`, with values for its `override` constants.
    pub fn new(gpu: &Gpu, label: &'static str, source: &str, constants: &[(&str, f64)]) -> Self {
        let module = gpu
            .device
            .create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Wgsl(source.into()) });
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions { constants, ..Default::default() },
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        Self { label, pipeline, layout }
    }

    /// A dispatch of `groups` workgroups with these parameters and buffers.
    pub fn step<P: bytemuck::Pod>(&self, gpu: &Gpu, params: &P, buffers: &[&wgpu::Buffer], groups: [u32; 3]) -> Step {
        let parts: Vec<_> = buffers.iter().map(|b| b.as_entire_binding()).collect();
        self.step_parts(gpu, params, &parts, groups)
    }

    /// [`Kernel::step`] that sees parts of buffers, or textures.
    pub fn step_parts<P: bytemuck::Pod>(&self, gpu: &Gpu, params: &P, parts: &[wgpu::BindingResource], groups: [u32; 3]) -> Step {
        let uniform = gpu.uniform(self.label, bytemuck::bytes_of(params));
        let entries: Vec<_> = std::iter::once(uniform.as_entire_binding())
            .chain(parts.iter().cloned())
            .enumerate()
            .map(|(i, resource)| wgpu::BindGroupEntry { binding: i as u32, resource })
            .collect();
        let bindings =
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some(self.label), layout: &self.layout, entries: &entries });
        Step::Dispatch { pipeline: self.pipeline.clone(), bindings, groups }
    }
}

/// Records `steps` in order; dispatches that follow one another share a compute pass.
pub(super) fn record(steps: &[Step], encoder: &mut wgpu::CommandEncoder) {
    for run in steps.chunk_by(|a, b| matches!((a, b), (Step::Dispatch { .. }, Step::Dispatch { .. }))) {
        match &run[0] {
            Step::Copy(from, to) => encoder.copy_buffer_to_buffer(from, 0, to, 0, to.size()),
            Step::Clear(buffer) => encoder.clear_buffer(buffer, 0, None),
            // Gpu::submit writes these: they are no commands.
            Step::Upload(..) => {}
            Step::Dispatch { .. } => {
                let mut pass = encoder.begin_compute_pass(&Default::default());
                for step in run {
                    if let Step::Dispatch { pipeline, bindings, groups } = step {
                        pass.set_pipeline(pipeline);
                        pass.set_bind_group(0, bindings, &[]);
                        pass.dispatch_workgroups(groups[0], groups[1], groups[2]);
                    }
                }
            }
        }
    }
}
