use super::*;
use crate::archive::Manifest;
use crate::config::Config;
use crate::runtime::{Interrupt, Operator};
use crate::session::{Lane, Outcome, Output, Progress, Session, Severity};
use crate::stage::Counters;
use crate::telemetry::tests::{CONFIG_TOML, manifest};
use crate::telemetry::{Backpressure, Recorder, utc_text};
use crate::tracker::{Event, Protocol};
use crate::transport::link::LinkSettings;
use crate::transport::tests::memory::MemoryBus;
use std::io::Cursor;

/// A bus that refuses one frame, the first, and notes the others.
#[derive(Default)]
struct Refusing {
    asked: usize,
    taken: Vec<String>,
}

impl CanBus for Refusing {
    fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
        self.asked += 1;
        if self.asked == 1 {
            return Err(CanError::TransmitQueueFull {
                interface: "can0".to_owned(),
                frame: *frame,
            });
        }
        self.taken.push(frame.to_string());
        Ok(())
    }
    fn receive(&mut self, _: Duration) -> Result<Option<BusEvent>, CanError> {
        Ok(None)
    }
    fn name(&self) -> &str {
        "can0"
    }
    fn dropped(&self) -> Result<u64, CanError> {
        Ok(0)
    }
}

struct Nobody;

impl Operator for Nobody {
    fn progress(&mut self, _: Progress) {}
    fn event(&mut self, _: Time, _: Lane, _: Severity, _: &str) {}
}

/// A machine that nobody has carried on for a second.
struct Late(Option<Outcome>, Vec<Input>);

