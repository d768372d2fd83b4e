//! `[record]`: where runs are kept, and what a run does when recording fails.

use crate::keys::{choice, named, section, within};

section! {
    /// `[record]`.
    pub struct RecordConfig {
        /// The folder in which run folders are made.
        dir: String [named("the path of a folder")] = "runs";
        /// What a run does when its record can no longer be written.
        on_failure: OnFailure = "stop";
        /// A run is refused when `dir` has less free space than this, MB.
        free_mb_min: u32 [within(0.0, u32::MAX as f64)] = 100;
        /// Who runs the bench. It goes into each manifest; `run --operator` replaces it.
        operator: Option<String> [named("a name")];
        /// What needles are inserted into. It goes into each manifest; `run --phantom` replaces it.
        phantom: Option<String> [named("a description")];
    }
}

choice! {
    /// What a run does when its record can no longer be written: the disk is full or stalled, or the
    /// folder is gone.
    pub enum OnFailure {
        /// The run is stopped, safely.
        Stop = "stop",
        /// The run goes on. The operator is told, and what is lost is counted.
        GoOn = "go-on",
    }
}
