//! Runs whose writer or disk stalls, or whose viewer reads nothing.

use super::disk::Disk;
use super::viewer::frozen_viewer;
use super::{SLOW, closed, repair};
use crate::support::peers::{assert_recording_agrees, hold};
use crate::support::programs::{self, Ended, Program, Scratch, beside_others, free_address};
use crate::support::udp_stage::Stage;
use crate::support::witness::Witness;
use needle_bench::archive::{Manifest, file};
use needle_bench::telemetry::RunFolder;

/// A run of some seconds with a hindrance in the middle.
struct Hindered {
    scratch: Scratch,
    stage: Stage,
}

/// Depths at which the hindrance begins and ends, mm, and depth of the run.
const BEGINS_MM: f64 = 1.0;
const ENDS_MM: f64 = 5.0;
const DEPTH: &str = "insertion={ depth_mm = 8, plane_out_of_reach = \"insert\" }";

impl Hindered {
    fn new(by: &str) -> Self {
        let scratch = Scratch::new(&format!("records-{}", by.replace(' ', "-")));
        Hindered { scratch, stage: Stage::start(&[]) }
    }

    /// A run whose record goes to a disk of its own; `None` without the permission to mount.
    fn on_disk(by: &str) -> Option<(Self, Disk)> {
        let run = Self::new(by);
        let disk = Disk::in_file(run.scratch.path("runs"), &run.scratch.path("disk"))?;
        Some((run, disk))
    }

    /// Starts the bench and waits for the depth at which the hindrance begins.
    fn begin(&self, flags: &[&str], settings: &[&str]) -> (Program, Witness) {
        let mut witness = Witness::of(&self.stage);
        let settings = [&SLOW[..], settings].concat();
        let flags = [&["--json"], flags].concat();
        let bench = self.scratch.bench(&flags, &self.stage.settings(&settings));
        witness.wait_until_inserted(BEGINS_MM);
        (bench, witness)
    }

    /// Asserts that the run completed and its record is complete. Prints the timing, to compare with that of a run
    /// without a hindrance.
    fn assert_whole(&self, by: &str, bench: &Ended) -> Manifest {
        bench.assert_status(0);
        let manifest = closed(&self.scratch.run_dir());
        let dropped = manifest.dropped.unwrap();
        let timing = &bench.json()["timing"];
        let [sync, record] = ["sync_late_us", "record_ns"].map(|figure| {
            ["p50", "p99", "max"].map(|of| timing[format!("{figure}_{of}")].to_string()).join(" ")
        });
        println!("{by}: SYNC late {sync} us, a record queued in {record} ns; {dropped:?}");
        assert_eq!((manifest.faults.len(), dropped.text_files, dropped.recording), (0, 0, 0));
        let can_log = programs::read(&self.scratch.run_dir().join(file::CAN));
        let syncs = can_log.lines().filter(|line| line.ends_with(" 080# T")).count();
        assert_eq!(timing["syncs"], syncs);
        manifest
    }
}

#[test]
fn a_run_without_a_hindrance_has_a_complete_record() {
    let _machine = beside_others();
    let run = Hindered::new("nothing");
    let (bench, mut witness) = run.begin(&[], &[DEPTH]);
    witness.wait_until_inserted(ENDS_MM);
    run.assert_whole("no hindrance", &bench.end());
    assert_recording_agrees(&run.scratch.run_dir(), 0);
}

/// For the other threads a writer that is stopped by ptrace is like one that waits for its disk.
#[test]
fn a_writer_that_stalls_is_reported_and_loses_nothing() {
    let _machine = beside_others();
    for thread in ["text-files", "run-folder"] {
        let run = Hindered::new(thread);
        let (mut bench, mut witness) = run.begin(&[], &[DEPTH]);
        let Some(holder) = hold(&bench, thread) else { return };
        let name = thread.replace('-', " ");
        bench.wait_for(&format!("record: {name}: no sign of life for 0.7 s"));
        witness.wait_until_inserted(ENDS_MM);
        holder.signal("INT");
        holder.end().assert_status(0);
        bench.wait_for(&format!("record: {name}: alive again after "));
        run.assert_whole(&format!("{name} held"), &bench.end());
    }
}

#[test]
fn a_frozen_disk_is_reported_and_loses_nothing() {
    let _machine = beside_others();
    let Some((run, disk)) = Hindered::on_disk("frozen") else { return };
    let (mut bench, mut witness) = run.begin(&[], &[DEPTH, "record.free_mb_min=0"]);
    let frozen = disk.freeze();
    bench.wait_for("no sign of life for 0.7 s");
    witness.wait_until_inserted(ENDS_MM);
    drop(frozen);
    bench.wait_for("alive again after ");
    run.assert_whole("disk frozen", &bench.end());
}

