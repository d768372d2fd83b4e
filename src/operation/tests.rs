//! Operations on the virtual stage, in virtual time.

mod handedness;
mod prove;

use super::*;
use crate::canopen::Frame;
use crate::canopen::cia402::DriveState;
use crate::config::Config;
use crate::emulator::fault::{Fault, FaultKind};
use crate::emulator::{StageOutput, VirtualStage};
use crate::session::{Input, Machine, Outcome, Output, Record, Session, State};
use crate::tracker::{Event, Sample, Validity};
use crate::units::Time;
use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_4;
use std::time::Duration;

/// Position of the sensor, mm, by the true rotation of the base, rad.
type Sensor = fn(f64) -> Vector3<f64>;

struct Bench {
    now: Time,
    operation: Session,
    stage: VirtualStage,
    /// The true depth, mm, and rotation, rad, at power-on.
    start: (f64, f64),
    was_enabled: bool,
    /// Once a drive was enabled, RPDO1 with this controlword does not reach the insertion drive.
    lost_controlword: Option<u8>,
    /// Once a drive was enabled, no SDO write of the controlword reaches the insertion drive.
    is_deaf: bool,
    /// `None` without a tracker.
    sensor: Option<Sensor>,
    samples: u32,
    /// When the bench last sent on each identifier.
    last_sent: BTreeMap<Option<u16>, Time>,
    events: Vec<String>,
}

fn config(sets: &[&str]) -> Config {
    let sets: Vec<String> = sets.iter().map(|set| set.to_string()).collect();
    Config::from_sources(&[], &sets).unwrap()
}

fn by(axis: Axis, distance: f64) -> Move {
    let goal = MoveGoal::By(distance);
    Move { axis, goal, speed: 2.0, acceleration: 10.0, arrival: 0.05 }
}

impl Bench {
    fn new(config: &Config, operation: Operation) -> Self {
        let now = Time::ZERO;
        let stage = config.to_stage().unwrap();
        let operation = RunConfig::Operation(Box::new(stage), operation).begin(now);
        let stage = VirtualStage::new(config.virtual_stage().unwrap(), now);
        let start = stage.position_true(now);
        Bench {
            now,
            operation,
            stage,
            start,
            was_enabled: false,
            lost_controlword: None,
            is_deaf: false,
            sensor: None,
            samples: 0,
            last_sent: BTreeMap::new(),
            events: Vec::new(),
        }
    }

    fn is_lost(&self, frame: &Frame) -> bool {
        let is_of = |word| frame.cob_id() == Some(0x201) && frame.data().first() == Some(&word);
        let is_sdo = frame.cob_id() == Some(0x601)
            && matches!(frame.data(), [_, 0x40, 0x60, ..])
            && self.is_deaf;
        self.was_enabled && (self.lost_controlword.is_some_and(is_of) || is_sdo)
    }

    fn settle(&mut self) {
        loop {
            let mut quiet = true;
            while let Some(output) = self.operation.poll() {
                quiet = false;
                let frame = match output {
                    Output::Transmit { frame, .. } => frame,
                    Output::Record(Record::Event { text, .. }) => {
                        self.events.push(text);
                        continue;
                    }
                    Output::Record(_) => continue,
                };
                self.last_sent.insert(frame.cob_id(), self.now);
                if !self.is_lost(&frame) {
                    self.stage.handle_frame(self.now, &frame);
                }
            }
            while let Some(output) = self.stage.poll() {
                let input = match (output, self.sensor) {
                    (StageOutput::Frame(frame), _) => Input::Frame(frame),
                    (StageOutput::Tip { .. }, Some(sensor)) => self.sample(sensor),
                    _ => continue,
                };
                quiet = false;
                self.operation.handle(self.now, input);
            }
            let enabled = DriveState::OperationEnabled;
            self.was_enabled |= self.stage.drives().iter().any(|drive| drive.state() == enabled);
            if quiet {
                return;
            }
        }
    }

    /// A position of the sensor with ±0.1 mm of noise on each coordinate.
    fn sample(&mut self, sensor: Sensor) -> Input {
        self.samples += 1;
        let noise = |step: f64| 0.2 * (f64::from(self.samples) * step).fract() - 0.1;
        let noise_mm = Vector3::from([0.618_034, 0.414_214, 0.732_051].map(noise));
        Input::Tracker(Event::Sample(Sample {
            tool: "NeedleToTracker".to_owned(),
            receive_time: self.now,
            source_unix_ns: None,
            position_mm: sensor(self.travel().1) + noise_mm,
            orientation: None,
            validity: Validity::Valid,
        }))
    }

