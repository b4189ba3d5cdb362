//! Irradiance straight from the solver's planes to a render target (`display.wgsl`).

use super::Channels;

pub(super) const DISPLAY: &str = include_str!("../../shaders/display.wgsl");

/// A picture in planes, as the shader sees it.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Place {
    /// Pixels; 0: no picture.
    pub size: [u32; 2],
    /// Values per row of the planes.
    pub stride: u32,
    /// Index of the first value.
    pub first: u32,
}

impl Place {
    /// A picture of `width` x `height` inside `pad` further pixels on every side.
    pub fn padded(width: usize, height: usize, pad: usize) -> Self {
        let stride = width + 2 * pad;
        Self { size: [width as u32, height as u32], stride: stride as u32, first: (pad * stride + pad) as u32 }
    }
}

/// What is shown and how; see the shader for each field.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub struct DisplayParams {
    /// Columns of the frames' RGB to Rec. 709.
    pub matrix: [[f32; 4]; 3],
    /// Pixel of the target at the view's corner.
    pub origin: [f32; 2],
    /// Point of the frame there.
    pub pan: [f32; 2],
    /// Full frame in pixels.
    pub frame: [f32; 2],
    /// Pixels of the frame per pixel of the target.
    pub per_pixel: f32,
    /// Divider in pixels of the target from the view's corner.
    pub split: f32,
    /// Luminance to exposed luminance.
    pub gain: f32,
    /// Exposed luminance that becomes white.
    pub white: f32,
    /// 1 keeps the colours.
    pub saturation: f32,
    /// 1: filmic; 0: Reinhard.
    pub filmic: u32,
    /// Left of the divider.
    pub a: Place,
    /// Right of it.
    pub b: Place,
    /// Drawn over both.
    pub overlay: Place,
    /// 0 none, 1 mask, 2 residual, 3 clipped.
    pub overlay_kind: u32,
    /// 1: what the curve makes white or black is marked.
    pub extremes: u32,
    /// 1: the target takes sRGB codes.
    pub encoded: u32,
    /// sRGB code beyond the frame.
    pub background: f32,
}

/// The pipeline for one format of target.
pub struct Display {
    pipeline: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
    params: wgpu::Buffer,
    empty: wgpu::Buffer,
    encoded: bool,
}

impl Display {
    /// Compiles the shader for targets of `format`.
    pub fn new(device: &wgpu::Device, format: wgpu::TextureFormat) -> Self {
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("display"),
            source: wgpu::ShaderSource::Wgsl(DISPLAY.into()),
        });
        let stage = wgpu::PipelineCompilationOptions::default();
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("display"),
            layout: None,
            vertex: wgpu::VertexState { module: &module, entry_point: Some("corners"), compilation_options: stage.clone(), buffers: &[] },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: None,
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("main"),
                compilation_options: stage,
                targets: &[Some(format.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        let buffer = |label, size, usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size,
                usage: usage | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        };
        let params = buffer("display", size_of::<DisplayParams>() as u64, wgpu::BufferUsages::UNIFORM);
        let empty = buffer("no picture", 16, wgpu::BufferUsages::STORAGE);
        Self { pipeline, layout, params, empty, encoded: !format.is_srgb() }
    }

    /// Takes parameters and pictures for the next [`Display::draw`]; what is `None` is not drawn.
    pub fn bind(
        &self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        params: &DisplayParams,
        a: Option<&Channels>,
        b: Option<&Channels>,
        overlay: Option<&wgpu::Buffer>,
    ) -> wgpu::BindGroup {
        let gone = Place::default();
        let own = DisplayParams {
            encoded: u32::from(self.encoded),
            a: if a.is_some() { params.a } else { gone },
            b: if b.is_some() { params.b } else { gone },
            overlay: if overlay.is_some() { params.overlay } else { gone },
            ..*params
        };
        queue.write_buffer(&self.params, 0, bytemuck::bytes_of(&own));
        let none = [self.empty.clone(), self.empty.clone(), self.empty.clone()];
        let buffers = std::iter::once(&self.params)
            .chain(a.unwrap_or(&none))
            .chain(b.unwrap_or(&none))
            .chain(std::iter::once(overlay.unwrap_or(&self.empty)));
        let entries: Vec<_> =
            buffers.enumerate().map(|(i, b)| wgpu::BindGroupEntry { binding: i as u32, resource: b.as_entire_binding() }).collect();
        device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("display"), layout: &self.layout, entries: &entries })
    }

    /// Draws into the viewport of `pass`.
    pub fn draw(&self, pass: &mut wgpu::RenderPass<'_>, bindings: &wgpu::BindGroup) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, bindings, &[]);
        pass.draw(0..3, 0..1);
    }
}
