//! Configurations that are refused, and the text of the error.

use super::*;

#[test]
fn an_unknown_key_is_refused_with_the_nearest_known_one() {
    assert_eq!(
        refusal("\n[insertion]\ndepth_mm = 100\nspeed_mm_s = 3\n"),
        "bench.toml:4: unknown key \"insertion.speed_mm_s\"; did you mean \
         \"insertion.speed_mm_per_s\"?"
    );
    assert_eq!(
        set_refusal(&["insertion.dpeth_mm=3"]),
        "--set insertion.dpeth_mm: unknown key; did you mean \"insertion.depth_mm\"?"
    );
    assert_eq!(
        refusal("depth_mm = 100"),
        "bench.toml:1: unknown key \"depth_mm\"; did you mean \"insertion.depth_mm\"?"
    );
    assert_eq!(
        set_refusal(&["study.seed=3"]),
        "--set study.seed: unknown key; give it to the study as an option: --seed"
    );
    assert_eq!(
        refusal("[insertoin]\ndepth_mm = 100\nstep_mm = 1"),
        "bench.toml:1: unknown key \"insertoin\"; did you mean \"insertion\"?"
    );
    assert_eq!(
        refusal("record.zzz = 1"),
        "bench.toml:1: unknown key \"record.zzz\"; known in [record] are dir, free_mb_min, on_failure, \
         operator, phantom"
    );
    assert_eq!(
        refusal("\"insertion.depth_mm\" = 1"),
        "bench.toml:1: unknown key \"\"insertion.depth_mm\"\"; did you mean \"insertion.depth_mm\"?"
    );
}

#[test]
fn a_value_of_the_wrong_type_is_refused() {
    assert_eq!(
        refusal("[insertion]\ndepth_mm = \"150 mm\""),
        "bench.toml:2: insertion.depth_mm is \"150 mm\", expected a number in mm"
    );
    assert_eq!(
        set_refusal(&["insertion.depth_mm=150 mm"]),
        "--set insertion.depth_mm is \"150 mm\", expected a number in mm"
    );
    assert_eq!(
        refusal("can.sync_ms = 10.0"),
        "bench.toml:1: can.sync_ms is 10.0, expected a whole number in ms"
    );
    assert_eq!(
        refusal("insertion = 5"),
        "bench.toml:1: insertion is 5, expected a table, { depth_mm = …, speed_mm_per_s = …, \
         acceleration_mm_per_s2 = …, mode = …, … }"
    );
    assert_eq!(
        refusal("stage.insertion.counts_per_mm = 4646"),
        "bench.toml:1: stage.insertion.counts_per_mm is 4646, expected a table, { counts = …, mm = … }"
    );
    assert_eq!(
        refusal("insertion.depth_mm = { value = 5 }"),
        "bench.toml:1: insertion.depth_mm is a table, expected a number in mm"
    );
    assert_eq!(
        refusal("[[plane]]\nx_mm = 1\n"),
        "bench.toml:1: plane is an array of tables, expected a table, { x_mm = …, y_mm = …, z_mm = …, \
         yaw_deg = …, … }"
    );
    assert_eq!(
        refusal("observer.coupled.fibre_poles_per_mm = [0.1]"),
        "bench.toml:1: observer.coupled.fibre_poles_per_mm is [0.1], expected 2 numbers, each \
         over 0 to 1 per mm"
    );
    assert_eq!(refusal("name = 1979-05-27"), "bench.toml:1: name is 1979-05-27, expected a string");
    assert_eq!(
        refusal("stage.insertion.vendor_id = \"maxon\""),
        "bench.toml:1: stage.insertion.vendor_id is \"maxon\", expected a 32-bit whole number or \
         \"any\""
    );
}

