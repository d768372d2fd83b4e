//! Interfaces, brought down and up.

use std::process::Command;

/// `ip` as root, or with a sudo that asks nothing, which is how the interfaces came to be.
pub(crate) fn ip(arguments: &str) {
    let script = format!("[ $(id -u) = 0 ] && exec ip {arguments}; exec sudo -n ip {arguments}");
    let status = Command::new("sh").args(["-c", &script]).status().unwrap();
    assert!(status.success(), "ip {arguments}: {status}");
}
