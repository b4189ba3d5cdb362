//! `unshaken batch`: finds the brackets among many photographs and merges each in a process of its own, so that one that fails or is killed
//! takes no other with it.

use super::args::BatchArgs;
use super::grouping::{self, Group};
use super::progress::{self, Voice, done};
use super::{DEGRADED, Done, Usage, frames, interrupt};
use crate::error::Error;
use crate::io::output::Output;
use anyhow::Context;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Folder of the records, below the results.
const RECORDS: &str = ".unshaken";

/// What became of a bracket.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Status {
    Done,
    Degraded,
    Failed,
    Skipped,
    Interrupted,
}

/// What is kept of a bracket that was begun.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Record {
    format: String,
    version: u32,
    /// Hash of the frames' contents, the options and the program's version; empty until it is finished.
    hash: String,
    status: Status,
    warnings: Vec<String>,
    seconds: f64,
}

impl Default for Record {
    fn default() -> Self {
        Self {
            format: "unshaken-batch-record".into(),
            version: 1,
            hash: String::new(),
            status: Status::Interrupted,
            warnings: Vec::new(),
            seconds: 0.0,
        }
    }
}

/// A bracket's line of the table.
struct Row {
    name: String,
    frames: usize,
    status: Status,
    seconds: f64,
    note: String,
}

pub(super) fn run(args: &BatchArgs, merge_options: &[OsString]) -> anyhow::Result<Done> {
    let shard = args.shard.as_deref().map(parse_shard).transpose()?;
    if !(args.gap.is_finite() && args.gap >= 0.0) {
        return Err(Usage(format!("--gap: {} is not a number of seconds", args.gap)).into());
    }
    let grouping = match &args.manifest {
        Some(path) => grouping::of_manifest(path)?,
        None => grouping::find(&grouping::photographs(&args.photographs)?, args.gap),
    };
    if args.dry_run {
        print!("{}", grouping::as_manifest(&grouping));
        return Ok(Done::AsAsked);
    }
    for (path, reason) in &grouping.left_out {
        say_left_out(path, reason);
    }
    if grouping.groups.is_empty() {
        return Err(
            Error::Input("no bracket was found; --dry-run says why, and a manifest (--manifest) lists brackets by hand".into()).into()
        );
    }
    let groups = match shard {
        Some((i, n)) => grouping::shard(grouping.groups, i, n),
        None => grouping.groups,
    };
    let records = args.output_dir.join(RECORDS);
    std::fs::create_dir_all(&records)
        .with_context(|| format!("{}: cannot be made; choose another --output-dir", args.output_dir.display()))?;
    let strict = merge_options.iter().any(|o| o == "--strict");
    let overwrite = merge_options.iter().any(|o| o == "--overwrite");
    let job = Job { args, options: merge_options, records: &records, overwrite };
    let (next, rows) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let start = Instant::now();
    std::thread::scope(|scope| {
        for _ in 0..usize::from(args.jobs).min(groups.len()) {
            scope.spawn(|| {
                loop {
                    let i = next.fetch_add(1, Ordering::SeqCst);
                    let Some(group) = groups.get(i).filter(|_| !interrupt::asked()) else { break };
                    tell(&json!({ "event": "bracket-started", "name": group.name, "frames": group.frames }), || {
                        format!("{}: merging {}", group.name, frames::count(group.frames.len(), "frame"))
                    });
                    let row = job.one(group);
                    tell(
                        &json!({ "event": "bracket", "name": row.name, "status": row.status, "seconds": row.seconds, "note": row.note }),
                        || {
                            format!(
                                "{}: {}{}",
                                row.name,
                                word(row.status),
                                if row.note.is_empty() { String::new() } else { format!(" ({})", row.note) }
                            )
                        },
                    );
                    rows.lock().expect("no thread panics with it").push((i, row));
                }
            });
        }
    });
    let mut rows = rows.into_inner().expect("no thread panics with it");
    rows.sort_by_key(|r| r.0);
    let rows: Vec<Row> = rows.into_iter().map(|r| r.1).collect();
    if interrupt::asked() {
        return Err(Error::Cancelled.into());
    }
    let count = |s: Status| rows.iter().filter(|r| r.status == s).count();
    let (failed, degraded) = (count(Status::Failed), count(Status::Degraded));
    let summary = format!(
        "{}{} done, {degraded} degraded, {} skipped, {failed} failed in {:.0} s",
        table(&rows),
        count(Status::Done),
        count(Status::Skipped),
        start.elapsed().as_secs_f64()
    );
    done(&summary, json!({ "done": count(Status::Done), "degraded": degraded, "skipped": count(Status::Skipped), "failed": failed }));
    if failed > 0 {
        anyhow::bail!("{} of {} failed; the lines above say why", failed, frames::count(rows.len(), "bracket"));
    }
    // A skipped bracket is as good as it was when it was merged.
    let skipped_degraded = rows.iter().any(|r| r.status == Status::Skipped && !r.note.is_empty());
    Ok(if strict && (degraded > 0 || skipped_degraded) { Done::Degraded } else { Done::AsAsked })
}

