//! A whole run in virtual time. Tests can change, delay or lose everything between bench, drives and tracker.

use needle_bench::canopen::Frame;
use needle_bench::config::Config;
use needle_bench::emulator::{StageOutput, TrackedTip, VirtualStage, VirtualStageConfig};
use needle_bench::geometry::so3;
use needle_bench::session::{
    Input, Machine as _, Outcome, Output, Record, Session, SessionConfig, State, StepRecord,
};
use needle_bench::tracker::{Event, Sample, Validity};
use needle_bench::units::Time;
use std::time::Duration;

/// A run that takes longer than this virtual time fails its test.
const END_BY: Time = Time::from_nanos(200_000_000_000);

/// What happens to an input on its way to the bench.
pub(crate) enum Fate {
    Arrives(Input),
    Late(Duration, Input),
    Lost,
}

/// True depth, mm, and rotation, rad.
pub(crate) type Position = (f64, f64);

/// When and where the run was first held or stopped.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Detection {
    pub(crate) time: Time,
    pub(crate) position: Position,
}

/// When the run began to stop.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stopping {
    pub(crate) time: Time,
    /// Number of frames sent until then.
    pub(crate) sent: usize,
}

/// A session, the virtual stage, and the connections between them.
pub(crate) struct Bench {
    pub(crate) now: Time,
    pub(crate) stage: VirtualStage,
    pub(crate) session: Session,
    /// Everything that the session recorded.
    pub(crate) records: Vec<Record>,
    /// Every frame that the session sent.
    pub(crate) sent: Vec<Frame>,
    /// The frames, and the number of samples, that reached the session before its run ended.
    pub(crate) received: (Vec<Frame>, usize),
    pub(crate) detection: Option<Detection>,
    pub(crate) stopping: Option<Stopping>,
    /// The fault ends as soon as it is detected.
    pub(crate) heals: bool,
    tool: String,
    target: Option<String>,
    to_bench: Box<dyn FnMut(Input) -> Fate>,
    to_drives: Box<dyn FnMut(&Frame) -> bool>,
    late: Vec<(Time, Input)>,
}

/// The paper's observer and law, so that the measured numbers do not change with the defaults.
pub(crate) const PAPER: [&str; 5] = [
    "observer.kind=\"coupled\"",
    "observer.coupled.gains=\"placed\"",
    "control.kind=\"feedback-linearization\"",
    "control.feedback_linearization.poles_per_mm=[0.05,0.05,0.05]",
    "control.feedback_linearization.roll_demand_max_deg=60",
];

/// The configuration of the paper's steering with `sets`.
pub(crate) fn configured(sets: &[&str]) -> (SessionConfig, VirtualStageConfig) {
    configured_with(&[&PAPER, sets].concat())
}

/// The default configuration with `sets`. Most insertions here are too short to reach the plane.
pub(crate) fn configured_with(sets: &[&str]) -> (SessionConfig, VirtualStageConfig) {
    let short = "insertion.plane_out_of_reach=\"insert\"";
    let sets: Vec<String> = [&[short], sets].concat().iter().map(|set| set.to_string()).collect();
    let config = Config::from_sources(&[], &sets).expect("valid");
    let mut session = config.session().expect("valid");
    // Skips the wait for another master; no test here measures it.
    session.stage.listen_first = Duration::ZERO;
    (session, config.virtual_stage().expect("valid"))
}

pub(crate) fn is_tracker(input: &Input) -> bool {
    matches!(input, Input::Tracker(_))
}

pub(crate) fn is_frame(input: &Input, cob_ids: &[u16]) -> bool {
    matches!(input, Input::Frame(frame) if frame.cob_id().is_some_and(|id| cob_ids.contains(&id)))
}

impl Bench {
    pub(crate) fn new((session, stage): (SessionConfig, VirtualStageConfig)) -> Self {
        let now = Time::ZERO;
        let mut begun = Session::new(session.clone(), now);
        let peer = "127.0.0.1:18944".to_owned();
        begun.handle(now, Input::Tracker(Event::Connected { peer }));
        Bench {
            now,
            stage: VirtualStage::new(stage, now),
            target: session.goal.and_then(|goal| goal.tool).map(|tool| tool.gate.tool),
            tool: session.tracker.gate.tool,
            session: begun,
            records: Vec::new(),
            sent: Vec::new(),
            received: (Vec::new(), 0),
            detection: None,
            stopping: None,
            heals: false,
            to_bench: Box::new(Fate::Arrives),
            to_drives: Box::new(|_| true),
            late: Vec::new(),
        }
    }

