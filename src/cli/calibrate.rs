//! `unshaken calibrate`.

use super::args::CalibrateArgs;
use super::progress::Progress;
use super::{Usage, frames};
use crate::io::output::{self, Output};
use crate::response::{self, Provenance, ResponseFile};

pub(super) fn run(args: &CalibrateArgs) -> anyhow::Result<()> {
    let times = args.exposures.as_deref().map(|list| frames::exposure_times(list, &args.frames)).transpose()?;
    frames::check(&args.frames)?;
    let inputs: Vec<_> = args.frames.iter().map(|p| ("frame", p.as_path())).collect();
    output::check_distinct(&[("--output", &args.output)], &inputs).map_err(|e| Usage(e.to_string()))?;
    let target = Output::check(&args.output, args.overwrite)?;

    let mut progress = Progress::new();
    progress.at("reading frames", 0.0);
    let bracket = frames::read(&args.frames, times)?;
    progress.at("calibrating", 0.4);
    let response = response::calibrate(&bracket)?;
    let provenance = Provenance {
        program: concat!("unshaken ", env!("CARGO_PKG_VERSION")).into(),
        method: "Debevec and Malik 1997, per channel, all pixels, ends extrapolated".into(),
        frames: bracket.frames().iter().map(|f| f.name.clone()).collect(),
        exposure_times: bracket.frames().iter().map(|f| f.exposure_time).collect(),
    };
    target.stage_json(&ResponseFile::new(&response, provenance))?.commit()?;
    drop(progress);
    println!("wrote {} (response from {})", args.output.display(), frames::count(args.frames.len(), "frame"));
    Ok(())
}
