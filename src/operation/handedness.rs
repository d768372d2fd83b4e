//! The check of handedness: the base turns in air, and a sensor off its axis must turn in the same direction.
//!
//! A sensor at some distance from the needle's axis moves along a circle when the base turns. Seen along the
//! insertion, it moves in the direction in which the base turns. A mirrored tracker axis or a stage of the wrong sign
//! shows at once, before anything is inserted.

use super::moving::{Move, Moving};
use super::{HandednessSettings, MoveGoal};
use crate::math;
use crate::session::{
    Lane, MovingMean, PROVED, Record, SampleRecord, Severity, Shell, State, Task, tracker_news,
};
use crate::stage::{Feedback, SetPoint, StageEvent};
use crate::tracker::{Event, GateCounts, Refusal, Sample};
use crate::units::Time;
use std::time::Duration;

/// The base rests for `SETTLE` before each mean, which is taken over `SAMPLE`.
const SETTLE: Duration = Duration::from_millis(300);
const SAMPLE: Duration = Duration::from_secs(1);
/// Fewer positions make no mean.
const POSITIONS_MIN: usize = 5;
/// One of this many positions counts as independent: real noise is correlated.
const CORRELATED: f64 = 4.0;
/// A chord shorter than this many standard deviations of the means has no direction.
const CHORD_SDS: f64 = 8.0;
/// How far the sensor's turn may be from the base's, and its circle from the insertion axis, degrees.
const TURN_TOLERANCE_DEG: f64 = 15.0;
const TILT_MAX_DEG: f64 = 20.0;

/// The part of the check that is under way.
#[derive(Debug, Clone)]
enum Leg {
    Resting {
        since: Option<Time>,
    },
    Turning(Box<Moving>),
    /// The base makes the last turn, back to where it began.
    Returning(Box<Moving>),
}

impl HandednessSettings {
    fn turn_rad(&self) -> f64 {
        if let MoveGoal::By(turn_rad) = self.turn.goal { turn_rad } else { 0.0 }
    }
}

/// A check under way: rest, turn, rest, turn, rest, and back.
#[derive(Debug)]
pub(super) struct HandednessCheck {
    settings: HandednessSettings,
    counts: GateCounts,
    leg: Leg,
    /// The means of the rests that have ended.
    means: Vec<MovingMean>,
    /// The mean of the present rest, or of the last one.
    mean: MovingMean,
    /// Why the last position was refused.
    refused: Option<Refusal>,
    /// The reason to stop the run once the base is back.
    failed: Option<String>,
}

impl HandednessCheck {
    pub(super) fn new(settings: HandednessSettings) -> Self {
        HandednessCheck {
            settings,
            counts: GateCounts::default(),
            leg: Leg::Resting { since: None },
            means: Vec::new(),
            mean: MovingMean::new(SETTLE + SAMPLE),
            refused: None,
            failed: None,
        }
    }

    /// Takes a position of the sensor. Positions count while the base rests.
    fn take_sample(&mut self, shell: &mut Shell, sample: Sample) {
        let admitted = self.settings.gate.admit(&sample);
        self.counts.count(admitted.as_ref().err());
        let is_resting =
            matches!(self.leg, Leg::Resting { since: Some(since) } if shell.now >= since + SETTLE);
        match &admitted {
            _ if !is_resting => {}
            Ok(position_mm) => self.mean.take(shell.now, *position_mm),
            Err(refusal) => self.refused = Some(refusal.clone()),
        }
        let refused = admitted.err();
        shell.record(Record::Sample(SampleRecord { refused, ..SampleRecord::received(sample) }));
    }

    /// Handles the answers of both drives to a SYNC.
    fn handle_feedback(&mut self, shell: &mut Shell, feedback: &Feedback) -> Result<(), String> {
        if let Leg::Turning(moving) | Leg::Returning(moving) = &mut self.leg
            && !moving.has_arrived(feedback)?
        {
            let sync_period = shell.config().bus.sync_period();
            return shell.command(moving.advance(sync_period));
        }
        match &mut self.leg {
            Leg::Resting { since } => {
                let since = *since.get_or_insert(feedback.time);
                match feedback.time < since + SETTLE + SAMPLE {
                    true => Ok(()),
                    false => self.end_rest(shell, feedback),
                }
            }
            Leg::Turning(_) => {
                self.leg = Leg::Resting { since: None };
                self.mean = MovingMean::new(SETTLE + SAMPLE);
                self.refused = None;
                Ok(())
            }
            Leg::Returning(_) => match self.failed.take() {
                Some(reason) => Err(reason),
                None => {
                    shell.complete();
                    Ok(())
                }
            },
        }
    }

