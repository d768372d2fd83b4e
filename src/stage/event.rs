//! What the stage reports to its owner.

use super::{Axis, Identity};
use crate::canopen::cia402::Statusword;
use crate::canopen::emcy::Emcy;
use crate::canopen::{Frame, ObjectAddress};
use crate::units::Time;

/// Where both axes are to be at the next SYNC.
#[derive(Debug, Clone, Copy, PartialEq)]
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

/// Both axes at one SYNC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Feedback {
    /// When the SYNC went out.
    pub time: Time,
    /// Which SYNC, counted from 1.
    pub sync: u64,
    /// Where both axes were, the angle counted on over full turns.
    pub measured: SetPoint,
    /// What this SYNC made their targets.
    pub commanded: SetPoint,
}

/// How far the stage has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, derive_more::Display)]
pub enum Progress {
    /// Nothing is sent yet; another master would be heard.
    #[display("listening for another master")]
    Listening,
    /// A part of a drive's bring-up begins.
    #[display("{_0}: {_1}")]
    BringUp(Axis, &'static str),
    /// A drive lacks an optional object.
    #[display("{_0}: drive has no {_1}, skipped")]
    Skipped(Axis, ObjectAddress),
    /// A drive restarted in the middle of its bring-up, which begins anew.
    #[display("{_0}: the drive restarted, its bring-up begins anew")]
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

/// A bit of the statusword that an enabled drive is to show, and whose loss stops the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, derive_more::Display)]
#[repr(u16)]
pub enum DriveFlag {
    /// It obeys the controlword.
    #[display("bit 9 (remote)")]
    Remote = Statusword::REMOTE,
    /// Its power stage has its supply.
    #[display("bit 4 (voltage enabled)")]
    Voltage = Statusword::VOLTAGE_ENABLED,
    /// In cyclic synchronous position: it follows its targets.
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
    /// Not from a drive of this stage.
    #[display("frame from elsewhere")]
    Foreign,
    /// With an identifier under which the bench alone sends: SYNC, NMT, its heartbeat, RPDO1 and
    /// SDO requests of its drives.
    #[display("frame under an identifier of the bench's own, is there another master?")]
    OwnIdentifier,
    /// From a drive, but of the wrong length.
    #[display("frame of the wrong length")]
    WrongLength,
    /// A TPDO1 before the first SYNC, or a second one after the same SYNC; an SDO answer without a request.
    #[display("position without a SYNC, or answer without a question")]
    Unexpected,
}

/// How often something went wrong that stops nothing by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Frames without effect, for each [`Ignored`] in the order of its variants.
    pub ignored: [u64; 4],
    /// SYNCs that went out without both positions coming back.
    pub feedback_missed: u64,
    /// SYNC periods skipped because the bench was late.
    pub syncs_skipped: u64,
}

/// What happened.
#[derive(Debug, Clone, PartialEq)]
pub enum StageEvent {
    /// Something for the operator to follow.
    Progress(Progress),
    /// Who a drive is.
    Identity(Axis, Identity),
    /// Where both axes stand, before they have power: the moment to refuse a goal
    /// ([`Stage::check_goal`](super::Stage::check_goal)).
    Located(SetPoint),
    /// Both drives follow their targets: set-points are taken.
    Ready,
    /// Both axes at a SYNC.
    Feedback(Feedback),
    /// An axis has found its home.
    Homed {
        /// Which.
        axis: Axis,
        /// Where it stands now, mm or rad.
        position: f64,
    },
    /// A drive's emergency message, error or reset. The same one again and again is told at the
    /// 1st, 2nd, 4th, 8th … time.
    Emergency(Axis, Emcy),
    /// A limit inside the drive has begun to hold (statusword bit 11): it goes no further, whatever
    /// its target.
    InternalLimit(Axis),
    /// A drive that is enabled and ready has not set this bit of its statusword: its loss could not
    /// be noticed. Told once a bit.
    NotShown(Axis, DriveFlag),
    /// An enabled drive warns (statusword bit 7), and goes on. Told at the 1st, 2nd, 4th, 8th … time.
    Warns {
        /// Whose drive.
        axis: Axis,
        /// As heard.
        statusword: Statusword,
        /// How often it has begun to.
        count: u64,
    },
    /// A flood begins: so many frames that are no part of the cycle or of the bring-up came within 100 ms.
    Flood(u64),
    /// A frame had no effect. Told at the 1st, 2nd, 4th, 8th … of a kind.
    Ignored {
        /// Why.
        why: Ignored,
        /// How many so far.
        count: u64,
        /// The newest.
        frame: Frame,
    },
    /// The bench was late: this many SYNC periods were skipped.
    SyncSkipped(u64),
    /// The stage stops for this reason. It never moves again: a new run needs a new stage.
    Fault(String),
    /// The nodes were told to take power off and to go to Pre-operational, SYNC has ended. The last
    /// event but for emergency messages.
    Stopped {
        /// Both axes were seen to stand before. False after a time-out, and when bring-up ended
        /// early.
        standing: bool,
        /// Both drives have said that they are without power.
        off: bool,
    },
}

/// What the stage wants done.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// Send this frame now.
    Transmit(Frame),
    /// Know this.
    Event(StageEvent),
}
