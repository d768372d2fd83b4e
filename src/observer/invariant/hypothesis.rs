//! One hypothesis: a left-invariant extended Kalman filter on the tip's pose, the needle's
//! curvature and the torsion of its shaft.
//!
//! The kinematics are left-invariant, so the error `ε` of `g = ĝ Exp(ε)` propagates by
//! `F = Ad(Exp(−ξ))`, independently of the tip's pose. The measured position is expressed in the
//! tip frame, `ĝ⁻¹ y`, with `H = [I 0]` (the invariant filter of Barrau and Bonnabel). Curvature
//! and torsion are additional states.

use super::error_state::{
    ANCHOR, BACKLOG, CURVATURE, Covariance, ErrorState, Extent, GROWTH, LAG, LOWER, PoseMap, ROLL,
    Transition, UPPER, bracket,
};
use super::positive_part::PositivePart;
use crate::geometry::{Pose, Twist};
use crate::math;
use crate::needle::{Increment, Needle, TipPosition};
use crate::observer::Slack;
use nalgebra::{Matrix3, Vector3};

/// A turn against the stroke starts a new stroke if it comes within a margin of the other edge: this angle, rad, plus
/// [`REVERSAL_MARGIN_SD`] standard deviations.
const REVERSAL_MARGIN_RAD: f64 = 0.05;
/// The part of that margin in standard deviations of the distance to the edge.
const REVERSAL_MARGIN_SD: f64 = 5.0;

/// What a restart adds to the uncertainty of the pose. It need not cover a large error, since the next restart adds to
/// it again.
const RESTART_POSITION_SD_MM: f64 = 0.1;
const RESTART_HEADING_SD_RAD: f64 = 0.03;

/// The innovation of one hypothesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Innovation {
    /// Its normalised square (NIS): χ² with three degrees of freedom.
    pub(super) square: f64,
    /// Its part across the heading in units of its standard deviation, in the plane frame.
    pub(super) across: Vector3<f64>,
}

/// Process noise, as variances per mm of insertion.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct ProcessNoise {
    pub(super) position_mm2_per_mm: f64,
    pub(super) axial_mm2_per_mm: f64,
    pub(super) heading_rad2_per_mm: f64,
    pub(super) roll_rad2_per_mm: f64,
    pub(super) curvature_per_mm3: f64,
    pub(super) edge_rad2_per_mm: f64,
}

/// The play as one hypothesis estimates it: edges at depth 0, growth, and creep.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Band {
    pub(super) lower_rad: f64,
    pub(super) upper_rad: f64,
    pub(super) growth_rad_per_mm: f64,
    pub(super) creep_mm: f64,
    pub(super) creep_mm_per_mm: f64,
}

/// The base's rotation in one direction since it last reversed.
///
/// The play pushes the tip where the lag would otherwise leave the band. Over a stroke in the
/// positive direction it pushes by the largest value so far of `max(L(ℓ) − λₐ + θ, 0)`: L is the
/// lower edge, θ the rotation since the start of the stroke, and λₐ the lag at the start (the
/// anchor). The anchor is a state of the filter, so an uncertain edge is crossed only once, however
/// finely the stroke is divided.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Stroke {
    /// +1 for the positive direction, towards the lower edge; −1 for the negative, towards the
    /// upper.
    sign: f64,
    /// Base rotation since the start of the stroke, rad.
    turned_rad: f64,
    /// Where the base was farthest beyond the edge: `sign · turned`, rad, and depth, mm.
    farthest: (f64, f64),
}

/// Mean and covariance of one hypothesis.
#[derive(Debug, Clone)]
pub(super) struct Hypothesis {
    pub(super) x_pb: Pose,
    pub(super) curvature_per_mm: f64,
    /// How far the tip is ahead of the point that moves along the shaft's axis, mm.
    tip_ahead_mm: f64,
    pub(super) band: Band,
    pub(super) backlog_rad: f64,
    pub(super) lag_rad: f64,
    anchor_rad: f64,
    pub(super) insertion_mm: f64,
    stroke: Stroke,
    pub(super) covariance: Covariance,
    /// Transition since the covariance was last propagated; a correction's Jacobian is its first part.
    pending: Transition,
    pending_mm: f64,
    /// Logarithm of the weight, up to a constant common to the bank.
    pub(super) log_weight: f64,
}

/// `J_r(ξ) τ`, the right Jacobian of SE(3) times a twist: how the end of a step moves, seen from the end, when
/// its twist changes by `tau`. By the series `Σ (−ad_ξ)ᵏ τ / (k + 1)!`.
fn right_jacobian_times(xi: &Twist, tau: [f64; 6]) -> [f64; 6] {
    let (mut term, mut sum) = (tau, tau);
    for k in 2..16 {
        term = bracket(xi, &term).map(|t| -t / f64::from(k));
        sum = std::array::from_fn(|i| sum[i] + term[i]);
        if term.iter().all(|t| t.abs() < 1e-7) {
            break;
        }
    }
    sum
}

