//! Records that can be trusted whatever ends or hinders the run: killed at any moment, on a disk
//! that is full or takes nothing, with its folder taken away. Two processes over UDP multicast, in
//! real time.
//!
//! `NEEDLE_PEERS_PYTHON` names a Python that holds a thread of the bench. Unset, that part is said
//! to be skipped.
#![cfg(target_os = "linux")]

mod support {
    pub(crate) mod drives;
    pub(crate) mod peers;
    #[allow(dead_code, reason = "not every test needs all of it")]
    pub(crate) mod programs;
    #[allow(dead_code, reason = "not every test needs all of it")]
    pub(crate) mod udp_stage;
}

use needle_bench::archive::{Dropped, EventLine, Manifest, RunOutcome, file};
use needle_bench::telemetry::{RunFolder, repair};
use needle_bench::transport::can::{BusEvent, CanBus};
use needle_bench::transport::udp::UdpBus;
use needle_bench::units::Time;
use rerun::{ChunkStore, ChunkStoreConfig, StoreKind};
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use support::peers::peer;
use support::programs::{self, LONG, Program, Scratch, alone};
use support::udp_stage::{COUNTS_PER_MM, Stage};

const SYNC: u16 = 0x080;
const TPDO1_INSERTION: u16 = 0x181;
const EMCY_INSERTION: u16 = 0x081;
/// Half as fast as the tests on vcan, which have a machine to themselves, with a step every 0.2 s.
const SLOW: [&str; 2] = ["insertion.speed_mm_per_s=2.5", "insertion.step_mm=0.5"];
const STEP_S: f64 = 0.2;
/// What a kill may cost, in SYNC periods of 10 ms, and in s.
const LOST_SYNCS_MAX: usize = 20;
const LOST_MAX_S: f64 = 0.2;
const SYNC_S: f64 = 0.01;

/// One who hears the bus and is no part of the bench or the stage.
struct Witness {
    bus: UdpBus,
    syncs: usize,
    inserted_mm: f64,
}

impl Witness {
    fn of(stage: &Stage) -> Self {
        Witness { bus: UdpBus::join(stage.group).unwrap(), syncs: 0, inserted_mm: 0.0 }
    }

    fn hear(&mut self) -> Option<u16> {
        let event = self.bus.receive(LONG).unwrap();
        let Some(BusEvent::Frame(frame)) = event else { panic!("silent, or {event:?}") };
        match (frame.cob_id(), frame.data()) {
            (Some(SYNC), _) => self.syncs += 1,
            (Some(TPDO1_INSERTION), &[_, _, a, b, c, d]) => {
                self.inserted_mm = f64::from(i32::from_le_bytes([a, b, c, d])) / COUNTS_PER_MM;
            }
            _ => {}
        }
        frame.cob_id()
    }

    fn wait_until_inserted(&mut self, depth_mm: f64) {
        while self.inserted_mm < depth_mm {
            self.hear();
        }
    }
}

/// The last line of `text` that has its end.
fn last_line(text: &str) -> &str {
    text.rsplit_once('\n').and_then(|(whole, _)| whole.lines().last()).expect("a line")
}

/// The last moment on the time line of the recording, s.
fn last_of_recording(path: &Path) -> f64 {
    let mut recording = File::open(path).unwrap();
    let stores = ChunkStore::from_rrd_reader(&ChunkStoreConfig::ALL_DISABLED, &mut recording);
    let stores = stores.unwrap();
    let of_run = stores.iter().filter(|(id, _)| id.kind() == StoreKind::Recording);
    let chunks = of_run.flat_map(|(_, store)| store.iter_physical_chunks());
    let times = chunks.flat_map(|chunk| {
        let column = chunk.timelines().get(&"run_time".into());
        column.map_or(Vec::new(), |column| column.times_raw().to_vec())
    });
    Time::from_nanos(times.max().expect("a row")).as_secs_f64()
}

