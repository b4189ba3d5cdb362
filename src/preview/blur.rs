//! The blur view: patches and their PSFs on the picture, a grid of PSFs, the camera's motion as a path and in its own space.

use super::canvas::Layout;
use super::state::{Over, State};
use super::worker::Solved;
use crate::image::Plane;
use crate::pose::project;
use crate::tsf::Tsf;
use egui::{Color32, Pos2, Rect, RichText, Sense, Stroke, Vec2};
use glam::DVec2;

/// Columns of the grid of PSFs.
const COLUMNS: usize = 7;
/// Side of a patch that the user adds, as the pipeline has it, in pixels of the solution.
const PATCH: f32 = 96.0;
/// Points within which the pointer takes hold of a patch.
const GRIP: f32 = 14.0;

/// What the view keeps between frames of the window.
#[derive(Default)]
pub struct Drawn {
    /// The patch that is being dragged.
    dragged: Option<usize>,
    glyphs: Option<Glyphs>,
}

/// PSFs as textures, for one frame of one solution.
struct Glyphs {
    of: (u64, usize),
    grid: Option<Grid>,
    patches: Vec<Glyph>,
}

/// A measured PSF.
struct Glyph {
    /// Patch in pixels of the full frame: corner and side.
    corner: Vec2,
    side: f32,
    texture: egui::TextureHandle,
    /// Pixels of the full frame across the PSF.
    across: f32,
    confidence: f64,
    extent: f64,
}

/// PSFs that the TSF makes, at equal steps over the frame.
struct Grid {
    texture: egui::TextureHandle,
    cells: (usize, usize),
    /// Pixels of the full frame across one cell.
    across: f32,
}

/// White where `values` are largest, see-through where they are 0.
fn glyph(values: &[f32], size: [usize; 2]) -> egui::ColorImage {
    let most = values.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    let pixels = values.iter().map(|v| {
        let a = (v / most).clamp(0.0, 1.0).powf(0.6);
        Color32::from_rgba_unmultiplied(255, (190.0 + 65.0 * a) as u8, (60.0 + 180.0 * a) as u8, (255.0 * a) as u8)
    });
    egui::ColorImage::new(size, pixels.collect())
}

/// The PSF that `tsf` makes at the frame's pixel `p` (centred pixels): square of side 2 · radius + 1, bilinear.
pub fn psf_at(tsf: &Tsf, p: DVec2, radius: usize) -> Plane {
    let side = 2 * radius + 1;
    let mut psf = Plane::filled(side, side, 0.0);
    let centre = project(&tsf.centre(), p) - p;
    for pose in &tsf.poses {
        let u = project(&(pose.homography(tsf.focal_px) * tsf.base), p) - p - centre + DVec2::splat(radius as f64);
        let (x, y) = (u.x.floor(), u.y.floor());
        for (i, j) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let weight = (1.0 - (u.x - x - i as f64).abs()) * (1.0 - (u.y - y - j as f64).abs()) * pose.weight;
            let (a, b) = (x as isize + i as isize, y as isize + j as isize);
            if a >= 0 && b >= 0 && (a as usize) < side && (b as usize) < side {
                psf.data[b as usize * side + a as usize] += weight as f32;
            }
        }
    }
    psf
}

