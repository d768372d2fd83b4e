//! `[[emulator.fault]]` and the switches of emulated drives.

use std::time::Duration;

use super::*;
use crate::canopen::Frame;
use crate::canopen::emcy::EmcyCode;
use crate::emulator::drive::{Model, Switches};
use crate::emulator::fault::{
    Fault, FaultKind, FaultyDrives, FrameAction, FrameClass, Toward, Trigger,
};

#[test]
fn faults_are_told_in_the_order_they_are_written() {
    let config = loaded(
        "[[emulator.fault]]\nat_mm = 10\nkind = \"delay\"\naxis = \"rotation\"\nframes = \"pdo\"\n\
         toward = \"drives\"\ndelay_ms = 2.5\ncount = 3\nduration_s = 0.1\n\
         [[emulator.fault]]\nat_s = 1.5\nkind = \"drive-fault\"\ncode = 0x8611\n\
         [[emulator.fault]]\nat_s = 0\nkind = \"foreign\"\nframe = \"181#0102\"\nperiod_ms = 20\n",
        &[],
    );
    let millis = Duration::from_millis;
    let delay = FaultKind::Frames {
        action: FrameAction::Delay(Duration::from_micros(2500)),
        frames: FrameClass::Pdo,
        toward: Toward::Drives,
        count: Some(3),
    };
    let foreign = FaultKind::Foreign { frame: Frame::new(0x181, &[1, 2]), every: Some(millis(20)) };
    let fault = |trigger, kind| Fault { trigger, kind, drives: FaultyDrives::Both, duration: None };
    let expected = [
        Fault {
            drives: FaultyDrives::Rotation,
            duration: Some(millis(100)),
            ..fault(Trigger::AtDepth(10.0), delay)
        },
        fault(Trigger::AtTime(millis(1500)), FaultKind::Drive(EmcyCode(0x8611))),
        fault(Trigger::AtTime(Duration::ZERO), foreign),
    ];
    assert_eq!(config.virtual_stage().expect("valid").faults, expected);
    let again = loaded(&config.to_toml().expect("TOML"), &[]);
    assert_eq!(again, config);
}

/// The bench's heartbeat is the one that drives watch.
#[test]
fn heartbeats_to_the_drives_are_the_benchs() {
    let set = "emulator.fault=[{ at_s = 1, kind = \"drop\", frames = \"heartbeat\", \
               toward = \"drives\" }]";
    let stage = loaded("", &[set, "can.bench_node=100"]).virtual_stage().expect("valid");
    let FaultKind::Frames { frames, .. } = stage.faults[0].kind else { panic!("of frames") };
    assert_eq!(frames.to_string(), "heartbeats of node 100");
}

#[test]
fn every_kind_is_taken_with_what_it_needs() {
    for kind in [
        "kind = \"drop\"",
        "kind = \"delay\", delay_ms = 1",
        "kind = \"duplicate\"",
        "kind = \"reorder\"",
        "kind = \"corrupt\", byte = 2",
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
fn a_fault_without_what_it_needs_is_refused() {
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
        let refused = set_refusal(&[&set]);
        let expected = format!("emulator.fault[0]: frames = \"{frames}\" go toward = ");
        assert!(refused.contains(&expected), "{refused}");
    }
    assert_eq!(
        set_refusal(&["emulator.fault=[{ at_mm = 1, at_s = 2, kind = \"stall\" }]"]),
        "--set emulator.fault[0].at_s is given along with emulator.fault[0].at_mm: give one of \
         the two"
    );
    let refused =
        set_refusal(&["emulator.fault=[{ at_mm = 1, kind = \"foreign\", frame = \"1\" }]"]);
    assert!(refused.contains("emulator.fault[0].frame is \"1\", allowed: a frame"), "{refused}");
}

#[test]
fn a_key_that_the_kind_of_fault_does_not_have() {
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
        let said =
            set_refusal(&[&format!("emulator.fault=[{{ at_s = 1, kind = \"{kind}\", {key} }}]")]);
        assert!(said.contains("has no such key, only at_mm, at_s, duration_s"), "{said}");
    }
}

/// A recorded configuration has these keys in every fault.
#[test]
fn the_defaults_of_keys_that_the_kind_of_fault_does_not_have_are_taken() {
    let defaults = "axis = \"both\", frames = \"any\", toward = \"bench\"";
    loaded("", &[&format!("emulator.fault=[{{ at_s = 1, kind = \"bus-off\", {defaults} }}]")]);
}

#[test]
fn switches_are_told_in_counts_of_the_drive() {
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
    // A drive that counts the other way has them the other way round.
    let turned = loaded("", &[switches, "stage.insertion.sign=-1"]).virtual_stage().expect("valid");
    let counts = Switches {
        negative_counts: Some(-10 * 4646),
        positive_counts: Some(2 * 4646),
        home_counts: Some(-4646),
    };
    assert_eq!(turned.insertion.0.switches, counts);
}
