//! `manifest.json`: what was run, with what, and how it ended.

use super::{RunInfo, TelemetryError, utc};
use crate::session::Outcome;
use serde::Serialize;
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::Path;

/// Who a drive says it is (CiA 301 object 1018h), with the name the bench uses.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DriveIdentity {
    /// Axis: `insertion` or `rotation`.
    pub axis: String,
    /// Node number.
    pub node: u8,
    /// Vendor (1018h:01).
    pub vendor_id: u32,
    /// Product code (1018h:02).
    pub product_code: u32,
    /// Revision (1018h:03), where the drive has it.
    pub revision: Option<u32>,
    /// Serial number (1018h:04), where the drive has it.
    pub serial: Option<u32>,
}

/// How many records reached the text files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Counts {
    /// Lines of `can.log`.
    pub can_frames: u64,
    /// Lines of `tracker.ndjson`.
    pub tracker_samples: u64,
    /// Rows of `steps.csv`.
    pub steps: u64,
}

/// How many records did not reach a writer because its queue was full or the writer dead.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Dropped {
    /// Not in the text files.
    pub text_files: u64,
    /// Not in `run.rrd`.
    pub recording: u64,
}

/// The manifest. Its outcome is null while the run goes on, and stays so after a kill.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Manifest {
    /// Layout of this file; raised when a key changes its meaning.
    pub format: u32,
    /// Name of the run.
    pub name: String,
    /// Version of the bench.
    pub version: String,
    /// Git state of the bench.
    pub git: Option<String>,
    /// SHA-256 of `config.toml`, hex.
    pub config_sha256: String,
    /// CAN interface.
    pub bus: String,
    /// The drives found on it.
    pub drives: Vec<DriveIdentity>,
    /// Tracker source.
    pub tracker: String,
    /// Seed of the emulator.
    pub seed: Option<u64>,
    /// Origin of the run's time line, RFC 3339.
    pub started_utc: String,
    /// When the record was closed, RFC 3339.
    pub ended_utc: Option<String>,
    /// Length of the run on its own time line, s; in virtual time not what a clock on the wall says.
    pub duration_s: Option<f64>,
    /// `completed` or `stopped`.
    pub outcome: Option<&'static str>,
    /// Why the run was stopped.
    pub stop_reason: Option<String>,
    /// What the text files hold.
    pub counts: Option<Counts>,
    /// What they and the recording do not hold.
    pub dropped: Option<Dropped>,
    /// Writers that failed, with their reasons.
    pub faults: Vec<String>,
    /// Tracker samples accepted, and refused by each gate.
    pub gates: Map<String, Value>,
    /// Timing figures of the runtime, units in the keys.
    pub timing: Map<String, Value>,
}

impl Manifest {
    pub(super) fn new(info: &RunInfo, started_unix_us: i64) -> Self {
        Manifest {
            format: 1,
            name: info.name.clone(),
            version: info.version.clone(),
            git: info.git.clone(),
            config_sha256: sha256_hex(info.config_toml.as_bytes()),
            bus: info.bus.clone(),
            drives: Vec::new(),
            tracker: info.tracker.clone(),
            seed: info.seed,
            started_utc: utc::rfc3339(started_unix_us),
            ended_utc: None,
            duration_s: None,
            outcome: None,
            stop_reason: None,
            counts: None,
            dropped: None,
            faults: Vec::new(),
            gates: Map::new(),
            timing: Map::new(),
        }
    }

    pub(super) fn set_outcome(&mut self, outcome: &Outcome) {
        self.outcome = Some(match outcome {
            Outcome::Completed => "completed",
            Outcome::Stopped(_) => "stopped",
        });
        self.stop_reason = outcome.stop_reason().map(str::to_owned);
    }

    /// Writes the manifest as `path`, whole or not at all: a reader, or a run killed in the
    /// middle of it, sees the old one or the new one.
    pub(super) fn write(&self, path: &Path) -> Result<(), TelemetryError> {
        let new = path.with_extension("json.new");
        let write = || -> io::Result<()> {
            let mut file = File::create(&new)?;
            serde_json::to_writer_pretty(&file, self)?;
            file.write_all(b"\n")?;
            file.sync_all()?;
            fs::rename(&new, path)
        };
        write().map_err(|source| {
            let _ = fs::remove_file(&new);
            TelemetryError::File { path: path.to_path_buf(), source }
        })
    }
}

/// The SHA-256 of `bytes`, in hex.
pub fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |mut hex, byte| {
        let _ = write!(hex, "{byte:02x}");
        hex
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::folder::tests::Scratch;
    use crate::telemetry::tests::run_info;

    #[test]
    fn sha256_of_the_standard_vector() {
        assert_eq!(
            sha256_hex(b"abc"),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
    }

    /// Do not edit: scripts read these keys.
    #[test]
    fn manifest_is_frozen() {
        let mut manifest = Manifest::new(&run_info(), 1_700_000_000_000_000);
        manifest.drives.push(DriveIdentity {
            axis: "insertion".to_owned(),
            node: 1,
            vendor_id: 0xFB,
            product_code: 0x6150_0000,
            revision: None,
            serial: Some(42),
        });
        manifest.set_outcome(&Outcome::Stopped("tracker lost at 31.2 mm".to_owned()));
        manifest.gates.insert("accepted".to_owned(), 208.into());
        manifest.timing.insert("sync_jitter_us_p99".to_owned(), 12.5.into());
        let scratch = Scratch::new("manifest");
        let path = scratch.0.join("manifest.json");
        std::fs::write(&path, "the manifest of the start").unwrap();
        manifest.write(&path).unwrap();
        insta::assert_snapshot!(std::fs::read_to_string(&path).unwrap(), @r#"
        {
          "format": 1,
          "name": "virtual",
          "version": "0.1.0",
          "git": "abc1234",
          "config_sha256": "ada9dd2c2d992c626e293d64a7a30fde75cb556e00facc0c87196b05812d601a",
          "bus": "memory",
          "drives": [
            {
              "axis": "insertion",
              "node": 1,
              "vendor_id": 251,
              "product_code": 1632632832,
              "revision": null,
              "serial": 42
            }
          ],
          "tracker": "emulated",
          "seed": 7,
          "started_utc": "2023-11-14T22:13:20.000000Z",
          "ended_utc": null,
          "duration_s": null,
          "outcome": "stopped",
          "stop_reason": "tracker lost at 31.2 mm",
          "counts": null,
          "dropped": null,
          "faults": [],
          "gates": {
            "accepted": 208
          },
          "timing": {
            "sync_jitter_us_p99": 12.5
          }
        }
        "#);
        assert_eq!(std::fs::read_dir(&scratch.0).unwrap().count(), 1);
    }
}
