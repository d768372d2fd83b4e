//! The command `needle-bench review`: one run, two, a campaign; verdicts, edited and open records, repair.

use crate::support::program::{Said, Scratch, needle_bench, refusals, repository};
use needle_bench::archive::Manifest;
use needle_bench::telemetry::{RunFolder, lock, write_manifest};
use serde_json::Value;
use std::fs;
use std::path::Path;

/// The folder of a short run with these arguments, relative to `scratch`.
fn run(scratch: &Scratch, arguments: &[&str]) -> String {
    let short = [
        "run",
        "--json",
        "-q",
        "--set",
        "insertion={ depth_mm = 6, plane_out_of_reach = \"insert\" }",
    ];
    let said = needle_bench(scratch, &[&short[..], arguments].concat());
    said.json()["run_dir"].as_str().expect("a run folder").to_owned()
}

fn review(scratch: &Scratch, arguments: &[&str]) -> Said {
    needle_bench(scratch, &[&["review"], arguments].concat())
}

/// Opens the record in `dir` again, as if the bench had been killed.
fn leave_open(scratch: &Scratch, dir: &str) {
    let dir = scratch.path().join(dir);
    let folder = RunFolder::open(&dir).expect("a run folder");
    let mut open = Manifest::new(&folder.manifest.name, folder.manifest.started_utc.clone());
    open.config_sha256 = folder.manifest.config_sha256.clone();
    write_manifest(&dir, &open).expect("a manifest");
}

/// Renames the run folder `dir`, so that a snapshot has no date.
fn named(scratch: &Scratch, dir: &str) -> &'static str {
    fs::rename(scratch.path().join(dir), scratch.path().join("runs/one")).expect("renamed");
    "runs/one"
}

fn assert_all(text: &str, parts: &[&str]) {
    parts.iter().for_each(|part| assert!(text.contains(part), "no {part:?} in:\n{text}"));
}

#[test]
fn review_shows_a_run_on_one_screen_and_writes_one_page() {
    let scratch = Scratch::new();
    let note = "<script src='https://x'>third</script> & last try";
    let about = ["--operator", "J. Doe", "--phantom", "gelatin 10 %", "--note", note];
    let dir = run(&scratch, &about);
    let said = review(&scratch, &[&dir]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""));
    assert_all(
        &said.stdout,
        &[", by J. Doe, into gelatin 10 %", note, "accepted, 0 refused", "≥ 5.95", "s inserting"],
    );
    assert!(said.stdout.lines().count() <= 35, "more than one screen:\n{}", said.stdout);
    assert_eq!(said.stdout.lines().last(), Some("completed"));
    let page = fs::read_to_string(scratch.path().join(&dir).join("report.html")).expect("a page");
    assert_all(
        &page,
        &["J. Doe", "&lt;script", "Distance from the plane", "Errors of the estimated angles"],
    );
    assert_loads_nothing(&page);
    assert_is_well_formed(&page);
    // The page is not part of the record, which stays whole.
    let json = review(&scratch, &[&dir, "--json"]).json();
    assert_eq!((&json["condition"], &json["outcome"]), (&"whole".into(), &"completed".into()));
    assert!(json["figures"]["off_plane_rms_mm"].is_f64() && json["limits"]["tip_age_s_max"] == 0.5);
    assert!(json["figures"]["estimate_rms.roll_deg"].is_f64(), "{json}");
}

/// No element and no style of the page loads anything.
fn assert_loads_nothing(page: &str) {
    for load in ["<script", "<link", "<img", "<iframe", "url(", "@import", " src=\"", " href=\""] {
        assert!(!page.contains(load), "{load}");
    }
}

/// Every element is closed by its own end tag.
fn assert_is_well_formed(page: &str) {
    let mut open: Vec<&str> = Vec::new();
    for tag in page.split('<').skip(1) {
        let (tag, _) = tag.split_once('>').expect("a tag ends");
        let name = tag.trim_start_matches('/').split_whitespace().next().unwrap_or_default();
        let name = name.trim_end_matches('/');
        match tag {
            _ if tag.starts_with('!') || name == "meta" || tag.ends_with('/') => {}
            _ if tag.starts_with('/') => assert_eq!(open.pop(), Some(name)),
            _ => open.push(name),
        }
    }
    assert!(open.is_empty(), "not closed: {open:?}");
}

#[test]
fn the_page_of_an_operation_shows_the_motion_of_both_axes() {
    let scratch = Scratch::new();
    let jog = repository("tests/recorded/jog");
    let said = review(&scratch, &[&jog, "--html", "page.html"]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""));
    let page = fs::read_to_string(scratch.path().join("page.html")).expect("a page");
    assert_all(&page, &["Motion of the rotation", "Motion of the insertion", "position (deg)"]);
}

