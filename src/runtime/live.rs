//! A session on a CAN bus and a tracker, in real time.

use super::interrupt::Interrupt;
use super::realtime::RealTime;
use super::sink::{RunReport, Sink};
use super::timing::{Clock, TimingFigures, TimingReport};
use super::virtual_time::stop_reason;
use crate::canopen::{Frame, cob};
use crate::session::{Direction, Input, Machine, Output, Record};
use crate::transport::can::{BusEvent, CanBus};
use crate::transport::link::Link;
use crate::units::Time;
use std::time::{Duration, SystemTime};

/// The longest the control thread waits on the bus in one go: tracker news are taken in between.
const WAIT_MAX: Duration = Duration::from_millis(5);

/// A session in real time: everything it is given goes through here, with the time of now.
struct Timed<'a> {
    session: &'a mut dyn Machine,
    clock: Clock,
    timing: TimingFigures,
    /// The time of the last input.
    last: Time,
    /// The first deadline met since everything was sent.
    met: Option<Time>,
}

impl<'a> Timed<'a> {
    fn new(session: &'a mut dyn Machine, clock: Clock) -> Self {
        // What waits on the bus came before the session was made, and is given to it afterwards.
        let last = clock.now();
        Timed { session, clock, timing: TimingFigures::default(), last, met: None }
    }

    /// Gives `input` to the session with the time of now.
    fn give(&mut self, input: Input) {
        self.give_at(self.clock.now(), input);
    }

    /// Gives `input` to the session; what is due is done with it, so how late that is is noted.
    fn give_at(&mut self, now: Time, input: Input) {
        let deadline = self.session.deadline();
        if now >= deadline {
            self.timing.note_deadline(now.since(deadline));
            self.met.get_or_insert(deadline);
        }
        self.session.handle(now, input);
        self.last = now;
    }

    /// When the frame arrived that `bus` gave last: by the kernel's stamp where there is one, but
    /// never before anything that the session was told already, and before what is due. A bench that
    /// was late would otherwise make up, frame by frame, for each SYNC that it missed.
    fn arrival(&self, bus: &dyn CanBus) -> Time {
        let age = bus.received_at().and_then(|at| SystemTime::now().duration_since(at).ok());
        let arrived = self.clock.now() - age.unwrap_or_default();
        arrived.min(self.session.deadline() - Duration::from_nanos(1)).max(self.last)
    }

    /// Notes how late a frame that has just left was, if it is a SYNC.
    fn note_sent(&mut self, frame: &Frame) {
        if let (Some(cob::SYNC), Some(due)) = (frame.cob_id(), self.met) {
            self.timing.note_sync(self.clock.now().since(due));
        }
    }
}

/// Runs `session`, a run or an operation, until it ends, on the calling thread, which is the SYNC
/// thread; `realtime` says how that runs, for the record.
///
/// The bus is waited upon until the session's next deadline, which is absolute, so that a late
/// cycle does not delay the ones after it. Tracker events were dated when they were received;
/// they are taken whenever the thread wakes, at least every 5 ms.
pub fn run_live(
    session: &mut dyn Machine,
    bus: &mut dyn CanBus,
    mut tracker: Option<&mut Link>,
    clock: Clock,
    realtime: Option<RealTime>,
    mut sink: Sink<'_>,
    interrupt: &Interrupt,
) -> RunReport {
    let mut run = Timed::new(session, clock);
    let mut stop_asked = false;
    loop {
        drain(&mut run, bus, &mut sink);
        if let Some(outcome) = run.session.outcome().cloned() {
            let figures = run.timing.report(run.session.stage_counters());
            let timing = TimingReport { frames_dropped: bus.dropped().ok(), realtime, ..figures };
            let gates = run.session.gate_counts();
            return sink.finish(outcome, clock.now(), gates, Some(timing));
        }
        let late = clock.now().since(run.session.deadline());
        if let Some(max) = run.session.silence_max().filter(|max| late >= *max) {
            run.give(Input::Stop(held_up(late, max)));
        }
        // What the bus holds came before what is due and what the tracker says now. A flood, which
        // never ends, does not keep the deadline waiting.
        if take_frames(&mut run, bus) && clock.now() < run.session.deadline() {
            continue;
        }
        while let Some(event) = tracker.as_mut().and_then(|link| link.try_next()) {
            run.give(Input::Tracker(event));
        }
        if let Some(reason) = stop_reason(interrupt, &mut sink, clock.now(), stop_asked) {
            stop_asked = true;
            run.give(Input::Stop(reason));
            continue;
        }
        let (now, deadline) = (clock.now(), run.session.deadline());
        if now >= deadline {
            run.give(Input::Tick);
            sink.progress(run.session.progress());
        } else {
            take_frame(&mut run, bus, deadline.since(now).min(WAIT_MAX));
        }
    }
}

