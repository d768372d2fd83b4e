//! A recording written once more: whole and small.
//!
//! Ten chunks a second for each table make a file several times as large as its rows. And after a
//! kill a recording has no footer, by which a viewer finds its way, and its last message may be
//! cut. Both are mended alike: read all messages that are whole, join the chunks of each table,
//! write them with the manifest as it is now, and put the new file in the place of the old one.

use super::content::{MANIFEST_PAGES, manifest_pages};
use crate::archive::Manifest;
use crate::telemetry::TelemetryError;
use rerun::external::arrow::array::{Array as _, AsArray as _, RecordBatch};
use rerun::external::arrow::compute::{cast, concat_batches};
use rerun::external::arrow::datatypes::{DataType, Int64Type};
use rerun::external::arrow::error::ArrowError;
use rerun::external::re_log_encoding::{DecoderApp, Encoder};
use rerun::external::re_log_types::{ArrowMsg, StoreId};
use rerun::log::LogMsg;
use std::collections::BTreeMap;
use std::error::Error;
use std::fs::{self, File};
use std::io::{BufReader, Write as _};
use std::path::Path;

/// Rows of a joined chunk: a minute of the stage, ten of what comes ten times a second. Longer
/// ones make a viewer slow and the file hardly smaller.
const CHUNK_ROWS: usize = 6000;
type AnyError = Box<dyn Error + Send + Sync>;

/// Closes the recording `path` of a run that was killed: what its last message was cut in is left
/// out, everything before is kept, and it gets the footer that it lacks and the page of `manifest`.
///
/// The file is replaced by the new one in one step, when that is complete and on disk.
///
/// # Errors
/// [`TelemetryError::Recording`] where the file cannot be read or written, is no recording or is
/// damaged before its end; then it is as it was.
pub fn repair_recording(path: &Path, manifest: &Manifest) -> Result<(), TelemetryError> {
    rewrite(path, manifest, u64::MAX, &|| true).map_err(|error| TelemetryError::Recording {
        path: path.to_path_buf(),
        reason: error.to_string(),
    })
}

/// Writes the recording `path` once more, with `manifest` as its page, if it is not larger than
/// `bytes_max`, as it is joined in memory, and as long as it `may_go_on`, which is asked for every
/// message.
pub(super) fn rewrite(
    path: &Path,
    manifest: &Manifest,
    bytes_max: u64,
    may_go_on: &dyn Fn() -> bool,
) -> Result<(), AnyError> {
    let in_time = || if may_go_on() { Ok(()) } else { Err("it takes too long") };
    let file = File::open(path)?;
    if file.metadata()?.len() > bytes_max {
        return Err(format!("larger than {} MiB", bytes_max >> 20).into());
    }
    let mut parts = Parts::default();
    // Ends before a message that is cut.
    for message in DecoderApp::decode_eager(BufReader::new(file))? {
        in_time()?;
        parts.take(message?);
    }
    if parts.still.is_empty() {
        return Err("not a single message of it can be read".into());
    }
    let mut encoder = Encoder::local()?;
    let pages = parts.run.as_ref().map(|run| manifest_pages(run, manifest)).transpose()?;
    for message in parts.still.iter().chain(pages.iter().flatten()) {
        encoder.append(message)?;
    }
    let mut tables: Vec<_> = parts.tables.into_iter().collect();
    // The small ones first: a viewer that draws while it reads has states and tip at once.
    tables.sort_by_key(|(_, chunks)| chunks.iter().map(|c| c.batch.num_rows()).sum::<usize>());
    for ((store, _), chunks) in &tables {
        for chunk in joined(chunks)? {
            in_time()?;
            encoder.append(&LogMsg::ArrowMsg(store.clone(), chunk))?;
        }
    }
    in_time()?;
    encoder.finish()?;
    in_time()?;
    replace(path, &encoder.into_inner()?)?;
    Ok(())
}

/// Puts `bytes` in the place of the file `path`, which is the old one until they are on disk.
fn replace(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let new = path.with_extension("rrd.new");
    let write = || {
        let mut file = File::create(&new)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&new, path)
    };
    write().inspect_err(|_| {
        let _ = fs::remove_file(&new);
    })
}

/// The messages of a recording.
#[derive(Default)]
struct Parts {
    /// The recording, which layouts come with.
    run: Option<StoreId>,
    /// What has no time, and layouts, in their order, without the manifest's pages.
    still: Vec<LogMsg>,
    /// The chunks of every entity, in their order.
    tables: BTreeMap<(StoreId, String), Vec<ArrowMsg>>,
}

impl Parts {
    fn take(&mut self, message: LogMsg) {
        match message {
            LogMsg::ArrowMsg(store, chunk) if !store.is_blueprint() => {
                let schema = chunk.batch.schema();
                let entity = schema.metadata().get("rerun:entity_path").cloned();
                let entity = entity.unwrap_or_default();
                if times(&chunk.batch).next().is_some() {
                    self.tables.entry((store, entity)).or_default().push(chunk);
                } else if !MANIFEST_PAGES.contains(&entity.as_str()) {
                    self.still.push(LogMsg::ArrowMsg(store, chunk));
                }
            }
            LogMsg::SetStoreInfo(info) => {
                let store = &info.info.store_id;
                if !store.is_blueprint() {
                    self.run = Some(store.clone());
                }
                self.still.push(LogMsg::SetStoreInfo(info));
            }
            other => self.still.push(other),
        }
    }
}

/// Neighbours of one kind as one chunk each, in the order of time that they have.
fn joined(chunks: &[ArrowMsg]) -> Result<Vec<ArrowMsg>, ArrowError> {
    let mut joined = Vec::new();
    let mut rest = chunks;
    while let Some(first) = rest.first() {
        let mut rows = first.batch.num_rows();
        let more = rest.windows(2).take_while(|pair| {
            let [before, next] = pair else { return false };
            rows += next.batch.num_rows();
            rows <= CHUNK_ROWS && follows(&before.batch, &next.batch)
        });
        let (these, others) = rest.split_at(1 + more.count());
        rest = others;
        let batches = these.iter().map(|chunk| &chunk.batch);
        let batch = concat_batches(&first.batch.schema(), batches)?;
        joined.push(ArrowMsg { chunk_id: first.chunk_id, batch, on_release: None });
    }
    Ok(joined)
}

/// Whether `next` has the columns of `before`, and begins on no time line before that one ends.
fn follows(before: &RecordBatch, next: &RecordBatch) -> bool {
    before.schema().fields() == next.schema().fields()
        && times(before).zip(times(next)).all(|(ends, begins)| match (ends, begins) {
            (Some((_, end)), Some((begin, _))) => end <= begin,
            _ => false,
        })
}

/// The first and the last time of a chunk on each of its time lines.
fn times(batch: &RecordBatch) -> impl Iterator<Item = Option<(i64, i64)>> {
    let is_time = |n: &usize| {
        let schema = batch.schema();
        schema.field(*n).metadata().get("rerun:kind").is_some_and(|kind| kind == "index")
    };
    (0..batch.num_columns()).filter(is_time).map(|n| {
        let column = batch.column(n);
        let at = |row: usize| {
            let time = cast(&column.slice(row, 1), &DataType::Int64).ok()?;
            Some(time.as_primitive_opt::<Int64Type>()?.value(0))
        };
        Some((at(0)?, at(column.len().checked_sub(1)?)?))
    })
}
