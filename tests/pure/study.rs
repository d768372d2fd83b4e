//! The command `needle-bench study`.

use crate::support::program::{Scratch, needle_bench, refusals, repository};
use serde_json::Value;
use std::process::{Command, Stdio};
use std::time::Duration;

const COORDINATES: [&str; 6] = ["x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg"];
const DEPTH: &str = "insertion={ depth_mm = 30, plane_out_of_reach = \"insert\" }";

/// The rows of the CSV that a study with these arguments writes.
fn rows(scratch: &Scratch, arguments: &[&str]) -> Vec<Vec<String>> {
    let out = scratch.path().join("out.csv").display().to_string();
    let said =
        needle_bench(scratch, &[&["study", "--set", DEPTH, "--out", &out], arguments].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    let text = std::fs::read_to_string(&out).unwrap();
    let again = needle_bench(scratch, &["study", "--trials", "1", "--out", &out]);
    assert_eq!(again.status, 2, "{}", again.stderr);
    assert!(again.stderr.contains("exists, and is not overwritten"), "{}", again.stderr);
    std::fs::remove_file(out).unwrap();
    text.lines().map(|line| line.split(',').map(str::to_owned).collect()).collect()
}

fn column(rows: &[Vec<String>], name: &str) -> usize {
    rows[0].iter().position(|column| column == name).unwrap_or_else(|| panic!("no column {name}"))
}

#[test]
fn study_json_has_its_documented_keys() {
    let scratch = Scratch::new();
    let said = needle_bench(
        &scratch,
        &["study", "--trials", "8", "--seed", "3", "--json", "--set", DEPTH],
    );
    assert_eq!(said.status, 0, "{}", said.stderr);
    let json = said.json();
    assert_eq!(json["trials"], 8);
    let settled = json["settled_fraction"].as_f64().unwrap();
    assert!((0.0..=1.0).contains(&settled));
    assert_eq!(json["warned_fraction"], 0.0);
    for (key, parts) in [
        ("off_plane_rms_mm", &["median", "p95", "max"][..]),
        ("settling_mm", &["median", "p95"]),
        ("shortest_settling_mm", &["median"]),
        ("estimate_rms", &COORDINATES),
        ("bound_ratio", &COORDINATES),
    ] {
        for part in parts {
            let value = json[key].get(part);
            let is_number_or_null = value.is_some_and(|value| value.is_f64() || value.is_null());
            assert!(is_number_or_null, "{key}.{part} in {json}");
        }
    }
    assert!(json["off_plane_rms_mm"]["median"].as_f64().unwrap() > 0.0);
    assert!(json["insertion_mm_per_second"].as_f64().unwrap() > 0.0);
    let failed = json["failed"].as_array().unwrap();
    assert_eq!(failed.len(), ((1.0 - settled) * 8.0).round() as usize);
    assert!(failed.iter().all(|trial| trial["seed"].is_u64()));
}

#[test]
fn a_single_trial_gets_no_verdict() {
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["study", "--trials", "1", "--set", DEPTH]);
    let line = |name: &str| said.stdout.lines().find(|line| line.starts_with(name));
    assert!(line("NEES  ").is_some_and(|line| line.ends_with(" at the end")), "{}", said.stdout);
    assert!(line("NIS  ").is_some_and(|line| line.ends_with(" third")), "{}", said.stdout);
}

#[test]
fn the_command_that_a_study_prints_repeats_a_failed_trial() {
    let scratch = Scratch::new();
    scratch.write("my rig.toml", "insertion.depth_mm = 60\n");
    let set = "study.x_mm=[30, 40]";
    let study = ["study", "my rig.toml", "--trials", "2", "--seed", "3", "--set", set];
    let json = needle_bench(&scratch, &[&study[..], &["--json"]].concat()).json();
    let seed = json["failed"][0]["seed"].to_string();
    let said = needle_bench(&scratch, &study);
    let out_of_reach = "insertion.plane_out_of_reach=insert";
    assert!(
        said.stdout.ends_with(&format!(
            "\nrepeat      needle-bench run 'my rig.toml' --set 'study.x_mm=[30, 40]' --set \
             {out_of_reach} --seed {seed}\n"
        )),
        "{}",
        said.stdout
    );
    let run = ["run", "my rig.toml", "--set", set, "--set", out_of_reach, "--seed", &seed];
    let repeated = needle_bench(&scratch, &[&run[..], &["--json"]].concat());
    assert_eq!(repeated.status, 0, "{}", repeated.stderr);
    let off_mm = |json: &serde_json::Value| json["off_plane_rms_mm"].as_f64().unwrap();
    let (trial_mm, run_mm) = (off_mm(&json["failed"][0]), off_mm(&repeated.json()));
    assert!((trial_mm - run_mm).abs() < 0.5, "{trial_mm} {run_mm}");
}

