//! Shows the run to viewers while it goes on. Records that do not fit into its queue are dropped and counted.

use super::content::{Content, builder};
use super::document::log_manifest;
use crate::archive::Manifest;
use crate::telemetry::worker::{Backpressure, Sink, Worker};
use crate::telemetry::{Entry, Scene, TelemetryError};
use rerun::{MemoryLimit, ServerOptions};
use std::net::{SocketAddr, TcpListener};
use std::thread;
use std::time::Duration;

/// Capacity of the queue, records.
const QUEUE_ENTRIES: usize = 32_768;
/// Memory for the history that a viewer gets when it connects late. In addition rerun holds up to 128 MiB for
/// viewers that do not read. Beyond that this thread blocks, its queue fills, and further records are dropped
/// and counted.
const HISTORY_BYTES: u64 = 64 << 20;
/// Viewers are given this long to take the end of the run.
const DRAIN_TIME: Duration = Duration::from_millis(300);
/// A frozen viewer delays the end of the run at most this long.
pub(in crate::telemetry) const CLOSE_TIMEOUT: Duration = Duration::from_secs(2);

/// Serves the run of `manifest` to viewers at `address`, from a thread of its own. Viewers see it under the same
/// identity as `run.rrd`.
///
/// # Errors
/// The bench cannot listen at the address.
pub(in crate::telemetry) fn serve(
    address: SocketAddr,
    manifest: &Manifest,
    config_toml: &str,
    scene: &Scene,
) -> Result<Worker<Entry>, TelemetryError> {
    let failed = |reason: String| {
        TelemetryError::Recording(format!("--live: {address}: {reason}; is the port free?"))
    };
    // The server would report a port in use only on its own thread.
    TcpListener::bind(address).map_err(|e| failed(e.to_string()))?;
    let memory_limit = MemoryLimit::from_bytes(HISTORY_BYTES);
    let options = ServerOptions { memory_limit, ..ServerOptions::default() };
    let (ip, port) = (address.ip().to_string(), address.port());
    let served = builder(manifest).serve_grpc_opts(ip, port, options);
    let content = served.and_then(|stream| Content::open(stream, manifest, config_toml, scene));
    let content = content.map_err(|error| failed(error.to_string()))?;
    Worker::start("live view", QUEUE_ENTRIES, Backpressure::DropAndCount, content)
}

impl Sink for Content {
    type Item = Entry;
    const TICK: Duration = Duration::from_millis(50);

    fn take(&mut self, entry: Entry) -> Result<(), String> {
        Content::take(self, entry).map_err(|error| {
            tracing::warn!("live view: {error}; viewers see no more of this run");
            error.to_string()
        })
    }

    /// Gives viewers time to take the end of the run before the stream is dropped. The drop waits for frozen viewers.
    fn close(&mut self, manifest: &Manifest, _: &dyn Fn()) -> Result<(), String> {
        let ended = log_manifest(&self.stream, manifest);
        let _ = self.stream.flush_with_timeout(DRAIN_TIME);
        thread::sleep(DRAIN_TIME);
        ended.map_err(|error| error.to_string())
    }
}
