//! A tracker's stream: a queue of events that a reader task or thread fills.

use crate::tracker::openigtlink::ToolStream;
use crate::tracker::{Event, Protocol, Reader, Sieve, StreamReplay};
use crate::units::Time;
use rtrb::{Consumer, Producer, RingBuffer};
use std::io::{ErrorKind, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio::time::sleep;

/// The protocol of a [`Link`], its time limits and sizes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkSettings {
    /// The protocol of the stream.
    pub protocol: Protocol,
    /// The tools whose samples are delivered; if empty, those of every tool.
    pub tools: Vec<String>,
    /// The stream to request from an OpenIGTLink peer when it is connected.
    pub request: Option<ToolStream>,
    /// Wait before the next attempt to connect; it doubles with each attempt.
    pub retry_first: Duration,
    /// A peer that is silent for this long may be gone. Then the bench reconnects to a server; a client is
    /// replaced by the next one that connects.
    pub silence_limit: Duration,
    /// Length of the queue: when this many events wait, samples are dropped.
    pub queue: usize,
}

impl Default for LinkSettings {
    fn default() -> Self {
        LinkSettings {
            protocol: Protocol::OpenIgtLink,
            tools: Vec::new(),
            request: None,
            retry_first: Duration::from_millis(100),
            silence_limit: Duration::from_secs(10),
            queue: 1024,
        }
    }
}

/// A tracker's stream: over TCP with reconnection ([`Link::connect`], [`Link::listen`]), from a pipe
/// ([`Link::read`]), or from a recording ([`Link::replay`]). It ends when the link is dropped.
#[derive(Debug)]
pub struct Link {
    events: Consumer<Event>,
    shared: Arc<Shared>,
    /// The counts of messages passed over and of samples dropped that were last reported.
    reported: (u64, u64),
    task: Option<JoinHandle<()>>,
}

/// Shared by both ends of the queue.
#[derive(Debug, Default)]
struct Shared {
    /// Samples, statuses and refused messages received.
    messages: AtomicU64,
    /// How many of them the sieve did not pass: of other tools, or too many at once.
    passed_over: AtomicU64,
    /// Samples dropped because the queue was full or because newer ones were waiting.
    dropped: AtomicU64,
    /// No more events will come.
    has_ended: AtomicBool,
    /// Notified when an event was queued or the stream has ended.
    filled: Notify,
}

impl Link {
    /// Maximum number of events that the control thread takes at a time. When more are waiting, the older
    /// samples are dropped.
    pub const BATCH_MAX: usize = 64;

    /// A link, and the end of its queue that a reader fills.
    pub(super) fn new(settings: &LinkSettings) -> (Self, Outlet) {
        let (producer, events) = RingBuffer::new(settings.queue.max(1) + Outlet::RESERVE);
        let shared = Arc::new(Shared::default());
        let sieve = Sieve::new(&settings.tools);
        let outlet = Outlet { events: producer, sieve, shared: Arc::clone(&shared) };
        (Link { events, shared, reported: (0, 0), task: None }, outlet)
    }

    /// A link that a task fills. The task ends with the link.
    pub(super) fn filled_by<F>(settings: &LinkSettings, fill: impl FnOnce(Outlet) -> F) -> Self
    where
        F: Future<Output = ()> + Send + 'static,
    {
        let (mut link, outlet) = Link::new(settings);
        link.task = Some(tokio::spawn(fill(outlet)));
        link
    }

    /// The next event, if there is one now. This never waits for the reader, even if that was preempted,
    /// and takes a bounded time.
    pub fn try_next(&mut self) -> Option<Event> {
        let mut event = self.events.pop().ok()?;
        for _ in 0..self.events.buffer().capacity() {
            let is_behind = self.events.slots() >= Self::BATCH_MAX;
            if !is_behind || !matches!(event, Event::Sample(_)) {
                break;
            }
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
            event = self.events.pop().ok()?;
        }
        Some(event)
    }

    /// The next event; `None` when the reader has ended or the runtime was shut down.
    pub async fn next(&mut self) -> Option<Event> {
        loop {
            let has_ended = self.shared.has_ended.load(Ordering::Acquire);
            match self.events.pop() {
                Ok(event) => return Some(event),
                Err(_) if has_ended => return None,
                Err(_) => self.shared.filled.notified().await,
            }
        }
    }

    /// The numbers of messages passed over and of samples dropped since the last call; `None` if both are 0.
    pub fn passed_over(&mut self) -> Option<Event> {
        let Shared { passed_over, dropped, .. } = &*self.shared;
        let now = (passed_over.load(Ordering::Relaxed), dropped.load(Ordering::Relaxed));
        let before = std::mem::replace(&mut self.reported, now);
        (now != before)
            .then(|| Event::PassedOver { messages: now.0 - before.0, dropped: now.1 - before.1 })
    }

    /// Samples, statuses and refused messages so far, including those passed over.
    pub fn messages(&self) -> u64 {
        self.shared.messages.load(Ordering::Relaxed)
    }

