//! The bench's end of a tracker's connection over TCP.

use super::super::link::{Link, LinkSettings, Outlet};
use crate::tracker::openigtlink::{ToolStream, get_status};
use crate::tracker::{Event, Protocol, Reader};
use crate::units::Time;
use std::io::{self, ErrorKind};
use std::net::SocketAddr;
use std::pin::pin;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, sleep, timeout};

/// Longest wait for a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Longest wait between two attempts to connect.
const RETRY_MAX: Duration = Duration::from_secs(5);

impl Link {
    /// Connects to the server at `address` (`host:port`), and reconnects when the connection is lost.
    /// `clock` gives the receive times.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn connect<C>(address: &str, settings: LinkSettings, clock: C) -> Self
    where
        C: Fn() -> Time + Send + Sync + 'static,
    {
        let address = address.to_owned();
        Link::filled_by(&settings.clone(), |outlet| {
            LinkTask { settings, clock, outlet }.keep_connected(address)
        })
    }

    /// Reads clients that connect to `listener` and push, one at a time. Others are turned away unless
    /// the connected one is silent.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn listen<C>(listener: TcpListener, settings: LinkSettings, clock: C) -> Self
    where
        C: Fn() -> Time + Send + Sync + 'static,
    {
        Link::filled_by(&settings.clone(), |outlet| {
            LinkTask { settings, clock, outlet }.keep_listening(listener)
        })
    }
}

/// The task that fills a link.
struct LinkTask<C> {
    settings: LinkSettings,
    clock: C,
    outlet: Outlet,
}

impl<C: Fn() -> Time> LinkTask<C> {
    async fn keep_connected(mut self, address: String) {
        let mut retry = self.settings.retry_first;
        loop {
            self.outlet.wait_for_room().await;
            let failure = match timeout(CONNECT_TIMEOUT, TcpStream::connect(&address)).await {
                Ok(Ok(stream)) => {
                    let mut peer = Peer::new(stream, address.clone(), &self.settings);
                    self.report(Event::Connected { peer: address.clone() });
                    let reason = self.read_to_end(&mut peer).await;
                    self.report(Event::Disconnected { reason });
                    if peer.reader.messages() > 0 {
                        retry = self.settings.retry_first;
                    }
                    None
                }
                Ok(Err(error)) => Some(error.to_string()),
                Err(_) => Some(format!("no answer within {CONNECT_TIMEOUT:?}")),
            };
            if let Some(error) = failure {
                let reason = format!(
                    "tracker: cannot connect to {address}: {error}; is the server running, and \
                     are host and port right? next attempt in {:.1} s",
                    retry.as_secs_f64()
                );
                self.report(Event::Unreachable { reason });
            }
            sleep(retry).await;
            retry = (2 * retry).min(RETRY_MAX);
        }
    }

    /// Reads a server until the connection ends, and returns the reason. A server that is silent for half of the
    /// limit is asked for its status: a tool out of view then does not end the connection.
    async fn read_to_end(&mut self, peer: &mut Peer) -> String {
        // The request comes first: a server that knows only header version 1 finds no message after GET_STATUS.
        if let Err(reason) = peer.request_stream().await {
            return reason;
        }
        peer.ask_status().await;
        let half = self.settings.silence_limit / 2;
        loop {
            let read = match timeout(half, peer.read()).await {
                Ok(read) => Ok(read),
                Err(_) => timeout(half, peer.ask_and_read()).await,
            };
            let Ok(read) = read else {
                return format!(
                    "tracker: nothing from {} for {:?}; reconnecting",
                    peer.name, self.settings.silence_limit
                );
            };
            if let Err(reason) = self.take(peer, read) {
                return reason;
            }
        }
    }

