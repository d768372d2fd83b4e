//! The default observer: a bank of left-invariant extended Kalman filters. It needs no local
//! coordinates, as the paper's last sentence asks for.
//!
//! Each filter ([`hypothesis`]) estimates the pose on SE(3), the needle's curvature and the torsion
//! of its shaft, and works from every pose. A single filter can lock on to the wrong roll, so
//! several start around the circle, each with several torsions if the torsion is uncertain. They
//! are weighted by their likelihood. Unlikely ones are dropped and those that agree are merged
//! ([`mixture`]), so that soon one or a few are left. If the positions later leave them all behind ([`bias`]), the
//! bank is restarted around the circle.

mod bank;
mod bias;
mod config;
mod error_state;
mod hypothesis;
mod positive_part;
#[cfg(test)]
mod tests;

pub use config::{InvariantConfig, NoiseConfig};

use super::{Estimate, Observer, mixture};
use crate::needle::{Increment, Needle, TipPosition, Torsion};
use bias::InnovationBias;
use hypothesis::{Hypothesis, Innovation};
use nalgebra::Vector3;
use std::collections::VecDeque;

/// Number of innovations over which divergence is judged.
const INNOVATIONS: usize = 20;
/// The bias of the innovations is judged from this depth on: before it the likeliest roll may be a wrong one, and
/// the size of the noise is not known yet.
const BIAS_JUDGED_FROM_MM: f64 = 15.0;
/// So long after a restart it is judged again, mm.
const RESTART_AFTER_MM: f64 = 10.0;
/// A needle that bends so many times as much as configured is another one.
const CURVATURE_MAX_TIMES: f64 = 2.5;

/// The bank of filters.
#[derive(Debug, Clone)]
pub struct Invariant {
    needle: Needle,
    torsion: Torsion,
    config: InvariantConfig,
    bank: Vec<Hypothesis>,
    /// Normalised innovations squared (NIS) of the likeliest hypothesis, the last ones: χ² with three degrees
    /// of freedom.
    innovations: VecDeque<f64>,
    /// Their bias since the last restart.
    bias: InnovationBias,
    /// Depth from which on the bias is judged, mm.
    judged_from_mm: f64,
    /// Says why the bank was restarted, until it is taken.
    warning: Option<String>,
    insertion_mm: f64,
    log_evidence: f64,
    /// No hypothesis is left.
    is_lost: bool,
}

impl Invariant {
    /// An observer for the configured `needle` and `torsion`.
    pub fn new(needle: Needle, torsion: Torsion, config: InvariantConfig) -> Self {
        Invariant {
            needle,
            torsion,
            config,
            bank: Vec::new(),
            innovations: VecDeque::new(),
            bias: InnovationBias::default(),
            judged_from_mm: BIAS_JUDGED_FROM_MM,
            warning: None,
            insertion_mm: 0.0,
            log_evidence: 0.0,
            is_lost: false,
        }
    }

    /// Logarithm of the likelihood of all positions so far under this model, up to a constant that
    /// depends only on their number. It serves to compare two observers of the same positions.
    pub fn log_evidence(&self) -> f64 {
        self.log_evidence
    }

    /// Mean square of the last innovations relative to its expected value; at least 1.
    pub fn innovation_excess(&self) -> f64 {
        let samples = self.innovations.len().max(1) as f64;
        (self.innovations.iter().sum::<f64>() / (3.0 * samples)).max(1.0)
    }

    /// True if no hypothesis is left; corrections are then ignored.
    pub fn is_lost(&self) -> bool {
        self.is_lost
    }

