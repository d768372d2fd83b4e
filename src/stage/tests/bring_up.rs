//! Bring-up, frame by frame, and against drives that misbehave.

use super::drive::VENDOR;
use super::*;
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::DriveState;
use crate::canopen::nmt::{NmtState, heartbeat_frame};

/// The fault of a bring-up after `setup`. Nothing was powered.
pub(super) fn fault_of(config: StageConfig, setup: impl FnOnce(&mut Bench)) -> String {
    let mut bench = Bench::new(config);
    setup(&mut bench);
    let fault = bench.until_fault();
    assert!(!bench.until_stopped(), "no standstill is reported");
    assert!(bench.command(0.0, 0.0).is_err());
    assert!(!bench.has_sent("201#") && !bench.has_sent("202#"), "no set-point was sent");
    fault
}

/// The frames to the insertion drive, as candump prints them. Their order matters.
#[test]
fn bring_up_sends_these_frames_in_this_order() {
    let mut bench = Bench::new(config());
    bench.until_progress(StageProgress::Enabling);
    let sent: Vec<String> = bench
        .sent
        .iter()
        .filter(|(_, f)| f.cob_id() == Some(0x601) || f.to_string().ends_with("01"))
        .map(|(_, frame)| frame.to_string())
        .collect();
    insta::assert_snapshot!(sent.join("\n"));
}

#[test]
fn bring_up_writes_the_configuration_to_both_drives() {
    let mut bench = Bench::new(config());
    bench.until_ready();
    for drive in [&bench.insertion, &bench.rotation] {
        let id = u32::from(drive.node.get());
        assert_eq!(drive.value(0x1017, 0), 100);
        assert_eq!(drive.value(0x1016, 1), 127 << 16 | 300);
        assert_eq!(drive.value(0x1400, 1), 0x200 + id);
        assert_eq!(drive.value(0x1401, 1) >> 31, 1);
        assert_eq!(drive.value(0x1600, 2), 0x607a_0020);
        assert_eq!(drive.value(0x1800, 1), 0x4000_0180 + id);
        assert_eq!(drive.value(0x1800, 2), 1);
        assert_eq!(drive.value(0x1a00, 1), 0x6041_0010);
        assert_eq!((drive.value(0x60c2, 1), drive.value(0x60c2, 2)), (10, 0xfd));
        assert_eq!(drive.value(0x1029, 1), 0, "to NMT pre-operational when the bench falls silent");
        assert_eq!((drive.value(0x6007, 0), drive.value(0x605a, 0)), (3, 6));
        assert_eq!(drive.value(0x607a, 0), drive.counts as u32);
        assert_eq!(drive.state, DriveState::OperationEnabled);
    }
}

#[test]
fn the_identity_and_the_missing_objects_of_a_drive_are_reported() {
    let mut bench = Bench::new(config());
    let event = bench.run_until(|event| matches!(event, StageEvent::Identity(..)));
    let identity = Identity {
        vendor: VENDOR,
        product: 0x6065_0000,
        revision: Some(0x0170_0000),
        serial: None,
    };
    assert_eq!(event, StageEvent::Identity(Axis::Insertion, identity));
    let skipped = StageProgress::Skipped(Axis::Insertion, ObjectAddress::new(0x1402, 1));
    bench.until_progress(skipped);
    assert_eq!(skipped.to_string(), "insertion: drive has no 0x1402:01, skipped");
}

#[test]
fn both_axes_are_enabled_at_one_sync_and_nothing_moves() {
    let mut bench = Bench::new(config());
    bench.insertion.brake_cycles = 30;
    bench.rotation.charge_cycles = 7;
    bench.until_ready();
    bench.run_for(Duration::from_millis(200));
    assert_eq!((bench.insertion.counts, bench.rotation.counts), (1000, -20));
    let feedback = bench.until_feedback();
    assert_eq!((feedback.measured.insertion_mm, feedback.measured.rotation_rad), (0.0, 0.0));
    let first = |cob_id| {
        let enables = |(_, f): &&(Time, Frame)| f.cob_id() == Some(cob_id) && f.data()[0] == 0x0f;
        bench.sent.iter().find(enables).map(|(time, _)| *time)
    };
    assert!(first(0x201).is_some());
    assert_eq!(first(0x201), first(0x202));
}

