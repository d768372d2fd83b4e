//! Skips tests on a machine that lacks peers, data sets, CAN interfaces or privileges.

use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Fails the test in CI (`CI=true`), where nothing may be missing. Elsewhere this prints that the test is skipped
/// and the remedy; the test harness does not capture it.
#[track_caller]
pub(crate) fn skip(missing: &str, remedy: &str) {
    let test = std::thread::current().name().unwrap_or("a test").to_owned();
    assert!(std::env::var_os("CI").is_none_or(|ci| ci != "true"), "no {missing}; {remedy}");
    let _ = writeln!(std::io::stderr(), "SKIPPED {test}: no {missing}; {remedy}");
}

/// The Python interpreter with tests/peers/requirements.txt.
pub(crate) fn python() -> Option<OsString> {
    let python = std::env::var_os("NEEDLE_PEERS_PYTHON");
    if python.is_none() {
        let remedy = "set NEEDLE_PEERS_PYTHON to a Python with tests/peers/requirements.txt";
        skip("Python peers", remedy);
    }
    python
}

/// A file or folder of the recordings by other labs, which this project has no licence to ship: in
/// `$NEEDLE_DATA`, by default `../shared/data`. `NEEDLE_DATA=none` skips the tests that need them, in CI too.
pub(crate) fn data(path: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("NEEDLE_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    if folder == Path::new("none") {
        let _ = writeln!(std::io::stderr(), "SKIPPED: {path}: NEEDLE_DATA=none");
        return None;
    }
    let found = folder.join(path);
    if !found.exists() {
        skip(&found.display().to_string(), "set NEEDLE_DATA to the folder of data");
        return None;
    }
    Some(found)
}
