//! `unshaken baseline`: what one would do instead of deblurring all frames together, judged side by side.

use super::{Usage, compare, frames, given, with_progress};
use crate::baseline;
use crate::experiments::Joint;
use crate::io::exr::{self, Radiometry};
use crate::io::output::{Output, Staged};
use crate::metrics::{self, Judge, Score};
use crate::pipeline::{Event, Settings};
use crate::response::Response;
use crate::tonemap::ToneMap;
use anyhow::Context;
use clap::{Args, ValueEnum};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "Examples:
  unshaken baseline --truth bracket/truth.exr --output-dir others bracket/frame*.png
  unshaken baseline --method debevec,mertens --output-dir others IMG_1.jpg IMG_2.jpg IMG_3.jpg";

#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct BaselineArgs {
    /// Frames of one scene, counted from 1
    #[arg(required = true, value_name = "FRAME")]
    pub frames: Vec<PathBuf>,
    /// Folder for the results, one EXR and one picture per method, made if need be
    #[arg(long, value_name = "DIR")]
    pub output_dir: PathBuf,
    /// Methods to run, in this order [default: all that the given files allow]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "NAME,NAME,...")]
    pub method: Vec<Method>,
    /// Exposure times in seconds in the order of the frames [default: from EXIF]
    #[arg(long, value_name = "T,T,...", allow_hyphen_values = true)]
    pub exposures: Option<String>,
    /// Camera response: srgb, linear, gamma:2.2, or a file from 'unshaken calibrate'
    #[arg(long, value_name = "NAME|FILE.json", default_value = "srgb")]
    pub response: String,
    /// These frames are sharp [default: found out]
    #[arg(long, value_name = "N,N,...", allow_hyphen_values = true)]
    pub sharp: Option<String>,
    /// Use these TSFs instead of estimating them (naive, unshaken)
    #[arg(long, value_name = "FILE.json")]
    pub tsf: Option<PathBuf>,
    /// When no frame is sharp: auto, joint, patches or off, as for 'unshaken merge' (naive, uniform, unshaken) [default: auto]
    #[arg(long, value_name = "auto|joint|patches|off", conflicts_with = "tsf")]
    pub blind: Option<String>,
    /// The same exposures from a tripod, for the method 'tripod'
    #[arg(long, value_name = "FRAME,FRAME,...", value_delimiter = ',')]
    pub tripod: Vec<PathBuf>,
    /// Judge all against this irradiance
    #[arg(long, value_name = "TRUTH.exr")]
    pub truth: Option<PathBuf>,
    /// Move the truth onto each result before judging it: results of all-blurred brackets may lie a few pixels off
    #[arg(long, value_enum, default_value = "none", requires = "truth")]
    pub align: compare::Alignment,
    /// Judge only where the truth is below this value
    #[arg(long, value_name = "VALUE", requires = "truth")]
    pub limit: Option<f32>,
    /// Replace outputs that exist
    #[arg(long)]
    pub overwrite: bool,
}

/// What can be done with a bracket.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Method {
    /// Weighted merge of all frames (Debevec and Malik 1997), blurred ones too
    Debevec,
    /// The same of the sharp frames alone: delete the shaken ones
    DebevecSharp,
    /// Exposure fusion (Mertens et al. 2007): a picture, not irradiance
    Mertens,
    /// Each shaken frame deblurred by itself, then merged
    Naive,
    /// All frames together, but with blur that is the same everywhere: stands in for Lu et al. 2009, whose program is not published
    Uniform,
    /// All frames together: this program
    Unshaken,
    /// Weighted merge of frames from a tripod: the ideal
    Tripod,
}

impl Method {
    fn name(self) -> &'static str {
        match self {
            Self::Debevec => "debevec",
            Self::DebevecSharp => "debevec-sharp",
            Self::Mertens => "mertens",
            Self::Naive => "naive",
            Self::Uniform => "uniform",
            Self::Unshaken => "unshaken",
            Self::Tripod => "tripod",
        }
    }
}

/// A method's files and what it made.
struct Made {
    method: Method,
    score: Option<Score>,
    sharpness: f64,
    staged: Vec<Staged>,
}

