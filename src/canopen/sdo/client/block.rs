//! Block transfer, as the client sees it.

use super::{Awaited, Step, Transfer};
use crate::canopen::ObjectAddress;
use crate::canopen::sdo::block::{
    BLOCK_SIZE_MAX, BlockFrame, BlockReceiver, BlockSegment, BlockSender,
};
use crate::canopen::sdo::codec::ClientFrame;
use crate::canopen::sdo::{AbortCode, SdoErrorKind, SdoReply};

/// The request to read `object`.
pub(super) fn ready(object: ObjectAddress) -> ClientFrame {
    let block_size = BLOCK_SIZE_MAX;
    ClientFrame::Block(BlockFrame::Ready { object, crc: true, block_size, threshold: 0 })
}

/// The request to write `size` bytes to `object`.
pub(super) fn announce(object: ObjectAddress, size: usize) -> ClientFrame {
    let size = u32::try_from(size).ok();
    ClientFrame::Block(BlockFrame::Announce { object, crc: true, size })
}

impl Transfer {
    /// What `frame` means to this transfer.
    pub(super) fn block_step(&mut self, frame: BlockFrame) -> Step {
        let object = self.object;
        let step = match (&mut self.awaited, frame) {
            (Awaited::BlockAnnounce, BlockFrame::Announce { object: about, crc, size })
                if about == object =>
            {
                BlockReceiver::new(size, crc).map(|receiver| {
                    self.awaited = Awaited::BlockSegments(receiver);
                    Step::Send(ClientFrame::Block(BlockFrame::Start))
                })
            }
            (Awaited::BlockSegments(receiver), BlockFrame::End { unused, crc })
                if receiver.is_complete() =>
            {
                receiver.finish(unused, crc).map(|data| {
                    let done = ClientFrame::Block(BlockFrame::Done);
                    Step::SendLast(done, SdoReply::Uploaded(data))
                })
            }
            (Awaited::BlockReady, BlockFrame::Ready { object: about, crc, block_size, .. })
                if about == object =>
            {
                let mut sender = BlockSender::new(std::mem::take(&mut self.data));
                sender.block(block_size).map(|segments| {
                    self.awaited = Awaited::BlockAcknowledge(sender, crc);
                    Step::SendBlock(segments)
                })
            }
            (
                Awaited::BlockAcknowledge(sender, crc),
                BlockFrame::Acknowledge { sequence, block_size },
            ) => match sender.acknowledge(sequence) {
                Ok(true) => {
                    let end = sender.end(*crc);
                    self.awaited = Awaited::BlockDone;
                    Ok(Step::Send(ClientFrame::Block(end)))
                }
                Ok(false) => sender.block(block_size).map(Step::SendBlock),
                Err(code) => Err(code),
            },
            (Awaited::BlockDone, BlockFrame::Done) => Ok(Step::Done(SdoReply::Downloaded)),
            // Left over from a transfer given up before.
            _ => Ok(Step::Ignore),
        };
        step.unwrap_or_else(fail)
    }

    pub(super) fn take_block_segment(&mut self, segment: BlockSegment) -> Step {
        let Awaited::BlockSegments(receiver) = &mut self.awaited else { return Step::Ignore };
        match receiver.take(segment) {
            Ok(None) => Step::Wait,
            Ok(Some(acknowledge)) => Step::Send(ClientFrame::Block(acknowledge)),
            Err(code) => fail(code),
        }
    }
}

fn fail(code: AbortCode) -> Step {
    Step::Fail(SdoErrorKind::Block(code), Some(code))
}