    fn step(&mut self) {
        self.settle();
        self.now = self.now.max(self.operation.deadline().min(self.stage.deadline()));
        self.stage.handle_timeout(self.now);
        self.operation.handle(self.now, Input::Tick);
        self.settle();
    }

    /// True travel since power-on, mm and rad.
    fn travel(&self) -> (f64, f64) {
        let (insertion_mm, rotation_rad) = self.stage.position_true(self.now);
        (insertion_mm - self.start.0, rotation_rad - self.start.1)
    }

    fn run(&mut self) -> Outcome {
        let mut steps = 0;
        while self.operation.outcome().is_none() {
            self.step();
            steps += 1;
            assert!(steps < 1_000_000, "the operation does not end");
        }
        for drive in self.stage.drives() {
            assert_ne!(drive.state(), DriveState::OperationEnabled, "power is off");
        }
        self.operation.outcome().cloned().unwrap()
    }

    fn reason(&mut self) -> String {
        self.run().stop_reason().expect("stopped").to_owned()
    }

    fn run_until_moved(&mut self, mm: f64) {
        while self.travel().0.abs() < mm {
            assert_eq!(self.operation.outcome(), None);
            self.step();
        }
    }
}

#[test]
fn a_jog_moves_its_axis_and_no_other() {
    for (axis, distance, expected) in [
        (Axis::Insertion, 2.0, (2.0, 0.0)),
        (Axis::Insertion, -0.5, (-0.5, 0.0)),
        (Axis::Rotation, -1.5, (0.0, -1.5)),
        (Axis::Rotation, 0.0, (0.0, 0.0)),
    ] {
        let mut bench = Bench::new(&config(&[]), Operation::Move(by(axis, distance)));
        assert_eq!(bench.run(), Outcome::Completed);
        let (insertion_mm, rotation_rad) = bench.travel();
        assert!((insertion_mm - expected.0).abs() < 2e-4, "{insertion_mm}");
        assert!((rotation_rad - expected.1).abs() < 2e-4, "{rotation_rad}");
        let [moved] = bench.operation.moves() else { panic!("one move") };
        let distance_moved = moved.to - moved.from.expect("a start position");
        assert!((distance_moved - distance).abs() < 2e-4, "{moved:?}");
    }
}

#[test]
fn a_goal_out_of_the_limits_is_refused_before_anything_moves() {
    let mut bench = Bench::new(&config(&[]), Operation::Move(by(Axis::Insertion, 310.5)));
    assert_eq!(
        bench.reason(),
        "stage: insertion: 310.500 mm is over the limit of 310.000 mm (stage.insertion.max_mm)"
    );
    assert_eq!(bench.travel(), (0.0, 0.0));
    assert!(!bench.was_enabled);
    let mut bench = Bench::new(&config(&[]), Operation::Move(by(Axis::Rotation, f64::NAN)));
    assert_eq!(bench.reason(), "stage: rotation: the target NaN is not a finite number");
}

#[test]
fn a_move_whose_drive_keeps_its_power_is_not_completed() {
    let mut bench = Bench::new(&config(&[]), Operation::Move(by(Axis::Insertion, 2.0)));
    bench.lost_controlword = Some(0x06);
    assert_eq!(
        bench.reason(),
        "stage: insertion: the drive still has power 2000 ms after shutdown (statusword 0x1237 \
         operation enabled); if it does not stop now, press the emergency stop"
    );
    assert!((bench.travel().0 - 2.0).abs() < 2e-4, "{:?}", bench.travel());
}

#[test]
fn a_speed_over_the_limit_is_refused() {
    let fast = Move { speed: 20.0, acceleration: 1e4, ..by(Axis::Insertion, 5.0) };
    let reason = Bench::new(&config(&[]), Operation::Move(fast)).reason();
    assert!(reason.contains("over the limit of 10.000 mm/s"), "{reason}");
}

#[test]
fn withdrawing_comes_back_to_zero_and_turns_nothing() {
    let config = config(&["emulator.insertion_start_mm=40"]);
    let back = Move { goal: MoveGoal::BackTo(0.0), ..by(Axis::Insertion, 0.0) };
    let mut bench = Bench::new(&config, Operation::Move(back));
    assert_eq!(bench.run(), Outcome::Completed);
    let (insertion_mm, rotation_rad) = bench.travel();
    assert!((insertion_mm + 40.0).abs() < 2e-4, "{insertion_mm}");
    assert_eq!(rotation_rad, 0.0);
}

