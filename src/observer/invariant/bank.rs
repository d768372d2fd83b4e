//! Several hypotheses, weighted by their likelihood.

use super::error_state::{CURVATURE, GROWTH, LAG, LOWER, ROLL, UPPER};
use super::hypothesis::Hypothesis;
use crate::geometry::Pose;
use crate::math;
use crate::observer::{Belief, Estimate, Shaft, Slack};
use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3};

/// Below this length the mean bevel direction does not define a roll.
const AGREEMENT_MIN: f64 = 1e-3;
/// Two hypotheses are merged if every state differs by less than this fraction of the smaller
/// standard deviation…
const ALIKE_SD: f64 = 0.5;
/// … and the variances of their parameters by less than this factor: the more confident one may be
/// wrong where the other is right.
const ALIKE_VARIANCE: f64 = 1.5;

/// The covariance uses each weight to this power. Positions hardly distinguish a shaft that twists
/// a little from a rigid one. The rigid hypothesis has fewer unknowns, so it is soon a thousand
/// times as likely, even if it is wrong. It then dominates the mean, but the other one still widens
/// the covariance.
const DOUBT_POWER: f64 = 0.2;

/// The weights of the hypotheses, each to this power; they add up to 1.
fn weights(bank: &[Hypothesis], power: f64) -> Vec<f64> {
    let most = bank.iter().map(|h| h.log_weight).fold(f64::NEG_INFINITY, f64::max);
    let raw: Vec<f64> = bank.iter().map(|h| math::exp(power * (h.log_weight - most))).collect();
    let sum: f64 = raw.iter().sum();
    raw.into_iter().map(|weight| weight / sum).collect()
}

/// Logarithm of the sum of all weights.
pub(super) fn log_weight(bank: &[Hypothesis]) -> f64 {
    let most = bank.iter().map(|h| h.log_weight).fold(f64::NEG_INFINITY, f64::max);
    most + math::ln(bank.iter().map(|h| math::exp(h.log_weight - most)).sum())
}

/// The likeliest hypothesis.
pub(super) fn likeliest(bank: &[Hypothesis]) -> Option<&Hypothesis> {
    bank.iter().max_by(|a, b| a.log_weight.total_cmp(&b.log_weight))
}

/// Mean position, plane frame, mm. `None` for an empty bank.
pub(super) fn position_mm(bank: &[Hypothesis]) -> Option<Vector3<f64>> {
    let weighted = bank.iter().zip(weights(bank, 1.0));
    (!bank.is_empty()).then(|| weighted.map(|(h, w)| h.x_pb.translation * w).sum())
}

/// The bank as one estimate: mean heading, bevel direction and position, and the covariance about
/// them, to which unlikely hypotheses add more than their weight. `None` for an empty bank.
pub(super) fn estimate(bank: &[Hypothesis]) -> Option<Estimate> {
    let likeliest = likeliest(bank)?;
    let doubts = weights(bank, DOUBT_POWER);
    let weights = weights(bank, 1.0);
    let weighted = || bank.iter().zip(weights.iter().copied());
    let mean = |of: &dyn Fn(&Hypothesis) -> f64| weighted().map(|(h, w)| of(h) * w).sum::<f64>();
    let direction = |axis: usize| -> Vector3<f64> {
        weighted().map(|(h, w)| h.x_pb.rotation.matrix().column(axis) * w).sum()
    };
    let translation = position_mm(bank)?;
    let heading = direction(2).normalize();
    let bevel = direction(0);
    let across = bevel - heading * bevel.dot(&heading);
    let roll_agreement = across.norm();
    let rotation = if roll_agreement > AGREEMENT_MIN {
        let x = across / roll_agreement;
        Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, heading.cross(&x), heading]))
    } else {
        likeliest.x_pb.rotation
    };
    let x_pb = Pose { rotation, translation };

    let inverse = x_pb.inverse();
    let mut covariance = Matrix6::zeros();
    for (h, w) in bank.iter().zip(doubts) {
        covariance += h.covariance.pose() * w;
        if bank.len() > 1 {
            let apart = (inverse * h.x_pb).log().to_vector();
            covariance += apart * apart.transpose() * w;
        }
    }
    let slack = |sign: f64| {
        let slacks: Vec<Slack> = bank.iter().map(|h| h.slack(sign)).collect();
        let weighted = || slacks.iter().zip(weights.iter().copied());
        let mean_rad = weighted().map(|(s, w)| s.mean_rad * w).sum::<f64>();
        let spread = |s: &Slack| s.sd_rad.powi(2) + (s.mean_rad - mean_rad).powi(2);
        let variance: f64 = weighted().map(|(s, w)| spread(s) * w).sum();
        Slack { mean_rad, sd_rad: variance.sqrt() }
    };
    let belief = Belief {
        covariance,
        roll_agreement: roll_agreement.min(1.0),
        nis: None,
        curvature_per_mm: mean(&|h| h.curvature_per_mm),
        shaft: Shaft {
            slack_forward: slack(1.0),
            slack_backward: slack(-1.0),
            backlog_rad: mean(&|h| h.backlog_rad),
            creep_mm: likeliest.creep_length_mm(),
        },
    };
    Some(Estimate::of_belief(x_pb, belief))
}

