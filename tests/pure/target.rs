//! Runs and studies to a target: where the tip ends, what is refused, what ends a run, and its replay.

use crate::support::program::{Said, Scratch, needle_bench, repository};
use serde_json::Value;

/// A target in the plane behind two balls, at 5 mm/s and with a known roll.
const GOAL: &str = "\
[goal]
kind = \"target\"
position_mm = [0.0, 8.0, 90.3]
curvature_margin = 0.1
[[goal.obstacle]]
shape = \"sphere\"
centre_mm = [0.0, 1.0, 45.0]
radius_mm = 3.0
[[goal.obstacle]]
shape = \"sphere\"
centre_mm = [0.0, 20.0, 70.0]
radius_mm = 6.0
[needle]
radius_mm = 80.0
[emulator]
radius_mm = 80.0
start = { x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }
noise = { uniform_mm = 1.0 }
[observer.invariant]
start_sd = { yaw_deg = 3.0, pitch_deg = 3.0, roll_deg = 5.0 }
[insertion]
speed_mm_per_s = 5.0
[study]
x_mm = [0.0, 0.0]
yaw_deg = [0.0, 0.0]
pitch_deg = [0.0, 0.0]
roll_deg = [0.0, 0.0]
";

const STUDY: &str = "bench-config/target-study.toml";

fn run(scratch: &Scratch, sets: &[&str]) -> Said {
    scratch.write("goal.toml", GOAL);
    let sets = sets.iter().flat_map(|set| ["--set", *set]);
    let arguments: Vec<&str> =
        ["run", "goal.toml", "--json", "--quiet"].into_iter().chain(sets).collect();
    needle_bench(scratch, &arguments)
}

fn number(json: &Value, key: &str) -> f64 {
    json[key].as_f64().unwrap_or_else(|| panic!("{key} in {json}"))
}

fn steps_csv(scratch: &Scratch, said: &Said) -> String {
    std::fs::read_to_string(said.run_dir(scratch).join("steps.csv")).unwrap()
}

/// The least distance of the true tip to the first ball, mm.
fn least_distance_mm(scratch: &Scratch, said: &Said) -> f64 {
    let steps = steps_csv(scratch, said);
    let mut lines = steps.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let column = |name: &str| names.iter().position(|n| *n == name).unwrap();
    let at = ["x_true_mm", "y_true_mm", "z_true_mm"].map(column);
    let distance_mm = |row: &str| {
        let cells: Vec<&str> = row.split(',').collect();
        let [x, y, z] = at.map(|i| cells[i].parse::<f64>().unwrap());
        (x * x + (y - 1.0).powi(2) + (z - 45.0).powi(2)).sqrt() - 3.0
    };
    lines.map(distance_mm).fold(f64::INFINITY, f64::min)
}

/// A ball of 0.5 mm that the tip passes between two steps of 10 mm, where it is more than 5 mm away.
#[test]
fn the_clearance_counts_between_the_steps() {
    let scratch = Scratch::new();
    let ball = "goal.obstacle=[{shape=\"sphere\", centre_mm=[0.0, 3.0, 45.0], radius_mm=0.5}]";
    let said = run(&scratch, &[ball, "insertion.step_mm=10"]);
    let clearance_mm = number(&said.json(), "clearance_mm_min");
    assert!((1.5..4.0).contains(&clearance_mm), "{clearance_mm}");

    let sets = ["--set", ball, "--set", "insertion.step_mm=10", "--trials", "1", "--json"];
    let study = needle_bench(&scratch, &[&["study", "goal.toml"][..], &sets].concat()).json();
    let clearance_mm = number(&study["clearance_mm_min"], "min");
    assert!((1.5..4.0).contains(&clearance_mm), "{clearance_mm}");
}

#[test]
fn the_configuration_of_the_study_also_runs() {
    let scratch = Scratch::new();
    let study = repository(STUDY);
    let said = needle_bench(&scratch, &["run", &study, "--json", "--quiet"]);
    assert_eq!(said.status, 0, "{}", said.stdout);
}

