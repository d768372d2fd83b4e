//! The electronic data sheets of the virtual stage's drives, as `vcan-stage --write-eds` writes them.

use crate::support::needed::python;
use crate::support::program::{Scratch, repository};
use std::path::PathBuf;
use std::process::Command;

const SHEETS: [&str; 2] = ["insertion.eds", "rotation.eds"];

/// Writes the two sheets of a stage with these settings into a new folder.
fn written(scratch: &Scratch, settings: &[&str]) -> PathBuf {
    let dir = scratch.path().join("sheets");
    let mut command = Command::new(env!("CARGO_BIN_EXE_vcan-stage"));
    for setting in settings {
        command.args(["--set", setting]);
    }
    let status = command.arg("--write-eds").arg(&dir).status();
    assert!(status.expect("it starts").success());
    dir
}

#[test]
fn the_object_lists_of_a_sheet_name_every_object_in_it() {
    let makes = [(&[] as &[&str], 63), (&["emulator.drives=\"epos4\""], 56)];
    for (settings, objects) in makes {
        let scratch = Scratch::new();
        let dir = written(&scratch, settings);
        for name in SHEETS {
            let sheet = std::fs::read_to_string(dir.join(name)).expect("written");
            assert!(sheet.contains(&format!("FileName={name}\n")));
            let listed = sheet.lines().filter_map(|line| line.split_once("=0x"));
            let mut listed: Vec<_> = listed
                .filter(|(key, _)| key.parse::<u16>().is_ok())
                .map(|(_, index)| index.to_owned())
                .collect();
            listed.sort();
            let sections =
                sheet.lines().filter_map(|line| line.strip_prefix('[')?.strip_suffix(']'));
            let is_object = |name: &&str| name.len() == 4 && u16::from_str_radix(name, 16).is_ok();
            assert!(listed.iter().eq(sections.filter(is_object)), "{name}: {listed:?}");
            assert_eq!(listed.len(), objects, "{name}");
        }
    }
}

#[test]
fn python_canopen_loads_the_sheets() {
    let Some(python) = python() else { return };
    let scratch = Scratch::new();
    let dir = written(&scratch, &["can.interface=\"vcan0\"", "emulator.drives=\"generic\""]);
    let mut command = Command::new(python);
    let paths = SHEETS.map(|name| dir.join(name));
    command.arg(repository("tests/peers/eds_load.py")).args(&paths);
    let output = command.output().expect("it starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let sheets: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for (sheet, path) in sheets.as_array().expect("two").iter().zip(&paths) {
        let text = std::fs::read_to_string(path).expect("there");
        assert_eq!(sheet["values"], text.matches("DefaultValue=").count(), "{sheet}");
        assert_eq!((&sheet["receive_pdos"], &sheet["transmit_pdos"]), (&4.into(), &4.into()));
        assert_eq!(sheet["product_code"], 0x402);
        // The peer loads the sheets as node 5.
        assert_eq!((&sheet["sdo_request"], &sheet["emergency"]), (&0x605.into(), &0x85.into()));
        assert_eq!(sheet["rpdo1"], 0x205);
        let controlword = &sheet["controlword"];
        assert_eq!((&controlword["index"], &controlword["bits"]), (&0x6040.into(), &16.into()));
        assert_eq!(
            (&controlword["mappable"], &controlword["writable"]),
            (&true.into(), &true.into())
        );
        assert_eq!(sheet["statusword_writable"], false);
        assert_eq!(sheet["software_limit_min"], i32::MIN);
        assert_eq!(sheet["modes"], 0xa0);
    }
}
