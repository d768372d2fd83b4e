//! The outputs of the stage: frames to send, and events.

use super::{Axis, Identity};
use crate::canopen::cia402::{DriveState, Statusword};
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::{Frame, ObjectAddress};
use crate::units::Time;
use std::time::Duration;

/// Where both axes are to be at the next SYNC.
#[derive(Debug, Clone, Copy, PartialEq, derive_more::Add, derive_more::Sub, derive_more::Mul)]
pub struct SetPoint {
    /// Depth.
    pub insertion_mm: f64,
    /// Angle, counted on over full turns.
    pub rotation_rad: f64,
}

impl SetPoint {
    /// Where `axis` is to be, mm or rad.
    pub fn along(&self, axis: Axis) -> f64 {
        match axis {
            Axis::Insertion => self.insertion_mm,
            Axis::Rotation => self.rotation_rad,
        }
    }
}

/// A drive's last state and error.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DriveReport {
    /// Its state; `None` before its first statusword, or if the profile does not define it.
    pub state: Option<DriveState>,
    /// The last error that it reported, unless it has reported its end since.
    pub error: Option<EmcyCode>,
    /// It has restarted since its bring-up, and may count its position from another zero.
    pub restarted: bool,
}

impl DriveReport {
    /// True if the drive has said that its motor may have power.
    pub fn says_power(&self) -> bool {
        self.state.is_some_and(DriveState::may_have_power)
    }
}

/// Whether the motor may have power in `state`, which may be undefined or not known.
pub fn may_have_power(state: Option<DriveState>) -> bool {
    state.is_none_or(DriveState::may_have_power)
}

/// Both axes at one SYNC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Feedback {
    /// When the SYNC went out.
    pub time: Time,
    /// The number of the SYNC, counted from 1.
    pub sync: u64,
    /// Where both axes were, the angle counted on over full turns.
    pub measured: SetPoint,
    /// The targets that took effect at this SYNC.
    pub commanded: SetPoint,
}

/// How far the stage has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, derive_more::Display)]
pub enum StageProgress {
    /// The stage sends nothing yet, and listens for another master.
    #[display("listening for another master")]
    Listening,
    /// A part of a drive's bring-up begins.
    #[display("{_0}: {_1}")]
    BringUp(Axis, &'static str),
    /// A drive lacks an optional object.
    #[display("{_0}: drive has no {_1}, skipped")]
    Skipped(Axis, ObjectAddress),
    /// A drive restarted in the middle of its bring-up, which begins again.
    #[display("{_0}: the drive restarted, its bring-up begins again")]
    Restarted(Axis),
    /// Both drives are configured; SYNC runs, and they have no power.
    #[display("both drives are configured, without power")]
    Standby,
    /// Both drives are being enabled.
    #[display("enabling both axes")]
    Enabling,
    /// The axes are held, or quick-stopped, until they stand.
    #[display("stopping both axes")]
    Stopping,
    /// The axes are losing power.
    #[display("taking power off both axes")]
    Disabling,
}

/// A bit of the statusword that an enabled drive must show, and whose loss stops the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, derive_more::Display)]
#[repr(u16)]
pub enum DriveFlag {
    /// The drive obeys the controlword.
    #[display("bit 9 (remote)")]
    Remote = Statusword::REMOTE,
    /// The power stage has its supply.
    #[display("bit 4 (voltage enabled)")]
    Voltage = Statusword::VOLTAGE_ENABLED,
    /// In cyclic synchronous position: the drive follows its targets.
    #[display("bit 12 (drive follows command)")]
    FollowsCommand = Statusword::FOLLOWS_COMMAND,
}

impl DriveFlag {
    pub(super) const ALL: [DriveFlag; 3] =
        [DriveFlag::Remote, DriveFlag::Voltage, DriveFlag::FollowsCommand];
}

/// Why a frame had no effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, derive_more::Display)]
pub enum Ignored {
    /// It is not from a drive of this stage.
    #[display("frame from elsewhere")]
    Foreign,
    /// It has an identifier that only the bench sends: SYNC, NMT, the bench's heartbeat, RPDO1 and SDO requests
    /// of its drives.
    #[display("frame under an identifier of the bench's own, is there another master?")]
    OwnIdentifier,
    /// It is from a drive, but has the wrong length.
    #[display("frame of the wrong length")]
    WrongLength,
    /// It is a TPDO1 before the first SYNC, or a second one after the same SYNC, or an SDO answer without a
    /// request.
    #[display("position without a SYNC, or answer without a question")]
    Unexpected,
}

/// Counts of irregularities that do not stop the stage by themselves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Frames without effect, for each [`Ignored`] in the order of its variants.
    pub ignored: [u64; 4],
    /// SYNCs that went out without both positions coming back.
    pub feedback_missed: u64,
    /// SYNC periods skipped because the bench was late.
    pub syncs_skipped: u64,
    /// The longest delay of a SYNC after it was due.
    pub sync_late_max: Duration,
}

