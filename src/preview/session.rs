//! What the user has said: frames, marks, parameters, look. Undo, files, the same as a command line and as a configuration.

use crate::error::{Error, Result};
use crate::io;
use crate::io::output::Output;
use crate::tonemap::Operator;
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// `format` of a session file.
const FORMAT: &str = "unshaken-session";
/// Edits that can be taken back.
const UNDO: usize = 200;
/// Sessions and frames that are remembered.
const RECENT: usize = 8;

/// One frame and what the user says of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// The file.
    pub path: PathBuf,
    /// Exposure time in seconds that the user gave; `None`: what the file notes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_time: Option<f64>,
    /// Left out.
    #[serde(default)]
    pub excluded: bool,
    /// Said to be sharp.
    #[serde(default)]
    pub sharp: bool,
}

impl Shot {
    /// A frame of which nothing is said.
    pub fn of(path: PathBuf) -> Self {
        Self { path, exposure_time: None, excluded: false, sharp: false }
    }

    /// File name without folder.
    pub fn name(&self) -> String {
        self.path.file_name().unwrap_or(self.path.as_os_str()).to_string_lossy().into_owned()
    }
}

/// Parameters of the merge; each is an option of `merge`, which documents it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Parameters {
    /// `--prior`.
    pub prior: String,
    /// `--lambda`.
    pub lambda: f32,
    /// `--robust`.
    pub robust: f32,
    /// `--alpha`.
    pub alpha: f64,
    /// `--model`.
    pub model: String,
    /// `--psf-radius`; 0: as far as needed.
    pub psf_radius: usize,
    /// Whether frames are registered (`--no-align` otherwise).
    pub align: bool,
    /// Whether ghosts are removed (`--keep-ghosts` otherwise).
    pub deghost: bool,
    /// `--blind`.
    pub blind: String,
    /// `--response`; empty: as `merge` finds it.
    pub response: String,
    /// `--reference`, counted from 0; `None`: found out.
    pub reference: Option<usize>,
    /// The number that `--scale` is one over.
    pub divisor: usize,
    /// `--memory-limit`; empty: all there is.
    pub memory_limit: String,
}

impl Default for Parameters {
    fn default() -> Self {
        let merge = crate::pipeline::Settings::default();
        Self {
            prior: "collaborative".into(),
            lambda: merge.deblur.lambda,
            robust: merge.deblur.robust,
            alpha: merge.alpha,
            model: merge.model.name().into(),
            psf_radius: 0,
            align: merge.align,
            deghost: merge.deghost,
            blind: "auto".into(),
            response: String::new(),
            reference: None,
            divisor: 1,
            memory_limit: String::new(),
        }
    }
}

/// How the result is shown and exported; `--tonemap` of `merge`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Look {
    /// Name of the operator.
    pub curve: String,
    /// EV added to the automatic exposure.
    pub exposure: f32,
    /// 1 keeps the colours.
    pub saturation: f32,
    /// Luminance of the middle of the picture, where the operator has such a parameter.
    pub key: f32,
}

impl Default for Look {
    fn default() -> Self {
        Self { curve: "filmic".into(), exposure: 0.0, saturation: 1.0, key: 0.18 }
    }
}

impl Look {
    /// In the words of `--tonemap`.
    pub fn words(&self) -> String {
        let key = if self.has_key() { format!(",key={}", self.key) } else { String::new() };
        format!("{}:exposure={},saturation={}{key}", self.curve, self.exposure, self.saturation)
    }

    /// Whether the operator knows a luminance of the middle.
    pub fn has_key(&self) -> bool {
        Operator::parse(&self.curve).is_ok_and(|o| o.parameter("key").is_some())
    }

    /// Another operator, whose colours are its own unless they were chosen.
    pub fn choose(&mut self, name: &str) {
        let usual = |name: &str| Operator::parse(name).ok().and_then(|o| o.parameter("saturation"));
        if usual(&self.curve) == Some(self.saturation) {
            self.saturation = usual(name).unwrap_or(self.saturation);
        }
        self.curve = name.into();
    }
}

/// Everything that can be edited, saved and taken back.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Session {
    /// The frames in their order.
    pub shots: Vec<Shot>,
    /// Parameters of the merge.
    pub parameters: Parameters,
    /// Pixels of the full frame at which to look at the blur; empty: chosen.
    pub patches: Vec<(usize, usize)>,
    /// How it is shown.
    pub look: Look,
}

#[derive(Serialize, Deserialize)]
struct File {
    format: String,
    version: u32,
    session: Session,
}

fn numbers(chosen: impl Iterator<Item = usize>) -> String {
    chosen.map(|i| (i + 1).to_string()).collect::<Vec<_>>().join(",")
}

