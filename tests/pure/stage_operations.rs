//! The command `needle-bench stage`, on the virtual stage.

use crate::support::program::{Said, Scratch, needle_bench, refusals};
use std::process::Command;

fn stage(scratch: &Scratch, arguments: &[&str]) -> Said {
    needle_bench(scratch, &[&["stage", "--virtual"], arguments].concat())
}

#[test]
fn status_shows_identity_and_position_and_leaves_no_record() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["status", "--set", "emulator.insertion_start_mm=12.5"]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""));
    let lines: Vec<&str> = said.stdout.lines().collect();
    assert!(lines[0].starts_with("insertion   node 1, vendor 0x000002F1"), "{}", said.stdout);
    assert!(lines[0].ends_with("at 12.500 mm (58075 counts)"), "{}", said.stdout);
    assert!(lines[1].ends_with("at 0.000 deg (0 counts)"), "{}", said.stdout);
    assert!(!scratch.path().join("runs").exists(), "status left a record");

    let json = stage(&scratch, &["status", "--json"]).json();
    assert_eq!(json["insertion"]["state"], "switch on disabled");
    assert_eq!(json["insertion"]["position_mm"], 0.0);
    assert_eq!(json["rotation"]["position_deg"], 0.0);
    assert_eq!(json["rotation"]["node"], 2);
}

#[test]
fn a_jog_leaves_a_record_and_says_where_it_went() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["jog", "--axis", "insertion", "--by", "2mm", "--quiet"]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""));
    let lines: Vec<&str> = said.stdout.lines().collect();
    assert_eq!(lines[0], "insertion   from 0.000 to 2.000 mm");
    assert_eq!(lines.last(), Some(&"completed"));

    let said = stage(&scratch, &["jog", "--axis", "rotation", "--by", "-10deg", "--json", "-q"]);
    let json = said.json();
    assert_eq!((said.status, json["outcome"].as_str()), (0, Some("completed")));
    let moved = json["axes"][0]["to_deg"].as_f64().unwrap();
    assert!((moved + 10.0).abs() < 0.01, "{json}");
    let dir = said.run_dir(&scratch);
    // The second of two folders within a second has a number behind its name.
    let name = dir.to_string_lossy();
    assert!(name.trim_end_matches("-2").ends_with("-virtual-jog"), "{name}");
    let manifest = std::fs::read_to_string(dir.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["outcome"], "completed");
    assert_eq!(manifest["drives"].as_array().map(Vec::len), Some(2));
    let log = std::fs::read_to_string(dir.join("can.log")).unwrap();
    assert!(log.contains(" 080# "), "no SYNC in can.log");
}

#[test]
fn a_jog_goes_to_a_position_at_a_speed() {
    let scratch = Scratch::new();
    let start = ["--set", "emulator.insertion_start_mm=5"];
    let jog = ["jog", "--axis", "insertion", "-q"];
    let said = stage(
        &scratch,
        &[&jog[..], &["--to", "2.5mm", "--speed", "0.5mm/s", "--json"], &start].concat(),
    );
    let json = said.json();
    assert_eq!((said.status, &json["axes"][0]["from_mm"]), (0, &5.0.into()), "{}", said.stderr);
    assert!((json["axes"][0]["to_mm"].as_f64().unwrap() - 2.5).abs() < 0.01, "{json}");
    // 2.5 mm at 0.5 mm/s, bring-up and stop included.
    let duration_s = json["duration_s"].as_f64().unwrap();
    assert!((5.0..6.5).contains(&duration_s), "{json}");
    let replayed = needle_bench(&scratch, &["replay", json["run_dir"].as_str().unwrap()]);
    assert_eq!(replayed.stdout.lines().last(), Some("identical"), "{}", replayed.screen());
    let turn = ["jog", "--axis", "rotation", "--to", "10deg"];
    let commands: &[&[&str]] = &[
        &[&jog[..], &["--to", "2mm", "--by", "2mm"]].concat(),
        &jog,
        &[&jog[..], &["--to", "2deg"]].concat(),
        &[&jog[..], &["--by", "2mm", "--speed", "11mm/s"]].concat(),
        &[&jog[..], &["--by", "2mm", "--speed", "2mm"]].concat(),
        &[&jog[..], &["--by", "2mm", "--speed", "-1mm/s"]].concat(),
        &turn,
    ];
    let commands: Vec<Vec<&str>> =
        commands.iter().map(|command| [&["stage", "--virtual"], *command].concat()).collect();
    let commands: Vec<&[&str]> = commands.iter().map(Vec::as_slice).collect();
    insta::assert_snapshot!(refusals(&scratch, &commands));
}

