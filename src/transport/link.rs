//! A tracker's stream as the bench takes it: a queue of events, filled from outside.

use crate::tracker::openigtlink::StartStream;
use crate::tracker::{Event, Protocol};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::sync::mpsc::{self, error::TrySendError};
use tokio::task::JoinHandle;

/// What is spoken over a [`Link`], its time limits and sizes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkSettings {
    /// What the stream speaks.
    pub protocol: Protocol,
    /// What a peer over OpenIGTLink is asked for when it is connected.
    pub request: Option<StartStream>,
    /// Longest wait for a connection to be made.
    pub connect_timeout: Duration,
    /// Wait before the first new attempt; doubled for each further one.
    pub retry_first: Duration,
    /// Longest wait between attempts.
    pub retry_max: Duration,
    /// A peer this long silent may be gone without a word. A server is connected to anew; a
    /// client gives way to the next.
    pub silence_limit: Duration,
    /// Events kept for the reader before samples are dropped.
    pub queue: usize,
}

impl Default for LinkSettings {
    fn default() -> Self {
        LinkSettings {
            protocol: Protocol::OpenIgtLink,
            request: None,
            connect_timeout: Duration::from_secs(5),
            retry_first: Duration::from_millis(100),
            retry_max: Duration::from_secs(5),
            silence_limit: Duration::from_secs(10),
            queue: 1024,
        }
    }
}

/// A tracker's stream: over TCP, where the connection is made again when it is lost
/// ([`Link::connect`], [`Link::listen`]), from a pipe ([`Link::read`]), or from a recording
/// ([`Link::replay`]). It ends when the link is dropped.
#[derive(Debug)]
pub struct Link {
    events: mpsc::Receiver<Event>,
    dropped: Arc<AtomicU64>,
    local_addr: Option<SocketAddr>,
    task: Option<JoinHandle<()>>,
}

impl Link {
    /// A link, and where its events are to go.
    pub(super) fn new(queue: usize) -> (Self, Outlet) {
        let (sender, events) = mpsc::channel(queue.max(1));
        let dropped = Arc::new(AtomicU64::new(0));
        let outlet = Outlet { events: sender, dropped: Arc::clone(&dropped) };
        (Link { events, dropped, local_addr: None, task: None }, outlet)
    }

    /// The same, filled by a task that ends with it.
    pub(super) fn filled_by(mut self, task: JoinHandle<()>) -> Self {
        self.task = Some(task);
        self
    }

    /// The same, listening at `address`.
    pub(super) fn listening_at(mut self, address: SocketAddr) -> Self {
        self.local_addr = Some(address);
        self
    }

    /// The next event, if there is one now.
    pub fn try_next(&mut self) -> Option<Event> {
        self.events.try_recv().ok()
    }

    /// The next event; none when the runtime has been shut down.
    pub async fn next(&mut self) -> Option<Event> {
        self.events.recv().await
    }

    /// Events that were lost because they were not taken in time.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// The address listened on; none of a link that does not listen.
    pub fn local_addr(&self) -> Option<SocketAddr> {
        self.local_addr
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        if let Some(task) = &self.task {
            task.abort();
        }
    }
}

/// Where events go. Whoever takes them may be late, but cannot stop the reader.
#[derive(Debug)]
pub(super) struct Outlet {
    events: mpsc::Sender<Event>,
    dropped: Arc<AtomicU64>,
}

impl Outlet {
    /// Longest wait for room when the event changes the connection's state.
    const PATIENCE: Duration = Duration::from_secs(1);

    /// For what comes at the tracker's rate: dropped where there is no room.
    pub(super) fn stream(&self, event: Event) {
        if let Err(TrySendError::Full(_)) = self.events.try_send(event) {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// True once nobody takes events any more.
    pub(super) fn is_closed(&self) -> bool {
        self.events.is_closed()
    }

    /// An event as what it is: one that changes what is known of the connection is
    /// [reported](Outlet::report), every other one [streamed](Outlet::stream).
    pub(super) async fn hand_on(&self, event: Event) {
        if is_state(&event) { self.report(event).await } else { self.stream(event) }
    }

    /// The same from a thread, which waits for as long as it takes.
    pub(super) fn hand_on_blocking(&self, event: Event) {
        if !is_state(&event) {
            self.stream(event);
        } else if self.events.blocking_send(event).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// For what comes rarely and matters later: room is waited for, though not for ever.
    pub(super) async fn report(&self, event: Event) {
        if self.events.send_timeout(event, Self::PATIENCE).await.is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

fn is_state(event: &Event) -> bool {
    match event {
        Event::Connected { .. }
        | Event::Unreachable { .. }
        | Event::SawTool { .. }
        | Event::Disconnected { .. } => true,
        Event::Sample(_) | Event::Status { .. } | Event::Malformed(_) => false,
    }
}
