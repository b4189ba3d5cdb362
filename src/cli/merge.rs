//! `unshaken merge`.

use super::args::MergeArgs;
use super::{Done, Usage, frames, with_progress};
use crate::error::Error;
use crate::exposure::Bracket;
use crate::io::exr::Radiometry;
use crate::io::output::{self, Output};
use crate::noise::NoiseModel;
use crate::pipeline::{self, Event, Settings};
use crate::response::{Response, ResponseFile};
use crate::tsf::{Interpolation, Model, TsfFile};
use std::path::{Path, PathBuf};

pub(super) fn run(args: &MergeArgs) -> anyhow::Result<Done> {
    // Everything that can be refused without reading pixels comes first: a merge takes a while.
    let times = args.exposures.as_deref().map(|list| frames::exposure_times(list, &args.frames)).transpose()?;
    let settings = settings(args)?;
    let divisor = args.scale.as_deref().map_or(Ok(1), divisor)?;
    frames::check(&args.frames)?;
    let given = args.response.as_deref().filter(|r| *r != "auto");
    let named = given.map(Response::named).transpose().map_err(|e| Usage(format!("--response: {e}")))?.flatten();
    let response_file = given.filter(|_| named.is_none()).map(Path::new);
    let (exr, preview, report) = outputs(args, response_file)?;

    let response = match (named, response_file) {
        (None, Some(path)) => Some(read_response(path)?),
        (named, _) => named,
    };
    let tsf = args.tsf.as_deref().map(read_tsf).transpose()?;
    if let (Some(file), Some(path)) = (&tsf, &args.tsf) {
        check_tsf_names(file, path, &args.frames)?;
    }

    let (text, left_out) = with_progress(|events| {
        events(Event::Progress { stage: "reading frames".into(), fraction: 0.0 });
        let bracket = frames::read(&args.frames, times)?;
        if let (Some(file), Some(path)) = (&tsf, &args.tsf) {
            check_tsfs(file, path, &bracket)?;
        }
        let (response, origin) = super::response::choose(args, response, &bracket, events)?;
        if args.frames.len() == settings.exclude.len() + 1 {
            let text = "--exclude leaves one frame: what it clips or drowns in noise, no other frame can fill in";
            events(Event::Warning(text.into()));
        }
        let mut settings = settings.clone();
        if settings.focal_px.is_none() {
            let (w, h) = bracket.size();
            settings.focal_px = frames::focal_px(&args.frames[0], w, h)?;
        }
        // Lengths in pixels shrink with the frames.
        settings.focal_px = settings.focal_px.map(|f| f / divisor as f64);
        settings.patches.iter_mut().for_each(|(x, y)| (*x, *y) = (*x / divisor, *y / divisor));
        let tsf = tsf.as_ref().map(|t| t.reduced(divisor));
        let bracket = if divisor == 1 { bracket } else { crate::response::reduced(&bracket, &response, divisor)? };
        let mut outcome = pipeline::merge(&bracket, &response, &settings, tsf.as_ref(), events)?;
        events(Event::Progress { stage: "writing".into(), fraction: 1.0 });

        outcome.report["response"] = origin;

        // All are complete before the first is renamed.
        let reference = &bracket.frames()[outcome.reference];
        let radiometry = Radiometry { exposure_time: reference.exposure_time, frame: reference.name.clone() };
        let mut staged = vec![exr.stage_exr(&outcome.irradiance, &radiometry)?];
        if let Some(target) = &preview {
            staged.push(target.stage_png(&crate::tonemap::preview(&outcome.irradiance))?);
        }
        if let Some(target) = &report {
            staged.push(target.stage_json(&outcome.report)?);
        }
        for file in staged {
            file.commit()?;
        }
        Ok((summary(args, &bracket, outcome.reference), outcome.left_out))
    })?;
    println!("{text}");
    Ok(if args.strict && !left_out.is_empty() { Done::Degraded } else { Done::AsAsked })
}

fn summary(args: &MergeArgs, bracket: &Bracket, reference: usize) -> String {
    let (width, height) = bracket.size();
    let frame = &bracket.frames()[reference];
    format!(
        "wrote {} ({width} x {height}; 1.0 is the white of frame {}, {}, at {} s)",
        args.output.display(),
        reference + 1,
        frame.name,
        frame.exposure_time
    )
}

