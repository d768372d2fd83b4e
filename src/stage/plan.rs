//! The objects of a drive that bring-up reads and writes, as a plain list.

use super::config::{interpolation_period, millis, unsigned_counts};
use super::{Axis, AxisConfig, HomingConfig, Reference, Scale, StageConfig};
use crate::canopen::cia402::{Controlword, Mode, object as drive};
use crate::canopen::object::communication::{self, error_history, identity};
use crate::canopen::pdo::{EVERY_SYNC, MappedObject, PDOS, PdoCobId, PdoDirection};
use crate::canopen::sdo::SdoValue;
use crate::canopen::{NodeId, ObjectAddress, cob};

/// The parts of bring-up, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, derive_more::Display)]
pub enum BringUpPart {
    /// Does the drive answer?
    #[display("looking for the drive")]
    Find,
    /// Is it the right one?
    #[display("checking its identity")]
    Identify,
    /// Take power off, look for a fault.
    #[display("taking power off, looking for faults")]
    Disarm,
    /// Objects of the configuration.
    #[display("writing the configured objects")]
    Configure,
    /// Heartbeats, both ways.
    #[display("setting heartbeats")]
    Supervise,
    /// PDOs.
    #[display("mapping PDOs")]
    MapPdos,
    /// Does the drive know where it is?
    #[display("checking that it is homed")]
    CheckHomed,
    /// Cyclic synchronous position on the SYNC period, or homing.
    #[display("setting its mode of operation")]
    SetMode,
    /// The drive's own limits, and the target where the axis stands.
    #[display("setting its limits and seeding the target")]
    SeedTarget,
}

/// A value read for what it says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reading {
    Vendor,
    Product,
    Revision,
    Serial,
    SupportedModes,
    Statusword,
    Homed,
    ErrorCode,
    ErrorHistory,
    Position,
}

/// What to do with an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Action {
    /// Read until the drive answers: is it a CiA 402 drive?
    Find,
    Read(Reading),
    /// Read; these bits must be so.
    Expect {
        value: u32,
        mask: u32,
    },
    /// Read until it has this value.
    Await(SdoValue),
    /// Write and read back.
    Write(SdoValue),
    /// Write: the object does not read as written.
    Command(SdoValue),
    /// Set bit 31 of a COB-ID and leave the others, which may not change while it is clear.
    DisablePdo,
    /// Write the position read before, and read it back.
    SeedTarget,
    /// Write a limit that the position read before may decide, and read it back.
    Limit(End),
}

/// An end of the drive's own position limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    Min,
    Max,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Step {
    pub(super) part: BringUpPart,
    pub(super) object: ObjectAddress,
    pub(super) action: Action,
    /// The drive may lack the object.
    pub(super) optional: bool,
}

/// RPDO1: controlword and target in one frame, so that neither is older than the other.
pub(super) const RPDO: [MappedObject; 2] =
    [MappedObject::new(0x6040, 0, 16), MappedObject::new(0x607a, 0, 32)];
/// TPDO1: statusword and position of one instant.
pub(super) const TPDO: [MappedObject; 2] =
    [MappedObject::new(0x6041, 0, 16), MappedObject::new(0x6064, 0, 32)];

struct Plan {
    steps: Vec<Step>,
    optional_objects: Vec<ObjectAddress>,
}

impl Plan {
    fn add(&mut self, part: BringUpPart, object: ObjectAddress, action: Action) {
        let optional = self.optional_objects.contains(&object);
        self.steps.push(Step { part, object, action, optional });
    }

    /// A value in mm or rad (a second, a second squared), where one is configured.
    fn add_counts(&mut self, part: BringUpPart, object: ObjectAddress, counts: Option<u32>) {
        if let Some(counts) = counts {
            self.add(part, object, Action::Write(counts.into()));
        }
    }

    /// For objects that CiA leaves to the manufacturer.
    fn add_optional(&mut self, part: BringUpPart, object: ObjectAddress, action: Action) {
        self.steps.push(Step { part, object, action, optional: true });
    }
}

