//! An emulated CiA 402 drive: a CANopen node with an axis behind it.
//!
//! It behaves as a real one where a master can tell: PDOs come event-driven and unmapped for
//! cyclic work, supervision is off, a stale target is a following error, and nothing moves
//! unless the node is Operational and the drive in Operation Enabled. It offers cyclic
//! synchronous position alone and says so in 0x6502. Without power the axis stops dead, as a lead
//! screw or a high gear does: that is also what shutdown and disable operation do here.

mod axis;
mod motion;
mod objects;
mod state_machine;
#[cfg(test)]
mod tests;

use self::axis::Axis;
use crate::canopen::cia402::DriveState;
use crate::canopen::nmt::NmtState;
use crate::canopen::node::{Identity, Node};
use crate::canopen::{Frame, NodeId};
use crate::units::Time;

/// What an emulated drive is built with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DriveConfig {
    /// Its node number.
    pub node: NodeId,
    /// What it says it is, 0x1018.
    pub identity: Identity,
    /// Its name, 0x1008.
    pub name: String,
    /// Where the axis stands at power-on; the encoder agrees.
    pub start_counts: i64,
    /// The fastest the motor turns; power-on value of 0x607F as well.
    pub speed_max_counts_per_s: u32,
    /// The negative limit switch closes at and below this position: bit 0 of 0x60FD.
    pub negative_switch_counts: Option<i64>,
    /// The positive limit switch closes at and above this position: bit 1 of 0x60FD.
    pub positive_switch_counts: Option<i64>,
}

impl DriveConfig {
    /// A drive at position 0 without limit switches that can do 200,000 counts/s.
    pub fn new(node: NodeId, identity: Identity) -> Self {
        DriveConfig {
            node,
            identity,
            name: "emulated drive".into(),
            start_counts: 0,
            speed_max_counts_per_s: 200_000,
            negative_switch_counts: None,
            positive_switch_counts: None,
        }
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
        let objects = objects::dictionary(&config);
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