fn word(status: Status) -> &'static str {
    match status {
        Status::Done => "done",
        Status::Degraded => "degraded",
        Status::Failed => "failed",
        Status::Skipped => "skipped",
        Status::Interrupted => "interrupted",
    }
}

fn tell(event: &Value, text: impl FnOnce() -> String) {
    match progress::voice() {
        Voice::Human => eprintln!("{}", text()),
        Voice::Json => progress::event(event),
        Voice::Quiet => {}
    }
}

fn say_left_out(path: &Path, reason: &str) {
    match progress::voice() {
        Voice::Human => super::warn(&format!("{}: {reason}; it is left out", path.display())),
        Voice::Json => progress::event(&json!({ "event": "left-out", "file": path, "reason": reason })),
        Voice::Quiet => {}
    }
}

/// `I/N`, I counted from 1.
fn parse_shard(word: &str) -> Result<(usize, usize), Usage> {
    let parsed = word.split_once('/').and_then(|(i, n)| Some((i.parse::<usize>().ok()?, n.parse::<usize>().ok()?)));
    match parsed {
        Some((i, n)) if (1..=n).contains(&i) => Ok((i - 1, n)),
        _ => Err(Usage(format!("--shard: {word:?} is not I/N with I from 1 to N, such as 2/8"))),
    }
}

fn table(rows: &[Row]) -> String {
    let width = rows.iter().map(|r| r.name.chars().count()).max().unwrap_or(0).max(7);
    let mut text = format!("{:<width$}  frames  {:<11}  seconds  note\n", "bracket", "status");
    for r in rows {
        text += format!("{:<width$}  {:>6}  {:<11}  {:>7.1}  {}", r.name, r.frames, word(r.status), r.seconds, r.note).trim_end();
        text.push('\n');
    }
    text
}

struct Job<'a> {
    args: &'a BatchArgs,
    options: &'a [OsString],
    records: &'a Path,
    overwrite: bool,
}

