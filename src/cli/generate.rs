//! `unshaken generate`: shell completions and the manual page, from the command line's own description.

use super::args::{Generate, GenerateArgs};
use super::options;
use clap_complete::Shell;
use std::io::Write;

pub(super) fn run(args: &GenerateArgs) -> anyhow::Result<()> {
    let mut command = options::command();
    let mut text = Vec::new();
    let mut complete = |shell| clap_complete::generate(shell, &mut command, "unshaken", &mut text);
    match args.what {
        Generate::Bash => complete(Shell::Bash),
        Generate::Zsh => complete(Shell::Zsh),
        Generate::Fish => complete(Shell::Fish),
        Generate::Man => manual(&mut text)?,
    }
    // A pager that was left early is no fault.
    let _ = std::io::stdout().write_all(&text);
    Ok(())
}

/// The main page, then a section of options for each command.
fn manual(to: &mut Vec<u8>) -> std::io::Result<()> {
    let mut command = options::command().disable_help_subcommand(true);
    command.build();
    let page = clap_mangen::Man::new(command.clone());
    page.render(to)?;
    for sub in command.get_subcommands() {
        writeln!(to, ".SH \"UNSHAKEN {}\"", sub.get_name().to_uppercase())?;
        let page = clap_mangen::Man::new(sub.clone());
        page.render_description_section(to)?;
        page.render_synopsis_section(to)?;
        page.render_options_section(to)?;
        page.render_extra_section(to)?;
    }
    Ok(())
}