fn glyphs(state: &State, ctx: &egui::Context, solved: &Solved, frame: usize) -> Glyphs {
    let of = (state.solutions, frame);
    let (w, h) = solved.bracket.size();
    let scale = solved.divisor as f32;
    let smooth = egui::TextureOptions::LINEAR;
    let grid = solved.tsf(frame).map(|tsf| {
        let reach = (0.5 * crate::tsf::extent(&tsf, w, h)).ceil() as usize + 2;
        let radius = reach.min(64);
        let side = 2 * radius + 1;
        let rows = (COLUMNS * h).div_ceil(w).max(2);
        let mut all = Plane::filled(side * COLUMNS, side * rows, 0.0);
        for j in 0..rows {
            for i in 0..COLUMNS {
                let at = DVec2::new((i as f64 + 0.5) / COLUMNS as f64 - 0.5, (j as f64 + 0.5) / rows as f64 - 0.5);
                let psf = psf_at(&tsf, at * DVec2::new(w as f64, h as f64), radius);
                let most = psf.data.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
                for (k, v) in psf.data.iter().enumerate() {
                    all.data[(j * side + k / side) * all.width + i * side + k % side] = v / most;
                }
            }
        }
        let texture = ctx.load_texture("PSF grid", glyph(&all.data, [all.width, all.height]), smooth);
        Grid { texture, cells: (COLUMNS, rows), across: side as f32 * scale }
    });
    let none = Vec::new();
    let entries = solved.outcome.report["frames"][frame]["blur"]["patches"].as_array().unwrap_or(&none);
    let patches = entries.iter().filter_map(|p| {
        let number = |name: &str| p[name].as_f64();
        let values: Vec<f32> = p["psf"]["values"].as_array()?.iter().filter_map(|v| v.as_f64().map(|v| v as f32)).collect();
        let side = 2 * p["psf"]["radius"].as_u64()? as usize + 1;
        (values.len() == side * side).then_some(())?;
        Some(Glyph {
            corner: Vec2::new(number("x")? as f32, number("y")? as f32) * scale,
            side: number("size")? as f32 * scale,
            texture: ctx.load_texture("PSF", glyph(&values, [side, side]), smooth),
            across: side as f32 * scale,
            confidence: number("confidence")?,
            extent: p["psf"]["extent_px"].as_f64()? * f64::from(scale),
        })
    });
    let patches = patches.collect();
    Glyphs { of, grid, patches }
}

/// The frame whose blur is shown: the chosen one, or else the first that is blurred.
fn subject(state: &State) -> Option<usize> {
    let solved = state.solved.as_ref()?;
    let blurred = |i: &usize| solved.tsf(*i).is_some();
    Some(state.frame).filter(blurred).or_else(|| (0..solved.bracket.frames().len()).find(blurred))
}

/// The user's patch nearest to `at` on the screen.
fn grasped(state: &State, layout: &Layout, at: Pos2) -> Option<usize> {
    let place = |p: &(usize, usize)| layout.to_screen(Vec2::new(p.0 as f32 + 0.5, p.1 as f32 + 0.5));
    let near = state.session.patches.iter().enumerate().map(|(i, p)| (i, place(p).distance(at)));
    near.filter(|n| n.1 < GRIP).min_by(|a, b| a.1.total_cmp(&b.1)).map(|n| n.0)
}

/// Adds, moves and removes patches; whether the pointer has one in hand.
pub fn wants_pointer(state: &mut State, drawn: &mut Drawn, ui: &egui::Ui, response: &egui::Response, layout: &Layout) -> bool {
    let Some(size) = state.size() else { return false };
    let pixel = |at: Pos2| {
        let q = layout.to_frame(at);
        let inside = q.x >= 0.0 && q.y >= 0.0 && q.x < size.x && q.y < size.y;
        inside.then_some((q.x as usize, q.y as usize))
    };
    if response.drag_started() {
        let origin = ui.input(|i| i.pointer.press_origin());
        drawn.dragged = origin.and_then(|at| grasped(state, layout, at));
    }
    let at = response.interact_pointer_pos();
    if let (Some(i), Some(at)) = (drawn.dragged, at)
        && response.dragged()
        && let Some(to) = pixel(at)
        && let Some(patch) = state.session.patches.get_mut(i)
    {
        *patch = to;
    }
    if response.drag_stopped() {
        drawn.dragged = None;
    }
    if response.clicked()
        && !response.double_clicked()
        && state.blur.patches
        && let Some(at) = at
        && grasped(state, layout, at).is_none()
        && let Some(to) = pixel(at)
    {
        state.session.patches.push(to);
    }
    if response.secondary_clicked()
        && let Some(at) = at
        && let Some(i) = grasped(state, layout, at)
    {
        state.session.patches.remove(i);
    }
    drawn.dragged.is_some()
}

