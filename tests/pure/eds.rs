//! The electronic data sheets of the virtual stage's drives, as `vcan-stage --write-eds` writes them.

use crate::support::needed::python;
use std::path::{Path, PathBuf};
use std::process::Command;

const SHEETS: [&str; 2] = ["insertion.eds", "rotation.eds"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The two sheets of a stage with these settings, in a folder of their own, which is not there before.
fn written(settings: &[&str]) -> PathBuf {
    let number = std::process::id() as usize + settings.len();
    let dir = std::env::temp_dir().join(format!("needle-bench-eds-{number}"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_vcan-stage"));
    for setting in settings {
        command.args(["--set", setting]);
    }
    let status = command.current_dir(root()).arg("--write-eds").arg(&dir).status();
    assert!(status.expect("it starts").success());
    dir
}

/// The lists of objects name every index that has a section, and no other.
#[test]
fn the_object_lists_of_a_sheet_name_every_object_in_it() {
    let makes = [(&[] as &[&str], 62), (&["emulator.drives=\"epos4\""], 56)];
    for (settings, objects) in makes {
        let dir = written(settings);
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
        std::fs::remove_dir_all(&dir).expect("removed");
    }
}

#[test]
fn python_canopen_loads_the_sheets() {
    let Some(python) = python() else { return };
    let dir = written(&["can.interface=\"vcan0\"", "emulator.drives=\"generic\""]);
    let mut command = Command::new(python);
    let paths = SHEETS.map(|name| dir.join(name));
    command.arg(root().join("tests/peers/eds_load.py")).args(&paths);
    let output = command.output().expect("it starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let sheets: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for (sheet, path) in sheets.as_array().expect("two").iter().zip(&paths) {
        let text = std::fs::read_to_string(path).expect("there");
        assert_eq!(sheet["values"], text.matches("DefaultValue=").count(), "{sheet}");
        assert_eq!((&sheet["receive_pdos"], &sheet["transmit_pdos"]), (&4.into(), &4.into()));
        assert_eq!(sheet["product_code"], 0x402);
        // Of node 5.
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
    std::fs::remove_dir_all(&dir).expect("removed");
}
