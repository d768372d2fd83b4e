//! Frames of real drives during bring-up, as others published them: the bench sends the same requests, and
//! reads the answers correctly.

use needle_bench::canopen::cia402::{Controlword, DriveState, Statusword};
use needle_bench::canopen::nmt::{NmtCommand, NmtState, parse_heartbeat, parse_nmt};
use needle_bench::canopen::sdo::codec::ClientFrame;
use needle_bench::canopen::sdo::{AbortCode, SdoClient, SdoError, SdoReply, SdoRequest};
use needle_bench::canopen::{Frame, NodeId};
use needle_bench::units::Time;
use std::time::Duration;

/// SDO requests and the drives' answers.
const SDO_TRANSFERS: [[&str; 2]; 9] = [
    // A pair of servo drives for a mobile robot, vendor 0x300: "NaviCAN" motor set-up guide. They
    // repeat the data of a write in its confirmation, where CiA 301 reserves the bytes.
    ["601#4000100000000000", "581#4300100092010200"],
    ["601#4018100100000000", "581#4318100100030000"],
    ["601#4018100200000000", "581#4318100244460000"],
    ["602#2316100158026400", "582#6016100158026400"],
    // A maxon EPOS, statusword: github.com/machinekit/machinekit/issues/589.
    ["602#4041600000000000", "582#4B41600037070000"],
    // A drive on node 5, mode and controlwords: an example for libcanopen, by the same author.
    ["605#2F60600001000000", "585#6060600000000000"],
    ["605#2B40600006000000", "585#6040600000000000"],
    ["605#237A6000803E0000", "585#607A600000000000"],
    // An iHSV60, which lacks 0x6502: github.com/ros-industrial/ros2_canopen/issues/299.
    ["601#4002650000000000", "581#8002650000000206"],
];

fn frame(text: &str) -> Frame {
    Frame::parse(text).unwrap_or_else(|| panic!("{text}"))
}

#[test]
fn sdo_requests_are_those_sent_to_real_drives_and_their_answers_are_read() {
    for [request, answer] in SDO_TRANSFERS.map(|pair| pair.map(frame)) {
        let node = NodeId::new((request.cob_id().unwrap() & 0x7F) as u8).unwrap();
        let ClientFrame::Request(asked) = ClientFrame::decode(request.data()).unwrap() else {
            panic!("{request} is not a request");
        };
        let mut client = SdoClient::new(node, Duration::from_millis(150));
        client.start(Time::ZERO, asked);
        assert_eq!(client.poll_transmit(), Some(request));
        client.handle_frame(Time::ZERO, &answer);
        match (client.poll_result().expect("a result"), answer.data()[0]) {
            (Ok(SdoReply::Uploaded(value)), 0x43) => {
                assert_eq!(value.as_bytes(), &answer.data()[4..]);
            }
            (Ok(SdoReply::Uploaded(value)), 0x4B) => {
                assert_eq!(value.as_bytes(), &answer.data()[4..6]);
            }
            (Ok(reply), 0x60) => {
                assert_eq!(reply, SdoReply::Downloaded);
                assert!(matches!(asked, SdoRequest::Download(..)));
            }
            (Err(error), 0x80) => assert_eq!(error, SdoError::Aborted(AbortCode::NO_SUCH_OBJECT)),
            (result, _) => panic!("{answer}: {result:?}"),
        }
    }
}

/// The state in this PDO, which begins with the statusword.
fn state(pdo: &str) -> DriveState {
    let pdo = frame(pdo);
    let statusword = Statusword(u16::from_le_bytes([pdo.data()[0], pdo.data()[1]]));
    statusword.state().unwrap_or_else(|| panic!("{pdo}: no state"))
}

/// By PDO. The EPOS does not set bit 4, "voltage enabled".
#[test]
fn statuswords_of_real_drives_are_read_while_they_are_enabled() {
    let enabled = [
        DriveState::SwitchOnDisabled,
        DriveState::ReadyToSwitchOn,
        DriveState::SwitchedOn,
        DriveState::OperationEnabled,
    ];
    assert_eq!(["182#4007", "182#2107", "182#2307", "182#3707"].map(state), enabled);
    let node_5 = ["185#400600000000", "185#210600000000", "185#330600000000", "185#370600000000"];
    assert_eq!(node_5.map(state), enabled);
    // The iHSV60 when enabled; one of the pair of servo drives, with a fault from the start.
    assert_eq!(state("281#371000"), DriveState::OperationEnabled);
    assert_eq!(state("181#384200"), DriveState::Fault);
    let ours = [Controlword::SHUTDOWN, Controlword::SWITCH_ON, Controlword::ENABLE_OPERATION];
    for (theirs, ours) in ["202#0600", "202#0700", "202#0F00"].iter().zip(ours) {
        assert_eq!(frame(theirs).data(), ours.0.to_le_bytes());
    }
}

#[test]
fn boot_up_and_nmt_frames_of_real_drives_are_read() {
    let node = |id| NodeId::new(id).unwrap();
    for (boot_up, id) in [("703#00", 3), ("702#00", 2), ("701#00", 1)] {
        assert_eq!(parse_heartbeat(&frame(boot_up)), Some((node(id), NmtState::BootUp)));
    }
    assert_eq!(parse_nmt(&frame("000#0102")), Some((NmtCommand::StartRemoteNode, Some(node(2)))));
    assert_eq!(parse_nmt(&frame("000#8200")), Some((NmtCommand::ResetCommunication, None)));
}
