//! The master of the two-axis stage, sans-IO.
//!
//! # Contract
//! Hand a [`Stage`] every frame received ([`Stage::handle_frame`]) and the time at its
//! [`Stage::deadline`] ([`Stage::handle_timeout`]); after each, drain [`Stage::poll`] to `None`,
//! sending the frames in order and at once. Hand in all that was received before the time that
//! has come after it: a bench that was held up must not take frames it did not read for frames
//! that did not come. The stage touches no clock and no socket.
//!
//! It listens first, for as long as a heartbeat may be late. If another master commands these drives, it
//! ends without sending anything; if one begins to do so later, it stops with a fault.
//!
//! It brings both drives up over SDO, every object read back; starts SYNC; enables both drives
//! together with their targets where they stand; and says [`StageEvent::Ready`]. From then on,
//! at each SYNC deadline: RPDO1 of both axes (controlword and target), then SYNC, on absolute
//! deadlines. When it is late by whole periods it skips and counts them; it never sends a burst.
//! Both TPDO1 (statusword and position, latched at that SYNC) are awaited until the next
//! deadline; when both are in, one [`Feedback`] is given at once.
//!
//! [`Stage::command`] takes the targets for the next SYNC, for both axes or neither: only while
//! ready, only while the positions at the last SYNC are known, only within the soft limits.
//! Without a command the axes are held.
//!
//! Any [`StageEvent::Fault`] is reported once and quick-stops both axes; SYNC goes on until they are seen to
//! stand or a time-out, then power is taken off, the nodes are sent to Pre-operational and
//! [`StageEvent::Stopped`] is reported. A drive that does not obey is commanded again by SDO every 100 ms. An
//! orderly end ([`Stage::disable`]) whose time is over is such a fault, too. The stage never moves
//! again: a new run needs a new stage.
//! The bench's own heartbeat, which the drives watch, runs from the end of that silence to the last;
//! drives known to be without power are then configured to watch it no more.
//!
//! Frames of the wrong length, from elsewhere, or without a SYNC have no effect but a count. A
//! TPDO carries no stamp, so one that comes late, after the next SYNC, is taken for that SYNC's; its
//! successor is then the one that is counted, and one that says something else, SYNC after SYNC, is
//! a second sender, which is a fault. A drive whose every answer is late by a whole
//! period from some SYNC on cannot be told from one that is on time.

mod bring_up;
mod config;
mod cycle;
mod dialogue;
mod drive;
mod event;
mod flood;
mod halt;
mod homing;
mod limits;
mod machine;
mod plan;
mod scale;
mod standstill;
mod status;
mod supervision;
#[cfg(test)]
mod tests;

pub use bring_up::{FoundFault, Identity};
pub use config::{Axis, AxisConfig, BusConfig, PerAxis, PowerConfig, RawSdo, StageConfig};
pub use dialogue::Dialogue;
pub use drive::{DriveReport, may_have_power};
pub use event::{Counters, DriveFlag, Feedback, Ignored, Output, Progress, SetPoint, StageEvent};
pub use halt::Halt;
pub use homing::{HomingConfig, Reference};
pub use limits::{AxisLimits, Commanded, LimitCheck};
pub use machine::Stage;
pub use scale::{CountsRatio, Scale, Sign, Unwrapper};
pub use status::{AxisStatus, Reset, StatusReader};
