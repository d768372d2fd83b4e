//! A thread that takes entries from a bounded queue, and what the session's side sees of it.

use super::silence::Silence;
use super::vitals::{SILENCE_LIMIT, Vitals};
use super::{Entry, TelemetryError};
use crate::archive::{Counts, FileSeal, Manifest};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{
    Receiver, RecvTimeoutError, SyncSender, TrySendError, channel, sync_channel,
};
use std::thread;
use std::time::{Duration, Instant};

/// What happens to an entry when a queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Backpressure {
    /// The caller waits: for virtual time, where waiting costs nothing and nothing may be lost.
    Block,
    /// The entry is dropped and counted: for live runs, where nothing may wait for a disk.
    DropAndCount,
}

/// Between two ticks of a writer: what of the text files is lost when the bench is killed.
const TICK: Duration = Duration::from_millis(50);
/// Between two tries of one who waits for room in a queue.
pub(super) const RETRY: Duration = Duration::from_millis(1);

/// What a writer does, on its own thread.
pub(super) trait Sink: Send {
    /// Takes one entry.
    fn take(&mut self, entry: Entry) -> Result<(), String>;
    /// Called every [`TICK`], busy or not: hand over to the disk.
    fn tick(&mut self) -> Result<(), String>;
    /// Whether it goes its rounds and gets nothing done.
    fn is_stuck(&self) -> bool {
        false
    }
    /// Whether it takes no more entries for now: those that come stay in the queue.
    fn is_full(&self) -> bool {
        false
    }
    /// The run is over: complete the file, and say that one is `alive` over it.
    fn close(&mut self, closing: &Closing, alive: &dyn Fn()) -> Result<(), String>;
    /// What is on the disk by its own account, closed or failed.
    fn left(&self) -> Left {
        Left::default()
    }
}

/// What a writer has left on the disk.
#[derive(Debug, Clone, Default)]
pub(super) struct Left {
    /// Lines of its files.
    pub(super) counts: Counts,
    /// Its files by name, as it wrote them.
    pub(super) files: BTreeMap<String, FileSeal>,
    /// Entries that are in its files; `None` where it does not count them.
    pub(super) entries: Option<u64>,
}

/// How a writer ended: what it left, and why that is not all.
pub(super) struct Ended {
    pub(super) left: Left,
    pub(super) fault: Option<TelemetryError>,
}

/// What a writer is told at the end.
pub(super) struct Closing {
    /// The manifest with the outcome, without counts.
    pub(super) manifest: Manifest,
}

#[expect(clippy::large_enum_variant, reason = "all but the last one are entries")]
enum Message {
    Entry(Entry),
    Close(Arc<Closing>),
}

/// The session's side of a writer; cheap to clone.
#[derive(Clone)]
pub(super) struct Intake {
    queue: SyncSender<Message>,
    backpressure: Backpressure,
    given: Arc<AtomicU64>,
    dropped: Arc<AtomicU64>,
    pub(super) vitals: Arc<Vitals>,
}

