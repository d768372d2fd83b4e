//! The paper's planar control law (Eq. 5 to 7), with its singularities guarded.

use super::spin_guard::{SEARCHING_SPIN_RAD, SpinGuard};
use super::{Command, Controller, RATE, ROTATION, state_within};
use crate::keys::{over, section, within};
use crate::math;
use crate::needle::{Needle, Reduced};
use crate::observer::Estimate;
use std::f64::consts::TAU;

/// Pitch limit of the law, rad: beyond it the demanded bend is always saturated.
const PITCH_LIMIT_RAD: f64 = 60.0 / 180.0 * std::f64::consts::PI;
/// Beyond this distance of the roll from the nearer of 0 and π, rad, the divisor |cos γ| is no longer
/// decreased.
const ROLL_GUARD_RAD: f64 = 80.0 / 180.0 * std::f64::consts::PI;
/// Insertion allowed with the roll estimate beyond the guard, mm.
const ROLL_GUARD_DEPTH_MM: f64 = 30.0;

section! {
    /// `[control.feedback_linearization]`: parameters of the law.
    #[derive(Copy)]
    pub struct FeedbackLinearizationConfig {
        /// Decay rates of the distance from the plane, per mm.
        poles_per_mm: [f64; 3] [RATE] = [0.06, 0.06, 0.06];
        /// The law never asks for more roll than this.
        roll_demand_max_rad as "roll_demand_max_deg": f64 [over(0.0, 85.0)] = 75.0;
        /// Part of each turn that is withheld while the roll is unknown.
        caution: f64 [within(0.0, 1.0)] = 0.5;
        /// The law never turns the base faster.
        rotation_max_rad_per_mm as "rotation_max_deg_per_mm": f64 [ROTATION] = 20.0;
    }
}

/// Feedback linearisation: `s‴ = u`, `u = −k₁s₁ − k₂s₂ − k₃s₃`, and from Eq. 6
/// `ω = (u + κ² sin β) / (κ cos β cos γ)`.
///
/// Written as a roll loop, `u = −k₃ (s₃ − s₃,demand)` with `s₃,demand = −(k₁s₁ + k₂s₂)/k₃`, the
/// demand is limited to `κ cos β sin(roll_demand_max)`: the needle cannot bend harder than κ. Both
/// equilibria, γ = 0 and γ = π, are valid; the sign of cos γ selects the nearer one. While the observer
/// does not know the roll, the law commands only a part of each turn.
#[derive(Debug, Clone)]
pub struct FeedbackLinearization {
    needle: Needle,
    config: FeedbackLinearizationConfig,
    /// Insertion with the roll estimate beyond the guard so far, mm.
    past_guard_mm: f64,
    spin: SpinGuard,
}

impl FeedbackLinearization {
    /// The law for a needle of known curvature.
    pub fn new(needle: Needle, config: FeedbackLinearizationConfig) -> Self {
        FeedbackLinearization { needle, config, past_guard_mm: 0.0, spin: SpinGuard::default() }
    }

    /// Checks that the roll estimate has not been beyond the guard for too long.
    fn check_roll(&mut self, state: &Reduced, step_mm: f64) -> Result<(), String> {
        let past = math::cos(state.roll_rad).abs() < math::cos(ROLL_GUARD_RAD);
        self.past_guard_mm = if past { self.past_guard_mm + step_mm } else { 0.0 };
        if self.past_guard_mm > ROLL_GUARD_DEPTH_MM {
            return Err(format!(
                "estimated roll has been over {:.0} deg from the plane for {:.0} mm: the control law divides by its cosine there; check the assumed start and the observer's poles",
                ROLL_GUARD_RAD.to_degrees(),
                self.past_guard_mm
            ));
        }
        Ok(())
    }
}

