//! The tracker's end: sends the tool's position to every client.

use crate::tracker::openigtlink::{Message, encode};
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::broadcast::{self, error::RecvError};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::{sleep, timeout};

/// An OpenIGTLink server that sends each message to all clients. It ends when dropped.
///
/// What clients send is read and ignored. A client that cannot keep up is dropped.
#[derive(Debug)]
pub struct TransformServer {
    local_addr: SocketAddr,
    messages: broadcast::Sender<Arc<[u8]>>,
    task: JoinHandle<()>,
}

impl TransformServer {
    /// Messages a client may be behind before it is dropped.
    pub const BACKLOG: usize = 256;
    /// Clients served at a time; more are turned away.
    pub const CLIENTS_MAX: usize = 16;
    /// Timeout for sending a message to a client.
    const WRITE_TIMEOUT: Duration = Duration::from_secs(1);

    /// Listens on `address` (`host:port`; port 0 lets the system choose).
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn bind(address: &str) -> io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let local_addr = listener.local_addr()?;
        let (messages, _) = broadcast::channel(Self::BACKLOG);
        let task = tokio::spawn(accept_clients(listener, messages.clone()));
        Ok(TransformServer { local_addr, messages, task })
    }

    /// Sends a message to all clients, and returns their number. It never blocks.
    pub fn send(&self, message: &Message) -> usize {
        if self.clients() == 0 {
            return 0;
        }
        self.messages.send(encode(message).into()).unwrap_or(0)
    }

    /// How many clients are connected.
    pub fn clients(&self) -> usize {
        self.messages.receiver_count()
    }

    /// The address listened on.
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }
}

impl Drop for TransformServer {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Accepts clients. Their tasks belong to this task and end with it.
async fn accept_clients(listener: TcpListener, messages: broadcast::Sender<Arc<[u8]>>) {
    let mut clients = JoinSet::new();
    loop {
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((_, peer)) if clients.len() >= TransformServer::CLIENTS_MAX => {
                    tracing::warn!(
                        "tracker server: {peer} turned away, {} clients are served",
                        clients.len()
                    );
                }
                Ok((stream, peer)) => {
                    tracing::info!("tracker server: {peer} connected");
                    let messages = messages.subscribe();
                    clients.spawn(async move {
                        let reason = serve(stream, messages).await;
                        tracing::info!("tracker server: {peer} dropped: {reason}");
                    });
                }
                Err(error) => {
                    // Most likely there are no file descriptors left; that may change.
                    tracing::warn!("tracker server: cannot accept a connection: {error}");
                    sleep(TransformServer::WRITE_TIMEOUT).await;
                }
            },
            Some(_) = clients.join_next() => {}
        }
    }
}

/// Serves a client until it disconnects or falls behind, and returns the reason.
async fn serve(mut stream: TcpStream, mut messages: broadcast::Receiver<Arc<[u8]>>) -> String {
    // Without Nagle's algorithm each message leaves at once.
    if let Err(error) = stream.set_nodelay(true) {
        return error.to_string();
    }
    let (mut reader, mut writer) = stream.split();
    let mut ignored = [0; 1024];
    loop {
        tokio::select! {
            message = messages.recv() => {
                let bytes = match message {
                    Ok(bytes) => bytes,
                    Err(RecvError::Lagged(missed)) => {
                        return format!("too slow, {missed} messages missed");
                    }
                    Err(RecvError::Closed) => return "the server ended".to_owned(),
                };
                match timeout(TransformServer::WRITE_TIMEOUT, writer.write_all(&bytes)).await {
                    Ok(Ok(())) => {}
                    Ok(Err(error)) => return error.to_string(),
                    Err(_) => return "too slow, it takes no more bytes".to_owned(),
                }
            }
            read = reader.read(&mut ignored) => match read {
                Ok(0) => return "closed by the client".to_owned(),
                Ok(_) => {}
                Err(error) => return error.to_string(),
            }
        }
    }
}
