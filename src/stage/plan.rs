//! The steps of bring-up, in order: what is read from a drive, and what is written to it.

use super::bring_up::{FoundFault, Identity, Object, POLL_PERIOD, Script, optional};
use super::config::unsigned_counts;
use super::event::may_have_power;
use super::homing::is_at_home;
use super::{Axis, AxisConfig, AxisUse, HomingConfig, Reference, Sign, StageEvent};
use crate::canopen::cia402::{Controlword, Mode, Statusword, object as drive};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::object::communication::{
    COMMUNICATION_ERROR_BEHAVIOUR, DEVICE_TYPE, PRODUCER_HEARTBEAT, SYNC_COB_ID,
    consumer_heartbeat, error_history, identity,
};
use crate::canopen::pdo::{EVERY_SYNC, MappedObject, PDOS, PdoCobId, PdoDirection};
use crate::canopen::sdo::{SdoError, SdoReply, SdoRequest, SdoValue};
use crate::canopen::{ObjectAddress, cob};

/// RPDO1: controlword and target in one frame, so that neither is older than the other.
pub(super) const RPDO1: [MappedObject; 2] =
    [MappedObject::new(0x6040, 0, 16), MappedObject::new(0x607a, 0, 32)];
/// TPDO1: statusword and position of one instant.
pub(super) const TPDO1: [MappedObject; 2] =
    [MappedObject::new(0x6041, 0, 16), MappedObject::new(0x6064, 0, 32)];

/// PDOs beyond the usual four of each direction are switched off up to this number: some drives have eight.
const PDOS_MAX: u16 = 8;

/// CiA 402, the low word of 0x1000.
const DRIVE_PROFILE: u16 = 402;
/// The bits of 0x1005 that are checked: the identifier, and bit 30, which makes the node produce SYNC.
const SYNC_BITS: u32 = 0x4000_07ff;

impl Script {
    /// Brings the drive up, to be moved in cyclic synchronous position or to be homed. Returns where the
    /// axis stands (0x6064).
    pub(super) async fn run(self) -> Result<i32, String> {
        self.find().await?;
        self.identify().await?;
        // Two drives must not be configured as one.
        self.check_node_number()?;
        self.take_power_off().await?;
        self.configure().await?;
        self.supervise().await?;
        self.map_pdos().await?;
        self.check_homed().await?;
        self.set_modes().await?;
        let position = self.seed_target().await?;
        self.check_not_homed_elsewhere(position).await?;
        self.check_node_number()?;
        Ok(position)
    }

    /// Checks that only one drive answers. Two drives with the same node number would both move.
    fn check_node_number(&self) -> Result<(), String> {
        match self.sdo.extra_answers() {
            0 => Ok(()),
            extra => Err(format!(
                "{extra} answers more than requests: two drives have this node number, give one of them \
                 another"
            )),
        }
    }

    /// Reads the device type until the drive answers, and checks that it is a CiA 402 drive.
    async fn find(&self) -> Result<(), String> {
        self.begin("looking for the drive");
        let boot_timeout = self.config.bus.boot_timeout;
        let give_up = self.sdo.now() + boot_timeout;
        let request = SdoRequest::Upload(DEVICE_TYPE);
        let answer = loop {
            match self.sdo.ask_once(request).await {
                Err(SdoError::Timeout(_)) if self.sdo.now() >= give_up => {
                    let cob_id = cob::sdo_rx(self.sdo.node());
                    let timeout_s = boot_timeout.as_secs_f64();
                    return Err(format!(
                        "no answer on {cob_id:X}h within {timeout_s:.1} s, is the drive powered, \
                         node-id and bitrate right?"
                    ));
                }
                // The drive may have been left in NMT Stopped, where it does not answer. It must have left that
                // state when the next request comes.
                Err(SdoError::Timeout(_)) => {
                    self.sdo.leave_operational();
                    self.sdo.pause(POLL_PERIOD).await;
                }
                Err(SdoError::TooLong | SdoError::UnexpectedCommand(_))
                    if self.sdo.now() < give_up => {}
                answer => break answer,
            }
        };
        self.note(|state| state.found = true);
        match self.accept(request, false, answer)? {
            Some(SdoReply::Uploaded(value)) if value.to_u32() as u16 != DRIVE_PROFILE => {
                let profile = value.to_u32() as u16;
                Err(format!(
                    "{DEVICE_TYPE}: device profile {profile} where {DRIVE_PROFILE} (drives) is needed, \
                     is the node-id right?"
                ))
            }
            _ => Ok(()),
        }
    }

