//! Several hypotheses of the tip's pose, weighted by their likelihood.

use crate::geometry::Pose;
use crate::math;
use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3};

/// Below this length the mean bevel direction does not define a roll.
const AGREEMENT_MIN: f64 = 1e-3;
/// Two hypotheses agree if every state differs by less than this fraction of the smaller standard
/// deviation.
pub(super) const ALIKE_SD: f64 = 0.5;

/// Hypotheses below this fraction of the largest weight are dropped.
pub(super) const WEIGHT_MIN: f64 = 1e-5;

/// One hypothesis of a mixture.
pub(super) trait Hypothesis {
    /// Logarithm of the weight, up to a constant common to the mixture.
    fn log_weight(&self) -> f64;
    /// The log weight, mutable.
    fn log_weight_mut(&mut self) -> &mut f64;
    /// The tip's pose, plane frame.
    fn x_pb(&self) -> &Pose;
    /// Covariance of the pose's left-invariant error.
    fn covariance(&self) -> Matrix6<f64>;
    /// True if the two agree well enough to be merged.
    fn is_alike(&self, other: &Self) -> bool;
}

/// A mixture as one pose.
pub(super) struct Mean {
    /// Mean heading, bevel direction and position.
    pub(super) x_pb: Pose,
    /// Covariance of the left-invariant error about them.
    pub(super) covariance: Matrix6<f64>,
    /// Length of the mean bevel direction.
    pub(super) roll_agreement: f64,
}

/// The weights of the hypotheses, each to this power; they add up to 1.
pub(super) fn weights<H: Hypothesis>(mixture: &[H], power: f64) -> Vec<f64> {
    let most = mixture.iter().map(H::log_weight).fold(f64::NEG_INFINITY, f64::max);
    let raw: Vec<f64> =
        mixture.iter().map(|h| math::exp(power * (h.log_weight() - most))).collect();
    let sum: f64 = raw.iter().sum();
    raw.into_iter().map(|weight| weight / sum).collect()
}

/// Logarithm of the sum of all weights.
pub(super) fn log_weight<H: Hypothesis>(mixture: &[H]) -> f64 {
    let most = mixture.iter().map(H::log_weight).fold(f64::NEG_INFINITY, f64::max);
    most + math::ln(mixture.iter().map(|h| math::exp(h.log_weight() - most)).sum())
}

/// The likeliest hypothesis.
pub(super) fn likeliest<H: Hypothesis>(mixture: &[H]) -> Option<&H> {
    mixture.iter().max_by(|a, b| a.log_weight().total_cmp(&b.log_weight()))
}

/// Mean position, plane frame, mm. `None` for an empty mixture.
pub(super) fn position_mm<H: Hypothesis>(mixture: &[H]) -> Option<Vector3<f64>> {
    let weighted = mixture.iter().zip(weights(mixture, 1.0));
    (!mixture.is_empty()).then(|| weighted.map(|(h, w)| h.x_pb().translation * w).sum())
}

/// Mean heading, bevel direction and position, and the covariance about them. The covariance raises each
/// weight to the power `covariance_power`. `None` for an empty mixture.
pub(super) fn mean<H: Hypothesis>(mixture: &[H], covariance_power: f64) -> Option<Mean> {
    let likeliest = likeliest(mixture)?;
    let weights_1 = weights(mixture, 1.0);
    let direction = |axis: usize| -> Vector3<f64> {
        let weighted = mixture.iter().zip(&weights_1);
        weighted.map(|(h, &w)| h.x_pb().rotation.matrix().column(axis) * w).sum()
    };
    let translation = position_mm(mixture)?;
    let heading = direction(2).normalize();
    let bevel = direction(0);
    let across = bevel - heading * bevel.dot(&heading);
    let agreement = across.norm();
    let rotation = if agreement > AGREEMENT_MIN {
        let x = across / agreement;
        Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, heading.cross(&x), heading]))
    } else {
        likeliest.x_pb().rotation
    };
    let x_pb = Pose { rotation, translation };
    let inverse = x_pb.inverse();
    let mut covariance = Matrix6::zeros();
    for (h, w) in mixture.iter().zip(weights(mixture, covariance_power)) {
        covariance += h.covariance() * w;
        if mixture.len() > 1 {
            let apart = (inverse * *h.x_pb()).log().to_vector();
            covariance += apart * apart.transpose() * w;
        }
    }
    Some(Mean { x_pb, covariance, roll_agreement: agreement.min(1.0) })
}

/// Drops unlikely hypotheses, and merges a hypothesis into a likelier one if the two agree.
pub(super) fn reduce<H: Hypothesis>(mixture: &mut Vec<H>) {
    mixture.sort_by(|a, b| b.log_weight().total_cmp(&a.log_weight()));
    let Some(most) = mixture.first().map(H::log_weight) else { return };
    mixture.iter_mut().for_each(|h| *h.log_weight_mut() -= most);
    let log_weight_min = math::ln(WEIGHT_MIN);
    mixture.retain(|h| h.log_weight() > log_weight_min);
    let mut kept = 1;
    while kept < mixture.len() {
        let (likelier, others) = mixture.split_at_mut(kept);
        let next = &others[0];
        match likelier.iter_mut().find(|likelier| likelier.is_alike(next)) {
            Some(likelier) => {
                let log_ratio = next.log_weight() - likelier.log_weight();
                *likelier.log_weight_mut() += math::ln_1p(math::exp(log_ratio));
                mixture.remove(kept);
            }
            None => kept += 1,
        }
    }
}
