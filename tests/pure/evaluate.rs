//! `needle-bench evaluate` over synthetic recordings, and over real ones if `NEEDLE_DATA` has them.

use crate::support::needed::data;
use crate::support::program::{Scratch, needle_bench, refusals};
use crate::support::recording;
use needle_bench::needle::{Needle, Torsion, TorsionConfig};

/// A torsion-free needle of radius 80 mm, its sensor in line with its tip.
fn recording() -> String {
    let needle = Needle::new(0.0125).unwrap();
    recording::recording(needle, &Torsion::default(), |n| 0.02 * (f64::from(n) * 0.02).sin())
}

const IN_LINE: [&str; 4] =
    ["--set", "evaluation.axis=[0,0,1]", "--set", "evaluation.bend_axis=[1,0,0]"];
/// The true parameters of that needle.
const RIGID: [&str; 8] = [
    "--set",
    "needle.curvature_per_mm=0.0125",
    "--set",
    "needle.tip_ahead_mm=0",
    "--set",
    "needle.torsion={offset_deg=0,creep_mm=0,creep_mm_per_mm=0}",
    "--set",
    "observer.invariant.torsion_search_deg_per_mm=0",
];

#[test]
fn a_needle_without_torsion_is_followed_by_all_observers() {
    let scratch = Scratch::new();
    scratch.write("a.csv", &recording());
    scratch.write("b.csv", recording().trim_end().rsplit_once('\n').unwrap().0);
    let mut arguments = vec!["evaluate", "a.csv", "b.csv", "--json"];
    arguments.extend(IN_LINE);
    arguments.extend(RIGID);
    // The finite differences need some distance between two positions.
    arguments.extend(["--set", "observer.samples=\"one-per-step\""]);
    arguments.extend(["--set", "observer.finite_difference.baseline_mm=2"]);
    let said = needle_bench(&scratch, &arguments);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let json = said.json();
    assert_eq!(json["observer"], "invariant");
    let observers = json["observers"].as_array().unwrap();
    assert_eq!(observers.len(), 3);
    for observer in observers {
        assert!(observer["roll_rms_deg"]["median"].as_f64().unwrap() < 2.0, "{observer}");
        assert!(observer["roll_rms_deg"]["p90"].is_f64());
        // The prediction is scored. It is exact for observers that start from the truth, and not for finite
        // differences.
        let position_mm = observer["position_rms_mm"].as_f64().unwrap();
        let exact = position_mm < 1e-9;
        assert_eq!(exact, observer["observer"] != "finite-difference", "{observer}");
        assert!(position_mm < 0.05, "{position_mm}");
        let ahead_mm = observer["prediction_5mm_rms_mm"].as_f64().unwrap();
        assert!(ahead_mm < 0.2, "{ahead_mm}");
        let files = observer["files"].as_array().unwrap();
        assert_eq!(files.len(), 2);
        assert_eq!(files[0]["file"], "a.csv");
    }
}

/// The recorded orientation is for scoring only: the estimate is the same without it.
#[test]
fn the_observers_never_see_the_recorded_orientation() {
    let scratch = Scratch::new();
    let with = recording();
    let without: String = with
        .lines()
        .map(|l| l.splitn(6, ',').take(5).collect::<Vec<_>>().join(",") + "\n")
        .collect();
    scratch.write("with.csv", &with);
    scratch.write("without.csv", &without);
    let evaluate = |file| {
        let mut arguments = vec!["evaluate", file, "--json"];
        arguments.extend(IN_LINE);
        needle_bench(&scratch, &arguments).json()
    };
    let (with, without) = (evaluate("with.csv"), evaluate("without.csv"));
    assert!(with["position_rms_mm"].is_f64() && with["roll_rms_deg"]["median"].is_f64(), "{with}");
    assert_eq!(with["position_rms_mm"], without["position_rms_mm"]);
    assert!(without["roll_rms_deg"]["median"].is_null());
}

/// The base turns by up to 115 degrees.
#[test]
fn no_roll_is_scored_against_headings_after_a_small_turn() {
    let scratch = Scratch::new();
    scratch.write("posed.csv", &recording());
    scratch.write("heading.csv", &recording::heading_only(&recording()));
    let evaluate = |file| {
        let mut arguments = vec!["evaluate", file, "--json"];
        arguments.extend(IN_LINE);
        needle_bench(&scratch, &arguments)
    };
    let (posed, heading) = (evaluate("posed.csv"), evaluate("heading.csv"));
    assert!(posed.json()["roll_rms_deg"]["median"].is_f64(), "{}", posed.stdout);
    assert!(heading.json()["roll_rms_deg"]["median"].is_null(), "{}", heading.stdout);
    let warning = "warning: heading.csv: no roll is scored: the base turned by only 115 deg, so the orientations do \
                   not show whether they turn with it";
    assert!(heading.stderr.contains(warning), "{}", heading.stderr);
    assert!(!posed.stderr.contains("no roll is scored"), "{}", posed.stderr);
}

