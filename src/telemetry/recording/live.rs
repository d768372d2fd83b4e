//! The run for viewers while it goes.

use super::content::{Content, builder};
use super::pace::Pace;
use crate::archive::Manifest;
use crate::telemetry::worker::{Closing, Sink};
use crate::telemetry::{Entry, RunInfo, TelemetryError};
use rerun::{MemoryLimit, RecordingStreamResult, ServerOptions};
use std::net::{SocketAddr, TcpListener};
use std::thread;
use std::time::{Duration, Instant};

/// What a viewer that comes late is given of the past, and with it most of the memory. Beside it
/// rerun holds up to 128 MiB for viewers that do not read; then this thread waits, its queue runs
/// full, and what comes after is dropped and counted.
const HISTORY_BYTES: u64 = 64 << 20;
/// Viewers are given this long to take the end of the run.
const FAREWELL: Duration = Duration::from_millis(300);

/// Serves a run to viewers, on the thread that opened it.
///
/// It is a recording of its own with the identity of the one in the file, so that a viewer that
/// freezes can hold up neither file nor run.
pub(in crate::telemetry) struct Live {
    content: Content,
    pace: Pace,
}

impl Live {
    /// Serves at `address`.
    pub(in crate::telemetry) fn open(
        address: SocketAddr,
        info: &RunInfo,
        manifest: &Manifest,
    ) -> Result<Self, TelemetryError> {
        let failed = |reason: String| TelemetryError::Live { address, reason };
        // The server would say so only on its own thread.
        TcpListener::bind(address).map_err(|e| failed(e.to_string()))?;
        Self::try_open(address, info, manifest).map_err(|e| failed(e.to_string()))
    }

    fn try_open(
        address: SocketAddr,
        info: &RunInfo,
        manifest: &Manifest,
    ) -> RecordingStreamResult<Self> {
        let options = ServerOptions {
            memory_limit: MemoryLimit::from_bytes(HISTORY_BYTES),
            ..ServerOptions::default()
        };
        let stream = builder(info, manifest).serve_grpc_opts(
            address.ip().to_string(),
            address.port(),
            options,
        )?;
        let content = Content::open(stream, info, manifest)?;
        Ok(Live { content, pace: Pace::new(Instant::now()) })
    }
}

impl Sink for Live {
    fn take(&mut self, entry: Entry) -> Result<(), String> {
        self.content.take(entry);
        Ok(())
    }

    fn tick(&mut self) -> Result<(), String> {
        let began = Instant::now();
        if self.pace.is_due(began) {
            self.content.send().map_err(|e| e.to_string())?;
            self.pace.sent(began, Instant::now());
        }
        Ok(())
    }

    fn close(&mut self, closing: &Closing, _: &dyn Fn()) -> Result<(), String> {
        self.content.end(&closing.manifest).map_err(|e| e.to_string())?;
        // A viewer that does not take it by then is left behind.
        let _ = self.content.stream().flush_with_timeout(FAREWELL);
        thread::sleep(FAREWELL);
        Ok(())
    }
}
