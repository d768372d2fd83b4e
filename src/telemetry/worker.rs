//! A thread fed by a bounded queue: it writes the text files, keeps the folder, or shows the run to
//! viewers.

use super::TelemetryError;
use super::watchdog::{RecordNews, STALL_TIMEOUT, StallTimer, ThreadStatus, Watchdog};
use crate::archive::{Counts, FileSeal, Manifest};
use rtrb::{Consumer, Producer, PushError, RingBuffer};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::thread::{self, Thread};
use std::time::{Duration, Instant};

/// What happens to an item while the queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Backpressure {
    /// The caller waits: for virtual time, where waiting is harmless and nothing may be lost.
    Block,
    /// The item is dropped and counted: for live runs, where the control thread must not wait.
    DropAndCount,
}

/// Retry interval while the queue is full.
const RETRY: Duration = Duration::from_millis(1);
/// The operator is told if the writer, while it completes its files, makes no progress for this long.
const WARN_AFTER: Duration = Duration::from_secs(3);

/// What the thread does with the items.
pub(super) trait Sink: Send + 'static {
    /// The items that the sink takes.
    type Item: Send + 'static;
    /// The word for those items in messages.
    const ITEMS: &'static str = "records";
    /// Interval of [`Sink::tick`].
    const TICK: Duration;
    /// Takes one item.
    fn take(&mut self, item: Self::Item) -> Result<(), String>;
    /// Called every [`Sink::TICK`], busy or not.
    fn tick(&mut self) -> Result<(), String> {
        Ok(())
    }
    /// Completes the files at the end of the run that `manifest` describes. Must call `alive` periodically
    /// while this takes long.
    fn close(&mut self, manifest: &Manifest, alive: &dyn Fn()) -> Result<(), String>;
    /// What the sink has written so far; also called after a failure.
    fn result(&self) -> WriterResult {
        WriterResult::default()
    }
}

/// What a writer has written.
#[derive(Debug, Clone, Default)]
pub(super) struct WriterResult {
    /// Numbers of lines in its files.
    pub(super) counts: Counts,
    /// The seals of its files, by name.
    pub(super) files: BTreeMap<String, FileSeal>,
    /// Number of entries in its files.
    pub(super) entries: u64,
}

enum Message<T> {
    Item(T),
    Close(Box<Manifest>),
}

/// The session thread's handle to a writer thread. The queue is lock-free, so a preempted writer never makes the
/// session wait (docs/decisions/0018-tracker-queue.md).
pub(super) struct Worker<T> {
    queue: Producer<Message<T>>,
    /// Dropped after the queue: its last wake-up shows the writer that the run was abandoned.
    waker: Waker,
    backpressure: Backpressure,
    /// Number of items passed to [`Worker::send`] so far, including dropped ones.
    pub(super) sent: u64,
    /// Number of items that did not reach the writer.
    pub(super) dropped: u64,
    pub(super) status: Arc<ThreadStatus>,
    watchdog: Watchdog,
    done: Receiver<WriterResult>,
}

/// Wakes a thread, and wakes it a last time when dropped.
struct Waker(Thread);

impl Drop for Waker {
    fn drop(&mut self) {
        self.0.unpark();
    }
}