#[test]
fn positions_count_from_the_configured_zero() {
    let mut config = config();
    config.insertion.zero = Some(1000 - COUNTS_PER_MM);
    config.rotation.sign = Sign::Negative;
    config.rotation.zero = Some(COUNTS_PER_TURN - 20);
    let mut bench = Bench::new(config);
    let feedback = bench.until_feedback();
    assert_eq!(feedback.measured.insertion_mm, 1.0);
    assert_eq!(feedback.measured.rotation_rad, std::f64::consts::TAU);
}

#[test]
fn an_axis_that_stands_outside_its_limits_is_not_enabled() {
    let mut config = config();
    config.insertion.zero = Some(1000 + 2 * COUNTS_PER_MM);
    let mut bench = Bench::new(config);
    assert_eq!(
        bench.until_fault(),
        "cannot start: the axis stands outside its limits: insertion: -2.000 mm is under the \
         limit of -1.000 mm (stage.insertion.min_mm); jog it back, or correct its limits or zero"
    );
    bench.until_stopped();
    let enabled =
        bench.sent.iter().any(|(_, f)| f.cob_id() == Some(0x201) && f.data()[0] & 0x08 != 0);
    assert!(!enabled);
}

/// The operator moves it back, over less than a count at the least. The drive's own limits let it stand there.
#[test]
fn an_axis_that_stands_outside_its_limits_can_be_moved_back() {
    let mut config = config();
    config.insertion.zero = Some(1000 + 2 * COUNTS_PER_MM);
    config.insertion.quick_stop_deceleration = Some(20.0);
    let nodes = config.nodes();
    let begun = Time::from_secs_f64(1.0);
    let purpose = PerAxis::from_fn(|_| AxisUse::Move);
    let mut bench = Bench::with(Stage::for_use(config, purpose, begun), nodes);
    let feedback = bench.until_feedback();
    assert_eq!(feedback.measured.insertion_mm, -2.0);
    let at = |insertion_mm| SetPoint { insertion_mm, ..feedback.commanded };
    assert!(bench.stage.check_goal(at(-2.1)).is_err());
    for goal_mm in [-2.0, -1.5, 0.0] {
        bench.stage.check_goal(at(goal_mm)).expect("toward the inside");
    }
    let refused = bench.stage.command(at(-2.01)).expect_err("farther out");
    assert!(refused.contains("under the limit of -1.000 mm"), "{refused}");
    bench.stage.command(at(-2.0)).expect("held");
    let feedback = bench.until_feedback();
    assert_eq!(feedback.commanded.insertion_mm, -2.0);
    bench.stage.command(at(-1.99)).expect("back");
}

#[test]
fn an_absent_drive_is_a_fault_that_says_what_to_check() {
    let fault = fault_of(config(), |bench| bench.insertion.off = true);
    assert_eq!(
        fault,
        "node 1 (insertion): no answer on 601h within 5.0 s, \
         is the drive powered, node-id and bitrate right?"
    );
}

#[test]
fn a_drive_switched_on_late_is_waited_for() {
    let mut bench = Bench::new(config());
    bench.rotation.off = true;
    bench.run_for(Duration::from_secs(3));
    bench.rotation.off = false;
    bench.receive(heartbeat_frame(bench.rotation.node, NmtState::BootUp));
    bench.until_ready();
}

#[test]
fn a_drive_of_another_vendor_profile_or_mode_is_refused() {
    let mut other = config();
    other.rotation.vendor_id = Some(0x22);
    assert_eq!(
        fault_of(other, |_| {}),
        "node 2 (rotation): 0x1018:01: expected 0x00000022, received 0x000000FB, \
         is this the drive of the configuration?"
    );
    // The same type, but not the same drive.
    let mut exchanged = config();
    exchanged.rotation.serial = Some(0x11);
    let fault = fault_of(exchanged, |bench| bench.rotation.set(0x1018, 4, 0x12_u32));
    let expected =
        "node 2 (rotation): 0x1018:04: expected 0x00000011, received 0x00000012, is this";
    assert!(fault.starts_with(expected), "{fault}");
    let fault = fault_of(config(), |bench| bench.insertion.set(0x1000, 0, 0x0003_0191_u32));
    assert!(
        fault.starts_with("node 1 (insertion): 0x1000:00: device profile 401 where 402"),
        "{fault}"
    );
    let fault = fault_of(config(), |bench| bench.insertion.set(0x6502, 0, 0x25_u32));
    assert!(fault.contains("lack cyclic synchronous position"), "{fault}");
}

