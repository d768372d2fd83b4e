//! The Python programs of tests/peers.

use super::needed::{python, skip};
use super::programs::Program;
use std::path::Path;
use std::process::Command;

/// Starts `script`; `None` without the Python of the peers.
pub(crate) fn peer(script: &str, arguments: &[&str]) -> Option<Program> {
    let python = python()?;
    let path = format!("{}/tests/peers/{script}", env!("CARGO_MANIFEST_DIR"));
    Some(Program::start(Command::new(python).arg(path).args(arguments)))
}

/// Starts `script`, which prints "listening PORT" once it serves; gives the port too.
pub(crate) fn serving_peer(script: &str, arguments: &[&str]) -> Option<(Program, String)> {
    let mut server = peer(script, arguments)?;
    server.wait_for("listening ");
    let said = server.said();
    let port = said.lines().find_map(|line| line.strip_prefix("listening "));
    Some((server, port.expect("a port").to_owned()))
}

/// Asserts that rerun's reader and pandas find the same run in `run.rrd` and in `steps.csv`, except for the last
/// `missing_max` rows.
#[track_caller]
pub(crate) fn assert_recording_agrees(run_dir: &Path, missing_max: usize) {
    let arguments = [run_dir.to_str().expect("UTF-8"), &missing_max.to_string()];
    if let Some(peer) = peer("recording_values.py", &arguments) {
        let compared = peer.end();
        compared.assert_status(0);
        print!("{}", compared.stdout);
    }
}

/// Stops the bench's thread of that name until the holder gets SIGINT; `None` without the permission to trace.
pub(crate) fn hold(bench: &Program, thread: &str) -> Option<Program> {
    let mut holder = peer("hold_thread.py", &[&bench.id().to_string(), thread])?;
    holder.wait_for("\n");
    let is_allowed = !holder.said().starts_with("not allowed");
    if !is_allowed {
        skip("permission to trace a process", "run the tests as root");
    }
    is_allowed.then_some(holder)
}
