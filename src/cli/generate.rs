//! `needle-bench generate`: completions and man pages, from the command line as it is declared.

use super::output::print_stdout;
use super::{Failure, Result, command_line};
use clap::Subcommand;
use clap_complete::Shell;
use std::path::PathBuf;

#[derive(Debug, Subcommand)]
pub(super) enum Artifact {
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

pub(super) fn generate(artifact: &Artifact) -> Result<()> {
    let shell = match artifact {
        Artifact::Bash => Shell::Bash,
        Artifact::Zsh => Shell::Zsh,
        Artifact::Fish => Shell::Fish,
        Artifact::Man { dir } => {
            let written = std::fs::create_dir_all(dir)
                .and_then(|()| clap_mangen::generate_to(command_line(), dir));
            return written.map_err(|error| Failure::io(dir, error));
        }
    };
    // Into memory first: clap_complete panics if stdout is closed.
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut command_line(), "needle-bench", &mut script);
    print_stdout(String::from_utf8_lossy(&script).trim_end())
}
