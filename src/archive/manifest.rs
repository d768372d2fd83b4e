//! `manifest.json`: what was run, with what, and how it ended.

use super::file;
use crate::session::Outcome;
use derive_more::Display;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;

/// Format of the manifest that this version of the bench writes and reads.
const FORMAT: u32 = 2;
/// The key of the seal: the SHA-256 of all other keys.
const SEAL: &str = "seal_sha256";

/// The identity that a drive reports (CiA 301 object 1018h), and the axis that it moves.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Lines of `can.log`.
    pub can_frames: u64,
    /// Lines of `tracker.ndjson`.
    pub tracker_samples: u64,
    /// Rows of `steps.csv`.
    pub steps: u64,
    /// Lines of `events.log`.
    #[serde(default)]
    pub events: u64,
}

impl Counts {
    /// The counts of text files; `lines` returns the number of lines of the file with that name.
    pub fn of_lines(lines: impl Fn(&str) -> u64) -> Self {
        Counts {
            can_frames: lines(file::CAN),
            tracker_samples: lines(file::TRACKER),
            // Without the header.
            steps: lines(file::STEPS).saturating_sub(1),
            events: lines(file::EVENTS),
        }
    }
}

/// Numbers of lost records, for whatever reason: a full queue, a full disk, a failed writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Dropped {
    /// Not in the text files.
    pub text_files: u64,
    /// Not in `run.rrd`.
    pub recording: u64,
    /// Not shown by `--live`.
    #[serde(default)]
    pub live: u64,
}

/// How a run ended, without its reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, Serialize, Deserialize)]
#[display(rename_all = "snake_case")]
#[serde(rename_all = "snake_case")]
pub enum RunOutcome {
    /// The run or operation reached its end.
    Completed,
    /// It was stopped before its end.
    Stopped,
}

impl From<&Outcome> for RunOutcome {
    fn from(outcome: &Outcome) -> Self {
        match outcome {
            Outcome::Completed => RunOutcome::Completed,
            Outcome::Stopped(_) => RunOutcome::Stopped,
        }
    }
}

/// Size and hash of a file of the folder when the record was closed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileSeal {
    /// Its size.
    pub bytes: u64,
    /// Its SHA-256, hex.
    pub sha256: String,
}

impl FileSeal {
    /// The seal of a file with this content.
    pub fn of(bytes: &[u8]) -> Self {
        FileSeal { bytes: bytes.len() as u64, sha256: sha256_hex(bytes) }
    }
}

/// The operator's judgement of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, Serialize, Deserialize)]
#[display(rename_all = "snake_case")]
#[serde(rename_all = "snake_case")]
pub enum VerdictKind {
    /// The run counts.
    Valid,
    /// The run does not count: a campaign's figures leave it out.
    Invalid,
}

/// A verdict on a run, with its reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Verdict {
    /// The judgement.
    pub verdict: VerdictKind,
    /// The operator's reason.
    pub reason: String,
    /// When the operator gave it, RFC 3339.
    pub given_utc: String,
}

/// The manifest. Its outcome is null while the run goes on, and stays null if the bench is killed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Format of this file; raised when a key changes its meaning.
    pub format: u32,
    /// Name of the run.
    pub name: String,
    /// The operation, such as `home` or `jog`; `None` for an insertion.
    pub operation: Option<String>,
    /// The arguments of the operation on its command line:
    /// `--axis`, `insertion`, `--by`, `2mm`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub arguments: Vec<String>,
    /// The bus of the rig that was rehearsed; `None` if this was no rehearsal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rehearsal: Option<String>,
    /// The operator's name.
    pub operator: Option<String>,
    /// The phantom that the needle was inserted into.
    pub phantom: Option<String>,
    /// The operator's note.
    pub note: Option<String>,
    /// Version of the bench.
    pub version: String,
    /// Git state of the bench.
    pub git: Option<String>,
    /// SHA-256 of `config.toml`, hex.
    pub config_sha256: String,
    /// SHA-256 of the calibrated part of the configuration, hex.
    pub calibration_sha256: Option<String>,
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
    /// Length of the run on its own time line, s. In virtual time this differs from the elapsed time.
    pub duration_s: Option<f64>,
    /// How the run ended.
    pub outcome: Option<RunOutcome>,
    /// Why the run was stopped.
    pub stop_reason: Option<String>,
    /// Records in the text files.
    pub counts: Option<Counts>,
    /// Records that were lost.
    pub dropped: Option<Dropped>,
    /// Writers that failed, with their reasons.
    pub faults: Vec<String>,
    /// Tracker samples accepted, and refused by each gate.
    pub gates: Map<String, Value>,
    /// Figures of the run, units in the keys.
    pub figures: Map<String, Value>,
    /// Timing figures of the runtime, units in the keys.
    pub timing: Map<String, Value>,
    /// The other files, by name, as they were when the record was closed.
    pub files: BTreeMap<String, FileSeal>,
    /// When a repair closed the record after its bench had ended, RFC 3339.
    pub repaired_utc: Option<String>,
    /// The operator's verdicts; the last one counts.
    #[serde(default)]
    pub verdicts: Vec<Verdict>,
}