fn add_scaled(sum: &mut [f64; 6], twist: &[f64; 6], factor: f64) {
    for (s, t) in sum.iter_mut().zip(twist) {
        *s += t * factor;
    }
}

impl Hypothesis {
    pub(super) fn new(
        x_pb: Pose,
        needle: &Needle,
        band: Band,
        covariance: Covariance,
        log_weight: f64,
    ) -> Self {
        // The lag counts from 0. If 0 is outside the band, the tip still has to creep to the edge:
        // the distance is the first backlog.
        let lag_rad = 0f64.clamp(band.lower_rad, band.upper_rad);
        Hypothesis {
            x_pb,
            curvature_per_mm: needle.curvature_per_mm(),
            tip_ahead_mm: needle.tip_ahead_mm(),
            band,
            backlog_rad: lag_rad,
            lag_rad,
            anchor_rad: lag_rad,
            insertion_mm: 0.0,
            stroke: Stroke { sign: 1.0, turned_rad: 0.0, farthest: (0.0, 0.0) },
            covariance,
            pending: Transition::none(),
            pending_mm: 0.0,
            log_weight,
        }
    }

    /// True if the shaft has play, or may have: the tip then lags behind the base.
    fn has_play(&self) -> bool {
        let Band { lower_rad, upper_rad, growth_rad_per_mm, .. } = self.band;
        self.covariance.extent() == Extent::Banded
            || upper_rad > lower_rad
            || growth_rad_per_mm != 0.0
    }

    /// The edge that the lag follows while the base turns in the direction `sign`: its state, and
    /// its value at depth 0, rad.
    fn edge(&self, sign: f64) -> (usize, f64) {
        if sign > 0.0 { (LOWER, self.band.lower_rad) } else { (UPPER, self.band.upper_rad) }
    }

    /// Base rotation in the direction `sign` before the tip starts to turn.
    pub(super) fn slack(&self, sign: f64) -> Slack {
        let (edge, edge_rad) = self.edge(sign);
        let depth = self.insertion_mm;
        let mean_rad = sign * (self.lag_rad - edge_rad) + self.band.growth_rad_per_mm * depth;
        let variance =
            self.covariance.variance_of(&[(LAG, 1.0), (edge, -1.0), (GROWTH, sign * depth)]);
        Slack { mean_rad, sd_rad: variance.sqrt() }
    }

    /// How far beyond the edge the lag would be at that point of the stroke if the edge did not
    /// hold it, rad: mean and standard deviation.
    fn beyond(&self, (drive_rad, depth_mm): (f64, f64)) -> (f64, f64) {
        let sign = self.stroke.sign;
        let (edge, edge_rad) = self.edge(sign);
        let mean = sign * (edge_rad - self.anchor_rad) - self.band.growth_rad_per_mm * depth_mm
            + drive_rad;
        let terms = [(edge, 1.0), (ANCHOR, -1.0), (GROWTH, -sign * depth_mm)];
        (mean, self.covariance.variance_of(&terms).sqrt())
    }

    /// Turns the base by `turn_rad` on the way to `depth_mm`. Returns by how much the play pushes
    /// the tip, rad, and the derivatives of this with respect to the edge's distance from the
    /// anchor and to the growth.
    fn push(&mut self, turn_rad: f64, depth_mm: f64) -> (f64, f64, f64) {
        if !self.has_play() {
            return (turn_rad, 0.0, 0.0);
        }
        if turn_rad * self.stroke.sign < 0.0 {
            let Slack { mean_rad, sd_rad } = self.slack(-self.stroke.sign);
            let margin_rad = REVERSAL_MARGIN_RAD + REVERSAL_MARGIN_SD * sd_rad;
            if turn_rad.abs() >= mean_rad - margin_rad {
                self.reverse();
            }
        }
        let sign = self.stroke.sign;
        self.stroke.turned_rad += turn_rad;
        let (before, now) = (self.stroke.farthest, (sign * self.stroke.turned_rad, depth_mm));
        let reach =
            |(drive_rad, depth_mm): (f64, f64)| drive_rad - self.band.growth_rad_per_mm * depth_mm;
        let (mut pushed_rad, mut by_edge, mut by_growth) = (0.0, 0.0, 0.0);
        if reach(now) > reach(before) {
            let ((from, from_sd), (to, to_sd)) = (self.beyond(before), self.beyond(now));
            let (first, last) = (PositivePart::of(from, from_sd), PositivePart::of(to, to_sd));
            pushed_rad = sign * (last.mean - first.mean);
            by_edge = last.gain - first.gain;
            // A lag that is held at the edge moves with the edge.
            by_growth = sign * (first.gain * before.1 - last.gain * now.1);
            self.pending.push_variance +=
                PositivePart::residual_variance(from, 0.5 * (from_sd + to_sd), to - from);
            self.stroke.farthest = now;
        }
        self.lag_rad += pushed_rad - turn_rad;
        (pushed_rad, by_edge, by_growth)
    }