#[test]
fn a_jog_past_a_limit_is_refused_with_the_limit() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["jog", "--axis", "insertion", "--by", "311mm"]);
    assert_eq!(said.status, 1);
    assert!(!said.stderr.contains("enabling"), "{}", said.stderr);
    assert_eq!(
        said.stdout.lines().last(),
        Some(
            "stopped: stage: insertion: 311.000 mm is over the limit of 310.000 mm (stage.insertion.max_mm)"
        )
    );
    let said = stage(&scratch, &["jog", "--axis", "insertion", "--by", "-1.5mm", "-q"]);
    assert_eq!(said.status, 1);
    assert_eq!(
        said.stdout.lines().last(),
        Some(
            "stopped: stage: insertion: -1.500 mm is under the limit of -1.000 mm (stage.insertion.min_mm)"
        )
    );
    let fast = ["jog", "--axis", "insertion", "--by", "1mm", "--set"];
    let said = stage(&scratch, &[&fast[..], &["stage.insertion.jog_speed_mm_per_s=11"]].concat());
    assert_eq!(said.status, 2);
    assert!(
        said.stderr
            .contains("is 11, allowed: up to stage.insertion.speed_max_mm_per_s, which is 10"),
        "{}",
        said.stderr
    );
}

#[test]
fn unusable_arguments_are_bad_usage() {
    let scratch = Scratch::new();
    let operations: &[&[&str]] = &[
        &["jog", "--axis", "insertion", "--by", "2"],
        &["jog", "--axis", "insertion", "--by", "2deg"],
        &["jog", "--axis", "rotation", "--by", "2mm"],
        &["jog", "--axis", "insertion", "--by", "1e300mm"],
        &["jog", "--axis", "insertion", "--by", "0.00001mm"],
        &["withdraw", "--by", "-2mm"],
        &["withdraw", "--by=-2mm"],
        &["withdraw", "--set", "stage.insertion.zero=start"],
        &["home", "--axis", "insertion", "--set", "can.interface=can0"],
        &["prove", "--realtime"],
        &["--realtime", "--cpu", "0", "stop"],
        &["up"],
        &["status", "--set", "can.interface=udp", "--set", "tracker.source=openigtlink"],
        &["stop"],
    ];
    let commands: Vec<Vec<&str>> =
        operations.iter().map(|operation| [&["stage", "--virtual"], *operation].concat()).collect();
    let commands: Vec<&[&str]> = commands.iter().map(Vec::as_slice).collect();
    insta::assert_snapshot!(refusals(&scratch, &commands));
    assert!(!scratch.path().join("runs").exists(), "a refusal left a run folder");
}

#[test]
fn settings_before_and_after_the_operation_both_apply() {
    let scratch = Scratch::new();
    let [limit, jog] = [["--set", "stage.insertion.max_mm=5"], ["--axis", "insertion"]];
    let other = ["--set", "name=x", "--set", "insertion.depth_mm=4"];
    let by = ["--by", "6mm", "-q"];
    let before = [&limit[..], &["jog"], &jog, &by, &other].concat();
    let after = [&other[..], &["jog"], &jog, &by, &limit].concat();
    for arguments in [before, after] {
        let said = stage(&scratch, &arguments);
        assert_eq!(said.status, 1, "{}{}", said.stdout, said.stderr);
        assert!(
            said.stdout
                .ends_with("6.000 mm is over the limit of 5.000 mm (stage.insertion.max_mm)\n"),
            "{}",
            said.stdout
        );
        assert!(said.stdout.contains("-x-jog"), "{}", said.stdout);
    }
    // The last value of a key counts.
    let twice =
        [&["--set", "name=a", "jog"][..], &jog, &["--by", "1mm", "--set", "name=b"]].concat();
    assert!(stage(&scratch, &twice).stdout.contains("-b-jog"));
}