/// Drops unlikely hypotheses, and merges a hypothesis into a likelier one if the two agree.
pub(super) fn reduce(bank: &mut Vec<Hypothesis>, weight_min: f64) {
    bank.sort_by(|a, b| b.log_weight.total_cmp(&a.log_weight));
    let Some(most) = bank.first().map(|h| h.log_weight) else { return };
    bank.iter_mut().for_each(|h| h.log_weight -= most);
    bank.retain(|h| h.log_weight > math::ln(weight_min));
    let mut kept = 1;
    while kept < bank.len() {
        let (likelier, rest) = bank.split_at_mut(kept);
        match likelier.iter_mut().find(|likelier| alike(likelier, &rest[0])) {
            Some(likelier) => {
                let behind = rest[0].log_weight - likelier.log_weight;
                likelier.log_weight += math::ln_1p(math::exp(behind));
                bank.remove(kept);
            }
            None => kept += 1,
        }
    }
}

fn alike(a: &Hypothesis, b: &Hypothesis) -> bool {
    let (p, q) = (&a.covariance, &b.covariance);
    let least = |state: usize| p.at(state, state).min(q.at(state, state));
    let near =
        |state: usize, apart: f64| apart * apart <= ALIKE_SD * ALIKE_SD * least(state) + 1e-18;
    let as_sure = |state: usize| {
        let most = p.at(state, state).max(q.at(state, state));
        most <= ALIKE_VARIANCE * least(state) + 1e-12
    };
    // A cheap test first: hypotheses far apart in roll have different bevel directions.
    let bevels = a.x_pb.rotation.matrix().column(0).dot(&b.x_pb.rotation.matrix().column(0));
    let parameters = || {
        [
            (CURVATURE, a.curvature_per_mm - b.curvature_per_mm),
            (LAG, a.lag_rad - b.lag_rad),
            (LOWER, a.band.lower_rad - b.band.lower_rad),
            (UPPER, a.band.upper_rad - b.band.upper_rad),
            (GROWTH, a.band.growth_rad_per_mm - b.band.growth_rad_per_mm),
        ]
    };
    let poses = || {
        let apart = (a.x_pb.inverse() * b.x_pb).log().to_vector();
        apart.iter().enumerate().all(|(state, &apart)| near(state, apart))
    };
    p.extent() == q.extent()
        && 1.0 - bevels <= ALIKE_SD * ALIKE_SD * (least(4) + least(ROLL)) + 1e-12
        && [CURVATURE, LOWER, UPPER, GROWTH].into_iter().all(as_sure)
        && parameters().into_iter().all(|(state, apart)| near(state, apart))
        && poses()
}
