//! Irradiance from the solver's planes to a render target: `picture.wgsl`, `shrink.wgsl`, `display.wgsl`.

use super::DeviceRgb;
use std::collections::HashMap;
use std::ops::Range;
use wgpu::util::DeviceExt;

pub(super) const PICTURE: &str = source!("common/corners", "picture");
pub(super) const SHRINK: &str = source!("common/corners", "shrink");
pub(super) const DISPLAY: &str = source!("common/corners", "display");

/// What pictures are sampled from.
const PICTURES: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;

/// A picture in planes, as the shader sees it.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
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

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct PictureParams {
    matrix: [[f32; 4]; 3],
    place: Place,
    factor: u32,
    _pad: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct ShrinkParams {
    origin: [u32; 2],
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Params {
    pan: [f32; 2],
    frame: [f32; 2],
    scale: [f32; 2],
    per_pixel: f32,
    gain: f32,
    white: f32,
    saturation: f32,
    level: u32,
    reach: f32,
    overlay: Place,
    linear: u32,
    background: f32,
}

/// How a picture is shown.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DisplayParams {
    /// Point of the frame at the view's corner.
    pub pan: [f32; 2],
    /// Full frame in pixels.
    pub frame: [f32; 2],
    /// Pixels of the frame per pixel of the target.
    pub per_pixel: f32,
    /// Luminance of the picture to exposed luminance.
    pub gain: f32,
    /// Exposed luminance that becomes white.
    pub white: f32,
    /// 1 keeps the colours.
    pub saturation: f32,
    /// 0: Reinhard; 1: filmic; 2: the picture is toned, and exposure and colours are its own.
    pub curve: u32,
    /// Drawn over the picture.
    pub overlay: Place,
    /// 0 none, 1 mask, 2 residual, 3 clipped.
    pub overlay_kind: u32,
    /// What the curve makes white or black is marked.
    pub extremes: bool,
    /// sRGB code beyond the frame.
    pub background: f32,
}

/// Where a fragment is sampled.
struct Sampling {
    level: u32,
    scale: [f32; 2],
    reach: f32,
    linear: bool,
}

impl Sampling {
    /// Of a picture of `size` texels with `levels` copies, for `frame` and `per_pixel` of the parameters: the mean where the screen is
    /// coarser than the picture, the pixel where it is finer, between pixels where the picture is a reduced one.
    fn of(size: [u32; 2], levels: u32, frame: [f32; 2], per_pixel: f32) -> Self {
        let scale = [size[0] as f32 / frame[0], size[1] as f32 / frame[1]];
        let step = per_pixel * scale[0];
        if step <= 1.001 {
            let linear = scale[0] <= 0.99;
            return Self { level: 0, scale, reach: if linear { 0.5 } else { 0.0 }, linear };
        }
        // Of the copy that is finer than the screen, but no more than twice, the texels in the quarters of the fragment.
        let level = ((step * 0.999).log2().ceil() as u32).saturating_sub(1).min(levels - 1);
        let shrunk = 0.5f32.powi(level as i32);
        Self { level, scale: scale.map(|s| s * shrunk), reach: 0.25 * step * shrunk, linear: false }
    }
}

/// What pipelines of the last shader differ in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Variant {
    curve: u32,
    overlay_kind: u32,
    saturated: bool,
    extremes: bool,
    between: bool,
}

/// Sizes of the mirrors, as [`super::params_sizes`].
pub(super) fn params_sizes() -> Vec<(&'static str, usize)> {
    vec![("picture", size_of::<PictureParams>()), ("shrink", size_of::<ShrinkParams>()), ("display", size_of::<Params>())]
}

/// A shader that fills a target.
struct Filling {
    label: &'static str,
    pipeline: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
}

