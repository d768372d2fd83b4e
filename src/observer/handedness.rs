//! Checks the handedness of the tracked positions, and the configured heading and roll at the start.
//!
//! The kinematics are left-invariant (paper Eq. 1). A rotated or shifted registration gives the
//! path of a needle that started elsewhere: positions reveal it only where the configured start
//! does not allow for that. They do reveal a mirrored tracker axis, or a stage that turns against its
//! configured sign: the mirrored path is that of a needle whose base turns the other way. So several
//! invariant filters follow the same positions, and their likelihoods are compared: the configured one, one
//! with the base's rotation negated, one that does not know the heading at the start, and one that does not
//! know the roll there.
//!
//! Under the configured model the likelihood ratio of any alternative is a martingale of mean 1.
//! The probability that it ever exceeds `e^L` is at most `e^-L` (Ville's inequality). This holds
//! for noise as configured. If the noise is correlated or larger, each position counts for less
//! ([`Whiteness`](super::Whiteness)). docs/hazards.md has the measured rate of false stops, and the
//! depth at which wrong streams are stopped.

use super::{Invariant, InvariantConfig, Observer};
use crate::geometry::FixedAngles;
use crate::needle::{Increment, Needle, TipPosition, Torsion};
use derive_more::Display;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

/// An alternative that is `e^7` times as likely as the configured model ends the run.
const LOG_ODDS_MAX: f64 = 7.0;
/// Another roll at the start ends the run only if it is `e^10` times as likely, because `e^7` stopped one correct run
/// of 2,000. Its odds grow so fast that this takes only 2 to 4 mm more.
const TURNED_LOG_ODDS_MAX: f64 = 10.0;
/// Two alternatives whose odds differ by at most a factor of `e^3` are both asked for.
const ALIKE_LOG_ODDS: f64 = 3.0;
/// At most this many positions per mm count as independent.
const INDEPENDENT_PER_MM: f64 = 20.0;
/// Share of the bank that searches for a torsion if none is configured: the shaft is assumed to
/// twist as likely as not. With the smaller share used for steering, the shaft counts as rigid
/// until the positions show its twist, and until then a mirrored needle may fit better.
const SEARCH_SHARE: f64 = 0.5;
/// Standard deviation of yaw and pitch of a heading that is not known at the start.
const HEADING_UNKNOWN_RAD: f64 = FRAC_PI_4;
/// The roll at the start is judged if its configured standard deviation is at most this, rad.
pub const ROLL_JUDGED_SD_MAX_RAD: f64 = FRAC_PI_2;
/// The first positions show the heading at the start. It is no longer judged after this depth.
const HEADING_JUDGED_MM: f64 = 30.0;

/// A model that the positions may fit better than the configured one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
enum Alternative {
    /// The base turns the other way.
    #[display("a mirrored needle")]
    Mirrored,
    /// The heading at the start is not known.
    #[display("another heading at the start")]
    Tilted,
    /// The roll at the start is not known.
    #[display("another roll at the start")]
    Turned,
}

impl Alternative {
    /// Log odds against the configured model that end the run.
    fn log_odds_max(self) -> f64 {
        match self {
            Alternative::Mirrored | Alternative::Tilted => LOG_ODDS_MAX,
            Alternative::Turned => TURNED_LOG_ODDS_MAX,
        }
    }

    /// Advice to the operator, as a question. That about a mirrored needle asks for the roll too if another roll
    /// `is_likely` as well.
    fn question(self, is_likely: impl Fn(Alternative) -> bool) -> &'static str {
        match self {
            Alternative::Mirrored if is_likely(Alternative::Turned) => {
                "is an axis mirrored, stage.rotation.sign or observer.start.roll_deg wrong, or the stream another's?"
            }
            Alternative::Mirrored => {
                "is a tracker axis mirrored, stage.rotation.sign wrong, or the stream another's?"
            }
            Alternative::Tilted => {
                "is the registration tilted, or observer.start or start_sd wrong?"
            }
            Alternative::Turned => {
                "is observer.start.roll_deg or the registration wrong, did the chuck slip, or the tissue change?"
            }
        }
    }
}