#[test]
fn two_configurations_are_refused() {
    let scratch = Scratch::new();
    for name in ["a.toml", "b.toml"] {
        scratch.write(name, "");
    }
    let twice = ["status", "stop", "home"]
        .map(|operation| ["stage", "--config", "a.toml", operation, "--config", "b.toml"]);
    insta::assert_snapshot!(refusals(&scratch, &twice.each_ref().map(|command| &command[..])));
}

#[test]
fn withdraw_comes_back_to_where_the_axis_reads_zero() {
    let scratch = Scratch::new();
    let deep = ["--set", "emulator.insertion_start_mm=30"];
    let said = stage(&scratch, &[&["withdraw", "-q"][..], &deep].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert_eq!(said.stdout.lines().next(), Some("insertion   from 30.000 to 0.000 mm"));
    let said = stage(&scratch, &[&["withdraw", "--by", "5mm", "-q"][..], &deep].concat());
    assert_eq!(said.stdout.lines().next(), Some("insertion   from 30.000 to 25.000 mm"));
}

/// A needle must not stay in because a disk is full. Every other operation is refused.
#[test]
fn a_withdrawal_goes_on_without_a_record() {
    let scratch = Scratch::new();
    let file = scratch.write("file", "");
    let in_file = format!("record.dir={}", file.display());
    // No user can create a folder there, not even root.
    for dir in ["record.dir=/proc/runs", &in_file] {
        let set = ["--set", "emulator.insertion_start_mm=30", "--set", dir, "-q"];
        let jog = ["jog", "--axis", "insertion", "--by", "-2mm"];
        let refused = stage(&scratch, &[&jog[..], &set].concat());
        assert_eq!((refused.status, refused.stdout.as_str()), (3, ""), "{}", refused.stderr);
        let said = stage(&scratch, &[&["withdraw"], &set[..]].concat());
        let why = refused.stderr.trim().trim_start_matches("error: ");
        let warning = format!("warning: {why}; the withdrawal is not recorded\n");
        assert_eq!((said.status, said.stderr.as_str()), (3, warning.as_str()));
        let lines: Vec<&str> = said.stdout.lines().collect();
        assert_eq!(lines[0], "insertion   from 30.000 to 0.000 mm");
        assert!(lines[1].starts_with("record      none: "), "{}", said.stdout);
        assert_eq!(lines.last(), Some(&"completed"));
        let json = stage(&scratch, &[&["withdraw", "--json"], &set[..]].concat()).json();
        assert!(json["run_dir"].is_null() && json["record_error"].is_string(), "{json}");
    }
    let set = ["--set", "emulator.insertion_start_mm=3", "--set", "record.free_mb_min=4294967295"];
    let said = stage(&scratch, &[&["withdraw", "--json", "-q"], &set[..]].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    let warning = "free some, or set another record.dir; the withdrawal goes on\n";
    assert!(said.stderr.ends_with(warning), "{}", said.stderr);
    assert!(said.run_dir(&scratch).join("can.log").exists());
}

/// The record fails at 100 kB a file, as on a disk that fills: well before the end, since the 150 s of virtual time
/// give some 90,000 records, almost three times as many as wait for the writer at most.
#[test]
fn a_withdrawal_goes_on_when_its_record_fails() {
    for (operation, outcome) in [
        ("withdraw --speed 0.2mm/s", "completed"),
        ("jog --axis insertion --by -30mm --speed 0.2mm/s", "stopped: record: "),
    ] {
        let scratch = Scratch::new();
        // POSIX counts blocks of 512 bytes.
        let script = format!(
            "ulimit -f 200 && exec \"$0\" stage --virtual {operation} --set emulator.insertion_start_mm=30"
        );
        let mut limited = Command::new("sh");
        limited.args(["-c", &script, env!("CARGO_BIN_EXE_needle-bench")]);
        let ended = limited.current_dir(scratch.path()).output().expect("the program starts");
        let [stdout, stderr] =
            [&ended.stdout, &ended.stderr].map(|bytes| String::from_utf8_lossy(bytes));
        let last = stdout.lines().last().unwrap_or_default();
        assert!(last.starts_with(outcome), "{stdout}{stderr}");
        let is_withdrawal = operation.starts_with("withdraw");
        assert_eq!(
            stderr.contains("not recorded; the withdrawal goes on"),
            is_withdrawal,
            "{stderr}"
        );
        assert_eq!(stdout.starts_with("insertion   from 30.000 to 0.000 mm"), is_withdrawal);
        assert_eq!(
            ended.status.code(),
            Some(if is_withdrawal { 3 } else { 1 }),
            "{stdout}{stderr}"
        );
    }
}

#[test]
fn home_homes_both_axes_and_other_commands_ask_for_it() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["home", "-q", "--set", "emulator.insertion_start_mm=5"]);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    let lines: Vec<&str> = said.stdout.lines().collect();
    assert_eq!(lines[..2], ["insertion   home, at 0.000 mm", "rotation    home, at 0.000 deg"]);

    // The switch is 30 degrees before the start, and the axis reads 0 there.
    let said = stage(
        &scratch,
        &[
            "home",
            "--axis",
            "rotation",
            "-q",
            "--set",
            "stage.rotation.homing.method=24",
            "--set",
            "emulator.rotation_switches_deg.home=0",
            "--set",
            "emulator.rotation_start_deg=30",
        ],
    );
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    assert_eq!(said.stdout.lines().next(), Some("rotation    home, at 0.000 deg"));

    let needs = "stage.insertion.reference=homing";
    for arguments in [
        &["run", "-q", "--set", needs][..],
        &["stage", "--virtual", "jog", "--axis", "insertion", "--by", "1mm", "-q", "--set", needs],
        &["stage", "--virtual", "withdraw", "-q", "--set", needs],
    ] {
        let said = needle_bench(&scratch, arguments);
        assert_eq!(said.status, 1, "{arguments:?}");
        let last = said.stdout.lines().last().unwrap();
        assert!(last.starts_with("stopped: stage: node 1 (insertion): not homed"), "{last}");
        assert!(
            last.ends_with("home it first: needle-bench stage home CONFIG --axis insertion"),
            "{last}"
        );
    }
}

