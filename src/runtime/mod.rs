//! Runs a session: connects it to clocks, threads and sockets.
//!
//! [`run_virtual`] connects it to the emulated stage in virtual time, on request at a [`Pace`]; [`run_live`]
//! connects it to a CAN bus and a tracker in real time. Both use one loop, which only moves inputs and outputs:
//! every decision is the session's.

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

pub use dialogue::{BusErrors, talk_live, talk_virtual};
pub use interrupt::Interrupt;
pub use live::run_live;
pub use realtime::{RealTime, enter_real_time};
pub use recording::{Describe, RecordedRun, complete_record, make_recording};
pub use sink::{Holds, Operator, RunReport, Sink, gates_to_json};
pub use stage_server::{TipServer, serve_stage};
pub use study::Study;
pub use timing::Clock;
pub use virtual_time::{DriveOutcome, EmulationReport, Moment, Pace, TipSource, run_virtual};