/// Draws patches, PSFs and paths over the picture.
pub fn over_picture(state: &State, drawn: &mut Drawn, ui: &egui::Ui, response: &egui::Response, layout: &Layout) {
    let (Some(size), Some(solved), Some(frame)) = (state.size(), state.solved.clone(), subject(state)) else { return };
    if drawn.glyphs.as_ref().is_none_or(|g| g.of != (state.solutions, frame)) {
        drawn.glyphs = Some(glyphs(state, ui.ctx(), &solved, frame));
    }
    let Some(glyphs) = &drawn.glyphs else { return };
    let painter = ui.painter_at(layout.rect);
    let uv = Rect::from_min_max(Pos2::ZERO, Pos2::new(1.0, 1.0));
    let shade = |place: Rect| painter.rect_filled(place, 3.0, Color32::from_black_alpha(150));
    if state.blur.grid
        && let Some(grid) = &glyphs.grid
    {
        let (nx, ny) = grid.cells;
        let cell = Vec2::new(size.x / nx as f32, size.y / ny as f32);
        for j in 0..ny {
            for i in 0..nx {
                let centre = layout.to_screen(Vec2::new((i as f32 + 0.5) * cell.x, (j as f32 + 0.5) * cell.y));
                let side = (grid.across * state.blur.magnified * layout.zoom).min(0.9 * cell.min_elem() * layout.zoom);
                let place = Rect::from_center_size(centre, Vec2::splat(side));
                let at = Pos2::new(i as f32 / nx as f32, j as f32 / ny as f32);
                let part = Rect::from_min_size(at, Vec2::new(1.0 / nx as f32, 1.0 / ny as f32));
                shade(place);
                painter.image(grid.texture.id(), place, part, Color32::WHITE);
            }
        }
    }
    if state.blur.patches {
        for p in &glyphs.patches {
            let place = Rect::from_min_max(layout.to_screen(p.corner), layout.to_screen(p.corner + Vec2::splat(p.side)));
            let colour = if p.confidence > 0.5 { Color32::from_rgb(110, 230, 130) } else { Color32::from_rgb(240, 180, 60) };
            painter.rect_stroke(place, 2.0, Stroke::new(1.5, colour), egui::StrokeKind::Inside);
            if !state.blur.grid {
                let side = (p.across * state.blur.magnified * layout.zoom).min(0.85 * place.width());
                let inner = Rect::from_center_size(place.center(), Vec2::splat(side));
                shade(inner);
                painter.image(p.texture.id(), inner, uv, Color32::WHITE);
            }
            // A number only where it fits.
            if place.width() > 48.0 {
                let (text, font) = (format!("{:.1} px", p.extent), egui::FontId::proportional(11.0));
                painter.text(place.left_bottom() + Vec2::new(4.0, -3.0), egui::Align2::LEFT_BOTTOM, text, font, colour);
            }
        }
        let hovered = response.hover_pos().and_then(|at| grasped(state, layout, at));
        for (i, p) in state.session.patches.iter().enumerate() {
            let at = layout.to_screen(Vec2::new(p.0 as f32 + 0.5, p.1 as f32 + 0.5));
            let side = PATCH.min(0.5 * size.min_elem()) * layout.zoom;
            let own = Color32::from_rgb(110, 190, 255);
            let width = if hovered == Some(i) { 2.5 } else { 1.5 };
            painter.rect_stroke(Rect::from_center_size(at, Vec2::splat(side)), 2.0, Stroke::new(1.0, own), egui::StrokeKind::Middle);
            painter.circle(at, 5.0, Color32::from_black_alpha(140), Stroke::new(width, own));
        }
    }
    if state.blur.path
        && let Some(tsf) = solved.tsf(frame)
    {
        let (w, h) = solved.bracket.size();
        let scale = solved.divisor as f64;
        let corners = [(0.5, 0.5), (0.15, 0.15), (0.85, 0.15), (0.15, 0.85), (0.85, 0.85)];
        for (fx, fy) in corners {
            let p = DVec2::new((fx - 0.5) * w as f64, (fy - 0.5) * h as f64);
            let middle = project(&tsf.centre(), p);
            let origin = Vec2::new(fx as f32 * size.x, fy as f32 * size.y);
            let places: Vec<Pos2> = tsf
                .poses
                .iter()
                .map(|pose| {
                    let u = (project(&(pose.homography(tsf.focal_px) * tsf.base), p) - middle) * scale * f64::from(state.blur.magnified);
                    layout.to_screen(origin + Vec2::new(u.x as f32, u.y as f32))
                })
                .collect();
            path(&painter, &places, &tsf);
        }
    }
}

