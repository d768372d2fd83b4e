//! The shaft's torsion: between the base's rotation and the tip's roll there is play (hysteresis).

use super::Increment;
use super::kinematics::bounded;
use crate::keys::{Rule, section, within};
use crate::math;

/// Below this ratio of insertion to creep length the creep is linear, up to rounding.
const CREEP_RATIO_MIN: f64 = 1e-9;
/// Rounding tolerance of the band's edges, relative to 1 rad and the half-width.
const EDGE_TOLERANCE: f64 = 1e-12;

/// Half-width of a play in degrees, its growth in degrees per mm, and its offset in degrees.
pub(crate) const HALF_WIDTH: Rule = within(0.0, 720.0);
pub(crate) const HALF_WIDTH_PER_MM: Rule = within(0.0, 36.0);
pub(crate) const OFFSET: Rule = within(-720.0, 720.0);

section! {
    /// `[needle.torsion]` and `[emulator.torsion]`: the play between the base's rotation and the
    /// tip's.
    #[derive(Copy, Default)]
    pub struct TorsionConfig {
        /// Half the width of the band at the start: the tip stays within offset ± half-width
        /// of the base.
        half_width_rad as "half_width_deg": f64 [HALF_WIDTH] = 0.0;
        /// Growth of the half-width with depth.
        half_width_rad_per_mm as "half_width_deg_per_mm": f64 [HALF_WIDTH_PER_MM] = 0.0;
        /// Middle of the band; without creep at most `half_width_deg` in magnitude.
        offset_rad as "offset_deg": f64 [OFFSET] = 0.0;
        /// Insertion over which the tip creeps to the band, at the start, mm; 0: at once.
        creep_mm: f64 [within(0.0, 100.0)] = 0.0;
        /// Growth of that with depth, mm per mm.
        creep_mm_per_mm: f64 [within(0.0, 1.0)] = 0.0;
    }
}

impl TorsionConfig {
    /// The name of each key, and its value in the key's unit.
    pub fn in_keys(&self) -> [(&'static str, f64); 5] {
        [
            ("half_width_deg", self.half_width_rad.to_degrees()),
            ("half_width_deg_per_mm", self.half_width_rad_per_mm.to_degrees()),
            ("offset_deg", self.offset_rad.to_degrees()),
            ("creep_mm", self.creep_mm),
            ("creep_mm_per_mm", self.creep_mm_per_mm),
        ]
    }
}

/// The play between base and tip. The lag λ is tip roll minus base rotation, both counted from the
/// start. The play keeps it within the band `c ± w(ℓ)` with `w(ℓ) = w₀ + w₁ ℓ`.
///
/// An excess over the band decays with insertion over the creep length `L(ℓ) = L₀ + L₁ ℓ`. With L = 0
/// the play is Coulomb friction on the shaft. With w = 0 it is viscous friction, a first-order lag in
/// depth. The default is a rigid shaft.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Torsion {
    config: TorsionConfig,
}

impl Torsion {
    /// A torsion of these parameters.
    ///
    /// # Errors
    /// A value that is not finite, over 1e6 or negative; a creep length that grows from zero, for which
    /// the creep at the start is not defined; without creep a start outside the band, as the lag starts
    /// at 0.
    pub fn new(config: TorsionConfig) -> Result<Self, String> {
        let TorsionConfig { half_width_rad, offset_rad, creep_mm, creep_mm_per_mm, .. } = config;
        bounded("torsion offset in rad", offset_rad)?;
        for (quantity, value) in [
            ("torsion half-width in rad", half_width_rad),
            ("torsion half-width in rad per mm", config.half_width_rad_per_mm),
            ("torsion creep length in mm", creep_mm),
            ("torsion creep length in mm per mm", creep_mm_per_mm),
        ] {
            bounded(quantity, value)?;
            if value < 0.0 {
                return Err(format!("{quantity} is {value}, the least is 0"));
            }
        }
        if creep_mm == 0.0 && creep_mm_per_mm > 0.0 {
            return Err(format!(
                "torsion creep grows by {creep_mm_per_mm} mm per mm from 0 mm: give its length at the \
                 start"
            ));
        }
        if creep_mm == 0.0 && offset_rad.abs() > half_width_rad {
            let (offset_deg, limit_deg) = (offset_rad.to_degrees(), half_width_rad.to_degrees());
            return Err(format!(
                "torsion offset is {offset_deg:.3} deg, allowed is up to the half-width at the start, \
                 {limit_deg:.3} deg, in magnitude: the tip would start outside its own band"
            ));
        }
        Ok(Torsion { config })
    }