impl Controller for FeedbackLinearization {
    fn command(&mut self, estimate: &Estimate, step_mm: f64) -> Result<Command, String> {
        let state = state_within(estimate, step_mm, PITCH_LIMIT_RAD)?;
        self.check_roll(&state, step_mm)?;

        let k = self.needle.curvature_per_mm();
        let [a, b, c] = self.config.poles_per_mm;
        let (k1, k2, k3) = (a * b * c, a * b + b * c + c * a, a + b + c);
        let (sin_b, cos_b) = math::sin_cos(state.pitch_rad);
        let (sin_g, cos_g) = math::sin_cos(state.roll_rad);

        let demand = -(k1 * state.x_mm + k2 * sin_b) / k3;
        let most = k * cos_b * math::sin(self.config.roll_demand_max_rad);
        let u = -k3 * (k * cos_b * sin_g - demand.clamp(-most, most));
        let divisor = cos_g.abs().max(math::cos(ROLL_GUARD_RAD)).copysign(cos_g);
        let wanted =
            estimate.demand_gain(self.config.caution) * (u + k * k * sin_b) / (k * cos_b * divisor);

        let limit = self.config.rotation_max_rad_per_mm;
        let spin_limit_rad = if estimate.belief.is_some() { SEARCHING_SPIN_RAD } else { TAU };
        let command = self.spin.command(wanted, limit, step_mm, spin_limit_rad)?;
        Ok(Command { saturated: command.saturated || demand.abs() > most, ..command })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::NOT_FINITE;
    use crate::geometry::{FixedAngles, Pose};
    use crate::needle::{Fibre, Increment};
    use nalgebra::Vector3;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    fn law() -> FeedbackLinearization {
        let config = FeedbackLinearizationConfig {
            poles_per_mm: [0.05; 3],
            roll_demand_max_rad: 60f64.to_radians(),
            caution: 0.5,
            rotation_max_rad_per_mm: 20f64.to_radians(),
        };
        FeedbackLinearization::new(Needle::new(1.0 / 122.0).unwrap(), config)
    }

    fn at(x_mm: f64, pitch_rad: f64, roll_rad: f64) -> Estimate {
        Estimate::of_pose(Reduced { x_mm, pitch_rad, roll_rad }.join(&Fibre::default()))
    }

    proptest! {
        /// With the state known, every start settles into the plane, at the nearer equilibrium.
        #[test]
        fn settles_with_the_state_known(x in -8.0..8.0f64, pitch in -0.2..0.2f64, roll in -3.1..3.1f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let mut law = law();
            let mut tip = at(x, pitch, roll).x_pb;
            for _ in 0..300 {
                let command = law.command(&Estimate::of_pose(tip), 1.0).unwrap();
                tip = needle.step(&tip, Increment::new(1.0, command.rotation_rad_per_mm).unwrap());
            }
            let (end, _) = Reduced::split(&tip);
            prop_assert!(end.x_mm.abs() < 0.05 && end.pitch_rad.abs() < 0.002 && end.roll_rad.sin().abs() < 0.02, "{end:?}");
        }

        /// For every estimate the command is finite and within the limit, or refused.
        #[test]
        fn never_commands_beyond_its_limit(x in -1e9..1e9f64, pitch in -1.6..1.6f64, roll in -4.0..4.0f64) {
            let mut law = law();
            for _ in 0..200 {
                match law.command(&at(x, pitch, roll), 1.0) {
                    Ok(command) => prop_assert!(command.rotation_rad_per_mm.abs() <= 20f64.to_radians()),
                    Err(_) => return Ok(()),
                }
            }
        }

        /// Near the plane the law equals Eq. 6 and 7.
        #[test]
        fn is_the_papers_law_inside_its_limits(x in -0.2..0.2f64, pitch in -0.01..0.01f64, roll in -0.1..0.1f64) {
            let k = 1.0 / 122.0;
            let command = law().command(&at(x, pitch, roll), 1.0).unwrap();
            prop_assert!(!command.saturated);
            let s = [x, pitch.sin(), k * pitch.cos() * roll.sin()];
            let u = -(0.05f64.powi(3) * s[0] + 3.0 * 0.05f64.powi(2) * s[1] + 3.0 * 0.05 * s[2]);
            let omega = (u + k * k * pitch.sin()) / (k * pitch.cos() * roll.cos());
            prop_assert!((command.rotation_rad_per_mm - omega).abs() < 1e-12);
        }
    }

    #[test]
    fn at_the_singularity_the_command_turns_back_to_the_plane() {
        let command = law().command(&at(0.0, 0.0, PI / 2.0 - 1e-9), 1.0).unwrap();
        assert!(command.rotation_rad_per_mm < 0.0 && command.rotation_rad_per_mm.is_finite());
        let command = law().command(&at(0.0, 0.0, PI / 2.0 + 1e-9), 1.0).unwrap();
        assert!(command.rotation_rad_per_mm > 0.0, "towards π");
    }

    #[test]
    fn refuses_estimates_outside_its_domain() {
        let mut law = law();
        let steep = law.command(&at(0.0, 1.2, 0.0), 1.0).unwrap_err();
        assert!(steep.to_string().starts_with("estimated pitch is 68.8 deg"), "{steep}");
        let stuck = (0..40).find_map(|_| law.command(&at(3.0, 0.1, PI / 2.0), 1.0).err());
        let is_stuck =
            |why: &str| why.contains("estimated roll has been over") || why.contains("spinning it");
        assert!(stuck.as_deref().is_some_and(is_stuck), "{stuck:?}");
        let straight = Needle::new(0.0).unwrap();
        let mut for_straight = FeedbackLinearization::new(straight, law.config);
        assert_eq!(for_straight.command(&at(1.0, 0.0, 0.0), 1.0), Err(NOT_FINITE.to_owned()));
        let mut law = self::law();
        let nan = Pose {
            translation: Vector3::new(f64::NAN, 0.0, 0.0),
            rotation: FixedAngles::default().to_rotation(),
        };
        assert_eq!(law.command(&Estimate::of_pose(nan), 1.0), Err(NOT_FINITE.to_owned()));
    }

    /// With a constant error of the observer the law would turn the needle without end.
    #[test]
    fn a_constant_error_stops_the_law_within_a_turn() {
        let mut law = law();
        let mut turned = 0.0;
        let stopped = (0..500).find_map(|_| match law.command(&at(0.0, 0.0, 1.0), 1.0) {
            Ok(command) => {
                turned += command.rotation_rad_per_mm;
                None
            }
            Err(error) => Some(error),
        });
        assert!(stopped.as_ref().is_some_and(|why| why.ends_with("spinning it")), "{stopped:?}");
        assert!(turned.abs() <= TAU, "{turned}");
    }
}
