//! The predefined connection set: which identifier carries what (CiA 301, 7.3.3).

use super::NodeId;

/// NMT commands from the master.
pub const NMT: u16 = 0x000;
/// The SYNC object's default identifier.
pub const SYNC: u16 = 0x080;

/// Emergency messages of `node`.
pub const fn emcy(node: NodeId) -> u16 {
    0x080 + node.get() as u16
}

/// Transmit PDO 1 of `node` (the node sends it).
pub const fn tpdo1(node: NodeId) -> u16 {
    0x180 + node.get() as u16
}

/// Receive PDO 1 of `node` (the node acts on it).
pub const fn rpdo1(node: NodeId) -> u16 {
    0x200 + node.get() as u16
}

/// SDO from the server `node` to its client.
pub const fn sdo_tx(node: NodeId) -> u16 {
    0x580 + node.get() as u16
}

/// SDO from a client to the server `node`.
pub const fn sdo_rx(node: NodeId) -> u16 {
    0x600 + node.get() as u16
}

/// Boot-up and heartbeat messages of `node`.
pub const fn heartbeat(node: NodeId) -> u16 {
    0x700 + node.get() as u16
}

/// The node that `cob_id` names, if it is one of the 127 identifiers that follow `base`.
pub(crate) fn node_of(cob_id: u16, base: u16) -> Option<NodeId> {
    cob_id.checked_sub(base).and_then(|id| u8::try_from(id).ok()).and_then(NodeId::new)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_are_those_of_the_standard() {
        let node = NodeId::new(5).unwrap();
        let last = NodeId::new(127).unwrap();
        assert_eq!(emcy(node), 0x085);
        assert_eq!((tpdo1(node), rpdo1(node)), (0x185, 0x205));
        assert_eq!((sdo_tx(last), sdo_rx(last), heartbeat(last)), (0x5ff, 0x67f, 0x77f));
    }

    #[test]
    fn a_node_is_found_only_in_its_own_function_code() {
        assert_eq!(node_of(0x705, 0x700), NodeId::new(5));
        assert_eq!(node_of(0x700, 0x700), None);
        assert_eq!(node_of(0x780, 0x700), None);
        assert_eq!(node_of(0x080, 0x700), None);
    }
}
