//! The drive's communication. Each PDO of the test's drive carries the target position, from -1000 to 1000 counts.

use super::*;
use crate::canopen::CanId;
use crate::canopen::eds::Eds;
use crate::units::at_ms;

const TARGET: ObjectAddress = object::TARGET_POSITION;

fn node() -> Drive {
    let sheet = objects::data_sheet(&config()).to_string();
    let limited = sheet.replace("[607A]", "[607A]\nLowLimit=-1000\nHighLimit=1000");
    let mut eds = Eds::parse(&limited);
    let entry = MappedObject { object: TARGET, bits: 32 }.to_u32();
    for n in 0..4 {
        for (communication, mapping) in [(0x1400, 0x1600), (0x1800, 0x1a00)] {
            eds.set(&format!("{:04X}sub2", communication + n), "DefaultValue", 1);
            eds.set(&format!("{:04X}sub0", mapping + n), "DefaultValue", 1);
            eds.set(&format!("{:04X}sub1", mapping + n), "DefaultValue", entry);
        }
    }
    let mut node = Drive::with_objects(config(), eds.objects(NODE));
    assert_eq!(sent(&mut node), "705#00");
    node
}

fn target(node: &Drive) -> i64 {
    node.device.objects.integer(TARGET)
}

fn sent(node: &mut Drive) -> String {
    let frames = std::iter::from_fn(|| node.poll_transmit()).map(|frame| frame.to_string());
    frames.collect::<Vec<_>>().join(" ")
}

fn give(node: &mut Drive, ms: i64, frame: Frame) -> String {
    node.handle_frame(at_ms(ms), &frame);
    sent(node)
}

fn nmt(node: &mut Drive, ms: i64, command: NmtCommand) -> String {
    give(node, ms, nmt_frame(command, Some(NODE)))
}

fn sdo(node: &mut Drive, bytes: [u8; 8]) -> String {
    give(node, 0, Frame::new(0x605, &bytes))
}

/// Writes by expedited SDO. Returns the bytes of the abort code, or nothing on success.
fn write(node: &mut Drive, index: u16, sub: u8, data: &[u8]) -> String {
    let [low, high] = index.to_le_bytes();
    let mut bytes = [0x23 | (4 - data.len() as u8) << 2, low, high, sub, 0, 0, 0, 0];
    bytes[4..4 + data.len()].copy_from_slice(data);
    let answer = sdo(node, bytes);
    answer.strip_prefix(&format!("585#80{low:02X}{high:02X}{sub:02X}")).unwrap_or("").into()
}

fn started() -> Drive {
    let mut node = node();
    assert_eq!(nmt(&mut node, 0, NmtCommand::StartRemoteNode), "");
    node
}

#[test]
fn a_node_reports_its_identity_and_keeps_it() {
    let mut node = node();
    assert_eq!(sdo(&mut node, [0x40, 0x18, 0x10, 1, 0, 0, 0, 0]), "585#43181001FB000000");
    assert_eq!(sdo(&mut node, [0x40, 0x08, 0x10, 0, 0, 0, 0, 0]), "585#410810000E000000");
    assert_eq!(sdo(&mut node, [0x40, 0x18, 0x10, 9, 0, 0, 0, 0]), "585#8018100911000906");
    assert_eq!(write(&mut node, 0x1018, 1, &[0; 4]), "02000106");
}

/// Expedited, without a size (e = 1, s = 0): the length of the object counts (CiA 301, 7.2.4.3.3).
#[test]
fn a_value_written_without_a_size_has_that_of_its_object() {
    let mut node = node();
    assert_eq!(sdo(&mut node, [0x22, 0x29, 0x10, 1, 2, 9, 9, 9]), "585#6029100100000000");
    assert_eq!(sdo(&mut node, [0x40, 0x29, 0x10, 1, 0, 0, 0, 0]), "585#4F29100102000000");
    assert_eq!(sdo(&mut node, [0x22, 0x17, 0x10, 0, 0xe8, 3, 9, 9]), "585#6017100000000000");
    assert_eq!(sdo(&mut node, [0x40, 0x17, 0x10, 0, 0, 0, 0, 0]), "585#4B171000E8030000");
    assert_eq!(sdo(&mut node, [0x22, 0x7a, 0x60, 0, 7, 0, 0, 0]), "585#607A600000000000");
    assert_eq!(target(&node), 7);
    assert_eq!(write(&mut node, 0x1017, 0, &[0, 0, 0, 0]), "12000706", "with a wrong size");
}