impl Manifest {
    /// The manifest of a run that starts at `started_utc`.
    pub fn new(name: &str, started_utc: String) -> Self {
        Manifest { format: FORMAT, name: name.to_owned(), started_utc, ..Manifest::default() }
    }

    /// The verdict that counts: the last.
    pub fn verdict(&self) -> Option<&Verdict> {
        self.verdicts.last()
    }

    /// Sets how the run ended.
    pub fn set_outcome(&mut self, outcome: &Outcome) {
        self.outcome = Some(outcome.into());
        self.stop_reason = outcome.stop_reason().map(str::to_owned);
    }

    /// The manifest as text, with its seal: a hash of all other keys. The seal detects edits by hand; it is
    /// not a signature.
    ///
    /// # Errors
    /// The manifest cannot be written as JSON, which does not happen for a manifest of this program.
    pub fn to_text(&self) -> Result<String, serde_json::Error> {
        let mut value = serde_json::to_value(self)?;
        let seal = seal_of(&value);
        if let Value::Object(keys) = &mut value {
            keys.insert(SEAL.to_owned(), Value::String(seal));
        }
        Ok(serde_json::to_string_pretty(&value)? + "\n")
    }

    /// Reads what [`Manifest::to_text`] wrote.
    ///
    /// # Errors
    /// The text is no manifest, has another format, or was edited. The message says what to do next.
    pub fn from_text(text: &str) -> Result<Self, String> {
        let foreign = |error| format!("not a run's manifest: {error} (restore it from a copy)");
        let mut value: Value = serde_json::from_str(text).map_err(foreign)?;
        if let Some(found) = value.get("format").and_then(Value::as_u64)
            && found != u64::from(FORMAT)
        {
            let version = value.get("version").and_then(Value::as_str).unwrap_or("unknown");
            return Err(format!(
                "format {found}, this bench reads format {FORMAT}; use the bench it was made by ({version})"
            ));
        }
        // `shift_remove` keeps the order of the others.
        let seal = value.as_object_mut().and_then(|keys| keys.shift_remove(SEAL));
        let is_sealed = seal.as_ref().and_then(Value::as_str) == Some(seal_of(&value).as_str());
        let manifest = serde_json::from_value(value).map_err(foreign)?;
        let edited =
            "edited since the bench wrote it: its seal does not fit (restore it from a copy)";
        if is_sealed { Ok(manifest) } else { Err(edited.to_owned()) }
    }
}

fn seal_of(manifest: &Value) -> String {
    sha256_hex(manifest.to_string().as_bytes())
}

/// The SHA-256 of `bytes`, in hex.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// `bytes` in hex.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sha256_of_the_standard_vector() {
        assert_eq!(
            sha256_hex(b"abc"),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
    }

    fn manifest() -> Manifest {
        let mut manifest = Manifest::new("virtual", "2023-11-14T22:13:20.000000Z".to_owned());
        manifest.operator = Some("J. Doe".to_owned());
        manifest.version = "0.1.0".to_owned();
        manifest.git = Some("abc1234".to_owned());
        manifest.config_sha256 = sha256_hex(b"abc");
        manifest.bus = "memory".to_owned();
        manifest.tracker = "emulated".to_owned();
        manifest.seed = Some(7);
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
        manifest.timing.insert("sync_jitter_us_p99".to_owned(), 0.1f64.into());
        let seal = FileSeal { bytes: 3, sha256: sha256_hex(b"abc") };
        manifest.files.insert("steps.csv".to_owned(), seal);
        manifest
    }

    /// Do not edit: scripts read these keys.
    #[test]
    fn manifest_is_frozen() {
        insta::assert_snapshot!(manifest().to_text().unwrap());
    }

    #[test]
    fn a_manifest_is_read_back() {
        let mut manifest = manifest();
        let reason = "wrong gain".to_owned();
        let given_utc = "2023-11-15T08:00:00.000000Z".to_owned();
        manifest.verdicts.push(Verdict { verdict: VerdictKind::Invalid, reason, given_utc });
        assert_eq!(Manifest::from_text(&manifest.to_text().unwrap()).unwrap(), manifest);
    }

    #[test]
    fn a_foreign_edited_or_newer_manifest_is_refused_with_the_reason() {
        let text = manifest().to_text().unwrap();
        let cases = [
            (
                "{}".to_owned(),
                "not a run's manifest: missing field `format` (restore it from a copy)",
            ),
            (
                "step,time_s".to_owned(),
                "not a run's manifest: expected value at line 1 column 1 (restore it from a copy)",
            ),
            (
                text.replace("31.2", "31.3"),
                "edited since the bench wrote it: its seal does not fit (restore it from a copy)",
            ),
            (
                text.replace("\"format\": 2", "\"format\": 3"),
                "format 3, this bench reads format 2; use the bench it was made by (0.1.0)",
            ),
        ];
        for (text, said) in cases {
            assert_eq!(Manifest::from_text(&text).unwrap_err().to_string(), said);
        }
    }
}
