//! Network management: commands, states and the heartbeat's bytes (CiA 301, 7.2.8).

use super::{Frame, NodeId, cob};

/// A command of the NMT master to a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum NmtCommand {
    /// Go to Operational: PDOs flow.
    StartRemoteNode = 0x01,
    /// Go to Stopped: NMT and heartbeat only.
    StopRemoteNode = 0x02,
    /// Go to Pre-operational: SDOs, no PDOs.
    EnterPreOperational = 0x80,
    /// Restart the application: every object returns to its power-on value.
    ResetNode = 0x81,
    /// Restart communication: objects 0x1000 to 0x1FFF return to their power-on values.
    ResetCommunication = 0x82,
}

impl NmtCommand {
    const ALL: [NmtCommand; 5] = [
        NmtCommand::StartRemoteNode,
        NmtCommand::StopRemoteNode,
        NmtCommand::EnterPreOperational,
        NmtCommand::ResetNode,
        NmtCommand::ResetCommunication,
    ];
}

/// The state a node reports in its heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, derive_more::Display)]
pub enum NmtState {
    /// 0: the boot-up message, sent once on entering Pre-operational.
    #[display("boot-up")]
    BootUp,
    /// 4: neither PDO nor SDO.
    #[display("stopped")]
    Stopped,
    /// 5: PDO and SDO.
    #[display("operational")]
    Operational,
    /// 127: SDO, no PDO.
    #[display("pre-operational")]
    PreOperational,
    /// A value the standard does not define.
    #[display("unknown NMT state 0x{_0:02X}")]
    Unknown(u8),
}

impl NmtState {
    /// The state of a heartbeat's byte; bit 7, the node guarding toggle, is left out.
    pub const fn from_byte(byte: u8) -> Self {
        match byte & 0x7f {
            0x00 => NmtState::BootUp,
            0x04 => NmtState::Stopped,
            0x05 => NmtState::Operational,
            0x7f => NmtState::PreOperational,
            other => NmtState::Unknown(other),
        }
    }

    /// The byte a heartbeat carries.
    pub const fn to_byte(self) -> u8 {
        match self {
            NmtState::BootUp => 0x00,
            NmtState::Stopped => 0x04,
            NmtState::Operational => 0x05,
            NmtState::PreOperational => 0x7f,
            NmtState::Unknown(byte) => byte,
        }
    }
}

/// The frame that gives `command` to `node`, or to every node when `None`.
pub fn nmt_frame(command: NmtCommand, node: Option<NodeId>) -> Frame {
    Frame::new(cob::NMT, &[command as u8, node.map_or(0, NodeId::get)])
}

/// The command in `frame` and the node it is for (`None`: all); `None` when it is no NMT command.
pub fn parse_nmt(frame: &Frame) -> Option<(NmtCommand, Option<NodeId>)> {
    let (Some(cob::NMT), &[specifier, node]) = (frame.cob_id(), frame.data()) else { return None };
    let command = NmtCommand::ALL.into_iter().find(|command| *command as u8 == specifier)?;
    match node {
        0 => Some((command, None)),
        node => Some((command, Some(NodeId::new(node)?))),
    }
}

/// The heartbeat of `node` in `state`; with [`NmtState::BootUp`] its boot-up message.
pub fn heartbeat_frame(node: NodeId, state: NmtState) -> Frame {
    Frame::new(cob::heartbeat(node), &[state.to_byte()])
}

/// The sender and state of a heartbeat or boot-up message; `None` for any other frame.
pub fn parse_heartbeat(frame: &Frame) -> Option<(NodeId, NmtState)> {
    let node = cob::node_of(frame.cob_id()?, 0x700)?;
    match frame.data() {
        &[byte] => Some((node, NmtState::from_byte(byte))),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const NODE: NodeId = NodeId::new(5).unwrap();

    #[test]
    fn commands_are_two_bytes_on_identifier_zero() {
        let frames = [
            (NmtCommand::StartRemoteNode, Some(NODE), "000#0105"),
            (NmtCommand::StopRemoteNode, Some(NODE), "000#0205"),
            (NmtCommand::EnterPreOperational, None, "000#8000"),
            (NmtCommand::ResetNode, Some(NODE), "000#8105"),
            (NmtCommand::ResetCommunication, None, "000#8200"),
        ];
        for (command, node, bytes) in frames {
            let frame = nmt_frame(command, node);
            assert_eq!(frame.to_string(), bytes);
            assert_eq!(parse_nmt(&frame), Some((command, node)));
        }
        assert_eq!(parse_nmt(&Frame::new(0, &[0x03, 5])), None);
        assert_eq!(parse_nmt(&Frame::new(0, &[0x01, 200])), None);
        assert_eq!(parse_nmt(&Frame::new(0, &[0x01])), None);
    }

    #[test]
    fn a_heartbeat_carries_the_nmt_state() {
        assert_eq!(heartbeat_frame(NODE, NmtState::BootUp).to_string(), "705#00");
        assert_eq!(heartbeat_frame(NODE, NmtState::PreOperational).to_string(), "705#7F");
        let operational = Frame::new(0x705, &[0x05]);
        assert_eq!(parse_heartbeat(&operational), Some((NODE, NmtState::Operational)));
        assert_eq!(parse_heartbeat(&Frame::new(0x705, &[])), None);
        assert_eq!(parse_heartbeat(&Frame::new(0x605, &[5])), None);
    }

    proptest! {
        #[test]
        fn every_state_byte_is_kept(byte in 0u8..0x80) {
            prop_assert_eq!(NmtState::from_byte(byte).to_byte(), byte);
        }
    }
}
