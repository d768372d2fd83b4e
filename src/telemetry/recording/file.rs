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

/// Rows of a chunk: 20 s of the stage, 200 of what comes ten times a second. They wait in memory, and
/// longer ones make a viewer slow and the file hardly smaller.
const CHUNK_ROWS: u64 = 2000;

type RrdEncoder = Encoder<BufWriter<File>>;
/// The file while rerun's thread writes to it, or why it could not.
type Written = Arc<Mutex<Result<RrdEncoder, EncodeError>>>;

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
            let written: Written = Arc::new(Mutex::new(Ok(encoder)));
            let sink = Arc::clone(&written);
            let batches =
                ChunkBatcherConfig { flush_num_rows: CHUNK_ROWS, ..ChunkBatcherConfig::NEVER };
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
            let mut encoder = mem::replace(&mut *written, Err(EncodeError::AlreadyFinished))?;
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
    if let Ok(encoder) = &mut *written
        && let Err(error) = messages.iter().try_for_each(|m| encoder.append(m).map(drop))
    {
        *written = Err(error);
    }
}

fn failed(path: &Path, error: &(dyn Error + 'static)) -> TelemetryError {
    TelemetryError::Recording { path: path.to_path_buf(), reason: error.to_string() }
}
