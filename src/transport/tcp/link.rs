//! The bench's end of a tracker's connection.

use crate::tracker::openigtlink::{Body, Message, StreamDecoder};
use crate::tracker::{Event, Sample};
use crate::units::Time;
use std::collections::BTreeSet;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc::{self, error::TrySendError};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, timeout};

/// Time limits and sizes of a [`Link`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkSettings {
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
            connect_timeout: Duration::from_secs(5),
            retry_first: Duration::from_millis(100),
            retry_max: Duration::from_secs(5),
            silence_limit: Duration::from_secs(10),
            queue: 1024,
        }
    }
}

/// A connection to a tracker that is made, and made again when lost, until the link is dropped.
#[derive(Debug)]
pub struct Link {
    events: mpsc::Receiver<Event>,
    dropped: Arc<AtomicU64>,
    local_addr: Option<SocketAddr>,
    task: JoinHandle<()>,
}

impl Link {
    /// Connects to the server at `address` (`host:port`), and again whenever the connection is
    /// lost. `clock` dates what is received.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn connect<C>(address: &str, settings: LinkSettings, clock: C) -> Self
    where
        C: Fn() -> Time + Send + Sync + 'static,
    {
        let address = address.to_owned();
        Self::spawn(None, settings, clock, |end| end.keep_connected(address))
    }

    /// Listens on `address` for clients that push, one at a time. Others are turned away unless
    /// the present one is silent.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn listen<C>(address: &str, settings: LinkSettings, clock: C) -> io::Result<Self>
    where
        C: Fn() -> Time + Send + Sync + 'static,
    {
        let listener = TcpListener::bind(address).await?;
        let local_addr = listener.local_addr()?;
        Ok(Self::spawn(Some(local_addr), settings, clock, |end| end.keep_listening(listener)))
    }

