//! The observer without local coordinates that the paper's last sentence asks for.
//!
//! A left-invariant extended Kalman filter on SE(3) ([`hypothesis`]), augmented with the needle's
//! curvature and the torsion of its shaft, holds from every pose. One filter can lock on to the
//! wrong roll, so several start around the circle, and over what is not known of the torsion; they
//! are weighted by their likelihood, and those that are no longer likely or say the same as
//! another are dropped ([`bank`]), so that soon one or a few are left.

mod bank;
mod config;
mod error_state;
mod hypothesis;
mod positive_part;

pub use config::InvariantConfig;

use super::{Estimate, Observer};
use crate::needle::{Increment, Needle, TipPosition, Torsion};
use hypothesis::Hypothesis;

/// The observer.
#[derive(Debug, Clone)]
pub struct Invariant {
    needle: Needle,
    torsion: Torsion,
    config: InvariantConfig,
    bank: Vec<Hypothesis>,
}

impl Invariant {
    /// An observer of a needle that is believed to be `needle` on a shaft of `torsion`.
    pub fn new(needle: Needle, torsion: Torsion, config: InvariantConfig) -> Self {
        Invariant { needle, torsion, config, bank: Vec::new() }
    }

    /// Hypotheses in the bank.
    pub fn hypotheses(&self) -> usize {
        self.bank.len()
    }
}

impl Observer for Invariant {
    fn predict(&mut self, increment: Increment) {
        self.bank.iter_mut().for_each(|h| h.predict(increment));
    }

    fn correct(&mut self, tip_meas: &TipPosition) {
        if self.bank.is_empty() {
            self.bank = self.config.bank(&self.needle, &self.torsion, tip_meas);
            return;
        }
        let noise = self.config.process_noise(&self.needle);
        let variance_mm2 = self.config.position_sd_mm.powi(2);
        for h in &mut self.bank {
            h.carry_covariance(Some(&noise));
            h.correct(tip_meas, variance_mm2);
        }
        bank::reduce(&mut self.bank, self.config.weight_min);
    }

    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate> {
        if increments.is_empty() {
            return bank::estimate(&self.bank);
        }
        let mut ahead = self.bank.clone();
        for h in &mut ahead {
            increments.iter().for_each(|&increment| h.predict(increment));
            h.carry_covariance(None);
        }
        bank::estimate(&ahead)
    }
}