fn settings(args: &MergeArgs) -> Result<Settings, Usage> {
    let n = args.frames.len();
    let mut settings = Settings { align: !args.no_align, ..Settings::default() };
    if let Some(word) = &args.reference {
        settings.reference = Some(frame_number("--reference", word, n)?);
    }
    if let Some(list) = &args.sharp {
        settings.sharp = Some(frame_numbers("--sharp", list, n)?);
    }
    if let Some(list) = &args.exclude {
        settings.exclude = frame_numbers("--exclude", list, n)?;
    }
    if let Some(word) = &args.alpha {
        settings.alpha = word
            .parse()
            .ok()
            .filter(|a| (0.0..=1.0).contains(a))
            .ok_or_else(|| Usage(format!("--alpha: {word:?} is not a number from 0 to 1")))?;
    }
    if let Some(word) = &args.model {
        let names: Vec<&str> = Model::ALL.iter().map(|m| m.name()).collect();
        settings.model =
            Model::named(word).ok_or_else(|| Usage(format!("--model: {word:?} is not a model; choose one of {}", names.join(", "))))?;
    }
    if let Some(word) = &args.focal_px {
        let focal = word.parse().ok().filter(|f: &f64| f.is_finite() && *f > 0.0);
        settings.focal_px = Some(focal.ok_or_else(|| Usage(format!("--focal-px: {word:?} is not a positive number of pixels")))?);
    }
    for word in &args.patch {
        let pixel = word.split_once(',').and_then(|(x, y)| Some((x.trim().parse().ok()?, y.trim().parse().ok()?)));
        settings.patches.push(pixel.ok_or_else(|| Usage(format!("--patch: {word:?} is not a pixel such as 120,80")))?);
    }
    settings.noise = args.noise.as_deref().map(noise_level).transpose()?;
    settings.deblur.interpolation = match args.interpolation.as_str() {
        "bicubic" => Interpolation::Bicubic,
        "six-point" => Interpolation::SixPoint,
        _ => Interpolation::Bilinear,
    };
    settings.deblur.memory_limit = args.memory_limit.as_deref().map(bytes).transpose()?;
    let name = |i: usize| format!("frame {} ({})", i + 1, args.frames[i].display());
    if let Some(i) = settings.exclude.iter().find(|i| settings.sharp.as_ref().is_some_and(|s| s.contains(i))) {
        return Err(Usage(format!("--sharp and --exclude both name {}; name it in one of them", name(*i))));
    }
    if let Some(i) = settings.reference.filter(|i| settings.exclude.contains(i)) {
        return Err(Usage(format!("--exclude leaves out {}, which --reference names; choose another reference", name(i))));
    }
    if settings.exclude.len() == n {
        return Err(Usage(format!("--exclude leaves out all {}; keep at least one", frames::count(n, "frame"))));
    }
    Ok(settings)
}

/// The whole number that `--scale` is one over.
fn divisor(word: &str) -> Result<usize, Usage> {
    let divisor = word.parse::<f64>().ok().filter(|s| *s > 0.0 && *s <= 1.0).map(|s| (1.0 / s, (1.0 / s).round()));
    match divisor {
        Some((exact, whole)) if (exact - whole).abs() <= 0.02 * whole && whole <= 1000.0 => Ok(whole as usize),
        _ => Err(Usage(format!("--scale: {word:?} is not one over a whole number; give 1, 0.5, 0.333, 0.25, ..."))),
    }
}

/// Bytes of a size such as 2GiB, 1.5GB or 800MiB.
fn bytes(word: &str) -> Result<u64, Usage> {
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

/// Frame number, counted from 1, to an index.
fn frame_number(option: &str, word: &str, frames: usize) -> Result<usize, Usage> {
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
fn noise_level(text: &str) -> Result<NoiseModel, Usage> {
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

/// The three outputs, of which each can be written.
fn outputs(args: &MergeArgs, response_file: Option<&Path>) -> anyhow::Result<(Output, Option<Output>, Option<Output>)> {
    let mut inputs: Vec<_> = args.frames.iter().map(|p| ("frame", p.as_path())).collect();
    inputs.extend(response_file.map(|p| ("response file", p)));
    inputs.extend(args.tsf.as_deref().map(|p| ("TSF file", p)));
    let mut targets = vec![("--output", args.output.as_path())];
    targets.extend(args.preview.as_deref().map(|p| ("--preview", p)));
    targets.extend(args.report.as_deref().map(|p| ("--report", p)));
    output::check_distinct(&targets, &inputs).map_err(|e| Usage(e.to_string()))?;
    let check = |p: &PathBuf| Output::check(p, args.overwrite);
    Ok((check(&args.output)?, args.preview.as_ref().map(check).transpose()?, args.report.as_ref().map(check).transpose()?))
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
fn check_tsf_names(file: &TsfFile, path: &Path, frames: &[PathBuf]) -> Result<(), Error> {
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
fn check_tsfs(file: &TsfFile, path: &Path, bracket: &Bracket) -> Result<(), Error> {
    let (width, height) = bracket.size();
    for frame in bracket.frames() {
        file.find(&frame.name, width, height).map_err(|e| Error::Format { path: path.into(), reason: e.to_string() })?;
    }
    Ok(())
}
