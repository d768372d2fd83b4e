//! Parameters of the invariant observer, and the bank of hypotheses that it starts with.

use super::error_state::{BACKLOG, CURVATURE, Covariance, Extent, GROWTH, LOWER, UPPER};
use super::hypothesis::{Band, Hypothesis, ProcessNoise};
use crate::geometry::{FixedAngles, Pose};
use crate::keys::{Rule, section, within};
use crate::math;
use crate::needle::{Needle, TipPosition, Torsion, TorsionConfig};
use crate::observer::start;

/// Number of rolls that the bank starts with if the roll is unknown.
pub(super) const ROLLS: u32 = 8;
/// Relative standard deviation of a configured torsion in one half of the bank.
const TORSION_SD_TIGHT: f64 = 0.04;
/// The same in the other half, which takes over if the first half is wrong.
const TORSION_SD_LOOSE: f64 = 0.22;
/// If no torsion is configured, these growths of the band are tried, with these standard deviations, both as
/// fractions of the search range. They are finer near 0, because a growth that was once mistaken for none is
/// not searched for again.
const SEARCH: [(f64, f64); 4] = [(0.06, 0.05), (0.2, 0.08), (0.5, 0.12), (0.85, 0.12)];
/// The share of the bank that these growths have together; the rigid shaft has the rest.
const SEARCH_SHARE: f64 = 0.02;

/// A relative uncertainty: over 0.5 a needle could as well be straight.
const PART: Rule = within(0.0, 0.5);
/// A standard deviation of an angle; over 90 degrees a roll is not known at all.
const ANGLE_SD: Rule = within(0.0, 180.0);
/// The same at the start: with 0 the covariance would lose its last digits after 200 mm.
const START_SD: Rule = within(0.1, 180.0);
/// Standard deviation of a random walk after 1 mm.
const WALK_MM: Rule = within(0.0, 10.0);
const WALK_DEG: Rule = within(0.0, 45.0);

section! {
    /// `[observer.invariant]`: parameters of the observer.
    #[derive(Copy)]
    pub struct InvariantConfig {
        /// Standard deviations of `observer.start`. A roll of over 90 is not known at all.
        start_sd: FixedAngles => "{ yaw_deg = 12.0, pitch_deg = 8.0, roll_deg = 180.0 }", narrowed(
            &[("yaw_deg", START_SD), ("pitch_deg", START_SD), ("roll_deg", START_SD)]
        );
        /// Standard deviation of each coordinate of a measured position, mm; ±1 mm uniform has 0.577.
        position_sd_mm: f64 [within(0.001, 100.0)] = 0.577;
        /// Standard deviation of the needle's curvature, as a part of it.
        curvature_sd: f64 [PART] = 0.17;
        /// Standard deviation of `needle.torsion.offset_deg`, as a part of the half-width.
        torsion_offset_sd: f64 [PART] = 0.33;
        /// The same of a shaft that creeps and has no band.
        torsion_offset_sd_rad as "torsion_offset_sd_deg": f64 [ANGLE_SD] = 7.0;
        /// Where no torsion is given, a band that grows up to this fast is searched for.
        torsion_search_rad_per_mm as "torsion_search_deg_per_mm": f64 [within(0.0, 5.0)] = 0.6;
        /// Innovations of so many times what `position_sd_mm` explains stop the run.
        innovation_max: f64 [within(2.0, 100.0)] = 3.0;
        /// Roll, heading and curvature are estimated anew if the mean of the innovations across the heading
        /// is further from 0 than this χ², two degrees of freedom.
        innovation_bias_max: f64 [within(20.0, 1e6)] = 40.0;
        /// Random walks of the needle beside its model.
        noise: NoiseConfig;
    }
    beside {
        /// Angles assumed at the start.
        pub start: FixedAngles = FixedAngles::default(),
        /// Standard deviation in the worst direction due to the registration, mm. This error is
        /// the same in every position, so averaging does not reduce it. It is added to the
        /// covariance of the estimate, to every coordinate.
        pub registration_sd_mm: f64 = 0.0,
        /// Share of the bank that searches for a torsion if none is configured; the rigid shaft has
        /// the rest.
        pub search_share: f64 = SEARCH_SHARE,
    }
}

section! {
    /// `[observer.invariant.noise]`: random walks, as standard deviations after 1 mm. They grow
    /// with the square root of the depth.
    #[derive(Copy)]
    pub struct NoiseConfig {
        /// Of the position across the axis, mm.
        position_mm: f64 [WALK_MM] = 0.0;
        /// Of the position along the axis, mm: tissue that gives way.
        axial_mm: f64 [WALK_MM] = 0.0;
        /// Of the heading.
        heading_rad as "heading_deg": f64 [WALK_DEG] = 0.0;
        /// Of the roll.
        roll_rad as "roll_deg": f64 [WALK_DEG] = 0.0;
        /// Of the curvature, as a part of it.
        curvature: f64 [PART] = 0.0;
        /// Of the edges of the torsion's band.
        torsion_edge_rad as "torsion_edge_deg": f64 [WALK_DEG] = 0.1;
    }
}

/// A band and how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
struct TorsionPrior {
    band: TorsionConfig,
    /// Standard deviations of w₀ and c, rad, and of w₁, rad/mm.
    half_width_sd_rad: f64,
    offset_sd_rad: f64,
    growth_sd_rad_per_mm: f64,
    share: f64,
}

