//! The bring-up of one drive over SDO: when its script begins, restarts and ends, and how the script
//! reads and writes. The steps are in [`plan`](super::plan).

use std::cell::Cell;
use std::fmt;
use std::rc::Rc;
use std::time::Duration;

use super::dialogue::{ScriptRunner, Sdo};
use super::{Axis, AxisConfig, AxisUse, StageConfig, StageEvent, StageProgress};
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::Statusword;
use crate::canopen::emcy::EmcyCode;
use crate::canopen::object::communication::consumer_heartbeat;
use crate::canopen::sdo::{AbortCode, SdoError, SdoReply, SdoRequest, SdoValue};
use crate::units::Time;

/// A drive's identity object (0x1018).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Identity {
    /// 0x1018:01.
    pub vendor: u32,
    /// 0x1018:02.
    pub product: u32,
    /// 0x1018:03, when the drive has it.
    pub revision: Option<u32>,
    /// 0x1018:04, when the drive has it.
    pub serial: Option<u32>,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "vendor 0x{:08X}, product 0x{:08X}", self.vendor, self.product)?;
        if let Some(revision) = self.revision {
            write!(f, ", revision 0x{revision:08X}")?;
        }
        if let Some(serial) = self.serial {
            write!(f, ", serial 0x{serial:08X}")?;
        }
        Ok(())
    }
}

/// A fault that a drive was found in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FoundFault {
    /// 0x603F, when the drive has it.
    pub(super) error_code: Option<EmcyCode>,
}

/// Length of an expedited answer that does not say its size.
const UNSIZED: usize = 4;
/// Interval between two reads of an object that the drive changes by itself.
pub(super) const POLL_PERIOD: Duration = Duration::from_millis(10);

/// The bring-up of one drive.
#[derive(Debug)]
pub(super) struct BringUp {
    script: Script,
    /// Returns where the axis stood (0x6064), or why the drive could not be brought up.
    pub(super) runner: ScriptRunner<Result<i32, String>>,
    restarts_left: u8,
}

/// How far a bring-up has come.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct BringUpState {
    /// The part of the bring-up that is under way, as text for the operator.
    part: &'static str,
    /// The drive has answered.
    pub(super) found: bool,
    /// Its identity is that of the configuration.
    pub(super) identified: bool,
    /// Power is off, and the statusword was read: any fault from here on is a new one.
    pub(super) is_power_off: bool,
    /// The drive may have been configured to monitor the bench's heartbeat; its power was taken off before.
    pub(super) may_be_supervised: bool,
    /// The last statusword that was read.
    pub(super) statusword: Option<Statusword>,
    /// The fault that the drive was in when its statusword was read.
    pub(super) found_in_fault: Option<FoundFault>,
    /// The drive's position when it is at home, counts: minus its home offset, if it is to be homed.
    pub(super) home_counts: Option<i32>,
}

impl BringUp {
    /// The bring-up of `axis` for this `purpose`.
    pub(super) fn new(config: &StageConfig, axis: Axis, purpose: AxisUse, now: Time) -> Self {
        let sdo = Sdo::new(config, axis);
        let state = Rc::new(Cell::new(BringUpState::default()));
        let script = Script { axis, purpose, config: config.clone(), sdo, state };
        BringUp {
            runner: ScriptRunner::begin(&script.sdo, now, script.clone().run()),
            script,
            restarts_left: config.bus.boot_attempts.saturating_sub(1),
        }
    }

    /// Takes a boot-up message. A drive that has not answered yet is expected to send one. Later, it means
    /// that the drive has lost what was written: its bring-up begins again, a limited number of times.
    pub(super) fn handle_boot_up(&mut self, now: Time) {
        let BringUpState { part, found, .. } = self.state();
        if found && self.restarts_left > 0 {
            self.restarts_left -= 1;
            self.script.state.take();
            self.script.emit(StageProgress::Restarted(self.script.axis));
            let script = self.script.clone();
            self.runner = ScriptRunner::begin(&self.script.sdo, now, script.run());
        } else if found {
            let error = format!("boot-up message while {part}, is its supply stable?");
            self.runner.end(Err(error));
        }
    }