/// In the plane and in space.
#[test]
fn a_run_reaches_its_target_and_replays() {
    for in_plane in ["goal.in_plane=true", "goal.in_plane=false"] {
        let scratch = Scratch::new();
        let said = run(&scratch, &[in_plane]);
        assert_eq!(said.status, 0, "{in_plane}: {} {}", said.stdout, said.stderr);
        let json = said.json();
        assert_eq!(json["plan_status"], "arrived");
        assert!(number(&json, "target_error_mm") < 0.5, "{json}");
        assert!(number(&json, "target_error_est_mm") < 0.5, "{json}");
        assert!(number(&json, "clearance_mm_min") > 1.8, "{json}");
        assert!(least_distance_mm(&scratch, &said) > 1.8, "{json}");
        let inserted_mm = number(&json, "insertion_mm");
        assert!((90.0..95.0).contains(&inserted_mm), "{json}");
        let dir = json["run_dir"].as_str().unwrap();
        let steps = steps_csv(&scratch, &said);
        let last: Vec<&str> = steps.lines().last().unwrap().split(',').collect();
        assert_eq!(last.len(), 39, "the columns of the target are the nine before the last three");
        assert!(last[27].parse::<f64>().unwrap() < 0.5, "{last:?}");
        let replayed = needle_bench(&scratch, &["replay", dir]);
        assert_eq!(replayed.status, 0, "{}", replayed.stdout);
        assert_eq!(needle_bench(&scratch, &["review", dir]).status, 0);
        let page = std::fs::read_to_string(scratch.path().join(dir).join("report.html")).unwrap();
        for chart in ["Predicted error at the target", "Way to the target"] {
            assert!(page.contains(chart), "{in_plane}: no {chart}");
        }
    }
}

/// Seeds whose starts were once refused, by the search alone or by the noise of the first position, although
/// there is a path: for the first three to the target, for the last up to an obstacle near the start.
#[test]
fn a_start_with_a_path_is_not_refused() {
    let sets = [
        "goal.in_plane=false",
        "study.obstacles=5",
        "study.target_share=[0,0.6]",
        "goal.curvature_margin=0.1",
    ];
    let run = |seed| {
        let scratch = Scratch::new();
        scratch.write("study.toml", &std::fs::read_to_string(repository(STUDY)).unwrap());
        let sets = sets.iter().flat_map(|set| ["--set", *set]);
        let run = ["run", "study.toml", "--json", "--quiet", "--seed", seed];
        needle_bench(&scratch, &run.into_iter().chain(sets).collect::<Vec<_>>()).json()
    };
    for seed in ["1108866274680416", "4320813557789487", "8171976210547261"] {
        assert_eq!(run(seed)["plan_status"], "arrived", "{seed}");
    }
    let json = run("4390525250300538");
    assert!(number(&json, "insertion_mm") > 10.0, "{json}");
}

/// The target is a tool of its own on the tracker's stream, and moves by 3 mm.
#[test]
fn a_moving_target_is_reached_and_the_run_replays() {
    let scratch = Scratch::new();
    let drift = "emulator.target_drift_mm_per_mm=[0.0, 0.033, 0.0]";
    let said = run(&scratch, &["goal.tool=TargetToTracker", drift]);
    assert_eq!(said.status, 0, "{} {}", said.stdout, said.stderr);
    let json = said.json();
    assert!(number(&json, "target_error_mm") < 0.8, "{json}");
    let dir = json["run_dir"].as_str().unwrap();
    let steps = steps_csv(&scratch, &said);
    let last: Vec<f64> =
        steps.lines().last().unwrap().split(',').map(|cell| cell.parse().unwrap_or(0.0)).collect();
    assert!((last[31] - 11.0).abs() < 0.5 && (last[34] - 11.0).abs() < 0.2, "{last:?}");
    let replayed = needle_bench(&scratch, &["replay", dir]);
    assert_eq!(replayed.status, 0, "{}", replayed.stdout);
}

