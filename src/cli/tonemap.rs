//! `unshaken tonemap`: a picture for the screen from a linear image.

use super::args::TonemapArgs;
use super::merge::{check_gain_map, check_picture_name};
use super::{Usage, interrupt, with_progress};
use crate::colour::{self, Primaries};
use crate::error::Error;
use crate::io::input;
use crate::io::output::{self, Output};
use crate::pipeline::Event;
use crate::tonemap::Operator;

pub(super) fn run(args: &TonemapArgs) -> anyhow::Result<()> {
    let operator = Operator::parse(&args.tonemap).map_err(|e| Usage(format!("--tonemap: {e}")))?;
    check_picture_name("--output", &args.output)?;
    check_gain_map(args.gain_map, "--output", &args.output)?;
    output::check_distinct(&[("--output", &args.output)], &[("image", &args.input)]).map_err(|e| Usage(e.to_string()))?;
    let target = Output::check(&args.output, args.overwrite)?;
    let text = with_progress(|events| {
        events(Event::Progress { stage: "reading".into(), fraction: 0.0 });
        let linear = input::read_linear(&args.input)?;
        let mut image = linear.image;
        let back = colour::inverse(&Primaries::Rec709.to_xyz()).expect("standard primaries");
        colour::convert(&mut image, &colour::product(&back, &linear.to_xyz));
        events(Event::Progress { stage: format!("tone mapping, {operator}"), fraction: 0.3 });
        let picture = operator.apply(&image);
        events(Event::Progress { stage: "writing".into(), fraction: 0.8 });
        let staged = if args.gain_map {
            target.stage_gain_map(&picture, &image, args.quality, &linear.metadata)?
        } else {
            target.stage_picture(&picture, args.quality, &linear.metadata)?
        };
        if interrupt::asked() {
            return Err(Error::Cancelled.into());
        }
        staged.commit()?;
        Ok(format!("wrote {} ({} x {}; {operator})", args.output.display(), picture.width(), picture.height()))
    })?;
    super::progress::done(&text, serde_json::json!({ "output": args.output }));
    Ok(())
}
