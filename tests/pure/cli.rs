//! The command line: whole runs, exit statuses, messages.

use crate::support::program::{Scratch, needle_bench, refusals, repository};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Stdio};

const FILES: [&str; 7] = [
    "config.toml",
    "manifest.json",
    "steps.csv",
    "can.log",
    "tracker.ndjson",
    "inputs.log",
    "run.rrd",
];

const RUN_5_MM: [&str; 4] =
    ["run", "--json", "--set", "insertion={ depth_mm = 5, plane_out_of_reach = \"insert\" }"];

#[test]
fn a_console_needs_a_terminal() {
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["run", "--console"]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("--console needs a terminal"), "{}", said.stderr);
    assert!(!scratch.path().join("runs").exists());
    // This is checked before the preflight, which takes seconds.
    let rig = repository("bench-config/rig-epos4.toml");
    let said = needle_bench(&scratch, &["run", &rig, "--rehearse", "--console"]);
    assert!(said.stderr.starts_with("error: --console needs a terminal"), "{}", said.stderr);
}

#[test]
fn a_run_without_arguments_completes_and_leaves_its_record() {
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["run"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert_eq!(said.stdout.lines().last(), Some("completed"));
    let folders: Vec<_> = std::fs::read_dir(scratch.path().join("runs")).unwrap().collect();
    assert_eq!(folders.len(), 1);
    let dir = folders.into_iter().next().unwrap().unwrap().path();
    assert!(dir.file_name().unwrap().to_string_lossy().ends_with("-virtual"));
    for file in FILES {
        let size = std::fs::metadata(dir.join(file)).map(|meta| meta.len()).unwrap_or(0);
        assert!(size > 0, "{file} is missing or empty");
    }
    let steps = std::fs::read_to_string(dir.join("steps.csv")).unwrap();
    assert_eq!(steps.lines().count(), 1 + 251, "a row per millimetre from 0 to 250");
    assert!(steps.starts_with("step,time_s,insertion_mm,rotation_rad,rotation_cmd_rad_per_mm,"));
    let manifest: Value =
        serde_json::from_str(&std::fs::read_to_string(dir.join("manifest.json")).unwrap()).unwrap();
    assert_eq!(manifest["outcome"], "completed");
    assert_eq!(manifest["drives"].as_array().map(Vec::len), Some(2));
    assert_eq!(manifest["dropped"]["text_files"], 0);
}

#[test]
fn a_live_view_whose_port_is_taken_is_refused_before_the_run() {
    let scratch = Scratch::new();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let live = format!("--live={}", taken.local_addr().expect("an address"));
    let said = needle_bench(&scratch, &["run", &live]);
    assert_eq!(said.status, 3, "{}", said.stderr);
    assert!(said.stderr.contains("Address already in use"), "{}", said.stderr);
    assert!(!scratch.path().join("runs").exists());
}

#[test]
fn run_json_has_its_documented_keys() {
    let scratch = Scratch::new();
    let said =
        needle_bench(&scratch, &["run", "--json", "--quiet", "--set", "insertion.depth_mm=200"]);
    assert_eq!((said.status, said.stderr.as_str()), (0, ""));
    let json = said.json();
    assert_eq!(json["outcome"], "completed");
    assert_eq!(json["stop_reason"], Value::Null);
    assert_eq!(json["plane_missed_by_mm"], Value::Null);
    assert!((json["insertion_mm"].as_f64().unwrap() - 200.0).abs() < 1e-3);
    assert!(json["off_plane_rms_mm"].as_f64().unwrap() < 1.0);
    for key in ["estimate_rms", "final_error"] {
        for coordinate in ["x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg"] {
            assert!(json[key][coordinate].is_f64(), "{key}.{coordinate} in {json}");
        }
    }
    assert!(said.run_dir(&scratch).is_dir());
}

/// The run is shorter than the baseline of its observer. Where the true tip is, the emulator knows all the same.
#[test]
fn the_distance_of_an_emulated_run_without_an_estimate_is_called_true() {
    let sets = ["observer.kind=finite-difference", "insertion.depth_mm=5"];
    let sets = sets.into_iter().chain(["insertion.plane_out_of_reach=insert"]);
    let arguments = ["run", "--quiet"].into_iter().chain(sets.flat_map(|set| ["--set", set]));
    let said = needle_bench(&Scratch::new(), &arguments.collect::<Vec<_>>());
    assert!(said.stdout.contains(" mm RMS over the last third (true); "), "{}", said.stdout);
    assert!(!said.stdout.contains("last step"), "no estimate: {}", said.stdout);
}

/// The refusal comes before power and names the key that allows the run, which then ends with the distance from
/// the plane.
#[test]
fn a_plane_out_of_reach_is_refused_or_reported_at_the_end() {
    let scratch = Scratch::new();
    let far = ["--set", "emulator.start.x_mm=100", "--set", "insertion.depth_mm=150"];
    for sets in [&["--set", "emulator.start.x_mm=500"][..], &far] {
        let said = needle_bench(&scratch, &[&["run", "--quiet", "--json"], sets].concat());
        let json = said.json();
        let reason = json["stop_reason"].as_str().unwrap_or_default();
        assert_eq!(said.status, 1, "{reason}");
        assert!(
            reason.starts_with("insertion: the plane is out of reach: the tip is "),
            "{reason}"
        );
        assert!(reason.ends_with("; see insertion.plane_out_of_reach"), "{reason}");
        assert!(reason.chars().count() <= 200, "{reason}");
        assert_eq!(json["emulated"]["end"]["insertion_true_mm"], 0.0);
        let events = std::fs::read_to_string(said.run_dir(&scratch).join("events.log")).unwrap();
        assert!(!events.contains("operation enabled"), "{events}");
    }
    let insert = "insertion={ depth_mm = 10, plane_out_of_reach = \"insert\" }";
    let said = needle_bench(&scratch, &["run", "--set", insert]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let last = said.stdout.lines().last().unwrap_or_default();
    let (start, end) = (
        "completed, not in the plane: ",
        "; start nearer to it, or insert deeper if the tip was still approaching it",
    );
    assert!(last.starts_with(start) && last.ends_with(end), "{last}");
    let json = needle_bench(&scratch, &["run", "-q", "--json", "--set", insert]).json();
    assert_eq!(json["outcome"], "completed");
    assert!(json["plane_missed_by_mm"].as_f64().is_some_and(|mm| mm > 4.0), "{json}");
}

/// To the last bit. Another seed gives another run.
#[test]
fn a_seed_repeats_a_run() {
    let scratch = Scratch::new();
    let steps = |seed: &str| {
        let depth = "insertion={ depth_mm = 40, plane_out_of_reach = \"insert\" }";
        let said = needle_bench(&scratch, &["run", "--json", "-q", "--seed", seed, "--set", depth]);
        std::fs::read_to_string(said.run_dir(&scratch).join("steps.csv")).unwrap()
    };
    let first = steps("7");
    assert_eq!(first, steps("7"));
    assert_ne!(first, steps("8"));
}

/// The name of a folder has the second at which its run started; these two start within one second.
#[test]
fn a_run_folder_is_never_overwritten() {
    let scratch = Scratch::new();
    let first = needle_bench(&scratch, &RUN_5_MM).run_dir(&scratch);
    let before = std::fs::read(first.join("steps.csv")).unwrap();
    let second = needle_bench(&scratch, &RUN_5_MM).run_dir(&scratch);
    assert_ne!(first, second);
    assert_eq!(std::fs::read(first.join("steps.csv")).unwrap(), before);
}

#[test]
fn the_recorded_configuration_repeats_the_run() {
    let scratch = Scratch::new();
    let arguments = [
        "run",
        "--json",
        "-q",
        "--set",
        "insertion={ depth_mm = 30, plane_out_of_reach = \"insert\" }",
        "--set",
        "emulator.seed=5",
    ];
    let first = needle_bench(&scratch, &arguments).run_dir(&scratch);
    let config = first.join("config.toml").display().to_string();
    let second = needle_bench(&scratch, &["run", &config, "--json", "-q"]).run_dir(&scratch);
    let read = |dir: &Path| std::fs::read_to_string(dir.join("steps.csv")).unwrap();
    assert_eq!(read(&first), read(&second));
}

#[test]
fn a_stopped_run_ends_with_its_reason_and_exits_1() {
    let scratch = Scratch::new();
    // To come into the plane the base has to turn further back than this limit.
    let said = needle_bench(&scratch, &["run", "-q", "--set", "stage.rotation.min_deg=-10"]);
    assert_eq!(said.status, 1, "{}{}", said.stdout, said.stderr);
    let last = said.stdout.lines().last().unwrap();
    assert!(last.starts_with("stopped: stage: rotation: "), "{last}");
    assert!(last.contains("limit"), "{last}");
    let dir =
        std::fs::read_dir(scratch.path().join("runs")).unwrap().next().unwrap().unwrap().path();
    let manifest = std::fs::read_to_string(dir.join("manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["outcome"], "stopped");
    assert_eq!(Some(last.trim_start_matches("stopped: ")), manifest["stop_reason"].as_str());
}

#[test]
fn bad_configurations_are_refused_with_the_key() {
    let scratch = Scratch::new();
    let texts = [
        "[insertion]\nspeed_mm_s = 1\n",
        "[insertion]\ndepth_mm = -5\n",
        "[insertion]\ndepth_mm = \"150 mm\"\n",
        "[insertion]\ndepth_mm = 500\n",
        "[tracker]\nlatency_ms = nan\n",
        "[stage.rotation]\nnode = 1\n",
        "[observer]\nkind = \"couple\"\n",
        "[can]\ninterface = \"memory\"\n[stage]\nhardware = true\n",
        "[can]\ninterface = \"vcan0\"\n[tracker]\nsource = \"openigtlink\"\n",
        "[can]\ninterface = \"can0\"\n[tracker]\nsource = \"openigtlink\"\n",
        "[tracker]\nsource = \"openigtlink\"\n",
        "[tracker]\nlatency_ms = 600\n",
        "[insertion]\narrival_mm = 0.9\n",
        "[insertion]\nstep_mm = 0.1\n[can]\nsync_ms = 100\n",
        "[insertion\n",
    ];
    let mut screens = String::new();
    for text in texts {
        scratch.write("bench.toml", text);
        screens += &(text.to_owned() + &refusals(&scratch, &[&["run", "bench.toml"]]));
        assert!(!scratch.path().join("runs").exists(), "{text:?} left a run folder");
    }
    insta::assert_snapshot!(screens);
}

#[test]
fn bad_arguments_are_refused_with_the_argument() {
    let scratch = Scratch::new();
    let commands: &[&[&str]] = &[
        &["run", "absent.toml"],
        &["run", "--set", "insertion.dpeth_mm=3"],
        &["run", "--set", "insertion.depth_mm"],
        &["run", "--deep"],
        &["insert"],
        &["rnu"],
        &["stage", "jgo"],
        &["run", "--seed", "-1"],
        &["study", "--seed", "-1"],
        &["check", "."],
        &["evaluate"],
        &["check", "--listen", "0"],
        &["check", "--listen", "5"],
        &["check", "--print", "--json"],
    ];
    insta::assert_snapshot!(refusals(&scratch, commands));
}

/// It is bad usage, also after a mistyped command.
#[cfg(unix)]
#[test]
fn an_argument_that_is_not_utf_8_is_refused() {
    use std::os::unix::ffi::OsStrExt;
    for (words, reason) in
        [(&["check", "--set"][..], "invalid UTF-8"), (&["rnu"], "unrecognized subcommand 'rnu'")]
    {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        command.args(words).arg(std::ffi::OsStr::from_bytes(b"\xff.toml"));
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{words:?}");
        assert!(String::from_utf8_lossy(&output.stderr).contains(reason), "{words:?}");
    }
}

/// Commands with long reasons and long lists of allowed values.
#[test]
fn every_line_of_a_message_is_under_200_characters() {
    let scratch = Scratch::new();
    let fault = "emulator.fault=[{ kind = \"emergency-stop\", at_mm = 1 }]";
    let far = ["--set", "emulator.start.x_mm=100", "--set", "insertion.depth_mm=100"];
    for arguments in [
        &["check", "--set", "emulator.fault=[{ kind = \"x\" }]"][..],
        &["check", "--set", "tracker.latency_ms=600"],
        &["run", "--set", fault],
        &[&["run"][..], &far].concat(),
        &["stop", "--set", "can.interface=can9", "--set", "stage.insertion.node=1"],
        &["stage", "--virtual", "status"],
        &["review"],
    ] {
        let said = needle_bench(&scratch, arguments);
        let long = |line: &&str| line.chars().count() >= 200;
        assert_eq!(said.screen().lines().find(long), None, "{arguments:?}");
    }
}

/// The message names the first byte that is not text.
#[test]
fn a_binary_file_is_refused_as_configuration() {
    let scratch = Scratch::new();
    let mut screens = String::new();
    for bytes in [&b"name = \"a\"\n\0"[..], b"\x7fELF\xff"] {
        std::fs::write(scratch.path().join("bench.toml"), bytes).unwrap();
        screens += &refusals(&scratch, &[&["check", "bench.toml"]]);
    }
    insta::assert_snapshot!(screens);
}

#[test]
fn a_record_folder_that_is_a_file_is_refused() {
    let scratch = Scratch::new();
    scratch.write("taken", "");
    let said = needle_bench(&scratch, &["run", "--set", "record.dir=taken"]);
    assert_eq!(said.status, 3, "{}", said.stderr);
    insta::assert_snapshot!(said.screen());
}

#[test]
fn a_run_that_nobody_can_resume_is_warned_about() {
    let scratch = Scratch::new();
    let run =
        ["run", "--quiet", "--set", "insertion={ depth_mm = 1, plane_out_of_reach = \"insert\" }"];
    for (resume, is_warned) in [("operator", true), ("automatic", false)] {
        let set = format!("tracker.resume={resume}");
        let said = needle_bench(&scratch, &[&run[..], &["--set", &set]].concat());
        assert_eq!(said.status, 0, "{}", said.stderr);
        let warning =
            "warning: tracker.resume is \"operator\", but only the keys of --console resume";
        assert_eq!(said.stderr.contains(warning), is_warned, "{}", said.stderr);
    }
}

/// A limit of a law that does not steer has no effect.
#[test]
fn a_section_without_effect_is_warned_about() {
    let scratch = Scratch::new();
    let limit = "[control.feedback_linearization]\nrotation_max_deg_per_mm = 20\n";
    scratch.write("bench.toml", limit);
    let said = needle_bench(&scratch, &["check", "bench.toml"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    insta::assert_snapshot!(said.screen());
    let json = needle_bench(&scratch, &["check", "bench.toml", "--json"]).json();
    let warnings: Vec<_> =
        json["warnings"].as_array().unwrap().iter().flat_map(Value::as_str).collect();
    assert_eq!(said.stderr, warnings.iter().map(|w| format!("warning: {w}\n")).collect::<String>());
    let chosen = ["check", "bench.toml", "--set", "control.kind=feedback-linearization"];
    assert_eq!(needle_bench(&scratch, &chosen).stderr, "");
}

/// One object on stdout.
#[test]
fn json_is_printed_for_failed_commands_too() {
    let scratch = Scratch::new();
    let mut screens = String::new();
    for (arguments, status) in [
        (&["run", "--json", "absent.toml"][..], 2),
        (&["run", "--json", "--set", "record.dir=/proc/none"], 3),
        (&["check", "--json", "absent.toml"], 2),
        (&["evaluate", "--json", "absent.csv"], 2),
        (&["check", "--json", "--listen", "0"], 2),
    ] {
        let said = needle_bench(&scratch, arguments);
        assert_eq!(said.status, status, "{arguments:?}: {}", said.stderr);
        let json = said.json();
        assert!(json["error"].is_string(), "{arguments:?}: {json}");
        if arguments[0] == "run" {
            assert_eq!(json.get("outcome"), Some(&Value::Null), "{json}");
        }
        screens += &said.screen();
    }
    insta::assert_snapshot!(screens);
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_stderr_or_a_closed_stdout_does_not_stop_a_run() {
    let scratch = Scratch::new();
    let run = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        command.args(RUN_5_MM).current_dir(scratch.path());
        command
    };
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let output = run().stderr(full).output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(json["outcome"], "completed");

    let mut unread = run().stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    drop(unread.stdout.take());
    assert_eq!(unread.wait().unwrap().code(), Some(0));
}

/// The pipe is full from the start, and nothing reads it.
#[cfg(target_os = "linux")]
#[test]
fn a_blocked_stderr_does_not_hold_a_run_up() {
    use std::io::Write as _;
    let scratch = Scratch::new();
    let (unread, mut writer) = std::io::pipe().unwrap();
    // The capacity of a pipe is 64 KiB.
    writer.write_all(&[b'.'; 1 << 16]).unwrap();
    let status = Command::new(env!("CARGO_BIN_EXE_needle-bench"))
        .args(RUN_5_MM)
        .current_dir(scratch.path())
        .stdout(Stdio::null())
        .stderr(writer)
        .status()
        .unwrap();
    assert_eq!(status.code(), Some(0));
    drop(unread);
}

#[test]
fn the_virtual_stage_refuses_a_duration_out_of_range() {
    for seconds in ["1e30", "0", "-1", "nan", "soon"] {
        let output = Command::new(env!("CARGO_BIN_EXE_vcan-stage"))
            .arg(format!("--for={seconds}"))
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(2), "{seconds}");
        assert!(String::from_utf8_lossy(&output.stderr).contains("0.001 to 1000000 seconds"));
    }
}

/// A failure of the environment (exit 3), before any run folder.
#[test]
fn an_absent_can_interface_is_reported_with_the_next_step() {
    let scratch = Scratch::new();
    let vcan = repository("bench-config/vcan.toml");
    for command in [&["run", &vcan][..], &["check", &vcan, "--connect"]] {
        let arguments: Vec<&str> =
            command.iter().copied().chain(["--set", "can.interface=vcan97"]).collect();
        let said = needle_bench(&scratch, &arguments);
        assert_eq!(said.status, 3, "{}", said.stderr);
        // The message differs if the kernel has no CAN support.
        assert!(said.stderr.contains("vcan97"), "{}", said.stderr);
        assert!(said.stderr.contains("sudo "), "{}", said.stderr);
        assert!(!scratch.path().join("runs").exists());
    }
}

#[test]
fn check_passes_on_the_emulated_stage_and_prints_what_it_read() {
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["check", "--json"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert_eq!(said.json()["configuration"], "ok");
    let said = needle_bench(&scratch, &["check", "--connect"]);
    let emulated = "PASS  bus                      memory: not a CAN interface (no limit)";
    assert_eq!(said.stdout.lines().next(), Some(emulated), "{}", said.stdout);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let printed = needle_bench(&scratch, &["check", "--print"]);
    let path = scratch.write("printed.toml", &printed.stdout);
    let again = needle_bench(&scratch, &["check", &path.display().to_string(), "--print"]);
    assert_eq!(printed.stdout, again.stdout);
}

/// The rig's configuration as shipped.
#[test]
fn a_rig_without_registration_is_refused() {
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["run", &repository("bench-config/rig-epos4.toml")]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("tracker.registration"), "{}", said.stderr);
}

#[test]
fn a_run_on_hardware_without_a_terminal_needs_yes_and_a_preflight_that_passes() {
    let scratch = Scratch::new();
    let rig = repository("bench-config/rig-epos4.toml");
    let registration = "tracker.registration={ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, \
                        pitch_deg = 0.0, roll_deg = 0.0 }";
    let sets = ["--set", registration, "--set", "can.interface=nocan9"];
    let said = needle_bench(&scratch, &[&["run", &rig][..], &sets].concat());
    assert_eq!((said.status, said.stdout.as_str()), (2, ""));
    assert!(
        said.stderr.ends_with("`needle-bench check CONFIG --connect`, then give --yes\n"),
        "{}",
        said.stderr
    );
    let said = needle_bench(&scratch, &[&["run", &rig, "--yes", "--json"][..], &sets].concat());
    assert_eq!(said.status, 3, "{}", said.stderr);
    let json = said.json();
    assert_eq!(json["outcome"], serde_json::Value::Null);
    let checks = json["preflight"].as_array().unwrap();
    for check in checks {
        let has = |key: &str| check[key].as_str().is_some_and(|text| !text.is_empty());
        let passes = check["verdict"] == "PASS";
        assert!(has("found") && has("limit") && (passes || has("next_step")), "{check}");
    }
    let verdict = |name: &str| {
        let check = checks.iter().find(|check| check["name"] == name);
        check.unwrap_or_else(|| panic!("{name}: {json}"))["verdict"].clone()
    };
    assert_eq!(verdict("drives"), "FAIL");
    assert_eq!(verdict("stage prove"), "WARN");
    assert_eq!(verdict("bus"), "FAIL");
    assert_eq!(verdict("registration"), "WARN", "typed in");
    assert_eq!(verdict("tip"), "WARN", "the placeholder");
    assert!(said.stderr.ends_with("nothing has moved\n"), "{}", said.stderr);
    assert!(!scratch.path().join("runs").exists());
    // `check` runs without a registration, and lists it as a FAIL.
    let said =
        needle_bench(&scratch, &["check", &rig, "--connect", "--listen", "0.1", sets[2], sets[3]]);
    assert_eq!(said.status, 3, "{}", said.stderr);
    assert!(said.stdout.contains("FAIL  registration             missing"), "{}", said.stdout);
}
