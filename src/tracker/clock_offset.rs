//! The offset of the sender's clock from ours.

use crate::units::Time;
use std::time::Duration;

/// The minimum is kept over this window and the one before.
const WINDOW: Duration = Duration::from_secs(30);
/// A stamp that leads the quickest delivery so far by more than this is not taken for a quicker
/// one.
const AHEAD_MAX_NS: i64 = 50_000_000;
/// An offset is learnt from at least so many samples …
const SETTLING_SAMPLES: u32 = 3;
/// … over at least this time …
const SETTLING_TIME: Duration = Duration::from_millis(200);
/// … none of which was delivered quicker than the others by more than this …
const SETTLING_FALL_NS: i64 = 20_000_000;
/// … or slower by more than this.
const SETTLING_RISE_NS: i64 = 1_000_000_000;

/// Follows `receive − source`, the minimum of the last 30 to 60 s: the quickest delivery tells the
/// offset best, and a clock that drifts is followed.
///
/// - A connection's first samples are not believed: they may have waited in a queue, and would
///   look fresh for want of any to compare them with. The offset counts once it has stopped
///   falling.
/// - One stamp ahead would be the minimum for a minute. It is put aside; should those after it
///   agree with it, the sender's clock was set, and the offset is learnt anew.
#[derive(Debug, Clone, Default)]
pub(super) struct ClockOffset {
    known: Option<Minimum>,
    candidate: Settling,
}

/// Why there is no offset for a stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OffsetError {
    /// It is still being learnt.
    Unsettled {
        /// Samples it is being learnt from.
        samples: u32,
    },
    /// The stamp leads the clock so far.
    Ahead {
        /// By how much, ns.
        by_ns: i64,
    },
}

impl ClockOffset {
    /// What to add to `source_ns` to bring it to our time line: at most `receive − source`.
    ///
    /// # Errors
    /// [`OffsetError`]; the stamp is not to be used.
    pub(super) fn update(&mut self, receive: Time, source_ns: i64) -> Result<i64, OffsetError> {
        let offset_ns = receive.as_nanos().saturating_sub(source_ns);
        let by_ns = self.known.as_ref().map(|known| known.ns().saturating_sub(offset_ns));
        if let (Some(known), Some(..=AHEAD_MAX_NS)) = (&mut self.known, by_ns) {
            self.candidate = Settling::default();
            return Ok(known.update(receive, offset_ns));
        }
        match self.candidate.take(receive, source_ns, offset_ns) {
            Ok(settled) => {
                self.candidate = Settling::default();
                Ok(self.known.insert(settled).ns())
            }
            Err(samples) => Err(match by_ns {
                Some(by_ns) => OffsetError::Ahead { by_ns },
                None => OffsetError::Unsettled { samples },
            }),
        }
    }
}

/// The minimum over a window and the one before.
#[derive(Debug, Clone)]
struct Minimum {
    window_start: Time,
    current_ns: i64,
    previous_ns: Option<i64>,
}

impl Minimum {
    fn ns(&self) -> i64 {
        self.previous_ns.map_or(self.current_ns, |ns| ns.min(self.current_ns))
    }

    fn update(&mut self, receive: Time, offset_ns: i64) -> i64 {
        if receive.since(self.window_start) >= WINDOW {
            self.window_start = receive;
            self.previous_ns = Some(self.current_ns);
            self.current_ns = offset_ns;
        }
        self.current_ns = self.current_ns.min(offset_ns);
        self.ns()
    }
}

/// An offset that is being learnt.
#[derive(Debug, Clone, Default)]
struct Settling {
    since: Option<Time>,
    samples: u32,
    least_ns: i64,
    last_source_ns: i64,
}