#[test]
fn a_position_that_is_not_finite_is_refused_with_its_line() {
    let scratch = Scratch::new();
    scratch.write("bad.csv", "insertion_mm,rotation_rad,x_mm,y_mm,z_mm\n0,0,0,0,inf\n");
    insta::assert_snapshot!(refusals(&scratch, &[&["evaluate", "bad.csv"]]));
}

/// A recording without orientations has no roll: the medians of the roll name how many have it.
#[test]
fn a_median_of_fewer_recordings_names_their_number() {
    let scratch = Scratch::new();
    let plain: String = recording()
        .lines()
        .map(|line| line.splitn(6, ',').take(5).collect::<Vec<_>>().join(",") + "\n")
        .collect();
    scratch.write("plain.csv", plain.rsplit_once("\n59").unwrap().0);
    scratch.write("posed.csv", &recording());
    let files = ["evaluate", "plain.csv", "posed.csv", "--set", "observer.shadows=[]"];
    let said = needle_bench(&scratch, &files);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert!(said.stdout.contains(" deg median (1 of 2), "), "{}", said.stdout);
    assert!(!said.stdout.contains("mm (2 of 2)"), "{}", said.stdout);
    let json = needle_bench(&scratch, &[&files[..], &["--json"]].concat()).json();
    assert_eq!(json["roll_rms_deg"]["insertions"], 1);
    assert_eq!(json["position_insertions"], 2);
}

/// The tip travels a thousandth of the depth, or stands still in the second half.
#[test]
fn positions_that_contradict_the_insertion_are_refused() {
    let scratch = Scratch::new();
    let changed = |change: &dyn Fn(usize, &str) -> String| -> String {
        let text = recording();
        let (header, rows) = text.split_once('\n').unwrap();
        let rows = rows.lines().enumerate().map(|(row, line)| change(row, line) + "\n");
        format!("{header}\n{}", rows.collect::<String>())
    };
    let metres = |_: usize, line: &str| {
        let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
        for cell in &mut cells[2..5] {
            *cell = (1e-3 * cell.parse::<f64>().unwrap()).to_string();
        }
        cells.join(",")
    };
    let middle = recording().lines().nth(301).unwrap().to_owned();
    let frozen = |row: usize, line: &str| {
        let base: Vec<&str> = line.splitn(3, ',').take(2).collect();
        let still = middle.splitn(3, ',').nth(2).unwrap();
        if row < 300 { line.to_owned() } else { format!("{},{still}", base.join(",")) }
    };
    scratch.write("metres.csv", &changed(&metres));
    scratch.write("frozen.csv", &changed(&frozen));
    let commands: [&[&str]; 3] = [
        &["evaluate", "metres.csv"],
        &["evaluate", "frozen.csv"],
        &["calibrate", "needle", "metres.csv"],
    ];
    insta::assert_snapshot!(refusals(&scratch, &commands));
}

/// Counted twice, a recording would make the figures look more certain than they are.
#[test]
fn a_recording_given_twice_is_refused() {
    let scratch = Scratch::new();
    scratch.write("a.csv", &recording());
    scratch.write("copy.csv", &recording().replacen('\n', "\n\n", 1));
    let said =
        refusals(&scratch, &[&["evaluate", "a.csv", "a.csv"], &["evaluate", "a.csv", "copy.csv"]]);
    insta::assert_snapshot!(said);
}

#[test]
fn unreadable_files_are_refused_with_their_names() {
    let scratch = Scratch::new();
    std::fs::create_dir(scratch.path().join("folder")).unwrap();
    std::fs::write(scratch.path().join("binary"), [0xFF, 0xFE, 0x00]).unwrap();
    let files = ["absent.csv", "folder", "binary"].map(|name| ["evaluate", name]);
    insta::assert_snapshot!(refusals(&scratch, &files.each_ref().map(|command| &command[..])));
}

