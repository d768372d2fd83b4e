//! A hardware-in-the-loop bench for flexible bevel-tip needles.
//!
//! See `ARCHITECTURE.md` for the map and the invariants.

pub mod archive;
pub mod calibration;
pub mod canopen;
pub mod cli;
pub mod config;
pub mod control;
pub mod emulator;
pub mod geometry;
mod keys;
pub mod math;
pub mod needle;
pub mod observer;
pub mod operation;
pub mod plan;
pub mod preflight;
pub mod replay;
pub mod review;
pub mod runtime;
pub mod session;
pub mod stage;
pub mod study;
pub mod table;
pub mod telemetry;
pub mod text;
pub mod tracker;
pub mod transport;
pub mod units;
