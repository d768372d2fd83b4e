//! `--rehearse`: the unchanged file of a rig, on emulated drives and with an emulated tracker.

use crate::support::program::{Said, Scratch, needle_bench, repository};
use crate::support::protocol;
use needle_bench::archive::Manifest;
use needle_bench::telemetry::{RunFolder, write_manifest};
use std::fs;

/// What an operator measures: a tracker that is turned and far away, a sensor off the needle's axis, objects of
/// the drive's manufacturer, a zero that is not the drive's.
const MEASURED: [&str; 9] = [
    "tracker.registration={ x_mm = 120.0, y_mm = -40.0, z_mm = 310.0, yaw_deg = 30.0, pitch_deg = -20.0, \
     roll_deg = 100.0 }",
    "tracker.tip_offset_mm=[4.0, -3.0, 7.5]",
    "tracker.tip_tilt={ yaw_deg = 4.0, pitch_deg = -3.0, roll_deg = 50.0 }",
    "needle.radius_mm=95.0",
    "needle.torsion.half_width_deg=4.0",
    "stage.rotation.sdo=[{ index = 0x3001, subindex = 5, value = 7, bits = 16 }]",
    "stage.rotation.zero=12345",
    "stage.insertion.sign=-1",
    "stage.insertion.homing.method=18",
];

fn rehearse(scratch: &Scratch, command: &[&str], sets: &[&str]) -> Said {
    let rig = repository("bench-config/rig-epos4.toml");
    // A run that opened the bus or the tracker would fail.
    let nothing =
        ["can.interface=nocan9", "tracker.mode=listen", "tracker.address=192.0.2.1:18944"];
    let sets = nothing.iter().chain(sets).flat_map(|set| ["--set", set]);
    let named: &[&str] = if command[0] == "stage" { &["--config", &rig] } else { &[&rig] };
    let arguments: Vec<&str> = command.iter().chain(named).copied().chain(sets).collect();
    needle_bench(scratch, &arguments)
}

