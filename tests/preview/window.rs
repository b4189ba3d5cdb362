use super::support::{SIZE, Times, Window, frames};
use egui::{Key, Modifiers, Pos2, Vec2};
use egui_kittest::kittest::Queryable;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};
use unshaken::preview::Options;
use unshaken::preview::session::Session;
use unshaken::preview::state::Over;
use unshaken::tonemap::Operator;

fn bracket() -> (tempfile::TempDir, Vec<std::path::PathBuf>) {
    let folder = tempfile::tempdir().unwrap();
    let files = frames(folder.path(), Times::Exif);
    (folder, files)
}

fn click(window: &mut Window, label: &str) {
    window.harness.get_by_label(label).click();
    window.harness.run_steps(3);
}

#[test]
fn an_empty_window_says_what_to_do() {
    let mut window = Window::open(&[]);
    window.harness.run_steps(2);
    window.picture();
    assert!(window.harness.query_by_label("Main view").is_some());
    window.harness.key_press(Key::F1);
    window.harness.run_steps(3);
    assert!(window.harness.query_by_label("Half a stop brighter").is_some());
    window.picture();
    window.harness.key_press(Key::Escape);
    window.harness.run_steps(3);
    assert!(window.harness.query_by_label("Half a stop brighter").is_none(), "Escape closes the sheet");
}

/// Moves the pointer from `from` to `to` with the button held.
fn drag(window: &mut Window, from: Pos2, to: Pos2) {
    window.harness.hover_at(from);
    window.harness.run_steps(2);
    window.harness.drag_at(from);
    window.harness.run_steps(2);
    // Beyond what counts as a click first.
    window.harness.hover_at(from + 0.5 * (to - from));
    window.harness.run_steps(2);
    window.harness.hover_at(to);
    window.harness.run_steps(2);
    window.harness.drop_at(to);
    window.harness.run_steps(3);
}

/// The pixel of the frame that the window tells of while the pointer is at `at`.
#[track_caller]
fn probed(window: &mut Window, at: Pos2) -> (i32, i32) {
    window.harness.hover_at(at);
    window.harness.run_steps(2);
    let (x, y) = window.app().probed().expect("the pointer is over the frame");
    assert!(window.harness.query_by_label(&format!("at {x}, {y}")).is_some(), "{x}, {y} is not said");
    (x as i32, y as i32)
}

#[test]
fn frames_are_dropped_probed_zoomed_and_moved() {
    let (_folder, files) = bracket();
    let mut window = Window::open(&[]);
    window.harness.run_steps(2);
    window.drop_files(&files);
    window.harness.run_steps(2);
    assert_eq!(window.app().session().shots.len(), 3, "dropped");
    window.solve();
    window.harness.get_by_label("Pixel").scroll_to_me();
    window.harness.run_steps(4);

    // The probe tells the pixel under the pointer as the files have it.
    let view = window.harness.get_by_label("Main view").rect();
    let at = view.center() + Vec2::new(70.0, 30.0);
    let (x, y) = probed(&mut window, at);
    let frame = image::open(&files[1]).unwrap().into_rgb8();
    let zoom = (view.width() / frame.width() as f32).min(view.height() / frame.height() as f32);
    let expected = Vec2::new(frame.width() as f32, frame.height() as f32) * 0.5 + (at - view.center()) / zoom;
    assert_eq!((x, y), (expected.x as i32, expected.y as i32));
    for code in frame.get_pixel(x as u32, y as u32).0 {
        let text = format!("{code}.0");
        assert!(window.harness.query_all_by_label(&text).next().is_some(), "{text} of frame 2 at {x}, {y}");
    }
    assert!(window.harness.query_all_by_label_contains("mask ").count() >= 3, "the masks of all frames");

    // The pixel under the pointer stays there while the wheel turns.
    window.harness.hover_at(at);
    window.harness.event(egui::Event::MouseWheel {
        unit: egui::MouseWheelUnit::Point,
        delta: Vec2::new(0.0, 120.0),
        phase: egui::TouchPhase::Move,
        source: egui::MouseWheelSource::Unknown,
        modifiers: Modifiers::NONE,
    });
    window.harness.run_steps(30);
    let near = window.app().zoom().expect("zoomed");
    assert!(near > 1.2 * zoom, "{near} points per pixel, {zoom} before");
    let still = probed(&mut window, at);
    assert!((still.0 - x).abs() <= 1 && (still.1 - y).abs() <= 1, "{still:?}, ({x}, {y}) before");

    // A drag carries the picture along.
    let to = at + Vec2::new(-60.0, 40.0);
    drag(&mut window, at, to);
    let carried = probed(&mut window, to);
    assert!((carried.0 - still.0).abs() <= 1 && (carried.1 - still.1).abs() <= 1, "{carried:?}, {still:?} before");
    window.harness.key_press(Key::F);
    window.harness.run_steps(3);
    assert_eq!(window.app().zoom(), None, "the whole frame again");

    // Patches: added by a click, moved by a drag, removed by the other button.
    window.harness.key_press(Key::B);
    window.harness.run_steps(4);
    window.harness.hover_at(at);
    window.harness.drag_at(at);
    window.harness.drop_at(at);
    window.harness.run_steps(3);
    assert_eq!(window.app().session().patches, [(x as usize, y as usize)]);
    // Messages that the click made obsolete no longer take room.
    let now = window.harness.get_by_label("Main view").rect();
    let zoom = (now.width() / frame.width() as f32).min(now.height() / frame.height() as f32);
    let place = |p: Vec2| now.center() + (p - 0.5 * Vec2::new(frame.width() as f32, frame.height() as f32)) * zoom;
    let (from, to) = (place(expected), place(expected + Vec2::new(-9.0, 6.0)));
    drag(&mut window, from, to);
    let moved = window.app().session().patches[0];
    let wanted = expected + Vec2::new(-9.0, 6.0);
    assert!(
        (moved.0 as f32 + 0.5 - wanted.x).abs() <= 1.0 && (moved.1 as f32 + 0.5 - wanted.y).abs() <= 1.0,
        "{moved:?}, {wanted:?} wanted"
    );
    assert_eq!(window.app().zoom(), None, "a drag of a patch does not move the picture");
    window.harness.hover_at(to);
    for pressed in [true, false] {
        window.harness.event(egui::Event::PointerButton {
            pos: to,
            button: egui::PointerButton::Secondary,
            pressed,
            modifiers: Modifiers::NONE,
        });
        window.harness.run_steps(2);
    }
    assert!(window.app().session().patches.is_empty(), "removed");
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::Z);
    window.harness.run_steps(3);
    assert_eq!(window.app().session().patches, [moved], "and taken back");
}

