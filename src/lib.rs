//! A hardware-in-the-loop bench for flexible bevel-tip needles.
//!
//! See `ARCHITECTURE.md` for the map and the invariants.

pub mod canopen;
pub mod geometry;
pub mod stage;
pub mod units;
