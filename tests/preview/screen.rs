use super::support::{Times, frames};
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// A virtual screen, which ends with this.
struct Screen {
    server: Child,
    name: String,
}

impl Screen {
    fn open() -> Self {
        use std::io::BufRead;
        // The server chooses a free number and tells it.
        let mut server = Command::new("Xvfb")
            .args(["-displayfd", "1", "-screen", "0", "1100x760x24", "-nolisten", "tcp"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("Xvfb; ./setup installs it");
        let mut line = String::new();
        std::io::BufReader::new(server.stdout.take().expect("piped")).read_line(&mut line).expect("a number");
        Self { server, name: format!(":{}", line.trim()) }
    }
}

/// The program's window on `screen`, which saves its picture and closes.
fn preview(screen: &Screen, folder: &Path, picture: &Path) -> Command {
    let mut program = Command::new(env!("CARGO_BIN_EXE_unshaken"));
    program.args(["preview", "--size", "1000x700", "--theme", "dark", "--screenshot"]).arg(picture).args(frames(folder, Times::Exif));
    program.env("DISPLAY", &screen.name).env_remove("WAYLAND_DISPLAY").env("XDG_STATE_HOME", folder);
    program
}

impl Drop for Screen {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

#[test]
fn a_real_window_shows_the_loaded_result_and_saves_its_picture() {
    let folder = tempfile::tempdir().unwrap();
    let (screen, picture) = (Screen::open(), folder.path().join("window.png"));
    let run = preview(&screen, folder.path(), &picture).output().unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let shown = image::open(&picture).unwrap().into_rgb8();
    assert_eq!((shown.width(), shown.height()), (1000, 700));
    // The room is lit: the middle of the window holds a picture of many colours, not a grey field.
    let middle = image::imageops::crop_imm(&shown, 150, 150, 400, 250).to_image();
    let colours: std::collections::BTreeSet<[u8; 3]> = middle.pixels().map(|p| p.0).collect();
    assert!(colours.len() > 500, "{} colours", colours.len());
    if let Some(folder) = std::env::var_os("UNSHAKEN_PICTURES") {
        std::fs::copy(&picture, Path::new(&folder).join("screen.png")).unwrap();
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_window_that_is_resized_while_it_solves_stays_open() {
    use x11rb::connection::Connection;
    use x11rb::protocol::xproto::{ConfigureWindowAux, ConnectionExt, MapState, Window};
    let folder = tempfile::tempdir().unwrap();
    let (screen, picture) = (Screen::open(), folder.path().join("window.png"));
    let mut run = preview(&screen, folder.path(), &picture).stderr(Stdio::piped()).spawn().unwrap();

    let (x, number) = x11rb::connect(Some(&screen.name)).unwrap();
    let root = x.setup().roots[number].root;
    let shown = |w: &Window| x.get_window_attributes(*w).unwrap().reply().is_ok_and(|a| a.map_state == MapState::VIEWABLE);
    let mut times = 0;
    while run.try_wait().unwrap().is_none() {
        let children = x.query_tree(root).unwrap().reply().unwrap().children;
        for window in children.into_iter().filter(shown) {
            let size = ConfigureWindowAux::new().width(if times % 2 == 0 { 820 } else { 1000 }).height(700);
            x.configure_window(window, &size).unwrap();
            times += 1;
        }
        x.flush().unwrap();
        std::thread::sleep(std::time::Duration::from_millis(120));
    }
    let ended = run.wait_with_output().unwrap();
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    assert!(times > 5, "{times} times");
    assert!(picture.exists());
}

#[test]
fn without_a_screen_the_message_says_so() {
    let run =
        Command::new(env!("CARGO_BIN_EXE_unshaken")).arg("preview").env_remove("DISPLAY").env_remove("WAYLAND_DISPLAY").output().unwrap();
    assert_eq!(run.status.code(), Some(1));
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(said.contains("the window cannot be opened") && said.lines().count() == 1, "{said}");
}
