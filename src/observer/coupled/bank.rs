//! The coupled observer for any roll at the start: a bank of copies, spread over all rolls and weighted by
//! their innovations, until one is left.

use super::CoupledConfig;
use crate::geometry::{FixedAngles, Pose, so3};
use crate::math;
use crate::needle::{Increment, Needle, TipPosition};
use crate::observer::mixture::{self, ALIKE_SD};
use crate::observer::{Belief, Estimate, Observer, Shaft, start};
use nalgebra::{Matrix3, Matrix6, Matrix6x3, Vector3};
use std::f64::consts::PI;

/// Number of copies for an unknown roll. x alone corrects the roll of a copy, so they must start near enough to the
/// true one: eight were too few (`docs/decisions/0029-coupled-from-anywhere.md`).
const ROLLS: u32 = 16;
/// Weight of each challenger at its start, as a fraction of the weight of the last copy.
const CHALLENGER_WEIGHT: f64 = 1e-4;
/// x depends on the sine of the roll, so near ±90° it does not correct the roll.
const ROLL_SEEN_RAD: f64 = 80.0 / 180.0 * std::f64::consts::PI;
/// Indices into an error (displacement; turn) in the plane frame. These components change the reduced state:
/// x and the plane's normal as seen from the tip (S² × ℝ, paper Section 4).
const REDUCED: [usize; 3] = [0, 4, 5];
/// These components change the fibre, SE(2): y, z and the yaw.
const FIBRE: [usize; 3] = [1, 2, 3];

/// The paper's coupled observer (Fig. 2) without local coordinates, with fading memory.
///
/// The structure is the paper's: x alone corrects the reduced state, which does not depend on the
/// fibre. The reduced estimate drives the fibre, which y and z correct. The paper's coordinates (Eq. 5) end
/// at γ = ±90° and do not distinguish γ from π − γ. Here the state of a copy is the pose itself,
/// and its error is that of the pose on SE(3). In the plane frame a turn about the plane's normal
/// changes the fibre only, and turns about y and z the reduced state.
///
/// The exact kinematics predict; the error propagates by `Ad(Exp(−ξ))`. The gains are the best that this
/// structure allows if a position measured d before the present depth has the weight `exp(−d / memory_mm)`.
/// Near the plane they converge to the gains that place all poles of the paper's observer at a modulus of
/// `exp(−Δℓ / memory_mm)`.
///
/// Copies start at rolls around the circle. Their weights are the likelihoods of the innovations in all three
/// coordinates, and fade half as fast. Unlikely copies are dropped, and those that agree are merged.
/// The last copy left may have a wrong roll that x alone does not correct. So new copies around the circle challenge
/// it, at the earliest `memory_mm` after the last start of copies. They displace a wrong copy, and a right one
/// displaces them.
///
/// The stated covariance is the one that the gains follow from. It counts old positions for less than they
/// contribute, so it is larger than the error's: NEES is about 2.3 (`docs/steering.md`).
#[derive(Debug, Clone)]
pub(super) struct CoupledBank {
    needle: Needle,
    config: CoupledConfig,
    pub(super) bank: Vec<RollHypothesis>,
    /// The tip's motion since the last correction, in its frame then, and its depth.
    motion: Pose,
    motion_mm: f64,
    /// Insertion since copies were last started.
    since_start_mm: f64,
    /// Normalised innovation squared (NIS) of the likeliest copy at the last correction.
    nis: Option<f64>,
}

/// One copy, at the depth of the last correction.
#[derive(Debug, Clone)]
pub(super) struct RollHypothesis {
    x_pb: Pose,
    /// Covariance of the left-invariant error.
    covariance: Matrix6<f64>,
    log_weight: f64,
}

impl mixture::Hypothesis for RollHypothesis {
    fn log_weight(&self) -> f64 {
        self.log_weight
    }

    fn log_weight_mut(&mut self) -> &mut f64 {
        &mut self.log_weight
    }

    fn x_pb(&self) -> &Pose {
        &self.x_pb
    }

    fn covariance(&self) -> Matrix6<f64> {
        self.covariance
    }