impl Settling {
    /// The offset once it has settled, before that the samples it is being learnt from.
    fn take(&mut self, receive: Time, source_ns: i64, offset_ns: i64) -> Result<Minimum, u32> {
        let rise_ns = offset_ns.saturating_sub(self.least_ns);
        let since = match self.since {
            // Sent before: it says nothing of the clock.
            Some(_) if source_ns == self.last_source_ns => return Err(self.samples),
            Some(since)
                if source_ns > self.last_source_ns
                    && (-SETTLING_FALL_NS..=SETTLING_RISE_NS).contains(&rise_ns) =>
            {
                self.samples += 1;
                self.least_ns = self.least_ns.min(offset_ns);
                since
            }
            _ => {
                (self.samples, self.least_ns) = (1, offset_ns);
                *self.since.insert(receive)
            }
        };
        self.last_source_ns = source_ns;
        if self.samples < SETTLING_SAMPLES || receive.since(since) < SETTLING_TIME {
            return Err(self.samples);
        }
        let current_ns = self.least_ns;
        Ok(Minimum { window_start: since, current_ns, previous_ns: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn update(
        offset: &mut ClockOffset,
        receive_ms: i64,
        source_ms: i64,
    ) -> Result<i64, OffsetError> {
        let offset_ns = offset.update(Time::from_nanos(receive_ms * MS), source_ms * MS)?;
        Ok(offset_ns / MS)
    }

    /// Samples every 25 ms, delivered at once, of a sender whose clock is ahead by `ahead_ms`.
    fn listen(
        offset: &mut ClockOffset,
        from_ms: i64,
        ahead_ms: i64,
    ) -> Vec<Result<i64, OffsetError>> {
        let times = (0..12).map(|n| from_ms + 25 * n);
        times.map(|ms| update(offset, ms, ms + ahead_ms)).collect()
    }

    #[test]
    fn an_offset_is_known_after_a_while() {
        let mut offset = ClockOffset::default();
        let learnt = listen(&mut offset, 0, 500);
        assert!(learnt[..8].iter().all(|o| matches!(o, Err(OffsetError::Unsettled { .. }))));
        assert_eq!(learnt[8..], [Ok(-500); 4], "200 ms later");
    }

    /// A server that kept two seconds of measurements and sends them all when it is called.
    #[test]
    fn a_backlog_is_not_taken_for_fresh() {
        let mut offset = ClockOffset::default();
        for n in 0..80 {
            let dated = update(&mut offset, 0, -2000 + 25 * n);
            assert!(matches!(dated, Err(OffsetError::Unsettled { .. })), "{n}: {dated:?}");
        }
        assert_eq!(listen(&mut offset, 25, 0).last(), Some(&Ok(0)));
    }

    /// A server that sends its last pose when it is called, however old.
    #[test]
    fn a_stale_first_sample_is_not_taken_for_fresh() {
        let mut offset = ClockOffset::default();
        assert!(update(&mut offset, 0, -3000).is_err());
        let learnt = listen(&mut offset, 25, 0);
        assert_eq!(learnt.iter().find(|dated| dated.is_ok()), Some(&Ok(0)));
    }

    #[test]
    fn a_stamp_ahead_is_put_aside_also_while_learning() {
        let mut offset = ClockOffset::default();
        assert!(update(&mut offset, 0, 10_000).is_err());
        assert_eq!(listen(&mut offset, 25, 0).last(), Some(&Ok(0)));
        assert_eq!(
            update(&mut offset, 400, 10_400),
            Err(OffsetError::Ahead { by_ns: 10_000 * MS })
        );
        assert_eq!(update(&mut offset, 425, 425), Ok(0));
    }

    #[test]
    fn a_clock_that_was_set_ahead_is_followed_after_a_while() {
        let mut offset = ClockOffset::default();
        listen(&mut offset, 0, 0);
        let after = listen(&mut offset, 300, 10_000);
        assert!(after[..8].iter().all(|o| matches!(o, Err(OffsetError::Ahead { .. }))));
        assert_eq!(after[8..], [Ok(-10_000); 4]);
    }

    /// The same stamp over and over is no clock that was set.
    #[test]
    fn a_stamp_that_is_stuck_ahead_is_never_followed() {
        let mut offset = ClockOffset::default();
        listen(&mut offset, 0, 0);
        for n in 0..40 {
            assert!(update(&mut offset, 300 + 25 * n, 10_000).is_err());
        }
    }

    #[test]
    fn a_clock_that_runs_slow_is_followed() {
        // 1 ms in a second slow, for 10 minutes: with the first offset kept, 600 ms off.
        let mut offset = ClockOffset::default();
        let lag_ms = (0..600).filter_map(|s| {
            let offset_ms = update(&mut offset, s * 1000, s * 1000 - s).ok()?;
            Some(s - offset_ms)
        });
        assert_eq!(lag_ms.max(), Some(59));
    }
}
