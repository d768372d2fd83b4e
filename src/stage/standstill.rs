//! Standstill: a speed below a limit, over a time in which the counts of the axis can show it.

use std::time::Duration;

/// An axis slower than this stands, mm/s or rad/s: a slower motion is a hunting servo or encoder noise.
const SPEED_MAX: f64 = 0.04;
/// The axis is watched for at least this time, and for at least this number of positions.
const WINDOW_MIN: Duration = Duration::from_millis(50);
const POSITIONS_MIN: u32 = 5;
/// The axis is watched at least for the time in which it would move by this many counts at `SPEED_MAX`.
const COUNTS_MIN: f64 = 2.0;

/// Watches the positions of one axis for standstill.
#[derive(Debug, Clone, Copy)]
pub(super) struct Standstill {
    window: Duration,
    /// How far the axis may be from `anchor_counts`: its travel in `window` at `SPEED_MAX`.
    band_counts: f64,
    /// The position from which on the axis has stood; the number of positions since then, and the time.
    anchor_counts: i64,
    positions: u32,
    stood: Duration,
    /// How much longer the axis must still brake by its commanded speed. Positions that do not change until then are
    /// frozen, and do not show a standstill.
    braking: Duration,
}

impl Standstill {
    /// Watches an axis with this many counts per mm or rad.
    pub(super) fn new(counts_per_unit: f64) -> Self {
        let counts_per_s = SPEED_MAX * counts_per_unit;
        let resolvable = Duration::try_from_secs_f64(COUNTS_MIN / counts_per_s);
        let window = WINDOW_MIN.max(resolvable.unwrap_or(Duration::MAX));
        let band_counts = counts_per_s * window.as_secs_f64();
        let (stood, braking) = (Duration::ZERO, Duration::ZERO);
        Standstill { window, band_counts, anchor_counts: 0, positions: 0, stood, braking }
    }

    /// How long the axis must be watched at least, if its position comes once a `period`.
    pub(super) fn window(&self, period: Duration) -> Duration {
        self.window.max(period.saturating_mul(POSITIONS_MIN))
    }

    /// Begins to watch, from this position on.
    pub(super) fn watch_from(&mut self, counts: i64) {
        self.anchor_counts = counts;
        self.positions = 0;
        self.stood = Duration::ZERO;
    }

    /// Begins to watch, from this position on, an axis that brakes for this long.
    pub(super) fn watch_braking(&mut self, counts: i64, braking: Duration) {
        self.watch_from(counts);
        self.braking = braking;
    }

    /// Takes the next position, `elapsed` after the one before.
    pub(super) fn take(&mut self, counts: i64, elapsed: Duration) {
        self.braking = self.braking.saturating_sub(elapsed);
        if counts.abs_diff(self.anchor_counts) as f64 > self.band_counts {
            return self.watch_from(counts);
        }
        self.positions = self.positions.saturating_add(1);
        self.stood = self.stood.saturating_add(elapsed);
    }

    pub(super) fn stands(&self) -> bool {
        self.positions >= POSITIONS_MIN && self.stood >= self.window && self.braking.is_zero()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Time in ms after which an axis at `mm_per_s`, with a position every `period_ms`, counts as standing; `None`
    /// if it does not within 3 s.
    fn stands_after_ms(counts_per_mm: f64, mm_per_s: f64, period_ms: u64) -> Option<u64> {
        let mut standstill = Standstill::new(counts_per_mm);
        standstill.watch_from(0);
        (1..=3000 / period_ms).map(|n| n * period_ms).find(|ms| {
            let counts = counts_per_mm * mm_per_s * *ms as f64 / 1e3;
            standstill.take(counts as i64, Duration::from_millis(period_ms));
            standstill.stands()
        })
    }

    #[test]
    fn standing_is_a_speed_whatever_the_scale() {
        for (counts_per_mm, window_ms) in [(4646.0, 50), (1e6, 50), (100.0, 500), (25.0, 2000)] {
            for period_ms in [1, 10] {
                let after_ms = |mm_per_s| stands_after_ms(counts_per_mm, mm_per_s, period_ms);
                assert_eq!(after_ms(0.0), Some(window_ms), "{counts_per_mm}");
                assert_eq!(after_ms(0.03), Some(window_ms), "{counts_per_mm}");
                for mm_per_s in [0.08, 0.5, 4.9] {
                    assert_eq!(after_ms(mm_per_s), None, "{counts_per_mm} {mm_per_s}");
                }
            }
            assert_eq!(stands_after_ms(counts_per_mm, 0.0, 20), Some(window_ms.max(100)));
        }
    }

    #[test]
    fn a_position_that_is_frozen_while_the_axis_brakes_is_no_standstill() {
        let mut standstill = Standstill::new(4646.0);
        standstill.watch_braking(0, Duration::from_millis(420));
        let stands = |ms: u64| {
            standstill.take(0, Duration::from_millis(10));
            standstill.stands().then_some(ms)
        };
        assert_eq!((1..=100).map(|n| 10 * n).find_map(stands), Some(420));
    }
}
