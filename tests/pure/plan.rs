//! `needle-bench plan`: its output and its refusals.

use crate::support::program::{Scratch, needle_bench, refusals, repository};
use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::Value;
use std::io::Write;
use std::ops::Range;

/// A target straight ahead with a ball in the way.
const BALL: &str = "\
[goal]
kind = \"target\"
position_mm = [0.0, 0.0, 120.0]
[[goal.obstacle]]
shape = \"sphere\"
centre_mm = [0.0, 1.0, 60.0]
radius_mm = 5.0
";

fn plan(scratch: &Scratch, text: &str, more: &[&str]) -> (i32, Value) {
    scratch.write("goal.toml", text);
    let said = needle_bench(scratch, &[&["plan", "goal.toml", "--json"], more].concat());
    assert_eq!(said.stderr, "");
    (said.status, said.json())
}

#[test]
fn json_has_the_plan() {
    let scratch = Scratch::new();
    let (status, json) = plan(&scratch, BALL, &[]);
    assert_eq!(status, 0);
    assert_eq!(json["status"], "plan");
    assert_eq!(json["reason"], Value::Null);
    let number = |key: &str| json[key].as_f64().unwrap_or_else(|| panic!("{key} in {json}"));
    assert!((120.0..125.0).contains(&number("length_mm")), "{json}");
    assert!(number("end_error_mm") < 1e-6);
    assert!((1.99..3.0).contains(&number("clearance_mm")));
    assert!(number("expansions") >= 1.0 && number("seconds") > 0.0);
    assert!(number("run_seconds") > 0.0);
    let rows: Vec<[f64; 3]> = serde_json::from_value(json["path"].clone()).unwrap();
    assert_eq!(rows[0], [0.0, 0.0, 0.0]);
    assert!((rows[rows.len() - 1][2] - 120.0).abs() < 1e-6);
    assert_eq!(rows.len(), (number("length_mm") / 0.5).ceil() as usize + 1);
    let arcs = json["arcs"].as_array().unwrap();
    let length_mm: f64 = arcs.iter().map(|arc| arc["length_mm"].as_f64().unwrap()).sum();
    assert!((length_mm - number("length_mm")).abs() < 1e-9);
    // In the plane the roll is 0 or 180 deg; roll 0 bends toward -y.
    let first = arcs.iter().find(|arc| arc["curvature_per_mm"].as_f64() > Some(0.0)).unwrap();
    let roll_deg = first["roll_deg"].as_f64().unwrap();
    let bends_down = rows[40][1] < 0.0;
    assert!(if bends_down { roll_deg.abs() < 1e-6 } else { (roll_deg - 180.0).abs() < 1e-6 });
}

#[test]
fn no_plan_is_reported_with_the_reason_and_the_nearest_point() {
    let scratch = Scratch::new();
    let aside = BALL.replace("[0.0, 0.0, 120.0]", "[0.0, 60.0, 70.0]");
    let (status, json) = plan(&scratch, &aside, &[]);
    assert_eq!((status, &json["status"]), (1, &Value::from("none")));
    assert_eq!([&json["path"], &json["length_mm"]], [&Value::Null; 2]);
    let reason = json["reason"].as_str().unwrap();
    assert!(reason.starts_with("the target is out of reach: "), "{reason}");
    assert!(json["nearest_distance_mm"].as_f64().unwrap() > 10.0, "{json}");
    let said = needle_bench(&scratch, &["plan", "goal.toml"]);
    assert_eq!(said.status, 1);
    assert!(said.stdout.contains("nearest     0.0, "), "{}", said.stdout);
    let (status, json) = plan(&scratch, BALL, &["--set", "goal.expansions_max=2"]);
    assert_eq!((status, &json["status"]), (1, &Value::from("budget")));
    assert!(json["nearest_distance_mm"].as_f64().unwrap() > 10.0, "{json}");
    let said = needle_bench(&scratch, &["plan", "goal.toml", "--set", "goal.expansions_max=2"]);
    // A run is not allowed either, so no search for its path follows.
    assert_eq!([&json["run_refusal"], &json["run_seconds"]], [&json["reason"], &Value::Null]);
    let raise = "raise goal.expansions_max, which is 2\nnearest";
    assert!(
        said.stdout.contains(raise) && said.stdout.contains("mm was reached"),
        "{}",
        said.stdout
    );
}

