//! A session on a CAN bus and a tracker, in real time.

use super::drive::{RunIo, RunMonitor, drive, flush_outputs};
use super::realtime::{RealTime, wake_in_time};
use super::sink::{RunReport, Sink};
use super::timing::{Clock, TimingFigures, TimingReport};
use crate::canopen::{Frame, cob};
use crate::session::{Input, Machine, Record, STALLED};
use crate::transport::can::{BusEvent, CanBus, CanError};
use crate::transport::link::Link;
use crate::units::Time;
use std::time::{Duration, SystemTime};

/// Longest single wait on the bus; tracker events are taken in between.
const WAIT_MAX: Duration = Duration::from_millis(5);

/// With `--realtime` the thread spins instead of sleeping in this last part before a deadline: to wake up takes
/// tens of microseconds.
const SPIN: Duration = Duration::from_micros(150);

/// At most this many waiting frames are taken at once: as many as a bus at full load brings in some 30 ms, so
/// that an endless flood delays no deadline.
const ARRIVED_MAX: usize = 256;

/// Interval between two readings of the counts of the tracker's link.
const READ_PERIOD: Duration = Duration::from_millis(100);
/// More messages a second than this from the tracker are a flood.
const FLOOD_PER_S: f64 = 5000.0;

/// A session in real time, its bus and its tracker. Every input of the session passes through here.
struct Live<'a, M> {
    session: &'a mut dyn Machine,
    bus: &'a mut dyn CanBus,
    tracker: Option<&'a mut Link>,
    clock: Clock,
    monitor: M,
    timing: TimingFigures,
    /// How long before a deadline the thread stops sleeping.
    spin: Duration,
    /// When the counts of the tracker's link were last read, and its messages then.
    counts_read: Time,
    counted: u64,
    /// A frame that was made before this is stale.
    stale_before: Option<Time>,
    /// The time of the last input.
    last: Time,
    /// When the SYNC was due; `Some` from the handling of a deadline until the frames that follow from it are sent.
    pending_sync_due: Option<Time>,
}

impl<'a, M: RunMonitor> Live<'a, M> {
    fn new(
        session: &'a mut dyn Machine,
        bus: &'a mut dyn CanBus,
        tracker: Option<&'a mut Link>,
        clock: Clock,
        monitor: M,
    ) -> Self {
        // Frames that wait on the bus are older than the session, which gets them with the time of its start.
        let last = clock.now();
        let counted = tracker.as_ref().map_or(0, |link| link.messages());
        Live {
            session,
            bus,
            tracker,
            clock,
            monitor,
            timing: TimingFigures::default(),
            spin: Duration::ZERO,
            counts_read: last,
            counted,
            stale_before: None,
            last,
            pending_sync_due: None,
        }
    }

    /// Gives `input`, which came at `at`, to the session. After a gap longer than [`Machine::stall_max`] the
    /// session is told to stop first, so that it computes no set-point from the input.
    fn give_at(&mut self, at: Time, input: Input) {
        self.check_gap(self.session.deadline());
        self.handle(at.max(self.last), input);
    }

    /// Tells the session to stop if [`Machine::stall_max`] has passed since `since`. Frames that it made before
    /// and that were not sent yet are stale.
    fn check_gap(&mut self, since: Time) {
        let now = self.clock.now();
        if let Some(reason) = self.stall_reason(now.since(since)) {
            self.stale_before = Some(now);
            self.handle(now, Input::Stop(reason));
        }
    }

    /// Gives `input` to the session, which also does what is due; notes how late that is.
    fn handle(&mut self, now: Time, input: Input) {
        let deadline = self.session.deadline();
        if now >= deadline {
            self.timing.deadline_lateness.add_us(now.since(deadline));
            self.pending_sync_due.get_or_insert(self.session.sync_due());
        }
        self.session.handle(now, input);
        self.last = now;
    }

    /// Why a run ends after a `gap` in which the bench did nothing; `None` if it is short enough.
    fn stall_reason(&self, gap: Duration) -> Option<String> {
        let max = self.session.stall_max().filter(|max| gap >= *max)?;
        let messages = self.tracker.as_ref().map_or(0, |link| link.messages() - self.counted);
        let cause =
            flood(messages, self.clock.now().since(self.counts_read)).unwrap_or_else(|| {
                "was the program suspended, or the machine busy? See --realtime".to_owned()
            });
        Some(format!(
            "{STALLED}{} ms (limit {}, the drives' heartbeat time or tracker.hold_after_s), {cause}",
            gap.as_millis(),
            max.as_millis()
        ))
    }