#[test]
fn a_written_value_that_reads_back_different_is_a_fault() {
    let mode = ObjectAddress::new(0x6060, 0);
    let fault = fault_of(config(), |bench| bench.insertion.forgets = Some(mode));
    assert_eq!(fault, "node 1 (insertion): 0x6060:00: expected 0x08, received 0x01");
}

#[test]
fn an_unanswered_sdo_is_retried_and_then_a_fault() {
    let object = ObjectAddress::new(0x1017, 0);
    let mut bench = Bench::new(config());
    bench.insertion.mute = Some((object, 2));
    bench.until_ready();

    let fault = fault_of(config(), |bench| bench.insertion.mute = Some((object, 3)));
    assert_eq!(
        fault,
        "node 1 (insertion): 0x1017:00: no SDO reply within 150 ms (attempt 3 of 3), \
         check cable, termination and bus load"
    );
}

#[test]
fn a_refused_raw_sdo_is_a_fault_with_the_abort_code() {
    let raw = |index| RawSdo { bits: 16, index, subindex: 0, value: 7, read_back: true };
    let mut config = config();
    config.insertion.sdo = vec![raw(0x2001), raw(0x2000)];
    let fault = fault_of(config, |bench| bench.insertion.set(0x2001, 0, 0_u16));
    assert_eq!(
        fault,
        "node 1 (insertion): 0x2000:00: writing 0x0007 was refused with SDO abort \
         0x06020000 object does not exist; list it in \
         optional_objects if the bench can do without"
    );
}

#[test]
fn an_optional_object_may_be_absent() {
    let object = ObjectAddress::new(0x6007, 0);
    let fault = fault_of(config(), |bench| {
        bench.insertion.objects.remove(&object);
    });
    assert!(fault.contains("0x6007:00: writing 0x0003 was refused"), "{fault}");
    let mut config = config();
    config.insertion.optional_objects = vec![object.index];
    let mut bench = Bench::new(config);
    bench.insertion.objects.remove(&object);
    bench.until_ready();
}

#[test]
fn a_drive_that_keeps_its_power_is_not_configured() {
    let mut bench = Bench::new(config());
    bench.insertion.state = DriveState::OperationEnabled;
    (bench.insertion.ignores_sdo, bench.insertion.ignores_rpdo) = (true, true);
    let fault = bench.until_fault();
    assert!(fault.contains("the drive keeps its power (statusword 0x0237"), "{fault}");
    assert!(!bench.insertion.configured_under_power);
}

/// The stop comes before it has obeyed Disable Voltage.
#[test]
fn a_drive_that_has_power_when_its_bring_up_is_stopped_is_reported_with_power() {
    let mut bench = Bench::new(config());
    bench.insertion.state = DriveState::OperationEnabled;
    (bench.insertion.ignores_sdo, bench.insertion.ignores_rpdo) = (true, true);
    bench.run_for(Duration::from_millis(100));
    bench.stage.quick_stop(bench.now);
    assert!(!bench.until_stopped());
    let reports = bench.stage.drive_reports();
    assert!(reports.insertion.says_power() && !reports.rotation.says_power());
}

/// The other drive is not the configured one, so the bring-up ends before the identity of this one is confirmed. It is
/// not written to.
#[test]
fn a_drive_left_enabled_is_reported_although_the_other_is_refused_at_once() {
    let mut config = config();
    config.rotation.vendor_id = Some(VENDOR + 1);
    let mut bench = Bench::new(config);
    bench.insertion.state = DriveState::OperationEnabled;
    assert!(bench.until_fault().contains("is this the drive of the configuration?"));
    assert!(!bench.until_stopped());
    assert!(bench.stage.drive_reports().insertion.says_power());
    assert!(!bench.has_sent("601#2"), "written to");
}

