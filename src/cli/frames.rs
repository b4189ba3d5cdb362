//! Frames and their exposure times from the command line.

use super::Usage;
use crate::colour::Matrix;
use crate::error::Error;
use crate::exposure::{Bracket, Frame};
use crate::io::input::{self, Encoding, Input};
use crate::io::metadata::{self, Metadata};
use crate::io::output;
use crate::noise::NoiseModel;
use crate::response::Response;
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// How messages, TSF files and reports name the frames: file names without folder. Frames whose file name occurs
/// twice are named by their paths.
pub(super) fn names(paths: &[PathBuf]) -> Vec<String> {
    let file_name = |p: &Path| p.file_name().unwrap_or(p.as_os_str()).to_string_lossy().into_owned();
    paths
        .iter()
        .map(|p| match paths.iter().filter(|q| file_name(q) == file_name(p)).count() {
            1 => file_name(p),
            _ => p.display().to_string(),
        })
        .collect()
}

/// Focal length in pixels from what the camera noted as its equivalent on 35 mm film (36 mm across), `None` if it did not.
pub(super) fn focal_px(path: &Path, width: usize, height: usize) -> Result<Option<f64>, Error> {
    Ok(metadata::focal_length_35mm(path)?.map(|f| f / 36.0 * width.max(height) as f64))
}

/// Checks of the list of frames that need no pixels.
pub(super) fn check(paths: &[PathBuf]) -> anyhow::Result<()> {
    for (i, p) in paths.iter().enumerate() {
        if let Some(j) = paths[..i].iter().position(|q| output::is_same_file(p, q)) {
            let text = format!("{}: is given twice, as frames {} and {}; name each frame once", p.display(), j + 1, i + 1);
            return Err(Usage(text).into());
        }
    }
    if let [one] = paths {
        return Err(Error::Bracket(format!(
            "{}: is the only frame; a bracket needs at least two, with different exposure times",
            one.display()
        ))
        .into());
    }
    Ok(())
}

/// The times of `--exposures`, one per frame.
pub(super) fn exposure_times(list: &str, paths: &[PathBuf]) -> Result<Vec<f64>, Usage> {
    let words: Vec<&str> = list.split(',').map(str::trim).collect();
    if words.len() != paths.len() {
        return Err(Usage(format!(
            "--exposures: {} for {}; give one time in seconds per frame, in their order",
            count(words.len(), "time"),
            count(paths.len(), "frame")
        )));
    }
    words
        .iter()
        .zip(paths)
        .enumerate()
        .map(|(i, (word, path))| {
            let refuse = |why| {
                let name = path.display();
                Usage(format!("--exposures: {word:?} for frame {} ({name}) {why}; give seconds such as 1/30 or 0.2", i + 1))
            };
            let seconds = match word.split_once('/') {
                Some((a, b)) => a.trim().parse::<f64>().and_then(|a| Ok(a / b.trim().parse::<f64>()?)),
                None => word.parse(),
            };
            match seconds {
                Ok(t) if t.is_finite() && t > 0.0 => Ok(t),
                Ok(_) => Err(refuse("is not a positive time")),
                Err(_) => Err(refuse("is not a number")),
            }
        })
        .collect()
}

/// The relative exposures of `--ev`, one step per frame, as times: 2^EV.
pub(super) fn exposure_values(list: &str, paths: &[PathBuf]) -> Result<Vec<f64>, Usage> {
    let words: Vec<&str> = list.split(',').map(str::trim).collect();
    if words.len() != paths.len() {
        let (given, frames) = (count(words.len(), "value"), count(paths.len(), "frame"));
        return Err(Usage(format!("--ev: {given} for {frames}; give one exposure in EV per frame, in their order")));
    }
    let value = |(i, word): (usize, &&str)| match word.parse::<f64>() {
        Ok(v) if v.abs() <= 40.0 => Ok(v.exp2()),
        _ => {
            let name = paths[i].display();
            Err(Usage(format!("--ev: {word:?} for frame {} ({name}) is not an exposure; give EV such as -2 or +1.5", i + 1)))
        }
    };
    words.iter().enumerate().map(value).collect()
}

/// Frames that are read, and what their files say that pixels do not.
pub(super) struct Loaded {
    pub bracket: Bracket,
    /// The response that the files themselves state; `None` for a camera's own curve.
    pub stated: Option<(String, Response)>,
    /// Of each frame, linear RGB to XYZ relative to D50.
    pub to_xyz: Vec<Matrix>,
    pub metadata: Vec<Metadata>,
    /// The noise that all files note alike.
    pub noise: Option<NoiseModel>,
    /// What the user should know.
    pub notes: Vec<String>,
}

