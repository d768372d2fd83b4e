use super::*;
use crate::archive::Manifest;
use crate::config::Config;
use crate::runtime::{Interrupt, Operator};
use crate::session::{Lane, Outcome, Output, Progress, Session, Severity};
use crate::stage::Counters;
use crate::telemetry::tests::{CONFIG_TOML, Scratch, manifest};
use crate::telemetry::{Backpressure, Recorder, utc_text};
use crate::tracker::{Event, Protocol};
use crate::transport::link::LinkSettings;
use crate::transport::tests::memory::MemoryBus;
use std::io::Cursor;

/// A bus that refuses the first frame and records the others.
#[derive(Default)]
struct Refusing {
    sent: usize,
    accepted: Vec<String>,
}

impl CanBus for Refusing {
    fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
        self.sent += 1;
        if self.sent == 1 {
            return Err(CanError::TransmitQueueFull {
                interface: "can0".to_owned(),
                frame: *frame,
            });
        }
        self.accepted.push(frame.to_string());
        Ok(())
    }
    fn receive(&mut self, _: Duration) -> Result<Option<BusEvent>, CanError> {
        Ok(None)
    }
    fn name(&self) -> &str {
        "can0"
    }
    fn dropped(&self) -> Option<u64> {
        Some(0)
    }
}

struct NoOperator;

impl Operator for NoOperator {
    fn progress(&mut self, _: Progress) {}
    fn event(&mut self, _: Time, _: Lane, _: Severity, _: &str) {}
}

/// A machine whose deadline passed a second before its start: its outcome and its inputs.
struct Stalled(Option<Outcome>, Vec<Input>);

impl Machine for Stalled {
    fn handle(&mut self, _: Time, input: Input) {
        if let (Input::Stop(reason), None) = (&input, &self.0) {
            self.0 = Some(Outcome::Stopped(reason.clone()));
        }
        self.1.push(input);
    }
    fn poll(&mut self) -> Option<Output> {
        None
    }
    fn deadline(&self) -> Time {
        Time::from_nanos(-1_000_000_000)
    }
    fn sync_due(&self) -> Time {
        self.deadline()
    }
    fn outcome(&self) -> Option<&Outcome> {
        self.0.as_ref()
    }
    fn progress(&self) -> Progress {
        Progress::default()
    }
    fn stage_counters(&self) -> Counters {
        Counters::default()
    }
    fn stall_max(&self) -> Option<Duration> {
        self.0.is_none().then_some(Duration::from_millis(100))
    }
}

/// A machine whose SYNC was due 5 s before the start, and whose heartbeat was due another 5 s before that.
struct Overdue(Option<Output>);

impl Machine for Overdue {
    fn handle(&mut self, time: Time, _: Input) {
        self.0 = Some(Output::Transmit { time, frame: Frame::new(cob::SYNC, &[]) });
    }
    fn poll(&mut self) -> Option<Output> {
        self.0.take()
    }
    fn deadline(&self) -> Time {
        Time::from_nanos(-10_000_000_000)
    }
    fn sync_due(&self) -> Time {
        Time::from_nanos(-5_000_000_000)
    }
    fn outcome(&self) -> Option<&Outcome> {
        None
    }
    fn progress(&self) -> Progress {
        Progress::default()
    }
    fn stage_counters(&self) -> Counters {
        Counters::default()
    }
    fn stall_max(&self) -> Option<Duration> {
        None
    }
}

#[test]
fn the_lateness_of_a_sync_counts_from_when_the_sync_was_due() {
    let (clock, mut machine) = (Clock::start(), Overdue(None));
    let mut bus = StampedBus { frame: None, stamp: SystemTime::now() };
    let mut run = Live::new(&mut machine, &mut bus, None, clock, |_, _| {});
    run.give(Input::Tick);
    flush_outputs(&mut run);
    let timing = run.timing.report(Counters::default());
    assert!((5_000_000..9_000_000).contains(&timing.sync_late_us_max), "{timing:?}");
    assert!(timing.deadline_late_us_max >= 10_000_000, "{timing:?}");
}

/// A bus with at most one frame on it, which the kernel received at `stamp`.
struct StampedBus {
    frame: Option<Frame>,
    stamp: SystemTime,
}

