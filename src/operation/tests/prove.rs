//! What stops a proof while the bench is silent, and what does not.

use super::*;

fn prove(sets: &[&str]) -> Bench {
    Bench::new(&config(sets), Operation::Prove)
}

impl Bench {
    fn run_until_event(&mut self, text: &str) {
        while !self.events.iter().any(|event| event.contains(text)) {
            assert_eq!(self.operation.outcome(), None);
            self.step();
        }
    }

    fn has_proved(&self) -> bool {
        self.events.iter().any(|event| event.starts_with("proved: "))
    }
}

/// The insertion drive does nothing when the bench is silent, and stops because of its own fault.
#[test]
fn a_drive_that_stops_for_another_fault_proves_nothing() {
    let mut bench = prove(&[
        "stage.insertion.abort_connection_option=0",
        "stage.insertion.communication_error_behaviour=1",
        "can.heartbeat_timeout_ms=500",
        r#"emulator.fault=[{kind="drive-fault", code=0x4210, axis="insertion", at_s=0.8}]"#,
    ]);
    let reason = bench.reason();
    assert!(reason.starts_with("stage: insertion: emergency 0x4210"), "{reason}");
    assert!(!bench.has_proved());
}

/// 2.5 s before the drives are to notice the silence.
#[test]
fn what_stops_a_run_stops_a_proof() {
    for (fault, message) in [
        (r#"kind="drive-fault", code=0x4210, axis="rotation""#, "rotation: emergency 0x4210"),
        (r##"kind="foreign", frame="602#2B40600000000000""##, "another master on the bus: a write"),
        (r#"kind="drop", frames="pdo""#, "insertion: no TPDO1 for 2 SYNCs in a row"),
        (r##"kind="foreign", frame="000#8002""##, "another master on the bus: an NMT command"),
        (r#"kind="restart", axis="insertion""#, "insertion: boot-up message in mid-run"),
        (r#"kind="corrupt", frames="pdo", byte=3, axis="rotation""#, "rotation: following error"),
        (
            r#"kind="corrupt", frames="pdo", byte=1, mask=2, axis="rotation""#,
            "rotation: the drive no",
        ),
    ] {
        let fault = format!("emulator.fault=[{{at_s=3.6, {fault}}}]");
        let mut bench = prove(&["can.heartbeat_timeout_ms=3000", &fault]);
        let reason = bench.reason();
        assert!(reason.starts_with(&format!("stage: {message}")), "{fault}: {reason}");
        assert!(!bench.has_proved());
        assert!(bench.now < Time::from_secs_f64(4.2), "{fault}: {:?}", bench.now);
    }
}

/// No emergency message tells why: the statusword shows it before the drive can have noticed the silence.
#[test]
fn a_drive_that_leaves_operation_enabled_before_it_notices_proves_nothing() {
    let mut bench = prove(&[
        "stage.insertion.communication_error_behaviour=1",
        "can.heartbeat_timeout_ms=500",
        r#"emulator.fault=[
            {kind="drop", frames="emergency", axis="insertion", at_s=0.79, duration_s=0.05},
            {kind="drive-fault", code=0x4210, axis="insertion", at_s=0.8},
        ]"#,
    ]);
    let reason = bench.reason();
    assert!(reason.starts_with("stage: insertion: drive in fault"), "{reason}");
    assert!(!bench.has_proved());
}

#[test]
fn a_drive_that_has_not_noticed_is_watched_after_the_other_has() {
    let mut bench = prove(&[]);
    while bench.stage.drives()[0].state() != DriveState::OperationEnabled {
        bench.step();
    }
    let no_consumer = Frame::new(0x601, &[0x23, 0x16, 0x10, 1, 0, 0, 0, 0]);
    bench.stage.handle_frame(bench.now, &no_consumer);
    bench.run_until_event("rotation: noticed the bench's silence");
    bench.stage.change_drive(0, bench.now, &Fault::of(FaultKind::NoVoltage), true);
    let reason = bench.reason();
    assert!(reason.starts_with("stage: insertion: emergency 0x3220"), "{reason}");
}

/// The statusword, the NMT state or the missing TPDO1s may come before the emergency message.
#[test]
fn an_emergency_message_that_comes_after_the_statusword_proves_as_well() {
    let delay = r#"emulator.fault=[{kind="delay", frames="emergency", delay_ms=35, at_s=0.0}]"#;
    for behaviour in [0, 1, 2] {
        for option in [1, 2, 3] {
            let sets = ["insertion", "rotation"].map(|axis| {
                [
                    format!("stage.{axis}.communication_error_behaviour={behaviour}"),
                    format!("stage.{axis}.abort_connection_option={option}"),
                ]
            });
            let sets: Vec<&str> = sets.as_flattened().iter().map(String::as_str).collect();
            let mut bench = prove(&[&sets[..], &[delay]].concat());
            assert_eq!(bench.run(), Outcome::Completed, "{behaviour} {option}");
            assert!(bench.has_proved());
        }
    }
}
