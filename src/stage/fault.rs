//! Why the stage stopped, and why it takes no command.

use std::time::Duration;

use super::{Axis, BringUpError, DriveFlag, LimitError};
use crate::canopen::cia402::Statusword;
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::nmt::NmtState;
use crate::canopen::{Frame, NodeId};

/// What stopped the stage. After any of these it never moves again: a new run needs a new stage.
///
/// The axis is the one whose drive it is about; a statusword is the last that was heard of it, a
/// duration the time allowed.
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
    /// The axis stands where it may not be; the drive was not enabled.
    #[error(
        "cannot start, the axis stands out of its limits: {0}; move it back, or set its limits and zero"
    )]
    StandsOutside(LimitError),
    /// Somebody else commands the drives: what the frame is, and the frame.
    #[error(
        "another master on the bus: {0} ({1}); stop it, or give it other nodes: two masters cannot \
         share an axis"
    )]
    AnotherMaster(&'static str, Frame),
    /// Two positions that differ answer one SYNC, again and again.
    #[error(
        "{axis}: two TPDO1 that differ after each of {syncs} SYNCs in a row, the second {frame}; does \
         another node send as this one, or does the drive answer late?"
    )]
    TwoSenders {
        /// Whose identifier.
        axis: Axis,
        /// How many SYNCs.
        syncs: u32,
        /// The newest second answer.
        frame: Frame,
    },
    /// A drive that was on its way to Operation Enabled went back, or never left its first state.
    #[error(
        "{0}: the drive is not let on (statusword {1}), is its safety input open, its emergency stop \
         pressed, its supply off? set them right, then begin anew"
    )]
    NotLetOn(Axis, Statusword),
    /// The position of an axis did not come after so many SYNCs in a row. The axis is the one that was
    /// not heard for longer.
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
    /// An enabled drive no longer shows a bit of its statusword.
    #[error("{0}: {lost}", lost = lost(*.1, *.2))]
    FlagLost(Axis, DriveFlag, Statusword),
    /// An axis was held in order to end, and did not come to stand.
    #[error(
        "{0}: not seen to stand {ms} ms after its last target (statusword {1}); if it does not stop \
         now, press the emergency stop",
        ms = .2.as_millis()
    )]
    NotStanding(Axis, Statusword, Duration),
    /// A drive was shut down in order to end, and did not say that its power is off.
    #[error(
        "{0}: the drive still has power {ms} ms after shutdown (statusword {1}); if it does not stop \
         now, press the emergency stop",
        ms = .2.as_millis()
    )]
    KeepsPower(Axis, Statusword, Duration),
    /// The drive reports that the axis does not follow (statusword bit 13): target less position, mm or
    /// rad.
    #[error("{0}: following error reported by the drive, {1:.3} {unit} behind its target", unit = .0.unit())]
    FollowingError(Axis, f64),
    /// The drive gave up looking for its home (statusword bit 13).
    #[error("{0}: homing failed (statusword {1}); check switches, method (0x6098) and speeds")]
    HomingFailed(Axis, Statusword),
    /// The drive has not found its home in time.
    #[error(
        "{0}: not home within {s:.1} s (statusword {1}), is the switch far, or the homing slow?",
        s = .2.as_secs_f64()
    )]
    HomingTimeout(Axis, Statusword, Duration),
    /// The axis is not where its targets led it.
    #[error(
        "{axis}: measured {following_error:.3} {} from its target (limit {limit:.3}), is the axis blocked, or its encoder lost?",
        axis.unit()
    )]
    NotFollowing {
        /// Whose drive.
        axis: Axis,
        /// Target less position, mm or rad.
        following_error: f64,
        /// The limit, mm or rad.
        limit: f64,
    },
    /// The drive sent an emergency message.
    #[error("{0}: emergency {1}{hint}", hint = missed_bench(.1))]
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

fn lost(flag: DriveFlag, statusword: Statusword) -> String {
    match flag {
        DriveFlag::Remote => format!(
            "the drive does not obey the bus any more (statusword {statusword}, bit 9 clear): no stop \
             will be obeyed; press the emergency stop"
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

fn missed_bench(emcy: &Emcy) -> &'static str {
    match emcy.code {
        EmcyCode::HEARTBEAT => {
            ": the drive missed the bench's heartbeat; is the bench stalled or unplugged?"
        }
        _ => "",
    }
}

/// Why a set-point was refused. Nothing of it is sent, on neither axis.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum CommandError {
    /// It breaks a limit.
    #[error(transparent)]
    Limit(#[from] LimitError),
    /// The stage is not ready yet, stopping, or stopped.
    #[error("the stage takes no set-points {0}")]
    NotReady(&'static str),
    /// The axis is in another mode, or the stage is not ready to let it find its home.
    #[error("the stage is not ready to home")]
    NotReadyToHome,
    /// The positions at the last SYNC, which has this number, are not known.
    #[error("the positions at SYNC {0} have not come: no set-point is taken on older ones")]
    StaleFeedback(u64),
}
