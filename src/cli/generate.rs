//! `needle-bench generate`: completions and man pages, from the command line as it is declared.

use super::{Bench, Failure};
use clap::{Args, CommandFactory, Subcommand};
use clap_complete::Shell;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Completions for bash, on stdout.
    #[command(
        after_help = "Examples:\n  needle-bench generate bash > ~/.local/share/bash-completion/completions/needle-bench"
    )]
    Bash,
    /// Completions for zsh, on stdout.
    #[command(after_help = "Examples:\n  needle-bench generate zsh > ~/.zfunc/_needle-bench")]
    Zsh,
    /// Completions for fish, on stdout.
    #[command(
        after_help = "Examples:\n  needle-bench generate fish > ~/.config/fish/completions/needle-bench.fish"
    )]
    Fish,
    /// A man page for each command, into the folder DIR.
    #[command(after_help = "Examples:\n  needle-bench generate man ~/.local/share/man/man1")]
    Man {
        /// The folder.
        dir: PathBuf,
    },
}

pub(super) fn generate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let shell = match &arguments.what {
        What::Bash => Shell::Bash,
        What::Zsh => Shell::Zsh,
        What::Fish => Shell::Fish,
        What::Man { dir } => {
            let failed = |error| Failure::Environment(format!("{}: {error}", dir.display()));
            std::fs::create_dir_all(dir).map_err(failed)?;
            clap_mangen::generate_to(Bench::command(), dir).map_err(failed)?;
            return Ok(ExitCode::SUCCESS);
        }
    };
    // Not to stdout: clap_complete panics where that is closed.
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Bench::command(), "needle-bench", &mut script);
    std::io::stdout().write_all(&script).map_err(Failure::environment)?;
    Ok(ExitCode::SUCCESS)
}
