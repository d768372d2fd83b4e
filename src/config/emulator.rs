//! `[emulator]`: the emulated drives, needle and tracker, separate from the bench's model of them.

use std::time::Duration;

use super::IDENTITY;
use super::needle::{Arc, TIP_AHEAD};
use crate::emulator::drive::{Model, Switches};
use crate::emulator::fault::Fault;
use crate::emulator::{CorrelatedNoise, TrackerModel, WhiteNoise};
use crate::geometry::Pose;
use crate::keys::{Rule, choice, over, section, within};
use crate::needle::TorsionConfig;
use nalgebra::Vector3;

/// The largest seed that every JSON reader represents exactly.
pub const SEED_MAX: u64 = (1 << 53) - 1;

/// Pitch of a needle's tip, short of ±90°, where yaw and roll are the same rotation.
pub(super) const TIP_PITCH: Rule = within(-85.0, 85.0);
const SWITCH: Rule = within(-1e6, 1e6);
const NOISE: Rule = within(0.0, 100.0);

section! {
    /// `[emulator]`.
    pub struct EmulatorConfig {
        /// The arc that the needle really cuts.
        arc: Arc, flat;
        /// How far the tip really is ahead, mm; `[needle]` has what the bench believes under the same name.
        tip_ahead_mm: f64 [TIP_AHEAD] = 0.0;
        /// Seed of all random numbers.
        seed: u64 [within(0.0, SEED_MAX as f64)] = 1;
        /// A preset of the noise, rate, latency and repeats of the emulated tracker. Keys that are given
        /// override it.
        tracker: TrackerPreset = "plain";
        /// Positions per second, Hz.
        tracker_rate_hz: f64 [within(0.1, 1000.0)] = 40.0;
        /// From acquisition to arrival.
        tracker_latency as "tracker_latency_ms": Duration [within(0.0, 5000.0)] = 0.0;
        /// How often each position is repeated, stamped as if it were new.
        tracker_repeats: u32 [within(0.0, 1000.0)] = 0;
        /// The tip's true pose at the start, in the plane frame.
        start: Pose => "{ x_mm = 5.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 5.0, pitch_deg = 5.0, \
            roll_deg = 30.0 }", narrowed(&[("pitch_deg", TIP_PITCH)]);
        /// How far the target moves with each millimetre that is inserted, mm. With `goal.tool` the emulated
        /// tracker sees it; before the insertion it is at `goal.position_mm`.
        target_drift_mm_per_mm: Vector3<f64> [within(-1.0, 1.0)] = [0.0, 0.0, 0.0];
        /// The real play of the shaft; the keys are those of `[needle.torsion]`.
        torsion: TorsionConfig;
        /// Zero-mean noise of each coordinate of a position; {} is none.
        noise: Noise => "{ uniform_mm = 1.0 }", whole;
        /// A rehearsal, like `--rehearse`: the drives and the tracker of this configuration are emulated in
        /// memory, whatever `can.interface` and `tracker.source` say.
        rehearse: bool = false;
        /// The pose of the tracked sensor in the frame of the tip.
        sensor: Pose => IDENTITY;
        /// True if both drives were homed before the start.
        homed: bool = false;
        /// The make of drive that is emulated.
        drives: Model = "generic";
        /// Reading of the insertion axis when the stage is switched on, mm.
        insertion_start_mm: f64 [within(-1000.0, 1000.0)] = 0.0;
        /// Reading of the rotation axis when the stage is switched on, degrees.
        rotation_start_deg: f64 [within(-360.0, 360.0)] = 0.0;
        /// Where the switches of the insertion axis close, mm, as the axis reads before it is homed.
        insertion_switches_mm: SwitchesConfig => "{}";
        /// Where the switches of the rotation axis close, degrees, likewise.
        rotation_switches_deg: SwitchesConfig => "{}";
        /// A fault to test the bench with; repeat the table for each.
        fault: Vec<Fault> [Rule::Fields("kind, at_mm or at_s, axis and more")] = [];
    }
}