#[test]
fn received_data_waits_for_sync_and_samples_come_before_it() {
    let mut node = started();
    assert_eq!(give(&mut node, 1, Frame::new(0x205, &[7, 0, 0, 0])), "");
    assert_eq!(target(&node), 0);
    assert_eq!(give(&mut node, 10, sync_frame()), "185#00000000");
    assert_eq!(target(&node), 7);
    assert_eq!(give(&mut node, 20, sync_frame()), "185#07000000");
}

#[test]
fn of_two_pdos_before_a_sync_the_newer_counts() {
    let mut node = started();
    give(&mut node, 1, Frame::new(0x205, &[7, 0, 0, 0]));
    give(&mut node, 2, Frame::new(0x205, &[8, 0, 0, 0]));
    give(&mut node, 10, sync_frame());
    assert_eq!(target(&node), 8);
}

#[test]
fn pdos_flow_in_operational_only() {
    let mut node = node();
    give(&mut node, 1, Frame::new(0x205, &[7, 0, 0, 0]));
    assert_eq!(give(&mut node, 1, sync_frame()), "");
    nmt(&mut node, 2, NmtCommand::StartRemoteNode);
    give(&mut node, 3, Frame::new(0x205, &[7, 0, 0, 0]));
    nmt(&mut node, 4, NmtCommand::EnterPreOperational);
    nmt(&mut node, 5, NmtCommand::StartRemoteNode);
    give(&mut node, 6, sync_frame());
    assert_eq!(target(&node), 0, "an RPDO before the SYNC is dropped on leaving operational");
}

#[test]
fn stopped_answers_nothing_but_nmt() {
    let mut node = started();
    nmt(&mut node, 0, NmtCommand::StopRemoteNode);
    assert_eq!(sdo(&mut node, [0x40, 0x18, 0x10, 1, 0, 0, 0, 0]), "");
    assert_eq!(give(&mut node, 1, sync_frame()), "");
    assert_eq!(nmt(&mut node, 2, NmtCommand::EnterPreOperational), "");
    assert_eq!(node.nmt_state(), NmtState::PreOperational);
}

#[test]
fn short_pdos_and_values_out_of_limits_are_ignored() {
    let mut node = started();
    assert_eq!(give(&mut node, 1, Frame::new(0x205, &[7, 0])), "085#1082110000000000");
    assert_eq!(give(&mut node, 1, Frame::new(0x205, &[7, 0])), "", "reported once");
    assert_eq!(give(&mut node, 2, Frame::new(0x205, &[0, 0, 1, 0])), "085#0000000000000000");
    give(&mut node, 10, sync_frame());
    assert_eq!(target(&node), 0);
    assert_eq!(sdo(&mut node, [0x40, 0x03, 0x10, 1, 0, 0, 0, 0]), "585#4303100110820000");
}

/// CiA 301, 7.5.2.4.
#[test]
fn the_error_history_has_no_data_beyond_its_errors() {
    let mut node = started();
    let read = |node: &mut Drive, sub| sdo(node, [0x40, 0x03, 0x10, sub, 0, 0, 0, 0]);
    assert_eq!(read(&mut node, 0), "585#4F03100000000000");
    assert_eq!(read(&mut node, 1), "585#8003100124000008");
    give(&mut node, 1, Frame::new(0x205, &[7, 0]));
    assert_eq!(read(&mut node, 1), "585#4303100110820000");
    assert_eq!(read(&mut node, 2), "585#8003100224000008");
    assert_eq!(read(&mut node, 9), "585#8003100911000906", "no such subindex");
    assert_eq!(write(&mut node, 0x1003, 0, &[1]), "30000906");
    assert_eq!(write(&mut node, 0x1003, 0, &[0]), "");
    assert_eq!(read(&mut node, 1), "585#8003100124000008");
}

