//! The rules for writing the communication objects (CiA 301, 7.5).

use crate::canopen::object::communication::consumer_heartbeat;
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::canopen::pdo::{MappedObject, PDOS, PdoCobId, PdoDirection, PdoMapping};
use crate::canopen::sdo::AbortCode;
use crate::canopen::{ObjectAddress, cob};

use super::pdo::{EVENT_MANUFACTURER, EVENT_PROFILE, SYNC_EVERY_MAX};

/// How many nodes a node can supervise: entries of 0x1016.
pub(super) const SUPERVISED_LEN: u8 = 4;
/// Objects a PDO can carry at most: entries of its mapping.
const MAPPING_LEN: u8 = 8;

/// Which PDO's parameters an index belongs to.
pub(super) fn pdo_of(index: u16) -> Option<(PdoDirection, u16)> {
    match (index & 0xff00, index & 0xff) {
        (0x1400 | 0x1600, offset @ 0..PDOS) => Some((PdoDirection::Receive, offset)),
        (0x1800 | 0x1a00, offset @ 0..PDOS) => Some((PdoDirection::Transmit, offset)),
        _ => None,
    }
}

/// The mapping in the objects; empty while subindex 0 is 0.
pub(super) fn mapping_of(
    objects: &ObjectDictionary,
    direction: PdoDirection,
    offset: u16,
) -> PdoMapping {
    let index = direction.mapping_index(offset);
    let count = objects.integer(ObjectAddress::new(index, 0));
    PdoMapping::new(mapping_entries(objects, index, count)).unwrap_or_default()
}

fn mapping_entries(objects: &ObjectDictionary, index: u16, count: i64) -> Vec<MappedObject> {
    let count = u8::try_from(count).unwrap_or(MAPPING_LEN).min(MAPPING_LEN);
    (1..=count)
        .map(|sub| objects.integer(ObjectAddress::new(index, sub)))
        .map(|entry| MappedObject::from_u32(entry as u32))
        .collect()
}

/// Checks that the communication object `object` may become `value`.
///
/// # Errors
/// The abort code to refuse with.
pub(super) fn check_write(
    objects: &ObjectDictionary,
    object: ObjectAddress,
    value: i64,
) -> Result<(), AbortCode> {
    let allowed = match (object.index, pdo_of(object.index)) {
        (0x1600..=0x17ff | 0x1a00.., Some((direction, _))) => {
            return check_mapping(objects, object, direction, value);
        }
        (_, Some(_)) => may_set_pdo_parameter(objects, object, value),
        // The error history can only be erased.
        (0x1003, _) => value == 0,
        // No SYNC producer, no 29-bit identifiers.
        (0x1005, _) => (0..=0x7ff).contains(&value) && !is_restricted(value as u16),
        // The identifier is fixed; bit 31 switches the messages off.
        (0x1014, _) => (value ^ objects.integer(object)) & 0x7fff_ffff == 0,
        (0x1016, _) => return check_supervision(objects, object.subindex, value as u32),
        _ => true,
    };
    if allowed { Ok(()) } else { Err(AbortCode::INVALID_VALUE) }
}

fn check_supervision(
    objects: &ObjectDictionary,
    subindex: u8,
    entry: u32,
) -> Result<(), AbortCode> {
    let node_and_time = |entry: u32| ((entry >> 16) as u8, entry as u16);
    let (node, time) = node_and_time(entry);
    if time != 0 && (entry >> 24 != 0 || node > 127) {
        return Err(AbortCode::INVALID_VALUE);
    }
    let is_supervised_already =
        (1..=SUPERVISED_LEN).filter(|other| *other != subindex).any(|other| {
            let other = objects.integer(consumer_heartbeat(other)) as u32;
            let (other_node, other_time) = node_and_time(other);
            time != 0 && node != 0 && other_time != 0 && other_node == node
        });
    if is_supervised_already { Err(AbortCode::PARAMETER_INCOMPATIBLE) } else { Ok(()) }
}

/// True if a communication parameter of a PDO may become `value`.
fn may_set_pdo_parameter(objects: &ObjectDictionary, object: ObjectAddress, value: i64) -> bool {
    let current = PdoCobId(objects.integer(ObjectAddress::new(object.index, 1)) as u32);
    match object.subindex {
        1 => {
            let wanted = PdoCobId(value as u32);
            let same_id = (current.0 ^ wanted.0) & 0x3fff_ffff == 0;
            let is_free = |cob_id| cob_id != cob::SYNC && !is_restricted(cob_id);
            let usable = wanted.cob_id().is_some_and(|id| !wanted.is_valid() || is_free(id));
            (same_id || !current.is_valid()) && usable
        }
        2 => matches!(value as u8, 1..=SYNC_EVERY_MAX | EVENT_MANUFACTURER | EVENT_PROFILE),
        3 => !current.is_valid(),
        _ => true,
    }
}

/// True for an identifier that no object may be given (CiA 301, table 39).
fn is_restricted(cob_id: u16) -> bool {
    matches!(
        cob_id,
        0x000..=0x07f | 0x101..=0x180 | 0x581..=0x5ff | 0x601..=0x67f | 0x6e0..=0x6ff | 0x701..
    )
}

/// A mapping changes while its PDO is off, and its entries while their number, subindex 0, is 0.
fn check_mapping(
    objects: &ObjectDictionary,
    ObjectAddress { index, subindex }: ObjectAddress,
    direction: PdoDirection,
    value: i64,
) -> Result<(), AbortCode> {
    let cob_id = objects.integer(ObjectAddress::new(index - 0x200, 1));
    let mapped = objects.integer(ObjectAddress::new(index, 0)) != 0;
    if PdoCobId(cob_id as u32).is_valid() || (subindex != 0 && mapped) {
        return Err(AbortCode::UNSUPPORTED_ACCESS);
    }
    let check = |entry: MappedObject| objects.check_mappable(entry.object, entry.bits, direction);
    if subindex != 0 {
        return check(MappedObject::from_u32(value as u32));
    }
    if value > i64::from(MAPPING_LEN) {
        return Err(AbortCode::PDO_LENGTH_EXCEEDED);
    }
    let entries = mapping_entries(objects, index, value);
    entries.iter().try_for_each(|entry| check(*entry))?;
    PdoMapping::new(entries).map(|_| ()).ok_or(AbortCode::PDO_LENGTH_EXCEEDED)
}
