//! The tracker stream of a session: each sample is gated, registered, dated, paired and judged.

use super::config::{SessionConfig, TrackerConfig};
use super::estimation::{Estimation, Measurement};
use super::record::{Record, SampleRecord, Severity};
use crate::geometry::Pose;
use crate::needle::TipPosition;
use crate::session::{Lane, State};
use crate::tracker::gate::is_same_tool;
use crate::tracker::openigtlink::Status;
use crate::tracker::{
    AcquisitionClock, Census, CoordinateWatch, Effect, Event, Fix, GateCounts, GateName, Refusal,
    Sample, StageHistory, Track, TrackState, TravelCheck,
};
use crate::units::Time;
use std::collections::VecDeque;
use std::time::Duration;

/// Maximum number of samples that wait for the stage's next feedback; the oldest position is then refused.
const PENDING_MAX: usize = 256;
/// Once a run is being stopped, a position waits for the stage's feedback no longer than this or two SYNC
/// periods, whichever is longer, so that samples are recorded until the end.
const UNPAIRED_AGE_MAX: Duration = Duration::from_millis(100);
/// A coordinate may stay the same to the bit up to this depth, mm.
const COORDINATES_AFTER_MM: f64 = 5.0;
/// Why a position that still waits at the end is refused.
const NEVER_PAIRED: &str = "the stage gave no position at its acquisition before the run ended";
/// Why the oldest of too many positions that wait is refused.
const TOO_MANY_WAIT: &str = "too many positions wait for the stage's position at their acquisition";

/// Why the needle cannot be steered for now.
#[derive(Debug, Clone)]
pub(super) struct HoldReason {
    /// The tool that is not seen, or whose positions are refused: "tip" or "target".
    pub(super) of: &'static str,
    /// The problem, with its numbers and limits.
    pub(super) what: String,
    /// Its cause, or the advice to the operator.
    pub(super) why: String,
}

/// Positions that contradict the model.
#[derive(Debug, Clone)]
pub(super) struct Jump {
    /// The refusal, with its numbers and limits.
    pub(super) what: String,
    /// They are those of a tip that does not move.
    pub(super) is_frozen: bool,
    /// They lie behind the model along the heading.
    pub(super) is_behind: bool,
}

/// The stream of the tracker.
///
/// A sample first passes the gates that look at it alone ([`Tracking::take`]). During an insertion
/// it then waits until the stage's position at its acquisition is known, and is judged against the
/// others and the model there ([`Tracking::judge`]). Its record leaves once that is decided, in the
/// order of receipt.
pub(crate) struct Tracking {
    config: TrackerConfig,
    x_pw: Pose,
    clock: AcquisitionClock,
    pub(super) track: Track,
    travel: TravelCheck,
    /// Watches the coordinates of the accepted positions.
    coordinates: CoordinateWatch,
    /// Acquisition time of the last position that was accepted with its depth.
    accepted_at: Option<Time>,
    /// How late the newest sample came by its stamp, beyond the configured latency; 0 if it was not dated.
    late: Duration,
    /// The numbers of samples that the gates have accepted and refused so far.
    pub(super) counts: GateCounts,
    census: Census,
    unpaired_age_max: Duration,
    /// Samples in order of receipt, from the first that is not judged yet.
    waiting: VecDeque<Waiting>,
    /// Records that the session has not taken yet.
    pub(super) records: VecDeque<Record>,
    reported_state: TrackState,
    last_refusal: Option<String>,
    /// The refusal by which the mean of the last positions contradicted the model, until a position is accepted.
    pub(super) jump: Option<Jump>,
    link_error: Option<String>,
    /// The error of the last malformed message, until a position is accepted.
    malformed: Option<String>,
    /// The last STATUS with a text, or that came unasked, was OK and came after the last accepted position. PLUS sends
    /// it while its tracker gives no frames, not while a tool is out of view.
    status_is_ok: bool,
    /// Samples of the tool that the link dropped.
    dropped: u64,
    /// Positions in a row that the model refused.
    off_model_in_a_row: u32,
    /// How often there were two in a row.
    off_model_pairs: u32,
}

