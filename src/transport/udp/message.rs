//! One datagram: python-can's `Message` as a map of eleven keys
//! (`can.interfaces.udp_multicast.utils`, python-can 4.6).

use super::msgpack::{MsgpackError, Reader, Scalar, Writer};
use crate::canopen::{CanId, Frame};
use crate::transport::bus_error::BusError;
use crate::transport::can::BusEvent;

/// What one datagram carries.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct UdpMessage {
    /// When it was sent by its sender's clock, s since 1970. Receivers put their own in its place.
    pub(super) timestamp_s: f64,
    /// A frame, or a report of the sender's controller.
    pub(super) event: BusEvent,
}

/// Why a datagram is not a message that is understood here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum MessageError {
    /// It is not MessagePack of the kind used.
    #[error(transparent)]
    Msgpack(#[from] MsgpackError),
    /// A CAN FD frame.
    #[error("a CAN FD frame")]
    CanFd,
    /// Identifier, length or type of a field are out of range, or a field is missing.
    #[error("no classic CAN frame: identifier {id:?}, {len} bytes of data, length {dlc:?}")]
    NoFrame {
        /// Its identifier.
        id: Option<u64>,
        /// Bytes of data given.
        len: usize,
        /// Its data length code.
        dlc: Option<u64>,
    },
}

impl UdpMessage {
    /// The datagram.
    pub(super) fn encode(&self) -> Vec<u8> {
        let zeros = [0; 8];
        let (id, extended, remote, error, dlc, data) = match &self.event {
            BusEvent::Frame(frame) => {
                let (id, extended) = match frame.id() {
                    CanId::Base(id) => (u32::from(id), false),
                    CanId::Extended(id) => (id, true),
                };
                let data = if frame.is_remote() { &zeros[..0] } else { frame.data() };
                (id, extended, frame.is_remote(), false, frame.data().len(), data)
            }
            BusEvent::Error(error) => (error.classes(), true, false, true, 8, &error.data()[..]),
        };
        let mut writer = Writer::map(11);
        writer.pair("timestamp", Scalar::Float(self.timestamp_s));
        writer.pair("arbitration_id", Scalar::Unsigned(id.into()));
        writer.pair("is_extended_id", Scalar::Boolean(extended));
        writer.pair("is_remote_frame", Scalar::Boolean(remote));
        writer.pair("is_error_frame", Scalar::Boolean(error));
        writer.pair("channel", Scalar::Nil);
        writer.pair("dlc", Scalar::Unsigned(dlc as u64));
        writer.pair("data", Scalar::Bytes(data));
        writer.pair("is_fd", Scalar::Boolean(false));
        writer.pair("bitrate_switch", Scalar::Boolean(false));
        writer.pair("error_state_indicator", Scalar::Boolean(false));
        writer.finish()
    }

    /// Reads a datagram; keys may come in any order, unknown ones are passed over.
    ///
    /// # Errors
    /// [`MessageError`].
    pub(super) fn decode(datagram: &[u8]) -> Result<Self, MessageError> {
        let mut reader = Reader::new(datagram);
        let mut timestamp_s = 0.0;
        let (mut id, mut dlc, mut data) = (None, None, &datagram[..0]);
        let [mut extended, mut remote, mut error, mut fd] = [false; 4];
        for _ in 0..reader.map()? {
            match (reader.text()?, reader.scalar()?) {
                ("timestamp", Scalar::Float(value)) => timestamp_s = value,
                ("arbitration_id", Scalar::Unsigned(value)) => id = Some(value),
                ("is_extended_id", Scalar::Boolean(value)) => extended = value,
                ("is_remote_frame", Scalar::Boolean(value)) => remote = value,
                ("is_error_frame", Scalar::Boolean(value)) => error = value,
                ("is_fd", Scalar::Boolean(value)) => fd = value,
                ("dlc", Scalar::Unsigned(value)) => dlc = Some(value),
                ("data", Scalar::Bytes(value)) => data = value,
                _ => {}
            }
        }
        if fd {
            return Err(MessageError::CanFd);
        }
        let event = if error { report(id, data) } else { frame(id, extended, remote, dlc, data) };
        let no_frame = MessageError::NoFrame { id, len: data.len(), dlc };
        Ok(UdpMessage { timestamp_s, event: event.ok_or(no_frame)? })
    }
}

fn report(classes: Option<u64>, data: &[u8]) -> Option<BusEvent> {
    let mut bytes = [0; 8];
    bytes.get_mut(..data.len())?.copy_from_slice(data);
    Some(BusEvent::Error(BusError::new(u32::try_from(classes?).ok()?, bytes)))
}

