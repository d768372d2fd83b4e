//! The Python programs of tests/peers.

use super::needed::python;
use super::programs::Program;
use std::process::Command;

/// Starts `script` where there is a Python for it.
pub(crate) fn peer(script: &str, arguments: &[&str]) -> Option<Program> {
    let python = python()?;
    let path = format!("{}/tests/peers/{script}", env!("CARGO_MANIFEST_DIR"));
    Some(Program::start(Command::new(python).arg(path).args(arguments)))
}
