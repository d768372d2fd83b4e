//! Converts sections of the configuration to the settings of other folders, in mm, rad and per mm.

use super::needle::torsion;
use super::{CanInterface, Config, ConfigError, ReadMask, TrackerSource, rehearsal};
use crate::canopen::ObjectAddress;
use crate::emulator::drive::DriveConfig;
use crate::emulator::{TargetModel, VirtualStageConfig};
use crate::observer::InvariantConfig;
use crate::session::{SessionConfig, TrackerConfig};
use crate::stage::{AxisConfig, Sign, StageConfig};
use crate::tracker::AcquisitionClock;
use std::f64::consts::TAU;

/// Identity of an emulated drive if the configuration accepts any; no vendor has this number.
const EMULATED_VENDOR_ID: u32 = 0;
const EMULATED_PRODUCT_CODE: u32 = 0x402;

impl Config {
    /// The bus of a run; a rehearsal uses `memory`.
    pub fn bus(&self) -> &CanInterface {
        if self.emulator.rehearse { &CanInterface::Memory } else { &self.can.interface }
    }

    /// True if the drives, the needle and the tracker are emulated in this process.
    pub fn is_emulated(&self) -> bool {
        *self.bus() == CanInterface::Memory
    }

    /// True if the true pose of the tip is known: the needle and its tracker are emulated in this process.
    pub fn knows_truth(&self) -> bool {
        self.is_emulated() && self.tip_source() == TrackerSource::Emulated
    }

    /// The source of a run's tip positions; a rehearsal uses the emulated tracker.
    pub fn tip_source(&self) -> TrackerSource {
        if self.emulator.rehearse { TrackerSource::Emulated } else { self.tracker.source }
    }

    /// The settings of a session, including the planned path to its target. Fails if an obstacle is a mask.
    ///
    /// # Errors
    /// Those of [`Config::session_reading`].
    pub fn session(&self) -> Result<SessionConfig, ConfigError> {
        self.session_reading(&|_, _, _| Err("masks are not read here".to_owned()))
    }

    /// Like [`Config::session`], but reads masks with `read_mask`.
    ///
    /// # Errors
    /// There is no registration; the needle, the stage or the observers refuse a value; or the target cannot be
    /// reached.
    pub fn session_reading(&self, read_mask: ReadMask<'_>) -> Result<SessionConfig, ConfigError> {
        let goal = self.to_goal(read_mask)??;
        Ok(SessionConfig { goal, ..self.session_without_goal()? })
    }

    /// The settings of a session that steers into the plane, whatever the goal.
    ///
    /// # Errors
    /// There is no registration, or the needle, the stage or the observers refuse a value.
    pub fn session_without_goal(&self) -> Result<SessionConfig, ConfigError> {
        let invariant = self.observer.invariant;
        let (needle, needle_torsion) = self.believed_needle()?;
        Ok(SessionConfig {
            x_wp: self.plane,
            insertion: self.insertion,
            needle,
            needle_torsion,
            handedness: InvariantConfig {
                // The noise may be configured in only one of the two places.
                position_sd_mm: invariant.position_sd_mm.max(self.tracker.to_track().noise_sd_mm),
                ..invariant
            },
            observer: self.observer.steering(),
            shadows: self.observer.observers().skip(1).collect(),
            control: self.control,
            goal: None,
            stage: self.to_stage()?,
            tracker: TrackerConfig {
                gate: self.tracker.to_gate()?,
                judges_stream: self.tracker.gates.stream,
                is_exact: self.tip_source() == TrackerSource::Emulated
                    && self.emulator.to_tracker().is_exact(),
                clock: AcquisitionClock::new(self.tracker.stamp, self.tracker.latency),
                track: self.tracker.to_track(),
                noise: self.tracker.noise,
                timeout: self.tracker.timeout,
                hold: self.tracker.hold,
            },
        })
    }