#[test]
fn every_position_steers_better_than_one_a_step() {
    let scratch = Scratch::new();
    let [all_mm, one_mm] = ["all", "one-per-step"].map(|samples| {
        let samples = format!("observer.samples={samples}");
        let said = needle_bench(
            &scratch,
            &[
                "study",
                "--trials",
                "12",
                "--json",
                "--set",
                &samples,
                "--set",
                "insertion.depth_mm=150",
            ],
        );
        assert_eq!(said.status, 0, "{}", said.stderr);
        said.json()["off_plane_rms_mm"]["median"].as_f64().unwrap()
    });
    assert!(all_mm < 0.5 * one_mm, "{all_mm} {one_mm}");
}

/// Nor on the number of trials.
#[test]
fn trials_do_not_depend_on_the_number_of_threads() {
    let scratch = Scratch::new();
    let one = rows(&scratch, &["--trials", "6", "--threads", "1"]);
    assert_eq!(one.len(), 7);
    assert_eq!(one, rows(&scratch, &["--trials", "6", "--threads", "2"]));
    assert_eq!(one[..4], rows(&scratch, &["--trials", "3"])[..]);
    assert_ne!(one, rows(&scratch, &["--trials", "6", "--seed", "2"]));
}

/// A trial through a whole session is the same run (JSON may lose the last bit); one without a session differs by
/// the rounding of the encoders.
/// With eight copies at the start the coupled observer keeps a wrong roll here, and the run is stopped.
#[test]
fn the_coupled_observer_steers_a_start_that_misleads_it_into_the_plane() {
    let scratch = Scratch::new();
    let study = concat!(env!("CARGO_MANIFEST_DIR"), "/bench-config/study.toml");
    for (seed, law) in
        [("2441011085624716", "feedback-linearization"), ("2260397153495269", "nested-saturation")]
    {
        let law = format!("control.kind={law}");
        let sets = ["observer.kind=coupled", "observer.samples=one-per-step", &law];
        let sets = sets.iter().flat_map(|set| ["--set", *set]).collect::<Vec<_>>();
        let said = needle_bench(
            &scratch,
            &[&["run", study, "--json", "-q", "--seed", seed], &sets[..]].concat(),
        );
        assert_eq!(said.status, 0, "{}", said.stderr);
        let off_plane_mm = said.json()["off_plane_rms_mm"].as_f64().expect("a number");
        assert!(off_plane_mm < 0.5, "{off_plane_mm} mm");
    }
}

#[test]
fn a_run_with_the_seed_of_a_trial_repeats_it() {
    let scratch = Scratch::new();
    let whole = rows(&scratch, &["--trials", "2", "--through-session"]);
    let short = rows(&scratch, &["--trials", "2"]);
    let (seed, off_plane) = (column(&whole, "seed"), column(&whole, "off_plane_rms_mm"));
    for (whole, short) in whole.iter().zip(&short).skip(1) {
        let said = needle_bench(
            &scratch,
            &["run", "--json", "-q", "--seed", &whole[seed], "--set", DEPTH],
        );
        let run_mm = said.json()["off_plane_rms_mm"].as_f64().unwrap();
        let [whole_mm, short_mm] =
            [whole, short].map(|trial| trial[off_plane].parse::<f64>().unwrap());
        assert!((run_mm - whole_mm).abs() < 1e-12 * run_mm, "{run_mm} {whole_mm}");
        assert!((run_mm - short_mm).abs() < 0.02, "{run_mm} {short_mm}");
    }
}

