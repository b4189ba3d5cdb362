//! `unshaken demo`: makes a shaken bracket of a scene drawn by the program, reconstructs it and shows what that gained.

use crate::baseline;
use crate::exposure::Frame;
use crate::image::Rgb;
use crate::io::exr::Radiometry;
use crate::io::output::Output;
use crate::metrics::{Judge, Score, score};
use crate::pipeline::{self, Event, Settings};
use crate::response::Response;
use crate::synth::{self, Camera, SyntheticBracket, Tremor, font};
use crate::tonemap::{self, ToneMap};
use crate::tsf::{TsfEntry, TsfFile};
use anyhow::Context;
use image::{RgbImage, imageops};
use std::path::{Path, PathBuf};

/// Size of the demo's frames, pixels.
const SIZE: (usize, usize) = (512, 384);
/// Content beyond the frame that the shake can bring in, pixels.
const MARGIN: usize = 48;
/// Median luminance of the room: this part of white after 1 s. At 1/5 s that is 40 electrons, five times the read noise.
const MEDIAN: f64 = 0.05;
/// The seed of scene, shake and noise.
const SEED: u64 = 1;
/// One cell of the before/after picture, pixels.
const CELL: (u32, u32) = (400, 300);
/// Space between cells and height of a label's capitals, pixels.
const GAP: u32 = 8;
const LABEL: u32 = 15;
/// Quality of the picture as JPEG: below 400 kB, so that a web page can show it (as PNG it is 2 MB, of noise).
pub const JPEG_QUALITY: u8 = 80;
/// Upper left corners of the close-ups, for frames of [`SIZE`]; each shows [`CELL`] / 3.
const CLOSE_UPS: [(u32, u32); 2] = [(372, 86), (16, 272)];

/// Makes the demo's bracket: 1/30, 1/8 and 1/5 s sharp, 1/2 and 2 s shaken; a dim room and a small sensor, so that the sharp
/// frames are noisy.
///
/// # Errors
/// None that a caller could cause; see [`synth::capture()`].
pub fn bracket() -> crate::error::Result<SyntheticBracket> {
    let scene = synth::room(SIZE.0, SIZE.1, MARGIN, SEED);
    let shaken = |extent_px, roll_deg| Some(Tremor { extent_px, roll_deg, offset_px: 1.5, offset_deg: 0.1 });
    let frames = [(1.0 / 30.0, None), (1.0 / 8.0, None), (1.0 / 5.0, None), (1.0 / 2.0, shaken(6.0, 0.5)), (2.0, shaken(9.0, 0.8))];
    synth::capture(&scene, &Camera::default(), &frames, MEDIAN, SEED)
}

