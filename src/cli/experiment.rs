//! `unshaken experiment`.

use super::{Usage, frames, with_progress};
use crate::experiments::{Experiment, Lab, Report};
use crate::io::output::{Output, Staged, ending};
use crate::pipeline::Event;
use anyhow::Context;
use clap::Args;
use std::io::Write;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "Examples:
  unshaken experiment fig5 --output-dir experiments
  unshaken experiment all --output-dir experiments";

#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct ExperimentArgs {
    /// fig3, fig4, tsf, fig5, fig6, ..., fig12, sharpness, office, or all
    #[arg(value_name = "NAME")]
    pub name: String,
    /// Folder for tables and pictures, made if need be
    #[arg(long, value_name = "DIR")]
    pub output_dir: PathBuf,
    /// Width of the frames in pixels; their height is three quarters of it
    #[arg(long, value_name = "PX", default_value_t = 192, value_parser = clap::value_parser!(u32).range(160..=2048))]
    pub width: u32,
    /// Seed of scenes, shake and noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Folder with a bracket of JPEG files with EXIF from a tripod, for the experiment 'office': it is calibrated, merged, shaken and photographed again
    #[arg(long, value_name = "DIR")]
    pub photographs: Option<PathBuf>,
    /// Replace outputs that exist
    #[arg(long)]
    pub overwrite: bool,
}

pub(super) fn run(args: &ExperimentArgs) -> anyhow::Result<()> {
    let chosen =
        if args.name == "all" { Experiment::ALL.to_vec() } else { vec![Experiment::named(&args.name).map_err(|e| Usage(e.to_string()))?] };
    let mut chosen = chosen;
    if args.photographs.is_none() && chosen.contains(&Experiment::Office) {
        if args.name != "all" {
            return Err(
                Usage("the experiment office needs photographs; give --photographs FOLDER with a bracket from a tripod".into()).into()
            );
        }
        super::warn("office is left out: it needs --photographs FOLDER with a bracket from a tripod");
        chosen.retain(|e| *e != Experiment::Office);
    }
    let photographs = args.photographs.as_deref().map(jpegs).transpose()?;
    std::fs::create_dir_all(&args.output_dir)
        .with_context(|| format!("{}: cannot be made; choose another --output-dir", args.output_dir.display()))?;
    let at = |name: String| Output::check(&args.output_dir.join(name), args.overwrite);
    for e in &chosen {
        at(format!("{}.md", e.name()))?;
        at(format!("{}.jpg", e.name()))?;
    }
    let begun = std::time::Instant::now();
    let (texts, times) = with_progress(|events| {
        let photographs = photographs.as_deref().map(|p| frames::read(p, None)).transpose()?;
        let mut lab = Lab::new(args.width as usize, args.seed, photographs);
        let mut texts = Vec::new();
        let mut times = Vec::new();
        for (i, &e) in chosen.iter().enumerate() {
            let mut hear = |event: Event| match event {
                Event::Progress { stage, fraction } => events(Event::Progress {
                    stage: format!("{}: {stage}", e.name()),
                    fraction: (i as f32 + fraction) / chosen.len() as f32,
                }),
                warning => events(warning),
            };
            let begun = std::time::Instant::now();
            let report = lab.run(e, &mut hear)?;
            times.push(format!("{} {:.0} s", e.name(), begun.elapsed().as_secs_f64()));
            let text = markdown(e, &report);
            let staged: Vec<Staged> = vec![
                at(format!("{}.md", e.name()))?.stage(|to| to.write_all(text.as_bytes()).map_err(|e| e.to_string()))?,
                at(format!("{}.jpg", e.name()))?.stage_jpeg(&report.picture, PICTURE_QUALITY)?,
            ];
            for file in staged {
                file.commit()?;
            }
            texts.push(text);
        }
        Ok((texts, times))
    })?;
    println!("{}", texts.join("\n"));
    let seconds = begun.elapsed().as_secs_f64();
    println!("wrote tables and pictures to {} in {seconds:.0} s ({})", args.output_dir.display(), times.join(", "));
    Ok(())
}

/// The JPEG files of a folder, in the order of their names.
fn jpegs(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder)
        .with_context(|| format!("{}: cannot be read; give --photographs the folder of a bracket", folder.display()))?;
    let mut found: Vec<PathBuf> =
        entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| matches!(ending(p).as_str(), "jpg" | "jpeg")).collect();
    found.sort();
    if found.len() < 2 {
        let count = frames::count(found.len(), "JPEG file");
        return Err(Usage(format!("--photographs: {} holds {count}; a bracket has two or more", folder.display())).into());
    }
    Ok(found)
}

/// Quality of the pictures as JPEG.
const PICTURE_QUALITY: u8 = 85;

fn markdown(e: Experiment, report: &Report) -> String {
    format!("## {}\n\n{}\n\n{}\n\n![{}]({}.jpg)\n", report.title, report.text, report.table, report.title, e.name())
}
