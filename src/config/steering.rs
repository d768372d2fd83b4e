//! `[insertion]`, `[needle]`, `[observer]`: what is done and believed.

use serde::Serialize;

use super::choice::choice;
use super::invariant::InvariantObserverConfig;
use super::needle_fit::NeedleFitConfig;
use super::pose::AnglesConfig;
use super::rule::Range;
use super::section::Section;
use crate::needle::{self, Torsion, TorsionError};
use crate::observer::{CoupledConfig, InvariantConfig};
use crate::session::PlaneOutOfReach;

/// Radii of arcs and their curvatures: from a stiff needle to one tighter than any made.
const RADIUS: Range = Range::within(10.0, 100_000.0);
const CURVATURE: Range = Range::over(0.0, 0.1);
pub(super) const TIP_AHEAD: Range = Range::within(-100.0, 100.0);
/// Half-width of a play in degrees, its growth in degrees per mm, and its offset in degrees.
pub(super) const WIDTH: Range = Range::within(0.0, 720.0);
pub(super) const GROWTH: Range = Range::within(0.0, 36.0);
pub(super) const OFFSET: Range = Range::within(-720.0, 720.0);
/// Faster than 1 per mm a pole is done within a sample.
const POLE: Range = Range::over(0.0, 1.0);

/// `[insertion]`: how far and how.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InsertionConfig {
    /// From where the run starts, mm.
    pub depth_mm: f64,
    /// mm/s.
    pub speed_mm_per_s: f64,
    /// mm/s².
    pub acceleration_mm_per_s2: f64,
    /// Without stops or with.
    pub mode: InsertionMode,
    /// An estimate and a command every so often, mm.
    pub step_mm: f64,
    /// Standing this near to the end of its set-points the needle counts as there, mm.
    pub arrival_mm: f64,
    /// Stepwise: standstill before samples are taken, s.
    pub settle_s: f64,
    /// Stepwise: samples averaged at each step.
    pub samples: u32,
    /// When the depth does not suffice to reach the plane.
    pub plane_out_of_reach: OutOfReachKind,
}

choice! {
    /// What to do with an insertion that cannot reach the plane.
    OutOfReachKind {
        /// It is refused before the axes have power.
        Refuse = "refuse",
        /// The needle is inserted all the same.
        Insert = "insert",
    }
}

choice! {
    /// How the needle advances.
    InsertionMode {
        /// Without stops.
        Continuous = "continuous",
        /// Advance a step, stop, settle, average.
        Stepwise = "stepwise",
    }
}

impl InsertionConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        InsertionConfig {
            depth_mm: s.number("depth_mm", Range::over(0.0, 1000.0)),
            speed_mm_per_s: s.number("speed_mm_per_s", Range::over(0.0, 100.0)),
            acceleration_mm_per_s2: s.number("acceleration_mm_per_s2", Range::over(0.0, 1000.0)),
            mode: s.choice("mode"),
            step_mm: s.number("step_mm", Range::within(0.1, 10.0)),
            arrival_mm: s.number("arrival_mm", Range::within(0.001, 1.0)),
            settle_s: s.number("settle_s", Range::within(0.0, 60.0)),
            samples: s.integer("samples", 1, 1000),
            plane_out_of_reach: s.choice("plane_out_of_reach"),
        }
    }

    /// What to do when the insertion cannot reach the plane.
    pub fn to_plane_out_of_reach(&self) -> PlaneOutOfReach {
        match self.plane_out_of_reach {
            OutOfReachKind::Refuse => PlaneOutOfReach::Refuse,
            OutOfReachKind::Insert => PlaneOutOfReach::Insert,
        }
    }
}

/// The arc that a needle cuts when it is not turned, as it was given.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Arc {
    /// By its radius.
    Radius {
        /// mm.
        radius_mm: f64,
    },
    /// By its curvature.
    Curvature {
        /// Per mm.
        curvature_per_mm: f64,
    },
}

impl Arc {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        match s.either(("radius_mm", RADIUS), ("curvature_per_mm", CURVATURE)) {
            (_, Some(curvature_per_mm)) => Arc::Curvature { curvature_per_mm },
            (radius_mm, None) => Arc::Radius { radius_mm: radius_mm.unwrap_or(f64::NAN) },
        }
    }

    /// κ, per mm.
    pub fn curvature_per_mm(&self) -> f64 {
        match *self {
            Arc::Radius { radius_mm } => 1.0 / radius_mm,
            Arc::Curvature { curvature_per_mm } => curvature_per_mm,
        }
    }
}

/// `[needle]`: what the bench believes of the needle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NeedleConfig {
    /// The arc it cuts unturned.
    #[serde(flatten)]
    pub arc: Arc,
    /// How far the tip is ahead of the rear wheel of its bicycle, mm.
    pub tip_ahead_mm: f64,
    /// The play of its shaft.
    pub torsion: TorsionConfig,
    /// How these were found, where `needle-bench calibrate needle` did it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<NeedleFitConfig>,
}

impl NeedleConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        NeedleConfig {
            arc: Arc::read(s),
            tip_ahead_mm: s.number("tip_ahead_mm", TIP_AHEAD),
            torsion: s.section("torsion", TorsionConfig::read),
            fit: s.optional_section("fit", NeedleFitConfig::read),
        }
    }
}

