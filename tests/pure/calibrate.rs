//! `needle-bench calibrate`, the use of its results, and the presets of the emulated tracker.

use crate::support::program::{Said, Scratch, needle_bench, refusals, repository};
use std::fmt::Write as _;
use std::path::PathBuf;

const FIDUCIALS: &str = "x_tracker_mm,y_tracker_mm,z_tracker_mm,x_bench_mm,y_bench_mm,z_bench_mm\n";
/// The fiducials on the bench, mm.
const POINTS_MM: [[f64; 3]; 6] = [
    [-60.0, -60.0, 0.0],
    [60.0, -60.0, 0.0],
    [60.0, 60.0, 0.0],
    [-60.0, 60.0, 0.0],
    [-40.0, 0.0, 120.0],
    [40.0, 0.0, 120.0],
];

/// The fiducials as a tracker at (100, −50, 20), turned by 90° about z, sees them, with errors of at most
/// `error_mm`.
fn fiducials(error_mm: f64) -> String {
    let mut csv = FIDUCIALS.to_owned();
    for (n, [x, y, z]) in (0i32..).zip(POINTS_MM) {
        let error_mm = error_mm * f64::from((n * 5 + 3) % 7 - 3) / 3.0;
        let (tx, ty, tz) = (y + 50.0 + error_mm, 100.0 - x - error_mm, z - 20.0 + error_mm);
        writeln!(csv, "{tx},{ty},{tz},{x},{y},{z}").unwrap();
    }
    csv
}