/// It is reached at speed then, and the needle must not stop at once.
#[test]
fn a_target_that_comes_toward_the_tip_is_braked_for() {
    let scratch = Scratch::new();
    for (seed, speed) in [("5", "2"), ("10", "2"), ("11", "2"), ("6", "6")] {
        let said = needle_bench(
            &scratch,
            &[
                "run",
                &repository("bench-config/target.toml"),
                "--json",
                "--quiet",
                "--set",
                "goal.tool=TargetToTracker",
                "--set",
                "emulator.target_drift_mm_per_mm=[0.0, 0.0, -0.05]",
                "--set",
                &format!("emulator.seed={seed}"),
                "--set",
                &format!("insertion.speed_mm_per_s={speed}"),
            ],
        );
        assert_eq!(said.json()["plan_status"], "arrived", "{}", said.stderr);
        assert!(number(&said.json(), "target_error_mm") < 0.5, "{}", said.stdout);
        let log = std::fs::read_to_string(said.run_dir(&scratch).join("can.log")).unwrap();
        let targets: Vec<i64> = log
            .lines()
            .filter_map(|line| line.split_once(" 201#")?.1.get(4..12))
            .map(|hex| i64::from(u32::from_str_radix(hex, 16).unwrap().swap_bytes().cast_signed()))
            .collect();
        let steps: Vec<i64> = targets.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let most = steps.windows(2).map(|pair| (pair[1] - pair[0]).abs()).max().unwrap();
        // 10 mm/s² by the peak of a profile is 5.2 counts a SYNC per SYNC, and the targets are rounded.
        assert!(targets.len() > 1000 && most <= 7, "seed {seed}: {most} counts");
    }
}

#[test]
fn an_unreachable_target_is_refused_before_power() {
    for (set, reason) in [
        ("goal.position_mm=[0.0, 60.0, 60.0]", "the target is out of reach"),
        ("goal.position_mm=[0.0, 40.0, 10.0]", "mm from the target"),
        ("goal.position_mm=[0.0, 0.0, -20.0]", "20.0 mm behind the start"),
        ("goal.position_mm=[0.0, 1.0, 45.0]", "inside an obstacle"),
        ("goal.position_mm=[0.0, 1.0, 48.5]", "from an obstacle"),
        ("goal.position_mm=[0.0, 90.0, 90.0]", "outside goal.workspace_mm"),
        ("goal.position_mm=[0.0, nan, 90.0]", "goal.position_mm"),
        ("insertion.depth_mm=80", "the target is out of reach"),
        ("control.kind=\"feedback-linearization\"", "control.kind"),
        ("goal.expansions_max=1", "the budget of expansions was spent"),
        (
            "goal.obstacle=[{ shape=\"sphere\", centre_mm=[0.0,0.0,2.0], radius_mm=3.0 }]",
            "the start is",
        ),
    ] {
        let scratch = Scratch::new();
        let said = run(&scratch, &[set]);
        assert_eq!(said.status, 2, "{set}: {} {}", said.stdout, said.stderr);
        assert!(said.stderr.contains(reason), "{set}: {}", said.stderr);
        assert!(!scratch.path().join("runs").exists(), "{set}");
    }
}

/// A needle that hardly bends is stopped before it comes nearer to the ball than the clearance less the
/// uncertainty of the tip.
#[test]
fn a_curvature_so_wrong_that_no_path_is_left_ends_the_run() {
    let scratch = Scratch::new();
    let said = run(&scratch, &["emulator.radius_mm=2000.0"]);
    assert_eq!(said.status, 1, "{} {}", said.stdout, said.stderr);
    let json = said.json();
    let reason = json["stop_reason"].as_str().unwrap();
    let known = ["goal: ", "tracker: ", "observer: "];
    assert!(known.iter().any(|known| reason.starts_with(known)), "{reason}");
    assert!(least_distance_mm(&scratch, &said) > 1.5, "{json}");
}

