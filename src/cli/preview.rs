//! `unshaken preview`: the window, and `merge` behind it.

use super::args::{Command, MergeArgs, PreviewArgs};
use super::merge::{self, Asked};
use super::options::{self, Parsed, Refused};
use crate::colour::{self, Primaries};
use crate::exposure::Bracket;
use crate::pipeline::{Event, Outcome, Settings};
use crate::preview::{self, Opened, Program, session::Recent};
use std::ffi::OsString;
use std::sync::Arc;

pub(super) fn run(args: &PreviewArgs) -> anyhow::Result<()> {
    let size = match args.size.as_deref() {
        None => None,
        Some(word) => {
            let sides = word.split_once('x').and_then(|(w, h)| Some((w.parse::<f32>().ok()?, h.parse::<f32>().ok()?)));
            let fits = |s: &(f32, f32)| [s.0, s.1].iter().all(|v| (200.0..=16_000.0).contains(v));
            Some(sides.filter(fits).ok_or_else(|| super::Usage(format!("--size: {word:?} is not a size such as 1440x900")))?)
        }
    };
    for file in &args.files {
        // Whatever else is wrong with a file is said in the window.
        if !file.exists() {
            return Err(super::Usage(format!("{}: does not exist; check the name", file.display())).into());
        }
    }
    let options = preview::Options {
        files: args.files.clone(),
        screenshot: args.screenshot.clone(),
        size,
        blur: args.blur,
        light: args.theme.as_deref().map(|t| t == "light"),
        recent: Recent::usual_file(),
    };
    preview::run(&options, Arc::new(Merge))
}

/// `unshaken merge` for the window.
pub struct Merge;

fn understood(arguments: &[OsString]) -> anyhow::Result<Box<MergeArgs>> {
    let mut line: Vec<OsString> = vec!["unshaken".into(), "merge".into()];
    line.extend_from_slice(arguments);
    match options::parse(line) {
        Ok(Parsed::Line(line)) => match line.line.command {
            Command::Merge(args) => Ok(args),
            _ => anyhow::bail!("these are no arguments of merge"),
        },
        Ok(Parsed::Print(_)) => anyhow::bail!("these arguments only print"),
        Err(Refused::Clap(e)) => Err(super::usage_of(&e).into()),
        Err(Refused::Other(e)) => Err(e),
    }
}

fn own(opened: &Opened) -> anyhow::Result<&merge::Opened> {
    opened.more.downcast_ref().ok_or_else(|| anyhow::anyhow!("these frames were opened by another program"))
}

impl Program for Merge {
    fn open(&self, arguments: &[OsString], events: &mut dyn FnMut(Event) -> bool) -> anyhow::Result<Opened> {
        let args = understood(arguments)?;
        let opened = Asked::of(&args)?.read()?.open(events)?;
        let back = colour::inverse(&Primaries::Rec709.to_xyz()).expect("standard primaries");
        Ok(Opened {
            bracket: opened.bracket.clone(),
            response: opened.response.clone(),
            to_display: colour::product(&back, &opened.to_xyz[0]),
            more: Arc::new(opened),
        })
    }

    fn settings(&self, arguments: &[OsString], opened: &Opened) -> anyhow::Result<Settings> {
        let args = understood(arguments)?;
        Asked::of(&args)?.read()?.settings(own(opened)?)
    }

    fn write(
        &self,
        arguments: &[OsString],
        opened: &Opened,
        bracket: &Bracket,
        outcome: &Outcome,
        warnings: &[String],
    ) -> anyhow::Result<String> {
        let args = understood(arguments)?;
        let asked = Asked::of(&args)?;
        let targets = asked.outputs()?;
        let job = asked.read()?;
        let mut said = Vec::new();
        let text = job.write(&targets, own(opened)?, bracket, outcome, warnings, &mut |event| {
            if let Event::Warning(text) = event {
                said.push(text);
            }
            true
        })?;
        Ok(std::iter::once(text).chain(said).collect::<Vec<_>>().join("; "))
    }
}