#[test]
fn html_and_no_html_decide_where_the_page_goes() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &["--set", "record.operator=M. Doe"]);
    assert_eq!(review(&scratch, &[&dir, "--no-html"]).status, 0);
    assert!(!scratch.path().join(&dir).join("report.html").exists());
    let said = review(&scratch, &[&dir, "--html", "page.html"]);
    assert_all(&said.stdout, &["report      page.html", "by M. Doe"]);
    assert!(scratch.path().join("page.html").exists());
    let steps = format!("{dir}/steps.csv");
    let said = review(&scratch, &[&dir, "--html", &steps]);
    assert_all(&said.stderr, &["steps.csv: File exists"]);
    assert_eq!(review(&scratch, &[&dir, "--no-html"]).status, 0, "steps.csv was overwritten");
    let said = review(&scratch, &[&dir, "--html", "gone/page.html"]);
    assert_eq!((said.status, said.stdout.lines().last()), (3, Some("completed")));
    assert_all(&said.stderr, &["gone/page.html: ", "--no-html"]);
}

#[test]
fn a_comparison_lists_configurations_before_figures() {
    let scratch = Scratch::new();
    let a = run(&scratch, &[]);
    let b = run(&scratch, &["--set", "needle.radius_mm=121.0"]);
    let said = review(&scratch, &[&a, &b]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let at =
        |text: &str| said.stdout.find(text).unwrap_or_else(|| panic!("{text}:\n{}", said.stdout));
    assert!(at("needle.radius_mm  122.0 → 121.0") < at("calibration_sha256"));
    assert!(at("calibration_sha256") < at("off plane"));
    let json = review(&scratch, &[&a, &b, "--json"]).json();
    assert_eq!(json["configuration"]["needle.radius_mm"]["b"], "121.0");
    assert_eq!(json["configuration"].as_object().map(serde_json::Map::len), Some(1));
    assert!(json["figures"]["off_plane_rms_mm"]["b_minus_a"].is_f64());
}

#[test]
fn a_campaign_lists_counted_and_excluded_runs() {
    let scratch = Scratch::new();
    let runs: Vec<String> = ["1", "2", "3", "4"]
        .iter()
        .map(|seed| run(&scratch, &["--set", &format!("emulator.seed={seed}")]))
        .collect();
    let said = review(&scratch, &[&runs[0], "--verdict", "invalid", "--reason", "wrong gain"]);
    assert_eq!((said.status, said.stdout), (0, format!("{}: invalid, wrong gain\n", runs[0])));
    leave_open(&scratch, &runs[1]);
    let jog = [
        "stage",
        "--virtual",
        "jog",
        "--axis",
        "insertion",
        "--by",
        "1mm",
        "--note",
        "loose",
        "-q",
    ];
    assert_eq!(needle_bench(&scratch, &jog).status, 0);
    fs::create_dir(scratch.path().join("runs/notes")).expect("a folder");
    copy_folder(&scratch.path().join(&runs[2]), &scratch.path().join("runs/copy"));

    let json = review(&scratch, &["runs", "--json"]).json();
    assert_eq!(json["counted"], 2);
    let reasons: Vec<&str> =
        json["excluded"].as_array().unwrap().iter().filter_map(|e| e["reason"].as_str()).collect();
    assert_eq!(reasons, ["invalid", "not_closed", "operation", "copy", "unreadable"]);
    let group = &json["groups"][0];
    assert_eq!((&group["group"], &group["completed"]["count"]), (&"virtual".into(), &2.into()));
    assert_eq!(group["varied"], serde_json::json!(["emulator.seed"]));
    assert_eq!(group["off_plane_rms_mm"]["order_statistics_95"], Value::Null);
    let text = review(&scratch, &["runs"]).stdout;
    assert_all(
        &text,
        &["2 of 2, 100 % (34 to 100 %, Wilson 95 %)", "wrong gain", "--repair", "needs six"],
    );
    let by = review(&scratch, &["runs", "--by", "emulator.seed"]).stdout;
    assert_all(&by, &["emulator.seed = 3: 1 run", "emulator.seed = 4: 1 run"]);
    let said = review(&scratch, &["runs", "--by", "goal"]);
    assert_eq!(said.status, 2);
    assert_all(&said.stderr, &["goal is a table: name one of its keys, such as goal.clearance_mm"]);
    // Three folders are a campaign too.
    let three = review(&scratch, &[&runs[1], &runs[2], &runs[3], "--json"]).json();
    assert_eq!((&three["counted"], three["runs"].as_array().map(Vec::len)), (&2.into(), Some(3)));
}

/// Rather than ignored.
#[test]
fn a_flag_that_does_not_apply_is_refused() {
    let scratch = Scratch::new();
    let dir = named(&scratch, &run(&scratch, &[]));
    let commands: &[&[&str]] = &[
        &["review", dir, "--by", "needle.radius_mm"],
        &["review", dir, dir, "--html", "x.html"],
        &["review", "runs", "--html", "x.html"],
        &["review", dir, "--repair", "--html", "x.html"],
        &["review", "runs", "--by", "needle.radius"],
        &["review", "runs", "--by", "nosuch"],
    ];
    insta::assert_snapshot!(refusals(&scratch, commands));
    assert!(!scratch.path().join("x.html").exists());
    // A campaign has no page, so --no-html is true of it.
    assert_eq!(review(&scratch, &["runs", "--no-html"]).status, 0);
}

#[test]
fn a_run_still_being_written_is_not_offered_for_repair() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    leave_open(&scratch, &dir);
    let bench = lock(&scratch.path().join(&dir)).expect("a configuration").expect("unlocked");
    let said = review(&scratch, &[&dir]);
    assert_all(&said.stdout, &[": being written", "the run is still going on"]);
    assert!(!said.stdout.contains("--repair"), "{}", said.stdout);
    let campaign = review(&scratch, &["runs"]).stdout;
    assert_all(&campaign, &["going on: 1"]);
    let verdict = [&dir, "--verdict", "valid", "--reason", "x"];
    assert_eq!(review(&scratch, &verdict).status, 3, "a verdict on a record that is locked");
    drop(bench);
    assert_all(&review(&scratch, &[&dir]).stdout, &[": open", "--repair"]);
}

