//! One datagram: python-can's `Message` as a MessagePack map of eleven keys
//! (`can.interfaces.udp_multicast.utils`, python-can 4.6).

use crate::canopen::{CanId, Frame};
use crate::transport::can::{BusError, BusEvent};
use serde::{Deserialize, Serialize, Serializer};
use socketcan::EmbeddedFrame;

/// Maximum nesting depth. A map of scalars needs less; deeper data is refused before it uses stack.
const DEPTH_MAX: usize = 4;

/// The map, in python-can's order. Other keys are ignored.
#[derive(Default, Serialize, Deserialize)]
struct Fields<'a> {
    timestamp: f64,
    arbitration_id: u32,
    is_extended_id: bool,
    is_remote_frame: bool,
    is_error_frame: bool,
    /// The sender's name of the bus, of any type; the bench sends none.
    #[serde(skip_deserializing)]
    channel: (),
    dlc: u8,
    #[serde(serialize_with = "as_bytes")]
    data: &'a [u8],
    is_fd: bool,
    bitrate_switch: bool,
    error_state_indicator: bool,
}

fn as_bytes<S: Serializer>(data: &&[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(data)
}

/// The datagram that carries `event`, sent at `timestamp_s` by the sender's clock, s since 1970.
///
/// # Errors
/// Never with these fields; the encoder's signature has it.
pub(super) fn encode(
    timestamp_s: f64,
    event: &BusEvent,
) -> Result<Vec<u8>, rmp_serde::encode::Error> {
    let mut fields =
        Fields { timestamp: timestamp_s, is_extended_id: true, dlc: 8, ..Fields::default() };
    match event {
        BusEvent::Frame(frame) => {
            (fields.arbitration_id, fields.is_extended_id) = match frame.id() {
                CanId::Base(id) => (u32::from(id), false),
                CanId::Extended(id) => (id, true),
            };
            fields.is_remote_frame = frame.is_remote();
            fields.dlc = frame.data().len() as u8;
            fields.data = if frame.is_remote() { &[] } else { frame.data() };
        }
        BusEvent::Error(error) => {
            fields.arbitration_id = error.0.error_bits();
            fields.is_error_frame = true;
            fields.data = error.0.data();
        }
    }
    rmp_serde::to_vec_named(&fields)
}

/// The event in a datagram, whose keys may come in any order; the timestamp is ignored. `None` if the
/// datagram is no such map, or holds no classic frame.
pub(super) fn decode(datagram: &[u8]) -> Option<BusEvent> {
    let mut deserializer = rmp_serde::Deserializer::from_read_ref(datagram);
    deserializer.set_max_depth(DEPTH_MAX);
    let fields = Fields::deserialize(&mut deserializer).ok()?;
    if fields.is_fd {
        None
    } else if fields.is_error_frame {
        error_event(&fields)
    } else {
        frame_event(&fields)
    }
}

fn error_event(fields: &Fields<'_>) -> Option<BusEvent> {
    let mut bytes = [0; 8];
    bytes.get_mut(..fields.data.len())?.copy_from_slice(fields.data);
    Some(BusEvent::Error(BusError::new(fields.arbitration_id, bytes)))
}

fn frame_event(fields: &Fields<'_>) -> Option<BusEvent> {
    let id = if fields.is_extended_id {
        CanId::Extended(fields.arbitration_id)
    } else {
        CanId::Base(u16::try_from(fields.arbitration_id).ok()?)
    };
    let (len, zeros) = (usize::from(fields.dlc), [0; 8]);
    let payload = if fields.is_remote_frame {
        // A remote frame has a length and no data.
        zeros.get(..len)?
    } else if fields.data.len() == len {
        fields.data
    } else {
        return None;
    };
    Frame::from_parts(id, fields.is_remote_frame, payload).map(BusEvent::Frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::tests::frames;
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
    fn messages_agree_with_python_can_to_the_byte() {
        let request = Frame::new(0x601, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]);
        let sdo = BusEvent::Frame(request);
        assert_eq!(decode(&hex(SDO)), Some(sdo));
        assert_eq!(encode(1_700_000_000.25, &sdo).unwrap(), hex(SDO));

        // The channel is the sender's name for the bus; this bench sends none.
        let remote = Frame::from_parts(CanId::Extended(0x0123_4567), true, &[0; 4]).unwrap();
        assert_eq!(decode(&hex(REMOTE)), Some(BusEvent::Frame(remote)));

        let report = BusEvent::Error(BusError::bus_off());
        assert_eq!(decode(&hex(REPORT)), Some(report));
        assert_eq!(encode(0.0, &report).unwrap(), hex(REPORT));
    }

    #[test]
    fn only_classic_frames_are_accepted() {
        let message = |arbitration_id, dlc, data, is_fd| {
            let datagram = rmp_serde::to_vec_named(&Fields {
                arbitration_id,
                dlc,
                data,
                is_fd,
                ..Fields::default()
            });
            decode(&datagram.unwrap())
        };
        assert!(message(0x7FF, 2, &[1, 2], false).is_some());
        assert_eq!(message(0x80, 2, &[1, 2], true), None, "CAN FD");
        assert_eq!(message(0x800, 1, &[1], false), None, "identifier over 11 bits");
        assert_eq!(message(0x80, 9, &[0; 9], false), None, "9 bytes");
        assert_eq!(message(0x80, 8, &[0; 7], false), None, "length without data");
        assert_eq!(decode(b"hello"), None, "not a message");
    }

    /// Strings, binary data, arrays and maps that announce 4 GiB, and 2000 nested arrays.
    #[test]
    fn hostile_lengths_and_nesting_are_refused() {
        for head in [0xDB, 0xC6, 0xDD, 0xDF] {
            let key = [&[0x81, 0xA4][..], b"data", &[head, 0xFF, 0xFF, 0xFF, 0xFF]].concat();
            for hostile in [&key[6..], &key] {
                assert_eq!(decode(hostile), None, "{head:#x}");
            }
        }
        let unknown = [&[0x81, 0xA1, b'x'][..], &[0x91; 2000]].concat();
        assert_eq!(decode(&unknown), None);
    }

    proptest! {
        #[test]
        fn frames_make_the_round_trip(frame in frames(), timestamp_s in 0.0..1e10) {
            let event = BusEvent::Frame(frame);
            prop_assert_eq!(decode(&encode(timestamp_s, &event).unwrap()), Some(event));
        }

        #[test]
        fn damaged_bytes_never_panic_and_cut_messages_are_refused(mut bytes: Vec<u8>, at: usize, byte: u8) {
            let _ = decode(&bytes);
            bytes = hex(SDO);
            let at = at % bytes.len();
            bytes[at] = byte;
            let _ = decode(&bytes);
            prop_assert_eq!(decode(&bytes[..at]), None);
        }
    }
}
