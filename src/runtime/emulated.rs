//! What is known of an emulated run alone: which faults struck, when the run began to stop, where
//! the axes truly were, and what became of the drives.

use crate::canopen::cia402::DriveState;
use crate::emulator::VirtualStage;
use crate::emulator::fault::Fault;
use crate::units::Time;

/// A moment of an emulated run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// When.
    pub time: Time,
    /// True depth, mm, from where the stage was switched on.
    pub insertion_true_mm: f64,
    /// True rotation, rad, from there.
    pub rotation_true_rad: f64,
}

impl Moment {
    fn of(stage: &VirtualStage, time: Time) -> Self {
        let (insertion_true_mm, rotation_true_rad) = stage.position_true(time);
        Moment { time, insertion_true_mm, rotation_true_rad }
    }
}

/// One emulated drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveEnd {
    /// Its state at the end.
    pub state: DriveState,
    /// When it last left Operation Enabled.
    pub left_operation: Option<Moment>,
    was: DriveState,
}

/// What is known of an emulated run.
#[derive(Debug, Clone, PartialEq)]
pub struct Emulated {
    /// The faults that struck, in order.
    pub faults: Vec<(Fault, Moment)>,
    /// When the run began to stop.
    pub stopping: Option<Moment>,
    /// The insertion drive and the rotation drive.
    pub drives: [DriveEnd; 2],
    /// The end of the run.
    pub end: Moment,
}

impl Emulated {
    /// A run that begins on `stage`.
    pub(super) fn new(stage: &VirtualStage, now: Time) -> Self {
        let drives = stage.drives().map(|drive| {
            let state = drive.state();
            DriveEnd { state, left_operation: None, was: state }
        });
        Emulated { faults: Vec::new(), stopping: None, drives, end: Moment::of(stage, now) }
    }

    pub(super) fn struck(&mut self, fault: Fault, stage: &VirtualStage, now: Time) {
        self.faults.push((fault, Moment::of(stage, now)));
    }

    pub(super) fn stopping(&mut self, stage: &VirtualStage, now: Time) {
        self.stopping = Some(Moment::of(stage, now));
    }

    /// Looks at the stage, after every change of it.
    pub(super) fn look(&mut self, stage: &VirtualStage, now: Time) {
        self.end = Moment::of(stage, now);
        for (end, drive) in self.drives.iter_mut().zip(stage.drives()) {
            end.state = drive.state();
            let enabled = |state| state == DriveState::OperationEnabled;
            if enabled(end.was) && !enabled(end.state) {
                end.left_operation = Some(self.end);
            }
            end.was = end.state;
        }
    }
}
