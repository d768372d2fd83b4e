//! Nested saturation: the planar control law that works from every start, with compensation of the
//! shaft's torsion.

use super::spin_guard::{SEARCHING_SPIN_RAD, SpinGuard};
use super::{Command, Controller, NOT_FINITE, RATE, ROTATION, state_within};
use crate::keys::{over, section, within};
use crate::math;
use crate::needle::{Needle, Reduced};
use crate::observer::{Estimate, Shaft, Slack};
use crate::units::wrap_angle;
use std::f64::consts::PI;

/// Pitch limit, rad: beyond it yaw and roll cannot be separated well enough to steer.
const PITCH_LIMIT_RAD: f64 = 80.0 / 180.0 * PI;
/// A distance to the other edge of the band below this base rotation, rad, counts as zero.
const SLACK_MIN_RAD: f64 = 0.02;
/// The tip is assumed to make at least this share of the outstanding turn within a step. Inverting a slower creep
/// would amplify noise.
const FOLLOWED_MIN: f64 = 0.5;

section! {
    /// `[control.nested_saturation]`: parameters of the law.
    #[derive(Copy)]
    pub struct NestedSaturationConfig {
        /// Decay rate of the distance from the plane, per mm.
        distance_rate_per_mm: f64 [RATE] = 0.08;
        /// Decay rate of the pitch error, per mm.
        pitch_rate_per_mm: f64 [RATE] = 0.2;
        /// The law never steers towards the plane at more than this pitch.
        pitch_demand_max_rad as "pitch_demand_max_deg": f64 [over(0.0, 60.0)] = 30.0;
        /// Part of the needle's bend that the way into the plane counts on.
        bend_part: f64 [over(0.0, 1.0)] = 0.9;
        /// The law never turns the base faster.
        rotation_max_rad_per_mm as "rotation_max_deg_per_mm": f64 [ROTATION] = 60.0;
        /// Smaller turns of the tip do not make the base cross the torsion's band.
        reversal_min_rad as "reversal_min_deg": f64 [within(0.0, 45.0)] = 4.5;
        /// Nor do turns under so many standard deviations of that band's width.
        reversal_sd: f64 [within(0.0, 10.0)] = 1.0;
        /// Part of each turn that is withheld while the roll is unknown.
        caution: f64 [within(0.0, 1.0)] = 0.5;
    }
}

/// Nested saturation: the distance x demands a pitch, the pitch demands a roll, and the roll demands a
/// turn, each limited to what the needle can do.
///
/// * The demanded pitch is `−sign(x) min(k |x|, β_b(x), β_max)`. `β_b = acos(1 − b κ |x|)` is the
///   pitch from which an arc of curvature b κ just ends in the plane: the second of the two arcs of the
///   shortest path ([`shortest_into_plane_mm`](crate::needle::shortest_into_plane_mm)).
/// * The demanded roll has `κ sin γ` equal to the decay of the pitch error plus the rate of the demand
///   along the path (`x′ = sin β`, paper Eq. 3), limited to ±κ. The law takes the nearer of γ and π − γ.
/// * The demanded turn is the difference to that roll, plus the feed-forward `κ cos γ tan β` that holds it
///   (Eq. 3).
///
/// The inverse of the play converts the turn of the tip into a turn of the base: the base first turns to the
/// edge of the band. Crossing the band adds the uncertainty of its width to the roll, so small demands do
/// not cross it. The law uses the observer's curvature and torsion if the observer estimates them.
#[derive(Debug, Clone)]
pub struct NestedSaturation {
    needle: Needle,
    config: NestedSaturationConfig,
    /// Direction in which the base is crossing the band.
    crossing: Option<f64>,
    spin: SpinGuard,
}

impl NestedSaturation {
    /// The law for a needle of assumed curvature.
    pub fn new(needle: Needle, config: NestedSaturationConfig) -> Self {
        NestedSaturation { needle, config, crossing: None, spin: SpinGuard::default() }
    }

