//! Tests of the last lines of a run.

use super::*;
use crate::archive::Manifest;
use crate::canopen::emcy::EmcyCode;
use crate::cli::arguments::Configured;
use crate::geometry::Pose;
use crate::observer::{Belief, Estimate, Shaft};
use crate::runtime::Holds;
use crate::session::{Decision, StepRecord};
use crate::stage::{PerAxis, SetPoint};
use crate::study::RunFigures;
use crate::telemetry::TelemetryError;
use crate::tracker::GateCounts;
use crate::units::Time;
use nalgebra::Vector3;
use std::path::PathBuf;

fn report(outcome: Outcome, faults: &[&str]) -> RunReport {
    let faults = faults.iter().map(|fault| (*fault).to_owned()).collect();
    RunReport {
        outcome,
        figures: RunFigures::default(),
        stage_at_end: StageAtEnd::default(),
        holds: Holds::default(),
        gates: GateCounts::default(),
        end: Time::ZERO,
        timing: None,
        run_dir: Some(PathBuf::from("runs/a")),
        record: Ok(Manifest { faults, ..Manifest::default() }),
        emulated: None,
    }
}

#[test]
fn a_record_left_open_is_named_with_what_closes_it() {
    let mut report = report(Outcome::Completed, &[]);
    let source = std::io::ErrorKind::NotFound.into();
    report.record = Err(TelemetryError::File { path: "runs/a/manifest.json".into(), source });
    let mut said = |run_dir: &str| {
        report.run_dir = Some(PathBuf::from(run_dir));
        ending(&Config::from_sources(&[], &[]).unwrap(), &report)
    };
    let text = said("src");
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines[0].starts_with("record      src, left open: "), "{text}");
    assert!(lines[0].ends_with("; close it: needle-bench review src --repair"), "{text}");
    assert_eq!(lines[1], "completed");
    let text = said("runs/gone");
    assert!(text.starts_with("record      runs/gone is no longer there: "), "{text}");
    assert!(text.contains("needle-bench review FOLDER --repair\ncompleted"), "{text}");
}

/// A needle that hardly bends misses the plane from wherever it starts.
#[test]
fn a_needle_that_hardly_bends_is_not_asked_to_start_nearer() {
    let config = config(&[]);
    let said = |part: f64| {
        let mut report = report(Outcome::Completed, &[]);
        for depth_mm in [40.0, 80.0, 120.0] {
            let x_pb = Pose { translation: Vector3::new(12.3, 0.0, depth_mm), ..Pose::identity() };
            let belief = Belief::certain(part * config.needle.arc.curvature_per_mm(), Shaft::RIGID);
            let estimate = Some(Estimate::of_belief(x_pb, belief));
            let decision = Decision { estimate, ..Decision::default() };
            let step =
                StepRecord { insertion_meas_mm: depth_mm, decision, ..StepRecord::default() };
            report.figures.take_step(&step, None);
        }
        let last = ending(&config, &report).lines().last().map(str::to_owned);
        last.filter(|last| last.chars().count() < 200).expect("a line of under 200 characters")
    };
    assert_eq!(
        said(0.103),
        "completed, not in the plane: 12.3 mm RMS off it by the estimate (limit 1.0); the needle bent by 10% of what \
         needle.radius_mm says: check bevel, tissue and radius (needle-bench calibrate needle)"
    );
    for part in [0.51, 1.0] {
        assert!(said(part).ends_with("or insert deeper if the tip was still approaching it"));
    }
}

/// A withdrawal goes on without a record, and the command that finishes it has no recorded configuration to name.
#[test]
fn a_withdrawal_without_a_record_says_how_to_finish_it() {
    let config = config(&[]);
    let error = TelemetryError::Recording("run folder runs: No space left on device".to_owned());
    let report = RunReport { run_dir: None, record: Err(error), ..stopped(stood()) };
    assert_eq!(
        ending(&config, &report),
        "record      none: run folder runs: No space left on device\nstopped: operator: interrupted"
    );
    let after = after_operation(&config, None, Some(" --by 5.0mm"), &report).unwrap();
    let next =
        "next        needle-bench stage withdraw CONFIG --by 5.0mm, CONFIG and its --set as before";
    assert_eq!(after.lines().last(), Some(next));
    let after = after_operation(&config, Some(Path::new(RIG)), Some(""), &report).unwrap();
    assert_eq!(after.lines().last(), Some("next        needle-bench stage withdraw rig.toml"));
    let emulated = Config::from_sources(&[], &[]).unwrap();
    assert_eq!(after_operation(&emulated, None, None, &report), None);
}

/// With `record.on_failure = "stop"` a run without a complete record does not succeed.
#[test]
fn a_completed_run_without_its_record_is_a_failure() {
    let mut config = Configured::default().load(None).unwrap();
    let lost = ["recording: the disk took nothing for 5.0 s"];
    assert_eq!(status(&config, &report(Outcome::Completed, &[])), 0);
    assert_eq!(status(&config, &report(Outcome::Completed, &lost)), 3);
    assert_eq!(status(&config, &report(Outcome::Stopped("tracker".to_owned()), &lost)), 1);
    config.record.on_failure = OnFailure::GoOn;
    assert_eq!(status(&config, &report(Outcome::Completed, &lost)), 0);
}

