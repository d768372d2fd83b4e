//! Makes `run.rrd` from the record of a run, after the run.

use super::content::{Content, builder};
use crate::archive::{Manifest, file};
use crate::telemetry::{Entry, Scene, TelemetryError};
use rerun::external::re_build_info::CrateVersion;
use rerun::external::re_log_encoding::{EncodeError, Encoder, EncodingOptions};
use rerun::log::{ChunkBatcherConfig, LogMsg};
use rerun::sink::CallbackSink;
use std::error::Error;
use std::fs::{self, File};
use std::io::{BufWriter, Write as _};
use std::mem;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// Rows per chunk: 20 s of a table with a row every 10 ms, 200 s of one with ten rows a second. Longer
/// chunks slow a viewer down and make the file hardly smaller.
const CHUNK_ROWS: u64 = 2000;
/// Bytes per chunk. Rows wait in memory until their chunk is full, and the row of a step is long.
const CHUNK_BYTES: u64 = 1 << 20;
/// Upper limit of the rows and chunks in memory, bytes. Beyond it [`Recording::take`] blocks, and with it
/// the replay that makes the file.
const IN_FLIGHT_BYTES: u64 = 4 << 20;
/// A file with more chunks than this gets no footer, the index of its chunks. Making the footer takes
/// some 20 kB of memory per chunk, and a viewer does not need it. Half an hour reaches the limit.
const INDEXED_CHUNKS_MAX: usize = 800;

/// The open file and the number of its chunks, or the first error. rerun's thread writes to it.
type Written = Arc<Mutex<Result<(Encoder<BufWriter<File>>, usize), EncodeError>>>;

/// Makes the recording of a run after the run, from all of its records in order.
///
/// Writes `run.rrd.new`, and renames it to `run.rrd` when it is complete and synced to the disk. A `Recording`
/// must stay on the thread that created it.
pub struct Recording {
    content: Content,
    written: Written,
    /// `run.rrd.new`.
    new_path: PathBuf,
    /// `run.rrd`.
    path: PathBuf,
}

impl Recording {
    /// Creates the file in the run folder `dir`, and writes what does not change: the layout, the scene,
    /// the manifest and the configuration.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(
        dir: &Path,
        manifest: &Manifest,
        config_toml: &str,
        scene: &Scene,
    ) -> Result<Self, TelemetryError> {
        let path = dir.join(file::RECORDING);
        let new_path = path.with_extension("rrd.new");
        let create = || -> Result<Recording, Box<dyn Error + Send + Sync>> {
            let options = EncodingOptions::PROTOBUF_COMPRESSED;
            let file = BufWriter::new(File::create(&new_path)?);
            let encoder = Encoder::new_eager(CrateVersion::LOCAL, options, file)?;
            let written: Written = Arc::new(Mutex::new(Ok((encoder, 0))));
            let sink = Arc::clone(&written);
            let batches = ChunkBatcherConfig {
                flush_num_rows: CHUNK_ROWS,
                flush_num_bytes: CHUNK_BYTES,
                max_bytes_in_flight: IN_FLIGHT_BYTES,
                ..ChunkBatcherConfig::NEVER
            };
            let stream = builder(manifest).batcher_config(batches).buffered()?;
            stream.set_sink(Box::new(CallbackSink::new(move |messages| write(&sink, messages))));
            let content = Content::open(stream, manifest, config_toml, scene)?;
            let (new_path, path) = (new_path.clone(), path.clone());
            Ok(Recording { content, written, new_path, path })
        };
        create().map_err(|error| {
            let _ = fs::remove_file(&new_path);
            failed(&path, error.as_ref())
        })
    }

    /// Adds a record.
    ///
    /// # Errors
    /// Rerun refuses the record. [`finish`](Self::finish) reports a failed write.
    pub fn take(&mut self, entry: Entry) -> Result<(), TelemetryError> {
        self.content.take(entry).map_err(|error| failed(&self.path, &error))
    }

    /// Completes the file, syncs it, and renames it to `run.rrd`.
    ///
    /// # Errors
    /// The file cannot be written; an earlier `run.rrd` then stays.
    pub fn finish(self) -> Result<(), TelemetryError> {
        let finish = || -> Result<(), Box<dyn Error + Send + Sync>> {
            self.content.stream.flush_blocking()?;
            let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
            let (mut encoder, _) = mem::replace(&mut *written, Err(EncodeError::AlreadyFinished))?;
            encoder.finish()?;
            let mut file = encoder.into_inner()?;
            file.flush()?;
            file.get_ref().sync_all()?;
            fs::rename(&self.new_path, &self.path)?;
            Ok(())
        };
        finish().map_err(|error| failed(&self.path, error.as_ref()))
    }
}

impl Drop for Recording {
    /// Removes `run.rrd.new`, which a successful [`finish`](Recording::finish) has renamed.
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.new_path);
    }
}

/// Writes `messages`. The first error is kept in `written`, and nothing is written after it.
fn write(written: &Written, messages: &[LogMsg]) {
    let mut written = written.lock().unwrap_or_else(PoisonError::into_inner);
    for message in messages {
        let Ok((encoder, chunks)) = &mut *written else { return };
        *chunks += 1;
        if *chunks > INDEXED_CHUNKS_MAX {
            encoder.do_not_emit_footer();
        }
        if let Err(error) = encoder.append(message) {
            *written = Err(error);
        }
    }
}

fn failed(path: &Path, error: &(dyn Error + 'static)) -> TelemetryError {
    TelemetryError::Recording(format!("{}: {error}", path.display()))
}
