//! The records that a session writes. A session never reads them.

use super::machine::Input;
use super::state::State;
use super::steering::Decision;
use crate::canopen::{Frame, NodeId};
use crate::stage::{Axis, Feedback, Identity};
use crate::tracker::{Refusal, Sample};
use crate::units::Time;
use derive_more::Display;
use nalgebra::Vector3;

/// Direction of a frame, from the bench's point of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Taken from the bus.
    Received,
    /// Put on the bus.
    Sent,
}

/// The parts of the bench that have a state of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Display)]
#[display(rename_all = "lowercase")]
pub enum Lane {
    /// The run itself.
    Session,
    /// The CANopen stage.
    Stage,
    /// The tracker stream.
    Tracker,
    /// The observer that steers.
    Observer,
    /// The controller.
    Control,
}

impl Lane {
    /// Every lane.
    pub const ALL: [Lane; 5] =
        [Lane::Session, Lane::Stage, Lane::Tracker, Lane::Observer, Lane::Control];
}

/// How much an event matters to the operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Worth knowing.
    Info,
    /// Something is wrong, but the run goes on.
    Warning,
    /// The run is stopped.
    Fault,
}

/// One position as received, and whether it was accepted.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleRecord {
    /// As received.
    pub received: Sample,
    /// Position in plane frame P, mm, if the sample was accepted.
    pub position_plane_mm: Option<Vector3<f64>>,
    /// When the tip was there: the stamp less the latency, if the sample was accepted.
    pub acquisition_time: Option<Time>,
    /// Why the sample was refused; `None` when it was accepted.
    pub refused: Option<Refusal>,
}

impl SampleRecord {
    /// The sample `received`, not judged yet.
    pub fn received(received: Sample) -> Self {
        SampleRecord { received, position_plane_mm: None, acquisition_time: None, refused: None }
    }
}

/// One step of an insertion, in the plane frame: a row of `steps.csv`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepRecord {
    /// Number of the step, from 0 at the start of the insertion.
    pub step: u32,
    /// When the step was taken.
    pub time: Time,
    /// Measured depth, mm.
    pub insertion_meas_mm: f64,
    /// Measured base rotation, rad.
    pub rotation_meas_rad: f64,
    /// Tracked positions that corrected the observers since the step before.
    pub tip_positions: u32,
    /// The newest of them, or in a stepwise insertion their mean, plane frame, mm.
    pub tip_meas_mm: Option<Vector3<f64>>,
    /// Measured depth at which that position was acquired, mm.
    pub tip_meas_insertion_mm: Option<f64>,
    /// Age of that position at the step, s.
    pub tip_meas_age_s: Option<f64>,
    /// Measured minus predicted position at that depth, plane frame, mm.
    pub innovation_mm: Option<Vector3<f64>>,
    /// The estimates at this depth, and the command.
    pub decision: Decision,
}

/// One record of a session.
#[derive(Debug, Clone, PartialEq)]
pub enum Record {
    /// The session begins.
    Begun {
        /// The time it was made at.
        time: Time,
    },
    /// An input of the session. The inputs, in this order and with these times, determine the whole run: a
    /// replay needs nothing else.
    Input {
        /// The time it was given at.
        time: Time,
        /// The input.
        input: Input,
    },
    /// A CAN frame.
    Can {
        /// When it was sent or taken from the bus.
        time: Time,
        /// Which way it went.
        direction: Direction,
        /// The frame.
        frame: Frame,
    },
    /// A tip position, accepted or not.
    Sample(SampleRecord),
    /// A position of the target, if that is a tool of its own, accepted or not.
    Target(SampleRecord),
    /// The stage at one SYNC; depth and rotation of an insertion count from where it began.
    Stage(Feedback),
    /// One step of the insertion.
    Step(Box<StepRecord>),
    /// A drive reported its identity.
    Drive {
        /// When.
        time: Time,
        /// The axis of the drive.
        axis: Axis,
        /// Its node number.
        node: NodeId,
        /// The identity.
        identity: Identity,
    },
    /// A part of the bench entered a new state.
    State {
        /// When.
        time: Time,
        /// Which part, and the state.
        state: State,
    },
    /// Something happened that the operator may read.
    Event {
        /// When.
        time: Time,
        /// Which part.
        lane: Lane,
        /// How much it matters.
        severity: Severity,
        /// What happened, with its numbers.
        text: String,
    },
}
