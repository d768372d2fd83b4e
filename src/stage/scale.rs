//! Converts mm or rad to the counts of a drive and back, without accumulating rounding errors.
//!
//! Targets are absolute: every conversion starts from the target itself, never from the counts
//! sent before, so a million increments round no worse than one.

use std::f64::consts::TAU;
use std::num::NonZeroU32;

use super::Axis;
use crate::keys::{Field, Kind, Rule, section, within};
use toml::Value;

/// Counts per mm (insertion) or per turn (rotation), as a ratio of integers.
///
/// Example: 2000 encoder counts a turn through a 5.9:1 gear on a 2.54 mm lead screw make 4645.669… counts per
/// mm. No decimal fraction is exact, but 11800/2.54 = 590000/127 is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CountsRatio {
    counts: NonZeroU32,
    per: NonZeroU32,
}

const COUNTS: Rule = within(1.0, u32::MAX as f64);

section! {
    /// The ratio as it is written.
    #[expect(unreachable_pub, reason = "a section is public")]
    pub struct CountsPer of AXIS {
        /// Number of counts.
        counts: u32 [COUNTS];
        /// Number of units that these counts make.
        per as (["mm", "turns"][AXIS]): u32 [COUNTS];
    }
}

impl Field for CountsRatio {
    const KIND: Kind = CountsPer::KIND;
    fn take(value: Option<&Value>) -> Self {
        let CountsPer { counts, per } = CountsPer::take(value);
        CountsRatio::new(counts, per).unwrap_or(const { CountsRatio::new(1, 1).unwrap() })
    }
}

impl CountsRatio {
    /// `counts` counts for every `per` mm or turns; `None` when either is zero.
    pub const fn new(counts: u32, per: u32) -> Option<Self> {
        match (NonZeroU32::new(counts), NonZeroU32::new(per)) {
            (Some(counts), Some(per)) => Some(CountsRatio { counts, per }),
            _ => None,
        }
    }

    /// Counts per mm or turn, rounded to `f64`.
    pub fn to_f64(self) -> f64 {
        f64::from(self.counts.get()) / f64::from(self.per.get())
    }

    /// The count nearest to `value` mm or turns, halves away from zero; `None` when `value` is
    /// not finite or the count does not fit.
    ///
    /// Exact: `value` is an integer times a power of two, so the product with the ratio is formed
    /// and rounded in 128-bit integers.
    pub fn nearest_count(self, value: f64) -> Option<i64> {
        if !value.is_finite() {
            return None;
        }
        let (mantissa, exponent) = decompose(value.abs());
        let mut numerator = u128::from(mantissa) * u128::from(self.counts.get()); // under 2^85
        let mut denominator = u128::from(self.per.get());
        match exponent {
            ..-94 => return Some(0), // under 2^85 / 2^95 counts
            -94..0 => denominator <<= exponent.unsigned_abs(),
            0..=40 => numerator <<= exponent.unsigned_abs(),
            41.. => return None, // over 2^93 mm or turns
        }
        let magnitude = i64::try_from((numerator + denominator / 2) / denominator).ok()?;
        Some(if value < 0.0 { -magnitude } else { magnitude })
    }

    /// `counts` in mm or turns.
    pub fn value_of(self, counts: i64) -> f64 {
        let scaled = i128::from(counts) * i128::from(self.per.get());
        scaled as f64 / f64::from(self.counts.get())
    }
}

/// A finite `value ≥ 0` as (m, e) with value = m·2^e exactly, m < 2^53 (IEEE 754).
fn decompose(value: f64) -> (u64, i32) {
    let bits = value.to_bits();
    let fraction = bits & ((1 << 52) - 1);
    match (bits >> 52) as i32 {
        0 => (fraction, -1074),
        biased => (fraction | 1 << 52, biased - 1075),
    }
}

/// Which way counts grow when the axis moves in its positive direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Sign {
    /// With the axis.
    #[default]
    Positive,
    /// Against the axis.
    Negative,
}

impl Field for Sign {
    const KIND: Kind = i8::KIND;
    fn take(value: Option<&Value>) -> Self {
        if i8::take(value) < 0 { Sign::Negative } else { Sign::Positive }
    }
}

impl Sign {
    const fn apply(self, counts: i64) -> Option<i64> {
        match self {
            Sign::Positive => Some(counts),
            Sign::Negative => counts.checked_neg(),
        }
    }
}

/// The scale of one axis: counts = zero + sign · ratio · value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Scale {
    axis: Axis,
    ratio: CountsRatio,
    sign: Sign,
    zero_counts: i64,
}

impl Scale {
    /// The scale of `axis` whose value is zero at `zero_counts`.
    pub const fn new(axis: Axis, ratio: CountsRatio, sign: Sign, zero_counts: i64) -> Self {
        Scale { axis, ratio, sign, zero_counts }
    }

    /// The count nearest to `value`, in mm or rad; `None` when it is not finite or does not fit.
    pub fn counts(&self, value: f64) -> Option<i64> {
        let value = match self.axis {
            Axis::Insertion => value,
            Axis::Rotation => value / TAU,
        };
        let relative = self.sign.apply(self.ratio.nearest_count(value)?)?;
        self.zero_counts.checked_add(relative)
    }

    /// `distance`, in mm or rad, in counts of the drive; `None` when it is not finite or does not fit 32 bits.
    pub fn relative_counts(&self, distance: f64) -> Option<i32> {
        let from_zero = self.counts(distance)?.checked_sub(self.zero_counts)?;
        i32::try_from(from_zero).ok()
    }

