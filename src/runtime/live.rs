//! A session on a CAN bus and a tracker, in real time.

use super::drive::{Witness, World, carry_out, drive};
use super::realtime::{RealTime, wake_in_time};
use super::sink::{RunReport, Sink};
use super::timing::{Clock, TimingFigures, TimingReport};
use crate::canopen::{Frame, cob};
use crate::session::{HELD_UP, Input, Machine, Record};
use crate::transport::can::{BusEvent, CanBus, CanError};
use crate::transport::link::Link;
use crate::units::Time;
use std::time::{Duration, SystemTime};

/// The longest the control thread waits on the bus in one go: tracker news are taken in between.
const WAIT_MAX: Duration = Duration::from_millis(5);

/// With `--realtime` the last part before a deadline is not slept but spun: to wake a thread takes the
/// system tens of microseconds.
const SPIN: Duration = Duration::from_micros(150);

/// Time between two looks at what the tracker's link keeps back and counts.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// More messages a second than this from the tracker are a flood.
const FLOOD_PER_S: f64 = 5000.0;

/// A session in real time, its bus and its tracker: everything the session is given goes through
/// here, with the time of now.
struct Live<'a, W> {
    session: &'a mut dyn Machine,
    bus: &'a mut dyn CanBus,
    tracker: Option<&'a mut Link>,
    clock: Clock,
    witness: W,
    timing: TimingFigures,
    /// How long before a deadline the thread stops sleeping.
    spin: Duration,
    /// When the tracker's link was last looked at, and the count of its messages then.
    looked: Time,
    counted: u64,
    /// A frame that was made before this is stale.
    stale_before: Option<Time>,
    /// The time of the last input.
    last: Time,
    /// The first deadline met since everything was sent.
    met: Option<Time>,
}

impl<'a, W: Witness> Live<'a, W> {
    fn new(
        session: &'a mut dyn Machine,
        bus: &'a mut dyn CanBus,
        tracker: Option<&'a mut Link>,
        clock: Clock,
        witness: W,
    ) -> Self {
        // What waits on the bus came before the session was made, and is given to it afterwards.
        let last = clock.now();
        let counted = tracker.as_ref().map_or(0, |link| link.messages());
        Live {
            session,
            bus,
            tracker,
            clock,
            witness,
            timing: TimingFigures::default(),
            spin: Duration::ZERO,
            looked: last,
            counted,
            stale_before: None,
            last,
            met: None,
        }
    }

    /// Gives `input` to the session as of `at`. Where the thread was held up for longer than the
    /// drives bear, the session is told to stop first: whatever it is given after a gap, it makes no
    /// set-point of it.
    fn give_at(&mut self, at: Time, input: Input) {
        self.check_gap(self.session.deadline());
        self.handle(at.max(self.last), input);
    }

    /// Tells the session to stop where longer has passed since `since` than the drives bear. What it
    /// made before and was not sent yet is stale.
    fn check_gap(&mut self, since: Time) {
        let now = self.clock.now();
        if let Some(reason) = self.held_up(now.since(since)) {
            self.stale_before = Some(now);
            self.handle(now, Input::Stop(reason));
        }
    }

    /// What is due is done with the input, so how late that is is noted.
    fn handle(&mut self, now: Time, input: Input) {
        let deadline = self.session.deadline();
        if now >= deadline {
            self.timing.deadline_lateness.add_us(now.since(deadline));
            self.met.get_or_insert(deadline);
        }
        self.session.handle(now, input);
        self.last = now;
    }

    /// Why a run ends that nothing was done for during `gap`; `None` where the drives bear that.
    fn held_up(&self, gap: Duration) -> Option<String> {
        let max = self.session.silence_max().filter(|max| gap >= *max)?;
        let messages = self.tracker.as_ref().map_or(0, |link| link.messages() - self.counted);
        let cause = flood(messages, self.clock.now().since(self.looked)).unwrap_or_else(|| {
            "was the program suspended, or the machine busy? See --realtime".to_owned()
        });
        Some(format!(
            "{HELD_UP}{} ms (limit {}, the drives' heartbeat time or tracker.hold_after_s), {cause}",
            gap.as_millis(),
            max.as_millis()
        ))
    }

    /// When the frame arrived that the bus gave last: by the kernel's stamp where there is one, but
    /// never before anything that the session was told already, and before what is due. A bench that
    /// was late would otherwise make up, frame by frame, for each SYNC that it missed.
    fn arrival(&self) -> Time {
        let age = self.bus.received_at().and_then(|at| SystemTime::now().duration_since(at).ok());
        let arrived = self.clock.now() - age.unwrap_or_default();
        arrived.min(self.session.deadline() - Duration::from_nanos(1)).max(self.last)
    }

    /// Notes how late a frame that was made at `made` and has just left was: a SYNC after its time, a
    /// set-point after the feedback.
    fn note_sent(&mut self, made: Time, frame: &Frame) {
        match (frame.cob_id(), self.met) {
            (Some(cob::SYNC), Some(due)) => self.timing.note_sync(self.clock.now().since(due)),
            (Some(0x201..=0x27F), None) => {
                self.timing.set_point_delay.add_us(self.clock.now().since(made));
            }
            _ => {}
        }
    }

