//! A whole run with foreign frames on its bus: it ends, and the bench sends no target past a limit and none that
//! jumps.

use super::canopen::{frames, written};
use super::fuzz;
use needle_bench::canopen::Frame;
use needle_bench::config::Config;
use needle_bench::emulator::{StageOutput, VirtualStage};
use needle_bench::session::{Input, Machine, Output, Session};
use needle_bench::tracker::{Event, Sample, Validity};
use needle_bench::units::Time;
use std::ops::RangeInclusive;
use std::time::Duration;

/// A whole run takes as long as this number of cases of the other targets.
const COST: usize = 50;
const END_BY: Time = Time::from_nanos(60_000_000_000);
/// Of the default configuration: counts per mm and per turn, and the largest steps in 10 ms.
const PER_MM: f64 = 4646.0;
const PER_TURN: f64 = 378_830.0 / 5.0;
const STEP_MAX_MM: f64 = 0.1;
const STEP_MAX_TURNS: f64 = 0.01;

/// A session, the virtual stage and the bus between them.
struct Run {
    now: Time,
    session: Session,
    stage: VirtualStage,
    tool: String,
    /// The frames on the bus, each with its time and whether the bench sent it.
    bus: Vec<(Time, Frame, bool)>,
}

impl Run {
    fn new() -> Self {
        let sets = [
            "insertion={ depth_mm = 4, plane_out_of_reach = \"insert\" }",
            "insertion.speed_mm_per_s=4",
            "stage.insertion.max_mm=4.2",
            "stage.rotation.min_deg=-60",
            "stage.rotation.max_deg=60",
            "control.nested_saturation.rotation_max_deg_per_mm=20",
        ];
        let config = Config::from_sources(&[], &sets.map(str::to_owned)).expect("valid");
        let now = Time::ZERO;
        Run {
            now,
            session: Session::new(config.session().expect("valid"), now),
            stage: VirtualStage::new(config.virtual_stage().unwrap(), now),
            tool: config.tracker.tool,
            bus: Vec::new(),
        }
    }

    fn settle(&mut self) {
        loop {
            let mut quiet = true;
            while let Some(output) = self.session.poll() {
                quiet = false;
                if let Output::Transmit { frame, .. } = output {
                    self.bus.push((self.now, frame, true));
                    self.stage.handle_frame(self.now, &frame);
                }
            }
            while let Some(output) = self.stage.poll() {
                quiet = false;
                let input = match output {
                    StageOutput::Frame(frame) => {
                        self.bus.push((self.now, frame, false));
                        Input::Frame(frame)
                    }
                    StageOutput::FaultBegan(_) | StageOutput::Target(_) => continue,
                    StageOutput::Tip { tip, .. } => Input::Tracker(Event::Sample(Sample {
                        tool: self.tool.clone(),
                        receive_time: self.now,
                        source_unix_ns: None,
                        position_mm: tip.x_ts.translation,
                        orientation: None,
                        validity: Validity::Valid,
                    })),
                };
                self.session.handle(self.now, input);
            }
            if quiet {
                return;
            }
        }
    }

    /// Jumps from deadline to deadline until `end`, or until the run is over.
    fn run_until(&mut self, end: Time) {
        self.settle();
        while self.now < end && self.session.outcome().is_none() {
            let due = self.session.deadline().min(self.stage.deadline());
            self.now = self.now.max(due.min(end));
            if self.stage.deadline() <= self.now {
                self.stage.handle_timeout(self.now);
            }
            self.settle();
            if self.session.deadline() <= self.now {
                self.session.handle(self.now, Input::Tick);
            }
            self.settle();
        }
    }

    /// Puts a foreign frame on the bus: drives and bench receive it.
    fn intrude(&mut self, frame: &Frame) {
        self.stage.handle_frame(self.now, frame);
        self.session.handle(self.now, Input::Frame(*frame));
        self.settle();
    }

    /// Every target (607A) that the bench sent to the drive of `rpdo` with Enable Operation set
    /// lies in `range`, counted from the first, and no further than `step_max` from the last.
    fn check_targets(&self, rpdo: u16, range: RangeInclusive<f64>, step_max: f64) {
        let target = |(_, frame, sent): &(Time, Frame, bool)| match frame.data() {
            [control, 0, target @ ..]
                if *sent && frame.cob_id() == Some(rpdo) && control & 0x08 != 0 =>
            {
                Some(f64::from(i32::from_le_bytes(target.try_into().expect("607A"))))
            }
            _ => None,
        };
        let targets: Vec<f64> = self.bus.iter().filter_map(target).collect();
        let first = targets.first().copied().unwrap_or(0.0);
        for pair in targets.windows(2) {
            let (at, step) = (pair[1] - first, (pair[1] - pair[0]).abs());
            assert!(range.contains(&at), "{rpdo:#x}: {at} counts, allowed {range:?}");
            assert!(step <= step_max, "{rpdo:#x}: a step of {step} counts, allowed {step_max}");
        }
    }
}

/// The frames of an undisturbed run, in pieces of forty.
fn corpus() -> Vec<Vec<u8>> {
    let mut run = Run::new();
    run.run_until(END_BY);
    assert!(run.session.outcome().is_some_and(|outcome| outcome.stop_reason().is_none()));
    let mut last = Time::ZERO;
    let script: Vec<[u8; 12]> = run
        .bus
        .iter()
        .map(|(time, frame, _)| {
            let wait_ms = time.since(last).as_millis().min(255) as u8;
            last = *time;
            written(wait_ms, frame)
        })
        .collect();
    script.chunks(40).map(<[[u8; 12]]>::concat).collect()
}

#[test]
fn no_frames_lead_out_of_the_limits_and_every_run_ends() {
    let mut cases = 0;
    fuzz(&corpus(), |input, mutator| {
        if mutator.below(COST) != 0 {
            return;
        }
        cases += 1;
        let mut run = Run::new();
        let begin = Time::ZERO + Duration::from_millis(mutator.below(2000) as u64);
        run.run_until(begin);
        for (wait, frame) in frames(input) {
            run.run_until(run.now + wait);
            run.intrude(&frame);
        }
        run.run_until(END_BY);
        assert!(run.session.outcome().is_some(), "the run does not end");
        let slack = 1.0;
        let depth = -PER_MM - slack..=4.2 * PER_MM + slack;
        run.check_targets(0x201, depth, STEP_MAX_MM * PER_MM + slack);
        let turn_max = PER_TURN / 6.0 + slack;
        run.check_targets(0x202, -turn_max..=turn_max, STEP_MAX_TURNS * PER_TURN + slack);
    });
    println!("{cases} runs");
}
