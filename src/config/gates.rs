//! `[tracker.gates]`: what a tip position has to pass.

use serde::Serialize;

use super::rule::Range;
use super::section::Section;
use crate::tracker::{TrackSettings, TrackerKind};

/// `[tracker.gates]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GatesConfig {
    /// Refuse a sample whose orientation is not a rotation.
    pub rotation: bool,
    /// Refuse the exact zero and identity.
    pub zero: bool,
    /// Refuse what the tracker itself calls invalid.
    pub status: bool,
    /// End the run where the stream as a whole contradicts the insertion.
    pub stream: bool,
    /// Noise of each coordinate, standard deviation, mm.
    pub noise_sd_mm: f64,
    /// The tip moves no faster, mm/s.
    pub tip_speed_max_mm_per_s: f64,
    /// Noise let pass between two positions, in standard deviations.
    pub step_sds: f64,
    /// Limit of the squared Mahalanobis distance from the model.
    pub innovation_chi2: f64,
    /// Uncertainty of the model's position where the observer knows none, mm.
    pub model_sd_mm: f64,
    /// What is added to it per mm since the observer was corrected, mm.
    pub model_sd_per_mm: f64,
    /// Refusals in a row after which the track is lost.
    pub lost_after: u32,
    /// Positions in a row that agree after which it is found.
    pub found_after: u32,
    /// Periods without a position after which the run is coasting.
    pub coast_after_periods: f64,
}

impl GatesConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        GatesConfig {
            rotation: s.boolean("rotation"),
            zero: s.boolean("zero"),
            status: s.boolean("status"),
            stream: s.boolean("stream"),
            noise_sd_mm: s.number("noise_sd_mm", Range::over(0.0, 100.0)),
            tip_speed_max_mm_per_s: s
                .number("tip_speed_max_mm_per_s", Range::within(0.1, 10_000.0)),
            step_sds: s.number("step_sds", Range::within(1.0, 1e6)),
            innovation_chi2: s.number("innovation_chi2", Range::within(1.0, 1e9)),
            model_sd_mm: s.number("model_sd_mm", Range::within(0.0, 100.0)),
            model_sd_per_mm: s.number("model_sd_per_mm", Range::within(0.0, 10.0)),
            lost_after: s.integer("lost_after", 1, 1000),
            found_after: s.integer("found_after", 1, 1000),
            coast_after_periods: s.number("coast_after_periods", Range::within(1.0, 1000.0)),
        }
    }

    pub(super) fn to_track(self, kind: TrackerKind) -> TrackSettings {
        TrackSettings {
            kind,
            noise_sd_mm: self.noise_sd_mm,
            tip_speed_max_mm_per_s: self.tip_speed_max_mm_per_s,
            step_sds: self.step_sds,
            innovation_chi2: self.innovation_chi2,
            model_sd_mm: self.model_sd_mm,
            model_sd_per_mm: self.model_sd_per_mm,
            lost_after: self.lost_after,
            found_after: self.found_after,
            coast_after_periods: self.coast_after_periods,
        }
    }
}
