//! The drive's switches and safety input.

/// An end of the axis's travel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    /// Towards smaller counts.
    Negative,
    /// Towards larger counts.
    Positive,
}

/// Positions of the switches in encoder counts; `None` for a switch that does not exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Switches {
    /// The negative limit switch closes at and below this position: bit 0 of 0x60FD.
    pub negative_counts: Option<i64>,
    /// The positive limit switch closes at and above this position: bit 1 of 0x60FD.
    pub positive_counts: Option<i64>,
    /// The home switch closes at and above this position: bit 2 of 0x60FD.
    pub home_counts: Option<i64>,
}

/// The state of the inputs.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Inputs {
    pub(super) switches: Switches,
    /// The limit switches that are stuck closed, by [`End`].
    pub(super) stuck: [bool; 2],
    /// True while the safety input is open and removes the torque: bit 3 of 0x60FD.
    pub(super) interlocked: bool,
}

impl Inputs {
    /// True while the limit switch of this end is closed.
    pub(super) fn is_closed(&self, end: End, counts: i64) -> bool {
        let at_switch = match end {
            End::Negative => self.switches.negative_counts.is_some_and(|at| counts <= at),
            End::Positive => self.switches.positive_counts.is_some_and(|at| counts >= at),
        };
        at_switch || self.stuck[end as usize]
    }

    /// Object 0x60FD.
    pub(super) fn bits(&self, counts: i64) -> i64 {
        let home = self.switches.home_counts.is_some_and(|at| counts >= at);
        i64::from(self.is_closed(End::Negative, counts))
            | i64::from(self.is_closed(End::Positive, counts)) << 1
            | i64::from(home) << 2
            | i64::from(self.interlocked) << 3
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A broken wire opens both normally closed switches.
    #[test]
    fn both_limit_switches_may_be_stuck() {
        let inputs = Inputs { stuck: [true; 2], ..Inputs::default() };
        assert_eq!(inputs.bits(0), 0b11);
    }
}
