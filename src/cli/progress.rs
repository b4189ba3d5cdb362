//! Progress: one bar on standard error, or a line per stage where that is no terminal.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;

pub(super) struct Progress {
    bar: Option<ProgressBar>,
    stage: String,
}

impl Progress {
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{bar:30} {percent:>3}% {elapsed:>4} {msg}").expect("the template is ours");
            ProgressBar::new(1000).with_style(style)
        });
        Self { bar, stage: String::new() }
    }

    /// `fraction` of the whole is done, and `stage` begins or goes on.
    pub fn at(&mut self, stage: &str, fraction: f32) {
        match &self.bar {
            Some(bar) => {
                bar.set_message(stage.to_owned());
                bar.set_position((fraction.clamp(0.0, 1.0) * 1000.0) as u64);
            }
            None if self.stage != stage => eprintln!("{stage}"),
            None => {}
        }
        if self.stage != stage {
            self.stage = stage.to_owned();
        }
    }

    pub fn warn(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| super::warn(text)),
            None => super::warn(text),
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
