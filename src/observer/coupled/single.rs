//! The paper's coupled observer (Section 5.4): a Luenberger observer on the reduced space feeding
//! one on the fibre, in discrete predict and correct form.

use super::CoupledConfig;
use crate::geometry::FixedAngles;
use crate::math;
use crate::needle::{Fibre, Increment, Needle, Reduced, TipPosition};
use crate::observer::{Estimate, Observer};
use nalgebra::{Complex, Matrix3, RowVector3, Vector3};

/// A measurement closer than this to the last correction, mm, is ignored. The gains for so short a
/// step are nearly zero (the first is 0.19, 0.021 and 0.0021 at 1, 0.1 and 0.01 mm), and computing
/// them loses digits: it inverts a nearly singular observability matrix, and divides by w.
const LEAST_SPACING_MM: f64 = 0.01;

/// Upper limit of the estimate's |sin β| and |sin γ|. The paper's coordinates end at 1.
const SINE_LIMIT: f64 = 0.999;

/// Coupled reduced-space and fibre-space observer (paper Eq. 8 and 15).
///
/// The paper holds each sample over the next mm and integrates, which leaves a steady error. Here
/// the exact kinematics predict the state up to the sample, and gains placed for the sampled error
/// dynamics correct it there:
///
/// - reduced: `s = (x, sin β, κ cos β sin γ)` (Eq. 5), error `e⁺ = (I − L C) Φ e`, Φ the
///   transition of `s₁′ = s₂, s₂′ = s₃, s₃′ = −κ² s₂` (Eq. 6 and 7 with its constant part);
/// - fibre: Eq. 10 in two complex numbers, `q = z − i y` and `c = cos α + i sin α`. Eq. 15, with
///   `T A_h` in place of the printed `A_h T`, is `q′ = cos β c`, `c′ = i κ (cos γ / cos β) c`. It
///   is linear over C, so the exact transition over a step is `(q, c) → (q + w c, E c)`; the exact
///   step of the reduced pose gives w and E. Two complex gains place both poles exactly.
///
/// The estimate is local. Pitch stays within ±90°. Corrections change only the sine of the roll; the
/// start and the turning since then decide between γ and π − γ.
#[derive(Debug, Clone)]
pub struct Coupled {
    needle: Needle,
    config: CoupledConfig,
    /// `None` until the first measurement.
    state: Option<State>,
    since_correction: Transition,
}

#[derive(Debug, Clone, Copy)]
struct State {
    reduced: Reduced,
    q: Complex<f64>,
    c: Complex<f64>,
}

/// The fibre's transition since the last correction, and the depth it spans.
#[derive(Debug, Clone, Copy)]
struct Transition {
    depth_mm: f64,
    w: Complex<f64>,
    e: Complex<f64>,
}

impl Transition {
    const NONE: Transition =
        Transition { depth_mm: 0.0, w: Complex::new(0.0, 0.0), e: Complex::new(1.0, 0.0) };

    fn then(self, next: Transition) -> Transition {
        Transition {
            depth_mm: self.depth_mm + next.depth_mm,
            w: self.w + self.e * next.w,
            e: self.e * next.e,
        }
    }
}

impl State {
    /// The exact step of the reduced state, and the transition of the fibre that follows from it.
    fn step(&self, needle: &Needle, increment: Increment) -> (State, Transition) {
        let tip = needle.step(&self.reduced.join(&Fibre::default()), increment);
        let (reduced, moved) = Reduced::split(&tip);
        let transition = Transition {
            depth_mm: increment.insertion_mm(),
            w: Complex::new(moved.z_mm, -moved.y_mm),
            e: Complex::from_polar(1.0, moved.yaw_rad),
        };
        let state = State { reduced, q: self.q + transition.w * self.c, c: transition.e * self.c };
        (state, transition)
    }

    fn estimate(&self) -> Estimate {
        let fibre = Fibre { y_mm: -self.q.im, z_mm: self.q.re, yaw_rad: self.c.arg() };
        Estimate::of_pose(self.reduced.join(&fibre))
    }
}

impl Coupled {
    /// An observer for a needle of known curvature, which is not straight: the path of a straight needle does not
    /// depend on its roll.
    pub fn new(needle: Needle, config: CoupledConfig) -> Self {
        Coupled { needle, config, state: None, since_correction: Transition::NONE }
    }

    /// The gain L that gives `(I − L C) Φ` the configured poles over `depth_mm`, by Ackermann's
    /// formula for the pair (Φ, C Φ).
    fn reduced_gain(&self, depth_mm: f64) -> Option<Vector3<f64>> {
        let k = self.needle.curvature_per_mm();
        let (sin, cos) = math::sin_cos(k * depth_mm);
        let half = math::sin(0.5 * k * depth_mm);
        let phi = Matrix3::new(
            1.0,
            sin / k,
            2.0 * half * half / (k * k),
            0.0,
            cos,
            sin / k,
            0.0,
            -k * sin,
            cos,
        );
        let first = RowVector3::new(1.0, 0.0, 0.0) * phi;
        let observability = Matrix3::from_rows(&[first, first * phi, first * phi * phi]);
        // The desired characteristic polynomial, evaluated at Φ.
        let mut polynomial = Matrix3::<f64>::identity();
        for rate in self.config.reduced_poles_per_mm {
            polynomial *= phi - Matrix3::identity() * math::exp(-rate * depth_mm);
        }
        Some(polynomial * observability.try_inverse()? * Vector3::z())
    }

