//! The drive's objects and their power-on values: one table, which the node serves and the
//! electronic data sheet prints.

use super::{DriveConfig, Model};
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::object;
use crate::canopen::node::{DeviceInfo, PdoDefault, pdo_objects, standard_objects};
use crate::canopen::object_dictionary::{Access, DataType, Entry, ObjectDictionary, ObjectKind};
use crate::canopen::pdo::{MappedObject, PdoDirection, PdoNumber, TransmissionType};

/// u32, counts per second squared.
pub(super) const MAX_ACCELERATION: ObjectAddress = ObjectAddress::new(0x60c5, 0);

/// Bits of 0x6502: homing, cyclic synchronous position.
const SUPPORTED_MODES: i64 = 1 << 5 | 1 << 7;

/// Objects of CiA 301 and 402 that an EPOS4 does not have: communication cycle, window and
/// counter of SYNC, following error time out, gear ratio and feed constant, for it counts increments
/// alone.
const NOT_IN_EPOS4: [u16; 6] = [0x1006, 0x1007, 0x1019, 0x6066, 0x6091, 0x6092];

pub(super) fn dictionary(config: &DriveConfig) -> ObjectDictionary {
    let info = DeviceInfo {
        // Servo drive (2) of profile 402.
        device_type: 0x0002_0192,
        name: config.name.clone(),
        hardware_version: "emulated".into(),
        software_version: env!("CARGO_PKG_VERSION").into(),
        identity: config.identity,
    };
    let mut objects = standard_objects(config.node, &info);
    put_commands(&mut objects);
    put_settings(&mut objects, config);
    put_constants(&mut objects);
    put_state(&mut objects);
    put_pdos(&mut objects, config);
    if config.model == Model::Epos4 {
        NOT_IN_EPOS4.into_iter().for_each(|index| objects.remove(index));
        for number in PdoNumber::ALL {
            let index = PdoDirection::Transmit.communication_index(number);
            objects.remove_entry(ObjectAddress::new(index, EVENT_TIMER));
            objects.set(ObjectAddress::new(index, 0), INHIBIT_TIME.into());
        }
    }
    objects
}

/// Subindices of a TPDO's communication parameters.
const INHIBIT_TIME: u8 = 3;
const EVENT_TIMER: u8 = 5;

fn put_commands(objects: &mut ObjectDictionary) {
    for (address, name, data_type) in [
        (object::CONTROLWORD, "Controlword", DataType::U16),
        (object::MODES_OF_OPERATION, "Modes of operation", DataType::I8),
        (object::TARGET_POSITION, "Target position", DataType::I32),
    ] {
        let entry = Entry::new(data_type, Access::ReadWrite, 0);
        objects.insert(address, entry.mappable(PdoDirection::Receive));
        objects.describe(address.index, ObjectKind::Variable, name, &[]);
    }
}

fn put_settings(objects: &mut ObjectDictionary, config: &DriveConfig) {
    use DataType::{I8, I16, I32, U8, U16, U32};
    let any_u32 = 0..=i64::from(u32::MAX);
    let positive = 1..=i64::from(u32::MAX);
    let any_i32 = i32::MIN.into()..=i32::MAX.into();
    let speed_max = config.speed_max_counts_per_s;
    let acceleration_max = config.acceleration_max_counts_per_s2;
    let rows = [
        (object::ABORT_CONNECTION_OPTION, "Abort connection option code", I16, 1, 0..=3),
        (object::QUICK_STOP_OPTION, "Quick stop option code", I16, 2, 0..=6),
        (object::HALT_OPTION, "Halt option code", I16, 1, 1..=2),
        (object::FAULT_REACTION_OPTION, "Fault reaction option code", I16, 2, 0..=2),
        (object::FOLLOWING_ERROR_WINDOW, "Following error window", U32, 2000, any_u32),
        (object::FOLLOWING_ERROR_TIMEOUT, "Following error time out", U16, 0, 0..=u16::MAX.into()),
        (object::HOME_OFFSET, "Home offset", I32, 0, any_i32),
        (object::MAX_PROFILE_VELOCITY, "Max profile velocity", U32, speed_max, positive.clone()),
        (object::PROFILE_DECELERATION, "Profile deceleration", U32, 10_000, positive.clone()),
        (
            object::QUICK_STOP_DECELERATION,
            "Quick stop deceleration",
            U32,
            100_000,
            positive.clone(),
        ),
        (object::HOMING_METHOD, "Homing method", I8, 37, -128..=127),
        (object::HOMING_ACCELERATION, "Homing acceleration", U32, 10_000, positive.clone()),
        (MAX_ACCELERATION, "Max acceleration", U32, acceleration_max, positive.clone()),
    ];
    for (address, name, data_type, default, limits) in rows {
        let entry = Entry::new(data_type, Access::ReadWrite, default.into());
        objects.insert(address, entry.limits(limits));
        objects.describe(address.index, ObjectKind::Variable, name, &[]);
    }
    let any_i32 = || i32::MIN.into()..=i32::MAX.into();
    let pairs = [
        // Both 0: no limits.
        (
            (0x607d, ObjectKind::Array, "Software position limit"),
            [("Min position limit", I32, 0, any_i32()), ("Max position limit", I32, 0, any_i32())],
        ),
        (
            (0x6099, ObjectKind::Array, "Homing speeds"),
            [
                ("Speed during search for switch", U32, 10_000, positive.clone()),
                ("Speed during search for zero", U32, 1000, positive),
            ],
        ),
        (
            (0x60c2, ObjectKind::Record, "Interpolation time period"),
            [
                ("Interpolation time period value", U8, 1, 1..=255),
                ("Interpolation time index", I8, -3, -6..=0),
            ],
        ),
    ];
    for ((index, kind, name), members) in pairs {
        objects.describe(index, kind, name, &members.each_ref().map(|(name, ..)| *name));
        objects.insert(ObjectAddress::new(index, 0), Entry::new(U8, Access::ReadOnly, 2));
        for (sub, (_, data_type, default, limits)) in (1..).zip(members) {
            let entry = Entry::new(data_type, Access::ReadWrite, default);
            objects.insert(ObjectAddress::new(index, sub), entry.limits(limits));
        }
    }
}

