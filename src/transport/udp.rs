//! CAN over UDP multicast, compatible with python-can's `udp_multicast`: one frame per datagram.
//!
//! This bus is for tests, and for machines and containers without CAN. There is no arbitration, datagrams may
//! be lost or reordered, and anyone may send, so it must never drive a real stage.

mod message;

use super::can::{BusError, BusEvent, CanBus, CanError, wait_readable};
use crate::canopen::Frame;
use nix::cmsg_space;
use nix::sys::socket::{
    AddressFamily, ControlMessageOwned, MsgFlags, SockFlag, SockType, SockaddrIn, bind, recvmsg,
    setsockopt, socket, sockopt,
};
use std::io::{self, ErrorKind, IoSliceMut};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::{AsFd, AsRawFd};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Size of the receive buffer: more than the length of any message, which is some 190 bytes.
const DATAGRAM_MAX: usize = 2048;
/// A call whose timeout is over returns after this many ignored datagrams, so that a flood of them does not
/// block the caller.
const IGNORED_MAX: usize = 1024;

/// An endpoint of the bus. The bus is a multicast group.
///
/// Datagrams do not leave this machine (hop limit 0, as with python-can). The endpoint receives its own
/// frames too, and recognizes them by their source port.
#[derive(Debug)]
pub struct UdpBus {
    name: String,
    group: SocketAddrV4,
    sender: UdpSocket,
    sender_port: u16,
    receiver: UdpSocket,
    dropped: u32,
}

impl UdpBus {
    /// Joins `group`.
    ///
    /// # Errors
    /// [`CanError::Io`]: `group` is not a multicast address, a program that does not share its port uses
    /// it, or this machine has no multicast route.
    pub fn join(group: SocketAddrV4) -> Result<Self, CanError> {
        let name = format!("udp:{group}");
        let receiver = shared_socket(group).map_err(failed(&name, "bind the group's port"))?;
        let join = || {
            receiver.join_multicast_v4(group.ip(), &Ipv4Addr::UNSPECIFIED)?;
            receiver.set_nonblocking(true)?;
            setsockopt(&receiver, sockopt::RxqOvfl, &1).map_err(io::Error::from)
        };
        join().map_err(failed(&name, "join the multicast group (is there a route for it)"))?;
        let open_sender = || {
            let sender = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
            sender.set_multicast_ttl_v4(0)?;
            sender.set_multicast_loop_v4(true)?;
            sender.set_nonblocking(true)?;
            let port = sender.local_addr()?.port();
            Ok((sender, port))
        };
        let (sender, sender_port) =
            open_sender().map_err(failed(&name, "open the sending socket"))?;
        Ok(UdpBus { name, group, sender, sender_port, receiver, dropped: 0 })
    }

    fn send_event(&self, event: &BusEvent) -> io::Result<()> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let datagram = message::encode(now.as_secs_f64(), event).map_err(io::Error::other)?;
        self.sender.send_to(&datagram, self.group).map(drop)
    }

    /// The event in the next datagram that has arrived. `None` for a datagram to ignore: not of this
    /// format, CAN FD, or from this endpoint.
    fn take(&mut self) -> io::Result<Option<BusEvent>> {
        let mut datagram = [0; DATAGRAM_MAX];
        let mut control = cmsg_space!(u32);
        let mut buffers = [IoSliceMut::new(&mut datagram)];
        let flags = MsgFlags::empty();
        let socket = self.receiver.as_raw_fd();
        let received = recvmsg::<SockaddrIn>(socket, &mut buffers, Some(&mut control), flags)?;
        for message in received.cmsgs()? {
            if let ControlMessageOwned::RxqOvfl(dropped) = message {
                self.dropped = dropped;
            }
        }
        let (len, from) = (received.bytes, received.address);
        if from.is_some_and(|from| from.port() == self.sender_port) {
            return Ok(None);
        }
        let event = message::decode(&datagram[..len]);
        if event.is_none() {
            tracing::debug!("{}: {len} bytes that are no classic CAN frame", self.name);
        }
        Ok(event)
    }
}

/// Makes an error of the operating system a [`CanError`].
fn failed(name: &str, action: &'static str) -> impl FnOnce(io::Error) -> CanError {
    let interface = name.to_owned();
    move |reason| CanError::Io { interface, action, reason }
}

/// A socket on the port of `group` that other programs on this machine may bind too. It is bound to the
/// group's address, because a socket bound to any address receives every group that the machine joined.
fn shared_socket(group: SocketAddrV4) -> io::Result<UdpSocket> {
    let socket = socket(AddressFamily::Inet, SockType::Datagram, SockFlag::SOCK_CLOEXEC, None)?;
    setsockopt(&socket, sockopt::ReuseAddr, &true)?;
    setsockopt(&socket, sockopt::ReusePort, &true)?;
    bind(socket.as_raw_fd(), &SockaddrIn::from(group))?;
    Ok(UdpSocket::from(socket))
}

