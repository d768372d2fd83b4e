//! `[emulator]`: the emulated needle and tracker, apart from what the bench believes of them.

use serde::Serialize;
use std::time::Duration;

use super::choice::choice;
use super::pose::PoseConfig;
use super::rule::Range;
use super::section::Section;
use super::steering::{Arc, TIP_AHEAD, TorsionConfig};
use crate::emulator::{self, TrackerModel};

/// The largest seed: a number that any reader of JSON takes exactly.
pub const SEED_MAX: u64 = (1 << 53) - 1;

/// `[emulator]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EmulatorConfig {
    /// The arc that the needle really cuts.
    #[serde(flatten)]
    pub arc: Arc,
    /// How far the tip really is ahead of the rear wheel, mm.
    pub tip_ahead_mm: f64,
    /// Of all that is random.
    pub seed: u64,
    /// What the four keys of the tracker are preset to.
    pub tracker: TrackerPreset,
    /// Positions a second.
    pub tracker_rate_hz: f64,
    /// From acquisition to arrival, ms.
    pub tracker_latency_ms: f64,
    /// How many times each position is sent again, with fresh stamps.
    pub tracker_repeats: u32,
    /// The tip's true pose at the start, in the plane frame.
    pub start: PoseConfig,
    /// The play that its shaft really has.
    pub torsion: TorsionConfig,
    /// Of the tracked position.
    pub noise: Noise,
}

choice! {
    /// A tracker whose noise, rate, latency and repeats were measured; see docs/decisions.
    TrackerPreset {
        /// None: what the keys themselves say.
        Plain = "plain",
        /// Electromagnetic, near its field generator.
        ElectromagneticNear = "electromagnetic-near",
        /// Electromagnetic, far from it.
        ElectromagneticFar = "electromagnetic-far",
        /// The tip segmented in ultrasound.
        Ultrasound = "ultrasound",
        /// A pair of cameras.
        StereoCamera = "stereo-camera",
    }
}

/// Noise of each coordinate of a position, independent and zero in the mean.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Noise {
    /// Within ± a bound.
    Uniform {
        /// The bound, mm.
        uniform_mm: f64,
    },
    /// Gaussian.
    Gaussian {
        /// Standard deviation, mm.
        sd_mm: f64,
    },
    /// None.
    None {},
}

impl Noise {
    fn read(s: &mut Section<'_>) -> Self {
        let range = Range::within(0.0, 100.0);
        match s.either(("uniform_mm", range), ("sd_mm", range)) {
            (_, Some(sd_mm)) => Noise::Gaussian { sd_mm },
            (Some(uniform_mm), None) => Noise::Uniform { uniform_mm },
            (None, None) => Noise::None {},
        }
    }
}

impl EmulatorConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        EmulatorConfig {
            arc: Arc::read(s),
            tip_ahead_mm: s.number("tip_ahead_mm", TIP_AHEAD),
            seed: s.integer("seed", 0, SEED_MAX),
            tracker: s.choice("tracker"),
            tracker_rate_hz: s.number("tracker_rate_hz", Range::within(0.1, 1000.0)),
            tracker_latency_ms: s.number("tracker_latency_ms", Range::within(0.0, 5000.0)),
            tracker_repeats: s.integer("tracker_repeats", 0, 1000),
            start: s.section("start", PoseConfig::read_tip),
            torsion: s.section("torsion", TorsionConfig::read),
            noise: s.section("noise", Noise::read),
        }
    }

    /// What the emulated tracker does to positions.
    pub fn to_tracker(&self) -> TrackerModel {
        TrackerModel {
            noise: match self.noise {
                Noise::Uniform { uniform_mm } => emulator::Noise::Uniform(uniform_mm),
                Noise::Gaussian { sd_mm } => emulator::Noise::Gaussian(sd_mm),
                Noise::None {} => emulator::Noise::None,
            },
            seed: self.seed,
            period: Duration::from_secs_f64(1.0 / self.tracker_rate_hz),
            latency: Duration::from_secs_f64(self.tracker_latency_ms * 1e-3),
            repeats: self.tracker_repeats,
        }
    }
}
