//! `run.rrd`, made from the record of a run that is over.

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

/// Rows of a chunk: 20 s of the stage, 200 of what comes ten times a second. Longer ones make a viewer
/// slow and the file hardly smaller.
const CHUNK_ROWS: u64 = 2000;
/// Rows wait in memory for their chunk; a step has many columns, so their bytes are limited, too.
const CHUNK_BYTES: u64 = 1 << 20;
/// Rows and chunks on their way to the file, bytes; then the replay waits.
const IN_FLIGHT_BYTES: u64 = 4 << 20;
/// The file ends with an index of its chunks, which takes some 20 kB of memory a chunk while it is made.
/// A recording longer than half an hour has none: a viewer does not need it.
const INDEXED_CHUNKS_MAX: usize = 800;

/// The file while rerun's thread writes to it, with the number of its chunks, or why it could not.
type Written = Arc<Mutex<Result<(Encoder<BufWriter<File>>, usize), EncodeError>>>;

/// The recording of a run that is over, written from its first record to its last.
///
/// It stands beside its place until it is whole and on the disk, and is then moved there in one step.
/// It is bound to the thread that created it.
pub struct Recording {
    content: Content,
    written: Written,
    new: PathBuf,
    path: PathBuf,
}

impl Recording {
    /// Begins `run.rrd` in the run folder `dir`, with what stands still: the layout, the scene, the
    /// manifest and the configuration.
    ///
    /// # Errors
    /// [`TelemetryError::Recording`] where it cannot be written.
    pub fn create(
        dir: &Path,
        manifest: &Manifest,
        config_toml: &str,
        scene: &Scene,
    ) -> Result<Self, TelemetryError> {
        let path = dir.join(file::RECORDING);
        let new = path.with_extension("rrd.new");
        let create = || -> Result<_, Box<dyn Error + Send + Sync>> {
            let options = EncodingOptions::PROTOBUF_COMPRESSED;
            let file = BufWriter::new(File::create(&new)?);
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
            Ok((content, written))
        };
        match create() {
            Ok((content, written)) => Ok(Recording { content, written, new, path }),
            Err(error) => {
                let _ = fs::remove_file(&new);
                Err(failed(&path, error.as_ref()))
            }
        }
    }

    /// Adds a record.
    ///
    /// # Errors
    /// [`TelemetryError::Recording`] of a record that rerun cannot take; what cannot be written is
    /// an error at the end.
    pub fn take(&mut self, entry: Entry) -> Result<(), TelemetryError> {
        self.content.take(entry).map_err(|error| failed(&self.path, &error))
    }

    /// Completes the file and puts it in its place.
    ///
    /// # Errors
    /// [`TelemetryError::Recording`] where it cannot be written; then what stood in its place stays.
    pub fn finish(self) -> Result<(), TelemetryError> {
        let finish = || -> Result<(), Box<dyn Error + Send + Sync>> {
            self.content.end()?;
            self.content.stream().flush_blocking()?;
            let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
            let (mut encoder, _) = mem::replace(&mut *written, Err(EncodeError::AlreadyFinished))?;
            encoder.finish()?;
            let mut file = encoder.into_inner()?;
            file.flush()?;
            file.get_ref().sync_all()?;
            fs::rename(&self.new, &self.path)?;
            Ok(())
        };
        finish().map_err(|error| failed(&self.path, error.as_ref()))
    }
}

impl Drop for Recording {
    /// Takes away what was not completed.
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.new);
    }
}

/// Writes `messages` until one cannot be written.
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
    TelemetryError::Recording { path: path.to_path_buf(), reason: error.to_string() }
}
