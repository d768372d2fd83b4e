//! The time since a thread's last sign of life, without the watcher's own stalls.

use std::time::{Duration, Instant};

/// At most this much of the time between two looks counts: a busy machine or a debugger may have
/// suspended the watcher itself.
pub(super) const LOOK_MAX: Duration = Duration::from_millis(50);

/// How long a thread, which counts its signs of life, has shown none.
#[derive(Debug)]
pub(super) struct Silence {
    beats: u64,
    looked: Instant,
    lasted: Duration,
}

impl Silence {
    /// For a thread that has shown `beats` signs of life by `now`.
    pub(super) fn new(beats: u64, now: Instant) -> Self {
        Silence { beats, looked: now, lasted: Duration::ZERO }
    }

    /// A look at `now` at a thread that has shown `beats` signs of life. If any is new, returns how long
    /// the thread had been silent.
    pub(super) fn look(&mut self, beats: u64, now: Instant) -> Option<Duration> {
        let since = now.saturating_duration_since(std::mem::replace(&mut self.looked, now));
        if std::mem::replace(&mut self.beats, beats) != beats {
            return Some(std::mem::take(&mut self.lasted));
        }
        self.lasted += since.min(LOOK_MAX);
        None
    }

    /// How long it has been silent.
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
        // The watcher was suspended for ten seconds.
        assert_eq!(silence.look(7, begin + ms(10_030)), None);
        assert_eq!(silence.lasted(), ms(80));
        assert_eq!(silence.look(8, begin + ms(10_040)), Some(ms(80)));
        assert_eq!(silence.lasted(), ms(0));
    }
}
