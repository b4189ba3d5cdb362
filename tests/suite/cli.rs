//! The program as a user runs it: outputs, messages, exit codes.

use crate::support::files::{Noise, listing, scene, shared, write_png};
use std::path::Path;
use std::process::{Command, Output};
use tempfile::{TempDir, tempdir};

fn unshaken(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_unshaken")).current_dir(folder).args(arguments).output().expect("the program runs")
}

/// A folder with three frames a.png, b.png, c.png (at 1/30, 1/8 and 1/2 s), and what the bad cases need.
fn folder() -> TempDir {
    let dir = tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let scene = scene(64, 48, 2.5);
    let mut noise = Noise::new(3);
    for (name, time) in [("a.png", 1.0 / 30.0), ("b.png", 1.0 / 8.0), ("c.png", 0.5)] {
        let picture = image::RgbImage::from_fn(64, 48, |x, y| {
            let e = f64::from(scene.at(x as usize, y as usize)) * time * 20.0 + 0.003 * noise.normal();
            image::Rgb([(e.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8; 3])
        });
        picture.save(at(name)).unwrap();
    }
    write_png(&at("small.png"), 32, 48, |x, _| x as u8);
    for name in ["white1.png", "white2.png"] {
        write_png(&at(name), 64, 48, |_, _| 255);
    }
    for name in ["black1.png", "black2.png"] {
        write_png(&at(name), 64, 48, |_, _| 0);
    }
    let whole = std::fs::read(at("b.png")).unwrap();
    std::fs::write(at("cut.png"), &whole[..whole.len() / 2]).unwrap();
    std::fs::write(at("text.png"), "no picture").unwrap();
    std::fs::write(at("there.exr"), "old").unwrap();
    std::fs::write(at("tsf.json"), r#"{"format":"unshaken-tsf","version":1,"frames":[]}"#).unwrap();
    std::fs::write(at("response.json"), r#"{"format":"unshaken-response","version":1}"#).unwrap();
    std::fs::create_dir(at("other")).unwrap();
    std::fs::copy(at("a.png"), at("other/a.png")).unwrap();
    let pose = r#"[{"t_x":0,"t_y":0,"weight":1}]"#;
    let entry = format!(r#"{{"frame":"a.png","width":64,"height":48,"focal_px":80,"poses":{pose}}}"#);
    std::fs::write(at("a-tsf.json"), format!(r#"{{"format":"unshaken-tsf","version":1,"frames":[{entry}]}}"#)).unwrap();
    std::fs::write(at("two-tsf.json"), format!(r#"{{"format":"unshaken-tsf","version":1,"frames":[{entry},{entry}]}}"#)).unwrap();
    dir
}

/// Runs each case, of one line of arguments, in a fresh folder: exit code, one line of error that holds all of `words`,
/// and nothing written or changed.
fn assert_refused(cases: &[(&str, i32, &[&str])]) {
    let dir = folder();
    let before = listing(dir.path());
    for (line, code, words) in cases {
        let out = unshaken(dir.path(), &line.split_whitespace().collect::<Vec<_>>());
        let text = String::from_utf8_lossy(&out.stderr);
        let errors: Vec<_> = text.lines().filter(|l| l.starts_with("error:")).collect();
        assert_eq!(out.status.code(), Some(*code), "{line}: {text}");
        assert!(errors.len() == 1 && text.lines().last() == Some(errors[0]), "{line}: {text}");
        for word in *words {
            assert!(errors[0].contains(word), "{line}: {:?} lacks {word:?}", errors[0]);
        }
        assert_eq!(listing(dir.path()), before, "{line}");
        assert_eq!(std::fs::read_to_string(dir.path().join("there.exr")).unwrap(), "old", "{line}");
    }
}

#[test]
fn frames_that_make_no_bracket_are_refused() {
    assert_refused(&[
        ("merge -o x.exr --exposures 1,2 a.png none.png", 1, &["none.png", "cannot be read"]),
        ("merge -o x.exr --exposures 1,2 a.png cut.png", 1, &["cut.png", "truncated", "copy it again"]),
        ("merge -o x.exr --exposures 1,2 a.png text.png", 1, &["text.png", "not a picture", "PNG, JPEG or TIFF"]),
        ("merge -o x.exr --exposures 1,2 a.png small.png", 1, &["small.png", "32 x 48", "64 x 48", "one size"]),
        ("merge -o x.exr --exposures 1 a.png", 1, &["a.png", "only frame", "at least two"]),
        ("merge -o x.exr --exposures 1,1 a.png b.png", 1, &["a.png", "same exposure time", "--exposures"]),
        ("merge -o x.exr a.png b.png", 1, &["a.png", "no exposure time", "--exposures"]),
        ("merge -o x.exr --exposures 1,2 white1.png white2.png", 1, &["white1.png", "clipped", "shorter"]),
        ("merge -o x.exr --exposures 1,2 black1.png black2.png", 1, &["black1.png", "black", "longer"]),
        ("calibrate -o x.json --exposures 1,2 a.png none.png", 1, &["none.png", "cannot be read"]),
        ("calibrate -o x.json --exposures 1,2 black1.png b.png", 1, &["black1.png", "too few pixels", "closer"]),
        ("merge -o x.exr --exposures 1,2 a.png ./a.png", 2, &["a.png", "given twice", "frames 1 and 2"]),
    ]);
}

#[test]
fn wrong_options_are_usage_errors() {
    assert_refused(&[
        ("", 2, &["no command", "--help"]),
        ("merge a.png b.png", 2, &["--output", "--help"]),
        ("merge -o x.exr", 2, &["FRAME"]),
        ("merge -o x.exr --overwrit a.png b.png", 2, &["--overwrit", "'--overwrite'"]),
        ("merge -o x.exr --exposures 1,2,3 a.png b.png", 2, &["--exposures", "3 times for 2 frames", "one time in seconds per frame"]),
        ("merge -o x.exr --exposures 0,1 a.png b.png", 2, &["--exposures", "frame 1 (a.png)", "positive", "1/30"]),
        ("merge -o x.exr --exposures 1,-1 a.png b.png", 2, &["frame 2 (b.png)", "positive"]),
        ("merge -o x.exr --exposures -1,1 a.png b.png", 2, &["frame 1 (a.png)", "positive"]),
        ("merge -o x.exr --exposures 1/0,1 a.png b.png", 2, &["\"1/0\"", "positive"]),
        ("merge -o x.exr --exposures 1,nan a.png b.png", 2, &["\"nan\"", "positive"]),
        ("merge -o x.exr --exposures 1,,2 a.png b.png c.png", 2, &["frame 2 (b.png)", "is not a number"]),
        ("merge -o x.exr --exposures 1,2 --reference 3 a.png b.png", 2, &["--reference", "no frame 3", "from 1 to 2"]),
        ("merge -o x.exr --exposures 1,2 --sharp 0 a.png b.png", 2, &["--sharp", "no frame 0", "from 1 to 2"]),
        ("merge -o x.exr --exposures 1,2 --sharp -1 a.png b.png", 2, &["--sharp", "\"-1\" is not a frame number"]),
        ("merge -o x.exr --exposures 1,2 --exclude 1,1 a.png b.png", 2, &["--exclude", "frame 1 is named twice"]),
        ("merge -o x.exr --exposures 1,2 --sharp 1,2 --exclude 2 a.png b.png", 2, &["--sharp and --exclude", "frame 2 (b.png)"]),
        ("merge -o x.exr --exposures 1,2 --reference 2 --exclude 2 a.png b.png", 2, &["--reference", "frame 2 (b.png)"]),
        ("merge -o x.exr --exposures 1,2 --exclude 1,2 a.png b.png", 2, &["--exclude", "all 2 frames"]),
        ("merge -o x.exr --exposures 1,2 --alpha 1.5 a.png b.png", 2, &["--alpha", "from 0 to 1"]),
        ("merge -o x.exr --exposures 1,2 --response gamma:0 a.png b.png", 2, &["--response", "gamma:2.2"]),
        ("merge -o x.exr --exposures 1,2 --report x.exr a.png b.png", 2, &["both --output and --report", "x.exr"]),
        ("merge -o ./a.png --overwrite --exposures 1,2 a.png b.png", 2, &["--output", "frame", "a.png"]),
        ("merge -o x.exr --preview tsf.json --tsf tsf.json --overwrite --exposures 1,2 a.png b.png", 2, &["--preview", "TSF file"]),
    ]);
}

#[test]
fn files_of_another_kind_are_refused() {
    assert_refused(&[
        ("merge -o x.exr --exposures 1,2 --response tsf.json a.png b.png", 1, &["tsf.json", "unshaken-tsf", "unshaken calibrate"]),
        ("merge -o x.exr --exposures 1,2 --response a.png a.png b.png", 1, &["a.png", "not a text file"]),
        ("merge -o x.exr --exposures 1,2 --response none.json a.png b.png", 1, &["none.json", "srgb, linear, gamma:"]),
        ("merge -o x.exr --exposures 1,2 --tsf response.json a.png b.png", 1, &["response.json", "unshaken-tsf"]),
        ("merge -o x.exr --exposures 1,2 --tsf tsf.json a.png b.png", 1, &["tsf.json", "no TSF of any of the frames (a.png, b.png)"]),
        ("merge -o x.exr --exposures 1,2 --tsf two-tsf.json a.png b.png", 1, &["two-tsf.json", "two TSFs of \"a.png\""]),
        ("merge -o x.exr --exposures 1,2 --tsf a-tsf.json a.png other/a.png", 1, &["a-tsf.json", "2 frames share"]),
    ]);
}

#[test]
fn outputs_are_refused_before_the_work() {
    assert_refused(&[
        ("merge -o there.exr --exposures 1,2 a.png b.png", 1, &["there.exr", "exists", "--overwrite"]),
        ("merge -o x.exr --report there.exr --exposures 1,2 a.png b.png", 1, &["there.exr", "exists", "--overwrite"]),
        ("merge -o none/x.exr --exposures 1,2 a.png b.png", 1, &["none/x.exr", "does not exist"]),
        ("merge -o a.png/x.exr --exposures 1,2 a.png b.png", 1, &["a.png/x.exr", "not a folder"]),
        ("merge -o other --overwrite --exposures 1,2 a.png b.png", 1, &["other", "is a folder"]),
        ("calibrate -o there.exr --exposures 1,2 a.png b.png", 1, &["there.exr", "exists", "--overwrite"]),
    ]);
    if cfg!(target_os = "linux") {
        assert_refused(&[("merge -o /proc/x.exr --exposures 1,2 a.png b.png", 1, &["/proc/x.exr", "takes no new file"])]);
    }
}

#[test]
fn help_and_version_succeed() {
    for arguments in [["--help"].as_slice(), &["--version"], &["merge", "--help"], &["calibrate", "--help"]] {
        let out = unshaken(Path::new("."), arguments);
        assert!(out.status.success() && !out.stdout.is_empty() && out.stderr.is_empty(), "{arguments:?}");
    }
}

#[test]
fn calibrate_writes_a_response_file() {
    let dir = folder();
    let arguments = ["calibrate", "--exposures", "1/30,1/8,0.5", "-o", "r.json", "a.png", "b.png", "c.png"];
    let out = unshaken(dir.path(), &arguments);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    assert!(String::from_utf8_lossy(&out.stdout).starts_with("wrote r.json"));
    let text = std::fs::read_to_string(dir.path().join("r.json")).unwrap();
    let file = unshaken::response::ResponseFile::parse(&text).unwrap();
    assert_eq!(file.provenance.frames, ["a.png", "b.png", "c.png"]);
    assert_eq!(file.provenance.exposure_times, [1.0 / 30.0, 0.125, 0.5]);
    let middle = file.response().inverse(1, 0.5);
    assert!((middle / 0.5f64.powf(2.2) - 1.0).abs() < 0.1, "{middle}");

    assert_eq!(unshaken(dir.path(), &arguments).status.code(), Some(1), "a second time it exists");
    assert!(unshaken(dir.path(), &[&arguments[..], &["--overwrite"]].concat()).status.success());
}

#[test]
fn calibrate_reads_exposure_times_from_exif() {
    let Some(office) = shared("data/brackets/office") else { return };
    let dir = tempdir().unwrap();
    let frames: Vec<_> = (1..=6).map(|i| office.join(format!("office_{i}.jpg")).display().to_string()).collect();
    let mut arguments = vec!["calibrate", "-o", "r.json"];
    arguments.extend(frames.iter().map(String::as_str));
    let out = unshaken(dir.path(), &arguments);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
}
