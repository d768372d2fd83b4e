//! Checks that the tip travels as far as the needle is inserted.
//!
//! A needle's shaft does not stretch: whatever way it bends, its tip travels a millimetre for each
//! millimetre inserted. Over a stretch of depth the slope of the positions against the depth, a
//! vector, therefore has a length near 1, whatever the needle, the start and the turns of the base.
//! In a stream that is frozen but for noise the length is near 0, in one of wrong scale it is the scale,
//! and after a jump it is larger than 1.

mod change;

use super::refusal::{Effect, Refusal};
use crate::units::IN_METRES;
use change::{FASTER, SLOWER, ScaleChange, Tenths};
use derive_more::{AddAssign, Mul};
use nalgebra::Vector3;
use std::collections::VecDeque;

/// Positions are summed in bins of this depth, mm.
const BIN_MM: f64 = 0.25;
/// Lengths of the stretches that are checked, in bins: 3 to 64 mm.
const STRETCHES: [usize; 10] = [12, 16, 24, 32, 48, 64, 96, 128, 192, BINS_MAX];
const BINS_MAX: usize = 256;
/// A stretch with fewer positions is not checked.
const POSITIONS_MIN: f64 = 6.0;
/// A bin counts for at most this many times the usual number of positions. A bin in which the needle was held would
/// otherwise outweigh the others, and a stretch with it would not be checked.
const BIN_WEIGHT_MAX: f64 = 4.0;
/// At most this many positions per mm count as independent: real noise is correlated.
const INDEPENDENT_PER_MM: f64 = 10.0;
/// Standard deviations of the slope's length that are allowed for noise, besides the tolerance.
const NOISE_SDS: f64 = 5.5;
/// Positions count as metres if the tip travels by a share of the depth in this range, and the standard error of the
/// slope, from its own scatter, is at most [`METRES_SD`] times the slope.
const METRES: std::ops::Range<f64> = 0.0008..0.00125;
const METRES_SD: f64 = 0.2;
/// The explanation of a refusal looks at this many bins: 8 mm.
const EXPLAINED_BINS: usize = 32;
/// The tolerances of a slope that is too short and of one that is too long. 59 recorded insertions of a
/// real needle (docs/decisions/0013) stay within them over every stretch: 0.70 to 1.22 over 2.5 mm, 0.89
/// to 1.05 over 10 mm, 0.93 to 1.02 over 30 mm.
const SHORT: Tolerance = Tolerance { share: 0.06, length_mm: 0.75 };
const LONG: Tolerance = Tolerance { share: 0.03, length_mm: 0.5 };
/// The slope along an arc of angle φ is shorter than the arc by φ²/40 of it; a needle may be more curved than
/// configured by this factor.
const CURVATURE_MARGIN: f64 = 1.3;

/// A recorded insertion is checked in equal stretches of at least this depth, mm, each by itself.
const RECORDED_STRETCH_MM: f64 = 10.0;
/// A recorded insertion has at most this many stretches.
const RECORDED_STRETCHES_MAX: f64 = 100.0;
/// The range of the tip's travel over a recorded stretch, in mm per mm inserted, without noise. It is wide, since the
/// needle and the noise of a recording are not known: over 20 mm an arc with a radius of 10 mm has 0.9.
const RECORDED_TRAVEL: std::ops::Range<f64> = 0.5..1.5;

/// The deviation that is tolerated besides noise.
struct Tolerance {
    /// A share of the travel.
    share: f64,
    /// A length over the whole stretch, mm.
    length_mm: f64,
}

/// Follows the slope of the accepted positions over the depth.
#[derive(Debug, Clone)]
pub struct TravelCheck {
    noise_sd_mm: f64,
    curvature_per_mm: f64,
    /// The sums of each bin, the newest at the back.
    bins: VecDeque<Sums>,
    /// The depth of the newest bin, in bins.
    newest_bin: i64,
    error: Option<String>,
}