/// One solution, and everything that needs one: a device and a solve are dear.
#[test]
#[ignore = "the shaken frame of the tiny bracket is judged stationary"]
fn a_bracket_is_solved_compared_nudged_and_exported_as_merge_would() {
    let (folder, files) = bracket();
    let mut window = Window::open(&files);
    window.solve();
    // Badges.
    for label in ["Frame 2: sharp, reference", "Frame 1: sharp"] {
        assert!(window.harness.query_by_label(label).is_some(), "{label}");
    }
    assert!(window.harness.query_by_label_contains("Frame 3: blurred").is_some());

    // The picture is tone mapped as `--preview` would be: beyond the divider the result, pixel for pixel.
    let view = window.harness.get_by_label("Main view").rect();
    window.harness.key_press(Key::D);
    window.harness.key_press(Key::Num1);
    window.harness.run_steps(4);
    let shown = window.picture();
    let solved = window.app().solution().expect("solved").clone();
    let time = solved.bracket.frames()[solved.outcome.reference].exposure_time as f32;
    let irradiance = solved.outcome.irradiance.map_planes(|p| p.map(|v| v / time));
    let (w, h) = (irradiance.size().0 as i64, irradiance.size().1 as i64);
    let pan = (0.5 * Vec2::new(w as f32, h as f32) - 0.5 * view.size()).round();
    let (x0, y0) = ((view.left().round() - pan.x) as i64, (view.top().round() - pan.y) as i64);
    // Pixels of `shown` that are more than `most` codes from what the operator makes.
    let far = |shown: &image::RgbImage, operator: &Operator, most: u8| {
        let wanted = operator.apply(&irradiance);
        let differs = |(x, y, p): (u32, u32, &image::Rgb<u8>)| {
            let q = shown.get_pixel((x0 + i64::from(x)) as u32, (y0 + i64::from(y)) as u32);
            (0..3).any(|c| p.0[c].abs_diff(q.0[c]) > most)
        };
        wanted.enumerate_pixels().filter(|p| differs(*p)).count()
    };
    let found = far(&shown, &Operator::default(), 2);
    assert!(found < (w * h / 200) as usize, "{found} of {} pixels differ by more than rounding", w * h);
    // So it is where an operator looks at surroundings, once it is computed: what it made is what is shown.
    for name in ["reinhard-local", "durand", "fattal"] {
        window.choose_curve(name);
        window.wait_for_tones(name);
        let operator = Operator::parse(&window.app().session().look.words()).unwrap();
        assert_eq!(operator.name(), name);
        let found = far(&window.picture(), &operator, 1);
        assert!(found < (w * h / 200) as usize, "{name}: {found} of {} pixels differ by more than rounding", w * h);
    }
    window.choose_curve("filmic");

    // Exposure acts without solving.
    let (before, serial) = (shown.clone(), Arc::as_ptr(&solved));
    window.harness.key_press(Key::CloseBracket);
    window.harness.run_steps(3);
    let brighter = window.picture();
    let mean = |p: &image::RgbImage| {
        let part = image::imageops::crop_imm(p, x0 as u32, y0 as u32, w as u32, h as u32).to_image();
        part.as_raw().iter().map(|v| f64::from(*v)).sum::<f64>() / part.as_raw().len() as f64
    };
    assert!(mean(&brighter) > 1.1 * mean(&before), "{} against {}", mean(&brighter), mean(&before));
    assert_eq!(Arc::as_ptr(window.app().solution().unwrap()), serial, "nothing was solved for it");
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::Z);
    window.harness.run_steps(3);
    assert_eq!(window.app().session().look.exposure, 0.0, "undone");

    // The divider: left of it the plain merge.
    window.harness.key_press(Key::D);
    window.harness.run_steps(3);
    let at = window.harness.get_by_label("Divider between before and after").rect().center();
    let to = Pos2::new(view.left() + 0.8 * view.width(), at.y);
    window.harness.hover_at(at);
    window.harness.run_steps(2);
    window.harness.drag_at(at);
    window.harness.run_steps(2);
    window.harness.hover_at(to);
    window.harness.run_steps(2);
    window.harness.drop_at(to);
    window.harness.run_steps(3);
    assert!((window.app().divider() - 0.8).abs() < 0.02, "{}", window.app().divider());
    let divided = window.picture();
    let at = |p: &image::RgbImage, part: f32| {
        let x = (view.left() + part * view.width()) as u32;
        (0..view.height() as u32).map(|y| p.get_pixel(x, view.top() as u32 + y).0.map(u64::from).iter().sum::<u64>()).collect::<Vec<_>>()
    };
    assert_ne!(at(&divided, 0.5), at(&before, 0.5), "the merge lies left of the divider");

    // Overlays.
    for expected in [Over::FrameClipped, Over::AllClipped, Over::Mask, Over::Residual] {
        window.harness.key_press(Key::O);
        window.harness.run_steps(3);
        assert_eq!(window.app().overlay(), expected);
    }
    let end = Instant::now() + Duration::from_secs(30);
    while at(&window.picture(), 0.45) == at(&divided, 0.45) {
        assert!(Instant::now() < end, "the residual is not drawn");
        std::thread::sleep(Duration::from_millis(50));
    }
    window.harness.key_press(Key::O);

    // The blur view.
    window.harness.key_press(Key::B);
    window.harness.run_steps(4);
    assert!(window.harness.query_by_label("Camera motion in shift and roll").is_some());
    assert!(window.harness.query_by_label("Blur of frame 3").is_some());
    window.picture();
    let place = view.center();
    window.harness.hover_at(place);
    window.harness.drag_at(place);
    window.harness.drop_at(place);
    window.harness.run_steps(3);
    assert_eq!(window.app().session().patches.len(), 1, "a click adds a patch");
    window.wait("the patch's PSF", 120, |app| {
        !app.is_busy() && app.solution().is_some_and(|s| s.session.patches.len() == 1 && s.divisor == 1)
    });
    let again = window.app().solution().unwrap().clone();
    assert_eq!(again.ran.len(), 1, "only the PSFs are measured again: {:?}", again.ran);
    assert!(again.ran[0].starts_with("PSFs"));
    assert_eq!(again.outcome.irradiance, solved.outcome.irradiance);
    window.picture();
    window.harness.key_press(Key::B);
    window.harness.run_steps(3);

    // Export: what `merge` makes of the command line is the same, byte for byte; the picture as well, whatever its operator.
    window.choose_curve("durand");
    let target = folder.path().join("seen.exr");
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::E);
    window.harness.run_steps(3);
    let field = window.harness.get_by_label("Linear result");
    field.focus();
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::A);
    window.harness.get_by_label("Linear result").type_text(&target.display().to_string());
    window.harness.run_steps(3);
    window.picture();
    click(&mut window, "Write the files");
    window.wait("the files", 30, |_| target.exists());
    assert!(target.exists() && target.with_extension("png").exists() && target.with_extension("json").exists());
    // The same as TIFF, with a page.
    let tiff = folder.path().join("seen.tif");
    window.harness.get_by_label("Linear result").focus();
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::A);
    window.harness.get_by_label("Linear result").type_text(&tiff.display().to_string());
    window.harness.run_steps(3);
    for label in ["Report page (HTML)", "Replace files that exist", "Write the files"] {
        click(&mut window, label);
    }
    let page = tiff.with_extension("html");
    window.wait("the page", 30, |_| page.exists());
    assert!(std::fs::read_to_string(&page).unwrap().contains("<html"));
    let read = unshaken::io::input::read(&tiff, 1.0).unwrap().intensity;
    for (a, b) in read.0.iter().zip(pixels(&target)) {
        assert!(a.data.iter().zip(&b).all(|(a, b)| (a - b.clamp(0.0, 1.0)).abs() <= 1e-6), "TIFF and OpenEXR hold the same");
    }

    let own = folder.path().join("headless.exr");
    let program = env!("CARGO_BIN_EXE_unshaken");
    let line = window.app().session().command_line(&[None; 3], &own).replacen("unshaken merge", &format!("'{program}' merge --quiet"), 1);
    assert!(line.contains("--tonemap=durand:"), "{line}");
    let run = Command::new("sh").args(["-c", &line]).output().unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let picture = |path: &Path| image::open(path.with_extension("png")).unwrap().into_rgb8();
    assert!(picture(&target) == picture(&own), "the window's picture and the command line's");
    // And what `tonemap` makes of the linear result.
    let toned = folder.path().join("toned.png");
    let words = window.app().session().look.words();
    let run = Command::new(program).args(["tonemap", "--quiet", "--tonemap", &words, "-o"]).args([&toned, &target]).output().unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let most = picture(&toned).as_raw().iter().zip(picture(&target).as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(most <= Some(1), "{most:?} codes");
    let (seen, headless) = (pixels(&target), pixels(&own));
    assert_eq!(seen, headless, "the window's result and the command line's");
}

