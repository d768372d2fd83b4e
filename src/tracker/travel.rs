//! Whether the tip travels as far as the needle is inserted.
//!
//! A needle's shaft does not stretch: whatever way it bends, its tip travels a millimetre for each
//! millimetre inserted. Over a stretch of depth the slope of the positions against the depth, a
//! vector, therefore has a length near 1, whatever the needle, the start and the turns of the base.
//! A stream that is frozen but for noise has 0, one of wrong scale its scale, one that jumped more.

mod change;

use super::refusal::{Effect, Refusal};
use change::{Change, FASTER, SLOWER, Tenths};
use nalgebra::Vector3;
use std::collections::VecDeque;

/// Positions are summed in bins of this depth, mm.
const BIN_MM: f64 = 0.25;
/// Bins in each stretch that is looked at: 3 to 64 mm.
const STRETCHES: [usize; 10] = [12, 16, 24, 32, 48, 64, 96, 128, 192, BINS_MAX];
const BINS_MAX: usize = 256;
/// Fewer positions than this in a stretch say nothing.
const POSITIONS_MIN: f64 = 6.0;
/// Positions count as independent only so many to a mm: real noise is correlated.
const INDEPENDENT_PER_MM: f64 = 10.0;
/// Standard deviations of the slope's length that are allowed for noise, besides the tolerance.
const NOISE_SDS: f64 = 5.5;
/// Bins over which positions that contradict the model are explained: 8 mm.
const EXPLAINED_BINS: usize = 32;
/// What is tolerated besides noise: a share of the way, and a length over the whole stretch, mm.
/// 59 recorded insertions of a real needle (docs/decisions/0013) stay inside with every stretch:
/// 0.70 to 1.22 over 2.5 mm, 0.89 to 1.05 over 10 mm, 0.93 to 1.02 over 30 mm.
const SHORT: (f64, f64) = (0.06, 0.75);
const LONG: (f64, f64) = (0.03, 0.5);
/// The slope along an arc of angle φ is shorter than the arc by φ²/40 of it; a needle may be more curved than
/// configured by this factor.
const CURVATURE_MARGIN: f64 = 1.3;

/// Follows the slope of the accepted positions over the depth.
#[derive(Debug, Clone)]
pub struct TravelCheck {
    noise_sd_mm: f64,
    curvature_per_mm: f64,
    bins: VecDeque<Bin>,
    /// Number of the bin at the back.
    number: i64,
    error: Option<String>,
}

/// Sums over the positions of a stretch: `Σ 1, Σ ℓ, Σ ℓ², Σ p, Σ ℓ p, Σ pᵀp`, depth and position
/// counted from a common origin.
#[derive(Debug, Clone, Copy, Default)]
struct Bin {
    count: f64,
    depth_mm: f64,
    depth_mm2: f64,
    position_mm: Vector3<f64>,
    product_mm2: Vector3<f64>,
    square_mm2: f64,
}

impl Bin {
    /// The sums of one position.
    fn of(insertion_mm: f64, position_mm: &Vector3<f64>) -> Self {
        Bin {
            count: 1.0,
            depth_mm: insertion_mm,
            depth_mm2: insertion_mm * insertion_mm,
            position_mm: *position_mm,
            product_mm2: insertion_mm * position_mm,
            square_mm2: position_mm.norm_squared(),
        }
    }

    fn add(&mut self, other: &Bin) {
        self.count += other.count;
        self.depth_mm += other.depth_mm;
        self.depth_mm2 += other.depth_mm2;
        self.position_mm += other.position_mm;
        self.product_mm2 += other.product_mm2;
        self.square_mm2 += other.square_mm2;
    }
}

impl TravelCheck {
    /// A check of the positions of a needle of this curvature, with this noise, mm, the standard
    /// deviation of each coordinate; more is allowed for where the positions themselves scatter more.
    pub fn new(noise_sd_mm: f64, curvature_per_mm: f64) -> Self {
        TravelCheck { noise_sd_mm, curvature_per_mm, bins: VecDeque::new(), number: 0, error: None }
    }

    /// Takes an accepted position, measured at this depth of the stage, mm.
    pub fn take(&mut self, insertion_mm: f64, position_mm: &Vector3<f64>) {
        let number = (insertion_mm / BIN_MM).floor() as i64;
        if self.bins.is_empty() || number > self.number {
            self.check_stretches();
            // Bins without a position are kept empty, so that places tell depths.
            let first = if self.bins.is_empty() { number - 1 } else { self.number };
            for _ in 0..(number - first).min(BINS_MAX as i64) {
                self.bins.push_back(Bin::default());
                if self.bins.len() > BINS_MAX {
                    self.bins.pop_front();
                }
            }
            self.number = number;
        }
        // An encoder's step back belongs to the newest bin.
        if let Some(bin) = self.bins.back_mut() {
            bin.add(&Bin::of(insertion_mm, position_mm));
        }
    }

    /// Whether the tip may travel like this.
    ///
    /// # Errors
    /// From the first stretch on that contradicts the insertion: the run is to be stopped.
    pub fn check(&self) -> Result<(), String> {
        self.error.clone().map_or(Ok(()), Err)
    }