impl CanBus for StampedBus {
    fn send(&mut self, _: &Frame) -> Result<(), CanError> {
        Ok(())
    }
    fn receive(&mut self, _: Duration) -> Result<Option<BusEvent>, CanError> {
        Ok(self.frame.take().map(BusEvent::Frame))
    }
    fn received_at(&self) -> Option<SystemTime> {
        Some(self.stamp)
    }
    fn name(&self) -> &str {
        "can0"
    }
    fn dropped(&self) -> Option<u64> {
        Some(0)
    }
}

/// Otherwise the record of a run beside drives that send already could not be replayed.
#[test]
fn a_frame_older_than_the_session_gets_the_time_of_its_start() {
    let clock = Clock::start();
    let (begun, mut session) = (clock.now(), Answering::new(Duration::ZERO, usize::MAX));
    let frame = Some(Frame::new(0x701, &[127]));
    let mut bus = StampedBus { frame, stamp: SystemTime::UNIX_EPOCH };
    let mut run = Live::new(&mut session, &mut bus, None, clock, |_, _| {});
    assert!(run.take_frame(Duration::ZERO));
    let [(time, Input::Frame(_))] = session.inputs[..] else { panic!("{:?}", session.inputs) };
    assert!(time >= begun, "{time:?} before {begun:?}");
}

/// The drives' emergency messages wait on the bus by then, but the bench's own stall is the first reason.
#[test]
fn a_bench_that_stalled_gives_its_stall_as_the_reason() {
    let mut stalled = Stalled(None, Vec::new());
    let emergency = Frame::new(0x81, &[0x30, 0x81, 0x11, 0, 0, 0, 0, 0]);
    live("stalled", &mut stalled, &[emergency], None);
    let reason = stalled.0.as_ref().and_then(Outcome::stop_reason).expect("stopped");
    assert!(reason.starts_with("bench: was held up for "), "{reason}");
    assert!(reason.contains("ms (limit 100, the drives' heartbeat time"), "{reason}");
    let inputs = &stalled.1;
    assert!(matches!(inputs[..], [Input::Stop(_), Input::Frame(_), Input::Tick]), "{inputs:?}");
}

/// A machine that answers a frame with a set-point and a stop with a quick stop, and records its inputs.
struct Answering {
    /// Time that it takes to answer a frame.
    takes: Duration,
    /// Number of tracker events after which it is due.
    due_after: usize,
    inputs: Vec<(Time, Input)>,
    outputs: Vec<Output>,
    outcome: Option<Outcome>,
}

fn set_point() -> Frame {
    Frame::new(0x201, &[0x0F, 0, 1, 0, 0, 0])
}

fn is_tick((_, input): &(Time, Input)) -> bool {
    matches!(input, Input::Tick)
}

fn quick_stop() -> Frame {
    Frame::new(0x201, &[0x02, 0, 0, 0, 0, 0])
}

impl Answering {
    fn new(takes: Duration, due_after: usize) -> Self {
        let (inputs, outputs) = (Vec::new(), Vec::new());
        Answering { takes, due_after, inputs, outputs, outcome: None }
    }

    fn send(&mut self, time: Time, frame: Frame) {
        self.outputs.push(Output::Transmit { time, frame });
    }

    fn tracker_events(&self) -> Vec<&Event> {
        let mut events = Vec::new();
        for (_, input) in &self.inputs {
            if let Input::Tracker(event) = input {
                events.push(event);
            }
        }
        events
    }
}

impl Machine for Answering {
    fn handle(&mut self, now: Time, input: Input) {
        match &input {
            Input::Frame(_) => {
                self.send(now, set_point());
                std::thread::sleep(self.takes);
            }
            Input::Stop(reason) => {
                self.send(now, quick_stop());
                self.outcome = Some(Outcome::Stopped(reason.clone()));
            }
            Input::Tracker(Event::Disconnected { reason }) => {
                self.outcome = Some(Outcome::Stopped(reason.clone()));
            }
            Input::Tick => {
                assert!(self.outputs.is_empty(), "not sent yet: {:?}", self.outputs)
            }
            _ => {}
        }
        self.inputs.push((now, input));
    }
    fn poll(&mut self) -> Option<Output> {
        (!self.outputs.is_empty()).then(|| self.outputs.remove(0))
    }
    fn deadline(&self) -> Time {
        let is_ticked = self.inputs.iter().any(is_tick);
        match self.tracker_events().len() >= self.due_after && !is_ticked {
            true => Time::ZERO,
            false => Time::NEVER,
        }
    }
    fn sync_due(&self) -> Time {
        self.deadline()
    }
    fn outcome(&self) -> Option<&Outcome> {
        self.outcome.as_ref()
    }
    fn progress(&self) -> Progress {
        Progress::default()
    }
    fn stage_counters(&self) -> Counters {
        Counters::default()
    }
    fn stall_max(&self) -> Option<Duration> {
        (self.outcome.is_none() && self.due_after == usize::MAX)
            .then_some(Duration::from_millis(50))
    }
}

