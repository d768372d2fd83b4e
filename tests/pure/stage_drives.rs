//! The stage against two emulated drives, in virtual time.

use needle_bench::canopen::cia402::DriveState;
use needle_bench::canopen::nmt::NmtState;
use needle_bench::canopen::{Frame, NodeId};
use needle_bench::config::Config;
use needle_bench::emulator::drive::{Drive, DriveConfig};
use needle_bench::emulator::fault::{Fault, FaultKind};
use needle_bench::stage::{
    Axis, AxisConfig, AxisLimits, AxisUse, CountsRatio, Feedback, HomingConfig, Output, PerAxis,
    Reference, SetPoint, Sign, Stage, StageConfig, StageEvent,
};
use needle_bench::units::Time;
use std::time::Duration;

const VENDOR: u32 = 0x1ee7;
const PRODUCT: u32 = 1;

struct Bench {
    now: Time,
    stage: Stage,
    drives: [Drive; 2],
    events: Vec<StageEvent>,
    /// What the stage sent.
    sent: Vec<Frame>,
}

fn node(id: u8) -> NodeId {
    NodeId::new(id).expect("in range")
}

fn axis(id: u8, counts: u32, speed_max: f64) -> AxisConfig {
    let limits = AxisLimits { min: -1.0, max: 200.0, speed_max, acceleration_max: None };
    let ratio = CountsRatio::new(counts, 1).expect("not zero");
    AxisConfig {
        node: node(id),
        vendor_id: Some(VENDOR),
        product_code: None,
        serial: None,
        ratio,
        sign: Sign::Positive,
        zero: None,
        reference: Reference::Absolute,
        homing: None,
        wraps: false,
        limits,
        following_error_max: None,
        following_error_timeout_ms: None,
        quick_stop_deceleration: None,
        quick_stop_option: 6,
        fault_reaction_option: 2,
        abort_connection_option: 3,
        communication_error_behaviour: 0,
        optional_objects: Vec::new(),
        sdo: Vec::new(),
        jog_speed: 2.0,
        jog_acceleration: 10.0,
        withdraw_speed: None,
    }
}

fn config() -> StageConfig {
    let config = Config::from_sources(&[], &[]).expect("valid");
    StageConfig {
        insertion: axis(1, 4646, 10.0),
        rotation: axis(2, 75_766, 10.0),
        ..config.to_stage().expect("valid")
    }
}

impl Bench {
    fn new() -> Self {
        let now = Time::ZERO;
        let drive = |id, start_counts| {
            let config = DriveConfig::new(node(id), VENDOR, PRODUCT);
            Drive::new(DriveConfig { start_counts, ..config })
        };
        Bench {
            now,
            stage: Stage::new(config(), now),
            drives: [drive(1, 12_345), drive(2, -70_000)],
            events: Vec::new(),
            sent: Vec::new(),
        }
    }

    fn settle(&mut self) {
        loop {
            let mut frames: Vec<Frame> = Vec::new();
            while let Some(output) = self.stage.poll() {
                match output {
                    Output::Event(event) => self.events.push(event),
                    Output::Transmit(frame) => frames.push(frame),
                }
            }
            self.sent.extend(&frames);
            for drive in &mut self.drives {
                frames.iter().for_each(|frame| drive.handle_frame(self.now, frame));
            }
            let mut answers: Vec<Frame> = Vec::new();
            for drive in &mut self.drives {
                answers.extend(std::iter::from_fn(|| drive.poll_transmit()));
            }
            if frames.is_empty() && answers.is_empty() {
                return;
            }
            answers.iter().for_each(|frame| self.stage.handle_frame(self.now, frame));
        }
    }

    fn step(&mut self) {
        self.settle();
        let [a, b] = &self.drives;
        self.now = self.now.max(self.stage.deadline().min(a.deadline()).min(b.deadline()));
        self.drives.iter_mut().for_each(|drive| drive.handle_timeout(self.now));
        self.settle();
        self.stage.handle_timeout(self.now);
        self.settle();
    }