    async fn identify(&self) -> Result<(), String> {
        self.begin("checking its identity");
        // From here on it is known whether the drive had power, whatever ends the bring-up.
        self.read_statusword().await?;
        let vendor = self.read_identity(1, self.drive().vendor_id).await?;
        let product = self.read_identity(2, self.drive().product_code).await?;
        if self.drive().serial.is_some() {
            self.read_identity(4, self.drive().serial).await?;
        }
        self.note(|state| state.identified = true);
        // The node is not reset: the drive may hold a load.
        self.sdo.leave_operational();
        let revision = self.read(optional(identity(3))).await?.map(SdoValue::to_u32);
        let serial = self.read(optional(identity(4))).await?.map(SdoValue::to_u32);
        let supported = self.read(drive::SUPPORTED_MODES).await?;
        let identity = Identity { vendor, product, revision, serial };
        self.sdo.emit(StageEvent::Identity(self.axis, identity));
        let mode = match self.purpose {
            AxisUse::Home { .. } => Mode::HOMING,
            _ => Mode::CSP,
        };
        match supported.map(SdoValue::to_u32) {
            Some(supported) if !mode.is_in(supported) => Err(format!(
                "{}: supported modes {supported:#010X} lack {mode} (bit {})",
                drive::SUPPORTED_MODES,
                mode.0 - 1
            )),
            _ => Ok(()),
        }
    }

    async fn read_identity(&self, subindex: u8, expected: Option<u32>) -> Result<u32, String> {
        let object = identity(subindex);
        let received = self.read(object).await?.map(SdoValue::to_u32);
        match (expected, received) {
            (Some(expected), Some(received)) if expected != received => Err(format!(
                "{object}: expected {expected:#010X}, received {received:#010X}, is this the drive of \
                 the configuration?"
            )),
            _ => Ok(received.unwrap_or(0)),
        }
    }

    /// Takes power off first: a drive that an earlier run left enabled is not reconfigured under power. If
    /// the drive is in Fault, the cause is read; unless it may be reset, bring-up ends there.
    async fn take_power_off(&self) -> Result<(), String> {
        self.begin("taking power off, looking for faults");
        self.write_unchecked(drive::CONTROLWORD, Controlword::DISABLE_VOLTAGE.0.into()).await?;
        let statusword = self.wait_for_power_off().await?;
        self.note(|state| state.is_power_off = true);
        if !statusword.is_fault() {
            return Ok(());
        }
        let mut fault = FoundFault { error_code: None };
        self.note(|state| state.found_in_fault = Some(fault));
        // A fault is reset only if its code can be read, unless the drive has no codes.
        let error_code = match self.config.power.fault_reset_on_start {
            true => self.read(optional(drive::ERROR_CODE)).await?,
            false => self.sdo.read_optional(drive::ERROR_CODE).await?,
        };
        fault.error_code = error_code.map(|code| EmcyCode(code.to_u32() as u16));
        self.note(|state| state.found_in_fault = Some(fault));
        if self.config.power.fault_reset_on_start {
            return Ok(());
        }
        // A drive refuses to read an error history that is empty.
        let history = self.sdo.read_optional(error_history(1)).await?.map(SdoValue::to_u32);
        let error_code = fault.error_code.map_or("absent".to_owned(), |code| code.to_string());
        let history = history.map_or("empty".to_owned(), |error| format!("{error:#010X}"));
        Err(format!(
            "drive found in fault (statusword {statusword}, 0x603F {error_code}, 0x1003:01 {history}); \
             clear its cause, then: needle-bench stage reset CONFIG"
        ))
    }

    /// Reads the statusword until the motor has no power, which takes some time with a brake.
    async fn wait_for_power_off(&self) -> Result<Statusword, String> {
        let give_up = self.sdo.now() + self.config.power.enable_timeout;
        loop {
            let statusword = self.read_statusword().await?;
            if !may_have_power(statusword.state()) {
                return Ok(statusword);
            }
            if self.sdo.now() >= give_up {
                return Err(format!(
                    "the drive keeps its power (statusword {statusword}), does an input or another tool \
                     hold it? Press the emergency stop"
                ));
            }
            self.sdo.pause(POLL_PERIOD).await;
        }
    }

    async fn read_statusword(&self) -> Result<Statusword, String> {
        let value = self.read(drive::STATUSWORD).await?;
        let statusword = Statusword(value.map_or(0, SdoValue::to_u32) as u16);
        self.note(|state| state.statusword = Some(statusword));
        Ok(statusword)
    }

