//! When a sample was measured, on the session's time line.

use super::clock_offset::ClockOffset;
use super::refusal::{GateName, Refusal};
use super::sample::Sample;
use crate::keys::choice;
use crate::units::Time;
use std::time::Duration;

choice! {
    /// The stamp that dates a sample.
    pub enum StampPolicy {
        /// The time of receipt.
        Receive = "receive",
        /// The source's own stamp.
        Source = "source",
        /// The source's own stamp where there is one.
        Auto = "auto",
    }
}

/// Dates samples: `acquisition = stamp − latency`, with the sender's stamp converted to the session's
/// time line first.
///
/// The sender has its own clock. The quickest delivery gives its offset (`ClockOffset`), which includes the
/// time that this delivery took. The fixed latency must cover that time, and the tracker's own.
///
/// A stamp must also be later than the one before. Equal stamps are one measurement sent twice.
#[derive(Debug, Clone)]
pub struct AcquisitionClock {
    policy: StampPolicy,
    latency: Duration,
    offset: ClockOffset,
}

const NO_STAMP: &str =
    "the sender sends no stamps, but tracker.stamp is \"source\": set \"receive\" or \"auto\"";

impl AcquisitionClock {
    /// A clock with a fixed `latency` from measurement to stamp.
    pub fn new(policy: StampPolicy, latency: Duration) -> Self {
        AcquisitionClock { policy, latency, offset: ClockOffset::default() }
    }

    /// The fixed latency from measurement to stamp.
    pub fn latency(&self) -> Duration {
        self.latency
    }

    /// When the sample was measured; never later than its receipt.
    ///
    /// # Errors
    /// [`Refusal`] of a sample that cannot be dated; never with [`StampPolicy::Receive`].
    pub fn acquisition_time(&mut self, sample: &Sample) -> Result<Time, Refusal> {
        let stamp = match (self.policy, sample.source_unix_ns) {
            (StampPolicy::Receive, _) | (StampPolicy::Auto, None) => sample.receive_time,
            (StampPolicy::Source, None) => {
                return Err(Refusal::new(GateName::Stamp, NO_STAMP));
            }
            (StampPolicy::Auto | StampPolicy::Source, Some(unix_ns)) => {
                let offset_ns = self.offset.update(sample.receive_time, unix_ns)?;
                Time::from_nanos(unix_ns.saturating_add(offset_ns))
            }
        };
        Ok(stamp - self.latency)
    }

    /// Forgets offset and last stamp: a new connection may be another sender, with another clock.
    pub fn reconnected(&mut self) {
        self.offset = ClockOffset::default();
    }

    /// Takes the message to the operator about the sender's clock, if the last sample has caused one.
    pub fn news(&mut self) -> Option<String> {
        self.offset.news()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    const UNIX_NS: i64 = 1_700_000_000_000_000_000;
    const MS: i64 = 1_000_000;

    fn sample(receive_ms: i64, source_ms: Option<i64>) -> Sample {
        Sample {
            receive_time: Time::from_nanos(receive_ms * MS),
            source_unix_ns: source_ms.map(|ms| UNIX_NS + ms * MS),
            ..Sample::valid("Tip", Vector3::zeros())
        }
    }

    fn at_ms(
        clock: &mut AcquisitionClock,
        receive_ms: i64,
        source_ms: Option<i64>,
    ) -> Result<i64, String> {
        let dated = clock.acquisition_time(&sample(receive_ms, source_ms));
        dated.map(|time| time.as_nanos() / MS).map_err(|refusal| refusal.to_string())
    }

    const LEARNING: &str = "stamp: the sender's clock is still being learnt, from 1 samples so far";

    /// A clock at 1000 ms that has learnt that the sender's clock is 1000 ms ahead.
    fn settled(latency_ms: u64) -> AcquisitionClock {
        let mut clock = AcquisitionClock::new(StampPolicy::Auto, Duration::from_millis(latency_ms));
        let dated: Vec<_> =
            (0..11).map(|n| at_ms(&mut clock, n * 100, Some(1000 + n * 100))).collect();
        assert_eq!(dated[0], Err(LEARNING.to_owned()));
        assert_eq!(dated[10], Ok(1000 - latency_ms as i64));
        clock
    }

    #[test]
    fn jitter_of_delivery_does_not_change_the_acquisition_time() {
        // Measured every 25 ms, delivered 12, 3 and 40 ms later than the quickest so far.
        let mut clock = settled(20);
        assert_eq!(at_ms(&mut clock, 1037, Some(2025)), Ok(1005));
        assert_eq!(at_ms(&mut clock, 1053, Some(2050)), Ok(1030));
        assert_eq!(at_ms(&mut clock, 1115, Some(2075)), Ok(1055));
    }

    #[test]
    fn each_policy_uses_its_stamp() {
        let clock = |policy| AcquisitionClock::new(policy, Duration::from_millis(10));
        let mut receive = clock(StampPolicy::Receive);
        assert_eq!(at_ms(&mut receive, 100, Some(5)), Ok(90));
        assert_eq!(at_ms(&mut receive, 500, Some(1)), Ok(490));
        assert_eq!(at_ms(&mut clock(StampPolicy::Auto), 500, None), Ok(490));
        let error = at_ms(&mut clock(StampPolicy::Source), 1, None).unwrap_err();
        assert!(error.starts_with("stamp: the sender sends no stamps, "), "{error}");
    }

    #[test]
    fn a_stamp_must_be_later_than_the_one_before() {
        let mut clock = settled(0);
        let again = at_ms(&mut clock, 1010, Some(2000)).unwrap_err();
        assert_eq!(again, "duplicate: sent twice (stamp 1700000002000000000 ns)");
        let back = at_ms(&mut clock, 1010, Some(1990)).unwrap_err();
        assert_eq!(back, "stamp: went back by 0.010 s; was the sender's clock set?");
        assert_eq!(at_ms(&mut clock, 1010, Some(2001)), Ok(1001));
    }

    /// If it set the offset, every later sample would be dated 10 s too old.
    #[test]
    fn one_stamp_ahead_does_not_change_the_dating_of_later_samples() {
        let mut clock = settled(0);
        let ahead = at_ms(&mut clock, 1025, Some(12_025)).unwrap_err();
        let expected = "stamp: 10.000 s ahead of the sender's clock so far; was it set?";
        assert_eq!(ahead, expected);
        assert_eq!(at_ms(&mut clock, 1050, Some(2050)), Ok(1050));
    }

    #[test]
    fn a_new_connection_learns_the_offset_again() {
        let mut clock = settled(0);
        clock.reconnected();
        let first = at_ms(&mut clock, 2000, Some(-500));
        assert_eq!(first, Err(LEARNING.to_owned()));
    }

    proptest! {
        #[test]
        fn no_acquisition_time_is_after_the_receipt(
            policy in prop::sample::select(vec![StampPolicy::Auto, StampPolicy::Receive]),
            stamps in prop::collection::vec((any::<i64>(), prop_oneof![any::<i64>(), -9..9i64]), 1..50),
        ) {
            let mut clock = AcquisitionClock::new(policy, Duration::ZERO);
            for (receive_ns, source_ns) in stamps {
                let mut sample = sample(0, None);
                sample.receive_time = Time::from_nanos(receive_ns / 4);
                sample.source_unix_ns = Some(source_ns / 4);
                if let Ok(acquired) = clock.acquisition_time(&sample) {
                    prop_assert!(acquired <= sample.receive_time);
                }
            }
        }
    }
}
