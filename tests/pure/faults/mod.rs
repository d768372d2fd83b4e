//! What can go wrong in a run, one test a fault: it is detected by name and in time, both axes
//! end in a safe state, nothing is commanded afterwards, and the record is whole.
//!
//! `stop` checks what every fault has in common. Times and travels are of virtual time
//! and of the true axes, at 10 ms SYNC and the default configuration; `docs/hazards.md` lists
//! them, and each test compares its row.

mod bus;
mod contradictions;
mod determinism;
mod drives;
mod hostile;
mod law;
mod limits;
mod operations;
mod operator;
mod scripted;
mod stream;
mod target;
mod tracker;
mod tracker_tolerated;