    fn is_alike(&self, other: &Self) -> bool {
        let apart = (self.x_pb.inverse() * other.x_pb).log().to_vector();
        let (p, q) = (self.covariance.diagonal(), other.covariance.diagonal());
        let least = p.zip_map(&q, f64::min) * (ALIKE_SD * ALIKE_SD);
        apart.iter().zip(&least).all(|(apart, least)| apart * apart <= *least)
    }
}

/// Turns both halves of a twist's covariance by `r`.
fn turned(covariance: &Matrix6<f64>, r: &Matrix3<f64>) -> Matrix6<f64> {
    let mut both = Matrix6::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(r);
    both.fixed_view_mut::<3, 3>(3, 3).copy_from(r);
    both * covariance * both.transpose()
}

/// The gains of the reduced state from x, and of the fibre from y and z.
fn gain(p: &Matrix6<f64>, s: &Matrix3<f64>) -> Option<Matrix6x3<f64>> {
    let s_yz_inverse = s.fixed_view::<2, 2>(1, 1).into_owned().try_inverse()?;
    let mut gain = Matrix6x3::zeros();
    for state in REDUCED {
        gain[(state, 0)] = p[(state, 0)] / s[(0, 0)];
    }
    for state in FIBRE {
        let row = p.fixed_view::<1, 2>(state, 1) * s_yz_inverse;
        gain.fixed_view_mut::<1, 2>(state, 1).copy_from(&row);
    }
    Some(gain)
}

impl RollHypothesis {
    /// Propagates the copy over a motion of the tip. Old knowledge fades: the covariance grows by the factor
    /// `forgetting`, and the log weight shrinks by the root of it: evidence against a wrong roll stays true, but
    /// an old position says little about the present pose.
    fn propagate(&mut self, motion: &Pose, forgetting: f64) {
        self.x_pb = (self.x_pb * *motion).renormalized();
        let ad = motion.inverse().adjoint();
        self.covariance = ad * self.covariance * ad.transpose() * forgetting;
        self.log_weight /= forgetting.sqrt();
    }

    /// Corrects with a measured position. Returns the normalised innovation squared (NIS), or `None`
    /// if the innovation's covariance is not positive.
    fn correct(&mut self, tip_meas: &TipPosition, variance_mm2: f64) -> Option<f64> {
        let p = turned(&self.covariance, self.x_pb.rotation.matrix());
        let innovation = tip_meas.mm() - self.x_pb.translation;
        let s = p.fixed_view::<3, 3>(0, 0) + Matrix3::identity() * variance_mm2;
        let square = innovation.dot(&s.cholesky()?.solve(&innovation));
        self.log_weight -= 0.5 * (square + math::ln(s.determinant()));
        let gain = gain(&p, &s)?;
        let correction = gain * innovation;
        let tilted =
            so3::exp(&Vector3::new(0.0, correction[4], correction[5])) * self.x_pb.rotation;
        let mut kept = Matrix6::<f64>::identity();
        let mut of_position = kept.fixed_view_mut::<6, 3>(0, 0);
        of_position -= gain;
        let p = kept * p * kept.transpose() + gain * gain.transpose() * variance_mm2;
        // The turn of the fibre is applied last and turns the error with it: neither the reduced state nor its
        // covariance depends on this turn.
        self.covariance = turned(&p, &tilted.matrix().transpose());
        self.x_pb = Pose {
            rotation: so3::exp(&Vector3::new(correction[3], 0.0, 0.0)) * tilted,
            translation: self.x_pb.translation + correction.fixed_rows::<3>(0),
        };
        Some(square)
    }

    fn is_sound(&self) -> bool {
        self.x_pb.is_finite()
            && self.log_weight.is_finite()
            && self.covariance.iter().all(|v| v.is_finite())
    }
}

impl CoupledBank {
    pub(super) fn new(needle: Needle, config: CoupledConfig) -> Self {
        CoupledBank {
            needle,
            config,
            bank: Vec::new(),
            motion: Pose::identity(),
            motion_mm: 0.0,
            since_start_mm: 0.0,
            nis: None,
        }
    }

