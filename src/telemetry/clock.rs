//! The wall clock, as the files of a run have it.

use crate::archive::rfc3339;
use jiff::Timestamp;
use std::time::SystemTime;

/// `2026-03-01T14:30:00.123456Z` of `time`.
pub fn utc_text(time: SystemTime) -> String {
    rfc3339(Timestamp::try_from(time).unwrap_or_default().as_microsecond())
}
