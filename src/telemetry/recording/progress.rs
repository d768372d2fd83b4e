//! Whether the recording's file still takes what it is given.

use crate::telemetry::room::free_there;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Without a flush that succeeds and without a byte more in the file for this long, the recording
/// is given up: before those who look after it do so without knowing why.
pub(super) const STALL_LIMIT: Duration = Duration::from_millis(4500);
/// No more than this counts between two looks: one who was held up himself has not seen a disk that
/// takes nothing.
const LOOK_MAX: Duration = Duration::from_millis(500);

/// When the file last took something.
#[derive(Debug)]
pub(super) struct Progress {
    path: PathBuf,
    looked: Instant,
    /// For how long it has been seen to take nothing.
    stalled: Duration,
    file_bytes: u64,
    /// The last flush timed out, and the file did not grow.
    is_stalled: bool,
}

impl Progress {
    /// Of the file `path`, made at `now`.
    pub(super) fn new(path: &Path, now: Instant) -> Self {
        Progress {
            path: path.to_path_buf(),
            looked: now,
            stalled: Duration::ZERO,
            file_bytes: 0,
            is_stalled: false,
        }
    }

    /// A flush succeeded.
    pub(super) fn made(&mut self) {
        self.looked = Instant::now();
        self.stalled = Duration::ZERO;
        self.file_bytes = self.bytes_now();
        self.is_stalled = false;
    }

    fn bytes_now(&self) -> u64 {
        fs::metadata(&self.path).map_or(0, |file| file.len())
    }

    /// Whether the file took nothing when it was last seen to.
    pub(super) fn is_stalled(&self) -> bool {
        self.is_stalled
    }

    /// To be called when a flush timed out: a file that grows is written to all the same, by a
    /// machine that is busy.
    ///
    /// # Errors
    /// The reason to give the recording up.
    pub(super) fn check(&mut self) -> Result<(), String> {
        self.is_stalled = self.bytes_now() <= self.file_bytes;
        if !self.is_stalled {
            self.made();
        }
        let now = Instant::now();
        let since = now.duration_since(std::mem::replace(&mut self.looked, now));
        self.stalled += since.min(LOOK_MAX);
        if self.stalled > STALL_LIMIT {
            return Err(format!(
                "the disk took nothing for {:.1} s, {}",
                self.stalled.as_secs_f64(),
                free_there(&self.path)
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::folder::tests::Scratch;

    #[test]
    fn a_file_that_grows_is_not_stalled() {
        let scratch = Scratch::new("progress");
        let path = scratch.0.join("run.rrd");
        let long_ago = Instant::now().checked_sub(2 * STALL_LIMIT).unwrap();
        let mut progress = Progress::new(&path, long_ago);
        fs::write(&path, "RRF2").unwrap();
        progress.check().unwrap();
        // Held up for nine seconds, it has not seen nine seconds of a disk that takes nothing.
        progress.looked = long_ago;
        progress.check().unwrap();
        assert!(progress.is_stalled());
        progress.stalled = STALL_LIMIT;
        progress.looked = long_ago;
        let reason = progress.check().unwrap_err();
        assert!(reason.starts_with("the disk took nothing for 5.0 s"), "{reason}");
        progress.made();
        assert!(!progress.is_stalled());
        fs::write(&path, "RRF2 and more").unwrap();
        progress.check().unwrap();
        assert!(!progress.is_stalled());
    }
}
