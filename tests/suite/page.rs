//! The report page in a real browser (Debian's package chromium): it shows, and its slider moves. Skipped, visibly, where there is none.
#![cfg(target_os = "linux")]

use crate::support::files::scene;
use crate::support::photos::{self, Notes};
use base64::Engine;
use serde_json::{Value, json};
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::Command;
use tempfile::tempdir;

/// A browser that is told what to do through two pipes (the Chrome DevTools protocol, messages that end with a zero byte).
struct Browser {
    process: std::process::Child,
    to: File,
    from: BufReader<File>,
    session: Option<String>,
    id: u64,
}

impl Browser {
    fn open(folder: &Path, page: &Path) -> Self {
        let pipe = |name: &str| {
            let path = folder.join(name);
            assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
            path
        };
        let (to, from) = (pipe("to"), pipe("from"));
        let script = "exec timeout 120 chromium --headless --no-sandbox --disable-gpu --disable-dev-shm-usage --window-size=1200,900 \
                      --remote-debugging-pipe --user-data-dir=profile 3<to 4>from 2>/dev/null";
        let process = Command::new("sh").args(["-c", script]).current_dir(folder).env("HOME", folder).spawn().unwrap();
        let to = File::options().write(true).open(to).unwrap();
        let from = BufReader::new(File::open(from).unwrap());
        let mut browser = Self { process, to, from, session: None, id: 0 };
        let target = browser.call("Target.createTarget", json!({ "url": format!("file://{}", page.display()) }));
        let attached = browser.call("Target.attachToTarget", json!({ "targetId": target["targetId"], "flatten": true }));
        browser.session = attached["sessionId"].as_str().map(str::to_string);
        while browser.value("document.readyState + !!document.getElementById('handle')") != "completetrue" {
            std::thread::sleep(std::time::Duration::from_millis(100));
        }
        browser
    }

    fn call(&mut self, method: &str, params: Value) -> Value {
        self.id += 1;
        let mut message = json!({ "id": self.id, "method": method, "params": params });
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.to.write_all(format!("{message}\0").as_bytes()).unwrap();
        loop {
            let mut bytes = Vec::new();
            assert!(self.from.read_until(0, &mut bytes).unwrap() > 0, "the browser went away at {method}");
            bytes.pop();
            let answer: Value = serde_json::from_slice(&bytes).unwrap();
            if answer["id"] == self.id {
                assert!(answer["error"].is_null(), "{method}: {answer}");
                return answer["result"].clone();
            }
        }
    }

    fn value(&mut self, expression: &str) -> Value {
        self.call("Runtime.evaluate", json!({ "expression": expression, "returnByValue": true }))["result"]["value"].clone()
    }

    fn screenshot(&mut self) -> image::RgbImage {
        let shot = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        let bytes = base64::engine::general_purpose::STANDARD.decode(shot["data"].as_str().unwrap()).unwrap();
        image::load_from_memory(&bytes).unwrap().into_rgb8()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

#[test]
fn the_report_page_shows_and_its_slider_moves() {
    if !Command::new("chromium").arg("--version").output().is_ok_and(|o| o.status.success()) {
        let _ = writeln!(std::io::stderr(), "SKIPPED the_report_page_shows_and_its_slider_moves: chromium is not installed");
        return;
    }
    let dir = tempdir().unwrap();
    let s = scene(90, 60, 1.5);
    let mut noise = crate::support::files::Noise::new(9);
    for (name, time) in [("a.jpg", (1, 30)), ("b.jpg", (1, 1))] {
        let seconds = f64::from(time.0) / f64::from(time.1);
        let picture = image::RgbImage::from_fn(90, 60, |x, y| {
            // Noisy, so that before and after differ.
            let e = f64::from(s.at(x as usize, y as usize)) * seconds + 0.02 * noise.normal();
            image::Rgb([(e.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8; 3])
        });
        photos::write_jpeg(&dir.path().join(name), &picture, &Notes { time: Some(time), ..Notes::default() });
    }
    let arguments =
        ["merge", "--no-align", "--sharp", "1,2", "--response", "gamma:2.2", "-o", "x.exr", "--report-html", "x.html", "a.jpg", "b.jpg"];
    let out = Command::new(env!("CARGO_BIN_EXE_unshaken")).current_dir(dir.path()).args(arguments).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));

    let mut browser = Browser::open(dir.path(), &dir.path().join("x.html"));
    assert_eq!(browser.value("[...document.images].filter(i => !i.complete || i.naturalWidth == 0).length"), 0, "every picture decodes");
    assert!(
        browser.value("document.images.length").as_f64() >= Some(8.0),
        "{} pictures; {}",
        browser.value("document.images.length"),
        String::from_utf8_lossy(&out.stderr)
    );
    assert_eq!(browser.value("document.documentElement.scrollWidth <= window.innerWidth"), true, "nothing sticks out");
    let rectangle = browser.value("(r => [r.left, r.top, r.width, r.height])(document.getElementById('slider').getBoundingClientRect())");
    let [left, top, width, height] = std::array::from_fn(|i| rectangle[i].as_f64().unwrap());
    assert!(width > 500.0 && height > 200.0, "{rectangle}");
    let before = browser.screenshot();
    if let Some(folder) = std::env::var_os("UNSHAKEN_PICTURES") {
        before.save(Path::new(&folder).join("page.png")).unwrap();
    }
    // From the middle to a fifth from the left: what lies between shows the result now.
    let (x, y) = (left + 0.2 * width, top + 0.5 * height);
    for kind in ["mousePressed", "mouseReleased"] {
        browser.call("Input.dispatchMouseEvent", json!({ "type": kind, "x": x, "y": y, "button": "left", "clickCount": 1 }));
    }
    let place = browser.value("parseFloat(document.getElementById('handle').value)").as_f64();
    assert!(place.is_some_and(|v| (v - 200.0).abs() < 25.0), "the handle is at {place:?} of 1000");
    let after = browser.screenshot();
    let changed = |from: f64, to: f64| {
        let bottom = (top + height).min(f64::from(before.height())) as u32 - 40;
        let mut sum = 0u64;
        for y in top as u32 + 10..bottom {
            for x in (left + from * width) as u32..(left + to * width) as u32 {
                sum += u64::from(before.get_pixel(x, y).0[1].abs_diff(after.get_pixel(x, y).0[1]));
            }
        }
        sum
    };
    assert!(changed(0.25, 0.45) > 1000, "between the two places the picture changes");
    assert_eq!(changed(0.55, 0.95), 0, "beyond them it does not");
}
