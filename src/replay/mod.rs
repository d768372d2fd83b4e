//! Replays a recorded run.
//!
//! The configuration and the inputs determine everything that a session does. [`replay`] gives a new session
//! the recorded inputs, from `inputs.log`, `can.log` and `tracker.ndjson`, and compares its output with the
//! record, as text: every row of `steps.csv`, every frame sent, every sample with its acceptance or refusal,
//! and the outcome. The truth is copied, not compared: the emulator computed it.
//!
//! A what-if observer shows what another observer would have estimated. It runs as a shadow of the recorded
//! one, which steers and gates as it did in the run.

mod comparison;
mod inputs;
mod machine;
mod recorded;

pub use machine::{Replayed, Truncation, replay, replay_to};
pub use recorded::Recorded;