/// One viewer reads nothing of what the bench sends. In addition the bench's thread that serves viewers is
/// stopped, as if it waited for one for ever.
#[test]
fn frozen_viewers_disturb_neither_the_run_nor_its_record() {
    let _machine = beside_others();
    let run = Hindered::new("viewer");
    let address = free_address();
    let live = format!("--live={address}");
    let viewer = std::thread::spawn(move || frozen_viewer(address));
    let (bench, mut witness) = run.begin(&[&live], &[DEPTH]);
    let holder = hold(&bench, "live-view");
    witness.wait_until_inserted(ENDS_MM);
    // The disk may stall for other reasons, but must recover while the viewers are frozen.
    let said = bench.said();
    let times = |words: &str| said.matches(words).count();
    assert_eq!(times("no sign of life"), times("alive again"), "{said}");
    if let Some(holder) = holder {
        holder.signal("INT");
        holder.end().assert_status(0);
    }
    let bench = bench.end();
    run.assert_whole("viewer frozen", &bench);
    drop(viewer.join());
}

#[test]
fn a_writer_that_stalls_for_5_s_stops_the_run_safely() {
    let _machine = beside_others();
    let run = Hindered::new("stalled");
    let (mut bench, _) = run.begin(&[], &[]);
    let Some(holder) = hold(&bench, "text-files") else { return };
    bench.wait_for("fault: record: text files: no sign of life for 5.0 s (given up after 5.0)");
    bench.wait_for("stage: taking power off both axes");
    // The writer resumes after all, and writes what waited.
    holder.signal("INT");
    run.assert_stopped(&bench.end());
}

/// The bench cannot know what such a writer has written, so it does not close the record.
#[test]
fn a_writer_that_stalls_beyond_the_end_leaves_the_record_open() {
    let _machine = beside_others();
    let run = Hindered::new("lost");
    let (mut bench, _) = run.begin(&[], &[]);
    let Some(holder) = hold(&bench, "text-files") else { return };
    // The process cannot end while one of its threads is stopped, but it prints its result.
    bench.wait_for("\"record_error\"");
    drop(holder);
    let bench = bench.end();
    bench.assert_status(3);
    let json = bench.json();
    assert!(json["stop_reason"].as_str().unwrap().starts_with("record: text files: no sign"));
    assert!(
        json["record_error"].as_str().unwrap().starts_with("text files: no sign of life for 1")
    );
    let run_dir = run.scratch.run_dir();
    assert!(!RunFolder::open(&run_dir).unwrap().is_closed());
    repair(&run_dir);
    let manifest = closed(&run_dir);
    assert!(manifest.faults.iter().any(|fault| fault.starts_with("text files: ")), "{manifest:?}");
}

#[test]
fn a_disk_that_stalls_for_5_s_stops_the_run_safely() {
    let _machine = beside_others();
    let Some((run, disk)) = Hindered::on_disk("dead") else { return };
    let (mut bench, _) = run.begin(&[], &["record.free_mb_min=0"]);
    let frozen = disk.freeze();
    bench.wait_for("fault: record: ");
    bench.wait_for("stage: taking power off both axes");
    drop(frozen);
    run.assert_stopped(&bench.end());
}

/// The bench prints its result all the same, and the record can be closed afterwards.
#[test]
fn a_disk_that_stalls_beyond_the_end_leaves_the_record_open() {
    let _machine = beside_others();
    let Some((run, disk)) = Hindered::on_disk("gone") else { return };
    let (mut bench, _) = run.begin(&[], &["record.free_mb_min=0"]);
    let frozen = disk.freeze();
    // A process that waits for a disk cannot end, but it prints its result.
    bench.wait_for("\"record_error\"");
    run.stage.assert_it_stands();
    drop(frozen);
    let bench = bench.end();
    bench.assert_status(3);
    let json = bench.json();
    assert!(json["stop_reason"].as_str().unwrap().starts_with("record: "), "{json}");
    assert!(json["record_error"].as_str().unwrap().contains(": no sign of life for "), "{json}");
    repair(&run.scratch.run_dir());
    assert!(closed(&run.scratch.run_dir()).counts.unwrap().steps > 0);
}

impl Hindered {
    /// Asserts that the run was stopped because of its record, and that the record is complete all the same.
    fn assert_stopped(&self, bench: &Ended) {
        bench.assert_status(1);
        self.stage.assert_it_stands();
        let manifest = closed(&self.scratch.run_dir());
        let reason = manifest.stop_reason.unwrap();
        assert!(reason.starts_with("record: "), "{reason}");
        assert_eq!(reason, format!("record: {}", manifest.faults[0]));
        assert_eq!(manifest.dropped.unwrap().text_files, 0);
        let events = programs::read(&self.scratch.run_dir().join(file::EVENTS));
        assert!(events.contains(&format!("fault    {reason}")), "{events}");
    }
}
