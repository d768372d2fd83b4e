//! The emulated needle in its tissue.

use crate::geometry::Pose;
use crate::needle::{Cut, Increment, InsertedPath, Needle, Play, Torsion};

/// A needle withdrawn to this depth is out of the tissue, mm.
const OUT_MM: f64 = 0.1;

/// Which part of the needle's curvature the path has, and which part of the base's turns and advances reaches the tip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Shares {
    pub(crate) curvature: f64,
    pub(crate) turn: f64,
    pub(crate) advance: f64,
}

impl Shares {
    /// Those of needle and tissue as configured.
    const WHOLE: Shares = Shares { curvature: 1.0, turn: 1.0, advance: 1.0 };
}

/// A needle in tissue. The true position of the stage drives it; its true tip pose follows.
#[derive(Debug, Clone)]
pub(crate) struct Tissue {
    needle: Needle,
    torsion: Torsion,
    play: Play,
    path: InsertedPath,
    /// True depth of the base, mm, and its rotation, rad, at the last advance.
    insertion_true_mm: f64,
    rotation_true_rad: f64,
    /// What the faults of needle and tissue leave.
    shares: Shares,
    /// By how much the tip is behind the base's depth, mm: the shaft has buckled.
    behind_mm: f64,
    /// Turns of the base that have not reached the needle, rad: it has slipped in the chuck.
    slipped_rad: f64,
    /// Tip pose `X_PB`, and the sum of the tip's rotations about its own axis, rad.
    true_now: Cut,
}

impl Tissue {
    /// A needle whose tip is at `start` (`X_PB`) when the stage is at (0, 0).
    pub(crate) fn new(needle: Needle, torsion: Torsion, start: Pose) -> Self {
        let start = Cut { tip: start, roll_rad: 0.0 };
        let mut path = InsertedPath::default();
        path.advance(0.0, start);
        Tissue {
            needle,
            torsion,
            play: Play::default(),
            path,
            insertion_true_mm: 0.0,
            rotation_true_rad: 0.0,
            shares: Shares::WHOLE,
            behind_mm: 0.0,
            slipped_rad: 0.0,
            true_now: start,
        }
    }

    /// Sets what the faults of needle and tissue leave from here on.
    pub(crate) fn set_shares(&mut self, shares: Shares) {
        self.shares = shares;
    }

    /// Moves the base to this true stage position; both axes move in proportion.
    ///
    /// Beyond its deepest position the needle cuts (paper Eq. 1). In the channel that it has cut it
    /// slides: the channel holds the tip's place and heading, the base its roll. The shaft's torsion
    /// decides how much of the base's rotation reaches the tip. A needle that was pulled out enters
    /// fresh tissue.
    pub(crate) fn advance(&mut self, insertion_true_mm: f64, rotation_true_rad: f64) {
        let base_turn_rad = rotation_true_rad - self.rotation_true_rad;
        let turn_rad = base_turn_rad * self.shares.turn;
        self.slipped_rad += base_turn_rad - turn_rad;
        let cut_mm = self.path.depth_mm().unwrap_or(0.0);
        let from_mm = self.insertion_true_mm - self.behind_mm;
        let advance_mm = (insertion_true_mm - self.insertion_true_mm).max(0.0);
        self.behind_mm += advance_mm * (1.0 - self.shares.advance);
        let to_mm = insertion_true_mm - self.behind_mm;
        let new_mm = (to_mm - from_mm.max(cut_mm)).max(0.0);
        let turn_cutting_rad =
            if new_mm > 0.0 { turn_rad * new_mm / (to_mm - from_mm) } else { 0.0 };
        let turn_in_channel_rad = turn_rad - turn_cutting_rad;
        if from_mm.max(to_mm) <= 0.0 {
            // In air nothing holds the tip back.
            self.true_now.roll_rad += turn_in_channel_rad;
        } else if let Ok(turn) = Increment::new(0.0, turn_in_channel_rad) {
            let rolls = self.play.advance(&self.torsion, turn);
            self.true_now.roll_rad += rolls.map(|roll| roll.rotation_rad()).sum::<f64>();
        }
        self.slide(to_mm.clamp(0.0, cut_mm));
        if let Ok(base) = Increment::new(new_mm, turn_cutting_rad)
            && new_mm > 0.0
        {
            let needle = self.needle.with_share_of_curvature(self.shares.curvature);
            let mut depth_mm = to_mm - new_mm;
            for tip in self.play.advance(&self.torsion, base) {
                depth_mm += tip.insertion_mm();
                self.true_now.tip = needle.step(&self.true_now.tip, tip);
                self.true_now.roll_rad += tip.rotation_rad();
                self.path.advance(depth_mm, self.true_now);
            }
        }
        if to_mm < from_mm.min(OUT_MM) {
            self.leave(to_mm.clamp(0.0, cut_mm), rotation_true_rad);
        }
        self.insertion_true_mm = insertion_true_mm;
        self.rotation_true_rad = rotation_true_rad;
    }

