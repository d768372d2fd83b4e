//! Moves one axis to a goal; the other is held.

use crate::session::{ARRIVAL_TIMEOUT, AxisMove, Profile, Record, Shell, State, Task};
use crate::stage::{Axis, Feedback, SetPoint, StageEvent};
use crate::units::Time;
use std::time::Duration;

/// A move of one axis, in mm or rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// The axis that moves.
    pub axis: Axis,
    /// Where it moves to.
    pub goal: MoveGoal,
    /// Highest speed, per second.
    pub speed: f64,
    /// Acceleration and braking, per second squared.
    pub acceleration: f64,
    /// Position tolerance at the goal.
    pub arrival: f64,
}

/// The goal of a move, in mm or rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MoveGoal {
    /// This far from where the axis stands, in either direction.
    By(f64),
    /// To this position, in either direction.
    To(f64),
    /// Back to this position, from beyond it only: this never pushes the needle.
    BackTo(f64),
}

/// A move under way.
#[derive(Debug, Clone)]
pub(super) struct Moving {
    request: Move,
    from: SetPoint,
    /// Distance of the goal from `from`, with its sign.
    distance: f64,
    profile: Profile,
    /// How far the axis stood from its target when the move began. It may stand as far from it at the end.
    offset: Option<f64>,
    /// When the last set-point took effect.
    ended: Option<Time>,
}

impl Moving {
    /// Begins at the target `from` at which both axes are held.
    ///
    /// # Errors
    /// The axis would have to be pushed to its goal, which [`MoveGoal::BackTo`] excludes.
    pub(super) fn new(request: Move, from: SetPoint) -> Result<Self, String> {
        let here = from.along(request.axis);
        let distance = match request.goal {
            MoveGoal::By(distance) => distance,
            MoveGoal::To(goal) => goal - here,
            MoveGoal::BackTo(goal) if here >= goal - request.arrival => (goal - here).min(0.0),
            MoveGoal::BackTo(goal) => {
                let (axis, [here, goal]) =
                    (request.axis, [here, goal].map(|at| request.axis.shown(at)));
                return Err(format!(
                    "{axis}: stands at {here}, not beyond {goal}: a withdrawal never pushes the needle"
                ));
            }
        };
        let mut profile = Profile::new(request.speed, request.acceleration);
        profile.go_to(distance.abs());
        Ok(Moving { request, from, distance, profile, offset: None, ended: None })
    }

    fn set_point_at(&self, distance: f64) -> SetPoint {
        let mut set_point = self.from;
        match self.request.axis {
            Axis::Insertion => set_point.insertion_mm += distance,
            Axis::Rotation => set_point.rotation_rad += distance,
        }
        set_point
    }

    /// The last set-point.
    pub(super) fn goal(&self) -> SetPoint {
        self.set_point_at(self.distance)
    }

    /// The set-point for the next SYNC.
    pub(super) fn advance(&mut self, sync_period: Duration) -> SetPoint {
        let gone = self.profile.advance(sync_period);
        if gone >= self.distance.abs() {
            self.goal()
        } else {
            self.set_point_at(gone * self.distance.signum())
        }
    }

    /// True once the last set-point has taken effect and the axis is within the tolerance of its goal.
    ///
    /// # Errors
    /// The axis has not come there in time.
    pub(super) fn has_arrived(&mut self, feedback: &Feedback) -> Result<bool, String> {
        let Move { axis, arrival, .. } = self.request;
        let here = feedback.measured.along(axis);
        let standing = here - feedback.commanded.along(axis);
        let offset = *self.offset.get_or_insert(standing);
        if self.profile.position_mm() < self.profile.goal_mm() {
            return Ok(false);
        }
        // The target that was sent: the goal, rounded to whole counts.
        let goal = feedback.commanded.along(axis);
        let off = (goal + offset - here).abs();
        let since = *self.ended.get_or_insert(feedback.time);
        if off <= arrival {
            return Ok(true);
        }
        let waited = feedback.time.since(since);
        if waited < ARRIVAL_TIMEOUT {
            return Ok(false);
        }
        let [here, off, goal] = [here, off, goal].map(|value| axis.shown(value));
        Err(format!(
            "{axis}: stands at {here}, {off} from the {goal} commanded (limit {:.3}), for {:.1} s; \
             does the drive hold its target?",
            axis.in_unit(arrival).0,
            waited.as_secs_f64()
        ))
    }
}

/// The task of moving one axis, from the targets that both are held at.
#[derive(Debug)]
pub(super) struct MoveOneAxis {
    request: Move,
    moving: Option<Moving>,
    moves: Vec<AxisMove>,
}

impl MoveOneAxis {
    pub(super) fn new(request: Move) -> Self {
        MoveOneAxis { request, moving: None, moves: Vec::new() }
    }

    /// The move from `at`, if its goal is within the limits.
    fn plan_from(&self, shell: &Shell, at: SetPoint) -> Result<Moving, String> {
        let moving = Moving::new(self.request, at)?;
        shell.check_goal(moving.goal())?;
        Ok(moving)
    }

    /// Computes the set-point for the next SYNC.
    fn advance(&mut self, shell: &mut Shell, feedback: &Feedback) -> Result<(), String> {
        let mut moving = match self.moving.take() {
            Some(moving) => moving,
            None => {
                let moving = self.plan_from(shell, feedback.commanded)?;
                let (axis, from) = (self.request.axis, feedback.commanded.along(self.request.axis));
                self.moves.push(AxisMove { axis, from: Some(from), to: from });
                shell.enter(State::Moving);
                moving
            }
        };
        if moving.has_arrived(feedback)? {
            shell.complete();
            return Ok(());
        }
        let set_point = moving.advance(shell.config().bus.sync_period());
        self.moving = Some(moving);
        shell.command(set_point)
    }
}

impl Task for MoveOneAxis {
    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String> {
        match event {
            // Refuses the goal before the axes have power.
            StageEvent::Located(at) => self.plan_from(shell, *at).map(drop),
            StageEvent::Feedback(feedback) => {
                shell.record(Record::Stage(*feedback));
                if let Some(moved) = self.moves.last_mut() {
                    moved.to = feedback.measured.along(moved.axis);
                }
                if shell.is_running() { self.advance(shell, feedback) } else { Ok(()) }
            }
            _ => Ok(()),
        }
    }

    /// A stop from outside ends the feedback while the axis still brakes, so the end of the move is where the axis
    /// was measured last, unless the drive has restarted since.
    fn end(&mut self, shell: &mut Shell) {
        let Some(moved) = self.moves.last_mut() else { return };
        if let Some(position) = shell.stage_at_end().position_of(moved.axis) {
            moved.to = position;
        }
    }

    fn moves(&self) -> &[AxisMove] {
        &self.moves
    }
}