/// A sample that is not recorded yet. `position` is `Some` while it waits to be judged.
struct Waiting {
    record: SampleRecord,
    is_target: bool,
    position: Option<(Time, TipPosition)>,
}

impl Tracking {
    pub(crate) fn new(config: &SessionConfig) -> Self {
        let tracker = config.tracker.clone();
        Tracking {
            x_pw: config.x_wp.inverse(),
            clock: tracker.clock.clone(),
            track: Track::new(tracker.track),
            travel: TravelCheck::new(tracker.track.noise_sd_mm, config.needle.curvature_per_mm()),
            coordinates: CoordinateWatch::default(),
            accepted_at: None,
            late: Duration::ZERO,
            counts: GateCounts::default(),
            census: Census::default(),
            unpaired_age_max: UNPAIRED_AGE_MAX.max(2 * config.stage.bus.sync_period()),
            config: tracker,
            waiting: VecDeque::new(),
            records: VecDeque::new(),
            reported_state: TrackState::Waiting,
            last_refusal: None,
            jump: None,
            link_error: None,
            malformed: None,
            status_is_ok: false,
            dropped: 0,
            off_model_in_a_row: 0,
            off_model_pairs: 0,
        }
    }

    /// Notes an event of the link. A sample is only counted here: [`Tracking::take`] judges it.
    pub(crate) fn note(&mut self, now: Time, event: &Event) {
        self.census.note(event);
        match event {
            Event::Connected { .. } => {
                self.clock.reconnected();
                self.link_error = None;
                self.status_is_ok = false;
            }
            Event::Unreachable { reason } | Event::Disconnected { reason } => {
                self.link_error = Some(reason.clone());
            }
            Event::Status { status, .. } => self.status_is_ok = status.code == Status::OK,
            Event::Malformed(error) => self.malformed = Some(error.clone()),
            Event::PassedOver { dropped, .. } => self.count_dropped(now, *dropped),
            Event::Sample(_) | Event::SawTool { .. } | Event::TurnedAway { .. } => {}
        }
    }

    /// Counts samples that the link dropped. Warns at the first, and at each doubling of the count.
    fn count_dropped(&mut self, now: Time, dropped: u64) {
        let before = self.dropped;
        self.dropped += dropped;
        if self.dropped.checked_ilog2() > before.checked_ilog2() {
            let text = format!(
                "{} samples dropped so far: they come faster than the bench takes them; the newest \
                 are used; lower the tracker's rate",
                self.dropped
            );
            self.warn(now, text);
        }
    }

    fn warn(&mut self, time: Time, text: String) {
        let (lane, severity) = (Lane::Tracker, Severity::Warning);
        self.records.push_back(Record::Event { time, lane, severity, text });
    }

    /// Takes one sample. While no insertion goes on it is judged at once; during one it waits for
    /// [`Tracking::judge`].
    pub(crate) fn take(&mut self, now: Time, sample: Sample, is_inserting: bool) {
        let admitted = self.admit(&sample);
        if let Some(text) = self.clock.news() {
            self.warn(now, text);
        }
        let mut record = SampleRecord::received(sample);
        let mut position = None;
        match admitted {
            Ok((acquisition_time, tip_meas)) => {
                record.acquisition_time = Some(acquisition_time);
                record.position_plane_mm = Some(tip_meas.mm());
                if is_inserting {
                    position = Some((acquisition_time, tip_meas));
                } else {
                    let judged = self.track.seek(fix(&record, acquisition_time, &tip_meas, None));
                    if judged.is_ok() {
                        self.coordinates.take(&record.received.position_mm);
                    }
                    self.note_verdict(now, &mut record, judged.err());
                }
            }
            Err(refusal) => {
                self.track.note_refusal(&refusal);
                self.note_verdict(now, &mut record, Some(refusal));
            }
        }
        self.waiting.push_back(Waiting { record, is_target: false, position });
        if self.waiting.len() > PENDING_MAX {
            self.refuse_oldest(now, 1, TOO_MANY_WAIT);
        }
        self.release_records();
    }

