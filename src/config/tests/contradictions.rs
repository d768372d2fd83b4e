//! Keys that are valid alone and contradict each other.

use super::*;

#[test]
fn two_alternatives_in_one_source_are_refused() {
    assert_eq!(
        refusal("[needle]\nradius_mm = 100\ncurvature_per_mm = 0.01"),
        "bench.toml:3: needle.curvature_per_mm is given along with needle.radius_mm: give one of \
         the two"
    );
    assert_eq!(
        refusal("emulator.noise = { uniform_mm = 1, sd_mm = 1 }"),
        "bench.toml:1: emulator.noise.sd_mm is given along with emulator.noise.uniform_mm: give \
         one of the two"
    );
    // All `--set` together are one source.
    for (one, other) in [
        ("needle.radius_mm=100", "needle.curvature_per_mm=0.01"),
        ("emulator.noise.sd_mm=1", "emulator.noise.uniform_mm=1"),
        ("tracker.registration.x_mm=1", "tracker.registration.fiducials=[]"),
        ("tracker.tip_file=tip.toml", "tracker.tip_offset_mm=[0,0,1]"),
    ] {
        for sets in [[one, other], [other, one]] {
            let error = set_refusal(&sets);
            assert!(error.contains("given along with"), "{sets:?}: {error}");
        }
    }
    // A repeated key replaces its earlier value.
    let radius = loaded("", &["needle.radius_mm=100", "needle.radius_mm=120"]);
    assert_eq!(radius.number("needle.radius_mm"), 120.0);
}

/// Each has one element or one key that is wrong. What is read without it would contradict other keys.
#[test]
fn a_key_that_is_wrong_by_itself_contradicts_no_other() {
    for set in [
        "goal.position_mm=[0, 1e6, 90]",
        "goal.workspace_mm.min=1",
        "goal.obstacle=[1]",
        "emulator.target_drift_mm_per_mm=[2, 0, 0]",
        "tracker.csv.time.s=1",
        "tracker.registration.fiducials=[1]",
    ] {
        let error = set_refusal(&[set]);
        assert_eq!(error.lines().count(), 1, "{error}");
    }
}

