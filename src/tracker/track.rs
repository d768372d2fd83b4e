//! Checks that the positions of a stream agree with one another and with the model of the needle.

use super::refusal::{Effect, GateName, Refusal, short};
use crate::keys::{choice, over, section, within};
use crate::math;
use crate::units::Time;
use nalgebra::{Matrix3, Vector3};
use std::collections::VecDeque;
use std::time::Duration;

choice! {
    /// What a repeated value means.
    pub enum TrackerKind {
        /// Every sample is a measurement: a repeated value is a frozen stream.
        Electromagnetic = "electromagnetic",
        /// Most frames are repeated: a repeated value is no measurement.
        Imaging = "imaging",
    }
}

section! {
    /// The limits of a [`Track`].
    #[derive(Copy)]
    pub struct TrackSettings {
        /// Standard deviation of the noise of each coordinate, mm; ±1 mm uniform has 0.58.
        noise_sd_mm: f64 [over(0.0, 100.0)] = 0.6;
        /// The tip moves no faster than this, mm/s.
        tip_speed_max_mm_per_s: f64 [within(0.1, 10_000.0)] = 10.0;
        /// Noise allowed between two positions, in standard deviations.
        step_sds: f64 [within(1.0, 1e6)] = 6.0;
        /// Limit of the squared Mahalanobis distance from the model; 0.1% of good positions exceed 16.3.
        innovation_chi2: f64 [within(1.0, 1e9)] = 16.3;
        /// Standard deviation of each coordinate of the model, mm, for observers without a covariance.
        model_sd_mm: f64 [within(0.0, 100.0)] = 1.0;
        /// Growth of the model's standard deviation per mm since the observer's last correction, mm.
        model_sd_per_mm: f64 [within(0.0, 10.0)] = 0.2;
        /// After so many refusals in a row the track is lost.
        lost_after: u32 [within(1.0, 1000.0)] = 5;
        /// It is found again when so many positions in a row agree with the model.
        found_after: u32 [within(1.0, 1000.0)] = 3;
        /// After so many periods of the stream without a position the run is coasting.
        coast_after_periods: f64 [within(1.0, 1000.0)] = 2.0;
    }
    beside {
        /// What a repeated value means.
        pub kind: TrackerKind = TrackerKind::Electromagnetic,
        /// The share of the noise's variance whose correlation decays with time, and the time after which it is 1/e.
        pub correlated: Option<(f64, Duration)> = None,
    }
}

/// A position of the tip to judge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fix {
    /// When the bench received it.
    pub receive_time: Time,
    /// When the tip was there.
    pub acquisition_time: Time,
    /// Where it was, mm, in a fixed frame.
    pub position_mm: Vector3<f64>,
    /// The stage's depth at that moment, mm; none before an insertion.
    pub insertion_mm: Option<f64>,
}

/// Where the model has the tip at a sample's acquisition.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// The predicted position, mm, in the frame of the fixes.
    pub position_mm: Vector3<f64>,
    /// Where the tip is heading, a unit vector in that frame; zero if it does not move.
    pub heading: Vector3<f64>,
    /// Its covariance when the observer was last corrected, where the observer carries one, mm².
    pub covariance_mm2: Option<Matrix3<f64>>,
    /// Millimetres inserted since then.
    pub since_correction_mm: f64,
}

/// The state of a track, for the operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackState {
    /// Too few positions have come yet that agree with one another.
    Waiting,
    /// Positions come and are believed.
    Tracking,
    /// None has come for some periods.
    Coasting,
    /// Too many were refused; only the model can find the tip again.
    Lost,
}

/// The position of the newest sample, accepted or not, and how often it was repeated.
#[derive(Debug, Clone, Copy)]
struct Newest {
    position_mm: Vector3<f64>,
    /// The stage's depth when this position first came, mm.
    insertion_mm: Option<f64>,
    repeats: u32,
}