#[test]
fn a_drive_left_enabled_loses_power_before_it_is_configured() {
    let mut bench = Bench::new(config());
    bench.insertion.state = DriveState::OperationEnabled;
    bench.until_ready();
    assert!(!bench.insertion.configured_under_power);
}

/// An earlier run has left the insertion drive enabled and supervised. The bring-up waits for `object` and is
/// then stopped: the NMT commands and writes that the drive gets after the stop.
fn sent_when_interrupted_at(object: ObjectAddress) -> (Bench, Vec<String>) {
    let mut bench = Bench::new(config());
    bench.insertion.state = DriveState::OperationEnabled;
    bench.insertion.nmt = NmtState::Operational;
    bench.insertion.set(0x1016, 1, 0x007f_00c8_u32);
    bench.insertion.mute = Some((object, u32::MAX));
    bench.run_for(Duration::from_millis(100));
    let before = bench.sent.len();
    bench.stage.quick_stop(bench.now);
    assert!(!bench.until_stopped());
    let to_insertion = |frame: &Frame| match (frame.cob_id(), frame.data()) {
        (Some(0x000), [_, node]) => *node == 1,
        (Some(0x601), [command, ..]) => !matches!(command, 0x40 | 0x80),
        _ => false,
    };
    let sent = bench.sent[before..].iter().map(|(_, frame)| frame);
    let sent = sent.filter(|frame| to_insertion(frame)).map(Frame::to_string).collect();
    (bench, sent)
}

#[test]
fn an_interrupted_bring_up_takes_power_off_an_identified_drive() {
    let (off, pre_operational) = ("601#2B40600000000000", "000#8001");
    for object in [ObjectAddress::new(0x6502, 0), ObjectAddress::new(0x1018, 3)] {
        let (bench, sent) = sent_when_interrupted_at(object);
        assert_eq!(sent, [off, pre_operational], "{object}");
        assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);
        assert_eq!(bench.insertion.nmt, NmtState::PreOperational);
        assert_eq!(bench.insertion.value(0x1016, 1), 0x007f_00c8);
    }
    let (bench, sent) = sent_when_interrupted_at(ObjectAddress::new(0x1400, 1));
    assert_eq!(sent, [off, pre_operational, "601#2316100100000000"]);
    assert_eq!(bench.insertion.value(0x1016, 1), 0, "without power it needs no supervision");
}

#[test]
fn a_node_of_unknown_or_wrong_identity_is_not_written_to() {
    for (index, subindex) in [(0x1000, 0), (0x1018, 1), (0x1018, 2)] {
        let (bench, sent) = sent_when_interrupted_at(ObjectAddress::new(index, subindex));
        assert_eq!(sent, [""; 0], "{index:x}");
        assert_eq!(bench.insertion.state, DriveState::OperationEnabled, "left as it was found");
    }
    let mut config = config();
    config.rotation.product_code = Some(0x22);
    let mut bench = Bench::new(config);
    bench.insertion.state = DriveState::OperationEnabled;
    bench.until_fault();
    bench.until_stopped();
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled, "this drive is identified");
    let written = bench.sent.iter().find(|(_, frame)| match (frame.cob_id(), frame.data()) {
        (Some(0x000), [_, node]) => *node != 1,
        (Some(0x602), [command, ..]) => *command != 0x40,
        _ => false,
    });
    assert_eq!(written, None);
}

