//! `cargo bench --features preview-tests --bench window [-- FRAME...]`: seconds until a bracket's merge and its first solution are in the window,
//! and milliseconds per redraw, as median (fastest): from the event to the finished picture, the interface's own work included. Without
//! frames, three of 1152 x 864 pixels.

#[path = "../tests/preview/support.rs"]
#[expect(dead_code, reason = "the tests of the window need more of it")]
mod support;

use egui::{Key, Pos2, Vec2};
use egui_kittest::kittest::Queryable;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};
use support::{Times, Window, sized_frames};
use unshaken::preview::Options;

/// Redraws of each kind.
const TIMES: usize = 15;

/// Milliseconds of the median redraw after `event`, and of the fastest: what the machine does while nobody else uses it.
fn redraws(window: &mut Window, mut event: impl FnMut(&mut Window, usize)) -> String {
    let mut all: Vec<f64> = (0..TIMES)
        .map(|i| {
            let start = Instant::now();
            event(window, i);
            window.harness.step();
            window.draw();
            window.settle();
            1e3 * start.elapsed().as_secs_f64()
        })
        .collect();
    all.sort_unstable_by(f64::total_cmp);
    format!("{:.1} ({:.1})", all[TIMES / 2], all[0])
}

/// Milliseconds of redraws while the pointer, its button held, goes back and forth from `from`.
fn dragged(window: &mut Window, from: Pos2) -> String {
    window.harness.hover_at(from);
    window.harness.run_steps(2);
    window.harness.drag_at(from);
    window.harness.run_steps(2);
    let found = redraws(window, |w, i| w.harness.hover_at(from + Vec2::new(20.0 + 7.0 * (i % 5) as f32, 3.0 * (i % 4) as f32)));
    window.harness.drop_at(from);
    window.harness.run_steps(3);
    found
}

fn main() {
    let folder = tempfile::tempdir().expect("a folder");
    let named: Vec<PathBuf> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).map(PathBuf::from).collect();
    let files = if named.is_empty() { sized_frames(folder.path(), Times::Exif, (1152, 864)) } else { named };
    let start = Instant::now();
    let options = Options { files, ..Options::default() };
    let mut window = Window::drawn(&options, Arc::default(), 1.0, egui_wgpu::RendererOptions::default());
    window.harness.run_steps(2);
    let view = window.harness.get_by_label("Main view").rect();
    window.harness.hover_at(view.center());
    window.wait("the plain merge", 240, |app| app.probed().is_some());
    println!("the merge after {:.1} s", start.elapsed().as_secs_f64());
    window.wait("the first solution", 240, |app| app.solution().is_some());
    println!("the first solution after {:.1} s", start.elapsed().as_secs_f64());
    window.harness.key_press(Key::Escape);
    window.harness.run_steps(4);
    // The solver stops where it next looks.
    std::thread::sleep(Duration::from_secs(8));
    window.harness.run_steps(4);
    let view = window.harness.get_by_label("Main view").rect();
    println!("view of {} x {} points", view.width(), view.height());
    for (name, key) in [("whole frame", Key::F), ("actual pixels", Key::Num1)] {
        window.harness.key_press(key);
        window.harness.run_steps(4);
        window.harness.hover_at(view.center() + Vec2::new(100.0, 50.0));
        redraws(&mut window, |_, _| {});
        let idle = redraws(&mut window, |w, i| w.harness.hover_at(view.center() + Vec2::new(100.0 + (i % 3) as f32, 50.0)));
        let exposure = redraws(&mut window, |w, i| w.harness.key_press(if i % 2 == 0 { Key::CloseBracket } else { Key::OpenBracket }));
        let grip = window.harness.get_by_label("Divider between before and after").rect().center();
        let divider = dragged(&mut window, grip);
        let zoom = redraws(&mut window, |w, i| w.harness.key_press(if i % 2 == 0 { Key::Plus } else { Key::Minus }));
        window.harness.key_press(key);
        window.harness.run_steps(4);
        let pan = dragged(&mut window, view.center() + Vec2::new(150.0, 100.0));
        window.harness.key_press(key);
        window.harness.run_steps(4);
        println!("{name}: idle {idle}, exposure {exposure}, divider {divider}, zoom {zoom}, pan {pan} ms");
    }
}