/// What can be read and not changed. The drive makes no SYNC, takes one of any period without a
/// counter, and its user's unit is the increment.
fn put_constants(objects: &mut ObjectDictionary) {
    use DataType::{U8, U32};
    for (index, name, data_type, value) in [
        (0x1006, "Communication cycle period", U32, 0),
        (0x1007, "Synchronous window length", U32, 0),
        (0x1019, "Synchronous counter overflow value", U8, 0),
        (0x6502, "Supported drive modes", U32, SUPPORTED_MODES),
    ] {
        let entry = Entry::new(data_type, Access::ReadOnly, value);
        objects.insert(ObjectAddress::new(index, 0), entry);
        objects.describe(index, ObjectKind::Variable, name, &[]);
    }
    for (index, name, members) in [
        (0x6091, "Gear ratio", ["Motor revolutions", "Shaft revolutions"]),
        (0x6092, "Feed constant", ["Feed", "Shaft revolutions"]),
    ] {
        objects.insert(ObjectAddress::new(index, 0), Entry::new(U8, Access::ReadOnly, 2));
        for sub in 1..=2 {
            objects.insert(ObjectAddress::new(index, sub), Entry::new(U32, Access::ReadOnly, 1));
        }
        objects.describe(index, ObjectKind::Array, name, &members);
    }
}

fn put_state(objects: &mut ObjectDictionary) {
    use DataType::{I8, I32, U16, U32};
    for (address, name, data_type) in [
        (object::ERROR_CODE, "Error code", U16),
        (object::STATUSWORD, "Statusword", U16),
        (object::MODES_OF_OPERATION_DISPLAY, "Modes of operation display", I8),
        (object::POSITION_DEMAND, "Position demand value", I32),
        (object::POSITION_ACTUAL, "Position actual value", I32),
        (object::VELOCITY_ACTUAL, "Velocity actual value", I32),
        (object::FOLLOWING_ERROR_ACTUAL, "Following error actual value", I32),
        (object::DIGITAL_INPUTS, "Digital inputs", U32),
    ] {
        let entry = Entry::new(data_type, Access::ReadOnly, 0);
        objects.insert(address, entry.mappable(PdoDirection::Transmit));
        objects.describe(address.index, ObjectKind::Variable, name, &[]);
    }
}

/// As real drives come: event-driven, the first of each direction carrying the state machine,
/// and nothing that a cyclic master could use without remapping.
fn put_pdos(objects: &mut ObjectDictionary, config: &DriveConfig) {
    let map =
        |address: ObjectAddress, bits| MappedObject::new(address.index, address.subindex, bits);
    let controlword = map(object::CONTROLWORD, 16);
    let statusword = map(object::STATUSWORD, 16);
    let receive = [
        vec![controlword],
        vec![controlword, map(object::MODES_OF_OPERATION, 8)],
        vec![controlword, map(object::TARGET_POSITION, 32)],
        vec![],
    ];
    let transmit = [
        vec![statusword],
        vec![statusword, map(object::MODES_OF_OPERATION_DISPLAY, 8)],
        vec![statusword, map(object::POSITION_ACTUAL, 32)],
        vec![statusword, map(object::VELOCITY_ACTUAL, 32)],
    ];
    let directions = [(PdoDirection::Receive, receive), (PdoDirection::Transmit, transmit)];
    for (direction, mappings) in directions {
        for (number, mapping) in PdoNumber::ALL.into_iter().zip(mappings) {
            let default = PdoDefault {
                enabled: number == PdoNumber::One,
                transmission: TransmissionType::EventProfile,
                mapping,
            };
            objects.extend(pdo_objects(config.node, direction, number, &default));
        }
    }
}