    fn run_until<T>(&mut self, mut wanted: impl FnMut(&StageEvent) -> Option<T>) -> T {
        for _ in 0..10_000 {
            while !self.events.is_empty() {
                if let Some(found) = wanted(&self.events.remove(0)) {
                    return found;
                }
            }
            self.step();
        }
        panic!("no such event");
    }

    fn feedback(&mut self) -> Feedback {
        self.run_until(|event| match event {
            StageEvent::Feedback(feedback) => Some(*feedback),
            StageEvent::Fault(fault) => panic!("{fault}"),
            _ => None,
        })
    }

    fn fault(&mut self) -> String {
        self.run_until(|event| match event {
            StageEvent::Fault(fault) => Some(fault.to_string()),
            _ => None,
        })
    }

    fn stopped(&mut self) -> bool {
        self.run_until(|event| match event {
            StageEvent::Stopped { standing, .. } => Some(*standing),
            StageEvent::Fault(fault) => panic!("{fault}"),
            _ => None,
        })
    }

    fn drive_on(&mut self, steps: u32) {
        for step in 1..=steps {
            self.feedback();
            let way = f64::from(step) * 0.02;
            let set_point = SetPoint { insertion_mm: way, rotation_rad: way };
            self.stage.command(set_point).expect("within limits");
        }
    }
}

#[test]
fn both_drives_follow_every_set_point_to_the_count() {
    let mut bench = Bench::new();
    let mut feedback = bench.feedback();
    assert_eq!((feedback.measured.insertion_mm, feedback.measured.rotation_rad), (0.0, 0.0));
    for step in 1..=3000 {
        let way = f64::from(step) * 0.005;
        let set_point = SetPoint { insertion_mm: way, rotation_rad: 2.0 * way };
        bench.stage.command(set_point).expect("within limits");
        let next = bench.feedback();
        assert_eq!(next.sync, feedback.sync + 1);
        // In cyclic synchronous position the target of one SYNC is the position at the next.
        assert_eq!(next.measured.insertion_mm, feedback.commanded.insertion_mm);
        assert_eq!(next.measured.rotation_rad, feedback.commanded.rotation_rad);
        feedback = next;
    }
    let feedback = bench.feedback();
    assert!((feedback.measured.insertion_mm - 15.0).abs() <= 0.5 / 4646.0);
    assert_eq!(bench.drives[0].position_counts_at(bench.now).round() as i64, 12_345 + 15 * 4646);

    bench.stage.disable(bench.now);
    assert!(bench.stopped());
    // Drives that were shut down do not report that the bench is silent.
    let later = bench.now + Duration::from_secs(5);
    for drive in &mut bench.drives {
        assert_eq!(drive.nmt_state(), NmtState::PreOperational);
        assert_ne!(drive.state(), DriveState::OperationEnabled);
        drive.handle_timeout(later);
        let emergency = std::iter::from_fn(|| drive.poll_transmit())
            .find(|frame| matches!(frame.cob_id(), Some(0x081 | 0x082)));
        assert_eq!(emergency, None);
    }
}

#[test]
fn a_power_loss_of_one_drive_stops_both() {
    let mut bench = Bench::new();
    bench.drive_on(100);
    bench.drives[1].apply_fault(bench.now, &Fault::of(FaultKind::NoVoltage), true);
    let fault_counts = bench.drives[0].position_counts_at(bench.now).round() as i64;
    let fault = bench.fault();
    assert!(fault.starts_with("rotation: emergency 0x3220 DC link undervoltage"), "{fault}");
    assert!(bench.stopped(), "the axes do not stand");
    assert_ne!(bench.drives[0].state(), DriveState::OperationEnabled);
    let travel_counts = bench.drives[0].position_counts_at(bench.now).round() as i64 - fault_counts;
    // Two cycles of 93 counts, then a quick stop at 100,000 counts/s² from 9292 counts/s.
    assert!((1..=186 + 450).contains(&travel_counts), "{travel_counts} counts");
}