    /// The gains (l₁, l₂) with which the transition `(q, c) → (q + w c, E c)` and the following
    /// correction have the configured poles p₁, p₂: `l₁ = 1 − p₁p₂/E`,
    /// `l₂ = (1 − l₁ + E − p₁ − p₂) / w`.
    fn fibre_gain(&self, over: &Transition) -> (Complex<f64>, Complex<f64>) {
        let [p1, p2] = self.config.fibre_poles_per_mm.map(|rate| math::exp(-rate * over.depth_mm));
        let l1 = Complex::new(1.0, 0.0) - over.e.finv() * (p1 * p2);
        let l2 = (Complex::new(1.0 - p1 - p2, 0.0) - l1 + over.e) * over.w.finv();
        (l1, l2)
    }

    /// The reduced state corrected by `change` (gain times innovation) in the coordinates of Eq. 5.
    /// The result stays within those coordinates and on the same side of γ = ±90°.
    fn corrected(&self, reduced: &Reduced, change: Vector3<f64>) -> Reduced {
        let k = self.needle.curvature_per_mm();
        let (sin_b, cos_b) = math::sin_cos(reduced.pitch_rad);
        let bend = k * cos_b * math::sin(reduced.roll_rad) + change.z;
        let sin_b = (sin_b + change.y).clamp(-SINE_LIMIT, SINE_LIMIT);
        let pitch_rad = math::asin(sin_b);
        let sin_g = (bend / (k * math::cos(pitch_rad))).clamp(-SINE_LIMIT, SINE_LIMIT);
        let cos_g = (1.0 - sin_g * sin_g).sqrt().copysign(math::cos(reduced.roll_rad));
        Reduced { x_mm: reduced.x_mm + change.x, pitch_rad, roll_rad: math::atan2(sin_g, cos_g) }
    }
}

impl Observer for Coupled {
    fn predict(&mut self, increment: Increment) {
        if let Some(state) = &mut self.state {
            let (next, transition) = state.step(&self.needle, increment);
            *state = next;
            self.since_correction = self.since_correction.then(transition);
        }
    }

    fn correct(&mut self, tip_meas: &TipPosition, _: f64) {
        let p = tip_meas.mm();
        let q_meas = Complex::new(p.z, -p.y);
        let Some(state) = self.state else {
            let FixedAngles { yaw, pitch, roll } = self.config.start;
            let reduced = Reduced { x_mm: p.x, pitch_rad: pitch, roll_rad: roll };
            self.state = Some(State { reduced, q: q_meas, c: Complex::from_polar(1.0, yaw) });
            return;
        };
        let over = self.since_correction;
        if over.depth_mm < LEAST_SPACING_MM || over.w.norm() < LEAST_SPACING_MM {
            return;
        }
        let Some(gain) = self.reduced_gain(over.depth_mm) else { return };
        let reduced = self.corrected(&state.reduced, gain * (p.x - state.reduced.x_mm));
        let (l1, l2) = self.fibre_gain(&over);
        let innovation = q_meas - state.q;
        let (q, c) = (state.q + l1 * innovation, state.c + l2 * innovation);
        self.state = Some(State { reduced, q, c });
        self.since_correction = Transition::NONE;
    }

    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate> {
        let start = self.state?;
        let state = increments.iter().fold(start, |state, &i| state.step(&self.needle, i).0);
        Some(state.estimate())
    }
}

#[cfg(test)]
mod tests {
    use super::super::Gains;
    use super::*;
    use crate::geometry::Pose;
    use crate::units::wrap_angle;
    use proptest::prelude::*;

    fn needle() -> Needle {
        Needle::new(1.0 / 122.0).unwrap()
    }

    fn config() -> CoupledConfig {
        CoupledConfig {
            reduced_poles_per_mm: [0.07; 3],
            fibre_poles_per_mm: [0.07; 2],
            gains: Gains::Placed,
            memory_mm: 20.0,
            start: FixedAngles::default(),
            start_sd: FixedAngles::default(),
            position_sd_mm: 0.577,
        }
    }

    fn observer() -> Coupled {
        Coupled::new(needle(), config())
    }

    fn tip(x: f64, yaw: f64, pitch: f64, roll: f64) -> Pose {
        Pose {
            rotation: FixedAngles { yaw, pitch, roll }.to_rotation(),
            translation: Vector3::new(x, 1.0, 2.0),
        }
    }

    fn measured(p: Vector3<f64>) -> TipPosition {
        TipPosition::new(p).unwrap()
    }

