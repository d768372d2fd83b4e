//! A drive's answers to SYNC: its TPDO1, one after each.

use crate::canopen::Frame;

/// So many SYNCs more may stay unanswered than may be missed in a row.
const UNANSWERED_MAX: u32 = 2;
/// One unanswered SYNC no longer counts after so many: a frame that is lost now and then is no fault.
const LEAK_SYNCS: u64 = 1000;

/// The answers of one drive so far.
#[derive(Debug, Default)]
pub(super) struct Answers {
    /// The answer to the last SYNC has come.
    pub(super) fresh: bool,
    /// SYNCs in a row without an answer.
    pub(super) missed_in_a_row: u32,
    /// The length, bytes, of a TPDO1 that came since the last one that was taken.
    pub(super) wrong_length: Option<usize>,
    /// SYNCs that were sent, less the TPDO1 that came: answers that were lost, or that are late by so many SYNCs.
    unanswered: u32,
    payload: [u8; 6],
    /// A second TPDO1 after the last SYNC, with another payload.
    second: Option<Frame>,
    /// SYNCs in a row with such a second TPDO1.
    conflicts: u32,
}

impl Answers {
    /// The SYNC of this number is sent.
    pub(super) fn begin(&mut self, sync: u64) {
        self.fresh = false;
        self.unanswered += 1;
        self.unanswered -= u32::from(sync.is_multiple_of(LEAK_SYNCS));
    }

    /// Takes a TPDO1 with this payload. False if the last SYNC has had its answer: the payload must not be used then.
    pub(super) fn take(&mut self, frame: &Frame, payload: [u8; 6]) -> bool {
        self.unanswered = self.unanswered.saturating_sub(1);
        if self.fresh {
            self.second = (payload != self.payload).then_some(*frame).or(self.second);
            return false;
        }
        (self.fresh, self.payload, self.wrong_length) = (true, payload, None);
        true
    }

    /// To be called once before each SYNC. Returns the fault of a drive that gives two answers to a SYNC.
    /// `missed_max` may be missed in a row; all of them if the drive `may_be_silent`.
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

    /// The fault of a drive whose positions may be too old.
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
