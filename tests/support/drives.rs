//! The state of the drives, as `needle-bench check` reads it.

use super::programs::Program;
use std::process::Command;

/// Statusword and position of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Drive {
    pub(crate) statusword: u64,
    pub(crate) position_counts: i64,
}

impl Drive {
    /// CiA 402 state Operation Enabled.
    pub(crate) fn is_enabled(&self) -> bool {
        self.statusword & 0x6F == 0x27
    }
}

/// Both drives, insertion first, as `needle-bench check --connect --json` reads them by SDO, with
/// `settings` over bench-config/vcan.toml.
pub(crate) fn drives(settings: &[&str]) -> [Drive; 2] {
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    command.args(["check", "bench-config/vcan.toml", "--connect", "--listen", "0.1", "--json"]);
    for setting in ["can.sdo_attempts=10"].iter().chain(settings) {
        command.args(["--set", setting]);
    }
    let checked = Program::start(&mut command).end();
    let drives = checked.json()["drives"].clone();
    [0, 1].map(|n| Drive {
        statusword: drives[n]["statusword"].as_u64().unwrap_or_else(|| panic!("{drives}")),
        position_counts: drives[n]["position_counts"].as_i64().unwrap(),
    })
}

/// Asserts that both drives stand and take no targets: reads them twice.
#[track_caller]
pub(crate) fn assert_the_drives_stand(settings: &[&str]) -> [Drive; 2] {
    let (first, second) = (drives(settings), drives(settings));
    assert_eq!(first, second, "a drive moves");
    assert!(!first.iter().any(Drive::is_enabled), "{first:x?}");
    first
}
