//! Insertions on the virtual stage, with a tracker that each test scripts.

use crate::canopen::Frame;
use crate::config::Config;
use crate::emulator::{StageOutput, VirtualStage};
use crate::session::{Input, Machine, Output, Record, Session, StepRecord};
use crate::tracker::{Event, Sample, Validity};
use crate::units::Time;
use nalgebra::Vector3;
use std::time::Duration;

struct Bench {
    now: Time,
    session: Session,
    stage: VirtualStage,
    tool: String,
    /// Measured tip position, 40 times a second from `next_sample` on.
    tip_mm: Vector3<f64>,
    /// Measured position of the target's tool, as often.
    target_mm: Option<Vector3<f64>>,
    next_sample: Time,
    samples: u32,
    /// Each position is received together with an earlier one, which is this far behind, mm.
    behind_mm: Option<f64>,
    /// RPDO1 and SDO requests do not reach the insertion drive.
    is_deaf: bool,
    /// By how many counts the insertion axis was moved by hand.
    moved_counts: i32,
    events: Vec<String>,
    steps: Vec<StepRecord>,
}

impl Bench {
    fn new(sets: &[&str]) -> Self {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        let config = Config::from_sources(&[], &sets).unwrap();
        let now = Time::ZERO;
        Bench {
            now,
            session: Session::new(config.session().unwrap(), now),
            stage: VirtualStage::new(config.virtual_stage().unwrap(), now),
            tool: config.tracker.tool,
            tip_mm: Vector3::zeros(),
            target_mm: None,
            next_sample: Time::NEVER,
            samples: 0,
            behind_mm: None,
            is_deaf: false,
            moved_counts: 0,
            events: Vec::new(),
            steps: Vec::new(),
        }
    }

    fn settle(&mut self) {
        loop {
            while let Some(output) = self.session.poll() {
                match output {
                    Output::Transmit { frame, .. } => {
                        let is_lost = matches!(frame.cob_id(), Some(0x201 | 0x601));
                        if !(self.is_deaf && is_lost) {
                            let frame = moved(&frame, 0x201, -self.moved_counts);
                            self.stage.handle_frame(self.now, &frame);
                        }
                    }
                    Output::Record(Record::Event { text, .. }) => self.events.push(text),
                    Output::Record(Record::Step(step)) => self.steps.push(*step),
                    Output::Record(_) => {}
                }
            }
            match self.stage.poll() {
                Some(StageOutput::Frame(frame)) => {
                    let frame = moved(&frame, 0x181, self.moved_counts);
                    self.session.handle(self.now, Input::Frame(frame));
                }
                Some(_) => {}
                None => return,
            }
        }
    }

    fn step(&mut self) {
        self.settle();
        let due = self.session.deadline().min(self.stage.deadline());
        self.now = self.now.max(due.min(self.next_sample));
        self.stage.handle_timeout(self.now);
        if self.now < self.next_sample {
            self.session.handle(self.now, Input::Tick);
        } else {
            self.next_sample = self.now + Duration::from_millis(25);
            for behind_mm in self.behind_mm.into_iter().chain([0.0]) {
                let sample = self.sample(self.tip_mm - Vector3::z() * behind_mm);
                self.session.handle(self.now, Input::Tracker(Event::Sample(sample)));
            }
            if let Some(target_mm) = self.target_mm {
                let sample = Sample { tool: TARGET.to_owned(), ..self.sample(target_mm) };
                self.session.handle(self.now, Input::Tracker(Event::Sample(sample)));
            }
        }
        self.settle();
    }

    fn sample(&mut self, at_mm: Vector3<f64>) -> Sample {
        self.samples += 1;
        let ahead_mm = 1e-3 * f64::from(self.samples % 7);
        Sample {
            tool: self.tool.clone(),
            receive_time: self.now,
            source_unix_ns: None,
            position_mm: at_mm + Vector3::z() * ahead_mm,
            orientation: None,
            validity: Validity::Valid,
        }
    }

    fn run_until(&mut self, event: &str) {
        while !self.events.iter().any(|text| text.contains(event)) {
            assert_eq!(self.session.outcome(), None);
            self.step();
        }
    }

    fn run_for(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.step();
        }
    }

    fn reason(&mut self) -> String {
        while self.session.outcome().is_none() {
            self.step();
        }
        self.session.outcome().unwrap().stop_reason().expect("stopped").to_owned()
    }

    /// Another master enables the insertion drive, with `pause` after each controlword; the run stops for it.
    fn enable_from_elsewhere(&mut self, pause: Duration) {
        for controlword in [0x06, 0x07, 0x0F] {
            let write = Frame::new(0x601, &[0x2B, 0x40, 0x60, 0, controlword, 0, 0, 0]);
            self.stage.handle_frame(self.now, &write);
            self.run_for(pause);
        }
        let reason = self.reason();
        let expected = "stage: insertion: the drive has power before the bench gave it any";
        assert!(reason.starts_with(expected), "{reason}");
    }
}

