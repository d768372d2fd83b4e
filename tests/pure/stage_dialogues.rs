//! The dialogues with drives outside a run: status, reset, and a stop while a run moves the drives.

use crate::support::program::{Scratch, needle_bench};
use needle_bench::canopen::cia402::{DriveState, Mode};
use needle_bench::canopen::emcy::EmcyCode;
use needle_bench::canopen::{Frame, NodeId};
use needle_bench::config::Config;
use needle_bench::emulator::fault::{Fault, FaultKind};
use needle_bench::emulator::{StageOutput, VirtualStage};
use needle_bench::runtime::talk_virtual;
use needle_bench::stage::{
    Axis, Dialogue, Output, QuickStop, Reset, SetPoint, Stage, StageConfig, StageEvent,
    StatusReader,
};
use needle_bench::units::Time;

/// A dialogue that sends nothing.
struct Idle;

impl Dialogue for Idle {
    fn handle_frame(&mut self, _: Time, _: &Frame) {}
    fn handle_timeout(&mut self, _: Time) {}
    fn poll_transmit(&mut self) -> Option<Frame> {
        None
    }
    fn deadline(&self) -> Time {
        Time::NEVER
    }
    fn is_over(&self) -> bool {
        true
    }
}

/// A run's master moves the stage while another program talks to the drives.
struct Bench {
    now: Time,
    config: StageConfig,
    master: Stage,
    stage: VirtualStage,
    step: u32,
    events: Vec<StageEvent>,
    /// What the other program has sent.
    sent: Vec<Frame>,
}

impl Bench {
    /// The insertion moves at 2 mm/s.
    fn moving() -> Self {
        let config = Config::from_sources(&[], &[]).unwrap();
        let now = Time::ZERO;
        let stage = config.to_stage().unwrap();
        let mut bench = Bench {
            now,
            master: Stage::new(stage.clone(), now),
            config: stage,
            stage: VirtualStage::new(config.virtual_stage().unwrap(), now),
            step: 0,
            events: Vec::new(),
            sent: Vec::new(),
        };
        while bench.step < 100 {
            bench.go_on_alone(1);
        }
        bench
    }

    fn settle(&mut self, other: &mut dyn Dialogue) {
        loop {
            let mut frames = Vec::new();
            while let Some(output) = self.master.poll() {
                match output {
                    Output::Transmit(frame) => frames.push(frame),
                    Output::Event(StageEvent::Feedback(_)) => {
                        self.step += 1;
                        let way = f64::from(self.step) * 0.02;
                        let set_point = SetPoint { insertion_mm: way, rotation_rad: 0.0 };
                        // The master refuses this once it stops.
                        let _ = self.master.command(set_point);
                    }
                    Output::Event(event) => self.events.push(event),
                }
            }
            let of_other: Vec<Frame> = std::iter::from_fn(|| other.poll_transmit()).collect();
            self.sent.extend(&of_other);
            frames.extend(of_other);
            frames.iter().for_each(|frame| self.stage.handle_frame(self.now, frame));
            let answers: Vec<Frame> = std::iter::from_fn(|| self.stage.poll())
                .filter_map(|output| match output {
                    StageOutput::Frame(frame) => Some(frame),
                    _ => None,
                })
                .collect();
            for frame in &answers {
                self.master.handle_frame(self.now, frame);
                other.handle_frame(self.now, frame);
            }
            if frames.is_empty() && answers.is_empty() {
                return;
            }
        }
    }

    fn go_on(&mut self, other: &mut dyn Dialogue) {
        self.settle(other);
        let due = self.master.deadline().min(self.stage.deadline()).min(other.deadline());
        self.now = self.now.max(due);
        self.stage.handle_timeout(self.now);
        self.master.handle_timeout(self.now);
        other.handle_timeout(self.now);
        self.settle(other);
    }

    fn go_on_alone(&mut self, turns: u32) {
        (0..turns).for_each(|_| self.go_on(&mut Idle));
    }

    fn talk(&mut self, other: &mut dyn Dialogue) {
        let mut turns = 0;
        while !other.is_over() {
            self.go_on(other);
            turns += 1;
            assert!(turns < 10_000, "the dialogue does not end");
        }
    }

    fn depth_mm(&self) -> f64 {
        self.stage.position_true(self.now).0
    }

    fn states(&self) -> [DriveState; 2] {
        self.stage.drives().map(|drive| drive.state())
    }
}

