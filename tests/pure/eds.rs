//! The electronic data sheets of the virtual stage's drives, `vcan/*.eds`.

use crate::support::needed::python;
use std::path::{Path, PathBuf};
use std::process::Command;

const SHEETS: [&str; 2] = ["insertion.eds", "rotation.eds"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn committed(name: &str) -> PathBuf {
    root().join("vcan").join(name)
}

/// Sheet and drive come from one table; the files are what that table prints.
#[test]
fn the_files_are_what_the_drives_say() {
    let dir = std::env::temp_dir().join(format!("needle-bench-eds-{}", std::process::id()));
    std::fs::create_dir_all(&dir).expect("a folder");
    let mut command = Command::new(env!("CARGO_BIN_EXE_vcan-stage"));
    let status = command.current_dir(root()).arg("--write-eds").arg(&dir).status();
    assert!(status.expect("it starts").success());
    for name in SHEETS {
        let written = std::fs::read_to_string(dir.join(name)).expect("written");
        let kept = std::fs::read_to_string(committed(name)).unwrap_or_default();
        assert!(written == kept, "vcan/{name} is old: vcan-stage --write-eds vcan");
        assert!(!written.contains("=Object 0x"), "vcan/{name}: an object without a name");
    }
    std::fs::remove_dir_all(&dir).expect("removed");
}

#[test]
fn python_canopen_loads_them() {
    let Some(python) = python() else { return };
    let mut command = Command::new(python);
    command.arg(root().join("tests/peers/eds_load.py")).args(SHEETS.map(committed));
    let output = command.output().expect("it starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let sheets: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for (sheet, name) in sheets.as_array().expect("two").iter().zip(SHEETS) {
        let text = std::fs::read_to_string(committed(name)).expect("there");
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
}