impl InvariantConfig {
    pub(super) fn process_noise(&self, needle: &Needle) -> ProcessNoise {
        ProcessNoise {
            position_mm2_per_mm: self.noise.position_mm.powi(2),
            axial_mm2_per_mm: self.noise.axial_mm.powi(2),
            heading_rad2_per_mm: self.noise.heading_rad.powi(2),
            roll_rad2_per_mm: self.noise.roll_rad.powi(2),
            curvature_per_mm3: (self.noise.curvature * needle.curvature_per_mm()).powi(2),
            edge_rad2_per_mm: self.noise.torsion_edge_rad.powi(2),
        }
    }

    /// The bank at the first measurement.
    pub(super) fn bank(
        &self,
        needle: &Needle,
        torsion: &Torsion,
        tip_meas: &TipPosition,
    ) -> Vec<Hypothesis> {
        let priors = self.priors(torsion.config());
        let rolls = start::rolls(self.start.roll, self.start_sd.roll, ROLLS);
        let each = rolls.iter().flat_map(|roll| priors.iter().map(move |prior| (roll, prior)));
        each.map(|(&(roll, roll_sd, share), prior)| {
            let angles = FixedAngles { roll, ..self.start };
            self.hypothesis(needle, angles, roll_sd, prior, tip_meas, math::ln(share * prior.share))
        })
        .collect()
    }

    fn priors(&self, configured: TorsionConfig) -> Vec<TorsionPrior> {
        let TorsionConfig { half_width_rad, half_width_rad_per_mm, .. } = configured;
        let prior = |part: f64, share: f64| TorsionPrior {
            band: configured,
            half_width_sd_rad: part * half_width_rad,
            offset_sd_rad: self.torsion_offset_sd * half_width_rad,
            growth_sd_rad_per_mm: part * half_width_rad_per_mm,
            share,
        };
        if half_width_rad > 0.0 || half_width_rad_per_mm > 0.0 {
            return vec![prior(TORSION_SD_TIGHT, 0.5), prior(TORSION_SD_LOOSE, 0.5)];
        }
        let mut priors = vec![prior(0.0, 0.5)];
        priors[0].offset_sd_rad = self.torsion_offset_sd_rad;
        if self.torsion_search_rad_per_mm > 0.0 && configured.creep_mm == 0.0 {
            let range = self.torsion_search_rad_per_mm;
            priors[0].share = 1.0 - self.search_share;
            priors.extend(SEARCH.map(|(growth, sd)| TorsionPrior {
                band: TorsionConfig { half_width_rad_per_mm: growth * range, ..configured },
                growth_sd_rad_per_mm: sd * range,
                share: self.search_share / SEARCH.len() as f64,
                ..prior(0.0, 0.0)
            }));
        }
        priors
    }

    fn hypothesis(
        &self,
        needle: &Needle,
        angles: FixedAngles,
        roll_sd: f64,
        prior: &TorsionPrior,
        tip_meas: &TipPosition,
        log_weight: f64,
    ) -> Hypothesis {
        let TorsionConfig { half_width_rad, half_width_rad_per_mm, offset_rad, .. } = prior.band;
        let (width_variance, offset_variance) =
            (prior.half_width_sd_rad.powi(2), prior.offset_sd_rad.powi(2));
        let banded = half_width_rad > 0.0 || half_width_rad_per_mm > 0.0;
        let known = width_variance == 0.0 && prior.growth_sd_rad_per_mm == 0.0;
        let extent = match (banded, prior.band.creep_mm > 0.0) {
            (true, _) if !(known && offset_variance == 0.0) => Extent::Banded,
            (_, true) => Extent::Creeping,
            _ => Extent::Rigid,
        };
        let mut p = Covariance::zero(extent);
        let sd = FixedAngles { roll: roll_sd, ..self.start_sd };
        let pose = start::covariance(&angles, &sd, self.position_sd_mm);
        (0..6).for_each(|i| (i..6).for_each(|k| p.set(i, k, pose[(i, k)])));
        p.set(CURVATURE, CURVATURE, (self.curvature_sd * needle.curvature_per_mm()).powi(2));
        if extent == Extent::Banded {
            p.set(LOWER, LOWER, offset_variance + width_variance);
            p.set(UPPER, UPPER, offset_variance + width_variance);
            p.set(LOWER, UPPER, offset_variance - width_variance);
            p.set(GROWTH, GROWTH, prior.growth_sd_rad_per_mm.powi(2));
        } else if extent == Extent::Creeping && !banded {
            // The lag starts at the middle of the band, and the tip still has to creep there, so the
            // uncertainty of the offset is that of the backlog.
            p.set(BACKLOG, BACKLOG, offset_variance);
        }
        let band = Band {
            lower_rad: offset_rad - half_width_rad,
            upper_rad: offset_rad + half_width_rad,
            growth_rad_per_mm: half_width_rad_per_mm,
            creep_mm: prior.band.creep_mm,
            creep_mm_per_mm: prior.band.creep_mm_per_mm,
        };
        let x_pb = Pose { rotation: angles.to_rotation(), translation: tip_meas.mm() };
        Hypothesis::new(x_pb, needle, band, p, log_weight)
    }
}
