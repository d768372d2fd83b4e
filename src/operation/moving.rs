//! One axis on its way, the other held.

use crate::session::{AxisMove, Profile, Record, Shell, State, Task};
use crate::stage::{Axis, Feedback, SetPoint, StageConfig, StageEvent};
use crate::units::Time;
use std::time::Duration;

/// Time after the last set-point by which the axis must be within its arrival tolerance.
const ARRIVAL_TIMEOUT: Duration = Duration::from_secs(2);

/// A way to go, in mm or rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// Which axis.
    pub axis: Axis,
    /// Where to.
    pub goal: Goal,
    /// Highest speed, per second.
    pub speed: f64,
    /// Acceleration and braking, per second squared.
    pub acceleration: f64,
    /// Standing this near to the goal counts as there.
    pub arrival: f64,
}

/// Where to, in mm or rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// So far from where the axis stands, either way.
    By(f64),
    /// To this position, either way.
    To(f64),
    /// Back to this position, from beyond it only: a needle is never pushed by it.
    BackTo(f64),
}

/// A move under way.
#[derive(Debug, Clone)]
pub(super) struct Moving {
    way: Move,
    from: SetPoint,
    /// Distance from there, with its sign.
    distance: f64,
    profile: Profile,
    /// What the drive stood off its target when the move began, and may stand off it at the end.
    offset: Option<f64>,
    /// Since when the set-points have ended.
    ended: Option<Time>,
}

impl Moving {
    /// Begins where both axes are held. An error is the reason not to.
    pub(super) fn new(way: Move, from: SetPoint) -> Result<Self, String> {
        let here = from.along(way.axis);
        let distance = match way.goal {
            Goal::By(distance) => distance,
            Goal::To(goal) => goal - here,
            Goal::BackTo(goal) if here >= goal - way.arrival => (goal - here).min(0.0),
            Goal::BackTo(goal) => {
                let (axis, [here, goal]) = (way.axis, [here, goal].map(|at| way.axis.shown(at)));
                return Err(format!(
                    "{axis}: stands at {here}, not beyond the {goal} to go back to"
                ));
            }
        };
        let mut profile = Profile::new(way.speed, way.acceleration);
        profile.go_to(distance.abs());
        Ok(Moving { way, from, distance, profile, offset: None, ended: None })
    }

    fn at(&self, distance: f64) -> SetPoint {
        let mut at = self.from;
        match self.way.axis {
            Axis::Insertion => at.insertion_mm += distance,
            Axis::Rotation => at.rotation_rad += distance,
        }
        at
    }

    /// Where it ends.
    pub(super) fn goal(&self) -> SetPoint {
        self.at(self.distance)
    }

    /// The set-point for the next SYNC.
    pub(super) fn advance(&mut self, sync_period: Duration) -> SetPoint {
        let gone = self.profile.advance(sync_period);
        if gone >= self.distance.abs() {
            self.goal()
        } else {
            self.at(gone * self.distance.signum())
        }
    }

    /// True once the last set-point was sent and the axis stands near enough to their end. An error
    /// is the reason to stop for: it does not come there.
    pub(super) fn has_arrived(&mut self, feedback: &Feedback) -> Result<bool, String> {
        let Move { axis, arrival, .. } = self.way;
        let here = feedback.measured.along(axis);
        let standing = here - feedback.commanded.along(axis);
        let offset = *self.offset.get_or_insert(standing);
        if self.profile.position_mm() < self.profile.goal_mm() {
            return Ok(false);
        }
        let goal = self.goal().along(axis);
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
    way: Move,
    sync_period: Duration,
    moving: Option<Moving>,
    moves: Vec<AxisMove>,
}

impl MoveOneAxis {
    pub(super) fn new(config: &StageConfig, way: Move) -> Self {
        MoveOneAxis { way, sync_period: config.bus.sync_period(), moving: None, moves: Vec::new() }
    }

    /// The move from `at`; a goal out of the limits is refused.
    fn from(&self, shell: &Shell, at: SetPoint) -> Result<Moving, String> {
        let moving = Moving::new(self.way, at)?;
        shell.check_goal(moving.goal())?;
        Ok(moving)
    }

    /// One SYNC.
    fn go_on(&mut self, shell: &mut Shell, feedback: &Feedback) -> Result<(), String> {
        let mut moving = match self.moving.take() {
            Some(moving) => moving,
            None => {
                let moving = self.from(shell, feedback.commanded)?;
                let (axis, from) = (self.way.axis, feedback.commanded.along(self.way.axis));
                self.moves.push(AxisMove { axis, from: Some(from), to: from });
                shell.enter(State::Moving);
                moving
            }
        };
        if moving.has_arrived(feedback)? {
            shell.complete();
            return Ok(());
        }
        let set_point = moving.advance(self.sync_period);
        self.moving = Some(moving);
        shell.command(set_point)
    }
}

impl Task for MoveOneAxis {
    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String> {
        match event {
            // Before the axes have power.
            StageEvent::Located(at) => self.from(shell, *at).map(drop),
            StageEvent::Feedback(feedback) => {
                shell.record(Record::Stage(*feedback));
                if let Some(moved) = self.moves.last_mut() {
                    moved.to = feedback.measured.along(moved.axis);
                }
                match shell.is_running() {
                    true => self.go_on(shell, feedback),
                    false => Ok(()),
                }
            }
            _ => Ok(()),
        }
    }

    fn moves(&self) -> &[AxisMove] {
        &self.moves
    }
}