#[test]
fn without_its_configuration_a_run_is_shown_without_limits() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    fs::remove_file(scratch.path().join(&dir).join("config.toml")).expect("removed");
    let said = review(&scratch, &[&dir, "--json"]);
    assert_eq!(said.status, 2);
    let json = said.json();
    assert_eq!(
        (&json["condition"], &json["limits"]["tip_age_s_max"]),
        (&"edited".into(), &Value::Null)
    );
    assert_all(
        &json["warnings"].to_string(),
        &["config.toml is missing", "the limits are unknown"],
    );
    assert_all(&json["error"].to_string(), &[&dir, "config.toml is missing"]);
    let other = run(&scratch, &[]);
    let compared = review(&scratch, &[&other, &dir, "--json"]);
    assert_eq!(compared.status, 2);
    assert_eq!(compared.json()["error"], json["error"]);
    let whole = review(&scratch, &[&other, "--json"]);
    assert_eq!((whole.status, whole.json().get("error")), (0, None));
}

fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir(to).expect("a folder");
    for file in fs::read_dir(from).expect("a folder").flatten() {
        fs::copy(file.path(), to.join(file.file_name())).expect("a copy");
    }
}

/// One run and a campaign show the same figures, computed from the steps.
#[test]
fn a_repaired_record_is_incomplete_wherever_it_is_shown() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    leave_open(&scratch, &dir);
    assert_eq!(review(&scratch, &[&dir, "--repair"]).status, 0);
    let one = review(&scratch, &[&dir, "--json"]).json();
    assert_eq!(one["condition"], "incomplete");
    assert!(one["figures"]["insertion_mm"].as_f64() > Some(5.0), "{one}");
    assert!(one["figures"]["steps"].is_u64(), "{one}");
    let campaign = review(&scratch, &["runs", "--json"]).json();
    let line = &campaign["runs"][0];
    assert_eq!(line["insertion_mm"], one["figures"]["insertion_mm"]);
    assert_eq!(line["condition"], "incomplete");
    assert_all(&review(&scratch, &["runs"]).stdout, &["stopped, incomplete"]);
}

#[test]
fn a_file_that_is_not_our_report_is_not_overwritten() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    let report = scratch.path().join(&dir).join("report.html");
    fs::write(&report, "<p>my notes</p>").expect("written");
    let said = review(&scratch, &[&dir]);
    assert_eq!((said.status, said.stdout.lines().last()), (3, Some("completed")));
    assert_all(&said.stderr, &["report.html: exists and is not a report of this program"]);
    let json = review(&scratch, &[&dir, "--json"]).json();
    assert_all(&json["error"].to_string(), &["exists and is not a report of this program"]);
    assert_eq!((&json["report"], &json["outcome"]), (&Value::Null, &"completed".into()));
    assert_eq!(fs::read_to_string(&report).expect("notes"), "<p>my notes</p>");
    fs::remove_file(&report).expect("removed");
    for _ in 0..2 {
        assert_eq!(review(&scratch, &[&dir]).status, 0, "our own report is not made again");
    }
}