section! {
    /// Where the switches of an axis close, in its unit. A switch that is not given does not exist.
    #[derive(Copy)]
    pub struct SwitchesConfig {
        /// The negative limit switch closes at and below this position.
        negative: Option<f64> [SWITCH];
        /// The positive limit switch closes at and above this position.
        positive: Option<f64> [SWITCH];
        /// The home switch closes at and above this position.
        home: Option<f64> [SWITCH];
    }
}

section! {
    /// Zero-mean noise of each coordinate of a position: a part that is independent from one position to the
    /// next, and a part that is correlated in time.
    #[derive(Copy)]
    pub struct Noise {
        /// Independent, uniform within ± this, mm.
        uniform_mm: Option<f64> [NOISE];
        /// Independent, Gaussian of this standard deviation, mm.
        sd_mm: Option<f64> [NOISE], instead_of("uniform_mm");
        /// Correlated in time, added to it: Gaussian of this standard deviation, mm.
        correlated_sd_mm: Option<f64> [NOISE];
        /// Its correlation time, after which the correlation is 1/e.
        correlation_time as "correlation_time_s": Option<Duration> [over(0.0, 3600.0)];
    }
}

choice! {
    /// A tracker whose noise, rate, latency and repeats were measured; see docs/decisions.
    pub enum TrackerPreset {
        /// No preset: the keys themselves.
        Plain = "plain",
        /// Electromagnetic, near its field generator.
        ElectromagneticNear = "electromagnetic-near",
        /// Electromagnetic, far from its field generator.
        ElectromagneticFar = "electromagnetic-far",
        /// The tip segmented in ultrasound.
        Ultrasound = "ultrasound",
        /// A pair of cameras.
        StereoCamera = "stereo-camera",
    }
}

impl TrackerPreset {
    /// The keys that the preset sets, as TOML.
    pub(super) fn toml(self) -> &'static str {
        match self {
            TrackerPreset::Plain => "",
            TrackerPreset::ElectromagneticNear => {
                include_str!("../../bench-config/emulated-trackers/electromagnetic-near.toml")
            }
            TrackerPreset::ElectromagneticFar => {
                include_str!("../../bench-config/emulated-trackers/electromagnetic-far.toml")
            }
            TrackerPreset::Ultrasound => {
                include_str!("../../bench-config/emulated-trackers/ultrasound.toml")
            }
            TrackerPreset::StereoCamera => {
                include_str!("../../bench-config/emulated-trackers/stereo-camera.toml")
            }
        }
    }
}

impl SwitchesConfig {
    /// The switches in counts, for an axis that reads 0 at `zero_counts`. If `counts_per_unit` is negative the
    /// drive counts in the opposite direction, and the bench's negative end is the drive's positive end.
    pub(super) fn to_counts(self, zero_counts: i64, counts_per_unit: f64) -> Switches {
        let counts = |at: f64| zero_counts + (at * counts_per_unit).round() as i64;
        let (low, high) = match counts_per_unit < 0.0 {
            true => (self.positive, self.negative),
            false => (self.negative, self.positive),
        };
        Switches {
            negative_counts: low.map(counts),
            positive_counts: high.map(counts),
            home_counts: self.home.map(counts),
        }
    }
}

impl EmulatorConfig {
    /// The model of the emulated tracker.
    pub fn to_tracker(&self) -> TrackerModel {
        let Noise { uniform_mm, sd_mm, correlated_sd_mm, correlation_time } = self.noise;
        let white = sd_mm.map(WhiteNoise::Gaussian).or(uniform_mm.map(WhiteNoise::Uniform));
        let correlated = correlated_sd_mm.filter(|sd_mm| *sd_mm > 0.0).zip(correlation_time);
        TrackerModel {
            noise: white.unwrap_or(WhiteNoise::None),
            correlated: correlated
                .map(|(sd_mm, time)| CorrelatedNoise { sd_mm, time_s: time.as_secs_f64() }),
            seed: self.seed,
            period: Duration::from_secs_f64(1.0 / self.tracker_rate_hz),
            latency: self.tracker_latency,
            repeats: self.tracker_repeats,
        }
    }
}