    /// Takes a portion of what the tracker's link says, and none of it once a deadline is due.
    fn take_events(&mut self) {
        let now = self.clock.now();
        if let Some(link) = &mut self.tracker
            && now.since(self.looked) >= LOOK_PERIOD
        {
            let (messages, passed_over) = (link.messages(), link.passed_over());
            // What came during a gap is counted from the look before it.
            self.check_gap(self.session.deadline());
            (self.looked, self.counted) = (now, messages);
            if let Some(event) = passed_over {
                self.give(Input::Tracker(event));
            }
        }
        for _ in 0..Link::PORTION {
            if self.clock.now() >= self.session.deadline() {
                break;
            }
            let next = self.tracker.as_mut().and_then(|link| link.try_next());
            let Some(event) = next else { break };
            self.give(Input::Tracker(event));
        }
    }

    /// Waits for one event of the bus; false when none came.
    fn take_frame(&mut self, timeout: Duration) -> bool {
        let input = match self.bus.receive(timeout) {
            Ok(None) => return false,
            Ok(Some(BusEvent::Frame(frame))) => {
                self.give_at(self.arrival(), Input::Frame(frame));
                return true;
            }
            Ok(Some(BusEvent::Error(error))) if error.is_bus_off() || error.is_restarted() => {
                Input::BusFault(error.to_string())
            }
            Ok(Some(BusEvent::Error(error))) => Input::BusWarning(error.to_string()),
            Err(error) => Input::BusFault(error.to_string()),
        };
        let has_failed = matches!(input, Input::BusFault(_));
        self.give(input);
        !has_failed
    }
}

impl<W: Witness> World for Live<'_, W> {
    fn machine(&mut self) -> &mut dyn Machine {
        self.session
    }

    fn witness(&mut self) -> &mut dyn Witness {
        &mut self.witness
    }

    fn now(&self) -> Time {
        self.clock.now()
    }

    fn give(&mut self, input: Input) {
        self.give_at(self.clock.now(), input);
    }

    /// A frame that was made before a gap longer than the drives bear is never sent.
    fn send(&mut self, made: Time, frame: &Frame) -> Result<bool, CanError> {
        self.check_gap(made);
        if self.stale_before.is_some_and(|before| made < before) {
            return Ok(false);
        }
        self.bus.send(frame)?;
        self.note_sent(made, frame);
        Ok(true)
    }

    fn record(&mut self, record: Record) {
        self.witness.take(record, None);
    }

    /// What the bus holds came before what is due and what the tracker says now: as many frames as a
    /// bus at full load brings in some 30 ms, so that a flood, which never ends, neither holds the
    /// thread nor keeps the deadline waiting.
    fn take_arrived(&mut self) -> bool {
        self.met = None;
        let any = (0..256).take_while(|_| self.take_frame(Duration::ZERO)).count() > 0;
        any && self.clock.now() < self.session.deadline()
    }

    fn go_on(&mut self) {
        if self.clock.now() >= self.session.deadline() {
            self.give(Input::Tick);
            self.witness.progress(self.session.progress());
            carry_out(self);
            self.met = None;
        }
        self.take_events();
        carry_out(self);
        self.met = None;
        // Also where more events wait: a thread that never waits is throttled by the system.
        let deadline = self.session.deadline();
        let wait = deadline.since(self.clock.now()).saturating_sub(self.spin).min(WAIT_MAX);
        match wait.is_zero() {
            false => _ = self.take_frame(wait),
            true => while self.clock.now() < deadline && !self.take_frame(Duration::ZERO) {},
        }
    }
}

/// So many messages from the tracker in this time in words, where they are a flood.
fn flood(messages: u64, time: Duration) -> Option<String> {
    let per_s = messages as f64 / time.max(LOOK_PERIOD).as_secs_f64();
    (per_s > FLOOD_PER_S)
        .then(|| format!("by a flood from the tracker? {messages} messages, {per_s:.0} a second"))
}

/// Runs `session`, an insertion or an operation, until it ends, on the calling thread, which is the
/// SYNC thread; `realtime` says how that runs, for the record.
///
/// The bus is waited upon until the session's next deadline, which is absolute, so that a late
/// cycle does not delay the ones after it. Tracker events were dated when they were received; a
/// bounded portion of them is taken whenever the thread wakes, at least every 5 ms, and only while
/// no deadline is due.
pub fn run_live(
    session: &mut dyn Machine,
    bus: &mut dyn CanBus,
    tracker: Option<&mut Link>,
    clock: Clock,
    realtime: Option<RealTime>,
    sink: Sink<'_>,
) -> RunReport {
    wake_in_time();
    let mut run = Live::new(session, bus, tracker, clock, sink);
    run.spin = if realtime.is_some() { SPIN } else { Duration::ZERO };
    let outcome = drive(&mut run);
    run.witness.progress(run.session.progress());
    let figures = run.timing.report(run.session.stage_counters());
    let timing = TimingReport { frames_dropped: run.bus.dropped().ok(), realtime, ..figures };
    let (gates, left) = (run.session.gate_counts(), run.session.left());
    let report = run.witness.finish(outcome, clock.now(), gates, Some(timing));
    RunReport { left, ..report }
}

#[cfg(test)]
mod tests;