    /// After the third rest, or one without enough positions, the base is turned back.
    fn end_rest(&mut self, shell: &mut Shell, feedback: &Feedback) -> Result<(), String> {
        let turn = self.settings.turn;
        let is_seen = self.mean.count() >= POSITIONS_MIN;
        self.means.push(self.mean.clone());
        if is_seen && self.means.len() < 3 {
            self.leg = Leg::Turning(Box::new(Moving::new(turn, feedback.commanded)?));
            return Ok(());
        }
        let verdict = if is_seen { self.verdict() } else { Err(self.too_few()) };
        // The base turns back whatever the verdict is, so that no cable stays wound up.
        let turned = self.means.len() as f64 - 1.0;
        let goal = MoveGoal::By(-turned * self.settings.turn_rad());
        let back = Moving::new(Move { goal, ..turn }, feedback.commanded)?;
        self.leg = Leg::Returning(Box::new(back));
        match verdict {
            Ok(text) => shell.report(Lane::Session, Severity::Info, text),
            Err(reason) => {
                // Report it now: the turn back may be stopped, and then the run ends for another reason.
                shell.report(Lane::Session, Severity::Warning, reason.clone());
                self.failed = Some(reason);
            }
        }
        Ok(())
    }

    fn too_few(&self) -> String {
        let count = self.mean.count();
        let why = match &self.refused {
            Some(refusal) => refusal.to_string(),
            None => "the stream is silent, or has another tool".to_owned(),
        };
        format!(
            "tracker: {count} positions within {:.1} s (limit {POSITIONS_MIN}); {why}",
            SAMPLE.as_secs_f64()
        )
    }

    /// Judges the three means: the vector from the second to the third must be the vector from the first to the
    /// second, turned by as much as the base. Returns the text of the proof.
    ///
    /// # Errors
    /// The reason to stop the run.
    fn verdict(&self) -> Result<String, String> {
        let rests = self.means.iter().filter_map(MovingMean::mean_and_variance);
        let (means_mm, variances_mm2): (Vec<_>, Vec<_>) = rests.unzip();
        let [a, b, c] = [means_mm[0], means_mm[1], means_mm[2]];
        let (first, second) = (b - a, c - b);
        let turn_rad = self.settings.turn_rad();
        let radius_mm = 0.5 * (first.norm() + second.norm()) / (2.0 * math::sin(0.5 * turn_rad));
        let of_mean = variances_mm2.iter().zip(&self.means);
        let of_mean = of_mean.map(|(mm2, mean)| mm2 * CORRELATED / mean.count() as f64);
        let variance_mm2 = of_mean.sum::<f64>() * 2.0 / 3.0;
        let chord_min_mm = CHORD_SDS * variance_mm2.sqrt();
        if first.norm().min(second.norm()) <= chord_min_mm.max(1e-3) {
            return Err(format!(
                "tracker: the sensor is {radius_mm:.2} mm from the axis and moved no more than its noise \
                 explains ({chord_min_mm:.2} mm): handedness cannot be seen; mount it off the axis"
            ));
        }
        let normal = first.cross(&second);
        let along = normal.dot(&self.settings.axis);
        let turned_deg =
            math::atan2(normal.norm(), first.dot(&second)).to_degrees() * along.signum();
        let asked_deg = turn_rad.to_degrees();
        if (turned_deg + asked_deg).abs() <= TURN_TOLERANCE_DEG {
            return Err(format!(
                "tracker: the base turned by {asked_deg:.0} deg and the sensor by {turned_deg:.0}: is a \
                 tracker axis mirrored, or stage.rotation.sign wrong?"
            ));
        }
        if (turned_deg - asked_deg).abs() > TURN_TOLERANCE_DEG {
            return Err(format!(
                "tracker: the base turned by {asked_deg:.0} deg and the sensor by {turned_deg:.0} (tolerance \
                 {TURN_TOLERANCE_DEG:.0}): is it the needle's sensor, and counts_per_turn right?"
            ));
        }
        let tilt_deg = math::atan2((normal.norm_squared() - along * along).max(0.0).sqrt(), along)
            .to_degrees();
        if tilt_deg > TILT_MAX_DEG {
            return Err(format!(
                "tracker: the sensor's circle is tilted by {tilt_deg:.0} deg against the insertion axis \
                 (limit {TILT_MAX_DEG:.0}): is the registration turned?"
            ));
        }
        Ok(format!(
            "{PROVED}handedness is right: the sensor, {radius_mm:.2} mm off the axis, turned by {turned_deg:.1} \
             deg of {asked_deg:.1}, its circle tilted by {tilt_deg:.1} deg"
        ))
    }
}

impl Task for HandednessCheck {
    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String> {
        match event {
            // Refuses the turn before the axes have power.
            StageEvent::Located(at) => {
                let rotation_rad = at.rotation_rad + 2.0 * self.settings.turn_rad();
                shell.check_goal(SetPoint { rotation_rad, ..*at })
            }
            StageEvent::Ready => {
                shell.enter(State::TurningInAir);
                Ok(())
            }
            StageEvent::Feedback(feedback) => {
                shell.record(Record::Stage(*feedback));
                if shell.is_running() { self.handle_feedback(shell, feedback) } else { Ok(()) }
            }
            _ => Ok(()),
        }
    }

    fn take_tracker_event(&mut self, shell: &mut Shell, event: Event) {
        if let Some((severity, text)) = tracker_news(&event) {
            shell.report(Lane::Tracker, severity, text);
        }
        if let Event::Sample(sample) = event {
            self.take_sample(shell, sample);
        }
    }

    fn gate_counts(&self) -> GateCounts {
        self.counts.clone()
    }
}
