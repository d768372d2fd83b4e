//! The Python programs of tests/peers.

use super::programs::Program;
use std::process::Command;

/// Starts `script`; none, said plainly, where `NEEDLE_PEERS_PYTHON` names no Python with
/// tests/peers/requirements.txt. Where it does, everything has to work.
pub(crate) fn peer(script: &str, arguments: &[&str]) -> Option<Program> {
    let Some(python) = std::env::var_os("NEEDLE_PEERS_PYTHON") else {
        println!("{script} SKIPPED: set NEEDLE_PEERS_PYTHON, see tests/peers/requirements.txt");
        return None;
    };
    let path = format!("{}/tests/peers/{script}", env!("CARGO_MANIFEST_DIR"));
    Some(Program::start(Command::new(python).arg(path).args(arguments)))
}