    /// Near the plane each sample multiplies the error by a matrix. Its eigenvalues are the configured poles.
    #[test]
    fn the_reduced_error_decays_by_the_configured_poles() {
        for spacing_mm in [0.1, 1.0, 3.0] {
            let mut poles = config();
            poles.reduced_poles_per_mm = [0.05, 0.08, 0.11];
            let observer = Coupled::new(needle(), poles);
            let gain = observer.reduced_gain(spacing_mm).unwrap();
            let k = needle().curvature_per_mm();
            let (sin, cos) = (k * spacing_mm).sin_cos();
            let phi = Matrix3::new(
                1.0,
                sin / k,
                (1.0 - cos) / (k * k),
                0.0,
                cos,
                sin / k,
                0.0,
                -k * sin,
                cos,
            );
            let error_map = (Matrix3::identity() - gain * RowVector3::new(1.0, 0.0, 0.0)) * phi;
            for rate in poles.reduced_poles_per_mm {
                let pole = (-rate * spacing_mm).exp();
                let determinant = (error_map - Matrix3::identity() * pole).determinant();
                assert!(determinant.abs() < 1e-9, "{spacing_mm} mm, {rate}: {determinant}");
            }
        }
    }

    #[test]
    fn the_fibre_error_decays_by_the_configured_poles() {
        let observer = observer();
        let (state, over) = State {
            reduced: Reduced { x_mm: 1.0, pitch_rad: 0.3, roll_rad: 0.7 },
            q: Complex::new(0.0, 0.0),
            c: Complex::new(1.0, 0.0),
        }
        .step(&needle(), Increment::new(2.0, 0.4).unwrap());
        assert!((state.q - over.w).norm() < 1e-15);
        let (l1, l2) = observer.fibre_gain(&over);
        let one = Complex::new(1.0, 0.0);
        let trace = (one - l1) + over.e - l2 * over.w;
        let determinant = (one - l1) * over.e;
        let pole = (-0.07f64 * 2.0).exp();
        assert!((trace - 2.0 * pole).norm() < 1e-12);
        assert!((determinant - pole * pole).norm() < 1e-12);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        /// Without noise the estimate converges from unknown angles, also around the other
        /// equilibrium (roll near π), at every sample spacing.
        #[test]
        fn converges_without_noise(x in -8.0..8.0f64, yaw in -0.3..0.3f64, pitch in -0.15..0.15f64,
                                   roll in -0.6..0.6f64, far in any::<bool>(), spacing in 0.5..2.0f64) {
            let half_turn = if far { std::f64::consts::PI } else { 0.0 };
            let mut truth = tip(x, yaw, pitch, half_turn + roll);
            let start = FixedAngles { roll: half_turn, ..FixedAngles::default() };
            let mut observer = Coupled::new(needle(), CoupledConfig { start, ..config() });
            observer.correct(&measured(truth.translation), 1.0);
            let mut control = crate::control::FeedbackLinearization::new(needle(), crate::control::FeedbackLinearizationConfig {
                poles_per_mm: [0.05; 3], roll_demand_max_rad: 1.0, caution: 0.5, rotation_max_rad_per_mm: 0.35 });
            let mut depth = 0.0;
            while depth < 300.0 {
                let estimate = observer.estimate().unwrap();
                let command = crate::control::Controller::command(&mut control, &estimate, spacing).unwrap();
                let i = Increment::new(spacing, command.rotation_rad_per_mm * spacing).unwrap();
                truth = needle().step(&truth, i);
                observer.predict(i);
                observer.correct(&measured(truth.translation), 1.0);
                depth += spacing;
            }
            let estimate = observer.estimate().unwrap();
            let true_angles = FixedAngles::from_rotation(&truth.rotation);
            prop_assert!((estimate.x_pb.translation - truth.translation).norm() < 1e-5);
            let angles = FixedAngles::from_rotation(&estimate.x_pb.rotation);
            prop_assert!(wrap_angle(angles.yaw - true_angles.yaw).abs() < 1e-6);
            prop_assert!((angles.pitch - true_angles.pitch).abs() < 1e-6);
            prop_assert!(wrap_angle(angles.roll - true_angles.roll).abs() < 1e-5);
        }

        #[test]
        fn stays_finite(steps in prop::collection::vec((0.0..3.0f64, -7.0..7.0f64, prop::array::uniform3(-1e6..1e6f64)), 1..60)) {
            let mut observer = observer();
            for (insertion, rotation, position) in steps {
                observer.predict(Increment::new(insertion, rotation).unwrap());
                observer.correct(&measured(Vector3::from(position)), 1.0);
                prop_assert!(observer.estimate().unwrap().x_pb.is_finite());
            }
        }
    }

    #[test]
    fn a_measurement_at_the_same_depth_changes_nothing() {
        let mut observer = observer();
        observer.correct(&measured(Vector3::zeros()), 1.0);
        observer.predict(Increment::new(1.0, 0.0).unwrap());
        observer.correct(&measured(Vector3::new(0.1, 0.0, 1.0)), 1.0);
        observer.predict(Increment::new(0.0, 0.0).unwrap());
        let before = observer.estimate();
        observer.correct(&measured(Vector3::new(5.0, 5.0, 5.0)), 1.0);
        assert_eq!(observer.estimate(), before);
    }
}
