//! The tracker stream as the session believes it: gated, registered, dated and paired.

use super::config::{SessionConfig, TrackerConfig};
use super::estimation::Measurement;
use super::record::SampleRecord;
use crate::geometry::Pose;
use crate::needle::TipPosition;
use crate::tracker::gate::is_tool;
use crate::tracker::{AcquisitionClock, Census, Event, Gate, Sample, StageHistory};
use crate::units::Time;
use nalgebra::UnitQuaternion;
use std::collections::VecDeque;

/// Positions waiting for the stage's next feedback, at most; the oldest make room.
const PENDING_MAX: usize = 256;

/// What has been heard from the tracker.
pub(crate) struct Tracking {
    config: TrackerConfig,
    x_pw: Pose,
    gate: Gate,
    clock: AcquisitionClock,
    census: Census,
    pending: VecDeque<(Time, TipPosition)>,
    accepted: u64,
    last_acquisition: Option<Time>,
    last_refusal: Option<String>,
    link_trouble: Option<String>,
}

impl Tracking {
    pub(crate) fn new(config: &SessionConfig) -> Self {
        let tracker = config.tracker.clone();
        Tracking {
            x_pw: config.x_wp.inverse(),
            gate: Gate::new(tracker.gate.clone()),
            clock: tracker.clock.clone(),
            census: Census::default(),
            config: tracker,
            pending: VecDeque::new(),
            accepted: 0,
            last_acquisition: None,
            last_refusal: None,
            link_trouble: None,
        }
    }

    /// Notes what happened on the link, samples apart.
    pub(crate) fn note(&mut self, event: &Event) {
        self.census.note(event);
        match event {
            Event::Connected { .. } => {
                self.gate.reconnected();
                self.clock.reconnected();
                self.link_trouble = None;
            }
            Event::Unreachable { reason } | Event::Disconnected { reason } => {
                self.link_trouble = Some(reason.clone());
            }
            Event::Sample(_)
            | Event::Status { .. }
            | Event::SawTool { .. }
            | Event::Malformed(_) => {}
        }
    }

    /// Takes one sample: refuses it, or keeps it until the stage's position at its acquisition is
    /// known.
    pub(crate) fn take(&mut self, sample: Sample) -> SampleRecord {
        let accepted = self.accept(&sample);
        let mut record = SampleRecord {
            receive_time: sample.receive_time,
            source_unix_ns: sample.source_unix_ns,
            tool: sample.tool.clone(),
            position_tracker_mm: sample.position_mm,
            orientation_tracker_wxyz: sample.orientation.map(|rotation| {
                let q = UnitQuaternion::from_rotation_matrix(&rotation);
                [q.w, q.i, q.j, q.k]
            }),
            validity: sample.validity.clone(),
            position_plane_mm: None,
            acquisition_time: None,
            refused: None,
        };
        self.census.note(&Event::Sample(sample));
        match accepted {
            Ok((acquisition_time, tip_meas)) => {
                record.acquisition_time = Some(acquisition_time);
                record.position_plane_mm = Some(tip_meas.mm());
                self.accepted += 1;
                self.last_acquisition = self.last_acquisition.max(Some(acquisition_time));
                self.last_refusal = None;
                if self.pending.len() == PENDING_MAX {
                    self.pending.pop_front();
                }
                self.pending.push_back((acquisition_time, tip_meas));
            }
            Err(reason) => {
                if is_tool(&record.tool, &self.config.gate.tool) {
                    self.last_refusal = Some(reason.clone());
                }
                record.refused = Some(reason);
            }
        }
        record
    }

    fn accept(&mut self, sample: &Sample) -> Result<(Time, TipPosition), String> {
        let position_bench_mm = self.gate.admit(sample).map_err(|refusal| refusal.to_string())?;
        let tip_meas = TipPosition::new(self.x_pw.transform(&position_bench_mm))
            .ok_or_else(|| "tracker: not finite in the plane frame".to_owned())?;
        let acquired = self.clock.acquisition_time(sample).map_err(|error| error.to_string())?;
        Ok((acquired, tip_meas))
    }

    /// The positions whose acquisition the stage's history now covers, oldest first. One from
    /// before the history begins is passed over: the stage was not yet watched then.
    pub(crate) fn paired(&mut self, history: &StageHistory) -> Vec<Measurement> {
        let Some(newest) = history.newest().map(|point| point.time) else { return Vec::new() };
        let mut paired = Vec::new();
        while let Some((acquisition_time, tip_meas)) =
            self.pending.pop_front_if(|(acquired, _)| *acquired <= newest)
        {
            if let Ok(point) = history.at(acquisition_time) {
                let insertion_meas_mm = point.insertion_mm;
                paired.push(Measurement { acquisition_time, insertion_meas_mm, tip_meas });
            }
        }
        paired
    }

    /// Seconds since the newest believed position was acquired; `None` before the first.
    pub(crate) fn age_s(&self, now: Time) -> Option<f64> {
        self.last_acquisition.map(|acquired| now.seconds_after(acquired))
    }

    /// True while the newest believed position is young enough to steer by.
    pub(crate) fn is_fresh(&self, now: Time) -> bool {
        self.age_s(now).is_some_and(|age_s| age_s <= self.config.hold_after.as_secs_f64())
    }

    /// When the newest believed position was acquired.
    pub(crate) fn last_acquisition(&self) -> Option<Time> {
        self.last_acquisition
    }

    /// Why there is no tip to steer by, and what to do: for the operator.
    pub(crate) fn explain_silence(&self) -> String {
        if let Some(trouble) = &self.link_trouble {
            return trouble.clone();
        }
        match &self.last_refusal {
            Some(refusal) if self.census.has(&self.config.gate.tool) => {
                format!("{}; the last: {refusal}", self.gate.counts())
            }
            _ if self.accepted > 0 => {
                "the link is up: the tool is out of view, or the source has stopped sending"
                    .to_owned()
            }
            _ => self.census.explain_missing(&self.config.gate.tool),
        }
    }
}
