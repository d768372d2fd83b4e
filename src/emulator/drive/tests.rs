//! A drive brought up and driven frame by frame, in virtual time.

mod homing;
mod inputs;
mod node;
mod stops;

use std::time::Duration;

use proptest::prelude::*;

use super::*;
use crate::canopen::cia402::{DriveState, EnableSequence, Statusword, object};
use crate::canopen::nmt::{NmtCommand, NmtState, heartbeat_frame, nmt_frame};
use crate::canopen::pdo::MappedObject;
use crate::canopen::sdo::{AbortCode, SdoClient, SdoError, SdoReply, SdoRequest, SdoValue};
use crate::canopen::sync::sync_frame;
use crate::canopen::{Frame, ObjectAddress, cob};
use crate::emulator::fault::{Fault, FaultKind};
use crate::units::Time;

const NODE: NodeId = NodeId::new(5).unwrap();
const MASTER: NodeId = NodeId::new(127).unwrap();
const PERIOD: Duration = Duration::from_millis(10);

/// A drive and its master.
struct Bench {
    drive: Drive,
    now: Time,
    emergencies: Vec<String>,
    /// Statusword and position of the last TPDO1.
    sample: Option<(Statusword, i32)>,
}

impl Bench {
    fn new(config: DriveConfig) -> Self {
        let drive = Drive::new(config);
        let mut bench = Bench { drive, now: Time::ZERO, emergencies: vec![], sample: None };
        assert_eq!(bench.take(), ["705#00"], "boot-up");
        bench
    }

    /// An enabled drive that holds its position at `start_counts`, with PDOs mapped for CSP.
    fn enabled_at(start_counts: i64) -> Self {
        let mut bench = Bench::new(DriveConfig { start_counts, ..config() });
        bench.map_cyclic();
        bench.enable();
        bench
    }

    fn map_cyclic(&mut self) {
        for (communication, enabled, objects) in [
            (0x1400, 0x205u32, [object::CONTROLWORD, object::TARGET_POSITION]),
            (0x1800, 0x4000_0185, [object::STATUSWORD, object::POSITION_ACTUAL]),
        ] {
            let com = |sub| ObjectAddress::new(communication, sub);
            let map = |sub| ObjectAddress::new(communication + 0x200, sub);
            self.write(com(1), &(enabled | 1 << 31).to_le_bytes());
            self.write(com(2), &[1]);
            self.write(map(0), &[0]);
            for (sub, (object, bits)) in (1..).zip(objects.into_iter().zip([16, 32])) {
                let entry = MappedObject { object, bits }.to_u32();
                self.write(map(sub), &entry.to_le_bytes());
            }
            self.write(map(0), &[2]);
            self.write(com(1), &enabled.to_le_bytes());
        }
        self.write(object::INTERPOLATION_PERIOD_VALUE, &[10]);
        self.write(object::MODES_OF_OPERATION, &[8]);
        self.nmt(NmtCommand::StartRemoteNode);
    }

    fn enable(&mut self) {
        let mut sequence = EnableSequence::default();
        let hold = self.drive.position_counts_at(self.now) as i64;
        for _ in 0..10 {
            let word = self.sample.map_or(Statusword(0x0250), |(word, _)| word);
            self.cycle(sequence.step(word).0, hold);
        }
        assert_eq!(self.drive.state(), DriveState::OperationEnabled);
    }

    fn give(&mut self, frame: Frame) -> Vec<String> {
        self.drive.handle_frame(self.now, &frame);
        self.take()
    }

    fn take(&mut self) -> Vec<String> {
        let frames: Vec<Frame> = std::iter::from_fn(|| self.drive.poll_transmit()).collect();
        for frame in &frames {
            if frame.cob_id() == Some(cob::emcy(NODE)) {
                self.emergencies.push(frame.to_string());
            }
            if let (Some(0x185), &[a, b, c, d, e, f]) = (frame.cob_id(), frame.data()) {
                let word = Statusword(u16::from_le_bytes([a, b]));
                self.sample = Some((word, i32::from_le_bytes([c, d, e, f])));
            }
        }
        frames.iter().map(Frame::to_string).collect()
    }