/// The run sends set-points until it notices the stop; they do not undo the stop.
#[test]
fn a_stop_from_outside_ends_a_run_that_is_moving() {
    let mut bench = Bench::moving();
    let at_mm = bench.depth_mm();
    let mut quick_stop = QuickStop::new(&bench.config, bench.now);
    assert_eq!(quick_stop.outcome(Axis::Insertion), None);
    bench.talk(&mut quick_stop);
    assert!((bench.depth_mm() - at_mm).abs() < 0.2, "{} mm", bench.depth_mm() - at_mm);
    assert!(quick_stop.outcome(Axis::Insertion).unwrap().is_ok());
    assert!(quick_stop.outcome(Axis::Rotation).unwrap().is_ok());
    let first: Vec<String> = bench.sent.iter().take(4).map(Frame::to_string).collect();
    let quick_stop = ["601#2B40600002000000", "602#2B40600002000000"];
    assert_eq!(first[..2], ["000#8001", "000#8002"]);
    assert_eq!(first[2..], quick_stop, "not both at once");
    let faults = bench.events.iter().filter(|event| matches!(event, StageEvent::Fault(_)));
    assert_eq!(faults.count(), 1, "the run did not end by its own fault");
    let at_mm = bench.depth_mm();
    bench.go_on_alone(500);
    assert_eq!(bench.depth_mm(), at_mm, "it moved after the stop");
    assert!(!bench.states().contains(&DriveState::OperationEnabled));
}

#[test]
fn a_drive_that_does_not_answer_a_stop_is_named_and_the_other_is_stopped() {
    let mut bench = Bench::moving();
    let mut config = bench.config.clone();
    config.rotation.node = NodeId::new(9).unwrap();
    let mut quick_stop = QuickStop::new(&config, bench.now);
    bench.talk(&mut quick_stop);
    assert!(quick_stop.outcome(Axis::Insertion).unwrap().is_ok());
    assert_eq!(
        quick_stop.outcome(Axis::Rotation).unwrap().unwrap_err(),
        "rotation: node 9 0x6040:00: no SDO reply within 150 ms (attempt 3 of 3), is the drive \
         powered, node-id and bitrate right?; power off was not confirmed"
    );
}

/// A dialogue that loses frames both ways.
struct Lossy<D> {
    dialogue: D,
    is_received: Box<dyn FnMut(&Frame) -> bool>,
    is_sent: Box<dyn FnMut(&Frame) -> bool>,
}

impl<D: Dialogue> Dialogue for Lossy<D> {
    fn handle_frame(&mut self, now: Time, frame: &Frame) {
        if (self.is_received)(frame) {
            self.dialogue.handle_frame(now, frame);
        }
    }
    fn handle_timeout(&mut self, now: Time) {
        self.dialogue.handle_timeout(now);
    }
    fn poll_transmit(&mut self) -> Option<Frame> {
        std::iter::from_fn(|| self.dialogue.poll_transmit()).find(|frame| (self.is_sent)(frame))
    }
    fn deadline(&self) -> Time {
        self.dialogue.deadline()
    }
    fn is_over(&self) -> bool {
        self.dialogue.is_over()
    }
}

/// No answer of the rotation drive arrives, and the first frames to it are lost too.
#[test]
fn a_drive_whose_answers_are_lost_is_stopped_and_loses_power() {
    for lost in [0, 1, 5] {
        let mut bench = Bench::moving();
        let mut left = lost;
        let mut stop = Lossy {
            dialogue: QuickStop::new(&bench.config, bench.now),
            is_received: Box::new(|frame| frame.cob_id() != Some(0x582)),
            is_sent: Box::new(move |frame| {
                let is_lost = frame.cob_id() == Some(0x602) && left > 0;
                left -= u32::from(is_lost);
                !is_lost
            }),
        };
        bench.talk(&mut stop);
        assert_eq!(bench.states(), [DriveState::SwitchOnDisabled; 2], "{lost} lost");
        let error = stop.dialogue.outcome(Axis::Rotation).unwrap().unwrap_err();
        assert!(error.ends_with("; power off was not confirmed"), "{error}");
        let sent = |word: &str| {
            let frame = format!("602#2B406000{word}000000");
            bench.sent.iter().filter(|sent| sent.to_string() == frame).count()
        };
        // Quick stop, and disable voltage.
        assert!(sent("02") >= 2 && sent("00") >= 1, "{} and {}", sent("02"), sent("00"));
    }
}

/// A drive that may still move must not keep its power.
#[test]
fn a_stop_without_statuswords_takes_power_off_and_says_it_is_unconfirmed() {
    let mut bench = Bench::moving();
    let statusword = Frame::new(0x602, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]);
    let mut stop = Lossy {
        dialogue: QuickStop::new(&bench.config, bench.now),
        // The run reads the statusword too, and the stop would receive that answer.
        is_received: Box::new(|frame| !frame.to_string().starts_with("582#4B4160")),
        is_sent: Box::new(move |frame| *frame != statusword),
    };
    bench.talk(&mut stop);
    let error = stop.dialogue.outcome(Axis::Rotation).unwrap().unwrap_err();
    assert!(error.starts_with("rotation: node 2 0x6041:00: no SDO reply within 150 ms"), "{error}");
    assert!(error.ends_with(": power off was not seen, press the emergency stop"), "{error}");
    assert!(stop.dialogue.outcome(Axis::Insertion).unwrap().is_ok());
    assert_eq!(bench.states(), [DriveState::SwitchOnDisabled; 2]);
    // The node has to leave Operational.
    assert_eq!(bench.sent.last().map(Frame::to_string).as_deref(), Some("000#8002"));
}

