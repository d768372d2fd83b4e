//! What a frame is for, by its identifier.

use crate::canopen::Frame;

/// The service of a frame (CiA 301, 7.3.5: pre-defined connection set).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Service {
    Nmt,
    Sync,
    Time,
    Emergency(u8),
    /// Transmit PDO (from the drive) 1 to 4 of a node.
    Tpdo(u8, u8),
    /// Receive PDO (to the drive) 1 to 4 of a node.
    Rpdo(u8, u8),
    SdoAnswer(u8),
    SdoRequest(u8),
    Heartbeat(u8),
    Other,
}

impl Service {
    pub(super) fn of(frame: &Frame) -> Self {
        let Some(cob_id) = frame.cob_id() else { return Service::Other };
        let node = (cob_id & 0x7F) as u8;
        match (cob_id >> 7, node) {
            (0x0, 0) => Service::Nmt,
            (0x1, 0) => Service::Sync,
            (0x2, 0) => Service::Time,
            (_, 0) => Service::Other,
            (0x1, _) => Service::Emergency(node),
            (0xB, _) => Service::SdoAnswer(node),
            (0xC, _) => Service::SdoRequest(node),
            (0xE, _) => Service::Heartbeat(node),
            (code @ 0x3..=0xA, _) if code % 2 == 1 => Service::Tpdo((code as u8 - 1) / 2, node),
            (code @ 0x3..=0xA, _) => Service::Rpdo((code as u8 - 2) / 2, node),
            _ => Service::Other,
        }
    }

    /// Sent again and again, whether it says something new or not.
    pub(super) fn is_cyclic(self) -> bool {
        matches!(self, Service::Sync | Service::Tpdo(..) | Service::Rpdo(..))
    }
}