    /// Writes the raw objects of the configuration, then its settings that have objects of their own.
    async fn configure(&self) -> Result<(), String> {
        self.begin("writing the configured objects");
        let config = self.drive();
        for raw in &config.sdo {
            let (object, value) = raw.to_write()?;
            if raw.read_back {
                self.write(object, value).await?;
            } else {
                self.write_unchecked(object, value).await?;
            }
        }
        if let Some(timeout_ms) = config.following_error_timeout_ms {
            // A drive without this object faults at once.
            self.write(optional(drive::FOLLOWING_ERROR_TIMEOUT), timeout_ms).await?;
        }
        let window = Some(config.following_error_window());
        self.write_counts(drive::FOLLOWING_ERROR_WINDOW, window).await?;
        let is_raw = config.sdo.iter().any(|raw| raw.is_quick_stop());
        let deceleration = config.quick_stop_deceleration.filter(|_| !is_raw);
        self.write_counts(drive::QUICK_STOP_DECELERATION, deceleration).await
    }

    /// Writes `value`, in mm or rad (per second, per second squared), in counts; nothing for `None`.
    async fn write_counts(&self, object: ObjectAddress, value: Option<f64>) -> Result<(), String> {
        let Some(value) = value else { return Ok(()) };
        let counts = unsigned_counts(self.drive().scale(self.axis, 0), value);
        self.write(object, counts.ok_or_else(|| unfit(object, value))?).await
    }

    async fn supervise(&self) -> Result<(), String> {
        self.begin("setting heartbeats");
        let config = self.drive();
        let timeout_ms = u32::from(self.config.bus.heartbeat_timeout_ms);
        self.note(|state| state.may_be_supervised = true);
        let watched = u32::from(self.config.bus.bench_node.get()) << 16 | timeout_ms;
        self.write(PRODUCER_HEARTBEAT, self.config.bus.heartbeat_ms).await?;
        self.write(consumer_heartbeat(1), watched).await?;
        match config.communication_error_behaviour {
            // A node without this object behaves as if it were 0.
            0 => self.write(optional(COMMUNICATION_ERROR_BEHAVIOUR), 0_u8).await?,
            behaviour => self.write(COMMUNICATION_ERROR_BEHAVIOUR, behaviour).await?,
        }
        self.write(drive::ABORT_CONNECTION_OPTION, config.abort_connection_option).await?;
        self.write(drive::QUICK_STOP_OPTION, config.quick_stop_option).await?;
        self.write(optional(drive::FAULT_REACTION_OPTION), config.fault_reaction_option).await
    }

    /// Switches every PDO off, then maps one in each direction in the order of CiA 301, 7.5.2.36: off by
    /// bit 31, number of entries 0, entries, number of entries, on.
    async fn map_pdos(&self) -> Result<(), String> {
        self.begin("mapping PDOs");
        if let Some(received) = self.read(optional(SYNC_COB_ID)).await?
            && received.to_u32() & SYNC_BITS != u32::from(cob::SYNC)
        {
            let (object, expected) = (SYNC_COB_ID, SdoValue::from(u32::from(cob::SYNC)));
            return Err(format!("{object}: expected {expected}, received {received}"));
        }
        let node = self.drive().node;
        for direction in [PdoDirection::Receive, PdoDirection::Transmit] {
            let communication = |sub| ObjectAddress::new(direction.communication_index(0), sub);
            let mapping = |sub| ObjectAddress::new(direction.mapping_index(0), sub);
            self.disable_pdo(communication(1).into()).await?;
            for offset in 1..PDOS_MAX {
                let cob_id = ObjectAddress::new(direction.communication_index(offset), 1);
                if offset >= PDOS && self.sdo.read_optional(cob_id).await?.is_none() {
                    break;
                }
                self.disable_pdo(optional(cob_id)).await?;
            }
            let (entries, enabled) = match direction {
                // Bit 30 has no meaning in an RPDO.
                PdoDirection::Receive => (RPDO1, u32::from(cob::rpdo1(node))),
                PdoDirection::Transmit => (TPDO1, PdoCobId::enabled(cob::tpdo1(node)).0),
            };
            self.write(communication(2), EVERY_SYNC).await?;
            self.write(mapping(0), 0_u8).await?;
            for (sub, entry) in (1..).zip(entries) {
                self.write(mapping(sub), entry.to_u32()).await?;
            }
            self.write(mapping(0), entries.len() as u8).await?;
            self.write(communication(1), enabled).await?;
        }
        Ok(())
    }

