//! The SYNC object (CiA 301, 7.2.5). At each SYNC the drives apply their set-points and sample their positions.

use std::time::Duration;

use super::{Frame, cob};
use crate::units::Time;

/// The SYNC frame, without a counter.
pub fn sync_frame() -> Frame {
    Frame::new(cob::SYNC, &[])
}

/// True for a SYNC on the identifier `cob_id` (0x1005), with or without a counter.
pub fn is_sync(frame: &Frame, cob_id: u16) -> bool {
    frame.cob_id() == Some(cob_id) && frame.data().len() <= 1
}

/// Produces SYNC at absolute deadlines: a late SYNC does not delay the next.
#[derive(Debug, Clone)]
pub struct SyncProducer {
    period: Duration,
    /// When the next SYNC is due.
    pub deadline: Time,
}

impl SyncProducer {
    /// A SYNC every `period`, which is over zero, the first at `first`.
    pub fn new(period: Duration, first: Time) -> Self {
        SyncProducer { period, deadline: first }
    }

    /// If a SYNC is due, the number of SYNCs that were missed before it. Missed SYNCs are skipped: two in
    /// quick succession would make the drives jump.
    pub fn handle_timeout(&mut self, now: Time) -> Option<u32> {
        if now < self.deadline {
            return None;
        }
        let periods = now.since(self.deadline).as_nanos() / self.period.as_nanos().max(1);
        let missed = u32::try_from(periods).unwrap_or(u32::MAX);
        self.deadline = self.deadline + self.period.saturating_mul(missed) + self.period;
        Some(missed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::at_ms;

    #[test]
    fn a_sync_frame_is_empty_or_holds_a_counter() {
        assert_eq!(sync_frame().to_string(), "080#");
        assert!(is_sync(&sync_frame(), 0x80));
        assert!(is_sync(&Frame::new(0x80, &[7]), 0x80), "with a counter");
        assert!(!is_sync(&Frame::new(0x81, &[]), 0x80));
        assert!(!is_sync(&Frame::new(0x80, &[0; 8]), 0x80), "8 bytes are no SYNC");
    }

    #[test]
    fn sync_times_are_absolute_and_missed_ones_are_skipped() {
        let mut sync = SyncProducer::new(Duration::from_millis(10), at_ms(0));
        assert_eq!((sync.handle_timeout(at_ms(4)), sync.deadline), (Some(0), at_ms(10)));
        assert_eq!(sync.handle_timeout(at_ms(9)), None);
        assert_eq!((sync.handle_timeout(at_ms(35)), sync.deadline), (Some(2), at_ms(40)));
    }
}