    fn nmt(&mut self, command: NmtCommand) {
        self.give(nmt_frame(command, Some(NODE)));
    }

    /// RPDO1, then SYNC, then one period.
    fn cycle(&mut self, controlword: u16, target: i64) {
        self.command(controlword, target);
        self.give(sync_frame());
        self.pass(PERIOD);
    }

    fn command(&mut self, controlword: u16, target: i64) {
        let mut payload = controlword.to_le_bytes().to_vec();
        payload.extend((target as i32).to_le_bytes());
        self.give(Frame::new(0x205, &payload));
    }

    /// Lets time pass, waking the drive when it asks.
    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        while self.drive.deadline() <= end {
            self.now = self.drive.deadline().max(self.now);
            self.drive.handle_timeout(self.now);
            self.take();
        }
        self.now = end;
    }

    fn sdo(&mut self, request: SdoRequest) -> Result<SdoReply, SdoError> {
        let mut client = SdoClient::new(NODE, Duration::from_millis(1));
        client.start(self.now, request);
        loop {
            if let Some(result) = client.poll_result() {
                return result;
            }
            match client.poll_transmit() {
                Some(frame) => self.drive.handle_frame(self.now, &frame),
                None => client.handle_timeout(client.deadline()),
            }
            while let Some(frame) = self.drive.poll_transmit() {
                client.handle_frame(self.now, &frame);
            }
        }
    }

    fn write(&mut self, object: ObjectAddress, data: &[u8]) {
        let value = SdoValue::from_bytes(data).unwrap();
        let result = self.sdo(SdoRequest::Download(object, value));
        assert_eq!(result, Ok(SdoReply::Downloaded), "{object}");
    }

    fn read(&mut self, object: ObjectAddress) -> Vec<u8> {
        match self.sdo(SdoRequest::Upload(object)) {
            Ok(SdoReply::Uploaded(value)) => value.as_bytes().to_vec(),
            other => panic!("{object}: {other:?}"),
        }
    }

    fn state(&self) -> DriveState {
        self.drive.state()
    }

    fn position(&self) -> f64 {
        self.drive.position_counts_at(self.now)
    }
}

fn config() -> DriveConfig {
    DriveConfig::new(NODE, 0xfb, 0x6552)
}

/// A drive moving at 10,000 counts/s at position 300, in the middle of a period.
fn moving() -> Bench {
    let mut bench = Bench::enabled_at(0);
    for target in [100, 200, 300] {
        bench.cycle(0x0f, target);
    }
    bench.command(0x0f, 400);
    bench.give(sync_frame());
    bench
}

#[test]
fn a_drive_identifies_itself_and_refuses_invalid_writes() {
    let mut bench = Bench::new(config());
    assert_eq!(bench.read(ObjectAddress::new(0x1000, 0)), [0x92, 0x01, 0x02, 0x00]);
    let name = bench.sdo(SdoRequest::Upload(ObjectAddress::new(0x1008, 0)));
    assert_eq!(name, Err(SdoError::TooLong), "a text comes in segments");
    assert_eq!(bench.read(ObjectAddress::new(0x1018, 2)), [0x52, 0x65, 0, 0]);
    assert_eq!(bench.read(object::SUPPORTED_MODES), [0xa0, 0, 0, 0]);
    assert_eq!(bench.read(object::STATUSWORD), [0x50, 0x00]);
    let refused = bench.sdo(SdoRequest::Download(object::MODES_OF_OPERATION, 3_i8.into()));
    assert_eq!(refused, Err(SdoError::Aborted(AbortCode::INVALID_VALUE)));
    let refused = bench.sdo(SdoRequest::Download(object::QUICK_STOP_OPTION, 3_i16.into()));
    assert_eq!(refused, Err(SdoError::Aborted(AbortCode::INVALID_VALUE)));
    let refused = bench.sdo(SdoRequest::Download(object::STATUSWORD, 0_u16.into()));
    assert_eq!(refused, Err(SdoError::Aborted(AbortCode::READ_ONLY)));
}

