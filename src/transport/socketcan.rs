//! Linux SocketCAN: `can0`, `vcan0` and their like.

use std::io::{self, ErrorKind};
use std::os::fd::AsFd;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use nix::errno::Errno;
use socketcan::timestamp::{
    SOF_TIMESTAMPING_OPT_CMSG, SOF_TIMESTAMPING_RX_SOFTWARE, SOF_TIMESTAMPING_SOFTWARE,
};
use socketcan::{
    CanDataFrame, CanFilter, CanFrame, CanRemoteFrame, CanSocket, EmbeddedFrame, ExtendedId, Id,
    Socket, SocketOptions, StandardId,
};

use super::can::{BusError, BusEvent, CanBus, CanError, wait_readable};
use super::unconfirmed::Unconfirmed;
use crate::canopen::{CanId, Frame, NodeId};

// getsockopt(2): SO_MEMINFO gives nine u32; the last is the number of frames dropped by a full buffer.
const SOL_SOCKET: i32 = 1;
const SO_MEMINFO: i32 = 55;
const MEMINFO_BYTES: usize = 9 * 4;

// linux/can.h: the flag of an extended identifier, here as part of a filter's mask.
const CAN_EFF_FLAG: u32 = 0x8000_0000;
/// The node number in an identifier of the predefined connection set (CiA 301, 7.3.3).
const NODE_BITS: u32 = 0x7F;

/// Size of the receive buffer; the kernel gives at most twice `net.core.rmem_max`. A frame takes some
/// 0.8 KiB, so the default of 208 KiB is full after 25 ms at 10,000 frames a second.
const RECEIVE_BUFFER_BYTES: usize = 4 << 20;
/// To drain the receive buffer, at most this many frames are read: more than the buffer holds.
const DRAIN_MAX: usize = 16_384;

/// Timestamps that the kernel takes when the driver hands a frame over.
const STAMPS: u32 =
    SOF_TIMESTAMPING_RX_SOFTWARE | SOF_TIMESTAMPING_SOFTWARE | SOF_TIMESTAMPING_OPT_CMSG;

/// A raw socket on one CAN interface, with error frames and the kernel's receive timestamps.
///
/// Other programs on the interface receive the frames sent here. [`receive`](CanBus::receive) gives only
/// frames of others; the echoes of its own frames, if enabled, confirm that they were sent.
#[derive(Debug)]
pub struct SocketCan {
    interface: String,
    socket: CanSocket,
    received_at: Option<SystemTime>,
    /// The frames sent and not yet confirmed; `None` if sending need not be confirmed.
    unconfirmed: Option<Unconfirmed>,
}

impl SocketCan {
    /// Opens `interface`, which must exist and be up.
    ///
    /// # Errors
    /// [`CanError::NoCan`], [`CanError::NoInterface`], [`CanError::NotCan`], [`CanError::Down`],
    /// each with the next step; [`CanError::Io`] for all others, such as missing permission.
    pub fn open(interface: &str) -> Result<Self, CanError> {
        let socket = CanSocket::open(interface).map_err(|error| cannot_open(interface, error))?;
        let interface = interface.to_owned();
        let bus = SocketCan { interface, socket, received_at: None, unconfirmed: None };
        let set_up = || {
            bus.socket.set_error_filter_accept_all()?;
            bus.socket.set_timestamping(STAMPS)?;
            bus.socket.set_nonblocking(true)?;
            bus.socket.as_raw_socket().set_recv_buffer_size(RECEIVE_BUFFER_BYTES)?;
            // Binding to an interface that is down succeeds and leaves the error here.
            bus.socket.as_raw_socket().take_error()
        };
        match set_up() {
            Ok(None) => Ok(bus),
            Ok(Some(error)) | Err(error) => Err(failed(&bus.interface, "set the socket up")(error)),
        }
    }

    /// Requires every frame to be confirmed: the kernel echoes a frame when the controller has sent it and
    /// another node has acknowledged it. While the frames of `syncs_max` SYNCs wait for that, no more frames
    /// are accepted. Call this before the first frame. Echoes are taken only in [`receive`](CanBus::receive).
    ///
    /// # Errors
    /// [`CanError::Io`] if the kernel gives no echoes.
    pub fn confirm_sending(&mut self, syncs_max: usize) -> Result<(), CanError> {
        self.socket.set_recv_own_msgs(true).map_err(failed(&self.interface, "ask for echoes"))?;
        self.unconfirmed = Some(Unconfirmed::new(syncs_max));
        Ok(())
    }

    /// Stops waiting for echoes: an interface or controller that has failed has dropped the frames.
    fn give_up_unconfirmed(&mut self) {
        self.unconfirmed.iter_mut().for_each(Unconfirmed::give_up);
    }

