//! From configuration sections to what the pure parts of the bench are told: mm, rad, per mm.

use super::{
    Config, ConfigError, ControlKind, DriveConfig, DriveModel, InsertionMode, ObserverKind,
};
use crate::emulator::fault::Fault;
use crate::emulator::{Gearing, VirtualStageConfig, drive};
use crate::needle::{Needle, Torsion};
use crate::observer::InvariantConfig;
use crate::session::{
    self, ControlConfig, InsertionConfig, ObserverConfig, SessionConfig, TrackerConfig,
};
use std::time::Duration;

/// What an emulated drive says it is where the configuration expects nothing: no vendor's number.
const EMULATED_VENDOR_ID: u32 = 0;
const EMULATED_PRODUCT_CODE: u32 = 0x402;

impl Config {
    /// What a session is told.
    ///
    /// # Errors
    /// No registration, or numbers that the parts themselves refuse.
    pub fn session(&self) -> Result<SessionConfig, ConfigError> {
        let insertion = &self.insertion;
        let tracker = &self.tracker;
        Ok(SessionConfig {
            x_wp: self.plane.to_pose(),
            insertion: InsertionConfig {
                depth_mm: insertion.depth_mm,
                speed_mm_per_s: insertion.speed_mm_per_s,
                acceleration_mm_per_s2: insertion.acceleration_mm_per_s2,
                step_mm: insertion.step_mm,
                arrival_mm: insertion.arrival_mm,
                mode: match insertion.mode {
                    InsertionMode::Continuous => session::InsertionMode::Continuous,
                    InsertionMode::Stepwise => session::InsertionMode::Stepwise {
                        settle: Duration::from_secs_f64(insertion.settle_s),
                        samples: insertion.samples,
                    },
                },
            },
            plane_out_of_reach: insertion.to_plane_out_of_reach(),
            needle: self.believed_needle()?,
            needle_torsion: self.believed_torsion()?,
            observer: self.observer(self.observer.kind),
            handedness: InvariantConfig {
                registration_sd_mm: self.registration_sd_mm()?,
                // The noise may be told in one place only.
                position_sd_mm: self
                    .observer
                    .invariant
                    .position_sd_mm
                    .max(tracker.gates.noise_sd_mm),
                ..self.observer.to_invariant()
            },
            shadows: self.observers().skip(1).collect(),
            control: match self.control.kind {
                ControlKind::FeedbackLinearization => {
                    ControlConfig::FeedbackLinearization(self.control.to_feedback_linearization())
                }
                ControlKind::NestedSaturation => {
                    ControlConfig::NestedSaturation(self.control.to_nested_saturation())
                }
            },
            stage: self.stage.to_stage(&self.can)?,
            tracker: TrackerConfig {
                gate: tracker.to_gate()?,
                judges_stream: tracker.gates.stream,
                clock: tracker.to_clock(),
                track: tracker.to_track(),
                timeout: Duration::from_secs_f64(tracker.timeout_s),
                hold_after: Duration::from_secs_f64(tracker.hold_after_s),
                hold_after_mm: tracker.hold_after_mm,
                hold_braking_mm_per_s2: tracker.hold_braking_mm_per_s2,
                hold_timeout: Duration::from_secs_f64(tracker.hold_timeout_s),
                resume: tracker.to_resume(),
            },
        })
    }

    /// The needle as the bench believes it to be.
    ///
    /// # Errors
    /// A curvature that no needle has.
    pub fn believed_needle(&self) -> Result<Needle, ConfigError> {
        Needle::new(self.needle.arc.curvature_per_mm())
            .and_then(|needle| needle.with_tip_ahead(self.needle.tip_ahead_mm))
            .map_err(|error| ConfigError::of(format!("needle: {error}")))
    }

    /// The torsion of its shaft as the bench believes it to be.
    ///
    /// # Errors
    /// An offset outside the band.
    pub fn believed_torsion(&self) -> Result<Torsion, ConfigError> {
        let torsion = self.needle.torsion.to_torsion();
        torsion.map_err(|error| ConfigError::of(format!("needle.torsion: {error}")))
    }

