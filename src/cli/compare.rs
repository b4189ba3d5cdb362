//! `unshaken compare`: results against the truth, or pictures by their sharpness.

use super::Usage;
use crate::error::Error;
use crate::image::Rgb;
use crate::io::exr;
use crate::io::output::Output;
use crate::metrics::{self, Align, Judge, Moved, Score};
use crate::tonemap;
use clap::{Args, ValueEnum};
use serde::Serialize;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "Examples:
  unshaken compare result.exr truth.exr --map error.png
  unshaken compare --align rigid --json a.exr b.exr truth.exr
  unshaken compare --no-reference a.jpg b.jpg";

#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct CompareArgs {
    /// One or more results and, last, the truth: linear OpenEXR of one size. With --no-reference pictures (PNG, JPEG, TIFF or EXR)
    #[arg(required = true, value_name = "RESULT.exr... TRUTH.exr")]
    pub files: Vec<PathBuf>,
    /// Move the truth onto the result before judging: results of all-blurred brackets may lie a few pixels off
    #[arg(long, value_enum, default_value = "none")]
    pub align: Alignment,
    /// Judge only where the truth is below this value (what even the shortest frame clipped cannot be known)
    #[arg(long, value_name = "VALUE")]
    pub limit: Option<f32>,
    /// Pixels left out at each side
    #[arg(long, value_name = "PX", default_value_t = 24)]
    pub crop: usize,
    /// Luminance in cd/m2 that the truth's highlights (99.5th percentile) are shown at
    #[arg(long, value_name = "NITS", default_value_t = 1000.0)]
    pub peak_nits: f64,
    /// Write the error as a picture: red where too bright, blue where too dark (one result only)
    #[arg(long, value_name = "OUT.png")]
    pub map: Option<PathBuf>,
    /// No truth: sharpness alone (CPBD, Narvekar and Karam 2011: the part of the edges without noticeable blur, 0 to 1)
    #[arg(long, conflicts_with_all = ["align", "limit", "map"])]
    pub no_reference: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
    /// Replace an output that exists
    #[arg(long)]
    pub overwrite: bool,
}

/// `--align`.
#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
pub(super) enum Alignment {
    /// Both lie on one grid
    None,
    /// By a shift
    Shift,
    /// By a shift and a rotation
    Rigid,
}

impl From<Alignment> for Align {
    fn from(a: Alignment) -> Self {
        match a {
            Alignment::None => Self::None,
            Alignment::Shift => Self::Shift,
            Alignment::Rigid => Self::Rigid,
        }
    }
}

/// One judged file.
#[derive(Serialize)]
struct Judged {
    file: String,
    #[serde(flatten)]
    score: Option<Score>,
    #[serde(skip_serializing_if = "Option::is_none")]
    moved: Option<Moved>,
    /// CPBD of the tone-mapped picture.
    sharpness: f64,
}

pub(super) fn run(args: &CompareArgs) -> anyhow::Result<()> {
    if args.no_reference {
        let rows = args.files.iter().map(|f| sharpness_of(f)).collect::<Result<Vec<_>, _>>()?;
        return print(args, &rows);
    }
    let Some((truth_path, results)) = args.files.split_last().filter(|(_, r)| !r.is_empty()) else {
        return Err(Usage("compare needs a result and the truth; for pictures without a truth give --no-reference".into()).into());
    };
    if args.map.is_some() && results.len() > 1 {
        return Err(Usage("--map shows one result; give one".into()).into());
    }
    if !(args.peak_nits.is_finite() && args.peak_nits > 0.0) {
        return Err(Usage(format!("--peak-nits: {} is not a positive number", args.peak_nits)).into());
    }
    let map = args.map.as_deref().map(|p| Output::check(p, args.overwrite)).transpose()?;
    let (truth, _) = exr::read(truth_path)?;
    let judge = Judge { crop: args.crop, peak_nits: args.peak_nits, limit: args.limit };
    let tone = tonemap::ToneMap::fit(&truth);
    let mut rows = Vec::new();
    for path in results {
        let named = |e: Error| Error::Format { path: path.clone(), reason: e.to_string() };
        let (result, _) = exr::read(path)?;
        let (moved_truth, moved) = metrics::align(&result, &truth, args.align.into()).map_err(named)?;
        let score = metrics::score(&result, &moved_truth, &judge).map_err(named)?;
        if let Some(map) = &map {
            map.stage_png(&metrics::error_map(&result, &moved_truth, &judge).map_err(named)?)?.commit()?;
        }
        let moved = (args.align != Alignment::None).then_some(moved);
        // Shown at the truth's brightness, so that results of any scale are shown alike.
        let gain = (brightness(&truth) / brightness(&result).max(1e-30)) as f32;
        let shown = result.map_planes(|p| p.map(|v| v * gain));
        rows.push(Judged { file: path.display().to_string(), score: Some(score), moved, sharpness: metrics::cpbd_of(&tone.apply(&shown)) });
    }
    print(args, &rows)
}

/// Median of the mean of the channels.
fn brightness(image: &Rgb) -> f64 {
    let mut v = image.mean().data;
    let middle = v.len() / 2;
    f64::from(*v.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// CPBD of a picture, or of an EXR's tone-mapped preview.
fn sharpness_of(path: &Path) -> Result<Judged, Error> {
    let picture = if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr")) {
        tonemap::preview(&exr::read(path)?.0)
    } else {
        tonemap::codes(&crate::io::ldr::read(path)?.intensity)
    };
    if picture.width().min(picture.height()) < 64 {
        return Err(Error::Format { path: path.into(), reason: "is smaller than 64 pixels, too small to measure sharpness".into() });
    }
    Ok(Judged { file: path.display().to_string(), score: None, moved: None, sharpness: metrics::cpbd_of(&picture) })
}

fn print(args: &CompareArgs, rows: &[Judged]) -> anyhow::Result<()> {
    if args.json {
        let text = if let [one] = rows { serde_json::to_string_pretty(one) } else { serde_json::to_string_pretty(rows) };
        println!("{}", text?);
        return Ok(());
    }
    println!("{}", table(rows.iter().map(|r| (r.file.as_str(), r.score.as_ref(), r.sharpness))));
    for row in rows {
        if let Some(m) = row.moved {
            println!("{}: the truth was moved by ({:.2}, {:.2}) px and {:.3} deg", row.file, m.x, m.y, m.roll_deg);
        }
    }
    Ok(())
}

/// One line per row (name, score, sharpness) under a heading.
pub(super) fn table<'a>(rows: impl Iterator<Item = (&'a str, Option<&'a Score>, f64)> + Clone) -> String {
    let wide = rows.clone().map(|r| r.0.chars().count()).max().unwrap_or(0).max(6);
    let judged = rows.clone().any(|r| r.1.is_some());
    let mut out = format!("{:<wide$}", "");
    if judged {
        out += "  PU-PSNR   dark    mid bright  PU-SSIM  mu-PSNR  log-RMSE  edges";
    }
    out += "  sharpness";
    for (name, score, sharpness) in rows {
        out += &format!("\n{name:<wide$}");
        if let Some(s) = score {
            out += &format!(
                "  {:7.2} {:6.2} {:6.2} {:6.2}   {:.4}  {:7.2}    {:.4}   {:.2}",
                s.pu_psnr, s.pu_dark, s.pu_mid, s.pu_bright, s.pu_ssim, s.mu_psnr, s.log_rmse, s.edge_ratio
            );
        } else if judged {
            out += &format!("  {:63}", "(no irradiance)");
        }
        out += &format!("      {sharpness:.3}");
    }
    out
}