    /// The curvature that the law assumes, per mm.
    pub(super) fn curvature_per_mm(&self, estimate: &Estimate) -> f64 {
        let believed = self.needle.curvature_per_mm();
        let estimated = estimate.belief.map_or(believed, |belief| belief.curvature_per_mm);
        estimated.max(0.1 * believed)
    }

    pub(super) fn transmission(&self, estimate: &Estimate, step_mm: f64) -> Transmission {
        let shaft = estimate.belief.map_or(Shaft::RIGID, |belief| belief.shaft);
        let followed = if shaft.creep_mm > 0.0 {
            (-math::exp_m1(-step_mm / shaft.creep_mm)).max(FOLLOWED_MIN)
        } else {
            1.0
        };
        Transmission { shaft, followed, demand_gain: estimate.demand_gain(self.config.caution) }
    }

    /// The fastest rotation, rad/mm.
    pub(super) fn rotation_max_rad_per_mm(&self) -> f64 {
        self.config.rotation_max_rad_per_mm
    }

    /// The pitch demanded at distance `x_mm`, rad, and its derivative with respect to x, per mm.
    fn pitch_demand(&self, x_mm: f64, curvature_per_mm: f64, rate_per_mm: f64) -> (f64, f64) {
        let distance_mm = x_mm.abs();
        let bend = self.config.bend_part * curvature_per_mm;
        let cos_brake = (1.0 - bend * distance_mm).max(0.0);
        let (linear, brake) = (rate_per_mm * distance_mm, math::acos(cos_brake));
        let most = self.config.pitch_demand_max_rad;
        let (demand, slope) = if linear.min(brake) >= most {
            (most, 0.0)
        } else if linear <= brake || (brake == 0.0 && bend > 0.0) {
            // The second condition holds so near to the plane that `1 - bend * distance_mm` rounds to 1.
            (linear, rate_per_mm)
        } else {
            (brake, bend / (1.0 - cos_brake * cos_brake).sqrt())
        };
        (-demand.copysign(x_mm), -slope)
    }

    /// The sine of the roll that steers from `state` to the plane; beyond ±1 the needle cannot bend enough.
    pub(super) fn demand(&self, state: &Reduced, curvature_per_mm: f64, step_mm: f64) -> f64 {
        // A rate that would overshoot within one step is limited.
        let per_mm = |rate: f64| rate.min(0.5 / step_mm);
        let distance_rate = per_mm(self.config.distance_rate_per_mm);
        let (pitch_demand, slope) = self.pitch_demand(state.x_mm, curvature_per_mm, distance_rate);
        let pitch_rate = slope * math::sin(state.pitch_rad)
            + per_mm(self.config.pitch_rate_per_mm) * (pitch_demand - state.pitch_rad);
        pitch_rate / curvature_per_mm
    }

    /// The turn of the base over the next step that turns the tip by the smaller of the two turns `to`, rad,
    /// plus the feed-forward `hold_rad`.
    pub(super) fn base_turn(
        &mut self,
        to: [f64; 2],
        hold_rad: f64,
        transmission: &Transmission,
    ) -> f64 {
        let nearest = if to[0].abs() <= to[1].abs() { to[0] } else { to[1] };
        let excess =
            |turn_rad: f64| transmission.excess_for(turn_rad * transmission.demand_gain + hold_rad);
        let wanted = excess(nearest);
        let Slack { mean_rad, sd_rad } = transmission.slack(wanted);
        if mean_rad <= SLACK_MIN_RAD {
            self.crossing = None;
            return wanted + mean_rad.max(0.0).copysign(wanted);
        }
        if wanted.abs() < self.config.reversal_min_rad + self.config.reversal_sd * sd_rad {
            self.crossing = None;
            return 0.0;
        }
        // Crossing the band takes more than one step. Meanwhile the tip bends further, so the other roll
        // with the same sine may become the nearer one. If the law turned back each time, it would never
        // finish the crossing.
        let ongoing =
            self.crossing.filter(|&sign| transmission.slack(sign).mean_rad > SLACK_MIN_RAD);
        let sign = ongoing.unwrap_or(wanted.signum());
        self.crossing = Some(sign);
        let onward = to.map(excess).into_iter().filter(|excess_rad| excess_rad * sign > 0.0);
        let chosen = onward.min_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(wanted);
        chosen + transmission.slack(chosen).mean_rad.max(0.0).copysign(chosen)
    }
}

