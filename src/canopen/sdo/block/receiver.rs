//! The side of a block transfer that takes the data.

use std::cmp::Ordering;

use super::crc::crc16;
use super::{BLOCK_SIZE_MAX, BlockFrame, BlockSegment};
use crate::canopen::sdo::{AbortCode, MAX_TRANSFER_BYTES};

/// Puts segments together, in order, and checks what they make.
#[derive(Debug, Clone)]
pub struct BlockReceiver {
    data: Vec<u8>,
    announced: Option<u32>,
    checks_crc: bool,
    /// The last segment of this block that came in order.
    sequence: u8,
    /// The last segment of all has come in order.
    complete: bool,
}

impl BlockReceiver {
    /// A receiver of as many bytes as were `announced`; `checks_crc` when the sender makes one.
    ///
    /// # Errors
    /// [`AbortCode::OutOfMemory`] for more than [`MAX_TRANSFER_BYTES`].
    pub fn new(announced: Option<u32>, checks_crc: bool) -> Result<Self, AbortCode> {
        if announced.is_some_and(|size| size as usize > MAX_TRANSFER_BYTES) {
            return Err(AbortCode::OutOfMemory);
        }
        Ok(BlockReceiver { data: Vec::new(), announced, checks_crc, sequence: 0, complete: false })
    }

    /// True when only the end is awaited.
    pub fn is_complete(&self) -> bool {
        self.complete
    }

    /// Bytes taken so far, those of the last segment that hold no data among them.
    pub fn received(&self) -> usize {
        self.data.len()
    }

    /// Takes a segment of a block of 127; gives the acknowledgement behind the block's last. What
    /// came out of order is dropped, to be sent again.
    ///
    /// # Errors
    /// [`AbortCode::OutOfMemory`] for more than [`MAX_TRANSFER_BYTES`].
    pub fn take(&mut self, segment: BlockSegment) -> Result<Option<BlockFrame>, AbortCode> {
        if segment.sequence == self.sequence + 1 {
            if self.data.len() >= MAX_TRANSFER_BYTES {
                return Err(AbortCode::OutOfMemory);
            }
            self.data.extend_from_slice(&segment.bytes);
            self.sequence = segment.sequence;
            self.complete = segment.last;
        }
        if segment.sequence < BLOCK_SIZE_MAX && !segment.last {
            return Ok(None);
        }
        let sequence = std::mem::take(&mut self.sequence);
        Ok(Some(BlockFrame::Acknowledge { sequence, block_size: BLOCK_SIZE_MAX }))
    }

    /// The data, once the sender has ended with these `unused` bytes and this `crc`.
    ///
    /// # Errors
    /// [`AbortCode::CrcError`], or a length other than announced.
    pub fn finish(&mut self, unused: u8, crc: u16) -> Result<Vec<u8>, AbortCode> {
        let len = self.data.len().checked_sub(unused.into());
        self.data.truncate(len.ok_or(AbortCode::LengthTooLow)?);
        match self.announced.map(|size| self.data.len().cmp(&(size as usize))) {
            Some(Ordering::Greater) => Err(AbortCode::LengthTooHigh),
            Some(Ordering::Less) => Err(AbortCode::LengthTooLow),
            _ if self.checks_crc && crc16(&self.data) != crc => Err(AbortCode::CrcError),
            _ => Ok(std::mem::take(&mut self.data)),
        }
    }
}
