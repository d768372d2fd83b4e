//! A writer waits for its disk, a viewer reads nothing.

use super::disk::Disk;
use super::viewer::{free_address, frozen_viewer};
use super::witness::Witness;
use super::{SLOW, assert_they_agree, closed, repair};
use crate::support::peers::hold;
use crate::support::programs::{self, Ended, Program, Scratch, beside_others};
use crate::support::udp_stage::Stage;
use needle_bench::archive::{Manifest, file};
use needle_bench::telemetry::RunFolder;

/// A run of some seconds that is hindered in the middle of it.
struct Hindered {
    scratch: Scratch,
    stage: Stage,
}

/// Depth at which the hindrance begins, mm, at which it ends, and of the run.
const BEGINS_MM: f64 = 1.0;
const ENDS_MM: f64 = 5.0;
const DEPTH: &str = "insertion={ depth_mm = 8, plane_out_of_reach = \"insert\" }";

impl Hindered {
    fn new(by: &str) -> Self {
        let scratch = Scratch::new(&format!("records-{}", by.replace(' ', "-")));
        Hindered { scratch, stage: Stage::start(&[]) }
    }

    /// One whose record goes to a disk of its own; none where that cannot be had.
    fn on_disk(by: &str) -> Option<(Self, Disk)> {
        let run = Self::new(by);
        let disk = Disk::in_file(run.scratch.path("runs"), &run.scratch.path("disk"))?;
        Some((run, disk))
    }

    /// A bench that is at the depth where the hindrance begins.
    fn begin(&self, flags: &[&str], settings: &[&str]) -> (Program, Witness) {
        let mut witness = Witness::of(&self.stage);
        let settings = [&SLOW[..], settings].concat();
        let flags = [&["--json"], flags].concat();
        let bench = self.scratch.bench(&flags, &self.stage.settings(&settings));
        witness.wait_until_inserted(BEGINS_MM);
        (bench, witness)
    }

    /// The run completed and nothing of its record is lost. How well time was kept is printed, to be
    /// set against that of a run in which nothing was in the way.
    fn assert_whole(&self, by: &str, bench: &Ended) -> Manifest {
        bench.assert_status(0);
        let manifest = closed(&self.scratch.run_dir());
        let dropped = manifest.dropped.unwrap();
        let timing = &bench.json()["timing"];
        let [sync, record] = ["sync_late_us", "record_ns"].map(|figure| {
            ["p50", "p99", "max"].map(|of| timing[format!("{figure}_{of}")].to_string()).join(" ")
        });
        println!("{by}: SYNC late {sync} us, a record handed over in {record} ns; {dropped:?}");
        assert_eq!((manifest.faults.len(), dropped.text_files, dropped.recording), (0, 0, 0));
        let can_log = programs::read(&self.scratch.run_dir().join(file::CAN));
        let syncs = can_log.lines().filter(|line| line.ends_with(" 080# T")).count();
        assert_eq!(timing["syncs"], syncs);
        manifest
    }
}

#[test]
fn nothing_in_the_way() {
    let _machine = beside_others();
    let run = Hindered::new("nothing");
    let (bench, mut witness) = run.begin(&[], &[DEPTH]);
    witness.wait_until_inserted(ENDS_MM);
    run.assert_whole("nothing in the way", &bench.end());
    assert_they_agree(&run.scratch.run_dir(), 0);
}

/// A thread that is held is to the others what one is that waits for a disk.
#[test]
fn a_writer_that_is_held_is_told_of_and_loses_nothing() {
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
fn a_frozen_disk_is_told_of_and_loses_nothing() {
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

/// Two that read nothing: one is given more and more to read, and to the other the thread that
/// serves viewers is as one that waits for them for ever.
#[test]
fn frozen_viewers_are_nothing_to_the_run_and_its_record() {
    let _machine = beside_others();
    let run = Hindered::new("viewer");
    let address = free_address();
    let live = format!("--live={address}");
    let viewer = std::thread::spawn(move || frozen_viewer(address));
    let (bench, mut witness) = run.begin(&[&live], &[DEPTH]);
    let holder = hold(&bench, "live-view");
    witness.wait_until_inserted(ENDS_MM);
    // A disk that others write to may stall, and is alive again while the viewers are not.
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
fn a_writer_that_never_comes_back_stops_the_run_safely() {
    let _machine = beside_others();
    let run = Hindered::new("wedged");
    let (mut bench, _) = run.begin(&[], &[]);
    let Some(holder) = hold(&bench, "text-files") else { return };
    bench.wait_for("fault: record: text files: no sign of life for 5.0 s (given up after 5.0)");
    bench.wait_for("stage: taking power off both axes");
    // It comes back after all, and writes down what waited.
    holder.signal("INT");
    run.assert_stopped(&bench.end());
}

/// Nobody knows what is in the files of such a writer: the record is not closed over them.
#[test]
fn a_writer_that_is_gone_for_good_leaves_the_record_open() {
    let _machine = beside_others();
    let run = Hindered::new("lost");
    let (mut bench, _) = run.begin(&[], &[]);
    let Some(holder) = hold(&bench, "text-files") else { return };
    // It cannot end while one of its threads is held, but has said all there is to say.
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
fn a_disk_that_takes_nothing_stops_the_run_safely() {
    let _machine = beside_others();
    let Some((run, disk)) = Hindered::on_disk("dead") else { return };
    let (mut bench, _) = run.begin(&[], &["record.free_mb_min=0"]);
    let frozen = disk.freeze();
    bench.wait_for("fault: record: ");
    bench.wait_for("stage: taking power off both axes");
    drop(frozen);
    run.assert_stopped(&bench.end());
}

/// The operator hears how the run ended all the same, and the record can be closed afterwards.
#[test]
fn a_disk_that_never_comes_back_leaves_the_record_open() {
    let _machine = beside_others();
    let Some((run, disk)) = Hindered::on_disk("gone") else { return };
    let (mut bench, _) = run.begin(&[], &["record.free_mb_min=0"]);
    let frozen = disk.freeze();
    // One who waits for a disk can say what there is to say, and not end.
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
    /// The run was stopped for its record, of which nothing is lost all the same.
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
