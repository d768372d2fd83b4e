//! Closes a record that its bench left open, for example because the bench was killed.

use super::run_folder::seal_of;
use super::{RunFolder, TelemetryError, folder, utc_text};
use crate::archive::{Counts, RecordedColumns, file};
use crate::session::Outcome;
use std::collections::BTreeMap;
use std::fmt;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead as _, BufReader};
use std::path::Path;
use std::time::SystemTime;

/// The result of a repair.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Repaired {
    /// The stop reason that the repair wrote into the manifest.
    pub stop_reason: String,
    /// Numbers of whole lines in the text files.
    pub counts: Counts,
    /// Text files that ended in the middle of a line, each with the length of that partial line in bytes.
    /// The partial line is now in a file of the same name with `.cut` appended.
    pub cuts: Vec<(String, u64)>,
    /// Text files that are missing.
    pub missing: Vec<&'static str>,
}

impl fmt::Display for Repaired {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Counts { can_frames, tracker_samples, steps, events, .. } = self.counts;
        write!(
            f,
            "{}: {steps} steps, {can_frames} frames, {tracker_samples} samples, {events} events",
            self.stop_reason
        )?;
        self.cuts.iter().try_for_each(|(name, bytes)| write!(f, "; {}", cut_text(name, *bytes)))?;
        // The stop reason names missing steps.
        let others = self.missing.iter().filter(|name| **name != file::STEPS);
        others.map(missing_text).try_for_each(|text| write!(f, "; {text}"))
    }
}

fn missing_text(name: impl fmt::Display) -> String {
    format!("{name} is missing")
}

fn cut_text(name: &str, bytes: u64) -> String {
    format!("{name} ended in the middle of a line; that part ({bytes} bytes) is now in {name}.cut")
}

/// Closes the record in `dir`, whose bench ended without closing it.
///
/// Moves the partial last line of each text file to a `.cut` file, counts the lines, seals the files, and writes
/// a manifest that says that the run was stopped, and at which step. Nothing recorded is lost. An interrupted
/// repair can be repeated. The caller makes `run.rrd` afterwards, from the closed record.
///
/// # Errors
/// [`TelemetryError`]; the record then stays open.
pub fn repair(dir: &Path) -> Result<Repaired, TelemetryError> {
    // If `dir` is no run folder, the error must say so, not that there is nothing to lock.
    RunFolder::open(dir)?;
    let Some(_lock) = folder::lock(dir)? else {
        let reason = "a bench is still writing this record, or another repair has it; wait for it, or end it with Ctrl-C";
        return Err(TelemetryError::unusable(dir, reason));
    };
    // The bench may have closed the record before the lock was taken.
    let run = RunFolder::open(dir)?;
    run.verify()?;
    if run.is_closed() {
        let reason = "the record is closed: there is nothing to repair";
        return Err(TelemetryError::unusable(dir, reason));
    }
    let (mut lines, mut cuts, mut missing) = (BTreeMap::new(), Vec::new(), Vec::new());
    for name in file::TEXT_FILES {
        let cut = move_partial_line(dir, name).map_err(TelemetryError::file(&dir.join(name)));
        match cut? {
            None => missing.push(name),
            Some((whole, cut)) => {
                lines.insert(name, whole);
                cuts.extend((cut > 0).then(|| (name.to_owned(), cut)));
            }
        }
    }
    let counts = Counts::of_lines(|name| lines.get(name).copied().unwrap_or_default());
    let last_step = match lines.contains_key(file::STEPS) {
        true => last_step(&run.text(file::STEPS)?),
        false => missing_text(file::STEPS),
    };
    let stop_reason = format!("the bench ended without closing its record; {last_step}");
    let mut manifest = run.manifest.clone();
    manifest.set_outcome(&Outcome::Stopped(stop_reason.clone()));
    manifest.counts = Some(counts);
    manifest.faults.extend(cuts.iter().map(|(name, bytes)| cut_text(name, *bytes)));
    manifest.faults.extend(missing.iter().map(missing_text));
    manifest.repaired_utc = Some(utc_text(SystemTime::now()));
    let names = [file::CONFIG].into_iter().chain(file::TEXT_FILES);
    for name in names.map(str::to_owned).chain(cuts.iter().map(|(name, _)| cut_name(name))) {
        manifest.files.extend(seal_of(dir, &name)?.map(|seal| (name, seal)));
    }
    folder::write_manifest(dir, &manifest)?;
    Ok(Repaired { stop_reason, counts, cuts, missing })
}

