//! Whether the tracked positions have the handedness of the needle, and the roll that is told.
//!
//! The kinematics are left-invariant (paper Eq. 1): a registration that is turned or shifted gives
//! the path of a needle that started elsewhere, and no position tells the difference. A mirrored
//! axis, or a stage that turns against its configured sign, does not: a mirrored path is that of a
//! needle whose base turns the other way. So two invariant filters follow the same positions, one of
//! them with the base's rotation negated, and their likelihoods are compared.
//!
//! Under the told model the likelihood ratio of any alternative is a martingale of mean 1, so that
//! it ever exceeds `e^L` has a probability of at most `e^-L` (Ville's inequality). That holds for
//! noise as told; of noise that is correlated or larger each position counts for less
//! ([`Whiteness`](super::Whiteness)). How often a right stream is stopped, and how soon a wrong one,
//! is measured in docs/hazards.md.

use super::{Invariant, InvariantConfig, Observer};
use crate::geometry::FixedAngles;
use crate::needle::{Increment, Needle, TipPosition, Torsion};
use std::f64::consts::{FRAC_PI_2, PI};
use thiserror::Error;

/// An alternative that is `e^7` times as likely as what is told ends the run.
const LOG_ODDS_MAX: f64 = 7.0;
/// So many positions to a mm count as independent at most.
const INDEPENDENT_PER_MM: f64 = 20.0;
/// A shaft whose torsion is not told twists as likely as not. For steering it is taken for rigid until
/// it shows its twist, and till then a mirrored needle may fit better.
const SEARCH_SHARE: f64 = 0.5;

/// What the positions say against what the bench is told.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum StreamContradiction {
    /// They are those of a mirrored needle.
    #[error(
        "the positions fit a mirrored needle e^{log_odds:.0} times better after {depth_mm:.1} mm (limit \
         e^{LOG_ODDS_MAX:.0}): is a tracker axis mirrored, \
         stage.rotation.sign wrong, or the stream another's?"
    )]
    Mirrored {
        /// Logarithm of the likelihood ratio.
        log_odds: f64,
        /// Insertion since the first position, mm.
        depth_mm: f64,
    },
    /// They are those of a needle that started at another roll than the one told.
    #[error(
        "the positions fit another roll at the start e^{log_odds:.0} times better after {depth_mm:.1} mm \
         (limit e^{LOG_ODDS_MAX:.0}): is the registration turned, or observer.start.roll_deg wrong?"
    )]
    Turned {
        /// Logarithm of the likelihood ratio.
        log_odds: f64,
        /// Insertion since the first position, mm.
        depth_mm: f64,
    },
}

/// Compares the told model with its alternatives, until the odds decide.
#[derive(Debug, Clone)]
pub struct HandednessWatch {
    told: Invariant,
    alternatives: Vec<(Alternative, Invariant)>,
    position_sd_mm: f64,
    insertion_mm: f64,
    /// Insertion at the last correction, mm.
    corrected_mm: f64,
    contradiction: Option<StreamContradiction>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Alternative {
    /// The base turns the other way.
    Mirrored,
    /// The roll at the start is not known.
    Turned,
}

impl HandednessWatch {
    /// A watch over the positions of a needle that is believed to be `needle` on a shaft of
    /// `torsion`, told what the invariant observer is told.
    pub fn new(needle: Needle, torsion: Torsion, config: InvariantConfig) -> Self {
        let config = InvariantConfig { search_share: SEARCH_SHARE, ..config };
        let told = Invariant::new(needle, torsion, config);
        let mut alternatives = vec![(Alternative::Mirrored, told.clone())];
        if config.start_sd.roll <= FRAC_PI_2 {
            let start_sd = FixedAngles { roll: PI, ..config.start_sd };
            let unknown = Invariant::new(needle, torsion, InvariantConfig { start_sd, ..config });
            alternatives.push((Alternative::Turned, unknown));
        }
        HandednessWatch {
            told,
            alternatives,
            position_sd_mm: config.position_sd_mm,
            insertion_mm: 0.0,
            corrected_mm: 0.0,
            contradiction: None,
        }
    }

    /// Carries every model on by one measured increment of the base.
    pub fn predict(&mut self, increment: Increment) {
        if self.is_decided() {
            return;
        }
        self.insertion_mm += increment.insertion_mm();
        self.told.predict(increment);
        for (alternative, model) in &mut self.alternatives {
            model.predict(match alternative {
                Alternative::Mirrored => increment.turned_back(),
                Alternative::Turned => increment,
            });
        }
    }

    /// Compares every model with a position, plane frame, measured where the models stand, or a mean
    /// that is worth so many `independent` ones. An alternative that is as unlikely as the limit is
    /// dropped for good: handedness and mounting do not change during an insertion.
    pub fn correct(&mut self, tip_meas: &TipPosition, independent: f64) {
        if self.is_decided() {
            return;
        }
        let since_mm = self.insertion_mm - self.corrected_mm;
        self.corrected_mm = self.insertion_mm;
        let independent = independent.min((INDEPENDENT_PER_MM * since_mm).max(1.0));
        let variance_mm2 = self.position_sd_mm.powi(2) / independent;
        self.told.correct_with(tip_meas, variance_mm2);
        let (told, depth_mm) = (self.told.log_evidence(), self.insertion_mm);
        let contradiction = &mut self.contradiction;
        self.alternatives.retain_mut(|(alternative, model)| {
            model.correct_with(tip_meas, variance_mm2);
            // Noise over what is told makes every difference too large. How well the model itself
            // fits says by how much.
            let log_odds = (model.log_evidence() - told) / model.innovation_excess();
            if log_odds > LOG_ODDS_MAX {
                contradiction.get_or_insert(match alternative {
                    Alternative::Mirrored => StreamContradiction::Mirrored { log_odds, depth_mm },
                    Alternative::Turned => StreamContradiction::Turned { log_odds, depth_mm },
                });
            }
            !model.is_lost() && log_odds > -LOG_ODDS_MAX
        });
        // What it is told cannot be compared any more.
        if self.told.is_lost() {
            self.give_up();
        }
    }

    /// Compares nothing any more, and contradicts nothing.
    pub fn give_up(&mut self) {
        self.alternatives.clear();
        self.contradiction = None;
    }

    /// Whether the positions may still be those of the told model.
    ///
    /// # Errors
    /// [`StreamContradiction`] once an alternative has won: the run is to be stopped with it.
    pub fn check(&self) -> Result<(), StreamContradiction> {
        self.contradiction.map_or(Ok(()), Err)
    }

    /// True once the odds have decided, for the told model or against it: nothing is followed any
    /// more.
    pub fn is_decided(&self) -> bool {
        self.contradiction.is_some() || self.alternatives.is_empty()
    }
}
