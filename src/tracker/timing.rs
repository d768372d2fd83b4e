//! When a sample was measured, on the session's time line.

use super::sample::Sample;
use crate::units::Time;
use std::time::Duration;
use thiserror::Error;

/// Which stamp a sample is dated by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum StampPolicy {
    /// The sender's stamp where there is one, else the time of receipt.
    #[default]
    Auto,
    /// The sender's stamp; a sample without one is refused.
    Source,
    /// The time of receipt, whatever the sender says.
    Receive,
}

/// Dates samples: `acquisition = stamp − latency`, the sender's stamp brought to the session's
/// time line first.
///
/// The sender's clock is not ours. Their offset is taken from the quickest delivery, the minimum
/// of `receive − source`: of all samples in the last 30 to 60 s, so that a clock that drifts is
/// followed. What even the quickest delivery takes counts as offset; the fixed latency is for
/// that, and for the time the tracker itself needs.
#[derive(Debug, Clone)]
pub struct AcquisitionClock {
    policy: StampPolicy,
    latency: Duration,
    offset: MinimumOffset,
}

/// A sample that cannot be dated.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum TimingError {
    /// The sender stamps nothing.
    #[error(
        "tracker: \"{tool}\" comes without time stamps, and tracker.stamp is \"source\"; set it to \
         \"receive\" or \"auto\""
    )]
    NoStamp {
        /// The sample's tool.
        tool: String,
    },
}

impl AcquisitionClock {
    /// A clock with a fixed `latency` from measurement to stamp.
    pub fn new(policy: StampPolicy, latency: Duration) -> Self {
        AcquisitionClock { policy, latency, offset: MinimumOffset::default() }
    }

    /// When the sample was measured; never later than its receipt.
    ///
    /// # Errors
    /// `NoStamp` under [`StampPolicy::Source`] when the sample has none.
    pub fn acquisition_time(&mut self, sample: &Sample) -> Result<Time, TimingError> {
        let stamp = match (self.policy, sample.source_unix_ns) {
            (StampPolicy::Receive, _) | (StampPolicy::Auto, None) => sample.receive_time,
            (StampPolicy::Source, None) => {
                return Err(TimingError::NoStamp { tool: sample.tool.clone() });
            }
            (StampPolicy::Auto | StampPolicy::Source, Some(source_ns)) => {
                let offset_ns = self.offset.update(sample.receive_time, source_ns);
                Time::from_nanos(source_ns.saturating_add(offset_ns))
            }
        };
        Ok(stamp - self.latency)
    }

    /// Forgets the offset: a new connection may be another sender, with another clock.
    pub fn reconnected(&mut self) {
        self.offset = MinimumOffset::default();
    }
}

const WINDOW: Duration = Duration::from_secs(30);

/// The minimum of `receive − source` over this window and the one before.
#[derive(Debug, Clone, Default)]
struct MinimumOffset {
    window_start: Option<Time>,
    current_ns: Option<i64>,
    previous_ns: Option<i64>,
}

impl MinimumOffset {
    fn update(&mut self, receive: Time, source_ns: i64) -> i64 {
        let start = *self.window_start.get_or_insert(receive);
        if receive.since(start) >= WINDOW {
            self.window_start = Some(receive);
            self.previous_ns = self.current_ns.take();
        }
        let offset_ns = receive.as_nanos().saturating_sub(source_ns);
        let current_ns = self.current_ns.map_or(offset_ns, |ns| ns.min(offset_ns));
        self.current_ns = Some(current_ns);
        self.previous_ns.map_or(current_ns, |ns| ns.min(current_ns))
    }
}

#[cfg(test)]
mod tests {
    use super::super::sample::Validity;
    use super::*;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    const UNIX_NS: i64 = 1_700_000_000_000_000_000;
    const MS: i64 = 1_000_000;

    fn sample(receive_ms: i64, source_ms: Option<i64>) -> Sample {
        Sample {
            tool: "Tip".to_owned(),
            receive_time: Time::from_nanos(receive_ms * MS),
            source_unix_ns: source_ms.map(|ms| UNIX_NS + ms * MS),
            position_mm: Vector3::zeros(),
            orientation: None,
            validity: Validity::Valid,
        }
    }

    fn at_ms(clock: &mut AcquisitionClock, receive_ms: i64, source_ms: Option<i64>) -> i64 {
        let time = clock.acquisition_time(&sample(receive_ms, source_ms)).expect("dated");
        time.as_nanos() / MS
    }

    #[test]
    fn jitter_of_delivery_is_taken_out() {
        // Measured every 25 ms, delivered after 5, 12, 3, 40 ms; our origin is 1000 ms earlier.
        let mut clock = AcquisitionClock::new(StampPolicy::Auto, Duration::from_millis(20));
        assert_eq!(at_ms(&mut clock, 1005, Some(0)), 985);
        assert_eq!(at_ms(&mut clock, 1037, Some(25)), 1010);
        assert_eq!(at_ms(&mut clock, 1053, Some(50)), 1033);
        assert_eq!(at_ms(&mut clock, 1115, Some(75)), 1058);
    }

    #[test]
    fn each_policy_uses_its_stamp() {
        let clock = |policy| AcquisitionClock::new(policy, Duration::from_millis(10));
        let mut receive = clock(StampPolicy::Receive);
        assert_eq!(at_ms(&mut receive, 100, Some(0)), 90);
        assert_eq!(at_ms(&mut receive, 500, Some(1)), 490);
        assert_eq!(at_ms(&mut clock(StampPolicy::Auto), 500, None), 490);
        let error = clock(StampPolicy::Source).acquisition_time(&sample(1, None));
        assert_eq!(error, Err(TimingError::NoStamp { tool: "Tip".to_owned() }));
    }

    #[test]
    fn a_clock_that_runs_slow_is_followed() {
        // 1 ms in a second slow, for 10 minutes: with the first offset kept, 600 ms off.
        let mut clock = AcquisitionClock::new(StampPolicy::Source, Duration::ZERO);
        let lag_ms = (0..600)
            .map(|s| {
                let receive_ms = s * 1000;
                receive_ms - at_ms(&mut clock, receive_ms, Some(receive_ms - s))
            })
            .max();
        assert_eq!(lag_ms, Some(59));
    }

    #[test]
    fn a_new_connection_starts_anew() {
        let mut clock = AcquisitionClock::new(StampPolicy::Auto, Duration::ZERO);
        assert_eq!(at_ms(&mut clock, 1000, Some(0)), 1000);
        clock.reconnected();
        assert_eq!(at_ms(&mut clock, 2000, Some(-500)), 2000);
    }

    proptest! {
        #[test]
        fn nothing_is_measured_after_its_receipt(
            stamps in prop::collection::vec((any::<i64>(), any::<i64>()), 1..50),
        ) {
            let mut clock = AcquisitionClock::new(StampPolicy::Auto, Duration::ZERO);
            for (receive_ns, source_ns) in stamps {
                let mut sample = sample(0, None);
                sample.receive_time = Time::from_nanos(receive_ns / 4);
                sample.source_unix_ns = Some(source_ns / 4);
                let acquired = clock.acquisition_time(&sample).expect("stamped");
                prop_assert!(acquired <= sample.receive_time);
            }
        }
    }
}