/// Why a run ends that nobody carried on for `late`, told before what the drives say of it.
fn held_up(late: Duration, max: Duration) -> String {
    format!(
        "bench: was held up for {} ms (limit {}, the drives' heartbeat time: they stop by themselves), \
         was the program suspended, or the machine busy? See --realtime",
        late.as_millis(),
        max.as_millis()
    )
}

/// Sends and records everything the session has to say. A frame that the bus does not take is a
/// fault, told to the session; what was queued behind it is stale and never sent, so that the
/// frames that stop the axes are the next to be tried. A frame is recorded as sent once it was.
fn drain(run: &mut Timed<'_>, bus: &mut dyn CanBus, sink: &mut Sink<'_>) {
    let mut failed = false;
    let mut sent = None;
    while let Some(output) = run.session.poll() {
        let frame = match output {
            Output::Record(record @ Record::Can { direction: Direction::Sent, .. }) => {
                sent = Some(record);
                continue;
            }
            Output::Record(record) => {
                sink.take(record, None);
                continue;
            }
            Output::Transmit(frame) => frame,
        };
        match (bus.send(&frame), sent.take()) {
            (Ok(()), record) => {
                run.note_sent(&frame);
                record.into_iter().for_each(|record| sink.take(record, None));
            }
            // One fault a time is enough; the frames that follow it are tried all the same.
            (Err(_), _) if failed => {}
            (Err(error), _) => {
                failed = true;
                discard_frames(run, sink);
                run.give(Input::BusFault(error.to_string()));
            }
        }
    }
    run.met = None;
}

/// Records what the session has said and forgets the frames among it.
fn discard_frames(run: &mut Timed<'_>, sink: &mut Sink<'_>) {
    while let Some(output) = run.session.poll() {
        match output {
            Output::Record(Record::Can { direction: Direction::Sent, .. })
            | Output::Transmit(_) => {}
            Output::Record(record) => sink.take(record, None),
        }
    }
}

/// Takes the frames that have arrived, without waiting; as many as a bus at full load brings in
/// some 30 ms, so that a flood cannot hold the thread. True when there was any.
fn take_frames(run: &mut Timed<'_>, bus: &mut dyn CanBus) -> bool {
    (0..256).take_while(|_| take_frame(run, bus, Duration::ZERO)).count() > 0
}

