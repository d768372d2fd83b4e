//! `[record]`: where runs are kept, and what becomes of one whose record fails.

use serde::Serialize;

use super::choice::choice;
use super::section::Section;

/// `[record]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordConfig {
    /// The folder in which run folders are made.
    pub dir: String,
    /// What a run does when its record can no longer be kept.
    pub on_failure: OnFailure,
    /// Less free space than this in `dir` refuses a run, MB.
    pub free_mb_min: u32,
    /// Who runs the bench, where `--operator` does not say.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub operator: Option<String>,
    /// What needles are inserted into, where `--phantom` does not say.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phantom: Option<String>,
}

choice! {
    /// What a run does when its record can no longer be kept: the disk is full or takes nothing, or
    /// the folder is gone.
    OnFailure {
        /// It is stopped, safely.
        Stop = "stop",
        /// It goes on, and is told and counted what is lost.
        GoOn = "go-on",
    }
}

impl RecordConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        RecordConfig {
            dir: s.text("dir", "the path of a folder", |dir| !dir.trim().is_empty()),
            on_failure: s.choice("on_failure"),
            free_mb_min: s.integer("free_mb_min", 0, u32::MAX),
            operator: s.optional_text("operator", "a name"),
            phantom: s.optional_text("phantom", "a description"),
        }
    }
}