#[test]
fn the_default_tpdo1_reports_each_change_of_state() {
    let mut bench = Bench::new(config());
    let mut answer = |frame| {
        bench.pass(PERIOD);
        bench.give(frame)
    };
    assert_eq!(answer(nmt_frame(NmtCommand::StartRemoteNode, None)), ["185#5002"]);
    for (controlword, status) in
        [(0x06, "185#3102"), (0x07, "185#3302"), (0x0f, "185#3706"), (0x00, "185#5002")]
    {
        assert_eq!(answer(Frame::new(0x205, &[controlword, 0])), [status]);
    }
}

#[test]
fn enable_operation_passes_switched_on_by_itself() {
    let mut bench = Bench::new(config());
    bench.write(object::CONTROLWORD, &[0x06, 0]);
    assert_eq!(bench.state(), DriveState::ReadyToSwitchOn);
    bench.write(object::CONTROLWORD, &[0x0f, 0]);
    assert_eq!(bench.state(), DriveState::OperationEnabled);
}

#[test]
fn targets_are_reached_exactly_one_period_later() {
    let mut bench = Bench::enabled_at(1000);
    for target in [1010, 1030, 1031, 990] {
        let before = bench.position();
        bench.command(0x0f, target);
        assert_eq!(bench.position(), before, "a PDO moves nothing before the SYNC");
        bench.give(sync_frame());
        let (_, sampled) = bench.sample.unwrap();
        assert_eq!(f64::from(sampled), before, "the TPDO has the position at the SYNC");
        bench.pass(PERIOD / 4);
        assert_eq!(bench.position(), before + (target as f64 - before) / 4.0);
        bench.pass(PERIOD - PERIOD / 4);
        assert_eq!(bench.position(), target as f64);
    }
    let (word, _) = bench.sample.unwrap();
    assert!(word.0 & Statusword::FOLLOWS_COMMAND != 0 && !word.has(Statusword::INTERNAL_LIMIT));
    bench.pass(PERIOD * 5);
    assert_eq!(bench.position(), 990.0, "without SYNC the axis holds");
}

#[test]
fn the_position_offset_is_added_to_each_target() {
    let mut bench = Bench::enabled_at(1000);
    bench.write(object::POSITION_OFFSET, &(-20_i32).to_le_bytes());
    bench.cycle(0x0f, 1000);
    assert_eq!(bench.position(), 980.0);
    bench.cycle(0x0f, 1030);
    assert_eq!(bench.position(), 1010.0);
}

#[test]
fn a_sync_that_is_1_ms_early_ends_the_period() {
    let mut bench = Bench::enabled_at(0);
    for target in [100, 200, 300] {
        bench.command(0x0f, target);
        bench.give(sync_frame());
        let (_, sampled) = bench.sample.unwrap();
        assert_eq!(i64::from(sampled), target - 100);
        assert_eq!(bench.position(), f64::from(sampled));
        bench.pass(Duration::from_millis(9));
    }
}

#[test]
fn counts_wrap_on_the_bus_and_not_in_the_true_position() {
    let start = i64::from(i32::MAX) - 150;
    let mut bench = Bench::enabled_at(start);
    for step in 1..=4 {
        bench.cycle(0x0f, start + 100 * step);
    }
    assert_eq!(bench.position(), (start + 400) as f64);
    assert_eq!(bench.state(), DriveState::OperationEnabled);
    bench.cycle(0x0f, start + 400);
    assert_eq!(bench.sample.map(|(_, counts)| counts), Some((start + 400) as i32));
    assert!((start + 400) as i32 <= i32::MIN + 250);
}

