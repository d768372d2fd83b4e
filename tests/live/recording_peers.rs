//! Rerun's own checker and reader, and pandas, read `run.rrd` and `steps.csv`.

use crate::support::peers::assert_recording_agrees;
use crate::support::program::{Scratch, needle_bench};
use crate::support::programs::{Program, beside_others};
use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

/// Steps that a kill may cost the recording and not `steps.csv`: those of a tenth of a second, in which a fast
/// machine makes 1000.
const STEPS_LOST_MAX: usize = 1000;

#[test]
fn a_finished_recording_holds_what_steps_csv_holds() {
    let _machine = beside_others();
    let scratch = Scratch::new();
    let arguments = ["run", "--set", "insertion.depth_mm=60", "--json"];
    let run = needle_bench(&scratch, &arguments);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let run_dir = scratch.path().join(run.json()["run_dir"].as_str().expect("a folder"));
    assert_recording_agrees(&run_dir, 0);
}

#[test]
fn a_repaired_recording_holds_the_steps_before_the_kill() {
    let _machine = beside_others();
    let scratch = Scratch::new();
    let run_dir = killed_after_rows(&scratch, 100);
    let run = run_dir.to_str().expect("UTF-8");
    let repaired = needle_bench(&scratch, &["review", run, "--repair"]);
    assert_eq!(repaired.status, 0, "{}", repaired.stderr);
    assert_recording_agrees(&run_dir, STEPS_LOST_MAX);
}

/// Kills a bench once its `steps.csv` has so many of the thousands of rows to come; returns the run folder.
fn killed_after_rows(scratch: &Scratch, rows: usize) -> PathBuf {
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    command.args(["run", "--quiet", "--set", "insertion.step_mm=0.1"]).current_dir(scratch.path());
    let mut bench = Program::start(&mut command);
    let deadline = Instant::now() + Duration::from_secs(120);
    loop {
        assert!(Instant::now() < deadline, "no {rows} steps in two minutes");
        assert!(!bench.has_ended(), "the run ended by itself: {}", bench.said());
        let runs = fs::read_dir(scratch.path().join("runs")).ok();
        if let Some(Ok(run_dir)) = runs.and_then(|mut runs| runs.next()) {
            let steps = fs::read_to_string(run_dir.path().join("steps.csv")).unwrap_or_default();
            if steps.lines().count() > rows {
                bench.signal("KILL");
                assert_eq!(bench.end().status.code(), None, "killed by a signal");
                return run_dir.path();
            }
        }
        thread::sleep(Duration::from_millis(1));
    }
}
