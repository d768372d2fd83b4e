//! A CAN bus as the control thread uses it.

use std::io;
use std::time::{Duration, SystemTime};

use crate::canopen::Frame;
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;
use socketcan::CanErrorFrame;
use socketcan::errors::{self, CAN_ERR_BUSOFF, CAN_ERR_RESTARTED};
use std::fmt;
use std::os::fd::BorrowedFd;

/// An event received from the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusEvent {
    /// Another node's frame.
    Frame(Frame),
    /// A report of the controller about itself or the wires.
    Error(BusError),
}

/// A report of a CAN controller about itself and the wires: an error frame as the kernel gives it to programs,
/// with the layout of `linux/can/error.h`. It was never on the bus. One frame may report several errors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BusError(pub CanErrorFrame);

impl BusError {
    /// An error frame with these class bits and 8 data bytes.
    pub fn new(classes: u32, data: [u8; 8]) -> Self {
        BusError(CanErrorFrame::new_error(classes, &data).expect("8 bytes fit an error frame"))
    }

    /// The controller has left the bus: nothing more is sent or received.
    pub fn bus_off() -> Self {
        BusError::new(CAN_ERR_BUSOFF, [0; 8])
    }

    /// True when the controller has left the bus.
    pub fn is_bus_off(&self) -> bool {
        self.0.error_bits() & CAN_ERR_BUSOFF != 0
    }

    /// True when the controller came back after bus off. Frames queued before may be sent now.
    pub fn is_restarted(&self) -> bool {
        self.0.error_bits() & CAN_ERR_RESTARTED != 0
    }
}

/// Names every error that is reported: `bus off; error counters: tx=248, rx=0`.
impl fmt::Display for BusError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        errors::CanError::from(self.0).fmt(f)
    }
}

/// A CAN bus, used by one blocking thread.
///
/// A bus carries each frame to every endpoint but its sender, in the same order for all.
pub trait CanBus: Send {
    /// Queues `frame` for sending. This never blocks and never retries, because a delayed set-point is
    /// stale.
    ///
    /// # Errors
    /// [`CanError::TransmitQueueFull`] when the interface takes no more frames;
    /// [`CanError::NotConfirmed`] when earlier frames were not confirmed; [`CanError::Down`] or
    /// [`CanError::Gone`] when the interface is down or gone; [`CanError::Io`] otherwise.
    fn send(&mut self, frame: &Frame) -> Result<(), CanError>;

    /// Waits up to `timeout` for the next event; `None` if none came in that time. With a zero
    /// `timeout` this returns at once.
    ///
    /// # Errors
    /// [`CanError::Down`], [`CanError::Gone`] or [`CanError::Io`].
    fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError>;

    /// When the kernel received the last event of [`receive`](Self::receive), UTC; `None` if unknown. The
    /// event may have waited since then.
    fn received_at(&self) -> Option<SystemTime> {
        None
    }

    /// Sends an error frame to every other endpoint of a virtual bus, as if its own controller had reported `error`.
    /// Real buses carry no error frames.
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

    /// How many frames this endpoint lost so far because they were not received in time; `None` if the kernel does
    /// not count them.
    fn dropped(&self) -> Option<u64>;
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
    #[error("no interface {0}: {next}", next = bring_up_hint(.0))]
    NoInterface(String),
    /// The interface is another kind, such as a network card.
    #[error("interface {0} is not a CAN interface; ip -brief link show type can lists them")]
    NotCan(String),
    /// The interface is down, or went down while in use.
    #[error("interface {0} is down: {next}", next = bring_up_hint(.0))]
    Down(String),
    /// The interface vanished while in use.
    #[error("interface {0} is gone, was the adapter unplugged?")]
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
        "{interface}: {frames} frames not confirmed on the bus within {syncs} SYNCs, is the cable in and \
         does a node acknowledge?"
    )]
    NotConfirmed {
        /// The interface's name.
        interface: String,
        /// The number of frames that wait.
        frames: usize,
        /// The number of SYNCs whose frames wait.
        syncs: usize,
    },
    /// Another error of the operating system.
    #[error("{interface}: cannot {action}: {reason}")]
    Io {
        /// The interface's name.
        interface: String,
        /// The action that failed.
        action: &'static str,
        /// The error of the operating system.
        reason: io::Error,
    },
}

/// The emulated bus, which no command can bring up.
const MEMORY: &str = "memory";

/// The next step to bring `interface` up: for most interfaces a command.
fn bring_up_hint(interface: &str) -> String {
    if interface == MEMORY {
        "it is emulated, an [[emulator.fault]] took it down".to_owned()
    } else if interface.starts_with("vcan") {
        format!(
            "sudo ip link add dev {interface} type vcan; sudo ip link set {interface} up \
             (or let vcan/run.sh do it)"
        )
    } else if interface.starts_with("vxcan") {
        format!(
            "sudo ip link add dev {interface} type vxcan; sudo ip link set {interface} up, and its peer"
        )
    } else {
        format!(
            "plug the adapter in, then sudo ip link set {interface} up type can bitrate 1000000 \
             restart-ms 0, with the bit rate of your drives"
        )
    }
}

/// Waits up to `timeout` until `socket` has data or an error. It uses ppoll(2), since poll(2) counts whole
/// milliseconds. A signal ends the wait early; the caller then waits again for the remaining time.
pub(super) fn wait_readable(socket: BorrowedFd<'_>, timeout: Duration) -> io::Result<()> {
    let mut sockets = [PollFd::new(socket, PollFlags::POLLIN)];
    match ppoll(&mut sockets, Some(TimeSpec::from_duration(timeout)), None) {
        Ok(_) | Err(Errno::EINTR) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_frame_is_described_with_everything_it_reports() {
        let passive = BusError::new(0x204, [0, 0x30, 0, 0, 0, 0, 136, 128]);
        assert!(!passive.is_bus_off() && BusError::bus_off().is_bus_off());
        assert!(BusError::new(0x100, [0; 8]).is_restarted());
        assert_eq!(BusError::bus_off().to_string(), "bus off");
        assert_eq!(
            passive.to_string(),
            "controller problem: rx passive, tx passive; error counters: tx=136, rx=128"
        );
        assert_eq!(BusError::new(0, [0; 8]).to_string(), "unknown error (0x0)");
    }

    #[test]
    fn messages_give_the_next_step() {
        let text = |error: CanError| error.to_string();
        assert_eq!(
            text(CanError::NoInterface("can0".into())),
            "no interface can0: plug the adapter in, \
             then sudo ip link set can0 up type can bitrate 1000000 restart-ms 0, \
             with the bit rate of your drives"
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
