//! The worked protocol of docs/rig.md over vcan0, with `hardware = true`: what the bus matters for. All of it is
//! followed over UDP, see tests/live/protocol.rs.

use crate::support::protocol::{Change, follow};
use crate::support::vcan;
use std::collections::HashSet;

/// What differs on this bus, and why; docs/rig.md says so too.
const CHANGES: [Change; 2] = [
    // An EPOS4 takes 0x6085 in rpm/s, an emulated drive in counts/s²: these are 21.5 mm/s² and 475°/s².
    ("value = 10_000  ", "value = 100_000  "),
    ("value = 10_000\n", "value = 100_000\n"),
];

/// Whether a command of the page is about the bus.
fn opens_the_bus(line: &str) -> bool {
    let starts = ["run ", "stage ", "stop "];
    line.contains("--connect") || starts.iter().any(|start| line.starts_with(start))
}

/// Its words before the first file, flag or setting, such as "stage jog".
fn kind(line: &str) -> String {
    let words = line.split_whitespace().take_while(|word| !word.contains(['.', '-']));
    words.collect::<Vec<_>>().join(" ")
}

/// One command of each kind that opens the bus: the first.
#[test]
fn the_worked_protocol_on_the_bus() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let mut kinds = HashSet::new();
    let done = follow("vcan0", &CHANGES, |line| opens_the_bus(line) && kinds.insert(kind(line)));
    let done: Vec<String> = done.iter().map(|line| kind(line)).collect();
    assert_eq!(
        done,
        [
            "stage status",
            "stop",
            "stage home",
            "stage jog",
            "stage prove",
            "stage reset",
            "check",
            "run",
            "stage withdraw",
        ]
    );
}