    /// Sets bit 31 of a COB-ID. The other bits stay as they are: they must not change while bit 31 is clear.
    async fn disable_pdo(&self, object: Object) -> Result<(), String> {
        match self.read(object).await?.map(SdoValue::to_u32) {
            Some(cob_id) if PdoCobId(cob_id).is_valid() => {
                self.write(object, cob_id | PdoCobId::INVALID).await
            }
            _ => Ok(()),
        }
    }

    async fn check_homed(&self) -> Result<(), String> {
        let AxisConfig { homing, reference, .. } = self.drive();
        let must_be_homed = matches!(self.purpose, AxisUse::Steer | AxisUse::Move);
        let Some(homing) = homing.filter(|_| *reference == Reference::Homing && must_be_homed)
        else {
            return Ok(());
        };
        self.begin("checking that it is homed");
        // Bit 12 means "homed" only in homing mode, so the statusword is read in that mode, without power.
        if homing.homed_bit == HomingConfig::ATTAINED_BIT {
            self.set_mode(Mode::HOMING).await?;
        }
        let statusword = self.read_statusword().await?;
        // An axis without a zero is pulled back because it has lost its home.
        match (homing.says_homed(statusword), self.drive().zero) {
            (true, Some(_)) | (false, None) => return Ok(()),
            (true, None) => return Err("homed: withdraw it without --unhomed".to_owned()),
            (false, Some(_)) => {}
        }
        let (axis, bit) = (self.axis, homing.homed_bit);
        let first = match (axis, self.purpose) {
            (Axis::Insertion, AxisUse::Move) => "needle in: withdraw --by DEPTH --unhomed; out: ",
            (Axis::Insertion, _) => "take the needle off and ",
            _ => "",
        };
        Err(format!(
            "not homed (bit {bit} of statusword {:#06X} is clear); {first}home it first: \
             needle-bench stage home CONFIG --axis {axis}",
            statusword.0
        ))
    }

    /// Refuses to home again an axis that stands away from its home. Homing in place would set its zero with the cable
    /// twisted or the needle inserted, and any other method would move it.
    async fn check_not_homed_elsewhere(&self, position: i32) -> Result<(), String> {
        let (AxisUse::Home { again: false }, Some(homing)) = (self.purpose, self.drive().homing)
        else {
            return Ok(());
        };
        let axis = self.axis;
        let counts = f64::from(position) - f64::from(self.state().home_counts.unwrap_or(0));
        let apart = counts / self.drive().scale(axis, 0).counts_per_unit();
        if is_at_home(axis, apart) || !homing.says_homed(self.read_statusword().await?) {
            return Ok(());
        }
        let apart = axis.shown(apart.abs());
        Err(format!(
            "homed already, and {apart} from its home, which would be lost; jog it back there, or home it --again \
             (take the needle off, untwist the cable)"
        ))
    }

    async fn set_modes(&self) -> Result<(), String> {
        self.begin("setting its mode of operation");
        // In units of 10^-3 s.
        self.write(drive::INTERPOLATION_PERIOD_EXPONENT, -3_i8).await?;
        self.write(drive::INTERPOLATION_PERIOD_VALUE, self.config.bus.sync_ms as u8).await?;
        match self.drive().homing {
            Some(homing) if matches!(self.purpose, AxisUse::Home { .. }) => {
                self.configure_homing(homing).await?;
                self.set_mode(Mode::HOMING).await
            }
            _ => self.set_mode(Mode::CSP).await,
        }
    }

    async fn configure_homing(&self, homing: HomingConfig) -> Result<(), String> {
        self.write(drive::HOMING_METHOD, homing.method).await?;
        self.write_counts(drive::HOMING_SPEED_SWITCH, homing.speed_switch).await?;
        self.write_counts(drive::HOMING_SPEED_ZERO, homing.speed_zero).await?;
        self.write_counts(drive::HOMING_ACCELERATION, homing.acceleration).await?;
        let object = drive::HOME_OFFSET;
        let offset_counts = match homing.offset {
            // Without the object home is 0. An EPOS4 has 0x30B0 in its place: over 1 mm or 5 degrees it is noticed after
            // the homing.
            None => self.sdo.read_optional(object).await?.map_or(0, |value| value.to_u32() as i32),
            Some(offset) => {
                let counts = self.drive().scale(self.axis, 0).relative_counts(offset);
                let counts = counts.ok_or_else(|| unfit(object, offset))?;
                self.write(object, counts).await?;
                counts
            }
        };
        self.note(|state| state.home_counts = Some(offset_counts.wrapping_neg()));
        Ok(())
    }

