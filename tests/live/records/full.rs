//! Runs on a full disk, and runs whose folder is moved or changed.

use super::disk::Disk;
use super::{SLOW, closed, repair};
use crate::support::programs::{self, Program, Scratch, beside_others};
use crate::support::udp_stage::Stage;
use crate::support::witness::Witness;
use needle_bench::archive::{Dropped, EventLine, RunOutcome, file};
use needle_bench::telemetry::RunFolder;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Starts the bench with a limit of `kb` kB for the size of a file.
fn on_a_full_disk(scratch: &Scratch, kb: u32, settings: &[&str]) -> Program {
    let bench = scratch.command(&["--json"], settings);
    // POSIX counts blocks of 512 bytes.
    let script = format!("ulimit -f {} && exec \"$0\" \"$@\"", 2 * kb);
    let mut limited = Command::new("sh");
    limited.args(["-c", &script]).arg(bench.get_program()).args(bench.get_args());
    Program::start(limited.current_dir(env!("CARGO_MANIFEST_DIR")))
}

#[test]
fn a_disk_that_fills_stops_the_run_safely() {
    let _machine = beside_others();
    let scratch = Scratch::new("records-full");
    let stage = Stage::start(&[]);
    let bench = on_a_full_disk(&scratch, FULL_KB, &stage.settings(&SLOW)).end();
    bench.assert_status(1);
    let reason = bench.json()["stop_reason"].as_str().unwrap().to_owned();
    assert!(reason.starts_with("record: ") && reason.contains("not recorded"), "{reason}");
    assert!(stage.assert_it_stands() < 140.0);
    let manifest = closed(&scratch.run_dir());
    assert_eq!(manifest.outcome, Some(RunOutcome::Stopped));
    assert_eq!(manifest.stop_reason, Some(reason.clone()));
    assert_eq!(reason, format!("record: {}", manifest.faults[0]));
}

#[test]
fn a_run_may_go_on_without_its_record() {
    let _machine = beside_others();
    let scratch = Scratch::new("records-go-on");
    let stage = Stage::start(&[]);
    let more = ["insertion.depth_mm=20", "record.on_failure=\"go-on\""];
    let settings = [&SLOW[..], &more].concat();
    let bench = on_a_full_disk(&scratch, FULL_KB, &stage.settings(&settings)).end();
    bench.assert_status(0);
    assert!((stage.assert_it_stands() - 20.0).abs() < 0.1);
    let warning = "the run goes on (record.on_failure)";
    assert!(bench.stderr.contains(warning), "{}", bench.stderr);
    let manifest = closed(&scratch.run_dir());
    assert_eq!(manifest.outcome, Some(RunOutcome::Completed));
    assert!(!manifest.faults.is_empty());
    let dropped = manifest.dropped.unwrap();
    assert!(dropped.recording + dropped.text_files > 0, "{dropped:?}");
    assert_eq!(bench.json()["record_error"], manifest.faults[0].as_str());
}

/// Largest size of a file: a few seconds of `can.log`.
const FULL_KB: u32 = 100;

/// If the run itself fills the disk, the run stops before any record is lost. If another program fills it at once,
/// all files fail at the same time, and no room is left for the manifest.
#[test]
fn a_full_file_system_is_refused_before_a_run_and_stops_one_safely() {
    let _machine = beside_others();
    let scratch = Scratch::new("records-tmpfs");
    for filled_by_another in [false, true] {
        let stage = Stage::start(&[]);
        let Some(disk) = Disk::in_memory(scratch.path("runs")) else { return };
        let refused = scratch.bench(&[], &stage.settings(&SLOW)).end();
        refused.assert_status(3);
        let said = "MB free, record.free_mb_min asks for 100; free some, or set another record.dir";
        assert!(refused.stderr.contains(said), "{}", refused.stderr);

        let settings = [&SLOW[..], &["record.free_mb_min=0"]].concat();
        fill(&disk.0);
        let refused = scratch.bench(&[], &stage.settings(&settings)).end();
        refused.assert_status(3);
        assert!(refused.stderr.contains("No space left"), "{}", refused.stderr);
        let left = fs::read_dir(&disk.0).unwrap().count();
        assert_eq!(left, 1, "a folder of a run that never began");
        fs::remove_file(disk.0.join(FILLER)).unwrap();

        let mut witness = Witness::of(&stage);
        let bench = scratch.bench(&[], &stage.settings(&settings));
        if filled_by_another {
            witness.wait_until_inserted(4.0);
            fill(&disk.0);
        }
        let bench = bench.end();
        bench.assert_status(1);
        let reason = bench.last_line();
        assert!(reason.starts_with("stopped: record: "), "{reason}");
        assert!(FULL.iter().any(|words| reason.contains(words)), "{reason}");
        stage.assert_it_stands();
        let run_dir = scratch.run_dir();
        let manifest = closed(&run_dir);
        let (counts, dropped) = (manifest.counts.unwrap(), manifest.dropped.unwrap());
        println!("{reason}; {counts:?}, {dropped:?}");
        assert_eq!(manifest.outcome, Some(RunOutcome::Stopped));
        assert!(counts.steps > 3);
        assert!(filled_by_another || dropped == Dropped::default(), "{dropped:?}");
        let events = programs::read(&run_dir.join(file::EVENTS));
        assert!(events.lines().all(|line| EventLine::parse(line).is_some()), "{events}");
    }
}