impl<T: Send + 'static> Worker<T> {
    /// Starts the thread `writer` with a queue of `capacity` items for `sink`.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(super) fn start<S: Sink<Item = T>>(
        writer: &'static str,
        capacity: usize,
        backpressure: Backpressure,
        mut sink: S,
    ) -> Result<Self, TelemetryError> {
        let (queue, items) = RingBuffer::new(capacity);
        let (done_tx, done) = channel();
        let status = Arc::new(ThreadStatus::default());
        let watchdog = Watchdog::new(writer, S::ITEMS, Instant::now());
        let thread_status = Arc::clone(&status);
        let run = move || {
            let run = AssertUnwindSafe(|| serve(&mut sink, items, &thread_status));
            let result =
                catch_unwind(run).unwrap_or_else(|_| Err("the writer panicked".to_owned()));
            if let Err(reason) = result {
                let _ = thread_status.fault.set(reason);
            }
            // Report first: dropping a failed sink may block.
            let _ = done_tx.send(sink.result());
        };
        let thread = thread::Builder::new().name(writer.replace(' ', "-")).spawn(run);
        let failed = |error| TelemetryError::writer_failed(writer, error);
        let waker = Waker(thread.map_err(failed)?.thread().clone());
        let (sent, dropped) = (0, 0);
        Ok(Worker { queue, waker, backpressure, sent, dropped, status, watchdog, done })
    }

    /// The next change in the writer's health. Call this until it returns `None`.
    pub(super) fn news(&mut self, now: Instant) -> Option<RecordNews> {
        let health = self.watchdog.health_news(&self.status, now);
        health.or_else(|| self.watchdog.drop_news(self.dropped, now))
    }

    /// Sends `item` to the writer, or counts it as dropped.
    pub(super) fn send(&mut self, item: T) {
        self.sent += 1;
        let taken = match self.backpressure {
            Backpressure::DropAndCount => self.push(Message::Item(item)).is_ok(),
            Backpressure::Block => self.wait_and_push(Message::Item(item)),
        };
        self.dropped += u64::from(!taken);
    }

    /// Queues `message` and wakes the writer. Returns the message if the queue is full or the writer has ended.
    fn push(&mut self, message: Message<T>) -> Result<(), Message<T>> {
        if self.queue.is_abandoned() {
            return Err(message);
        }
        self.queue.push(message).map_err(|PushError::Full(message)| message)?;
        self.waker.0.unpark();
        Ok(())
    }

    /// Waits for room in the queue while the writer makes progress. Returns false if the message is lost.
    fn wait_and_push(&mut self, mut message: Message<T>) -> bool {
        let mut stall_timer = StallTimer::new(Instant::now());
        while let Err(unsent) = self.push(message) {
            if self.queue.is_abandoned() || self.status.fault.get().is_some() {
                return false;
            }
            if stall_timer.stalled_for(&self.status, Instant::now()) > STALL_TIMEOUT {
                let limit_s = STALL_TIMEOUT.as_secs_f64();
                let reason = format!("took nothing for {limit_s:.1} s; is the disk stalled?");
                let _ = self.status.fault.set(reason);
                return false;
            }
            message = unsent;
            thread::sleep(RETRY);
        }
        self.status.fault.get().is_none()
    }

    /// Tells the thread how the run ended, and waits at most `limit` for it to finish. If the queue is full, returns
    /// at once without telling it.
    pub(super) fn close_within(&mut self, manifest: &Manifest, limit: Duration) {
        if self.push(Message::Close(Box::new(manifest.clone()))).is_ok() {
            let _ = self.done.recv_timeout(limit);
        }
    }

    /// Lets the writer complete its files, and waits for it. Returns what it wrote, and its failure, if any.
    ///
    /// # Errors
    /// The writer made no progress for `limit` and was given up. What it wrote is unknown.
    pub(super) fn close(
        &mut self,
        manifest: &Manifest,
        limit: Duration,
    ) -> Result<(WriterResult, Option<TelemetryError>), TelemetryError> {
        let (mut has_warned, mut is_close_sent) = (false, false);
        let mut stall_timer = StallTimer::new(Instant::now());
        let writer = self.watchdog.writer;
        loop {
            is_close_sent =
                is_close_sent || self.push(Message::Close(Box::new(manifest.clone()))).is_ok();
            if let Ok(result) = self.done.recv_timeout(RETRY) {
                let failed = |reason| TelemetryError::writer_failed(writer, reason);
                return Ok((result, self.status.fault.get().map(failed)));
            }
            let silent = stall_timer.stalled_for(&self.status, Instant::now());
            if silent > WARN_AFTER && !std::mem::replace(&mut has_warned, true) {
                let limit_s = limit.as_secs();
                tracing::warn!(
                    "{writer}: waiting for it to complete its files, {limit_s} s at most"
                );
            }
            if silent > limit {
                return Err(TelemetryError::writer_stalled(writer, silent, limit));
            }
        }
    }
}