    /// Starts copies at a measured position with this standard deviation, at the rolls that `start` and `start_sd`
    /// allow. `log_weight` is that of the likeliest of them.
    fn start_copies(
        &mut self,
        start: &FixedAngles,
        start_sd: &FixedAngles,
        (tip_meas, position_sd_mm): (&TipPosition, f64),
        log_weight: f64,
    ) {
        self.since_start_mm = 0.0;
        for (roll, roll_sd, share) in start::rolls(start.roll, start_sd.roll, ROLLS) {
            let angles = FixedAngles { roll, ..*start };
            let sd = FixedAngles { roll: roll_sd, ..*start_sd };
            self.bank.push(RollHypothesis {
                x_pb: Pose { rotation: angles.to_rotation(), translation: tip_meas.mm() },
                covariance: start::covariance(&angles, &sd, position_sd_mm),
                log_weight: log_weight + math::ln(share),
            });
        }
    }

    /// Starts the bank if it is empty. Challenges the last copy if none was started over the memory and the roll was
    /// not known at the start. The challengers' heading is as uncertain as that of the start.
    fn start_copies_if_due(&mut self, measured: (&TipPosition, f64)) {
        let CoupledConfig { start, start_sd, memory_mm, .. } = self.config;
        match self.bank[..] {
            [] => self.start_copies(&start, &start_sd, measured, 0.0),
            [ref last]
                if self.since_start_mm >= memory_mm && !start::is_one_roll(start_sd.roll) =>
            {
                let angles = FixedAngles::from_rotation(&last.x_pb.rotation);
                let log_weight = last.log_weight + math::ln(CHALLENGER_WEIGHT);
                let unknown = FixedAngles { roll: PI, ..start_sd };
                self.start_copies(&angles, &unknown, measured, log_weight);
            }
            _ => {}
        }
    }

    fn forgetting(&self, depth_mm: f64) -> f64 {
        math::exp(depth_mm / self.config.memory_mm)
    }

    fn motion_after(&self, motion: Pose, increment: Increment) -> Pose {
        motion * Pose::exp(&self.needle.twist(increment))
    }

    /// The copies at the present depth, or after `increments` from there.
    fn bank_after(&self, increments: &[Increment]) -> Vec<RollHypothesis> {
        let motion = increments.iter().fold(self.motion, |motion, &i| self.motion_after(motion, i));
        let ahead_mm: f64 = increments.iter().map(Increment::insertion_mm).sum();
        let forgetting = self.forgetting(self.motion_mm + ahead_mm);
        let mut ahead = self.bank.clone();
        ahead.iter_mut().for_each(|copy| copy.propagate(&motion, forgetting));
        ahead
    }
}

impl Observer for CoupledBank {
    fn predict(&mut self, increment: Increment) {
        self.motion = self.motion_after(self.motion, increment);
        self.motion_mm += increment.insertion_mm();
    }

    fn correct(&mut self, tip_meas: &TipPosition, independent: f64) {
        let variance_mm2 = self.config.position_sd_mm.powi(2) / independent;
        self.bank = self.bank_after(&[]);
        self.since_start_mm += self.motion_mm;
        (self.motion, self.motion_mm) = (Pose::identity(), 0.0);
        let mut likeliest = (f64::NEG_INFINITY, None);
        self.bank.retain_mut(|copy| {
            let square = copy.correct(tip_meas, variance_mm2);
            if copy.log_weight > likeliest.0 {
                likeliest = (copy.log_weight, square);
            }
            square.is_some() && copy.is_sound()
        });
        self.nis = likeliest.1;
        // The bank starts at the first position, and starts again if no copy can explain a position.
        // A mean is more accurate than one position. A single position has the configured standard deviation, however
        // correlated its noise is with that of the next.
        let sd_mm = variance_mm2.sqrt().min(self.config.position_sd_mm);
        self.start_copies_if_due((tip_meas, sd_mm));
        mixture::reduce(&mut self.bank);
    }

    fn position_mm(&self) -> Option<Vector3<f64>> {
        mixture::position_mm(&self.bank_after(&[]))
    }

    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate> {
        let mixture::Mean { x_pb, covariance, roll_agreement } =
            mixture::mean(&self.bank_after(increments), 1.0)?;
        let belief = Belief {
            covariance,
            roll_agreement,
            roll_seen_rad: ROLL_SEEN_RAD,
            curvature_per_mm: self.needle.curvature_per_mm(),
            nis: self.nis,
            shaft: Shaft::RIGID,
        };
        Some(Estimate::of_belief(x_pb, belief))
    }
}