/// A run begins with a path that keeps more than the clearance, and refuses one that cannot keep
/// `goal.reserve_mm`.
#[test]
fn plan_reports_the_reserve_of_a_run() {
    let scratch = Scratch::new();
    let (_, json) = plan(&scratch, BALL, &[]);
    assert_eq!((&json["run_reserve_mm"], &json["run_refusal"]), (&2.0.into(), &Value::Null));
    let said = needle_bench(&scratch, &["plan", "goal.toml"]);
    let begins =
        "\nrun         begins with a path that keeps 2.00 mm more than goal.clearance_mm\n";
    assert!(said.stdout.contains(begins), "{}", said.stdout);
    // No needle keeps 40 mm from a ball on its axis.
    let reserve = ["--set", "goal.reserve_mm=40"];
    let (status, json) = plan(&scratch, BALL, &reserve);
    let refusal = json["run_refusal"].as_str().unwrap();
    assert_eq!((status, &json["status"]), (0, &Value::from("plan")));
    assert_eq!([&json["run_reserve_mm"], &json["reason"]], [&Value::Null; 2]);
    assert!(refusal.contains("none was found that keeps goal.reserve_mm, 40,"), "{refusal}");
    let said = needle_bench(&scratch, &[&["plan", "goal.toml"], &reserve[..]].concat());
    let words = said.stdout.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(said.stdout.starts_with("plan\nlength "), "{}", said.stdout);
    assert!(words.contains(&format!(" run is refused: {refusal} ")), "{}", said.stdout);
    let run = needle_bench(&scratch, &[&["run", "goal.toml", "--json"], &reserve[..]].concat());
    assert!(run.status == 2 && run.json()["error"].to_string().contains(refusal), "{}", run.stdout);
    // The target is 0.1 mm from a wall, and a stop at 2 mm/s takes 0.13 mm.
    let wall = ["--set", "goal.workspace_mm.max=[50.0, 75.0, 120.1]"];
    let (_, json) = plan(&scratch, BALL, &wall);
    let refusal = json["run_refusal"].as_str().unwrap();
    assert!(refusal.contains("0.10 mm from a wall"), "{refusal}");
    let run = needle_bench(&scratch, &[&["run", "goal.toml", "--json"], &wall[..]].concat());
    assert!(run.status == 2 && run.json()["error"].to_string().contains(refusal), "{}", run.stdout);
    let clear = BALL.split("[[goal").next().unwrap();
    let (_, json) = plan(&scratch, clear, &[]);
    assert_eq!([&json["run_reserve_mm"], &json["run_refusal"]], [&Value::Null; 2]);
}

/// Around obstacles a plan leaves 15% of the curvature unused by default. A refusal for that names the key.
#[test]
fn the_curvature_margin_is_reported_and_recorded() {
    let scratch = Scratch::new();
    let far = BALL.replace("[0.0, 0.0, 120.0]", "[0.0, 44.0, 100.0]");
    let far = far.replace("[0.0, 1.0, 60.0]", "[0.0, -60.0, 20.0]");
    let margin = |text: &str, more: &[&str]| {
        let (status, json) = plan(&scratch, text, more);
        (status, json["curvature_margin"].as_f64().unwrap())
    };
    assert_eq!(margin(far.split("[[goal").next().unwrap(), &[]), (0, 0.0));
    assert_eq!(margin(&far, &[]), (1, 0.15));
    let said = needle_bench(&scratch, &["plan", "goal.toml"]);
    let line =
        "\nmargin      0.15 of the needle's curvature is left unused (goal.curvature_margin)\n";
    assert!(said.stdout.contains(line), "{}", said.stdout);
    let run = needle_bench(&scratch, &["run", "goal.toml", "--json"]);
    let refusal = run.json()["error"].to_string();
    assert!(run.status == 2 && refusal.contains("see goal.curvature_margin"), "{refusal}");
    let none = ["--set", "goal.curvature_margin=0"];
    assert_eq!(margin(&far, &none), (0, 0.0));
    let near = far.replace("[0.0, 44.0, 100.0]", "[0.0, 0.0, 8.0]");
    scratch.write("goal.toml", &near);
    let run =
        needle_bench(&scratch, &["run", "goal.toml", "--json", "--set", "emulator.start.x_mm=0"]);
    assert_eq!(run.status, 0, "{}{}", run.stdout, run.stderr);
    let run_dir = run.json()["run_dir"].as_str().unwrap().to_owned();
    let recorded =
        std::fs::read_to_string(scratch.path().join(run_dir).join("config.toml")).unwrap();
    assert!(recorded.contains("\ncurvature_margin = 0.15\n"), "{recorded}");
}