#[test]
fn withdrawing_never_pushes() {
    let config = config(&["emulator.insertion_start_mm=-0.5"]);
    let back = Move { goal: MoveGoal::BackTo(0.0), ..by(Axis::Insertion, 0.0) };
    let mut bench = Bench::new(&config, Operation::Move(back));
    let reason = bench.reason();
    assert!(reason.starts_with("insertion: stands at -0.500 mm, not beyond 0.000 mm"), "{reason}");
    assert_eq!(bench.travel(), (0.0, 0.0));
}

/// From 2 mm/s by 21.5 mm/s² the axis stands within 0.15 mm, one SYNC included.
#[test]
fn an_operator_a_bus_fault_and_a_drive_fault_stop_an_operation() {
    let inputs = [
        (Input::Stop("operator: interrupted".to_owned()), "operator: interrupted"),
        (Input::BusFault("can0: bus off".to_owned()), "can: can0: bus off"),
    ];
    for (input, reason) in inputs {
        let mut bench = Bench::new(&config(&[]), Operation::Move(by(Axis::Insertion, 10.0)));
        bench.run_until_moved(3.0);
        let at_mm = bench.travel().0;
        bench.operation.handle(bench.now, input);
        assert_eq!(bench.reason(), reason);
        assert!((bench.travel().0 - at_mm).abs() < 0.15, "{} mm", bench.travel().0 - at_mm);
    }
    let mut bench = Bench::new(&config(&[]), Operation::Move(by(Axis::Insertion, 10.0)));
    bench.run_until_moved(3.0);
    bench.stage.change_drive(1, bench.now, &Fault::of(FaultKind::NoVoltage), true);
    let reason = bench.reason();
    assert!(reason.starts_with("stage: rotation: emergency 0x3220"), "{reason}");
}

/// `needle-bench stop` takes the nodes out of Operational, so the axis brakes without feedback.
#[test]
fn the_end_of_a_move_that_is_stopped_from_outside_is_where_the_axis_stands() {
    let mut bench = Bench::new(&config(&[]), Operation::Move(by(Axis::Insertion, 10.0)));
    bench.run_until_moved(3.0);
    let preoperational = Frame::new(0, &[0x80, 0]);
    bench.stage.handle_frame(bench.now, &preoperational);
    let reason = bench.reason();
    assert!(reason.contains("no TPDO1 for 2 SYNCs in a row"), "{reason}");
    let [moved] = bench.operation.moves() else { panic!("one move") };
    assert!((moved.to - bench.travel().0).abs() < 1e-3, "{moved:?}, {}", bench.travel().0);
}

#[test]
fn an_axis_that_does_not_reach_its_goal_is_an_error() {
    let feedback = |time_s: f64, commanded_mm: f64| crate::stage::Feedback {
        time: Time::from_secs_f64(time_s),
        sync: 1,
        measured: crate::stage::SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 },
        commanded: crate::stage::SetPoint { insertion_mm: commanded_mm, rotation_rad: 0.0 },
    };
    let way = Move { speed: 10.0, acceleration: 1e6, ..by(Axis::Insertion, 0.1) };
    let mut moving = moving::Moving::new(way, feedback(0.0, 0.0).measured).unwrap();
    assert_eq!(moving.has_arrived(&feedback(0.0, 0.0)), Ok(false));
    for _ in 0..10 {
        moving.advance(Duration::from_millis(10));
    }
    assert_eq!(moving.has_arrived(&feedback(0.1, 0.1)), Ok(false));
    assert_eq!(moving.has_arrived(&feedback(2.0, 0.1)), Ok(false));
    let text = moving.has_arrived(&feedback(2.1, 0.1)).unwrap_err();
    assert!(
        text.starts_with("insertion: stands at 0.000 mm, 0.100 mm from the 0.100 mm"),
        "{text}"
    );
}

/// 0.36° is one count, so the axis stands 0.16° from the goal, and exactly at the count that was sent.
#[test]
fn a_move_ends_at_the_count_nearest_to_its_goal() {
    let config = config(&["stage.rotation.counts_per_turn={ counts = 1000, turns = 1 }"]);
    let degrees = Move {
        speed: 0.5,
        arrival: 0.1_f64.to_radians(),
        ..by(Axis::Rotation, 10.6_f64.to_radians())
    };
    let mut bench = Bench::new(&config, Operation::Move(degrees));
    assert_eq!(bench.run(), Outcome::Completed);
    let [moved] = bench.operation.moves() else { panic!("one move") };
    assert!((moved.to.to_degrees() - 10.44).abs() < 1e-9, "{moved:?}");
}

