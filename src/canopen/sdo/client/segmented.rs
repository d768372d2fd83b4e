//! Expedited and segmented transfer, as the client sees them.

use std::cmp::Ordering;

use super::{Awaited, Step, Transfer};
use crate::canopen::sdo::codec::{ClientFrame, Initiate, Segment, ServerFrame};
use crate::canopen::sdo::{AbortCode, MAX_TRANSFER_BYTES, SdoErrorKind, SdoReply};

impl Transfer {
    /// What `answer`, of an expedited or segmented transfer, means to this one. What is none of
    /// it is left over from a transfer given up before.
    pub(super) fn segmented_step(&mut self, answer: ServerFrame) -> Step {
        use ServerFrame as S;
        match (&self.awaited, answer) {
            (Awaited::Upload, S::InitiateUpload(about, initiate)) if about == self.object => {
                match initiate {
                    Initiate::Expedited(chunk) => {
                        Step::Done(SdoReply::Uploaded(chunk.as_slice().to_vec()))
                    }
                    Initiate::Segmented(announced) => self.begin_upload(announced),
                }
            }
            (&Awaited::UploadSegment { toggle, announced }, S::UploadSegment(segment)) => {
                self.take_segment(toggle, announced, segment)
            }
            (Awaited::Download, S::InitiateDownload(about)) if about == self.object => {
                match Initiate::for_data(&self.data) {
                    Initiate::Expedited(_) => Step::Done(SdoReply::Downloaded),
                    Initiate::Segmented(_) => self.send_segment(0, false),
                }
            }
            (
                &Awaited::DownloadSegment { toggle, sent },
                S::DownloadSegment { toggle: answered },
            ) => {
                if answered != toggle {
                    Step::Fail(SdoErrorKind::Toggle(sent), Some(AbortCode::ToggleNotAlternated))
                } else if sent == self.data.len() {
                    Step::Done(SdoReply::Downloaded)
                } else {
                    self.send_segment(sent, !toggle)
                }
            }
            _ => Step::Ignore,
        }
    }

    fn begin_upload(&mut self, announced: Option<u32>) -> Step {
        let size = announced.map_or(0, |size| usize::try_from(size).unwrap_or(usize::MAX));
        if size > MAX_TRANSFER_BYTES {
            return Step::Fail(SdoErrorKind::TooLong(size), Some(AbortCode::OutOfMemory));
        }
        self.awaited = Awaited::UploadSegment { toggle: false, announced };
        Step::Send(ClientFrame::UploadSegment { toggle: false })
    }

    fn take_segment(&mut self, toggle: bool, announced: Option<u32>, segment: Segment) -> Step {
        if segment.toggle != toggle {
            let kind = SdoErrorKind::Toggle(self.data.len());
            return Step::Fail(kind, Some(AbortCode::ToggleNotAlternated));
        }
        self.data.extend_from_slice(segment.chunk.as_slice());
        let received = self.data.len();
        if received > MAX_TRANSFER_BYTES {
            return Step::Fail(SdoErrorKind::TooLong(received), Some(AbortCode::OutOfMemory));
        }
        if let Some(announced) = announced {
            let size = usize::try_from(announced).unwrap_or(usize::MAX);
            let code = match received.cmp(&size) {
                Ordering::Greater => Some(AbortCode::LengthTooHigh),
                Ordering::Less if segment.last => Some(AbortCode::LengthTooLow),
                _ => None,
            };
            if code.is_some() {
                return Step::Fail(SdoErrorKind::Size { announced, received }, code);
            }
        }
        if segment.last {
            return Step::Done(SdoReply::Uploaded(std::mem::take(&mut self.data)));
        }
        self.awaited = Awaited::UploadSegment { toggle: !toggle, announced };
        Step::Send(ClientFrame::UploadSegment { toggle: !toggle })
    }

    fn send_segment(&mut self, offset: usize, toggle: bool) -> Step {
        let segment = Segment::at(&self.data, offset, toggle);
        let sent = offset + segment.chunk.as_slice().len();
        self.awaited = Awaited::DownloadSegment { toggle, sent };
        Step::Send(ClientFrame::DownloadSegment(segment))
    }
}
