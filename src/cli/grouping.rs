//! Brackets among many photographs: by camera, time, size and exposure pattern, or as a manifest says.

use super::options;
use crate::error::Error;
use crate::io::input;
use crate::io::metadata::{self, Metadata};
use anyhow::Context;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Frames that belong together.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Group {
    /// Name of the results, without an ending.
    pub name: String,
    pub frames: Vec<PathBuf>,
    /// Options of merge for this bracket.
    pub options: Vec<OsString>,
    /// What was found of it, for people.
    pub note: String,
}

/// Brackets, and what belongs to none with the reason.
#[derive(Debug, Default)]
pub(super) struct Grouping {
    pub groups: Vec<Group>,
    pub left_out: Vec<(PathBuf, String)>,
}

/// What grouping knows of one photograph.
#[derive(Clone, Debug)]
struct Shot {
    path: PathBuf,
    camera: String,
    /// Seconds; `None` when the file notes no date.
    time: Option<f64>,
    size: Option<(u32, u32)>,
    /// EV: what separates the frames of a bracket.
    exposure: f64,
    /// Exposure time in seconds, during which the next frame cannot begin.
    lasts: f64,
}

/// Endings of files that folders are searched for.
const PICTURES: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];
/// Exposures closer than this are the same, EV.
const SAME: f64 = 0.15;

/// Photographs that the command line names: files as they are, folders for what they hold (not what their folders hold), by name.
pub(super) fn photographs(named: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut all = Vec::new();
    for path in named {
        if !path.is_dir() {
            all.push(path.clone());
            continue;
        }
        let entries = std::fs::read_dir(path).with_context(|| format!("{}: the folder cannot be read", path.display()))?;
        let mut found: Vec<PathBuf> = entries.filter_map(Result::ok).map(|e| e.path()).filter(|p| p.is_file() && is_picture(p)).collect();
        found.sort();
        all.extend(found);
    }
    all.dedup();
    if all.is_empty() {
        let named = named.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ");
        return Err(
            Error::Input(format!("{named}: no photographs; name files, or a folder with JPEG, PNG, TIFF or camera raw files")).into()
        );
    }
    Ok(all)
}

fn is_picture(path: &Path) -> bool {
    let ending = crate::io::output::ending(path);
    PICTURES.contains(&ending.as_str()) || input::is_raw_name(&ending)
}

/// Finds the brackets: frames of one camera, folder and size, each begun within `gap` seconds of the end of the one before, of
/// different exposures. An exposure that comes again begins the next bracket. Files without a date follow one another by name.
pub(super) fn find(paths: &[PathBuf], gap: f64) -> Grouping {
    let shots: Vec<Result<Shot, (PathBuf, String)>> = paths.par_iter().map(|p| shot(p)).collect();
    let mut out = Grouping::default();
    let mut rolls: BTreeMap<(PathBuf, String), Vec<Shot>> = BTreeMap::new();
    for shot in shots {
        match shot {
            Ok(s) => {
                let folder = s.path.parent().map(Path::to_path_buf).unwrap_or_default();
                rolls.entry((folder, s.camera.clone())).or_default().push(s);
            }
            Err(left) => out.left_out.push(left),
        }
    }
    let mut brackets: Vec<Vec<Shot>> = Vec::new();
    for (_, mut roll) in rolls {
        roll.sort_by(|a, b| a.time.unwrap_or(0.0).total_cmp(&b.time.unwrap_or(0.0)).then_with(|| a.path.cmp(&b.path)));
        let mut current: Vec<Shot> = Vec::new();
        for shot in roll {
            let follows = current.last().is_none_or(|last| {
                let near = match (last.time, shot.time) {
                    (Some(a), Some(b)) => b - (a + last.lasts) <= gap,
                    (None, None) => true,
                    _ => false,
                };
                let again = current.iter().any(|s| (s.exposure - shot.exposure).abs() < SAME);
                near && !again && last.size == shot.size
            });
            if !follows {
                brackets.push(std::mem::take(&mut current));
            }
            current.push(shot);
        }
        brackets.push(current);
    }
    for shots in brackets {
        match shots.as_slice() {
            [] => {}
            [one] => out.left_out.push((one.path.clone(), "is alone: no frame of another exposure follows it in time".into())),
            [first, ..] => {
                let list = shots.iter().map(|s| format!("{:+.1}", s.exposure - first.exposure)).collect::<Vec<_>>().join(", ");
                let camera = if first.camera.is_empty() { "unknown camera" } else { &first.camera };
                out.groups.push(Group {
                    name: first.path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
                    note: format!("{camera}; {list} EV{}", if first.time.is_none() { "; no dates, by name" } else { "" }),
                    frames: shots.into_iter().map(|s| s.path).collect(),
                    options: Vec::new(),
                });
            }
        }
    }
    out.groups.sort_by(|a, b| a.frames[0].cmp(&b.frames[0]));
    out.left_out.sort();
    distinct_names(&mut out.groups);
    out
}

/// Two folders may hold a file of one name: their names tell them apart, then numbers.
fn distinct_names(groups: &mut [Group]) {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    groups.iter().for_each(|g| *counts.entry(g.name.clone()).or_default() += 1);
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    for group in groups {
        if counts[&group.name] > 1
            && let Some(folder) = group.frames[0].parent().and_then(Path::file_name)
        {
            group.name = format!("{}-{}", folder.to_string_lossy(), group.name);
        }
        let n = seen.entry(group.name.clone()).or_default();
        *n += 1;
        if *n > 1 {
            group.name = format!("{}-{n}", group.name);
        }
    }
}