    /// Starts a stroke in the other direction, with the present lag as its anchor.
    fn reverse(&mut self) {
        self.propagate_covariance(None);
        self.anchor_rad = self.lag_rad;
        self.covariance.copy_state(LAG, ANCHOR);
        let farthest = (0.0, self.insertion_mm);
        self.stroke = Stroke { sign: -self.stroke.sign, turned_rad: 0.0, farthest };
    }

    /// The fractions that are still backlog after `increment_mm`: first of a push that is spread evenly over
    /// it, then of the backlog at its start.
    fn creep(&self, increment_mm: f64) -> (f64, f64) {
        let Band { creep_mm, creep_mm_per_mm, .. } = self.band;
        let length_mm = creep_mm + creep_mm_per_mm * (self.insertion_mm + 0.5 * increment_mm);
        if length_mm <= 0.0 {
            return (0.0, 0.0);
        }
        let ratio = increment_mm / length_mm;
        let of_push = if ratio < 1e-9 { 1.0 } else { -math::exp_m1(-ratio) / ratio };
        (of_push, math::exp(-ratio))
    }

    /// The insertion over which the backlog falls to 1/e, at the present depth, mm.
    pub(super) fn creep_length_mm(&self) -> f64 {
        self.band.creep_mm + self.band.creep_mm_per_mm * self.insertion_mm
    }