/// Edges of the shortest tree that joins the poses where they lie: a camera moves from pose to neighbouring pose.
pub fn tree(places: &[Pos2]) -> Vec<(usize, usize)> {
    let n = places.len();
    let mut nearest: Vec<(f32, usize)> = vec![(f32::INFINITY, 0); n];
    let mut joined = vec![false; n];
    let mut edges = Vec::new();
    let mut now = 0;
    for _ in 1..n {
        joined[now] = true;
        for i in 0..n {
            let d = places[now].distance_sq(places[i]);
            if !joined[i] && d < nearest[i].0 {
                nearest[i] = (d, now);
            }
        }
        let Some(next) = (0..n).filter(|&i| !joined[i]).min_by(|&a, &b| nearest[a].0.total_cmp(&nearest[b].0)) else { break };
        edges.push((nearest[next].1, next));
        now = next;
    }
    edges
}

fn path(painter: &egui::Painter, places: &[Pos2], tsf: &Tsf) {
    for (a, b) in tree(places) {
        painter.line_segment([places[a], places[b]], Stroke::new(3.0, Color32::from_black_alpha(120)));
        painter.line_segment([places[a], places[b]], Stroke::new(1.2, Color32::from_rgb(120, 220, 255)));
    }
    let most = tsf.poses.iter().map(|p| p.weight).fold(f64::MIN_POSITIVE, f64::max);
    for (p, pose) in places.iter().zip(&tsf.poses) {
        let r = 1.0 + 4.0 * (pose.weight / most).sqrt() as f32;
        painter.circle(*p, r, Color32::from_rgb(255, 190, 70), Stroke::new(0.8, Color32::from_black_alpha(180)));
    }
}

/// The side panel of the blur view.
pub fn panel(state: &mut State, ui: &mut egui::Ui) {
    ui.add_space(6.0);
    let Some(solved) = state.solved.clone() else {
        ui.weak("The blur is shown once the frames are solved");
        return;
    };
    let Some(frame) = subject(state) else {
        ui.label("No frame of this bracket is blurred, or none could be explained");
        return;
    };
    ui.label(RichText::new(format!("Blur of frame {}", frame + 1)).strong().size(14.0));
    let blurred: Vec<usize> = (0..solved.bracket.frames().len()).filter(|&i| solved.tsf(i).is_some()).collect();
    ui.horizontal(|ui| {
        for i in blurred {
            if ui.selectable_label(i == frame, format!("Frame {}", i + 1)).clicked() {
                state.choose(i);
            }
        }
    });
    let entry = &solved.outcome.report["frames"][frame];
    if let Some(tsf) = solved.tsf(frame) {
        plot(state, ui, &tsf, solved.divisor as f64);
        ui.label(RichText::new("Drag to turn. A dot is a pose; its size, the time spent there").small().weak());
        let (w, h) = solved.bracket.size();
        let extent = crate::tsf::extent(&tsf, w, h) * solved.divisor as f64;
        let model = entry["blur"]["model"].as_str().unwrap_or("given");
        ui.label(format!("{} poses, {extent:.1} px, model {model}", tsf.poses.len()));
    }
    if let Some(chi) = entry["chi_squared"].as_f64() {
        ui.label(format!("Residual: {chi:.2} times what noise explains"));
    }
    ui.checkbox(&mut state.blur.grid, "PSF grid");
    ui.checkbox(&mut state.blur.patches, "Patches");
    ui.checkbox(&mut state.blur.path, "Camera path");
    ui.add(egui::Slider::new(&mut state.blur.magnified, 1.0..=20.0).logarithmic(true).text("Magnified"));
    let mut residual = state.over == Over::Residual;
    if ui.checkbox(&mut residual, "Residual map").changed() {
        state.over = if residual { Over::Residual } else { Over::Nothing };
        state.choose(frame);
    }
    ui.label(RichText::new("Click: add a patch. Drag: move it. Right click: remove it").small().weak());
    if ui.add_enabled(!state.session.patches.is_empty(), egui::Button::new("Remove all patches")).clicked() {
        state.session.patches.clear();
    }
}