impl Filling {
    fn new(device: &wgpu::Device, label: &'static str, source: &str, constants: &[(&str, f64)], format: wgpu::TextureFormat) -> Self {
        let module = device
            .create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Wgsl(source.into()) });
        let stage = wgpu::PipelineCompilationOptions { constants, ..Default::default() };
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some(label),
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
        Self { label, pipeline, layout }
    }

    fn bind<P: bytemuck::Pod>(&self, device: &wgpu::Device, params: &P, resources: &[wgpu::BindingResource<'_>]) -> wgpu::BindGroup {
        let uniform = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some(self.label),
            contents: bytemuck::bytes_of(params),
            usage: wgpu::BufferUsages::UNIFORM,
        });
        let entries: Vec<_> = std::iter::once(uniform.as_entire_binding())
            .chain(resources.iter().cloned())
            .enumerate()
            .map(|(i, resource)| wgpu::BindGroupEntry { binding: i as u32, resource })
            .collect();
        device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some(self.label), layout: &self.layout, entries: &entries })
    }

    fn draw(&self, pass: &mut wgpu::RenderPass<'_>, bindings: &wgpu::BindGroup) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, bindings, &[]);
        pass.draw(0..3, 0..1);
    }
}

fn begin<'e>(encoder: &'e mut wgpu::CommandEncoder, label: &str, target: &wgpu::TextureView) -> wgpu::RenderPass<'e> {
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some(label),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: target,
            resolve_target: None,
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            depth_slice: None,
        })],
        ..Default::default()
    })
}

/// One of `levels` of a texture.
fn level(texture: &wgpu::Texture, level: u32) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor { base_mip_level: level, mip_level_count: Some(1), ..Default::default() })
}

/// The pipelines for one format of target.
pub struct Display {
    picture: Filling,
    halve: Filling,
    /// Compiled when they are first needed.
    display: HashMap<Variant, Filling>,
    copy: Filling,
    format: wgpu::TextureFormat,
    /// Where there is no picture, and no overlay.
    nothing: wgpu::Texture,
    empty: wgpu::Buffer,
}

/// What is drawn in some columns of a view.
pub struct Part<'a> {
    /// The columns, in pixels.
    pub columns: Range<u32>,
    /// How it is shown.
    pub params: DisplayParams,
    /// A picture made by [`Display::picture`]; `None`: there is none yet.
    pub picture: Option<&'a wgpu::Texture>,
}