    /// Propagates the mean over one measured increment of the base. The covariance follows when it
    /// is next needed.
    pub(super) fn predict(&mut self, increment: Increment) {
        let insertion_mm = increment.insertion_mm();
        let (pushed_rad, by_edge, by_growth) =
            self.push(increment.rotation_rad(), self.insertion_mm + insertion_mm);
        let (push_kept, backlog_kept) = self.creep(insertion_mm);
        let backlog_rad = backlog_kept * self.backlog_rad + push_kept * pushed_rad;
        let turn_rad = self.backlog_rad + pushed_rad - backlog_rad;
        self.backlog_rad = backlog_rad;
        let [slip_mm, bend_rad] = [-self.tip_ahead_mm, 1.0].map(|by| by * insertion_mm);
        let xi = Twist {
            v: Vector3::new(0.0, self.curvature_per_mm * slip_mm, insertion_mm),
            w: Vector3::new(self.curvature_per_mm * bend_rad, 0.0, turn_rad),
        };
        let step = Pose::exp(&xi);
        let back = PoseMap::adjoint_inverse(&step);

        let t = &mut self.pending;
        t.by_curvature = back.times(&t.by_curvature);
        let bend = right_jacobian_times(&xi, [0.0, slip_mm, 0.0, bend_rad, 0.0, 0.0]);
        add_scaled(&mut t.by_curvature, &bend, 1.0);
        if self.covariance.extent() != Extent::Rigid {
            let roll = right_jacobian_times(&xi, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
            let followed = 1.0 - backlog_kept;
            t.by_backlog = back.times(&t.by_backlog);
            add_scaled(&mut t.by_backlog, &roll, t.backlog_kept * followed);
            t.backlog_kept *= backlog_kept;
            for (pushed, by) in [(&mut t.by_edge, by_edge), (&mut t.by_growth, by_growth)] {
                pushed.pose = back.times(&pushed.pose);
                let turn = pushed.backlog * followed + by * (1.0 - push_kept);
                add_scaled(&mut pushed.pose, &roll, turn);
                pushed.backlog = pushed.backlog * backlog_kept + by * push_kept;
                pushed.lag += by;
            }
        }
        t.pose = back * t.pose;
        self.pending_mm += insertion_mm;
        self.insertion_mm += insertion_mm;
        self.x_pb = self.x_pb * step;
    }

    /// The transition since the covariance was last propagated.
    pub(super) fn transition(&self) -> Transition {
        Transition { push_edge: self.edge(self.stroke.sign).0, ..self.pending }
    }

    /// Propagates the covariance over the pending transition, and adds `noise` for the depth of it.
    pub(super) fn propagate_covariance(&mut self, noise: Option<&ProcessNoise>) {
        let transition = self.transition();
        self.pending = Transition::none();
        self.covariance.propagate(&transition);
        if let Some(noise) = noise {
            let depth_mm = std::mem::take(&mut self.pending_mm);
            for across in [0, 1] {
                self.covariance.add_variance(across, noise.position_mm2_per_mm * depth_mm);
                self.covariance.add_variance(3 + across, noise.heading_rad2_per_mm * depth_mm);
            }
            self.covariance.add_variance(2, noise.axial_mm2_per_mm * depth_mm);
            self.covariance.add_roll_variance(noise.roll_rad2_per_mm * depth_mm);
            self.covariance.add_variance(CURVATURE, noise.curvature_per_mm3 * depth_mm);
            // Without an uncertain band the tip creeps toward the band's middle, so the random walk of the
            // edges acts on the backlog.
            let edges: &[usize] = match self.covariance.extent() {
                Extent::Rigid => &[],
                Extent::Creeping => &[BACKLOG],
                Extent::Banded => &[LOWER, UPPER],
            };
            for &edge in edges {
                self.covariance.add_variance(edge, noise.edge_rad2_per_mm * depth_mm);
            }
        }
    }

    /// Corrects with a measured position. Returns its innovation, or `None` if the innovation's covariance is not
    /// positive. The hypothesis' covariance must have been propagated.
    pub(super) fn correct(
        &mut self,
        tip_meas: &TipPosition,
        variance_mm2: f64,
    ) -> Option<Innovation> {
        let off_mm = tip_meas.mm() - self.x_pb.translation;
        let innovation = self.x_pb.rotation.inverse_transform_vector(&off_mm);
        let s = self.covariance.position() + Matrix3::identity() * variance_mm2;
        let factor = s.cholesky()?;
        let weight = factor.inverse();
        let whitened = factor.l_dirty().solve_lower_triangular(&innovation)?;
        let across = self.x_pb.rotation * Vector3::new(whitened.x, whitened.y, 0.0);
        let square = innovation.dot(&(weight * innovation));
        self.log_weight -= 0.5 * (square + math::ln(s.determinant()));
        let delta = self.covariance.correct(&innovation, &weight);
        // The error is now that of the corrected pose: `Exp(ε⁺) = Exp(−δ) Exp(ε)`.
        self.pending.pose = PoseMap::right_jacobian(&self.apply(&delta)) * self.pending.pose;
        Some(Innovation { square, across })
    }

    /// The hypothesis that the tip has turned by `roll_rad` unnoticed, with the standard deviation `roll_sd_rad` and this
    /// share of the weight. Heading, position and, by `curvature_sd_per_mm`, the curvature may have changed as well.
    pub(super) fn restarted(
        &self,
        roll_rad: f64,
        roll_sd_rad: f64,
        curvature_sd_per_mm: f64,
        share: f64,
    ) -> Self {
        let mut h = self.clone();
        h.propagate_covariance(None);
        let turn = Pose::exp(&Twist { v: Vector3::zeros(), w: Vector3::new(0.0, 0.0, roll_rad) });
        h.x_pb = h.x_pb * turn;
        h.covariance
            .propagate(&Transition { pose: PoseMap::adjoint_inverse(&turn), ..Transition::none() });
        for across in [0, 1] {
            h.covariance.add_variance(across, RESTART_POSITION_SD_MM.powi(2));
            h.covariance.add_variance(3 + across, RESTART_HEADING_SD_RAD.powi(2));
        }
        h.covariance.add_variance(ROLL, roll_sd_rad.powi(2));
        h.covariance.add_variance(CURVATURE, curvature_sd_per_mm.powi(2));
        h.log_weight += math::ln(share);
        h
    }

    /// Moves the mean by `delta`. Returns the pose part of `delta`.
    pub(super) fn apply(&mut self, delta: &ErrorState) -> Twist {
        let xi = Twist {
            v: Vector3::new(delta[0], delta[1], delta[2]),
            w: Vector3::new(delta[3], delta[4], delta[5]),
        };
        self.x_pb = (self.x_pb * Pose::exp(&xi)).renormalized();
        self.curvature_per_mm += delta[CURVATURE];
        self.backlog_rad += delta[BACKLOG];
        self.lag_rad += delta[LAG];
        self.anchor_rad += delta[ANCHOR];
        self.band.lower_rad += delta[LOWER];
        self.band.upper_rad += delta[UPPER];
        self.band.growth_rad_per_mm += delta[GROWTH];
        xi
    }

    /// True while pose, curvature, backlog, lag, weight and covariance are finite and no variance is negative.
    pub(super) fn is_sound(&self) -> bool {
        self.x_pb.is_finite()
            && [self.curvature_per_mm, self.backlog_rad, self.lag_rad, self.log_weight]
                .iter()
                .all(|v| v.is_finite())
            && self.covariance.is_sound()
    }
}
