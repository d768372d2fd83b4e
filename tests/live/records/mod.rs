//! Records that can be trusted whatever ends or hinders the run: killed at any moment, on a disk
//! that is full or takes nothing, with its folder taken away, before a viewer that is frozen. Two
//! processes over UDP multicast, in real time.
#![cfg(target_os = "linux")]

mod disk;
mod full;
mod hindered;
mod killed;
mod viewer;
mod witness;

use crate::support::peers;
use needle_bench::archive::Manifest;
use needle_bench::telemetry::RunFolder;
use std::path::Path;
use std::process::Command;

/// rerun's reader and pandas find one run in the recording and in `steps.csv`, but for the last
/// `missing_max` rows.
fn assert_they_agree(run_dir: &Path, missing_max: usize) {
    let arguments = [run_dir.to_str().expect("UTF-8"), &missing_max.to_string()];
    if let Some(peer) = peers::peer("recording_values.py", &arguments) {
        let said = peer.end();
        said.assert_status(0);
        print!("{}", said.stdout);
    }
}

/// Half as fast as the tests on vcan, which have a machine to themselves, with a step every 0.2 s.
const SLOW: [&str; 2] = ["insertion.speed_mm_per_s=2.5", "insertion.step_mm=0.5"];

/// Closes the record in `run_dir` and makes its `run.rrd`, as an operator does; what was said.
#[track_caller]
fn repair(run_dir: &Path) -> String {
    let mut bench = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    let said = bench.arg("review").arg(run_dir).arg("--repair").output().unwrap();
    let stderr = String::from_utf8_lossy(&said.stderr);
    assert!(said.status.success(), "{stderr}");
    assert!(!stderr.contains("run.rrd"), "{stderr}");
    String::from_utf8_lossy(&said.stdout).into_owned()
}

/// The manifest of a record that was closed and is what it says.
#[track_caller]
fn closed(run_dir: &Path) -> Manifest {
    let run = RunFolder::open(run_dir).unwrap();
    assert!(run.is_closed());
    run.verify().unwrap();
    run.manifest().clone()
}
