//! Block transfer (CiA 301, 7.2.4.3): up to 127 segments of seven bytes for one acknowledgement.
//!
//! Who sends the data announces, sends segments and ends; who takes them is ready, acknowledges
//! and is done. A client that writes and a server that is read send the same bytes, so that both
//! sides of both directions are one [`BlockSender`] and one [`BlockReceiver`]:
//!
//! | byte 0, bits 7 to 5 | bits 1, 0 | frame                                              |
//! |---------------------|-----------|----------------------------------------------------|
//! | 6, of the sender    | 0 in bit 0 | [`BlockFrame::Announce`]: CRC in bit 2, size in bit 1 |
//! | 6                   | 1 in bit 0 | [`BlockFrame::End`]: unused bytes in bits 4 to 2      |
//! | 5, of the receiver  | 0         | [`BlockFrame::Ready`]: CRC in bit 2                |
//! | 5                   | 3         | [`BlockFrame::Start`]                              |
//! | 5                   | 2         | [`BlockFrame::Acknowledge`]                        |
//! | 5                   | 1         | [`BlockFrame::Done`]                               |

pub mod crc;
pub mod receiver;
pub mod sender;

pub use receiver::BlockReceiver;
pub use sender::BlockSender;

use super::codec::{Chunk, SdoBytes, object_of, with_object};
use crate::canopen::ObjectAddress;

/// The most segments in a block.
pub const BLOCK_SIZE_MAX: u8 = 127;

const CRC_SUPPORTED: u8 = 1 << 2;
const SIZE_INDICATED: u8 = 1 << 1;
const LAST: u8 = 1 << 7;
/// Byte 0 of an abort. Among segments it would be the last one with number 0, which no segment has.
pub(super) const ABORT: u8 = 4 << 5;

/// What steers a block transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlockFrame {
    /// The sender has data for, or of, an object.
    Announce {
        /// The object.
        object: ObjectAddress,
        /// It can make the CRC.
        crc: bool,
        /// Bytes to come, when it says so.
        size: Option<u32>,
    },
    /// The sender has sent everything.
    End {
        /// Bytes of the last segment that hold no data, 0 to 7.
        unused: u8,
        /// CRC of all data; 0 unless both sides can make it.
        crc: u16,
    },
    /// The receiver asks for, or agrees to take, an object.
    Ready {
        /// The object.
        object: ObjectAddress,
        /// It can check the CRC.
        crc: bool,
        /// Segments in the first block, 1 to 127.
        block_size: u8,
        /// From a client that reads: data of at most so many bytes may come by expedited or
        /// segmented transfer instead; 0 for no.
        threshold: u8,
    },
    /// The client that reads takes the first block.
    Start,
    /// The receiver has taken a block.
    Acknowledge {
        /// The last segment that came in order; the sender goes on behind it. 0 for none.
        sequence: u8,
        /// Segments in the next block, 1 to 127.
        block_size: u8,
    },
    /// The receiver has checked everything.
    Done,
}

impl BlockFrame {
    /// The object it names; `None` for the later frames of a transfer.
    pub fn object(self) -> Option<ObjectAddress> {
        match self {
            BlockFrame::Announce { object, .. } | BlockFrame::Ready { object, .. } => Some(object),
            _ => None,
        }
    }

    /// The frame's bytes.
    pub fn encode(self) -> SdoBytes {
        let flag = |set: bool, bit: u8| if set { bit } else { 0 };
        match self {
            BlockFrame::Announce { object, crc, size } => {
                let flags = flag(crc, CRC_SUPPORTED) | flag(size.is_some(), SIZE_INDICATED);
                with_object(6 << 5 | flags, object, size.unwrap_or(0).to_le_bytes())
            }
            BlockFrame::End { unused, crc } => {
                let [low, high] = crc.to_le_bytes();
                [6 << 5 | (unused & 7) << 2 | 1, low, high, 0, 0, 0, 0, 0]
            }
            BlockFrame::Ready { object, crc, block_size, threshold } => {
                let command = 5 << 5 | flag(crc, CRC_SUPPORTED);
                with_object(command, object, [block_size, threshold, 0, 0])
            }
            BlockFrame::Start => [5 << 5 | 3, 0, 0, 0, 0, 0, 0, 0],
            BlockFrame::Acknowledge { sequence, block_size } => {
                [5 << 5 | 2, sequence, block_size, 0, 0, 0, 0, 0]
            }
            BlockFrame::Done => [5 << 5 | 1, 0, 0, 0, 0, 0, 0, 0],
        }
    }