#[test]
fn the_example_has_a_plan_and_a_picture() {
    let scratch = Scratch::new();
    let example = repository("bench-config/target.toml");
    for in_plane in ["true", "false"] {
        let set = format!("goal.in_plane={in_plane}");
        let picture = format!("{in_plane}.svg");
        let said = needle_bench(&scratch, &["plan", &example, "--set", &set, "--out", &picture]);
        assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
        assert!(said.stdout.starts_with("plan\nlength "), "{}", said.stdout);
        let svg = std::fs::read_to_string(scratch.path().join(&picture)).unwrap();
        assert_eq!(svg.matches("<polygon").count(), 6, "three obstacles, from two sides");
        assert_eq!(svg.matches("<polyline").count(), 2);
        let again = needle_bench(&scratch, &["plan", &example, "--out", &picture]);
        assert_eq!(again.status, 2, "{}", again.stderr);
        assert!(again.stderr.contains("exists, and is not overwritten"), "{}", again.stderr);
    }
}

#[test]
fn contradictory_goals_are_refused_with_the_key() {
    let scratch = Scratch::new();
    let target = "[goal]\nkind = \"target\"\nposition_mm = [0, 0, 100]\n";
    let obstacle = |text: &str| format!("{target}[[goal.obstacle]]\n{text}\n");
    let ball = "shape = \"sphere\"\ncentre_mm = [0, 20, 50]\nradius_mm = 5";
    let texts = [
        "[goal]\nkind = \"target\"\n".to_owned(),
        "[goal]\nposition_mm = [0, 0, 100]\n".to_owned(),
        "[goal]\nkind = \"target\"\nposition_mm = [0, nan, 100]\n".to_owned(),
        "[goal]\nkind = \"target\"\nposition_mm = [3, 0, 100]\n".to_owned(),
        "[goal]\nkind = \"target\"\nposition_mm = [0, 0, 160]\n".to_owned(),
        "[goal]\nkind = \"target\"\nposition_mm = [0, 0, 100]\nexpansions_max = 0\n".to_owned(),
        format!("{target}clearance_mm = 0.09\n[[goal.obstacle]]\n{ball}\n"),
        format!("{target}workspace_mm = {{ min = [0, 0, 0], max = [1, 0, 1] }}\n"),
        format!("{target}workspace_mm = {{ min = [1, 0, 0], max = [2, 1, 1] }}\n"),
        obstacle("shape = \"ball\""),
        obstacle("shape = \"sphere\"\ncentre_mm = [0, 0, 50]"),
        obstacle("shape = \"sphere\"\ncentre_mm = [0, 0, 50]\nradius_mm = -1"),
        obstacle("shape = \"sphere\"\ncentre_mm = [0, 0, inf]\nradius_mm = 5"),
        obstacle("shape = \"sphere\"\ncentre_mm = [0, 2, 100]\nradius_mm = 5"),
        obstacle("shape = \"sphere\"\ncentre_mm = [0, 0, 50]\nradius_mm = 5\nmin_mm = [0, 0, 0]"),
        obstacle("shape = \"cylinder\"\nfrom_mm = [0, 0, 50]\nto_mm = [0, 0, 50]\nradius_mm = 5"),
        obstacle("shape = \"box\"\nmin_mm = [0, 0, 50]\nmax_mm = [1, 0, 60]"),
        obstacle("shape = \"mask\"\nfile = \"none.nii\""),
    ];
    let mut screens = String::new();
    for text in texts {
        scratch.write("goal.toml", &text);
        let refused = refusals(&scratch, &[&["check", "goal.toml"]]);
        screens += &format!("{text}{refused}");
    }
    insta::assert_snapshot!(screens);
}

#[test]
fn a_plan_needs_a_target() {
    let scratch = Scratch::new();
    scratch.write("goal.toml", BALL);
    insta::assert_snapshot!(refusals(&scratch, &[&["plan", "--set", "goal.kind=plane"]]));
}

/// The offset of `xyzt_units` in a header.
const UNITS: usize = 123;
/// Where a header has the first byte of its voxels (`vox_offset`).
const VOX_OFFSET: Range<usize> = 108..112;