/// The transmission from the base's rotation to the tip's roll.
pub(super) struct Transmission {
    shaft: Shaft,
    /// Share of the outstanding turn that the tip makes within a step.
    followed: f64,
    /// Share of each demanded turn that is commanded; less than 1 while the roll is uncertain.
    demand_gain: f64,
}

impl Transmission {
    /// The excess over the band that makes the tip turn by `turn_rad` within the step, rad.
    fn excess_for(&self, turn_rad: f64) -> f64 {
        turn_rad / self.followed - self.shaft.backlog_rad
    }

    /// Turn of the base in `direction`, rad, after which the tip has turned by `turn_rad` once it has stopped
    /// creeping.
    pub(super) fn base_turn_for(&self, turn_rad: f64, direction: f64) -> f64 {
        let slack_rad = self.slack(direction).mean_rad.max(0.0);
        turn_rad - self.shaft.backlog_rad + slack_rad.copysign(direction)
    }

    fn slack(&self, direction: f64) -> Slack {
        if direction > 0.0 { self.shaft.slack_forward } else { self.shaft.slack_backward }
    }

    /// Base rotation from one edge of the band to the other, rad.
    fn band_rad(&self) -> f64 {
        (self.shaft.slack_forward.mean_rad + self.shaft.slack_backward.mean_rad).max(0.0)
    }
}