    /// Samples dropped so far.
    pub fn dropped(&self) -> u64 {
        self.shared.dropped.load(Ordering::Relaxed)
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        if let Some(task) = &self.task {
            task.abort();
        }
    }
}

/// The reader's end of the queue. A slow control thread never blocks the reader: data that waits in the
/// socket would get a receive time that is too late.
#[derive(Debug)]
pub(super) struct Outlet {
    events: Producer<Event>,
    sieve: Sieve,
    shared: Arc<Shared>,
}

impl Outlet {
    /// Places in the queue that samples leave free for changes of the connection: its beginning, its
    /// end, a failed attempt to connect, and the tools that it names.
    const RESERVE: usize = Reader::NAMES_MAX + 4;
    /// Interval between two checks for room.
    const ROOM_POLL: Duration = Duration::from_millis(10);

    /// Waits until there is room for the events of a connection that must not be lost. Call it before
    /// connecting, while no data is waiting in the socket.
    pub(super) async fn wait_for_room(&mut self) {
        while self.events.slots() < Self::RESERVE {
            sleep(Self::ROOM_POLL).await;
        }
    }

    /// Delivers an event received at `now`, if it passes the sieve. A sample, status or refused message
    /// is dropped and counted when there is no room.
    pub(super) fn deliver(&mut self, now: Time, event: Event) {
        self.shared.messages.fetch_add(u64::from(event.is_message()), Ordering::Relaxed);
        let passed = self.sieve.pass(now, event);
        self.shared.passed_over.store(self.sieve.passed_over(), Ordering::Relaxed);
        let Some(event) = passed else { return };
        let has_room = !event.is_message() || self.events.slots() > Self::RESERVE;
        if !has_room || self.events.push(event).is_err() {
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
        }
        self.shared.filled.notify_one();
    }

    /// Delivers what `reader` still has at the end of the connection. Returns why the end is wrong, after a colon.
    pub(super) fn finish(&mut self, now: Time, reader: &mut Reader) -> String {
        let finished = reader.finish().and_then(|()| self.deliver_all(now, reader));
        finished.err().map(|error| format!(": {error}")).unwrap_or_default()
    }

    /// Delivers the events in the bytes that `reader` got at `now`. An error ends the connection.
    pub(super) fn deliver_all(&mut self, now: Time, reader: &mut Reader) -> Result<(), String> {
        loop {
            match reader.poll() {
                Ok(None) => return Ok(()),
                Ok(Some(event)) => self.deliver(now, event),
                Err(error) => return Err(format!("dropped: {error}")),
            }
        }
    }
}

impl Drop for Outlet {
    fn drop(&mut self) {
        self.shared.has_ended.store(true, Ordering::Release);
        self.shared.filled.notify_one();
    }
}

/// Streams that are not over TCP: from standard input or another reader, and from a recording.
impl Link {
    /// Reads `input`, called `name` in messages, to its end, on a thread of its own, because reading a pipe may
    /// block forever. `clock` gives the receive times.
    pub fn read<R, C>(mut input: R, name: &str, settings: LinkSettings, clock: C) -> Self
    where
        R: Read + Send + 'static,
        C: Fn() -> Time + Send + 'static,
    {
        let (link, mut outlet) = Link::new(&settings);
        let mut reader = Reader::new(settings.protocol);
        let name = name.to_owned();
        thread::spawn(move || {
            outlet.deliver(clock(), Event::Connected { peer: name.clone() });
            let why = read_to_end(&mut input, &mut reader, &mut outlet, &clock);
            let reason = format!("tracker: {name} {why}");
            outlet.deliver(clock(), Event::Disconnected { reason });
        });
        link
    }

    /// Delivers the events of `replay` when they are due by `clock`. Of `settings`, only the tools and the
    /// queue length matter.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn replay<C>(mut replay: StreamReplay, settings: &LinkSettings, clock: C) -> Self
    where
        C: Fn() -> Time + Send + 'static,
    {
        Link::filled_by(settings, async move |mut outlet| {
            while replay.deadline() < Time::NEVER {
                sleep(replay.deadline().since(clock())).await;
                while let Some(event) = replay.poll(clock()) {
                    outlet.deliver(clock(), event);
                }
            }
        })
    }
}