/// The emulated drives have none of these methods.
#[test]
fn a_homing_in_an_unknown_direction_is_a_warning() {
    let scratch = Scratch::new();
    for (axis, method, warns) in [
        ("insertion", -3, true),
        ("insertion", 3, true),
        ("insertion", 27, false),
        ("rotation", -3, false),
    ] {
        let method = format!("stage.{axis}.homing.method={method}");
        let said = stage(
            &scratch,
            &["home", "--axis", axis, "-q", "--set", &method, "--set", "stage.insertion.sign=1"],
        );
        assert_eq!(
            said.stderr.contains("in which direction the axis moves"),
            warns,
            "{}",
            said.stderr
        );
    }
}

/// After a power cycle neither axis is homed; the other one is only held.
#[test]
fn one_axis_is_homed_while_the_other_is_not() {
    let scratch = Scratch::new();
    let needs = ["insertion", "rotation"].map(|axis| format!("stage.{axis}.reference=homing"));
    let zero = "stage.rotation.zero=0";
    let sets = ["--set", &needs[0], "--set", &needs[1], "--set", zero];
    let said = stage(&scratch, &[&["home", "--axis", "rotation", "-q"][..], &sets].concat());
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    assert_eq!(said.stdout.lines().next(), Some("rotation    home, at 0.000 deg"));
}