impl Intake {
    /// Gives `entry` to the writer, or counts it as dropped.
    pub(super) fn give(&self, entry: Entry) {
        self.given.fetch_add(1, Ordering::Relaxed);
        let message = Message::Entry(entry);
        let taken = match self.backpressure {
            Backpressure::DropAndCount => self.queue.try_send(message).is_ok(),
            Backpressure::Block => self.wait_and_send(message),
        };
        if !taken {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Waits for room, but not for a writer that makes none.
    fn wait_and_send(&self, mut message: Message) -> bool {
        let mut silence = Silence::new(self.vitals.beats(), Instant::now());
        while let Err(TrySendError::Full(back)) = self.queue.try_send(message) {
            if self.vitals.fault().is_some() {
                return false;
            }
            silence.look(self.vitals.beats(), Instant::now());
            if silence.lasted() > SILENCE_LIMIT {
                let limit_s = SILENCE_LIMIT.as_secs_f64();
                self.vitals.fail(format!("took nothing for {limit_s:.1} s; is the disk stalled?"));
                return false;
            }
            message = back;
            thread::sleep(RETRY);
        }
        self.vitals.fault().is_none()
    }

    /// Entries given so far, taken or not.
    pub(super) fn given(&self) -> u64 {
        self.given.load(Ordering::Relaxed)
    }

    /// Entries that did not reach the writer.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// A writer's thread, seen from its owner.
pub(super) struct Worker {
    pub(super) writer: &'static str,
    pub(super) intake: Intake,
    done: Receiver<(Left, Result<(), String>)>,
}

impl Worker {
    /// Starts the thread `writer` with a queue of `capacity` entries. `open` runs on it, so that
    /// a sink may be bound to its thread; this waits for what it says.
    ///
    /// # Errors
    /// What `open` says, and [`TelemetryError::WriterFailed`] when no thread can be started.
    pub(super) fn start<S: Sink + 'static>(
        writer: &'static str,
        capacity: usize,
        backpressure: Backpressure,
        open: impl FnOnce() -> Result<S, TelemetryError> + Send + 'static,
    ) -> Result<Worker, TelemetryError> {
        let (queue, entries) = sync_channel(capacity);
        let (opened_tx, opened) = sync_channel(1);
        let (done_tx, done) = channel();
        let vitals = Arc::new(Vitals::default());
        let failed = |reason: String| TelemetryError::WriterFailed { writer, reason };
        let of_thread = Arc::clone(&vitals);
        thread::Builder::new()
            .name(writer.replace(' ', "-"))
            .spawn(move || {
                let mut sink = match open() {
                    Ok(sink) => sink,
                    Err(error) => {
                        let _ = opened_tx.send(Err(error));
                        return;
                    }
                };
                let _ = opened_tx.send(Ok(()));
                let run = AssertUnwindSafe(|| serve(&mut sink, entries, &of_thread));
                let result =
                    catch_unwind(run).unwrap_or_else(|_| Err("the writer panicked".to_owned()));
                if let Err(reason) = &result {
                    of_thread.fail(reason.clone());
                }
                // Said before the sink is dropped: a failed one may take for ever over it.
                let _ = done_tx.send((sink.left(), result));
            })
            .map_err(|e| failed(e.to_string()))?;
        opened.recv().map_err(|_| failed("the writer died at its start".to_owned()))??;
        let intake =
            Intake { queue, backpressure, given: Arc::default(), dropped: Arc::default(), vitals };
        Ok(Worker { writer, intake, done })
    }

    /// Tells the writer that the run is over; not, where its queue is full.
    pub(super) fn tell(&self, closing: &Arc<Closing>) -> bool {
        let told = self.intake.queue.try_send(Message::Close(Arc::clone(closing)));
        !matches!(told, Err(TrySendError::Full(_)))
    }

    /// How the writer ended, once, when it has.
    pub(super) fn ended(&self) -> Option<Ended> {
        let (left, result) = self.done.try_recv().ok()?;
        let failed = |reason| TelemetryError::WriterFailed { writer: self.writer, reason };
        Some(Ended { left, fault: result.err().map(failed) })
    }
}

/// The writer's loop: until the run is closed or everyone who could give an entry is gone. The
/// queue ends with it, so that nobody waits for a writer that is not there.
fn serve(sink: &mut impl Sink, entries: Receiver<Message>, vitals: &Vitals) -> Result<(), String> {
    let mut next_tick = Instant::now() + TICK;
    loop {
        let wait = next_tick.saturating_duration_since(Instant::now());
        let message = if sink.is_full() {
            thread::sleep(wait);
            Err(RecvTimeoutError::Timeout)
        } else {
            entries.recv_timeout(wait)
        };
        match message {
            Ok(Message::Entry(entry)) => sink.take(entry)?,
            Ok(Message::Close(closing)) => return sink.close(&closing, &|| vitals.beat()),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                sink.tick()?;
                return Err("the run was abandoned".to_owned());
            }
        }
        if Instant::now() >= next_tick {
            sink.tick()?;
            next_tick = Instant::now() + TICK;
            if !sink.is_stuck() {
                vitals.beat();
            }
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::closing::tests::{FOR_EVER, closed};
    use super::*;
    use crate::session::{Lane, Record, Severity};
    use crate::units::Time;

    /// A sink that takes an entry only when it is let, and says when it has begun to.
    struct Gated {
        begun: SyncSender<()>,
        let_go: Receiver<()>,
        taken: u64,
        fail_at: u64,
    }

    impl Sink for Gated {
        fn take(&mut self, _: Entry) -> Result<(), String> {
            let _ = self.begun.send(());
            let _ = self.let_go.recv();
            self.taken += 1;
            if self.taken == self.fail_at { Err("no space left".to_owned()) } else { Ok(()) }
        }
        fn tick(&mut self) -> Result<(), String> {
            Ok(())
        }
        fn close(&mut self, _: &Closing, _: &dyn Fn()) -> Result<(), String> {
            Ok(())
        }
        fn left(&self) -> Left {
            let counts = Counts { steps: self.taken, ..Counts::default() };
            Left { counts, ..Left::default() }
        }
    }

    pub(in crate::telemetry) fn gated(
        fail_at: u64,
        backpressure: Backpressure,
    ) -> (Worker, Receiver<()>, SyncSender<()>) {
        let (begun_tx, begun) = sync_channel(100);
        let (let_go, let_go_rx) = sync_channel(100);
        let sink = Gated { begun: begun_tx, let_go: let_go_rx, taken: 0, fail_at };
        (Worker::start("gated", 4, backpressure, move || Ok(sink)).unwrap(), begun, let_go)
    }

    pub(in crate::telemetry) fn entry() -> Entry {
        Entry::from(Record::Event {
            time: Time::ZERO,
            lane: Lane::Session,
            severity: Severity::Info,
            text: "x".to_owned(),
        })
    }

    #[test]
    fn a_wedged_writer_costs_entries_and_never_the_callers_time() {
        let (worker, begun, let_go) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.intake.give(entry());
        begun.recv().unwrap();
        // The writer holds one and its queue four: of ten more, six are lost. Were `give` to
        // block, this test would not end.
        (0..10).for_each(|_| worker.intake.give(entry()));
        assert_eq!(worker.intake.dropped(), 6);
        drop(let_go);
        assert_eq!(closed(&worker, FOR_EVER).left.counts.steps, 5);
    }

    #[test]
    fn a_waiting_caller_loses_nothing() {
        let (worker, _begun, let_go) = gated(u64::MAX, Backpressure::Block);
        let intake = worker.intake.clone();
        let caller = thread::spawn(move || (0..50).for_each(|_| intake.give(entry())));
        (0..50).for_each(|_| let_go.send(()).unwrap());
        caller.join().unwrap();
        assert_eq!(closed(&worker, FOR_EVER).left.counts.steps, 50);
        assert_eq!(worker.intake.dropped(), 0);
    }

    /// A sink with room for one entry between two ticks; it counts entries as steps, and as events
    /// the most it had at a time.
    #[derive(Default)]
    struct Narrow {
        waiting: u64,
        counts: Counts,
    }

    impl Sink for Narrow {
        fn take(&mut self, _: Entry) -> Result<(), String> {
            self.waiting += 1;
            self.counts.steps += 1;
            self.counts.events = self.counts.events.max(self.waiting);
            Ok(())
        }
        fn tick(&mut self) -> Result<(), String> {
            self.waiting = 0;
            Ok(())
        }
        fn is_full(&self) -> bool {
            self.waiting > 0
        }
        fn close(&mut self, _: &Closing, _: &dyn Fn()) -> Result<(), String> {
            Ok(())
        }
        fn left(&self) -> Left {
            Left { counts: self.counts, ..Left::default() }
        }
    }

    #[test]
    fn a_full_writer_is_given_no_more() {
        let open = || Ok(Narrow::default());
        let worker = Worker::start("narrow", 4, Backpressure::DropAndCount, open).unwrap();
        (0..4).for_each(|_| worker.intake.give(entry()));
        let Counts { steps, events, .. } = closed(&worker, FOR_EVER).left.counts;
        assert_eq!((steps, events, worker.intake.dropped()), (4, 1, 0));
    }

    #[test]
    fn a_failed_writer_is_seen_and_stops_nobody() {
        for backpressure in [Backpressure::Block, Backpressure::DropAndCount] {
            let (worker, _begun, let_go) = gated(2, backpressure);
            assert_eq!(worker.intake.vitals.fault(), None);
            (0..2).for_each(|_| worker.intake.give(entry()));
            drop(let_go);
            let ended = closed(&worker, FOR_EVER);
            let said = "gated: no space left; what follows is not recorded";
            assert_eq!(ended.fault.unwrap().to_string(), said);
            assert_eq!(ended.left.counts.steps, 2, "what it left is told all the same");
            assert_eq!(worker.intake.vitals.fault(), Some("no space left"));
            (0..10).for_each(|_| worker.intake.give(entry()));
            assert_eq!(worker.intake.dropped(), 10);
        }
    }

    #[test]
    fn what_cannot_be_opened_is_an_error_at_the_start() {
        let open =
            || Err::<Gated, _>(TelemetryError::Recording { path: "x".into(), reason: "y".into() });
        let result = Worker::start("gated", 4, Backpressure::Block, open);
        assert!(matches!(result, Err(TelemetryError::Recording { .. })));
    }
}
