//! A thread that takes entries from a bounded queue, and what the session's side sees of it.

use super::vitals::{LOOK_MAX, SILENCE_LIMIT, Vitals};
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
/// One who waits for a writer to complete its files says so after this long.
const CLOSING_TOLD_AFTER: Duration = Duration::from_secs(3);
/// Between two tries of one who waits for room in a queue.
const RETRY: Duration = Duration::from_millis(1);

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

/// How long one waits for a writer that completes its files.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patience {
    /// Without a sign of life.
    pub(super) silence: Duration,
    /// In all.
    pub(super) total: Duration,
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
        let mut heard = (self.vitals.beats(), Instant::now());
        while let Err(TrySendError::Full(back)) = self.queue.try_send(message) {
            if self.vitals.fault().is_some() {
                return false;
            }
            let beats = self.vitals.beats();
            if beats != heard.0 {
                heard = (beats, Instant::now());
            }
            if heard.1.elapsed() > SILENCE_LIMIT {
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
    writer: &'static str,
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
}

/// A writer that is to complete its files.
struct Closer<'a> {
    worker: &'a Worker,
    patience: Patience,
    /// What it is still to be told, in a queue that may be full.
    message: Option<Message>,
    beats: u64,
    silent: Duration,
    told: bool,
    is_given_up: bool,
    ended: Option<Ended>,
}

/// Tells the writers that the run is over and waits until they are done, each as long as its patience
/// lasts: a wedged one is left alone.
pub(super) fn close_all<const N: usize>(
    writers: [(&Worker, Patience); N],
    closing: &Arc<Closing>,
) -> [Ended; N] {
    let mut closers = writers.map(|(worker, patience)| Closer {
        worker,
        patience,
        message: Some(Message::Close(Arc::clone(closing))),
        beats: worker.intake.vitals.beats(),
        silent: Duration::ZERO,
        told: false,
        is_given_up: false,
        ended: None,
    });
    let (mut looked, mut waited) = (Instant::now(), Duration::ZERO);
    while closers.iter().any(Closer::is_waited_for) {
        let now = Instant::now();
        // Where all of them stood still, with who waits, nothing is proved of any.
        let since = now.duration_since(std::mem::replace(&mut looked, now)).min(LOOK_MAX);
        waited += since;
        closers.iter_mut().for_each(|closer| closer.look(since, waited));
        thread::sleep(RETRY);
    }
    closers.map(Closer::end)
}

impl Closer<'_> {
    fn is_waited_for(&self) -> bool {
        self.ended.is_none() && !self.is_given_up
    }

    fn look(&mut self, since: Duration, waited: Duration) {
        if !self.is_waited_for() {
            return;
        }
        if let Some(message) = self.message.take()
            && let Err(TrySendError::Full(back)) = self.worker.intake.queue.try_send(message)
        {
            self.message = Some(back);
        }
        let writer = self.worker.writer;
        if let Ok((left, result)) = self.worker.done.try_recv() {
            let failed = |reason| TelemetryError::WriterFailed { writer, reason };
            self.ended = Some(Ended { left, fault: result.err().map(failed) });
            return;
        }
        let beats = self.worker.intake.vitals.beats();
        self.silent = if beats == self.beats { self.silent + since } else { Duration::ZERO };
        self.beats = beats;
        let limit_s = self.patience.silence.as_secs_f64();
        if self.silent > CLOSING_TOLD_AFTER && !std::mem::replace(&mut self.told, true) {
            tracing::warn!(
                "{writer}: waiting for it to complete its files, {limit_s:.0} s at most"
            );
        }
        self.is_given_up = self.silent > self.patience.silence || waited > self.patience.total;
    }

    fn end(self) -> Ended {
        let Closer { worker: Worker { writer, .. }, patience, silent, .. } = self;
        let (silent_s, limit_s) = (silent.as_secs_f64(), patience.silence.as_secs_f64());
        self.ended.unwrap_or_else(|| {
            let fault = if silent > patience.silence {
                TelemetryError::WriterSilent { writer, silent_s, limit_s }
            } else {
                let total_s = patience.total.as_secs_f64();
                let reason = format!("its files were not complete after {total_s:.0} s");
                TelemetryError::WriterFailed { writer, reason }
            };
            Ended { left: Left::default(), fault: Some(fault) }
        })
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
mod tests {
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

    fn gated(fail_at: u64, backpressure: Backpressure) -> (Worker, Receiver<()>, SyncSender<()>) {
        let (begun_tx, begun) = sync_channel(100);
        let (let_go, let_go_rx) = sync_channel(100);
        let sink = Gated { begun: begun_tx, let_go: let_go_rx, taken: 0, fail_at };
        (Worker::start("gated", 4, backpressure, move || Ok(sink)).unwrap(), begun, let_go)
    }

    fn entry() -> Entry {
        Entry::from(Record::Event {
            time: Time::ZERO,
            lane: Lane::Session,
            severity: Severity::Info,
            text: "x".to_owned(),
        })
    }

    fn closing() -> Arc<Closing> {
        Arc::new(Closing { manifest: Manifest::new("x", String::new()) })
    }

    const HOUR: Duration = Duration::from_secs(3600);
    const FOR_EVER: Patience = Patience { silence: HOUR, total: HOUR };
    const NO_PATIENCE: Patience = Patience { silence: Duration::ZERO, total: Duration::ZERO };

    fn closed(worker: &Worker, patience: Patience) -> Ended {
        let [ended] = close_all([(worker, patience)], &closing());
        ended
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
    fn a_wedged_writer_does_not_hold_up_the_end() {
        let (worker, begun, _let_go) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.intake.give(entry());
        begun.recv().unwrap();
        (0..4).for_each(|_| worker.intake.give(entry()));
        let fault = closed(&worker, NO_PATIENCE).fault;
        assert!(matches!(fault, Some(TelemetryError::WriterSilent { writer: "gated", .. })));
        let fault = closed(&worker, Patience { total: Duration::ZERO, ..FOR_EVER }).fault;
        assert!(fault.unwrap().to_string().contains("not complete after 0 s"));
    }

    /// A slow machine is no wedged one: its patience counts from the last sign of life.
    #[test]
    fn a_writer_that_shows_itself_is_waited_for() {
        let (worker, begun, let_go) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.intake.give(entry());
        begun.recv().unwrap();
        let vitals = Arc::clone(&worker.intake.vitals);
        let silence = Duration::from_secs(1);
        let shows_itself = thread::spawn(move || {
            let end = Instant::now() + 2 * silence;
            while Instant::now() < end {
                vitals.beat();
                thread::sleep(RETRY);
            }
            drop(let_go);
        });
        let ended = closed(&worker, Patience { silence, total: HOUR });
        shows_itself.join().unwrap();
        assert!(ended.fault.is_none(), "{:?}", ended.fault);
        assert_eq!(ended.left.counts.steps, 1);
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
