//! An emulated CiA 402 drive: a CANopen node with an axis behind it.
//!
//! To a master it behaves like a real drive. At power-on its PDOs are event-driven and not mapped for
//! cyclic operation, and heartbeat supervision is off. A stale target is a following error. The axis
//! moves only while the node is Operational and the drive is in Operation Enabled. The drive has
//! homing and cyclic synchronous position (0x6502). Without power the axis stops at once, as a lead
//! screw or a high gear ratio does; Shutdown and Disable Operation do the same here.

mod axis;
mod csp;
mod homing;
mod inputs;
mod motion;
mod objects;
mod profile;
mod state_machine;
#[cfg(test)]
mod tests;

pub use self::inputs::Switches;

use self::axis::Axis;
use super::fault::{Fault, FaultKind};
use crate::canopen::cia402::DriveState;
use crate::canopen::nmt::{NmtCommand, nmt_frame};
use crate::canopen::node::Node;
use crate::canopen::{NodeId, ObjectAddress};
use crate::keys::choice;
use crate::units::Time;

/// The configuration of an emulated drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DriveConfig {
    /// Its node number.
    pub node: NodeId,
    /// Its identity, 0x1018.
    pub identity: Identity,
    /// Its name, 0x1008.
    pub name: String,
    /// Position of axis and encoder at power-on.
    pub start_counts: i64,
    /// The maximum speed of the motor, and the power-on value of 0x607F.
    pub speed_max_counts_per_s: u32,
    /// The maximum acceleration of the motor, and the power-on value of 0x60C5.
    pub acceleration_max_counts_per_s2: u32,
    /// Counts between two index pulses of the encoder.
    pub index_counts: u32,
    /// Limit and home switches.
    pub switches: Switches,
    /// The make that it imitates.
    pub model: Model,
    /// It was homed since power-on.
    pub homed: bool,
    /// Objects of its own besides those of the data sheet, and their bits.
    pub more_objects: Vec<(ObjectAddress, u8)>,
}

/// The identity of a drive, object 0x1018.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Identity {
    /// Subindex 1, assigned by CiA.
    pub vendor: u32,
    /// Subindex 2.
    pub product: u32,
    /// Subindex 3.
    pub revision: u32,
    /// Subindex 4.
    pub serial: u32,
}

choice! {
    /// The make that a drive imitates, where the profile leaves a choice.
    ///
    /// The generic drive has all objects of the data sheet, and a limit switch causes a quick stop. Of an
    /// EPOS4 TPDOs have no event timer; the unit is the increment (no 0x6091, 0x6092); 0x1006, 0x1007, 0x1019
    /// and 0x6066 are missing; a limit switch is a fault; bit 15 of the statusword says that the axis was
    /// homed.
    pub enum Model {
        /// All that the emulator has.
        Generic = "generic",
        /// As an EPOS4.
        Epos4 = "epos4",
    }
}

impl DriveConfig {
    /// A drive at position 0, without switches, with a maximum speed of 200,000 counts/s.
    pub fn new(node: NodeId, identity: Identity) -> Self {
        DriveConfig {
            node,
            identity,
            name: "emulated drive".into(),
            start_counts: 0,
            speed_max_counts_per_s: 200_000,
            acceleration_max_counts_per_s2: 100_000_000,
            index_counts: 2000,
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

/// An emulated CiA 402 drive, sans-IO: [`Node`] says how it is driven.
///
/// In cyclic synchronous position the axis reaches the target received before a SYNC exactly, at
/// constant speed, one interpolation period (0x60C2) after that SYNC. So the position reported at each
/// SYNC is the target of the SYNC before.
pub type Drive = Node<Axis>;

impl Drive {
    /// A drive that has just been switched on; its boot-up message waits to be sent.
    pub fn new(config: DriveConfig) -> Self {
        let node = config.node;
        let objects = objects::data_sheet(&config).objects(node);
        Node::switched_on(Time::ZERO, node, objects, Axis::new(config))
    }

    /// The state of the CiA 402 state machine.
    pub fn state(&self) -> DriveState {
        self.application().state()
    }

    /// A fault of the drive or its axis begins or ends; faults of frames and of the bus do nothing here.
    pub fn apply_fault(&mut self, now: Time, fault: &Fault, begins: bool) {
        match fault.kind {
            // It restarts again at the end, so that its boot-up message is received.
            FaultKind::Restart => {
                self.handle_frame(now, &nmt_frame(NmtCommand::ResetNode, Some(self.id())));
            }
            FaultKind::Stall
            | FaultKind::DriveFault
            | FaultKind::NegativeSwitch
            | FaultKind::PositiveSwitch
            | FaultKind::EmergencyStop
            | FaultKind::NoVoltage => {
                self.apply(now, |axis, device| axis.apply_fault(now, fault, begins, device));
            }
            _ => {}
        }
    }

    /// The true position of the axis in counts, not wrapped to 32 bits and not rounded.
    pub fn position_counts_at(&self, now: Time) -> f64 {
        self.application().position_at(now)
    }
}