/// The steps for `axis`, to be moved in cyclic synchronous position or to be `homed`.
pub(super) fn bring_up_plan(config: &StageConfig, axis: Axis, homed: bool) -> Vec<Step> {
    use BringUpPart as P;
    let drive_config = config.axis(axis);
    let node = drive_config.node;
    let homing = drive_config.homing;
    let mut plan =
        Plan { steps: Vec::new(), optional_objects: drive_config.optional_objects.clone() };

    plan.add(P::Find, communication::DEVICE_TYPE, Action::Find);

    plan.add(P::Identify, identity(1), Action::Read(Reading::Vendor));
    plan.add(P::Identify, identity(2), Action::Read(Reading::Product));
    plan.add_optional(P::Identify, identity(3), Action::Read(Reading::Revision));
    plan.add_optional(P::Identify, identity(4), Action::Read(Reading::Serial));
    plan.add(P::Identify, drive::SUPPORTED_MODES, Action::Read(Reading::SupportedModes));

    // A drive that an earlier run left enabled is not reconfigured under power.
    let off = SdoValue::from(Controlword::DISABLE_VOLTAGE.0);
    plan.add(P::Disarm, drive::CONTROLWORD, Action::Command(off));
    plan.add(P::Disarm, drive::STATUSWORD, Action::Read(Reading::Statusword));

    for raw in &drive_config.raw_sdos {
        let action =
            if raw.read_back { Action::Write(raw.value) } else { Action::Command(raw.value) };
        plan.add(P::Configure, raw.object, action);
    }
    configure(&mut plan, drive_config, drive_config.scale(axis, 0));

    let producer_ms = millis(config.heartbeat.producer_period).unwrap_or(u16::MAX);
    let consumer_ms = millis(config.heartbeat.consumer_time).unwrap_or(u16::MAX);
    let watched = u32::from(config.bench_node.get()) << 16 | u32::from(consumer_ms);
    plan.add(P::Supervise, communication::PRODUCER_HEARTBEAT, Action::Write(producer_ms.into()));
    plan.add(P::Supervise, communication::consumer_heartbeat(1), Action::Write(watched.into()));
    let behaviour = Action::Write(drive_config.communication_error_behaviour.into());
    match drive_config.communication_error_behaviour {
        // A node without it behaves as by 0.
        0 => {
            plan.add_optional(P::Supervise, communication::COMMUNICATION_ERROR_BEHAVIOUR, behaviour)
        }
        _ => plan.add(P::Supervise, communication::COMMUNICATION_ERROR_BEHAVIOUR, behaviour),
    }
    let abort_connection = Action::Write(drive_config.abort_connection_option.into());
    plan.add(P::Supervise, drive::ABORT_CONNECTION_OPTION, abort_connection);
    let quick_stop = Action::Write(drive_config.quick_stop_option.into());
    plan.add(P::Supervise, drive::QUICK_STOP_OPTION, quick_stop);
    let fault_reaction = Action::Write(drive_config.fault_reaction_option.into());
    plan.add_optional(P::Supervise, drive::FAULT_REACTION_OPTION, fault_reaction);

    // On the usual identifier, and made by the bench alone (bit 30: the node makes SYNC).
    let sync = Action::Expect { value: u32::from(cob::SYNC), mask: 0x4000_07ff };
    plan.add_optional(P::MapPdos, communication::SYNC_COB_ID, sync);
    map_pdos(&mut plan, node);

    if let Some(homing) = homing
        && drive_config.reference == Reference::Homing
        && !homed
    {
        check_homed(&mut plan, homing);
    }

    let (count, exponent) = interpolation_period(config.sync_period).unwrap_or((u8::MAX, -3));
    plan.add(P::SetMode, drive::INTERPOLATION_PERIOD_EXPONENT, Action::Write(exponent.into()));
    plan.add(P::SetMode, drive::INTERPOLATION_PERIOD_VALUE, Action::Write(count.into()));
    match homing {
        Some(homing) if homed => {
            configure_homing(&mut plan, homing, drive_config.scale(axis, 0));
            set_mode(&mut plan, P::SetMode, Mode::HOMING);
        }
        _ => set_mode(&mut plan, P::SetMode, Mode::CSP),
    }

    plan.add(P::SeedTarget, drive::POSITION_ACTUAL, Action::Read(Reading::Position));
    // Never an upper limit under the lower one, whatever the drive had before.
    let lowest = Action::Write(i32::MIN.into());
    if drive_config.wraps {
        // An axis that goes round has no limits: those of another use of the drive would hold it.
        let highest = Action::Write(i32::MAX.into());
        plan.add_optional(P::SeedTarget, drive::SOFTWARE_LIMIT_MIN, lowest);
        plan.add_optional(P::SeedTarget, drive::SOFTWARE_LIMIT_MAX, highest);
    } else if !homed {
        plan.add(P::SeedTarget, drive::SOFTWARE_LIMIT_MIN, lowest);
        plan.add(P::SeedTarget, drive::SOFTWARE_LIMIT_MAX, Action::Limit(End::Max));
        plan.add(P::SeedTarget, drive::SOFTWARE_LIMIT_MIN, Action::Limit(End::Min));
    }
    plan.add(P::SeedTarget, drive::TARGET_POSITION, Action::SeedTarget);
    plan.steps
}

