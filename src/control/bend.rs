//! The law that bends the needle along a path: toward any side, by any curvature up to its own.

use super::nested_saturation::{NestedSaturation, NestedSaturationConfig};
use super::{Command, NOT_FINITE};
use crate::math;
use crate::needle::{Needle, Reduced};
use crate::observer::Estimate;
use crate::units::wrap_angle;
use nalgebra::Vector3;
use std::f64::consts::{PI, TAU};

/// The share of the needle's bend that is always available to hold the plane, whatever the path demands.
const TOWARD_PLANE_MIN: f64 = 0.25;

/// A wanted bend below this share has no direction worth aiming at; the base then makes whole turns.
const SHARE_MIN: f64 = 0.05;
/// The excess fades towards the end of the path, and is zero within this many whole turns of it.
const FADE_TURNS: f64 = 2.0;

/// The bend wanted over the next step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bend {
    /// The path bends toward this unit vector across the heading, plane frame.
    pub toward: Vector3<f64>,
    /// Its mean curvature, per mm; negative if the path soon bends to the other side.
    pub curvature_per_mm: f64,
    /// Remaining length of the path, mm.
    pub remaining_mm: f64,
    /// The path can still be followed after a whole turn of the base.
    pub may_turn: bool,
    /// The law holds the plane x = 0 as well.
    pub in_plane: bool,
}

/// Bends the needle by less than its full curvature. The law holds the roll that bends the needle along the
/// path, so the needle bends by more than wanted. Once half of a whole turn would make up for this excess, and
/// if the path can still be followed afterwards, the law turns the base once around, over which the bends
/// cancel.
///
/// Each whole turn goes in the direction opposite to the one before, so the turns do not add up. In the plane,
/// [`NestedSaturation`], which holds the plane, gives the sine of the roll, and the path gives its cosine.
#[derive(Debug, Clone)]
pub struct BendLaw {
    plane: NestedSaturation,
    /// By how much the needle has bent more than wanted, in mm of full curvature, plane frame.
    excess_mm: Vector3<f64>,
    /// The rest of a whole turn that is under way, rad; 0 while the roll is held.
    remaining_rad: f64,
    /// By how much the rest of that turn may still grow, rad.
    spare_rad: f64,
    /// The direction of that turn, 1 or -1.
    side: f64,
}

impl BendLaw {
    /// The law for a needle of assumed curvature.
    pub fn new(needle: Needle, config: NestedSaturationConfig) -> Self {
        BendLaw {
            plane: NestedSaturation::new(needle, config),
            excess_mm: Vector3::zeros(),
            remaining_rad: 0.0,
            spare_rad: 0.0,
            side: -1.0,
        }
    }

    /// How far the needle goes while the base turns once around, mm.
    pub fn turn_mm(&self) -> f64 {
        TAU / self.plane.rotation_max_rad_per_mm()
    }

    /// The command for the next `step_mm` of insertion, from the estimate at its start.
    ///
    /// # Errors
    /// Why there is no valid command; the run must stop for that reason.
    pub fn command(
        &mut self,
        estimate: &Estimate,
        bend: &Bend,
        step_mm: f64,
    ) -> Result<Command, String> {
        let rotation = &estimate.x_pb.rotation;
        let wanted = self.wanted_bend(estimate, bend, step_mm);
        let share = wanted.norm();
        // An unturned tip bends toward its own -y.
        let seen = rotation.inverse() * wanted;
        let off_rad = math::atan2(seen.x, -seen.y);
        if !(off_rad + share).is_finite() {
            return Err(NOT_FINITE.to_owned());
        }
        let transmission = self.plane.transmission(estimate, step_mm);
        let limit_rad_per_mm = self.plane.rotation_max_rad_per_mm();
        let step_max_rad = limit_rad_per_mm * step_mm;
        let turn_mm = self.turn_mm();
        // Near the end only the path counts: it leads to the target whatever the past bends were.
        self.excess_mm *= 1.0 - (FADE_TURNS * turn_mm / bend.remaining_mm).min(1.0);
        self.excess_mm += (rotation * -Vector3::y() - wanted / share.max(1.0)) * step_mm;
        let has_aim = share > SHARE_MIN;
        let has_excess = self.excess_mm.dot(&wanted) >= 0.5 * share * share * turn_mm;
        let is_due = bend.may_turn && (has_excess || !has_aim);
        let is_turning = self.remaining_rad > 0.0;
        if !estimate.is_roll_known() {
            (self.excess_mm, self.remaining_rad) = (Vector3::zeros(), 0.0);
        } else if is_turning || is_due {
            if !is_turning {
                (self.side, self.remaining_rad, self.spare_rad) = (-self.side, TAU, PI);
            }
            // The wanted roll may have changed meanwhile. A turn without an aim must cross the play as well.
            if has_aim || !is_turning {
                let aim_rad = if has_aim { off_rad } else { 0.0 };
                let to_rad = self.side * transmission.base_turn_for(aim_rad, self.side);
                let added_rad = wrap_angle(to_rad - self.remaining_rad).min(self.spare_rad);
                self.spare_rad -= added_rad.max(0.0);
                self.remaining_rad += added_rad;
            }
        }
        let turn_rad = if self.remaining_rad > 0.0 {
            let turn_rad = self.remaining_rad.min(step_max_rad);
            self.remaining_rad -= turn_rad;
            turn_rad * self.side
        } else {
            self.remaining_rad = 0.0;
            self.plane.base_turn([off_rad; 2], 0.0, &transmission)
        };
        let wanted_rad_per_mm = turn_rad / step_mm;
        if !wanted_rad_per_mm.is_finite() {
            return Err(NOT_FINITE.to_owned());
        }
        let rotation_rad_per_mm = wanted_rad_per_mm.clamp(-limit_rad_per_mm, limit_rad_per_mm);
        Ok(Command { rotation_rad_per_mm, saturated: share > 1.0 })
    }

