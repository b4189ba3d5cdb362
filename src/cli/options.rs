//! The command line with what configuration files and presets add to it.
//!
//! A configuration is a TOML file whose keys are the long options of `merge`, without dashes before them; a `[preset.NAME]` table holds
//! options for `--preset NAME`. What the command line says comes before the preset, the preset before the file, the file before the
//! defaults. Paths in it are relative to the current folder, as on the command line.

use super::Usage;
use super::args::CommandLine;
use anyhow::Context;
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command, CommandFactory, FromArgMatches};
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// A command line, understood.
pub(super) struct Line {
    pub line: CommandLine,
    /// What `batch` was told of the options of `merge`, for each merge.
    pub merge_options: Vec<OsString>,
}

pub(super) enum Parsed {
    Line(Box<Line>),
    /// Only to be printed.
    Print(String),
}

pub(super) enum Refused {
    Clap(clap::Error),
    Other(anyhow::Error),
}

impl From<clap::Error> for Refused {
    fn from(e: clap::Error) -> Self {
        Self::Clap(e)
    }
}

/// Options of `merge` that say where one bracket's files are, or what a configuration cannot hold.
const OF_ONE_RUN: [&str; 6] = ["output", "config", "preset", "print_config", "help", "version"];
/// Those that `batch` chooses by itself.
const BATCH_CHOOSES: [&str; 5] = ["output", "preview", "report", "report_html", "tsf"];

/// Built-in presets.
const PRESETS: [(&str, &str); 2] = [("archive", "primaries = \"acescg\"\nlayers = true\n"), ("small", "half = true\n")];

/// The command line's description; `batch` understands the options of `merge`.
pub(super) fn command() -> Command {
    let command = CommandLine::command();
    let merge = command.find_subcommand("merge").expect("ours").clone();
    command.mut_subcommand("batch", |batch| {
        let own: Vec<String> = batch.get_arguments().map(|a| a.get_id().to_string()).collect();
        let more: Vec<Arg> = merge
            .get_arguments()
            .filter(|a| {
                a.get_long().is_some() && !own.iter().any(|o| a.get_id() == o.as_str()) && !BATCH_CHOOSES.contains(&a.get_id().as_str())
            })
            .map(|a| a.clone().required(false).help_heading("Options of merge"))
            .collect();
        batch.args(more)
    })
}