/// Such a run still completes.
#[test]
fn a_missed_target_is_reported_as_missed() {
    let scratch = Scratch::new();
    let said = run(&scratch, &["goal.tolerance_mm=0.0001"]);
    let json = said.json();
    assert_eq!((said.status, &json["plan_status"]), (0, &Value::from("missed")));
    let folder = json["run_dir"].as_str().unwrap();
    let review = |more: &[&str]| needle_bench(&scratch, &[&["review", folder], more].concat());
    assert_eq!(review(&["--json"]).json()["plan_status"], "missed");
    let text = review(&[]).stdout;
    assert!(text.ends_with("completed, not at the target\n"), "{text}");
    assert!(text.contains("distance from the target at the last step, true  "), "{text}");
    let without_json = ["run", "goal.toml", "--quiet", "--set", "goal.tolerance_mm=0.0001"];
    let text = needle_bench(&scratch, &without_json).stdout;
    let last = text.lines().last().unwrap();
    let off_mm = number(&json, "target_error_est_mm");
    let missed = format!("completed, not at the target: {off_mm:.3} mm from it by the estimate");
    assert!(last.starts_with(&missed), "{last}");
    let true_mm = number(&json, "target_error_mm");
    let labelled = format!("{true_mm:.3} mm from it (true), {off_mm:.3} mm (estimated); nearest");
    assert!(text.contains(&labelled), "{text}");
}

/// The path in the plane is clear, but the tip is not on it.
#[test]
fn a_tip_off_the_plane_keeps_clear_of_obstacles_beside_the_plane() {
    let run = |z_mm: f64| {
        let start =
            "emulator.start={x_mm=8.0,y_mm=0.0,z_mm=0.0,yaw_deg=0.0,pitch_deg=0.0,roll_deg=0.0}";
        let ball = format!(
            "goal.obstacle=[{{shape=\"sphere\",centre_mm=[9.0,0.0,{z_mm:.1}],radius_mm=5.0}}]"
        );
        let reach = "insertion.plane_out_of_reach=\"insert\"";
        let said = run(&Scratch::new(), &[start, &ball, reach]);
        (said.status, said.json())
    };
    let (status, json) = run(15.0);
    assert_eq!(status, 1, "{json}");
    let reason = json["stop_reason"].as_str().unwrap();
    assert!(reason.contains("the next step, or a stop after it, may lead nearer"), "{reason}");
    assert!(number(&json, "clearance_mm_min") > 1.5, "{json}");
    let (status, json) = run(3.0);
    let reason = json["stop_reason"].as_str().unwrap();
    assert_eq!(status, 1, "{json}");
    assert!(reason.contains("off the plane, and nearer to an obstacle"), "{reason}");
    assert_eq!(number(&json, "steps"), 0.0, "{json}");
}

/// At 10 mm/s the needle goes on by more than 2 mm after the step that stops it. The ball is beside the plane.
#[test]
fn a_stop_at_speed_keeps_clear() {
    let scratch = Scratch::new();
    let said = run(
        &scratch,
        &[
            "emulator.start={x_mm=8.0,y_mm=0.0,z_mm=0.0,yaw_deg=0.0,pitch_deg=0.0,roll_deg=0.0}",
            "goal.obstacle=[{shape=\"sphere\",centre_mm=[9.0,0.0,15.0],radius_mm=5.0}]",
            "insertion.plane_out_of_reach=\"insert\"",
            "insertion.speed_mm_per_s=10",
            "control.nested_saturation.rotation_max_deg_per_mm=20",
            "tracker.hold_after_mm=5",
        ],
    );
    let json = said.json();
    let reason = json["stop_reason"].as_str().unwrap();
    assert!(reason.contains("the next step, or a stop after it, may lead nearer"), "{reason}");
    let steps = steps_csv(&scratch, &said);
    let mut rows = steps.lines();
    let names: Vec<&str> = rows.next().unwrap().split(',').collect();
    let last: Vec<&str> = rows.last().unwrap().split(',').collect();
    let value = |name| last[names.iter().position(|n| *n == name).unwrap()].parse::<f64>().unwrap();
    let [x, y, z] = ["x_true_mm", "y_true_mm", "z_true_mm"].map(value);
    // From its last step on the needle goes straight toward the ball at worst.
    let gone_mm = number(&json, "insertion_mm") - value("insertion_mm");
    let from_ball_mm = ((x - 9.0).powi(2) + y * y + (z - 15.0).powi(2)).sqrt() - 5.0 - gone_mm;
    assert!(gone_mm > 1.5 && from_ball_mm > 1.5, "{gone_mm} {from_ball_mm} {json}");
    assert!(number(&json, "clearance_mm_min") < from_ball_mm + 1.0, "{json}");
}