/// What of each file is missing at its end, s, when the run went on to `end_s`.
fn missing_s(run_dir: &Path, end_s: f64) -> [(&'static str, f64, f64); 4] {
    let text = |name: &str| programs::read(&run_dir.join(name));
    let ns = |ns: &str| ns.parse::<i64>().unwrap() as f64 * 1e-9;
    let inputs = text(file::INPUTS);
    let steps = text(file::STEPS);
    let sample: serde_json::Value = serde_json::from_str(last_line(&text(file::TRACKER))).unwrap();
    let lasts = [
        (file::INPUTS, ns(last_line(&inputs).split(' ').next().unwrap()), 0.0),
        (file::TRACKER, ns(&sample["receive_time_ns"].to_string()), 0.025),
        (file::STEPS, last_line(&steps).split(',').nth(1).unwrap().parse().unwrap(), STEP_S),
        (file::RECORDING, last_of_recording(&run_dir.join(file::RECORDING)), 0.0),
    ];
    lasts.map(|(name, last_s, every_s)| (name, end_s - last_s, every_s))
}

/// Kills come at any phase of the writers' rounds: after so many SYNCs more, in the insertion.
#[test]
fn a_record_killed_at_any_moment_can_be_read_up_to_it() {
    let _alone = alone();
    for (n, syncs_more) in [0, 7, 13, 31, 58].into_iter().enumerate() {
        let scratch = Scratch::new(&format!("records-killed-{n}"));
        let stage = Stage::start(&[]);
        let mut witness = Witness::of(&stage);
        let settings = [&SLOW[..], &["can.heartbeat_timeout_ms=400"]].concat();
        let bench = scratch.bench(&[], &stage.settings(&settings));
        witness.wait_until_inserted(1.5);
        let kill_at = witness.syncs + syncs_more;
        while witness.syncs < kill_at {
            witness.hear();
        }
        bench.signal("KILL");
        assert_eq!(bench.end().status.code(), None, "killed by a signal");
        while witness.hear() != Some(EMCY_INSERTION) {}

        let run_dir = scratch.run_dir();
        let can_log = programs::read(&run_dir.join(file::CAN));
        let syncs: Vec<&str> = can_log.lines().filter(|line| line.ends_with(" 080# T")).collect();
        let lost = witness.syncs.checked_sub(syncs.len()).expect("all of them were on the bus");
        assert!(lost <= LOST_SYNCS_MAX, "{lost} SYNCs are not in can.log");

        repair(&run_dir).unwrap();
        let run = RunFolder::open(&run_dir).unwrap();
        run.verify().unwrap();
        let reason = run.manifest().stop_reason.clone().unwrap();
        assert!(
            reason.starts_with("the bench ended without closing its record; the last step is ")
        );
        let events = programs::read(&run_dir.join(file::EVENTS));
        assert!(events.lines().all(|line| EventLine::parse(line).is_some()), "{events}");

        let stamp = syncs.last().unwrap().split([' ', '(', ')']).nth(1).unwrap();
        let started_s = started_unix_s(&can_log, &programs::read(&run_dir.join(file::INPUTS)));
        let end_s = stamp.parse::<f64>().unwrap() - started_s + lost as f64 * SYNC_S;
        let missing = missing_s(&run_dir, end_s);
        println!(
            "killed after {end_s:.2} s: {lost} SYNCs lost; not in the files, s: {missing:.3?}"
        );
        for (name, missing_s, every_s) in missing {
            let limit_s = LOST_MAX_S + every_s;
            assert!(missing_s <= limit_s, "{name}: {missing_s:.3} s (limit {limit_s:.3})");
        }
    }
}

/// The origin of the run's time line, s since 1970: the first frame that was received has its time
/// on both.
fn started_unix_s(can_log: &str, inputs: &str) -> f64 {
    let received = can_log.lines().find(|line| line.ends_with(" R")).unwrap();
    let stamp: f64 = received.split([' ', '(', ')']).nth(1).unwrap().parse().unwrap();
    let given = inputs.lines().find_map(|line| line.strip_suffix(" frame")).unwrap();
    stamp - given.parse::<i64>().unwrap() as f64 * 1e-9
}

/// The bench where no file may grow past `kb` kB.
fn on_a_full_disk(scratch: &Scratch, kb: u32, settings: &[&str]) -> Program {
    let bench = scratch.command(&["--json"], settings);
    // POSIX counts blocks of 512 bytes.
    let script = format!("ulimit -f {} && exec \"$0\" \"$@\"", 2 * kb);
    let mut limited = Command::new("sh");
    limited.args(["-c", &script]).arg(bench.get_program()).args(bench.get_args());
    Program::start(limited.current_dir(env!("CARGO_MANIFEST_DIR")))
}

/// The manifest of a record that was closed and is what it says.
#[track_caller]
fn closed(run_dir: &Path) -> Manifest {
    let run = RunFolder::open(run_dir).unwrap();
    assert!(run.is_closed());
    run.verify().unwrap();
    run.manifest().clone()
}

#[test]
fn a_disk_that_fills_stops_the_run_safely() {
    let _alone = alone();
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
    let _alone = alone();
    let scratch = Scratch::new("records-go-on");
    let stage = Stage::start(&[]);
    let more = ["insertion.depth_mm=50", "record.on_failure=\"go-on\""];
    let settings = [&SLOW[..], &more].concat();
    let bench = on_a_full_disk(&scratch, FULL_KB, &stage.settings(&settings)).end();
    bench.assert_status(0);
    assert!((stage.assert_it_stands() - 50.0).abs() < 0.1);
    let told = "; the run goes on (record.on_failure)";
    assert!(bench.stderr.contains(told), "{}", bench.stderr);
    let manifest = closed(&scratch.run_dir());
    assert_eq!(manifest.outcome, Some(RunOutcome::Completed));
    assert!(!manifest.faults.is_empty());
    let dropped = manifest.dropped.unwrap();
    assert!(dropped.recording + dropped.text_files > 0, "{dropped:?}");
    assert_eq!(bench.json()["record_error"], manifest.faults[0].as_str());
}

/// No file may be larger: what the recording has before the run, and a few seconds.
const FULL_KB: u32 = 1000;

/// A small file system, mounted as long as it is held.
struct Disk(PathBuf);

impl Disk {
    /// None where this process may not mount.
    fn mount(path: PathBuf) -> Option<Self> {
        fs::create_dir_all(&path).unwrap();
        let size = format!("size={DISK_BYTES},mode=777");
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &size, "none"]).arg(&path).stderr(Stdio::null());
        mount.status().unwrap().success().then_some(Disk(path))
    }
}

