//! The commands of the worked protocol of docs/rig.md that open the bus, over vcan0 with `hardware = true`.
//! tests/live/protocol.rs follows the whole protocol over UDP.

use crate::support::protocol::{Change, follow};
use crate::support::vcan;
use std::collections::HashSet;

/// The changes of the operator's file on this bus, with their reasons, as in docs/rig.md.
const CHANGES: [Change; 2] = [
    // An EPOS4 reads 0x6085 in rpm/s, an emulated drive in counts/s²: these are 71.7 mm/s² and 316°/s².
    ("value = 10_000  ", "value = 333_000 "),
    ("value = 10_000\n", "value = 66_500\n"),
];

fn opens_the_bus(line: &str) -> bool {
    let starts = ["run ", "stage ", "stop "];
    line.contains("--connect") || starts.iter().any(|start| line.starts_with(start))
}

/// The words of a command before its first file, flag or setting, such as "stage jog".
fn kind(line: &str) -> String {
    let words = line.split_whitespace().take_while(|word| !word.contains(['.', '-']));
    words.collect::<Vec<_>>().join(" ")
}

/// The first command of each kind.
#[test]
fn the_worked_protocol_succeeds_on_the_bus() {
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