/// From 1 mm onto the negative limit switch at -0.8 mm and off it again. There the drive sets its zero.
#[test]
fn homing_finds_the_switch_and_ends_without_power() {
    let config = config(&[
        "emulator.insertion_start_mm=1.0",
        "emulator.insertion_switches_mm.negative=-0.8",
        "stage.insertion.homing.method=17",
        "stage.insertion.homing.speed_switch_mm_per_s=2.0",
        "stage.insertion.homing.speed_zero_mm_per_s=0.5",
        "stage.insertion.homing.acceleration_mm_per_s2=10.0",
    ]);
    let stage = config.to_stage().unwrap();
    let mut bench = Bench::new(&config, Operation::home(&stage, None, false));
    assert_eq!(bench.run(), Outcome::Completed);
    let (insertion_mm, rotation_rad) = bench.travel();
    assert!((insertion_mm + 1.8).abs() < 1e-3, "{insertion_mm}");
    assert_eq!(rotation_rad, 0.0);
    let moves: Vec<_> =
        bench.operation.moves().iter().map(|moved| (moved.axis, moved.from)).collect();
    assert_eq!(moves, [(Axis::Insertion, None), (Axis::Rotation, None)]);
    assert_eq!(bench.operation.moves()[0].to, 0.0);

    // The drive remembers that it is homed, so an axis that needs homing may be jogged now.
    let needs_homing = self::config(&["stage.insertion.reference=homing"]);
    let jog = Operation::Move(by(Axis::Insertion, 2.0));
    let stage = needs_homing.to_stage().unwrap();
    let operation = RunConfig::Operation(Box::new(stage), jog).begin(bench.now);
    let mut bench = Bench { operation, ..bench };
    assert_eq!(bench.run(), Outcome::Completed);
    assert!((bench.travel().0 - 0.2).abs() < 1e-3, "{}", bench.travel().0);
}

#[test]
fn an_axis_that_needs_homing_is_not_moved_before_it() {
    let config = config(&["stage.insertion.reference=homing"]);
    let mut bench = Bench::new(&config, Operation::Move(by(Axis::Insertion, 2.0)));
    let reason = bench.reason();
    assert!(reason.starts_with("stage: node 1 (insertion): not homed"), "{reason}");
    assert!(
        reason.ends_with("home it first: needle-bench stage home CONFIG --axis insertion"),
        "{reason}"
    );
    assert_eq!(bench.travel(), (0.0, 0.0));
}

/// The rotation drive has lost its home. The base is only held while the needle comes out.
#[test]
fn an_axis_is_moved_although_the_other_is_not_homed() {
    let config = config(&["stage.rotation.reference=homing", "stage.rotation.zero=0"]);
    let mut bench = Bench::new(&config, Operation::Move(by(Axis::Insertion, 2.0)));
    assert_eq!(bench.run(), Outcome::Completed);
    assert!((bench.travel().0 - 2.0).abs() < 1e-3, "{}", bench.travel().0);
    let mut bench = Bench::new(&config, Operation::Move(by(Axis::Rotation, 1.0)));
    let reason = bench.reason();
    assert!(
        reason.ends_with("); home it first: needle-bench stage home CONFIG --axis rotation"),
        "{reason}"
    );
}

#[test]
fn prove_completes_when_both_drives_miss_the_silent_bench() {
    let mut bench = Bench::new(&config(&[]), Operation::Prove);
    while bench.operation.progress().state != State::Silent {
        bench.step();
    }
    let silent_from = bench.now;
    while bench.operation.progress().state == State::Silent {
        bench.step();
    }
    let sent_after = |cob_id| bench.last_sent[&Some(cob_id)].since(silent_from);
    assert_eq!(sent_after(0x77f), Duration::ZERO, "no heartbeat");
    let goes_on = |cob_id: &u16| sent_after(*cob_id) > Duration::from_millis(50);
    assert!([0x080, 0x201, 0x202].iter().all(goes_on), "SYNC and set-points");
    assert_eq!(bench.run(), Outcome::Completed);
    assert_eq!(bench.travel(), (0.0, 0.0));
}

/// The axes are enabled between two heartbeats, and the drives' timeout runs from the last one.
#[test]
fn prove_counts_from_the_last_heartbeat() {
    let mut bench = Bench::new(&config(&[]), Operation::Prove);
    while bench.operation.progress().state != State::Silent {
        bench.step();
    }
    let last_sent = bench.last_sent[&Some(0x77f)];
    assert!(bench.now > last_sent);
    assert_eq!(bench.run(), Outcome::Completed);
    let said = "proved: both drives notice a silent bench and stand: insertion after 100 ms, rotation \
                after 100 ms (limit 300 ms)";
    assert!(bench.events.iter().any(|text| text == said), "{:?}", bench.events);
}