/// A remote frame has a length and no data.
fn frame(
    id: Option<u64>,
    extended: bool,
    remote: bool,
    dlc: Option<u64>,
    data: &[u8],
) -> Option<BusEvent> {
    let id = match extended {
        true => CanId::Extended(u32::try_from(id?).ok()?),
        false => CanId::Base(u16::try_from(id?).ok()?),
    };
    let len = usize::try_from(dlc?).ok()?;
    let zeros = [0; 8];
    let payload = match remote {
        true => zeros.get(..len)?,
        false if data.len() == len => data,
        false => return None,
    };
    Frame::from_parts(id, remote, payload).map(BusEvent::Frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn hex(text: &str) -> Vec<u8> {
        let digit = |at: usize| u8::from_str_radix(&text[at..at + 2], 16).unwrap();
        (0..text.len()).step_by(2).map(digit).collect()
    }

    /// Do not edit: written by python-can 4.6.1 with msgpack 1.2.
    const SDO: &str = "8ba974696d657374616d70cb41d954fc40100000ae6172626974726174696f6e5f6964cd0601\
        ae69735f657874656e6465645f6964c2af69735f72656d6f74655f6672616d65c2ae69735f6572726f725f667261\
        6d65c2a76368616e6e656cc0a3646c6308a464617461c4084041600000000000a569735f6664c2ae626974726174\
        655f737769746368c2b56572726f725f73746174655f696e64696361746f72c2";
    const REMOTE: &str = "8ba974696d657374616d70cb0000000000000000ae6172626974726174696f6e5f6964ce01\
        234567ae69735f657874656e6465645f6964c3af69735f72656d6f74655f6672616d65c3ae69735f6572726f725f\
        6672616d65c2a76368616e6e656ca57663616e30a3646c6304a464617461c400a569735f6664c2ae626974726174\
        655f737769746368c2b56572726f725f73746174655f696e64696361746f72c2";
    const REPORT: &str = "8ba974696d657374616d70cb0000000000000000ae6172626974726174696f6e5f696440ae\
        69735f657874656e6465645f6964c3af69735f72656d6f74655f6672616d65c2ae69735f6572726f725f6672616d\
        65c3a76368616e6e656cc0a3646c6308a464617461c4080000000000000000a569735f6664c2ae62697472617465\
        5f737769746368c2b56572726f725f73746174655f696e64696361746f72c2";

    #[test]
    fn agrees_with_python_can_to_the_byte() {
        let request = Frame::new(0x601, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]);
        let sdo = UdpMessage { timestamp_s: 1_700_000_000.25, event: BusEvent::Frame(request) };
        assert_eq!(UdpMessage::decode(&hex(SDO)), Ok(sdo));
        assert_eq!(sdo.encode(), hex(SDO));

        // The channel is the sender's own name for the bus; ours is none.
        let remote = Frame::from_parts(CanId::Extended(0x0123_4567), true, &[0; 4]).unwrap();
        let remote = UdpMessage { timestamp_s: 0.0, event: BusEvent::Frame(remote) };
        assert_eq!(UdpMessage::decode(&hex(REMOTE)), Ok(remote));

        let report = UdpMessage { timestamp_s: 0.0, event: BusEvent::Error(BusError::bus_off()) };
        assert_eq!(UdpMessage::decode(&hex(REPORT)), Ok(report));
        assert_eq!(report.encode(), hex(REPORT));
    }

    #[test]
    fn what_is_no_classic_frame_is_refused_with_its_numbers() {
        let message = |id, dlc, data: &[u8], fd| {
            let mut writer = Writer::map(4);
            writer.pair("arbitration_id", Scalar::Unsigned(id));
            writer.pair("dlc", Scalar::Unsigned(dlc));
            writer.pair("data", Scalar::Bytes(data));
            writer.pair("is_fd", Scalar::Boolean(fd));
            UdpMessage::decode(&writer.finish()).map_err(|error| error.to_string())
        };
        assert!(message(0x7FF, 2, &[1, 2], false).is_ok());
        assert_eq!(message(0x80, 12, &[0; 12], true).unwrap_err(), "a CAN FD frame");
        assert_eq!(
            message(0x800, 1, &[1], false).unwrap_err(),
            "no classic CAN frame: identifier Some(2048), 1 bytes of data, length Some(1)"
        );
        assert!(message(0x80, 9, &[0; 9], false).is_err());
        assert!(message(0x80, 8, &[0; 7], false).is_err());
        assert_eq!(
            UdpMessage::decode(b"hello").unwrap_err().to_string(),
            "type 0x68 at byte 0, expected a map"
        );
    }

    fn frames() -> impl Strategy<Value = Frame> {
        let id = prop_oneof![
            (0u16..=0x7FF).prop_map(CanId::Base),
            (0u32..=0x1FFF_FFFF).prop_map(CanId::Extended),
        ];
        let data = prop::collection::vec(any::<u8>(), 0..=8);
        (id, any::<bool>(), data).prop_map(|(id, remote, data)| {
            let data = if remote { vec![0; data.len()] } else { data };
            Frame::from_parts(id, remote, &data).unwrap()
        })
    }

    proptest! {
        #[test]
        fn frames_make_the_round_trip(frame in frames(), timestamp_s in 0.0..1e10) {
            let message = UdpMessage { timestamp_s, event: BusEvent::Frame(frame) };
            prop_assert_eq!(UdpMessage::decode(&message.encode()), Ok(message));
        }

        #[test]
        fn any_bytes_are_a_message_or_an_error(mut bytes: Vec<u8>, at: usize, byte: u8) {
            let _ = UdpMessage::decode(&bytes);
            bytes = hex(SDO);
            let at = at % bytes.len();
            bytes[at] = byte;
            let _ = UdpMessage::decode(&bytes);
            prop_assert!(UdpMessage::decode(&bytes[..at]).is_err());
        }
    }
}
