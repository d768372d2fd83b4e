//! CAN frames in words.

use super::drives::Drives;
use super::service::Service;
use crate::canopen::cia402::{Controlword, DriveState, Mode, Statusword, object};
use crate::canopen::emcy::parse_emcy;
use crate::canopen::nmt::NmtState;
use crate::canopen::sdo::AbortCode;
use crate::canopen::{Frame, ObjectAddress};

/// A frame in words, and how loud they are.
pub(super) fn describe(service: Service, frame: &Frame, drives: &Drives) -> (&'static str, String) {
    let data = frame.data();
    match service {
        Service::Nmt => ("INFO", nmt(data)),
        Service::Sync => ("TRACE", "SYNC".to_owned()),
        Service::Time => ("TRACE", "TIME".to_owned()),
        Service::Emergency(node) => emergency(node, frame),
        Service::Tpdo(1, node) => ("TRACE", feedback(node, data, drives)),
        Service::Rpdo(1, node) => ("TRACE", set_point(node, data, drives)),
        Service::Tpdo(n, node) => ("TRACE", format!("TPDO{n} node {node}")),
        Service::Rpdo(n, node) => ("TRACE", format!("RPDO{n} node {node}")),
        Service::SdoAnswer(node) => (sdo_level(data), sdo(node, data, false)),
        Service::SdoRequest(node) => (sdo_level(data), sdo(node, data, true)),
        Service::Heartbeat(node) => ("INFO", heartbeat(node, data)),
        Service::Other => ("WARN", "not of the pre-defined set".to_owned()),
    }
}

/// NMT commands (CiA 301, 7.2.8.3.1).
fn nmt(data: &[u8]) -> String {
    let &[command, node, ..] = data else { return "NMT, too short".to_owned() };
    let command = match command {
        0x01 => "start".to_owned(),
        0x02 => "stop".to_owned(),
        0x80 => "enter pre-operational".to_owned(),
        0x81 => "reset node".to_owned(),
        0x82 => "reset communication".to_owned(),
        unknown => format!("command {unknown:#04x}"),
    };
    if node == 0 { format!("NMT {command}, all") } else { format!("NMT {command}, node {node}") }
}

/// NMT states in heartbeats (CiA 301, 7.2.8.3.2.2).
fn heartbeat(node: u8, data: &[u8]) -> String {
    match data.first() {
        Some(&byte) => format!("heartbeat node {node}: {}", NmtState::from_byte(byte)),
        None => format!("heartbeat node {node}: without a state"),
    }
}

/// Emergencies (CiA 301, 7.2.7): error code 0 says that the error is gone.
fn emergency(node: u8, frame: &Frame) -> (&'static str, String) {
    match parse_emcy(frame) {
        Some((_, emcy)) if emcy.code.0 == 0 => ("INFO", format!("EMCY node {node}: {emcy}")),
        Some((_, emcy)) => ("ERROR", format!("EMCY node {node}: {emcy}")),
        None => ("ERROR", format!("EMCY node {node}, too short")),
    }
}

/// RPDO1, as the stage maps it: controlword and target position.
fn set_point(node: u8, data: &[u8], drives: &Drives) -> String {
    let &[c0, c1, p0, p1, p2, p3] = data else { return format!("RPDO1 node {node}") };
    let command = controlword(Controlword(u16::from_le_bytes([c0, c1])));
    let target = drives.position(node, i32::from_le_bytes([p0, p1, p2, p3]));
    format!("RPDO1 node {node}: controlword {command}, target {target}")
}

/// TPDO1, as the stage maps it: statusword and actual position.
fn feedback(node: u8, data: &[u8], drives: &Drives) -> String {
    let &[s0, s1, p0, p1, p2, p3] = data else { return format!("TPDO1 node {node}") };
    let status = statusword(Statusword(u16::from_le_bytes([s0, s1])));
    let position = drives.position(node, i32::from_le_bytes([p0, p1, p2, p3]));
    format!("TPDO1 node {node}: statusword {status}, position {position}")
}

