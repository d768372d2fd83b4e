//! `[observer]`: which observer steers, which run alongside, and their settings. An observer needs a
//! kind, a section, and what it is told, all of them here.

use super::Config;
use super::pose::AnglesConfig;
use super::schema::{Rule, choice, over, section, within};
use crate::observer::{CoupledConfig, InvariantConfig};
use crate::session::{self, Samples};

/// Faster than 1 per mm a pole is done within a sample.
const POLE: Rule = over(0.0, 1.0);
/// A relative uncertainty: over 0.5 a needle could as well be straight.
const PART: Rule = within(0.0, 0.5);
/// A standard deviation of an angle; over 90 degrees a roll is not known at all.
const ANGLE_SD: Rule = within(0.0, 180.0);
/// Standard deviation of a random walk after 1 mm.
const WALK_MM: Rule = within(0.0, 10.0);
const WALK_DEG: Rule = within(0.0, 45.0);

section! {
    /// `[observer]`.
    pub struct ObserverConfig {
        /// The observer that steers.
        kind: ObserverKind = "invariant";
        /// Observers that run alongside on the same stream: logged, never steering.
        shadows: Vec<ObserverKind> = ["coupled", "finite-difference"];
        /// Positions that correct the observers.
        samples: Samples = "all";
        /// Angles assumed at the start, in the plane frame; the position is the first measured one.
        start: AnglesConfig => "{ yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }",
            narrowed(&[("pitch_deg", within(-80.0, 80.0))]);
        /// The invariant observer; the check of the stream's handedness uses it as well.
        invariant: InvariantObserverConfig;
        /// The coupled observer: decay rates of the error; the poles are exp(-rate * step).
        coupled: CoupledObserverConfig;
        /// The finite differences.
        finite_difference: FiniteDifferenceConfig;
    }
}

choice! {
    /// An observer.
    pub enum ObserverKind {
        /// The paper's coupled observer.
        Coupled = "coupled",
        /// Three positions differenced.
        FiniteDifference = "finite-difference",
        /// A bank of invariant Kalman filters, without local coordinates.
        Invariant = "invariant",
    }
}

choice! {
    for Samples {
        /// Every believed one, at its own depth.
        All = "all",
        /// One at each step, as in the paper.
        OnePerStep = "one-per-step",
    }
}

section! {
    /// `[observer.invariant]`.
    pub struct InvariantObserverConfig {
        /// Standard deviations of `observer.start`. A roll of over 90 is not known at all.
        start_sd: AnglesConfig => "{ yaw_deg = 12.0, pitch_deg = 8.0, roll_deg = 180.0 }", narrowed(
            &[("yaw_deg", ANGLE_SD), ("pitch_deg", ANGLE_SD), ("roll_deg", ANGLE_SD)]
        );
        /// Standard deviation of each coordinate of a measured position, mm; ±1 mm uniform has 0.577.
        position_sd_mm: f64 [within(0.001, 100.0)] = 0.577;
        /// Standard deviation of the needle's curvature, as a part of it.
        curvature_sd: f64 [PART] = 0.17;
        /// Standard deviation of `needle.torsion.offset_deg`, as a part of the half-width.
        torsion_offset_sd: f64 [PART] = 0.33;
        /// The same of a shaft that creeps and has no band, degrees.
        torsion_offset_sd_deg: f64 [ANGLE_SD] = 7.0;
        /// Where no torsion is given, a band that grows up to this fast is searched for, degrees per
        /// mm.
        torsion_search_deg_per_mm: f64 [within(0.0, 5.0)] = 0.6;
        /// Innovations of so many times what `position_sd_mm` explains stop the run.
        innovation_max: f64 [within(2.0, 100.0)] = 3.0;
        /// Random walks of the needle beside its model.
        noise: ProcessNoiseConfig;
    }
}

section! {
    /// `[observer.invariant.noise]`: standard deviations after 1 mm, growing with the root.
    pub struct ProcessNoiseConfig {
        /// Of the position across the axis, mm.
        position_mm: f64 [WALK_MM] = 0.0;
        /// Of the position along the axis, mm: tissue that gives way.
        axial_mm: f64 [WALK_MM] = 0.0;
        /// Of the heading, degrees.
        heading_deg: f64 [WALK_DEG] = 0.0;
        /// Of the roll, degrees.
        roll_deg: f64 [WALK_DEG] = 0.0;
        /// Of the curvature, as a part of it.
        curvature: f64 [PART] = 0.0;
        /// Of the edges of the torsion's band, degrees.
        torsion_edge_deg: f64 [WALK_DEG] = 0.1;
    }
}

section! {
    /// `[observer.coupled]`.
    pub struct CoupledObserverConfig {
        /// Of x, sin(pitch), and curvature * cos(pitch) * sin(roll), per mm.
        reduced_poles_per_mm: [f64; 3] [POLE] = [0.07, 0.07, 0.07];
        /// Of y and z, and the heading in the plane, per mm.
        fibre_poles_per_mm: [f64; 2] [POLE] = [0.07, 0.07];
    }
}

section! {
    /// `[observer.finite_difference]`.
    pub struct FiniteDifferenceConfig {
        /// Distance between the three positions differenced, mm.
        baseline_mm: f64 [within(0.1, 100.0)] = 10.0;
    }
}

impl ObserverConfig {
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

    /// What the invariant observer is told, with a perfect registration.
    pub fn to_invariant(&self) -> InvariantConfig {
        let ObserverConfig { start, invariant, .. } = self;
        let noise = &invariant.noise;
        InvariantConfig {
            start: start.to_fixed_angles(),
            start_sd: invariant.start_sd.to_fixed_angles(),
            position_sd_mm: invariant.position_sd_mm,
            registration_sd_mm: 0.0,
            curvature_sd: invariant.curvature_sd,
            torsion_offset_sd: invariant.torsion_offset_sd,
            torsion_offset_sd_rad: invariant.torsion_offset_sd_deg.to_radians(),
            torsion_search_rad_per_mm: invariant.torsion_search_deg_per_mm.to_radians(),
            innovation_max: invariant.innovation_max,
            position_noise_mm: noise.position_mm,
            axial_noise_mm: noise.axial_mm,
            heading_noise_rad: noise.heading_deg.to_radians(),
            roll_noise_rad: noise.roll_deg.to_radians(),
            curvature_noise: noise.curvature,
            torsion_edge_noise_rad: noise.torsion_edge_deg.to_radians(),
        }
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

impl Config {
    /// The observer that steers, then its shadows.
    pub fn observers(&self) -> impl Iterator<Item = session::ObserverConfig> + '_ {
        let kinds = std::iter::once(self.observer.kind).chain(self.observer.shadows_apart());
        kinds.map(|kind| match kind {
            ObserverKind::Invariant => session::ObserverConfig::Invariant(InvariantConfig {
                // Recordings are evaluated without a registration.
                registration_sd_mm: self.registration_sd_mm().unwrap_or_default(),
                ..self.observer.to_invariant()
            }),
            ObserverKind::Coupled => session::ObserverConfig::Coupled(self.observer.to_coupled()),
            ObserverKind::FiniteDifference => session::ObserverConfig::FiniteDifference {
                baseline_mm: self.observer.finite_difference.baseline_mm,
            },
        })
    }
}