/// Waits for one event of the bus; false when none came.
fn take_frame(run: &mut Timed<'_>, bus: &mut dyn CanBus, timeout: Duration) -> bool {
    let input = match bus.receive(timeout) {
        Ok(None) => return false,
        Ok(Some(BusEvent::Frame(frame))) => Input::Frame(frame),
        Ok(Some(BusEvent::Error(error))) if error.is_bus_off() || error.is_restarted() => {
            Input::BusFault(error.to_string())
        }
        Ok(Some(BusEvent::Error(error))) => Input::BusWarning(error.to_string()),
        Err(error) => Input::BusFault(error.to_string()),
    };
    let failed = matches!(input, Input::BusFault(_));
    if matches!(input, Input::Frame(_)) {
        run.give_at(run.arrival(bus), input);
    } else {
        run.give(input);
    }
    !failed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::runtime::{OnRecordFailure, Operator};
    use crate::session::{Lane, Outcome, Progress, Session, Severity};
    use crate::stage::Counters;
    use crate::telemetry::tests::run_info;
    use crate::telemetry::{Backpressure, Recorder, RunInfo};
    use crate::transport::can::CanError;
    use crate::transport::memory::MemoryBus;

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
            Progress { insertion_meas_mm: 0.0, depth_mm: 1.0 }
        }
        fn stage_counters(&self) -> Counters {
            Counters::default()
        }
        fn silence_max(&self) -> Option<Duration> {
            Some(Duration::from_millis(100))
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
                Progress { insertion_meas_mm: 0.0, depth_mm: 1.0 }
            }
            fn stage_counters(&self) -> Counters {
                Counters::default()
            }
            fn silence_max(&self) -> Option<Duration> {
                None
            }
        }
        let clock = Clock::start();
        let (begun, mut session) = (clock.now(), Given(Vec::new()));
        let mut run = Timed::new(&mut session, clock);
        let heartbeat = Frame::new(0x701, &[127]);
        assert!(take_frame(&mut run, &mut Waiting(Some(heartbeat)), Duration::ZERO));
        assert!(matches!(session.0[..], [given] if given >= begun), "{:?}", session.0);
    }

    /// The drives' emergency messages wait on the bus by then: the bench's own absence is named first.
    #[test]
    fn a_bench_that_was_away_names_itself() {
        let clock = Clock::start();
        let dir = std::env::temp_dir().join(format!("needle-bench-away-{}", std::process::id()));
        let info = RunInfo { started_utc: clock.origin_utc(), ..run_info() };
        let mut nobody = Nobody;
        let recorder = Recorder::create(&dir, info, Backpressure::Block).unwrap();
        let mut late = Late(None, Vec::new());
        let bus = MemoryBus::new();
        let mut drive = bus.endpoint();
        let mut bench = bus.endpoint();
        drive.send(&Frame::new(0x81, &[0x30, 0x81, 0x11, 0, 0, 0, 0, 0])).unwrap();
        let sink = Sink::new(recorder, OnRecordFailure::Stop, &mut nobody);
        let interrupt = Interrupt::default();
        let report = run_live(&mut late, &mut bench, None, clock, None, sink, &interrupt);
        let reason = report.outcome.stop_reason().expect("stopped");
        assert!(reason.starts_with("bench: was held up for "), "{reason}");
        assert!(reason.contains("ms (limit 100, the drives' heartbeat time"), "{reason}");
        assert!(
            matches!(late.1[..], [Input::Stop(_), Input::Frame(_), Input::Tick]),
            "{:?}",
            late.1
        );
        std::fs::remove_dir_all(dir).unwrap();
    }

    /// What was queued behind a refused frame is stale and never sent; what the fault itself asks
    /// for is; and the record holds as sent what was sent.
    #[test]
    fn behind_a_refused_frame_only_the_stop_is_sent() {
        let config = Config::from_sources(&[], &[]).unwrap();
        let clock = Clock::start();
        let dir = std::env::temp_dir().join(format!("needle-bench-live-{}", std::process::id()));
        let info = RunInfo { started_utc: clock.origin_utc(), ..run_info() };
        let mut nobody = Nobody;
        let recorder = Recorder::create(&dir, info, Backpressure::Block).unwrap();
        let mut sink = Sink::new(recorder, OnRecordFailure::Stop, &mut nobody);
        let mut session = Session::new(config.session().unwrap(), clock.now()).unwrap();
        let mut run = Timed::new(&mut session, clock);
        // Frames are waiting that belong to the bring-up.
        let mut bus = Refusing::default();
        while bus.asked == 0 {
            run.session.handle(run.session.deadline(), Input::Tick);
            drain(&mut run, &mut bus, &mut sink);
        }
        let asked_for = [0x601, 0x602].map(|id| format!("{id:03X}#40"));
        let stale = |frame: &&String| asked_for.iter().any(|request| frame.starts_with(request));
        assert_eq!(bus.taken.iter().find(stale), None, "{:?}", bus.taken);
        while run.session.outcome().is_none() {
            run.session.handle(run.session.deadline(), Input::Tick);
            drain(&mut run, &mut bus, &mut sink);
        }
        let outcome = run.session.outcome().cloned().unwrap();
        assert!(matches!(&outcome, Outcome::Stopped(reason) if reason.starts_with("can: ")));
        let report = sink.finish(outcome, clock.now(), run.session.gate_counts(), None);
        let log = report.record.unwrap().run_dir.join("can.log");
        let log = std::fs::read_to_string(log).unwrap();
        let sent: Vec<&str> = log.lines().filter_map(|l| l.split(' ').nth(2)).collect();
        assert_eq!(sent, bus.taken);
        std::fs::remove_dir_all(dir).unwrap();
    }
}
