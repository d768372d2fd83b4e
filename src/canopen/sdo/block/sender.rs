//! The side of a block transfer that has the data.

use super::crc::crc16;
use super::{BlockFrame, BlockSegment};
use crate::canopen::sdo::AbortCode;

/// Blocks in a row of which nothing was acknowledged before the sender gives up.
const FUTILE_BLOCKS_MAX: u32 = 3;
const SEGMENT_BYTES: usize = 7;

/// Cuts data into blocks of segments, and goes back to what was not acknowledged.
#[derive(Debug, Clone)]
pub struct BlockSender {
    data: Vec<u8>,
    /// Bytes acknowledged.
    acknowledged: usize,
    /// Segments in the block under way.
    sent: u8,
    /// The data ends in that block.
    ends: bool,
    futile_blocks: u32,
}

impl BlockSender {
    /// A sender of `data`, which may be empty.
    pub fn new(data: Vec<u8>) -> Self {
        BlockSender { data, acknowledged: 0, sent: 0, ends: false, futile_blocks: 0 }
    }

    /// Bytes to send in all.
    pub fn size(&self) -> usize {
        self.data.len()
    }

    /// The next block, of at most `block_size` segments.
    ///
    /// # Errors
    /// [`AbortCode::InvalidBlockSize`] for none, or over 127.
    pub fn block(&mut self, block_size: u8) -> Result<Vec<BlockSegment>, AbortCode> {
        if !(1..=super::BLOCK_SIZE_MAX).contains(&block_size) {
            return Err(AbortCode::InvalidBlockSize);
        }
        let rest = self.data.get(self.acknowledged..).unwrap_or_default();
        let segments_left = rest.len().div_ceil(SEGMENT_BYTES).max(1);
        self.ends = segments_left <= usize::from(block_size);
        let in_block = segments_left.min(usize::from(block_size));
        let segments: Vec<_> = (1..)
            .zip(0..in_block)
            .map(|(sequence, n)| {
                let part = rest.get(n * SEGMENT_BYTES..).unwrap_or_default();
                BlockSegment::of(part, sequence, n + 1 == segments_left)
            })
            .collect();
        self.sent = in_block as u8;
        Ok(segments)
    }

    /// Takes the acknowledgement of the block under way up to segment `sequence`; true when that
    /// was all.
    ///
    /// # Errors
    /// [`AbortCode::InvalidSequenceNumber`] for a segment that was not sent, and for a receiver
    /// that acknowledges nothing again and again.
    pub fn acknowledge(&mut self, sequence: u8) -> Result<bool, AbortCode> {
        if sequence > self.sent {
            return Err(AbortCode::InvalidSequenceNumber);
        }
        self.futile_blocks = if sequence == 0 { self.futile_blocks + 1 } else { 0 };
        if self.futile_blocks >= FUTILE_BLOCKS_MAX {
            return Err(AbortCode::InvalidSequenceNumber);
        }
        let all = self.ends && sequence == self.sent;
        let bytes = usize::from(sequence) * SEGMENT_BYTES;
        self.acknowledged = (self.acknowledged + bytes).min(self.data.len());
        Ok(all)
    }

    /// The frame that ends the transfer; `with_crc` when the other side can check it.
    pub fn end(&self, with_crc: bool) -> BlockFrame {
        let in_last = match self.data.len() {
            0 => 0,
            len => (len - 1) % SEGMENT_BYTES + 1,
        };
        let crc = if with_crc { crc16(&self.data) } else { 0 };
        BlockFrame::End { unused: (SEGMENT_BYTES - in_last) as u8, crc }
    }
}
