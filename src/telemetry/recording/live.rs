//! The run for viewers while it goes on: a lossy tap.

use super::content::{Content, builder, log_manifest};
use crate::archive::Manifest;
use crate::telemetry::{Entry, Scene, TelemetryError};
use rerun::{MemoryLimit, RecordingStreamResult, ServerOptions};
use std::net::{SocketAddr, TcpListener};
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::thread;
use std::time::Duration;

/// Records that wait to be logged; what finds no room is dropped and counted.
const QUEUE_ENTRIES: usize = 32_768;
/// What a viewer that comes late is given of the past, and with it most of the memory. Beside it
/// rerun holds up to 128 MiB for viewers that do not read; then the tap's thread waits, its queue
/// runs full, and what comes after is dropped and counted.
const HISTORY_BYTES: u64 = 64 << 20;
/// Viewers are given this long to take the end of the run.
const FAREWELL: Duration = Duration::from_millis(300);
/// A viewer that is frozen holds up the end of the run no longer than this.
const FAREWELL_MAX: Duration = Duration::from_secs(2);

/// Serves a run to viewers, from a thread of its own.
///
/// It has the identity of the recording in the file, and nothing else to do with it.
pub(in crate::telemetry) struct Live {
    queue: SyncSender<Message>,
    ended: Receiver<()>,
    dropped: u64,
}

#[expect(clippy::large_enum_variant, reason = "all but the last one are entries")]
enum Message {
    Entry(Entry),
    End(Box<Manifest>),
}

impl Live {
    /// Serves the run of `manifest` at `address`.
    ///
    /// # Errors
    /// [`TelemetryError::Live`] where the address cannot be listened at.
    pub(in crate::telemetry) fn open(
        address: SocketAddr,
        manifest: Manifest,
        config_toml: String,
        scene: Scene,
    ) -> Result<Self, TelemetryError> {
        let failed = |reason: String| TelemetryError::Live { address, reason };
        // The server would say so only on its own thread.
        TcpListener::bind(address).map_err(|e| failed(e.to_string()))?;
        let (queue, messages) = sync_channel(QUEUE_ENTRIES);
        let (opened_tx, opened) = channel();
        let (ended_tx, ended) = channel();
        let serve = move || {
            let content = serve(address, &manifest, &config_toml, &scene);
            let _ = opened_tx.send(content.as_ref().err().map(ToString::to_string));
            let Ok(mut content) = content else { return };
            if let Err(error) = show(&mut content, &messages) {
                tracing::warn!("live view: {error}; viewers see no more of this run");
            }
            // Before the stream is dropped, which waits for viewers that are frozen.
            let _ = ended_tx.send(());
        };
        let thread = thread::Builder::new().name("live-view".to_owned()).spawn(serve);
        thread.map_err(|e| failed(e.to_string()))?;
        match opened.recv() {
            Ok(None) => Ok(Live { queue, ended, dropped: 0 }),
            Ok(Some(reason)) => Err(failed(reason)),
            Err(_) => Err(failed("its thread panicked".to_owned())),
        }
    }

    /// Shows `entry`, or counts it as dropped; never waits.
    pub(in crate::telemetry) fn give(&mut self, entry: Entry) {
        let is_taken = self.queue.try_send(Message::Entry(entry)).is_ok();
        self.dropped += u64::from(!is_taken);
    }

    /// Entries that were not shown.
    pub(in crate::telemetry) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Shows how the run ended; a viewer that does not take it in time is left behind.
    pub(in crate::telemetry) fn end(&self, manifest: &Manifest) {
        if self.queue.try_send(Message::End(Box::new(manifest.clone()))).is_ok() {
            let _ = self.ended.recv_timeout(FAREWELL_MAX);
        }
    }
}

fn serve(
    address: SocketAddr,
    manifest: &Manifest,
    config_toml: &str,
    scene: &Scene,
) -> RecordingStreamResult<Content> {
    let memory_limit = MemoryLimit::from_bytes(HISTORY_BYTES);
    let options = ServerOptions { memory_limit, ..ServerOptions::default() };
    let (ip, port) = (address.ip().to_string(), address.port());
    let stream = builder(manifest).serve_grpc_opts(ip, port, options)?;
    Content::open(stream, manifest, config_toml, scene)
}

/// Logs what comes until the run ends or is abandoned.
fn show(content: &mut Content, messages: &Receiver<Message>) -> RecordingStreamResult<()> {
    while let Ok(message) = messages.recv() {
        match message {
            Message::Entry(entry) => content.take(entry)?,
            Message::End(manifest) => {
                content.end()?;
                log_manifest(content.stream(), &manifest)?;
                let _ = content.stream().flush_with_timeout(FAREWELL);
                thread::sleep(FAREWELL);
                return Ok(());
            }
        }
    }
    Ok(())
}
