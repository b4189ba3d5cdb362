use super::support::{Times, frames};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use unshaken::preview::session::{History, Recent, Session};

fn session() -> Session {
    Session::of(["a b.png", "b.png", "c.png"].map(PathBuf::from).to_vec())
}

#[test]
fn undo_takes_back_one_edit_at_a_time_and_a_drag_at_once() {
    let mut history = History::default();
    let mut now = session();
    let edit = |history: &mut History, now: &mut Session, about: &str, time: f64, f: &dyn Fn(&mut Session)| {
        let before = now.clone();
        f(now);
        history.edited(before, about, time);
    };
    edit(&mut history, &mut now, "frames 1", 1.0, &|s| s.shots[0].excluded = true);
    for step in 0..5 {
        edit(&mut history, &mut now, "lambda", 2.0 + 0.1 * f64::from(step), &|s| s.parameters.lambda += 1.0);
    }
    assert_eq!(now.parameters.lambda, 7.5);
    now = history.undo(&now).unwrap();
    assert_eq!((now.parameters.lambda, now.shots[0].excluded), (2.5, true), "the slider's drag is one edit");
    now = history.undo(&now).unwrap();
    assert_eq!(now, session());
    assert!(!history.can_undo());
    now = history.redo(&now).unwrap();
    now = history.redo(&now).unwrap();
    assert_eq!(now.parameters.lambda, 7.5);
    edit(&mut history, &mut now, "alpha", 9.0, &|s| s.parameters.alpha = 0.5);
    assert!(!history.can_redo(), "a new edit ends what could be made again");
}

#[test]
fn a_session_file_holds_everything_and_finds_frames_beside_itself() {
    let folder = tempfile::tempdir().unwrap();
    let mut one = session();
    one.shots[1].sharp = true;
    one.shots[2].exposure_time = Some(0.5);
    one.parameters.model = "rigid".into();
    one.patches = vec![(3, 4)];
    one.look.exposure = -1.5;
    let path = folder.path().join("s.json");
    one.save(&path).unwrap();
    let read = Session::open(&path).unwrap();
    assert_eq!(read.shots[0].path, folder.path().join("a b.png"));
    let plain = |s: &Session| Session { shots: Vec::new(), ..s.clone() };
    assert_eq!(plain(&read), plain(&one));
    assert_eq!((read.shots[1].sharp, read.shots[2].exposure_time), (true, Some(0.5)));
    std::fs::write(&path, "{\"format\":\"other\",\"version\":1,\"session\":{}}").unwrap();
    assert!(Session::open(&path).unwrap_err().to_string().contains("expected \"unshaken-session\" version 1"));
    std::fs::write(&path, "[").unwrap();
    assert!(Session::open(&path).unwrap_err().to_string().contains("is no session"));
}

#[test]
fn recent_files_are_kept_latest_first() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("state/recent.json");
    let mut recent = Recent::load(Some(file.clone()));
    assert!(recent.entries.is_empty());
    for name in ["/a", "/b", "/a"] {
        recent.add(vec![name.into()]);
    }
    let again = Recent::load(Some(file));
    assert_eq!(again.entries, [[PathBuf::from("/a")], [PathBuf::from("/b")]]);
}

#[test]
fn a_command_line_says_what_differs_and_quotes_for_a_shell() {
    let mut s = session();
    assert_eq!(
        s.arguments(&[None; 3], Path::new("o.exr")),
        ["--config=none", "--output", "o.exr", "--", "a b.png", "b.png", "c.png"].map(OsString::from)
    );
    s.shots[0].exposure_time = Some(1.0 / 30.0);
    s.shots[1].excluded = true;
    s.parameters.lambda = 5.0;
    s.parameters.divisor = 3;
    let line = s.command_line(&[None, Some(0.25), Some(2.0)], Path::new("o.exr"));
    for part in
        ["--exposures=0.03333333333333333,0.25,2", "--exclude=2", "--lambda=5", "--scale=0.3333", "--preview o.png", "-- 'a b.png' b.png"]
    {
        assert!(line.contains(part), "{part} in {line}");
    }
    let table: toml::Table = s.configuration(&[None, Some(0.25), Some(2.0)]).parse().unwrap();
    assert_eq!(table["lambda"].as_str(), Some("5"));
}

/// The program understands every option that a session can hold.
#[test]
fn every_option_of_a_session_is_one_of_merge() {
    let folder = tempfile::tempdir().unwrap();
    let mut s = Session::of(frames(folder.path(), Times::Exif));
    let p = &mut s.parameters;
    (p.lambda, p.robust, p.alpha, p.psf_radius, p.align, p.divisor) = (4.0, 0.5, 0.2, 7, false, 2);
    (p.model, p.blind, p.response, p.reference) = ("rigid".into(), "auto".into(), "srgb".into(), Some(1));
    s.shots[0].sharp = true;
    s.shots[0].exposure_time = Some(0.07);
    s.patches = vec![(50, 40)];
    let noted = [Some(0.0667), Some(0.25), Some(1.0)];
    let file = folder.path().join("c.toml");
    std::fs::write(&file, s.configuration(&noted)).unwrap();
    let program = |arguments: &[OsString]| Command::new(env!("CARGO_BIN_EXE_unshaken")).arg("merge").args(arguments).output().unwrap();
    let mut arguments = s.arguments(&noted, &folder.path().join("o.exr"));
    arguments.insert(0, "--print-config".into());
    let from_line = program(&arguments);
    let said = String::from_utf8_lossy(&from_line.stdout).into_owned();
    assert!(from_line.status.success(), "{}", String::from_utf8_lossy(&from_line.stderr));
    let from_file = program(&["--config".into(), file.into(), "--print-config".into()]);
    let set = |text: &str| -> toml::Table {
        let mut table: toml::Table = text.parse().unwrap();
        table.remove("patch");
        table.remove("tonemap");
        table
    };
    assert_eq!(set(&said), set(&String::from_utf8_lossy(&from_file.stdout)), "line and configuration say the same");
    for (key, value) in
        [("lambda", "4"), ("robust", "0.5"), ("scale", "0.5000"), ("model", "rigid"), ("reference", "2"), ("psf-radius", "7")]
    {
        assert_eq!(set(&said)[key].as_str(), Some(value), "{key}");
    }
}