/// The TSF in (t_x, t_y, θ_z), to be turned by dragging.
fn plot(state: &mut State, ui: &mut egui::Ui, tsf: &Tsf, scale: f64) {
    let side = ui.available_width().min(300.0);
    let (rect, response) = ui.allocate_exact_size(Vec2::new(side, 0.85 * side), Sense::drag());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, "Camera motion in shift and roll"));
    if response.dragged() {
        let d = response.drag_delta();
        state.blur.turn.0 += 0.01 * d.x;
        state.blur.turn.1 = (state.blur.turn.1 + 0.01 * d.y).clamp(-1.5, 1.5);
    }
    let painter = ui.painter_at(rect);
    painter.rect_filled(rect, 4.0, ui.visuals().extreme_bg_color);
    let middle = tsf.mean();
    let values: Vec<[f64; 3]> = tsf
        .poses
        .iter()
        .map(|p| [(p.t_x - middle.t_x) * scale, (p.t_y - middle.t_y) * scale, p.theta_z_deg - middle.theta_z_deg])
        .collect();
    let reach = |k: usize| values.iter().map(|v| v[k].abs()).fold(0.0, f64::max);
    // Both shifts in one unit; the roll in its own.
    let pixels = nice(reach(0).max(reach(1)).max(0.5));
    let degrees = nice(reach(2).max(0.01));
    let (yaw, pitch) = state.blur.turn;
    let place = |v: [f64; 3]| {
        let (x, y, z) = ((v[0] / pixels) as f32, (v[1] / pixels) as f32, (v[2] / degrees) as f32);
        let (u, depth) = (x * yaw.cos() - y * yaw.sin(), x * yaw.sin() + y * yaw.cos());
        let v = z * pitch.cos() - depth * pitch.sin();
        rect.center() + Vec2::new(u, -v) * 0.23 * side
    };
    let (p, d) = (pixels, degrees);
    let weak = Stroke::new(1.0, ui.visuals().weak_text_color().gamma_multiply(0.45));
    let floor = [[-p, -p, -d], [p, -p, -d], [p, p, -d], [-p, p, -d]];
    for i in 0..4 {
        painter.line_segment([place(floor[i]), place(floor[(i + 1) % 4])], weak);
    }
    for (a, b) in [([-p, 0.0, -d], [p, 0.0, -d]), ([0.0, -p, -d], [0.0, p, -d]), ([-p, -p, -d], [-p, -p, d])] {
        painter.line_segment([place(a), place(b)], weak);
    }
    let text = |at: [f64; 3], words: String| {
        painter.text(place(at), egui::Align2::CENTER_CENTER, words, egui::FontId::proportional(11.0), ui.visuals().text_color());
    };
    text([1.28 * p, 0.0, -d], format!("x {p} px"));
    text([0.0, 1.28 * p, -d], format!("y {p} px"));
    text([-p, -p, 1.2 * d], format!("roll {d}\u{b0}"));
    let places: Vec<Pos2> = values.iter().map(|v| place(*v)).collect();
    for (v, at) in values.iter().zip(&places) {
        // The shadow on the floor tells depth.
        let below = place([v[0], v[1], -d]);
        painter.line_segment([*at, below], Stroke::new(0.5, ui.visuals().weak_text_color().gamma_multiply(0.25)));
        painter.circle_filled(below, 1.2, ui.visuals().weak_text_color().gamma_multiply(0.5));
    }
    path(&painter, &places, tsf);
}

/// The next 1, 2 or 5 times a power of ten.
pub fn nice(v: f64) -> f64 {
    let power = 10f64.powf(v.log10().floor());
    let lead = [1.0, 2.0, 5.0, 10.0].into_iter().find(|k| k * power >= v * 0.999).unwrap_or(10.0);
    // Without the error of the power.
    format!("{:.3e}", lead * power).parse().unwrap_or(v)
}
