//! Clocks, threads and sockets: where a session meets the world.
//!
//! [`run_virtual`] joins it to the emulated stage in virtual time, at a [`Pace`] if asked, [`run_live`] to a
//! CAN bus and a tracker in real time. Both are one loop, which only moves inputs and outputs: every decision
//! is the session's.

mod dialogue;
mod drive;
mod interrupt;
mod live;
mod realtime;
mod recording;
mod sink;
mod stage_server;
mod study;
mod timing;
mod virtual_time;

pub use dialogue::{BusTrouble, talk_despite_errors, talk_live, talk_virtual};
pub use interrupt::Interrupt;
pub use live::run_live;
pub use realtime::{RealTime, enter_real_time};
pub use recording::{Describe, RecordedRun, complete_record, make_recording};
pub use sink::{Holds, Operator, RunReport, Sink, gates_to_json};
pub use stage_server::{TipServer, serve_stage};
pub use study::Study;
pub use timing::Clock;
pub use virtual_time::{DriveOutcome, EmulationReport, Moment, Pace, TipSource, run_virtual};
