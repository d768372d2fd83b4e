//! The drive's objects and their power-on values, after an EPOS4.

use super::DriveConfig;
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::object;
use crate::canopen::node::{DeviceInfo, PdoDefault, pdo_objects, standard_objects};
use crate::canopen::object_dictionary::{Access, DataType, Entry, ObjectDictionary};
use crate::canopen::pdo::{MappedObject, PdoDirection, PdoNumber, TransmissionType};

/// Bit 7 of 0x6502: cyclic synchronous position, and nothing else.
const SUPPORTED_MODES: i64 = 1 << 7;

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
    put_state(&mut objects);
    put_pdos(&mut objects, config);
    objects
}

fn put_commands(objects: &mut ObjectDictionary) {
    for (address, data_type) in [
        (object::CONTROLWORD, DataType::U16),
        (object::MODES_OF_OPERATION, DataType::I8),
        (object::TARGET_POSITION, DataType::I32),
    ] {
        let entry = Entry::new(data_type, Access::ReadWrite, 0);
        objects.insert(address, entry.mappable(PdoDirection::Receive));
    }
}

fn put_settings(objects: &mut ObjectDictionary, config: &DriveConfig) {
    use DataType::{I8, I16, I32, U8, U32};
    let positive = 1..=i64::from(u32::MAX);
    let speed_max = config.speed_max_counts_per_s;
    let rows = [
        (object::ABORT_CONNECTION_OPTION, I16, 1, 0..=3),
        (object::QUICK_STOP_OPTION, I16, 2, 0..=6),
        (object::HALT_OPTION, I16, 1, 1..=2),
        (object::FAULT_REACTION_OPTION, I16, 2, 0..=2),
        (object::FOLLOWING_ERROR_WINDOW, U32, 2000, 0..=i64::from(u32::MAX)),
        (object::MAX_PROFILE_VELOCITY, U32, speed_max.into(), positive.clone()),
        (object::PROFILE_VELOCITY, U32, 1000, 0..=i64::from(u32::MAX)),
        (object::PROFILE_ACCELERATION, U32, 10_000, positive.clone()),
        (object::PROFILE_DECELERATION, U32, 10_000, positive.clone()),
        (object::QUICK_STOP_DECELERATION, U32, 100_000, positive),
        (object::INTERPOLATION_PERIOD_VALUE, U8, 1, 1..=255),
        (object::INTERPOLATION_PERIOD_EXPONENT, I8, -3, -6..=0),
        // Both 0: no limits.
        (object::SOFTWARE_LIMIT_MIN, I32, 0, i32::MIN.into()..=i32::MAX.into()),
        (object::SOFTWARE_LIMIT_MAX, I32, 0, i32::MIN.into()..=i32::MAX.into()),
    ];
    for (address, data_type, default, limits) in rows {
        let entry = Entry::new(data_type, Access::ReadWrite, default);
        objects.insert(address, entry.limits(limits));
    }
    for index in [0x607d, 0x60c2] {
        let count = Entry::new(U8, Access::ReadOnly, 2);
        objects.insert(ObjectAddress::new(index, 0), count);
    }
}

fn put_state(objects: &mut ObjectDictionary) {
    use DataType::{I8, I32, U16, U32};
    for (address, data_type) in [
        (object::ERROR_CODE, U16),
        (object::STATUSWORD, U16),
        (object::MODES_OF_OPERATION_DISPLAY, I8),
        (object::POSITION_DEMAND, I32),
        (object::POSITION_ACTUAL, I32),
        (object::VELOCITY_ACTUAL, I32),
        (object::FOLLOWING_ERROR_ACTUAL, I32),
        (object::DIGITAL_INPUTS, U32),
    ] {
        let entry = Entry::new(data_type, Access::ReadOnly, 0);
        objects.insert(address, entry.mappable(PdoDirection::Transmit));
    }
    let modes = Entry::new(U32, Access::ReadOnly, SUPPORTED_MODES);
    objects.insert(object::SUPPORTED_MODES, modes);
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