/// The thread's loop, until the run is closed or abandoned. It owns the queue, which is abandoned when the
/// loop ends, so that no caller waits for a writer that has ended.
fn serve<S: Sink>(
    sink: &mut S,
    mut queue: Consumer<Message<S::Item>>,
    status: &ThreadStatus,
) -> Result<(), String> {
    let mut next_tick = Instant::now() + S::TICK;
    loop {
        match queue.pop() {
            Ok(Message::Item(item)) => sink.take(item)?,
            Ok(Message::Close(manifest)) => return sink.close(&manifest, &|| status.beat()),
            // The last item may have come just before the run was dropped.
            Err(_) if queue.is_abandoned() && queue.is_empty() => {
                sink.tick()?;
                return Err("the run was abandoned".to_owned());
            }
            Err(_) => thread::park_timeout(next_tick.saturating_duration_since(Instant::now())),
        }
        if Instant::now() >= next_tick {
            sink.tick()?;
            next_tick = Instant::now() + S::TICK;
            status.beat();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::{Lane, Record, Severity};
    use crate::telemetry::Entry;
    use crate::units::Time;
    use std::sync::mpsc::{SyncSender, sync_channel};

    /// A sink that signals when it begins to take an entry, and waits for the test's permission.
    struct Gated {
        begun: SyncSender<()>,
        permission: Receiver<()>,
        taken: u64,
        fail_at: u64,
    }

    impl Sink for Gated {
        type Item = Entry;
        const TICK: Duration = Duration::from_millis(50);
        fn take(&mut self, _: Entry) -> Result<(), String> {
            let _ = self.begun.send(());
            let _ = self.permission.recv();
            self.taken += 1;
            if self.taken == self.fail_at { Err("no space left".to_owned()) } else { Ok(()) }
        }
        fn close(&mut self, _: &Manifest, _: &dyn Fn()) -> Result<(), String> {
            Ok(())
        }
        fn result(&self) -> WriterResult {
            WriterResult { entries: self.taken, ..WriterResult::default() }
        }
    }

    fn gated(
        fail_at: u64,
        backpressure: Backpressure,
    ) -> (Worker<Entry>, Receiver<()>, SyncSender<()>) {
        let (begun_tx, begun) = sync_channel(100);
        let (permit, permission) = sync_channel(100);
        let sink = Gated { begun: begun_tx, permission, taken: 0, fail_at };
        (Worker::start("gated", 4, backpressure, sink).unwrap(), begun, permit)
    }

    fn entry() -> Entry {
        let (lane, severity) = (Lane::Session, Severity::Info);
        let record = Record::Event { time: Time::ZERO, lane, severity, text: "x".to_owned() };
        Entry { record, truth: None }
    }

    const HOUR: Duration = Duration::from_secs(3600);

    fn entries_left(mut worker: Worker<Entry>) -> u64 {
        worker.close(&Manifest::default(), HOUR).unwrap().0.entries
    }

    #[test]
    fn a_stalled_writer_drops_entries_and_never_blocks_the_caller() {
        let (mut worker, begun, permit) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.send(entry());
        begun.recv().unwrap();
        // The writer holds one entry and its queue four, so six of ten more are lost. If `send` blocked, this test
        // would not end.
        (0..10).for_each(|_| worker.send(entry()));
        assert_eq!(worker.dropped, 6);
        drop(permit);
        assert_eq!(entries_left(worker), 5);
    }

    #[test]
    fn a_writer_with_back_pressure_loses_nothing() {
        let (mut worker, _begun, permit) = gated(u64::MAX, Backpressure::Block);
        let permits = thread::spawn(move || (0..50).for_each(|_| permit.send(()).unwrap()));
        (0..50).for_each(|_| worker.send(entry()));
        permits.join().unwrap();
        assert_eq!(worker.dropped, 0);
        assert_eq!(entries_left(worker), 50);
    }

    #[test]
    fn a_failed_writer_is_reported_and_never_blocks_the_caller() {
        for backpressure in [Backpressure::Block, Backpressure::DropAndCount] {
            let (mut worker, _begun, permit) = gated(2, backpressure);
            assert_eq!(worker.status.fault.get(), None);
            (0..2).for_each(|_| worker.send(entry()));
            drop(permit);
            let (left, fault) = worker.close(&Manifest::default(), HOUR).unwrap();
            let said = "gated: no space left; what follows is not recorded";
            assert_eq!(fault.unwrap().to_string(), said);
            assert_eq!(left.entries, 2, "the result of a failed writer");
            assert_eq!(worker.status.fault.get().unwrap(), "no space left");
            (0..10).for_each(|_| worker.send(entry()));
            assert_eq!(worker.dropped, 10);
        }
    }

    #[test]
    fn closing_gives_up_a_stalled_writer_at_the_limit() {
        let (mut worker, begun, _permit) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.send(entry());
        begun.recv().unwrap();
        (0..4).for_each(|_| worker.send(entry()));
        let given_up = worker.close(&Manifest::default(), Duration::ZERO).unwrap_err();
        assert!(given_up.to_string().starts_with("gated: no sign of life for 0."), "{given_up}");
    }

    /// A sink whose tick is not due during the test.
    struct SlowTick(SyncSender<&'static str>);

    impl Sink for SlowTick {
        type Item = Entry;
        const TICK: Duration = HOUR;
        fn take(&mut self, _: Entry) -> Result<(), String> {
            self.0.send("taken").map_err(|error| error.to_string())
        }
        fn tick(&mut self) -> Result<(), String> {
            self.0.send("last tick").map_err(|error| error.to_string())
        }
        fn close(&mut self, _: &Manifest, _: &dyn Fn()) -> Result<(), String> {
            Ok(())
        }
    }

    #[test]
    fn an_entry_and_the_drop_of_the_worker_wake_a_sleeping_writer() {
        let (said, heard) = sync_channel(10);
        let backpressure = Backpressure::DropAndCount;
        let mut worker = Worker::start("slow-tick", 4, backpressure, SlowTick(said)).unwrap();
        for _ in 0..3 {
            // Meanwhile the writer falls asleep.
            thread::sleep(Duration::from_millis(20));
            worker.send(entry());
            assert_eq!(heard.recv_timeout(Duration::from_secs(60)), Ok("taken"));
        }
        thread::sleep(Duration::from_millis(20));
        drop(worker);
        assert_eq!(heard.recv_timeout(Duration::from_secs(60)), Ok("last tick"));
    }

    /// The limit counts from the last beat, because a slow machine is not a stalled disk.
    #[test]
    fn closing_waits_for_a_writer_that_beats() {
        let (mut worker, begun, permit) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.send(entry());
        begun.recv().unwrap();
        let status = Arc::clone(&worker.status);
        let limit = Duration::from_secs(1);
        let beats = thread::spawn(move || {
            let end = Instant::now() + 2 * limit;
            while Instant::now() < end {
                status.beat();
                thread::sleep(RETRY);
            }
            drop(permit);
        });
        let (left, fault) = worker.close(&Manifest::default(), limit).unwrap();
        beats.join().unwrap();
        assert!(fault.is_none(), "{fault:?}");
        assert_eq!(left.entries, 1);
    }
}