const RIG: &str = "rig.toml";

fn config(sets: &[&str]) -> Config {
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    Configured::new(Some(Path::new("bench-config/vcan.toml")), sets).load(None).unwrap()
}

fn stopped(stage_at_end: StageAtEnd) -> RunReport {
    let stopped = Outcome::Stopped("operator: interrupted".to_owned());
    RunReport { stage_at_end, ..report(stopped, &[]) }
}

/// Both drives had power and stand at 5 mm and 90 degrees.
fn stood() -> StageAtEnd {
    at(5.0)
}

/// As [`stood`], at `insertion_mm`.
fn at(insertion_mm: f64) -> StageAtEnd {
    let off = DriveReport { state: Some(DriveState::SwitchOnDisabled), ..DriveReport::default() };
    let position = SetPoint { insertion_mm, rotation_rad: 90_f64.to_radians() };
    let drives = PerAxis::from_fn(|_| off);
    StageAtEnd { had_power: true, unknown: None, drives, position: Some(position) }
}

/// Like [`stood`], with the rotation drive in Fault.
fn in_fault() -> StageAtEnd {
    let mut stage = stood();
    stage.drives.rotation = DriveReport {
        state: Some(DriveState::Fault),
        error: Some(EmcyCode::HEARTBEAT),
        restarted: false,
    };
    stage
}

#[test]
fn a_needle_is_withdrawn_after_a_stop_as_after_a_completed_run() {
    let real = config(&[]);
    assert_eq!(
        possible_withdrawal(&real, &stopped(stood())),
        Ok(Withdrawal::from_depth(&real, 5.0))
    );
    let not_moved = possible_withdrawal(&real, &stopped(at(0.01))).unwrap_err();
    assert_eq!(not_moved, "the needle is 0.0 mm in from where the run began");
    let text = after_insertion(&real, Some(Path::new(RIG)), &stopped(stood())).unwrap();
    assert!(
        text.starts_with(
            "needle      5.0 mm in from where the run began; both axes stand, power is off\n\
             next        needle-bench stage withdraw rig.toml --by 5.0mm"
        ),
        "{text}"
    );
}

/// The run may begin with the needle in, and may move it no further.
#[test]
fn the_depth_after_a_run_is_that_of_the_axis_not_the_travel_of_the_run() {
    let real = config(&["stage.insertion.zero=0"]);
    let said = |stage| {
        let report = stopped(stage);
        let lines = after_insertion(&real, Some(Path::new(RIG)), &report).unwrap();
        (lines, possible_withdrawal(&real, &report).map(|withdrawal| withdrawal.to_string()))
    };
    let (lines, withdrawal) = said(StageAtEnd { had_power: false, ..at(10.0) });
    let expected = "needle      10.0 mm in; no power was given\n\
                    next        needle-bench stage withdraw rig.toml";
    assert_eq!((&lines[..], withdrawal), (expected, Ok("to depth 0".to_owned())));
    let (lines, withdrawal) = said(at(0.01));
    assert!(lines.starts_with("needle      out, at 0.01 mm; "), "{lines}");
    assert_eq!(withdrawal.unwrap_err(), "the needle is out, at 0.01 mm");
    let (lines, withdrawal) = said(StageAtEnd::default());
    let expected = "needle      its depth is not known, this run inserted 0.0 mm; no power was given\n\
                    next        needle-bench stage status rig.toml";
    assert_eq!(lines, expected);
    assert_eq!(withdrawal.unwrap_err(), "the needle's depth is not known; look at the stage");
}

/// It may count anew from 0, or from elsewhere, with the needle in.
#[test]
fn the_position_of_a_drive_that_has_restarted_is_not_known() {
    let real = config(&["stage.insertion.zero=0"]);
    let mut stage = at(10.0);
    stage.drives.insertion.restarted = true;
    let report = stopped(stage);
    let rig = Some(Path::new(RIG));
    let expected = "needle      its depth is not known, this run inserted 0.0 mm; both axes stand, power is \
                    off\nnext        needle-bench stage status rig.toml";
    assert_eq!(after_insertion(&real, rig, &report).unwrap(), expected);
    let withdrawal = possible_withdrawal(&real, &report).unwrap_err();
    assert_eq!(withdrawal, "the needle's depth is not known; look at the stage");
    let expected = "stage       not known where the insertion stands, rotation at 90.000 deg; both axes \
                    stand, power is off\nnext        needle-bench stage status rig.toml";
    assert_eq!(after_operation(&real, rig, Some(" --by 5.0mm"), &report).unwrap(), expected);
}