    /// Records a sample of the target, which [`TargetTracking`](super::target::TargetTracking) has judged, in
    /// the order of receipt.
    pub(crate) fn record_target(&mut self, record: SampleRecord) {
        self.waiting.push_back(Waiting { record, is_target: true, position: None });
        self.release_records();
    }

    /// Applies the gates that judge a sample by itself. Returns its acquisition time and tip position.
    fn admit(&mut self, sample: &Sample) -> Result<(Time, TipPosition), Refusal> {
        self.late = Duration::ZERO;
        let position_bench_mm = self.config.gate.admit(sample)?;
        let position_plane_mm = self.x_pw.transform(&position_bench_mm);
        let tip_meas = TipPosition::new(position_plane_mm)
            .ok_or_else(|| Refusal::not_finite(&position_plane_mm))?;
        let acquisition_time = self.clock.acquisition_time(sample)?;
        let age = sample.receive_time.since(acquisition_time);
        self.late = age.saturating_sub(self.clock.latency());
        Ok((acquisition_time, tip_meas))
    }

    /// Judges the positions whose acquisition the stage's history now covers, in the order of receipt.
    /// Returns those that are accepted.
    pub(crate) fn judge(
        &mut self,
        now: Time,
        history: &StageHistory,
        estimation: &Estimation,
    ) -> Vec<Measurement> {
        let mut believed = Vec::new();
        let Some(newest) = history.newest().map(|point| point.time) else { return believed };
        let mut waiting = std::mem::take(&mut self.waiting);
        for sample in &mut waiting {
            let Some((acquisition_time, tip_meas)) = sample.position else { continue };
            if acquisition_time > newest {
                continue;
            }
            sample.position = None;
            let judged =
                self.judge_one(&sample.record, acquisition_time, &tip_meas, history, estimation);
            if let Ok(stage_insertion_meas_mm) = judged {
                self.coordinates.take(&sample.record.received.position_mm);
                let independent = self.independent(acquisition_time);
                self.travel.take(stage_insertion_meas_mm, &tip_meas.mm(), independent);
                believed.push(Measurement {
                    acquisition_time,
                    stage_insertion_meas_mm,
                    tip_meas,
                    positions: 1,
                });
            }
            self.note_verdict(now, &mut sample.record, judged.err());
        }
        self.waiting = waiting;
        self.release_records();
        believed
    }

    /// Checks that the stream as a whole does not contradict the insertion, now `insertion_mm` deep.
    ///
    /// # Errors
    /// The contradiction, which is the reason to stop the run.
    pub(super) fn check_stream(&self, insertion_mm: f64) -> Result<(), String> {
        if !self.config.judges_stream {
            return Ok(());
        }
        let is_due = !self.config.is_exact && insertion_mm >= COORDINATES_AFTER_MM;
        let constant =
            is_due.then(|| self.coordinates.constant(CoordinateWatch::POSITIONS_INSERTED));
        match constant.flatten() {
            Some(constant) => Err(format!(
                "tracker: {constant}, {insertion_mm:.1} mm inserted (limit {COORDINATES_AFTER_MM:.1}): {}",
                CoordinateWatch::ADVICE
            )),
            None => self.travel.check().map_err(|error| format!("tracker: {error}")),
        }
    }

    /// The number of independent positions that carry as much information as an accepted one, by the configured noise.
    fn independent(&mut self, acquisition_time: Time) -> f64 {
        let last = self.accepted_at.replace(acquisition_time);
        let spacing_s = last.map_or(f64::INFINITY, |last| acquisition_time.seconds_after(last));
        self.config.noise.map_or(1.0, |noise| noise.inflation(spacing_s).recip())
    }