/// A NIfTI-1 image in one file: `size` voxels of `spacing_mm` with these `values`.
fn nifti(size: [u16; 3], spacing_mm: [f32; 3], values: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0; 352];
    let mut put = |at: usize, value: &[u8]| bytes[at..at + value.len()].copy_from_slice(value);
    put(0, &348i32.to_le_bytes());
    let dim = [3, size[0], size[1], size[2], 1, 1, 1, 1];
    dim.iter().enumerate().for_each(|(i, count)| put(40 + 2 * i, &count.to_le_bytes()));
    // Type of the voxels: unsigned bytes.
    put(70, &2i16.to_le_bytes());
    put(72, &8i16.to_le_bytes());
    let sides = [1.0, spacing_mm[0], spacing_mm[1], spacing_mm[2]];
    sides.iter().enumerate().for_each(|(i, side)| put(76 + 4 * i, &side.to_le_bytes()));
    put(VOX_OFFSET.start, &352f32.to_le_bytes());
    // Unit: mm.
    put(UNITS, &[2]);
    put(344, b"n+1\0");
    bytes.extend(values);
    bytes
}

const MASK: &str = "\
[goal]
kind = \"target\"
position_mm = [0.0, 0.0, 120.0]
[[goal.obstacle]]
shape = \"mask\"
file = \"mask.nii\"
pose = { x_mm = -9.5, y_mm = -4.5, z_mm = 55.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }
";

#[test]
fn a_path_keeps_clear_of_a_mask() {
    let scratch = Scratch::new();
    let write = |bytes: Vec<u8>| std::fs::write(scratch.path().join("mask.nii"), bytes).unwrap();
    write(nifti([20, 10, 10], [1.0; 3], &[1; 2000]));
    let (status, json) = plan(&scratch, MASK, &[]);
    assert_eq!((status, &json["status"]), (0, &Value::from("plan")), "{json}");
    // The block of voxels ends 5 mm beside the axis, between 54.5 and 64.5 mm.
    let rows: Vec<[f64; 3]> = serde_json::from_value(json["path"].clone()).unwrap();
    for [_, y, z] in rows.iter().filter(|row| (54.5..64.5).contains(&row[2])) {
        assert!(y.abs() >= 7.0, "{y} at {z}");
    }
    // The picture shows the mask in the size of the mask (20 by 10 mm from above, 10 by 10 from the side), however
    // large the workspace is.
    let large = "goal.workspace_mm={ min=[-1000, -1000, 0], max=[1000, 1000, 1000] }";
    let drawn = ["plan", "goal.toml", "--out", "mask.svg", "--set", large];
    let said = needle_bench(&scratch, &drawn);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let svg = std::fs::read_to_string(scratch.path().join("mask.svg")).unwrap();
    let squares = svg.matches("<polygon").count();
    assert!((25 + 50..=36 + 66).contains(&squares), "{squares} squares of 2 mm");
    // A run and its replay read the mask too, and the viewer's file shows it in a workspace of any size.
    let largest = "goal.workspace_mm={ min=[-10000, -10000, 0], max=[10000, 10000, 10000] }";
    let start = "emulator.start={ x_mm=0, y_mm=0, z_mm=0, yaw_deg=0, pitch_deg=0, roll_deg=0 }";
    let fast = "insertion.speed_mm_per_s=5";
    let known = "observer.invariant.start_sd={ yaw_deg=3, pitch_deg=3, roll_deg=5 }";
    let sets = ["--set", start, "--set", fast, "--set", known, "--set", largest];
    let run = [&["run", "goal.toml", "--quiet", "--json"], &sets[..]].concat();
    let said = needle_bench(&scratch, &run);
    let dir = said.json()["run_dir"].as_str().unwrap().to_owned();
    assert_eq!(said.status, 0, "{}", said.stdout);
    let said = needle_bench(&scratch, &["replay", &dir]);
    assert_eq!(said.status, 0, "{} {}", said.stdout, said.stderr);

    write(nifti([20, 10, 10], [1.0; 3], &[0; 2000]));
    let said = needle_bench(&scratch, &["replay", &dir]);
    assert_eq!(said.status, 2, "{}", said.stdout);
    assert!(
        said.stderr.contains("the content of the mask differs: its CRC-32 is 0x"),
        "{}",
        said.stderr
    );
    let said = needle_bench(&scratch, &["plan", "goal.toml"]);
    assert!(said.status == 2 && said.stderr.contains("all of its voxels are 0"), "{}", said.stderr);
}