#[test]
fn a_target_far_off_is_a_following_error_and_no_motion() {
    let mut bench = Bench::enabled_at(0);
    bench.cycle(0x0f, 1_000_000);
    assert_eq!(bench.state(), DriveState::Fault);
    assert_eq!(bench.position(), 0.0);
    assert_eq!(bench.emergencies, ["085#1186210000000000"]);
    bench.cycle(0x0f, 0);
    assert!(bench.sample.unwrap().0.has(Statusword::FOLLOWING_ERROR));
    assert_eq!(bench.read(object::ERROR_CODE), [0x11, 0x86]);
    assert_eq!(bench.read(ObjectAddress::new(0x1003, 1)), [0x11, 0x86, 0, 0]);
}

#[test]
fn a_stale_target_is_refused_after_re_enabling() {
    let mut bench = Bench::enabled_at(500_000);
    bench.nmt(NmtCommand::ResetNode);
    bench.map_cyclic();
    for controlword in [0x06, 0x07, 0x0f] {
        bench.give(Frame::new(0x205, &[controlword, 0, 0, 0, 0, 0]));
        bench.give(sync_frame());
        bench.pass(PERIOD);
    }
    assert_eq!((bench.state(), bench.position()), (DriveState::Fault, 500_000.0));
    assert_eq!(bench.emergencies, ["085#1186210000000000"]);
}

#[test]
fn a_target_somewhat_too_fast_is_followed_with_a_lag() {
    let mut bench = Bench::enabled_at(0);
    bench.write(object::MAX_PROFILE_VELOCITY, &10_000u32.to_le_bytes());
    bench.cycle(0x0f, 1500);
    assert_eq!(bench.position(), 100.0, "10,000 counts/s for 10 ms");
    assert_eq!(bench.read(object::FOLLOWING_ERROR_ACTUAL), 1400i32.to_le_bytes());
    bench.cycle(0x0f, 1500);
    assert!(bench.sample.unwrap().0.has(Statusword::INTERNAL_LIMIT));
    assert_eq!(bench.position(), 200.0);
}

#[test]
fn software_limits_clip_the_target() {
    let mut bench = Bench::enabled_at(0);
    bench.write(object::SOFTWARE_LIMIT_MIN, &(-50i32).to_le_bytes());
    bench.write(object::SOFTWARE_LIMIT_MAX, &100i32.to_le_bytes());
    bench.cycle(0x0f, 150);
    bench.cycle(0x0f, -150);
    assert_eq!(bench.sample.map(|(_, counts)| counts), Some(100));
    bench.cycle(0x0f, -150);
    assert_eq!(bench.position(), -50.0);
    assert!(bench.sample.unwrap().0.has(Statusword::INTERNAL_LIMIT));
    // A drive that is enabled again has no target yet.
    for controlword in [0x00, 0x06, 0x0f] {
        bench.write(object::CONTROLWORD, &[controlword, 0]);
    }
    let word = bench.read(object::STATUSWORD);
    let word = Statusword(u16::from_le_bytes([word[0], word[1]]));
    assert_eq!(bench.state(), DriveState::OperationEnabled);
    assert!(!word.has(Statusword::INTERNAL_LIMIT));
}

#[test]
fn a_drive_without_voltage_is_in_fault_until_it_returns() {
    let mut bench = moving();
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::NoVoltage), true);
    bench.take();
    bench.pass(PERIOD);
    assert_eq!((bench.state(), bench.position()), (DriveState::Fault, 300.0));
    assert_eq!(bench.emergencies, ["085#2032050000000000"]);
    bench.cycle(0x00, 300);
    bench.cycle(0x80, 300);
    assert_eq!(bench.state(), DriveState::Fault);
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::NoVoltage), false);
    bench.enable();
}

#[test]
fn limit_switches_show_in_60fd() {
    let switches =
        Switches { negative_counts: Some(-10), positive_counts: Some(50), ..Switches::default() };
    let mut bench = Bench::new(DriveConfig { switches, start_counts: -10, ..config() });
    assert_eq!(bench.read(object::DIGITAL_INPUTS), [1, 0, 0, 0]);
    bench.map_cyclic();
    bench.enable();
    bench.cycle(0x0f, 20);
    assert_eq!(bench.read(object::DIGITAL_INPUTS), [0, 0, 0, 0]);
    bench.cycle(0x0f, 50);
    assert_eq!(bench.read(object::DIGITAL_INPUTS), [2, 0, 0, 0]);
}