fn pixels(path: &Path) -> Vec<Vec<f32>> {
    unshaken::io::exr::read(path).unwrap().0.0.into_iter().map(|p| p.data).collect()
}

#[test]
#[ignore = "the shaken frame of the tiny bracket is judged stationary"]
fn a_parameter_runs_only_the_stages_that_it_touches() {
    let (folder, files) = bracket();
    let session = folder.path().join("s.json");
    let mut s = Session::of(files);
    s.parameters.lambda = 4.0;
    s.save(&session).unwrap();
    let mut window = Window::open(std::slice::from_ref(&session));
    window.solve();
    let first = window.app().solution().unwrap().ran.clone();
    assert!(
        ["registration", "stationary frames", "blur", "irradiance 0", "refinement"].iter().all(|s| first.iter().any(|r| r.starts_with(s))),
        "{first:?}"
    );
    // Reset: lambda goes back to its default.
    window.harness.get_by_label("Reset the parameters").scroll_to_me();
    window.harness.run_steps(4);
    click(&mut window, "Reset the parameters");
    window.wait("the second solution", 240, |app| {
        !app.is_busy() && app.solution().is_some_and(|s| s.divisor == 1 && s.session.parameters.lambda == 2.5)
    });
    let again = window.app().solution().unwrap().ran.clone();
    assert!(again.iter().all(|r| r.starts_with("irradiance 1")) && again.len() == 1, "{again:?}");
    // Back again: nothing is left to do.
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::Z);
    window.harness.run_steps(2);
    window.wait("the first solution", 240, |app| {
        !app.is_busy() && app.solution().is_some_and(|s| s.divisor == 1 && s.session.parameters.lambda == 4.0)
    });
    assert_eq!(window.app().solution().unwrap().ran, Vec::<String>::new());
}

