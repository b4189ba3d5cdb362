//! The main view: zoom, pan, divider, and the picture itself, drawn on the GPU.

use super::worker::{Overlay, Picture};
use crate::kernels::{Display, DisplayParams, Part};
use egui::{Color32, Pos2, Rect, Sense, Vec2};
use egui_wgpu::CallbackResources;
use std::ops::Range;

/// What the view looks at.
#[derive(Clone, Debug)]
pub struct View {
    /// Points per pixel of the frame; `None`: the whole frame fits.
    pub zoom: Option<f32>,
    /// Pixel of the frame in the middle of the view.
    pub centre: Vec2,
    /// Divider, 0..=1 of the view's width; left of it is what comes before.
    pub split: f32,
    /// Whether there is a divider.
    pub divided: bool,
}

impl Default for View {
    fn default() -> Self {
        Self { zoom: None, centre: Vec2::ZERO, split: 0.5, divided: true }
    }
}

/// Smallest and largest zoom, points per pixel.
const ZOOM: (f32, f32) = (0.02, 64.0);

/// Where the frame lies in the view.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// The view.
    pub rect: Rect,
    /// Points per pixel of the frame.
    pub zoom: f32,
    /// Pixel of the frame at the view's upper left corner.
    pub pan: Vec2,
}

impl Layout {
    /// Where a point of the frame (pixels, the first centre at 0.5) is on the screen.
    pub fn to_screen(self, p: Vec2) -> Pos2 {
        self.rect.min + (p - self.pan) * self.zoom
    }

    /// The point of the frame at `p`.
    pub fn to_frame(self, p: Pos2) -> Vec2 {
        self.pan + (p - self.rect.min) / self.zoom
    }
}

impl View {
    /// Where a frame of `size` pixels lies in `rect`.
    pub fn layout(&self, rect: Rect, size: Vec2) -> Layout {
        let (zoom, centre) = match self.zoom {
            Some(zoom) => (zoom, self.centre),
            None => ((rect.width() / size.x).min(rect.height() / size.y), 0.5 * size),
        };
        Layout { rect, zoom, pan: centre - 0.5 * rect.size() / zoom }
    }

    /// Zooms by `factor` about the point `at` of the screen.
    pub fn zoom_by(&mut self, factor: f32, at: Pos2, layout: &Layout) {
        let zoom = (layout.zoom * factor).clamp(ZOOM.0, ZOOM.1);
        let fixed = layout.to_frame(at);
        self.zoom = Some(zoom);
        self.centre = fixed - (at - layout.rect.center()) / zoom;
    }

    /// Moves the picture by points of the screen.
    pub fn pan_by(&mut self, points: Vec2, layout: &Layout) {
        self.zoom = Some(layout.zoom);
        self.centre = layout.to_frame(layout.rect.center()) - points / layout.zoom;
    }

    /// Shows a pixel of the frame as a pixel of the screen, or the whole frame again. `at`: what stays in place.
    pub fn toggle(&mut self, at: Pos2, layout: &Layout, points_per_pixel: f32) {
        if self.zoom.is_some() {
            self.zoom = None;
        } else {
            self.zoom_by(points_per_pixel / layout.zoom, at, layout);
        }
    }

    /// Hears mouse and touch pad over the view.
    pub fn listen(&mut self, ui: &egui::Ui, response: &egui::Response, layout: &Layout, pans: bool) {
        let at = response.hover_pos().unwrap_or(layout.rect.center());
        if response.hovered() {
            let (scroll, pinch) = ui.input(|i| (i.smooth_scroll_delta().y, i.zoom_delta()));
            let factor = pinch * (0.004 * scroll).exp();
            if (factor - 1.0).abs() > 1e-4 {
                self.zoom_by(factor, at, layout);
            }
        }
        if pans && response.dragged() && response.drag_delta() != Vec2::ZERO {
            self.pan_by(response.drag_delta(), layout);
        }
        if response.double_clicked() {
            self.toggle(at, layout, 1.0 / ui.ctx().pixels_per_point());
        }
    }

