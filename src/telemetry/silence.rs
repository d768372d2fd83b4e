//! How long a thread has not been heard, as far as that proves something.

use std::time::{Duration, Instant};

/// No more than this counts as silence between two looks: where the one who looks was held up
/// himself, by a busy machine or a debugger, the other's silence proves nothing.
pub(super) const LOOK_MAX: Duration = Duration::from_millis(50);

/// The silence of a thread that counts its signs of life.
#[derive(Debug)]
pub(super) struct Silence {
    beats: u64,
    looked: Instant,
    lasted: Duration,
}

impl Silence {
    /// Of a thread that has been heard `beats` times at `now`.
    pub(super) fn new(beats: u64, now: Instant) -> Self {
        Silence { beats, looked: now, lasted: Duration::ZERO }
    }

    /// A look at `now` at a thread that has been heard `beats` times: where it was heard since the
    /// last look, for how long it had been silent.
    pub(super) fn look(&mut self, beats: u64, now: Instant) -> Option<Duration> {
        let since = now.saturating_duration_since(std::mem::replace(&mut self.looked, now));
        if std::mem::replace(&mut self.beats, beats) != beats {
            return Some(std::mem::take(&mut self.lasted));
        }
        self.lasted += since.min(LOOK_MAX);
        None
    }

    /// For how long it has been silent, as far as it was looked at.
    pub(super) fn lasted(&self) -> Duration {
        self.lasted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_lasts_while_it_is_looked_at() {
        let ms = Duration::from_millis;
        let begin = Instant::now();
        let mut silence = Silence::new(7, begin);
        assert_eq!(silence.look(7, begin + ms(30)), None);
        assert_eq!(silence.lasted(), ms(30));
        // Nobody looked for ten seconds.
        assert_eq!(silence.look(7, begin + ms(10_030)), None);
        assert_eq!(silence.lasted(), ms(80));
        assert_eq!(silence.look(8, begin + ms(10_040)), Some(ms(80)));
        assert_eq!(silence.lasted(), ms(0));
    }
}
