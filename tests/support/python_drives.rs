//! Moves third-party drives with the bench, on any bus that both support.

use super::peers::peer;
use super::programs::{Program, Scratch};
use std::process::Command;

/// Jogs both axes of tests/peers/canopen_drives.py. python-can names the bus `interface` and `channel`, the bench
/// names it `bus`.
pub(crate) fn are_moved_by_the_bench(interface: &str, channel: &str, bus: &str) {
    let arguments = ["--interface", interface, "--channel", channel];
    let Some(mut drives) = peer("canopen_drives.py", &arguments) else { return };
    drives.wait_for("ready");
    let scratch = Scratch::new("python-drives");
    let settings = [
        format!("can.interface=\"{bus}\""),
        format!("record.dir=\"{}\"", scratch.path("runs").display()),
        // Python, and perhaps an emulated machine, answer when they are scheduled.
        "can.sync_ms=50".to_owned(),
        "can.sdo_timeout_ms=2000".to_owned(),
        "can.boot_timeout_s=20.0".to_owned(),
        "can.missed_feedback_max=30".to_owned(),
        "can.heartbeat_timeout_ms=2000".to_owned(),
    ];
    let jog = |axis: &str, by: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        command.current_dir(env!("CARGO_MANIFEST_DIR"));
        command.args(["stage", "jog", "--axis", axis, "--by", by]);
        command.args(["--config", "bench-config/vcan.toml"]);
        settings.iter().for_each(|setting| {
            command.args(["--set", setting]);
        });
        let jogged = Program::start(&mut command).end();
        println!("{}{}", jogged.stderr, jogged.stdout);
        jogged.assert_status(0);
    };
    jog("insertion", "2mm");
    jog("rotation", "10deg");
    drives.signal("INT");
    let drives = drives.end();
    println!("{}", drives.stdout);
    let [_, insertion, rotation] = drives.stdout.lines().collect::<Vec<_>>()[..] else {
        panic!("{}\n{}", drives.stdout, drives.stderr)
    };
    // 2 mm at 4646 counts/mm, 10° at 378,830 counts in 5 turns; power is off. Both watched the heartbeat of the
    // bench, node 127, during the motion and not after it.
    assert!(insertion.starts_with("node 1: at 9292 counts, statusword 0x0231, "), "{insertion}");
    assert!(rotation.starts_with("node 2: at 2105 counts, statusword 0x0231, "), "{rotation}");
    assert!(insertion.contains(" mode 8, RPDO1 ['0x60400010', '0x607a0020'], "), "{insertion}");
    let watched = "['0x7f07d0', '0x0', '0x7f07d0', '0x0']";
    assert!(insertion.ends_with(&format!(", watched {watched}")), "{insertion}");
}