    async fn set_mode(&self, mode: Mode) -> Result<(), String> {
        self.write(drive::MODES_OF_OPERATION, mode.0).await?;
        self.wait_for(drive::MODES_OF_OPERATION_DISPLAY, mode.0.into()).await
    }

    async fn seed_target(&self) -> Result<i32, String> {
        self.begin("setting its limits and seeding the target");
        let object = drive::POSITION_ACTUAL;
        let position = self.read(object).await?.map_or(Ok(0), |value| {
            let counts = value.at_least(4).map(|counts| counts as i32);
            counts.ok_or_else(|| format!("{object}: expected 4 bytes, received {value}"))
        })?;
        self.check_position_range(position).await?;
        let (min, max) = (drive::SOFTWARE_LIMIT_MIN, drive::SOFTWARE_LIMIT_MAX);
        if self.drive().wraps {
            // A wrapping axis needs no limits in the drive. Limits from an earlier use of the drive would stop it.
            self.write(optional(min), i32::MIN).await?;
            self.write(optional(max), i32::MAX).await?;
        } else if !matches!(self.purpose, AxisUse::Home { .. }) {
            let [lower, upper] = self.limit_counts(position);
            // In this order the upper limit is never under the lower one, whatever the drive had before.
            self.write(min, i32::MIN).await?;
            self.write(max, upper).await?;
            self.write(min, lower).await?;
        }
        self.clear_offset(drive::POSITION_OFFSET, SdoValue::from(0_i32)).await?;
        self.clear_offset(drive::VELOCITY_OFFSET, SdoValue::from(0_i32)).await?;
        self.clear_offset(drive::TORQUE_OFFSET, SdoValue::from(0_i16)).await?;
        self.write(drive::TARGET_POSITION, position).await?;
        Ok(position)
    }

    /// Sets an offset to 0: one from an earlier use would move the axis as soon as it follows.
    async fn clear_offset(&self, object: ObjectAddress, zero: SdoValue) -> Result<(), String> {
        match self.sdo.read_optional(object).await? {
            Some(value) if value.to_u32() != 0 => self.write(object, zero).await,
            _ => Ok(()),
        }
    }

    /// Refuses a drive whose position wraps within the axis's travel, where one reading would stand for several
    /// positions. The bench unwraps a position of 32 bits only.
    async fn check_position_range(&self, position: i32) -> Result<(), String> {
        let number = async |object| {
            let value = self.sdo.read_optional(object).await?;
            Ok::<_, String>(value.map_or(0, |value| value.to_u32() as i32))
        };
        let range =
            [number(drive::POSITION_RANGE_MIN).await?, number(drive::POSITION_RANGE_MAX).await?];
        let [lower, upper] = match self.drive().wraps {
            true => [i32::MIN, i32::MAX],
            false => self.limit_counts(position),
        };
        let [low, high] = range;
        if range == [0, 0] || (low <= lower && upper <= high) {
            return Ok(());
        }
        let object = drive::POSITION_RANGE_MIN;
        Err(format!(
            "{object}: the drive's position wraps at {low} and {high} counts, allowed: 0 and 0 (no wrapping), or \
             beyond {lower} to {upper}; set it in the drive, or by [[stage.{}.sdo]]",
            self.axis
        ))
    }

    /// The drive's own limits, counts: the soft limits and where the axis stands, widened by the following-error
    /// window. They stop the axis if the bench fails to refuse a target.
    fn limit_counts(&self, position: i32) -> [i32; 2] {
        let config = self.drive();
        let AxisConfig { limits, sign, .. } = config;
        let margin = config.following_error_window();
        let scale = config.scale(self.axis, position.into());
        let here = scale.value(position.into());
        let ends = [limits.min.min(here) - margin, limits.max.max(here) + margin];
        let ends = ends.map(|end| scale.counts(end));
        let [lower, upper] = match sign {
            Sign::Positive => ends,
            Sign::Negative => [ends[1], ends[0]],
        };
        let to_i32 = |counts: Option<i64>| counts.and_then(|counts| i32::try_from(counts).ok());
        [to_i32(lower).unwrap_or(i32::MIN), to_i32(upper).unwrap_or(i32::MAX)]
    }
}

/// The error of a `value`, in mm or rad, that `object` cannot hold in counts.
/// [`StageConfig::validate`](super::StageConfig::validate) refuses such a configuration.
fn unfit(object: ObjectAddress, value: f64) -> String {
    format!("{object} cannot hold {value} in counts")
}
