//! An emulated CiA 402 drive: a CANopen node with an axis behind it.
//!
//! To a master it behaves like a real drive. At power-on its PDOs are event-driven and not mapped for
//! cyclic operation, and heartbeat supervision is off. A stale target is a following error. The axis
//! moves only while the node is Operational and the drive is in Operation Enabled. The drive has
//! homing and cyclic synchronous position (0x6502). Without power the axis stops at once, as a lead
//! screw or a high gear ratio does; Shutdown and Disable Operation do the same here.

mod axis;
mod csp;
mod device;
mod fault_injection;
mod homing;
mod inputs;
mod motion;
mod node;
mod objects;
mod parameters;
mod pdo;
mod profile;
mod state_machine;
#[cfg(test)]
mod tests;

pub use self::homing::HOMING_METHODS;
pub use self::inputs::Switches;
pub use self::node::Drive;

use crate::canopen::{NodeId, ObjectAddress};
use crate::keys::choice;

/// The configuration of an emulated drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DriveConfig {
    /// Its node number, and its serial number (0x1018:04).
    pub node: NodeId,
    /// Its vendor (0x1018:01), assigned by CiA.
    pub vendor: u32,
    /// Its product (0x1018:02).
    pub product: u32,
    /// Position of axis and encoder at power-on.
    pub start_counts: i64,
    /// The maximum speed of the motor, and the power-on value of 0x607F.
    pub speed_max_counts_per_s: u32,
    /// Limit and home switches.
    pub switches: Switches,
    /// The make that the drive imitates.
    pub model: Model,
    /// True if the drive was homed since power-on.
    pub homed: bool,
    /// Objects besides those of the data sheet, and their bits.
    pub more_objects: Vec<(ObjectAddress, u8)>,
}

choice! {
    /// The make that a drive imitates, where the profile leaves a choice.
    ///
    /// The generic drive has all objects of the data sheet, and a limit switch causes a quick stop. On an
    /// EPOS4, TPDOs have no event timer; the unit is the increment (no 0x6091, 0x6092); 0x1006, 0x1007, 0x1019
    /// and 0x6066 are missing; a limit switch is a fault; bit 15 of the statusword says that the axis was
    /// homed.
    pub enum Model {
        /// A drive with all objects of the emulator.
        Generic = "generic",
        /// A maxon EPOS4.
        Epos4 = "epos4",
    }
}

impl DriveConfig {
    /// A drive at position 0, without switches, with a maximum speed of 200,000 counts/s.
    pub fn new(node: NodeId, vendor: u32, product: u32) -> Self {
        DriveConfig {
            node,
            vendor,
            product,
            start_counts: 0,
            speed_max_counts_per_s: 200_000,
            switches: Switches::default(),
            model: Model::Generic,
            homed: false,
            more_objects: Vec::new(),
        }
    }

    /// The electronic data sheet of this drive, for a file called `file_name`.
    pub fn eds(&self, file_name: &str) -> String {
        let mut eds = objects::data_sheet(self);
        eds.set("FileInfo", "FileName", file_name);
        eds.to_string()
    }
}