/// An event of the stage.
#[derive(Debug, Clone, PartialEq)]
pub enum StageEvent {
    /// The stage has come this far.
    Progress(StageProgress),
    /// A drive's identity was read.
    Identity(Axis, Identity),
    /// Where both axes stand, before they have power: the moment to refuse a goal
    /// ([`Stage::check_goal`](super::Stage::check_goal)).
    Located(SetPoint),
    /// Both drives follow their targets: from now on the stage takes set-points.
    Ready,
    /// Both axes at a SYNC.
    Feedback(Feedback),
    /// An axis has found its home.
    Homed {
        /// The axis.
        axis: Axis,
        /// Where it stands now, mm or rad.
        position: f64,
    },
    /// A drive's emergency message: an error, or its end. A repeated message is reported the 1st, 2nd, 4th,
    /// 8th … time.
    Emergency(Axis, Emcy),
    /// A limit inside the drive has become active (statusword bit 11): the axis does not follow its target beyond it.
    InternalLimit(Axis),
    /// A drive has not set this bit of its statusword when the stage became ready, so its loss cannot be
    /// noticed. Reported once for each bit.
    NotShown(Axis, DriveFlag),
    /// An enabled drive has set its warning bit (statusword bit 7). Reported the 1st, 2nd, 4th, 8th … time.
    Warns {
        /// The drive's axis.
        axis: Axis,
        /// The statusword with this bit.
        statusword: Statusword,
        /// How often the drive has set it.
        count: u64,
    },
    /// A drive was enabled although it was commanded to stop: its node is sent to Pre-operational.
    StopNotObeyed(Axis, Statusword),
    /// A flood begins: this many frames that are no part of the SYNC cycle or of the bring-up came within 100 ms.
    Flood(u64),
    /// A frame had no effect. Reported for the 1st, 2nd, 4th, 8th … of a kind.
    Ignored {
        /// Why.
        why: Ignored,
        /// How many so far.
        count: u64,
        /// The newest.
        frame: Frame,
    },
    /// The bench was late: emitted if more periods were skipped at once than ever before, and if the total has
    /// reached another power of two.
    SyncSkipped {
        /// SYNC periods skipped this time.
        periods: u64,
        /// SYNC periods skipped so far.
        total: u64,
    },
    /// The stage stops for this reason. It never moves again: a new run needs a new stage.
    Fault(String),
    /// The drives that the stage had identified were commanded to take power off and to enter Pre-operational,
    /// and SYNC has ended. No event follows except emergency messages.
    Stopped {
        /// Both axes were seen to stand before power was taken off. False after a timeout, and when bring-up
        /// ended early.
        standing: bool,
        /// Both drives have reported a state without power.
        off: bool,
    },
}

/// An output of the stage.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// A frame to send now.
    Transmit(Frame),
    /// Something that has happened.
    Event(StageEvent),
}