#[test]
fn contradictory_keys_are_refused_with_both_values() {
    assert_eq!(
        refusal("\ninsertion.depth_mm = 400"),
        "bench.toml:2: insertion.depth_mm is 400, allowed: up to stage.insertion.max_mm, which is \
         310"
    );
    assert_eq!(
        set_refusal(&[
            "insertion.speed_mm_per_s=20",
            "stage.rotation.speed_max_deg_per_s=2e3",
            "tracker.hold_after_mm=10",
        ]),
        "--set insertion.speed_mm_per_s is 20, allowed: up to \
         stage.insertion.speed_max_mm_per_s, which is 10"
    );
    assert_eq!(
        refusal("stage.rotation.speed_max_deg_per_s = 30"),
        "bench.toml:1: control.nested_saturation.rotation_max_deg_per_mm is 60: at 2 mm/s \
         that is 120 deg/s, over stage.rotation.speed_max_deg_per_s = 30; turn by 15.0000 deg/mm or \
         insert at 0.5000 mm/s"
    );
    assert_eq!(
        refusal("emulator.torsion = { half_width_deg = 10, offset_deg = -23 }"),
        "bench.toml:1: emulator.torsion: torsion offset is -23.000 deg, allowed is up to the half-width at \
         the start, 10.000 deg, in magnitude: the tip would start outside its own band"
    );
    assert_eq!(
        refusal("needle.torsion.creep_mm_per_mm = 0.01"),
        "bench.toml:1: needle.torsion: torsion creep grows by 0.01 mm per mm from 0 mm: give its length at \
         the start"
    );
    assert_eq!(
        refusal("stage.rotation.node = 1"),
        "bench.toml:1: stage.rotation.node is 1, the same as stage.insertion.node: each node \
         needs its own number"
    );
    assert_eq!(
        refusal("can.bench_node = 2"),
        "bench.toml:1: stage.rotation.node is 2, the same as can.bench_node: each node needs its \
         own number"
    );
    assert_eq!(
        refusal("can.heartbeat_ms = 150"),
        "bench.toml:1: can.heartbeat_timeout_ms is 100, allowed: at least twice can.heartbeat_ms, \
         which is 150"
    );
    assert_eq!(
        refusal("can.interface = \"vcan0\""),
        "bench.toml:1: tracker.source is \"emulated\", allowed only with can.interface = \
         \"memory\", which is \"vcan0\": it sees the emulated needle alone. Set tracker.source = \
         \"openigtlink\""
    );
    assert_eq!(
        refused(RIG, &["can.missed_feedback_max=11"]),
        "--set can.missed_feedback_max is 11, allowed with stage.hardware: up to 10, as \
         can.heartbeat_timeout_ms is 100 and can.sync_ms 10"
    );
    loaded(RIG, &["can.missed_feedback_max=10"]);
    loaded("", &["can.missed_feedback_max=11"]);
    assert_eq!(
        set_refusal(&["can.interface=vcan0"]),
        "--set can.interface: tracker.source is \"emulated\", allowed only with can.interface = \
         \"memory\", which is \"vcan0\": it sees the emulated needle alone. Set tracker.source = \
         \"openigtlink\""
    );
    let on_a_wire = [
        "can.interface=can0",
        "tracker.source=openigtlink",
        "stage.insertion.abort_connection_option=0",
    ];
    assert_eq!(
        set_refusal(&on_a_wire),
        "--set can.interface is \"can0\", which may have real drives on it, but stage.hardware is \
         false: start from bench-config/rig-epos4.toml, or name \"vcan0\" or \"udp\" for emulated \
         drives"
    );
    assert!(load("", &["can.interface=vxcan0", on_a_wire[1]]).is_ok());
    assert_eq!(
        refused(RIG, &["can.interface=udp"]),
        "--set can.interface is \"udp\", a bus made for tests, but stage.hardware is true: name the \
         interface of the real stage, such as \"can0\""
    );
    assert_eq!(
        refused(RIG, &["can.interface=memory"]),
        "--set can.interface is \"memory\", a bus made for tests, but stage.hardware is true: name \
         the interface of the real stage, such as \"can0\"\n\
         --set can.interface: tracker.source is \"openigtlink\", but can.interface = \"memory\" is \
         the emulated stage, which only its own tracker sees: name \"vcan0\" with vcan-stage on it"
    );
    assert!(
        refusal("tracker.source = \"ndjson\"").ends_with("on it, or a recording as tracker.file")
    );
    assert_eq!(
        set_refusal(&["tracker.hold_after_mm=0.1"]),
        "--set tracker.hold_after_mm is 0.1, allowed: over the 0.140 mm to standstill from \
         2 mm/s with tracker.hold_braking_mm_per_s2 = 40 and tracker.latency_ms = 0: insert slower \
         or brake harder"
    );
    assert_eq!(
        refusal("tracker.workspace = { min_mm = [0, 0, 0], max_mm = [1, 0, 1] }"),
        "bench.toml:1: tracker.workspace.min_mm is [0.0, 0.0, 0.0], allowed: each under that of \
         tracker.workspace.max_mm, which is [1.0, 0.0, 1.0]"
    );
}

#[test]
fn tracker_keys_that_contradict_the_source_are_refused() {
    assert_eq!(
        refusal("tracker.source = \"csv\""),
        "bench.toml:1: tracker.source is \"csv\", and there is no tracker.file to read"
    );
    assert_eq!(
        refusal("tracker.file = \"tip.csv\""),
        "bench.toml:1: tracker.file is \"tip.csv\", allowed with tracker.source = \"ndjson\" or \
         \"csv\", which is \"emulated\""
    );
    assert_eq!(
        refused(RIG, &["tracker.source=csv", "tracker.file=tip.csv"]),
        "--set tracker.file is \"tip.csv\", but stage.hardware is true: a recording does not see the \
         needle that would move"
    );
    assert_eq!(
        refusal("tracker.address = \"-\""),
        "bench.toml:1: tracker.address is \"-\", allowed with tracker.source = \"ndjson\", which is \
         \"emulated\""
    );
    assert_eq!(
        refusal("tracker.request = \"tdata\""),
        "bench.toml:1: tracker.request is given, allowed with tracker.source = \"openigtlink\", \
         which is \"emulated\""
    );
    assert_eq!(
        refusal("tracker.csv.time = {}"),
        "bench.toml:1: tracker.csv.time names no column, expected the name of one as s, ms, us or ns"
    );
    assert_eq!(
        refusal("tracker.csv.position = [\"x\", \"y\"]"),
        "bench.toml:1: tracker.csv.position is [\"x\", \"y\"], expected 3 strings, each the name of a \
         column"
    );
    assert_eq!(
        refusal("tracker.csv.position = [\"x\", \"y\", \" \"]"),
        "bench.toml:1: tracker.csv.position[2] is \" \", allowed: the name of a column"
    );
}