    /// The parameters.
    pub fn config(&self) -> TorsionConfig {
        self.config
    }

    /// w(ℓ), half-width of the band at `insertion_mm`, rad.
    pub fn half_width_rad(&self, insertion_mm: f64) -> f64 {
        self.config.half_width_rad + self.config.half_width_rad_per_mm * insertion_mm
    }
}

/// The state of the play. It starts with no lag at depth 0.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Play {
    insertion_mm: f64,
    lag_rad: f64,
}

impl Play {
    /// ℓ, the insertion so far, mm.
    pub fn insertion_mm(&self) -> f64 {
        self.insertion_mm
    }

    /// λ, tip roll minus base rotation, rad.
    pub fn lag_rad(&self) -> f64 {
        self.lag_rad
    }

    /// Advances the play by an increment of the base, with insertion and rotation in constant proportion.
    /// Returns one to three increments of the tip that add up to the same insertion.
    ///
    /// Within the band the tip does not turn: `λ' = −θ'`. Outside, the excess e over the edge obeys
    /// `e' = ∓θ' − w₁ − e / L(ℓ)` per inserted mm. With L = 0 the lag moves along the edge. With L > 0 an
    /// excess made at standstill stays until the needle is inserted further. The solution is piecewise
    /// and includes the kinks, so the lag does not depend on how a path is divided into steps. With L = 0
    /// neither does the tip's path; while the lag creeps, the tip turns at the mean rate of its piece.
    pub fn advance(
        &mut self,
        torsion: &Torsion,
        base: Increment,
    ) -> impl Iterator<Item = Increment> + use<> {
        let mut pieces = [None; 3];
        let mut remaining = 1.0;
        // Outside the band, through it and outside again: there is no fourth piece.
        for piece in &mut pieces {
            if remaining > 0.0 {
                let (part, lag_rad) = self.piece(torsion, base, remaining);
                let roll_rad = base.rotation_rad() * part + (lag_rad - self.lag_rad);
                let increment = base.part(part, roll_rad);
                self.insertion_mm += increment.insertion_mm();
                self.lag_rad = lag_rad;
                remaining -= part;
                *piece = Some(increment);
            }
        }
        pieces.into_iter().flatten()
    }

    /// The next piece, outside or inside the band: the part of `base` that it takes, at most `remaining`, and
    /// the lag at its end. All rates are per whole `base`.
    fn piece(&self, torsion: &Torsion, base: Increment, remaining: f64) -> (f64, f64) {
        let TorsionConfig { half_width_rad_per_mm, offset_rad, .. } = torsion.config;
        let half_width_rad = torsion.half_width_rad(self.insertion_mm);
        let widening = half_width_rad_per_mm * base.insertion_mm();
        let drift = -base.rotation_rad();
        let from_middle = self.lag_rad - offset_rad;
        let excess = from_middle.abs() - half_width_rad;
        let edge = EDGE_TOLERANCE * (1.0 + half_width_rad);
        let side = if excess > edge { from_middle } else { drift }.signum();
        let outward = side * drift - widening;
        if excess <= edge {
            let gap = half_width_rad - side * from_middle;
            if outward <= 0.0 || gap >= outward * remaining {
                return (remaining, self.lag_rad + drift * remaining);
            }
            if gap > edge {
                let part = gap / outward;
                return (part, offset_rad + side * (half_width_rad + widening * part));
            }
        }
        let creep = Creep::of(torsion, self.insertion_mm, base.insertion_mm());
        let excess = excess.max(0.0);
        let inside_after = if outward < 0.0 { creep.part_to_edge(excess, outward) } else { 1.0 };
        let part = remaining.min(inside_after);
        let excess = if part < remaining { 0.0 } else { creep.excess(excess, outward, part) };
        (part, offset_rad + side * (half_width_rad + widening * part + excess))
    }
}