/// Sums over the positions of a bin or a stretch: `Σ 1, Σ ℓ, Σ ℓ², Σ p, Σ ℓ p, Σ pᵀp`, and how many independent
/// positions they are worth. Depth and position are counted from a common origin.
#[derive(Debug, Clone, Copy, Default, AddAssign, Mul)]
struct Sums {
    count: f64,
    depth_mm: f64,
    depth_mm2: f64,
    position_mm: Vector3<f64>,
    product_mm2: Vector3<f64>,
    square_mm2: f64,
    independent: f64,
}

impl Sums {
    /// The sums of one position.
    fn of(insertion_mm: f64, position_mm: &Vector3<f64>, independent: f64) -> Self {
        Sums {
            count: 1.0,
            depth_mm: insertion_mm,
            depth_mm2: insertion_mm * insertion_mm,
            position_mm: *position_mm,
            product_mm2: insertion_mm * position_mm,
            square_mm2: position_mm.norm_squared(),
            independent,
        }
    }

    fn depth_spread_mm2(&self) -> f64 {
        (self.depth_mm2 - self.depth_mm * self.depth_mm / self.count).max(0.0)
    }

    /// The slope of the positions over the depth.
    fn slope(&self) -> Vector3<f64> {
        (self.product_mm2 - self.position_mm * (self.depth_mm / self.count))
            / self.depth_spread_mm2()
    }

    /// The variance of each coordinate about the line of that slope, mm².
    fn scatter_mm2(&self) -> f64 {
        let position_mm2 = self.square_mm2 - self.position_mm.norm_squared() / self.count;
        let residual_mm2 = position_mm2 - self.slope().norm_squared() * self.depth_spread_mm2();
        residual_mm2.max(0.0) / (3.0 * (self.count - 2.0))
    }

    /// Whether the positions are in metres: the tip travels a thousandth of the depth, and its positions scatter as
    /// little. The configured noise does not apply to them, since it is in mm.
    fn is_in_metres(&self) -> bool {
        let travel = self.slope().norm();
        let sd = (self.scatter_mm2() / self.depth_spread_mm2()).sqrt();
        self.count >= POSITIONS_MIN && METRES.contains(&travel) && sd <= METRES_SD * travel
    }
}

impl TravelCheck {
    /// A check for a needle of this curvature. `noise_sd_mm` is the standard deviation of the noise of each
    /// coordinate; where the positions scatter more, their own scatter counts instead.
    pub fn new(noise_sd_mm: f64, curvature_per_mm: f64) -> Self {
        let (bins, newest_bin) = (VecDeque::new(), 0);
        TravelCheck { noise_sd_mm, curvature_per_mm, bins, newest_bin, error: None }
    }

    /// Takes an accepted position, mm, measured at this depth of the stage, mm. It carries as much information as
    /// `independent` positions with independent noise: at most 1, and less if the configured noise is correlated.
    pub fn take(&mut self, insertion_mm: f64, position_mm: &Vector3<f64>, independent: f64) {
        let bin = (insertion_mm / BIN_MM).floor() as i64;
        if self.bins.is_empty() || bin > self.newest_bin {
            self.check_stretches();
            // A bin without positions is kept, so that the place of a bin gives its depth.
            let added = if self.bins.is_empty() { 1 } else { bin - self.newest_bin };
            for _ in 0..added.min(BINS_MAX as i64) {
                self.bins.push_back(Sums::default());
                if self.bins.len() > BINS_MAX {
                    self.bins.pop_front();
                }
            }
            self.newest_bin = bin;
        }
        // If the encoder has stepped back, the position still belongs to the newest bin.
        if let Some(newest) = self.bins.back_mut() {
            *newest += Sums::of(insertion_mm, position_mm, independent);
        }
    }

    /// Checks that no stretch so far contradicts the insertion.
    ///
    /// # Errors
    /// The first stretch that does: the run must stop.
    pub fn check(&self) -> Result<(), String> {
        self.error.clone().map_or(Ok(()), Err)
    }

