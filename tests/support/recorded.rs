//! Records the runs under `tests/recorded` again.

use needle_bench::archive::file;
use needle_bench::telemetry::{RunFolder, write_manifest};
use std::path::Path;

/// The environment variable that has the tests record their runs again.
pub(crate) const ANEW: &str = "NEEDLE_RECORD_ANEW";

/// Copies the run in `run_dir` to the recorded run `name` if [`ANEW`] is set. It leaves out `run.rrd`, which no
/// replay reads and which is larger than all other files.
pub(crate) fn keep(run_dir: &Path, name: &str) {
    if std::env::var_os(ANEW).is_none() {
        return;
    }
    let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/recorded").join(name);
    let _ = std::fs::remove_dir_all(&kept);
    std::fs::create_dir_all(&kept).expect("a folder for the recorded run");
    for entry in std::fs::read_dir(run_dir).expect("a run folder") {
        let path = entry.expect("a file").path();
        let name = path.file_name().expect("a name");
        if name != file::RECORDING {
            std::fs::copy(&path, kept.join(name)).expect("copied");
        }
    }
    let mut manifest = RunFolder::open(&kept).expect("a run folder").manifest;
    manifest.files.remove(file::RECORDING);
    write_manifest(&kept, &manifest).expect("written");
}