/// Reads until the input ends or the link is dropped, and returns how it ended.
fn read_to_end(
    input: &mut impl Read,
    reader: &mut Reader,
    outlet: &mut Outlet,
    clock: impl Fn() -> Time,
) -> String {
    let mut buffer = [0; 4096];
    // The queue is abandoned when the link is dropped.
    while !outlet.events.is_abandoned() {
        let len = match input.read(&mut buffer) {
            Ok(0) => {
                let next = "start the program that feeds it again, then this command";
                return format!("has ended{}; {next}", outlet.finish(clock(), reader));
            }
            Ok(len) => len,
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            Err(error) => return format!("failed: {error}"),
        };
        let now = clock();
        reader.push(now, buffer.get(..len).unwrap_or_default());
        if let Err(reason) = outlet.deliver_all(now, reader) {
            return reason;
        }
    }
    "is no longer read".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracker::{Sample, Validity, ndjson};
    use nalgebra::Vector3;

    fn sample(x_mm: usize) -> Event {
        Event::Sample(Sample {
            tool: "Needle".to_owned(),
            receive_time: Time::ZERO,
            source_unix_ns: None,
            position_mm: Vector3::x() * x_mm as f64,
            orientation: None,
            validity: Validity::Valid,
        })
    }

    fn positions(link: &mut Link) -> Vec<usize> {
        let taken = std::iter::from_fn(|| link.try_next());
        let x_mm = |event| match event {
            Event::Sample(sample) => Some(sample.position_mm.x as usize),
            _ => None,
        };
        taken.filter_map(x_mm).collect()
    }

    #[test]
    fn a_late_control_thread_gets_the_newest_samples() {
        let (mut link, mut outlet) = Link::new(&LinkSettings::default());
        (0..50).for_each(|n| outlet.deliver(Time::ZERO, sample(n)));
        assert_eq!(positions(&mut link), (0..50).collect::<Vec<_>>());
        outlet.deliver(Time::ZERO, Event::Connected { peer: "lab".to_owned() });
        (50..500).for_each(|n| outlet.deliver(Time::ZERO, sample(n)));
        assert!(
            matches!(link.try_next(), Some(Event::Connected { .. })),
            "only samples are dropped"
        );
        assert_eq!(positions(&mut link), (500 - Link::BATCH_MAX..500).collect::<Vec<_>>());
        let dropped = (450 - Link::BATCH_MAX) as u64;
        assert_eq!(link.passed_over(), Some(Event::PassedOver { messages: 0, dropped }));
        assert_eq!((link.passed_over(), link.messages()), (None, 500));
    }

    #[test]
    fn a_flood_leaves_room_for_the_state_of_the_connection() {
        let settings = LinkSettings { queue: 8, ..LinkSettings::default() };
        let (mut link, mut outlet) = Link::new(&settings);
        let deliver_tool = |outlet: &mut Outlet, n: usize| {
            let (tool, message_type) = (format!("tool {n}"), "IMAGE".to_owned());
            outlet.deliver(Time::ZERO, Event::SawTool { tool, message_type });
        };
        outlet.deliver(Time::ZERO, Event::Connected { peer: "lab".to_owned() });
        for n in 0..Reader::NAMES_MAX {
            (0..100).for_each(|n| outlet.deliver(Time::ZERO, sample(n)));
            deliver_tool(&mut outlet, n);
        }
        outlet.deliver(Time::ZERO, Event::Disconnected { reason: "gone".to_owned() });
        drop(outlet);
        let taken: Vec<Event> = std::iter::from_fn(|| link.try_next()).collect();
        let states = taken.iter().filter(|event| !event.is_message()).count();
        assert_eq!(states, Reader::NAMES_MAX + 2);
        assert!(matches!(taken.last(), Some(Event::Disconnected { .. })));
    }

    const NOW: Time = Time::from_nanos(42);

    fn events_of(text: &'static str) -> Vec<String> {
        let settings = LinkSettings { protocol: Protocol::Ndjson, ..LinkSettings::default() };
        let mut link = Link::read(text.as_bytes(), "standard input", settings, || NOW);
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let next = || runtime.block_on(link.next());
        std::iter::from_fn(next)
            .map(|event| match event {
                Event::Sample(sample) => {
                    assert_eq!(sample.receive_time, NOW);
                    format!("{} {}", sample.tool, sample.position_mm.x)
                }
                Event::Connected { peer } => format!("connected to {peer}"),
                Event::Malformed(error) => error.to_string(),
                Event::Disconnected { reason } => reason,
                other => format!("{other:?}"),
            })
            .collect()
    }

    #[test]
    fn a_pipe_is_read_to_its_end() {
        assert_eq!(
            events_of("{\"tool\":\"N\",\"position_tracker_mm\":[1,2,3]}\nnonsense\n{\"tool\""),
            [
                "connected to standard input",
                "SawTool { tool: \"N\", message_type: \"NDJSON\" }",
                "N 1",
                "ndjson: line 2: expected ident (column 2)",
                "ndjson: line 3: EOF while parsing an object (column 7)",
                "tracker: standard input has ended; start the program that feeds it again, then this command",
            ]
        );
    }

    #[tokio::test]
    async fn a_recording_is_replayed_to_its_end() {
        let line = |ns: u32| {
            format!(r#"{{"tool":"N","position_tracker_mm":[{ns},0,0],"receive_time_ns":{ns}}}"#)
        };
        let recording = ndjson::recording(&[line(1_000_000), line(3_000_000)].join("\n")).unwrap();
        let start = std::time::Instant::now();
        let clock = move || Time::ZERO + start.elapsed();
        let replay = StreamReplay::new("tip.ndjson", recording, Time::ZERO);
        let mut link = Link::replay(replay, &LinkSettings::default(), clock);
        let mut samples = Vec::new();
        while let Some(event) = link.next().await {
            if let Event::Sample(sample) = event {
                assert!(sample.receive_time <= clock(), "a sample before its time");
                samples.push(sample.receive_time.as_nanos());
            }
        }
        assert_eq!(samples, [0, 2_000_000]);
    }
}
