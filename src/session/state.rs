//! The states of the parts of the bench.

use super::record::Lane;

/// The state of a part of the bench. Each state belongs to one part, its [lane](State::lane).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, derive_more::Display)]
#[display("{}", self.as_str())]
pub enum State {
    /// The run: the stage is brought up, and the bench waits for a tip.
    #[default]
    Preparing,
    /// The run: the needle is steered.
    Inserting,
    /// The run: the insertion is held, because no tip position is accepted.
    Holding,
    /// The run: the insertion is held by the operator.
    HeldByOperator,
    /// The run: the needle makes a single step that the operator asked for.
    Stepping,
    /// The run: the insertion is held, because a single step is done.
    HeldAfterStep,
    /// The run: an axis finds its home.
    Homing,
    /// The run: an axis moves to its commanded position.
    Moving,
    /// The run: the bench sends no heartbeat, to test whether the drives notice.
    Silent,
    /// The run: the base turns in air.
    TurningInAir,
    /// The run: the drives are being stopped.
    Stopping,
    /// The run: completed.
    Completed,
    /// The run: ended before it was completed.
    Stopped,
    /// The stage: both axes have power and follow their targets.
    Enabled,
    /// The stage: both axes were told to take power off.
    PowerOff,
    /// The tracker: no tip has been found yet.
    AwaitingTip,
    /// The tracker: positions are accepted.
    Tracking,
    /// The tracker: no position has come for some periods of the stream.
    Coasting,
    /// The tracker: too many positions were refused; only the model can find the tip again.
    Lost,
    /// The tracker: there is no link.
    Disconnected,
    /// The observer that steers: it has no estimate yet.
    NoEstimate,
    /// The observer that steers: it has an estimate, but the roll is not known.
    RollUnknown,
    /// The observer that steers: it has an estimate.
    Estimating,
    /// The controller: its demand is within its limits.
    Steering,
    /// The controller: it demands more than its limits allow.
    Saturated,
}

impl State {
    /// Every state with its part of the bench, and its name as `events.log` has it. In the order of the
    /// enum.
    const TABLE: [(State, Lane, &'static str); 25] = [
        (State::Preparing, Lane::Session, "preparing"),
        (State::Inserting, Lane::Session, "inserting"),
        (State::Holding, Lane::Session, "holding"),
        (State::HeldByOperator, Lane::Session, "held by operator"),
        (State::Stepping, Lane::Session, "stepping"),
        (State::HeldAfterStep, Lane::Session, "held after step"),
        (State::Homing, Lane::Session, "homing"),
        (State::Moving, Lane::Session, "moving"),
        (State::Silent, Lane::Session, "silent"),
        (State::TurningInAir, Lane::Session, "turning in air"),
        (State::Stopping, Lane::Session, "stopping"),
        (State::Completed, Lane::Session, "completed"),
        (State::Stopped, Lane::Session, "stopped"),
        (State::Enabled, Lane::Stage, "operation enabled"),
        (State::PowerOff, Lane::Stage, "stopped"),
        (State::AwaitingTip, Lane::Tracker, "waiting"),
        (State::Tracking, Lane::Tracker, "tracking"),
        (State::Coasting, Lane::Tracker, "coasting"),
        (State::Lost, Lane::Tracker, "lost"),
        (State::Disconnected, Lane::Tracker, "disconnected"),
        (State::NoEstimate, Lane::Observer, "waiting"),
        (State::RollUnknown, Lane::Observer, "roll not known yet"),
        (State::Estimating, Lane::Observer, "estimating"),
        (State::Steering, Lane::Control, "steering"),
        (State::Saturated, Lane::Control, "saturated"),
    ];

    /// The state of `lane` that has this name in `events.log`.
    pub fn named(lane: Lane, name: &str) -> Option<Self> {
        let mut states = State::TABLE.into_iter();
        states
            .find(|&(_, its_lane, its_name)| (its_lane, its_name) == (lane, name))
            .map(|(state, ..)| state)
    }

    /// True while the insertion is held, for whatever reason.
    pub const fn is_held(self) -> bool {
        matches!(self, State::Holding | State::HeldByOperator | State::HeldAfterStep)
    }

    /// The part of the bench that is in this state.
    pub const fn lane(self) -> Lane {
        State::TABLE[self as usize].1
    }

    /// The state's name, as `events.log` has it.
    pub const fn as_str(self) -> &'static str {
        State::TABLE[self as usize].2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_the_order_of_the_states() {
        for (n, (state, lane, name)) in State::TABLE.into_iter().enumerate() {
            assert_eq!(state as usize, n);
            assert_eq!(State::named(lane, name), Some(state));
        }
    }
}