/// One expansion per step is too few to replan.
#[test]
fn a_step_without_budget_follows_the_plan_that_is_there() {
    let scratch = Scratch::new();
    let said = run(&scratch, &["goal.step_expansions_max=1"]);
    assert_eq!(said.json()["plan_status"], "arrived", "{}", said.stdout);
    assert!(least_distance_mm(&scratch, &said) > 1.8, "{}", said.stdout);
}

/// It counts the targets that are reached and refused, and no needle touches an obstacle.
#[test]
fn a_study_draws_targets_and_obstacles() {
    let scratch = Scratch::new();
    scratch.write("goal.toml", GOAL);
    let study = |sets: &[&str]| {
        let sets = sets.iter().flat_map(|set| ["--set", *set]);
        let begun = ["study", "goal.toml", "--json", "--trials", "12"];
        let said = needle_bench(&scratch, &begun.into_iter().chain(sets).collect::<Vec<_>>());
        assert_eq!(said.status, 0, "{}", said.stderr);
        said.json()
    };
    let drawn = [
        "goal.in_plane=false",
        "study.target_depth_mm=[60, 90]",
        "study.obstacles=3",
        "study.obstacle_radius_mm=[3, 6]",
    ];
    let json = study(&drawn);
    assert!(number(&json, "refused_fraction") < 0.7, "{json}");
    assert!(number(&json, "reached_fraction") > 0.7, "{json}");
    assert_eq!(json["touched_fraction"], 0.0, "{json}");
    assert!(number(&json["target_error_mm"], "median") < 0.3, "{json}");
    assert!(json["clearance_mm_min"]["p5"].as_f64().unwrap() > 1.7, "{json}");
    // Screen and CSV are about the target, not about the plane.
    let all = ["study", "goal.toml", "--trials", "4", "--out", "trials.csv"];
    let said = needle_bench(&scratch, &all);
    assert_eq!(said.status, 0, "{}", said.stderr);
    for line in
        ["\nrefused     0.00%", "\nreached     100.00%", "\ntarget      0.", "\nclearance   "]
    {
        assert!(said.stdout.contains(line), "{}", said.stdout);
    }
    assert!(!said.stdout.contains("off plane"), "{}", said.stdout);
    let rows = std::fs::read_to_string(scratch.path().join("trials.csv")).unwrap();
    let columns = ",target_x_mm,target_y_mm,target_z_mm,target_refused,target_reached,target_error_mm,clearance_mm_min,settled";
    assert!(rows.contains(columns), "{rows}");
    assert_eq!(rows.matches(",false,true,0.").count(), 4, "{rows}");
    // If every start is refused, there is no error to report.
    let json = study(&["goal.reserve_mm=40"]);
    assert_eq!(json["refused_fraction"], 1.0, "{json}");
    assert_eq!(json["target_error_mm"]["median"], Value::Null, "{json}");
    let all = ["study", "goal.toml", "--trials", "3", "--set", "goal.reserve_mm=40"];
    let said = needle_bench(&scratch, &all).stdout;
    assert!(
        said.contains(
            "\nrefused     100.00%: no path with which a run may begin\n            seed "
        ),
        "{said}"
    );
    assert_eq!(said.matches("none was found that keeps goal.reserve_mm, 40").count(), 1, "{said}");
    let plane = ["study", "goal.toml", "--trials", "1", "--set", "goal.kind=plane"];
    let refused = needle_bench(&scratch, &plane);
    assert_eq!(refused.status, 2, "{}", refused.stderr);
    assert!(refused.stderr.contains("goal.kind"), "{}", refused.stderr);
}

/// Without a reserve of the clearance, the runs with these seeds do not arrive.
#[test]
fn the_shipped_example_reaches_its_target() {
    let example = repository("bench-config/target.toml");
    for seed in [1, 4, 9] {
        let set = format!("emulator.seed={seed}");
        let arguments = ["run", &example, "--json", "--quiet", "--set", &set];
        let said = needle_bench(&Scratch::new(), &arguments);
        assert_eq!(said.status, 0, "seed {seed}: {}", said.stderr);
        assert!(number(&said.json(), "target_error_mm") < 0.3, "seed {seed}: {}", said.stdout);
    }
}