impl CanBus for UdpBus {
    fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
        self.send_event(&BusEvent::Frame(*frame)).map_err(|error| match error.kind() {
            ErrorKind::WouldBlock => {
                CanError::TransmitQueueFull { interface: self.name.clone(), frame: *frame }
            }
            _ => failed(&self.name, "send")(error),
        })
    }

    fn report(&mut self, error: &BusError) -> Result<(), CanError> {
        let sent = self.send_event(&BusEvent::Error(*error));
        sent.map_err(failed(&self.name, "put an error frame on the bus"))
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError> {
        let start = Instant::now();
        let mut ignored = 0;
        loop {
            let remaining = timeout.saturating_sub(start.elapsed());
            match self.take() {
                Ok(Some(event)) => return Ok(Some(event)),
                Ok(None) if remaining.is_zero() && ignored >= IGNORED_MAX => return Ok(None),
                Ok(None) => ignored += 1,
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    if remaining.is_zero() {
                        return Ok(None);
                    }
                    wait_readable(self.receiver.as_fd(), remaining)
                        .map_err(failed(&self.name, "receive"))?;
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(failed(&self.name, "receive")(error)),
            }
        }
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn dropped(&self) -> Option<u64> {
        Some(self.dropped.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(10);

    /// A multicast group of this process, with a port for each test, because other tests may run at the same time.
    fn group(number: u8) -> SocketAddrV4 {
        let [a, b, ..] = std::process::id().to_le_bytes();
        SocketAddrV4::new(Ipv4Addr::new(239, 74, a, b), 43_200 + u16::from(number))
    }

    #[test]
    fn a_frame_reaches_the_others_and_not_its_sender() {
        let [mut a, mut b, mut c] = [0; 3].map(|_| UdpBus::join(group(1)).unwrap());
        let (there, back) = (Frame::new(0x601, &[1, 2, 3]), Frame::new(0x581, &[]));
        a.send(&there).unwrap();
        assert_eq!(b.receive(LONG).unwrap(), Some(BusEvent::Frame(there)));
        b.send(&back).unwrap();
        assert_eq!(a.receive(LONG).unwrap(), Some(BusEvent::Frame(back)));
        assert_eq!(c.receive(LONG).unwrap(), Some(BusEvent::Frame(there)));
        assert_eq!(c.receive(LONG).unwrap(), Some(BusEvent::Frame(back)));
        assert_eq!(a.receive(Duration::ZERO).unwrap(), None);
    }

    /// Otherwise a bench would take another bench's SYNC for that of a second master.
    #[test]
    fn a_bus_receives_only_its_own_group() {
        let here = group(8);
        let there = SocketAddrV4::new(Ipv4Addr::new(239, 73, 1, 1), here.port());
        let (mut ours, mut theirs) = (UdpBus::join(here).unwrap(), UdpBus::join(there).unwrap());
        let (frame, other) = (Frame::new(0x80, &[]), Frame::new(0x81, &[1]));
        UdpBus::join(there).unwrap().send(&other).unwrap();
        UdpBus::join(here).unwrap().send(&frame).unwrap();
        assert_eq!(ours.receive(LONG).unwrap(), Some(BusEvent::Frame(frame)));
        assert_eq!(theirs.receive(LONG).unwrap(), Some(BusEvent::Frame(other)));
    }

    #[test]
    fn datagrams_of_another_format_are_ignored() {
        let mut bus = UdpBus::join(group(2)).unwrap();
        let stranger = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
        let mut peer = UdpBus::join(group(2)).unwrap();
        for junk in [&b""[..], b"\xC0", b"hello", &[0x8B; 2000]] {
            stranger.send_to(junk, group(2)).unwrap();
        }
        let frame = Frame::new(0x80, &[]);
        peer.send(&frame).unwrap();
        assert_eq!(bus.receive(LONG).unwrap(), Some(BusEvent::Frame(frame)));
    }

    #[test]
    fn frames_not_received_in_time_are_counted() {
        let (mut sender, mut sleeper) =
            (UdpBus::join(group(3)).unwrap(), UdpBus::join(group(3)).unwrap());
        let frame = Frame::new(0x80, &[]);
        // More than a socket's buffer can hold. The kernel reports the drops with the next datagram.
        let count = 20_000;
        (0..count).for_each(|_| sender.send(&frame).unwrap());
        let held = std::iter::from_fn(|| sleeper.receive(Duration::ZERO).unwrap()).count();
        sender.send(&frame).unwrap();
        assert_eq!(sleeper.receive(LONG).unwrap(), Some(BusEvent::Frame(frame)));
        assert_eq!(sleeper.dropped().unwrap(), (count - held) as u64);
    }

    #[test]
    fn a_unicast_address_is_refused_as_a_group() {
        let unicast = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 43_299);
        let error = UdpBus::join(unicast).unwrap_err().to_string();
        assert!(
            error.starts_with("udp:127.0.0.1:43299: cannot join the multicast group"),
            "{error}"
        );
    }
}
