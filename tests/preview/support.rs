//! The window as egui_kittest drives it, drawn with egui_wgpu on the device that it shares with the solver.

use eframe::App as _;
use egui_kittest::kittest::Queryable;
use egui_kittest::{Harness, TestRenderer};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use unshaken::cli::preview::Merge;
use unshaken::exposure::Frame;
use unshaken::io::exif::{self, Format};
use unshaken::preview::app::Kept;
use unshaken::preview::canvas::Canvas;
use unshaken::preview::{self, App, Options};
use unshaken::synth::{self, Camera, Tremor};

/// Hands egui's textures to the renderer that [`picture`] draws with.
struct Textures(egui_wgpu::RenderState);

impl TestRenderer for Textures {
    fn handle_delta(&mut self, delta: &mut egui::TexturesDelta) {
        let mut renderer = self.0.renderer.write();
        for (id, images) in delta.set.drain() {
            for image in images {
                renderer.update_texture(&self.0.device, &self.0.queue, id, &image);
            }
        }
        for id in delta.free.drain() {
            renderer.free_texture(&id);
        }
    }
}

/// A window and the device that it draws on.
pub struct Window {
    pub harness: Harness<'static, Option<App>>,
    pub render: egui_wgpu::RenderState,
    pub kept: Arc<Mutex<Kept>>,
}

/// Size of the window in points.
pub const SIZE: egui::Vec2 = egui::Vec2::new(1200.0, 820.0);

impl Window {
    pub fn open(files: &[PathBuf]) -> Self {
        Self::with(&Options { files: files.to_vec(), ..Options::default() }, Arc::default(), 1.0)
    }

    pub fn with(options: &Options, kept: Arc<Mutex<Kept>>, pixels_per_point: f32) -> Self {
        Self::drawn(options, kept, pixels_per_point, egui_wgpu::RendererOptions::PREDICTABLE)
    }

    /// With a renderer as the tests have it, or as the program.
    pub fn drawn(options: &Options, kept: Arc<Mutex<Kept>>, pixels_per_point: f32, renderer: egui_wgpu::RendererOptions) -> Self {
        let setup = preview::setup();
        let instance = pollster::block_on(setup.new_instance());
        let configuration = egui_wgpu::WgpuConfiguration { wgpu_setup: setup, ..Default::default() };
        let render = pollster::block_on(egui_wgpu::RenderState::create(&configuration, &instance, None, renderer))
            .unwrap_or_else(|e| panic!("the tests need a GPU adapter: {e}"));
        let (options, own, keep) = (options.clone(), render.clone(), kept.clone());
        let builder = Harness::builder().with_size(SIZE).with_pixels_per_point(pixels_per_point).renderer(Textures(render.clone()));
        let harness = builder.build_ui_state(
            move |ui, app: &mut Option<App>| {
                let ctx = ui.ctx().clone();
                let app = app.get_or_insert_with(|| App::new(&ctx, &own, &options, Arc::new(Merge), keep.clone()));
                app.think(&ctx);
                app.show(ui);
            },
            None,
        );
        Self { harness, render, kept }
    }

    pub fn app(&self) -> &App {
        self.harness.state().as_ref().expect("made when it was first drawn")
    }

    /// Draws until `done`, at most `seconds`.
    #[track_caller]
    pub fn wait(&mut self, what: &str, seconds: u64, done: impl Fn(&App) -> bool) {
        self.wait_for(what, seconds, |window| done(window.app()));
    }

    /// Draws until no picture is being computed.
    #[track_caller]
    pub fn wait_for_tones(&mut self, what: &str) {
        self.wait_for(what, 60, |window| window.harness.query_by_label_contains("being computed").is_none());
    }

    #[track_caller]
    fn wait_for(&mut self, what: &str, seconds: u64, done: impl Fn(&Self) -> bool) {
        let start = Instant::now();
        loop {
            self.harness.step();
            if done(self) {
                break;
            }
            let (texts, waited) = (self.app().texts().join("; "), start.elapsed());
            assert!(waited < Duration::from_secs(seconds), "{what} did not come within {seconds} s; messages: {texts}");
            std::thread::sleep(Duration::from_millis(15));
        }
        self.harness.run_steps(2);
    }

    /// Waits for the full-size solution.
    #[track_caller]
    pub fn solve(&mut self) {
        self.wait("the solution", 240, |app| !app.is_busy() && app.solution().is_some_and(|s| s.divisor == 1));
    }