pub(super) fn run(args: &BaselineArgs) -> anyhow::Result<()> {
    let times = args.exposures.as_deref().map(|list| frames::exposure_times(list, &args.frames)).transpose()?;
    let sharp = args.sharp.as_deref().map(|l| given::frame_numbers("--sharp", l, args.frames.len())).transpose()?;
    frames::check(&args.frames)?;
    let methods = methods(args)?;
    let response = match Response::named(&args.response).map_err(|e| Usage(format!("--response: {e}")))? {
        Some(response) => response,
        None => given::read_response(Path::new(&args.response))?,
    };
    let tsf = args.tsf.as_deref().map(given::read_tsf).transpose()?;
    let blind = given::blind(args.blind.as_deref())?;
    std::fs::create_dir_all(&args.output_dir)
        .with_context(|| format!("{}: cannot be made; choose another --output-dir", args.output_dir.display()))?;
    let target = |m: Method, extension: &str| Output::check(&args.output_dir.join(format!("{}.{extension}", m.name())), args.overwrite);
    for &m in &methods {
        if m != Method::Mertens {
            target(m, "exr")?;
        }
        target(m, "png")?;
    }
    let truth = args.truth.as_deref().map(exr::read).transpose()?.map(|t| t.0);
    let made = with_progress(|events| {
        events(Event::Progress { stage: "reading frames".into(), fraction: 0.0 });
        let bracket = frames::read(&args.frames, times)?;
        let tripod = if methods.contains(&Method::Tripod) {
            let times = bracket.frames().iter().map(|f| f.exposure_time).collect();
            Some(frames::read(&args.tripod, Some(times))?)
        } else {
            None
        };
        let settings = Settings { sharp: sharp.clone(), blind, ..Settings::default() };
        let joint = if methods.iter().any(|m| matches!(m, Method::Naive | Method::Uniform | Method::Unshaken | Method::DebevecSharp)) {
            Some(Joint::new(&bracket, &response, &settings, tsf.as_ref(), events)?)
        } else {
            None
        };
        let mut rows = Vec::new();
        // One tone map for all, so that pictures can be compared: the best guess of the scene decides.
        let all: Vec<usize> = (0..bracket.frames().len()).collect();
        let tone = ToneMap::fit(joint.as_ref().map_or(&baseline::merge(&bracket, &response, &all), |j| &j.irradiance));
        for &m in &methods {
            events(Event::Progress { stage: format!("method {}", m.name()), fraction: 0.9 });
            let image = match (m, &joint, &tripod) {
                (Method::DebevecSharp, Some(j), _) => baseline::merge(&bracket, &response, &j.sharp),
                (Method::Unshaken, Some(j), _) => j.irradiance.clone(),
                (Method::Uniform, Some(j), _) => j.uniform(&bracket, &response, &settings, events)?.irradiance,
                (Method::Naive, Some(j), _) => {
                    let mut hear = |f: f32| events(Event::Progress { stage: "deblurring each frame".into(), fraction: 0.5 + 0.4 * f });
                    baseline::deblur_each(&bracket, &response, &j.tsfs, &settings.deblur, &mut hear)?
                }
                (Method::Tripod, _, Some(t)) => baseline::merge(t, &response, &all),
                (Method::Mertens, ..) => baseline::fuse(&bracket, &all),
                _ => baseline::merge(&bracket, &response, &all),
            };
            let mut staged = Vec::new();
            let picture = if m == Method::Mertens {
                crate::tonemap::codes(&image)
            } else {
                let radiometry = Radiometry { exposure_time: 1.0, frame: "none: irradiance per second".into() };
                staged.push(target(m, "exr")?.stage_exr(&image, &radiometry)?);
                tone.apply(&image)
            };
            staged.push(target(m, "png")?.stage_png(&picture)?);
            let judge = Judge { limit: args.limit, ..Judge::default() };
            let score = match &truth {
                Some(truth) if m != Method::Mertens => {
                    let (there, _) = metrics::align(&image, truth, args.align.into())?;
                    Some(metrics::score(&image, &there, &judge)?)
                }
                _ => None,
            };
            rows.push(Made { method: m, score, sharpness: metrics::cpbd_of(&picture), staged });
        }
        Ok(rows)
    })?;
    let table = compare::table(made.iter().map(|m| (m.method.name(), m.score.as_ref(), m.sharpness)));
    for file in made.into_iter().flat_map(|m| m.staged) {
        file.commit()?;
    }
    println!("{table}\nwrote an EXR and a PNG of each to {}", args.output_dir.display());
    Ok(())
}

fn methods(args: &BaselineArgs) -> Result<Vec<Method>, Usage> {
    let all: Vec<Method> = Method::value_variants().iter().copied().filter(|m| *m != Method::Tripod || !args.tripod.is_empty()).collect();
    let chosen = if args.method.is_empty() { all } else { args.method.clone() };
    if chosen.contains(&Method::Tripod) && args.tripod.len() != args.frames.len() {
        return Err(Usage(format!(
            "--tripod: {} for {}; the method 'tripod' needs one tripod frame per frame, in their order",
            frames::count(args.tripod.len(), "tripod frame"),
            frames::count(args.frames.len(), "frame")
        )));
    }
    if let Some(i) = (1..chosen.len()).find(|&i| chosen[..i].contains(&chosen[i])) {
        return Err(Usage(format!("--method: {} is named twice; name it once", chosen[i].name())));
    }
    Ok(chosen)
}