impl Session {
    /// A session of these frames.
    pub fn of(paths: Vec<PathBuf>) -> Self {
        Self { shots: paths.into_iter().map(Shot::of).collect(), ..Self::default() }
    }

    /// The options of `merge` that differ from its defaults, as (name, value); a flag has no value. `noted`: exposure times that the files
    /// note, for those that the user gave none.
    pub fn options(&self, noted: &[Option<f64>]) -> Vec<(&'static str, Option<String>)> {
        let (p, usual) = (&self.parameters, Parameters::default());
        let mut all: Vec<(&'static str, Option<String>)> = Vec::new();
        if self.shots.iter().any(|s| s.exposure_time.is_some()) {
            let time = |(i, s): (usize, &Shot)| s.exposure_time.or(noted.get(i).copied().flatten()).map_or("?".into(), |t| t.to_string());
            all.push(("exposures", Some(self.shots.iter().enumerate().map(time).collect::<Vec<_>>().join(","))));
        }
        if !p.response.is_empty() {
            all.push(("response", Some(p.response.clone())));
        }
        if !p.memory_limit.is_empty() {
            all.push(("memory-limit", Some(p.memory_limit.clone())));
        }
        if let Some(i) = p.reference {
            all.push(("reference", Some((i + 1).to_string())));
        }
        let which = |f: &dyn Fn(&Shot) -> bool| numbers(self.shots.iter().enumerate().filter(|(_, s)| f(s)).map(|(i, _)| i));
        for (name, list) in [("sharp", which(&|s| s.sharp && !s.excluded)), ("exclude", which(&|s| s.excluded))] {
            if !list.is_empty() {
                all.push((name, Some(list)));
            }
        }
        if !p.align {
            all.push(("no-align", None));
        }
        if !p.deghost {
            all.push(("keep-ghosts", None));
        }
        let mut differs = |name, value: String, usual: String| {
            if value != usual {
                all.push((name, Some(value)));
            }
        };
        differs("alpha", p.alpha.to_string(), usual.alpha.to_string());
        differs("model", p.model.clone(), usual.model);
        differs("psf-radius", p.psf_radius.to_string(), usual.psf_radius.to_string());
        differs("prior", p.prior.clone(), usual.prior);
        differs("lambda", p.lambda.to_string(), usual.lambda.to_string());
        differs("robust", p.robust.to_string(), usual.robust.to_string());
        differs("blind", p.blind.clone(), usual.blind);
        if p.divisor > 1 {
            all.push(("scale", Some(format!("{:.4}", 1.0 / p.divisor as f64))));
        }
        all
    }

    /// The arguments of `merge` (without the word itself) that make `output` of this session. No configuration file adds to them.
    pub fn arguments(&self, noted: &[Option<f64>], output: &Path) -> Vec<OsString> {
        let mut all: Vec<OsString> = vec!["--config=none".into(), "--output".into(), output.into()];
        for (name, value) in self.options(noted) {
            all.push(match value {
                Some(value) => format!("--{name}={value}").into(),
                None => format!("--{name}").into(),
            });
        }
        all.extend(self.patches.iter().map(|(x, y)| format!("--patch={x},{y}").into()));
        all.push("--".into());
        all.extend(self.shots.iter().map(|s| s.path.clone().into_os_string()));
        all
    }

    /// The command line for a shell that makes `output` and, beside it, the picture as it is shown.
    pub fn command_line(&self, noted: &[Option<f64>], output: &Path) -> String {
        let mut words: Vec<String> = vec!["unshaken".into(), "merge".into()];
        let mut arguments = self.arguments(noted, output);
        let picture: Vec<OsString> =
            vec![format!("--tonemap={}", self.look.words()).into(), "--preview".into(), output.with_extension("png").into()];
        let at = arguments.iter().position(|a| a == "--").unwrap_or(arguments.len());
        arguments.splice(at..at, picture);
        words.extend(arguments.iter().map(|a| quoted(&a.to_string_lossy())));
        words.join(" ")
    }

    /// The same options as a configuration for `merge --config`.
    pub fn configuration(&self, noted: &[Option<f64>]) -> String {
        let mut table = toml::Table::new();
        for (name, value) in self.options(noted) {
            table.insert(name.into(), value.map_or(toml::Value::Boolean(true), toml::Value::String));
        }
        table.insert("tonemap".into(), self.look.words().into());
        let frames: Vec<String> = self.shots.iter().map(|s| quoted(&s.path.to_string_lossy())).collect();
        let patches: String = self.patches.iter().map(|(x, y)| format!(" --patch={x},{y}")).collect();
        format!(
            "# unshaken merge --config THIS.toml -o OUT.exr --preview OUT.png{patches} {}\n{}",
            frames.join(" "),
            toml::to_string(&table).unwrap_or_default()
        )
    }

    /// Writes a session file.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn save(&self, path: &Path) -> Result<()> {
        let file = File { format: FORMAT.into(), version: 1, session: self.clone() };
        Output::check(path, true)?.stage_json(&file)?.commit()
    }

