//! What the runtime drives.

use std::time::Duration;

use super::{Input, Outcome, Output, Progress, Session};
use crate::stage::Counters;
use crate::tracker::GateCounts;
use crate::units::Time;

/// So begins the reason of a run that the runtime stops because nothing was done for it for longer
/// than the drives bear. Frames that were made before and not sent are never sent.
pub const HELD_UP: &str = "bench: was held up for ";

/// A machine that commands the stage, sans-IO: a [`Session`], or an operation of the stage alone.
///
/// The whole contract: call [`handle`](Self::handle) with the time and one input, drain
/// [`poll`](Self::poll) to `None`, wait until [`deadline`](Self::deadline) or the next input,
/// repeat until [`outcome`](Self::outcome) says how it ended.
pub trait Machine {
    /// Takes one input at `now`.
    fn handle(&mut self, now: Time, input: Input);

    /// The next thing to leave the machine; `None` when it has nothing more to say for now.
    fn poll(&mut self) -> Option<Output>;

    /// When to call [`handle`](Self::handle) with [`Input::Tick`] if nothing comes before.
    fn deadline(&self) -> Time;

    /// How it ended; `None` while it goes on.
    fn outcome(&self) -> Option<&Outcome>;

    /// How far it is.
    fn progress(&self) -> Progress;

    /// What did not go as it should on the stage's bus, and did no harm.
    fn stage_counters(&self) -> Counters;

    /// How long the drives bear not to hear of the bench, whatever it is that holds it up; `None`
    /// before they are enabled and once they are being stopped.
    fn silence_max(&self) -> Option<Duration> {
        None
    }

    /// What the tracker's gates did with its samples; nothing where no needle is steered.
    fn gate_counts(&self) -> GateCounts {
        GateCounts::default()
    }
}

impl Machine for Session {
    fn handle(&mut self, now: Time, input: Input) {
        self.handle(now, input);
    }

    fn poll(&mut self) -> Option<Output> {
        self.poll()
    }

    fn deadline(&self) -> Time {
        self.deadline()
    }

    fn outcome(&self) -> Option<&Outcome> {
        self.outcome()
    }

    fn progress(&self) -> Progress {
        self.progress()
    }

    fn stage_counters(&self) -> Counters {
        self.stage_counters()
    }

    fn silence_max(&self) -> Option<Duration> {
        self.silence_max()
    }

    fn gate_counts(&self) -> GateCounts {
        self.gate_counts()
    }
}
