//! The command line: arguments, one file per command, progress. The only place that prints.
//!
//! Exit code 0: done; 1: failed; 2: the command line itself is wrong; 3: done, but not as asked (`--strict`). An error is one line on standard error.

mod adapters;
mod args;
mod baseline;
mod calibrate;
mod compare;
pub mod demo;
mod experiment;
mod frames;
mod merge;
mod progress;
mod response;
mod synth;

use crate::pipeline::Event;
use clap::Parser;
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
    /// Something was written, but frames had to be left out, and the user wants to know: exit code 3.
    Degraded,
}

/// Runs the program on the process's arguments.
pub fn run() -> ExitCode {
    let line = match args::CommandLine::try_parse() {
        Ok(line) => line,
        Err(e) if !e.use_stderr() => {
            // Help and version; nothing is left to do if even they cannot be printed.
            let _ = e.print();
            return ExitCode::SUCCESS;
        }
        Err(e) => return report(&usage_of(&e).into()),
    };
    let done = match line.command {
        args::Command::Merge(a) => merge::run(&a),
        args::Command::Calibrate(a) => calibrate::run(&a).map(|()| Done::AsAsked),
        args::Command::Demo(a) => with_progress(|events| demo::run(&a.output_dir, events)).map(|text| {
            println!("{text}");
            Done::AsAsked
        }),
        args::Command::Synth(a) => synth::run(&a).map(|()| Done::AsAsked),
        args::Command::Compare(a) => compare::run(&a).map(|()| Done::AsAsked),
        args::Command::Baseline(a) => baseline::run(&a).map(|()| Done::AsAsked),
        args::Command::Experiment(a) => experiment::run(&a).map(|()| Done::AsAsked),
        args::Command::Adapters => adapters::run().map(|()| Done::AsAsked),
    };
    match done {
        Ok(Done::AsAsked) => ExitCode::SUCCESS,
        Ok(Done::Degraded) => ExitCode::from(3),
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
        }
        true
    })
}

fn report(e: &anyhow::Error) -> ExitCode {
    eprintln!("error: {}", one_line(&format!("{e:#}")));
    ExitCode::from(if e.is::<Usage>() { 2 } else { 1 })
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
