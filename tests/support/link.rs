//! Configures network interfaces.

use std::process::Command;

/// Runs `ip` as root, or with a sudo that needs no password, as `vcan/run.sh` does.
pub(crate) fn ip(arguments: &str) {
    let script = format!("[ $(id -u) = 0 ] && exec ip {arguments}; exec sudo -n ip {arguments}");
    let status = Command::new("sh").args(["-c", &script]).status().unwrap();
    assert!(status.success(), "ip {arguments}: {status}");
}
