//! A drive's answers to SYNC: its TPDO1, one after each.

use crate::canopen::Frame;

/// A drive may leave this many more SYNCs unanswered in all than it may miss in a row.
const UNANSWERED_MAX: u32 = 2;
/// After this many SYNCs one unanswered SYNC is forgotten: a frame that is lost now and then is not a fault.
const LEAK_SYNCS: u64 = 1000;

/// The answers of one drive so far.
#[derive(Debug, Default)]
pub(super) struct Answers {
    /// The answer to the last SYNC has come.
    pub(super) fresh: bool,
    /// SYNCs in a row without an answer.
    pub(super) missed_in_a_row: u32,
    /// The length, in bytes, of a TPDO1 of the wrong length that came since the last valid one.
    pub(super) wrong_length: Option<usize>,
    /// SYNCs that were sent, less the TPDO1 that came: this many answers were lost, or answers are late by this many
    /// SYNCs.
    unanswered: u32,
    payload: [u8; 6],
    /// A second TPDO1 after the last SYNC, with another payload.
    second: Option<Frame>,
    /// SYNCs in a row with such a second TPDO1.
    conflicts: u32,
}

impl Answers {
    /// Notes that the SYNC of this number is sent.
    pub(super) fn begin(&mut self, sync: u64) {
        self.fresh = false;
        self.unanswered += 1;
        self.unanswered -= u32::from(sync.is_multiple_of(LEAK_SYNCS));
    }

    /// Takes a TPDO1 with this payload. Returns false if the last SYNC was answered already: the payload must then not
    /// be used.
    pub(super) fn take(&mut self, frame: &Frame, payload: [u8; 6]) -> bool {
        self.unanswered = self.unanswered.saturating_sub(1);
        if self.fresh {
            self.second = (payload != self.payload).then_some(*frame).or(self.second);
            return false;
        }
        (self.fresh, self.payload, self.wrong_length) = (true, payload, None);
        true
    }

    /// Counts the answers to the last SYNC. Call it once before each SYNC. Returns a fault if the drive has given two
    /// different answers to each of more than `missed_max` SYNCs in a row. No answer counts as missing while the drive
    /// `may_be_silent`.
    pub(super) fn judge(&mut self, missed_max: u32, may_be_silent: bool) -> Option<String> {
        let missed = self.missed_in_a_row.saturating_add(1);
        self.missed_in_a_row = if self.fresh || may_be_silent { 0 } else { missed };
        self.unanswered = if may_be_silent { 0 } else { self.unanswered };
        let second = self.second.take();
        self.conflicts = if second.is_some() { self.conflicts.saturating_add(1) } else { 0 };
        let syncs = self.conflicts;
        second.filter(|_| syncs > missed_max).map(|frame| {
            format!(
                "two TPDO1 that differ after each of {syncs} SYNCs in a row, the second {frame}; does another node \
                 have the same ID, or does the drive answer late?"
            )
        })
    }

    /// Returns a fault if so many SYNCs are unanswered that the drive's positions may be too old.
    pub(super) fn fault_of_unanswered(&self, missed_max: u32) -> Option<String> {
        let (unanswered, unanswered_max) = (self.unanswered, missed_max + UNANSWERED_MAX);
        (unanswered > unanswered_max).then(|| {
            format!(
                "{unanswered} TPDO1 are lost or late (limit {unanswered_max}): its positions may be {unanswered} SYNCs old; check bus \
                 load, cable, and what passes frames on"
            )
        })
    }
}