#[test]
fn remapping_follows_the_rules_of_cia_301() {
    let mut node = node();
    let wide = MappedObject::new(0x607a, 0, 32).to_u32().to_le_bytes();
    let register = MappedObject::new(0x1001, 0, 8).to_u32().to_le_bytes();
    let absent = MappedObject::new(0x2002, 0, 32).to_u32().to_le_bytes();
    let on = 0x4000_0185u32.to_le_bytes();
    let off = 0xc000_0185u32.to_le_bytes();
    let other = 0x4000_0187u32.to_le_bytes();
    assert_eq!(write(&mut node, 0x1a00, 0, &[0]), "00000106", "the PDO is still valid");
    assert_eq!(write(&mut node, 0x1800, 1, &other), "30000906", "the PDO is still valid");
    assert_eq!(write(&mut node, 0x1800, 1, &off), "");
    assert_eq!(write(&mut node, 0x1a00, 1, &register), "00000106", "still mapped");
    assert_eq!(write(&mut node, 0x1a00, 0, &[0]), "");
    assert_eq!(write(&mut node, 0x1a00, 1, &absent), "00000206", "no such object");
    assert_eq!(write(&mut node, 0x1a00, 1, &[16, 0, 0x7a, 0x60]), "41000406", "wrong length");
    assert_eq!(write(&mut node, 0x1a00, 1, &register), "");
    for sub in 2..=4 {
        assert_eq!(write(&mut node, 0x1a00, sub, &wide), "");
    }
    assert_eq!(write(&mut node, 0x1a00, 0, &[3]), "42000406", "72 bits");
    assert_eq!(write(&mut node, 0x1a00, 0, &[9]), "42000406");
    assert_eq!(write(&mut node, 0x1a00, 0, &[2]), "");
    assert_eq!(write(&mut node, 0x1800, 2, &[245]), "30000906", "reserved type");
    assert_eq!(write(&mut node, 0x1800, 2, &[2]), "");
    assert_eq!(
        write(&mut node, 0x1800, 1, &0x605u32.to_le_bytes()),
        "30000906",
        "the identifier of an SDO"
    );
    assert_eq!(write(&mut node, 0x1800, 1, &on), "");
    assert_eq!(write(&mut node, 0x1a00, 0, &[0]), "00000106");

    nmt(&mut node, 0, NmtCommand::StartRemoteNode);
    assert_eq!(give(&mut node, 10, sync_frame()), "");
    assert_eq!(give(&mut node, 20, sync_frame()), "185#0000000000", "every second SYNC");

    assert_eq!(write(&mut node, 0x607a, 0, &[7, 0, 0, 0]), "");
    assert_eq!(nmt(&mut node, 30, NmtCommand::ResetCommunication), "705#00");
    assert_eq!(sdo(&mut node, [0x40, 0x00, 0x1a, 0, 0, 0, 0, 0]), "585#4F001A0001000000");
    assert_eq!(target(&node), 7, "objects of the axis keep their values");
}

/// CiA 301, table 39. An extended identifier (bit 29) is refused for a PDO that is off (bit 31) too.
#[test]
fn restricted_and_extended_identifiers_are_refused() {
    let mut node = node();
    for cob_id in [0x000, 0x07f, 0x101, 0x180, 0x581, 0x601, 0x67f, 0x6e0, 0x701, 0x7ff_u32] {
        assert_eq!(write(&mut node, 0x1005, 0, &cob_id.to_le_bytes()), "30000906", "{cob_id:X}");
    }
    for cob_id in [0x080, 0x100, 0x181, 0x6df_u32] {
        assert_eq!(write(&mut node, 0x1005, 0, &cob_id.to_le_bytes()), "", "{cob_id:X}");
    }
    for (cob_id, answer) in
        [(0xc000_0185_u32, ""), (0xe000_0185, "30000906"), (0x6000_0185, "30000906")]
    {
        assert_eq!(write(&mut node, 0x1800, 1, &cob_id.to_le_bytes()), answer, "{cob_id:X}");
    }
}