fn shot(path: &Path) -> Result<Shot, (PathBuf, String)> {
    let left = |reason: String| (path.to_path_buf(), reason);
    let noted: Metadata = input::notes(path).map_err(|e| left(e.to_string()))?;
    // Of the kinds whose headers are quickly read.
    let size = ::image::image_dimensions(path).ok();
    if PICTURES.contains(&crate::io::output::ending(path).as_str()) && size.is_none() {
        return Err(left("is no picture that can be read".into()));
    }
    let time = noted.exposure_time.filter(|t| t.is_finite() && *t > 0.0);
    let exposure = match (time, noted.exposure_bias) {
        (Some(t), _) => t.log2() + noted.iso.map_or(0.0, |s| (s / 100.0).log2()) - 2.0 * noted.f_number.map_or(0.0, f64::log2),
        (None, Some(bias)) => bias,
        (None, None) => return Err(left("notes no exposure (EXIF); list its bracket in a manifest with exposures".into())),
    };
    let part = |v: &Option<String>| v.clone().unwrap_or_default();
    let camera = format!("{} {} {}", part(&noted.make), part(&noted.model), part(&noted.serial));
    Ok(Shot {
        path: path.into(),
        camera: camera.split_whitespace().collect::<Vec<_>>().join(" "),
        time: noted.taken.as_deref().and_then(metadata::seconds),
        size,
        exposure,
        lasts: time.unwrap_or(0.0),
    })
}

/// A manifest: `[[bracket]]` tables with `name`, `frames` and options of merge.
#[derive(Debug, Deserialize, Serialize)]
struct Manifest {
    #[serde(default)]
    bracket: Vec<Entry>,
}

#[derive(Debug, Deserialize, Serialize)]
struct Entry {
    name: String,
    frames: Vec<PathBuf>,
    #[serde(flatten)]
    options: toml::Table,
}

/// The brackets of a manifest. Paths are relative to the current folder.
pub(super) fn of_manifest(path: &Path) -> anyhow::Result<Grouping> {
    let groups = parse(&crate::io::read_text(path)?).with_context(|| path.display().to_string())?;
    Ok(Grouping { groups, left_out: Vec::new() })
}

/// The brackets of a manifest's text.
fn parse(text: &str) -> anyhow::Result<Vec<Group>> {
    let manifest: Manifest = toml::from_str(text)
        .map_err(|e| anyhow::anyhow!("is not a manifest ({}); it holds [[bracket]] tables with name and frames", e.message()))?;
    if manifest.bracket.is_empty() {
        anyhow::bail!("holds no [[bracket]]; 'unshaken batch --dry-run' prints a manifest");
    }
    let mut groups: Vec<Group> = Vec::new();
    for entry in manifest.bracket {
        let plain =
            !entry.name.is_empty() && !entry.name.starts_with('.') && !entry.name.contains(['/', '\\']) && !entry.name.contains('\0');
        if !plain {
            anyhow::bail!("{:?} cannot name a result; give a file name without folder and ending", entry.name);
        }
        if groups.iter().any(|g| g.name == entry.name) {
            anyhow::bail!("two brackets are called {:?}; give them different names", entry.name);
        }
        let options = options::of_manifest(&entry.options).with_context(|| format!("bracket {:?}", entry.name))?;
        groups.push(Group { name: entry.name, frames: entry.frames, options, note: "from the manifest".into() });
    }
    Ok(groups)
}

/// Names of the brackets of a manifest's text (see `unshaken batch --manifest`).
///
/// # Errors
/// Why it is no manifest, in words that follow the file's name.
pub fn manifest_brackets(text: &str) -> Result<Vec<String>, String> {
    parse(text).map(|groups| groups.into_iter().map(|g| g.name).collect()).map_err(|e| format!("{e:#}"))
}

/// The grouping as a manifest, with what was left out as comments.
pub(super) fn as_manifest(grouping: &Grouping) -> String {
    let quoted = |p: &Path| toml::Value::String(p.display().to_string()).to_string();
    let mut text = String::from(
        "# Brackets for 'unshaken batch --manifest'. Options of merge, such as response = \"camera.json\", may stand beside name.\n",
    );
    for g in &grouping.groups {
        let frames = g.frames.iter().map(|p| format!("    {},\n", quoted(p))).collect::<String>();
        text += &format!("\n# {}\n[[bracket]]\nname = {}\nframes = [\n{frames}]\n", one_line(&g.note), toml::Value::String(g.name.clone()));
    }
    if !grouping.left_out.is_empty() {
        text += "\n# Left out:\n";
    }
    for (path, reason) in &grouping.left_out {
        text += &format!("# {}: {}\n", path.display(), one_line(reason));
    }
    text
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The brackets of shard `index` of `count`: every `count`-th. Each bracket is of exactly one shard.
pub(super) fn shard(groups: Vec<Group>, index: usize, count: usize) -> Vec<Group> {
    groups.into_iter().enumerate().filter(|(i, _)| i % count == index).map(|(_, g)| g).collect()
}
