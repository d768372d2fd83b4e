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
    spin: SpinGuard,
}

impl NestedSaturation {
    /// The law for a needle of believed curvature.
    pub fn new(needle: Needle, config: NestedSaturationConfig) -> Self {
        NestedSaturation { needle, config, spin: SpinGuard::default() }
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

    /// The turn of the tip over the next step, rad, and whether it asks for all the bend there is.
    fn tip_turn(&self, state: &Reduced, curvature_per_mm: f64, step_mm: f64) -> (f64, bool) {
        // A rate that would overshoot within a step is none.
        let per_mm = |rate: f64| rate.min(0.5 / step_mm);
        let distance_rate = per_mm(self.config.distance_rate_per_mm);
        let (pitch_demand, slope) = self.pitch_demand(state.x_mm, curvature_per_mm, distance_rate);
        let pitch_rate = slope * state.pitch_rad.sin()
            + per_mm(self.config.pitch_rate_per_mm) * (pitch_demand - state.pitch_rad);
        let sine = pitch_rate / curvature_per_mm;
        let near = sine.clamp(-1.0, 1.0).asin();
        let [to_near, to_far] = [near, PI - near].map(|demand| wrap_angle(demand - state.roll_rad));
        let turn = if to_near.abs() <= to_far.abs() { to_near } else { to_far };
        let hold = curvature_per_mm * state.roll_rad.cos() * state.pitch_rad.tan() * step_mm;
        (turn + hold, sine.abs() > 1.0)
    }

    /// The turn of the base that turns the tip by `tip_turn_rad` over the next step: the inverse
    /// of play and creep.
    fn base_turn(&self, tip_turn_rad: f64, shaft: &Shaft, step_mm: f64) -> f64 {
        let followed = if shaft.creep_mm > 0.0 {
            (-(-step_mm / shaft.creep_mm).exp_m1()).max(FOLLOWED_MIN)
        } else {
            1.0
        };
        let push = tip_turn_rad / followed - shaft.backlog_rad;
        let Slack { mean_rad, sd_rad } =
            if push > 0.0 { shaft.slack_forward } else { shaft.slack_backward };
        let Config { reversal_min_rad, reversal_sd, .. } = self.config;
        if mean_rad > SLACK_MIN_RAD && push.abs() < reversal_min_rad + reversal_sd * sd_rad {
            return 0.0;
        }
        push + mean_rad.max(0.0).copysign(push)
    }
}

use NestedSaturationConfig as Config;

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
        let (turn, bent) = self.tip_turn(&state, curvature, step_mm);
        let (wanted, band_rad) = match &estimate.belief {
            Some(Belief { shaft, roll_agreement, .. }) => {
                let sure = 1.0 - self.config.caution * (1.0 - roll_agreement);
                let band = shaft.slack_forward.mean_rad + shaft.slack_backward.mean_rad;
                (self.base_turn(turn * sure, shaft, step_mm) / step_mm, band.max(0.0))
            }
            None => (turn / step_mm, 0.0),
        };
        if !wanted.is_finite() || !band_rad.is_finite() {
            return Err(ControlError::NotFinite);
        }
        let limit = self.config.rotation_max_rad_per_mm;
        let rotation_rad_per_mm = wanted.clamp(-limit, limit);
        let limit_rad = SPIN_LIMIT_RAD + band_rad;
        self.spin.turn(rotation_rad_per_mm * step_mm, step_mm, limit_rad)?;
        Ok(Command { rotation_rad_per_mm, saturated: bent || wanted.abs() > limit })
    }
}
