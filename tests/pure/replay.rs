//! Replays of recorded runs.
//!
//! The runs under `tests/recorded` hold what the bench estimated and decided when they were recorded. These tests
//! report a change of that by row and column. If the change is intended, record the runs again, as CONTRIBUTING.md
//! says, and review the difference in their `steps.csv`.

use crate::support::program::{Said, Scratch, needle_bench, repository};
use crate::support::recorded;
use needle_bench::archive::{Lines, Manifest, file};
use needle_bench::config::{Config, Source};
use needle_bench::operation::RunConfig;
use needle_bench::replay::{Recorded, Replayed, replay, replay_to};
use needle_bench::session::{ObserverConfig, SessionConfig};
use needle_bench::telemetry::RunFolder;
use std::io::Cursor;
use std::path::PathBuf;

/// The recorded runs in virtual time, and the configuration of each at 5 mm/s.
const RECORDED: [(&str, &str); 8] = [
    (
        "default",
        r#"
insertion.depth_mm = 10
observer.shadows = ["coupled", "finite-difference"]"#,
    ),
    (
        "paper",
        r#"
insertion.depth_mm = 10
observer = { kind = "coupled", coupled.gains = "placed" }
control = { kind = "feedback-linearization", feedback_linearization = { poles_per_mm = [0.05, 0.05, 0.05], roll_demand_max_deg = 60.0 } }"#,
    ),
    (
        "stepwise",
        r#"
insertion.depth_mm = 4
insertion.mode = "stepwise"
insertion.settle_s = 0.05
insertion.samples = 2"#,
    ),
    (
        "drive-fault",
        r#"
insertion.depth_mm = 10
emulator.fault = [{ kind = "drive-fault", axis = "rotation", at_mm = 6.0, code = 0x8611 }]"#,
    ),
    (
        "bus-full",
        r#"
insertion.depth_mm = 10
emulator.fault = [{ kind = "bus-full", at_mm = 6.0, duration_s = 0.1 }]"#,
    ),
    (
        "target",
        r#"
insertion.depth_mm = 40
goal.kind = "target"
goal.position_mm = [0.0, 1.5, 24.3]
goal.obstacle = [{ shape = "sphere", centre_mm = [0.0, 2.4, 12.0], radius_mm = 1.0 }]
goal.clearance_mm = 0.5
goal.tool = "TargetToTracker"
emulator.target_drift_mm_per_mm = [0.0, 0.03, 0.0]
needle.radius_mm = 40.0
emulator.radius_mm = 40.0
emulator.start = { x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }
observer.invariant.start_sd = { yaw_deg = 3.0, pitch_deg = 3.0, roll_deg = 5.0 }"#,
    ),
    (
        "posed",
        r#"
insertion.depth_mm = 10
tracker.tip_offset_mm = [0.3, -0.2, 0.4]
tracker.registration = { x_mm = 20.0, y_mm = -5.0, z_mm = 8.0, yaw_deg = 30.0, pitch_deg = -10.0, roll_deg = 100.0 }
tracker.latency_ms = 40
tracker.gates.noise_sd_mm = 0.3
emulator.tracker_latency_ms = 40"#,
    ),
    (
        "held",
        r#"
insertion.depth_mm = 4
tracker.hold_after_s = 0.4
tracker.hold_after_mm = 3
tracker.resume = "automatic"
emulator.tracker_rate_hz = 2.0"#,
    ),
];

/// The recorded operations of the emulated stage, and their arguments.
const OPERATIONS: [(&str, &[&str]); 2] =
    [("jog", &["jog", "--axis", "rotation", "--by", "-7.5deg"]), ("prove", &["prove"])];

/// The folder that `needle-bench stage --virtual` leaves in `scratch`.
pub(super) fn operated(scratch: &Scratch, operation: &[&str]) -> PathBuf {
    needle_bench(scratch, &[&["stage", "--virtual", "--json", "-q"], operation].concat())
        .run_dir(scratch)
}

/// The folder that `needle-bench run` with this configuration leaves in `scratch`. The run may be too short to
/// reach the plane.
pub(super) fn run(scratch: &Scratch, config: &str) -> PathBuf {
    let short = "insertion.plane_out_of_reach = \"insert\"";
    let config = scratch.write("run.toml", &format!("{short}\n{config}"));
    let config = config.to_str().expect("UTF-8");
    needle_bench(scratch, &["run", config, "--quiet", "--json"]).run_dir(scratch)
}

fn recorded_run(name: &str) -> PathBuf {
    repository("tests/recorded").parse::<PathBuf>().expect("a path").join(name)
}

pub(super) fn replayed(scratch: &Scratch, run: &std::path::Path, more: &[&str]) -> Said {
    let run = run.to_str().expect("UTF-8");
    needle_bench(scratch, &[&["replay", run][..], more].concat())
}

