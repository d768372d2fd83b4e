//! A recorded run, run again.
//!
//! A session's course is a function of its configuration and of what it was given. [`replay`] gives
//! the same session the same inputs, out of `inputs.log`, `can.log` and `tracker.ndjson`, and
//! compares what leaves it with the record, as text: every row of `steps.csv`, every frame sent,
//! every sample with what became of it, and the outcome. The truth alone is carried over: it is the
//! emulator's.
//!
//! Asked what another observer would have estimated, it runs that one as a shadow of the recorded
//! one, which steers and gates as it did.

mod comparison;
mod inputs;
mod machine;
mod recorded;

pub use machine::{Cut, Replayed, replay, replay_to};
pub use recorded::Recorded;