/// The frame with the position in it, which follows the status- or controlword, moved; `frame` itself if it has
/// another COB-ID.
fn moved(frame: &Frame, cob_id: u16, counts: i32) -> Frame {
    match *frame.data() {
        [a, b, ref position @ ..] if frame.cob_id() == Some(cob_id) => {
            let position = i32::from_le_bytes(position.try_into().unwrap()) + counts;
            Frame::new(cob_id, &[&[a, b], &position.to_le_bytes()[..]].concat())
        }
        _ => *frame,
    }
}

const CONFIGURED: &str = "both drives are configured";
const ENABLING: &str = "enabling both axes";
const TARGET: &str = "TargetToTracker";

/// The mean that decides takes 0.5 s. The tip times out after 0.3 s.
#[test]
fn a_start_out_of_reach_is_refused_for_that_and_not_for_the_tip_timeout() {
    let mut bench = Bench::new(&["tracker.timeout_s=0.3", "insertion.depth_mm=150"]);
    bench.tip_mm = Vector3::new(-100.0, 3.0, -2.0);
    bench.run_until(CONFIGURED);
    bench.next_sample = bench.now + Duration::from_millis(200);
    let reason = bench.reason();
    assert!(reason.starts_with("insertion: the plane is out of reach"), "{reason}");
}

/// The first position is out of reach, the mean is not.
#[test]
fn a_start_whose_mean_is_within_reach_begins_although_the_tip_times_out() {
    let seen_at = |x_mm: f64, then_mm: f64, phase_ms: u64| {
        // 0.5 s is no whole number of these SYNCs.
        let sets = ["tracker.timeout_s=0.3", "insertion.depth_mm=150", "can.sync_ms=12"];
        let mut bench = Bench::new(&sets);
        bench.tip_mm.x = x_mm;
        bench.run_until(CONFIGURED);
        bench.next_sample = bench.now + Duration::from_millis(phase_ms);
        bench.run_for(Duration::from_millis(phase_ms + 130));
        bench.tip_mm.x = then_mm;
        while bench.session.outcome().is_none() {
            if bench.events.iter().any(|text| text.contains(ENABLING)) {
                return Ok(bench.now);
            }
            bench.step();
        }
        Err(bench.reason())
    };
    // The smallest distance in whole mm from which the plane is out of reach.
    let refused_mm = (40..100)
        .map(f64::from)
        .find(|x_mm| seen_at(*x_mm, *x_mm, 150).is_err())
        .expect("a plane out of reach");
    for phase_ms in [150, 153, 157] {
        let begun = seen_at(refused_mm, refused_mm - 2.0, phase_ms);
        assert!(begun.is_ok(), "{phase_ms} ms: {begun:?}");
    }
}

/// The tip leaves before the drives are configured, or when power is coming on. The plane is out of reach from there.
#[test]
fn a_start_that_has_moved_out_of_reach_begins_no_insertion() {
    for (is_powered, timeout_s) in [(false, 5.0), (true, 5.0), (true, 0.3)] {
        let timeout = format!("tracker.timeout_s={timeout_s}");
        let mut bench = Bench::new(&["insertion.depth_mm=150", &timeout]);
        bench.next_sample = Time::ZERO;
        match is_powered {
            true => bench.run_until(ENABLING),
            false => {
                bench.is_deaf = true;
                bench.run_for(Duration::from_millis(300));
                bench.is_deaf = false;
            }
        }
        bench.tip_mm.x = -100.0;
        let reason = bench.reason();
        assert!(reason.starts_with("insertion: the plane is out of reach"), "{reason}");
        assert!(bench.steps.is_empty());
        let had_power = bench.events.iter().any(|text| text.contains(ENABLING));
        assert_eq!(had_power, is_powered, "{:?}", bench.events);
    }
}

/// The bench waits for the tip meanwhile.
#[test]
fn an_axis_that_was_moved_by_hand_begins_no_insertion_past_its_limit() {
    let mut bench = Bench::new(&["insertion.depth_mm=300"]);
    bench.run_until(CONFIGURED);
    // Where the axes stand is checked at the first answers, and the axis is moved after that.
    bench.run_for(Duration::from_millis(500));
    bench.moved_counts = 12 * 4646;
    bench.next_sample = bench.now;
    let reason = bench.reason();
    let expected =
        "stage: insertion: 312.000 mm is over the limit of 310.000 mm (stage.insertion.max_mm)";
    assert!(reason.starts_with(expected), "{reason}");
    assert!(bench.steps.is_empty());
}

