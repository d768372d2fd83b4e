//! The time stamp of an OpenIGTLink header.

/// A time stamp as sent: 32.32 fixed-point seconds since 1970-01-01 UTC.
///
/// Zero means "no stamp" and is not an `IgtlStamp` but `None` in a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct IgtlStamp(u64);

const NANOS_PER_S: u64 = 1_000_000_000;

impl IgtlStamp {
    /// The stamp of the raw 64 bits; none for zero.
    pub fn from_bits(bits: u64) -> Option<Self> {
        (bits != 0).then_some(IgtlStamp(bits))
    }

    /// The raw 64 bits: seconds in the upper half, 2⁻³² seconds in the lower.
    pub fn bits(self) -> u64 {
        self.0
    }

    /// The stamp nearest to `ns` nanoseconds since 1970; none at or before 1970 and past 2106.
    pub fn from_unix_ns(ns: i64) -> Option<Self> {
        let ns = u64::try_from(ns).ok()?;
        let seconds = u32::try_from(ns / NANOS_PER_S).ok()?;
        // Under a second, so the fraction stays under 2³².
        let fraction = (((ns % NANOS_PER_S) << 32) + NANOS_PER_S / 2) / NANOS_PER_S;
        Self::from_bits((u64::from(seconds) << 32) + fraction)
    }

    /// Nanoseconds since 1970, rounded. Inverts [`IgtlStamp::from_unix_ns`] exactly.
    pub fn unix_ns(self) -> i64 {
        let (seconds, fraction) = (self.0 >> 32, self.0 & 0xFFFF_FFFF);
        let ns = seconds * NANOS_PER_S + ((fraction * NANOS_PER_S + (1 << 31)) >> 32);
        // At most 2³² seconds: fits.
        i64::try_from(ns).unwrap_or(i64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn nanoseconds_survive(ns in 1..=i64::from(u32::MAX) * 1_000_000_000 + 999_999_999) {
            let stamp = IgtlStamp::from_unix_ns(ns).expect("in range");
            prop_assert_eq!(stamp.unix_ns(), ns);
        }

        #[test]
        fn any_bits_are_a_time_to_the_nearest_nanosecond(bits in 1..=u64::MAX) {
            let stamp = IgtlStamp::from_bits(bits).expect("not zero");
            let exact_ns = (u128::from(bits) * 1_000_000_000) as f64 / 2f64.powi(32);
            // A float holds such a time to 512 ns.
            prop_assert!((stamp.unix_ns() as f64 - exact_ns).abs() <= 512.0);
        }
    }

    #[test]
    fn half_a_second_is_half_the_range() {
        let stamp = IgtlStamp::from_unix_ns(1_500_000_000).expect("in range");
        assert_eq!(stamp.bits(), 0x0000_0001_8000_0000);
    }

    #[test]
    fn zero_and_times_outside_the_range_are_no_stamp() {
        assert_eq!(IgtlStamp::from_bits(0), None);
        assert_eq!(IgtlStamp::from_unix_ns(0), None);
        assert_eq!(IgtlStamp::from_unix_ns(-1), None);
        assert_eq!(IgtlStamp::from_unix_ns(i64::MAX), None);
    }
}
