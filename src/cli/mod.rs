//! The command line: arguments, one file per command, progress. The only place that prints.
//!
//! Exit code 0: done; 1: failed; 2: the command line itself is wrong; 3: done but degraded, under `--strict`; 130: interrupted. An error
//! is one line on standard error.

mod adapters;
mod args;
mod baseline;
mod batch;
mod calibrate;
mod compare;
pub mod demo;
mod experiment;
mod frames;
mod generate;
mod given;
mod grouping;
mod interrupt;
mod merge;
mod options;
mod page;
#[cfg(feature = "preview")]
pub mod preview;
mod progress;
mod response;
mod synth;
mod tonemap;

pub use grouping::manifest_brackets;
pub use options::configured_options;

use crate::error::Error;
use crate::pipeline::Event;
use progress::Voice;
use std::process::ExitCode;

/// The command line itself is wrong: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Usage(String);

/// How a command that did not fail ended.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Done {
    /// All is as asked.
    AsAsked,
    /// Something was written, but a stage warned: frames were left out, or nothing could be deblurred.
    Degraded,
}
/// Exit code of a result that is less than it should be, under `--strict`.
const DEGRADED: u8 = 3;

/// Runs the program on the process's arguments.
pub fn run() -> ExitCode {
    let line = match options::parse(std::env::args_os().collect()) {
        Ok(options::Parsed::Line(line)) => line,
        Ok(options::Parsed::Print(text)) => {
            print!("{text}");
            return ExitCode::SUCCESS;
        }
        Err(options::Refused::Clap(e)) if !e.use_stderr() => {
            // Help and version; nothing is left to do if even they cannot be printed.
            let _ = e.print();
            return ExitCode::SUCCESS;
        }
        Err(options::Refused::Clap(e)) => return report(&usage_of(&e).into()),
        Err(options::Refused::Other(e)) => return report(&e),
    };
    progress::set_voice(match (line.line.session.quiet, line.line.session.json) {
        (true, _) => Voice::Quiet,
        (_, true) => Voice::Json,
        _ => Voice::Human,
    });
    interrupt::listen();
    let as_asked = |()| Done::AsAsked;
    let done = match &line.line.command {
        args::Command::Merge(a) => merge::run(a),
        args::Command::Calibrate(a) => calibrate::run(a).map(as_asked),
        args::Command::Demo(a) => with_progress(|events| demo::run(&a.output_dir, events))
            .map(|text| progress::done(&text, serde_json::json!({ "output": a.output_dir })))
            .map(as_asked),
        args::Command::Synth(a) => synth::run(a).map(as_asked),
        args::Command::Compare(a) => compare::run(a).map(as_asked),
        args::Command::Baseline(a) => baseline::run(a).map(as_asked),
        args::Command::Experiment(a) => experiment::run(a).map(as_asked),
        args::Command::Adapters => adapters::run().map(as_asked),
        args::Command::Tonemap(a) => tonemap::run(a).map(as_asked),
        args::Command::Batch(a) => batch::run(a, &line.merge_options),
        #[cfg(feature = "preview")]
        args::Command::Preview(a) => preview::run(a).map(as_asked),
        args::Command::Generate(a) => generate::run(a).map(as_asked),
    };
    match done {
        Ok(Done::AsAsked) => ExitCode::SUCCESS,
        Ok(Done::Degraded) => ExitCode::from(DEGRADED),
        Err(e) => report(&e),
    }
}

/// Runs a job whose events go to the progress bar and to warnings. The bar is gone when it returns.
fn with_progress<T>(job: impl FnOnce(&mut dyn FnMut(Event) -> bool) -> anyhow::Result<T>) -> anyhow::Result<T> {
    let mut progress = progress::Progress::new();
    job(&mut |event| {
        match event {
            Event::Progress { stage, fraction } => progress.at(&stage, fraction),
            Event::Warning(text) => progress.warn(&text),
            Event::Estimate(_) => {}
        }
        !interrupt::asked()
    })
}

fn report(e: &anyhow::Error) -> ExitCode {
    let interrupted = interrupt::asked() && matches!(e.downcast_ref::<Error>(), Some(Error::Cancelled));
    let text = if interrupted { "interrupted; nothing was written".to_string() } else { one_line(&format!("{e:#}")) };
    if progress::voice() == Voice::Json {
        progress::event(&serde_json::json!({ "event": "error", "text": text }));
    }
    eprintln!("error: {text}");
    ExitCode::from(match () {
        () if interrupted => interrupt::INTERRUPTED,
        () if e.is::<Usage>() => 2,
        () => 1,
    })
}

fn warn(text: &str) {
    eprintln!("warning: {}", one_line(text));
}

/// The parser's message in one line: its first paragraph, and its tips. Without arguments the parser would print all
/// of the help.
fn usage_of(e: &clap::Error) -> Usage {
    use clap::error::ErrorKind;
    if matches!(e.kind(), ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand | ErrorKind::MissingSubcommand) {
        return Usage("no command; try 'unshaken demo', 'unshaken merge -o OUT.exr FRAME...' or 'unshaken --help'".into());
    }
    let text = e.render().to_string();
    let first = text.split("\n\n").next().unwrap_or_default();
    let tips = text.lines().map(str::trim).filter(|l| l.starts_with("tip:")).map(|l| format!("; {l}")).collect::<String>();
    Usage(format!("{}{tips}; see 'unshaken --help'", one_line(first.strip_prefix("error: ").unwrap_or(first))))
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
