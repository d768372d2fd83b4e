//! A drive's answers to SYNC: its TPDO1, one after each.

use crate::canopen::Frame;

/// A drive may owe so many answers more than it may leave out in a row …
const OWED_MAX: u32 = 2;
/// … and one of them is forgotten every so many SYNCs: a frame that is lost now and then is no fault.
const FORGOTTEN_SYNCS: u64 = 1000;

/// What has come of one drive's answers.
#[derive(Debug, Default)]
pub(super) struct Answers {
    /// The answer to the last SYNC has come.
    pub(super) fresh: bool,
    /// SYNCs in a row without an answer.
    pub(super) missed_in_a_row: u32,
    /// The length, bytes, of a TPDO1 that came since the last one that was taken.
    pub(super) wrong_length: Option<usize>,
    /// SYNCs that were sent, less the TPDO1 that came: answers that were lost, or that are late by so many SYNCs.
    owed: u32,
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
        self.owed += 1;
        self.owed -= u32::from(sync.is_multiple_of(FORGOTTEN_SYNCS));
    }

    /// Takes a TPDO1 with this payload. False if the last SYNC has had its answer: the payload must not be used then.
    pub(super) fn take(&mut self, frame: &Frame, payload: [u8; 6]) -> bool {
        self.owed = self.owed.saturating_sub(1);
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
        self.owed = if may_be_silent { 0 } else { self.owed };
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
    pub(super) fn fault_of_owed(&self, missed_max: u32) -> Option<String> {
        let (owed, owed_max) = (self.owed, missed_max + OWED_MAX);
        (owed > owed_max).then(|| {
            format!(
                "{owed} TPDO1 are lost or late (limit {owed_max}): its positions may be {owed} SYNCs old; check bus \
                 load, cable, and what passes frames on"
            )
        })
    }
}