impl Display {
    /// Compiles the shaders for targets of `format`.
    pub fn new(device: &wgpu::Device, format: wgpu::TextureFormat) -> Self {
        let empty = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("no overlay"),
            size: 16,
            usage: wgpu::BufferUsages::STORAGE,
            mapped_at_creation: false,
        });
        Self {
            picture: Filling::new(device, "picture", PICTURE, &[], PICTURES),
            halve: Filling::new(device, "shrink", SHRINK, &[("factor", 2.0)], PICTURES),
            display: HashMap::new(),
            copy: Filling::new(device, "shrink", SHRINK, &[("factor", 1.0)], format),
            format,
            nothing: texture(device, "no picture", [1, 1], 1, PICTURES, wgpu::TextureUsages::TEXTURE_BINDING),
            empty,
        }
    }

    /// Room for the picture at `place` and its smaller copies: at its size, or, where a texture of this device cannot be so large or there
    /// is no memory, at one over 2, 3, ... of it.
    pub fn room(&self, device: &wgpu::Device, place: &Place) -> wgpu::Texture {
        let most = device.limits().max_texture_dimension_2d;
        let mut factor = place.size[0].max(place.size[1]).div_ceil(most).max(1);
        loop {
            let size = place.size.map(|n| n.div_ceil(factor).max(1));
            let scope = device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
            let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
            let levels = size[0].max(size[1]).ilog2() + 1;
            let texture = texture(device, "picture", size, levels, PICTURES, usage);
            if pollster::block_on(scope.pop()).is_none() || size == [1, 1] {
                return texture;
            }
            factor += 1;
        }
    }

    /// Records the conversion of `planes` into `room`, by `matrix` (columns: their RGB to Rec. 709, in units of half precision's middle).
    pub fn picture(
        &self,
        device: &wgpu::Device,
        encoder: &mut wgpu::CommandEncoder,
        planes: &DeviceRgb,
        place: &Place,
        matrix: &[[f32; 4]; 3],
        room: &wgpu::Texture,
    ) {
        let factor = place.size[0].div_ceil(room.width()).max(place.size[1].div_ceil(room.height()));
        let params = PictureParams { matrix: *matrix, place: *place, factor, _pad: [0; 3] };
        let resources = planes.each_ref().map(|p| p.as_entire_binding());
        let bindings = self.picture.bind(device, &params, &resources);
        self.picture.draw(&mut begin(encoder, "picture", &level(room, 0)), &bindings);
        for i in 1..room.mip_level_count() {
            let params = ShrinkParams { origin: [0, 0] };
            let larger = level(room, i - 1);
            let bindings = self.halve.bind(device, &params, &[wgpu::BindingResource::TextureView(&larger)]);
            self.halve.draw(&mut begin(encoder, "shrink", &level(room, i)), &bindings);
        }
    }

    /// Room for a view of `size` pixels.
    pub fn view(&self, device: &wgpu::Device, size: [u32; 2]) -> wgpu::Texture {
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_SRC;
        texture(device, "view", size, 1, self.format, usage)
    }

    /// Records the drawing of `parts` into `view`.
    pub fn draw(
        &mut self,
        device: &wgpu::Device,
        encoder: &mut wgpu::CommandEncoder,
        view: &wgpu::Texture,
        parts: &[Part<'_>],
        overlay: Option<&wgpu::Buffer>,
    ) {
        let mut pass = begin(encoder, "display", &level(view, 0));
        for Part { columns, params: p, picture } in parts {
            let texture = picture.unwrap_or(&self.nothing);
            let at = Sampling::of([texture.width(), texture.height()], texture.mip_level_count(), p.frame, p.per_pixel);
            let variant = Variant {
                curve: p.curve,
                overlay_kind: if overlay.is_some() { p.overlay_kind } else { 0 },
                saturated: p.saturation == 1.0 || p.curve == 2,
                extremes: p.extremes,
                between: at.reach > 0.0,
            };
            let params = Params {
                pan: p.pan,
                // Without a picture all is beyond it.
                frame: if picture.is_some() { p.frame } else { [0.0; 2] },
                scale: at.scale,
                per_pixel: p.per_pixel,
                gain: p.gain,
                white: p.white,
                saturation: p.saturation,
                overlay: p.overlay,
                level: at.level,
                reach: at.reach,
                linear: u32::from(at.linear),
                background: p.background,
            };
            let format = self.format;
            let display = self.display.entry(variant).or_insert_with(|| {
                let flag = |v: bool| f64::from(u8::from(v));
                let constants = [
                    ("curve", f64::from(variant.curve)),
                    ("overlay_kind", f64::from(variant.overlay_kind)),
                    ("saturated", flag(variant.saturated)),
                    ("extremes", flag(variant.extremes)),
                    ("encoded", flag(!format.is_srgb())),
                    ("between", flag(variant.between)),
                ];
                Filling::new(device, "display", DISPLAY, &constants, format)
            });
            let picture = texture.create_view(&Default::default());
            let overlay = overlay.unwrap_or(&self.empty).as_entire_binding();
            let bindings = display.bind(device, &params, &[wgpu::BindingResource::TextureView(&picture), overlay]);
            pass.set_scissor_rect(columns.start, 0, columns.end - columns.start, view.height());
            display.draw(&mut pass, &bindings);
        }
    }

    /// For [`Display::copy`]: `view`, with its corner at the pixel `origin` of the target.
    pub fn placed(&self, device: &wgpu::Device, view: &wgpu::Texture, origin: [u32; 2]) -> wgpu::BindGroup {
        let params = ShrinkParams { origin };
        self.copy.bind(device, &params, &[wgpu::BindingResource::TextureView(&level(view, 0))])
    }

    /// Copies a view that was drawn into the viewport of `pass`.
    pub fn copy(&self, pass: &mut wgpu::RenderPass<'_>, placed: &wgpu::BindGroup) {
        self.copy.draw(pass, placed);
    }
}

fn texture(
    device: &wgpu::Device,
    label: &str,
    size: [u32; 2],
    mip_level_count: u32,
    format: wgpu::TextureFormat,
    usage: wgpu::TextureUsages,
) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some(label),
        size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
        mip_level_count,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage,
        view_formats: &[],
    })
}
