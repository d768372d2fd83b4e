//! `needle-bench generate`: completions and man pages, from the command line as it is declared.

use super::{Failure, command_line};
use clap::Subcommand;
use clap_complete::Shell;
use std::io::{self, Write as _};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Debug, Subcommand)]
pub(super) enum What {
    /// Completions for bash, on stdout.
    Bash,
    /// Completions for zsh, on stdout.
    Zsh,
    /// Completions for fish, on stdout.
    Fish,
    /// A man page for each command, into the folder DIR.
    Man {
        /// The folder.
        dir: PathBuf,
    },
}

pub(super) fn generate(what: &What) -> Result<ExitCode, Failure> {
    let shell = match what {
        What::Bash => Shell::Bash,
        What::Zsh => Shell::Zsh,
        What::Fish => Shell::Fish,
        What::Man { dir } => {
            let failed =
                |error: io::Error| Failure::environment(format_args!("{}: {error}", dir.display()));
            std::fs::create_dir_all(dir).map_err(failed)?;
            clap_mangen::generate_to(command_line(), dir).map_err(failed)?;
            return Ok(ExitCode::SUCCESS);
        }
    };
    // Not to stdout: clap_complete panics where that is closed.
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut command_line(), "needle-bench", &mut script);
    std::io::stdout().write_all(&script)?;
    Ok(ExitCode::SUCCESS)
}