    /// The meaning of `bytes`; `None` unless their specifier is 5 or 6.
    pub fn decode(bytes: &SdoBytes) -> Option<Self> {
        let (command, object) = (bytes[0], object_of(bytes));
        let crc = command & CRC_SUPPORTED != 0;
        Some(match (command >> 5, command & 3) {
            (6, 0 | 2) => {
                let size = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]);
                let sized = command & SIZE_INDICATED != 0;
                BlockFrame::Announce { object, crc, size: sized.then_some(size) }
            }
            (6, _) => {
                let crc = u16::from_le_bytes([bytes[1], bytes[2]]);
                BlockFrame::End { unused: command >> 2 & 7, crc }
            }
            (5, 0) => BlockFrame::Ready { object, crc, block_size: bytes[4], threshold: bytes[5] },
            (5, 1) => BlockFrame::Done,
            (5, 2) => BlockFrame::Acknowledge { sequence: bytes[1], block_size: bytes[2] },
            (5, _) => BlockFrame::Start,
            _ => return None,
        })
    }
}

/// Seven bytes of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlockSegment {
    /// Its number in the block, 1 to 127.
    pub sequence: u8,
    /// No segment follows: the data ends in it.
    pub last: bool,
    /// The bytes; in the last segment, fewer may be data.
    pub bytes: [u8; 7],
}

impl BlockSegment {
    /// The segment that carries the first seven bytes of `data`, padded with zeros.
    pub(super) fn of(data: &[u8], sequence: u8, last: bool) -> Self {
        BlockSegment { sequence, last, bytes: Chunk::of(data).padded() }
    }

    /// The frame's bytes.
    pub fn encode(self) -> SdoBytes {
        let [a, b, c, d, e, f, g] = self.bytes;
        let last = if self.last { LAST } else { 0 };
        [self.sequence & !LAST | last, a, b, c, d, e, f, g]
    }

    /// The meaning of `bytes` where a segment is awaited; `None` for number 0, of which an abort
    /// has the byte.
    pub fn decode(&[command, a, b, c, d, e, f, g]: &SdoBytes) -> Option<Self> {
        let sequence = command & !LAST;
        let last = command & LAST != 0;
        (sequence != 0).then_some(BlockSegment { sequence, last, bytes: [a, b, c, d, e, f, g] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames as CiA 301 lays them out, and as python-canopen's tests hold them. Do not edit: they
    /// are the standard's, not ours.
    #[test]
    fn frozen_bytes() {
        let object = ObjectAddress::new(0x2000, 0);
        let frames = [
            (
                BlockFrame::Announce { object, crc: true, size: Some(30) },
                [0xc6, 0x00, 0x20, 0x00, 0x1e, 0, 0, 0],
            ),
            (
                BlockFrame::Announce { object, crc: false, size: None },
                [0xc0, 0x00, 0x20, 0x00, 0, 0, 0, 0],
            ),
            (
                BlockFrame::Ready { object, crc: true, block_size: 127, threshold: 0 },
                [0xa4, 0x00, 0x20, 0x00, 0x7f, 0, 0, 0],
            ),
            (
                BlockFrame::Ready { object, crc: false, block_size: 1, threshold: 21 },
                [0xa0, 0x00, 0x20, 0x00, 0x01, 21, 0, 0],
            ),
            (BlockFrame::Start, [0xa3, 0, 0, 0, 0, 0, 0, 0]),
            (
                BlockFrame::Acknowledge { sequence: 5, block_size: 127 },
                [0xa2, 0x05, 0x7f, 0, 0, 0, 0, 0],
            ),
            (BlockFrame::End { unused: 5, crc: 0x6945 }, [0xd5, 0x45, 0x69, 0, 0, 0, 0, 0]),
            (BlockFrame::Done, [0xa1, 0, 0, 0, 0, 0, 0, 0]),
        ];
        for (frame, bytes) in frames {
            assert_eq!(frame.encode(), bytes, "{frame:?}");
            assert_eq!(BlockFrame::decode(&bytes), Some(frame));
        }
        let segment = BlockSegment { sequence: 5, last: true, bytes: *b"..\0\0\0\0\0" };
        assert_eq!(segment.encode(), [0x85, 0x2e, 0x2e, 0, 0, 0, 0, 0]);
        assert_eq!(BlockSegment::decode(&segment.encode()), Some(segment));
        assert_eq!(BlockSegment::decode(&[ABORT, 0, 0x20, 0, 0, 0, 4, 5]), None);
    }

    #[test]
    fn the_other_specifiers_are_none_of_it() {
        for command in (0..=0xff_u8).filter(|command| !matches!(command >> 5, 5 | 6)) {
            assert_eq!(BlockFrame::decode(&[command, 0, 0, 0, 0, 0, 0, 0]), None);
        }
    }
}