#[test]
fn event_driven_pdos_come_on_change_and_by_timer() {
    let mut node = node();
    assert_eq!(write(&mut node, 0x1800, 2, &[255]), "");
    assert_eq!(write(&mut node, 0x1800, 5, &100u16.to_le_bytes()), "");
    assert_eq!(write(&mut node, 0x1400, 2, &[255]), "");
    assert_eq!(nmt(&mut node, 0, NmtCommand::StartRemoteNode), "185#00000000");
    assert_eq!(give(&mut node, 5, Frame::new(0x205, &[7, 0, 0, 0])), "185#07000000");
    assert_eq!(give(&mut node, 6, Frame::new(0x205, &[7, 0, 0, 0])), "");
    assert_eq!(node.deadline(), at_ms(105));
    node.handle_timeout(at_ms(105));
    assert_eq!(sent(&mut node), "185#07000000");
    assert_eq!(give(&mut node, 105, Frame::new(0x205, &[8, 0, 0, 0])), "", "inhibited");
    assert_eq!(node.deadline(), at_ms(106));
    node.handle_timeout(at_ms(106));
    assert_eq!(sent(&mut node), "185#08000000");
}

#[test]
fn the_heartbeat_carries_the_nmt_state() {
    let mut node = node();
    assert_eq!(write(&mut node, 0x1017, 0, &100u16.to_le_bytes()), "");
    assert_eq!(node.deadline(), at_ms(100));
    node.handle_timeout(at_ms(100));
    assert_eq!(sent(&mut node), "705#7F");
    nmt(&mut node, 150, NmtCommand::StopRemoteNode);
    node.handle_timeout(at_ms(200));
    assert_eq!(sent(&mut node), "705#04");
    nmt(&mut node, 210, NmtCommand::EnterPreOperational);
    assert_eq!(write(&mut node, 0x607a, 0, &[7, 0, 0, 0]), "");
    nmt(&mut node, 250, NmtCommand::ResetNode);
    assert_eq!(target(&node), 0);
    assert_eq!(node.deadline(), Time::NEVER, "0x1017 is 0 again");
}

#[test]
fn a_lost_heartbeat_raises_8130_and_leaves_operational() {
    let mut node = started();
    assert_eq!(write(&mut node, 0x6007, 0, &[0, 0]), "", "the axis does not react");
    let supervise = (u32::from(MASTER.get()) << 16 | 50).to_le_bytes();
    assert_eq!(write(&mut node, 0x1016, 1, &supervise), "");
    assert_eq!(
        write(&mut node, 0x1016, 2, &supervise),
        "43000406",
        "the node is monitored already"
    );
    assert_eq!(node.deadline(), Time::NEVER, "monitoring starts with the first heartbeat");
    let heartbeat = heartbeat_frame(MASTER, NmtState::Operational);
    give(&mut node, 10, heartbeat);
    assert_eq!(node.deadline(), at_ms(60));
    node.handle_timeout(at_ms(60));
    assert_eq!(sent(&mut node), "085#3081117F00000000");
    assert_eq!(node.nmt_state(), NmtState::PreOperational);
    assert_eq!(give(&mut node, 70, heartbeat), "085#0000000000000000");

    nmt(&mut node, 70, NmtCommand::StartRemoteNode);
    let lost = give(&mut node, 80, heartbeat_frame(MASTER, NmtState::BootUp));
    assert_eq!(lost, "085#3081117F00000000", "a boot-up of the master is a loss too");
}

#[test]
fn error_behaviour_keeps_the_node_operational_or_stops_it() {
    for (behaviour, state) in [(1, NmtState::Operational), (2, NmtState::Stopped)] {
        let mut node = started();
        assert_eq!(write(&mut node, 0x1029, 1, &[behaviour]), "");
        assert_eq!(write(&mut node, 0x1016, 1, &[50, 0, 127, 0]), "");
        give(&mut node, 10, heartbeat_frame(MASTER, NmtState::Operational));
        node.handle_timeout(at_ms(60));
        assert_eq!(sent(&mut node), "085#3081117F00000000", "before the node is Stopped");
        assert_eq!(node.nmt_state(), state);
    }
}

/// CiA 301 advises against remote frames: none is answered, and their types are refused.
#[test]
fn remote_frames_are_not_answered() {
    let mut node = started();
    let remote = Frame::from_parts(CanId::Base(0x185), true, &[]).unwrap();
    assert_eq!(give(&mut node, 1, remote), "");
    for (index, kind) in [(0x1800, 252), (0x1800, 253), (0x1400, 253)] {
        let answer = write(&mut node, index, 2, &[kind]);
        assert!(answer.ends_with("30000906"), "{kind}: {answer}");
    }
}