/// A smaller change of depth, mm, is not motion: encoder counts, or a drive that holds its target.
const STANDSTILL_MM: f64 = 0.01;
/// The test for a jump takes the mean of this many innovations: 0.2 s of a tracker at 40 Hz.
const JUMP_POSITIONS: usize = 8;
/// The innovation of a refused position is part of the mean only up to this multiple of the step that
/// noise may cause (`step_sds`): a larger one would shift the mean by itself.
const JUMP_STEPS: f64 = 2.0;
/// The mean has the noise of this many independent innovations: real noise is correlated.
const JUMP_INDEPENDENT: f64 = 4.0;
/// The χ² limit of the mean is this multiple of the limit of a single innovation: 41 by default, exceeded
/// by chance once in 1e8.
const JUMP_CHI2_TIMES: f64 = 2.5;
/// The χ² limit of the mean's lag behind the model along the heading (one-sided, one degree of freedom) is
/// this share of the limit of the mean: 31.5 by default, exceeded by chance as seldom.
const LAG_CHI2_SHARE: f64 = 0.77;
/// Standard deviation, mm, added to that of any model when a jump is looked for.
const JUMP_MODEL_SD_MM: f64 = 0.2;
const NO_MODEL: &str = "no observer has an estimate yet to find the tip again";
/// The period is averaged over about this many positions.
const PERIOD_MEMORY: f64 = 16.0;

/// The track of a tip: accepts positions that follow from the ones before and from the model.
///
/// Before an insertion the tip may be anywhere: it is found once some positions in a row are
/// within a step of one another ([`Track::seek`]). During an insertion ([`Track::judge`]) a position must
/// pass these checks:
///
/// - **repeat**: it differs from the last sample. An electromagnetic tracker may repeat a position to
///   the bit while the needle stands; a repeat from an imaging tracker is never a measurement.
/// - **step**: `|p − p_last| ≤ v_max Δt + k σ`, from the last position believed.
/// - **innovation**: `rᵀ S⁻¹ r` under the χ² limit, with r the distance from the model and
///   `S = P + (g d)² I + σ² I`, P the observer's covariance or a configured prior, d the
///   millimetres since its last correction and g the configured growth.
/// - **jump**: the same test of the mean of the last innovations, which has less noise. Refused positions
///   count in it unless they are far off. It shows a jump that the noise of a single position hides, and
///   the track is lost at once. A jump is reported before a step or an innovation.
///
/// After some refusals in a row the track is lost. Then the step is not checked: the stream may have
/// jumped anywhere. The track is found again once enough positions in a row, and their mean, agree with
/// the model.
#[derive(Debug, Clone)]
pub struct Track {
    settings: TrackSettings,
    last_believed: Option<Fix>,
    newest: Option<Newest>,
    is_found: bool,
    is_lost: bool,
    /// Positions in a row that agree: with one another before an insertion, with the model while lost.
    agreeing: u32,
    refused_in_a_row: u32,
    /// The last distances from the model, of believed and refused positions, without those far off.
    innovations_mm: VecDeque<Vector3<f64>>,
    period_s: Option<f64>,
}

impl Track {
    /// A track without positions.
    pub fn new(settings: TrackSettings) -> Self {
        Track {
            settings,
            last_believed: None,
            newest: None,
            is_found: false,
            is_lost: false,
            agreeing: 0,
            refused_in_a_row: 0,
            innovations_mm: VecDeque::with_capacity(JUMP_POSITIONS),
            period_s: None,
        }
    }

    /// Judges a position while the needle stands and no insertion has begun.
    ///
    /// # Errors
    /// `Repeat` from an imaging tracker; `Step` if it is too far from the position before, which it then
    /// replaces.
    pub fn seek(&mut self, fix: Fix) -> Result<(), Refusal> {
        self.check_repeat(&fix)?;
        self.is_lost = false;
        let step = self.check_step(&fix);
        self.agreeing = if step.is_ok() { self.agreeing + 1 } else { 1 };
        self.is_found = self.agreeing >= self.settings.found_after;
        self.believe(fix);
        step
    }

    /// Judges a position during an insertion.
    ///
    /// # Errors
    /// The gate that refused it. A position may also be refused because it agrees with the model
    /// and the track, being lost, needs more that do.
    pub fn judge(&mut self, fix: Fix, prediction: Option<&Prediction>) -> Result<(), Refusal> {
        let judged = self.check(&fix, prediction);
        match &judged {
            Ok(()) => self.believe(fix),
            Err(refusal) => self.note_refusal(refusal),
        }
        judged
    }

    /// Counts a refusal, also one by another gate. Enough in a row lose the track.
    pub fn note_refusal(&mut self, refusal: &Refusal) {
        let is_usual =
            refusal.gate == GateName::Repeat && self.settings.kind == TrackerKind::Imaging;
        if refusal.effect != Effect::None && !is_usual {
            self.refused_in_a_row = self.refused_in_a_row.saturating_add(1);
        }
        let is_limit_reached = self.refused_in_a_row >= self.settings.lost_after;
        if (self.is_established() && is_limit_reached) || refusal.effect == Effect::Loses {
            self.is_lost = true;
            self.agreeing = 0;
        }
    }