/// The creep over one increment from depth ℓ: `e' = g − e / (L + L₁ s Δℓ)`, with the part s and the
/// outward rate g both per whole increment.
struct Creep {
    /// r = Δℓ / L; infinite if the tip follows at once instead of creeping.
    ratio: f64,
    /// L₁.
    growth: f64,
}

impl Creep {
    fn of(torsion: &Torsion, insertion_mm: f64, increment_mm: f64) -> Self {
        let TorsionConfig { creep_mm, creep_mm_per_mm, .. } = torsion.config;
        let length_mm = creep_mm + creep_mm_per_mm * insertion_mm;
        let ratio = if length_mm > 0.0 { increment_mm / length_mm } else { f64::INFINITY };
        Creep { ratio, growth: creep_mm_per_mm }
    }

    /// The excess after `part`: `e D + g s (1 + L₁ r s − D) / ((1 + L₁) r s)` with
    /// `D = (1 + L₁ r s)^(−1/L₁)`, which is `exp(−r s)` for L₁ = 0.
    fn excess(&self, excess: f64, outward: f64, part: f64) -> f64 {
        let (ratio, growth) = (self.ratio * part, self.growth);
        if ratio == f64::INFINITY {
            return 0.0;
        }
        let longer = growth * ratio;
        let exponent = if longer > 0.0 { ratio * math::ln_1p(longer) / longer } else { ratio };
        let mean = if ratio < CREEP_RATIO_MIN {
            1.0
        } else {
            (longer - math::exp_m1(-exponent)) / ((1.0 + growth) * ratio)
        };
        excess * math::exp(-exponent) + outward * part * mean
    }