    /// Looks at every stretch that ends with the newest bin, the shortest first.
    fn check_stretches(&mut self) {
        let mut sum = Bin::default();
        for (bins, bin) in (1..).zip(self.bins.iter().rev()) {
            sum.add(bin);
            if STRETCHES.contains(&bins) {
                let error = self.contradiction(&sum, bins);
                self.error = self.error.take().or(error);
            }
        }
    }

    /// Adds the likely cause to a refusal that loses the track: frozen or of too small a scale, where the
    /// travel shows it.
    pub fn explain(&self, mut refusal: Refusal) -> Refusal {
        if refusal.effect == Effect::Loses {
            refusal.why += &match self.change_over(EXPLAINED_BINS, SLOWER) {
                Some(change) => format!(": {change}"),
                None => ": a jump, a drift, or too large a scale".to_owned(),
            };
        }
        refusal
    }

    /// What changed over the last bins, to a scale in this range.
    fn change_over(&self, bins: usize, tenths: Tenths) -> Option<Change> {
        let bins = self.bins.iter().rev().take(bins);
        Change::fitted(bins, tenths, self.noise_sd_mm.powi(2))
    }

    /// What the sums over a stretch of so many bins say against the insertion.
    fn contradiction(&self, sum: &Bin, bins: usize) -> Option<String> {
        let (n, stretch_mm) = (sum.count, bins as f64 * BIN_MM);
        if n < POSITIONS_MIN {
            return None;
        }
        let spread_mm2 = (sum.depth_mm2 - sum.depth_mm * sum.depth_mm / n).max(0.0);
        // Where the positions do not fill the stretch evenly, as much as would have their spread.
        let filled_mm = (12.0 * spread_mm2 / n).sqrt().min(stretch_mm);
        if filled_mm < 0.75 * stretch_mm {
            return None;
        }
        let slope = (sum.product_mm2 - sum.position_mm * (sum.depth_mm / n)) / spread_mm2;
        let scatter_mm2 = sum.square_mm2 - sum.position_mm.norm_squared() / n;
        let residual_mm2 = (scatter_mm2 - slope.norm_squared() * spread_mm2).max(0.0);
        let variance_mm2 = (residual_mm2 / (3.0 * (n - 2.0))).max(self.noise_sd_mm.powi(2));
        let independent = n.min(INDEPENDENT_PER_MM * filled_mm);
        let sd = (variance_mm2 / (spread_mm2 * independent / n)).sqrt();
        let ratio = slope.norm();
        let bend_rad = CURVATURE_MARGIN * self.curvature_per_mm * stretch_mm;
        let min = 1.0 - SHORT.0 - SHORT.1 / filled_mm - bend_rad * bend_rad / 40.0 - NOISE_SDS * sd;
        // On average noise lengthens the slope: its two components across it add 2 sd² to the squared length.
        let max = (1.0 + 2.0 * sd * sd).sqrt() + LONG.0 + LONG.1 / filled_mm + NOISE_SDS * sd;
        (ratio < min || ratio > max).then(|| {
            let change = self.change_over(bins, if ratio < min { SLOWER } else { FASTER });
            let what = change.map_or("a jump, or a drift".to_owned(), |change| change.to_string());
            format!(
                "over the last {stretch_mm:.1} mm the tip travelled {ratio:.3} mm per mm inserted \
                 (expected {min:.3} to {max:.3}): {what}; check the tracker, counts_per_mm and \
                 needle.radius_mm"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Depth at which a stream whose tip is at `position` of the depth is contradicted, mm; a position
    /// each 0.05 mm, with noise of ±`noise_mm`.
    fn contradicted_mm(noise_mm: f64, position: impl Fn(f64) -> Vector3<f64>) -> Option<f64> {
        let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
        // Uniform noise by a Weyl sequence of each coordinate.
        let noise = |k: u32, step: f64| 2.0 * (f64::from(k) * step).fract() - 1.0;
        for k in 0..4000 {
            let depth_mm = 0.05 * f64::from(k);
            let steps = [0.618_034, 0.414_214, 0.732_051];
            let off_mm = Vector3::from(steps.map(|step| noise_mm * noise(k * 7919 % 65_537, step)));
            check.take(depth_mm, &(position(depth_mm) + off_mm));
            if check.check().is_err() {
                return Some(depth_mm);
            }
        }
        None
    }

    #[test]
    fn a_stream_of_another_travel_is_contradicted_in_time() {
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
    fn a_needle_is_never_contradicted() {
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
    fn a_contradiction_is_told_with_its_numbers() {
        let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
        (0..100).for_each(|k| check.take(0.05 * f64::from(k), &Vector3::zeros()));
        let text = check.check().unwrap_err();
        assert!(
            text.contains(" mm the tip travelled 0.000 mm per mm inserted (expected 0."),
            "{text}"
        );
        assert!(text.len() < 200, "{}", text.len());
    }

    proptest! {
        /// Gaps, steps back and positions all at one depth do no harm.
        #[test]
        fn any_depths_are_taken(depths in prop::collection::vec(-1e4..1e4f64, 0..200)) {
            let mut check = TravelCheck::new(0.6, 1.0 / 122.0);
            for depth_mm in depths {
                check.take(depth_mm, &(Vector3::z() * depth_mm));
            }
            prop_assert!(check.bins.len() <= BINS_MAX);
        }
    }
}