    /// The observer that steers, then its shadows.
    pub fn observers(&self) -> impl Iterator<Item = ObserverConfig> + '_ {
        let kinds = std::iter::once(self.observer.kind).chain(self.observer.shadows_apart());
        kinds.map(|kind| self.observer(kind))
    }

    fn observer(&self, kind: ObserverKind) -> ObserverConfig {
        match kind {
            ObserverKind::Invariant => ObserverConfig::Invariant(InvariantConfig {
                // Recordings are evaluated without a registration.
                registration_sd_mm: self.registration_sd_mm().unwrap_or_default(),
                ..self.observer.to_invariant()
            }),
            ObserverKind::Coupled => ObserverConfig::Coupled(self.observer.to_coupled()),
            ObserverKind::FiniteDifference => ObserverConfig::FiniteDifference {
                baseline_mm: self.observer.finite_difference.baseline_mm,
            },
        }
    }

    fn emulated_faults(&self) -> Result<Vec<Fault>, ConfigError> {
        let bench = self.can.bench_node;
        self.emulator.fault.iter().map(|fault| fault.to_fault(bench)).collect()
    }

    /// What the virtual stage is made of: the drives that the bench expects, and the emulator's
    /// own needle.
    ///
    /// # Errors
    /// No registration, or a curvature that no needle has.
    pub fn virtual_stage(&self) -> Result<VirtualStageConfig, ConfigError> {
        let (insertion, rotation) = (&self.stage.insertion, &self.stage.rotation);
        let (mm, turn) = (insertion.counts_per_mm, rotation.counts_per_turn);
        let emulator = &self.emulator;
        let drive = |drive: &DriveConfig, counts_per_unit: f64, units_per_s: f64| {
            let identity = drive::Identity {
                vendor: drive.vendor_id.unwrap_or(EMULATED_VENDOR_ID),
                product: drive.product_code.unwrap_or(EMULATED_PRODUCT_CODE),
                revision: 1,
                serial: u32::from(drive.node.get()),
            };
            let mut emulated = drive::DriveConfig::new(drive.node, identity);
            emulated.speed_max_counts_per_s = (2.0 * counts_per_unit * units_per_s).ceil() as u32;
            emulated.model = match emulator.drives {
                DriveModel::Generic => drive::Model::Generic,
                DriveModel::Epos4 => drive::Model::Epos4,
            };
            let gearing = Gearing { counts_per_unit: counts_per_unit * f64::from(drive.sign) };
            (emulated, gearing)
        };
        let (per_mm, per_turn) = (
            f64::from(mm.counts) / f64::from(mm.mm),
            f64::from(turn.counts) / f64::from(turn.turns),
        );
        let turns_per_s = rotation.speed_max_deg_per_s / 360.0;
        let mut rotation = drive(&rotation.drive, per_turn, turns_per_s);
        let mut insertion = drive(&insertion.drive, per_mm, insertion.speed_max_mm_per_s);
        let (per_mm, per_turn) = (insertion.1.counts_per_unit, rotation.1.counts_per_unit);
        insertion.0.start_counts = (emulator.insertion_start_mm * per_mm).round() as i64;
        insertion.0.switches = emulator.insertion_switches.to_counts(per_mm);
        rotation.0.switches = emulator.rotation_switches.to_counts(per_turn / 360.0);
        Ok(VirtualStageConfig {
            insertion,
            rotation,
            needle: Needle::new(emulator.arc.curvature_per_mm())
                .and_then(|needle| needle.with_tip_ahead(emulator.tip_ahead_mm))
                .map_err(|error| ConfigError::of(format!("emulator: {error}")))?,
            torsion: emulator
                .torsion
                .to_torsion()
                .map_err(|error| ConfigError::of(format!("emulator.torsion: {error}")))?,
            start: emulator.start.to_pose(),
            x_tp: self.tracker.to_registration()?.x_wt().inverse() * self.plane.to_pose(),
            tracker: emulator.to_tracker(),
            faults: self.emulated_faults()?,
        })
    }
}