    /// `counts` in mm or rad.
    pub fn value(&self, counts: i64) -> f64 {
        let relative = counts.saturating_sub(self.zero_counts);
        let value = self.ratio.value_of(self.sign.apply(relative).unwrap_or(i64::MAX));
        match self.axis {
            Axis::Insertion => value,
            Axis::Rotation => value * TAU,
        }
    }

    /// Counts per mm or rad, rounded to `f64`.
    pub fn counts_per_unit(&self) -> f64 {
        match self.axis {
            Axis::Insertion => self.ratio.to_f64(),
            Axis::Rotation => self.ratio.to_f64() / TAU,
        }
    }
}

/// Extends the 32-bit position of a drive (0x6064) to 64 bits, past its wrap-around.
///
/// Assumes that the axis moves less than half the range, 2³¹ counts, between two readings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unwrapper {
    counts: i64,
}

impl Unwrapper {
    /// Starts at the first reading.
    pub const fn new(first: i32) -> Self {
        Unwrapper { counts: first as i64 }
    }

    /// Takes the next reading and returns the extended position.
    pub const fn unwrap(&mut self, reading: i32) -> i64 {
        // The low 32 bits of the position are the last reading.
        let moved = reading.wrapping_sub(self.counts as i32);
        self.counts = self.counts.saturating_add(moved as i64);
        self.counts
    }

    /// The newest position.
    pub const fn counts(&self) -> i64 {
        self.counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ratio(counts: u32, per: u32) -> CountsRatio {
        CountsRatio::new(counts, per).expect("not zero")
    }

    #[test]
    fn a_ratio_that_is_no_whole_number_is_rounded_to_the_nearest_count() {
        let screw = ratio(590_000, 127);
        assert_eq!(screw.nearest_count(127.0), Some(590_000));
        assert_eq!(screw.nearest_count(-1.0), Some(-4646)); // 4645.669
        assert_eq!(screw.value_of(590_000), 127.0);
    }

    #[test]
    fn halves_round_away_from_zero_and_an_overflow_is_none() {
        let unit = ratio(1, 1);
        assert_eq!(unit.nearest_count(0.5), Some(1));
        assert_eq!(unit.nearest_count(-2.5), Some(-3));
        assert_eq!(unit.nearest_count(0.499_999_999_999_999_94), Some(0));
        assert_eq!(unit.nearest_count(f64::MIN_POSITIVE / 3.0), Some(0));
        assert_eq!(ratio(u32::MAX, 1).nearest_count(f64::MAX), None);
        assert_eq!(ratio(1, u32::MAX).nearest_count(1e40), None);
        assert_eq!(unit.nearest_count(f64::NAN), None);
        assert_eq!(unit.nearest_count(f64::INFINITY), None);
    }

    #[test]
    fn whole_turns_convert_exactly_in_both_directions() {
        let scale = Scale::new(Axis::Rotation, ratio(75_760, 1), Sign::Negative, 100);
        assert_eq!(scale.counts(TAU), Some(100 - 75_760));
        assert_eq!(scale.counts(-10.0 * TAU), Some(100 + 757_600));
        assert_eq!(scale.value(100 + 37_880), -TAU / 2.0);
    }

    #[test]
    fn a_million_set_points_do_not_drift() {
        let scale = Scale::new(Axis::Insertion, ratio(590_000, 127), Sign::Positive, 0);
        for step in 1..=1_000_000_i64 {
            let counts = scale.counts(step as f64 / 1000.0).expect("fits");
            // A step is exactly 590/127 counts, so the set-point is within half a count.
            assert!((2 * 127 * counts - 2 * 590 * step).abs() <= 127, "at {step}");
        }
    }

    #[test]
    fn a_position_is_unwrapped_past_32_bits_and_back() {
        let mut position = Unwrapper::new(i32::MAX - 1);
        assert_eq!(position.unwrap(i32::MIN), i64::from(i32::MAX) + 1);
        assert_eq!(position.unwrap(-1_000_000_000), (1_i64 << 32) - 1_000_000_000);
        assert_eq!(position.unwrap(5), 1 << 32 | 5);
        assert_eq!(position.unwrap(-1_000_000_000), (1 << 32) - 1_000_000_000);
        assert_eq!(position.unwrap(i32::MAX), i64::from(i32::MAX));
    }

    proptest! {
        #[test]
        fn counts_survive_the_round_trip(
            counts in -(1_i64 << 40)..(1 << 40),
            zero in any::<i32>(),
            num in 1..100_000_u32,
            den in 1..1000_u32,
            rotation: bool,
            negative: bool,
        ) {
            let axis = if rotation { Axis::Rotation } else { Axis::Insertion };
            let sign = if negative { Sign::Negative } else { Sign::Positive };
            let scale = Scale::new(axis, ratio(num, den), sign, i64::from(zero));
            prop_assert_eq!(scale.counts(scale.value(counts)), Some(counts));
        }

        #[test]
        fn values_survive_to_half_a_count(
            value in -1e4..1e4_f64,
            num in 1..100_000_u32,
            den in 1..1000_u32,
            rotation: bool,
        ) {
            let axis = if rotation { Axis::Rotation } else { Axis::Insertion };
            let scale = Scale::new(axis, ratio(num, den), Sign::Negative, 7);
            let back = scale.value(scale.counts(value).expect("fits"));
            let error_counts = (back - value).abs() * scale.counts_per_unit();
            prop_assert!(error_counts <= 0.5 + 1e-5, "{error_counts}");
        }

        #[test]
        fn unwrapping_follows_any_path(steps in proptest::collection::vec(any::<i32>(), 1..50)) {
            let mut true_counts = 0_i64;
            let mut position = Unwrapper::new(0);
            for step in steps {
                true_counts += i64::from(step / 2);
                prop_assert_eq!(position.unwrap(true_counts as i32), true_counts);
            }
        }
    }
}
