//! Frames and their exposure times from the command line.

use super::Usage;
use crate::error::Error;
use crate::exposure::{Bracket, Frame};
use crate::io::{ldr, metadata, output};
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

/// Reads the frames as a bracket; times that are not `given` come from the files.
pub(super) fn read(paths: &[PathBuf], given: Option<Vec<f64>>) -> crate::error::Result<Bracket> {
    let times = match given {
        Some(times) => times,
        None => paths.iter().map(|p| noted_time(p)).collect::<Result<_, _>>()?,
    };
    let pictures = paths.par_iter().map(|p| ldr::read(p)).collect::<Vec<_>>();
    let frames = pictures.into_iter().zip(names(paths)).zip(times).map(|((picture, name), exposure_time)| {
        let ldr::Picture { intensity, levels } = picture?;
        Ok(Frame { name, intensity, levels, exposure_time })
    });
    Bracket::new(frames.collect::<Result<_, Error>>()?)
}

fn noted_time(path: &Path) -> crate::error::Result<f64> {
    const REMEDY: &str = "give the times of all frames with --exposures";
    match metadata::exposure_time(path)? {
        Some(t) if t.is_finite() && t > 0.0 => Ok(t),
        Some(t) => {
            Err(Error::Format { path: path.into(), reason: format!("EXIF notes an exposure time of {t} s, which cannot be; {REMEDY}") })
        }
        None => Err(Error::Format { path: path.into(), reason: format!("holds no exposure time (EXIF); {REMEDY}") }),
    }
}

/// "1 frame", "3 frames".
pub(super) fn count(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}