/// Writes the seal of `run.rrd` into the manifest of the closed record in `dir`, and the `fault`, if the file is
/// missing or incomplete. A fault of an earlier `run.rrd` is removed from the manifest.
///
/// # Errors
/// [`TelemetryError`] if the manifest cannot be read or written.
pub fn note_recording(dir: &Path, fault: Option<String>) -> Result<(), TelemetryError> {
    let mut manifest = RunFolder::open(dir)?.manifest;
    manifest.faults.retain(|known| !known.starts_with(file::RECORDING));
    manifest.faults.extend(fault);
    manifest.files.remove(file::RECORDING);
    let seal = seal_of(dir, file::RECORDING)?;
    manifest.files.extend(seal.map(|seal| (file::RECORDING.to_owned(), seal)));
    folder::write_manifest(dir, &manifest)
}

fn cut_name(name: &str) -> String {
    format!("{name}.cut")
}

/// Moves what follows the last newline of the file `name` to its `.cut` file. Returns the number of whole lines and
/// the number of bytes in the `.cut` file, which an earlier, interrupted repair may have moved; `None` if the file
/// is missing.
fn move_partial_line(dir: &Path, name: &str) -> io::Result<Option<(u64, u64)>> {
    let (path, cut_path) = (dir.join(name), dir.join(cut_name(name)));
    if !is_regular(&path)? {
        return Ok(None);
    }
    let mut file = BufReader::new(File::open(&path)?);
    let (mut lines, mut whole_bytes, mut line) = (0, 0, Vec::new());
    while file.read_until(b'\n', &mut line)? > 0 && line.ends_with(b"\n") {
        lines += 1;
        whole_bytes += line.len() as u64;
        line.clear();
    }
    let partial_line = line;
    let existing = if is_regular(&cut_path)? { fs::read(&cut_path)? } else { Vec::new() };
    if partial_line.is_empty() {
        return Ok(Some((lines, existing.len() as u64)));
    }
    // An interrupted repair may have left the beginning of the partial line there.
    if !partial_line.starts_with(&existing) {
        let name = cut_path.display();
        return Err(io::Error::other(format!("{name} exists with other content; move it away")));
    }
    // The copy comes first, so that an interruption loses nothing.
    fs::write(&cut_path, &partial_line)?;
    File::open(&cut_path)?.sync_all()?;
    OpenOptions::new().write(true).open(path)?.set_len(whole_bytes)?;
    Ok(Some((lines, partial_line.len() as u64)))
}

/// True for a regular file, false if `path` does not exist. A link is refused, since it may lead out of the record.
fn is_regular(path: &Path) -> io::Result<bool> {
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
        Ok(found) if found.is_file() => Ok(true),
        Ok(_) => Err(io::Error::other(format!("{}: not a regular file", path.display()))),
    }
}