    /// Decides by `fate` what happens to every input on its way to the bench.
    pub(crate) fn spoil(&mut self, fate: impl FnMut(Input) -> Fate + 'static) {
        self.to_bench = Box::new(fate);
    }

    /// Loses the inputs for which `lost` is true on their way to the bench.
    pub(crate) fn lose(&mut self, mut lost: impl FnMut(&Input) -> bool + 'static) {
        self.spoil(move |input| if lost(&input) { Fate::Lost } else { Fate::Arrives(input) });
    }

    /// Changes every sample on its way to the bench.
    pub(crate) fn change_samples(&mut self, mut change: impl FnMut(&mut Sample) + 'static) {
        self.spoil(move |mut input| {
            if let Input::Tracker(Event::Sample(sample)) = &mut input {
                change(sample);
            }
            Fate::Arrives(input)
        });
    }

    /// Changes the insertion drive's position in its TPDO1, counts.
    pub(crate) fn change_depth(&mut self, mut change: impl FnMut(i32) -> i32 + 'static) {
        self.change_tpdo(move |word, counts| (word, change(counts)));
    }

    /// Loses everything that the bench sends to the drives.
    pub(crate) fn deafen_drives(&mut self) {
        self.to_drives = Box::new(|_| false);
    }

    /// Loses the frames for which `lost` is true on their way to the drives.
    pub(crate) fn lose_to_drives(&mut self, mut lost: impl FnMut(&Frame) -> bool + 'static) {
        self.to_drives = Box::new(move |frame| !lost(frame));
    }

    /// Changes statusword and position in TPDO1 of the insertion drive on its way to the bench.
    pub(crate) fn change_tpdo(&mut self, mut change: impl FnMut(u16, i32) -> (u16, i32) + 'static) {
        self.spoil(move |input| match input {
            Input::Frame(frame) if frame.cob_id() == Some(0x181) => {
                let &[s0, s1, p0, p1, p2, p3] = frame.data() else { panic!("mapped otherwise") };
                let (word, counts) =
                    change(u16::from_le_bytes([s0, s1]), i32::from_le_bytes([p0, p1, p2, p3]));
                let ([s0, s1], [p0, p1, p2, p3]) = (word.to_le_bytes(), counts.to_le_bytes());
                Fate::Arrives(Input::Frame(Frame::new(0x181, &[s0, s1, p0, p1, p2, p3])))
            }
            _ => Fate::Arrives(input),
        });
    }

    fn heal(&mut self) {
        self.to_bench = Box::new(Fate::Arrives);
        self.to_drives = Box::new(|_| true);
    }

    /// Gives the session one input directly, whatever fault is set.
    pub(crate) fn hand(&mut self, input: Input) {
        if self.session.outcome().is_none() {
            match &input {
                Input::Frame(frame) => self.received.0.push(*frame),
                Input::Tracker(Event::Sample(_)) => self.received.1 += 1,
                _ => {}
            }
        }
        self.session.handle(self.now, input);
        self.settle();
    }

    /// Puts a frame on the bus: the bench and the drives hear it.
    pub(crate) fn inject(&mut self, frame: Frame) {
        self.stage.handle_frame(self.now, &frame);
        self.hand(Input::Frame(frame));
    }

    /// The sample that a tracker would send now.
    pub(crate) fn sample(&self, tip: &TrackedTip) -> Sample {
        Sample {
            tool: self.tool.clone(),
            receive_time: self.now,
            source_unix_ns: Some(tip.acquisition_time.as_nanos()),
            position_mm: tip.x_ts.translation,
            orientation: Some(so3::quaternion(&tip.x_ts.rotation)),
            validity: Validity::Valid,
        }
    }

    /// Delivers all outputs until neither side has any.
    fn settle(&mut self) {
        loop {
            let mut quiet = true;
            while let Some(output) = self.session.poll() {
                quiet = false;
                match output {
                    Output::Record(record) => self.take(record),
                    Output::Transmit { frame, .. } => {
                        self.sent.push(frame);
                        if (self.to_drives)(&frame) {
                            self.stage.handle_frame(self.now, &frame);
                        }
                    }
                }
            }
            while let Some(output) = self.stage.poll() {
                quiet = false;
                let input = match output {
                    StageOutput::Frame(frame) => Input::Frame(frame),
                    StageOutput::Tip { tip, .. } => {
                        Input::Tracker(Event::Sample(self.sample(&tip)))
                    }
                    StageOutput::Target(seen) => {
                        let tool = self.target.clone().expect("the stage has a target");
                        Input::Tracker(Event::Sample(Sample { tool, ..self.sample(&seen) }))
                    }
                    StageOutput::FaultBegan(_) => continue,
                };
                match (self.to_bench)(input) {
                    Fate::Arrives(input) => self.hand(input),
                    Fate::Late(delay, input) => self.late.push((self.now + delay, input)),
                    Fate::Lost => {}
                }
            }
            if quiet {
                return;
            }
        }
    }