    /// The state at `now`, for the operator.
    pub fn state(&self, now: Time) -> TrackState {
        match self.last_believed {
            _ if self.is_lost => TrackState::Lost,
            Some(last) if self.is_found => {
                let silent_s = now.seconds_after(last.receive_time);
                let periods = self.settings.coast_after_periods;
                match self.period_s {
                    Some(period_s) if silent_s > periods * period_s => TrackState::Coasting,
                    _ => TrackState::Tracking,
                }
            }
            _ => TrackState::Waiting,
        }
    }

    /// True while the tip is found and not lost.
    pub fn is_established(&self) -> bool {
        self.is_found && !self.is_lost
    }

    /// Refusals in a row.
    pub fn refused_in_a_row(&self) -> u32 {
        self.refused_in_a_row
    }

    /// The number of them that loses the track.
    pub fn lost_after(&self) -> u32 {
        self.settings.lost_after
    }

    /// The last position believed.
    pub fn last_believed(&self) -> Option<&Fix> {
        self.last_believed.as_ref()
    }

    fn check(&mut self, fix: &Fix, prediction: Option<&Prediction>) -> Result<(), Refusal> {
        self.check_repeat(fix)?;
        let step = if self.is_lost { Ok(()) } else { self.check_step(fix) };
        let Some(prediction) = prediction else {
            return if self.is_lost { Err(Refusal::new(GateName::Lost, NO_MODEL)) } else { step };
        };
        let agrees = self.check_innovation(fix, prediction);
        if self.innovations_mm.len() == JUMP_POSITIONS {
            let limit = JUMP_CHI2_TIMES * self.settings.innovation_chi2;
            let independent = self.independent(JUMP_POSITIONS).min(JUMP_INDEPENDENT);
            self.check_jump(prediction, JUMP_POSITIONS, independent, limit)?;
        }
        step?;
        if self.is_lost { self.check_found(agrees, prediction) } else { agrees }
    }

    /// Judges one more position of a lost track, which may agree with the model.
    fn check_found(
        &mut self,
        agrees: Result<(), Refusal>,
        prediction: &Prediction,
    ) -> Result<(), Refusal> {
        self.agreeing = if agrees.is_ok() { self.agreeing + 1 } else { 0 };
        agrees?;
        let (agreeing, needed) = (self.agreeing, self.settings.found_after);
        if agreeing < needed {
            let why = format!("agrees with the model, {agreeing} of {needed} needed in a row");
            return Err(Refusal::new(GateName::Lost, why));
        }
        let positions = self.innovations_mm.len().min(agreeing as usize);
        let limit = self.settings.innovation_chi2;
        self.check_jump(prediction, positions, self.independent(positions), limit)?;
        self.is_lost = false;
        Ok(())
    }

    fn check_repeat(&mut self, fix: &Fix) -> Result<(), Refusal> {
        let newest = match &mut self.newest {
            Some(newest) if newest.position_mm == fix.position_mm => newest,
            _ => {
                let Fix { position_mm, insertion_mm, .. } = *fix;
                self.newest = Some(Newest { position_mm, insertion_mm, repeats: 0 });
                return Ok(());
            }
        };
        newest.repeats = newest.repeats.saturating_add(1);
        // Before an insertion the needle stands, wherever the stage is.
        let moved_mm =
            fix.insertion_mm.map_or(0.0, |mm| mm - *newest.insertion_mm.get_or_insert(mm));
        let may_repeat =
            self.settings.kind == TrackerKind::Electromagnetic && moved_mm.abs() <= STANDSTILL_MM;
        if may_repeat { Ok(()) } else { Err(Refusal::repeat(newest.repeats)) }
    }

    fn check_step(&self, fix: &Fix) -> Result<(), Refusal> {
        let Some(last) = &self.last_believed else { return Ok(()) };
        let TrackSettings { tip_speed_max_mm_per_s, step_sds, noise_sd_mm, .. } = self.settings;
        let step_mm = (fix.position_mm - last.position_mm).norm();
        let after_s = fix.acquisition_time.seconds_after(last.acquisition_time).max(0.0);
        let limit_mm = tip_speed_max_mm_per_s * after_s + step_sds * noise_sd_mm;
        // Written so that NaN is refused.
        if step_mm <= limit_mm {
            return Ok(());
        }
        let why = format!(
            "{} mm in {after_s:.3} s since the last tip (limit {limit_mm:.1}); is it another tool?",
            short(step_mm)
        );
        Err(Refusal::new(GateName::Step, why))
    }

