//! The planar control law that holds from everywhere: nested saturation, with the shaft's torsion
//! compensated.

use super::spin_guard::SpinGuard;
use super::{Command, ControlError, Controller};
use crate::needle::{Needle, Reduced};
use crate::observer::{Belief, Estimate, Shaft, Slack};
use crate::units::wrap_angle;
use std::f64::consts::{PI, TAU};

/// Pitch, rad, past which yaw and roll cannot be told apart well enough to steer by.
const PITCH_LIMIT_RAD: f64 = 80.0 / 180.0 * PI;
/// Below this base rotation, rad, a way to the other edge of the band is none.
const SLACK_MIN_RAD: f64 = 0.02;
/// Of the turn that is still to come, at least this part is expected within a step: the inverse of
/// a longer creep would command nothing but noise.
const FOLLOWED_MIN: f64 = 0.5;
/// Net rotation allowed in the spin window beside one way through the band: while the roll is not
/// known the law tries more than one, and each may be most of a turn away.
const SPIN_LIMIT_RAD: f64 = 3.0 * TAU;

/// What the law is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NestedSaturationConfig {
    /// Decay rate of the distance from the plane, per mm.
    pub distance_rate_per_mm: f64,
    /// Decay rate of the pitch error, per mm.
    pub pitch_rate_per_mm: f64,
    /// The law never steers towards the plane at more than this pitch, rad.
    pub pitch_demand_max_rad: f64,
    /// Part of the needle's bend that the way into the plane counts on, up to 1.
    pub bend_part: f64,
    /// The law never asks for faster turning of the base, rad/mm.
    pub rotation_max_rad_per_mm: f64,
    /// Demands under this, rad, do not make the base cross the band to its other edge…
    pub reversal_min_rad: f64,
    /// … nor do those under so many standard deviations of the way there.
    pub reversal_sd: f64,
    /// Part of the demand that is withheld while nothing is known of the roll.
    pub caution: f64,
}

/// Nested saturation: the distance x asks for a pitch, the pitch for a roll, the roll for a turn,
/// each within what the needle can do.
///
/// * The demanded pitch is `−sign(x) min(k |x|, β_b(x), β_max)`, where `β_b = acos(1 − b κ |x|)` is
///   the pitch from which an arc of the bend b κ just ends in the plane: the second of the two
///   arcs that are the shortest way ([`shortest_into_plane_mm`](crate::needle::shortest_into_plane_mm)).
/// * The demanded roll has `κ sin γ` equal to the pitch error's decay and the demand's own rate
///   along the path (`x′ = sin β`, paper Eq. 3), never past ±κ. Of γ and π − γ the nearer one.
/// * The turn is the way to that roll and the feed-forward `κ cos γ tan β` that holds it (Eq. 3).
///
/// The inverse of the play makes the turn one of the base: the way to the edge of the band comes
/// first. Crossing it costs what is not known of its width, so small demands do not. Curvature and
/// shaft are the observer's where it estimates them.
#[derive(Debug, Clone)]
pub struct NestedSaturation {
    needle: Needle,
    config: NestedSaturationConfig,
    /// Direction in which the base is under way through the band.
    crossing: Option<f64>,
    spin: SpinGuard,
}

impl NestedSaturation {
    /// The law for a needle of believed curvature.
    pub fn new(needle: Needle, config: NestedSaturationConfig) -> Self {
        NestedSaturation { needle, config, crossing: None, spin: SpinGuard::default() }
    }

    /// The pitch to steer at from distance `x_mm`, rad, and its derivative by x, per mm.
    fn pitch_demand(&self, x_mm: f64, curvature_per_mm: f64, rate_per_mm: f64) -> (f64, f64) {
        let distance_mm = x_mm.abs();
        let bend = self.config.bend_part * curvature_per_mm;
        let cos_brake = (1.0 - bend * distance_mm).max(0.0);
        let (linear, brake) = (rate_per_mm * distance_mm, cos_brake.acos());
        let most = self.config.pitch_demand_max_rad;
        let (demand, slope) = if linear.min(brake) >= most {
            (most, 0.0)
        } else if linear <= brake {
            (linear, rate_per_mm)
        } else {
            (brake, bend / (1.0 - cos_brake * cos_brake).sqrt())
        };
        (-demand.copysign(x_mm), -slope)
    }

    /// The sine of the roll that steers from `state` to the plane; past ±1 the needle cannot.
    fn demand(&self, state: &Reduced, curvature_per_mm: f64, step_mm: f64) -> f64 {
        // A rate that would overshoot within a step is none.
        let per_mm = |rate: f64| rate.min(0.5 / step_mm);
        let distance_rate = per_mm(self.config.distance_rate_per_mm);
        let (pitch_demand, slope) = self.pitch_demand(state.x_mm, curvature_per_mm, distance_rate);
        let pitch_rate = slope * state.pitch_rad.sin()
            + per_mm(self.config.pitch_rate_per_mm) * (pitch_demand - state.pitch_rad);
        pitch_rate / curvature_per_mm
    }