    /// Moves the tip along the channel.
    fn slide(&mut self, to_mm: f64) {
        if let Some(cut) = self.path.at(to_mm) {
            self.true_now.tip = cut.tip_rolled_to(self.true_now.roll_rad);
        }
    }

    /// The needle is out: its tip follows the base's rotation, and its channel is dropped.
    fn leave(&mut self, at_mm: f64, rotation_true_rad: f64) {
        self.play = Play::default();
        self.true_now.roll_rad = rotation_true_rad - self.slipped_rad;
        self.slide(at_mm);
        self.path = InsertedPath::default();
        self.path.advance(at_mm, self.true_now);
    }

    /// The true tip pose `X_PB`.
    pub(crate) fn tip_true(&self) -> &Pose {
        &self.true_now.tip
    }

    /// The true tip pose `X_PB` when the needle had cut to `insertion_true_mm`; `None` for a depth
    /// that it has not reached.
    pub(crate) fn cut_at(&self, insertion_true_mm: f64) -> Option<Pose> {
        self.path.at(insertion_true_mm).map(|cut| cut.tip)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::FixedAngles;
    use crate::needle::TorsionConfig;

    fn needle() -> Needle {
        Needle::new(1.0 / 122.0).unwrap()
    }

    /// The tip at `from`, advanced by `along_mm` with a turn of `turn_rad`.
    fn step(from: &Pose, along_mm: f64, turn_rad: f64) -> Pose {
        needle().step(from, Increment::new(along_mm, turn_rad).unwrap())
    }

    fn tissue() -> Tissue {
        twisting(0.0)
    }

    /// A needle whose shaft has a torsion band of `half_width_rad`.
    fn twisting(half_width_rad: f64) -> Tissue {
        let torsion =
            Torsion::new(TorsionConfig { half_width_rad, ..TorsionConfig::default() }).unwrap();
        Tissue::new(needle(), torsion, Pose::identity())
    }

    #[test]
    fn cuts_by_the_kinematics_and_retraces_on_the_way_out() {
        let mut tissue = tissue();
        let mut path = Vec::new();
        for n in 1..=50 {
            tissue.advance(f64::from(n), 0.05 * f64::from(n));
            path.push(*tissue.tip_true());
        }
        let mut expected = Pose::identity();
        for _ in 0..50 {
            expected = step(&expected, 1.0, 0.05);
        }
        assert!((tissue.tip_true().translation - expected.translation).norm() < 1e-9);
        tissue.advance(20.0, 2.5);
        assert!((tissue.tip_true().translation - path[19].translation).norm() < 1e-9);
    }

    #[test]
    fn turning_on_the_spot_turns_the_bevel_alone() {
        let mut tissue = tissue();
        tissue.advance(10.0, 0.0);
        let before = *tissue.tip_true();
        tissue.advance(10.0, 0.7);
        let turned =
            FixedAngles::from_rotation(&(before.rotation.inverse() * tissue.tip_true().rotation));
        assert_eq!(tissue.tip_true().translation, before.translation);
        assert!((turned.roll - 0.7).abs() < 1e-12);
    }

    #[test]
    fn a_needle_pulled_back_and_pushed_again_cuts_on_from_its_deepest_point() {
        let mut tissue = tissue();
        tissue.advance(10.0, 0.0);
        let deepest = *tissue.tip_true();
        tissue.advance(5.0, 0.0);
        tissue.advance(10.0, 0.0);
        assert!((tissue.tip_true().translation - deepest.translation).norm() < 1e-9);
        tissue.advance(12.0, 0.0);
        let on = step(&deepest, 2.0, 0.0);
        assert!((tissue.tip_true().translation - on.translation).norm() < 1e-9);
    }

    fn distance(a: &Pose, b: &Pose) -> f64 {
        (a.translation - b.translation).norm() + (a.rotation.matrix() - b.rotation.matrix()).norm()
    }

    /// A move across the deepest point slides to it and cuts from there. A turn on the way is split in proportion.
    #[test]
    fn one_move_from_the_channel_into_new_tissue_cuts_from_the_deepest_point() {
        for turn_rad in [0.0, 0.7] {
            let mut tissue = tissue();
            tissue.advance(10.0, 0.0);
            let deepest = *tissue.tip_true();
            tissue.advance(5.0, 0.0);
            tissue.advance(12.0, turn_rad);
            let rolled = step(&deepest, 0.0, turn_rad * 5.0 / 7.0);
            let on = step(&rolled, 2.0, turn_rad * 2.0 / 7.0);
            assert!(distance(tissue.tip_true(), &on) < 1e-9);
        }
    }

    /// A turn in the channel is kept while the needle slides, and bends what it cuts next. The channel itself does
    /// not move.
    #[test]
    fn a_turn_in_the_channel_is_kept() {
        let mut tissue = tissue();
        tissue.advance(5.0, 0.0);
        let halfway = *tissue.tip_true();
        tissue.advance(10.0, 0.0);
        let deepest = *tissue.tip_true();
        tissue.advance(8.0, 0.0);
        tissue.advance(8.0, 1.2);
        tissue.advance(5.0, 1.2);
        assert!(distance(tissue.tip_true(), &step(&halfway, 0.0, 1.2)) < 1e-9);
        tissue.advance(10.0, 1.2);
        let rolled = step(&deepest, 0.0, 1.2);
        assert!(distance(tissue.tip_true(), &rolled) < 1e-9);
        tissue.advance(12.0, 1.2);
        let on = step(&rolled, 2.0, 0.0);
        assert!(distance(tissue.tip_true(), &on) < 1e-9);
        tissue.advance(5.0, 1.2);
        assert!(distance(tissue.tip_true(), &step(&halfway, 0.0, 1.2)) < 1e-9);
    }

    /// Without torsion the tip keeps the roll of the base, whatever the turns along the channel.
    #[test]
    fn the_channel_does_not_turn_the_tip() {
        let mut tissue = tissue();
        tissue.advance(5.0, 1.0);
        let halfway = *tissue.tip_true();
        tissue.advance(10.0, 3.0);
        for rotation_rad in [3.0, 0.4] {
            tissue.advance(5.0, rotation_rad);
            let rolled = step(&halfway, 0.0, rotation_rad - 1.0);
            assert!(distance(tissue.tip_true(), &rolled) < 1e-9);
        }
    }

    /// Before the insertion, and after a withdrawal.
    #[test]
    fn in_air_the_tip_turns_with_the_base() {
        let mut tissue = twisting(0.5);
        let turned = |rad| step(&Pose::identity(), 0.0, rad);
        tissue.advance(0.0, 0.4);
        assert!(distance(tissue.tip_true(), &turned(0.4)) < 1e-9);
        tissue.advance(10.0, 2.0);
        tissue.advance(0.0, 2.0);
        tissue.advance(0.0, 0.3);
        assert!(distance(tissue.tip_true(), &turned(0.3)) < 1e-9);
    }

    /// The channel and the torsion of the shaft are gone: the next insertion is like the first one of a needle with
    /// this roll.
    #[test]
    fn a_needle_pulled_out_enters_fresh_tissue() {
        let mut tissue = twisting(0.5);
        tissue.advance(10.0, 2.0);
        tissue.advance(0.05, 2.0);
        let out = *tissue.tip_true();
        let straight = step(&Pose::identity(), 0.0, 2.0);
        assert!((out.rotation.matrix() - straight.rotation.matrix()).norm() < 1e-3);
        let mut first = Tissue::new(needle(), tissue.torsion, out);
        for n in 1..=10 {
            let deeper_mm = f64::from(n);
            tissue.advance(0.05 + deeper_mm, 2.0 + 0.2 * deeper_mm);
            first.advance(deeper_mm, 0.2 * deeper_mm);
            assert!(distance(tissue.tip_true(), first.tip_true()) < 1e-9);
        }
    }

    /// This holds while the needle cuts, and in the channel.
    #[test]
    fn the_tip_turns_once_the_base_has_crossed_the_torsion_band() {
        let mut tissue = twisting(0.5);
        tissue.advance(10.0, 0.4);
        let straight = step(&Pose::identity(), 10.0, 0.0);
        assert!(distance(tissue.tip_true(), &straight) < 1e-9);
        tissue.advance(10.0, 0.8);
        let rolled = step(&straight, 0.0, 0.3);
        assert!(distance(tissue.tip_true(), &rolled) < 1e-9);
        // Back through the whole band over 2 mm: the first 10/13 of them unturned.
        tissue.advance(12.0, -0.5);
        let free = step(&rolled, 2.0 / 1.3, 0.0);
        let dragged = step(&free, 2.0 * 0.3 / 1.3, -0.3);
        assert!(distance(tissue.tip_true(), &dragged) < 1e-9);
        tissue.advance(10.0 + 2.0 / 1.3, -0.5);
        let back = step(&free, 0.0, -0.3);
        assert!(distance(tissue.tip_true(), &back) < 1e-9, "retraced through the kink");
    }

    #[test]
    fn tissue_chuck_and_shaft_leave_their_share() {
        let mut tissue = tissue();
        tissue.set_shares(Shares { curvature: 0.5, ..Shares::WHOLE });
        tissue.advance(10.0, 0.0);
        let softer = needle().with_share_of_curvature(0.5);
        let mut expected = softer.step(&Pose::identity(), Increment::new(10.0, 0.0).unwrap());
        assert!(distance(tissue.tip_true(), &expected) < 1e-9);
        tissue.set_shares(Shares { turn: 0.5, ..Shares::WHOLE });
        tissue.advance(10.0, 0.8);
        expected = step(&expected, 0.0, 0.4);
        assert!(distance(tissue.tip_true(), &expected) < 1e-9);
        tissue.set_shares(Shares { advance: 0.5, ..Shares::WHOLE });
        tissue.advance(14.0, 0.8);
        expected = step(&expected, 2.0, 0.0);
        assert!(distance(tissue.tip_true(), &expected) < 1e-9);
        tissue.set_shares(Shares::WHOLE);
        tissue.advance(15.0, 0.8);
        expected = step(&expected, 1.0, 0.0);
        assert!(distance(tissue.tip_true(), &expected) < 1e-9, "what was lost stays lost");
        tissue.advance(0.0, 0.8);
        assert!(distance(tissue.tip_true(), &step(&Pose::identity(), 0.0, 0.4)) < 1e-9);
        tissue.advance(3.0, 0.8);
        let again = step(&step(&Pose::identity(), 0.0, 0.4), 1.0, 0.0);
        assert!(distance(tissue.tip_true(), &again) < 1e-9, "also outside the tissue");
    }
}
