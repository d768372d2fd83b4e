//! The preflight of a real CAN controller, which vcan/guest/run.sh puts into its machine.

use crate::support::link::ip;
use crate::support::programs::{Program, Scratch};
use crate::support::vcan;
use serde_json::Value;
use std::process::Command;
use std::sync::RwLockWriteGuard;

/// Reserves the bus and the controller of the emulated machine; `None` elsewhere, because another controller may
/// have a rig behind it.
fn controller() -> Option<(RwLockWriteGuard<'static, ()>, String)> {
    let alone = vcan::alone_on_it()?;
    let can = std::env::var("NEEDLE_CAN").ok();
    if can.is_none() {
        println!("no controller of the emulated machine: VCAN_GUEST=qemu vcan/run.sh has one");
    }
    Some((alone, can?))
}

/// The preflight's rows about the bus, as verdict and finding.
fn bus(interface: &str) -> Vec<(String, String)> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    command.args([
        "check",
        "bench-config/rig-epos4.toml",
        "--connect",
        "--listen",
        "0.1",
        "--json",
    ]);
    let interface = format!("can.interface={interface}");
    for set in [&*interface, "can.sdo_attempts=1", "can.sdo_timeout_ms=50"] {
        command.args(["--set", set]);
    }
    let checks = Program::start(&mut command).end().json()["checks"].clone();
    let text = |check: &Value, key: &str| check[key].as_str().unwrap_or_default().to_owned();
    let checks = checks.as_array().expect("a list").iter();
    let of_bus = checks.filter(|check| text(check, "name").starts_with("bus"));
    of_bus.map(|check| (text(check, "verdict"), text(check, "found"))).collect()
}

/// Bit rate, restart-ms, error counters and state come from the kernel, by netlink.
#[test]
fn a_controller_is_judged_by_what_the_kernel_reports() {
    let Some((_alone, can)) = controller() else { return };
    let set = |what: &str| {
        ip(&format!("link set {can} down"));
        ip(&format!("link set {can} type can {what}"));
        ip(&format!("link set {can} up"));
    };
    let row = |verdict: &str, found: &str| (verdict.to_owned(), found.to_owned());
    set("bitrate 125000 restart-ms 100");
    assert_eq!(
        bus(&can),
        [
            row("PASS", &format!("{can} up, error active")),
            row("PASS", "125 kbit/s, 48% load by SYNC"),
            row("FAIL", "100 ms"),
            row("PASS", "0 sending, 0 receiving"),
        ]
    );
    set("bitrate 100000 restart-ms 0");
    let rows = bus(&can);
    assert_eq!(rows[1..3], [row("WARN", "100 kbit/s, 60% load by SYNC"), row("PASS", "0 ms")]);
    set("bitrate 1000000 restart-ms 0");
    let rows = bus(&can);
    assert!(rows.iter().all(|(verdict, _)| verdict == "PASS"), "{rows:?}");
    assert_eq!(rows[1].1, "1000 kbit/s, 6% load by SYNC");
    ip(&format!("link set {can} down"));
    assert_eq!(bus(&can)[0], row("FAIL", &format!("{can} down, stopped")));
}

#[test]
fn hardware_false_is_refused_on_a_controller_named_vcan9() {
    let Some((_alone, can)) = controller() else { return };
    ip(&format!("link set {can} down"));
    ip(&format!("link set {can} type can bitrate 1000000"));
    ip(&format!("link set {can} name vcan9"));
    ip("link set vcan9 up");
    let scratch = Scratch::new("named");
    let bench = scratch.bench(&[], &["can.interface=\"vcan9\""]).end();
    ip("link set vcan9 down");
    ip(&format!("link set vcan9 name {can}"));
    bench.assert_status(2);
    let refused = "stage.hardware = false, but vcan9 has a device behind it: ";
    assert!(bench.stderr.contains(refused), "{}", bench.stderr);
    assert!(!scratch.path("runs").exists());
}
