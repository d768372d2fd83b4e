//! The depth from which a tip no longer travels as far as the needle is inserted, and its scale since.

use super::{BIN_MM, Sums};
use std::fmt;
use std::ops::RangeInclusive;

/// A range of scales to try, in tenths.
pub(super) type Tenths = RangeInclusive<u32>;
/// A frozen stream (0), and scales that are too small.
pub(super) const SLOWER: Tenths = 0..=9;
/// Scales that are too large.
pub(super) const FASTER: Tenths = 11..=20;
/// A stream is called frozen unless another scale fits better by this margin, in variances of the noise.
const FROZEN_MARGIN: f64 = 10.0;
/// A change is reported only if it fits better than none by this margin, in variances of the noise.
const CHANGE_MARGIN: f64 = 15.0;

/// A tip that travels as far as the needle is inserted up to a depth, and from there on by `scale` times
/// as far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::tracker) struct ScaleChange {
    /// Depth inserted since the change, mm.
    since_mm: f64,
    /// Travel of the tip per mm inserted since the change; 0 is frozen.
    scale: f64,
}

impl fmt::Display for ScaleChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.scale {
            0.0 => write!(f, "frozen for the last {:.1} mm", self.since_mm),
            scale => write!(f, "of scale {scale:.1} for the last {:.1} mm", self.since_mm),
        }
    }
}

impl ScaleChange {
    /// Whether the tip has not moved since the change.
    pub(super) fn is_frozen(&self) -> bool {
        self.scale == 0.0
    }

    /// The change to a scale of `tenths` that fits the positions of these bins best, newest bin first, with
    /// noise of this variance in each coordinate, mm²; `None` if a stream without a change fits as well.
    pub(super) fn fitted(
        bins: impl Iterator<Item = Sums>,
        tenths: Tenths,
        variance_mm2: f64,
    ) -> Option<Self> {
        // The sums over the positions after each depth at which the scale may have changed.
        let mut after = vec![Sums::default()];
        for bin in bins {
            let mut sums = after[after.len() - 1];
            sums += bin;
            after.push(sums);
        }
        let all = *after.last()?;
        let best = |tenths: Tenths| {
            let scales = tenths.map(|tenths| f64::from(tenths) / 10.0);
            let fits = scales.flat_map(|scale| {
                let after = after.iter().enumerate().filter(|(_, sums)| sums.count > 0.0);
                after.map(move |(bins, sums)| {
                    let since_mm = bins as f64 * BIN_MM;
                    (misfit_mm2(&all, sums, scale), ScaleChange { since_mm, scale })
                })
            });
            fits.min_by(|(a, _), (b, _)| a.total_cmp(b))
        };
        let (unchanged_mm2, _) = best(10..=10)?;
        let (scaled_mm2, scaled) = best(tenths)?;
        let frozen = best(0..=0).filter(|(frozen_mm2, _)| {
            scaled.scale < 1.0 && frozen_mm2 - scaled_mm2 <= FROZEN_MARGIN * variance_mm2
        });
        let (best_mm2, change) = frozen.unwrap_or((scaled_mm2, scaled));
        (unchanged_mm2 - best_mm2 > CHANGE_MARGIN * variance_mm2).then_some(change)
    }
}

/// The smallest sum of squared residuals, mm², of a tip that moves on a straight line, by 1 mm per mm of
/// depth before the change and by `scale` after it. `after` are the sums over the positions after the
/// change.
///
/// With the travel `m` the line is `a + u m`, `|u| = 1`. The best `a` and `u` leave
/// `S_pp + S_mm − 2 |S_mp|`, sums about the mean.
fn misfit_mm2(all: &Sums, after: &Sums, scale: f64) -> f64 {
    // The depth of the change: positions spread evenly begin √3 standard deviations before their mean.
    let mean_mm = after.depth_mm / after.count;
    let spread_mm2 = after.depth_mm2 / after.count - mean_mm * mean_mm;
    let change_mm = mean_mm - (3.0 * spread_mm2.max(0.0)).sqrt();
    // After the change at depth c, m = c (1 − s) + s ℓ. The sums over the travel:
    let at_change_mm = change_mm * (1.0 - scale);
    let travel_mm =
        all.depth_mm - after.depth_mm + at_change_mm * after.count + scale * after.depth_mm;
    let travel_mm2 = all.depth_mm2 - after.depth_mm2
        + at_change_mm * at_change_mm * after.count
        + 2.0 * at_change_mm * scale * after.depth_mm
        + scale * scale * after.depth_mm2;
    let product_mm2 = all.product_mm2 - after.product_mm2
        + at_change_mm * after.position_mm
        + scale * after.product_mm2;
    let n = all.count;
    let position_mm2 = all.square_mm2 - all.position_mm.norm_squared() / n;
    let travel_mm2 = travel_mm2 - travel_mm * travel_mm / n;
    let product_mm2 = product_mm2 - all.position_mm * (travel_mm / n);
    position_mm2 + travel_mm2 - 2.0 * product_mm2.norm()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// The change that fits a tip that moves by `travel(depth)` over 8 mm of depth, along a direction that is no axis.
    fn fitted(tenths: Tenths, travel: impl Fn(f64) -> f64) -> Option<ScaleChange> {
        let heading = Vector3::new(1.0, 2.0, 2.0) / 3.0;
        let bins = (0..32).rev().map(|bin| {
            let mut sum = Sums::default();
            for n in 0..5 {
                let depth_mm = 100.0 + BIN_MM * (f64::from(bin) + f64::from(n) / 5.0);
                sum += Sums::of(depth_mm, &(heading * travel(depth_mm - 100.0)), 1.0);
            }
            sum
        });
        ScaleChange::fitted(bins, tenths, 0.01)
    }

    #[test]
    fn a_change_is_found_with_its_scale_and_depth() {
        let change = |since_mm, scale| Some(ScaleChange { since_mm, scale });
        let after_5 = |scale: f64| move |mm: f64| mm.min(5.0) + scale * (mm - 5.0).max(0.0);
        assert_eq!(fitted(SLOWER, after_5(0.0)), change(3.0, 0.0));
        assert_eq!(fitted(SLOWER, after_5(0.5)), change(3.0, 0.5));
        assert_eq!(fitted(FASTER, after_5(1.5)), change(3.0, 1.5));
        assert_eq!(fitted(SLOWER, |_| 0.0), change(8.0, 0.0));
        assert_eq!(fitted(SLOWER, |mm| mm), None);
        assert_eq!(fitted(SLOWER, |mm| mm + 3.0 * f64::from(u8::from(mm > 5.0))), None, "a jump");
    }

    #[test]
    fn without_positions_no_change_is_found() {
        assert_eq!(ScaleChange::fitted([].into_iter(), SLOWER, 0.36), None);
        assert_eq!(ScaleChange::fitted([Sums::default()].into_iter(), SLOWER, 0.36), None);
    }

    #[test]
    fn a_change_is_reported_with_its_numbers() {
        let text = |scale| ScaleChange { since_mm: 3.04, scale }.to_string();
        assert_eq!(text(0.0), "frozen for the last 3.0 mm");
        assert_eq!(text(0.5), "of scale 0.5 for the last 3.0 mm");
    }
}
