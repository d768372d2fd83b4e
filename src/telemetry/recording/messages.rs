//! What would be sent of a recording, as messages.

use rerun::log::LogMsg;
use rerun::{RecordingStream, RecordingStreamBuilder, RecordingStreamResult};

/// The messages that `log` makes, of the recording or the layout of `builder`.
pub(super) fn messages(
    builder: RecordingStreamBuilder,
    log: impl FnOnce(&RecordingStream) -> RecordingStreamResult<()>,
) -> RecordingStreamResult<Vec<LogMsg>> {
    let (stream, storage) = builder.enabled(true).memory()?;
    let logged = log(&stream);
    let messages = storage.take();
    // Its own storage holds it, so that it would never end.
    stream.disconnect();
    logged.map(|()| messages)
}