/// A stop at a limit may leave an axis a little outside. The way back is open for it and for the other axis, with
/// the limits as they are, also where a SYNC moves it by less than a count.
#[test]
fn axes_outside_their_limits_come_back() {
    let scratch = Scratch::new();
    for (start_mm, back, out) in [(315.0, "-0.1mm", "0.1mm"), (-4.0, "0.1mm", "-0.1mm")] {
        let start = format!("emulator.insertion_start_mm={start_mm}");
        let moved = |arguments: &[&str], sync_ms: u32| {
            let sync = format!("can.sync_ms={sync_ms}");
            let sets = ["-q", "--set", &start, "--set", &sync];
            let said = stage(&scratch, &[arguments, &sets].concat());
            let last = said.stdout.lines().last().unwrap_or_default().to_owned();
            (said.status, last + &said.stderr)
        };
        let completed = (0, "completed".to_owned());
        for sync_ms in [1, 10] {
            let by =
                |by: &str| moved(&["jog", "--axis", "insertion", &format!("--by={by}")], sync_ms);
            assert_eq!(by(back), completed, "{start_mm} mm, {sync_ms} ms");
            let (status, refused) = by(out);
            assert!(status == 1 && refused.contains("the limit of"), "{refused}");
            // The insertion is held outside.
            assert_eq!(moved(&["jog", "--axis", "rotation", "--by=10deg"], sync_ms), completed);
        }
        if start_mm > 0.0 {
            assert_eq!(moved(&["withdraw"], 10), completed);
        }
        let (status, refused) = moved(&["prove"], 10);
        assert!(status == 1 && refused.contains("stands outside its limits"), "{refused}");
    }
}

/// The last set-point of a move may be a bit past its goal, as a sum of floating-point numbers is.
#[test]
fn a_move_may_end_at_the_limit_itself() {
    let scratch = Scratch::new();
    for (start_mm, goal, limits) in [
        ("1.001", "--to=-1mm", "stage.insertion.min_mm=-1"),
        ("0.1", "--by=30mm", "stage.insertion.max_mm=30.1"),
        ("-0.1", "--by=20mm", "stage.insertion.min_mm=-0.1"),
    ] {
        let start = format!("emulator.insertion_start_mm={start_mm}");
        let sets = ["-q", "--set", &start, "--set", limits, "--set", "insertion.depth_mm=20"];
        let said = stage(&scratch, &[&["jog", "--axis", "insertion", goal][..], &sets].concat());
        assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    }
}

#[test]
fn prove_shows_that_both_drives_notice_a_silent_bench() {
    let scratch = Scratch::new();
    let said = stage(&scratch, &["prove"]);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    for axis in ["insertion", "rotation"] {
        let noticed = format!("{axis}: noticed the bench's silence after ");
        assert!(said.stderr.contains(&noticed), "{}", said.stderr);
    }
    // The proof must not take the answers to its own requests for those to another master.
    assert!(!said.stderr.contains("answer without a question"), "{}", said.stderr);
    let last = said.stdout.lines().last().unwrap();
    assert!(
        last.starts_with("proved: both drives notice a silent bench and stand: insertion after "),
        "{last}"
    );
    let reviewed = needle_bench(&scratch, &["review"]);
    assert!(reviewed.stdout.lines().any(|line| line == last), "{}", reviewed.screen());
}

/// An operator who forgot `--config` must not take the emulated stage for the rig.
#[test]
fn an_operation_without_a_named_stage_is_refused() {
    let scratch = Scratch::new();
    scratch.write("memory.toml", "can.interface = \"memory\"\n");
    let mut screens = String::new();
    for operation in [
        &["status"][..],
        &["home"],
        &["jog", "--axis", "insertion", "--by", "1mm"],
        &["withdraw"],
        &["prove"],
    ] {
        for named in [&[][..], &["--config", "memory.toml"], &["--set", "can.interface=memory"]] {
            screens += &refusals(&scratch, &[&[&["stage"], operation, named].concat()]);
        }
    }
    // A real interface alone does not name a stage either.
    screens += &refusals(&scratch, &[&["stage", "status", "--set", "can.interface=can0"]]);
    insta::assert_snapshot!(screens);
    assert!(!scratch.path().join("runs").exists());
}

