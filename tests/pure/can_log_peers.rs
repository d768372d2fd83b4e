//! Wireshark's CANopen dissector reads `can.log` and names every frame as CiA 301 does.

use crate::support::needed::skip;
use crate::support::program::{Scratch, needle_bench, repository};
use std::process::Command;

/// How tshark's summary of a frame of the predefined connection set begins.
fn expected(frame: &str) -> &'static str {
    let (id, data) = frame.split_once('#').expect("id#data");
    let id = u16::from_str_radix(id, 16).expect("a base identifier");
    match (id & 0x780, id, data) {
        (_, 0x000, data) if data.starts_with("01") => "NMT: Start remote node",
        (_, 0x000, data) if data.starts_with("80") => "NMT: Enter pre-operational state",
        (_, 0x080, "") => "SYNC",
        (0x080, ..) => "EMCY",
        (0x180, ..) => "PDO1 (tx)",
        (0x200, ..) => "PDO1 (rx)",
        (0x580, _, data) if data.starts_with("60") => {
            "Default-SDO (tx): Initiate download response"
        }
        (0x580, _, data) if data.starts_with("80") => "Default-SDO (tx): Abort transfer",
        (0x580, ..) => "Default-SDO (tx): Initiate upload response",
        (0x600, _, data) if data.starts_with("40") => "Default-SDO (rx): Initiate upload request",
        (0x600, ..) => "Default-SDO (rx): Initiate download request",
        (0x700, _, "00") => "NMT Error Control: Boot-up",
        (0x700, _, "04") => "NMT Error Control: Stopped",
        (0x700, _, "05") => "NMT Error Control: Operational",
        (0x700, _, "7F") => "NMT Error Control: Pre-operational",
        _ => panic!("a run sends no such frame: {frame}"),
    }
}

#[test]
fn wiresharks_dissector_names_every_frame() {
    let scratch = Scratch::new();
    let config = repository("bench-config/virtual.toml");
    let run = needle_bench(
        &scratch,
        &[
            "run",
            &config,
            "--set",
            "insertion={ depth_mm = 3, plane_out_of_reach = \"insert\" }",
            "--json",
        ],
    );
    assert_eq!(run.status, 0, "{}", run.stderr);
    let run_dir = scratch.path().join(run.json()["run_dir"].as_str().expect("a folder"));
    let log = std::fs::read_to_string(run_dir.join("can.log")).expect("the log");
    // Wireshark 4.0 knows candump -L, but not the direction that -x adds.
    let lines: Vec<&str> = log.lines().filter_map(|line| line.get(..line.len() - 2)).collect();
    let plain = scratch.write("plain.log", &(lines.join("\n") + "\n"));

    let mut tshark = Command::new("tshark");
    tshark.arg("-r").arg(plain).args(["-d", "can.subdissector,canopen"]);
    tshark.args(["-T", "fields", "-e", "can.id", "-e", "_ws.col.Info"]);
    let output = match tshark.output() {
        Ok(output) => output,
        Err(error) => {
            return skip(&format!("tshark: {error}"), "install it (Debian package tshark)");
        }
    };
    let text = String::from_utf8(output.stdout).expect("UTF-8");
    assert_eq!(text.lines().count(), lines.len());
    for (line, dissected) in lines.iter().zip(text.lines()) {
        let frame = line.split(' ').nth(2).expect("a frame");
        let (_, info) = dissected.split_once('\t').expect("two fields");
        assert!(info.starts_with(expected(frame)), "{frame}: {info}");
        assert!(!info.contains("Malformed"), "{frame}: {info}");
    }
    println!("{} frames", lines.len());
}