#[test]
fn a_value_out_of_range_is_refused_with_the_range() {
    assert_eq!(
        refusal("\n\n\n\n\n[insertion]\ndepth_mm = -5"),
        "bench.toml:7: insertion.depth_mm is -5, allowed: over 0 to 1000 mm"
    );
    assert_eq!(
        refusal("insertion.depth_mm = 0.0"),
        "bench.toml:1: insertion.depth_mm is 0.0, allowed: over 0 to 1000 mm"
    );
    assert_eq!(
        refusal("insertion.depth_mm = nan"),
        "bench.toml:1: insertion.depth_mm is nan, not finite, allowed: over 0 to 1000 mm"
    );
    assert_eq!(
        refusal("insertion.depth_mm = 1e999"),
        "bench.toml:1: insertion.depth_mm is 1e999, not finite, allowed: over 0 to 1000 mm"
    );
    assert_eq!(
        refusal("can.sync_ms = 101"),
        "bench.toml:1: can.sync_ms is 101, allowed: 1 to 100 ms"
    );
    assert_eq!(
        refusal("stage.insertion.node = 0x80"),
        "bench.toml:1: stage.insertion.node is 0x80, allowed: 1 to 127"
    );
    assert_eq!(
        refusal("emulator.seed = 99999999999999999999999999999999999999999"),
        "bench.toml:1: emulator.seed is 99999999999999999999999999999999999999999, allowed: 0 to \
         9007199254740991"
    );
    assert_eq!(
        refusal("observer.coupled.reduced_poles_per_mm = [\n 0.1,\n -0.1,\n 0.1]"),
        "bench.toml:3: observer.coupled.reduced_poles_per_mm[1] is -0.1, allowed: over 0 to 1 per \
         mm"
    );
    assert_eq!(
        refusal("observer.kind = \"cuopled\""),
        "bench.toml:1: observer.kind is \"cuopled\", allowed: \"coupled\" or \"finite-difference\" or \
         \"invariant\""
    );
    assert_eq!(
        refusal("stage.rotation.sign = 0"),
        "bench.toml:1: stage.rotation.sign is 0, allowed: 1 or -1"
    );
    assert_eq!(
        refusal("name = \"../x\""),
        "bench.toml:1: name is \"../x\", allowed: 1 to 64 letters, digits, '.', '_' or '-'"
    );
    assert_eq!(
        refusal("tracker.address = \"localhost\""),
        "bench.toml:1: tracker.address is \"localhost\", allowed: host:port, such as \
         \"127.0.0.1:18944\", or \"-\" for standard input"
    );
    assert_eq!(
        refusal("can.interface = \"can 0\""),
        "bench.toml:1: can.interface is \"can 0\", allowed: \"memory\", \"udp\", \
         \"udp:ADDRESS:PORT\" or the name of a CAN interface such as \"can0\""
    );
}

#[test]
fn an_invalid_raw_sdo_is_refused_with_its_line() {
    assert_eq!(
        refusal("[[stage.insertion.sdo]]\nindex = 0x2310\nsubindex = 0\nvalue = 40000\nbits = 8"),
        "bench.toml:4: stage.insertion.sdo[0].value is 40000, allowed: -128 to 255"
    );
    assert_eq!(
        refusal("[[stage.insertion.sdo]]\nindex = 0x2310\nsubindx = 0\nvalue = 1\nbits = 16"),
        "bench.toml:1: stage.insertion.sdo[0].subindex is missing and has no default here, \
         expected a whole number\n\
         bench.toml:3: unknown key \"stage.insertion.sdo[0].subindx\"; did you mean \
         \"stage.insertion.sdo[0].subindex\"?"
    );
    assert_eq!(
        refusal("stage.insertion.sdo = [1]"),
        "bench.toml:1: stage.insertion.sdo[0] is 1, expected a table, { bits = …, index = …, subindex \
         = …, value = …, … }"
    );
}

#[test]
fn a_ratio_with_one_number_is_refused() {
    assert_eq!(
        refusal("stage.rotation.counts_per_turn = { counts = 8000 }"),
        "bench.toml:1: stage.rotation.counts_per_turn.turns is missing and has no default here, \
         expected a whole number"
    );
}

#[test]
fn a_real_stage_without_nodes_scales_and_signs_is_refused() {
    let error = refusal(
        "stage.hardware = true\ncan.interface = \"can0\"\ntracker.source = \"openigtlink\"",
    );
    for key in ["insertion.node", "insertion.counts_per_mm.counts", "insertion.sign"] {
        assert!(
            error.contains(&format!("stage.{key} is missing and has no default here")),
            "{error}"
        );
    }
    assert_eq!(error.lines().count(), 11, "{error}");
    assert_eq!(error.lines().last(), Some("and 6 more"));
}