    /// Draws what the window shows.
    pub fn draw(&self) -> wgpu::Texture {
        let (ctx, output, render) = (&self.harness.ctx, self.harness.output(), &self.render);
        let per_point = ctx.pixels_per_point();
        let size = [(SIZE.x * per_point) as u32, (SIZE.y * per_point) as u32];
        let screen = egui_wgpu::ScreenDescriptor { pixels_per_point: per_point, size_in_pixels: size };
        // Without the ground that the harness lays first: the program's window is cleared to its colour.
        let (ground, shapes) = output.shapes.split_first().expect("the ground");
        assert!(matches!(ground.shape, egui::Shape::Rect(_)));
        let shapes = ctx.tessellate(shapes.to_vec(), per_point);
        let mut encoder = render.device.create_command_encoder(&Default::default());
        let mut renderer = render.renderer.write();
        let buffers = renderer.update_buffers(&render.device, &render.queue, &mut encoder, &shapes, &screen);
        let texture = render.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("window"),
            size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: render.target_format,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let view = texture.create_view(&Default::default());
        let [r, g, b, a] = self.app().clear_color(&ctx.global_style().visuals).map(f64::from);
        let ground = wgpu::Color { r, g, b, a };
        {
            let attachment = wgpu::RenderPassColorAttachment {
                view: &view,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(ground), store: wgpu::StoreOp::Store },
                depth_slice: None,
            };
            let descriptor = wgpu::RenderPassDescriptor { color_attachments: &[Some(attachment)], ..Default::default() };
            let mut pass = encoder.begin_render_pass(&descriptor).forget_lifetime();
            renderer.render(&mut pass, &shapes, &screen);
        }
        render.queue.submit(buffers.into_iter().chain([encoder.finish()]));
        texture
    }

    /// How often a picture was converted, and how often the view was drawn.
    pub fn counts(&self) -> (usize, usize) {
        let renderer = self.render.renderer.read();
        let canvas = renderer.callback_resources.get::<Canvas>().expect("made with the window");
        (canvas.conversions, canvas.drawings)
    }

    /// Drops files on the window.
    pub fn drop_files(&mut self, files: &[PathBuf]) {
        let handles = files.iter().map(|f| Arc::new(Dropped(f.clone())) as egui::DroppedFileHandle);
        self.harness.input_mut().dropped_files = handles.collect();
    }

    /// Chooses a tone curve. Returns whether one of the steps that this takes said that the picture is being computed: a small one may be
    /// there at the next.
    pub fn choose_curve(&mut self, name: &str) -> bool {
        let now = self.app().session().look.curve.clone();
        self.harness.get_by_value(&now).click();
        self.harness.run_steps(3);
        self.harness.get_by_label(name).click();
        let sign = format!("{name} is being computed");
        let mut said = false;
        for _ in 0..2 {
            self.harness.step();
            said |= self.harness.query_by_label_contains(&sign).is_some();
        }
        said
    }

    /// Waits for the device.
    pub fn settle(&self) {
        let wait = wgpu::PollType::Wait { submission_index: None, timeout: Some(Duration::from_secs(60)) };
        self.render.device.poll(wait).expect("the device answers");
    }

    /// What the window shows, as pixels.
    pub fn picture(&mut self) -> image::RgbImage {
        self.harness.step();
        let (texture, render) = (self.draw(), &self.render);
        let size = [texture.width(), texture.height()];
        let mut encoder = render.device.create_command_encoder(&Default::default());
        let row = (4 * size[0]).next_multiple_of(256);
        let staging = render.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("window"),
            size: u64::from(row * size[1]),
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row), rows_per_image: None };
        let to = wgpu::TexelCopyBufferInfo { buffer: &staging, layout };
        encoder.copy_texture_to_buffer(texture.as_image_copy(), to, texture.size());
        render.queue.submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |r| r.expect("the picture is mapped"));
        self.settle();
        let bytes = staging.get_mapped_range(..).expect("mapped");
        let swapped = matches!(render.target_format, wgpu::TextureFormat::Bgra8Unorm | wgpu::TextureFormat::Bgra8UnormSrgb);
        let picture = image::RgbImage::from_fn(size[0], size[1], |x, y| {
            let p = &bytes[(y * row + 4 * x) as usize..][..3];
            image::Rgb(if swapped { [p[2], p[1], p[0]] } else { [p[0], p[1], p[2]] })
        });
        // For people: UNSHAKEN_PICTURES names a folder.
        if let Some(folder) = std::env::var_os("UNSHAKEN_PICTURES") {
            let name = std::thread::current().name().unwrap_or("window").replace("::", "-");
            let count = std::fs::read_dir(&folder).map(|d| d.count()).unwrap_or(0);
            picture.save(Path::new(&folder).join(format!("{count:02}-{name}.png"))).expect("a folder that can be written");
        }
        picture
    }
}

/// A file as the desktop hands it over.
#[derive(Debug)]
struct Dropped(PathBuf);

impl egui::DroppedFile for Dropped {
    fn path(&self) -> &Path {
        &self.0
    }

    fn bytes(&self) -> Result<Vec<u8>, String> {
        std::fs::read(&self.0).map_err(|e| e.to_string())
    }
}

/// How frames note their exposure time.
#[derive(Clone, Copy, PartialEq)]
pub enum Times {
    Exif,
    Absent,
}

/// A small bracket: 1/15 and 1/4 s sharp, 1 s shaken.
pub fn frames(folder: &Path, times: Times) -> Vec<PathBuf> {
    sized_frames(folder, times, (128, 96))
}

/// The same at a size.
pub fn sized_frames(folder: &Path, times: Times, (width, height): (usize, usize)) -> Vec<PathBuf> {
    let scene = synth::room(width, height, 24, 3);
    let shake = Tremor { extent_px: 5.0, roll_deg: 0.3, offset_px: 0.5, offset_deg: 0.0 };
    let wanted = [(1.0 / 15.0, None), (0.25, None), (1.0, Some(shake))];
    let made = synth::capture(&scene, &Camera::default(), &wanted, 0.08, 5).expect("a bracket");
    made.bracket.frames().iter().map(|f| write(folder, f, times)).collect()
}

fn write(folder: &Path, frame: &Frame, times: Times) -> PathBuf {
    let path = folder.join(&frame.name);
    let picture = unshaken::tonemap::codes(&frame.intensity);
    if times == Times::Absent {
        picture.save(&path).expect("written");
    } else {
        let mut file = std::fs::File::create(&path).expect("a file");
        exif::write(&mut file, &picture.into(), Format::Png, frame.exposure_time).expect("written");
    }
    path
}
