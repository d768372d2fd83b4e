//! Replays run folders that a test made.

use super::programs::Program;
use std::path::Path;
use std::process::Command;

/// Asserts that `needle-bench replay` gives the same run again.
#[track_caller]
pub(crate) fn assert_it_replays(run_dir: &Path) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    let replayed = Program::start(command.arg("replay").arg(run_dir)).end();
    println!("{}", replayed.stdout);
    replayed.assert_status(0);
    assert_eq!(replayed.last_line(), "identical");
}