/// Why the run must stop after `depth_mm`, if the log odds of any alternative are over its limit. Names the likeliest
/// alternative, which may be another one: a limit that is higher is reached later.
fn contradiction(odds: &[(Alternative, f64)], depth_mm: f64) -> Option<String> {
    let over = odds.iter().filter(|(alternative, log_odds)| *log_odds > alternative.log_odds_max());
    let lowest = over.map(|(alternative, _)| alternative.log_odds_max()).reduce(f64::min)?;
    let known = odds.iter().filter(|(_, log_odds)| !log_odds.is_nan());
    let (likeliest, log_odds) = *known.max_by(|(_, a), (_, b)| a.total_cmp(b))?;
    let own = likeliest.log_odds_max();
    let limit = if log_odds > own { own } else { lowest };
    let question = likeliest.question(|other| {
        odds.iter().any(|(each, odds)| *each == other && *odds >= log_odds - ALIKE_LOG_ODDS)
    });
    Some(format!(
        "the positions fit {likeliest} e^{log_odds:.0} times better after {depth_mm:.1} mm (limit e^{limit:.0}): \
         {question}"
    ))
}

/// Compares the configured model with its alternatives until the odds decide.
#[derive(Debug, Clone)]
pub struct HandednessWatch {
    configured: Invariant,
    alternatives: Vec<(Alternative, Invariant)>,
    position_sd_mm: f64,
    insertion_mm: f64,
    /// Insertion at the last correction, mm.
    corrected_mm: f64,
    /// Why the run must stop, once an alternative has won.
    contradiction: Option<String>,
}

impl HandednessWatch {
    /// A watch for the configured `needle` and `torsion`, with the parameters of the invariant
    /// observer.
    pub fn new(needle: Needle, torsion: Torsion, config: InvariantConfig) -> Self {
        let config = InvariantConfig { search_share: SEARCH_SHARE, ..config };
        let configured = Invariant::new(needle, torsion, config);
        let mut alternatives = vec![(Alternative::Mirrored, configured.clone())];
        let start_sd = config.start_sd;
        let mut add_alternative = |alternative, start_sd| {
            let model = Invariant::new(needle, torsion, InvariantConfig { start_sd, ..config });
            alternatives.push((alternative, model));
        };
        if start_sd.yaw.max(start_sd.pitch) < HEADING_UNKNOWN_RAD {
            let [yaw, pitch] = [HEADING_UNKNOWN_RAD; 2];
            add_alternative(Alternative::Tilted, FixedAngles { yaw, pitch, ..start_sd });
        }
        if start_sd.roll <= ROLL_JUDGED_SD_MAX_RAD {
            add_alternative(Alternative::Turned, FixedAngles { roll: PI, ..start_sd });
        }
        HandednessWatch {
            configured,
            alternatives,
            position_sd_mm: config.position_sd_mm,
            insertion_mm: 0.0,
            corrected_mm: 0.0,
            contradiction: None,
        }
    }

    /// Advances every model by one measured increment of the base.
    pub fn predict(&mut self, increment: Increment) {
        if self.is_decided() {
            return;
        }
        self.insertion_mm += increment.insertion_mm();
        self.configured.predict(increment);
        for (alternative, model) in &mut self.alternatives {
            model.predict(match alternative {
                Alternative::Mirrored => increment.with_rotation_reversed(),
                Alternative::Tilted | Alternative::Turned => increment,
            });
        }
    }