    /// The stage's depth at the position's acquisition, if the position is accepted.
    fn judge_one(
        &mut self,
        record: &SampleRecord,
        acquisition_time: Time,
        tip_meas: &TipPosition,
        history: &StageHistory,
        estimation: &Estimation,
    ) -> Result<f64, Refusal> {
        let stage = history.at(acquisition_time);
        let stage = stage.map_err(|why| Refusal::new(GateName::Pairing, why))?;
        let insertion_mm = stage.insertion_mm;
        let prediction = estimation.prediction(acquisition_time, history)?;
        let fix = fix(record, acquisition_time, tip_meas, Some(insertion_mm));
        let judged = self.track.judge(fix, prediction.as_ref());
        judged.map_err(|refusal| self.travel.explain(refusal))?;
        Ok(insertion_mm)
    }

    /// Notes whether a sample was accepted, in its record and for the messages.
    fn note_verdict(&mut self, now: Time, record: &mut SampleRecord, refusal: Option<Refusal>) {
        self.counts.count(refusal.as_ref());
        match refusal {
            None => {
                self.off_model_in_a_row = 0;
                self.last_refusal = None;
                self.jump = None;
                self.malformed = None;
                self.status_is_ok = false;
            }
            Some(refusal) => {
                match refusal.effect {
                    Effect::Loses => {
                        let is_behind = refusal.is_behind && !self.travel.is_in_metres();
                        let (what, is_frozen) = (refusal.to_string(), self.travel.is_frozen());
                        self.jump = Some(Jump { what, is_frozen, is_behind });
                    }
                    _ if refusal.gate == GateName::Innovation => self.warn_of_jump(now, &refusal),
                    _ => {}
                }
                if is_same_tool(&record.received.tool, &self.config.gate.tool) {
                    self.last_refusal = Some(refusal.to_string());
                }
                record.position_plane_mm = None;
                record.acquisition_time = None;
                record.refused = Some(refusal);
            }
        }
        self.report_track(now);
    }

    /// Warns when the model refuses a second position in a row. Such a jump may be too small, or the stream too
    /// slow, to lose the track; the observer then may come to accept it. The warning comes at the first pair and
    /// at each doubling of their number.
    fn warn_of_jump(&mut self, time: Time, refusal: &Refusal) {
        self.off_model_in_a_row += 1;
        if self.off_model_in_a_row != 2 {
            return;
        }
        self.off_model_pairs += 1;
        if self.off_model_pairs.is_power_of_two() && self.track.is_established() {
            let text = format!(
                "two positions in a row do not fit the model (pair {} of this run): {refusal}",
                self.off_model_pairs
            );
            self.warn(time, text);
        }
    }

    /// Records that the track was lost or found again.
    fn report_track(&mut self, time: Time) {
        let state = self.track.state(time);
        let was = std::mem::replace(&mut self.reported_state, state);
        let (severity, text) = match (was, state) {
            (TrackState::Lost, TrackState::Lost) => return,
            (_, TrackState::Lost) => {
                let last = self.last_refusal.as_deref().unwrap_or("none");
                let refused = self.track.refused_in_a_row();
                (Severity::Warning, format!("lost, {refused} refused in a row; the last: {last}"))
            }
            // Before an insertion the tip is searched for again, without a model.
            (TrackState::Lost, TrackState::Waiting) => return,
            (TrackState::Lost, _) => {
                (Severity::Info, "found again: it agrees with the model".to_owned())
            }
            _ => return,
        };
        self.records.push_back(Record::Event { time, lane: Lane::Tracker, severity, text });
    }

    /// Refuses those of the `count` oldest samples that still wait to be judged.
    fn refuse_oldest(&mut self, now: Time, count: usize, why: &str) {
        let mut waiting = std::mem::take(&mut self.waiting);
        for sample in waiting.iter_mut().take(count) {
            if sample.position.take().is_some() {
                let refusal = Refusal::new(GateName::Pairing, why);
                self.note_verdict(now, &mut sample.record, Some(refusal));
            }
        }
        self.waiting = waiting;
    }