#[test]
fn correlated_noise_without_a_time_or_a_size_is_refused() {
    assert_eq!(
        set_refusal(&["emulator.noise={sd_mm=0.1,correlated_sd_mm=0.4}"]),
        "--set emulator.noise.correlated_sd_mm is given without \
         emulator.noise.correlation_time_s: give both"
    );
    assert_eq!(
        set_refusal(&["emulator.noise={correlation_time_s=0.4}"]),
        "--set emulator.noise.correlation_time_s is given without \
         emulator.noise.correlated_sd_mm: give both"
    );
    assert_eq!(
        set_refusal(&["emulator.noise={correlated_sd_mm=1,correlation_time_s=-1}"]),
        "--set emulator.noise.correlation_time_s is -1, allowed: over 0 to 3600 s"
    );
}

#[test]
fn noise_that_lasts_longer_than_the_insertion_is_refused() {
    let noise = |time: &str| {
        format!("tracker.noise={{white_sd_mm=0.1,correlated_sd_mm=0.1,correlation_time_s={time}}}")
    };
    assert_eq!(
        set_refusal(&[&noise("126")]),
        "--set tracker.noise.correlation_time_s is 126, allowed: up to the 125.000 s of the insertion; \
         noise that lasts longer is an error of the registration, tracker.registration.sd_mm"
    );
    // The advised value is itself allowed: 125.0006 s are rounded down.
    let longer = set_refusal(&["insertion.depth_mm=250.0012", &noise("125.001")]);
    assert!(longer.contains("allowed: up to the 125.000 s"), "{longer}");
    assert_eq!(
        set_refusal(&[&noise("-0.1")]),
        "--set tracker.noise.correlation_time_s is -0.1, allowed: 0 to 3600 s"
    );
    assert_eq!(
        set_refusal(&["tracker.noise={white_sd_mm=0.1}"]),
        "--set tracker.noise.correlated_sd_mm is missing and has no default here, expected a number in \
         mm\n--set tracker.noise.correlation_time_s is missing and has no default here, expected a \
         number in s"
    );
}

#[test]
fn an_error_of_a_creep_that_is_not_there_is_refused() {
    let error = "study.creep_error=[-0.3, 0.3]";
    assert_eq!(
        set_refusal(&[error]),
        "--set study.creep_error has no effect: emulator.torsion.creep_mm and creep_mm_per_mm are 0"
    );
    assert!(load("", &[error, "emulator.torsion.creep_mm=0.75"]).is_ok());
}

#[test]
fn a_target_move_without_a_tool_or_faster_than_the_needle_is_refused() {
    let moves = "study.target_move_mm=[1, 30]";
    assert_eq!(
        set_refusal(&[moves]),
        "--set study.target_move_mm has no effect without goal.tool: name the tool that is the target"
    );
    let drifts = "emulator.target_drift_mm_per_mm=[0, 0.02, 0]";
    assert_eq!(
        set_refusal(&[drifts]),
        "--set emulator.target_drift_mm_per_mm has no effect without goal.tool: name the tool that is the \
         target"
    );
    let target =
        ["goal.kind=target", "goal.tool=Target", "goal.position_mm=[0, 0, 90]", moves, drifts];
    assert!(load("", &target).is_ok());
    let near = [&["study.target_depth_mm=[20, 90]"], &target[..]].concat();
    assert_eq!(
        set_refusal(&near),
        "--set study.target_move_mm reaches 30, allowed: up to the least distance of the target from the \
         start, 20 mm; it would move faster than the needle"
    );
}

/// Only a path to a target stays in it. The default may be printed.
#[test]
fn a_workspace_on_the_way_into_the_plane() {
    let narrow = "goal.workspace_mm = { min = [-50, -20, 0], max = [50, 20, 150] }";
    assert_eq!(
        refusal(narrow),
        "bench.toml:1: goal.workspace_mm has no effect, since goal.kind is \"plane\": set goal.kind = \
         \"target\""
    );
    let part = set_refusal(&["goal.workspace_mm.max=[50, 20, 150]"]);
    assert!(part.contains("goal.workspace_mm has no effect"), "{part}");
    let target = ["goal.kind=target", "goal.position_mm=[0, 0, 90]"];
    assert!(load(narrow, &target).is_ok());
    let printed = loaded("", &[]).to_toml().expect("TOML");
    assert!(printed.contains("workspace_mm") && load(&printed, &[]).is_ok(), "{printed}");
}