    /// Compares every model with a position, plane frame, measured at the depth of the models. The position
    /// may be a mean; it counts as `independent` positions. An alternative that is less likely than the
    /// configured model by a factor of `e^7` is dropped for good: handedness and mounting do not change
    /// during an insertion.
    pub fn correct(&mut self, tip_meas: &TipPosition, independent: f64) {
        if self.is_decided() {
            return;
        }
        let since_mm = self.insertion_mm - self.corrected_mm;
        self.corrected_mm = self.insertion_mm;
        let independent = independent.min((INDEPENDENT_PER_MM * since_mm).max(1.0));
        let variance_mm2 = self.position_sd_mm.powi(2) / independent;
        self.configured.correct_with(tip_meas, variance_mm2);
        let (configured, depth_mm) = (self.configured.log_evidence(), self.insertion_mm);
        let mut odds = Vec::with_capacity(self.alternatives.len());
        self.alternatives.retain_mut(|(alternative, model)| {
            model.correct_with(tip_meas, variance_mm2);
            // Noise beyond the configured standard deviation exaggerates every difference. The
            // innovations of the alternative itself show by how much.
            let log_odds = (model.log_evidence() - configured) / model.innovation_excess();
            odds.push((*alternative, log_odds));
            let is_too_deep = *alternative == Alternative::Tilted && depth_mm > HEADING_JUDGED_MM;
            !model.is_lost() && log_odds > -LOG_ODDS_MAX && !is_too_deep
        });
        self.contradiction = contradiction(&odds, depth_mm);
        // Without the configured model there is nothing to compare with.
        if self.configured.is_lost() {
            self.give_up();
        }
    }

    /// Stops comparing, and withdraws any contradiction.
    pub fn give_up(&mut self) {
        self.alternatives.clear();
        self.contradiction = None;
    }

    /// Whether the positions still fit the configured model.
    ///
    /// # Errors
    /// Once an alternative has won: the run must stop with that reason.
    pub fn check(&self) -> Result<(), String> {
        self.contradiction.clone().map_or(Ok(()), Err)
    }

    /// True once the comparison is over, for or against the configured model.
    pub fn is_decided(&self) -> bool {
        self.contradiction.is_some() || self.alternatives.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::Alternative::{Mirrored, Tilted, Turned};
    use super::*;

    /// What is said of these log odds after 123.4 mm, without what is the same in all messages.
    fn said(odds: &[(Alternative, f64)]) -> String {
        let text = contradiction(odds, 123.4).unwrap_or_default();
        assert!(format!("tracker: {text}").len() < 200, "{text}");
        let text = text.replace(" times better after 123.4 mm", "");
        text.trim_start_matches("the positions fit ").to_owned()
    }

    #[test]
    fn the_likeliest_alternative_is_named() {
        assert_eq!(said(&[(Mirrored, 6.9), (Tilted, 6.9), (Turned, 9.9)]), "");
        assert_eq!(said(&[(Mirrored, f64::NAN), (Turned, f64::NAN)]), "");
        let roll = "is observer.start.roll_deg or the registration wrong, did the chuck slip, or the tissue change?";
        let turned = said(&[(Mirrored, 7.1), (Tilted, f64::NAN), (Turned, 9.2)]);
        assert_eq!(turned, format!("another roll at the start e^9 (limit e^7): {roll}"));
        let turned = said(&[(Mirrored, 8.0), (Turned, 11.4)]);
        assert_eq!(turned, format!("another roll at the start e^11 (limit e^10): {roll}"));
        let tilted = said(&[(Mirrored, 7.1), (Tilted, 12.0), (Turned, 10.5)]);
        assert!(tilted.starts_with("another heading at the start e^12 (limit e^7): "), "{tilted}");
    }

    #[test]
    fn a_mirrored_needle_asks_for_the_roll_if_another_roll_fits_as_well() {
        let asks_for_the_roll = |roll: f64| {
            let text = said(&[(Mirrored, 7.4), (Turned, roll)]);
            assert!(text.starts_with("a mirrored needle e^7 (limit e^7): "), "{text}");
            text.contains("observer.start.roll_deg")
        };
        assert_eq!(
            [4.5, 7.3, 4.3, -2.0, f64::NAN].map(asks_for_the_roll),
            [true, true, false, false, false]
        );
        assert!(!said(&[(Mirrored, 7.4)]).contains("roll_deg"));
    }
}
