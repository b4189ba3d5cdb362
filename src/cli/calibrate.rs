//! `unshaken calibrate`.

use super::args::{CalibrateArgs, Method};
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
    let given: Vec<f64> = bracket.frames().iter().map(|f| f.exposure_time).collect();
    let debevec = || {
        let method = "Debevec and Malik 1997, per channel, all pixels, ends extrapolated".to_owned();
        anyhow::Ok((response::calibrate(&bracket)?, method, given.clone()))
    };
    // Without a response to compare with, only times that contradict each other are seen; frames that say nothing say so.
    let (blocks, check) = match response::of_still_frames(&bracket) {
        Ok(found) => (found.poor.is_none().then_some((found.response, found.method)), Some(found.exposures)),
        Err(_) => (None, None),
    };
    let (response, method, exposure_times) = match args.method {
        Method::Blocks => match blocks {
            Some((response, method)) => (response, method, given.clone()),
            // Too few shades for blocks: single pixels show more.
            None => debevec()?,
        },
        Method::Debevec => debevec()?,
        Method::Mitsunaga => {
            let found = response::mitsunaga(&bracket)?;
            let method = format!("Mitsunaga and Nayar 1999, polynomials of degree {}, exposure times refined", found.degree);
            (found.response, method, found.exposure_times)
        }
    };
    if let Some(text) = check.and_then(|c| c.warning(&bracket)) {
        progress.warn(&text);
    }
    if args.method == Method::Mitsunaga {
        let differences: Vec<String> = exposure_times.iter().zip(&given).map(|(t, g)| format!("{:+.2}", (t / g).log2())).collect();
        progress.at(&format!("exposure times refined by {} EV", differences.join(", ")), 0.9);
    }
    let provenance = Provenance {
        program: concat!("unshaken ", env!("CARGO_PKG_VERSION")).into(),
        method,
        frames: bracket.frames().iter().map(|f| f.name.clone()).collect(),
        exposure_times,
    };
    target.stage_json(&ResponseFile::new(&response, provenance))?.commit()?;
    drop(progress);
    let text = format!("wrote {} (response from {})", args.output.display(), frames::count(args.frames.len(), "frame"));
    super::progress::done(&text, serde_json::json!({ "output": args.output }));
    Ok(())
}