/// Runs the demo and writes everything to `output_dir`, which is made if need be; files of an earlier demo are replaced, other
/// files are not. `events` hears the merge's events and can stop it by returning `false`. Returns what was gained and written,
/// in words.
///
/// # Errors
/// What the merge reports, and files that cannot be written; nothing is written then.
pub fn run(output_dir: &Path, events: &mut dyn FnMut(Event) -> bool) -> anyhow::Result<String> {
    // Everything that can be refused comes before the work, and every file is complete before the first is renamed.
    std::fs::create_dir_all(output_dir)
        .with_context(|| format!("{}: cannot be made; choose another --output-dir", output_dir.display()))?;
    let targets = targets(output_dir)?;
    events(Event::Progress { stage: "photographing a room at night".into(), fraction: 0.0 });
    let synthetic = bracket()?;
    let frames = synthetic.bracket.frames();
    let response = Response::Srgb;
    let outcome = pipeline::merge(&synthetic.bracket, &response, &Settings::default(), None, events)?;

    let all: Vec<usize> = (0..frames.len()).collect();
    let sharp: Vec<usize> = all.iter().copied().filter(|&i| synthetic.sharp[i]).collect();
    let plain = baseline::merge(&synthetic.bracket, &response, &all);
    let sharp_only = baseline::merge(&synthetic.bracket, &response, &sharp);
    let radiometry = Radiometry { exposure_time: frames[outcome.reference].exposure_time, frame: frames[outcome.reference].name.clone() };
    let seconds = radiometry.exposure_time as f32;
    let unshaken = outcome.irradiance.map_planes(|p| p.map(|v| v / seconds));
    let truth = synthetic.truth.map_planes(|p| p.map(|v| v * seconds));
    let shortest = frames.iter().map(|f| f.exposure_time).fold(f64::INFINITY, f64::min);
    let judge = Judge { limit: Some((0.98 / shortest) as f32), ..Judge::default() };
    let judged = |image: &Rgb| score(image, &synthetic.truth, &judge);
    let scores = [judged(&plain)?, judged(&sharp_only)?, judged(&unshaken)?];

    let shaken = as_taken(&frames[frames.len() - 1], &response, &synthetic.truth);
    let columns = [("SHAKEN, 2 S", &shaken), ("ALL FRAMES MERGED", &plain), ("SHARP FRAMES ONLY", &sharp_only), ("UNSHAKEN", &unshaken)];
    let picture = comparison(&columns, &ToneMap::fit(&unshaken));
    let mut report = outcome.report;
    if let Some(fields) = report.as_object_mut() {
        let [plain, sharp_only, unshaken] = &scores;
        fields.insert(MARK.into(), serde_json::json!({ "plain": plain, "sharp_only": sharp_only, "unshaken": unshaken }));
    }
    let mut staged = vec![
        // The first to be renamed: by it a later demo knows the folder.
        targets.report.stage_json(&report)?,
        targets.picture.stage_png(&picture)?,
        targets.small.stage_jpeg(&picture, JPEG_QUALITY)?,
        targets.unshaken.stage_exr(&outcome.irradiance, &radiometry)?,
        targets.truth.stage_exr(&truth, &radiometry)?,
        targets.true_tsfs.stage_json(&true_tsfs(&synthetic))?,
    ];
    for (frame, target) in frames.iter().zip(&targets.frames) {
        staged.push(target.stage_png(&tonemap::codes(&frame.intensity))?);
    }
    for file in staged {
        file.commit()?;
    }
    Ok(summary(&scores, &targets))
}

/// The field by which the report tells that it is a demo's.
const MARK: &str = "demo";

/// The files that the demo writes.
struct Targets {
    report: Output,
    picture: Output,
    small: Output,
    unshaken: Output,
    truth: Output,
    true_tsfs: Output,
    frames: [Output; 5],
}

/// Checks that all files can be written; what is there must be an earlier demo's, for nobody asked to replace photographs.
fn targets(folder: &Path) -> anyhow::Result<Targets> {
    let earlier = crate::io::read_text(&folder.join(REPORT))
        .ok()
        .and_then(|text| serde_json::from_str::<serde_json::Value>(&text).ok())
        .is_some_and(|report| report.get(MARK).is_some());
    let at = |name: &str| -> anyhow::Result<Output> {
        let path: PathBuf = folder.join(name);
        if !earlier && path.symlink_metadata().is_ok() {
            anyhow::bail!("{}: exists and is not of an earlier demo; choose another --output-dir", path.display());
        }
        Ok(Output::check(&path, true)?)
    };
    Ok(Targets {
        report: at(REPORT)?,
        picture: at("before-after.png")?,
        small: at("before-after.jpg")?,
        unshaken: at("unshaken.exr")?,
        truth: at("truth.exr")?,
        true_tsfs: at("truth_tsf.json")?,
        frames: [at("frame1.png")?, at("frame2.png")?, at("frame3.png")?, at("frame4.png")?, at("frame5.png")?],
    })
}

const REPORT: &str = "report.json";