    /// The divider over the view: dragged, or moved with the arrow keys when it has the focus.
    pub fn divider(&mut self, ui: &egui::Ui, rect: Rect) {
        let x = rect.left() + self.split * rect.width();
        let grip = Rect::from_center_size(Pos2::new(x, rect.center().y), Vec2::new(14.0, rect.height()));
        let response = ui.interact(grip, ui.scope_id().with("divider"), Sense::click_and_drag());
        let at = f64::from(self.split);
        response.widget_info(|| egui::WidgetInfo::slider(true, at, "Divider between before and after"));
        if response.dragged() {
            self.split = ((x + response.drag_delta().x - rect.left()) / rect.width()).clamp(0.0, 1.0);
        }
        if response.has_focus() {
            let step = ui.input(|i| i.num_presses(egui::Key::ArrowRight) as f32 - i.num_presses(egui::Key::ArrowLeft) as f32);
            self.split = (self.split + 0.02 * step).clamp(0.0, 1.0);
        }
        if response.hovered() || response.dragged() {
            ui.ctx().set_cursor_icon(egui::CursorIcon::ResizeHorizontal);
        }
        let x = rect.left() + self.split * rect.width();
        let painter = ui.painter_at(rect);
        painter.line_segment([Pos2::new(x, rect.top()), Pos2::new(x, rect.bottom())], (3.0, Color32::from_black_alpha(120)));
        painter.line_segment([Pos2::new(x, rect.top()), Pos2::new(x, rect.bottom())], (1.5, Color32::WHITE));
        let (centre, size) = (Pos2::new(x, rect.center().y), if response.hovered() || response.has_focus() { 13.0 } else { 11.0 });
        painter.circle(centre, size, Color32::from_black_alpha(170), (1.5, Color32::WHITE));
        for side in [-1.0, 1.0] {
            let tip = centre + Vec2::new(side * 7.0, 0.0);
            let back = Vec2::new(-side * 4.0, 0.0);
            painter.line_segment([tip, tip + back + Vec2::new(0.0, 4.0)], (1.5, Color32::WHITE));
            painter.line_segment([tip, tip + back - Vec2::new(0.0, 4.0)], (1.5, Color32::WHITE));
        }
    }
}

/// A name on the picture; returns where it is.
pub fn tag(ui: &egui::Ui, rect: Rect, align: egui::Align2, text: &str) -> Rect {
    let painter = ui.painter_at(rect);
    let galley = painter.layout_no_wrap(text.into(), egui::FontId::proportional(13.0), Color32::WHITE);
    let place = align.align_size_within_rect(galley.size() + Vec2::new(16.0, 8.0), rect.shrink(8.0));
    painter.rect_filled(place, 4.0, Color32::from_black_alpha(170));
    painter.galley(place.min + Vec2::new(8.0, 4.0), galley, Color32::WHITE);
    place
}

/// What one side of the divider shows, and by which curve.
#[derive(Clone, PartialEq)]
pub struct Side {
    /// The picture.
    pub picture: Picture,
    /// Columns: its RGB to Rec. 709, such that the middle of its light is near 1.
    pub matrix: [[f32; 4]; 3],
    /// As [`DisplayParams::curve`].
    pub curve: u32,
}

/// What is drawn in a frame of the window.
pub struct Shown {
    /// Parameters; place and curve are filled in.
    pub params: DisplayParams,
    /// Left of the divider, and right of it.
    pub sides: [Option<Side>; 2],
    /// Over both.
    pub overlay: Option<Overlay>,
}

/// Everything that the pixels of the view depend on.
#[derive(Clone, PartialEq)]
struct Drawing {
    /// Pixels.
    size: [u32; 2],
    /// Columns left of the divider.
    split: u32,
    params: DisplayParams,
    sides: [Option<Side>; 2],
    overlay: Option<Overlay>,
}

/// What the view is drawn with, and what was drawn: pictures are converted when they change, the view is drawn when anything of it
/// changes, and otherwise copied.
pub struct Canvas {
    display: Display,
    /// The pictures of the two sides, to be sampled.
    pictures: Vec<(Picture, wgpu::Texture)>,
    view: Option<(Drawing, wgpu::Texture)>,
    placed: Option<wgpu::BindGroup>,
    /// How often a picture was converted.
    pub conversions: usize,
    /// How often the view was drawn.
    pub drawings: usize,
}

impl Canvas {
    /// For a window of `format`.
    pub fn new(device: &wgpu::Device, format: wgpu::TextureFormat) -> Self {
        let display = Display::new(device, format);
        Self { display, pictures: Vec::new(), view: None, placed: None, conversions: 0, drawings: 0 }
    }