/// The soft limits in counts, wider by the following-error window: 30 ms at the highest speed unless configured.
#[test]
fn the_soft_limits_and_windows_are_written_to_the_drives() {
    let mut config = config();
    config.rotation.sign = Sign::Negative;
    config.insertion.zero = Some(500);
    config.insertion.following_error_max = Some(0.5);
    config.insertion.quick_stop_deceleration = Some(20.0);
    // The raw value is in the drive's own unit. The key tells the bench what it is, and is not written.
    config.rotation.quick_stop_deceleration = Some(6.0);
    let raw = RawSdo { bits: 32, index: 0x6085, subindex: 0, value: 77, read_back: true };
    config.rotation.sdo.push(raw);
    let mut bench = Bench::new(config);
    bench.until_ready();
    let limits = |drive: &TestDrive| [1, 2].map(|end| drive.value(0x607d, end) as i32);
    let per_mm = COUNTS_PER_MM;
    assert_eq!(limits(&bench.insertion), [500 - per_mm * 3 / 2, 500 + per_mm * 301 / 2]);
    let end = (700.6 / std::f64::consts::TAU * f64::from(COUNTS_PER_TURN)).round() as i32;
    assert_eq!(limits(&bench.rotation), [-20 - end, -20 + end]);
    assert_eq!(bench.insertion.value(0x6065, 0), 2323);
    assert_eq!(bench.rotation.value(0x6065, 0), 7235);
    assert_eq!(bench.insertion.value(0x6085, 0), 92_920);
    assert_eq!(bench.rotation.value(0x6085, 0), 77);
}

/// The rotation drive has no 0x6066; its bring-up succeeds too.
#[test]
fn the_following_error_timeout_is_written_where_the_drive_has_it() {
    let mut config = config();
    config.insertion.following_error_timeout_ms = Some(20);
    config.rotation.following_error_timeout_ms = Some(20);
    let mut bench = Bench::new(config);
    bench.insertion.set(0x6066, 0, 5000_u16);
    bench.until_ready();
    assert_eq!(bench.insertion.value(0x6066, 0), 20);
}

#[test]
fn a_wrapping_axis_gets_no_position_limits_in_its_drive() {
    let mut config = config();
    config.rotation.wraps = true;
    let mut bench = Bench::new(config);
    bench.until_ready();
    let limits = [1, 2].map(|sub| bench.rotation.value(0x607d, sub) as i32);
    assert_eq!(limits, [i32::MIN, i32::MAX], "the limits of an earlier use are gone");
}

/// A node in NMT Stopped answers no SDO, so a silent node is first sent to pre-operational.
#[test]
fn a_drive_left_in_nmt_stopped_is_brought_up() {
    let mut bench = Bench::new(config());
    bench.insertion.nmt = NmtState::Stopped;
    bench.until_ready();
    let first = |start: &str| {
        let starts = |(_, frame): &(Time, Frame)| frame.to_string().starts_with(start);
        bench.sent.iter().position(starts).expect("sent")
    };
    let (leave, identify) = (first("000#8001"), first("601#401810"));
    assert!(leave < identify);
    // By then the node has left Stopped and answers.
    let asked_after = bench.sent[identify].0.since(bench.sent[leave].0);
    assert_eq!(asked_after, Duration::from_millis(10));
}

/// Restarts the insertion drive `times` times, each time in the same step of its bring-up.
fn reboot(bench: &mut Bench, times: u32) {
    for _ in 0..times {
        let step = "taking power off, looking for faults";
        bench.until_progress(StageProgress::BringUp(Axis::Insertion, step));
        bench.receive(heartbeat_frame(bench.insertion.node, NmtState::BootUp));
    }
}

#[test]
fn a_drive_that_restarts_in_bring_up_is_brought_up_again() {
    let mut bench = Bench::new(config());
    bench.insertion.mute = Some((ObjectAddress::new(0x6040, 0), u32::MAX));
    bench.rotation.mute = Some((ObjectAddress::new(0x1018, 4), 2));
    reboot(&mut bench, 1);
    bench.insertion.mute = None;
    bench.until_progress(StageProgress::Restarted(Axis::Insertion));
    bench.until_ready();
    assert_eq!(bench.insertion.value(0x1800, 2), 1);
}

#[test]
fn a_drive_that_restarts_three_times_is_a_fault() {
    let mut bench = Bench::new(config());
    bench.insertion.mute = Some((ObjectAddress::new(0x6040, 0), u32::MAX));
    reboot(&mut bench, 3);
    assert_eq!(
        bench.until_fault(),
        "node 1 (insertion): boot-up message while taking power off, looking for faults, is its \
         supply stable?"
    );
}