#[test]
fn every_recorded_run_replays_identically() {
    let scratch = Scratch::new();
    if std::env::var_os(recorded::ANEW).is_some() {
        for (name, config) in RECORDED {
            let config = format!("name = \"{name}\"\ninsertion.speed_mm_per_s = 5{config}\n");
            recorded::keep(&run(&scratch, &config), name);
        }
        for (name, operation) in OPERATIONS {
            recorded::keep(&operated(&scratch, operation), name);
        }
    }
    let mut names: Vec<String> = std::fs::read_dir(recorded_run(""))
        .expect("the recorded runs")
        .map(|entry| entry.expect("a folder").file_name().into_string().expect("UTF-8"))
        .collect();
    names.sort();
    assert_eq!(names.len(), RECORDED.len() + OPERATIONS.len() + 2, "{names:?}");
    let mut different = String::new();
    for name in &names {
        let said = replayed(&scratch, &recorded_run(name), &["--json"]);
        let json = said.json();
        println!("{name}: {json}");
        if said.status != 0 {
            let what = json["difference"].as_str().or(json["error"].as_str());
            different += &format!("{name}: {}\n", what.unwrap_or("no reason"));
        }
    }
    assert!(
        different.is_empty(),
        "{different}if this is intended, record them again (CONTRIBUTING.md has the commands) and review \
         the difference in their steps.csv"
    );
}

/// A recorded run in memory, for tests to change.
#[derive(Clone)]
struct Run {
    manifest: Manifest,
    session: SessionConfig,
    inputs: String,
    can: String,
    tracker: String,
    steps: String,
}

impl Run {
    fn load(name: &str) -> Self {
        let folder = RunFolder::open(&recorded_run(name)).expect("a run folder");
        let text = |name| folder.text(name).expect("is there");
        let config = text(file::CONFIG);
        let config = [Source { name: file::CONFIG, text: &config }];
        let mut run = Run {
            manifest: folder.manifest.clone(),
            session: Config::from_sources(&config, &[]).expect("valid").session().expect("valid"),
            inputs: text(file::INPUTS),
            can: text(file::CAN),
            tracker: text(file::TRACKER),
            steps: text(file::STEPS),
        };
        let replayed = run.replay().expect("replays");
        assert_eq!(replayed.difference, None, "{name}");
        // An older record lacks the columns that were added since.
        run.steps = replayed.steps_csv();
        run
    }

    fn asked(&self, what_if: Option<ObserverConfig>) -> Result<Replayed, String> {
        self.with(|recorded| replay(recorded, what_if))
    }

