//! The Python programs of tests/peers.

use super::needed::{python, skip};
use super::programs::Program;
use std::process::Command;

/// Starts `script` where there is a Python for it.
pub(crate) fn peer(script: &str, arguments: &[&str]) -> Option<Program> {
    let python = python()?;
    let path = format!("{}/tests/peers/{script}", env!("CARGO_MANIFEST_DIR"));
    Some(Program::start(Command::new(python).arg(path).args(arguments)))
}

/// Holds the bench's thread of that name until the holder gets SIGINT; none where that is not possible here.
pub(crate) fn hold(bench: &Program, thread: &str) -> Option<Program> {
    let mut holder = peer("hold_thread.py", &[&bench.id().to_string(), thread])?;
    holder.wait_for("\n");
    let is_allowed = !holder.said().starts_with("not allowed");
    if !is_allowed {
        skip("permission to trace a process", "run the tests as root");
    }
    is_allowed.then_some(holder)
}