    /// The wanted bend as a vector, relative to the needle's curvature.
    fn wanted_bend(&self, estimate: &Estimate, bend: &Bend, step_mm: f64) -> Vector3<f64> {
        let curvature_per_mm = self.plane.curvature_per_mm(estimate);
        let share = bend.curvature_per_mm / curvature_per_mm;
        let along = bend.toward * share;
        if !bend.in_plane {
            return along;
        }
        let (state, _) = Reduced::split(&estimate.x_pb);
        let most = (1.0 - share * share).max(0.0).sqrt().max(TOWARD_PLANE_MIN);
        let toward_plane = self.plane.demand(&state, curvature_per_mm, step_mm).clamp(-most, most);
        let heading = estimate.x_pb.rotation * Vector3::z();
        let across = Vector3::x() - heading * heading.x;
        along + across.try_normalize(1e-9).unwrap_or_default() * toward_plane
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{FixedAngles, Pose};
    use crate::needle::{Increment, Play, Torsion, TorsionConfig};
    use crate::observer::{Belief, Shaft, Slack};
    use proptest::prelude::*;

    const CURVATURE_PER_MM: f64 = 1.0 / 122.0;
    const LENGTH_MM: f64 = 120.0;

    fn config() -> NestedSaturationConfig {
        NestedSaturationConfig {
            distance_rate_per_mm: 0.08,
            pitch_rate_per_mm: 0.2,
            pitch_demand_max_rad: 0.5,
            bend_part: 0.9,
            rotation_max_rad_per_mm: PI / 3.0,
            reversal_min_rad: 0.08,
            reversal_sd: 1.0,
            caution: 0.5,
        }
    }

    /// An estimate without uncertainty.
    fn estimate(tip: Pose, shaft: Shaft) -> Estimate {
        Estimate::of_belief(tip, Belief::certain(CURVATURE_PER_MM, shaft))
    }

    fn known(tip: Pose) -> Estimate {
        estimate(tip, Shaft::RIGID)
    }

    /// Follows an arc of `share` of the needle's curvature toward `toward` with the state known. Returns the tip at
    /// its end and the largest turn of the base.
    fn follow(
        share: f64,
        toward: Vector3<f64>,
        start: Pose,
        torsion: TorsionConfig,
        in_plane: bool,
    ) -> (Pose, f64) {
        let needle = Needle::new(CURVATURE_PER_MM).unwrap();
        let torsion = Torsion::new(torsion).unwrap();
        let (mut tip, mut play, mut law) = (start, Play::default(), BendLaw::new(needle, config()));
        let (mut base_rad, mut most_rad) = (0.0f64, 0.0f64);
        for step in 0..LENGTH_MM as u32 {
            let (lower, upper) = torsion.band_rad(play.insertion_mm());
            let creep_mm = torsion.config().creep_mm;
            let slack = |mean_rad| Slack { mean_rad, sd_rad: 0.0 };
            let lag_rad = play.lag_rad();
            let shaft = match creep_mm > 0.0 {
                true => Shaft { backlog_rad: -lag_rad, creep_mm, ..Shaft::RIGID },
                false => Shaft {
                    slack_forward: slack(lag_rad - lower),
                    slack_backward: slack(upper - lag_rad),
                    ..Shaft::RIGID
                },
            };
            // The arc turns with the depth, as a planned path does.
            let angle = share * CURVATURE_PER_MM * f64::from(step);
            let toward = toward * angle.cos() - Vector3::z() * angle.sin();
            let heading = tip.rotation * Vector3::z();
            let bend = Bend {
                toward: (toward - heading * toward.dot(&heading)).normalize(),
                curvature_per_mm: share * CURVATURE_PER_MM,
                remaining_mm: 1e6,
                may_turn: true,
                in_plane,
            };
            let command = law.command(&estimate(tip, shaft), &bend, 1.0).unwrap();
            base_rad += command.rotation_rad_per_mm;
            most_rad = most_rad.max(base_rad.abs());
            for increment in
                play.advance(&torsion, Increment::new(1.0, command.rotation_rad_per_mm).unwrap())
            {
                tip = needle.step(&tip, increment);
            }
        }
        (tip, most_rad)
    }

    /// A target straight ahead gives no direction to bend to. The base turns back and forth, so the cable is not
    /// wound up.
    #[test]
    fn a_target_straight_ahead_does_not_wind_up_the_base() {
        let needle = Needle::new(CURVATURE_PER_MM).unwrap();
        for aside_mm in [0.0, 0.1, 0.5, 2.0] {
            let (mut tip, mut law) = (Pose::identity(), BendLaw::new(needle, config()));
            let target_mm = Vector3::new(0.6 * aside_mm, 0.8 * aside_mm, LENGTH_MM);
            let mut base_rad = 0.0f64;
            while target_mm.z - tip.translation.z > 4.0 {
                let (way, heading) = (target_mm - tip.translation, tip.rotation * Vector3::z());
                let across = way - heading * way.dot(&heading);
                let bend = Bend {
                    toward: across.try_normalize(1e-9).unwrap_or_default(),
                    curvature_per_mm: 2.0 * across.norm() / way.norm_squared(),
                    remaining_mm: way.norm(),
                    may_turn: true,
                    in_plane: false,
                };
                let command = law.command(&known(tip), &bend, 1.0).unwrap();
                base_rad += command.rotation_rad_per_mm;
                assert!(base_rad.abs() < 3.0 * TAU, "{base_rad} at {}", tip.translation);
                tip = needle.step(&tip, Increment::new(1.0, command.rotation_rad_per_mm).unwrap());
            }
            let off_mm = (target_mm - tip.translation).xy().norm();
            assert!(off_mm < 0.5, "{aside_mm}: {off_mm}");
        }
    }

    /// However much the demand has summed up, the roll is held until the path has room for a turn.
    #[test]
    fn a_turn_starts_only_where_the_path_has_room_for_it() {
        let needle = Needle::new(CURVATURE_PER_MM).unwrap();
        let mut law = BendLaw::new(needle, config());
        let estimate = known(Pose::identity());
        let mut rotation_rad_per_mm = |may_turn| {
            let bend = Bend {
                toward: -Vector3::y(),
                curvature_per_mm: 0.3 * CURVATURE_PER_MM,
                remaining_mm: 1e6,
                may_turn,
                in_plane: false,
            };
            law.command(&estimate, &bend, 1.0).unwrap().rotation_rad_per_mm
        };
        assert!((0..20).all(|_| rotation_rad_per_mm(false).abs() < 1e-9));
        // Once begun, a turn is finished.
        let turn: Vec<f64> = (0..6).map(|step| rotation_rad_per_mm(step == 0)).collect();
        assert!(turn.iter().all(|turn| (turn.abs() - PI / 3.0).abs() < 1e-9), "{turn:?}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// From any roll, through creep or play, the final heading is that of the arc, within what the turns of the
        /// base cost. A straight path through play drifts; replanning corrects that, so `share` starts at 0.1.
        #[test]
        fn follows_an_arc_of_any_curvature_to_any_side(
            share in 0.1..0.95f64, side in 0.0..TAU, roll in -3.0..3.0f64, kind in 0..3u32, in_plane in any::<bool>(),
        ) {
            let torsion = match kind {
                0 => TorsionConfig::default(),
                1 => TorsionConfig { creep_mm: 1.2, ..TorsionConfig::default() },
                _ => TorsionConfig { half_width_rad: 0.4, ..TorsionConfig::default() },
            };
            let side = if in_plane { 0.5 * PI * side.cos().signum() } else { side };
            let toward = Vector3::new(side.cos(), side.sin(), 0.0);
            let rotation = FixedAngles { roll, ..FixedAngles::default() }.to_rotation();
            let start = Pose { rotation, translation: Vector3::zeros() };
            let (tip, most_rad) = follow(share, toward, start, torsion, in_plane);
            let angle = share * CURVATURE_PER_MM * LENGTH_MM;
            let wanted = toward * angle.sin() + Vector3::z() * angle.cos();
            let off_rad = (tip.rotation * Vector3::z()).angle(&wanted);
            // Half a turn at the start takes 3 mm, and each turn 6 mm. Keeping to the plane costs more.
            let most_mm = if in_plane { 30.0 } else { 15.0 };
            prop_assert!(off_rad < most_mm * CURVATURE_PER_MM, "{off_rad}");
            prop_assert!(most_rad < 3.0 * TAU, "{most_rad}");
        }
    }
}