fn manifest(scratch: &Scratch, said: &Said) -> serde_json::Value {
    let path = said.run_dir(scratch).join("manifest.json");
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn the_rig_of_the_worked_example_completes_a_rehearsal_and_replays() {
    let scratch = Scratch::new();
    let said = rehearse(&scratch, &["run", "--rehearse", "--json", "-q"], &[]);
    assert_eq!(said.status, 0, "{}", said.screen());
    assert!(
        said.stderr.starts_with("warning: tracker.registration is missing: "),
        "{}",
        said.stderr
    );
    let json = said.json();
    assert_eq!((&json["rehearsal"], &json["outcome"]), (&true.into(), &"completed".into()));
    assert!(json["off_plane_rms_mm"].as_f64().unwrap() < 1.0, "{json}");
    // The preflight is shown, but its FAIL does not stop a rehearsal.
    let checks = json["preflight"].as_array().unwrap();
    let verdict = |name: &str| {
        let check = checks.iter().find(|check| check["name"] == name);
        check.map(|check| check["verdict"].as_str().unwrap().to_owned())
    };
    assert_eq!(verdict("registration").as_deref(), Some("FAIL"), "{json}");
    assert_eq!(verdict("stage prove").as_deref(), Some("WARN"), "{json}");
    assert_eq!(verdict("insertion room").as_deref(), Some("PASS"), "{json}");
    assert!(said.stderr.contains("\nFAIL  registration "), "{}", said.stderr);
    let manifest = manifest(&scratch, &said);
    assert_eq!(manifest["rehearsal"], "nocan9");
    assert_eq!((&manifest["bus"], &manifest["tracker"]), (&"memory".into(), &"emulated".into()));
    let replayed = needle_bench(&scratch, &["replay", json["run_dir"].as_str().unwrap()]);
    assert_eq!(replayed.stdout.lines().last(), Some("identical"), "{}", replayed.screen());
    // Without --rehearse the run opens the bus.
    let said = rehearse(&scratch, &["run", "--yes", "-q"], &MEASURED);
    assert_eq!(said.status, 3, "{}", said.screen());
    assert!(said.stderr.contains("nocan9"), "{}", said.stderr);
}

#[test]
fn a_rehearsal_uses_the_calibrations_of_the_rig() {
    let scratch = Scratch::new();
    let said = rehearse(&scratch, &["run", "--rehearse", "--json", "-q"], &MEASURED);
    assert_eq!(said.status, 0, "{}", said.screen());
    // The file names no product, the stage was never proved, the calibrations are typed in, and the roll at the
    // start is unknown.
    let warned = said.stderr.lines().filter(|line| !line.starts_with(' '));
    let warned: Vec<&str> = warned.map(|line| line[..23].trim_end()).collect();
    let names = [
        "WARN  insertion drive",
        "WARN  rotation drive",
        "WARN  stage prove",
        "WARN  handedness",
        "WARN  registration",
        "WARN  tip",
        "WARN  needle",
        "WARN  start roll",
    ];
    assert_eq!(warned, names);
    let json = said.json();
    // Without the registration the tip would be 300 mm away.
    assert!(json["off_plane_rms_mm"].as_f64().unwrap() < 1.0, "{json}");
    for key in ["x_mm", "y_mm", "z_mm"] {
        assert!(json["final_error"][key].as_f64().unwrap().abs() < 1.0, "{json}");
    }
}

#[test]
fn every_operation_can_be_rehearsed() {
    let scratch = Scratch::new();
    for (operation, last) in [
        (&["home"][..], "home, at 0.000"),
        (&["jog", "--axis", "insertion", "--by", "2mm"], "from 0.000 to 2.000 mm"),
        (&["jog", "--axis", "rotation", "--by", "-10deg"], "from 0.000 to -"),
        (&["withdraw"], "from 50.000 to 0.000 mm"),
        (&["prove"], "completed"),
        (&["prove", "--handedness"], "completed"),
        (&["status"], "homed, at 0.000 mm"),
    ] {
        let command = [&["stage", "--rehearse"], operation].concat();
        let said = rehearse(&scratch, &command, &MEASURED);
        assert_eq!(said.status, 0, "{}", said.screen());
        assert!(said.stdout.contains(last), "{}", said.screen());
        // A homing ends on a switch, which must give no warning.
        assert!(!said.stderr.contains("statusword bit 11"), "{}", said.screen());
    }
    let names: Vec<String> = fs::read_dir(scratch.path().join("runs"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    assert_eq!(names.len(), 6, "{names:?}");
    assert!(names.iter().all(|name| name.contains("-rehearsal")), "{names:?}");
}

#[test]
fn a_rehearsal_refuses_a_homing_that_does_not_suit_the_rig() {
    let scratch = Scratch::new();
    let home = ["stage", "home", "--rehearse", "--axis", "insertion", "-q"];
    for method in [1, 2, 17, 18, 24, 33, 34, 35, 37] {
        // With sign -1 the switch at the withdrawn end is the drive's positive one.
        let sign =
            format!("stage.insertion.sign={}", if [2, 18, 24].contains(&method) { -1 } else { 1 });
        let method = format!("stage.insertion.homing.method={method}");
        let said = rehearse(&scratch, &home, &[&method, &sign]);
        assert_eq!(said.status, 0, "{}", said.screen());
    }
    let runs = || fs::read_dir(scratch.path().join("runs")).unwrap().count();
    let before = runs();
    let lacking = &["stage.insertion.homing.method=27"];
    let said = rehearse(&scratch, &home, lacking);
    assert_eq!((said.status, said.stdout.as_str()), (2, ""), "{}", said.screen());
    let refusal = "stage.insertion.homing.method is 27, which the emulated drives lack; they have 1, 2, 17, 18, \
                   24, 33, 34, 35, 37: rehearse with one of these (--set stage.insertion.homing.method=N)";
    assert!(said.stderr.contains(refusal), "{}", said.stderr);
    assert_eq!(runs(), before, "it began");
    // Nothing else homes that axis.
    let rotation = ["stage", "home", "--rehearse", "--axis", "rotation", "-q"];
    assert_eq!(rehearse(&scratch, &rotation, lacking).status, 0);
    // With this sign method 17 homes at the deep end.
    let said = rehearse(&scratch, &["run", "--rehearse", "-q"], &["stage.insertion.sign=-1"]);
    assert_eq!(said.status, 2, "{}", said.screen());
    let said = said.stderr.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(said.contains("60.0 mm beyond it; is it 18?"), "{said}");
}

#[test]
fn a_missing_calibration_file_is_refused_with_the_command_that_writes_it() {
    let scratch = Scratch::new();
    for (file, command) in [("registration", "registration"), ("tip", "tip")] {
        let set = format!("tracker.{file}_file=\"none.toml\"");
        let said = rehearse(&scratch, &["run", "--rehearse", "-q"], &[&set]);
        assert_eq!(said.status, 2, "{}", said.screen());
        let hint = format!("needle-bench calibrate {command} --out writes it");
        assert!(said.stderr.contains(&hint), "{}", said.stderr);
    }
}

/// The base turns once and back; both jogs record the sensor and replay.
#[test]
fn a_turn_of_the_base_calibrates_the_tip() {
    let scratch = Scratch::new();
    let words =
        ["calibrate", "tip", "turn.csv", "--run", "--rehearse", "--along-mm", "7.5", "--json"];
    let sets = [&MEASURED[..], &["tracker.gates.noise_sd_mm=0.2"]].concat();
    let config = repository("bench-config/rig-epos4.toml");
    let sets = sets.iter().flat_map(|set| ["--set", set]);
    let named: Vec<&str> = words.into_iter().chain(["--config", &config]).chain(sets).collect();
    let said = needle_bench(&scratch, &named);
    assert_eq!(said.status, 0, "{}", said.screen());
    let json = said.json();
    assert_eq!(json["rehearsal"], true);
    for (found, truth) in
        json["tracker"]["tip_offset_mm"].as_array().unwrap().iter().zip([4.0, -3.0, 7.5])
    {
        assert!((found.as_f64().unwrap() - truth).abs() < 0.7, "{json}");
    }
    let runs = fs::read_dir(scratch.path().join("runs")).unwrap();
    let runs: Vec<_> = runs.map(|run| run.unwrap().path()).collect();
    assert_eq!(runs.len(), 2, "not a jog there and one back");
    for run in runs {
        assert!(fs::read_to_string(run.join("tracker.ndjson")).unwrap().lines().count() > 400);
        let replayed = needle_bench(&scratch, &["replay", run.to_str().unwrap()]);
        assert_eq!(replayed.stdout.lines().last(), Some("identical"), "{}", replayed.screen());
    }
    assert!(!scratch.path().join("turn.csv").exists(), "its sensor is emulated");
    scratch.write("turn.csv", "of the rig");
    let said = needle_bench(&scratch, &named);
    assert_eq!(said.status, 0, "{}", said.screen());
    assert_eq!(fs::read_to_string(scratch.path().join("turn.csv")).unwrap(), "of the rig");
    // On the rig the turn would overwrite it.
    let rig: Vec<&str> = named.iter().copied().filter(|word| *word != "--rehearse").collect();
    let said = needle_bench(&scratch, &rig);
    assert_eq!(said.status, 2, "{}", said.screen());
    assert!(said.stderr.contains("turn.csv: exists"), "{}", said.stderr);
    // A turn past a limit is refused and leaves no file.
    let limits = ["--set", "stage.rotation.max_deg=300"];
    let words = [&["calibrate", "tip", "short.csv", "--run", "--rehearse"], &limits[..]].concat();
    let said = needle_bench(&scratch, &[&words[..], &["--config", &config]].concat());
    assert_eq!(said.status, 1, "{}", said.screen());
    assert!(
        said.stderr.contains("360.000 deg is over the limit of 300.000 deg"),
        "{}",
        said.stderr
    );
    assert!(!scratch.path().join("short.csv").exists());
    // From elsewhere a turn is within these limits, and so is the way back from its end.
    let limits = [
        "--set",
        "stage.rotation.min_deg=-100",
        "--set",
        "stage.rotation.max_deg=300",
        "--set",
        "emulator.rotation_start_deg=-90",
        "--set",
        MEASURED[1],
    ];
    let words = [&["calibrate", "tip", "short.csv", "--run", "--rehearse"], &limits[..]].concat();
    let said = needle_bench(&scratch, &[&words[..], &["--config", &config]].concat());
    assert_eq!(said.status, 0, "{}", said.screen());
    assert!(said.stderr.contains("from -90.000 to 270."), "{}", said.stderr);
    assert!(said.stderr.contains("from 270."), "{}", said.stderr);
    // Without a stage in the configuration nothing turns.
    let said = needle_bench(&scratch, &["calibrate", "tip", "short.csv", "--run"]);
    assert_eq!(said.status, 2, "{}", said.screen());
    assert!(said.stderr.contains("no stage is named"), "{}", said.stderr);
}

/// With zero = "start" the axis reads 0 where it starts.
#[test]
fn a_withdrawal_is_refused_past_the_soft_limit_and_made_within_it() {
    let scratch = Scratch::new();
    let start = ["--set", "stage.insertion.zero=\"start\""];
    let withdraw = [&["stage", "--virtual", "withdraw", "--by", "13.0mm"], &start[..]].concat();
    let said = needle_bench(&scratch, &withdraw);
    assert_eq!(said.status, 1, "{}", said.screen());
    let refusal = "-13.000 mm is under the limit of -1.000 mm (stage.insertion.min_mm)";
    assert!(said.stdout.contains(refusal), "{}", said.stdout);
    let limit = ["--set", "stage.insertion.min_mm=-14.0"];
    let said = needle_bench(&scratch, &[&withdraw[..], &limit].concat());
    assert_eq!(said.status, 0, "{}", said.screen());
    assert!(said.stdout.contains("from 0.000 to -13.000 mm"), "{}", said.stdout);
}

/// A sensor on the axis would not move, so the emulated one is 5 mm off it.
#[test]
fn handedness_can_be_proved_on_the_emulated_stage() {
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["stage", "--virtual", "prove", "--handedness"]);
    assert_eq!(said.status, 0, "{}", said.screen());
    assert!(said.stderr.starts_with("emulated    emulator.sensor.x_mm=5\n"), "{}", said.stderr);
    assert!(said.stderr.contains("handedness is right"), "{}", said.stderr);
    assert!(said.stderr.ends_with("this proves nothing about a rig\n"), "{}", said.stderr);
}

/// An emulated needle must not become the calibration of the rig.
#[test]
fn a_rehearsal_calibrates_nothing() {
    let scratch = Scratch::new();
    let rig = repository("bench-config/rig-epos4.toml");
    let tip = ["calibrate", "tip", "turn.csv", &rig, "--run", "--rehearse"];
    let said = needle_bench(&scratch, &[&tip[..], &["--out", "tip.toml"]].concat());
    assert_eq!(said.status, 2, "{}", said.screen());
    assert!(said.stderr.contains("--rehearse writes no calibration"), "{}", said.stderr);
    assert_eq!(fs::read_dir(scratch.path()).unwrap().count(), 0, "nothing turned");

    let said = needle_bench(&scratch, &[&tip[..], &["--set", MEASURED[1]]].concat());
    assert_eq!((said.status, said.stdout.as_str()), (0, ""), "{}", said.screen());
    assert!(said.stderr.contains("rehearsal   emulated drives and tracker"), "{}", said.stderr);
    assert!(!scratch.path().join("turn.csv").exists());

    let short = ["insertion.depth_mm=10"];
    let said = rehearse(&scratch, &["run", "--rehearse", "--json", "-q"], &short);
    let run = said.json()["run_dir"].as_str().unwrap().to_owned();
    let said = needle_bench(&scratch, &["calibrate", "needle", &run]);
    assert_eq!((said.status, said.stdout.as_str()), (2, ""), "{}", said.screen());
    assert!(said.stderr.contains(&format!("{run}: a rehearsal")), "{}", said.stderr);
}

/// The three runs have a sensor of six degrees of freedom and a needle whose curvature the configuration does
/// not have.
#[test]
fn rehearsed_runs_calibrate_the_needle_and_the_file_is_used() {
    let scratch = Scratch::new();
    let needle = ["emulator.curvature_per_mm=0.0095", "emulator.noise={ sd_mm = 0.05 }"];
    let sensor = "tracker.tip_offset_mm=[0.5, 0.0, 0.0]";
    let mut runs = Vec::new();
    for start in ["1.0", "-0.5", "0.4"] {
        let start = format!("emulator.start.x_mm={start}");
        let sets = [&needle[..], &[sensor, &start, "tracker.gates.noise_sd_mm=0.1"]].concat();
        let said = rehearse(&scratch, &["run", "--rehearse", "--json", "-q"], &sets);
        assert_eq!(said.status, 0, "{}", said.screen());
        let run = said.json()["run_dir"].as_str().unwrap().to_owned();
        // As the record of a run on the rig: that of a rehearsal is refused.
        let dir = scratch.path().join(&run);
        let manifest = RunFolder::open(&dir).unwrap().manifest;
        write_manifest(&dir, &Manifest { rehearsal: None, ..manifest }).unwrap();
        runs.push(run);
    }
    let runs: Vec<&str> = runs.iter().map(String::as_str).collect();
    let out = ["--json", "--out", "needle.toml"];
    let found = needle_bench(&scratch, &[&["calibrate", "needle"], &runs[..], &out].concat());
    assert_eq!(found.status, 0, "{}", found.screen());
    let curvature = found.json()["needle"]["curvature_per_mm"].as_f64().unwrap();
    assert!((curvature - 0.0095).abs() < 5e-4, "{curvature}");
    let rig = fs::read_to_string(repository("bench-config/rig-epos4.toml")).unwrap();
    let both = rig.replace("[needle]\n", "[needle]\nneedle_file = \"needle.toml\"\n");
    scratch.write("both.toml", &both);
    let named = both.lines().filter(|line| !line.starts_with("radius_mm")).collect::<Vec<_>>();
    scratch.write("rig.toml", &named.join("\n"));
    let said = needle_bench(&scratch, &["run", "both.toml", "--rehearse"]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("is given along with needle.radius_mm"), "{}", said.stderr);
    let said = needle_bench(&scratch, &["run", "rig.toml", "--rehearse", "--json", "-q"]);
    let used = fs::read_to_string(said.run_dir(&scratch).join("config.toml")).unwrap();
    assert!(used.contains(&format!("curvature_per_mm = {curvature}")), "{used}");
    let scored = needle_bench(&scratch, &["evaluate", "--config", "rig.toml", runs[0], "--json"]);
    assert_eq!(scored.status, 0, "{}", scored.screen());
}

/// The tests find a command of docs/rig.md only at the beginning of a line.
#[test]
fn every_command_of_the_protocol_is_on_a_line_of_its_own() {
    let page = fs::read_to_string(repository("docs/rig.md")).unwrap();
    let is_inside =
        |line: &&str| line.contains("`needle-bench ") || line.contains(" needle-bench ");
    let inside: Vec<&str> = page.lines().filter(is_inside).collect();
    assert_eq!(inside, [] as [&str; 0], "no test runs these commands");
    assert_eq!(page.matches("\nneedle-bench ").count(), protocol::commands().len());
}

/// Rehearses each command of docs/rig.md that can be rehearsed on the worked example. The live test runs those
/// that need a rig.
#[test]
fn every_command_of_the_protocol_is_accepted() {
    let scratch = Scratch::new();
    fs::copy(repository("bench-config/rig-epos4.toml"), scratch.path().join("my-rig.toml"))
        .unwrap();
    let (mut rehearsed, mut understood) = (Vec::new(), Vec::new());
    for (line, words) in protocol::commands() {
        let mut words: Vec<&str> = words.iter().map(String::as_str).collect();
        let has_terminal = line.contains("--console");
        if (words[0] == "run" || words[0] == "stage") && !has_terminal {
            if !protocol::is_without_rig(&line) {
                words.push("--rehearse");
            }
            let said = needle_bench(&scratch, &words);
            // The page shows a run that a scripted emergency stop ends.
            let expected = i32::from(line.contains("emergency-stop"));
            assert_eq!(said.status, expected, "{}", said.screen());
            rehearsed.push(line);
        } else {
            // These fail without a rig or the operator's files, but are not bad usage.
            if line.starts_with("tracker watch") {
                words.extend(["--seconds", "1"]);
            }
            let said = needle_bench(&scratch, &words);
            assert!(!said.stderr.contains("Usage:"), "{}", said.screen());
            understood.push(line);
        }
    }
    assert_eq!((rehearsed.len(), understood.len()), (15, 13), "{rehearsed:#?} {understood:#?}");
}

/// Nothing is recorded of an operation that never begins.
#[test]
fn an_axis_without_homing_is_refused_before_a_record_is_made() {
    let scratch = Scratch::new();
    let rig = fs::read_to_string(repository("bench-config/rig-epos4.toml")).unwrap();
    let homing = rig.find("\n[stage.rotation.homing]").expect("the rig's");
    let after = homing + rig[homing..].find("[[stage.rotation.sdo]]").expect("the next");
    let absolute = [&rig[..homing], &rig[after..]].concat();
    let file = scratch.write("absolute.toml", &absolute);
    let file = file.to_str().expect("UTF-8");
    let sets = ["--set", "stage.rotation.reference=absolute", "--set", "record.dir=runs"];
    let stage = ["stage", "--rehearse", "--config", file];
    let said =
        needle_bench(&scratch, &[&stage[..], &sets, &["home", "--axis", "rotation"]].concat());
    assert_eq!(said.status, 2, "{}", said.screen());
    assert!(
        said.stderr.ends_with("rotation: no homing is configured (stage.rotation.homing)\n"),
        "{}",
        said.stderr
    );
    assert!(!scratch.path().join("runs").exists(), "{}", said.screen());
}

/// A drive that has restarted with the needle in has lost its home. The needle comes out all the same.
#[test]
fn a_needle_is_withdrawn_although_its_drive_is_not_homed() {
    let scratch = Scratch::new();
    let rig = repository("bench-config/rig-epos4.toml");
    let withdraw = ["stage", "withdraw", &rig, "--rehearse", "-q"];
    let lost = ["--set", "emulator.homed=false", "--set", "emulator.insertion_start_mm=15"];
    let said = needle_bench(&scratch, &[&withdraw[..], &lost].concat());
    assert_eq!(said.status, 1, "{}{}", said.stdout, said.stderr);
    assert!(said.stdout.contains("needle in: withdraw --by DEPTH --unhomed; "), "{}", said.stdout);
    let by = ["--by", "12mm", "--unhomed", "--json"];
    let said = needle_bench(&scratch, &[&withdraw[..], &lost, &by].concat());
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    let to_mm = said.json()["axes"][0]["to_mm"].as_f64().unwrap();
    assert!((to_mm + 12.0).abs() < 1e-3, "{to_mm}");
    let homed = needle_bench(&scratch, &[&withdraw[..], &lost[2..], &by].concat());
    assert_eq!(homed.status, 1, "{}{}", homed.stdout, homed.stderr);
    assert!(homed.stdout.contains("homed: withdraw it without --unhomed"), "{}", homed.stdout);
    let said = needle_bench(&scratch, &["replay", said.run_dir(&scratch).to_str().unwrap()]);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
}
