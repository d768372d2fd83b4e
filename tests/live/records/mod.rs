//! Records of runs that are killed at any moment, whose disk is full or stalls, whose folder is moved, or whose
//! viewer is frozen. Bench and stage are two processes over UDP multicast, in real time.
#![cfg(target_os = "linux")]

mod disk;
mod full;
mod hindered;
mod killed;
mod viewer;

use needle_bench::archive::Manifest;
use needle_bench::telemetry::RunFolder;
use std::path::Path;
use std::process::Command;

/// Half the speed of the tests on vcan, which have a machine to themselves, with a step every 0.2 s.
const SLOW: [&str; 2] = ["insertion.speed_mm_per_s=2.5", "insertion.step_mm=0.5"];

/// Closes the record in `run_dir` and makes its `run.rrd`, as an operator does; returns the output.
#[track_caller]
fn repair(run_dir: &Path) -> String {
    let mut bench = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    let said = bench.arg("review").arg(run_dir).arg("--repair").output().unwrap();
    let stderr = String::from_utf8_lossy(&said.stderr);
    assert!(said.status.success(), "{stderr}");
    // A repair that takes more than 2 s says how far it is.
    let mut faults = stderr.lines().filter(|line| !line.starts_with("making run.rrd: "));
    assert!(faults.all(|line| !line.contains("run.rrd")), "{stderr}");
    String::from_utf8_lossy(&said.stdout).into_owned()
}

/// Asserts that the record is closed and unchanged since then; returns its manifest.
#[track_caller]
fn closed(run_dir: &Path) -> Manifest {
    let run = RunFolder::open(run_dir).unwrap();
    assert!(run.is_closed());
    run.verify().unwrap();
    run.manifest.clone()
}