/// Understands the process's arguments, the program's name first.
pub(super) fn parse(arguments: Vec<OsString>) -> Result<Parsed, Refused> {
    let printing = arguments.iter().any(|a| a == "--print-config");
    let mut command = command();
    if printing {
        let free = |c: Command, ids: &[&'static str]| ids.iter().fold(c, |c, id| c.mut_arg(*id, |a| a.required(false)));
        command = command.mut_subcommand("merge", |c| free(c, &["frames", "output"])).mut_subcommand("batch", |c| {
            c.mut_arg("output_dir", |a| a.required(false)).mut_arg("photographs", |a| Arg::new(a.get_id().clone()).num_args(0..))
        });
    }
    let mut matches = command.clone().try_get_matches_from(&arguments)?;
    let name = matches.subcommand_name().unwrap_or_default().to_string();
    if name == "merge" || name == "batch" {
        let name = name.as_str();
        let sub = matches.subcommand_matches(name).expect("its name is there");
        let described = command.find_subcommand(name).expect("matched").clone();
        let added = configured(&described, sub, printing).map_err(Refused::Other)?;
        if !added.is_empty() {
            let at = arguments.iter().skip(1).position(|a| a == name).map_or(arguments.len(), |i| i + 2);
            let mut all = arguments.clone();
            all.splice(at..at, added);
            matches = command.clone().try_get_matches_from(all)?;
        }
        let sub = matches.subcommand_matches(name).expect("matched before");
        if printing {
            return Ok(Parsed::Print(in_force(&described, sub)));
        }
    }
    let merge_options = match matches.subcommand() {
        Some(("batch", sub)) => passed_on(command.find_subcommand("merge").expect("ours"), sub),
        _ => Vec::new(),
    };
    let line = CommandLine::from_arg_matches(&matches)?;
    Ok(Parsed::Line(Box::new(Line { line, merge_options })))
}

/// What the configuration and the preset add to the command line. Unless it is only printed: how pictures are made does not matter to a merge
/// that makes none, nor a gain map to one that makes a PNG.
fn configured(command: &Command, sub: &ArgMatches, printing: bool) -> anyhow::Result<Vec<OsString>> {
    let named = sub.get_one::<PathBuf>("config");
    let path = match named {
        Some(p) if p == Path::new("none") => None,
        Some(p) => Some(p.clone()),
        None => default_file().filter(|p| p.is_file()),
    };
    let mut file = match &path {
        None => Table::new(),
        Some(p) => crate::io::read_text(p)?
            .parse::<Table>()
            .map_err(|e| anyhow::anyhow!("{}: is not a configuration in TOML ({})", p.display(), e.message()))?,
    };
    let shown = path.as_deref().unwrap_or(Path::new("configuration")).display().to_string();
    let presets = match file.remove("preset") {
        None => Table::new(),
        Some(Value::Table(t)) => t,
        Some(_) => anyhow::bail!("{shown}: preset is not a table; write [preset.NAME] and its options below"),
    };
    let mut tables = Vec::new();
    if let Some(name) = sub.get_one::<String>("preset") {
        let built_in = PRESETS.iter().find(|p| p.0 == name).map(|p| p.1.parse::<Table>().expect("ours"));
        let table = match (presets.get(name), built_in) {
            (Some(Value::Table(t)), _) => t.clone(),
            (None, Some(t)) => t,
            _ => {
                let known: Vec<&str> = presets.keys().map(String::as_str).chain(PRESETS.iter().map(|p| p.0)).collect();
                return Err(Usage(format!("--preset: there is no preset {name:?}; there are {}", known.join(", "))).into());
            }
        };
        tables.push((format!("preset {name}"), table));
    }
    tables.push((shown, file));
    let merge = super::options::command().find_subcommand("merge").expect("ours").clone();
    let from_line = |id: &str| sub.try_contains_id(id).unwrap_or(false) && sub.value_source(id) == Some(ValueSource::CommandLine);
    let idle = |key: &str| {
        let (Some(line), false) = (sub.try_get_one::<PathBuf>("preview").ok(), printing) else { return false };
        let named = tables.iter().find_map(|(_, table)| table.get("preview")?.as_str()).map(PathBuf::from);
        let ending = line.cloned().or(named).map(|p| crate::io::output::ending(&p));
        match key {
            "tonemap" => ending.is_none(),
            "gain-map" => ending.is_none_or(|e| e == "png"),
            _ => false,
        }
    };
    let (mut arguments, mut seen) = (Vec::new(), Vec::new());
    for (source, table) in &tables {
        for (key, value) in table {
            let known =
                |c: &Command| c.get_arguments().find(|a| a.get_long() == Some(key) && !OF_ONE_RUN.contains(&a.get_id().as_str())).cloned();
            let Some(arg) = known(&merge) else {
                anyhow::bail!("{source}: {key:?} is no option of merge that a configuration can hold; see 'unshaken merge --help'");
            };
            let overridden = from_line(arg.get_id().as_str())
                || command
                    .get_arg_conflicts_with(&arg)
                    .iter()
                    .any(|c| from_line(c.get_id().as_str()) || seen.contains(&c.get_id().to_string()));
            // Another command may not have the option.
            if overridden || idle(key) || seen.contains(&arg.get_id().to_string()) || known(command).is_none() {
                continue;
            }
            seen.push(arg.get_id().to_string());
            arguments.extend(argument(&arg, value).with_context(|| format!("{source}: {key}"))?);
        }
    }
    Ok(arguments)
}

/// An option with the value that a TOML file gives it.
pub(super) fn argument(arg: &Arg, value: &Value) -> anyhow::Result<Vec<OsString>> {
    let long = arg.get_long().expect("only options are configured");
    let flag = matches!(arg.get_action(), ArgAction::SetTrue);
    let word = |v: &Value| match v {
        Value::String(s) => Ok(s.clone()),
        Value::Integer(i) => Ok(i.to_string()),
        Value::Float(x) => Ok(x.to_string()),
        other => Err(anyhow::anyhow!("{other} is no value of an option; give a number or a text")),
    };
    let option = |text: String| OsString::from(format!("--{long}={text}"));
    Ok(match value {
        Value::Boolean(true) if flag => vec![format!("--{long}").into()],
        Value::Boolean(false) if flag => vec![],
        _ if flag => anyhow::bail!("{value} is neither true nor false"),
        // An option that may be given several times, or one whose value is a list.
        Value::Array(list) if repeats(arg) => list.iter().map(|v| word(v).map(option)).collect::<anyhow::Result<_>>()?,
        Value::Array(list) => vec![option(list.iter().map(word).collect::<anyhow::Result<Vec<_>>>()?.join(","))],
        other => vec![option(word(other)?)],
    })
}

fn repeats(arg: &Arg) -> bool {
    matches!(arg.get_action(), ArgAction::Append)
}

/// The options, as on a command line, that a configuration's text stands for, presets left aside.
///
/// # Errors
/// Why it is no configuration, in words that follow the file's name.
pub fn configured_options(text: &str) -> Result<Vec<String>, String> {
    let table = text.parse::<Table>().map_err(|e| format!("is not a configuration in TOML ({})", e.message()))?;
    let options = of_manifest(&table).map_err(|e| format!("{e:#}"))?;
    Ok(options.into_iter().map(|o| o.to_string_lossy().into_owned()).collect())
}

/// Options for one bracket's merge from the keys of a manifest.
pub(super) fn of_manifest(table: &Table) -> anyhow::Result<Vec<OsString>> {
    let merge = command().find_subcommand("merge").expect("ours").clone();
    let mut all = Vec::new();
    for (key, value) in table {
        let skip =
            |a: &&Arg| OF_ONE_RUN.contains(&a.get_id().as_str()) || ["preview", "report", "report_html"].contains(&a.get_id().as_str());
        let arg = merge.get_arguments().find(|a| a.get_long() == Some(key)).filter(|a| !skip(a));
        let arg = arg.with_context(|| format!("{key:?} is no option of merge that a manifest can hold"))?;
        all.extend(argument(arg, value).with_context(|| key.clone())?);
    }
    Ok(all)
}

/// The options of `merge` among those of `batch`.
fn passed_on(merge: &Command, sub: &ArgMatches) -> Vec<OsString> {
    let mut all = Vec::new();
    for arg in merge.get_arguments() {
        let id = arg.get_id().as_str();
        let (Some(long), true) = (arg.get_long(), sub.try_contains_id(id).unwrap_or(false)) else { continue };
        if OF_ONE_RUN.contains(&id) || BATCH_CHOOSES.contains(&id) || sub.value_source(id) != Some(ValueSource::CommandLine) {
            continue;
        }
        if matches!(arg.get_action(), ArgAction::SetTrue) {
            all.push(format!("--{long}").into());
            continue;
        }
        for value in sub.get_raw(id).into_iter().flatten() {
            let mut word = OsString::from(format!("--{long}="));
            word.push(value);
            all.push(word);
        }
    }
    all
}

/// The options in force, as a configuration.
fn in_force(command: &Command, sub: &ArgMatches) -> String {
    let mut text = String::from("# The options in force. Command line, then --preset, then this file, then defaults.\n");
    for arg in command.get_arguments() {
        let id = arg.get_id().as_str();
        let Some(long) = arg.get_long().filter(|_| !OF_ONE_RUN.contains(&id) && !arg.is_global_set()) else { continue };
        let set = sub.try_contains_id(id).unwrap_or(false) && sub.value_source(id).is_some();
        let help = arg.get_help().map(|h| h.to_string()).unwrap_or_default();
        if matches!(arg.get_action(), ArgAction::SetTrue) {
            text += &format!("# {help}\n{long} = {}\n", sub.get_flag(id));
        } else if set {
            let values: Vec<&OsStr> = sub.get_raw(id).into_iter().flatten().collect();
            let words = values.iter().map(|v| v.to_string_lossy().into_owned());
            let value = if repeats(arg) {
                Value::Array(words.map(Value::String).collect())
            } else {
                Value::String(words.collect::<Vec<_>>().join(","))
            };
            text += &format!("# {help}\n{long} = {value}\n");
        } else {
            text += &format!("# {help}\n# {long} = \"...\"\n");
        }
    }
    text
}

/// `unshaken/config.toml` in the user's configuration folder.
fn default_file() -> Option<PathBuf> {
    let folder = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|p| p.is_absolute());
    let base = folder("XDG_CONFIG_HOME").or_else(|| folder("APPDATA")).or_else(|| folder("HOME").map(|h| h.join(".config")))?;
    Some(base.join("unshaken").join("config.toml"))
}