    fn take(&mut self, record: Record) {
        if let Record::State { state, time } = &record {
            let (is_stopping, time) = (*state == State::Stopping, *time);
            if self.detection.is_none() && (is_stopping || *state == State::Holding) {
                let position = self.stage.position_true(self.now);
                self.detection = Some(Detection { time, position });
                if self.heals {
                    self.heal();
                }
            }
            if is_stopping {
                self.stopping = Some(Stopping { time, sent: self.sent.len() });
            }
        }
        self.records.push(record);
    }

    /// Advances to the next deadline, at most to `until`.
    fn step(&mut self, until: Time) {
        self.settle();
        let late = self.late.iter().map(|(due, _)| *due).min().unwrap_or(Time::NEVER);
        let due = self.session.deadline().min(self.stage.deadline()).min(late);
        self.now = self.now.max(due.min(until));
        self.stage.handle_timeout(self.now);
        self.settle();
        while let Some(at) = self.late.iter().position(|(due, _)| *due <= self.now) {
            let (_, mut input) = self.late.remove(at);
            if let Input::Tracker(Event::Sample(sample)) = &mut input {
                sample.receive_time = self.now;
            }
            self.hand(input);
        }
        if self.session.deadline() <= self.now {
            self.hand(Input::Tick);
        }
    }

    pub(crate) fn run_for(&mut self, duration: Duration) {
        let end = self.now + duration;
        while self.now < end {
            self.step(end);
        }
    }

    /// Runs to this true depth.
    pub(crate) fn run_to_mm(&mut self, depth_mm: f64) {
        while self.stage.position_true(self.now).0 < depth_mm {
            assert!(self.session.outcome().is_none() && self.now < END_BY, "{}", self.reason());
            self.step(END_BY);
        }
    }

    /// Runs to the end and one second further without a fault, in which nothing may be sent, recorded or moved.
    pub(crate) fn run_to_end(&mut self) {
        while self.session.outcome().is_none() {
            assert!(self.now < END_BY, "the run does not end");
            self.step(END_BY);
        }
        self.settle();
        if self.heals {
            self.heal();
        }
        let (records, sent) = (self.records.len(), self.sent.len());
        let position = self.stage.position_true(self.now);
        self.run_for(Duration::from_secs(1));
        assert_eq!((records, sent), (self.records.len(), self.sent.len()), "after the end");
        assert_eq!(self.stage.position_true(self.now), position, "both axes stand");
    }

    /// Stalls the bench for `duration`; what is sent to it waits.
    pub(crate) fn hold_up_for(&mut self, duration: Duration) {
        let end = self.now + duration;
        while self.now < end {
            self.now = self.stage.deadline().clamp(self.now, end);
            self.stage.handle_timeout(self.now);
        }
    }

    pub(crate) fn completed(&self) -> bool {
        self.session.outcome() == Some(&Outcome::Completed)
    }

    /// The stop reason.
    pub(crate) fn reason(&self) -> String {
        let reason = self.session.outcome().and_then(Outcome::stop_reason);
        reason.unwrap_or("not stopped").to_owned()
    }

    pub(crate) fn steps(&self) -> impl Iterator<Item = &StepRecord> {
        self.records.iter().filter_map(|record| match record {
            Record::Step(step) => Some(step.as_ref()),
            _ => None,
        })
    }

    /// The texts of the events recorded, in order.
    pub(crate) fn events(&self) -> impl Iterator<Item = &str> {
        self.records.iter().filter_map(|record| match record {
            Record::Event { text, .. } => Some(text.as_str()),
            _ => None,
        })
    }

    /// The received frames that the session recorded.
    pub(crate) fn recorded_frames(&self) -> Vec<Frame> {
        let frame = |record: &Record| match record {
            Record::Can { frame, .. } => Some(*frame),
            _ => None,
        };
        self.records.iter().filter_map(frame).collect()
    }
}
