//! `[observer.invariant]`: what the invariant observer is told.

use serde::Serialize;

use super::pose::AnglesConfig;
use super::rule::Range;
use super::section::Section;
use crate::observer::InvariantConfig;

/// A relative uncertainty: over 0.5 a needle could as well be straight.
const PART: Range = Range::within(0.0, 0.5);
/// A standard deviation of an angle; over 90 degrees a roll is not known at all.
const ANGLE_SD: Range = Range::within(0.0, 180.0);
/// Standard deviation of a random walk after 1 mm.
const WALK_MM: Range = Range::within(0.0, 10.0);
const WALK_DEG: Range = Range::within(0.0, 45.0);

/// `[observer.invariant]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InvariantObserverConfig {
    /// Standard deviations of `observer.start`.
    pub start_sd: AnglesConfig,
    /// Of each coordinate of a measured position, mm.
    pub position_sd_mm: f64,
    /// Of the needle's curvature, as a part of it.
    pub curvature_sd: f64,
    /// Of `needle.torsion.offset_deg`, as a part of the half-width.
    pub torsion_offset_sd: f64,
    /// The same of a band without width, degrees.
    pub torsion_offset_sd_deg: f64,
    /// A band that grows up to this fast is looked for where none is told, degrees per mm.
    pub torsion_search_deg_per_mm: f64,
    /// Innovations so many times what `position_sd_mm` explains stop the run.
    pub innovation_max: f64,
    /// `[observer.invariant.noise]`.
    pub noise: ProcessNoiseConfig,
}

/// `[observer.invariant.noise]`: random walks of the needle beside its model, standard deviations
/// after 1 mm of insertion.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProcessNoiseConfig {
    /// Of the position across the axis, mm.
    pub position_mm: f64,
    /// Of the position along the axis, mm: tissue that gives way.
    pub axial_mm: f64,
    /// Of the heading, degrees.
    pub heading_deg: f64,
    /// Of the roll, degrees.
    pub roll_deg: f64,
    /// Of the curvature, as a part of it.
    pub curvature: f64,
    /// Of the edges of the torsion's band, degrees.
    pub torsion_edge_deg: f64,
}

impl InvariantObserverConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        InvariantObserverConfig {
            start_sd: s.section("start_sd", |s| AnglesConfig {
                yaw_deg: s.number("yaw_deg", ANGLE_SD),
                pitch_deg: s.number("pitch_deg", ANGLE_SD),
                roll_deg: s.number("roll_deg", ANGLE_SD),
            }),
            position_sd_mm: s.number("position_sd_mm", Range::within(0.001, 100.0)),
            curvature_sd: s.number("curvature_sd", PART),
            torsion_offset_sd: s.number("torsion_offset_sd", PART),
            torsion_offset_sd_deg: s.number("torsion_offset_sd_deg", ANGLE_SD),
            torsion_search_deg_per_mm: s
                .number("torsion_search_deg_per_mm", Range::within(0.0, 5.0)),
            innovation_max: s.number("innovation_max", Range::within(2.0, 100.0)),
            noise: s.section("noise", |s| ProcessNoiseConfig {
                position_mm: s.number("position_mm", WALK_MM),
                axial_mm: s.number("axial_mm", WALK_MM),
                heading_deg: s.number("heading_deg", WALK_DEG),
                roll_deg: s.number("roll_deg", WALK_DEG),
                curvature: s.number("curvature", PART),
                torsion_edge_deg: s.number("torsion_edge_deg", WALK_DEG),
            }),
        }
    }

    /// What the observer is told, with the angles assumed at the start and a perfect registration.
    pub(super) fn to_invariant(&self, start: &AnglesConfig) -> InvariantConfig {
        let noise = &self.noise;
        InvariantConfig {
            start: start.to_fixed_angles(),
            start_sd: self.start_sd.to_fixed_angles(),
            position_sd_mm: self.position_sd_mm,
            registration_sd_mm: 0.0,
            curvature_sd: self.curvature_sd,
            offset_sd: self.torsion_offset_sd,
            offset_sd_rad: self.torsion_offset_sd_deg.to_radians(),
            torsion_search_rad_per_mm: self.torsion_search_deg_per_mm.to_radians(),
            innovation_max: self.innovation_max,
            position_noise_mm: noise.position_mm,
            axial_noise_mm: noise.axial_mm,
            heading_noise_rad: noise.heading_deg.to_radians(),
            roll_noise_rad: noise.roll_deg.to_radians(),
            curvature_noise: noise.curvature,
            edge_noise_rad: noise.torsion_edge_deg.to_radians(),
        }
    }
}