    /// The part of the increment after which the excess is 0, for a negative outward rate.
    fn part_to_edge(&self, excess: f64, outward: f64) -> f64 {
        let (ratio, growth) = (self.ratio, self.growth);
        if ratio == f64::INFINITY {
            return 0.0;
        }
        if ratio < CREEP_RATIO_MIN {
            return excess / -outward;
        }
        let logarithm = math::ln_1p(excess * ratio * (1.0 + growth) / -outward) / (1.0 + growth);
        let grown = growth * logarithm;
        let line = if grown > 0.0 { math::exp_m1(grown) / grown } else { 1.0 };
        logarithm * line / ratio
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::needle::Needle;
    use proptest::prelude::*;

    impl Torsion {
        /// The band of the lag at `insertion_mm`: its lower and its upper edge, rad.
        pub(crate) fn band_rad(&self, insertion_mm: f64) -> (f64, f64) {
            let half_width_rad = self.half_width_rad(insertion_mm);
            (self.config.offset_rad - half_width_rad, self.config.offset_rad + half_width_rad)
        }
    }

    fn play(insertion_mm: f64, lag_rad: f64) -> Play {
        Play { insertion_mm, lag_rad }
    }

    fn torsion(w0: f64, w1: f64, offset: f64, creep_mm: f64) -> Torsion {
        Torsion::new(TorsionConfig {
            half_width_rad: w0,
            half_width_rad_per_mm: w1,
            offset_rad: offset,
            creep_mm,
            creep_mm_per_mm: 0.02 * creep_mm,
        })
        .unwrap()
    }

    fn any_torsion() -> impl Strategy<Value = Torsion> {
        let creep_mm = prop_oneof![Just(0.0), 0.01..5.0f64];
        (0.0..1.0f64, prop_oneof![Just(0.0), 0.0..0.1f64], -1.0..1.0f64, creep_mm)
            .prop_map(|(w0, w1, c, creep)| torsion(w0, w1, c * w0, creep))
    }

    fn increment(insertion_mm: f64, rotation_rad: f64) -> Increment {
        Increment::new(insertion_mm, rotation_rad).unwrap()
    }

    /// The turn of the tip caused by a turn of the base.
    fn turn(play: &mut Play, torsion: &Torsion, insertion_mm: f64, rotation_rad: f64) -> f64 {
        let parts = play.advance(torsion, increment(insertion_mm, rotation_rad));
        parts.map(|part| part.rotation_rad()).sum()
    }

    proptest! {
        /// The lag at the end of a step does not depend on how the step is divided.
        #[test]
        fn steps_compose(torsion in any_torsion(), lag in -3.0..3.0f64, l in prop_oneof![Just(0.0), 0.0..3.0f64], turned in -3.0..3.0f64, f in 0.0..1.0f64) {
            let mut whole = self::play(10.0, lag);
            turn(&mut whole, &torsion, l, turned);
            let mut parts = self::play(10.0, lag);
            turn(&mut parts, &torsion, l * f, turned * f);
            turn(&mut parts, &torsion, l * (1.0 - f), turned * (1.0 - f));
            prop_assert!((whole.lag_rad() - parts.lag_rad()).abs() < 1e-9, "{whole:?} {parts:?}");
        }

        /// The pieces add up to the step: insertion, and roll = rotation + change of the lag.
        #[test]
        fn the_pieces_add_up_to_the_step(torsion in any_torsion(), lag in -3.0..3.0f64, l in prop_oneof![Just(0.0), 0.0..3.0f64], turned in -3.0..3.0f64) {
            let mut play = self::play(10.0, lag);
            let pieces: Vec<Increment> = play.advance(&torsion, increment(l, turned)).collect();
            let inserted: f64 = pieces.iter().map(|piece| piece.insertion_mm()).sum();
            let rolled: f64 = pieces.iter().map(|piece| piece.rotation_rad()).sum();
            prop_assert!((inserted - l).abs() < 1e-12 && (play.insertion_mm() - 10.0 - l).abs() < 1e-12);
            prop_assert!((rolled - turned - (play.lag_rad() - lag)).abs() < 1e-12);
        }

        /// Without creep the lag never leaves the band, and the tip's path does not depend on how the
        /// base's path is divided.
        #[test]
        fn without_creep_the_path_is_exact(w0 in 0.0..1.0f64, w1 in 0.0..0.1f64, c in -1.0..1.0f64, turns in prop::collection::vec(-1.5..1.5f64, 1..8)) {
            let torsion = torsion(w0, w1, c * w0, 0.0);
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let follow = |pieces: u32| {
                let (mut play, mut tip) = (Play::default(), Pose::identity());
                for &turned in &turns {
                    for _ in 0..pieces {
                        let n = f64::from(pieces);
                        tip = play
                            .advance(&torsion, increment(1.0 / n, turned / n))
                            .fold(tip, |tip, part| needle.step(&tip, part));
                        let (low, high) = torsion.band_rad(play.insertion_mm());
                        assert!((low - 1e-9..=high + 1e-9).contains(&play.lag_rad()));
                    }
                }
                tip
            };
            let (whole, fine) = (follow(1), follow(50));
            prop_assert!((whole.translation - fine.translation).norm() < 1e-9);
            prop_assert!((whole.rotation.matrix() - fine.rotation.matrix()).norm() < 1e-9);
        }
    }

    #[test]
    fn a_rigid_shaft_turns_the_tip_as_the_base() {
        let (rigid, mut play) = (Torsion::default(), Play::default());
        for turned in [0.3, -1.7, 0.0] {
            let base = increment(1.0, turned);
            assert_eq!(play.advance(&rigid, base).collect::<Vec<_>>(), [base]);
        }
        assert_eq!(play.lag_rad(), 0.0);
    }

    /// From the middle of the band the base turns 40° before the tip moves. On the way back it crosses the whole band
    /// first.
    #[test]
    fn a_reversal_crosses_the_whole_band() {
        let torsion = torsion(0.7, 0.0, 0.0, 0.0);
        let mut play = Play::default();
        assert_eq!(turn(&mut play, &torsion, 1.0, 0.6), 0.0);
        assert!((turn(&mut play, &torsion, 1.0, 0.6) - 0.5).abs() < 1e-15);
        assert_eq!(turn(&mut play, &torsion, 1.0, -1.3), 0.0);
        assert!((turn(&mut play, &torsion, 1.0, -0.3) + 0.2).abs() < 1e-15);
    }

    /// In one step the base crosses what is left of the band, then drags the tip along.
    #[test]
    fn a_step_is_split_where_the_lag_meets_the_edge() {
        let mut play = Play::default();
        let torsion = torsion(0.2, 0.1, 0.1, 0.0);
        // After s of the step the lag −0.5 s meets the lower edge, c − w₀ − w₁ s, where 0.1 + 0.1 s = 0.5 s.
        let pieces: Vec<Increment> = play.advance(&torsion, increment(1.0, 0.5)).collect();
        let [free, dragged] = pieces[..] else { panic!("{pieces:?}") };
        assert!((free.insertion_mm() - 0.25).abs() < 1e-12 && free.rotation_rad().abs() < 1e-15);
        assert!((dragged.insertion_mm() - 0.75).abs() < 1e-12);
        assert!((dragged.rotation_rad() - 0.75 * 0.4).abs() < 1e-12);
    }

    #[test]
    fn an_excess_stays_at_standstill_and_creeps_with_insertion() {
        let torsion = torsion(0.2, 0.0, 0.0, 2.0);
        let mut play = Play::default();
        assert!(turn(&mut play, &torsion, 0.0, 1.2).abs() < 1e-15);
        assert!((play.lag_rad() + 1.2).abs() < 1e-15);
        let rolled = turn(&mut play, &torsion, 2.0, 0.0);
        // L grows from 2 mm by 0.04 mm/mm over 2 mm.
        let decay = 1.04f64.powf(-1.0 / 0.04);
        assert!((rolled - (1.0 - decay)).abs() < 1e-12, "{rolled}");
        assert!((play.lag_rad() + 0.2 + decay).abs() < 1e-12);
    }

    /// The reference integrates the differential equation in small steps.
    #[test]
    fn creep_solves_its_equation() {
        let torsion = torsion(0.1, 0.02, 0.05, 1.5);
        let (mut play, mut lag, n) = (self::play(0.0, 0.4), 0.4f64, 100_000);
        for turned in [0.3, -0.9, 1.4] {
            turn(&mut play, &torsion, 1.0, turned);
        }
        let h = 1.0 / f64::from(n);
        for (step, turned) in [0.3, -0.9, 1.4].into_iter().enumerate() {
            for i in 0..n {
                let depth = step as f64 + (f64::from(i) + 0.5) * h;
                let (low, high) = torsion.band_rad(depth);
                let excess = (lag - high).max(0.0) + (lag - low).min(0.0);
                lag += h * (-turned - excess / (1.5 + 0.03 * depth));
            }
        }
        assert!((play.lag_rad() - lag).abs() < 1e-4, "{} {lag}", play.lag_rad());
    }

    #[test]
    fn parameters_out_of_range_are_refused_by_name() {
        let refused = |w0, w1, c, creep, growth| {
            let config = TorsionConfig {
                half_width_rad: w0,
                half_width_rad_per_mm: w1,
                offset_rad: c,
                creep_mm: creep,
                creep_mm_per_mm: growth,
            };
            Torsion::new(config).unwrap_err()
        };
        assert_eq!(
            refused(-0.1, 0.0, 0.0, 0.0, 0.0),
            "torsion half-width in rad is -0.1, the least is 0"
        );
        assert!(refused(0.0, -1e-3, 0.0, 0.0, 0.0).starts_with("torsion half-width in rad per mm"));
        assert!(refused(0.0, 0.0, 0.0, -1.0, 0.0).starts_with("torsion creep length in mm"));
        assert!(refused(0.0, 0.0, f64::NAN, 0.0, 0.0).ends_with("not a finite number"));
        assert!(refused(f64::INFINITY, 0.0, 0.0, 0.0, 0.0).ends_with("not a finite number"));
        assert!(refused(0.0, 0.0, 0.0, 1.0, -0.1).starts_with("torsion creep length in mm per mm"));
        assert!(refused(0.0, 0.0, 0.0, 0.0, 0.1).starts_with("torsion creep grows by 0.1"));
        let outside = refused(0.1, 0.0, -0.2, 0.0, 0.0);
        assert!(outside.starts_with("torsion offset is -11.459 deg, allowed"), "{outside}");
    }
}
