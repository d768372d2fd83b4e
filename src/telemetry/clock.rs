//! The wall clock, as the files of a run have it.

use crate::archive::rfc3339;
use std::time::{SystemTime, UNIX_EPOCH};

/// Microseconds from 1970 to `time`, rounded down.
fn unix_us(time: SystemTime) -> i64 {
    match time.duration_since(UNIX_EPOCH) {
        Ok(after) => i64::try_from(after.as_micros()).unwrap_or(i64::MAX),
        Err(before) => {
            i64::try_from(before.duration().as_nanos().div_ceil(1000)).map_or(i64::MIN, |us| -us)
        }
    }
}

/// `2026-03-01T14:30:00.123456Z` of `time`.
pub fn utc_text(time: SystemTime) -> String {
    rfc3339(unix_us(time))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn microseconds_are_rounded_down_on_both_sides_of_1970() {
        assert_eq!(unix_us(UNIX_EPOCH + Duration::from_nanos(1_999)), 1);
        assert_eq!(unix_us(UNIX_EPOCH - Duration::from_nanos(1_001)), -2);
        assert_eq!(unix_us(UNIX_EPOCH), 0);
    }
}