/// Runs `machine` with `frames` on its bus, and returns the frames that it sent.
fn live(
    name: &str,
    machine: &mut dyn Machine,
    frames: &[Frame],
    tracker: Option<&mut Link>,
) -> Vec<Frame> {
    let clock = Clock::start();
    let scratch = Scratch::new(name);
    let manifest = Manifest { started_utc: utc_text(clock.origin_utc()), ..manifest() };
    let mut operator = NoOperator;
    let recorder =
        Recorder::create(&scratch.0, manifest, CONFIG_TOML.to_owned(), Backpressure::Block)
            .unwrap();
    let bus = MemoryBus::new();
    let (mut drives, mut bench) = (bus.endpoint(), bus.endpoint());
    frames.iter().for_each(|frame| drives.send(frame).unwrap());
    let sink = Sink::new(Ok(recorder), None, &mut operator, &Interrupt::default());
    run_live(machine, &mut bench, tracker, clock, None, sink);
    let sent = std::iter::from_fn(|| drives.receive(Duration::ZERO).unwrap());
    let frame = |event| match event {
        BusEvent::Frame(frame) => Some(frame),
        BusEvent::Error(_) => None,
    };
    sent.filter_map(frame).collect()
}

/// A set-point that could not be sent within the drives' heartbeat time is never sent.
#[test]
fn after_a_stall_only_the_stop_is_sent() {
    let mut machine = Answering::new(Duration::from_millis(60), usize::MAX);
    let sent = live("stall", &mut machine, &[Frame::new(0x181, &[0; 6])], None);
    assert_eq!(sent, [quick_stop()]);
    let reason = machine.outcome.as_ref().and_then(Outcome::stop_reason).unwrap();
    assert!(reason.starts_with("bench: was held up for ") && reason.len() < 200, "{reason}");
    let mut machine = Answering::new(Duration::ZERO, usize::MAX);
    let mut link = stream("Stylus", 1);
    let sent = live("no-stall", &mut machine, &[Frame::new(0x181, &[0; 6])], Some(&mut link));
    assert_eq!(sent, [set_point()], "without a stall it is sent");
}

/// A pipe with `count` samples of `tool`, to a bench whose tool is "Needle".
fn stream(tool: &str, count: usize) -> Link {
    let line = format!("{{\"tool\":\"{tool}\",\"position_tracker_mm\":[1,2,3]}}\n");
    let (protocol, tools) = (Protocol::Ndjson, vec!["Needle".to_owned()]);
    let settings = LinkSettings { protocol, tools, ..LinkSettings::default() };
    Link::read(Cursor::new(line.repeat(count)), "pipe", settings, || Time::ZERO)
}

#[test]
fn a_flood_of_other_tools_does_not_reach_the_session() {
    let mut machine = Answering::new(Duration::ZERO, usize::MAX - 1);
    let mut link = stream("Stylus", 60_000);
    live("flood", &mut machine, &[], Some(&mut link));
    let events = machine.tracker_events();
    let counts = events.iter().filter_map(|event| match event {
        Event::PassedOver { messages, dropped: 0 } => Some(messages),
        _ => None,
    });
    assert_eq!(events.len() - counts.count(), 3, "connected, saw Stylus, ended: {events:?}");
    assert_eq!(link.messages(), 60_000);
}

#[test]
fn a_deadline_is_met_before_the_next_tracker_event_that_waits() {
    let mut link = stream("Needle", 60);
    let mut machine = Answering::new(Duration::ZERO, 10);
    live("deadline", &mut machine, &[], Some(&mut link));
    assert_eq!(machine.inputs.iter().position(is_tick), Some(10), "{:?}", machine.inputs);
    assert_eq!(machine.tracker_events().len(), 63);
}

#[test]
fn an_answer_is_sent_before_the_machine_does_what_is_due() {
    let mut machine = Answering::new(Duration::ZERO, 0);
    let mut link = stream("Needle", 1);
    let sent = live("answer", &mut machine, &[Frame::new(0x181, &[0; 6])], Some(&mut link));
    assert_eq!(sent, [set_point()]);
    let inputs = &machine.inputs;
    assert!(matches!(inputs[..2], [(_, Input::Frame(_)), (_, Input::Tick)]), "{inputs:?}");
}

