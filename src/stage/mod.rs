//! The master of the two-axis stage, sans-IO.
//!
//! # Contract
//! Hand a [`Stage`] every frame received ([`Stage::handle_frame`]) and the time at its
//! [`Stage::deadline`] ([`Stage::handle_timeout`]). After each, drain [`Stage::poll`] to `None`, and send
//! the frames in order and at once. Before you hand in the time, hand in every frame that was received
//! before it: a late bench would otherwise take frames that it has not read for missing ones. The stage
//! touches no clock and no socket.
//!
//! The stage listens first, for as long as a heartbeat may be late. If another master commands these
//! drives, the stage ends without sending anything. If one begins to do so later, that is a fault.
//!
//! The stage brings both drives up over SDO and reads every object back. Then it starts SYNC, enables both
//! drives together, each with its position as its target, and reports [`StageEvent::Ready`]. From then on it
//! sends RPDO1 to both axes (controlword and target) and SYNC, at absolute deadlines. If it is late by whole
//! periods it skips and counts them; it never sends a burst. It awaits both TPDO1 (statusword and position,
//! sampled at that SYNC) until the next deadline. When both have come, it reports one [`Feedback`] at once.
//!
//! [`Stage::command`] sets the targets of both axes for the next SYNC. It refuses them unless the stage is
//! ready, both positions at the last SYNC are known, and both targets are within the soft limits. Without a
//! command the axes are held.
//!
//! A [`StageEvent::Fault`] is reported once and quick-stops both axes. SYNC continues until both are seen to
//! stand, or until a timeout. Then power is taken off, the nodes are sent to Pre-operational and
//! [`StageEvent::Stopped`] is reported. A drive that does not obey is sent to Pre-operational and commanded again
//! by SDO, at once and every 100 ms.
//! If an orderly end ([`Stage::disable`]) times out, that is such a fault, too. The stage never moves again: a
//! new run needs a new stage.
//!
//! The bench's heartbeat, which the drives monitor, begins when the listening ends and lasts as long as the
//! stage. When the stage ends, drives known to be without power are configured to monitor it no longer.
//!
//! Frames of the wrong length, from other nodes, or without a SYNC are counted and have no other effect. A
//! TPDO carries no timestamp, so one that comes after the next SYNC is taken for the answer to that SYNC. The
//! real answer, which follows, is then ignored and counted. If the two differ after several SYNCs in a row,
//! there is a second sender, which is a fault. Before power both answers to a SYNC must come before the next SYNC
//! is due. Later a late answer cannot be distinguished from a lost one, so unanswered SYNCs are counted: too many
//! are a fault.

mod answers;
mod axis;
mod bring_up;
mod config;
mod cycle;
mod dialogue;
mod drive;
mod event;
mod flood;
mod homing;
mod limits;
mod machine;
mod plan;
mod quick_stop;
mod scale;
mod silence;
mod standstill;
mod status;
mod supervision;
#[cfg(test)]
mod tests;

pub use axis::{Axis, AxisUse, PerAxis};
pub use bring_up::{Identity, SOFTWARE_LIMITS, why_needed};
pub use config::{AxisConfig, BusConfig, PowerConfig, RawSdo, StageConfig};
pub use dialogue::Dialogue;
pub use event::{
    Counters, DriveFlag, DriveReport, Feedback, Ignored, Output, SetPoint, StageEvent,
    StageProgress, may_have_power,
};
pub use homing::{HomingConfig, Reference};
pub use limits::{AxisLimits, Commanded, LimitCheck};
pub use machine::Stage;
pub use quick_stop::QuickStop;
pub use scale::{CountsRatio, Scale, Sign, Unwrapper};
pub use status::{AxisStatus, Reset, StatusReader};