    /// Makes the kernel pass only frames from or to `nodes`, frames to all nodes, and error frames. Frames
    /// received before are dropped, as if the socket had been opened now.
    ///
    /// # Errors
    /// [`CanError::Io`], or [`CanError::Down`] if the interface went down.
    pub fn listen_to(&mut self, nodes: &[NodeId]) -> Result<(), CanError> {
        let numbers = nodes.iter().map(|node| u32::from(node.get()));
        // Broadcast objects have the node bits 0: NMT, SYNC, TIME.
        let filters: Vec<CanFilter> = std::iter::once(0)
            .chain(numbers)
            .map(|number| CanFilter::new(number, NODE_BITS | CAN_EFF_FLAG))
            .collect();
        self.socket.set_filters(&filters).map_err(failed(&self.interface, "set filters"))?;
        // Bounded, since a flood that passes the filters would never let this end.
        for _ in 0..DRAIN_MAX {
            if self.receive(Duration::ZERO)?.is_none() {
                break;
            }
        }
        self.received_at = None;
        Ok(())
    }

    /// Confirms the own frame of which `event` is the echo; false if it is none. An error that says that the
    /// controller dropped its frames ends the wait for their echoes.
    fn take_echo(&mut self, event: &BusEvent) -> bool {
        match event {
            BusEvent::Frame(frame) => {
                self.unconfirmed.as_mut().is_some_and(|waiting| waiting.take_echo(frame))
            }
            BusEvent::Error(error) => {
                if error.is_bus_off() || error.is_restarted() {
                    self.give_up_unconfirmed();
                }
                false
            }
        }
    }
}

impl CanBus for SocketCan {
    fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
        // If the kernel does not count dropped frames, none are known to be dropped.
        let dropped = match self.unconfirmed {
            Some(_) => self.dropped().unwrap_or_default(),
            None => 0,
        };
        if let Some(waiting) = &mut self.unconfirmed
            && let Some((frames, syncs)) = waiting.too_many()
        {
            if !waiting.may_be_dropped(dropped) {
                let interface = self.interface.clone();
                return Err(CanError::NotConfirmed { interface, frames, syncs });
            }
            waiting.give_up();
        }
        let sent = match to_socketcan(frame) {
            Some(frame) => self.socket.write_frame(&frame),
            None => Err(ErrorKind::InvalidInput.into()),
        };
        match sent {
            Ok(()) => {
                self.unconfirmed.iter_mut().for_each(|waiting| waiting.sent(*frame, dropped));
                Ok(())
            }
            // ENOBUFS: the interface's queue is full. EAGAIN: the socket's queue is full.
            Err(error)
                if errno(&error) == Some(Errno::ENOBUFS)
                    || error.kind() == ErrorKind::WouldBlock =>
            {
                let interface = self.interface.clone();
                Err(CanError::TransmitQueueFull { interface, frame: *frame })
            }
            Err(error) => {
                self.give_up_unconfirmed();
                Err(failed(&self.interface, "send")(error))
            }
        }
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError> {
        let start = Instant::now();
        loop {
            let remaining = timeout.saturating_sub(start.elapsed());
            match self.socket.read_frame_with_timestamps() {
                Ok((frame, stamps)) => {
                    let event = to_event(&frame).map_err(failed(&self.interface, "receive"))?;
                    if self.take_echo(&event) {
                        continue;
                    }
                    self.received_at = stamps.sw;
                    return Ok(Some(event));
                }
                Err(error) if !is_nothing_yet(&error) => {
                    self.give_up_unconfirmed();
                    return Err(failed(&self.interface, "receive")(error));
                }
                Err(_) if remaining.is_zero() => return Ok(None),
                Err(_) => wait_readable(self.socket.as_fd(), remaining)
                    .map_err(failed(&self.interface, "receive"))?,
            }
        }
    }

    fn received_at(&self) -> Option<SystemTime> {
        self.received_at
    }

    fn report(&mut self, error: &BusError) -> Result<(), CanError> {
        let sent = self.socket.write_frame(&CanFrame::Error(error.0));
        sent.map_err(failed(&self.interface, "put an error frame on the bus"))
    }

    fn name(&self) -> &str {
        &self.interface
    }

    fn dropped(&self) -> Option<u64> {
        let mut info = [0; MEMINFO_BYTES];
        let read = self.socket.get_socket_option_bytes(SOL_SOCKET, SO_MEMINFO, &mut info);
        let [.., a, b, c, d] = info;
        (read.ok()? == MEMINFO_BYTES).then(|| u32::from_ne_bytes([a, b, c, d]).into())
    }
}