    /// The median number of positions in the bins that have any; 0 if there are none.
    fn median_count(&self) -> f64 {
        let counts = self.bins.iter().map(|bin| bin.count).filter(|count| *count > 0.0);
        let mut counts: Vec<f64> = counts.collect();
        counts.sort_by(f64::total_cmp);
        counts.get(counts.len() / 2).copied().unwrap_or_default()
    }

    /// Checks every stretch that ends with the newest bin, the shortest first.
    fn check_stretches(&mut self) {
        let mut sums = Sums::default();
        let error = (1..).zip(self.weighted_bins()).find_map(|(bins, bin)| {
            sums += bin;
            STRETCHES.contains(&bins).then(|| self.contradiction(&sums, bins))?
        });
        self.error = self.error.take().or(error);
    }

    /// The bins, the newest first, none with more weight than [`BIN_WEIGHT_MAX`] allows.
    fn weighted_bins(&self) -> impl Iterator<Item = Sums> {
        let count_max = BIN_WEIGHT_MAX * self.median_count();
        let limited = move |bin: &Sums| *bin * (count_max / bin.count).min(1.0);
        self.bins.iter().rev().map(move |bin| if bin.count > 0.0 { limited(bin) } else { *bin })
    }

    /// Adds the likely cause to a refusal that loses the track: a frozen stream or too small a scale if the
    /// travel shows it, otherwise a list.
    pub fn explain(&self, mut refusal: Refusal) -> Refusal {
        if refusal.effect == Effect::Loses {
            refusal.why += &match self.change_over(EXPLAINED_BINS, SLOWER) {
                _ if self.is_in_metres() => format!(": {IN_METRES}"),
                Some(change) => format!(": {change}"),
                None if refusal.is_behind => ": a jump, or too small a scale".to_owned(),
                None => ": a jump, a drift, or too large a scale".to_owned(),
            };
        }
        refusal
    }

    /// Whether the last positions are in metres.
    pub fn is_in_metres(&self) -> bool {
        let mut sums = Sums::default();
        self.weighted_bins().take(EXPLAINED_BINS).for_each(|bin| sums += bin);
        sums.is_in_metres()
    }

    /// Whether the last positions are those of a tip that does not move.
    pub fn is_frozen(&self) -> bool {
        let change = self.change_over(EXPLAINED_BINS, SLOWER);
        change.is_some_and(|change| change.is_frozen()) && !self.is_in_metres()
    }

    /// The change to a scale in this range that fits the last `bins` bins, if any does.
    fn change_over(&self, bins: usize, tenths: Tenths) -> Option<ScaleChange> {
        ScaleChange::fitted(self.weighted_bins().take(bins), tenths, self.noise_sd_mm.powi(2))
    }

    /// How the positions over the last `bins` bins, with these sums, contradict the insertion, if they do.
    fn contradiction(&self, sums: &Sums, bins: usize) -> Option<String> {
        let (n, stretch_mm) = (sums.count, bins as f64 * BIN_MM);
        if n < POSITIONS_MIN {
            return None;
        }
        let spread_mm2 = sums.depth_spread_mm2();
        // The length of an evenly filled stretch with the same spread.
        let filled_mm = (12.0 * spread_mm2 / n).sqrt().min(stretch_mm);
        if filled_mm < 0.75 * stretch_mm {
            return None;
        }
        let variance_mm2 = sums.scatter_mm2().max(self.noise_sd_mm.powi(2));
        let independent = sums.independent.max(1.0).min(INDEPENDENT_PER_MM * filled_mm);
        let sd = (variance_mm2 / (spread_mm2 * independent / n)).sqrt();
        let ratio = sums.slope().norm();
        let bend_rad = CURVATURE_MARGIN * self.curvature_per_mm * stretch_mm;
        let min = 1.0
            - SHORT.share
            - SHORT.length_mm / filled_mm
            - bend_rad * bend_rad / 40.0
            - NOISE_SDS * sd;
        // On average noise lengthens the slope: its two components across it add 2 sd² to the squared length.
        let max =
            (1.0 + 2.0 * sd * sd).sqrt() + LONG.share + LONG.length_mm / filled_mm + NOISE_SDS * sd;
        (ratio < min || ratio > max).then(|| {
            let what = if sums.is_in_metres() {
                IN_METRES.to_owned()
            } else {
                let change = self.change_over(bins, if ratio < min { SLOWER } else { FASTER });
                let what =
                    change.map_or("a jump, or a drift".to_owned(), |change| change.to_string());
                format!("{what}; check the tracker, counts_per_mm and needle.radius_mm")
            };
            format!(
                "over the last {stretch_mm:.1} mm the tip travelled {ratio:.3} mm per mm inserted \
                 (expected {min:.3} to {max:.3}): {what}"
            )
        })
    }
}

