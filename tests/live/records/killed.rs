//! Records of a bench that is killed.

use super::{SLOW, repair};
use crate::support::peers::assert_recording_agrees;
use crate::support::programs::{self, LONG, Scratch, beside_others};
use crate::support::udp_stage::Stage;
use crate::support::witness::Witness;
use needle_bench::archive::{EventLine, file};
use needle_bench::telemetry::RunFolder;
use needle_bench::units::Time;
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;
use rerun::external::re_log_encoding::DecoderApp;
use rerun::log::{Chunk, LogMsg};
use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

const KILLS: usize = 5;
/// Largest loss by a kill, in SYNC periods of 10 ms and in s.
const LOST_SYNCS_MAX: usize = 20;
const LOST_MAX_S: f64 = 0.2;
const SYNC_S: f64 = 0.01;
/// Time between two steps with [`SLOW`].
const STEP_S: f64 = 0.2;
/// Steps of `steps.csv` that the recording may lack.
const STEPS_LOST_MAX: usize = 1;

/// The last whole line of `text`.
fn last_line(text: &str) -> &str {
    text.rsplit_once('\n').and_then(|(whole, _)| whole.lines().last()).expect("a line")
}

/// The last time in the recording, s.
fn last_of_recording(path: &Path) -> f64 {
    let recording = BufReader::new(File::open(path).unwrap());
    let chunks = DecoderApp::decode_lazy(recording).filter_map(|message| match message.unwrap() {
        LogMsg::ArrowMsg(of, rows) if of.is_recording() => {
            Some(Chunk::from_arrow_msg(&rows).unwrap())
        }
        _ => None,
    });
    let times = chunks.flat_map(|chunk| {
        let column = chunk.timelines().get(&"run_time".into());
        column.map_or(Vec::new(), |column| column.times_raw().to_vec())
    });
    Time::from_nanos(times.max().expect("a row")).as_secs_f64()
}

/// For each file of a run that went on to `end_s`: the time missing at its end, and the time between two lines, s.
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

/// The moments of the kills are random. `NEEDLE_KILL_SEED` repeats those of a failed test, as far as time can be
/// repeated.
#[test]
fn a_record_can_be_read_up_to_the_moment_of_a_kill() {
    let _machine = beside_others();
    let seed = std::env::var("NEEDLE_KILL_SEED").map_or_else(|_| now_ns(), |s| s.parse().unwrap());
    println!("NEEDLE_KILL_SEED={seed}");
    let mut random = Pcg64::seed_from_u64(seed);
    for n in 0..KILLS {
        let (syncs_more, us_more) = (random.random_range(0..150), random.random_range(0..10_000));
        let scratch = Scratch::new(&format!("records-killed-{n}"));
        let stage = Stage::start(&[]);
        let mut witness = Witness::of(&stage);
        let settings = [&SLOW[..], &["can.heartbeat_timeout_ms=400"]].concat();
        let bench = scratch.bench(&[], &stage.settings(&settings));
        witness.wait_until_inserted(1.5);
        let kill_at = witness.syncs + syncs_more;
        witness.wait_until(|seen| seen.syncs >= kill_at);
        // The last frame was a SYNC; this is a random moment in its period.
        thread::sleep(Duration::from_micros(us_more));
        bench.signal("KILL");
        assert_eq!(bench.end().status.code(), None, "killed by a signal");
        witness.wait_for_emergency();

        let run_dir = scratch.run_dir();
        let can_log = programs::read(&run_dir.join(file::CAN));
        let syncs: Vec<&str> = can_log.lines().filter(|line| line.ends_with(" 080# T")).collect();
        let lost = witness.syncs.checked_sub(syncs.len()).expect("each was on the bus");
        assert!(lost <= LOST_SYNCS_MAX, "{lost} SYNCs are not in can.log");

        repair(&run_dir);
        let run = RunFolder::open(&run_dir).unwrap();
        run.verify().unwrap();
        assert_recording_agrees(&run_dir, STEPS_LOST_MAX);
        let reason = run.manifest.stop_reason.clone().unwrap();
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

/// Start of the run's time line, s since 1970. The first received frame has its time in both files.
fn started_unix_s(can_log: &str, inputs: &str) -> f64 {
    let received = can_log.lines().find(|line| line.ends_with(" R")).unwrap();
    let stamp: f64 = received.split([' ', '(', ')']).nth(1).unwrap().parse().unwrap();
    let input = inputs.lines().find_map(|line| line.strip_suffix(" frame")).unwrap();
    stamp - input.parse::<i64>().unwrap() as f64 * 1e-9
}

/// Kills come before the first step and after the last.
#[test]
fn a_bench_killed_at_its_start_or_its_end_leaves_a_record_that_can_be_closed() {
    let _machine = beside_others();
    for (n, message) in
        ["", "listening for another master", "enabling both axes", "stopping both axes"]
            .into_iter()
            .enumerate()
    {
        let scratch = Scratch::new(&format!("records-early-{n}"));
        let stage = Stage::start(&[]);
        let settings =
            [&SLOW[..], &["insertion={ depth_mm = 1, plane_out_of_reach = \"insert\" }"]].concat();
        let mut bench = scratch.bench(&[], &stage.settings(&settings));
        let manifests = || {
            let runs = fs::read_dir(scratch.path("runs")).into_iter().flatten().flatten();
            runs.filter(|run| run.path().join(file::MANIFEST).exists()).count()
        };
        let deadline = Instant::now() + LONG;
        while manifests() == 0 {
            assert!(Instant::now() < deadline, "no run folder: {}", bench.said());
            thread::sleep(Duration::from_millis(1));
        }
        bench.wait_for(message);
        bench.signal("KILL");
        let run_dir = scratch.run_dir();
        match bench.end().status.code() {
            None => println!("killed at {message:?}: {}", repair(&run_dir)),
            Some(status) => println!("at {message:?} the bench had ended already: {status}"),
        }
        let run = RunFolder::open(&run_dir).unwrap();
        run.verify().unwrap();
        assert!(run.is_closed());
    }
}

fn now_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64
}