    /// The turn of the base over the next step that brings the tip to a roll of the sine `demand`,
    /// rad, with `hold_rad` of feed-forward.
    fn base_turn(&mut self, roll_rad: f64, demand: f64, hold_rad: f64, way: &Way) -> f64 {
        let near_rad = demand.asin();
        let to = [near_rad, PI - near_rad].map(|goal| wrap_angle(goal - roll_rad));
        let nearest = if to[0].abs() <= to[1].abs() { to[0] } else { to[1] };
        let push = |turn: f64| way.push(turn * way.sure + hold_rad);
        let wanted = push(nearest);
        let Slack { mean_rad, sd_rad } = way.slack(wanted);
        if mean_rad <= SLACK_MIN_RAD {
            self.crossing = None;
            return wanted + mean_rad.max(0.0).copysign(wanted);
        }
        if wanted.abs() < self.config.reversal_min_rad + self.config.reversal_sd * sd_rad {
            self.crossing = None;
            return 0.0;
        }
        // A band takes more than a step to cross, and the tip bends on meanwhile, so that the other
        // roll of this sine becomes the nearer one: a law that turned back each time would never
        // arrive.
        let under_way = self.crossing.filter(|&sign| way.slack(sign).mean_rad > SLACK_MIN_RAD);
        let sign = under_way.unwrap_or(wanted.signum());
        self.crossing = Some(sign);
        let onward = to.map(push).into_iter().filter(|push| push * sign > 0.0);
        let push = onward.min_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(wanted);
        push + way.slack(push).mean_rad.max(0.0).copysign(push)
    }
}

/// The way from a turn of the base to a turn of the tip.
struct Way {
    shaft: Shaft,
    /// Part of the backlog that the tip follows within a step.
    followed: f64,
    /// Part of a demand that is not withheld.
    sure: f64,
}

impl Way {
    fn new(belief: Option<&Belief>, caution: f64, step_mm: f64) -> Self {
        let Some(belief) = belief else {
            return Way { shaft: Shaft::RIGID, followed: 1.0, sure: 1.0 };
        };
        let shaft = belief.shaft;
        let followed = if shaft.creep_mm > 0.0 {
            (-(-step_mm / shaft.creep_mm).exp_m1()).max(FOLLOWED_MIN)
        } else {
            1.0
        };
        Way { shaft, followed, sure: 1.0 - caution * (1.0 - belief.roll_agreement) }
    }

    /// What the play has to push, so that the tip turns by `turn_rad` within the step.
    fn push(&self, turn_rad: f64) -> f64 {
        turn_rad / self.followed - self.shaft.backlog_rad
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
    fn command(&mut self, estimate: &Estimate, step_mm: f64) -> Result<Command, ControlError> {
        if !estimate.x_pb.is_finite() || !step_mm.is_finite() {
            return Err(ControlError::NotFinite);
        }
        let (state, _) = Reduced::split(&estimate.x_pb);
        if state.pitch_rad.abs() > PITCH_LIMIT_RAD {
            let (pitch_rad, limit_rad) = (state.pitch_rad, PITCH_LIMIT_RAD);
            return Err(ControlError::PitchOutOfDomain { pitch_rad, limit_rad });
        }
        let believed = self.needle.curvature_per_mm();
        let curvature =
            estimate.belief.map_or(believed, |belief| belief.curvature_per_mm).max(0.1 * believed);
        let demand = self.demand(&state, curvature, step_mm);
        let hold = curvature * state.roll_rad.cos() * state.pitch_rad.tan() * step_mm;
        let way = Way::new(estimate.belief.as_ref(), self.config.caution, step_mm);
        let turn = self.base_turn(state.roll_rad, demand.clamp(-1.0, 1.0), hold, &way);
        let wanted = turn / step_mm;
        if !wanted.is_finite() || !way.band_rad().is_finite() {
            return Err(ControlError::NotFinite);
        }
        let limit = self.config.rotation_max_rad_per_mm;
        let rotation_rad_per_mm = wanted.clamp(-limit, limit);
        let limit_rad = SPIN_LIMIT_RAD + way.band_rad();
        self.spin.turn(rotation_rad_per_mm * step_mm, step_mm, limit_rad)?;
        Ok(Command { rotation_rad_per_mm, saturated: demand.abs() > 1.0 || wanted.abs() > limit })
    }
}