impl Machine for Late {
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

/// A bus with one frame on it, stamped when the machine was started.
struct Waiting(Option<Frame>);

impl CanBus for Waiting {
    fn send(&mut self, _: &Frame) -> Result<(), CanError> {
        Ok(())
    }
    fn receive(&mut self, _: Duration) -> Result<Option<BusEvent>, CanError> {
        Ok(self.0.take().map(BusEvent::Frame))
    }
    fn received_at(&self) -> Option<SystemTime> {
        Some(SystemTime::UNIX_EPOCH)
    }
    fn name(&self) -> &str {
        "can0"
    }
    fn dropped(&self) -> Result<u64, CanError> {
        Ok(0)
    }
}

/// Else no record of a run beside drives that send already could be replayed.
#[test]
fn nothing_is_given_to_a_session_before_it_was_made() {
    struct Given(Vec<Time>);
    impl Machine for Given {
        fn handle(&mut self, now: Time, _: Input) {
            self.0.push(now);
        }
        fn poll(&mut self) -> Option<Output> {
            None
        }
        fn deadline(&self) -> Time {
            Time::NEVER
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
    let clock = Clock::start();
    let (begun, mut session) = (clock.now(), Given(Vec::new()));
    let mut bus = Waiting(Some(Frame::new(0x701, &[127])));
    let mut run = Live::new(&mut session, &mut bus, None, clock, |_, _| {});
    assert!(run.take_frame(Duration::ZERO));
    assert!(matches!(session.0[..], [given] if given >= begun), "{:?}", session.0);
}

/// The drives' emergency messages wait on the bus by then: the bench's own absence is named first.
#[test]
fn a_bench_that_was_away_names_itself() {
    let clock = Clock::start();
    let dir = std::env::temp_dir().join(format!("needle-bench-away-{}", std::process::id()));
    let manifest = Manifest { started_utc: utc_text(clock.origin_utc()), ..manifest() };
    let mut nobody = Nobody;
    let recorder =
        Recorder::create(&dir, manifest, CONFIG_TOML.to_owned(), Backpressure::Block).unwrap();
    let mut late = Late(None, Vec::new());
    let bus = MemoryBus::new();
    let mut drive = bus.endpoint();
    let mut bench = bus.endpoint();
    drive.send(&Frame::new(0x81, &[0x30, 0x81, 0x11, 0, 0, 0, 0, 0])).unwrap();
    let sink = Sink::new(recorder, true, &mut nobody, &Interrupt::default());
    let report = run_live(&mut late, &mut bench, None, clock, None, sink);
    let reason = report.outcome.stop_reason().expect("stopped");
    assert!(reason.starts_with("bench: was held up for "), "{reason}");
    assert!(reason.contains("ms (limit 100, the drives' heartbeat time"), "{reason}");
    assert!(matches!(late.1[..], [Input::Stop(_), Input::Frame(_), Input::Tick]), "{:?}", late.1);
    std::fs::remove_dir_all(dir).unwrap();
}

/// A machine that answers a frame with a set-point and a stop with a stop, and notes its inputs.
struct Answering {
    /// It takes so long to answer a frame.
    takes: Duration,
    /// It is due after so many tracker events.
    due_after: usize,
    inputs: Vec<Input>,
    outputs: Vec<Output>,
    outcome: Option<Outcome>,
}

fn set_point() -> Frame {
    Frame::new(0x201, &[0x0F, 0, 1, 0, 0, 0])
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
        for input in &self.inputs {
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
                assert!(self.outputs.is_empty(), "made and not sent: {:?}", self.outputs)
            }
            _ => {}
        }
        self.inputs.push(input);
    }
    fn poll(&mut self) -> Option<Output> {
        (!self.outputs.is_empty()).then(|| self.outputs.remove(0))
    }
    fn deadline(&self) -> Time {
        let is_ticked = self.inputs.iter().any(|input| matches!(input, Input::Tick));
        match self.tracker_events().len() >= self.due_after && !is_ticked {
            true => Time::ZERO,
            false => Time::NEVER,
        }
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

/// Runs `machine` with `frames` on its bus, and gives the frames that it sent.
fn live(
    name: &str,
    machine: &mut dyn Machine,
    frames: &[Frame],
    tracker: Option<&mut Link>,
) -> Vec<Frame> {
    let clock = Clock::start();
    let dir = std::env::temp_dir().join(format!("needle-bench-{name}-{}", std::process::id()));
    let manifest = Manifest { started_utc: utc_text(clock.origin_utc()), ..manifest() };
    let mut nobody = Nobody;
    let recorder =
        Recorder::create(&dir, manifest, CONFIG_TOML.to_owned(), Backpressure::Block).unwrap();
    let bus = MemoryBus::new();
    let (mut drives, mut bench) = (bus.endpoint(), bus.endpoint());
    frames.iter().for_each(|frame| drives.send(frame).unwrap());
    let sink = Sink::new(recorder, true, &mut nobody, &Interrupt::default());
    run_live(machine, &mut bench, tracker, clock, None, sink);
    std::fs::remove_dir_all(dir).unwrap();
    let sent = std::iter::from_fn(|| drives.receive(Duration::ZERO).unwrap());
    let frame = |event| match event {
        BusEvent::Frame(frame) => Some(frame),
        BusEvent::Error(_) => None,
    };
    sent.filter_map(frame).collect()
}

/// A set-point that was made and could not be sent for longer than the drives bear never is.
#[test]
fn after_a_gap_only_the_stop_is_sent() {
    let mut machine = Answering::new(Duration::from_millis(60), usize::MAX);
    let sent = live("gap", &mut machine, &[Frame::new(0x181, &[0; 6])], None);
    assert_eq!(sent, [quick_stop()]);
    let reason = machine.outcome.as_ref().and_then(Outcome::stop_reason).unwrap();
    assert!(reason.starts_with("bench: was held up for ") && reason.len() < 200, "{reason}");
    let mut machine = Answering::new(Duration::ZERO, usize::MAX);
    let mut link = stream("Stylus", 1);
    let sent = live("no-gap", &mut machine, &[Frame::new(0x181, &[0; 6])], Some(&mut link));
    assert_eq!(sent, [set_point()], "without a gap it is sent");
}

/// A pipe that brings `count` samples of `tool`, to a bench that wants those of "Needle".
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
    let told = counts.count();
    assert_eq!(events.len() - told, 3, "connected, saw Stylus, ended: {events:?}");
    assert_eq!(link.messages(), 60_000);
}

/// A deadline that comes while events are waiting is met before the next of them is taken.
#[test]
fn a_deadline_goes_before_the_tracker() {
    let mut link = stream("Needle", 60);
    let mut machine = Answering::new(Duration::ZERO, 10);
    live("deadline", &mut machine, &[], Some(&mut link));
    let is_tick = |input: &Input| matches!(input, Input::Tick);
    assert_eq!(machine.inputs.iter().position(is_tick), Some(10), "{:?}", machine.inputs);
    assert_eq!(machine.tracker_events().len(), 63);
}

/// What a machine does after its answer to a frame, when it is due at once, delays no answer.
#[test]
fn an_answer_leaves_before_what_is_due() {
    let mut machine = Answering::new(Duration::ZERO, 0);
    let mut link = stream("Needle", 1);
    let sent = live("answer", &mut machine, &[Frame::new(0x181, &[0; 6])], Some(&mut link));
    assert_eq!(sent, [set_point()]);
    assert!(matches!(machine.inputs[..2], [Input::Frame(_), Input::Tick]), "{:?}", machine.inputs);
}

#[test]
fn a_flood_is_named() {
    let text = "by a flood from the tracker? 20000 messages, 100000 a second";
    assert_eq!(flood(20_000, Duration::from_millis(200)).as_deref(), Some(text));
    assert_eq!(flood(20_000, Duration::from_secs(10)), None);
}

/// Also where the thread goes on with a look at what the tracker's link counts.
#[test]
fn a_flood_during_a_gap_is_named_by_the_look_after_it() {
    let mut link = stream("Stylus", 60_000);
    while link.messages() < 60_000 {
        std::thread::yield_now();
    }
    let (mut late, mut bus) = (Late(None, Vec::new()), Waiting(None));
    let mut run = Live::new(&mut late, &mut bus, Some(&mut link), Clock::start(), |_, _| {});
    (run.counts_read, run.counted) = (run.last - Duration::from_secs(1), 0);
    run.take_events();
    let reason = late.0.as_ref().and_then(Outcome::stop_reason).unwrap();
    assert!(reason.contains("by a flood from the tracker? 60000 messages, "), "{reason}");
}

/// The kernel stamps frames by CLOCK_REALTIME, which may be set either way in a run.
#[test]
fn a_system_clock_that_is_set_moves_no_frame_out_of_order() {
    struct Stamped(SystemTime);
    impl CanBus for Stamped {
        fn send(&mut self, _: &Frame) -> Result<(), CanError> {
            Ok(())
        }
        fn receive(&mut self, _: Duration) -> Result<Option<BusEvent>, CanError> {
            Ok(None)
        }
        fn received_at(&self) -> Option<SystemTime> {
            Some(self.0)
        }
        fn name(&self) -> &str {
            "can0"
        }
        fn dropped(&self) -> Result<u64, CanError> {
            Ok(0)
        }
    }
    let clock = Clock::start();
    let mut machine = Answering::new(Duration::ZERO, usize::MAX);
    for set_by_s in [-3600.0, -0.3, 0.0, 0.3, 3600.0] {
        let stamp = SystemTime::now();
        let stamp = match set_by_s < 0.0 {
            // Set back after the frame came: its stamp is ahead of the clock.
            true => stamp + Duration::from_secs_f64(-set_by_s),
            false => stamp - Duration::from_secs_f64(set_by_s),
        };
        let mut bus = Stamped(stamp);
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
        carry_out(&mut run);
        match run.session.outcome().cloned() {
            Some(outcome) => break outcome,
            None => run.session.handle(run.session.deadline(), Input::Tick),
        }
    };
    let gates = run.session.gate_counts();
    run.witness.finish(outcome, clock.now(), gates, None)
}

/// What was queued behind a refused frame is stale and never sent; what the fault itself asks
/// for is; and the record holds as sent what was sent.
#[test]
fn behind_a_refused_frame_only_the_stop_is_sent() {
    let config = Config::from_sources(&[], &[]).unwrap();
    let clock = Clock::start();
    let dir = std::env::temp_dir().join(format!("needle-bench-live-{}", std::process::id()));
    let manifest = Manifest { started_utc: utc_text(clock.origin_utc()), ..manifest() };
    let mut nobody = Nobody;
    let recorder =
        Recorder::create(&dir, manifest, CONFIG_TOML.to_owned(), Backpressure::Block).unwrap();
    let sink = Sink::new(recorder, true, &mut nobody, &Interrupt::default());
    let mut session = Session::new(config.session().unwrap(), clock.now()).unwrap();
    let mut bus = Refusing::default();
    let report = run_ticking(&mut session, &mut bus, clock, sink);
    let asked_for = [0x601, 0x602].map(|id| format!("{id:03X}#40"));
    let stale = |frame: &&String| asked_for.iter().any(|request| frame.starts_with(request));
    assert_eq!(bus.taken.iter().find(stale), None, "{:?}", bus.taken);
    let outcome = &report.outcome;
    assert!(matches!(outcome, Outcome::Stopped(reason) if reason.starts_with("can: ")));
    let log = report.record.unwrap().run_dir.join("can.log");
    let log = std::fs::read_to_string(log).unwrap();
    let sent: Vec<&str> = log.lines().filter_map(|l| l.split(' ').nth(2)).collect();
    assert_eq!(sent, bus.taken);
    std::fs::remove_dir_all(dir).unwrap();
}