    /// The settings of the stage's master, in mm, rad and counts.
    ///
    /// # Errors
    /// The stage refuses the settings, for example a following-error window of less than a count.
    pub fn to_stage(&self) -> Result<StageConfig, ConfigError> {
        self.stage.validate()?;
        let mut stage = self.stage.clone();
        if self.emulator.rehearse {
            for axis in [&mut stage.insertion, &mut stage.rotation] {
                // A raw SDO has the real drive's unit, which the emulated drive does not know. It uses the key.
                let is_told = axis.quick_stop_deceleration.is_some();
                axis.sdo.retain(|raw| !(is_told && raw.is_quick_stop()));
            }
        }
        Ok(stage)
    }

    /// The settings of the virtual stage: the drives that the bench expects, and the emulator's needle.
    ///
    /// # Errors
    /// There is no registration, or the needle or its torsion is impossible.
    pub fn virtual_stage(&self) -> Result<VirtualStageConfig, ConfigError> {
        let emulator = &self.emulator;
        let turns_per_s = self.number("stage.rotation.speed_max_deg_per_s") / 360.0;
        let (along, about) = (&self.stage.insertion, &self.stage.rotation);
        let (mut insertion, per_mm) = self.emulated_drive(along, along.limits.speed_max);
        let (mut rotation, per_turn) = self.emulated_drive(about, turns_per_s);
        let [zero, zero_turned] = [along.zero, about.zero].map(|zero| zero.unwrap_or(0).into());
        insertion.start_counts = zero + (emulator.insertion_start_mm * per_mm).round() as i64;
        let start_turns = emulator.rotation_start_deg / 360.0;
        rotation.start_counts = zero_turned + (start_turns * per_turn).round() as i64;
        insertion.switches = emulator.insertion_switches_mm.to_counts(zero, per_mm);
        rotation.switches = emulator.rotation_switches_deg.to_counts(zero_turned, per_turn / 360.0);
        if emulator.rehearse {
            insertion.switches = rehearsal::switches(insertion.switches, along, per_mm);
            rotation.switches = rehearsal::switches(rotation.switches, about, per_turn / TAU);
        }
        Ok(VirtualStageConfig {
            insertion: (insertion, per_mm),
            rotation: (rotation, per_turn),
            needle: emulator.arc.to_needle(emulator.tip_ahead_mm, "emulator")?,
            torsion: torsion(emulator.torsion, "emulator")?,
            start: emulator.start,
            x_tp: self.tracker.to_registration()?.x_wt().inverse() * self.plane,
            x_bs: emulator.sensor,
            tracker: emulator.to_tracker(),
            target: self.goal.tool.as_ref().and(self.goal.position_mm).map(|start_mm| {
                TargetModel { start_mm, drift_mm_per_mm: emulator.target_drift_mm_per_mm }
            }),
            faults: emulator.fault.clone(),
        })
    }

    /// The emulated drive of `axis`, whose speed limit is `units_per_s` mm or turns per second, and its counts per mm
    /// or turn, negative if it counts in the opposite direction.
    fn emulated_drive(&self, axis: &AxisConfig, units_per_s: f64) -> (DriveConfig, f64) {
        let counts_per_unit = axis.ratio.to_f64();
        let vendor = axis.vendor_id.unwrap_or(EMULATED_VENDOR_ID);
        let product = axis.product_code.unwrap_or(EMULATED_PRODUCT_CODE);
        let raw_objects = axis.sdo.iter().filter(|_| self.emulator.rehearse);
        let drive = DriveConfig {
            speed_max_counts_per_s: (2.0 * counts_per_unit * units_per_s).ceil() as u32,
            model: self.emulator.drives,
            homed: self.emulator.homed,
            more_objects: raw_objects
                .map(|raw| (ObjectAddress::new(raw.index, raw.subindex), raw.bits))
                .collect(),
            ..DriveConfig::new(axis.node, vendor, product)
        };
        let sign = if axis.sign == Sign::Negative { -1.0 } else { 1.0 };
        (drive, counts_per_unit * sign)
    }
}
