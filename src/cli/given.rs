//! What options give, as values: words, lists of frames, files of responses and TSFs.

use super::{Usage, frames};
use crate::error::Error;
use crate::exposure::Bracket;
use crate::noise::NoiseModel;
use crate::pipeline::Blind;
use crate::response::{Response, ResponseFile};
use crate::tsf::TsfFile;
use std::path::{Path, PathBuf};

/// `--blind`.
pub(super) fn blind(word: Option<&str>) -> Result<Blind, Usage> {
    match word {
        None => Ok(Blind::default()),
        Some("auto") => Ok(Blind::Auto),
        Some("joint") => Ok(Blind::Joint),
        Some("patches") => Ok(Blind::Patches),
        Some("off") => Ok(Blind::Off),
        Some(word) => Err(Usage(format!("--blind: {word:?} is neither auto, joint, patches nor off"))),
    }
}

/// Frame number, counted from 1, to an index.
pub(super) fn frame_number(option: &str, word: &str, frames: usize) -> Result<usize, Usage> {
    match word.trim().parse::<usize>() {
        Ok(n) if (1..=frames).contains(&n) => Ok(n - 1),
        Ok(n) => Err(Usage(format!("{option}: there is no frame {n}; frames are counted from 1 to {frames}"))),
        Err(_) => Err(Usage(format!("{option}: {word:?} is not a frame number; frames are counted from 1 to {frames}"))),
    }
}

pub(super) fn frame_numbers(option: &str, list: &str, frames: usize) -> Result<Vec<usize>, Usage> {
    let mut indices = Vec::new();
    for word in list.split(',') {
        let i = frame_number(option, word, frames)?;
        if indices.contains(&i) {
            return Err(Usage(format!("{option}: frame {} is named twice; name it once", i + 1)));
        }
        indices.push(i);
    }
    Ok(indices)
}

/// The level that `--noise` gives.
pub(super) fn noise_level(text: &str) -> Result<NoiseModel, Usage> {
    let refuse =
        || Usage(format!("--noise: {text:?} is not a full well of at least 1 and a read noise of at least 0 electrons, such as 12000,6"));
    let (well, read) = text.split_once(',').ok_or_else(refuse)?;
    match (well.trim().parse::<f64>(), read.trim().parse::<f64>()) {
        // A read noise of nothing would divide by nothing where the frame is black; a tenth of an electron is as good.
        (Ok(w), Ok(r)) if w.is_finite() && w >= 1.0 && r.is_finite() && (0.0..=w).contains(&r) => {
            Ok(NoiseModel::from_electrons(w, r.max(0.1)))
        }
        _ => Err(refuse()),
    }
}

pub(super) fn read_response(path: &Path) -> Result<Response, Error> {
    if !path.exists() {
        let reason = "is neither auto, srgb, linear, gamma:NUMBER nor an existing file; give --response one of these".into();
        return Err(Error::Format { path: path.into(), reason });
    }
    let text = crate::io::read_text(path)?;
    ResponseFile::parse(&text).map(|f| f.response()).map_err(|e| Error::Format { path: path.into(), reason: e.to_string() })
}

pub(super) fn read_tsf(path: &Path) -> Result<TsfFile, Error> {
    let text = crate::io::read_text(path)?;
    TsfFile::parse(&text).map_err(|e| Error::Format { path: path.into(), reason: e.to_string() })
}

/// TSF files find frames by file name: one that fits no frame, or a name that two frames share, would be used silently wrong.
pub(super) fn check_tsf_names(file: &TsfFile, path: &Path, frames: &[PathBuf]) -> Result<(), Error> {
    let refuse = |reason| Err(Error::Format { path: path.into(), reason });
    let names = frames::names(frames);
    for (i, entry) in file.frames.iter().enumerate() {
        if file.frames[..i].iter().any(|e| e.frame == entry.frame) {
            return refuse(format!("holds two TSFs of {:?}; keep one", entry.frame));
        }
        let sharing = frames.iter().filter(|p| p.file_name().is_some_and(|n| n.to_string_lossy() == entry.frame)).count();
        if sharing > 1 {
            return refuse(format!(
                "holds a TSF of {:?}, a name that {sharing} frames share; give the frames different file names",
                entry.frame
            ));
        }
    }
    if !file.frames.iter().any(|e| names.contains(&e.frame)) {
        return refuse(format!("holds no TSF of any of the frames ({}); it names frames by file name, without folder", names.join(", ")));
    }
    Ok(())
}

/// Refuses TSFs that do not fit the frames before the work begins.
pub(super) fn check_tsfs(file: &TsfFile, path: &Path, bracket: &Bracket) -> Result<(), Error> {
    let (width, height) = bracket.size();
    for frame in bracket.frames() {
        file.find(&frame.name, width, height).map_err(|e| Error::Format { path: path.into(), reason: e.to_string() })?;
    }
    Ok(())
}

/// The whole number that `--scale` is one over.
pub(super) fn divisor(word: &str) -> Result<usize, Usage> {
    let divisor = word.parse::<f64>().ok().filter(|s| *s > 0.0 && *s <= 1.0).map(|s| (1.0 / s, (1.0 / s).round()));
    match divisor {
        Some((exact, whole)) if (exact - whole).abs() <= 0.02 * whole && whole <= 1000.0 => Ok(whole as usize),
        _ => Err(Usage(format!("--scale: {word:?} is not one over a whole number; give 1, 0.5, 0.333, 0.25, ..."))),
    }
}

/// Bytes of a size such as 2GiB, 1.5GB or 800MiB.
pub(super) fn bytes(word: &str) -> Result<u64, Usage> {
    let split = word.find(|c: char| c.is_alphabetic()).unwrap_or(word.len());
    let (number, unit) = word.split_at(split);
    let unit = match unit.to_lowercase().as_str() {
        "gib" | "g" => 1u64 << 30,
        "mib" | "m" => 1 << 20,
        "gb" => 1_000_000_000,
        "mb" => 1_000_000,
        _ => 0,
    };
    match number.trim().parse::<f64>() {
        Ok(n) if n.is_finite() && n > 0.0 && unit > 0 => Ok((n * unit as f64) as u64),
        _ => Err(Usage(format!("--memory-limit: {word:?} is not a size; give a number with a unit, such as 2GiB or 800MiB"))),
    }
}