/// Before the bring-up the drive reports twice that it missed the heartbeat of an earlier bench.
#[test]
fn prove_completes_after_a_drive_has_repeated_an_earlier_emergency() {
    let mut bench = Bench::new(&config(&[]), Operation::Prove);
    let missed = Frame::new(0x82, &[0x30, 0x81, 0x11, 127, 0, 0, 0, 0]);
    for _ in 0..2 {
        bench.operation.handle(bench.now, Input::Frame(missed));
    }
    assert_eq!(bench.run(), Outcome::Completed);
}

/// With 6007 = 0 the drive reports the lost heartbeat and does nothing else.
#[test]
fn prove_fails_on_a_drive_that_misses_the_bench_and_goes_on() {
    let config = config(&["stage.rotation.abort_connection_option=0"]);
    let mut bench = Bench::new(&config, Operation::Prove);
    let reason = bench.reason();
    let goes_on =
        "rotation: node 2 stays in operation enabled (0x0437 operation enabled); it noticed";
    assert!(reason.starts_with(goes_on), "{reason}");
    assert!(reason.ends_with("see abort_connection_option (0x6007)"), "{reason}");
}

/// Home is inside the limits by the configuration, but outside by the offset in the drive.
#[test]
fn a_home_outside_the_axis_limits_is_an_error() {
    let mut drives = config(&["stage.insertion.homing.method=37"]);
    let mut bench = Bench::new(&drives, Operation::Prove);
    // A tool of the manufacturer may have left this 607C.
    let offset = (5 * 4646_i32).to_le_bytes();
    let [a, b, c, d] = offset;
    let left = Frame::new(0x601, &[0x23, 0x7C, 0x60, 0, a, b, c, d]);
    bench.stage.handle_frame(bench.now, &left);
    drives.stage.rotation.homing = None;
    let stage = drives.to_stage().unwrap();
    let operation = Operation::home(&stage, None, false);
    let operation = RunConfig::Operation(Box::new(stage), operation).begin(bench.now);
    let mut bench = Bench { operation, ..bench };
    let reason = bench.reason();
    assert!(
        reason.starts_with(
            "insertion: home is at -5.000 mm, out of its limits of -1.000 mm to 310.000 mm"
        ),
        "{reason}"
    );
}

/// In whole counts the home is the limit; in mm it is 0.07 µm outside.
#[test]
fn a_home_on_the_limit_is_inside_it() {
    let config = config(&[
        "stage.insertion.counts_per_mm={ counts = 590_000, mm = 127 }",
        "stage.insertion.homing.method=37",
        "stage.insertion.homing.offset_mm=1.0",
        "stage.insertion.min_mm=-1",
    ]);
    let stage = config.to_stage().unwrap();
    let mut bench = Bench::new(&config, Operation::home(&stage, None, false));
    assert_eq!(bench.run(), Outcome::Completed);
    let home_mm = bench.operation.moves()[0].to;
    assert!(home_mm < -1.0 && home_mm > -1.001, "{home_mm}");
}

/// Another sender switches its heartbeat consumer off.
#[test]
fn prove_fails_on_a_drive_that_does_not_miss_the_bench() {
    let mut bench = Bench::new(&config(&[]), Operation::Prove);
    while bench.stage.drives()[1].state() != DriveState::OperationEnabled {
        bench.step();
    }
    let no_consumer = Frame::new(0x602, &[0x23, 0x16, 0x10, 1, 0, 0, 0, 0]);
    bench.stage.handle_frame(bench.now, &no_consumer);
    let reason = bench.reason();
    assert!(reason.starts_with("rotation: no emergency 0x8130 within "), "{reason}");
}

/// The drive notices the lost heartbeat and stands, but keeps its power.
#[test]
fn prove_fails_on_a_drive_that_keeps_its_power() {
    let mut bench = Bench::new(&config(&[]), Operation::Prove);
    assert_eq!(bench.run(), Outcome::Completed, "power off is seen by SDO, without a TPDO");
    let mut bench = Bench::new(&config(&[]), Operation::Prove);
    bench.is_deaf = true;
    let reason = bench.reason();
    assert!(reason.starts_with("stage: the drives have not confirmed"), "{reason}");
    assert!(reason.contains("press the emergency stop"), "{reason}");
}