/// The last step in `steps_csv`, in words: its number, depth and time.
fn last_step(steps_csv: &str) -> String {
    let mut lines = steps_csv.lines();
    let columns = RecordedColumns::of(lines.next().unwrap_or_default());
    let Some(row) = lines.last() else { return "no step was taken".to_owned() };
    match ["step", "insertion_mm", "time_s"].map(|column| columns.value(row, column)) {
        [Some(step), Some(insertion_mm), Some(time_s)] => {
            format!("the last step is {step} at {insertion_mm:.3} mm, {time_s:.3} s")
        }
        _ => "its last step cannot be read".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::{Manifest, RunOutcome, sha256_hex};
    use crate::telemetry::tests::Scratch;
    use crate::telemetry::write_manifest;

    const STEPS: &str = "step,time_s,insertion_mm\n0,1.5,0.001\n1,2.5,1.002\n";

    /// A record that was never closed.
    fn open_record(test: &str) -> Scratch {
        let scratch = Scratch::new(test);
        let dir = &scratch.0;
        fs::write(dir.join(file::CONFIG), "name = \"x\"\n").unwrap();
        fs::write(dir.join(file::STEPS), format!("{STEPS}2,3.5,2.0")).unwrap();
        fs::write(dir.join(file::CAN), "a\nb\nc\n").unwrap();
        let mut manifest = Manifest::new("x", "2023-11-14T22:13:20.000000Z".to_owned());
        manifest.config_sha256 = sha256_hex(b"name = \"x\"\n");
        write_manifest(dir, &manifest).unwrap();
        scratch
    }

    #[test]
    fn an_open_record_is_closed_and_nothing_is_lost() {
        let scratch = open_record("repair");
        let dir = &scratch.0;
        let repaired = repair(dir).unwrap();
        let reason = "the bench ended without closing its record; the last step is 1 at 1.002 mm, \
                      2.500 s";
        assert_eq!(repaired.stop_reason, reason);
        let counts = Counts { steps: 2, can_frames: 3, ..Counts::default() };
        assert_eq!((repaired.counts, repaired.cuts), (counts, vec![("steps.csv".to_owned(), 9)]));
        let text = |name: &str| fs::read_to_string(dir.join(name)).unwrap();
        assert_eq!((text(file::STEPS), text("steps.csv.cut")), (STEPS.into(), "2,3.5,2.0".into()));

        let run = RunFolder::open(dir).unwrap();
        run.verify().unwrap();
        let manifest = &run.manifest;
        assert_eq!(manifest.outcome, Some(RunOutcome::Stopped));
        assert_eq!(manifest.stop_reason.as_deref(), Some(reason));
        assert!(manifest.repaired_utc.is_some() && manifest.counts == Some(counts));
        let sealed: Vec<&str> = manifest.files.keys().map(String::as_str).collect();
        assert_eq!(sealed, ["can.log", "config.toml", "steps.csv", "steps.csv.cut"]);
        assert!(!dir.join(file::NEW_MANIFEST).exists());

        let said = repair(dir).unwrap_err().to_string();
        assert!(said.ends_with("the record is closed: there is nothing to repair"), "{said}");
    }

    /// A bench may be killed after it made the folder and before it made the files.
    #[test]
    fn a_record_with_a_missing_file_is_closed_with_a_fault() {
        let scratch = open_record("repair-early");
        fs::remove_file(scratch.0.join(file::STEPS)).unwrap();
        let repaired = repair(&scratch.0).unwrap();
        assert!(repaired.stop_reason.ends_with("; steps.csv is missing"), "{repaired}");
        let others = "; tracker.ndjson is missing; inputs.log is missing; events.log is missing";
        assert!(repaired.to_string().ends_with(others), "{repaired}");
        assert_eq!(repaired.to_string().matches("steps.csv is missing").count(), 1, "{repaired}");
        let run = RunFolder::open(&scratch.0).unwrap();
        run.verify().unwrap();
        let missing = "steps.csv is missing".to_owned();
        assert!(run.manifest.faults.contains(&missing), "{:?}", run.manifest.faults);
    }

    /// The first repair was interrupted after the cut and before it wrote the manifest.
    #[test]
    fn an_interrupted_repair_can_be_repeated() {
        let scratch = open_record("repair-again");
        move_partial_line(&scratch.0, file::STEPS).unwrap();
        let repaired = repair(&scratch.0).unwrap();
        assert_eq!(repaired.cuts, [("steps.csv".to_owned(), 9)]);
        let run = RunFolder::open(&scratch.0).unwrap();
        assert!(run.manifest.files.contains_key("steps.csv.cut"));
        let said = cut_text(file::STEPS, 9);
        assert!(run.manifest.faults.contains(&said), "{:?}", run.manifest.faults);
    }

    #[test]
    fn an_existing_cut_file_with_other_content_is_not_overwritten() {
        for (there, is_repaired) in
            [("", true), ("2,3", true), ("2,3.5,2.0", true), ("notes", false)]
        {
            let scratch = open_record("repair-aside");
            fs::write(scratch.0.join("steps.csv.cut"), there).unwrap();
            match repair(&scratch.0) {
                Ok(repaired) => assert_eq!(repaired.cuts, [("steps.csv".to_owned(), 9)], "{there}"),
                Err(error) => assert!(error.to_string().contains("move it away"), "{error}"),
            }
            let aside = fs::read_to_string(scratch.0.join("steps.csv.cut")).unwrap();
            assert_eq!(aside, if is_repaired { "2,3.5,2.0" } else { there });
            assert_eq!(RunFolder::open(&scratch.0).unwrap().is_closed(), is_repaired);
        }
    }

    #[test]
    fn a_record_that_is_being_written_is_left_alone() {
        let scratch = open_record("repair-locked");
        let lock = folder::lock(&scratch.0).unwrap();
        let said = repair(&scratch.0).unwrap_err().to_string();
        assert!(said.contains("a bench is still writing this record"), "{said}");
        drop(lock);
        repair(&scratch.0).unwrap();
    }

    #[test]
    fn an_edited_record_and_a_folder_without_a_record_are_left_alone() {
        let scratch = open_record("repair-edited");
        let dir = &scratch.0;
        fs::write(dir.join(file::CONFIG), "name = \"y\"\n").unwrap();
        let said = repair(dir).unwrap_err().to_string();
        assert!(said.contains("config.toml was edited"), "{said}");
        assert!(!dir.join("steps.csv.cut").exists());
        let said = repair(&dir.join("none")).unwrap_err().to_string();
        assert!(said.contains("not a run folder"), "{said}");
    }

    #[test]
    fn the_last_step_is_read_from_the_last_row() {
        assert_eq!(last_step("step,time_s,insertion_mm\n"), "no step was taken");
        assert_eq!(last_step(""), "no step was taken");
        assert_eq!(last_step("step\nx\n"), "its last step cannot be read");
    }
}
