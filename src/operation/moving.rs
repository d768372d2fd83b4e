//! One axis on its way, the other held.

use std::time::Duration;

use crate::session::Profile;
use crate::stage::{Axis, Feedback, SetPoint};
use crate::units::Time;

/// How long the axis may take to come near to where its set-points have ended.
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

/// The coordinate of `axis`.
pub(super) fn along(axis: Axis, at: SetPoint) -> f64 {
    match axis {
        Axis::Insertion => at.insertion_mm,
        Axis::Rotation => at.rotation_rad,
    }
}

/// The measured position.
pub(super) fn measured(feedback: &Feedback) -> SetPoint {
    SetPoint { insertion_mm: feedback.insertion_mm, rotation_rad: feedback.rotation_rad }
}

/// The targets that both axes are held at.
pub(super) fn commanded(feedback: &Feedback) -> SetPoint {
    SetPoint { insertion_mm: feedback.insertion_cmd_mm, rotation_rad: feedback.rotation_cmd_rad }
}

impl Moving {
    /// Begins where both axes are held. An error is the reason not to.
    pub(super) fn new(way: Move, from: SetPoint) -> Result<Self, String> {
        let here = along(way.axis, from);
        let distance = match way.goal {
            Goal::By(distance) => distance,
            Goal::BackTo(goal) if here >= goal - way.arrival => (goal - here).min(0.0),
            Goal::BackTo(goal) => {
                let (axis, unit) = (way.axis, way.axis.unit());
                return Err(format!(
                    "{axis}: stands at {here:.3} {unit}, not beyond the {goal:.3} {unit} to go back to"
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

    /// Where the move began.
    pub(super) fn from(&self) -> SetPoint {
        self.from
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
        let axis = self.way.axis;
        let standing = along(axis, measured(feedback)) - along(axis, commanded(feedback));
        let offset = *self.offset.get_or_insert(standing);
        if self.profile.position_mm() < self.profile.goal_mm() {
            return Ok(false);
        }
        let Move { axis, arrival, .. } = self.way;
        let (goal, here) = (along(axis, self.goal()), along(axis, measured(feedback)));
        let off = (goal + offset - here).abs();
        let since = *self.ended.get_or_insert(feedback.time);
        if off <= arrival {
            return Ok(true);
        }
        let waited = feedback.time.since(since);
        if waited < ARRIVAL_TIMEOUT {
            return Ok(false);
        }
        let unit = axis.unit();
        Err(format!(
            "{axis}: stands at {here:.4} {unit}, {off:.4} {unit} from the {goal:.4} {unit} commanded \
             (limit {arrival:.4}), for {:.1} s; does the drive hold its target?",
            waited.as_secs_f64()
        ))
    }
}
