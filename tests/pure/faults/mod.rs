//! What can go wrong in a run, one test for each fault: the bench detects it in time and reports it, both axes end
//! in a safe state, nothing is commanded afterwards, and the record is complete.
//!
//! A test whose name is only that of a fault compares its measurements with its row in `docs/hazards.md`. `stop`
//! checks what all faults have in common. Times are virtual; travels are those of the true axes, at 10 ms SYNC and
//! with the default configuration.

mod bus;
mod contradictions;
mod determinism;
mod drives;
mod hostile;
mod law;
mod limits;
mod needle;
mod operations;
mod operator;
mod scripted;
mod stream;
mod target;
mod tracker;
mod tracker_tolerated;