/// OpenIGTLink version 1 would send both tools by one name.
#[test]
fn tools_whose_names_are_cut_to_the_same_one_are_refused() {
    let target = ["goal.kind=target", "goal.position_mm=[0.0, 0.0, 100.0]"];
    let named = |tip: &str, tool: &str| {
        let [tip, tool] = [format!("tracker.tool={tip}"), format!("goal.tool={tool}")];
        [&target[..], &[tip.as_str(), tool.as_str()]]
            .concat()
            .into_iter()
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let refusal = |tip: &str, tool: &str| {
        Config::from_sources(&[], &named(tip, tool)).expect_err("refused").to_string()
    };
    assert_eq!(
        refusal("NeedleSensorToTracker1", "NeedleSensorToTracker2"),
        "--set goal.tool \"NeedleSensorToTracker2\" and tracker.tool \"NeedleSensorToTracker1\" have the same \
         first 20 bytes, where OpenIGTLink version 1 cuts a name; rename one"
    );
    let whole = refusal("NeedleSensorToTracke", "NeedleSensorToTracker");
    assert!(whole.contains("the same first 20 bytes"), "{whole}");
    let long = refusal(&"x".repeat(64), &"x".repeat(63));
    assert!(long.chars().count() <= 200, "{long}");
    let apart = Config::from_sources(&[], &named("NeedleSensorToTrac1er", "NeedleSensorToTrac2er"));
    assert!(apart.is_ok(), "{apart:?}");
}

/// Only a path to a target leads around obstacles.
#[test]
fn obstacles_on_the_way_into_the_plane_are_refused() {
    assert_eq!(
        refusal(
            "[[goal.obstacle]]\nshape = \"sphere\"\ncentre_mm = [0.0, 0.0, 60.0]\nradius_mm = 10.0"
        ),
        "bench.toml:1: goal.obstacle has no effect, since goal.kind is \"plane\": set goal.kind = \
         \"target\""
    );
    for drawn in ["study.target_depth_mm=[20, 90]", "study.obstacles=1"] {
        let error = set_refusal(&[drawn]);
        assert!(error.contains(" has no effect, since goal.kind is \"plane\""), "{error}");
    }
}

/// Obstacles that a study draws may be as thin as those of the configuration.
#[test]
fn a_clearance_of_0_is_refused_with_drawn_obstacles() {
    let target = ["goal.kind=target", "goal.position_mm=[0.0, 0.0, 100.0]", "goal.clearance_mm=0"];
    loaded("", &target);
    let error = set_refusal(&[&target[..], &["study.obstacles=1"]].concat());
    assert!(
        error.contains("goal.clearance_mm is 0, allowed with obstacles: at least 0.1"),
        "{error}"
    );
}

/// A clearance means something only with an estimate whose uncertainty is stated, and smaller.
#[test]
fn a_target_needs_an_estimate_that_bears_the_clearance() {
    let target = "[goal]\nkind = \"target\"\nposition_mm = [0.0, 0.0, 100.0]";
    let refused = |sets: &[&str]| load(target, sets).expect_err("a refusal").to_string();
    loaded(target, &["observer.kind=coupled"]);
    for sets in [
        &["observer.kind=finite-difference"][..],
        &["observer.kind=coupled", "observer.coupled.gains=placed"],
    ] {
        let error = refused(sets);
        assert!(error.contains("needs an observer that states how well"), "{error}");
    }
    let registered = |sd_mm| format!("tracker.registration.sd_mm={sd_mm:.1}");
    let ball = "goal.obstacle=[{shape=\"sphere\",centre_mm=[0.0,20.0,50.0],radius_mm=5.0}]";
    loaded(target, &[&registered(1.0)]);
    loaded(target, &[&registered(0.9), ball]);
    let error = refused(&[&registered(1.0), ball]);
    assert!(error.contains("goal.clearance_mm is 2, allowed with obstacles: over 2.00"), "{error}");
}