    /// When the last frame of the bus arrived: by the kernel's stamp if there is one, but not before the last
    /// input, and before the session's deadline. Otherwise a bench that was late would catch up on the missed
    /// SYNCs, one with each frame.
    fn arrival(&self) -> Time {
        let age = self.bus.received_at().and_then(|at| SystemTime::now().duration_since(at).ok());
        let arrived = self.clock.now() - age.unwrap_or_default();
        arrived.min(self.session.deadline() - Duration::from_nanos(1)).max(self.last)
    }

    /// Notes the delay of a frame that was made at `made` and has just been sent: of a SYNC after its deadline,
    /// of a set-point after the feedback.
    fn note_sent(&mut self, made: Time, frame: &Frame) {
        match (frame.cob_id(), self.pending_sync_due) {
            (Some(cob::SYNC), Some(due)) => self.timing.note_sync(self.clock.now().since(due)),
            (Some(0x201..=0x27F), None) => {
                self.timing.set_point_delay.add_us(self.clock.now().since(made));
            }
            _ => {}
        }
    }

    /// Takes a portion of the tracker's events, none of them once a deadline is due.
    fn take_events(&mut self) {
        let now = self.clock.now();
        if let Some(link) = &mut self.tracker
            && now.since(self.counts_read) >= READ_PERIOD
        {
            let (messages, passed_over) = (link.messages(), link.passed_over());
            // A gap is explained by the messages since the last reading, so it is checked first.
            self.check_gap(self.session.deadline());
            (self.counts_read, self.counted) = (now, messages);
            if let Some(event) = passed_over {
                self.give(Input::Tracker(event));
            }
        }
        for _ in 0..Link::BATCH_MAX {
            if self.clock.now() >= self.session.deadline() {
                break;
            }
            let next = self.tracker.as_mut().and_then(|link| link.try_next());
            let Some(event) = next else { break };
            self.give(Input::Tracker(event));
        }
    }

    /// Waits for one event of the bus; false if none came or the bus failed.
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

impl<M: RunMonitor> RunIo for Live<'_, M> {
    fn machine(&mut self) -> &mut dyn Machine {
        self.session
    }

    fn monitor(&mut self) -> &mut dyn RunMonitor {
        &mut self.monitor
    }

    fn now(&self) -> Time {
        self.clock.now()
    }

    fn give(&mut self, input: Input) {
        self.give_at(self.clock.now(), input);
    }

    /// A frame that was made before a gap longer than [`Machine::stall_max`] is never sent.
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
        self.monitor.take(record, None);
    }

    /// Takes the frames that wait on the bus: they came before what is due and before the tracker's events.
    fn take_arrived(&mut self) -> bool {
        self.pending_sync_due = None;
        let mut taken = 0;
        while taken < ARRIVED_MAX && self.take_frame(Duration::ZERO) {
            taken += 1;
        }
        taken > 0 && self.clock.now() < self.session.deadline()
    }

    fn wait_for_input(&mut self) {
        if self.clock.now() >= self.session.deadline() {
            self.give(Input::Tick);
            self.monitor.progress(self.session.progress());
            flush_outputs(self);
            self.pending_sync_due = None;
        }
        self.take_events();
        flush_outputs(self);
        self.pending_sync_due = None;
        // Sleep even if more events are queued: the kernel throttles a real-time thread that never sleeps.
        let deadline = self.session.deadline();
        let wait = deadline.since(self.clock.now()).saturating_sub(self.spin).min(WAIT_MAX);
        match wait.is_zero() {
            false => _ = self.take_frame(wait),
            true => while self.clock.now() < deadline && !self.take_frame(Duration::ZERO) {},
        }
    }
}

/// The cause of a gap in which the tracker sent this many messages in this time, if they are a flood.
fn flood(messages: u64, time: Duration) -> Option<String> {
    let per_s = messages as f64 / time.max(READ_PERIOD).as_secs_f64();
    (per_s > FLOOD_PER_S)
        .then(|| format!("by a flood from the tracker? {messages} messages, {per_s:.0} a second"))
}

/// Runs `session`, an insertion or an operation, until it ends, on the calling thread, which is the
/// SYNC thread; `realtime` says how that runs, for the record.
///
/// The thread waits on the bus until the session's next deadline. Deadlines are absolute, so a late cycle does
/// not delay the ones after it. The link has stamped the tracker's events when it received them; the thread
/// takes a bounded portion of them whenever it wakes, at least every 5 ms, and only while no deadline is due.
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
    let figures = run.timing.report(run.session.stage_counters());
    let timing = TimingReport { frames_dropped: run.bus.dropped(), realtime, ..figures };
    run.monitor.finish(run.session, outcome, clock.now(), Some(timing))
}

#[cfg(test)]
mod tests;