#[test]
fn trials_that_were_stopped_have_no_distance() {
    let curvature = "study.curvature_error=[-0.9,9]";
    let no_restart = "observer.invariant.innovation_bias_max=1e6";
    let sets = ["--set", curvature, "--set", no_restart, "--set", DEPTH];
    let study = ["study", "--trials", "3", "--through-session"];
    let said = needle_bench(&Scratch::new(), &[&study[..], &sets].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    let line = "off plane   stopped at the median, stopped at 95%, stopped the worst";
    assert!(said.stdout.contains(line), "{}", said.stdout);
}

/// The record has the parameters that were drawn.
#[test]
fn the_record_of_a_drawn_run_repeats_it() {
    let scratch = Scratch::new();
    let curvature = "study.curvature_error=[-0.3, 0.3]";
    let seed = "4503599627370497";
    let arguments = ["run", "--json", "-q", "--seed", seed, "--set", DEPTH, "--set", curvature];
    let steps = |arguments: &[&str]| {
        let dir = needle_bench(&scratch, arguments).run_dir(&scratch);
        (std::fs::read_to_string(dir.join("steps.csv")).unwrap(), dir)
    };
    let (first, dir) = steps(&arguments);
    let config = dir.join("config.toml").display().to_string();
    assert_eq!(first, steps(&["run", &config, "--json", "-q"]).0);
}

#[test]
fn bad_ranges_counts_and_stages_of_a_study_are_refused() {
    let scratch = Scratch::new();
    let on_vcan = ["--set", "can.interface=vcan0", "--set", "tracker.source=openigtlink"];
    let registered = [
        "--set",
        "tracker.registration={ x_mm = 0, y_mm = 0, z_mm = 0, yaw_deg = 0, pitch_deg = 0, roll_deg = 0 }",
    ];
    let on_vcan = [on_vcan.as_slice(), &registered].concat();
    let commands: &[&[&str]] = &[
        &["study", "--set", "study.x_mm=[2, -2]"],
        &["study", "--set", "study.torsion_offset_deg=[-23, 23]"],
        &["study", "--set", "study.speed=[1, 2]"],
        &["study", "--trials", "0"],
        &["study", "--trials", "4000000000"],
        &["study", "--threads", "99999"],
        &[&["study"], &on_vcan[..]].concat(),
        &[&["run", "--seed", "7"], &on_vcan[..]].concat(),
    ];
    insta::assert_snapshot!(refusals(&scratch, commands));
}

/// A trial of a rig's study is repeated by the command that the study prints.
#[test]
fn the_configuration_of_a_rig_is_studied_on_the_emulated_stage() {
    let scratch = Scratch::new();
    let rig = repository("bench-config/rig-epos4.toml");
    let rig = rig.as_str();
    let refused = needle_bench(&scratch, &["study", rig]);
    assert_eq!(refused.status, 2, "{}", refused.stderr);
    assert!(refused.stderr.contains("study this rig with --rehearse"), "{}", refused.stderr);
    let study = ["study", rig, "--rehearse", "--trials", "3", "--set", "insertion.depth_mm=30"];
    let said = needle_bench(&scratch, &study);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let (_, repeat) = said.stdout.split_once("needle-bench ").expect("a command");
    let run = needle_bench(&scratch, &repeat.split_whitespace().collect::<Vec<_>>());
    assert_eq!(run.status, 0, "{}", run.stderr);
    assert!(run.stdout.contains("can0 was not opened"), "{}", run.stdout);
}

/// The whole session that a study runs first must start at the configured roll too.
#[test]
fn a_known_roll_at_the_start_can_be_studied() {
    let scratch = Scratch::new();
    let known = [
        "insertion.depth_mm=100",
        "observer.start.roll_deg=137",
        "observer.invariant.start_sd.roll_deg=5",
        "study.roll_deg=[137, 137]",
    ];
    let sets: Vec<&str> = known.iter().flat_map(|set| ["--set", set]).collect();
    let said = needle_bench(&scratch, &[&["study", "--trials", "2", "--json"], &sets[..]].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert_eq!(said.json()["failed"], serde_json::json!([]));
}

/// A file that cannot be written is refused before any trial. One that fails later does not take the result with it.
#[test]
fn an_output_that_cannot_be_written_costs_no_result() {
    let scratch = Scratch::new();
    let study = ["study", "--trials", "20", "--set", "insertion.depth_mm=20", "--out"];
    let said = needle_bench(&scratch, &[&study[..], &["gone/x.csv"]].concat());
    assert_eq!((said.status, said.stdout.as_str()), (3, ""), "{}", said.stderr);
    assert!(said.stderr.contains("gone/x.csv: cannot be written: No such file"), "{}", said.stderr);
    // The CSV of 20 trials is longer than 512 bytes, the most that a file may have here.
    let bench = env!("CARGO_BIN_EXE_needle-bench");
    let script =
        format!("trap '' XFSZ; ulimit -f 1; exec {bench} {} x.csv --json", study.join(" "));
    let output = Command::new("dash")
        .args(["-c", &script])
        .current_dir(scratch.path())
        .output()
        .expect("dash starts");
    let json: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!((output.status.code(), &json["trials"]), (Some(3), &20.into()));
    assert!(
        json["error"].to_string().contains("x.csv: cannot be written: File too large"),
        "{json}"
    );
    assert!(!scratch.path().join("x.csv").exists());
}

/// Ctrl-C ends a study with the figures of the trials that are done.
#[test]
fn an_interrupted_study_reports_the_trials_that_are_done() {
    let scratch = Scratch::new();
    let mut study = Command::new(env!("CARGO_BIN_EXE_needle-bench"))
        .args(["study", "--trials", "1000000", "--set", "insertion.depth_mm=20"])
        .args(["--out", "x.csv", "--json"])
        .current_dir(scratch.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let pid = study.id();
    // The output file is tried before the signals are listened for; only a signal after that ends in order.
    let listens = || {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("a process");
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).expect("a mask");
        u64::from_str_radix(caught.trim(), 16).expect("a mask") & 2 != 0
    };
    while !listens() {
        assert_eq!(study.try_wait().expect("a process"), None);
        std::thread::sleep(Duration::from_millis(10));
    }
    let signalled = Command::new("kill").args(["-INT", &pid.to_string()]).status();
    assert!(signalled.expect("kill starts").success());
    let ended = study.wait_with_output().expect("it ends");
    let json: Value = serde_json::from_slice(&ended.stdout).expect("one JSON object");
    let (done, stderr) =
        (json["trials"].as_u64().expect("a number"), String::from_utf8_lossy(&ended.stderr));
    let reason = format!("interrupted after {done} of 1000000 trials");
    assert_eq!(ended.status.code(), Some(1), "{stderr}");
    assert!(json["stop_reason"].to_string().contains(&reason), "{json}");
    assert!(stderr.contains(&format!("stopped: {reason}")), "{stderr}");
    let rows = std::fs::read_to_string(scratch.path().join("x.csv")).expect("the rows");
    assert_eq!(rows.lines().count() as u64, done + 1);
}