    fn check_innovation(&mut self, fix: &Fix, prediction: &Prediction) -> Result<(), Refusal> {
        let TrackSettings { noise_sd_mm, step_sds, innovation_chi2: limit, .. } = self.settings;
        let innovation = fix.position_mm - prediction.position_mm;
        let distance_mm = innovation.norm();
        let chi2 = self.chi2(&innovation, prediction, noise_sd_mm.powi(2));
        // Written so that NaN is refused.
        let agrees = chi2 <= limit;
        if agrees || distance_mm <= JUMP_STEPS * step_sds * noise_sd_mm {
            if self.innovations_mm.len() == JUMP_POSITIONS {
                self.innovations_mm.pop_front();
            }
            self.innovations_mm.push_back(innovation);
        }
        if agrees {
            return Ok(());
        }
        let why = format!(
            "{} mm off the model, chi2 {} (limit {limit:.1}); a jump, or needle.radius_mm?",
            short(distance_mm),
            short(chi2)
        );
        Err(Refusal::new(GateName::Innovation, why))
    }

    /// The number of independent positions whose mean has as much noise as that of `positions` of this stream.
    fn independent(&self, positions: usize) -> f64 {
        let count = positions as f64;
        let Some((share, time)) = self.settings.correlated else { return count };
        let after = self.period_s.unwrap_or(0.0) / time.as_secs_f64();
        let pairs =
            (1..positions).map(|lag| 2.0 * (count - lag as f64) * math::exp(-after * lag as f64));
        count / (1.0 + share * pairs.sum::<f64>() / count)
    }

    /// Tests the mean of the last `positions` innovations, which has the noise of `independent` independent
    /// ones, and how far it lags behind the model along the heading. The lag is the first sign of a frozen
    /// stream.
    fn check_jump(
        &self,
        prediction: &Prediction,
        positions: usize,
        independent: f64,
        limit: f64,
    ) -> Result<(), Refusal> {
        let last = self.innovations_mm.iter().rev().take(positions);
        let mean = last.sum::<Vector3<f64>>() / positions as f64;
        let noise_mm2 = self.settings.noise_sd_mm.powi(2) / independent;
        let lag = prediction.heading * mean.dot(&prediction.heading).min(0.0);
        let lag_limit = LAG_CHI2_SHARE * limit;
        let chi2 = |offset: &Vector3<f64>| {
            self.chi2(offset, prediction, noise_mm2 + JUMP_MODEL_SD_MM.powi(2))
        };
        let is_behind = chi2(&lag) > lag_limit;
        let tests = [(mean, limit, "off the model"), (lag, lag_limit, "behind the model")];
        for (offset, limit, direction) in tests {
            let chi2 = chi2(&offset);
            // Written so that NaN is refused.
            if chi2 <= limit {
                continue;
            }
            let why = format!(
                "the mean of {positions} is {} mm {direction}, chi2 {} (limit {limit:.1})",
                short(offset.norm()),
                short(chi2)
            );
            let refusal = Refusal::new(GateName::Innovation, why);
            return Err(Refusal { effect: Effect::Loses, is_behind, ..refusal });
        }
        Ok(())
    }

    /// Squared Mahalanobis distance of an innovation whose noise has this variance.
    fn chi2(&self, innovation: &Vector3<f64>, prediction: &Prediction, noise_mm2: f64) -> f64 {
        let settings = &self.settings;
        let variance = |mm2: f64| Matrix3::identity() * mm2;
        let model =
            prediction.covariance_mm2.unwrap_or_else(|| variance(settings.model_sd_mm.powi(2)));
        let growth_mm = settings.model_sd_per_mm * prediction.since_correction_mm;
        let expected = model + variance(growth_mm.powi(2)) + variance(noise_mm2);
        expected
            .cholesky()
            .map_or(f64::INFINITY, |expected| innovation.dot(&expected.solve(innovation)))
    }

    fn believe(&mut self, fix: Fix) {
        let interval_s = self
            .last_believed
            .map(|last| fix.acquisition_time.seconds_after(last.acquisition_time));
        if let Some(interval_s) = interval_s.filter(|interval_s| *interval_s > 0.0) {
            // Limited, so that a gap hardly changes the period. The period of a slower stream is still learnt.
            let period_s = self.period_s.unwrap_or(interval_s);
            let interval_s = interval_s.min(self.settings.coast_after_periods * period_s);
            self.period_s = Some(period_s + (interval_s - period_s) / PERIOD_MEMORY);
        }
        self.refused_in_a_row = 0;
        self.last_believed = Some(fix);
    }
}

#[cfg(test)]
mod tests;
