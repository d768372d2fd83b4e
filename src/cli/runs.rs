//! Earlier runs, in the folders that record.dir holds.

use crate::archive::{Manifest, file, proof};
use crate::config::{CanInterface, Config};
use crate::preflight::Earlier;
use crate::review::{differences, keys};
use crate::telemetry::RunFolder;
use std::path::{Path, PathBuf};

/// The default of `record.dir`.
pub(super) const RUNS: &str = "runs";

/// The runs in `dir`, the newest first.
pub(super) fn newest_first(dir: &Path) -> impl Iterator<Item = RunFolder> + use<> {
    let entries = dir.read_dir().into_iter().flatten();
    let mut folders: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    // A folder's name starts with its time.
    folders.sort();
    folders.into_iter().rev().filter_map(|folder| RunFolder::open(&folder).ok())
}

/// The configuration of the newest run in `dir` that was on a bus (not on the emulated stage in memory).
pub(super) fn last_run_on_a_bus(dir: &Path) -> Option<PathBuf> {
    let memory = CanInterface::Memory.to_string();
    let on_a_bus = newest_first(dir).filter(|run| run.manifest().bus != memory);
    on_a_bus.map(|run| run.dir().join(file::CONFIG)).find(|config| config.is_file())
}

/// The newest run on the bus of `config` that `is_wanted`, and the keys changed since then that
/// `counts` takes into account.
pub(super) fn earlier(
    config: &Config,
    is_wanted: impl Fn(&Manifest) -> bool,
    counts: impl Fn(&str) -> bool,
) -> Option<Earlier> {
    let bus = config.bus().to_string();
    let mut runs = newest_first(Path::new(&config.record.dir));
    let run = runs.find(|run| run.manifest().bus == bus && is_wanted(run.manifest()))?;
    let before = keys(&run.text(file::CONFIG).ok()?).ok()?;
    let now = keys(&config.to_toml().ok()?).ok()?;
    let changed = differences(&before, &now).into_keys();
    Some(Earlier {
        started_utc: run.manifest().started_utc.clone(),
        proof: run.text(file::EVENTS).ok().and_then(|events| proof(&events)),
        changed: changed.filter(|key| counts(key)).collect(),
    })
}