    /// Corrects the state with a position of the tip whose coordinates have this variance, mm², in
    /// place of the configured one.
    pub fn correct_with(&mut self, tip_meas: &TipPosition, variance_mm2: f64) {
        if self.is_lost {
            return;
        }
        if self.bank.is_empty() {
            // A mean is more accurate than one position. A single position has the configured standard deviation,
            // however correlated its noise is with that of the next.
            let position_sd_mm = variance_mm2.sqrt().min(self.config.position_sd_mm);
            let config = InvariantConfig { position_sd_mm, ..self.config };
            self.bank = config.bank(&self.needle, &self.torsion, tip_meas);
            return;
        }
        let noise = self.config.process_noise(&self.needle);
        let unknown = Innovation { square: f64::INFINITY, across: Vector3::zeros() };
        let mut likeliest = (f64::NEG_INFINITY, unknown);
        let log_weight_before = mixture::log_weight(&self.bank);
        self.bank.retain_mut(|h| {
            h.propagate_covariance(Some(&noise));
            let Some(innovation) = h.correct(tip_meas, variance_mm2) else { return false };
            if h.log_weight > likeliest.0 {
                likeliest = (h.log_weight, innovation);
            }
            h.is_sound()
        });
        if self.bank.is_empty() {
            self.is_lost = true;
            return;
        }
        self.log_evidence += mixture::log_weight(&self.bank) - log_weight_before;
        if self.innovations.len() == INNOVATIONS {
            self.innovations.pop_front();
        }
        self.innovations.push_back(likeliest.1.square);
        self.bias.take(&likeliest.1.across, self.insertion_mm);
        mixture::reduce(&mut self.bank);
    }

    /// Restarts the bank if the innovations have a bias. Noise beyond the configured standard deviation exaggerates it;
    /// their mean square shows by how much.
    fn restart_if_biased(&mut self) {
        let (chi_squared, limit) =
            (self.bias.chi_squared() / self.innovation_excess(), self.config.innovation_bias_max);
        let is_biased = self.insertion_mm >= self.judged_from_mm && chi_squared > limit;
        if !is_biased {
            return;
        }
        self.bank = bank::restarted(&self.bank, &self.needle);
        self.bias = InnovationBias::default();
        self.judged_from_mm = self.insertion_mm + RESTART_AFTER_MM;
        self.warning = Some(format!(
            "the positions leave the model at {:.1} mm (chi2 {chi_squared:.1}, limit {limit:.1}): roll, heading and \
             curvature are estimated anew; did the chuck slip, or the tissue change?",
            self.insertion_mm
        ));
    }
}

impl Observer for Invariant {
    fn predict(&mut self, increment: Increment) {
        self.insertion_mm += increment.insertion_mm();
        self.bank.iter_mut().for_each(|h| h.predict(increment));
    }

    fn correct(&mut self, tip_meas: &TipPosition, independent: f64) {
        self.correct_with(tip_meas, self.config.position_sd_mm.powi(2) / independent);
        self.restart_if_biased();
    }

    fn take_warning(&mut self) -> Option<String> {
        self.warning.take()
    }

    fn position_mm(&self) -> Option<Vector3<f64>> {
        mixture::position_mm(&self.bank)
    }

    fn check(&self) -> Result<(), String> {
        if self.is_lost {
            return Err(format!(
                "the estimate is no longer finite, or its covariance no longer positive, at {:.1} mm",
                self.insertion_mm
            ));
        }
        let likeliest = mixture::likeliest(&self.bank);
        let bends = likeliest.map_or(0.0, |h| h.curvature_per_mm) / self.needle.curvature_per_mm();
        if bends > CURVATURE_MAX_TIMES {
            return Err(format!(
                "the needle bends {bends:.1} times as much as needle.radius_mm says (limit {CURVATURE_MAX_TIMES}) at \
                 {:.1} mm: is it another needle, or another tissue?",
                self.insertion_mm
            ));
        }
        let (samples, limit) = (self.innovations.len(), self.config.innovation_max);
        let times = self.innovation_excess().sqrt();
        if samples == INNOVATIONS && times > limit {
            return Err(format!(
                "the last {samples} tip positions are {times:.1} times as far from their predictions as \
                 observer.invariant.position_sd_mm explains (limit {limit:.1}); check the registration and \
                 the needle that is configured"
            ));
        }
        Ok(())
    }

    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate> {
        let noise = self.config.process_noise(&self.needle);
        let mut ahead = self.bank.clone();
        for h in &mut ahead {
            increments.iter().for_each(|&increment| h.predict(increment));
            h.propagate_covariance(Some(&noise));
        }
        let estimate = bank::estimate(&ahead)?;
        let mut belief = estimate.belief?;
        belief.nis = self.innovations.back().copied();
        for coordinate in 0..3 {
            belief.covariance[(coordinate, coordinate)] += self.config.registration_sd_mm.powi(2);
        }
        Some(Estimate::of_belief(estimate.x_pb, belief))
    }
}