    fn with(
        &self,
        replay: impl FnOnce(&Recorded<'_>) -> Result<Replayed, String>,
    ) -> Result<Replayed, String> {
        let open = |name: &str| {
            let text = match name {
                file::INPUTS => &self.inputs,
                file::CAN => &self.can,
                file::TRACKER => &self.tracker,
                _ => &self.steps,
            };
            Ok(Lines::new(Cursor::new(text.clone())))
        };
        let run_config = RunConfig::Insertion(Box::new(self.session.clone()));
        replay(&Recorded { manifest: &self.manifest, run_config, open: &open })
    }

    fn replay(&self) -> Result<Replayed, String> {
        self.asked(None)
    }

    /// The first difference that the replay reports.
    fn difference(&self) -> String {
        let replayed = self.replay().unwrap_or_else(|error| panic!("{error}"));
        replayed.difference.unwrap_or_default()
    }

    fn refusal(&self) -> String {
        self.replay().map(|replayed| replayed.difference).expect_err("is refused")
    }
}

/// `text` with line `number` (from 1) changed.
fn with_line(text: &str, number: usize, change: impl Fn(&str) -> String) -> String {
    let lines = text.lines().zip(1..);
    lines.map(|(line, n)| if n == number { change(line) } else { line.to_owned() } + "\n").collect()
}

/// The bus refuses the last frame too, after the session has ended.
#[test]
fn a_run_whose_bus_never_comes_back_replays() {
    let scratch = Scratch::new();
    for kind in ["bus-down", "bus-full", "bus-stuck"] {
        let fault = format!("emulator.fault = [{{ kind = \"{kind}\", at_mm = 3.0 }}]");
        let run = run(&scratch, &format!("insertion.depth_mm = 5\n{fault}"));
        let said = replayed(&scratch, &run, &[]);
        assert_eq!(said.status, 0, "{kind}: {} {}", said.stdout, said.stderr);
    }
}

/// As where the disk is full: nothing more would be kept of a replay that goes on.
#[test]
fn a_replay_whose_records_cannot_be_taken_ends() {
    let mut taken = 0;
    let mut take = |_, _| {
        taken += 1;
        if taken < 3 { Ok(()) } else { Err("no space left".to_owned()) }
    };
    let ended = Run::load("default").with(|recorded| replay_to(recorded, None, &mut take));
    assert_eq!((ended.expect_err("it ends"), taken), ("no space left".to_owned(), 3));
}

#[test]
fn a_replay_reports_the_first_difference() {
    let run = Run::load("default");
    assert_eq!(run.difference(), "");

    // One more in the last place of one number.
    let column =
        run.steps.lines().next().unwrap().split(',').position(|c| c == "roll_est_rad").unwrap();
    let mut changed = run.clone();
    changed.steps = with_line(&run.steps, 7, |row| {
        let mut values: Vec<String> = row.split(',').map(str::to_owned).collect();
        let value: f64 = values[column].parse().unwrap();
        values[column] = format!("{:?}", value.next_up());
        values.join(",")
    });
    let difference = changed.difference();
    assert!(
        difference.starts_with("steps.csv line 7, step 5, roll_est_rad: recorded "),
        "{difference}"
    );

    // The replay copies the truth from the record.
    let mut other_truth = run.clone();
    let (columns, _) = run.steps.split_once('\n').unwrap();
    let column = columns.split(',').position(|name| name == "roll_true_rad").unwrap();
    other_truth.steps = with_line(&run.steps, 7, |row| {
        let mut values: Vec<&str> = row.split(',').collect();
        values[column] = "0.25";
        values.join(",")
    });
    assert_eq!(other_truth.difference(), "");
    let csv = other_truth.replay().unwrap().steps_csv();
    assert_eq!(csv, other_truth.steps);

    // A record made before the last column existed.
    let mut older = run.clone();
    let shorter = |row: &str| row.rsplit_once(',').unwrap().0.to_owned() + "\n";
    older.steps = run.steps.lines().map(shorter).collect();
    assert_eq!(older.difference(), "");
    assert_eq!(older.replay().unwrap().steps_csv(), run.steps);

    let mut changed = run.clone();
    let sync = run.can.lines().position(|line| line.contains(" 080# T")).expect("a SYNC") + 1;
    changed.can = with_line(&run.can, sync, |line| line.replace("080#", "081#"));
    let difference = changed.difference();
    assert!(difference.starts_with(&format!("can.log line {sync}: recorded (")), "{difference}");
    assert!(difference.ends_with(" memory 080# T"), "{difference}");

    let mut changed = run.clone();
    changed.tracker =
        with_line(&run.tracker, 30, |line| line.replace("\"refused\":null", "\"refused\":\"x\""));
    assert!(changed.difference().starts_with("tracker.ndjson line 30: recorded {"));

    let mut changed = run.clone();
    changed.manifest.outcome = Some(needle_bench::archive::RunOutcome::Stopped);
    changed.manifest.stop_reason = Some("operator: interrupted".to_owned());
    assert_eq!(
        changed.difference(),
        "outcome: recorded stopped: operator: interrupted, replayed completed"
    );

    let mut changed = run.clone();
    changed.steps = run.steps.lines().take(5).map(|line| line.to_owned() + "\n").collect();
    assert!(
        changed.difference().starts_with("steps.csv line 6: recorded nothing more, replayed 4,")
    );
    let mut changed = run.clone();
    changed.steps += "11,3.5\n";
    assert!(changed.difference().ends_with("recorded 11,3.5, replayed nothing more"));
}

/// The files of a killed bench end within a line, at about the same time. A file that ends much earlier is a
/// difference.
#[test]
fn a_cut_record_is_replayed_as_far_as_it_goes() {
    let mut run = Run::load("default");
    run.manifest.outcome = None;
    let whole = run.clone();
    let cut = |text: &str, part: usize| text[..text.len() * part / 97].to_owned();
    for (parts, ends) in [
        ([50, 50, 50, 50], None),
        ([92, 93, 94, 93], None),
        ([20, 90, 97, 60], Some("inputs.log")),
        ([90, 30, 80, 97], Some("can.log")),
        ([90, 90, 30, 97], Some("tracker.ndjson")),
        ([97, 60, 20, 3], Some("steps.csv")),
        ([90, 97, 97, 0], Some("steps.csv")),
        ([1, 97, 97, 97], Some("inputs.log")),
    ] {
        run.inputs = cut(&whole.inputs, parts[0]);
        run.can = cut(&whole.can, parts[1]);
        run.tracker = cut(&whole.tracker, parts[2]);
        run.steps = cut(&whole.steps, parts[3]);
        let replayed = run.replay().unwrap_or_else(|error| panic!("{parts:?}: {error}"));
        let named = replayed.difference.as_deref().map(|difference| {
            let (file, rest) = difference.split_once(" ends ").expect("ends early");
            assert!(rest.contains(" s before the record does"), "{parts:?}: {difference}");
            file
        });
        let said = format!("{parts:?}: {:?} {:?}", replayed.difference, replayed.truncation);
        assert_eq!(named, ends, "{said}");
        let rows = run.steps.matches('\n').count().saturating_sub(1);
        assert_eq!(
            replayed.truncation.map(|end| end.rows_beyond + replayed.rows),
            Some(rows),
            "{said}"
        );
        assert_eq!(replayed.outcome, None);
    }
    run.inputs = whole.inputs[..10].to_owned();
    assert!(run.refusal().starts_with("inputs.log holds no input"), "{}", run.refusal());
}

/// On a dead bus the stop waits for seconds. If the bench is killed meanwhile, no sample may be lost.
#[test]
fn samples_are_recorded_at_once_while_a_stop_waits_for_silent_drives() {
    let scratch = Scratch::new();
    let gone = "emulator.fault = [{ kind = \"bus-full\", at_mm = 6.0 }]";
    let config = format!("insertion.depth_mm = 10\ninsertion.speed_mm_per_s = 5\n{gone}\n");
    let folder = self::run(&scratch, &config);
    let mut run = Run::load(folder.to_str().expect("UTF-8"));
    run.manifest.outcome = None;
    let ns = |line: &str| line.split(' ').next().and_then(|ns| ns.parse::<i64>().ok());
    let until = |end_ns: i64| {
        let before = |line: &&str| ns(line).is_none_or(|ns| ns <= end_ns);
        run.inputs.lines().filter(before).map(|line| line.to_owned() + "\n").collect::<String>()
    };
    let heard = |inputs: &str| inputs.lines().filter(|line| line.ends_with(" sample")).count();
    let (cut, well_before) = (until(5_000_000_000), heard(&until(4_850_000_000)));
    assert!(well_before > heard(&until(2_500_000_000)) + 50, "the stop is too short for this test");
    let recorded = Run { inputs: cut, ..run.clone() }.replay().expect("a replay").samples;
    assert!(recorded >= well_before, "{recorded} of {well_before} samples are recorded");
}

#[test]
fn a_row_that_lacks_values_is_a_difference() {
    for is_closed in [true, false] {
        let mut run = Run::load("default");
        if !is_closed {
            run.manifest.outcome = None;
        }
        let short = |row: &str| row.split(',').take(3).collect::<Vec<_>>().join(",");
        run.steps = with_line(&run.steps, 3, short);
        let difference = run.difference();
        assert!(difference.starts_with("steps.csv line 3: recorded "), "{difference}");
    }
}

#[test]
fn a_mixed_lossy_or_malformed_record_is_refused() {
    let (run, other) = (Run::load("default"), Run::load("paper"));
    let mixed = Run { can: other.can.clone(), ..run.clone() };
    let refusal = mixed.refusal();
    assert!(
        refusal.starts_with("the files are not of one run: inputs.log line 2 and can.log line"),
        "{refusal}"
    );
    let mixed = Run {
        tracker: other.tracker.lines().take(9).collect::<Vec<_>>().join("\n"),
        ..run.clone()
    };
    assert!(mixed.refusal().ends_with("has one more than tracker.ndjson"), "{}", mixed.refusal());

    let mut lossy = run.clone();
    lossy.manifest.dropped.get_or_insert_default().text_files = 3;
    assert!(lossy.refusal().starts_with("3 records were dropped while this run was recorded"));

    let broken = Run { can: with_line(&run.can, 4, |line| line.replace('(', "")), ..run.clone() };
    assert!(broken.refusal().starts_with("can.log line 4: \""), "{}", broken.refusal());
    let broken = Run { tracker: with_line(&run.tracker, 2, |_| "{}".to_owned()), ..run.clone() };
    assert!(
        broken.refusal().starts_with("tracker.ndjson: ndjson: line 2: "),
        "{}",
        broken.refusal()
    );
    let broken = Run { steps: with_line(&run.steps, 1, |_| "a,b".to_owned()), ..run.clone() };
    assert!(broken.refusal().starts_with("steps.csv begins with \"a,b\""));
}

/// A shadow estimates, bit for bit, what it would estimate if it steered.
#[test]
fn a_shadow_of_the_recorded_observer_gives_the_recorded_rows() {
    for name in ["default", "paper", "held"] {
        let run = Run::load(name);
        let replayed = run.asked(Some(run.session.observer)).unwrap();
        assert_eq!(replayed.difference, None);
        assert_eq!(replayed.steps_csv(), run.steps, "{name}");
    }
}
