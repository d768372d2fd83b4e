//! The bring-up of one drive over SDO: when its script begins, restarts and ends, and how the script
//! reads and writes. The steps are in [`plan`](super::plan).

use std::cell::Cell;
use std::rc::Rc;
use std::time::Duration;

use super::bring_up_error::{BringUpError, FoundFault, is_absent};
use super::dialogue::{Conversation, Sdo};
use super::{Axis, AxisConfig, BringUpPart, Progress, StageConfig, StageEvent};
use crate::canopen::ObjectAddress;
use crate::canopen::sdo::{SdoError, SdoReply, SdoRequest, SdoValue};
use crate::units::Time;

/// Bytes of an expedited answer that does not give its size.
const UNSIZED: usize = 4;
/// Interval between two readings of an object that the drive changes by itself.
const POLL_PERIOD: Duration = Duration::from_millis(10);

/// Brings up one drive.
#[derive(Debug)]
pub(super) struct BringUp {
    script: Script,
    /// Gives where the axis stood (0x6064), or why the drive could not be brought up.
    pub(super) conversation: Conversation<Result<i32, BringUpError>>,
    restarts_left: u32,
}

/// How far a bring-up has come.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SoFar {
    pub(super) part: Option<BringUpPart>,
    /// The drive is known to be the one of the configuration.
    pub(super) identified: bool,
    /// Its power is off, and its statusword was read: any fault from here on is a new one.
    pub(super) disarmed: bool,
    /// The fault that it was in when its statusword was read.
    pub(super) found_in_fault: Option<FoundFault>,
}

impl BringUp {
    /// The bring-up of `axis`, to be moved or to be `homed`.
    pub(super) fn new(config: &StageConfig, axis: Axis, homed: bool, now: Time) -> Self {
        let sdo = Sdo::new(config, axis);
        let so_far = Rc::new(Cell::new(SoFar::default()));
        let script = Script { axis, homed, config: config.clone(), sdo, so_far };
        BringUp {
            conversation: Conversation::begin(&script.sdo, now, script.clone().run()),
            script,
            restarts_left: config.boot_attempts.saturating_sub(1),
        }
    }

    /// Takes a boot-up message. A drive that has not answered yet is expected to send one. Later it means
    /// that the drive has lost what was written: its bring-up starts again, a limited number of times.
    pub(super) fn handle_boot_up(&mut self, now: Time) {
        match self.so_far().part {
            Some(BringUpPart::Find) | None => {}
            Some(_) if self.restarts_left > 0 => {
                self.restarts_left -= 1;
                self.script.so_far.take();
                self.script.tell(Progress::Restarted(self.script.axis));
                let script = self.script.clone();
                self.conversation = Conversation::begin(&self.script.sdo, now, script.run());
            }
            Some(part) => self.conversation.end(Err(BringUpError::Rebooted(part))),
        }
    }

    pub(super) fn so_far(&self) -> SoFar {
        self.script.so_far.get()
    }

    /// The drive may have been told to watch the bench; its power was taken off before.
    pub(super) fn may_be_supervised(&self) -> bool {
        self.so_far().part >= Some(BringUpPart::Supervise)
    }
}

/// An object, and whether a drive may lack it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Object {
    address: ObjectAddress,
    is_optional: bool,
}

impl From<ObjectAddress> for Object {
    fn from(address: ObjectAddress) -> Self {
        Object { address, is_optional: false }
    }
}

/// For objects that CiA leaves to the manufacturer.
pub(super) fn optional(address: ObjectAddress) -> Object {
    Object { address, is_optional: true }
}

/// What the steps of a bring-up use. An object that the configuration lists as optional is skipped if the
/// drive lacks it, as an [`optional`] one is.
#[derive(Debug, Clone)]
pub(super) struct Script {
    pub(super) axis: Axis,
    /// The axis is brought up to be homed.
    pub(super) homed: bool,
    pub(super) config: StageConfig,
    pub(super) sdo: Sdo,
    so_far: Rc<Cell<SoFar>>,
}

impl Script {
    pub(super) fn drive(&self) -> &AxisConfig {
        self.config.axis(self.axis)
    }

    pub(super) fn note(&self, change: impl FnOnce(&mut SoFar)) {
        let mut so_far = self.so_far.get();
        change(&mut so_far);
        self.so_far.set(so_far);
    }

    pub(super) fn begin(&self, part: BringUpPart) {
        self.note(|so_far| so_far.part = Some(part));
        self.tell(Progress::BringUp(self.axis, part));
    }