/// Fills the small disk `dir`.
fn fill(dir: &Path) {
    let filled = fs::write(dir.join(FILLER), vec![0; 2 * Disk::BYTES]).unwrap_err();
    assert_eq!(filled.kind(), ErrorKind::StorageFull);
}

const FILLER: &str = "filler";

/// The messages about a full disk, of the run folder's keeper and of the system.
const FULL: [&str; 2] = ["the disk is full", "No space left"];

/// Each file of the folder is part of the record.
#[test]
fn a_deleted_file_of_the_record_stops_the_run_safely() {
    let _machine = beside_others();
    for name in [file::EVENTS, file::CONFIG] {
        let scratch = Scratch::new(&format!("records-without-{name}"));
        let stage = Stage::start(&[]);
        let mut witness = Witness::of(&stage);
        let bench = scratch.bench(&[], &stage.settings(&SLOW));
        witness.wait_until_inserted(1.0);
        fs::remove_file(scratch.run_dir().join(name)).unwrap();
        let bench = bench.end();
        bench.assert_status(1);
        let reason = bench.last_line();
        assert!(reason.starts_with("stopped: record: run folder: "), "{reason}");
        assert!(reason.contains(&format!("{name}: No such file")), "{reason}");
        stage.assert_it_stands();
    }
}

/// The bench steers by what it read before the run.
#[test]
fn a_configuration_edited_during_the_run_is_reported_as_edited() {
    let _machine = beside_others();
    let scratch = Scratch::new("records-edited");
    let stage = Stage::start(&[]);
    let mut witness = Witness::of(&stage);
    let settings =
        [&SLOW[..], &["insertion={ depth_mm = 5, plane_out_of_reach = \"insert\" }"]].concat();
    let bench = scratch.bench(&[], &stage.settings(&settings));
    witness.wait_until_inserted(1.0);
    let config = scratch.run_dir().join(file::CONFIG);
    let text = programs::read(&config);
    fs::write(&config, text.replacen("depth_mm = 5.0", "depth_mm = 6.0", 1)).unwrap();
    bench.end().assert_status(0);
    let said = RunFolder::open(&scratch.run_dir()).unwrap().verify().unwrap_err().to_string();
    assert!(said.contains("config.toml was edited"), "{said}");
}

/// The bench leaves its own record open.
#[test]
fn another_folder_in_the_place_of_the_run_folder_is_not_written_to() {
    let _machine = beside_others();
    let scratch = Scratch::new("records-swapped");
    let stage = Stage::start(&[]);
    let mut witness = Witness::of(&stage);
    let bench = scratch.bench(&[], &stage.settings(&SLOW));
    witness.wait_until_inserted(1.0);
    let (run_dir, moved) = (scratch.run_dir(), scratch.path("moved"));
    fs::rename(&run_dir, &moved).unwrap();
    fs::create_dir(&run_dir).unwrap();
    for name in [file::MANIFEST, file::RECORDING] {
        fs::write(run_dir.join(name), "another's").unwrap();
    }
    let bench = bench.end();
    bench.assert_status(3);
    assert!(bench.stdout.contains("left open: "), "{}", bench.stdout);
    stage.assert_it_stands();
    assert_eq!(fs::read_dir(&run_dir).unwrap().count(), 2);
    for name in [file::MANIFEST, file::RECORDING] {
        assert_eq!(programs::read(&run_dir.join(name)), "another's");
    }
    repair(&moved);
    closed(&moved);
}

#[test]
fn a_moved_run_folder_stops_the_run_safely_and_can_be_repaired() {
    let _machine = beside_others();
    let scratch = Scratch::new("records-moved");
    let stage = Stage::start(&[]);
    let mut witness = Witness::of(&stage);
    let bench = scratch.bench(&[], &stage.settings(&SLOW));
    witness.wait_until_inserted(2.0);
    let moved: PathBuf = scratch.path("moved");
    fs::rename(scratch.run_dir(), &moved).unwrap();
    let bench = bench.end();
    // Exit 3, because the record was left open.
    bench.assert_status(3);
    let reason = bench.last_line();
    assert!(reason.starts_with("stopped: record: run folder: "), "{reason}");
    assert!(reason.contains("No such file"), "{reason}");
    stage.assert_it_stands();
    assert!(bench.stdout.contains(" is no longer there: "), "{}", bench.stdout);
    assert!(bench.stdout.contains(", CONFIG and its --set as before"), "{}", bench.stdout);
    repair(&moved);
    assert!(closed(&moved).counts.unwrap().steps > 3);
}
