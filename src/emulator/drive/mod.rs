//! An emulated CiA 402 drive: a CANopen node with an axis behind it.
//!
//! It behaves as a real one where a master can tell: PDOs come event-driven and unmapped for
//! cyclic work, supervision is off, a stale target is a following error, and nothing moves
//! unless the node is Operational and the drive in Operation Enabled. It offers homing and
//! cyclic synchronous position, and says so in 0x6502. Without power the axis stops
//! dead, as a lead screw or a high gear does: that is also what shutdown and disable operation do
//! here.

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

pub use self::inputs::{End, Switches};

use self::axis::Axis;
use crate::canopen::cia402::DriveState;
use crate::canopen::emcy::EmcyCode;
use crate::canopen::nmt::{NmtCommand, NmtState, nmt_frame};
use crate::canopen::node::Node;
use crate::canopen::{Frame, NodeId};
use crate::units::Time;

/// What an emulated drive is built with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DriveConfig {
    /// Its node number.
    pub node: NodeId,
    /// Who made it, and which of them it is.
    pub identity: Identity,
    /// Its name, 0x1008.
    pub name: String,
    /// Where the axis stands at power-on; the encoder agrees.
    pub start_counts: i64,
    /// The fastest the motor turns; power-on value of 0x607F as well.
    pub speed_max_counts_per_s: u32,
    /// The hardest it accelerates; power-on value of 0x60C5 as well.
    pub acceleration_max_counts_per_s2: u32,
    /// From one index pulse of its encoder to the next.
    pub index_counts: u32,
    /// Limit and home switches.
    pub switches: Switches,
    /// Whose habits it has.
    pub model: Model,
}

/// What a drive says it is, object 0x1018.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Identity {
    /// Subindex 1, given out by CiA.
    pub vendor: u32,
    /// Subindex 2.
    pub product: u32,
    /// Subindex 3.
    pub revision: u32,
    /// Subindex 4.
    pub serial: u32,
}

/// Whose habits a drive has, where the profile leaves a choice or makers leave something out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Model {
    /// All that the emulator has. A limit switch makes a quick stop.
    #[default]
    Generic,
    /// As an EPOS4: TPDOs have no event timer, the unit is the increment (no 0x6091, 0x6092), no
    /// 0x1006, 0x1007 and 0x1019, a limit switch is a fault, and bit 15 of the statusword says that
    /// the axis was homed.
    Epos4,
}

impl DriveConfig {
    /// A drive at position 0 without switches that can do 200,000 counts/s.
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
        }
    }

    /// The electronic data sheet of this drive, for a file called `file_name`.
    pub fn eds(&self, file_name: &str) -> String {
        let mut eds = objects::data_sheet(self);
        eds.set("FileInfo", "FileName", file_name);
        eds.to_string()
    }
}

/// An emulated CiA 402 drive, sans-IO.
///
/// Hand in every frame of the bus, call [`handle_timeout`](Self::handle_timeout) at
/// [`deadline`](Self::deadline), and after either drain [`poll_transmit`](Self::poll_transmit).
///
/// In cyclic synchronous position the target received before a SYNC is reached, exactly and at
/// constant speed, one interpolation period (0x60C2) after that SYNC: at each SYNC the position
/// reported is the true one and equals the target of the SYNC before.
#[derive(Debug, Clone)]
pub struct Drive {
    node: Node<Axis>,
}

impl Drive {
    /// A drive that has just been switched on; its boot-up message waits to be sent.
    pub fn new(config: DriveConfig) -> Self {
        let objects = objects::data_sheet(&config).objects(config.node);
        Drive { node: Node::new(Time::ZERO, config.node, objects, Axis::new(&config)) }
    }

    /// The drive's node number.
    pub fn node(&self) -> NodeId {
        self.node.id()
    }

    /// The node's NMT state.
    pub fn nmt_state(&self) -> NmtState {
        self.node.nmt_state()
    }

    /// The state of the CiA 402 state machine.
    pub fn state(&self) -> DriveState {
        self.node.application().state()
    }

    /// Takes any frame of the bus.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.node.handle_frame(now, frame);
    }

    /// Does what is due at `now`.
    pub fn handle_timeout(&mut self, now: Time) {
        self.node.handle_timeout(now);
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self) -> Option<Frame> {
        self.node.poll_transmit()
    }

    /// When [`handle_timeout`](Self::handle_timeout) wants to be called.
    pub fn deadline(&self) -> Time {
        self.node.deadline()
    }

    /// Switches the supply of the power stage, as an emergency stop does. Losing it with power
    /// applied is a fault (0x3220); the axis stops dead.
    pub fn set_voltage(&mut self, now: Time, on: bool) {
        self.node.apply(now, |axis, device| axis.set_voltage(now, on, device));
    }

    /// Opens or closes the safety input, which takes the torque away (safe torque off). With power
    /// applied that is a fault (0x9000); the axis stops dead.
    pub fn set_interlock(&mut self, now: Time, open: bool) {
        self.node.apply(now, |axis, device| axis.set_interlock(now, open, device));
    }

    /// Blocks the axis, or lets it go: it stays where it is, its targets run away from it, and
    /// beyond 0x6065 for 0x6066 the drive faults (0x8611).
    pub fn set_stalled(&mut self, now: Time, stalled: bool) {
        self.node.apply(now, |axis, device| axis.set_stalled(now, stalled, device));
    }

    /// Lets a limit switch stick closed wherever the axis is; `None`: they are as they are.
    pub fn set_stuck_switch(&mut self, now: Time, end: Option<End>) {
        self.node.apply(now, |axis, _| axis.set_stuck(end));
    }

    /// The drive finds a fault by itself, such as 0x8611: it reacts as 0x605E says.
    pub fn raise_fault(&mut self, now: Time, code: EmcyCode) {
        self.node.apply(now, |axis, device| axis.fault(now, code, code.register(), device));
    }

    /// Its electronics restart, as after a dip of their supply: all values are those of power-on,
    /// and it says so by its boot-up message.
    pub fn restart(&mut self, now: Time) {
        self.handle_frame(now, &nmt_frame(NmtCommand::ResetNode, Some(self.node())));
    }

    /// The true position of the axis in counts, not wrapped to 32 bits; between two SYNCs with
    /// its fraction.
    pub fn position_counts_at(&self, now: Time) -> f64 {
        self.node.application().position_at(now)
    }

    /// The position in whole counts, not wrapped, as the encoder showed it at the last input.
    pub fn position_counts(&self) -> i64 {
        self.node.application().counts()
    }
}
