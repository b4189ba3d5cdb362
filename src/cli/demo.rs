//! `unshaken demo`.

use super::args::DemoArgs;

pub(super) fn run(args: &DemoArgs) -> anyhow::Result<()> {
    anyhow::bail!("{}: demo is not built yet", args.output_dir.display())
}