/// The mean of the positions is within reach, but the tip is not: it has gone on since.
#[test]
fn a_good_mean_of_a_tip_that_has_left_begins_no_insertion() {
    let sets = ["insertion.depth_mm=150", "tracker.gates.step_sds=30"];
    let config = Config::from_sources(&[], &sets.map(str::to_owned)).unwrap().session().unwrap();
    let is_refused = |x_mm: &f64| config.check_reach(&Vector3::new(*x_mm, 0.0, 0.0)).is_err();
    let refused_mm = (40..100).map(f64::from).find(is_refused).expect("a plane out of reach");
    let begins = |end_mm: f64| {
        let mut bench = Bench::new(&sets);
        bench.tip_mm.x = refused_mm;
        bench.run_until(CONFIGURED);
        bench.next_sample = bench.now;
        bench.run_for(Duration::from_millis(150));
        bench.tip_mm.x = refused_mm - 14.0;
        bench.run_for(Duration::from_millis(300));
        bench.tip_mm.x = end_mm;
        loop {
            match bench.session.outcome() {
                Some(_) => return false,
                None if bench.events.iter().any(|text| text.contains(ENABLING)) => return true,
                None => bench.step(),
            }
        }
    };
    assert!(begins(refused_mm - 13.0));
    assert!(!begins(refused_mm));
}

/// It leaves the plane by more than its tolerance after power has come on.
#[test]
fn a_target_that_has_moved_off_the_plane_begins_no_insertion() {
    let tool = format!("goal.tool=\"{TARGET}\"");
    let sets = ["goal.kind=\"target\"", "goal.position_mm=[0.0, 4.0, 60.0]", &tool];
    let mut bench = Bench::new(&[&sets[..], &["goal.tool_average_s=0.1"]].concat());
    bench.target_mm = Some(Vector3::new(0.0, 4.0, 60.0));
    bench.next_sample = Time::ZERO;
    bench.run_until(ENABLING);
    bench.target_mm = Some(Vector3::new(8.0, 4.0, 60.0));
    let reason = bench.reason();
    assert!(reason.starts_with("goal: the target is 8.0 mm off the plane"), "{reason}");
    assert!(bench.steps.is_empty());
}

/// The time of receipt fits only the last of them. For the others it is too late.
#[test]
fn of_positions_received_at_once_only_the_last_corrects() {
    let mut bench = Bench::new(&["insertion.depth_mm=10", "insertion.plane_out_of_reach=insert"]);
    bench.next_sample = Time::ZERO;
    bench.behind_mm = Some(0.5);
    while bench.steps.len() < 3 {
        bench.step();
    }
    for step in &bench.steps {
        let tip_mm = step.tip_meas_mm.expect("a position");
        assert!(tip_mm.z >= 0.0, "{tip_mm} is 0.5 mm behind");
    }
}

/// The drive ignores the bench. The bench has given it no power, but must not claim that it has none.
#[test]
fn power_from_another_master_that_stays_on_is_reported_at_the_end() {
    let mut bench = Bench::new(&[]);
    bench.run_until(CONFIGURED);
    bench.is_deaf = true;
    bench.enable_from_elsewhere(Duration::from_millis(200));
    let at_end = bench.session.stage_at_end();
    let unknown = at_end.unknown.unwrap_or("nothing");
    assert!(at_end.had_power && unknown.contains("press the emergency stop"), "{unknown}");
    assert!(bench.events.iter().any(|text| text == unknown), "{:?}", bench.events);
}

#[test]
fn power_from_another_master_that_the_stop_took_off_is_reported_at_the_end() {
    let mut bench = Bench::new(&[]);
    bench.run_until(CONFIGURED);
    bench.enable_from_elsewhere(Duration::ZERO);
    let at_end = bench.session.stage_at_end();
    assert!(at_end.had_power, "{at_end:?}");
    assert_eq!(at_end.unknown, None);
}

/// They would fill the record and the screen.
#[test]
fn repeated_warnings_of_the_bus_are_counted() {
    let mut bench = Bench::new(&[]);
    for n in 0..1000 {
        let text = format!("bus error; error counters: tx={n}, rx=0");
        bench.session.handle(bench.now, Input::BusWarning(text));
    }
    bench.session.handle(bench.now, Input::BusWarning("error passive".to_owned()));
    bench.settle();
    let of = |text: &str| bench.events.iter().filter(|event| event.contains(text)).count();
    assert_eq!((of("bus error"), of("error passive")), (10, 1));
    assert_eq!(of("tx=511, rx=0 (512 times)"), 1, "{:?}", bench.events);
}

/// Else the runtime would take the time since the SYNC for a stall of the bench.
#[test]
fn a_late_answer_to_a_sync_makes_nothing_overdue() {
    let mut bench = Bench::new(&["insertion.depth_mm=10", "insertion.plane_out_of_reach=insert"]);
    bench.next_sample = Time::ZERO;
    while bench.steps.is_empty() {
        bench.step();
    }
    bench.now = bench.session.sync_due();
    bench.session.handle(bench.now, Input::Tick);
    while let Some(output) = bench.session.poll() {
        if let Output::Transmit { frame, .. } = output {
            bench.stage.handle_frame(bench.now, &frame);
        }
    }
    bench.now = bench.now + Duration::from_millis(8);
    bench.settle();
    assert!(bench.session.deadline() >= bench.now);
    bench.step();
    assert_eq!(bench.session.outcome(), None);
}