    fn tell(&self, progress: Progress) {
        self.sdo.tell(StageEvent::Progress(progress));
    }

    /// The drive's answer to `request`; `None` if it lacks an object that it may lack.
    pub(super) fn judge(
        &self,
        request: SdoRequest,
        is_optional: bool,
        answer: Result<SdoReply, SdoError>,
    ) -> Result<Option<SdoReply>, BringUpError> {
        let object = request.object();
        let may_lack = is_optional || self.drive().optional_objects.contains(&object);
        let attempts = self.config.sdo_attempts;
        match (answer, request) {
            (Ok(reply), _) => Ok(Some(reply)),
            (Err(SdoError::Aborted(code)), _) if may_lack && is_absent(code) => {
                self.tell(Progress::Skipped(self.axis, object));
                Ok(None)
            }
            (Err(SdoError::Aborted(code)), SdoRequest::Download(_, value)) => {
                Err(BringUpError::WriteRefused(object, value, code))
            }
            (Err(SdoError::Aborted(code)), _) => Err(BringUpError::ReadRefused(object, code)),
            (Err(SdoError::Timeout(timeout)), _) => {
                Err(BringUpError::NoReply { object, timeout, attempts })
            }
            (Err(error), _) => Err(BringUpError::Sdo(object, error)),
        }
    }

    async fn ask(
        &self,
        request: SdoRequest,
        is_optional: bool,
    ) -> Result<Option<SdoReply>, BringUpError> {
        self.judge(request, is_optional, self.sdo.ask(request).await)
    }

    /// Reads `object`; `None` if the drive lacks an object that it may lack.
    pub(super) async fn read(
        &self,
        object: impl Into<Object>,
    ) -> Result<Option<SdoValue>, BringUpError> {
        let Object { address, is_optional } = object.into();
        match self.ask(SdoRequest::Upload(address), is_optional).await? {
            Some(SdoReply::Uploaded(value)) => Ok(Some(value)),
            _ => Ok(None),
        }
    }

    /// Writes `value` to `object`, which does not read as written.
    pub(super) async fn command(
        &self,
        object: ObjectAddress,
        value: SdoValue,
    ) -> Result<(), BringUpError> {
        self.ask(SdoRequest::Download(object, value), false).await.map(drop)
    }

    /// Writes `value` to `object`, and reads it back.
    pub(super) async fn write(
        &self,
        object: impl Into<Object>,
        value: impl Into<SdoValue>,
    ) -> Result<(), BringUpError> {
        let (object, value) = (object.into(), value.into());
        let request = SdoRequest::Download(object.address, value);
        if self.ask(request, object.is_optional).await?.is_none() {
            return Ok(());
        }
        match self.read(object).await? {
            Some(received) => check(object.address, value, received),
            None => Ok(()),
        }
    }

    /// Reads `object` until it has this value.
    pub(super) async fn wait_for(
        &self,
        object: ObjectAddress,
        value: SdoValue,
    ) -> Result<(), BringUpError> {
        let patience = self.config.sdo_timeout.saturating_mul(self.config.sdo_attempts);
        let give_up = self.sdo.now() + patience;
        while let Some(received) = self.read(object).await? {
            let checked = check(object, value, received);
            if checked.is_ok() || self.sdo.now() >= give_up {
                return checked;
            }
            self.sdo.pause(POLL_PERIOD).await;
        }
        Ok(())
    }
}

/// Checks that `received` is what `expected` reads as. An expedited answer may leave out how many of its
/// four bytes are the object's (CiA 301, 7.2.4.3.6); the others are then zero. Bit 30 of a PDO's COB-ID
/// (remote requests) is fixed in many drives and of no consequence here.
fn check(
    object: ObjectAddress,
    expected: SdoValue,
    received: SdoValue,
) -> Result<(), BringUpError> {
    let is_pdo_cob_id =
        matches!(object.index, 0x1400..=0x15ff | 0x1800..=0x19ff) && object.subindex == 1;
    let ignored = if is_pdo_cob_id { 1 << 30 } else { 0 };
    let length = received.as_bytes().len();
    let fits = length == expected.as_bytes().len() || length == UNSIZED;
    match fits && (expected.to_u32() ^ received.to_u32()) & !ignored == 0 {
        true => Ok(()),
        false => Err(BringUpError::Mismatch { object, expected, received }),
    }
}
