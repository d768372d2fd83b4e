//! Where a record ends that was cut.

use super::difference::Difference;
use crate::units::Time;

/// The files of a record that was cut end at different times: those of a killed bench within 0.2 s,
/// those of a machine that lost power within a second and a quarter more, in which each is put on
/// the disk in its turn. One that ends earlier than this was not cut with the others.
const APART_MAX_S: f64 = 1.5;

/// Where a record ends that was cut.
#[derive(Debug, Clone, PartialEq)]
pub struct Cut {
    /// Its last entry, in whichever file.
    pub end: Time,
    /// The file that ends first.
    pub file: &'static str,
    /// The time of what that file does not hold any more.
    pub file_end: Time,
    /// Rows of `steps.csv` that come after what the session could be given.
    pub rows_beyond: usize,
}

impl Cut {
    /// How long before the record's end the first file's is, s.
    pub fn apart_s(&self) -> f64 {
        self.end.seconds_after(self.file_end).max(0.0)
    }

    /// The difference it makes that a file lacks more than a cut takes.
    pub(super) fn difference(&self) -> Option<Difference> {
        let (file, apart_s) = (self.file, self.apart_s());
        (apart_s > APART_MAX_S).then_some(Difference::Ends { file, apart_s, limit_s: APART_MAX_S })
    }
}