impl Job<'_> {
    fn one(&self, group: &Group) -> Row {
        let start = Instant::now();
        let row = |status, note: String| Row {
            name: group.name.clone(),
            frames: group.frames.len(),
            status,
            seconds: start.elapsed().as_secs_f64(),
            note,
        };
        match self.merge(group) {
            Ok((status, note)) => row(status, note),
            Err(e) => row(Status::Failed, super::one_line(&format!("{e:#}"))),
        }
    }

    fn merge(&self, group: &Group) -> anyhow::Result<(Status, String)> {
        let at = |ending: &str| self.args.output_dir.join(format!("{}.{ending}", group.name));
        let (image, preview, report) = (at("exr"), at("jpg"), at("json"));
        let record_path = self.records.join(format!("{}.json", group.name));
        let hash = self.hash(group)?;
        let earlier: Option<Record> = std::fs::read_to_string(&record_path).ok().and_then(|t| serde_json::from_str(&t).ok());
        if let Some(record) = earlier.as_ref().filter(|r| r.hash == hash && image.is_file() && !self.args.again) {
            let note = if record.status == Status::Degraded { format!("degraded: {}", record.warnings.join("; ")) } else { String::new() };
            return Ok((Status::Skipped, note));
        }
        // What an earlier batch wrote may be replaced; what somebody else put there may not, unless told.
        if earlier.is_none() && !self.overwrite {
            for path in [&image, &preview, &report] {
                Output::check(path, false)?;
            }
        }
        // From here on the results are the batch's own, even if it is killed before they are finished.
        Output::check(&record_path, true)?.stage_json(&Record::default())?.commit()?;
        let mut command = Command::new(std::env::current_exe().context("the program does not find itself")?);
        command.args(["merge", "--json", "--config=none", "-o"]).arg(&image).arg("--preview").arg(&preview).arg("--report").arg(&report);
        command.args(self.options.iter().filter(|o| *o != "--overwrite")).args(&group.options);
        command.arg("--overwrite").arg("--").args(&group.frames).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let start = Instant::now();
        let mut child = command.spawn().context("cannot start another process")?;
        let said = listen(&mut child)?;
        let note = said.warnings.join("; ");
        let status = match said.code {
            Some(0) if said.degraded => Status::Degraded,
            Some(0) => Status::Done,
            Some(c) if c == i32::from(DEGRADED) => Status::Degraded,
            _ if interrupt::asked() => return Ok((Status::Interrupted, String::new())),
            Some(_) => return Ok((Status::Failed, said.error)),
            None => return Ok((Status::Failed, "its process was killed".into())),
        };
        let record = Record { hash, status, warnings: said.warnings, seconds: start.elapsed().as_secs_f64(), ..Record::default() };
        Output::check(&record_path, true)?.stage_json(&record)?.commit()?;
        Ok((status, if status == Status::Degraded { note } else { String::new() }))
    }

    /// Hash of what the result depends on: the program's version, the options with the contents of the files that they name, the frames'
    /// names and contents.
    fn hash(&self, group: &Group) -> anyhow::Result<String> {
        let mut hasher = Sha256::new();
        let mut field = |bytes: &[u8]| {
            hasher.update((bytes.len() as u64).to_le_bytes());
            hasher.update(bytes);
        };
        field(env!("CARGO_PKG_VERSION").as_bytes());
        for option in self.options.iter().chain(&group.options).filter(|o| *o != "--overwrite" && *o != "--strict") {
            field(option.as_encoded_bytes());
            let text = option.to_string_lossy();
            if let Some((_, value)) = text.split_once('=')
                && Path::new(value).is_file()
            {
                field(&digest(Path::new(value))?);
            }
        }
        for frame in &group.frames {
            field(frame.file_name().unwrap_or(OsStr::new("")).as_encoded_bytes());
            field(&digest(frame)?);
        }
        Ok(hex(&hasher.finalize()))
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn digest(path: &Path) -> anyhow::Result<Vec<u8>> {
    let unreadable = |e: std::io::Error| Error::Read { path: path.into(), reason: crate::io::plain(&e) };
    let mut file = std::fs::File::open(path).map_err(unreadable)?;
    let (mut hasher, mut buffer) = (Sha256::new(), vec![0u8; 1 << 16]);
    loop {
        match file.read(&mut buffer).map_err(unreadable)? {
            0 => return Ok(hasher.finalize().to_vec()),
            n => hasher.update(&buffer[..n]),
        }
    }
}

/// What a merge said and how it ended.
struct Said {
    code: Option<i32>,
    degraded: bool,
    warnings: Vec<String>,
    error: String,
}

/// Waits for a merge. When the user interrupts, the merge is asked to stop as well.
fn listen(child: &mut Child) -> anyhow::Result<Said> {
    let (out, err) = (child.stdout.take().context("no output")?, child.stderr.take().context("no output")?);
    let events = std::thread::spawn(move || {
        let lines = BufReader::new(out).lines().map_while(Result::ok);
        lines.filter_map(|l| serde_json::from_str::<Value>(&l).ok()).filter(|e| e["event"] != "progress").collect::<Vec<_>>()
    });
    let words = std::thread::spawn(move || BufReader::new(err).lines().map_while(Result::ok).last().unwrap_or_default());
    let mut told = false;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if interrupt::asked() && !told {
            told = true;
            stop(child);
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    let events = events.join().unwrap_or_default();
    let last = words.join().unwrap_or_default();
    let text = |e: &Value| e["text"].as_str().unwrap_or_default().to_string();
    Ok(Said {
        code: status.code(),
        degraded: events.iter().any(|e| e["event"] == "done" && e["degraded"] == true),
        warnings: events.iter().filter(|e| e["event"] == "warning").map(text).collect(),
        error: last.strip_prefix("error: ").unwrap_or(&last).to_string(),
    })
}

/// Asks a process to stop, so that it can remove what is half-written.
fn stop(child: &mut Child) {
    let asked = cfg!(unix) && Command::new("kill").args(["-INT", &child.id().to_string()]).status().is_ok_and(|s| s.success());
    if !asked {
        let _ = child.kill();
    }
}