fn controlword(word: Controlword) -> String {
    let command = match Controlword(word.0 & 0x008f) {
        Controlword::ENABLE_OPERATION => "enable operation",
        Controlword::SWITCH_ON => "switch on",
        Controlword::SHUTDOWN => "shutdown",
        reset if reset.has(Controlword::FAULT_RESET_BIT) => "fault reset",
        no_power if !no_power.has(Controlword::ENABLE_VOLTAGE_BIT) => "disable voltage",
        no_stop if !no_stop.has(Controlword::NO_QUICK_STOP_BIT) => "quick stop",
        _ => "no command",
    };
    let bits = [(Controlword::HOMING_START_BIT, "bit 4"), (Controlword::HALT_BIT, "halt")];
    let set = bits.iter().filter(|(bit, _)| word.has(*bit)).map(|(_, name)| format!(", {name}"));
    format!("0x{:04X} {command}{}", word.0, set.collect::<String>())
}

fn statusword(word: Statusword) -> String {
    let bits = [
        (word.warning(), "warning"),
        (word.internal_limit(), "internal limit"),
        (word.following_error(), "bit 13"),
        (word.state() == Some(DriveState::OperationEnabled) && !word.remote(), "not remote"),
    ];
    let set = bits.iter().filter(|(set, _)| *set).map(|(_, name)| format!(", {name}"));
    format!("{word}{}", set.collect::<String>())
}

/// SDO transfers (CiA 301, 7.2.4.3): object by name, what is done with it, and its value where
/// the transfer is expedited.
fn sdo(node: u8, data: &[u8], request: bool) -> String {
    let &[command, low, high, sub, d0, d1, d2, d3] = data else {
        return format!("SDO node {node}, too short");
    };
    let address = ObjectAddress::new(u16::from_le_bytes([low, high]), sub);
    let name = address.name().map(|name| format!(" {name}")).unwrap_or_default();
    let bytes = [d0, d1, d2, d3];
    let value = || match command & 0x03 {
        0x03 => format!(" = {}", value(address, bytes, 4 - (command >> 2 & 0x03))),
        0x02 => format!(" = {}", value(address, bytes, 4)),
        _ => ", in segments".to_owned(),
    };
    let what = match (command >> 5, request) {
        (1, true) => format!("write {address}{name}{}", value()),
        (3, false) => format!("written {address}{name}"),
        (2, true) => format!("read {address}{name}"),
        (2, false) => format!("{address}{name}{}", value()),
        (4, _) => {
            let code = AbortCode::from_u32(u32::from_le_bytes(bytes));
            format!("abort {address}{name}: {code}")
        }
        (0, _) | (1, false) | (3, true) => "segment".to_owned(),
        _ => format!("command {command:02X}h"),
    };
    format!("SDO node {node}: {what}")
}

/// The first `size` of these bytes as the number they are in `address`, with what it means where
/// that is known.
fn value(address: ObjectAddress, [a, b, c, d]: [u8; 4], size: u8) -> String {
    match (address, size) {
        (object::CONTROLWORD, 2) => controlword(Controlword(u16::from_le_bytes([a, b]))),
        (object::STATUSWORD, 2) => statusword(Statusword(u16::from_le_bytes([a, b]))),
        (object::MODES_OF_OPERATION | object::MODES_OF_OPERATION_DISPLAY, 1) => {
            Mode::from_i8(a as i8).to_string()
        }
        (_, 1) => format!("{a} (0x{a:02X})"),
        (_, 2) => {
            let number = u16::from_le_bytes([a, b]);
            format!("{number} (0x{number:04X})")
        }
        (_, 3) => format!("bytes {:02X?}", [a, b, c]),
        _ => {
            let number = u32::from_le_bytes([a, b, c, d]);
            format!("{} (0x{number:08X})", number as i32)
        }
    }
}