    async fn keep_listening(mut self, listener: TcpListener) {
        let mut next = None;
        loop {
            self.outlet.wait_for_room().await;
            let accepted = match next.take() {
                Some(accepted) => Ok(accepted),
                None => listener.accept().await,
            };
            let (stream, address) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    let reason = format!("tracker: cannot accept a connection: {error}");
                    self.report(Event::Unreachable { reason });
                    sleep(RETRY_MAX).await;
                    continue;
                }
            };
            let mut peer = Peer::new(stream, address.to_string(), &self.settings);
            self.report(Event::Connected { peer: peer.name.clone() });
            let reason = self.read_until_replaced(&mut peer, &listener, &mut next).await;
            self.report(Event::Disconnected { reason });
        }
    }

    /// Reads a client until its connection ends, or until it is silent and another one connects.
    async fn read_until_replaced(
        &mut self,
        peer: &mut Peer,
        listener: &TcpListener,
        next: &mut Option<(TcpStream, SocketAddr)>,
    ) -> String {
        if let Err(reason) = peer.request_stream().await {
            return reason;
        }
        let retry = self.settings.retry_first;
        let mut next_client = pin!(accept(listener, retry));
        let mut is_reported = false;
        loop {
            tokio::select! {
                read = peer.read() => {
                    if let Err(reason) = self.take(peer, read) {
                        return reason;
                    }
                }
                (stream, newcomer) = &mut next_client => {
                    if peer.last_heard.elapsed() >= self.settings.silence_limit {
                        let reason =
                            format!("tracker: {} is silent, and {newcomer} took its place", peer.name);
                        *next = Some((stream, newcomer));
                        return reason;
                    }
                    // Reported once: a client may try again many times a second.
                    if !std::mem::replace(&mut is_reported, true) {
                        let reason = format!(
                            "tracker: {newcomer} turned away: {} is connected, and one tracker at a time is read",
                            peer.name
                        );
                        self.report(Event::TurnedAway { reason });
                    }
                    next_client.set(accept(listener, retry));
                }
            }
        }
    }

    /// Reports a change of the connection.
    fn report(&mut self, event: Event) {
        self.outlet.deliver((self.clock)(), event);
    }

    /// Delivers what was read. An error ends the connection.
    fn take(&mut self, peer: &mut Peer, read: io::Result<usize>) -> Result<(), String> {
        let now = (self.clock)();
        let len = match read {
            Ok(len) => len,
            // The peer closed it before it read what the bench had sent.
            Err(error) if error.kind() == ErrorKind::ConnectionReset => 0,
            Err(error) => {
                return Err(format!("tracker: connection to {} lost: {error}", peer.name));
            }
        };
        if len == 0 {
            let error = self.outlet.finish(now, &mut peer.reader);
            return Err(format!("tracker: {} closed the connection{error}", peer.name));
        }
        peer.reader.push(now, peer.buffer.get(..len).unwrap_or_default());
        peer.last_heard = Instant::now();
        let delivered = self.outlet.deliver_all(now, &mut peer.reader);
        delivered.map_err(|reason| format!("tracker: {} {reason}", peer.name))
    }
}

/// The next client. After an error, such as no file descriptors left, this tries again after `retry`, which
/// doubles with each attempt.
async fn accept(listener: &TcpListener, mut retry: Duration) -> (TcpStream, SocketAddr) {
    loop {
        match listener.accept().await {
            Ok(accepted) => return accepted,
            Err(error) => tracing::warn!("tracker: cannot accept a connection: {error}"),
        }
        sleep(retry).await;
        retry = (2 * retry).min(RETRY_MAX);
    }
}

/// A connected peer. If a stream was requested from it, dropping this asks it to end the stream.
struct Peer {
    stream: TcpStream,
    name: String,
    reader: Reader,
    buffer: Vec<u8>,
    last_heard: Instant,
    speaks_openigtlink: bool,
    request: Option<ToolStream>,
}

impl Peer {
    const BUFFER_LEN: usize = 16 * 1024;

    fn new(stream: TcpStream, name: String, settings: &LinkSettings) -> Self {
        let speaks_openigtlink = settings.protocol == Protocol::OpenIgtLink;
        Peer {
            stream,
            name,
            reader: Reader::new(settings.protocol),
            buffer: vec![0; Self::BUFFER_LEN],
            last_heard: Instant::now(),
            speaks_openigtlink,
            request: settings.request.filter(|_| speaks_openigtlink),
        }
    }

    /// Asks an OpenIGTLink server for its status. If the connection is lost, the next read says why.
    async fn ask_status(&mut self) {
        if self.speaks_openigtlink && self.stream.write_all(&get_status()).await.is_ok() {
            self.reader.await_status();
        }
    }

    /// Asks for the status and waits for bytes.
    async fn ask_and_read(&mut self) -> io::Result<usize> {
        self.ask_status().await;
        self.read().await
    }

    /// Requests the stream, if one is to be requested.
    async fn request_stream(&mut self) -> Result<(), String> {
        let Some(request) = self.request else { return Ok(()) };
        (self.stream.write_all(&request.start()).await)
            .map_err(|error| format!("tracker: connection to {} lost: {error}", self.name))
    }

    /// Waits for bytes. No bytes are lost if the future is dropped.
    async fn read(&mut self) -> io::Result<usize> {
        self.stream.read(&mut self.buffer).await
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        if let Some(request) = self.request {
            // Best effort: the connection ends now anyway.
            let _ = self.stream.try_write(&request.stop());
        }
    }
}