/// The demo's last words: scores of the plain merge, of the sharp frames alone, of the reconstruction; the files.
fn summary([plain, sharp_only, unshaken]: &[Score; 3], targets: &Targets) -> String {
    let line = |name: &str, s: &Score| format!("  {name:<28} {:5.1} dB   edges {:.2} of the truth's\n", s.pu_psnr, s.edge_ratio);
    let file = |target: &Output, what: &str| format!("  {:<40} {what}\n", target.path().display());
    let [first, .., last] = &targets.frames;
    let mut text = String::from("PU21-PSNR against the true irradiance:\n");
    text += &line("plain merge of all frames", plain);
    text += &line("merge of the sharp frames", sharp_only);
    text += &line("unshaken", unshaken);
    text += &format!(
        "gain: {:+.1} dB over the plain merge, {:+.1} dB over leaving the shaken frames out\nwrote\n",
        unshaken.pu_psnr - plain.pu_psnr,
        unshaken.pu_psnr - sharp_only.pu_psnr
    );
    text += &file(&targets.picture, "before and after: look at this first");
    text += &file(&targets.small, "the same, smaller");
    text += &file(&targets.unshaken, "the result, linear");
    text += &file(&targets.report, "everything that was estimated");
    text += &file(first, &format!("to {}: the frames", last.path().file_name().unwrap_or_default().display()));
    text += &file(&targets.truth, "the true irradiance, on the result's scale");
    text += &file(&targets.true_tsfs, "the true camera motion");
    text.truncate(text.trim_end().len());
    text
}

/// Irradiance of one frame for the picture: towards clipping it turns to the scene's brightest white, as a photograph's does.
pub fn as_taken(frame: &Frame, response: &Response, truth: &Rgb) -> Rgb {
    let white = truth.0[1].data.iter().copied().fold(0.0, f32::max);
    let mut out = frame.intensity.clone();
    for i in 0..out.0[0].data.len() {
        let z = frame.intensity.pixel(i);
        let clipping = ((z.iter().sum::<f32>() / 3.0 - 0.92) / 0.08).clamp(0.0, 1.0).powi(2);
        for (c, plane) in out.0.iter_mut().enumerate() {
            let irradiance = (response.inverse(c, f64::from(z[c])) / frame.exposure_time) as f32;
            plane.data[i] = irradiance.max(1e-6).powf(1.0 - clipping) * white.powf(clipping);
        }
    }
    out
}

/// The bracket's true TSFs as a TSF file.
fn true_tsfs(synthetic: &SyntheticBracket) -> TsfFile {
    let (width, height) = synthetic.bracket.size();
    let entry = |(frame, tsf): (&Frame, &crate::tsf::Tsf)| TsfEntry::new(&frame.name, width, height, tsf);
    TsfFile::new(synthetic.bracket.frames().iter().zip(&synthetic.tsfs).map(entry).collect())
}

/// One column per image: label, the whole image, close-ups enlarged three times; all through one tone map.
pub fn comparison(columns: &[(&str, &Rgb)], map: &ToneMap) -> RgbImage {
    let top = LABEL + 2 * GAP;
    let rows = 1 + CLOSE_UPS.len() as u32;
    let (width, height) = (columns.len() as u32 * (CELL.0 + GAP) + GAP, top + rows * (CELL.1 + GAP));
    let mut out = RgbImage::from_pixel(width, height, image::Rgb([24, 24, 26]));
    for (i, (label, image)) in columns.iter().enumerate() {
        let x = GAP + i as u32 * (CELL.0 + GAP);
        font::write(&mut out, label, x as f32 + 2.0, GAP as f32, LABEL as f32);
        let picture = map.apply(image);
        let whole = imageops::resize(&picture, CELL.0, CELL.1, imageops::FilterType::CatmullRom);
        imageops::replace(&mut out, &whole, i64::from(x), i64::from(top));
        for (row, (u, v)) in CLOSE_UPS.into_iter().enumerate() {
            let part = imageops::crop_imm(&picture, u, v, CELL.0 / 3, CELL.1 / 3).to_image();
            let large = imageops::resize(&part, CELL.0, CELL.1, imageops::FilterType::CatmullRom);
            imageops::replace(&mut out, &large, i64::from(x), i64::from(top + (row as u32 + 1) * (CELL.1 + GAP)));
        }
    }
    out
}