#[test]
fn marks_are_edits_and_escape_cancels() {
    let (_folder, files) = bracket();
    let mut window = Window::open(&files);
    window.wait("a solution", 120, |app| !app.is_busy() && app.solution().is_some());
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::Enter);
    window.harness.step();
    assert!(window.app().is_busy(), "asked to solve");
    window.harness.key_press(Key::Escape);
    window.harness.step();
    assert!(!window.app().is_busy(), "cancelled at once");
    click(&mut window, "Use frame 3");
    assert!(window.app().session().shots[2].excluded);
    assert!(window.harness.query_by_label("Frame 3: left out").is_some());
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::Z);
    window.harness.run_steps(3);
    assert!(!window.app().session().shots[2].excluded);
    window.harness.key_press(Key::N);
    window.harness.key_press(Key::S);
    window.harness.run_steps(3);
    assert!(window.app().session().shots[1].sharp, "S marks the frame that N chose");
}

#[test]
fn missing_exposure_times_are_asked_for_and_taken() {
    let folder = tempfile::tempdir().unwrap();
    let files = frames(folder.path(), Times::Absent);
    let mut window = Window::open(&files);
    window.wait("the request for times", 60, |app| !app.is_busy());
    window.picture();
    assert!(window.harness.query_all_by_label_contains("type it below the thumbnail").next().is_some());
    assert!(window.app().solution().is_none());
    for (i, text) in ["1/15", "0.25", "1"].iter().enumerate() {
        let label = format!("Exposure time of frame {}", i + 1);
        window.harness.get_by_label(&label).focus();
        window.harness.run_steps(2);
        window.harness.get_by_label(&label).type_text(text);
        window.harness.run_steps(2);
        window.harness.key_press(Key::Enter);
        window.harness.run_steps(2);
    }
    assert_eq!(window.app().session().shots[0].exposure_time, Some(1.0 / 15.0));
    window.solve();
}