/// Anything that may come from the bus, or happen to the supply.
#[derive(Debug, Clone)]
enum Input {
    Command(u16, i32),
    Sync,
    Nmt(NmtCommand),
    Voltage(bool),
    Wait(u64),
    Frame(u16, Vec<u8>),
}

fn inputs() -> impl Strategy<Value = Vec<Input>> {
    let controlword = prop_oneof![
        4 => Just(0x0f), 1 => Just(0x06), 1 => Just(0x07), 1 => Just(0x02), 1 => Just(0x00),
        1 => Just(0x80), 1 => Just(0x10f), 1 => any::<u16>(),
    ];
    let command = prop_oneof![
        Just(NmtCommand::StartRemoteNode),
        Just(NmtCommand::StopRemoteNode),
        Just(NmtCommand::EnterPreOperational),
    ];
    let input = prop_oneof![
        6 => (controlword, -3000i32..3000).prop_map(|(word, target)| Input::Command(word, target)),
        6 => Just(Input::Sync),
        1 => command.prop_map(Input::Nmt),
        1 => any::<bool>().prop_map(Input::Voltage),
        4 => (0u64..30).prop_map(Input::Wait),
        1 => (0u16..0x800, proptest::collection::vec(any::<u8>(), 0..=8))
            .prop_map(|(id, data)| Input::Frame(id, data)),
    ];
    proptest::collection::vec(input, 1..120)
}

proptest! {
    /// Outside NMT operational it does not gain speed either.
    #[test]
    fn an_axis_moves_only_with_power_and_within_its_speed(inputs in inputs()) {
        let mut bench = Bench::enabled_at(0);
        for input in inputs {
            let state = bench.state();
            let operational = bench.drive.nmt_state() == NmtState::Operational;
            let (then, before) = (bench.now, bench.position());
            let speed_before = bench.drive.axis.motion.velocity_at(bench.now).abs();
            match input {
                Input::Command(word, target) => bench.command(word, target.into()),
                Input::Sync => { bench.give(sync_frame()); }
                Input::Nmt(command) => bench.nmt(command),
                Input::Voltage(on) => {
                    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::NoVoltage), !on);
                    bench.take();
                }
                Input::Wait(ms) => bench.pass(Duration::from_millis(ms)),
                Input::Frame(id, data) => { bench.give(Frame::new(id, &data)); }
            }
            let moved = (bench.position() - before).abs();
            let powered = matches!(
                state,
                DriveState::OperationEnabled
                    | DriveState::QuickStopActive
                    | DriveState::FaultReactionActive
            );
            prop_assert!(moved == 0.0 || powered, "{moved} counts in {state}");
            let speed = bench.drive.axis.motion.velocity_at(bench.now).abs();
            if !operational {
                prop_assert!(speed <= speed_before + 1e-6, "gains speed outside NMT operational");
            }
            let reach = 200_001.0 * bench.now.seconds_after(then);
            // A SYNC in the second half of a period ends that period: half a step at most.
            prop_assert!(moved <= reach + 1001.0, "{moved} counts, {reach} possible");
        }
    }

    #[test]
    fn any_track_within_its_speed_is_followed_exactly(
        start in any::<i32>(),
        steps in proptest::collection::vec(-2000i64..=2000, 1..50),
    ) {
        let mut bench = Bench::enabled_at(start.into());
        let mut target = i64::from(start);
        for step in steps {
            let before = target;
            target += step;
            bench.cycle(0x0f, target);
            prop_assert_eq!(bench.sample.map(|(_, counts)| counts), Some(before as i32));
            prop_assert_eq!(bench.position(), target as f64);
        }
        prop_assert_eq!(bench.state(), DriveState::OperationEnabled);
    }
}
