//! A CAN bus as the control thread uses it.

use std::io;
use std::time::{Duration, SystemTime};

use super::bus_error::BusError;
use crate::canopen::Frame;

/// An event received from the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusEvent {
    /// Another node's frame.
    Frame(Frame),
    /// A report of the controller about itself or the wires.
    Error(BusError),
}

/// A CAN bus, used by one blocking thread.
///
/// A bus carries each frame to every endpoint but its sender, in the same order for all.
pub trait CanBus: Send {
    /// Queues `frame` for sending. It never blocks and never retries, because a delayed set-point is
    /// stale.
    ///
    /// # Errors
    /// [`CanError::TransmitQueueFull`] when the interface takes no more frames;
    /// [`CanError::NotConfirmed`] when earlier frames were not sent; [`CanError::Down`] and
    /// [`CanError::Gone`] when the interface has gone; [`CanError::Io`] otherwise.
    fn send(&mut self, frame: &Frame) -> Result<(), CanError>;

    /// Waits up to `timeout` for the next event; `None` when none came in that time. With a zero
    /// `timeout` it returns at once.
    ///
    /// # Errors
    /// [`CanError::Down`], [`CanError::Gone`] or [`CanError::Io`].
    fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError>;

    /// When the kernel received the last event of [`receive`](Self::receive), UTC; `None` if unknown. The
    /// event may have waited since then.
    fn received_at(&self) -> Option<SystemTime> {
        None
    }

    /// Puts an error frame on the bus, as if every controller on it had reported `error`. Real buses
    /// carry no error frames.
    ///
    /// # Errors
    /// [`CanError::Io`] on a bus that cannot do so; otherwise as [`send`](Self::send).
    fn report(&mut self, error: &BusError) -> Result<(), CanError> {
        let (interface, action) = (self.name().to_owned(), "put an error frame on the bus");
        let reason = io::Error::new(io::ErrorKind::Unsupported, error.to_string());
        Err(CanError::Io { interface, action, reason })
    }

    /// The interface's name, for messages and logs.
    fn name(&self) -> &str;

    /// How many frames this endpoint lost so far because they were not received in time.
    ///
    /// # Errors
    /// [`CanError::Io`] if the kernel does not count them.
    fn dropped(&self) -> Result<u64, CanError>;
}

/// Why a bus could not be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum CanError {
    /// The kernel has no CAN, built in or as a module.
    #[error(
        "this kernel has no CAN (AF_CAN unsupported), so no {0}: sudo modprobe can-raw, or \
         vcan/run.sh COMMAND with vcan0, or can.interface = \"memory\""
    )]
    NoCan(String),
    /// There is no interface of this name.
    #[error("no interface {0}: {next}", next = bring_up(.0))]
    NoInterface(String),
    /// The interface is another kind, such as a network card.
    #[error("interface {0} is not a CAN interface; ip -brief link show type can lists them")]
    NotCan(String),
    /// The interface is down, or went down while in use.
    #[error("interface {0} is down: {next}", next = bring_up(.0))]
    Down(String),
    /// The interface vanished while in use.
    #[error("interface {0} is gone; was the adapter unplugged")]
    Gone(String),
    /// Frames are not leaving: no other node acknowledges them, the bus is off, or it is full.
    #[error(
        "{interface} takes no more frames, {frame} was not sent: its transmit queue is full; \
         check cable, termination, bitrate and that the drives are on"
    )]
    TransmitQueueFull {
        /// The interface's name.
        interface: String,
        /// The frame that was not sent.
        frame: Frame,
    },
    /// Queued frames were not sent, so no more are taken. They leave when a node acknowledges again.
    #[error(
        "{interface}: {frames} frames not confirmed on the bus within 2 SYNCs, is the cable in and \
         does anyone acknowledge?"
    )]
    NotConfirmed {
        /// The interface's name.
        interface: String,
        /// How many wait.
        frames: usize,
    },
    /// Another error of the operating system.
    #[error("{interface}: cannot {action}: {reason}")]
    Io {
        /// The interface's name.
        interface: String,
        /// What was being done.
        action: &'static str,
        /// The error of the operating system.
        reason: io::Error,
    },
}

/// The emulated bus, which no command can bring up.
const MEMORY: &str = "memory";

/// The command that brings `interface` up.
fn bring_up(interface: &str) -> String {
    if interface == MEMORY {
        "it is emulated, an [[emulator.fault]] took it down".to_owned()
    } else if interface.starts_with("vcan") {
        format!(
            "sudo ip link add dev {interface} type vcan; sudo ip link set {interface} up \
             (or let vcan/run.sh do it)"
        )
    } else {
        format!(
            "plug the adapter in, then sudo ip link set {interface} up type can bitrate 1000000"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_give_the_next_step() {
        let text = |error: CanError| error.to_string();
        assert_eq!(
            text(CanError::NoInterface("can0".into())),
            "no interface can0: plug the adapter in, \
             then sudo ip link set can0 up type can bitrate 1000000"
        );
        assert_eq!(
            text(CanError::Down("memory".into())),
            "interface memory is down: it is emulated, an [[emulator.fault]] took it down"
        );
        assert_eq!(
            text(CanError::Down("vcan1".into())),
            "interface vcan1 is down: sudo ip link add dev vcan1 type vcan; \
             sudo ip link set vcan1 up (or let vcan/run.sh do it)"
        );
        let frame = Frame::new(0x201, &[0x0F, 0]);
        let full = CanError::TransmitQueueFull { interface: "can0".into(), frame };
        assert!(text(full).starts_with("can0 takes no more frames, 201#0F00 was not sent"));
    }
}
