//! Combines the bank into one estimate, and decides whether two of its hypotheses agree.

use super::config::ROLLS;
use super::error_state::{CURVATURE, GROWTH, LAG, LOWER, ROLL, UPPER};
use super::hypothesis::Hypothesis;
use crate::geometry::Pose;
use crate::needle::Needle;
use crate::observer::mixture::{self, ALIKE_SD};
use crate::observer::{Belief, Estimate, Shaft, Slack, start};
use nalgebra::Matrix6;
use std::f64::consts::PI;

/// Two hypotheses are merged if they agree and the variances of their parameters differ by less
/// than this factor: otherwise the more confident one may be wrong where the other is right.
const ALIKE_VARIANCE: f64 = 1.5;

/// The covariance uses each weight to this power. Positions hardly distinguish a shaft that twists
/// a little from a rigid one. The rigid hypothesis has fewer unknowns, so it is soon a thousand
/// times as likely, even if it is wrong. It then dominates the mean, but the other one still widens
/// the covariance.
const COVARIANCE_POWER: f64 = 0.2;

/// What a restart adds to the standard deviation of the curvature, as a part of the configured curvature.
const RESTART_CURVATURE_SD: f64 = 0.3;

impl mixture::Hypothesis for Hypothesis {
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
        self.covariance.pose()
    }

    fn is_alike(&self, other: &Self) -> bool {
        let (p, q) = (&self.covariance, &other.covariance);
        let least = |state: usize| p.at(state, state).min(q.at(state, state));
        let near =
            |state: usize, apart: f64| apart * apart <= ALIKE_SD * ALIKE_SD * least(state) + 1e-18;
        let is_as_certain = |state: usize| {
            let most = p.at(state, state).max(q.at(state, state));
            most <= ALIKE_VARIANCE * least(state) + 1e-12
        };
        // A cheap test first: hypotheses far apart in roll have different bevel directions.
        let bevels =
            self.x_pb.rotation.matrix().column(0).dot(&other.x_pb.rotation.matrix().column(0));
        let parameters = || {
            [
                (CURVATURE, self.curvature_per_mm - other.curvature_per_mm),
                (LAG, self.lag_rad - other.lag_rad),
                (LOWER, self.band.lower_rad - other.band.lower_rad),
                (UPPER, self.band.upper_rad - other.band.upper_rad),
                (GROWTH, self.band.growth_rad_per_mm - other.band.growth_rad_per_mm),
            ]
        };
        let poses = || {
            let apart = (self.x_pb.inverse() * other.x_pb).log().to_vector();
            apart.iter().enumerate().all(|(state, &apart)| near(state, apart))
        };
        p.extent() == q.extent()
            && 1.0 - bevels <= ALIKE_SD * ALIKE_SD * (least(4) + least(ROLL)) + 1e-12
            && [CURVATURE, LOWER, UPPER, GROWTH].into_iter().all(is_as_certain)
            && parameters().into_iter().all(|(state, apart)| near(state, apart))
            && poses()
    }
}

/// The bank as one estimate: mean heading, bevel direction and position, and the covariance about
/// them, to which unlikely hypotheses add more than their weight. `None` for an empty bank.
pub(super) fn estimate(bank: &[Hypothesis]) -> Option<Estimate> {
    let likeliest = mixture::likeliest(bank)?;
    let mixture::Mean { x_pb, covariance, roll_agreement } = mixture::mean(bank, COVARIANCE_POWER)?;
    let weights = mixture::weights(bank, 1.0);
    let weighted = || bank.iter().zip(weights.iter().copied());
    let mean = |of: &dyn Fn(&Hypothesis) -> f64| weighted().map(|(h, w)| of(h) * w).sum::<f64>();
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
        roll_agreement,
        roll_seen_rad: 0.5 * PI,
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

/// The bank once the positions no longer fit it: roll, heading and curvature may have changed. Each hypothesis starts
/// again at rolls around the circle; that it kept its roll is as likely as all the others together.
pub(super) fn restarted(bank: &[Hypothesis], needle: &Needle) -> Vec<Hypothesis> {
    let curvature_sd_per_mm = RESTART_CURVATURE_SD * needle.curvature_per_mm();
    let rolls = start::rolls(0.0, PI, ROLLS);
    let others = rolls.len() as f64 - 1.0;
    let each = bank.iter().flat_map(|h| rolls.iter().map(move |roll| (h, roll)));
    each.map(|(h, &(roll_rad, sd_rad, _))| {
        let share = if roll_rad == 0.0 { 0.5 } else { 0.5 / others };
        h.restarted(roll_rad, sd_rad, curvature_sd_per_mm, share)
    })
    .collect()
}
