//! What only a master sends: another one on the bus has no business with this stage's drives.

use crate::canopen::nmt::NmtCommand;
use crate::canopen::{Frame, NodeId, cob};

// Client command specifiers (CiA 301, 7.2.4.3).
const INITIATE_DOWNLOAD: u8 = 1;
const BLOCK_DOWNLOAD: u8 = 6;

/// What `frame`, received, does as a master of `drives` would, or as the node `bench`; `None` where
/// it does nothing to them. Reading an object of a drive is nobody's harm, nor is starting a node.
pub(super) fn word_of_another_master(
    frame: &Frame,
    bench: NodeId,
    drives: [NodeId; 2],
) -> Option<&'static str> {
    let cob_id = frame.cob_id()?;
    let is_one_of = |of: fn(NodeId) -> u16| drives.into_iter().any(|node| of(node) == cob_id);
    if cob_id == cob::SYNC {
        Some("SYNC")
    } else if cob_id == cob::NMT {
        let &[command, node] = frame.data() else { return None };
        let is_ours = node == 0 || drives.iter().any(|drive| drive.get() == node);
        let is_harmless = command == NmtCommand::StartRemoteNode as u8;
        (is_ours && !is_harmless).then_some("an NMT command")
    } else if cob_id == cob::heartbeat(bench) {
        // The drives would take it for the bench's, and not miss the bench.
        Some("a heartbeat of the bench's own node number")
    } else if is_one_of(cob::rpdo) {
        Some("RPDO1 of a drive")
    } else if is_one_of(cob::sdo_rx) {
        let specifier = frame.data().first().map(|command| command >> 5);
        let writes = matches!(specifier, Some(INITIATE_DOWNLOAD | BLOCK_DOWNLOAD));
        writes.then_some("a write to a drive's object dictionary")
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_moves_or_rewires_a_drive_is_a_masters_word() {
        let node = |n| NodeId::new(n).unwrap();
        let word = |id, data: &[u8]| {
            word_of_another_master(&Frame::new(id, data), node(127), [node(1), node(2)])
        };
        let of_a_master: [(u16, &[u8]); 9] = [
            (0x080, &[]),
            (0x000, &[0x80, 1]),
            (0x000, &[0x02, 0]),
            (0x000, &[0x81, 2]),
            (0x201, &[0x0F, 0, 0, 0, 0, 0]),
            (0x202, &[]),
            (0x77F, &[5]),
            (0x601, &[0x23, 0x16, 0x10, 1, 0, 0, 0, 0]),
            (0x602, &[0xC2, 0x10, 0x10, 1, 0, 0, 0, 0]),
        ];
        for (id, data) in of_a_master {
            assert!(word(id, data).is_some(), "{id:03X} {data:?}");
        }
        let of_nobody: [(u16, &[u8]); 9] = [
            (0x000, &[0x01, 0]),
            (0x000, &[0x80, 3]),
            (0x000, &[]),
            (0x181, &[0; 6]),
            (0x203, &[0; 6]),
            (0x601, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]),
            (0x603, &[0x2B, 0x40, 0x60, 0, 0, 0, 0, 0]),
            (0x77E, &[5]),
            (0x601, &[]),
        ];
        for (id, data) in of_nobody {
            assert_eq!(word(id, data), None, "{id:03X} {data:?}");
        }
    }
}