    /// Reads a session file. Frames that it names relative to itself are looked for beside it.
    ///
    /// # Errors
    /// [`Error::Read`], and [`Error::Format`] for another kind of file.
    pub fn open(path: &Path) -> Result<Self> {
        let refuse = |reason: String| Error::Format { path: path.into(), reason };
        let file: File = serde_json::from_str(&io::read_text(path)?).map_err(|e| refuse(format!("is no session of unshaken ({e})")))?;
        if file.format != FORMAT || file.version != 1 {
            return Err(refuse(format!("has format {:?} version {}; expected {FORMAT:?} version 1", file.format, file.version)));
        }
        let mut session = file.session;
        let folder = path.parent().unwrap_or(Path::new(""));
        for shot in session.shots.iter_mut().filter(|s| s.path.is_relative()) {
            shot.path = folder.join(&shot.path);
        }
        Ok(session)
    }
}

/// A word as a POSIX shell takes it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_./=,:@%+".contains(c);
    if !word.is_empty() && word.chars().all(plain) { word.into() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}

/// A session with the states before and after it.
#[derive(Default)]
pub struct History {
    before: Vec<Session>,
    after: Vec<Session>,
    /// What the last edit was about, and when: a slider's drag is one edit.
    last: Option<(String, f64)>,
}

impl History {
    /// `before` was the state until now; `about`: edits of one thing that follow within a second are one. `now` in seconds.
    pub fn edited(&mut self, before: Session, about: &str, now: f64) {
        let goes_on = self.last.as_ref().is_some_and(|(what, when)| what == about && now - when < 1.0);
        self.last = Some((about.into(), now));
        self.after.clear();
        if !goes_on {
            self.before.push(before);
            let surplus = self.before.len().saturating_sub(UNDO);
            self.before.drain(..surplus);
        }
    }

    /// Whether an edit can be taken back.
    pub fn can_undo(&self) -> bool {
        !self.before.is_empty()
    }

    /// Whether one that was taken back can be made again.
    pub fn can_redo(&self) -> bool {
        !self.after.is_empty()
    }

    /// The state before, for `now`.
    pub fn undo(&mut self, now: &Session) -> Option<Session> {
        let state = self.before.pop()?;
        self.after.push(now.clone());
        self.last = None;
        Some(state)
    }

    /// The state after, for `now`.
    pub fn redo(&mut self, now: &Session) -> Option<Session> {
        let state = self.after.pop()?;
        self.before.push(now.clone());
        self.last = None;
        Some(state)
    }
}

/// Brackets and sessions that were open before, the latest first.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Recent {
    /// The files of each: frames, or one session file.
    pub entries: Vec<Vec<PathBuf>>,
    #[serde(skip)]
    file: Option<PathBuf>,
}

impl Recent {
    /// What `file` remembers; nothing where it cannot be read, for nothing depends on it.
    pub fn load(file: Option<PathBuf>) -> Self {
        let read = |p: &PathBuf| serde_json::from_str::<Self>(&io::read_text(p).ok()?).ok();
        Self { file: file.clone(), ..file.as_ref().and_then(read).unwrap_or_default() }
    }

    /// Where a user's are.
    pub fn usual_file() -> Option<PathBuf> {
        let folder = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|p| p.is_absolute());
        let base =
            folder("XDG_STATE_HOME").or_else(|| folder("LOCALAPPDATA")).or_else(|| folder("HOME").map(|h| h.join(".local/state")))?;
        Some(base.join("unshaken").join("recent.json"))
    }

    /// `files` have been opened.
    pub fn add(&mut self, files: Vec<PathBuf>) {
        let files: Vec<PathBuf> = files.into_iter().map(|p| std::path::absolute(&p).unwrap_or(p)).collect();
        self.entries.retain(|e| *e != files);
        self.entries.insert(0, files);
        self.entries.truncate(RECENT);
        if let Some(file) = &self.file {
            // A list that cannot be kept is no reason to bother anyone.
            let _ = file.parent().map(std::fs::create_dir_all);
            let _ = serde_json::to_string_pretty(self).map(|text| std::fs::write(file, text));
        }
    }
}
