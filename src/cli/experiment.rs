//! `unshaken experiment`.

use super::{Usage, with_progress};
use crate::experiments::{Experiment, Lab, Report};
use crate::io::output::{Output, Staged};
use crate::pipeline::Event;
use anyhow::Context;
use clap::Args;
use std::io::Write;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct ExperimentArgs {
    /// fig3, tsf, fig5, fig7, fig11, fig12, sharpness, or all
    #[arg(value_name = "NAME")]
    pub name: String,
    /// Folder for tables and pictures, made if need be
    #[arg(long, value_name = "DIR")]
    pub output_dir: PathBuf,
    /// Width of the frames in pixels; their height is three quarters of it
    #[arg(long, value_name = "PX", default_value_t = 256, value_parser = clap::value_parser!(u32).range(160..=2048))]
    pub width: u32,
    /// Seed of scenes, shake and noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Replace outputs that exist
    #[arg(long)]
    pub overwrite: bool,
}

pub(super) fn run(args: &ExperimentArgs) -> anyhow::Result<()> {
    let chosen =
        if args.name == "all" { Experiment::ALL.to_vec() } else { vec![Experiment::named(&args.name).map_err(|e| Usage(e.to_string()))?] };
    std::fs::create_dir_all(&args.output_dir)
        .with_context(|| format!("{}: cannot be made; choose another --output-dir", args.output_dir.display()))?;
    let at = |name: String| Output::check(&args.output_dir.join(name), args.overwrite);
    for e in &chosen {
        at(format!("{}.md", e.name()))?;
        at(format!("{}.jpg", e.name()))?;
    }
    let begun = std::time::Instant::now();
    let texts = with_progress(|events| {
        let mut lab = Lab::new(args.width as usize, args.seed);
        let mut texts = Vec::new();
        for (i, &e) in chosen.iter().enumerate() {
            let mut hear = |event: Event| match event {
                Event::Progress { stage, fraction } => events(Event::Progress {
                    stage: format!("{}: {stage}", e.name()),
                    fraction: (i as f32 + fraction) / chosen.len() as f32,
                }),
                warning => events(warning),
            };
            let report = lab.run(e, &mut hear)?;
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
        Ok(texts)
    })?;
    println!("{}", texts.join("\n"));
    println!("wrote tables and pictures to {} in {:.0} s", args.output_dir.display(), begun.elapsed().as_secs_f64());
    Ok(())
}

/// Quality of the pictures as JPEG.
const PICTURE_QUALITY: u8 = 85;

fn markdown(e: Experiment, report: &Report) -> String {
    format!("## {}\n\n{}\n\n{}\n\n![{}]({}.jpg)\n", report.title, report.text, report.table, report.title, e.name())
}
