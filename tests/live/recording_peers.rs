//! `run.rrd` and `steps.csv` in the eyes of programs nobody here wrote: rerun's own checker and
//! reader, and pandas.

use crate::support::peers::peer;
use crate::support::program::{Scratch, needle_bench};
use crate::support::programs::beside_others;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Steps that a kill may cost the recording and not `steps.csv`: a tenth of a second of virtual
/// time, which is as fast as the machine is.
const STEPS_LOST_MAX: &str = "1000";

fn compare(arguments: &[&str]) {
    if let Some(peer) = peer("recording_values.py", arguments) {
        let said = peer.end();
        said.assert_status(0);
        print!("{}", said.stdout);
    }
}

#[test]
fn a_finished_recording_holds_what_steps_csv_holds() {
    let _machine = beside_others();
    let scratch = Scratch::new();
    let arguments = ["run", "--set", "insertion.depth_mm=60", "--json"];
    let run = needle_bench(&scratch, &arguments);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let run_dir = scratch.path().join(run.json()["run_dir"].as_str().expect("a folder"));
    compare(&[run_dir.to_str().expect("UTF-8")]);
}

/// A bench that is killed in the middle of a run, and its record repaired.
#[test]
fn a_repaired_recording_holds_what_it_held_when_the_bench_was_killed() {
    let _machine = beside_others();
    let scratch = Scratch::new();
    let mut bench = Bench::start(scratch.path());
    let run_dir = bench.killed_after_rows(100);
    let run = run_dir.to_str().expect("UTF-8");
    let repaired = needle_bench(&scratch, &["review", run, "--repair"]);
    assert_eq!(repaired.status, 0, "{}", repaired.stderr);
    compare(&[run, STEPS_LOST_MAX]);
}

/// A bench with thousands of steps to go, ended with the test whatever happens.
struct Bench {
    child: Child,
    runs: PathBuf,
}

impl Bench {
    fn start(dir: &Path) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_needle-bench"))
            .args(["run", "--quiet", "--set", "insertion.step_mm=0.1"])
            .current_dir(dir)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the program starts");
        Bench { child, runs: dir.join("runs") }
    }

    /// Kills the bench once `steps.csv` has so many rows; its run folder.
    fn killed_after_rows(&mut self, rows: usize) -> PathBuf {
        let deadline = Instant::now() + Duration::from_secs(120);
        loop {
            assert!(Instant::now() < deadline, "no {rows} steps in two minutes");
            assert_eq!(self.child.try_wait().expect("a child"), None, "the run ended by itself");
            let run_dir = fs::read_dir(&self.runs).ok().and_then(|mut runs| runs.next());
            let Some(Ok(run_dir)) = run_dir else { continue };
            let steps = fs::read_to_string(run_dir.path().join("steps.csv")).unwrap_or_default();
            if steps.lines().count() > rows {
                self.child.kill().expect("a child that lives");
                self.child.wait().expect("a child that ends");
                return run_dir.path();
            }
        }
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
