//! Whether tests on vcan0 and vcan1 are asked to run.

use std::io::Write;
use std::sync::Once;

/// True when `NEEDLE_VCAN=1` asks for the tests on vcan, as `vcan/run.sh` does: then a missing
/// interface is a failure. `NEEDLE_VCAN=0` says that they run elsewhere. Otherwise it is said once,
/// past the harness's capture, that they are skipped and how to run them.
pub(crate) fn asked_for() -> bool {
    static SAY: Once = Once::new();
    match std::env::var("NEEDLE_VCAN").as_deref() {
        Ok("1") => return true,
        Ok("0") => return false,
        _ => {}
    }
    SAY.call_once(|| {
        let _ = writeln!(
            std::io::stderr(),
            "\n{name}: SKIPPED, its tests need vcan0 and vcan1 and NEEDLE_VCAN is not 1; run them \
             with\n  CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER=$PWD/vcan/run.sh \
             cargo test --test {name}",
            name = env!("CARGO_CRATE_NAME"),
        );
    });
    false
}