#[test]
fn text_that_is_not_toml_is_refused_with_its_place() {
    assert_eq!(
        refusal("[insertion]\ndepth_mm = = 3\n"),
        "bench.toml:2:12: extra `=`, expected nothing"
    );
    assert_eq!(
        refusal("[insertion]\ndepth_mm = 3\ndepth_mm = 4\n"),
        "bench.toml:3:1: insertion.depth_mm is given twice, first on line 2: keep one"
    );
    assert_eq!(
        refusal("insertion.depth_mm = 3\n[can]\nsync_ms = 10\n[insertion]\nstep_mm = 1\n"),
        "bench.toml:4:2: insertion is given twice, first on line 1: keep one"
    );
    assert_eq!(
        refusal(
            "[[emulator.fault]]\nkind = \"stall\"\n[[emulator.fault]]\nat_s = 1\n\"at_s\" = 2\n"
        ),
        "bench.toml:5:1: emulator.fault[1].at_s is given twice, first on line 4: keep one"
    );
    assert_eq!(
        refusal("plane = { x_mm = 1, x_mm = 2 }"),
        "bench.toml:1:21: x_mm is given twice: keep one"
    );
    assert_eq!(
        set_refusal(&["plane={ x_mm = 1, x_mm = 2 }"]),
        "--set plane: x_mm is given twice: keep one"
    );
    for (written, unit) in [("20 mm", "mm"), ("20mm # deep", "mm"), ("20 mm/s²", "mm/s²")] {
        let error = refusal(&format!("[insertion]\ndepth_mm = {written}\n"));
        let (_, error) = error.split_once(": ").expect("a place");
        assert_eq!(
            error,
            format!("depth_mm is 20 {unit}: write only the number, in the unit of the key's name")
        );
    }
    assert_eq!(refusal("name = 3 # = 4\nname == 5"), "bench.toml:2:7: extra `=`, expected nothing");
    assert_eq!(
        set_refusal(&["insertion.depth_mm"]),
        "--set insertion.depth_mm: expected key=value, for example insertion.depth_mm=100"
    );
    assert_eq!(
        set_refusal(&["observer.shadows=[1"]),
        "--set observer.shadows: [1 is not a TOML value: unclosed array, expected `]`"
    );
}

#[test]
fn all_problems_are_reported_at_once_in_the_order_of_the_file() {
    let text = "[insertion]\nstep_mm = 99\ndpth_mm = 1\nmode = \"fast\"\n[can]\nsync_ms = true\n";
    let error = load(text, &["record.dir=3"]).expect_err("refused").to_string();
    assert_eq!(
        error,
        "bench.toml:2: insertion.step_mm is 99, allowed: 0.1 to 10 mm\n\
         bench.toml:3: unknown key \"insertion.dpth_mm\"; did you mean \"insertion.depth_mm\"?\n\
         bench.toml:4: insertion.mode is \"fast\", allowed: \"continuous\" or \"stepwise\"\n\
         bench.toml:6: can.sync_ms is true, expected a whole number in ms\n\
         --set record.dir is 3, expected a string"
    );
}

/// In a file this is a table in place of a value.
#[test]
fn a_key_below_a_value_is_refused() {
    assert_eq!(
        set_refusal(&["insertion.depth_mm.x=5"]),
        "--set insertion.depth_mm.x: unknown key; insertion.depth_mm has no keys below it; allowed as its \
         value: over 0 to 1000 mm"
    );
    assert_eq!(
        set_refusal(&["name.foo=1"]),
        "--set name.foo: unknown key; name has no keys below it; allowed as its value: 1 to 64 letters, digits, \
         '.', '_' or '-'"
    );
    for set in [
        "insertion.depth_mm.x.y=5",
        "insertion.depth_mm[0]=5",
        "observer.shadows[7]=\"coupled\"",
        "observer.shadows[0].x=1",
        "stage.insertion.following_error_mm.x=1",
        "control.kind.x=1",
    ] {
        let error = set_refusal(&[set]);
        assert!(
            error.contains("unknown key; ") && error.contains("has no keys below it"),
            "{error}"
        );
    }
}

/// The planner's lattice would have headings without end.
#[test]
fn a_curvature_under_that_of_the_largest_radius_is_refused() {
    assert_eq!(
        set_refusal(&["needle.curvature_per_mm=1e-9"]),
        "--set needle.curvature_per_mm is 1e-9, allowed: 0.00001 to 0.1 per mm"
    );
}
