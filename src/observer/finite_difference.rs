//! The paper's first observer (Eq. 2): the frame of the path, by finite differences.

use super::{Estimate, Observer};
use crate::geometry::Pose;
use crate::keys::{section, within};
use crate::needle::{Increment, Needle, TipPosition};
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::collections::VecDeque;

section! {
    /// `[observer.finite_difference]`.
    #[derive(Copy)]
    pub struct FiniteDifferenceConfig {
        /// Distance between the three positions differenced, mm.
        baseline_mm: f64 [within(0.1, 100.0)] = 10.0;
    }
}

/// At most about this many positions are kept per baseline.
const POSITIONS_PER_BASELINE: f64 = 1000.0;

/// Rotation from three measured positions, `R = [p′×p″/(κv³), −p″/(κv²), p′/v]` (paper Eq. 2
/// with the powers of v that the print drops).
///
/// The derivatives are those of the parabola through three positions a baseline apart, at the
/// middle one. The measured increments then predict the frame at the present depth, so turns
/// made in between are included. The columns are made orthonormal starting from the tangent, the most
/// accurate of the three; κ cancels out. The position is the last measured one.
///
/// Position noise of standard deviation σ causes a roll error of about `2.4 σ / (κ b²)` rad at baseline b.
/// The observer is meant for comparison, not for steering.
#[derive(Debug, Clone)]
pub struct FiniteDifference {
    needle: Needle,
    baseline_mm: f64,
    depth_mm: f64,
    /// The pose of a tip that started at the identity and made every increment.
    dead_reckoned: Pose,
    /// Oldest first.
    positions: VecDeque<Measured>,
    tip: Option<Pose>,
}

/// A measured position.
#[derive(Debug, Clone, Copy)]
struct Measured {
    depth_mm: f64,
    position_mm: Vector3<f64>,
    /// The rotation of [`FiniteDifference::dead_reckoned`] at that depth.
    dead_reckoned: Rotation3<f64>,
}

impl FiniteDifference {
    /// An observer with the given distance between the positions that it differences.
    pub fn new(needle: Needle, baseline_mm: f64) -> Self {
        FiniteDifference {
            needle,
            baseline_mm,
            depth_mm: 0.0,
            dead_reckoned: Pose::identity(),
            positions: VecDeque::new(),
            tip: None,
        }
    }

    /// The index of the newest position at least `distance_mm` before `depth_mm`.
    fn index_before(&self, depth_mm: f64, distance_mm: f64) -> Option<usize> {
        let limit_mm = depth_mm - distance_mm + 1e-6 * self.baseline_mm;
        self.positions.partition_point(|measured| measured.depth_mm <= limit_mm).checked_sub(1)
    }

    /// The frame at the newest of three positions. The kinematics are left-invariant, so the increments since
    /// the middle position turn its frame exactly as they turned the dead-reckoned tip.
    fn frame(&self) -> Option<Rotation3<f64>> {
        let newest = self.positions.back()?;
        let middle = self.positions.get(self.index_before(newest.depth_mm, self.baseline_mm)?)?;
        let oldest = self.positions.get(self.index_before(middle.depth_mm, self.baseline_mm)?)?;
        let (a, b) = (middle.depth_mm - oldest.depth_mm, newest.depth_mm - middle.depth_mm);
        let back = (middle.position_mm - oldest.position_mm) / a;
        let ahead = (newest.position_mm - middle.position_mm) / b;
        let first = (back * b + ahead * a) / (a + b);
        let second = (ahead - back) * (2.0 / (a + b));
        let e3 = first.try_normalize(1e-9)?;
        let e2 = (-(second - e3 * second.dot(&e3))).try_normalize(1e-12)?;
        let columns = Matrix3::from_columns(&[e2.cross(&e3), e2, e3]);
        let since = middle.dead_reckoned.inverse() * newest.dead_reckoned;
        Some(Rotation3::from_matrix_unchecked(columns) * since)
    }

    /// Minimum distance between two positions that are kept, mm.
    fn spacing_mm(&self) -> f64 {
        self.baseline_mm / POSITIONS_PER_BASELINE
    }

    /// Drops positions that no later difference can use.
    fn prune(&mut self) {
        if let Some(oldest) = self.index_before(self.depth_mm, 3.0 * self.baseline_mm) {
            self.positions.drain(..oldest);
        }
    }
}

impl Observer for FiniteDifference {
    fn predict(&mut self, increment: Increment) {
        self.depth_mm += increment.insertion_mm();
        self.dead_reckoned = self.needle.step(&self.dead_reckoned, increment);
        self.tip = self.tip.map(|tip| self.needle.step(&tip, increment));
    }

