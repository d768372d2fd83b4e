//! Tests on vcan0 and vcan1.

use super::needed;
use super::programs::alone;
use std::sync::RwLockWriteGuard;

/// The bus for one test where `NEEDLE_VCAN=1` says that there is one, as `vcan/run.sh` does: a missing
/// interface is then a failure.
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