#[test]
fn drives_stop_by_themselves_when_the_bench_falls_silent() {
    let mut bench = Bench::new();
    bench.drive_on(50);
    let end = bench.now + Duration::from_secs(2);
    for drive in &mut bench.drives {
        while drive.deadline() < end {
            drive.handle_timeout(drive.deadline());
        }
        assert_ne!(drive.state(), DriveState::OperationEnabled);
    }
}

/// A run is killed, and the next starts at once with another product code in its configuration.
#[test]
fn a_run_that_finds_another_type_takes_power_off_its_own_drive_alone() {
    let mut bench = Bench::new();
    bench.drive_on(50);
    let mut config = config();
    config.rotation.product_code = Some(PRODUCT + 1);
    // If the stage listened first, the drives would miss the heartbeat of the killed run.
    config.listen_first = Duration::ZERO;
    bench.stage = Stage::new(config, bench.now);
    bench.sent.clear();
    let fault = bench.fault();
    assert!(fault.starts_with("node 2 (rotation): 0x1018:02: expected 0x00000002"), "{fault}");
    assert!(!bench.stopped(), "the stage cannot see whether the rotation drive stands");
    let [insertion, rotation] = &bench.drives;
    assert_eq!(insertion.state(), DriveState::SwitchOnDisabled);
    assert_eq!(insertion.nmt_state(), NmtState::PreOperational);
    assert_eq!(rotation.state(), DriveState::OperationEnabled);
    let written = bench.sent.iter().find(|frame| match (frame.cob_id(), frame.data()) {
        (Some(0x000), [_, node]) => *node != 1,
        (Some(0x602), [command, ..]) => *command != 0x40,
        _ => false,
    });
    assert_eq!(written, None, "more than SDO uploads to a drive of another product");
    // That drive still stops by itself.
    let end = bench.now + Duration::from_secs(2);
    let [_, rotation] = &mut bench.drives;
    while rotation.deadline() < end {
        rotation.handle_timeout(rotation.deadline());
    }
    assert_ne!(rotation.state(), DriveState::OperationEnabled);
}

/// Without homing the axes are not enabled; after it they read zero at home.
#[test]
fn both_axes_are_homed_by_their_drives_and_a_run_may_begin() {
    let mut bench = Bench::new();
    let mut config = config();
    for (axis, method) in [(&mut config.insertion, 34), (&mut config.rotation, 37)] {
        axis.reference = Reference::Homing;
        axis.homing = Some(HomingConfig {
            method,
            speed_switch: None,
            speed_zero: None,
            acceleration: None,
            offset: None,
            timeout: Duration::from_secs(60),
            homed_bit: HomingConfig::ATTAINED_BIT,
        });
        axis.zero = Some(0);
    }
    bench.stage = Stage::new(config.clone(), bench.now);
    let fault = bench.fault();
    assert!(fault.contains("not homed"), "{fault}");

    let both = PerAxis::from_fn(|_| AxisUse::Home { again: false });
    bench.stage = Stage::for_use(config.clone(), both, bench.now);
    bench.run_until(|event| matches!(event, StageEvent::Ready).then_some(()));
    for axis in Axis::BOTH {
        bench.stage.home(bench.now, axis).expect("ready");
        let homed = |event: &StageEvent| match event {
            StageEvent::Homed { axis, .. } => Some(*axis),
            StageEvent::Fault(fault) => panic!("{fault}"),
            _ => None,
        };
        assert_eq!(bench.run_until(homed), axis);
    }
    // From 12,345 up to the next index pulse.
    let counts = |drive: &Drive| drive.position_counts_at(bench.now).round() as i64;
    let [insertion, rotation] = bench.drives.each_ref().map(counts);
    assert_eq!((insertion, rotation), (14_000, -70_000));
    bench.stage.disable(bench.now);
    assert!(bench.stopped());

    bench.stage = Stage::new(config, bench.now);
    let feedback = bench.feedback();
    assert_eq!((feedback.measured.insertion_mm, feedback.measured.rotation_rad), (0.0, 0.0));
}
