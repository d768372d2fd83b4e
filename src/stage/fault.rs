//! Why the stage stopped, and why it takes no command.

use std::time::Duration;

use super::{Axis, BringUpError, DriveFlag, LimitError};
use crate::canopen::Frame;
use crate::canopen::cia402::Statusword;
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::nmt::NmtState;

/// What stopped the stage. After any of these it never moves again: a new run needs a new stage.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum StageFault {
    /// A drive could not be brought up.
    #[error(transparent)]
    BringUp(#[from] BringUpError),
    /// A drive did not reach Operation Enabled.
    #[error(
        "{axis}: not in operation enabled within {} ms ({}), check power stage, enable input and brake",
        within.as_millis(),
        statusword.map_or("no TPDO1 was heard".to_string(), |word| format!("statusword {word}"))
    )]
    NotEnabled {
        /// Whose drive.
        axis: Axis,
        /// As last heard.
        statusword: Option<Statusword>,
        /// How long was waited.
        within: Duration,
    },
    /// The axis stands where it may not be; the drive was not enabled.
    #[error(
        "cannot start, the axis stands out of its limits: {0}; move it back, or set its limits and zero"
    )]
    StandsOutside(LimitError),
    /// Somebody else commands the drives.
    #[error(
        "another master on the bus: {word} ({frame}); stop it, or give it other nodes: two masters \
         cannot share an axis"
    )]
    AnotherMaster {
        /// What the frame is.
        word: &'static str,
        /// The frame.
        frame: Frame,
    },
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
        "{axis}: the drive is not let on (statusword {statusword}), is its safety input open, its \
         emergency stop pressed, its supply off? set them right, then begin anew"
    )]
    NotLetOn {
        /// Whose drive.
        axis: Axis,
        /// As heard.
        statusword: Statusword,
    },
    /// The position of an axis did not come after a SYNC, again and again.
    #[error("{axis}: no TPDO1 for {syncs} SYNCs in a row, check bus load, cable and the drive")]
    FeedbackMissing {
        /// The axis not heard for longer.
        axis: Axis,
        /// How many SYNCs.
        syncs: u32,
    },
    /// The drive reports a fault.
    #[error("{axis}: drive in fault (statusword {statusword})")]
    DriveFault {
        /// Whose drive.
        axis: Axis,
        /// As heard.
        statusword: Statusword,
    },
    /// The drive left Operation Enabled by itself.
    #[error(
        "{axis}: drive left operation enabled (statusword {statusword}), was an enable or limit switch opened?"
    )]
    LeftOperationEnabled {
        /// Whose drive.
        axis: Axis,
        /// As heard.
        statusword: Statusword,
    },
    /// An enabled drive no longer shows a bit of its statusword.
    #[error("{axis}: {}", lost(*flag, *statusword))]
    FlagLost {
        /// Whose drive.
        axis: Axis,
        /// Which bit.
        flag: DriveFlag,
        /// As heard.
        statusword: Statusword,
    },
    /// An axis was held in order to end, and did not come to stand.
    #[error(
        "{axis}: not seen to stand {} ms after its last target (statusword {statusword}); if it does \
         not stop now, press the emergency stop",
        within.as_millis()
    )]
    NotStanding {
        /// Whose drive.
        axis: Axis,
        /// As last heard.
        statusword: Statusword,
        /// The time allowed.
        within: Duration,
    },
    /// A drive was shut down in order to end, and did not say that its power is off.
    #[error(
        "{axis}: the drive still has power {} ms after shutdown (statusword {statusword}); if it does \
         not stop now, press the emergency stop",
        within.as_millis()
    )]
    KeepsPower {
        /// Whose drive.
        axis: Axis,
        /// As last heard.
        statusword: Statusword,
        /// The time allowed.
        within: Duration,
    },
    /// The drive reports that the axis does not follow (statusword bit 13).
    #[error(
        "{axis}: following error reported by the drive, {following_error:.3} {} behind its target",
        axis.unit()
    )]
    FollowingError {
        /// Whose drive.
        axis: Axis,
        /// Target less position, mm or rad.
        following_error: f64,
    },
    /// The drive gave up looking for its home (statusword bit 13).
    #[error(
        "{axis}: homing failed (statusword {statusword}); check switches, method (0x6098) and speeds"
    )]
    HomingFailed {
        /// Whose drive.
        axis: Axis,
        /// As heard.
        statusword: Statusword,
    },
    /// The drive has not found its home in time.
    #[error(
        "{axis}: not home within {:.1} s (statusword {statusword}), is the switch far, or the homing slow?",
        within.as_secs_f64()
    )]
    HomingTimeout {
        /// Whose drive.
        axis: Axis,
        /// The time allowed.
        within: Duration,
        /// As heard last.
        statusword: Statusword,
    },
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
    #[error("{axis}: emergency {emcy}{}", missed_bench(emcy))]
    Emergency {
        /// Whose drive.
        axis: Axis,
        /// The message.
        emcy: Emcy,
    },
    /// The drive's heartbeat stopped.
    #[error("{axis}: no heartbeat for {} ms, is the drive powered and on the bus?", within.as_millis())]
    HeartbeatLost {
        /// Whose drive.
        axis: Axis,
        /// The time allowed.
        within: Duration,
    },
    /// The drive restarted.
    #[error("{axis}: boot-up message in mid-run, the drive restarted; is its supply stable?")]
    Rebooted {
        /// Whose drive.
        axis: Axis,
    },
    /// The node left Operational.
    #[error("{axis}: NMT state {state} instead of operational, is there another master?")]
    NotOperational {
        /// Whose drive.
        axis: Axis,
        /// As heard.
        state: NmtState,
    },
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
    /// The positions at the last SYNC are not known.
    #[error("the positions at SYNC {sync} have not come: no set-point is taken on older ones")]
    StaleFeedback {
        /// The last SYNC, counted from 1.
        sync: u64,
    },
}