    fn spawn<C, F>(
        local_addr: Option<SocketAddr>,
        settings: LinkSettings,
        clock: C,
        run: impl FnOnce(End<C>) -> F,
    ) -> Self
    where
        F: Future<Output = ()> + Send + 'static,
    {
        let (sender, events) = mpsc::channel(settings.queue.max(1));
        let dropped = Arc::new(AtomicU64::new(0));
        let outlet = Outlet { events: sender, dropped: Arc::clone(&dropped) };
        let task = tokio::spawn(run(End { settings, clock, outlet }));
        Link { events, dropped, local_addr, task }
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

    /// The address listened on; none of a link that connects.
    pub fn local_addr(&self) -> Option<SocketAddr> {
        self.local_addr
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Where events go. Whoever takes them may be late, but cannot stop the reader.
struct Outlet {
    events: mpsc::Sender<Event>,
    dropped: Arc<AtomicU64>,
}

impl Outlet {
    /// Longest wait for room when the event changes the connection's state.
    const PATIENCE: Duration = Duration::from_secs(1);

    /// For what comes at the tracker's rate: dropped where there is no room.
    fn stream(&self, event: Event) {
        if let Err(TrySendError::Full(_)) = self.events.try_send(event) {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// For what comes rarely and matters later: room is waited for, though not for ever.
    async fn report(&self, event: Event) {
        if self.events.send_timeout(event, Self::PATIENCE).await.is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The task's side of a link.
struct End<C> {
    settings: LinkSettings,
    clock: C,
    outlet: Outlet,
}

impl<C: Fn() -> Time> End<C> {
    async fn keep_connected(self, address: String) {
        let mut retry = self.settings.retry_first;
        loop {
            let reason =
                match timeout(self.settings.connect_timeout, TcpStream::connect(&address)).await {
                    Ok(Ok(stream)) => {
                        let mut peer = Peer::new(stream, address.clone());
                        self.outlet.report(Event::Connected { peer: address.clone() }).await;
                        let reason = self.read_to_end(&mut peer).await;
                        self.outlet.report(Event::Disconnected { reason }).await;
                        if peer.messages > 0 {
                            retry = self.settings.retry_first;
                        }
                        None
                    }
                    Ok(Err(error)) => Some(error.to_string()),
                    Err(_) => Some(format!("no answer within {:?}", self.settings.connect_timeout)),
                };
            if let Some(error) = reason {
                let reason = format!(
                    "tracker: cannot connect to {address}: {error}; is the server running, and \
                     are host and port right? next attempt in {:.1} s",
                    retry.as_secs_f64()
                );
                self.outlet.report(Event::Unreachable { reason }).await;
            }
            sleep(retry).await;
            retry = (2 * retry).min(self.settings.retry_max);
        }
    }

    /// Reads a server until the connection ends, and says why it did.
    async fn read_to_end(&self, peer: &mut Peer) -> String {
        loop {
            let Ok(read) = timeout(self.settings.silence_limit, peer.read()).await else {
                return format!(
                    "tracker: nothing from {} for {:?}; connecting anew",
                    peer.name, self.settings.silence_limit
                );
            };
            if let Err(reason) = self.take(peer, read).await {
                return reason;
            }
        }
    }

    async fn keep_listening(self, listener: TcpListener) {
        let mut next = None;
        loop {
            let accepted = match next.take() {
                Some(accepted) => Ok(accepted),
                None => listener.accept().await,
            };
            let (stream, address) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    let reason = format!("tracker: cannot accept a connection: {error}");
                    self.outlet.report(Event::Unreachable { reason }).await;
                    sleep(self.settings.retry_max).await;
                    continue;
                }
            };
            let mut peer = Peer::new(stream, address.to_string());
            self.outlet.report(Event::Connected { peer: peer.name.clone() }).await;
            let reason = self.read_until_replaced(&mut peer, &listener, &mut next).await;
            self.outlet.report(Event::Disconnected { reason }).await;
        }
    }

    /// Reads a client until its connection ends, or it is silent and another one comes.
    async fn read_until_replaced(
        &self,
        peer: &mut Peer,
        listener: &TcpListener,
        next: &mut Option<(TcpStream, SocketAddr)>,
    ) -> String {
        loop {
            tokio::select! {
                read = peer.read() => {
                    if let Err(reason) = self.take(peer, read).await {
                        return reason;
                    }
                }
                Ok((stream, newcomer)) = listener.accept() => {
                    if peer.last_heard.elapsed() >= self.settings.silence_limit {
                        let reason =
                            format!("tracker: {} is silent, and {newcomer} took its place", peer.name);
                        *next = Some((stream, newcomer));
                        return reason;
                    }
                    tracing::warn!(
                        "tracker: {newcomer} turned away: {} is connected, and one tracker at a \
                         time is read",
                        peer.name
                    );
                }
            }
        }
    }

    /// Forwards what was read; an error is the reason to drop the connection.
    async fn take(&self, peer: &mut Peer, read: io::Result<usize>) -> Result<(), String> {
        let now = (self.clock)();
        match read {
            Ok(0) => {
                let name = &peer.name;
                return Err(match peer.decoder.finish() {
                    Ok(()) => format!("tracker: {name} closed the connection"),
                    Err(error) => format!("tracker: {name} closed the connection: {error}"),
                });
            }
            Ok(len) => peer.decoder.push(peer.buffer.get(..len).unwrap_or_default()),
            Err(error) => {
                return Err(format!("tracker: connection to {} lost: {error}", peer.name));
            }
        }
        peer.last_heard = Instant::now();
        loop {
            match peer.decoder.poll() {
                Ok(None) => return Ok(()),
                Ok(Some(message)) => self.forward(peer, &message, now).await,
                Err(error) if error.loses_framing() => {
                    return Err(format!("tracker: {} dropped: {error}", peer.name));
                }
                Err(error) => self.outlet.stream(Event::Malformed(error)),
            }
        }
    }

    async fn forward(&self, peer: &mut Peer, message: &Message, now: Time) {
        peer.messages += 1;
        let (tool, message_type) = (message.full_device_name(), message.body.type_name());
        if peer.names.len() < Peer::NAMES_MAX && !peer.names.contains(tool) {
            peer.names.insert(tool.to_owned());
            let saw =
                Event::SawTool { tool: tool.to_owned(), message_type: message_type.to_owned() };
            self.outlet.report(saw).await;
        }
        if let Some(sample) = Sample::from_message(message, now) {
            self.outlet.stream(Event::Sample(sample));
        } else if let Body::Status(status) = &message.body {
            let status = status.clone();
            self.outlet.stream(Event::Status { device: tool.to_owned(), status });
        }
    }
}

/// A connected peer.
struct Peer {
    stream: TcpStream,
    name: String,
    decoder: StreamDecoder,
    buffer: Vec<u8>,
    names: BTreeSet<String>,
    messages: u64,
    last_heard: Instant,
}

impl Peer {
    const NAMES_MAX: usize = 64;
    const BUFFER_LEN: usize = 16 * 1024;

    fn new(stream: TcpStream, name: String) -> Self {
        Peer {
            stream,
            name,
            decoder: StreamDecoder::new(),
            buffer: vec![0; Self::BUFFER_LEN],
            names: BTreeSet::new(),
            messages: 0,
            last_heard: Instant::now(),
        }
    }

    /// Waits for bytes. Nothing is lost if it is not waited for to the end.
    async fn read(&mut self) -> io::Result<usize> {
        self.stream.read(&mut self.buffer).await
    }
}
