use egui::Pos2;
use glam::DVec2;
use unshaken::image::{Plane, Rgb};
use unshaken::pose::Pose;
use unshaken::preview::blur::{nice, psf_at, tree};
use unshaken::preview::shortcuts::KEYS;
use unshaken::preview::words::{CONTROLS, in_window, seconds, time};
use unshaken::preview::worker::{BINS_PER_STOP, Histogram, divisors};
use unshaken::tsf::Tsf;

#[test]
fn times_are_read_as_photographers_write_them() {
    assert_eq!(seconds("1/30"), Some(1.0 / 30.0));
    assert_eq!(seconds(" 0.5 s"), Some(0.5));
    assert_eq!(seconds("0"), None);
    assert_eq!(seconds("1/0"), None);
    assert_eq!(seconds("soon"), None);
    assert_eq!(time(1.0 / 30.0), "1/30 s");
    assert_eq!(time(2.5), "2.5 s");
    assert_eq!(seconds(&time(1.0 / 125.0)), Some(1.0 / 125.0));
}

#[test]
fn a_drawn_psf_holds_all_of_the_time_and_is_centred() {
    let tsf = Tsf::new(500.0, vec![Pose::planar(-2.0, 1.0, 0.0, 0.5), Pose::planar(3.0, -1.0, 0.3, 0.5)]).unwrap();
    let psf = psf_at(&tsf, DVec2::new(30.0, -20.0), 8);
    let sum: f32 = psf.data.iter().sum();
    assert!((sum - 1.0).abs() < 1e-5, "{sum}");
    let x: f32 = psf.data.iter().enumerate().map(|(i, v)| v * ((i % 17) as f32 - 8.0)).sum();
    assert!(x.abs() < 0.05, "centre of mass {x}");
    // A later pose to the right shows right of the centre.
    assert!(psf.data[7 * 17 + 10] + psf.data[7 * 17 + 11] > 0.1);
}

#[test]
fn axes_end_at_round_numbers() {
    assert_eq!([nice(0.7), nice(3.2), nice(10.0), nice(0.013)], [1.0, 5.0, 10.0, 0.02]);
}

#[test]
fn a_path_joins_neighbours() {
    let places = [0.0, 10.0, 4.0, 7.0].map(|x| Pos2::new(x, 0.0));
    let mut edges = tree(&places).into_iter().map(|(a, b)| (a.min(b), a.max(b))).collect::<Vec<_>>();
    edges.sort_unstable();
    assert_eq!(edges, [(0, 2), (1, 3), (2, 3)]);
}

#[test]
fn no_key_does_two_things() {
    for (i, (one, ..)) in KEYS.iter().enumerate() {
        assert!(!KEYS[..i].iter().any(|(other, ..)| other == one), "{one:?}");
    }
}

#[test]
fn sizes_double_up_to_the_one_that_is_wanted() {
    assert_eq!(divisors((1024, 1024), 1, 70_000), [4, 2, 1]);
    assert_eq!(divisors((200, 150), 1, 70_000), [1]);
    assert_eq!(divisors((1024, 1024), 2, 70_000), [4, 2]);
    // Never too small to register.
    assert_eq!(divisors((6000, 100), 1, 1000), [2, 1]);
}

#[test]
fn a_histogram_counts_every_lit_pixel_once() {
    let image = Rgb(std::array::from_fn(|c| Plane { width: 4, height: 1, data: vec![0.0, 1.0, 2.0, [1.0, 8.0, 0.25][c]] }));
    let found = Histogram::of(&image);
    for bins in &found.bins {
        assert!((bins.iter().sum::<f32>() - 0.75).abs() < 1e-6);
    }
    assert_eq!(found.first, -2.0);
    assert_eq!(found.bins[1][5 * BINS_PER_STOP], 0.25, "8 lies five stops above a quarter");
}

#[test]
fn options_become_controls_and_nothing_else_changes() {
    let said = in_window("use a larger --scale, or --scale=1; --tsf stays -- as this does");
    assert_eq!(said, "use a larger \"Size\", or \"Size\"=1; --tsf stays -- as this does");
    assert_eq!(in_window("(--no-align takes it as it lies)"), "(\"Register the frames\" switched off takes it as it lies)");
    assert_eq!(in_window("--scaled"), "--scaled");
    assert_eq!(in_window("é--"), "é--");
    let help = std::process::Command::new(env!("CARGO_BIN_EXE_unshaken")).args(["merge", "--help"]).output().unwrap();
    let help = String::from_utf8(help.stdout).unwrap();
    for (option, _) in CONTROLS {
        assert!(help.contains(&format!("{option} ")) || help.contains(&format!("{option}\n")), "{option}");
    }
}