/// `[needle.torsion]` and `[emulator.torsion]`: the play between the base's rotation and the
/// tip's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TorsionConfig {
    /// Half the width of the band at the start, degrees.
    pub half_width_deg: f64,
    /// By which it grows with depth, degrees per mm.
    pub half_width_deg_per_mm: f64,
    /// Middle of the band, degrees.
    pub offset_deg: f64,
    /// Insertion over which the tip creeps to the band, at the start, mm.
    pub creep_mm: f64,
    /// By which it grows with depth, mm/mm.
    pub creep_mm_per_mm: f64,
}

impl TorsionConfig {
    /// The keys that say `torsion`.
    pub fn of(torsion: &needle::TorsionConfig) -> Self {
        TorsionConfig {
            half_width_deg: torsion.half_width_rad.to_degrees(),
            half_width_deg_per_mm: torsion.half_width_rad_per_mm.to_degrees(),
            offset_deg: torsion.offset_rad.to_degrees(),
            creep_mm: torsion.creep_mm,
            creep_mm_per_mm: torsion.creep_mm_per_mm,
        }
    }

    pub(super) fn read(s: &mut Section<'_>) -> Self {
        TorsionConfig {
            half_width_deg: s.number("half_width_deg", WIDTH),
            half_width_deg_per_mm: s.number("half_width_deg_per_mm", GROWTH),
            offset_deg: s.number("offset_deg", OFFSET),
            creep_mm: s.number("creep_mm", Range::within(0.0, 100.0)),
            creep_mm_per_mm: s.number("creep_mm_per_mm", Range::within(0.0, 1.0)),
        }
    }

    /// The play in rad.
    ///
    /// # Errors
    /// [`TorsionError`]: an offset outside the band, or a creep that grows from nothing.
    pub fn to_torsion(&self) -> Result<Torsion, TorsionError> {
        Torsion::new(needle::TorsionConfig {
            half_width_rad: self.half_width_deg.to_radians(),
            half_width_rad_per_mm: self.half_width_deg_per_mm.to_radians(),
            offset_rad: self.offset_deg.to_radians(),
            creep_mm: self.creep_mm,
            creep_mm_per_mm: self.creep_mm_per_mm,
        })
    }
}

choice! {
    /// An observer.
    ObserverKind {
        /// The paper's coupled observer.
        Coupled = "coupled",
        /// Three positions differenced.
        FiniteDifference = "finite-difference",
        /// The one without local coordinates.
        Invariant = "invariant",
    }
}

/// `[observer]`: which one steers, which run alongside, and their settings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ObserverConfig {
    /// The one that steers.
    pub kind: ObserverKind,
    /// As given; see [`ObserverConfig::shadows_apart`].
    pub shadows: Vec<ObserverKind>,
    /// Angles assumed at the start, in the plane frame.
    pub start: AnglesConfig,
    /// `[observer.invariant]`.
    pub invariant: InvariantObserverConfig,
    /// `[observer.coupled]`.
    pub coupled: CoupledObserverConfig,
    /// `[observer.finite_difference]`.
    pub finite_difference: FiniteDifferenceConfig,
}

/// `[observer.coupled]`: decay rates of the error; the poles are `exp(-rate · step)`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CoupledObserverConfig {
    /// Of x, sin β and κ cos β sin γ, per mm.
    pub reduced_poles_per_mm: [f64; 3],
    /// Of position and heading in the plane, per mm.
    pub fibre_poles_per_mm: [f64; 2],
}

/// `[observer.finite_difference]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FiniteDifferenceConfig {
    /// Distance between the three positions differenced, mm.
    pub baseline_mm: f64,
}

impl ObserverConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        ObserverConfig {
            kind: s.choice("kind"),
            shadows: s.choices("shadows"),
            start: s.section("start", AnglesConfig::read),
            invariant: s.section("invariant", InvariantObserverConfig::read),
            coupled: s.section("coupled", |s| CoupledObserverConfig {
                reduced_poles_per_mm: s.numbers("reduced_poles_per_mm", POLE),
                fibre_poles_per_mm: s.numbers("fibre_poles_per_mm", POLE),
            }),
            finite_difference: s.section("finite_difference", |s| FiniteDifferenceConfig {
                baseline_mm: s.number("baseline_mm", Range::within(0.1, 100.0)),
            }),
        }
    }

    /// The shadows without the observer that steers anyway, each once, in the order given.
    pub fn shadows_apart(&self) -> Vec<ObserverKind> {
        let mut apart = Vec::new();
        for &shadow in &self.shadows {
            if shadow != self.kind && !apart.contains(&shadow) {
                apart.push(shadow);
            }
        }
        apart
    }

    /// What the invariant observer is told.
    pub fn to_invariant(&self) -> InvariantConfig {
        self.invariant.to_invariant(&self.start)
    }

    /// What the coupled observer is told.
    pub fn to_coupled(&self) -> CoupledConfig {
        CoupledConfig {
            reduced_poles_per_mm: self.coupled.reduced_poles_per_mm,
            fibre_poles_per_mm: self.coupled.fibre_poles_per_mm,
            start: self.start.to_fixed_angles(),
        }
    }
}