    pub(super) fn state(&self) -> BringUpState {
        self.script.state()
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

/// `address`, which the drive may lack, since CiA leaves it to the manufacturer.
pub(super) fn optional(address: ObjectAddress) -> Object {
    Object { address, is_optional: true }
}

/// The script of a bring-up, and the reads and writes that its steps use. They skip an object that the drive
/// lacks if it is [`optional`], or if the configuration lists it as optional.
#[derive(Debug, Clone)]
pub(super) struct Script {
    pub(super) axis: Axis,
    pub(super) purpose: AxisUse,
    pub(super) config: StageConfig,
    pub(super) sdo: Sdo,
    state: Rc<Cell<BringUpState>>,
}

impl Script {
    pub(super) fn drive(&self) -> &AxisConfig {
        self.config.axis(self.axis)
    }

    pub(super) fn state(&self) -> BringUpState {
        self.state.get()
    }

    pub(super) fn note(&self, change: impl FnOnce(&mut BringUpState)) {
        let mut state = self.state.get();
        change(&mut state);
        self.state.set(state);
    }

    /// Begins a part of the bring-up.
    pub(super) fn begin(&self, part: &'static str) {
        self.note(|state| state.part = part);
        self.emit(StageProgress::BringUp(self.axis, part));
    }

    fn emit(&self, progress: StageProgress) {
        self.sdo.emit(StageEvent::Progress(progress));
    }

    /// The reply in the drive's `answer` to `request`; `None` if the drive lacks an object that it may lack.
    ///
    /// # Errors
    /// Any other failure, with the object and, where there is one, the next step.
    pub(super) fn accept(
        &self,
        request: SdoRequest,
        is_optional: bool,
        answer: Result<SdoReply, SdoError>,
    ) -> Result<Option<SdoReply>, String> {
        let object = request.object();
        let may_lack = is_optional || self.drive().optional_objects.contains(&object.index);
        let error = match answer {
            Ok(reply) => return Ok(Some(reply)),
            Err(error) => error,
        };
        let is_absent = matches!(
            error,
            SdoError::Aborted(AbortCode::NO_SUCH_OBJECT | AbortCode::NO_SUCH_SUBINDEX)
        );
        if is_absent && may_lack {
            self.emit(StageProgress::Skipped(self.axis, object));
            return Ok(None);
        }
        let hint = match (why_needed(object.index), &error) {
            (None, _) if is_absent => {
                "; list it in optional_objects if the bench can do without".to_owned()
            }
            (Some(why), _) if is_absent => format!("; it is needed: {why}"),
            (_, SdoError::Aborted(AbortCode::PARAMETER_INCOMPATIBLE)) if object == consumer_heartbeat(1) => {
                "; does another entry of it watch that node? Clear it, or set another can.bench_node"
                    .to_owned()
            }
            _ => String::new(),
        };
        let attempts = self.config.bus.sdo_attempts;
        Err(match (error, request) {
            (SdoError::Aborted(code), SdoRequest::Download(_, value)) => {
                format!("{object}: writing {value} was refused with SDO abort {code}{hint}")
            }
            (SdoError::Aborted(code), SdoRequest::Upload(_)) => {
                format!("{object}: reading was refused with SDO abort {code}{hint}")
            }
            (SdoError::Timeout(_), _) => format!(
                "{object}: {error} (attempt {attempts} of {attempts}), check cable, termination and \
                 bus load"
            ),
            _ => format!("{object}: {error}"),
        })
    }

    async fn ask(
        &self,
        request: SdoRequest,
        is_optional: bool,
    ) -> Result<Option<SdoReply>, String> {
        self.accept(request, is_optional, self.sdo.ask(request).await)
    }

    /// Reads `object`; `None` if the drive lacks an object that it may lack.
    pub(super) async fn read(&self, object: impl Into<Object>) -> Result<Option<SdoValue>, String> {
        let Object { address, is_optional } = object.into();
        match self.ask(SdoRequest::Upload(address), is_optional).await? {
            Some(SdoReply::Uploaded(value)) => Ok(Some(value)),
            _ => Ok(None),
        }
    }

    /// Writes `value` to `object` without reading it back: it would not read as written.
    pub(super) async fn write_unchecked(
        &self,
        object: ObjectAddress,
        value: SdoValue,
    ) -> Result<(), String> {
        self.ask(SdoRequest::Download(object, value), false).await.map(drop)
    }

    /// Writes `value` to `object`, reads it back and compares. A drive may refuse to be given the value that it has.
    pub(super) async fn write(
        &self,
        object: impl Into<Object>,
        value: impl Into<SdoValue>,
    ) -> Result<(), String> {
        let (object, value) = (object.into(), value.into());
        let request = SdoRequest::Download(object.address, value);
        let answer = self.sdo.ask(request).await;
        let is_refused = matches!(answer, Err(SdoError::Aborted(_)));
        match self.accept(request, object.is_optional, answer) {
            Ok(None) => return Ok(()),
            Ok(Some(_)) => {}
            Err(error) if is_refused => {
                let received = self.sdo.read_optional(object.address).await.ok().flatten();
                let Some(received) = received else { return Err(error) };
                let checked = check_read_back(object.address, value, received);
                return checked.map_err(|_| format!("{error}; the drive has {received}"));
            }
            Err(error) => return Err(error),
        }
        match self.read(object).await? {
            Some(received) => check_read_back(object.address, value, received),
            None => Ok(()),
        }
    }

    /// Reads `object` until it has this value.
    pub(super) async fn wait_for(
        &self,
        object: ObjectAddress,
        value: SdoValue,
    ) -> Result<(), String> {
        let timeout =
            self.config.bus.sdo_timeout().saturating_mul(self.config.bus.sdo_attempts.into());
        let give_up = self.sdo.now() + timeout;
        while let Some(received) = self.read(object).await? {
            let checked = check_read_back(object, value, received);
            if checked.is_ok() || self.sdo.now() >= give_up {
                return checked;
            }
            self.sdo.pause(POLL_PERIOD).await;
        }
        Ok(())
    }
}

/// Objects that no drive may lack if the bring-up uses them, each with the reason. Of the objects that the bring-up writes, a drive may lack:
///
/// - 605A: by CiA 402 the drive then brakes on its quick-stop ramp, as with option 2
/// - 6065 and 6066: the bench compares target and position itself
/// - 60C2: the drive takes the period from SYNC; if it gets the period wrong, a following error shows it
/// - 6099 and 609A: the drive homes at a speed of its own, as it does without the keys
/// - 6502: the bench reads back the mode (6061)
/// - 1029: by CiA 301 the drive then goes to Pre-operational, as with option 0
///
/// The bring-up never requires 1005, 1018:3, 1018:4, 605E, 607B, or PDOs beyond the first. A drive whose position
/// wraps needs no limits of its own (607D).
const NEEDED: [(&[u16], &str); 8] = [
    (&[0x1000, 0x1018], "it tells which drive this is"),
    (
        &[0x1016, 0x1017, 0x6007],
        "it stops the axis when the bench falls silent, or the bench when the drive does",
    ),
    (
        &[0x1400, 0x1600, 0x1800, 0x1A00],
        "without it set-points and positions are not where the bench takes them to be",
    ),
    (&[0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x607A], "no drive is moved or watched without it"),
    (&[0x607C], "leave out homing.offset if the drive has no such object, and set zero"),
    (&[SOFTWARE_LIMITS], "the drive keeps its limits itself, unless wraps is true"),
    (
        &[0x6085],
        "a configured quick-stop deceleration must hold: omit it if the drive has no such object",
    ),
    (&[0x6098], "the drive would home in a way that is not configured"),
];
/// The drive's own position limits.
pub const SOFTWARE_LIMITS: u16 = 0x607D;

/// Why a drive must have the object at `index`; `None` if `optional_objects` may name it.
pub fn why_needed(index: u16) -> Option<&'static str> {
    let needed = NEEDED.iter().find(|(indexes, _)| indexes.contains(&index));
    needed.map(|(_, why)| *why)
}

/// Checks that the value read back, `received`, is the `expected` one. An expedited answer need not say how
/// many of its four bytes belong to the object (CiA 301, 7.2.4.3.6); the others are then zero. Bit 30 of a
/// PDO's COB-ID (remote requests) is ignored: it is fixed in many drives, and the bench uses no remote requests.
fn check_read_back(
    object: ObjectAddress,
    expected: SdoValue,
    received: SdoValue,
) -> Result<(), String> {
    let is_pdo_cob_id =
        matches!(object.index, 0x1400..=0x15ff | 0x1800..=0x19ff) && object.subindex == 1;
    let ignored = if is_pdo_cob_id { 1 << 30 } else { 0 };
    let length = received.as_bytes().len();
    let same_length = length == expected.as_bytes().len() || length == UNSIZED;
    let same_bits = (expected.to_u32() ^ received.to_u32()) & !ignored == 0;
    if same_length && same_bits {
        Ok(())
    } else {
        Err(format!("{object}: expected {expected}, received {received}"))
    }
}