/// An error of the operating system as a [`CanError`]. For an interface that vanished, the first error is
/// ENODEV, and ENXIO at each later frame.
fn failed(interface: &str, action: &'static str) -> impl FnOnce(io::Error) -> CanError {
    let interface = interface.to_owned();
    move |reason| match errno(&reason) {
        Some(Errno::ENETDOWN) => CanError::Down(interface),
        Some(Errno::ENODEV | Errno::ENXIO) => CanError::Gone(interface),
        _ => CanError::Io { interface, action, reason },
    }
}

/// The error number of the operating system.
fn errno(error: &io::Error) -> Option<Errno> {
    error.raw_os_error().map(Errno::from_raw)
}

/// True if `interface` has a device behind it, whatever its name. vcan and vxcan have none.
pub fn has_device(interface: &str) -> bool {
    Path::new("/sys/class/net").join(interface).join("device").exists()
}

/// True when there is no frame yet, or a signal interrupted the call.
fn is_nothing_yet(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted)
}

/// Why `interface` did not open. The kernel looks up the name before it checks for CAN, so ENODEV has
/// three causes: no CAN in the kernel, an interface that is not CAN, and no such interface.
fn cannot_open(interface: &str, error: io::Error) -> CanError {
    // Interface 0 stands for all CAN interfaces: this fails only if the kernel has no CAN.
    let without_interface = CanSocket::open_iface(0).err().and_then(|error| errno(&error));
    let interface = interface.to_owned();
    match (without_interface, errno(&error)) {
        (Some(Errno::EAFNOSUPPORT | Errno::EPROTONOSUPPORT), _) => CanError::NoCan(interface),
        (_, Some(Errno::ENODEV)) if Path::new("/sys/class/net").join(&interface).exists() => {
            CanError::NotCan(interface)
        }
        (_, Some(Errno::ENODEV)) => CanError::NoInterface(interface),
        _ => CanError::Io { interface, action: "open", reason: error },
    }
}

/// Converts a frame for the kernel. Never `None`, since identifier and length of a [`Frame`] are in range.
fn to_socketcan(frame: &Frame) -> Option<CanFrame> {
    let id = match frame.id() {
        CanId::Base(id) => Id::Standard(StandardId::new(id)?),
        CanId::Extended(id) => Id::Extended(ExtendedId::new(id)?),
    };
    if frame.is_remote() {
        CanRemoteFrame::new_remote(id, frame.data().len()).map(CanFrame::Remote)
    } else {
        CanDataFrame::new(id, frame.data()).map(CanFrame::Data)
    }
}

fn to_event(frame: &CanFrame) -> io::Result<BusEvent> {
    if let CanFrame::Error(error) = frame {
        return Ok(BusEvent::Error(BusError(*error)));
    }
    let id = match frame.id() {
        Id::Standard(id) => CanId::Base(id.as_raw()),
        Id::Extended(id) => CanId::Extended(id.as_raw()),
    };
    let zeros = [0; 8];
    let data = if frame.is_remote_frame() { zeros.get(..frame.dlc()) } else { Some(frame.data()) };
    data.and_then(|data| Frame::from_parts(id, frame.is_remote_frame(), data))
        .map(BusEvent::Frame)
        .ok_or_else(|| ErrorKind::InvalidData.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::tests::frames;
    use proptest::prelude::*;
    use socketcan::CanErrorFrame;

    proptest! {
        #[test]
        fn frames_convert_both_ways(frame in frames()) {
            let there = to_socketcan(&frame).unwrap();
            prop_assert_eq!(to_event(&there).unwrap(), BusEvent::Frame(frame));
        }
    }

    #[test]
    fn an_error_frame_keeps_its_class_and_data() {
        let data = [0, 0x20, 0, 0, 0, 0, 128, 3];
        let frame = CanErrorFrame::new_error(0x244, &data).unwrap();
        let expected = BusEvent::Error(BusError::new(0x244, data));
        assert_eq!(to_event(&CanFrame::Error(frame)).unwrap(), expected);
    }

    #[test]
    fn a_vanished_interface_is_reported_as_gone() {
        for errno in [Errno::ENODEV, Errno::ENXIO] {
            let error = failed("can0", "send")(errno.into());
            assert_eq!(error.to_string(), "interface can0 is gone, was the adapter unplugged?");
        }
        let other = failed("can0", "send")(Errno::EPERM.into()).to_string();
        assert!(other.starts_with("can0: cannot send: Operation not permitted"), "{other}");
    }

    #[test]
    fn an_absent_interface_is_refused_with_its_name() {
        // The error depends on whether the kernel has CAN.
        match SocketCan::open("needle-none0") {
            Err(CanError::NoInterface(interface) | CanError::NoCan(interface)) => {
                assert_eq!(interface, "needle-none0");
            }
            other => panic!("opened, or another error: {other:?}"),
        }
    }
}
