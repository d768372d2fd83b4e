//! `needle-bench calibrate needle`: recorded insertions become a configuration.

use crate::support::program::{Scratch, needle_bench, refusals, repository};
use crate::support::recording::{heading_only, recording, to_and_fro};
use needle_bench::needle::{Needle, Torsion, TorsionConfig};

/// Four insertions of a needle with a curvature of 0.012 per mm, its tip 6 mm ahead, and a shaft that creeps
/// in torsion.
fn recorded(scratch: &Scratch) {
    let needle = Needle::new(0.012).unwrap().with_tip_ahead(6.0).unwrap();
    let creeping = TorsionConfig {
        offset_rad: 0.5,
        creep_mm: 0.8,
        creep_mm_per_mm: 0.005,
        ..TorsionConfig::default()
    };
    let torsion = Torsion::new(creeping).unwrap();
    for (name, way_mm) in [("a.csv", 3), ("b.csv", 4), ("c.csv", 5), ("d.csv", 7)] {
        scratch.write(name, &recording(needle, &torsion, to_and_fro(way_mm)));
    }
}

#[test]
fn a_calibrated_needle_evaluates_an_insertion_that_was_left_out() {
    let scratch = Scratch::new();
    recorded(&scratch);
    let found = needle_bench(
        &scratch,
        &["calibrate", "needle", "a.csv", "b.csv", "c.csv", "--json", "--out", "needle.toml"],
    );
    assert_eq!(found.status, 0, "{}", found.stderr);
    let json = found.json();
    let near = |value: &serde_json::Value, expected: f64, by: f64| {
        let value = value.as_f64().unwrap();
        assert!((value - expected).abs() < by, "{value} is not {expected}: {json}");
    };
    near(&json["needle"]["curvature_per_mm"], 0.012, 3e-4);
    near(&json["needle"]["tip_ahead_mm"], 6.0, 0.3);
    near(&json["needle"]["torsion"]["offset_deg"], 28.6, 0.5);
    near(&json["needle"]["torsion"]["creep_mm"], 0.8, 0.05);
    near(&json["evaluation"]["bend_axis"][0], 1.0, 1e-3);
    near(&json["needle"]["fit"]["insertions"], 3.0, 0.1);

    // The result is a configuration and fits the insertion that was left out.
    let said = needle_bench(
        &scratch,
        &[
            "evaluate",
            "d.csv",
            "--json",
            "--config",
            "needle.toml",
            "--set",
            "observer.kind=\"invariant\"",
            "--set",
            "observer.invariant.position_sd_mm=0.02",
        ],
    );
    assert_eq!(said.status, 0, "{}", said.stderr);
    let scores = said.json();
    assert!(scores["roll_rms_deg"]["median"].as_f64().unwrap() < 3.0, "{scores}");
    assert!(scores["prediction_5mm_rms_mm"].as_f64().unwrap() < 0.1, "{scores}");
}

#[test]
fn a_calibration_is_not_overwritten() {
    let scratch = Scratch::new();
    recorded(&scratch);
    scratch.write("needle.toml", "mine");
    let arguments = ["calibrate", "needle", "a.csv", "b.csv", "c.csv", "--out", "needle.toml"];
    insta::assert_snapshot!(refusals(&scratch, &[&arguments]));
    let kept = std::fs::read_to_string(scratch.path().join("needle.toml")).unwrap();
    assert_eq!(kept, "mine");
}

#[test]
fn too_few_or_unusable_recordings_are_refused_with_the_reason() {
    let scratch = Scratch::new();
    recorded(&scratch);
    scratch.write("plain.csv", "insertion_mm,rotation_rad,x_mm,y_mm,z_mm\n0,0,0,0,0\n");
    let text = std::fs::read_to_string(scratch.path().join("a.csv")).unwrap();
    scratch.write("again.csv", &text.replacen('\n', "\n\n", 1));
    // A depth has lost its point.
    scratch.write("spike.csv", &text.replacen("\n20.5,", "\n205,", 1));
    let screens = refusals(
        &scratch,
        &[
            &["calibrate", "needle", "a.csv", "b.csv"],
            // One recording given three times would have no scatter.
            &["calibrate", "needle", "a.csv", "a.csv", "a.csv"],
            &["calibrate", "needle", "a.csv", "b.csv", "again.csv"],
            &["calibrate", "needle", "a.csv", "plain.csv"],
            &["calibrate", "needle", "a.csv", "absent.csv"],
            &["evaluate", "spike.csv"],
        ],
    );
    insta::assert_snapshot!(screens);
}

/// The base turns both ways, but by too little to show whether the orientations turn with it.
#[test]
fn headings_after_small_turns_are_refused_as_such() {
    let scratch = Scratch::new();
    let rigid = Torsion::default();
    let names = ["a.csv", "b.csv", "c.csv"];
    for (name, turn_rad) in names.into_iter().zip([0.03, 0.04, 0.05]) {
        let to_and_fro = |n: u32| if (n / 20).is_multiple_of(2) { turn_rad } else { -turn_rad };
        let csv = recording(Needle::new(0.012).unwrap(), &rigid, to_and_fro);
        scratch.write(name, &heading_only(&csv));
    }
    let said = needle_bench(&scratch, &[&["calibrate", "needle"], &names[..]].concat());
    assert_eq!(said.status, 2, "{}", said.stdout);
    let why = "a.csv: the base turned by only 34 deg, so the orientations do not show whether they turn with it";
    assert!(said.stderr.replace("\n       ", " ").contains(why), "{}", said.stderr);
}

#[test]
fn a_rig_without_noise_of_the_path_is_warned_about() {
    let scratch = Scratch::new();
    recorded(&scratch);
    let rig = repository("bench-config/rig-epos4.toml");
    let files = ["calibrate", "needle", "a.csv", "b.csv", "c.csv", &rig];
    let is_warned = |sets: &[&str]| {
        let said = needle_bench(&scratch, &[&files, sets].concat());
        assert_eq!(said.status, 0, "{}", said.screen());
        said.stderr.contains(
            "warning: observer.invariant.noise has axial_mm = 0.05 and heading_deg = 0.1: ",
        )
    };
    assert!(is_warned(&[]));
    assert!(!is_warned(&["--set", "observer.invariant.noise.axial_mm=0.9"]));
}

/// As with a wrong counts_per_turn. The fit makes it a creep.
#[test]
fn a_rotation_of_another_scale_is_warned_about() {
    let scratch = Scratch::new();
    recorded(&scratch);
    for name in ["a.csv", "b.csv", "c.csv"] {
        let text = std::fs::read_to_string(scratch.path().join(name)).unwrap();
        let scaled =
            text.lines().enumerate().map(|(n, line)| match line.split(',').collect::<Vec<_>>() {
                cells if n > 0 => {
                    let rotation_rad = 1.4 * cells[1].parse::<f64>().unwrap();
                    format!("{},{rotation_rad},{}\n", cells[0], cells[2..].join(","))
                }
                _ => format!("{line}\n"),
            });
        scratch.write(&format!("scaled-{name}"), &scaled.collect::<String>());
    }
    let is_warned = |prefix: &str| {
        let files = ["a.csv", "b.csv", "c.csv"].map(|name| format!("{prefix}{name}"));
        let said =
            needle_bench(&scratch, &["calibrate", "needle", &files[0], &files[1], &files[2]]);
        assert_eq!(said.status, 0, "{}", said.screen());
        said.stderr.contains("is stage.rotation.counts_per_turn right")
    };
    assert!(!is_warned(""));
    assert!(is_warned("scaled-"));
}