    fn correct(&mut self, tip_meas: &TipPosition, _: f64) {
        if self.positions.back().is_some_and(|measured| measured.depth_mm >= self.depth_mm) {
            return;
        }
        let position_mm = tip_meas.mm();
        let dead_reckoned = self.dead_reckoned.rotation;
        // A slow needle has very dense positions. Each is used while it is the newest, but few are kept.
        let mut newest = self.positions.iter().rev().map(|measured| measured.depth_mm);
        let last = newest.next().zip(newest.next());
        if last.is_some_and(|(last, before)| last - before < self.spacing_mm()) {
            self.positions.pop_back();
        }
        self.positions.push_back(Measured { depth_mm: self.depth_mm, position_mm, dead_reckoned });
        let rotation = self.frame().or(self.tip.map(|tip| tip.rotation));
        self.tip = rotation.map(|rotation| Pose { rotation, translation: position_mm });
        self.prune();
    }

    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate> {
        let tip = increments.iter().fold(self.tip?, |tip, &i| self.needle.step(&tip, i));
        Some(Estimate::of_pose(tip))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{FixedAngles, so3};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Without noise the error of the frame is of second order in the baseline.
        #[test]
        fn recovers_the_frame_without_noise(yaw in -3.0..3.0f64, pitch in -1.2..1.2f64, roll in -3.0..3.0f64, omega in -0.02..0.02f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let mut truth = Pose { rotation: FixedAngles { yaw, pitch, roll }.to_rotation(), translation: Vector3::zeros() };
            let mut observer = FiniteDifference::new(needle, 2.0);
            let increment = Increment::new(0.5, 0.5 * omega).unwrap();
            for n in 0..40 {
                if n % 2 == 0 {
                    observer.correct(&TipPosition::new(truth.translation).unwrap(), 1.0);
                }
                truth = needle.step(&truth, increment);
                observer.predict(increment);
            }
            let estimate = observer.estimate().unwrap();
            let error = so3::log(&(truth.rotation.inverse() * estimate.x_pb.rotation));
            prop_assert!(error.norm() < 2e-3, "{error}");
            prop_assert!((estimate.x_pb.translation - truth.translation).norm() < 1e-3);
        }

        /// At a low speed there are many increments between two positions.
        #[test]
        fn the_number_of_increments_does_not_matter(omega in -0.05..0.05f64, parts in 2..100u32) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let estimate = |parts: u32| {
                let mut truth = Pose::identity();
                let mut observer = FiniteDifference::new(needle, 3.0);
                let part = 1.0 / f64::from(parts);
                let increment = Increment::new(part, omega * part).unwrap();
                for _ in 0..20 {
                    observer.correct(&TipPosition::new(truth.translation).unwrap(), 1.0);
                    for _ in 0..parts {
                        truth = needle.step(&truth, increment);
                        observer.predict(increment);
                    }
                }
                observer.estimate().unwrap().x_pb
            };
            let difference = estimate(1).inverse() * estimate(parts);
            prop_assert!(so3::log(&difference.rotation).norm() < 1e-9, "{difference:?}");
            prop_assert!(difference.translation.norm() < 1e-9, "{difference:?}");
        }

        #[test]
        fn stays_finite(steps in prop::collection::vec((0.0..3.0f64, -7.0..7.0f64, prop::array::uniform3(-1e6..1e6f64)), 1..80)) {
            let mut observer = FiniteDifference::new(Needle::new(0.01).unwrap(), 2.0);
            for (insertion, rotation, position) in steps {
                observer.predict(Increment::new(insertion, rotation).unwrap());
                observer.correct(&TipPosition::new(Vector3::from(position)).unwrap(), 1.0);
                prop_assert!(observer.estimate().is_none_or(|e| e.x_pb.is_finite()));
            }
        }
    }

    /// 1 mm with a position every 0.0002 mm.
    #[test]
    fn few_positions_of_a_slow_needle_are_kept() {
        let needle = Needle::new(0.01).unwrap();
        let mut observer = FiniteDifference::new(needle, 10.0);
        for n in 1..=5000 {
            observer.predict(Increment::new(2e-4, 0.0).unwrap());
            let depth_mm = f64::from(n) * 2e-4;
            observer.correct(&TipPosition::new(Vector3::new(0.0, 0.0, depth_mm)).unwrap(), 1.0);
            assert_eq!(observer.positions.back().unwrap().position_mm.z, depth_mm, "the newest");
        }
        assert!((50..=110).contains(&observer.positions.len()), "{}", observer.positions.len());
    }

    #[test]
    fn has_no_estimate_before_three_positions_a_baseline_apart() {
        let needle = Needle::new(0.01).unwrap();
        let mut observer = FiniteDifference::new(needle, 1.0);
        let mut truth = Pose::identity();
        let increment = Increment::new(1.0, 0.0).unwrap();
        for _ in 0..2 {
            observer.correct(&TipPosition::new(truth.translation).unwrap(), 1.0);
            assert!(observer.estimate().is_none());
            truth = needle.step(&truth, increment);
            observer.predict(increment);
        }
        observer.correct(&TipPosition::new(truth.translation).unwrap(), 1.0);
        assert!(observer.estimate().is_some());
    }

    /// A straight path has no normal, so there is no frame.
    #[test]
    fn a_straight_path_gives_no_frame() {
        let mut observer = FiniteDifference::new(Needle::new(0.0).unwrap(), 1.0);
        for n in 0..10 {
            observer.correct(&TipPosition::new(Vector3::new(0.0, 0.0, f64::from(n))).unwrap(), 1.0);
            observer.predict(Increment::new(1.0, 0.0).unwrap());
        }
        assert!(observer.estimate().is_none());
    }
}
