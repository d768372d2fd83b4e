//! The client's side of one expedited or segmented transfer.

use super::{Awaited, NO_OBJECT, Step, Transfer};
use crate::canopen::sdo::codec::{ClientFrame, Initiate, Segment, ServerFrame};
use crate::canopen::sdo::{AbortCode, MAX_TRANSFER_BYTES, SdoErrorKind, SdoReply, check_size};

impl Transfer {
    /// What `answer` means to this transfer. An answer that does not belong to it is left over from
    /// a transfer that was given up.
    pub(super) fn step(&mut self, answer: ServerFrame) -> Step {
        use ServerFrame as S;
        match (&self.awaited, answer) {
            // Some servers name no object. One transfer runs at a time, so the abort is for it.
            (_, S::Abort(about, code)) if about == self.object || about == NO_OBJECT => {
                Step::Fail(SdoErrorKind::Aborted(code), None)
            }
            (_, S::Unsupported(command)) => {
                let kind = SdoErrorKind::UnexpectedCommand(command);
                Step::Fail(kind, Some(AbortCode::UnknownSpecifier))
            }
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
        if let Err(code) = check_size(received, announced, segment.last) {
            let kind = match announced {
                Some(announced) if code != AbortCode::OutOfMemory => {
                    SdoErrorKind::Size { announced, received }
                }
                _ => SdoErrorKind::TooLong(received),
            };
            return Step::Fail(kind, Some(code));
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