#[test]
fn more_messages_per_second_than_a_tracker_sends_are_a_flood() {
    let text = "by a flood from the tracker? 20000 messages, 100000 a second";
    assert_eq!(flood(20_000, Duration::from_millis(200)).as_deref(), Some(text));
    assert_eq!(flood(20_000, Duration::from_secs(10)), None);
}

/// The control thread reads the link's counts first after the stall.
#[test]
fn the_reason_of_a_stall_names_a_flood_that_came_during_it() {
    let mut link = stream("Stylus", 60_000);
    while link.messages() < 60_000 {
        std::thread::yield_now();
    }
    let mut stalled = Stalled(None, Vec::new());
    let mut bus = StampedBus { frame: None, stamp: SystemTime::UNIX_EPOCH };
    let mut run = Live::new(&mut stalled, &mut bus, Some(&mut link), Clock::start(), |_, _| {});
    (run.counts_read, run.counted) = (run.last - Duration::from_secs(1), 0);
    run.take_events();
    let reason = stalled.0.as_ref().and_then(Outcome::stop_reason).unwrap();
    assert!(reason.contains("by a flood from the tracker? 60000 messages, "), "{reason}");
}

/// The kernel stamps frames with CLOCK_REALTIME, which may be set forward or back during a run.
#[test]
fn a_system_clock_that_is_set_moves_no_frame_out_of_order() {
    let clock = Clock::start();
    let mut machine = Answering::new(Duration::ZERO, usize::MAX);
    for set_by_s in [-3600.0, -0.3, 0.0, 0.3, 3600.0] {
        let stamp = SystemTime::now();
        let stamp = match set_by_s < 0.0 {
            // The clock was set back after the frame came, so the stamp is ahead of it.
            true => stamp + Duration::from_secs_f64(-set_by_s),
            false => stamp - Duration::from_secs_f64(set_by_s),
        };
        let mut bus = StampedBus { frame: None, stamp };
        let mut run = Live::new(&mut machine, &mut bus, None, clock, |_, _| {});
        let (last, arrived) = (run.last, run.arrival());
        assert!((last..=clock.now()).contains(&arrived), "{set_by_s} s: {arrived:?}");
        run.give_at(arrived, Input::Tick);
    }
}

/// Runs `session` from deadline to deadline, without waiting.
fn run_ticking(
    session: &mut dyn Machine,
    bus: &mut dyn CanBus,
    clock: Clock,
    sink: Sink<'_>,
) -> RunReport {
    let mut run = Live::new(session, bus, None, clock, sink);
    let outcome = loop {
        flush_outputs(&mut run);
        match run.session.outcome().cloned() {
            Some(outcome) => break outcome,
            None => run.session.handle(run.session.deadline(), Input::Tick),
        }
    };
    run.monitor.finish(run.session, outcome, clock.now(), None)
}

/// Frames queued behind the refused one are stale and never sent; the frames of the stop are. The record holds
/// exactly the frames that were sent.
#[test]
fn behind_a_refused_frame_only_the_stop_is_sent() {
    let config = Config::from_sources(&[], &[]).unwrap();
    let clock = Clock::start();
    let scratch = Scratch::new("refused-frame");
    let manifest = Manifest { started_utc: utc_text(clock.origin_utc()), ..manifest() };
    let mut operator = NoOperator;
    let recorder =
        Recorder::create(&scratch.0, manifest, CONFIG_TOML.to_owned(), Backpressure::Block)
            .unwrap();
    let sink = Sink::new(Ok(recorder), None, &mut operator, &Interrupt::default());
    let mut session = Session::new(config.session().unwrap(), clock.now());
    let mut bus = Refusing::default();
    let report = run_ticking(&mut session, &mut bus, clock, sink);
    let stale = |frame: &&String| frame.starts_with("601#40") || frame.starts_with("602#40");
    assert_eq!(bus.accepted.iter().find(stale), None, "{:?}", bus.accepted);
    let outcome = &report.outcome;
    assert!(matches!(outcome, Outcome::Stopped(reason) if reason.starts_with("can: ")));
    let log = report.run_dir.unwrap().join("can.log");
    let log = std::fs::read_to_string(log).unwrap();
    let sent: Vec<&str> = log.lines().filter_map(|l| l.split(' ').nth(2)).collect();
    assert_eq!(sent, bus.accepted);
}
