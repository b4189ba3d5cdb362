use super::support::{SIZE, Times, Window, frames};
use egui::{Key, Vec2};
use egui_kittest::kittest::Queryable;

/// A window that shows the plain merge on both sides of the divider and solves nothing.
fn merged() -> (tempfile::TempDir, Window) {
    let folder = tempfile::tempdir().unwrap();
    let files = frames(folder.path(), Times::Exif);
    let mut window = Window::open(&files);
    window.harness.hover_at((0.4 * SIZE).to_pos2());
    window.wait("the plain merge", 120, |app| app.probed().is_some());
    window.harness.key_press(Key::Escape);
    window.harness.run_steps(4);
    (folder, window)
}

fn part(picture: &image::RgbImage, rect: egui::Rect) -> image::RgbImage {
    let (min, size) = (rect.min, rect.size());
    image::imageops::crop_imm(picture, min.x as u32, min.y as u32, size.x as u32, size.y as u32).to_image()
}

#[test]
fn the_view_is_drawn_when_something_changes_and_copied_otherwise() {
    let (_folder, mut window) = merged();
    let first = window.picture();
    let before = window.counts();
    assert_eq!(before.0, 1, "both sides show one picture");
    for i in 0..4 {
        // The pointer moves, the probe tells, the window is drawn anew.
        window.harness.hover_at((0.4 * SIZE).to_pos2() + Vec2::splat(i as f32));
        window.harness.run_steps(2);
        window.picture();
    }
    assert_eq!(window.counts(), before, "nothing of the view has changed");
    let rect = window.harness.get_by_label("Main view").rect();
    let again = window.picture();
    assert!(part(&again, rect) == part(&first, rect), "and it shows the same");

    window.harness.key_press(Key::CloseBracket);
    window.harness.run_steps(3);
    let brighter = window.picture();
    assert_eq!(window.counts(), (before.0, before.1 + 1), "an exposure is drawn once, and converts nothing");
    assert!(part(&brighter, rect) != part(&again, rect));

    for (what, key) in [("actual pixels", Key::Num1), ("zoom", Key::Plus), ("no divider", Key::D)] {
        let (conversions, drawings) = window.counts();
        window.harness.key_press(key);
        window.harness.run_steps(3);
        window.picture();
        assert_eq!(window.counts(), (conversions, drawings + 1), "{what}");
    }
    let from = rect.center() + Vec2::new(150.0, 100.0);
    let (conversions, drawings) = window.counts();
    let still = window.picture();
    window.harness.drag_at(from);
    window.harness.run_steps(2);
    for i in 1..5 {
        window.harness.hover_at(from - Vec2::splat(15.0 * i as f32));
        window.harness.run_steps(2);
        window.picture();
    }
    window.harness.drop_at(from - Vec2::splat(60.0));
    window.harness.run_steps(2);
    let moved = window.picture();
    assert_eq!(window.counts().0, conversions, "a pan converts nothing");
    assert!(window.counts().1 >= drawings + 3, "the picture follows the pointer");
    // By whole pixels of the screen: what was shown is shown elsewhere.
    let at = |p: &image::RgbImage, d: f32| *p.get_pixel((from.x + d) as u32, (from.y + d) as u32);
    for d in [-40.0, -20.0, 0.0, 20.0] {
        assert_eq!(at(&moved, d - 60.0), at(&still, d), "{d}");
    }
}

#[test]
fn messages_float_over_the_view_and_leave_by_key() {
    let (folder, mut window) = merged();
    while window.harness.query_all_by_label("Dismiss").next().is_some() {
        window.harness.get_all_by_label("Dismiss").next().unwrap().click();
        window.harness.run_steps(3);
    }
    let rect = window.harness.get_by_label("Main view").rect();
    let without = window.picture();
    let bad = folder.path().join("broken.json");
    std::fs::write(&bad, "{}").unwrap();
    window.drop_files(&[bad]);
    window.harness.run_steps(3);
    assert!(window.app().texts()[0].contains("is no session"), "{:?}", window.app().texts());
    assert_eq!(window.harness.get_by_label("Main view").rect(), rect, "the picture stays where it is");
    let message = window.harness.get_by_label_contains("is no session").rect();
    assert!(rect.contains_rect(message), "{message:?} lies in {rect:?}");
    let with = window.picture();
    assert!(part(&with, rect) != part(&without, rect), "the message is drawn");
    let below = rect.with_min_y(message.bottom() + 20.0);
    assert!(part(&with, below) == part(&without, below), "the rest of the picture is as it was");

    // Without a mouse.
    let mut steps = 0;
    while !window.harness.get_by_label("Dismiss").is_focused() {
        window.harness.key_press(Key::Tab);
        window.harness.run_steps(2);
        steps += 1;
        assert!(steps < 120, "Tab does not come to the message");
    }
    window.harness.key_press(Key::Enter);
    window.harness.run_steps(3);
    assert!(window.app().texts().is_empty());
    assert_eq!(window.harness.get_by_label("Main view").rect(), rect);
}

#[test]
fn a_local_operator_is_computed_beside_and_a_newer_one_replaces_it() {
    let (_folder, mut window) = merged();
    window.harness.key_press(Key::Num1);
    window.harness.run_steps(3);
    let rect = window.harness.get_by_label("Main view").rect();
    let filmic = part(&window.picture(), rect);
    assert!(window.choose_curve("durand"), "the window goes on: the sign is there before the picture is");
    window.choose_curve("fattal");
    window.wait_for_tones("fattal's picture");
    let fattal = part(&window.picture(), rect);
    assert!(fattal != filmic);
    assert_eq!(window.app().session().look.saturation, 0.75, "the operator's own colours");
    window.harness.key_press(Key::CloseBracket);
    window.harness.run_steps(3);
    window.wait_for_tones("the brighter picture");
    assert!(part(&window.picture(), rect) != fattal, "the exposure is the operator's");
    window.choose_curve("filmic");
    window.harness.key_press(Key::OpenBracket);
    window.harness.run_steps(3);
    assert!(part(&window.picture(), rect) == filmic, "and back again");
}