/// A drive without power loses its position: after a restart it may report 0 with the needle in.
#[test]
fn a_position_of_less_than_was_inserted_is_no_depth() {
    let real = config(&["stage.insertion.zero=0"]);
    let mut restarted = stopped(at(0.0));
    restarted.figures.take_scored(15.0, None, None);
    let lines = after_insertion(&real, Some(Path::new(RIG)), &restarted).unwrap();
    let inserted = "needle      its depth is not known, this run inserted 15.0 mm; ";
    assert!(lines.starts_with(inserted), "{lines}");
    assert!(lines.ends_with("stage status rig.toml"), "{lines}");
    let why = possible_withdrawal(&real, &restarted).unwrap_err();
    assert_eq!(why, "the needle's depth is not known; look at the stage");
    // A drive that has lost its home moves only by a distance.
    let mut homed = real;
    homed.stage.insertion.reference = Reference::Homing;
    let lines = after_insertion(&homed, Some(Path::new(RIG)), &restarted).unwrap();
    assert!(lines.ends_with("stage withdraw rig.toml --by 15.0mm --unhomed"), "{lines}");
}

#[test]
fn drives_that_may_move_call_for_stage_status_first() {
    let real = config(&[]);
    let unknown = Some("the axes were not seen to stand");
    let stopped = stopped(StageAtEnd { unknown, ..in_fault() });
    let why = possible_withdrawal(&real, &stopped).unwrap_err();
    assert_eq!(why, "the drives are not known to stand; look at the stage");
    let path = Some(Path::new(RIG));
    for text in [
        after_insertion(&real, path, &stopped).unwrap(),
        after_operation(&real, path, Some(""), &stopped).unwrap(),
    ] {
        assert!(text.contains("; the axes were not seen to stand; rotation is in"), "{text}");
        assert!(text.ends_with("\nnext        needle-bench stage status rig.toml"), "{text}");
    }
}

#[test]
fn a_drive_in_fault_is_named_and_reset_first() {
    let real = config(&[]);
    let stopped = stopped(in_fault());
    assert_eq!(
        after_insertion(&real, Some(Path::new(RIG)), &stopped).unwrap(),
        "needle      5.0 mm in from where the run began; both axes stand, power is off; rotation \
         is in fault (0x8130 heartbeat or life guard lost)\n\
         next        needle-bench stage reset rig.toml"
    );
    let why = possible_withdrawal(&real, &stopped).unwrap_err();
    assert_eq!(why, "a drive is in fault: find why, then stage reset");
    let resets = config(&["stage.fault_reset_on_start=true"]);
    let text = after_insertion(&resets, Some(Path::new(RIG)), &stopped).unwrap();
    assert!(text.contains("\nnext        needle-bench stage withdraw rig.toml --by 5"), "{text}");
}

#[test]
fn an_operation_says_where_it_left_the_axes() {
    let real = config(&[]);
    let text = |report: &RunReport| after_operation(&real, Some(Path::new(RIG)), None, report);
    assert_eq!(
        text(&stopped(stood())).unwrap(),
        "stage       insertion at 5.000 mm, rotation at 90.000 deg; both axes stand, power is \
         off\nnext        needle-bench stage status rig.toml"
    );
    assert_eq!(
        text(&stopped(StageAtEnd::default())).unwrap(),
        "stage       not known where the axes stand; no power was given\n\
         next        needle-bench stage status rig.toml"
    );
    let withdrawal = stopped(stood());
    let rest =
        after_operation(&real, Some(Path::new(RIG)), Some(" --by 5.0mm"), &withdrawal).unwrap();
    assert!(
        rest.ends_with("\nnext        needle-bench stage withdraw rig.toml --by 5.0mm"),
        "{rest}"
    );
    let done = RunReport { outcome: Outcome::Completed, ..stopped(stood()) };
    assert_eq!(text(&done), None);
    let proved = RunReport { stage_at_end: in_fault(), ..done };
    let next = "\nnext        needle-bench stage reset rig.toml";
    assert!(text(&proved).unwrap().ends_with(next));
}

/// The limits of an axis that reads 0 at its start may not let it go back as far as the needle went in.
#[test]
fn the_suggested_withdrawal_is_within_the_limits() {
    let options = |sets: &[&str]| {
        let sets = sets.iter().map(|set| (*set).to_owned()).collect();
        let config = Configured::new(None, sets).load(None).unwrap();
        let withdrawal = Withdrawal::from_depth(&config, 12.96);
        let allowed = withdrawal.configuration(config, &stopped(stood()));
        assert_eq!(allowed.emulator.insertion_start_mm, 5.0, "where the stage stands");
        assert!(allowed.stage.insertion.limits.min <= -13.0 || withdrawal.by_mm.is_none());
        withdrawal.options()
    };
    assert_eq!(options(&[]), "");
    let start = "stage.insertion.zero=\"start\"";
    assert_eq!(options(&[start]), " --by 13.0mm --set stage.insertion.min_mm=-14.0");
    assert_eq!(options(&[start, "stage.insertion.min_mm=-20"]), " --by 13.0mm");
}
