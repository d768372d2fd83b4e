//! Homes the chosen axes, one after the other.

use crate::session::{AxisMove, Record, Shell, State, Task};
use crate::stage::{Axis, AxisLimits, PerAxis, StageEvent};
use std::collections::VecDeque;

/// Homes the chosen axes, the other held.
#[derive(Debug)]
pub(super) struct HomeAxes {
    /// The axes that are not homed yet, beginning with the one that is being homed.
    remaining: VecDeque<Axis>,
    moves: Vec<AxisMove>,
}

impl HomeAxes {
    pub(super) fn new(axes: PerAxis<bool>) -> Self {
        let remaining = Axis::BOTH.into_iter().filter(|axis| axes[*axis]).collect();
        HomeAxes { remaining, moves: Vec::new() }
    }

    fn home_next(&self, shell: &mut Shell) -> Result<(), String> {
        match self.remaining.front() {
            Some(axis) => shell.home(*axis),
            None => {
                shell.complete();
                Ok(())
            }
        }
    }

    /// Refuses a home outside the limits, from which the axis could not be moved.
    fn check_home(shell: &Shell, axis: Axis, position: f64) -> Result<(), String> {
        let config = shell.config().axis(axis);
        let scale = config.scale(axis, 0);
        if config.limits.check_counts(axis, position, &scale).is_ok() {
            return Ok(());
        }
        let AxisLimits { min, max, .. } = config.limits;
        let [position, min, max] = [position, min, max].map(|value| axis.shown(value));
        Err(format!(
            "{axis}: home is at {position}, out of its limits of {min} to {max}: nothing could be \
             moved from there; see zero, the limits and homing offset (0x607C) of the axis"
        ))
    }
}

impl Task for HomeAxes {
    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String> {
        match *event {
            StageEvent::Ready => {
                shell.enter(State::Homing);
                self.home_next(shell)
            }
            StageEvent::Homed { axis, position } => {
                self.moves.push(AxisMove { axis, from: None, to: position });
                Self::check_home(shell, axis, position)?;
                self.remaining.pop_front();
                self.home_next(shell)
            }
            StageEvent::Feedback(feedback) => {
                shell.record(Record::Stage(feedback));
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn moves(&self) -> &[AxisMove] {
        &self.moves
    }
}
