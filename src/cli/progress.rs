//! Progress: one bar with the time left on standard error, or a line per stage where that is no terminal; JSON lines on standard output
//! or nothing at all when asked.

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};
use std::io::{IsTerminal, Write};
use std::sync::OnceLock;
use std::time::Instant;

/// How the program speaks, for the whole run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Voice {
    /// A bar on a terminal, else lines.
    Human,
    /// Errors only.
    Quiet,
    /// A JSON object per line on standard output.
    Json,
}

static VOICE: OnceLock<Voice> = OnceLock::new();

/// Set once, before anything is said.
pub(super) fn set_voice(voice: Voice) {
    let _ = VOICE.set(voice);
}

pub(super) fn voice() -> Voice {
    VOICE.get().copied().unwrap_or(Voice::Human)
}

/// One JSON line. A reader that has gone away is no reason to stop.
pub(super) fn event(value: &Value) {
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{value}").and_then(|()| out.flush());
}

/// The last word of a command: what was written.
pub(super) fn done(text: &str, more: Value) {
    match voice() {
        Voice::Human => println!("{text}"),
        Voice::Quiet => {}
        Voice::Json => {
            let mut value = json!({ "event": "done", "text": text });
            if let (Some(all), Some(more)) = (value.as_object_mut(), more.as_object()) {
                all.extend(more.clone());
            }
            event(&value);
        }
    }
}

pub(super) struct Progress {
    bar: Option<ProgressBar>,
    stage: String,
    start: Instant,
    told: f32,
}

impl Progress {
    pub fn new() -> Self {
        let bar = (voice() == Voice::Human && std::io::stderr().is_terminal()).then(|| {
            let template = "{bar:30} {percent:>3}% {elapsed:>4}, {eta} left  {msg}";
            let style = ProgressStyle::with_template(template).expect("the template is ours");
            ProgressBar::new(1000).with_style(style)
        });
        Self { bar, stage: String::new(), start: Instant::now(), told: -1.0 }
    }

    /// `fraction` of the whole is done, and `stage` begins or goes on.
    pub fn at(&mut self, stage: &str, fraction: f32) {
        let news = self.stage != stage;
        match (&self.bar, voice()) {
            (Some(bar), _) => {
                bar.set_message(stage.to_owned());
                bar.set_position((fraction.clamp(0.0, 1.0) * 1000.0) as u64);
            }
            (None, Voice::Human) if news => eprintln!("{stage}"),
            // A hundred events, not thousands.
            (None, Voice::Json) if news || fraction - self.told >= 0.01 => {
                let seconds = self.start.elapsed().as_secs_f64();
                let left = (fraction > 0.05).then(|| seconds * f64::from((1.0 - fraction) / fraction));
                event(&json!({ "event": "progress", "stage": stage, "fraction": fraction, "elapsed_s": seconds, "left_s": left }));
                self.told = fraction;
            }
            _ => {}
        }
        if news {
            self.stage = stage.to_owned();
        }
    }

    pub fn warn(&self, text: &str) {
        match (&self.bar, voice()) {
            (_, Voice::Quiet) => {}
            (_, Voice::Json) => event(&json!({ "event": "warning", "text": text })),
            (Some(bar), _) => bar.suspend(|| super::warn(text)),
            (None, _) => super::warn(text),
        }
    }
}

impl Drop for Progress {
    /// An error or the result comes next: the bar makes room.
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