#[test]
fn what_cannot_be_read_is_said_in_the_window() {
    let (folder, mut files) = bracket();
    let bad = folder.path().join("broken.png");
    std::fs::write(&bad, b"not a picture").unwrap();
    files.push(bad);
    let mut window = Window::open(&files);
    window.wait("the message", 60, |app| !app.is_busy() && app.texts().iter().any(|t| t.contains("broken.png")));
    window.picture();
    // The note on the response may stand there as well.
    let said = window.app().texts().len();
    window.harness.get_all_by_label("Dismiss").next().expect("a message can be dismissed").click();
    window.harness.run_steps(3);
    assert_eq!(window.app().texts().len(), said - 1, "{:?}", window.app().texts());
    // A session file that is none.
    let other = folder.path().join("s.json");
    std::fs::write(&other, "{}").unwrap();
    let mut window = Window::open(&[other]);
    window.harness.run_steps(2);
    assert!(window.app().texts()[0].contains("is no session"), "{:?}", window.app().texts());
}

#[test]
fn without_memory_a_smaller_size_is_offered_and_taken() {
    let (folder, files) = bracket();
    let mut s = Session::of(files);
    s.parameters.memory_limit = "1MiB".into();
    let path = folder.path().join("s.json");
    s.save(&path).unwrap();
    let mut window = Window::open(&[path]);
    window.wait("the message", 120, |app| !app.is_busy() && !app.texts().is_empty());
    window.picture();
    let texts = window.app().texts();
    assert!(texts.iter().any(|t| t.contains("memory") && t.contains("\"Size\"") && !t.contains("--")), "{texts:?}");
    click(&mut window, "Solve at 1/2 of the size");
    assert_eq!(window.app().session().parameters.divisor, 2);
}

#[test]
fn a_device_that_is_lost_is_opened_anew_with_the_session() {
    let (_folder, files) = bracket();
    let mut window = Window::open(&files);
    window.wait("thumbnails", 60, |app| app.is_busy());
    click(&mut window, "Use frame 3");
    // While the solver works on it.
    window.render.device.destroy();
    let kept = window.kept.clone();
    window.wait("the wish to be opened again", 30, |_| kept.lock().unwrap().again);
    drop(window);
    let mut window = Window::with(&Options::default(), kept, 1.0);
    window.harness.run_steps(2);
    assert_eq!(window.app().session().shots.len(), 3);
    assert!(window.app().session().shots[2].excluded, "edits are kept");
    assert!(window.app().texts()[0].contains("opened again"));
    window.solve();
}

#[test]
fn the_window_is_whole_at_twice_the_pixels_and_in_light_colours() {
    let (_folder, files) = bracket();
    let options = Options { files, light: Some(true), ..Options::default() };
    let mut window = Window::with(&options, Arc::default(), 2.0);
    window.wait("the plain merge", 120, |app| app.solution().is_some());
    let picture = window.picture();
    assert_eq!((picture.width(), picture.height()), (2 * SIZE.x as u32, 2 * SIZE.y as u32));
    let view = window.harness.get_by_label("Main view").rect();
    // The frame fills the view's height or width: its middle row is not background.
    let y = (2.0 * view.center().y) as u32;
    let of = |x: f32| picture.get_pixel((2.0 * x) as u32, y).0;
    let background = [200u8; 3];
    assert_ne!(of(view.center().x + 40.0), background);
    assert_ne!(of(view.center().x - 40.0), background);
}