/// Checks that in no stretch of a recorded insertion the tip travels far less or far more than the needle is inserted.
/// `rows` are depths, mm, and positions, mm. Stretches with few positions are not checked.
///
/// # Errors
/// The first stretch that contradicts the insertion.
pub fn check_recorded(rows: &[(f64, Vector3<f64>)]) -> Result<(), String> {
    let Some((first_mm, origin_mm)) = rows.first() else { return Ok(()) };
    let depth_mm = rows.iter().fold(0.0f64, |deepest, (mm, _)| deepest.max(mm - first_mm));
    let stretches = (depth_mm / RECORDED_STRETCH_MM).floor().clamp(1.0, RECORDED_STRETCHES_MAX);
    let stretch_mm = depth_mm / stretches;
    for number in 0..stretches as u32 {
        let from_mm = first_mm + f64::from(number) * stretch_mm;
        let to_mm = from_mm + stretch_mm;
        let mut sums = Sums::default();
        for (mm, position_mm) in rows.iter().filter(|(mm, _)| (from_mm..=to_mm).contains(mm)) {
            sums += Sums::of(mm - first_mm, &(position_mm - origin_mm), 1.0);
        }
        let filled_mm = (12.0 * sums.depth_spread_mm2() / sums.count).sqrt();
        if sums.count < POSITIONS_MIN || filled_mm < 0.5 * RECORDED_STRETCH_MM {
            continue;
        }
        let allowed = NOISE_SDS * (sums.scatter_mm2() / sums.depth_spread_mm2()).sqrt();
        let (min, max) = (RECORDED_TRAVEL.start - allowed, RECORDED_TRAVEL.end + allowed);
        let travel = sums.slope().norm();
        let what = match travel {
            _ if sums.is_in_metres() => IN_METRES,
            _ if travel < min => "is the tracker's stream frozen, or are the positions not in mm?",
            _ if travel > max => "a jump, or positions that are not in mm",
            _ => continue,
        };
        return Err(format!(
            "from {from_mm:.1} to {to_mm:.1} mm the tip travelled {travel:.4} mm per mm inserted (expected \
             {min:.2} to {max:.2}): {what}"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    /// The depth, mm, at which the check contradicts a stream. The stream has a position each 0.05 mm of depth:
    /// `position(depth)`, with noise of ±`noise_mm`.
    fn contradicted_mm(noise_mm: f64, position: impl Fn(f64) -> Vector3<f64>) -> Option<f64> {
        contradicted_with_hold_mm(None, noise_mm, position)
    }

    /// The same if the needle is also held at that depth, over 2400 positions: a minute at 40 Hz.
    fn contradicted_with_hold_mm(
        held_mm: Option<f64>,
        noise_mm: f64,
        position: impl Fn(f64) -> Vector3<f64>,
    ) -> Option<f64> {
        let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
        // A Weyl sequence for each coordinate gives uniform noise.
        let noise = |k: u32, step: f64| 2.0 * (f64::from(k) * step).fract() - 1.0;
        let held = held_mm.map_or(0, |_| 2400);
        for k in 0..4000u32 + held {
            let held_from = held_mm.map_or(u32::MAX, |mm| (mm / 0.05) as u32);
            let moved = k - k.saturating_sub(held_from).min(held);
            let depth_mm = 0.05 * f64::from(moved);
            let steps = [0.618_034, 0.414_214, 0.732_051];
            let off_mm = Vector3::from(steps.map(|step| noise_mm * noise(k * 7919 % 65_537, step)));
            check.take(depth_mm, &(position(depth_mm) + off_mm), 1.0);
            if check.check().is_err() {
                return Some(depth_mm);
            }
        }
        None
    }

    #[test]
    fn a_frozen_scaled_or_drifting_stream_is_contradicted_in_time() {
        let z = Vector3::<f64>::z();
        let frozen = |depth_mm: f64| z * depth_mm.min(40.0);
        assert!(matches!(contradicted_mm(1.0, frozen), Some(40.0..=43.3)));
        let half = |depth_mm: f64| z * (0.5 * depth_mm);
        assert!(matches!(contradicted_mm(1.0, half), Some(..=8.0)));
        assert!(matches!(contradicted_mm(1.0, |depth_mm| z * (1.1 * depth_mm)), Some(..=30.0)));
        let drift =
            |depth_mm: f64| z * depth_mm + Vector3::x() * (0.5 * (depth_mm - 40.0).max(0.0));
        assert!(matches!(contradicted_mm(1.0, drift), Some(40.0..=60.0)));
    }

    #[test]
    fn a_long_hold_delays_no_contradiction() {
        let z = Vector3::<f64>::z();
        for held_mm in [0.0, 40.0, 46.0, 52.0] {
            for (scale, at_mm) in [(1.1, 60.0), (1.5, 45.0), (0.9, 85.0)] {
                let scaled =
                    |depth_mm: f64| z * (depth_mm + (scale - 1.0) * (depth_mm - 40.0).max(0.0));
                let found_mm = contradicted_with_hold_mm(Some(held_mm), 1.0, scaled);
                assert!(found_mm.is_some_and(|mm| mm < at_mm), "{held_mm} {scale} {found_mm:?}");
            }
            let straight = contradicted_with_hold_mm(Some(held_mm), 1.0, |depth_mm| z * depth_mm);
            assert_eq!(straight, None);
        }
    }

    #[test]
    fn positions_along_a_needles_arc_are_never_contradicted() {
        let arc = |radius_mm: f64| {
            move |depth_mm: f64| {
                let angle = depth_mm / radius_mm;
                Vector3::new(0.0, -radius_mm * (1.0 - angle.cos()), radius_mm * angle.sin())
            }
        };
        for noise_mm in [0.0, 0.1, 1.0, 3.0] {
            assert_eq!(contradicted_mm(noise_mm, arc(122.0)), None, "{noise_mm}");
            assert_eq!(contradicted_mm(noise_mm, arc(95.0)), None, "{noise_mm}");
        }
    }

    #[test]
    fn a_contradiction_is_reported_with_its_numbers() {
        let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
        (0..100).for_each(|k| check.take(0.05 * f64::from(k), &Vector3::zeros(), 1.0));
        let text = check.check().unwrap_err();
        assert!(
            text.contains(" mm the tip travelled 0.000 mm per mm inserted (expected 0."),
            "{text}"
        );
        assert!(text.len() < 200, "{}", text.len());
    }

    /// A frozen stream, with noise or to the bit, is not called one in metres.
    #[test]
    fn a_stream_in_metres_is_named() {
        let said = |scale: f64, noise_mm: f64| {
            let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
            for k in 0..100 {
                let noise_mm = noise_mm * (2.0 * (f64::from(k) * 0.618_034).fract() - 1.0);
                let along_mm = 0.05 * f64::from(k) * scale + noise_mm;
                let position_mm = Vector3::new(-500.0, 80.0, 300.0 + along_mm);
                check.take(0.05 * f64::from(k), &position_mm, 1.0);
            }
            let lost = Refusal { effect: Effect::Loses, ..Refusal::repeat(1) };
            [check.check().unwrap_err(), check.explain(lost).why]
        };
        for text in said(1e-3, 1e-3) {
            assert!(
                text.contains(": the positions look like metres; OpenIGTLink is in mm"),
                "{text}"
            );
            assert!(text.len() < 191, "{}", text.len());
        }
        for text in
            [(0.0, 0.0), (0.0, 1e-3), (0.0, 1.0), (1e-3, 1.0)].map(|(a, b)| said(a, b)).concat()
        {
            assert!(!text.contains("metres"), "{text}");
        }
    }

    /// Rows each 0.05 mm to a depth of 126 mm, with noise of ±`noise_mm`.
    fn recorded(noise_mm: f64, position: impl Fn(f64) -> Vector3<f64>) -> Vec<(f64, Vector3<f64>)> {
        let noise = |k: u32, step: f64| 2.0 * (f64::from(k) * step).fract() - 1.0;
        let row = |k: u32| {
            let depth_mm = 0.05 * f64::from(k);
            let steps = [0.618_034, 0.414_214, 0.732_051];
            let off_mm = steps.map(|step| noise_mm * noise(k * 7919 % 65_537, step));
            (depth_mm, position(depth_mm) + Vector3::from(off_mm))
        };
        (0..2520).map(row).collect()
    }

    /// A needle with a radius of 40 mm bends through half a circle.
    #[test]
    fn any_recorded_arc_is_accepted() {
        for radius_mm in [10.0, 40.0, 122.0] {
            for noise_mm in [0.0, 0.1, 1.0, 3.0] {
                let rows = recorded(noise_mm, |depth_mm| {
                    let angle: f64 = depth_mm / radius_mm;
                    radius_mm * Vector3::new(0.0, angle.cos() - 1.0, angle.sin())
                });
                assert_eq!(check_recorded(&rows), Ok(()), "{radius_mm} {noise_mm}");
                let sparse: Vec<_> = rows.iter().step_by(20).copied().collect();
                assert_eq!(check_recorded(&sparse), Ok(()), "{radius_mm} {noise_mm}");
            }
        }
        assert_eq!(check_recorded(&[]), Ok(()));
        assert_eq!(check_recorded(&[(0.0, Vector3::zeros()); 9]), Ok(()));
    }

    #[test]
    fn a_recording_in_metres_or_of_a_frozen_stream_is_refused() {
        let z = Vector3::<f64>::z();
        for noise_mm in [0.0, 1e-3] {
            let metres = recorded(noise_mm, |depth_mm| Vector3::x() + z * (1e-3 * depth_mm));
            let text = check_recorded(&metres).unwrap_err();
            assert!(text.starts_with("from 0.0 to 10.5 mm the tip travelled 0.001"), "{text}");
            assert!(text.ends_with(IN_METRES) && text.len() < 150, "{text}");
        }
        for noise_mm in [0.0, 0.1, 1.0, 3.0] {
            let frozen = recorded(noise_mm, |depth_mm| z * depth_mm.min(63.0));
            let text = check_recorded(&frozen).unwrap_err();
            assert!(text.contains("stream frozen") && text.len() < 170, "{text}");
        }
        let twice = recorded(1.0, |depth_mm| z * (2.0 * depth_mm));
        assert!(check_recorded(&twice).unwrap_err().ends_with("not in mm"));
    }

    /// Noise that changes slowly, 0.6 mm in 4 mm of depth and back, looks like travel.
    #[test]
    fn configured_correlated_noise_is_allowed_for() {
        let is_contradicted = |independent| {
            let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
            for k in 0..2000 {
                let depth_mm = 0.05 * f64::from(k);
                let off_mm = 0.9 * (depth_mm * TAU / 8.0).sin();
                check.take(depth_mm, &(Vector3::z() * (depth_mm + off_mm)), independent);
            }
            check.check().is_err()
        };
        assert_eq!([1.0, 1.0 / 40.0].map(is_contradicted), [true, false]);
    }

    proptest! {
        /// The depths may have gaps, go back, or all be equal.
        #[test]
        fn any_depths_are_taken_in_bounded_memory(depths in prop::collection::vec(-1e4..1e4f64, 0..200)) {
            let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
            for depth_mm in depths {
                check.take(depth_mm, &(Vector3::z() * depth_mm), 1.0);
            }
            prop_assert!(check.bins.len() <= BINS_MAX);
        }
    }
}
