//! `[[emulator.fault]]` and the switches of emulated drives.

use std::time::Duration;

use super::*;
use crate::emulator::drive::{Model, Switches};

#[test]
fn faults_are_read_in_the_order_of_the_file() {
    let config = loaded(
        "[[emulator.fault]]\nat_mm = 10\nkind = \"delay\"\naxis = \"rotation\"\nframes = \"pdo\"\n\
         toward = \"drives\"\ndelay_ms = 2.5\ncount = 3\nduration_s = 0.1\n\
         [[emulator.fault]]\nat_s = 1.5\nkind = \"drive-fault\"\ncode = 0x8611\n\
         [[emulator.fault]]\nat_s = 0\nkind = \"foreign\"\nframe = \"181#0102\"\nperiod_ms = 20\n",
        &[],
    );
    let stage = config.virtual_stage().expect("valid");
    let read: Vec<_> =
        stage.faults.iter().map(|f| (f.at_mm, f.start_after, f.to_string())).collect();
    let at = |ms| Some(Duration::from_millis(ms));
    let expected = [
        (Some(10.0), None, "rotation: PDOs to the drives late by 2.5 ms, 3 of them, for 0.1 s"),
        (None, at(1500), "both drives: fault 0x8611 following error"),
        (None, at(0), "foreign frame 181#0102 every 20 ms"),
    ];
    assert_eq!(read, expected.map(|(mm, after, text)| (mm, after, text.to_owned())));
    let again = loaded(&config.to_toml().expect("TOML"), &[]);
    assert_eq!(again, config);
}

/// The drives monitor the heartbeat of the bench.
#[test]
fn a_heartbeat_fault_toward_the_drives_hits_the_bench_node() {
    let set = "emulator.fault=[{ at_s = 1, kind = \"drop\", frames = \"heartbeat\", \
               toward = \"drives\" }]";
    let stage = loaded("", &[set, "can.bench_node=100"]).virtual_stage().expect("valid");
    let fault = stage.faults[0].to_string();
    assert_eq!(fault, "both drives: heartbeats of node 100 to the drives lost");
}

#[test]
fn every_kind_of_fault_loads_with_the_keys_it_needs() {
    for kind in [
        "kind = \"drop\"",
        "kind = \"delay\", delay_ms = 1",
        "kind = \"duplicate\"",
        "kind = \"reorder\"",
        "kind = \"corrupt\", byte = 1, mask = 2",
        "kind = \"resize\", length = 5",
        "kind = \"silent\"",
        "kind = \"restart\"",
        "kind = \"stall\"",
        "kind = \"drive-fault\", code = 0x4210",
        "kind = \"negative-switch\"",
        "kind = \"positive-switch\"",
        "kind = \"emergency-stop\"",
        "kind = \"no-voltage\"",
        "kind = \"bus-off\"",
        "kind = \"bus-down\"",
        "kind = \"bus-full\"",
        "kind = \"bus-stuck\", duration_s = 0.05",
        "kind = \"foreign\", frame = \"080#\"",
    ] {
        let set = format!("emulator.fault=[{{ at_mm = 1, {kind} }}]");
        let stage = loaded("", &[&set]).virtual_stage().expect("valid");
        assert_eq!(stage.faults.len(), 1, "{kind}");
    }
}