fn sdo_level(data: &[u8]) -> &'static str {
    if data.first() == Some(&0x80) { "WARN" } else { "DEBUG" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::CanId;
    use crate::telemetry::tests::run_info;

    fn words(cob_id: u16, data: &[u8]) -> String {
        let frame = Frame::new(cob_id, data);
        let drives = Drives::new(&run_info().scene.stage);
        let (level, text) = describe(Service::of(&frame), &frame, &drives);
        format!("{level} {text}")
    }

    #[test]
    fn frames_in_words() {
        assert_eq!(words(0x000, &[0x01, 0]), "INFO NMT start, all");
        assert_eq!(words(0x000, &[0x80, 2]), "INFO NMT enter pre-operational, node 2");
        assert_eq!(words(0x080, &[]), "TRACE SYNC");
        assert_eq!(words(0x481, &[]), "TRACE TPDO4 node 1");
        assert_eq!(words(0x501, &[]), "TRACE RPDO4 node 1");
        assert_eq!(
            words(0x082, &[0x11, 0x86, 0x20, 0, 0, 0, 0, 0]),
            "ERROR EMCY node 2: 0x8611 following error (register 0x20)"
        );
        assert_eq!(words(0x701, &[0x7F]), "INFO heartbeat node 1: pre-operational");
        assert_eq!(words(0x7E5, &[0]), "WARN not of the pre-defined set");
    }

    #[test]
    fn process_data_by_their_bits() {
        assert_eq!(
            words(0x201, &[0x0F, 0, 0xE8, 3, 0, 0]),
            "TRACE RPDO1 node 1: controlword 0x000F enable operation, target 1000 counts"
        );
        assert_eq!(
            words(0x181, &[0x37, 0x16, 0xFF, 0xFF, 0xFF, 0xFF]),
            "TRACE TPDO1 node 1: statusword 0x1637 operation enabled, position -1 counts"
        );
        assert!(words(0x201, &[2, 0, 0, 0, 0, 0]).contains("0x0002 quick stop"));
        assert!(words(0x201, &[0, 0, 0, 0, 0, 0]).contains("0x0000 disable voltage"));
        assert!(words(0x201, &[0x80, 0, 0, 0, 0, 0]).contains("0x0080 fault reset"));
    }

    #[test]
    fn service_data_by_object_and_value() {
        assert_eq!(
            words(0x601, &[0x2F, 0x60, 0x60, 0, 8, 0, 0, 0]),
            "DEBUG SDO node 1: write 0x6060:00 modes of operation = cyclic synchronous position"
        );
        assert_eq!(
            words(0x581, &[0x43, 0x18, 0x10, 1, 0xFB, 0, 0, 0]),
            "DEBUG SDO node 1: 0x1018:01 identity object = 251 (0x000000FB)"
        );
        assert_eq!(
            words(0x581, &[0x4B, 0x41, 0x60, 0, 0x40, 2, 0, 0]),
            "DEBUG SDO node 1: 0x6041:00 statusword = 0x0240 switch on disabled"
        );
        let abort = words(0x581, &[0x80, 0x18, 0x10, 1, 0, 0, 2, 6]);
        assert!(abort.starts_with("WARN SDO node 1: abort 0x1018:01 identity object: 0x06020000"));
        assert_eq!(
            words(0x601, &[0x40, 0, 0x20, 0, 0, 0, 0, 0]),
            "DEBUG SDO node 1: read 0x2000:00"
        );
    }

    #[test]
    fn short_and_foreign_frames_have_words_too() {
        for cob_id in 0..=0x7FF {
            for len in 0..=8 {
                assert!(!words(cob_id, &vec![0xA5; len]).is_empty());
            }
        }
        let extended = Frame::from_parts(CanId::Extended(0x1234), true, &[]).unwrap();
        assert_eq!(Service::of(&extended), Service::Other);
    }
}