/// What the configuration says in mm or rad; `scale` gives the counts.
fn configure(plan: &mut Plan, config: &AxisConfig, scale: Scale) {
    let part = BringUpPart::Configure;
    if let Some(timeout) = config.following_error_timeout.and_then(millis) {
        // A drive without it does not wait.
        plan.add_optional(part, drive::FOLLOWING_ERROR_TIMEOUT, Action::Write(timeout.into()));
    }
    let counts = |value: f64| unsigned_counts(scale, value);
    let window = counts(config.following_error_window());
    plan.add_counts(part, drive::FOLLOWING_ERROR_WINDOW, window);
    let deceleration = config.quick_stop_deceleration.and_then(counts);
    plan.add_counts(part, drive::QUICK_STOP_DECELERATION, deceleration);
}

/// Bit 12 says it in homing mode alone, and so that the drive is asked in that mode, without power.
fn check_homed(plan: &mut Plan, homing: HomingConfig) {
    let part = BringUpPart::CheckHomed;
    if homing.homed_bit == HomingConfig::ATTAINED_BIT {
        set_mode(plan, part, Mode::HOMING);
    }
    plan.add(part, drive::STATUSWORD, Action::Read(Reading::Homed));
}

fn configure_homing(plan: &mut Plan, homing: HomingConfig, scale: Scale) {
    let part = BringUpPart::SetMode;
    plan.add(part, drive::HOMING_METHOD, Action::Write(homing.method.into()));
    let counts = |value: f64| unsigned_counts(scale, value);
    plan.add_counts(part, drive::HOMING_SPEED_SWITCH, homing.speed_switch.and_then(counts));
    plan.add_counts(part, drive::HOMING_SPEED_ZERO, homing.speed_zero.and_then(counts));
    plan.add_counts(part, drive::HOMING_ACCELERATION, homing.acceleration.and_then(counts));
    let offset = homing.offset.and_then(|offset| scale.relative_counts(offset));
    if let Some(offset) = offset {
        plan.add(part, drive::HOME_OFFSET, Action::Write(offset.into()));
    }
}

fn set_mode(plan: &mut Plan, part: BringUpPart, mode: Mode) {
    let mode = SdoValue::from(mode.0);
    plan.add(part, drive::MODES_OF_OPERATION, Action::Write(mode));
    plan.add(part, drive::MODES_OF_OPERATION_DISPLAY, Action::Await(mode));
}

/// Every PDO off first, then one each way, by the rule of CiA 301, 7.5.2.36: off by bit 31, no
/// entries, entries, count, on.
fn map_pdos(plan: &mut Plan, node: NodeId) {
    let part = BringUpPart::MapPdos;
    for direction in [PdoDirection::Receive, PdoDirection::Transmit] {
        let communication = |sub| ObjectAddress::new(direction.communication_index(0), sub);
        let mapping = |sub| ObjectAddress::new(direction.mapping_index(0), sub);
        plan.add(part, communication(1), Action::DisablePdo);
        for offset in 1..PDOS {
            let cob_id = ObjectAddress::new(direction.communication_index(offset), 1);
            plan.add_optional(part, cob_id, Action::DisablePdo);
        }
        let (entries, enabled) = match direction {
            // Bit 30 has no meaning in an RPDO.
            PdoDirection::Receive => (RPDO, u32::from(cob::rpdo(node))),
            PdoDirection::Transmit => (TPDO, PdoCobId::enabled(cob::tpdo(node)).0),
        };
        plan.add(part, communication(2), Action::Write(EVERY_SYNC.into()));
        plan.add(part, mapping(0), Action::Write(0_u8.into()));
        for (sub, entry) in (1..).zip(entries) {
            plan.add(part, mapping(sub), Action::Write(entry.to_u32().into()));
        }
        plan.add(part, mapping(0), Action::Write((entries.len() as u8).into()));
        plan.add(part, communication(1), Action::Write(enabled.into()));
    }
}

/// What else to read from a drive found in Fault.
pub(super) fn fault_plan() -> Vec<Step> {
    let part = BringUpPart::Disarm;
    [(drive::ERROR_CODE, Reading::ErrorCode), (error_history(1), Reading::ErrorHistory)]
        .map(|(object, reading)| Step {
            part,
            object,
            action: Action::Read(reading),
            optional: true,
        })
        .to_vec()
}