#[test]
fn a_fault_without_a_key_it_needs_is_refused() {
    for (fault, message) in [
        ("kind = \"stall\"", "a fault of kind \"stall\" needs at_mm or at_s"),
        ("at_mm = 1, kind = \"delay\"", "a fault of kind \"delay\" needs delay_ms"),
        ("at_mm = 1, kind = \"resize\"", "a fault of kind \"resize\" needs length"),
        ("at_mm = 1, kind = \"drive-fault\"", "a fault of kind \"drive-fault\" needs code"),
        ("at_mm = 1, kind = \"foreign\"", "a fault of kind \"foreign\" needs frame"),
    ] {
        assert_eq!(
            set_refusal(&[&format!("emulator.fault=[{{ {fault} }}]")]),
            format!("--set emulator.fault[0]: {message}")
        );
    }
    assert_eq!(
        refusal("\n[[emulator.fault]]\nkind = \"stall\"\n"),
        "bench.toml:3: emulator.fault[0]: a fault of kind \"stall\" needs at_mm or at_s"
    );
    for (frames, toward) in [("emergency", "drives"), ("sync", "bench")] {
        let set = format!(
            "emulator.fault=[{{ at_mm = 1, kind = \"drop\", frames = \"{frames}\", \
             toward = \"{toward}\" }}]"
        );
        let error = set_refusal(&[&set]);
        let expected = format!("emulator.fault[0]: frames = \"{frames}\" needs toward = ");
        assert!(error.contains(&expected), "{error}");
    }
    assert_eq!(
        set_refusal(&["emulator.fault=[{ at_mm = 1, at_s = 2, kind = \"stall\" }]"]),
        "--set emulator.fault[0].at_s is given along with emulator.fault[0].at_mm: give one of \
         the two"
    );
    let error = set_refusal(&["emulator.fault=[{ at_mm = 1, kind = \"foreign\", frame = \"1\" }]"]);
    assert!(error.contains("emulator.fault[0].frame is \"1\", allowed: a frame"), "{error}");
}

#[test]
fn a_key_that_the_kind_of_fault_does_not_have_is_refused() {
    assert_eq!(
        refusal("[[emulator.fault]]\nkind = \"drop\"\nat_mm = 10\ncode = 0x8611\n"),
        "bench.toml:4: emulator.fault[0].code: a fault of kind \"drop\" has no such key, only at_mm, \
         at_s, duration_s, axis, frames, toward, count"
    );
    for (kind, key) in [
        ("duplicate", "delay_ms = 1"),
        ("reorder", "length = 1"),
        ("corrupt", "length = 1"),
        ("stall", "toward = \"drives\""),
        ("silent", "frames = \"sdo\""),
        ("bus-off", "axis = \"insertion\""),
        ("bus-down", "count = 3"),
        ("bus-full", "axis = \"both\""),
        ("stall", "frames = \"any\""),
        ("foreign", "axis = \"rotation\""),
        ("emergency-stop", "period_ms = 5"),
    ] {
        let error =
            set_refusal(&[&format!("emulator.fault=[{{ at_s = 1, kind = \"{kind}\", {key} }}]")]);
        assert!(error.contains("has no such key, only at_mm, at_s, duration_s"), "{error}");
    }
}

/// A recorded configuration has these keys in every fault.
#[test]
fn default_values_of_keys_that_the_kind_does_not_have_are_accepted() {
    let defaults = "axis = \"both\", frames = \"any\", toward = \"bench\"";
    loaded("", &[&format!("emulator.fault=[{{ at_s = 1, kind = \"bus-off\", {defaults} }}]")]);
}

#[test]
fn switches_are_converted_to_counts_of_the_drive() {
    let switches = "emulator.insertion_switches_mm={ negative = -2, positive = 10, home = 1 }";
    let stage =
        loaded("", &[switches, "emulator.drives=\"epos4\""]).virtual_stage().expect("valid");
    let (insertion, rotation) = (&stage.insertion.0, &stage.rotation.0);
    let counts = Switches {
        negative_counts: Some(-2 * 4646),
        positive_counts: Some(10 * 4646),
        home_counts: Some(4646),
    };
    assert_eq!((insertion.switches, insertion.model), (counts, Model::Epos4));
    assert_eq!(rotation.switches, Switches::default());
    // A drive with the opposite sign has its switches swapped.
    let turned = loaded("", &[switches, "stage.insertion.sign=-1"]).virtual_stage().expect("valid");
    let counts = Switches {
        negative_counts: Some(-10 * 4646),
        positive_counts: Some(2 * 4646),
        home_counts: Some(-4646),
    };
    assert_eq!(turned.insertion.0.switches, counts);
}