#[test]
fn huge_numbers_or_a_pipe_as_steps_csv_do_not_hang_review() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    let steps = scratch.path().join(&dir).join("steps.csv");
    let text = fs::read_to_string(&steps).expect("steps");
    let huge = |line: &str, value: &str| {
        let mut values: Vec<&str> = line.split(',').collect();
        values[1] = value;
        values.join(",")
    };
    let lines = text.lines().zip(0..).map(|(line, n)| match n {
        3 => huge(line, "1e308"),
        4 => huge(line, "-1e308"),
        _ => line.to_owned(),
    });
    fs::write(&steps, lines.map(|line| line + "\n").collect::<String>()).expect("written");
    let said = review(&scratch, &[&dir]);
    assert_eq!(said.status, 2, "{}", said.stderr);
    assert_all(&said.stdout, &["so this is not the record of that run any more"]);
    fs::remove_file(&steps).expect("removed");
    let made = std::process::Command::new("mkfifo").arg(&steps).status().expect("mkfifo");
    assert!(made.success());
    let said = review(&scratch, &[&dir]);
    assert_eq!(said.status, 3, "{}", said.stdout);
    assert_all(&said.stderr, &["steps.csv: not a regular file"]);
}

#[test]
fn all_verdicts_are_kept_and_the_last_counts() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    for (verdict, reason) in [("invalid", "wrong gain"), ("valid", "it was the other run")] {
        let said = review(&scratch, &[&dir, "--verdict", verdict, "--reason", reason]);
        assert_eq!(said.status, 0, "{}", said.stderr);
    }
    let said = review(&scratch, &[&dir]);
    assert_all(&said.stdout, &["whole", "verdict     valid, it was the other run"]);
    let folder = RunFolder::open(&scratch.path().join(&dir)).expect("a sealed record");
    assert_eq!(folder.manifest.verdicts.len(), 2);
}