#[test]
fn status_does_not_disturb_a_moving_run() {
    let mut bench = Bench::moving();
    let mut reader = StatusReader::new(&bench.config, bench.now);
    bench.talk(&mut reader);
    let status = reader.status(Axis::Insertion).unwrap();
    assert_eq!(status.statusword.state(), Some(DriveState::OperationEnabled));
    assert_eq!(status.mode, Some(Mode::CSP));
    assert!(status.position.is_some_and(|mm| (1.5..2.5).contains(&mm)), "{status:?}");
    assert_eq!(status.homed, None, "a drive reports this in homing mode only");
    assert!(bench.sent.iter().all(|frame| frame.data()[0] == 0x40), "not an SDO upload");
    bench.go_on_alone(200);
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))));
}

/// The insertion drive answers once.
#[test]
fn the_status_of_a_drive_that_falls_silent_is_an_error() {
    let mut bench = Bench::moving();
    let mut answers = 0;
    let mut reader = Lossy {
        dialogue: StatusReader::new(&bench.config, bench.now),
        is_received: Box::new(move |frame| {
            answers += u32::from(frame.cob_id() == Some(0x581));
            answers <= 1
        }),
        is_sent: Box::new(|_| true),
    };
    bench.talk(&mut reader);
    let error = reader.dialogue.status(Axis::Insertion).unwrap_err();
    assert!(
        error.starts_with("insertion: node 1 0x1000:00: no SDO reply within 150 ms"),
        "{error}"
    );
}

#[test]
fn a_drive_with_power_is_not_reset() {
    let mut bench = Bench::moving();
    // The insertion axis quick-stops, and may still need power to brake.
    bench.stage.handle_frame(bench.now, &Frame::new(0x601, &[0x2B, 0x40, 0x60, 0, 2, 0, 0, 0]));
    assert_eq!(bench.states()[0], DriveState::QuickStopActive);
    let mut reset = Reset::new(&bench.config, bench.now);
    bench.talk(&mut reset);
    for (axis, node) in [(Axis::Insertion, 1), (Axis::Rotation, 2)] {
        let why = reset.result(axis).unwrap_err();
        assert!(why.starts_with(&format!("{axis}: node {node} has power (")), "{why}");
    }
}

#[test]
fn a_reset_clears_a_fault_whose_cause_is_gone() {
    let config = Config::from_sources(&[], &[]).unwrap();
    let stage_config = config.to_stage().unwrap();
    let mut stage = VirtualStage::new(config.virtual_stage().unwrap(), Time::ZERO);
    stage.change_drive(
        0,
        Time::ZERO,
        &Fault { code: Some(0x4210), ..Fault::of(FaultKind::DriveFault) },
        true,
    );
    stage.handle_timeout(Time::from_secs_f64(0.01));
    let status = |stage: &mut VirtualStage| {
        let mut reader = StatusReader::new(&stage_config, Time::ZERO);
        talk_virtual(&mut reader, stage);
        Axis::BOTH.map(|axis| reader.status(axis).unwrap())
    };
    let [before, _] = status(&mut stage);
    assert_eq!(before.statusword.state(), Some(DriveState::Fault));
    assert_eq!(before.error_history, [EmcyCode(0x4210)]);
    let mut reset = Reset::new(&stage_config, Time::ZERO);
    talk_virtual(&mut reset, &mut stage);
    for (axis, after) in Axis::BOTH.into_iter().zip(status(&mut stage)) {
        assert_eq!(reset.result(axis).map(|word| word.state()), Ok(after.statusword.state()));
        assert_eq!(after.statusword.state(), Some(DriveState::SwitchOnDisabled));
        assert_eq!((after.error_history.len(), after.error_code), (0, None));
    }
    // While the emergency stop is pressed, the drive stays in fault.
    stage.change_drive(
        1,
        Time::ZERO,
        &Fault { code: Some(0x4210), ..Fault::of(FaultKind::DriveFault) },
        true,
    );
    stage.change_drive(1, Time::ZERO, &Fault::of(FaultKind::EmergencyStop), true);
    stage.handle_timeout(Time::from_secs_f64(20.0));
    let mut reset = Reset::new(&stage_config, Time::ZERO);
    talk_virtual(&mut reset, &mut stage);
    assert!(reset.result(Axis::Insertion).is_ok());
    let why = reset.result(Axis::Rotation).unwrap_err();
    assert!(why.starts_with("rotation: node 2 stays in fault, error 0x4210"), "{why}");
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["stage", "--virtual", "reset"]);
    assert_eq!((said.status, said.stdout.lines().count()), (0, 2), "{}", said.screen());
}
