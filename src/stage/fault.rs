//! Why the stage stopped, and why it refuses a command.

use std::time::Duration;

use super::{Axis, BringUpError, DriveFlag, LimitError};
use crate::canopen::cia402::Statusword;
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::nmt::NmtState;
use crate::canopen::{Frame, NodeId};

/// What stopped the stage. After any of these it never moves again: a new run needs a new stage.
///
/// In the variants, the axis is that of the drive concerned, the statusword is the last one that the
/// drive sent, and the duration is the time limit that was exceeded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum StageFault {
    /// A drive could not be brought up.
    #[error("node {1} ({0}): {2}")]
    BringUp(Axis, NodeId, BringUpError),
    /// A drive did not reach Operation Enabled.
    #[error(
        "{0}: not in operation enabled within {ms} ms ({heard}), check power stage, enable input and brake",
        ms = .2.as_millis(),
        heard = .1.map_or("no TPDO1 was heard".to_string(), |word| format!("statusword {word}"))
    )]
    NotEnabled(Axis, Option<Statusword>, Duration),
    /// The axis stands outside its soft limits; the drive was not enabled.
    #[error(
        "cannot start: the axis stands outside its limits: {0}; move it back, or correct its \
         limits or zero"
    )]
    StandsOutside(LimitError),
    /// Another master commands the drives: the kind of frame that it sent, and the frame.
    #[error(
        "another master on the bus: {0} ({1}); stop it, or give it other nodes: two masters cannot \
         share an axis"
    )]
    AnotherMaster(&'static str, Frame),
    /// For several SYNCs in a row, two different TPDO1 with the same COB-ID came after each SYNC.
    #[error(
        "{axis}: two TPDO1 that differ after each of {syncs} SYNCs in a row, the second {frame}; does \
         another node have the same ID, or does the drive answer late?"
    )]
    TwoSenders {
        /// The axis whose COB-ID it is.
        axis: Axis,
        /// The number of SYNCs in a row.
        syncs: u32,
        /// The second TPDO1 after the last of these SYNCs.
        frame: Frame,
    },
    /// A drive that was on its way to Operation Enabled went back, or never left its first state.
    #[error(
        "{0}: the drive refused to switch on (statusword {1}); check safety input, emergency stop \
         and supply, then start again"
    )]
    SwitchOnRefused(Axis, Statusword),
    /// No position of an axis arrived after this many SYNCs in a row. If both are missing, the axis is
    /// the one that has been missing for longer.
    #[error("{0}: no TPDO1 for {1} SYNCs in a row, check bus load, cable and the drive")]
    FeedbackMissing(Axis, u32),
    /// The drive reports a fault.
    #[error("{0}: drive in fault (statusword {1})")]
    DriveFault(Axis, Statusword),
    /// The drive left Operation Enabled by itself.
    #[error(
        "{0}: drive left operation enabled (statusword {1}), was an enable or limit switch opened?"
    )]
    LeftOperationEnabled(Axis, Statusword),
    /// A statusword bit that must be set while the drive is enabled is clear.
    #[error("{0}: {what}", what = lost_flag(*.1, *.2))]
    FlagLost(Axis, DriveFlag, Statusword),
    /// In an orderly end, an axis was held but did not reach standstill in time.
    #[error(
        "{0}: not seen to stand {ms} ms after its last target (statusword {1}); if it does not stop \
         now, press the emergency stop",
        ms = .2.as_millis()
    )]
    NotStanding(Axis, Statusword, Duration),
    /// In an orderly end, a drive was shut down but did not report in time that its power is off.
    #[error(
        "{0}: the drive still has power {ms} ms after shutdown (statusword {1}); if it does not stop \
         now, press the emergency stop",
        ms = .2.as_millis()
    )]
    KeepsPower(Axis, Statusword, Duration),
    /// The drive reports a following error (statusword bit 13): target minus position, mm or rad.
    #[error(
        "{0}: following error reported by the drive; target minus position is {off}",
        off = .0.shown(*.1)
    )]
    FollowingError(Axis, f64),
    /// The drive gave up looking for its home (statusword bit 13).
    #[error("{0}: homing failed (statusword {1}); check switches, method (0x6098) and speeds")]
    HomingFailed(Axis, Statusword),
    /// The drive did not complete homing in time.
    #[error(
        "{0}: not home within {s:.1} s (statusword {1}); is the switch too far, or the homing speed \
         too low?",
        s = .2.as_secs_f64()
    )]
    HomingTimeout(Axis, Statusword, Duration),
    /// The bench measured a following error beyond its limit.
    #[error(
        "{axis}: following error of {} (limit {:.3}); is the axis blocked, or the encoder lost?",
        axis.shown(*following_error), axis.in_unit(*limit).0
    )]
    NotFollowing {
        /// The axis.
        axis: Axis,
        /// Target minus position, mm or rad.
        following_error: f64,
        /// The limit, mm or rad.
        limit: f64,
    },
    /// The drive sent an emergency message.
    #[error("{0}: emergency {1}{hint}", hint = heartbeat_hint(.1))]
    Emergency(Axis, Emcy),
    /// The drive's heartbeat stopped.
    #[error("{0}: no heartbeat for {ms} ms, is the drive powered and on the bus?", ms = .1.as_millis())]
    HeartbeatLost(Axis, Duration),
    /// The drive restarted.
    #[error("{0}: boot-up message in mid-run, the drive restarted; is its supply stable?")]
    Rebooted(Axis),
    /// The node left Operational.
    #[error("{0}: NMT state {1} instead of operational, is there another master?")]
    NotOperational(Axis, NmtState),
}

fn lost_flag(flag: DriveFlag, statusword: Statusword) -> String {
    match flag {
        DriveFlag::Remote => format!(
            "the drive no longer obeys the bus (statusword {statusword}, bit 9 clear): it will \
             ignore a stop; press the emergency stop"
        ),
        DriveFlag::Voltage => format!(
            "the drive has lost its supply (statusword {statusword}, bit 4 clear), is an emergency \
             stop pressed, or a fuse blown?"
        ),
        DriveFlag::FollowsCommand => format!(
            "the drive ignores its targets (statusword {statusword}, bit 12 clear), does an input or \
             another tool hold it?"
        ),
    }
}

/// What to add to an emergency message of code 8130h (heartbeat error); empty for any other.
fn heartbeat_hint(emcy: &Emcy) -> &'static str {
    match emcy.code {
        EmcyCode::HEARTBEAT => {
            ": the drive missed the bench's heartbeat; is the bench stalled or unplugged?"
        }
        _ => "",
    }
}

/// Why a set-point was refused. Neither axis is sent anything.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum CommandError {
    /// It breaks a limit.
    #[error(transparent)]
    Limit(#[from] LimitError),
    /// The stage is not ready yet, homing, stopping or stopped; the text says which ("while it stops").
    #[error("the stage takes no set-points {0}")]
    NotReady(&'static str),
    /// The axis is not in homing mode, or the stage is not ready.
    #[error("the stage is not ready to home")]
    NotReadyToHome,
    /// The positions at the last SYNC have not arrived. The number is that of the SYNC.
    #[error("the positions at SYNC {0} have not arrived; older ones must not be used")]
    StaleFeedback(u64),
}