impl Controller for NestedSaturation {
    fn command(&mut self, estimate: &Estimate, step_mm: f64) -> Result<Command, String> {
        let state = state_within(estimate, step_mm, PITCH_LIMIT_RAD)?;
        let curvature = self.curvature_per_mm(estimate);
        let demand = self.demand(&state, curvature, step_mm);
        let hold = curvature * math::cos(state.roll_rad) * math::tan(state.pitch_rad) * step_mm;
        let transmission = self.transmission(estimate, step_mm);
        let seen_rad = estimate.belief.map_or(0.5 * PI, |belief| belief.roll_seen_rad);
        let near_rad = math::asin(demand.clamp(-1.0, 1.0)).clamp(-seen_rad, seen_rad);
        let to = [near_rad, PI - near_rad].map(|goal| wrap_angle(goal - state.roll_rad));
        let wanted = self.base_turn(to, hold, &transmission) / step_mm;
        let spin_limit_rad = SEARCHING_SPIN_RAD + transmission.band_rad();
        if !spin_limit_rad.is_finite() {
            return Err(NOT_FINITE.to_owned());
        }
        let limit = self.config.rotation_max_rad_per_mm;
        let command = self.spin.command(wanted, limit, step_mm, spin_limit_rad)?;
        Ok(Command { saturated: command.saturated || demand.abs() > 1.0, ..command })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{FixedAngles, Pose};
    use crate::needle::{Fibre, Increment, Play, Torsion, TorsionConfig, shortest_into_plane_mm};
    use crate::observer::Belief;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    fn needle() -> Needle {
        Needle::new(1.0 / 122.0).unwrap()
    }

    fn law() -> NestedSaturation {
        let config = NestedSaturationConfig {
            distance_rate_per_mm: 0.08,
            pitch_rate_per_mm: 0.2,
            pitch_demand_max_rad: 0.5,
            bend_part: 0.9,
            rotation_max_rad_per_mm: 1.0,
            reversal_min_rad: 0.08,
            reversal_sd: 1.0,
            caution: 0.5,
        };
        NestedSaturation::new(needle(), config)
    }

    fn pose(x_mm: f64, pitch_rad: f64, roll_rad: f64) -> Pose {
        Reduced { x_mm, pitch_rad, roll_rad }.join(&Fibre::default())
    }

    /// An estimate without uncertainty.
    fn known(tip: Pose, torsion: &Torsion, play: &Play) -> Estimate {
        let (lower, upper) = torsion.band_rad(play.insertion_mm());
        let slack = |mean_rad: f64| Slack { mean_rad, sd_rad: 0.0 };
        let shaft = Shaft {
            slack_forward: slack(play.lag_rad() - lower),
            slack_backward: slack(upper - play.lag_rad()),
            ..Shaft::RIGID
        };
        Estimate::of_belief(tip, Belief::certain(needle().curvature_per_mm(), shaft))
    }

    /// Steers from `tip` with the state known; returns the distance from the plane at each mm.
    fn steer(mut tip: Pose, torsion: &Torsion) -> Vec<f64> {
        let (mut law, mut play) = (law(), Play::default());
        (0..250)
            .map(|_| {
                let command = law.command(&known(tip, torsion, &play), 1.0).unwrap();
                let base = Increment::new(1.0, command.rotation_rad_per_mm).unwrap();
                for increment in play.advance(torsion, base) {
                    tip = needle().step(&tip, increment);
                }
                tip.translation.x
            })
            .collect()
    }

    proptest! {
        /// From every start near the plane the tip reaches the plane, on little more than the
        /// shortest path, and stays there.
        #[test]
        fn comes_into_the_plane_and_stays(x in -8.0..8.0f64, pitch in -0.2..0.2f64, roll in -3.1..3.1f64) {
            let path = steer(pose(x, pitch, roll), &Torsion::default());
            let start = Reduced { x_mm: x, pitch_rad: pitch, roll_rad: roll };
            let shortest_mm = shortest_into_plane_mm(&needle(), &start).unwrap();
            let settled = path.iter().rposition(|x| x.abs() > 1.0).map_or(0, |last| last + 1);
            prop_assert!((settled as f64) < 1.3 * shortest_mm + 25.0, "{settled} mm against {shortest_mm}");
            prop_assert!(path[200..].iter().all(|x| x.abs() < 0.01));
        }

        /// The same holds with a band of known width.
        #[test]
        fn comes_into_the_plane_through_a_torsion_band(
            x in -8.0..8.0f64, pitch in -0.2..0.2f64, roll in -3.1..3.1f64,
            width in 0.0..1.0f64, growth in 0.0..0.01f64,
        ) {
            let torsion = Torsion::new(TorsionConfig {
                half_width_rad: width,
                half_width_rad_per_mm: growth,
                ..TorsionConfig::default()
            }).unwrap();
            let path = steer(pose(x, pitch, roll), &torsion);
            prop_assert!(path[200..].iter().all(|x| x.abs() < 0.3), "{:?}", &path[200..]);
        }

        /// For every estimate the command is finite and within the limit, or refused.
        #[test]
        fn never_commands_beyond_its_limit(
            x in -1e6..1e6f64, pitch in -1.57..1.57f64, roll in -4.0..4.0f64,
            slack in prop::array::uniform2(-1.0..10.0f64), sd in 0.0..10.0f64,
            backlog in -10.0..10.0f64, creep in 0.0..100.0f64, agreement in 0.0..1.0f64,
            curvature in -1.0..1.0f64, step in 0.1..10.0f64,
        ) {
            let mut estimate = known(pose(x, pitch, roll), &Torsion::default(), &Play::default());
            let belief = estimate.belief.as_mut().unwrap();
            (belief.roll_agreement, belief.curvature_per_mm) = (agreement, curvature);
            belief.shaft = Shaft {
                slack_forward: Slack { mean_rad: slack[0], sd_rad: sd },
                slack_backward: Slack { mean_rad: slack[1], sd_rad: sd },
                backlog_rad: backlog,
                creep_mm: creep,
            };
            let mut law = law();
            for _ in 0..60 {
                match law.command(&estimate, step) {
                    Ok(command) => prop_assert!(command.rotation_rad_per_mm.abs() <= 1.0),
                    Err(_) => return Ok(()),
                }
            }
        }
    }

    /// Settled means within 1 mm of the plane, so settling takes less than the whole path into it.
    #[test]
    fn settles_in_less_than_four_fifths_of_the_shortest_way_in_the_median() {
        let spread = |n: u32, ratio: f64| 2.0 * (f64::from(n) * ratio).fract() - 1.0;
        let mut ratios: Vec<f64> = (1..=300)
            .map(|n| {
                let (x_mm, pitch_rad, roll_rad) = (
                    8.0 * spread(n, 0.819_172_513),
                    0.2 * spread(n, 0.671_043_606),
                    PI * spread(n, 0.549_700_477),
                );
                let path = steer(pose(x_mm, pitch_rad, roll_rad), &Torsion::default());
                let settled = path.iter().rposition(|x| x.abs() > 1.0).map_or(0, |last| last + 2);
                let start = Reduced { x_mm, pitch_rad, roll_rad };
                settled as f64 / shortest_into_plane_mm(&needle(), &start).unwrap()
            })
            .collect();
        ratios.sort_by(f64::total_cmp);
        assert!(ratios[150] < 0.8, "{}", ratios[150]);
    }

    /// A small demand does not send the base through a band of unknown width.
    #[test]
    fn small_demands_do_not_cross_the_band() {
        let mut estimate = known(pose(0.0, 0.0, 0.1), &Torsion::default(), &Play::default());
        estimate.belief.as_mut().unwrap().shaft.slack_backward =
            Slack { mean_rad: 1.0, sd_rad: 0.2 };
        assert_eq!(law().command(&estimate, 1.0).unwrap().rotation_rad_per_mm, 0.0);
        let mut far = known(pose(0.0, 0.0, 0.4), &Torsion::default(), &Play::default());
        far.belief.as_mut().unwrap().shaft.slack_backward = Slack { mean_rad: 1.0, sd_rad: 0.2 };
        assert!(law().command(&far, 1.0).unwrap().rotation_rad_per_mm < -0.9);
    }

    /// Half of the demand is withheld while the roll is unknown.
    #[test]
    fn is_cautious_while_the_roll_is_not_known() {
        let mut estimate = known(pose(0.0, 0.0, 0.5), &Torsion::default(), &Play::default());
        let sure = law().command(&estimate, 1.0).unwrap().rotation_rad_per_mm;
        estimate.belief.as_mut().unwrap().roll_agreement = 0.0;
        let unsure = law().command(&estimate, 1.0).unwrap().rotation_rad_per_mm;
        assert!((sure + 0.5).abs() < 1e-9 && (unsure - 0.5 * sure).abs() < 1e-9);
    }

    /// Nearer to the plane than 1e-14 mm the arc into it rounds to nothing.
    #[test]
    fn the_command_is_continuous_at_the_plane() {
        let at = |x_mm, pitch_rad| {
            let estimate = Estimate::of_pose(pose(x_mm, pitch_rad, 0.1));
            law().command(&estimate, 1.0).map(|command| command.rotation_rad_per_mm)
        };
        for pitch_rad in [0.0, 0.05] {
            let in_plane = at(0.0, pitch_rad).unwrap();
            for x_mm in [1e-300, -1e-16, 7e-15, -1e-14, 1e-13] {
                let near = at(x_mm, pitch_rad).unwrap();
                assert!((near - in_plane).abs() < 1e-9, "{x_mm}: {near} {in_plane}");
            }
        }
    }

    #[test]
    fn refuses_estimates_outside_its_domain() {
        let steep = law().command(&Estimate::of_pose(pose(0.0, 1.5, 0.0)), 1.0).unwrap_err();
        assert!(steep.to_string().starts_with("estimated pitch is 85.9 deg"), "{steep}");
        let rotation = FixedAngles::default().to_rotation();
        let nan = Pose { rotation, translation: Vector3::new(f64::NAN, 0.0, 0.0) };
        assert_eq!(law().command(&Estimate::of_pose(nan), 1.0), Err(NOT_FINITE.to_owned()));
        let mut for_straight = NestedSaturation::new(Needle::new(0.0).unwrap(), law().config);
        let at = Estimate::of_pose(pose(1.0, 0.1, 0.0));
        assert_eq!(for_straight.command(&at, 1.0), Err(NOT_FINITE.to_owned()));
    }
}
