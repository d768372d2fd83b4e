//! Block transfer, as the server sees it.

use super::{Direction, NOTHING, ObjectAccess, SdoServer, Transfer};
use crate::canopen::ObjectAddress;
use crate::canopen::sdo::AbortCode;
use crate::canopen::sdo::block::{
    BLOCK_SIZE_MAX, BlockFrame, BlockReceiver, BlockSegment, BlockSender,
};
use crate::canopen::sdo::codec::ServerFrame;
use crate::units::Time;

impl SdoServer {
    /// Takes a frame that steers a block transfer; a first one ends what was under way.
    pub(super) fn handle_block(
        &mut self,
        now: Time,
        frame: BlockFrame,
        transfer: Option<Transfer>,
        objects: &mut impl ObjectAccess,
    ) {
        let about = frame.object().or(transfer.as_ref().map(|transfer| transfer.object));
        let answered = match (frame, transfer) {
            (BlockFrame::Ready { object, crc, block_size, threshold }, _) => {
                self.begin_block_upload(now, object, crc, block_size, threshold, objects)
            }
            (BlockFrame::Announce { object, crc, size }, _) => {
                self.begin_block_download(now, object, size, crc)
            }
            (frame, Some(transfer)) => self.go_on_with_block(now, frame, transfer, objects),
            (_, None) => Err(AbortCode::UnknownSpecifier),
        };
        if let Err(code) = answered {
            self.outgoing.push_back(ServerFrame::Abort(about.unwrap_or(NOTHING), code));
        }
    }

    fn begin_block_upload(
        &mut self,
        now: Time,
        object: ObjectAddress,
        crc: bool,
        block_size: u8,
        threshold: u8,
        objects: &mut impl ObjectAccess,
    ) -> Result<(), AbortCode> {
        if !(1..=BLOCK_SIZE_MAX).contains(&block_size) {
            return Err(AbortCode::InvalidBlockSize);
        }
        let data = objects.read(object)?;
        if threshold > 0 && data.len() <= usize::from(threshold) {
            let answer = self.answer_upload(now, object, data);
            self.outgoing.push_back(answer);
            return Ok(());
        }
        let sender = BlockSender::new(data);
        let size = u32::try_from(sender.size()).ok();
        self.begin(now, object, Vec::new(), Direction::BlockUpload { sender, block_size, crc });
        self.send_block_frame(BlockFrame::Announce { object, crc: true, size });
        Ok(())
    }

    fn begin_block_download(
        &mut self,
        now: Time,
        object: ObjectAddress,
        size: Option<u32>,
        crc: bool,
    ) -> Result<(), AbortCode> {
        let receiver = BlockReceiver::new(size, crc)?;
        self.begin(now, object, Vec::new(), Direction::BlockDownload(receiver));
        let block_size = BLOCK_SIZE_MAX;
        self.send_block_frame(BlockFrame::Ready { object, crc: true, block_size, threshold: 0 });
        Ok(())
    }

    fn go_on_with_block(
        &mut self,
        now: Time,
        frame: BlockFrame,
        mut transfer: Transfer,
        objects: &mut impl ObjectAccess,
    ) -> Result<(), AbortCode> {
        match (&mut transfer.direction, frame) {
            (Direction::BlockUpload { sender, block_size, .. }, BlockFrame::Start) => {
                let segments = sender.block(*block_size)?;
                self.send_segments(segments);
            }
            (
                Direction::BlockUpload { sender, crc, .. },
                BlockFrame::Acknowledge { sequence, block_size },
            ) => {
                if sender.acknowledge(sequence)? {
                    let end = sender.end(*crc);
                    transfer.direction = Direction::BlockUploadEnded;
                    self.send_block_frame(end);
                } else {
                    let segments = sender.block(block_size)?;
                    self.send_segments(segments);
                }
            }
            (Direction::BlockUploadEnded, BlockFrame::Done) => return Ok(()),
            (Direction::BlockDownload(receiver), BlockFrame::End { unused, crc }) => {
                objects.write(transfer.object, &receiver.finish(unused, crc)?)?;
                self.send_block_frame(BlockFrame::Done);
                return Ok(());
            }
            _ => return Err(AbortCode::UnknownSpecifier),
        }
        transfer.deadline = now + self.timeout;
        self.transfer = Some(transfer);
        Ok(())
    }

    pub(super) fn take_block_segment(
        &mut self,
        now: Time,
        mut transfer: Transfer,
        segment: BlockSegment,
    ) -> Option<ServerFrame> {
        let object = transfer.object;
        let Direction::BlockDownload(receiver) = &mut transfer.direction else {
            return Some(ServerFrame::Abort(object, AbortCode::UnknownSpecifier));
        };
        let before = receiver.received();
        match receiver.take(segment) {
            Err(code) => Some(ServerFrame::Abort(object, code)),
            Ok(acknowledge) => {
                // Not for what is out of order: it may be another client's request.
                if receiver.received() > before {
                    transfer.deadline = now + self.timeout;
                }
                self.transfer = Some(transfer);
                acknowledge.map(ServerFrame::Block)
            }
        }
    }

    fn send_block_frame(&mut self, frame: BlockFrame) {
        self.outgoing.push_back(ServerFrame::Block(frame));
    }

    fn send_segments(&mut self, segments: Vec<BlockSegment>) {
        self.outgoing.extend(segments.into_iter().map(ServerFrame::BlockSegment));
    }
}
