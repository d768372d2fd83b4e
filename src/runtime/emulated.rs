//! What can be known only of an emulated run: the scripted faults that began, when the run began to
//! stop, the true positions of the axes, and the final states of the drives.

use crate::canopen::cia402::DriveState;
use crate::emulator::VirtualStage;
use crate::emulator::fault::Fault;
use crate::units::Time;

/// The true positions of both axes at one time of an emulated run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// When.
    pub time: Time,
    /// True depth, mm, from where the stage was switched on.
    pub insertion_true_mm: f64,
    /// True rotation, rad, from where the stage was switched on.
    pub rotation_true_rad: f64,
}

impl Moment {
    fn of(stage: &VirtualStage, time: Time) -> Self {
        let (insertion_true_mm, rotation_true_rad) = stage.position_true(time);
        Moment { time, insertion_true_mm, rotation_true_rad }
    }
}

/// How one emulated drive ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveOutcome {
    /// Its state at the end.
    pub state: DriveState,
    /// When it last left Operation Enabled.
    pub left_operation_enabled: Option<Moment>,
    previous_state: DriveState,
}

/// What can be known only of an emulated run.
#[derive(Debug, Clone, PartialEq)]
pub struct EmulationReport {
    /// The scripted faults that began, in order.
    pub faults: Vec<(Fault, Moment)>,
    /// When the run began to stop.
    pub stopping: Option<Moment>,
    /// The insertion drive and the rotation drive.
    pub drives: [DriveOutcome; 2],
    /// The end of the run.
    pub end: Moment,
}

impl EmulationReport {
    /// The report of a run that begins on `stage`.
    pub(super) fn new(stage: &VirtualStage, now: Time) -> Self {
        let drives = stage.drives().map(|drive| {
            let state = drive.state();
            DriveOutcome { state, left_operation_enabled: None, previous_state: state }
        });
        EmulationReport { faults: Vec::new(), stopping: None, drives, end: Moment::of(stage, now) }
    }

    pub(super) fn add_fault(&mut self, fault: Fault, stage: &VirtualStage, now: Time) {
        self.faults.push((fault, Moment::of(stage, now)));
    }

    pub(super) fn set_stopping(&mut self, stage: &VirtualStage, now: Time) {
        self.stopping = Some(Moment::of(stage, now));
    }

    /// Updates the positions and the drive states. Call it after every change of the stage.
    pub(super) fn update(&mut self, stage: &VirtualStage, now: Time) {
        self.end = Moment::of(stage, now);
        for (outcome, drive) in self.drives.iter_mut().zip(stage.drives()) {
            outcome.state = drive.state();
            let enabled = |state| state == DriveState::OperationEnabled;
            if enabled(outcome.previous_state) && !enabled(outcome.state) {
                outcome.left_operation_enabled = Some(self.end);
            }
            outcome.previous_state = outcome.state;
        }
    }
}