/// Such a number must not make `evaluate` hang.
#[test]
fn huge_numbers_are_refused_with_the_line() {
    let scratch = Scratch::new();
    let header = "insertion_mm,rotation_rad,x_mm,y_mm,z_mm";
    let mut screens = String::new();
    for row in ["1e308,0,0,0,1", "1,1e308,0,0,1", "1,0,1e308,0,1"] {
        scratch.write("huge.csv", &format!("{header}\n0,0,0,0,0\n{row}\n2,0,0,0,2\n"));
        screens += &refusals(&scratch, &[&["evaluate", "huge.csv"]]);
    }
    insta::assert_snapshot!(screens);
}

#[test]
fn an_insertion_too_short_to_score_is_refused_with_its_depth() {
    let scratch = Scratch::new();
    let header = "insertion_mm,rotation_rad,x_mm,y_mm,z_mm";
    scratch.write("short.csv", &format!("{header}\n0,0,0,0,0\n1,0,0,0,1\n3.25,0,0,0,3.25\n"));
    insta::assert_snapshot!(refusals(&scratch, &[&["evaluate", "short.csv"]]));
    let set = ["evaluate", "short.csv", "--set", "evaluation.score_after_mm=1"];
    assert_eq!(needle_bench(&scratch, &set).status, 0);
}

#[test]
fn a_byte_order_mark_is_ignored() {
    let scratch = Scratch::new();
    scratch.write("bom.csv", &format!("\u{feff}{}", recording()));
    let said = needle_bench(&scratch, &["evaluate", "bom.csv"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
}

/// A needle as in bench-config/recordings.toml, evaluated with the roll at the start known and unknown.
#[test]
fn an_unknown_roll_at_the_start_is_estimated() {
    let needle = Needle::new(0.0129).unwrap().with_tip_ahead(6.6).unwrap();
    let creeping = TorsionConfig {
        offset_rad: 30.4f64.to_radians(),
        creep_mm: 0.755,
        creep_mm_per_mm: 0.0057,
        ..TorsionConfig::default()
    };
    let torsion = Torsion::new(creeping).unwrap();
    let scratch = Scratch::new();
    let csv = recording::recording(needle, &torsion, recording::to_and_fro(4));
    scratch.write("a.csv", &csv);
    let mut arguments = vec!["evaluate", "a.csv", "--json"];
    arguments.extend(IN_LINE);
    let json = needle_bench(&scratch, &arguments).json();
    assert!(json["roll_rms_deg"]["median"].as_f64().unwrap() < 1.0, "{json}");
    assert!(json["roll_unknown_rms_deg"]["median"].as_f64().unwrap() < 10.0, "{json}");
    // The finite differences use no start.
    assert!(json["observers"][2]["roll_unknown_rms_deg"]["median"].is_null());
}

/// Insertions of a real needle, recorded by others (`$NEEDLE_DATA/steered-insertions`). The paper's observers
/// do not model torsion and are poor, so their limits are wide.
#[test]
fn real_insertions_are_scored() {
    let Some(insertions) = data("steered-insertions") else { return };
    let files: Vec<String> = std::fs::read_dir(insertions)
        .expect("a folder")
        .filter_map(|entry| Some(entry.ok()?.path().display().to_string()))
        .filter(|path| path.ends_with(".csv"))
        .collect();
    let mut arguments = vec!["evaluate", "--json"];
    arguments.extend(files.iter().map(String::as_str));
    let said = needle_bench(&Scratch::new(), &arguments);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let json = said.json();
    // Measured: 5.3, 7.6 and 0.33.
    let figure = |value: &serde_json::Value| value.as_f64().unwrap();
    assert!(figure(&json["roll_rms_deg"]["median"]) <= 6.0, "{}", json["roll_rms_deg"]);
    let unknown = &json["roll_unknown_rms_deg"];
    assert!(figure(&unknown["median"]) <= 10.0, "{unknown}");
    assert!(figure(&json["prediction_5mm_rms_mm"]) <= 0.4, "{}", json["prediction_5mm_rms_mm"]);
    for observer in &json["observers"].as_array().unwrap()[1..] {
        assert_eq!(observer["files"].as_array().unwrap().len(), files.len());
        let roll_deg = observer["roll_rms_deg"]["median"].as_f64().unwrap();
        assert!((10.0..120.0).contains(&roll_deg), "{observer}");
        // Measured: coupled 0.52, finite differences 0.14.
        let position_mm = observer["position_rms_mm"].as_f64().unwrap();
        assert!((0.05..1.0).contains(&position_mm), "{observer}");
    }
}
