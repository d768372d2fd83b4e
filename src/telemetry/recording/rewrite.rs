//! A recording written once more: whole and small.
//!
//! Ten chunks a second for each table make a file three times as large as its rows. And after a
//! kill a recording has no footer, by which a viewer finds its way, and its last message may be
//! cut. Both are mended alike: read all messages that are whole, join the chunks of each table,
//! write, and put the new file in the place of the old one.

use crate::telemetry::TelemetryError;

use rerun::external::re_log_encoding::{DecoderApp, Encoder};
use rerun::external::re_log_types::StoreId;
use rerun::log::{Chunk, LogMsg};
use std::collections::BTreeMap;
use std::error::Error;
use std::fs::{self, File};
use std::io::{BufReader, Write as _};
use std::path::Path;
use std::time::Instant;

/// Rows of a chunk: ten minutes of [`super::motion::MOTION`], a minute of
/// [`super::motion::STAGE`]. Larger ones make a viewer slow and the file hardly smaller.
const CHUNK_ROWS: usize = 6000;
/// A larger recording is left as it is at the end of a run, since it is joined in memory.
const BYTES_MAX: u64 = 512 << 20;

type AnyError = Box<dyn Error + Send + Sync>;

/// Closes the recording `path` of a run that was killed: what its last message was cut in is left
/// out, everything before is kept, and it gets the footer that it lacks.
///
/// The file is replaced by the new one in one step, when that is complete and on disk. Returns
/// whether something was cut off its end.
///
/// # Errors
/// [`TelemetryError::Recording`] where the file cannot be read or written, or is no recording.
pub fn repair_recording(path: &Path) -> Result<bool, TelemetryError> {
    rewrite(path, None).map_err(|error| TelemetryError::Recording {
        path: path.to_path_buf(),
        reason: error.to_string(),
    })
}

/// Writes the recording `path` once more, by `deadline` or not at all; whether its end was cut.
pub(super) fn rewrite(path: &Path, deadline: Option<Instant>) -> Result<bool, AnyError> {
    let file = File::open(path)?;
    if deadline.is_some() && file.metadata()?.len() > BYTES_MAX {
        return Err(format!("larger than {} MiB", BYTES_MAX >> 20).into());
    }
    let mut parts = Parts::default();
    let mut cut = false;
    let mut messages = DecoderApp::decode_eager(BufReader::new(file))?;
    for message in &mut messages {
        in_time(deadline)?;
        match message {
            Ok(message) => parts.take(message)?,
            Err(_) => {
                cut = true;
                break;
            }
        }
    }
    if parts.first.is_empty() {
        return Err("not a single message of it can be read".into());
    }
    let bytes = parts.encode(deadline)?;
    let new = path.with_extension("rrd.new");
    let write = || -> std::io::Result<()> {
        let mut file = File::create(&new)?;
        file.write_all(&bytes)?;
        file.sync_all()?;
        fs::rename(&new, path)
    };
    write().inspect_err(|_| {
        let _ = fs::remove_file(&new);
    })?;
    Ok(cut)
}

fn in_time(deadline: Option<Instant>) -> Result<(), AnyError> {
    match deadline {
        Some(deadline) if Instant::now() > deadline => Err("it takes too long".into()),
        _ => Ok(()),
    }
}

/// The messages of a recording, the chunks of each table apart.
#[derive(Default)]
struct Parts {
    /// What stands still, in its order.
    first: Vec<LogMsg>,
    /// By store, entity and components.
    tables: BTreeMap<(StoreId, String), Vec<Chunk>>,
}

impl Parts {
    fn take(&mut self, message: LogMsg) -> Result<(), AnyError> {
        let LogMsg::ArrowMsg(store, arrow) = &message else {
            self.first.push(message);
            return Ok(());
        };
        let chunk = Chunk::from_arrow_msg(arrow)?;
        if chunk.is_static() || store.is_blueprint() {
            self.first.push(message);
            return Ok(());
        }
        let mut components: Vec<&str> =
            chunk.components_identifiers().map(|component| component.as_str()).collect();
        components.sort_unstable();
        let table = format!("{} {}", chunk.entity_path(), components.join(" "));
        self.tables.entry((store.clone(), table)).or_default().push(chunk);
        Ok(())
    }

    fn encode(self, deadline: Option<Instant>) -> Result<Vec<u8>, AnyError> {
        let mut encoder = Encoder::local()?;
        for message in &self.first {
            encoder.append(message)?;
        }
        for ((store, _), chunks) in self.tables {
            for chunk in join(chunks, deadline)? {
                encoder.append(&LogMsg::ArrowMsg(store.clone(), chunk.to_arrow_msg()?))?;
            }
        }
        encoder.finish()?;
        Ok(encoder.into_inner()?)
    }
}

/// Joins neighbours pairwise until they have [`CHUNK_ROWS`], so that a row is copied log₂ n times.
fn join(mut chunks: Vec<Chunk>, deadline: Option<Instant>) -> Result<Vec<Chunk>, AnyError> {
    loop {
        let before = chunks.len();
        let mut joined: Vec<Chunk> = Vec::with_capacity(before.div_ceil(2));
        let mut may_join = false;
        for chunk in chunks {
            in_time(deadline)?;
            match joined.last_mut() {
                Some(last)
                    if may_join
                        && last.num_rows() + chunk.num_rows() <= CHUNK_ROWS
                        && last.concatenable(&chunk) =>
                {
                    *last = Chunk::concat_and_sort(last, &chunk)?;
                    may_join = false;
                }
                _ => {
                    joined.push(chunk);
                    may_join = true;
                }
            }
        }
        chunks = joined;
        if chunks.len() == before {
            return Ok(chunks);
        }
    }
}