#[test]
fn a_stop_without_an_interface_and_nodes_is_refused() {
    let scratch = Scratch::new();
    let commands: &[&[&str]] = &[
        &["stop"],
        &["stage", "stop"],
        &["stop", "--json", "--set", "can.interface=memory"],
        &["stop", "--json", "--set", "can.interface=can0"],
        &["stop", "--json", "--config", "absent.toml"],
    ];
    insta::assert_snapshot!(refusals(&scratch, commands));
}

/// A stop needs only the interface and the nodes; the configuration file may be missing.
#[test]
fn a_stop_that_cannot_be_sent_says_so() {
    let scratch = Scratch::new();
    let absent = ["--set", "can.interface=nocan9", "--config", "absent.toml"];
    let nodes = ["--set", "stage.insertion.node=5", "--set", "stage.rotation.node=6"];
    let said = needle_bench(&scratch, &[&["stop"][..], &absent, &nodes].concat());
    assert_eq!((said.status, said.stdout.as_str()), (3, ""), "{}", said.stderr);
    assert!(said.stderr.starts_with("error: nothing was stopped: "), "{}", said.stderr);
    assert!(said.stderr.contains("nocan9"), "{}", said.stderr);
    assert!(said.stderr.ends_with("; use the emergency stop\n"), "{}", said.stderr);
}

/// With the least limits that the configuration check accepts; a move past them would stop the operation.
#[test]
fn moves_keep_to_the_acceleration_of_their_axis() {
    let scratch = Scratch::new();
    let sets = [
        "stage.insertion.acceleration_max_mm_per_s2=40",
        "stage.insertion.jog_acceleration_mm_per_s2=35.5555",
        "stage.insertion.quick_stop_deceleration_mm_per_s2=40",
        "stage.insertion.withdraw_speed_mm_per_s=5",
        "stage.rotation.acceleration_max_deg_per_s2=24000",
        "stage.rotation.jog_acceleration_deg_per_s2=21333",
        "stage.rotation.quick_stop_deceleration_deg_per_s2=24000",
        "stage.rotation.jog_speed_deg_per_s=360",
        "emulator.insertion_start_mm=30",
    ];
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set]).collect();
    for operation in [
        &["jog", "--axis", "insertion", "--by", "0.017mm"][..],
        &["jog", "--axis", "insertion", "--by", "-3.3mm"],
        &["jog", "--axis", "rotation", "--by", "100deg"],
        &["jog", "--axis", "rotation", "--by", "-0.7deg"],
        &["withdraw"],
        &["withdraw", "--by", "0.123mm"],
    ] {
        let said = stage(&scratch, &[operation, &["-q"], &sets].concat());
        assert_eq!((said.status, said.stderr.as_str()), (0, ""), "{operation:?}: {}", said.stdout);
    }
}

/// Its record has no obstacle, and is complete without.
#[test]
fn a_motion_needs_no_mask() {
    let scratch = Scratch::new();
    let goal = "[goal]\nkind = \"target\"\nposition_mm = [0, 0, 90]\n[[goal.obstacle]]\nshape = \"mask\"\n\
                file = \"gone.nii\"\n[goal.obstacle.pose]\nx_mm = 0\ny_mm = 20\nz_mm = 40\nyaw_deg = 0\n\
                pitch_deg = 0\nroll_deg = 0\n";
    scratch.write("goal.toml", goal);
    let said = stage(&scratch, &["jog", "goal.toml", "--axis", "insertion", "--by", "1mm", "-q"]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""), "{}", said.screen());
    assert!(said.stdout.contains("look at it: rerun"), "{}", said.stdout);
}