/// The origin in the header of an image is not used, and an obstacle elsewhere has no effect.
#[test]
fn a_mask_that_its_header_places_elsewhere_or_that_is_far_away_is_warned_of() {
    let scratch = Scratch::new();
    let mut image = nifti([20, 10, 10], [1.0; 3], &[1; 2000]);
    let mut put = |at: usize, value: &[u8]| image[at..at + value.len()].copy_from_slice(value);
    // The code of the qform, and its origin.
    put(252, &1i16.to_le_bytes());
    [-9.5f32, -4.5, 55.0]
        .iter()
        .enumerate()
        .for_each(|(i, mm)| put(268 + 4 * i, &mm.to_le_bytes()));
    std::fs::write(scratch.path().join("mask.nii"), image).unwrap();
    let warned = |command: &str, mask: &str| {
        scratch.write("goal.toml", mask);
        let said = needle_bench(&scratch, &[command, "goal.toml"]);
        assert_eq!(said.status, 0, "{}", said.stderr);
        said.stderr.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    for command in ["plan", "check"] {
        assert_eq!(warned(command, MASK), "", "pose is the header's");
        let away = warned(command, &MASK.replace("x_mm = -9.5", "x_mm = 10.5"));
        let origins = "its header places voxel (0, 0, 0) at (-9.50, -4.50, 55.00) mm, pose at (10.50, -4.50, 55.00); \
                       the header's origin is not used";
        assert_eq!(away.matches(origins).count(), 1, "{away}");
        assert!(!away.contains("no effect"), "{away}");
        let far = warned(command, &MASK.replace("z_mm = 55.0", "z_mm = 1360.0"));
        let effect = "goal.obstacle[0] is 1206.1 mm outside goal.workspace_mm (goal.clearance_mm is 2), so it has no \
                      effect: is it in the plane's frame?";
        assert!(far.contains(effect), "{far}");
    }
}

/// Without a configuration file, the path of a mask is relative to the working directory.
#[test]
fn a_mask_of_the_command_line_is_recorded_with_its_path_and_checksum() {
    let scratch = Scratch::new();
    let mask = scratch.path().join("mask.nii");
    std::fs::write(&mask, nifti([2, 2, 2], [1.0; 3], &[1; 8])).unwrap();
    let sets = [
        "goal.kind=target",
        "goal.position_mm=[0, 0, 8]",
        "goal.obstacle=[{shape=\"mask\", file=\"mask.nii\", \
         pose={x_mm=0, y_mm=20, z_mm=20, yaw_deg=0, pitch_deg=0, roll_deg=0}}]",
        "emulator.start.x_mm=0",
        "observer.invariant.start_sd={yaw_deg=3, pitch_deg=3, roll_deg=5}",
    ];
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", *set]).collect();
    let said = needle_bench(&scratch, &[&["run", "--json", "--quiet"], &sets[..]].concat());
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    let recorded = std::fs::read_to_string(said.run_dir(&scratch).join("config.toml")).unwrap();
    let printed = needle_bench(&scratch, &[&["check", "--print"], &sets[..]].concat()).stdout;
    for text in [recorded, printed] {
        assert!(text.contains(&format!("file = {mask:?}")), "{text}");
        assert!(text.contains("\ncrc32 = "), "{text}");
    }
    // The record of a motion shows the obstacles too, wherever its configuration lies.
    std::fs::create_dir(scratch.path().join("rig")).unwrap();
    std::fs::rename(&mask, scratch.path().join("rig/mask.nii")).unwrap();
    scratch.write("rig/goal.toml", MASK);
    let jog =
        ["stage", "--virtual", "--json", "jog", "rig/goal.toml", "--axis=rotation", "--by=5deg"];
    let said = needle_bench(&scratch, &jog);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    assert!(said.run_dir(&scratch).join("run.rrd").is_file());
}

#[test]
fn a_file_that_is_not_a_mask_is_refused() {
    let scratch = Scratch::new();
    scratch.write("goal.toml", MASK);
    let mut turned = nifti([2, 2, 2], [1.0; 3], &[1; 8]);
    turned[254..256].copy_from_slice(&1i16.to_le_bytes());
    let mut metres = nifti([2, 2, 2], [0.001; 3], &[1; 8]);
    metres[UNITS] = 1;
    let mut two_sizes = nifti([2, 2, 2], [1.0; 3], &[1; 8]);
    two_sizes[254..256].copy_from_slice(&1i16.to_le_bytes());
    for at in [280, 300, 320] {
        two_sizes[at..at + 4].copy_from_slice(&3f32.to_le_bytes());
    }
    let mut pair = nifti([2, 2, 2], [1.0; 3], &[1; 8]);
    pair[344..347].copy_from_slice(b"ni1");
    // The voxels begin after 48 bytes of padding, or farther on than allowed.
    let mut padded = nifti([2, 2, 2], [1.0; 3], &[[0; 48].as_slice(), &[1; 8]].concat());
    padded[VOX_OFFSET].copy_from_slice(&400f32.to_le_bytes());
    let mut beyond = nifti([2, 2, 2], [1.0; 3], &[1; 8]);
    beyond[VOX_OFFSET].copy_from_slice(&1e9f32.to_le_bytes());
    let [mut no_number, mut before] = [(); 2].map(|()| nifti([2, 2, 2], [1.0; 3], &[1; 8]));
    no_number[VOX_OFFSET].copy_from_slice(&f32::NAN.to_le_bytes());
    before[VOX_OFFSET].copy_from_slice(&(-1f32).to_le_bytes());
    let mut negative = nifti([2, 2, 2], [1.0; 3], &[1; 8]);
    negative[42..44].copy_from_slice(&(-2i16).to_le_bytes());
    let mut two_lengths = nifti([2, 2, 2], [1.0; 3], &[1; 16]);
    two_lengths[72..74].copy_from_slice(&16i16.to_le_bytes());
    let mut unscaled = nifti([2, 2, 2], [1.0; 3], &[1; 8]);
    unscaled[112..116].copy_from_slice(&f32::NAN.to_le_bytes());
    let images = [
        b"no image".to_vec(),
        pair,
        nifti([2, 2, 2], [1.0; 3], &[0; 8]),
        nifti([2, 2, 2], [1.0, 0.0, 1.0], &[1; 8]),
        nifti([2, 2, 2], [f32::NAN; 3], &[1; 8]),
        nifti([2000, 2000, 200], [1.0; 3], &[]),
        nifti([20, 10, 10], [1.0; 3], &[1; 100]),
        turned,
        metres,
        two_sizes,
        nifti([20, 10, 10], [1.0; 3], &[1; 2500]),
        nifti([2, 2, 2], [0.001; 3], &[1; 8]),
        padded,
        beyond,
        no_number,
        before,
        negative,
        vec![0x1f, 0x8b, 8, 0],
        nifti([50, 50, 120], [1.0; 3], &[1; 300_000]),
        two_lengths,
        nifti([2, 2, 2], [1e30; 3], &[1; 8]),
        unscaled,
    ];
    let mut screens = refusals(&scratch, &[&["check", "goal.toml"]]);
    for image in images {
        std::fs::write(scratch.path().join("mask.nii"), image).unwrap();
        screens += &refusals(&scratch, &[&["check", "goal.toml"]]);
    }
    insta::assert_snapshot!(screens);
}

/// As other programs write it: the voxels begin after the extension.
#[test]
fn a_mask_with_an_extension_is_read() {
    let scratch = Scratch::new();
    let mut image = nifti([20, 10, 10], [1.0; 3], &[1; 2000]);
    image[348] = 1;
    image[VOX_OFFSET].copy_from_slice(&368f32.to_le_bytes());
    let extension = [16i32, 6, 0, 0].map(i32::to_le_bytes).concat();
    image.splice(352..352, extension);
    std::fs::write(scratch.path().join("mask.nii"), image).unwrap();
    let (status, json) = plan(&scratch, MASK, &[]);
    assert_eq!((status, &json["status"]), (0, &Value::from("plan")), "{json}");
}

/// With a wrong checksum, and cut before the checksum.
#[test]
fn a_damaged_compressed_mask_is_refused() {
    let scratch = Scratch::new();
    scratch.write("goal.toml", &MASK.replace("mask.nii", "mask.nii.gz"));
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(&nifti([20, 10, 10], [1.0; 3], &[1; 2000])).unwrap();
    let whole = encoder.finish().unwrap();
    let mut damaged = whole.clone();
    let checksum = whole.len() - 8;
    damaged[checksum] ^= 1;
    for (bytes, status) in [(&whole[..], 0), (&damaged, 2), (&whole[..checksum], 2)] {
        std::fs::write(scratch.path().join("mask.nii.gz"), bytes).unwrap();
        let said = needle_bench(&scratch, &["plan", "goal.toml"]);
        assert_eq!(said.status, status, "{}{}", said.stdout, said.stderr);
        let is_named = said.stderr.contains("mask.nii.gz: no NIfTI image");
        assert_eq!(is_named, status != 0, "{}", said.stderr);
        assert!(!said.stderr.contains("Custom"), "{}", said.stderr);
    }
}