    /// While the run is being stopped: refuses the samples that have waited too long for the stage's feedback.
    pub(crate) fn refuse_unpaired(&mut self, now: Time) {
        let oldest = now - self.unpaired_age_max;
        let is_late = |sample: &&Waiting| sample.record.received.receive_time < oldest;
        let late = self.waiting.iter().take_while(is_late).count();
        self.refuse_oldest(now, late, NEVER_PAIRED);
        self.release_records();
    }

    /// The run is over: positions that still wait are refused, and all samples recorded.
    pub(crate) fn close(&mut self, now: Time) {
        self.refuse_oldest(now, usize::MAX, NEVER_PAIRED);
        self.release_records();
    }

    /// Releases the records up to the first sample that still waits to be judged.
    fn release_records(&mut self) {
        while let Some(decided) = self.waiting.pop_front_if(|sample| sample.position.is_none()) {
            self.records.push_back(match decided.is_target {
                true => Record::Target(decided.record),
                false => Record::Sample(decided.record),
            });
        }
    }

    /// The state of the stream, for the operator.
    pub(crate) fn state(&self, now: Time) -> State {
        match self.track.state(now) {
            _ if self.link_error.is_some() => State::Disconnected,
            TrackState::Waiting => State::AwaitingTip,
            TrackState::Tracking => State::Tracking,
            TrackState::Coasting => State::Coasting,
            TrackState::Lost => State::Lost,
        }
    }

    /// Seconds since the newest accepted position was acquired; `None` before the first.
    pub(crate) fn age_s(&self, now: Time) -> Option<f64> {
        self.last_acquisition().map(|acquired| now.seconds_after(acquired))
    }

    /// True while the tip is found, not lost, and was seen lately.
    pub(crate) fn is_seen(&self, now: Time) -> bool {
        self.track.is_established() && self.is_fresh(now)
    }

    /// True while the newest accepted position is recent enough to steer by.
    pub(crate) fn is_fresh(&self, now: Time) -> bool {
        self.age_s(now).is_some_and(|age_s| age_s <= self.config.hold.after.as_secs_f64())
    }

    /// When the newest accepted position was acquired.
    pub(crate) fn last_acquisition(&self) -> Option<Time> {
        self.track.last_believed().map(|fix| fix.acquisition_time)
    }

    /// Why there is no tip to steer by, and what to do: for the operator.
    pub(crate) fn explain_silence(&self) -> String {
        if let Some(error) = &self.link_error {
            return error.clone();
        }
        if self.late > self.config.hold.after / 2 {
            return format!(
                "the newest came {:.2} s late by its stamp: a slow link, or its clock (tracker.stamp)",
                self.late.as_secs_f64()
            );
        }
        match &self.last_refusal {
            Some(refusal) if self.census.has(&self.config.gate.tool) => refusal.to_string(),
            _ if let Some(error) = self.malformed.as_ref().filter(|_| self.counts.accepted > 0) => {
                format!("the tracker's messages cannot be read: {error}")
            }
            _ if self.counts.accepted > 0 && self.status_is_ok => {
                "STATUS OK but no position: PLUS's tracker off, or tool out of view".to_owned()
            }
            _ if self.counts.accepted > 0 => {
                "the link is up: the tool is out of view, or the source has stopped sending"
                    .to_owned()
            }
            _ => self.census.explain_missing(&self.config.gate.tool),
        }
    }
}

fn fix(
    record: &SampleRecord,
    acquisition_time: Time,
    tip_meas: &TipPosition,
    insertion_mm: Option<f64>,
) -> Fix {
    let (receive_time, position_mm) = (record.received.receive_time, tip_meas.mm());
    Fix { receive_time, acquisition_time, position_mm, insertion_mm }
}

#[cfg(test)]
mod tests;
