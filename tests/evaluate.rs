//! `needle-bench evaluate` over recordings: synthetic ones, and real ones where they are at hand.

#[path = "support/program.rs"]
#[allow(dead_code, reason = "not every test needs all of it")]
mod program;

use nalgebra::UnitQuaternion;
use needle_bench::geometry::Pose;
use needle_bench::needle::{Increment, Needle};
use program::{Scratch, needle_bench};
use std::fmt::Write as _;
use std::path::PathBuf;

/// A torsion-free needle of radius 80 mm, its sensor in line with its tip.
fn recording() -> String {
    let needle = Needle::new(0.0125).unwrap();
    let mut csv = "insertion_mm,rotation_rad,x_mm,y_mm,z_mm,qw,qx,qy,qz\n".to_owned();
    let (mut tip, mut rotation) = (Pose::identity(), 0.0);
    for n in 0..600u32 {
        let q = UnitQuaternion::from_rotation_matrix(&tip.rotation);
        let [x, y, z]: [f64; 3] = tip.translation.into();
        let depth = 0.1 * f64::from(n);
        writeln!(csv, "{depth},{rotation},{x},{y},{z},{},{},{},{}", q.w, q.i, q.j, q.k).unwrap();
        let turn = 0.02 * (f64::from(n) * 0.02).sin();
        tip = needle.step(&tip, Increment::new(0.1, turn).unwrap());
        rotation += turn;
    }
    csv
}

const IN_LINE: [&str; 4] =
    ["--set", "evaluation.axis=[0,0,1]", "--set", "evaluation.bend_axis=[1,0,0]"];

#[test]
fn a_needle_without_torsion_is_followed_by_both_observers() {
    let scratch = Scratch::new();
    scratch.write("a.csv", &recording());
    scratch.write("b.csv", &recording());
    let mut arguments = vec!["evaluate", "a.csv", "b.csv", "--json"];
    arguments.extend(IN_LINE);
    arguments.extend(["--set", "observer.finite_difference.baseline_mm=2"]);
    let said = needle_bench(&scratch, &arguments);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let json = said.json();
    assert_eq!(json["observer"], "coupled");
    let observers = json["observers"].as_array().unwrap();
    assert_eq!(observers.len(), 2);
    for observer in observers {
        assert!(observer["roll_rms_deg"]["median"].as_f64().unwrap() < 2.0, "{observer}");
        assert!(observer["roll_rms_deg"]["p90"].is_f64());
        // A prediction is never exact, as the corrected position of the finite differences is.
        let position_mm = observer["position_rms_mm"].as_f64().unwrap();
        assert!(position_mm > 1e-9 && position_mm < 0.05, "{position_mm}");
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
    assert_eq!(with["position_rms_mm"], without["position_rms_mm"]);
    assert!(without["roll_rms_deg"]["median"].is_null());
}

#[test]
fn a_recording_that_is_none_is_refused_by_line() {
    let scratch = Scratch::new();
    scratch.write("bad.csv", "insertion_mm,rotation_rad,x_mm,y_mm,z_mm\n0,0,0,0,inf\n");
    let said = needle_bench(&scratch, &["evaluate", "bad.csv"]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("bad.csv: line 2: z_mm"), "{}", said.stderr);
}

/// No file is a file to evaluate, a folder or a binary neither: bad arguments.
#[test]
fn what_cannot_be_read_is_refused_by_name() {
    let scratch = Scratch::new();
    std::fs::create_dir(scratch.path().join("folder")).unwrap();
    std::fs::write(scratch.path().join("binary"), [0xFF, 0xFE, 0x00]).unwrap();
    for name in ["absent.csv", "folder", "binary"] {
        let said = needle_bench(&scratch, &["evaluate", name]);
        assert_eq!(said.status, 2, "{name}: {}", said.stderr);
        assert!(said.stderr.contains(name), "{}", said.stderr);
    }
}

/// A number at the end of what a float holds is an error with its line, and never a hang.
#[test]
fn a_number_beyond_any_needle_is_refused_by_line() {
    let scratch = Scratch::new();
    let header = "insertion_mm,rotation_rad,x_mm,y_mm,z_mm";
    for row in ["1e308,0,0,0,1", "1,1e308,0,0,1", "1,0,1e308,0,1"] {
        scratch.write("huge.csv", &format!("{header}\n0,0,0,0,0\n{row}\n2,0,0,0,2\n"));
        let said = needle_bench(&scratch, &["evaluate", "huge.csv"]);
        assert_eq!(said.status, 2, "{row}: {}", said.stderr);
        assert!(said.stderr.contains("huge.csv: line 3: "), "{row}: {}", said.stderr);
    }
}

#[test]
fn a_byte_order_mark_is_no_column() {
    let scratch = Scratch::new();
    scratch.write("bom.csv", &format!("\u{feff}{}", recording()));
    let said = needle_bench(&scratch, &["evaluate", "bom.csv"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
}

/// Insertions of a real needle, recorded by others (`$NEEDLE_DATA/steered-insertions`). The paper
/// has no torsion, so the figures are poor; what is asserted is that they are figures.
#[test]
fn real_insertions_are_scored() {
    let data = std::env::var_os("NEEDLE_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let Ok(entries) = std::fs::read_dir(data.join("steered-insertions")) else {
        eprintln!("SKIPPED: no recorded insertions in {} (set NEEDLE_DATA)", data.display());
        return;
    };
    let files: Vec<String> = entries
        .filter_map(|entry| Some(entry.ok()?.path().display().to_string()))
        .filter(|path| path.ends_with(".csv"))
        .collect();
    let mut arguments = vec!["evaluate", "--json"];
    arguments.extend(files.iter().map(String::as_str));
    let said = needle_bench(&Scratch::new(), &arguments);
    assert_eq!(said.status, 0, "{}", said.stderr);
    for observer in said.json()["observers"].as_array().unwrap() {
        assert_eq!(observer["files"].as_array().unwrap().len(), files.len());
        let roll_deg = observer["roll_rms_deg"]["median"].as_f64().unwrap();
        assert!((10.0..120.0).contains(&roll_deg), "{observer}");
        // Measured: coupled 0.61, finite differences 0.20.
        let position_mm = observer["position_rms_mm"].as_f64().unwrap();
        assert!((0.05..1.0).contains(&position_mm), "{observer}");
    }
}