/// Reads the frames as a bracket; times that are not `given` come from the files.
pub(super) fn read(paths: &[PathBuf], given: Option<Vec<f64>>) -> crate::error::Result<Bracket> {
    load(paths, given, 1.0).map(|l| l.bracket)
}

/// Reads the frames with all that their files say. `white`: see [`input::read`].
pub(super) fn load(paths: &[PathBuf], given: Option<Vec<f64>>, white: f32) -> crate::error::Result<Loaded> {
    // Exposures that will be refused need no pixels, for the kinds of files whose notes are quickly read.
    if given.is_none() && !paths.iter().any(|p| input::notes_need_pixels(p)) {
        let noted = paths.iter().map(|p| metadata::read(p)).collect::<crate::error::Result<Vec<_>>>()?;
        metadata::exposures(&pairs(paths, &noted))?;
    }
    let inputs = paths.par_iter().map(|p| input::read(p, white)).collect::<Vec<_>>();
    let inputs = inputs.into_iter().collect::<crate::error::Result<Vec<Input>>>()?;
    let mut notes = Vec::new();
    let times = match given {
        Some(times) => times,
        None => {
            let noted: Vec<_> = inputs.iter().map(|i| i.metadata.clone()).collect();
            let (times, more) = metadata::exposures(&pairs(paths, &noted))?;
            notes.extend(more);
            times
        }
    };
    let kind = |e: &Encoding| match e {
        Encoding::Camera => "in the camera's curve".to_string(),
        Encoding::Profile(name, _) => format!("in the curve of its profile \"{name}\""),
        Encoding::Linear => "linear".to_string(),
    };
    let first = &inputs[0];
    for (path, other) in paths.iter().zip(&inputs).skip(1) {
        if other.encoding != first.encoding {
            let (a, b) = (kind(&other.encoding), kind(&first.encoding));
            let reason = format!("is {a} but {} is {b}; give frames of one kind", paths[0].display());
            return Err(Error::Format { path: path.clone(), reason });
        }
        if !input::same_colours(&other.to_xyz, &first.to_xyz) {
            if !other.raw {
                let reason = format!("has other primaries than {}; convert both to one colour space", paths[0].display());
                return Err(Error::Format { path: path.clone(), reason });
            }
            let note = "the frames' white balances differ; that of the reference frame is used for all";
            if !notes.iter().any(|n| n == note) {
                notes.push(note.to_string());
            }
        }
    }
    let stated = match &first.encoding {
        Encoding::Camera => None,
        Encoding::Profile(name, response) => Some((format!("profile {name}"), response.clone())),
        Encoding::Linear => Some(("linear".to_string(), Response::Linear)),
    };
    let (mut frames, mut to_xyz, mut metadata) = (Vec::new(), Vec::new(), Vec::new());
    for ((input, name), exposure_time) in inputs.into_iter().zip(names(paths)).zip(times) {
        frames.push(Frame {
            name,
            intensity: input.intensity,
            levels: input.levels,
            chroma_subsampled: input.chroma_subsampled,
            lossy: input.lossy,
            speed: input.metadata.iso,
            exposure_time,
        });
        to_xyz.push(input.to_xyz);
        metadata.push(input.metadata);
    }
    let noise = noted_noise(&metadata);
    if noise.is_none() && metadata.iter().any(|m| m.noise.is_some()) {
        notes.push("the frames do not note one noise level (ISO speeds differ, or some note none); it is estimated from the frames".into());
    }
    Ok(Loaded { bracket: Bracket::new(frames)?, stated, to_xyz, metadata, noise, notes })
}

/// The noise level that all frames note, alike to a twentieth.
fn noted_noise(metadata: &[Metadata]) -> Option<NoiseModel> {
    let noted: Vec<[f64; 2]> = metadata.iter().map(|m| m.noise).collect::<Option<_>>()?;
    let [shot, read] = *noted.first()?;
    let alike = |a: f64, b: f64| (a - b).abs() <= 0.05 * b;
    noted.iter().all(|n| alike(n[0], shot) && alike(n[1], read)).then_some(NoiseModel { shot, read })
}

fn pairs<'a>(paths: &[PathBuf], noted: &'a [Metadata]) -> Vec<(PathBuf, &'a Metadata)> {
    paths.iter().cloned().zip(noted).collect()
}

/// "1 frame", "3 frames".
pub(super) fn count(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}