#[test]
fn an_open_record_is_shown_and_closed_by_repair() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    leave_open(&scratch, &dir);
    let steps = scratch.path().join(&dir).join("steps.csv");
    let text = fs::read_to_string(&steps).expect("steps");
    fs::write(&steps, &text[..text.len() - 9]).expect("a truncated file");
    let said = review(&scratch, &[&dir]);
    assert_all(&said.stdout, &[": open", "--repair", "off plane (true)", "not closed: "]);
    let said = review(&scratch, &[&dir, "--verdict", "valid", "--reason", "x"]);
    assert_eq!(said.status, 2);
    assert_all(&said.stderr, &["a verdict needs a closed record", "--repair"]);
    let said = review(&scratch, &[&dir, "--repair"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert_all(&said.stdout, &["closed: ", "6 steps"]);
    let said = review(&scratch, &[&dir]);
    assert_all(
        &said.stdout,
        &[": incomplete", "closed by a repair", "off plane (true)", "stopped: the bench ended"],
    );
    assert_eq!(review(&scratch, &[&dir, "--repair"]).status, 2, "repaired twice");
}

/// The figures of an open record come from its steps.
#[test]
fn figures_of_steps_that_cannot_be_read_are_unknown() {
    let scratch = Scratch::new();
    let (dir, other) = (run(&scratch, &[]), run(&scratch, &[]));
    leave_open(&scratch, &dir);
    let path = scratch.path().join(&dir).join("steps.csv");
    let text = fs::read_to_string(&path).expect("steps");
    let mut lines: Vec<&str> = text.lines().collect();
    lines.remove(3);
    fs::write(&path, lines.join("\n") + "\n").expect("written");
    let said = review(&scratch, &[&dir]);
    assert_all(&said.stdout, &["steps.csv: step 3 follows step 1", "off plane (true)"]);
    lines[2] = "1,0.5";
    fs::write(&path, lines.join("\n") + "\n").expect("written");
    let said = review(&scratch, &[&dir, "--json"]);
    let json = said.json();
    assert!(
        json["figures"]["insertion_mm"].is_null() && json["figures"]["steps"].is_null(),
        "{json}"
    );
    assert_eq!(json["outside"], serde_json::json!([]));
    let said = review(&scratch, &[&dir]);
    assert!(!said.stdout.contains("OUTSIDE"), "{}", said.stdout);
    let depth = said.stdout.lines().find(|line| line.starts_with("depth ")).expect("a depth");
    assert!(depth.split_whitespace().nth(1) == Some("-"), "{depth}");
    let said = review(&scratch, &[&dir, &other]);
    assert_all(&said.stdout, &["steps.csv: line 3: 2 fields where the header has "]);
}

#[test]
fn the_newest_run_is_the_last_to_start_whatever_its_name() {
    let scratch = Scratch::new();
    let earlier = run(&scratch, &[]);
    fs::rename(scratch.path().join(earlier), scratch.path().join("runs/zz-copy")).expect("renamed");
    let later = run(&scratch, &[]);
    fs::create_dir(scratch.path().join("runs/zzz")).expect("a folder");
    assert_eq!(review(&scratch, &["--json", "--no-html"]).json()["run_dir"], *later);
}

#[test]
fn a_missing_run_rrd_is_made_again_by_repair() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    let recording = scratch.path().join(&dir).join("run.rrd");
    fs::remove_file(&recording).expect("removed");
    let said = review(&scratch, &[&dir, "--no-html"]);
    let warning = "warning     run.rrd is missing; make it: needle-bench review ";
    assert!(said.stdout.contains(warning) && said.stdout.contains(" --repair"), "{}", said.stdout);
    // Nothing is read from it.
    let said = needle_bench(&scratch, &["replay", &dir]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let repaired = || {
        let said = review(&scratch, &[&dir, "--repair"]);
        assert_eq!(said.status, 0, "{}", said.stderr);
        assert_all(&said.stdout, &["run.rrd made"]);
        assert!(recording.is_file());
        let said = review(&scratch, &[&dir, "--json"]).json();
        assert_eq!(said["condition"], "whole", "{said}");
        assert!(!said["warnings"].to_string().contains("run.rrd"), "{said}");
    };
    repaired();
    fs::write(&recording, "damaged").expect("written");
    let said = review(&scratch, &[&dir, "--no-html"]);
    assert_all(&said.stdout, &["warning     run.rrd had ", " --repair"]);
    assert_eq!(needle_bench(&scratch, &["replay", &dir]).status, 0);
    repaired();
    assert_eq!(review(&scratch, &[&dir, "--repair"]).status, 2, "there is nothing to repair");
}

/// Without the inputs nothing can be replayed.
#[test]
fn a_record_without_inputs_is_named() {
    let scratch = Scratch::new();
    let dir = run(&scratch, &[]);
    leave_open(&scratch, &dir);
    let inputs = scratch.path().join(&dir).join("inputs.log");
    fs::write(&inputs, "").expect("emptied");
    let said = review(&scratch, &[&dir, "--repair"]);
    assert_all(&said.stderr, &["run.rrd ends before the run: inputs.log has no inputs"]);
    leave_open(&scratch, &dir);
    fs::remove_file(&inputs).expect("removed");
    let said = review(&scratch, &[&dir, "--repair"]);
    assert_all(&said.stdout, &["; inputs.log is missing"]);
}

#[test]
fn bad_records_and_verdicts_are_refused() {
    let scratch = Scratch::new();
    let whole = named(&scratch, &run(&scratch, &[]));
    fs::create_dir(scratch.path().join("empty")).expect("a folder");
    let mut screens = refusals(
        &scratch,
        &[
            &["review", "gone"],
            &["review", "empty"],
            &["review", whole, "empty"],
            &["review", whole, whole, "--repair"],
            &["review", whole, "--verdict", "invalid"],
            &["review", whole, "--verdict", "invalid", "--reason", " "],
        ],
    );
    let path = scratch.path().join(whole);
    let manifest = fs::read_to_string(path.join("manifest.json")).expect("a manifest");
    let spoil = |from: &str, to: &str| {
        fs::write(path.join("manifest.json"), manifest.replacen(from, to, 1)).expect("written");
    };
    spoil("\"format\": 2", "\"format\": 99");
    screens += &refusals(&scratch, &[&["review", whole]]);
    spoil("completed", "stopped");
    screens += &refusals(&scratch, &[&["review", whole]]);
    spoil("", "");

    // An edited file is shown, with the warning that it was edited.
    edit(&path.join("steps.csv"));
    let said = review(&scratch, &[whole]);
    assert_eq!(said.status, 2);
    assert_all(&said.stdout, &[": edited", "steps.csv was edited", "off plane"]);
    screens += &refusals(
        &scratch,
        &[
            &["review", whole, "--verdict", "valid", "--reason", "x"],
            &["review", whole, "--repair"],
        ],
    );
    insta::assert_snapshot!(screens);
}

/// Changes a digit.
fn edit(path: &Path) {
    let text = fs::read_to_string(path).expect("a file");
    fs::write(path, text.replacen("0.1", "0.2", 1)).expect("written");
}
