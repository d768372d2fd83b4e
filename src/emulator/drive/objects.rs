//! The drive's objects: its electronic data sheet, with the values of the configuration.

use std::fmt::Display;

use super::{DriveConfig, Model};
use crate::canopen::ObjectAddress;
use crate::canopen::eds::Eds;
use crate::canopen::pdo::{PDOS, PdoDirection};

/// u32, counts per second squared.
pub(super) const MAX_ACCELERATION: ObjectAddress = ObjectAddress::new(0x60c5, 0);

/// The maximum acceleration of the motor: the power-on value of [`MAX_ACCELERATION`].
pub(super) const ACCELERATION_MAX_COUNTS_PER_S2: f64 = 100_000_000.0;

/// The data sheet of a generic drive. The PDOs are as on real drives: event-driven, and without the mapping
/// that a master under SYNC needs.
const GENERIC: &str = include_str!("drive.eds");

/// Objects of CiA 301 and 402 that an EPOS4 does not have: communication cycle, window and
/// counter of SYNC, following error time out, home offset, gear ratio and feed constant (its unit is the
/// increment).
const NOT_IN_EPOS4: [u16; 7] = [0x1006, 0x1007, 0x1019, 0x6066, 0x607c, 0x6091, 0x6092];

pub(super) fn data_sheet(config: &DriveConfig) -> Eds {
    let mut eds = Eds::parse(GENERIC);
    let DriveConfig { node, vendor, product, .. } = config;
    eds.set("DeviceInfo", "VendorNumber", format_args!("0x{vendor:08X}"));
    eds.set("DeviceInfo", "ProductNumber", format_args!("0x{product:08X}"));
    let mut set_default = |section, value: &dyn Display| eds.set(section, "DefaultValue", value);
    set_default("100A", &env!("CARGO_PKG_VERSION"));
    set_default("1018sub1", vendor);
    set_default("1018sub2", product);
    set_default("1018sub4", node);
    set_default("607F", &config.speed_max_counts_per_s);
    for (address, bits) in &config.more_objects {
        eds.add_number(*address, *bits);
    }
    if config.model == Model::Epos4 {
        NOT_IN_EPOS4.into_iter().for_each(|index| eds.remove_object(index));
        for offset in 0..PDOS {
            remove_event_timer(&mut eds, PdoDirection::Transmit.communication_index(offset));
        }
    }
    eds
}

/// Removes subindex 5 of a TPDO's communication parameters, which leaves the subindices 0 to 3.
fn remove_event_timer(eds: &mut Eds, index: u16) {
    eds.remove_section(&format!("{index:04X}sub5"));
    eds.set(&format!("{index:04X}"), "SubNumber", 4);
    eds.set(&format!("{index:04X}sub0"), "DefaultValue", 3);
}

#[cfg(test)]
mod tests {
    use super::GENERIC;
    use crate::canopen::eds::Eds;
    use crate::canopen::{NodeId, ObjectAddress};

    /// `Eds::objects` leaves out a value of unknown type and a number that it cannot read.
    #[test]
    fn every_default_value_of_the_data_sheet_is_an_object() {
        let objects = Eds::parse(GENERIC).objects(const { NodeId::new(5).unwrap() });
        let sections = GENERIC.split("\n[").filter(|section| section.contains("DefaultValue="));
        let mut values = 0;
        for section in sections {
            let (name, _) = section.split_once(']').unwrap();
            let (index, sub) = name.split_once("sub").unwrap_or((name, "0"));
            let index = u16::from_str_radix(index, 16).unwrap();
            let sub = u8::from_str_radix(sub, 16).unwrap();
            assert!(objects.read(ObjectAddress::new(index, sub)).is_ok(), "{name}");
            values += 1;
        }
        assert_eq!(values, GENERIC.matches("DefaultValue=").count());
    }
}
