//! Access to vcan0 and vcan1.

use super::needed;
use super::programs::alone;
use std::sync::RwLockWriteGuard;

/// Reserves vcan0 and vcan1 for one test; `None` without `NEEDLE_VCAN=1`, which `vcan/run.sh` sets. With it a
/// missing interface fails the test.
pub(crate) fn alone_on_it() -> Option<RwLockWriteGuard<'static, ()>> {
    if std::env::var("NEEDLE_VCAN").as_deref() == Ok("1") {
        return Some(alone());
    }
    needed::skip(
        "vcan0 and vcan1",
        "CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER=$PWD/vcan/run.sh cargo test --test vcan",
    );
    None
}