/// A sensor 1.2 mm off the needle's axis, along its own x, while the base turns once.
fn turning(columns: usize) -> String {
    let header = ["rotation_rad", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"];
    let mut csv = header[..columns].join(",") + "\n";
    for n in 0..90u32 {
        let angle = std::f64::consts::TAU * f64::from(n) / 90.0;
        let (x, y) = (30.0 + 1.2 * angle.cos(), 40.0 + 1.2 * angle.sin());
        let row = [angle, x, y, 50.0, (0.5 * angle).cos(), 0.0, 0.0, (0.5 * angle).sin()];
        let row: Vec<String> = row[..columns].iter().map(f64::to_string).collect();
        csv += &(row.join(",") + "\n");
    }
    csv
}

fn calibrate(scratch: &Scratch, arguments: &[&str]) -> Said {
    needle_bench(scratch, &[&["calibrate"], arguments].concat())
}

/// The configuration that `check --print` gives with these arguments.
fn printed(scratch: &Scratch, arguments: &[&str]) -> toml::Table {
    let said = needle_bench(scratch, &[&["check", "--print"], arguments].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    said.stdout.parse().expect("TOML")
}

fn number(config: &toml::Table, path: &str) -> f64 {
    let (tables, key) = path.rsplit_once('.').expect("a key in a table");
    let table = tables.split('.').fold(config, |table, name| table[name].as_table().expect(name));
    table[key].as_float().unwrap_or_else(|| panic!("{path} is {:?}", table[key]))
}

/// The record of the run has the pose, its error and its origin, so it repeats the run without the file.
#[test]
fn a_registration_is_computed_used_from_its_file_and_recorded() {
    let scratch = Scratch::new();
    scratch.write("points.csv", &fiducials(0.3));
    let said = calibrate(&scratch, &["registration", "points.csv", "--out", "registration.toml"]);
    assert_eq!((said.status, said.stdout.as_str()), (0, ""), "{}", said.stderr);
    assert!(said.stderr.starts_with("registration: 6 points, 0."), "{}", said.stderr);

    let folder = scratch.path().join("rig");
    std::fs::create_dir(&folder).unwrap();
    std::fs::rename(scratch.path().join("registration.toml"), folder.join("r.toml")).unwrap();
    std::fs::write(folder.join("rig.toml"), "tracker.registration_file = \"r.toml\"").unwrap();
    let config = printed(&scratch, &["rig/rig.toml"]);
    for (key, expected, tolerance) in
        [("x_mm", 100.0, 0.5), ("y_mm", -50.0, 0.5), ("z_mm", 20.0, 0.5), ("roll_deg", 90.0, 0.5)]
    {
        let found = number(&config, &format!("tracker.registration.{key}"));
        assert!((found - expected).abs() < tolerance, "{key} = {found}");
    }
    let sd_mm = number(&config, "tracker.registration.sd_mm");
    assert!((0.05..1.0).contains(&sd_mm), "{sd_mm}");
    let fit = &config["tracker"]["registration"]["fit"];
    assert_eq!(fit.get("tip_offset_mm"), None, "no configuration was given");
    assert_eq!(fit["file"].as_str(), Some("points.csv"));
    assert_eq!(fit["sha256"].as_str().map(str::len), Some(64));
    assert_eq!(fit["fiducials"].as_array().map(Vec::len), Some(6));
    assert!(fit["date_utc"].as_str().is_some_and(|date| date.ends_with('Z')));

    let run = [
        "run",
        "rig/rig.toml",
        "--json",
        "-q",
        "--set",
        "insertion={ depth_mm = 20, plane_out_of_reach = \"insert\" }",
    ];
    let said = needle_bench(&scratch, &run);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let dir = said.run_dir(&scratch);
    let config = std::fs::read_to_string(dir.join("config.toml")).unwrap();
    assert!(config.contains("[tracker.registration.fit]") && !config.contains("registration_file"));
    std::fs::remove_file(folder.join("r.toml")).unwrap();
    let again =
        needle_bench(&scratch, &["run", dir.join("config.toml").to_str().unwrap(), "--json"]);
    let steps = |dir: PathBuf| std::fs::read_to_string(dir.join("steps.csv")).unwrap();
    assert_eq!(steps(dir), steps(again.run_dir(&scratch)));
}

/// They may be those that the bench collected before the tip was calibrated, or those of a probe.
#[test]
fn a_registration_of_a_file_does_not_say_with_which_tip_its_points_were_touched() {
    let scratch = Scratch::new();
    scratch.write("points.csv", &fiducials(0.3));
    scratch.write("rig.toml", "tracker.tip_offset_mm = [-3.0, 0.0, 7.0]");
    let said = calibrate(&scratch, &["registration", "points.csv", "rig.toml", "--json"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let fit = &said.json()["registration"]["fit"];
    assert!(fit.get("tip_offset_mm").is_none() && fit.get("tool").is_none(), "{fit}");
}

#[test]
fn a_collection_without_a_tip_on_hardware_is_warned_about() {
    let scratch = Scratch::new();
    let rig = repository("bench-config/rig-epos4.toml");
    let collect = |more: &[&str]| {
        // It ends before a point is asked for: the operator's lines cannot come from there too.
        let source = "tracker={ source = \"ndjson\", address = \"-\" }";
        let common = ["registration", "points.csv", &*rig, "--collect", "--set", source];
        let said = calibrate(&scratch, &[&common, more].concat());
        assert_eq!(said.status, 2, "{}", said.stderr);
        said.stderr
            .contains("warning: without tracker.tip_offset_mm each point is where the sensor")
    };
    assert!(collect(&[]));
    assert!(!collect(&["--set", "tracker.tip_offset_mm=[0.0, 0.0, 7.0]"]));
}

#[test]
fn fiducials_in_the_configuration_give_the_same_run_as_the_file() {
    let scratch = Scratch::new();
    let csv = fiducials(0.3);
    let mut config = String::new();
    for row in csv.lines().skip(1) {
        let (tracker, bench) = row.split_at(row.match_indices(',').nth(2).unwrap().0);
        let bench = &bench[1..];
        writeln!(
            config,
            "[[tracker.registration.fiducials]]\ntracker_mm = [{tracker}]\nbench_mm = [{bench}]"
        )
        .unwrap();
    }
    scratch.write("rig.toml", &config);
    scratch.write("points.csv", &csv);
    // The error of the pose in the file depends on the depth.
    let depth = "insertion={ depth_mm = 10, plane_out_of_reach = \"insert\" }";
    let written = ["registration", "points.csv", "--out", "r.toml", "--set", depth];
    assert_eq!(calibrate(&scratch, &written).status, 0);
    let steps = |arguments: &[&str]| {
        let common = ["run", "--json", "-q", "--set", depth];
        let said = needle_bench(&scratch, &[&common, arguments].concat());
        assert_eq!(said.status, 0, "{}", said.stderr);
        let text = std::fs::read_to_string(said.run_dir(&scratch).join("steps.csv")).unwrap();
        let last = text.lines().last().unwrap().to_owned();
        last.split(',').filter_map(|field| field.parse().ok()).collect::<Vec<f64>>()
    };
    let inline = steps(&["rig.toml"]);
    let from_file = steps(&["--set", "tracker.registration_file=r.toml"]);
    assert_eq!(inline.len(), from_file.len());
    for (inline, from_file) in inline.iter().zip(&from_file) {
        assert!((inline - from_file).abs() < 1e-6, "{inline} {from_file}");
    }
}

#[test]
fn bad_fiducials_are_refused_with_what_to_do() {
    let scratch = Scratch::new();
    let mut off = fiducials(0.0);
    off = off.replace("\n-10,160,-20,", "\n-10,160,-14,");
    let mut screens = String::new();
    for csv in [
        off.as_str(),
        &fiducials(0.0).lines().take(3).collect::<Vec<_>>().join("\n"),
        &format!("{FIDUCIALS}1,2,3,4,5,x\n"),
        "x,y,z\n1,2,3\n",
    ] {
        scratch.write("points.csv", csv);
        let command = ["calibrate", "registration", "points.csv", "--json"];
        screens += &refusals(&scratch, &[&command]);
    }
    let fiducials = "tracker.registration.fiducials=[{tracker_mm=[0,0,0],bench_mm=[0,0,0]}]";
    let and_a_pose = "tracker.registration.x_mm=1";
    screens += &refusals(
        &scratch,
        &[
            &["calibrate", "registration", "points.csv", "--rms-max-mm", "nan"],
            &["run", "--set", fiducials],
            &["run", "--set", fiducials, "--set", and_a_pose],
        ],
    );
    insta::assert_snapshot!(screens);
}

#[test]
fn a_calibration_is_not_overwritten() {
    let scratch = Scratch::new();
    scratch.write("points.csv", &fiducials(0.0));
    scratch.write("registration.toml", "kept");
    let over = ["calibrate", "registration", "points.csv", "--out", "registration.toml"];
    insta::assert_snapshot!(refusals(&scratch, &[&over]));
    let kept = std::fs::read_to_string(scratch.path().join("registration.toml")).unwrap();
    assert_eq!(kept, "kept");
}

#[test]
fn a_file_that_is_not_a_calibration_is_refused_with_file_and_line() {
    let scratch = Scratch::new();
    let mut screens = String::new();
    for text in [
        "name = \"x\"\n[tracker.registration]\nx_mm = 1.0\n",
        "",
        "[tracker.registration]\nx_mm = 1.0\n",
    ] {
        scratch.write("r.toml", text);
        let named = ["check", "--set", "tracker.registration_file=r.toml"];
        screens += &(text.to_owned() + &refusals(&scratch, &[&named]));
    }
    let both = "[tracker]\nregistration_file = \"r.toml\"\nregistration = { x_mm = 0.0 }";
    scratch.write("rig.toml", both);
    let absent = ["check", "--set", "tracker.registration_file=absent.toml"];
    screens += &refusals(&scratch, &[&absent, &["check", "rig.toml"]]);
    insta::assert_snapshot!(screens);
}

#[test]
fn the_tip_on_the_sensor_is_computed_and_used() {
    let scratch = Scratch::new();
    scratch.write("turn.csv", &turning(8));
    let arguments = ["tip", "turn.csv", "--along-mm", "7", "--out", "tip.toml"];
    let said = calibrate(&scratch, &arguments);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert!(said.stderr.contains("1.200 mm off the needle's axis"), "{}", said.stderr);
    let config = printed(&scratch, &["--set", "tracker.tip_file=tip.toml"]);
    let offset_mm: Vec<f64> = config["tracker"]["tip_offset_mm"]
        .as_array()
        .unwrap()
        .iter()
        .map(|coordinate| coordinate.as_float().unwrap())
        .collect();
    for (found, expected) in offset_mm.iter().zip([-1.2, 0.0, 7.0]) {
        assert!((found - expected).abs() < 1e-9, "{offset_mm:?}");
    }
    assert!(number(&config, "tracker.tip_tilt.pitch_deg").abs() < 1e-6);
    assert_eq!(config["tracker"]["tip_fit"]["points"].as_integer(), Some(90));
    // The limit is that of a recording made with --run and the same configuration.
    let set = ["--set", "tracker.gates.noise_sd_mm=0.8"];
    let said = calibrate(&scratch, &[&["tip", "turn.csv", "--json"], &set[..]].concat());
    assert!(said.stderr.contains("RMS off a circle (limit 1.60)"), "{}", said.stderr);
}

/// The turn does not show it, and a run cannot notice it.
#[test]
fn the_distance_of_the_tip_ahead_of_the_sensor_is_asked_for() {
    let scratch = Scratch::new();
    scratch.write("turn.csv", &turning(8));
    let of = |more: &[&str]| calibrate(&scratch, &[&["tip", "turn.csv"], more].concat());
    let given = of(&["--along-mm", "7"]);
    assert_eq!(given.status, 0, "{}", given.stderr);
    let said = "the tip is 7.00 mm ahead of the sensor, along the needle";
    assert!(given.stderr.contains(said) && !given.stderr.contains("warning"), "{}", given.stderr);
    let forgotten = of(&[]);
    assert_eq!(forgotten.status, 0, "{}", forgotten.stderr);
    let said = "warning: the tip is taken to be level with the sensor";
    assert!(forgotten.stderr.contains(said), "{}", forgotten.stderr);
    assert!(forgotten.stderr.contains("the tip is 0.00 mm ahead"), "{}", forgotten.stderr);
    let behind = of(&["--along-mm", "-7"]);
    assert_eq!(behind.status, 2, "{}", behind.stderr);
    let said = "--along-mm is -7 mm (at least 0): a sensor is not ahead of its own tip";
    assert!(behind.stderr.contains(said), "{}", behind.stderr);
}

/// A tenth of the offset would be subtracted.
#[test]
fn a_turn_with_less_noise_than_the_tracker_has_is_warned_about() {
    let scratch = Scratch::new();
    // Off the circle by 0.05 mm RMS, along the needle.
    let off = |(n, line): (usize, &str)| match n {
        0 => format!("{line}\n"),
        _ => line.replace(",50,", if n.is_multiple_of(2) { ",50.05," } else { ",49.95," }) + "\n",
    };
    scratch.write("turn.csv", &turning(8).lines().enumerate().map(off).collect::<String>());
    let is_warned = |noise_mm: Option<&str>| {
        let noise = noise_mm.map(|mm| {
            format!("tracker.noise={{ white_sd_mm = {mm}, correlated_sd_mm = 0.0, correlation_time_s = 0.0 }}")
        });
        let mut arguments = vec!["tip", "turn.csv", "--along-mm", "7"];
        arguments.extend(noise.iter().flat_map(|noise| ["--set", noise]));
        let said = calibrate(&scratch, &arguments);
        assert_eq!(said.status, 0, "{}", said.stderr);
        said.stderr.contains("(a quarter needed): are they in cm or inches, or smoothed?")
    };
    assert!(!is_warned(None), "not without a measured noise");
    // A quarter of sqrt(2) times 0.14 mm is 0.0495 mm, of 0.143 mm it is 0.0506 mm.
    assert!(!is_warned(Some("0.14")));
    assert!(is_warned(Some("0.143")));
}

/// A run could not apply such an offset, so the result is 0.
#[test]
fn without_orientations_the_tip_offset_is_reported_but_not_corrected() {
    let scratch = Scratch::new();
    scratch.write("turn.csv", &turning(4));
    let said = calibrate(&scratch, &["tip", "turn.csv"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert!(said.stderr.contains("expect an error of 1.200 mm"), "{}", said.stderr);
    assert!(said.stdout.contains("tip_offset_mm = [0.0, 0.0, 0.0]"), "{}", said.stdout);
    let mut screens = refusals(&scratch, &[&["calibrate", "tip", "turn.csv", "--along-mm", "7"]]);
    scratch.write("turn.csv", &turning(4).lines().take(20).collect::<Vec<_>>().join("\n"));
    screens += &refusals(&scratch, &[&["calibrate", "tip", "turn.csv", "--json"]]);
    insta::assert_snapshot!(screens);
}

#[test]
fn given_settings_override_a_preset_of_the_emulated_tracker() {
    let scratch = Scratch::new();
    let config = printed(&scratch, &["--set", "emulator.tracker=ultrasound"]);
    assert_eq!(number(&config, "emulator.noise.sd_mm"), 0.94);
    assert_eq!(number(&config, "emulator.tracker_latency_ms"), 175.0);
    assert_eq!(config["emulator"]["tracker_repeats"].as_integer(), Some(4));
    let sets = ["--set", "emulator.noise.uniform_mm=0.5", "--set", "emulator.tracker=ultrasound"];
    let config = printed(&scratch, &sets);
    assert_eq!(number(&config, "emulator.noise.uniform_mm"), 0.5);
    assert!(!config["emulator"]["noise"].as_table().unwrap().contains_key("sd_mm"));
    let unknown = ["check", "--set", "emulator.tracker=sonar"];
    insta::assert_snapshot!(refusals(&scratch, &[&unknown]));
}

/// The bench knows the preset's kind, latency and noise.
#[test]
fn a_run_completes_with_every_tracker_preset() {
    let scratch = Scratch::new();
    for (preset, kind, latency_ms, noise_sd_mm) in [
        ("electromagnetic-near", "electromagnetic", 10, 0.05),
        ("electromagnetic-far", "electromagnetic", 10, 0.2),
        ("ultrasound", "imaging", 175, 0.94),
        ("stereo-camera", "imaging", 33, 0.6),
    ] {
        let sets = [
            format!("emulator.tracker={preset}"),
            format!("tracker.kind={kind}"),
            format!("tracker.latency_ms={latency_ms}"),
            format!("tracker.gates.noise_sd_mm={noise_sd_mm}"),
            format!("observer.invariant.position_sd_mm={noise_sd_mm}"),
            "insertion={ depth_mm = 20, plane_out_of_reach = \"insert\" }".to_owned(),
        ];
        let mut arguments = vec!["run", "--json", "-q"];
        sets.iter().for_each(|set| arguments.extend(["--set", set]));
        let said = needle_bench(&scratch, &arguments);
        assert_eq!(said.status, 0, "{preset}: {}", said.stderr);
    }
}