    fn convert(&mut self, device: &wgpu::Device, encoder: &mut wgpu::CommandEncoder, side: &Side) {
        let Picture { planes, place, version } = &side.picture;
        let known = self.pictures.iter_mut().find(|(p, _)| p.planes == *planes && p.place == *place);
        let room = match known {
            Some((known, _)) if known.version == *version => return,
            Some((known, room)) => {
                known.version = *version;
                room
            }
            None => {
                let room = self.display.room(device, place);
                &self.pictures.push_mut((side.picture.clone(), room)).1
            }
        };
        self.display.picture(device, encoder, planes, place, &side.matrix, room);
        self.conversions += 1;
    }

    fn draw(&mut self, device: &wgpu::Device, encoder: &mut wgpu::CommandEncoder, drawing: &Drawing) {
        let sides = drawing.sides.each_ref().map(Option::as_ref);
        self.pictures.retain(|(p, _)| sides.iter().flatten().any(|s| s.picture.planes == p.planes && s.picture.place == p.place));
        for side in sides.into_iter().flatten() {
            self.convert(device, encoder, side);
        }
        let room = self.view.take().map(|v| v.1).filter(|t| [t.width(), t.height()] == drawing.size);
        let view = room.unwrap_or_else(|| self.display.view(device, drawing.size));
        let part = |i: usize, columns: Range<u32>| {
            let found = sides[i].and_then(|s| self.pictures.iter().find(|(p, _)| *p == s.picture));
            let params = DisplayParams { curve: sides[i].map_or(0, |s| s.curve), ..drawing.params };
            Part { columns, params, picture: found.map(|f| &f.1) }
        };
        let parts = [part(0, 0..drawing.split), part(1, drawing.split..drawing.size[0])];
        self.display.draw(device, encoder, &view, &parts, drawing.overlay.as_ref().map(|o| &o.plane));
        self.drawings += 1;
        self.view = Some((drawing.clone(), view));
    }
}

/// The view, where it lies in the window.
struct Placed {
    origin: [u32; 2],
    drawing: Drawing,
}

impl egui_wgpu::CallbackTrait for Placed {
    fn prepare(
        &self,
        device: &wgpu::Device,
        _queue: &wgpu::Queue,
        _screen: &egui_wgpu::ScreenDescriptor,
        encoder: &mut wgpu::CommandEncoder,
        resources: &mut CallbackResources,
    ) -> Vec<wgpu::CommandBuffer> {
        if let Some(canvas) = resources.get_mut::<Canvas>() {
            if canvas.view.as_ref().is_none_or(|v| v.0 != self.drawing) {
                canvas.draw(device, encoder, &self.drawing);
            }
            canvas.placed = canvas.view.as_ref().map(|v| canvas.display.placed(device, &v.1, self.origin));
        }
        Vec::new()
    }

    fn paint(&self, _info: egui::PaintCallbackInfo, pass: &mut wgpu::RenderPass<'static>, resources: &CallbackResources) {
        if let Some(canvas) = resources.get::<Canvas>()
            && let Some(placed) = &canvas.placed
        {
            canvas.display.copy(pass, placed);
        }
    }
}

/// Draws `shown` where `layout` says.
pub fn draw(ui: &egui::Ui, layout: &Layout, size: Vec2, split: f32, shown: Shown) {
    let per_point = ui.ctx().pixels_per_point();
    let pixel = |p: Pos2| [p.x, p.y].map(|v| (v * per_point).round().max(0.0) as u32);
    let (origin, end) = (pixel(layout.rect.min), pixel(layout.rect.max));
    let extent = [end[0].saturating_sub(origin[0]), end[1].saturating_sub(origin[1])];
    if extent.contains(&0) {
        return;
    }
    // Pixels of the frame begin where pixels of the screen do.
    let per_pixel = 1.0 / (layout.zoom * per_point);
    let pan = if per_pixel <= 1.0 { (layout.pan / per_pixel).round() * per_pixel } else { layout.pan };
    let params = DisplayParams {
        pan: [pan.x, pan.y],
        frame: [size.x, size.y],
        per_pixel,
        overlay: shown.overlay.as_ref().map(|o| o.place).unwrap_or_default(),
        ..shown.params
    };
    // Left are the pixels whose centres are.
    let split = ((split * layout.rect.width() * per_point - 0.5).ceil().max(0.0) as u32).min(extent[0]);
    let drawing = Drawing { size: extent, split, params, sides: shown.sides, overlay: shown.overlay };
    ui.painter().add(egui_wgpu::Callback::new_paint_callback(layout.rect, Placed { origin, drawing }));
}