const DISK_BYTES: usize = 2 << 20;

impl Drop for Disk {
    fn drop(&mut self) {
        let status = Command::new("umount").arg(&self.0).status().unwrap();
        assert!(status.success(), "umount: {status}");
    }
}

/// Filled by the run itself, the disk is full before anything of the record is lost; filled by
/// another, at once, it takes all files at a time, and the room for the manifest with them.
#[test]
fn a_full_file_system_is_refused_before_a_run_and_stops_one_safely() {
    let _alone = alone();
    let scratch = Scratch::new("records-tmpfs");
    for filled_by_another in [false, true] {
        let stage = Stage::start(&[]);
        let Some(disk) = Disk::mount(scratch.path("runs")) else {
            println!("SKIPPED: only who may mount can fill a file system");
            return;
        };
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
        assert_eq!(left, 1, "no folder of a run that never began");
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

/// Takes all the room of the small disk `dir`.
fn fill(dir: &Path) {
    let filled = fs::write(dir.join(FILLER), vec![0; 2 * DISK_BYTES]).unwrap_err();
    assert_eq!(filled.kind(), ErrorKind::StorageFull);
}

const FILLER: &str = "filler";

/// A full disk, by the keeper's account and by the system's.
const FULL: [&str; 2] = ["the disk is full", "No space left"];

#[test]
fn a_folder_taken_away_stops_the_run_safely_and_can_be_repaired() {
    let _alone = alone();
    let scratch = Scratch::new("records-moved");
    let stage = Stage::start(&[]);
    let mut witness = Witness::of(&stage);
    let bench = scratch.bench(&[], &stage.settings(&SLOW));
    witness.wait_until_inserted(2.0);
    let moved: PathBuf = scratch.path("moved");
    fs::rename(scratch.run_dir(), &moved).unwrap();
    let bench = bench.end();
    // The record was left open, which is a failure of its own.
    bench.assert_status(3);
    let reason = bench.last_line();
    assert!(reason.starts_with("stopped: record: run folder: "), "{reason}");
    assert!(reason.contains("No such file"), "{reason}");
    stage.assert_it_stands();
    assert!(bench.stdout.contains("left open: "), "{}", bench.stdout);
    repair(&moved).unwrap();
    assert!(closed(&moved).counts.unwrap().steps > 3);
}

/// Holds the bench's thread of that name; none where that is not possible here.
fn hold(bench: &Program, thread: &str) -> Option<Program> {
    let mut holder = peer("hold_thread.py", &[&bench.id().to_string(), thread])?;
    holder.wait_for("\n");
    let is_allowed = !holder.said().starts_with("not allowed");
    if !is_allowed {
        println!("SKIPPED: {}", holder.said());
    }
    is_allowed.then_some(holder)
}

/// A thread that is held is to the others what one is that waits for a disk. How well time is kept
/// meanwhile is printed, after that of a run in which none is held.
#[test]
fn a_writer_that_waits_for_its_disk_is_told_of_and_loses_nothing() {
    let _alone = alone();
    for thread in ["none", "text-files", "run-folder"] {
        let scratch = Scratch::new(&format!("records-{thread}"));
        let stage = Stage::start(&[]);
        let mut witness = Witness::of(&stage);
        let settings = [&SLOW[..], &["insertion.depth_mm=15"]].concat();
        let mut bench = scratch.bench(&["--json"], &stage.settings(&settings));
        witness.wait_until_inserted(1.0);
        if thread != "none" {
            let Some(holder) = hold(&bench, thread) else { return };
            let name = thread.replace('-', " ");
            bench.wait_for(&format!("record: {name}: no sign of life for 0.7 s"));
            witness.wait_until_inserted(8.0);
            holder.signal("INT");
            holder.end().assert_status(0);
            bench.wait_for(&format!("record: {name}: alive again after "));
        }
        let bench = bench.end();
        bench.assert_status(0);
        let manifest = closed(&scratch.run_dir());
        let timing = &bench.json()["timing"];
        let [sync, record] = ["sync_late_us", "record_ns"].map(|figure| {
            ["p50", "p99", "max"].map(|of| timing[format!("{figure}_{of}")].to_string()).join(" ")
        });
        println!("{thread} held: SYNC late {sync} us, a record handed over in {record} ns");
        assert_eq!((manifest.faults.len(), manifest.dropped.unwrap().text_files), (0, 0));
        let can_log = programs::read(&scratch.run_dir().join(file::CAN));
        let syncs = can_log.lines().filter(|line| line.ends_with(" 080# T")).count();
        assert_eq!(timing["syncs"], syncs);
    }
}

#[test]
fn a_writer_that_never_comes_back_stops_the_run_safely() {
    let _alone = alone();
    let scratch = Scratch::new("records-wedged");
    let stage = Stage::start(&[]);
    let mut witness = Witness::of(&stage);
    let mut bench = scratch.bench(&["--json"], &stage.settings(&SLOW));
    witness.wait_until_inserted(1.0);
    let Some(holder) = hold(&bench, "text-files") else { return };
    bench.wait_for("fault: record: text files: no sign of life for 5.0 s (given up after 5.0)");
    bench.wait_for("stage: taking power off both axes");
    // It comes back after all, and writes down what waited.
    holder.signal("INT");
    let bench = bench.end();
    bench.assert_status(1);
    stage.assert_it_stands();
    let manifest = closed(&scratch.run_dir());
    assert_eq!(manifest.faults.len(), 1);
    assert_eq!(manifest.dropped.unwrap().text_files, 0);
    let events = programs::read(&scratch.run_dir().join(file::EVENTS));
    assert!(events.contains("fault    record: text files: no sign of life"), "{events}");
}
