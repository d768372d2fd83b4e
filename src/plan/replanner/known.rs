//! Paths that are found without a search.

use super::super::arc::{Arc, Tip};
use super::super::nearest::sharpest_arc;
use super::super::path::Path;
use super::super::rejoin::ways_in_plane;
use super::super::search::Problem;
use super::{Replanner, rest_of};

/// Points of the last path from which the target is tried again, mm apart.
const TRY_MM: f64 = 2.0;
/// Points of the last path at which the tip may come back onto it, mm apart.
const JOIN_MM: f64 = 4.0;
/// An arc of a known path may be sharper by this share than the needle is believed to bend.
const CURVATURE_SLACK: f64 = 0.05;

impl Replanner {
    /// A path that is found without a search.
    pub(super) fn known(&mut self, last: Option<&Path>) -> Option<Path> {
        let mended = |this: &mut Self| this.mended(last?);
        let known = self.direct().or_else(|| mended(self)).or_else(|| self.nearly_direct());
        known.or_else(|| self.continued(last?)).or_else(|| self.rejoined())
    }

    /// Back onto the last path that was found, where that was found, if that is clear from there on.
    fn rejoined(&mut self) -> Option<Path> {
        let Problem { start, curvature_per_mm, in_plane, .. } = self.problem;
        let (path, along_mm) = self.found.clone().filter(|_| in_plane)?;
        if !self.ends_near(&path) || !path.arcs.iter().all(|arc| self.can_be(arc)) {
            return None;
        }
        let joins = ((path.length_mm() - along_mm) / JOIN_MM) as u32;
        let mut joins = (1..=joins).map(|join| along_mm + JOIN_MM * f64::from(join));
        joins.find_map(|join_mm| {
            let (to, _) = path.at(join_mm);
            let rest = rest_of(&path, join_mm, to);
            ways_in_plane(&start, &to, curvature_per_mm).find_map(|way| {
                let whole = Path { start, arcs: [&way[..], &rest.arcs[..]].concat() };
                self.is_clear(&whole).then(|| whole.joined())
            })
        })
    }

    /// The arc to the target, or the sharpest toward it, to where that is nearest to it.
    pub(super) fn sharpest(&self) -> Path {
        let Problem { start, length_max_mm, target_mm, curvature_per_mm, .. } = self.problem;
        let direct =
            start.arc_to(&target_mm).filter(|arc| arc.curvature_per_mm <= curvature_per_mm);
        let arc = direct.unwrap_or_else(|| sharpest_arc(&start, &self.problem, length_max_mm));
        Path { start, arcs: vec![arc] }
    }

    /// That arc, if it is clear and ends within the tolerance.
    fn nearly_direct(&mut self) -> Option<Path> {
        let path = self.sharpest();
        let is_free = self.ends_near(&path) && self.field.is_clear(&path.start, &path.arcs[0]);
        is_free.then_some(path)
    }

    fn ends_near(&self, path: &Path) -> bool {
        self.miss_mm(path) <= self.problem.tolerance_mm
    }

    /// The last path as it is from here, if it is clear and ends within the tolerance.
    fn continued(&mut self, last: &Path) -> Option<Path> {
        let can_be = last.arcs.iter().all(|arc| self.can_be(arc));
        (can_be && self.ends_near(last) && self.is_clear(last)).then(|| last.clone())
    }

    fn is_clear(&mut self, path: &Path) -> bool {
        path.pieces().all(|(tip, arc)| self.field.is_clear(&tip, &arc))
    }

    /// True for an arc of a known path that the needle can bend by, as far as the estimate tells.
    fn can_be(&self, arc: &Arc) -> bool {
        arc.curvature_per_mm <= self.problem.curvature_per_mm * (1.0 + CURVATURE_SLACK)
    }

    /// One arc from the tip to the target, if it is clear.
    fn direct(&mut self) -> Option<Path> {
        let start = self.problem.start;
        let arc = start.arc_to(&self.problem.target_mm)?;
        let is_bent = arc.curvature_per_mm <= self.problem.curvature_per_mm;
        let is_free = is_bent && self.field.is_clear(&start, &arc);
        is_free.then(|| Path { start, arcs: vec![arc] })
    }

    /// The last path from here, left for the target at the point from which the whole is the shortest.
    fn mended(&mut self, last: &Path) -> Option<Path> {
        let mut best: Option<Path> = None;
        let mut arcs = Vec::new();
        for (start, arc) in last.pieces() {
            // The needle was believed to bend by more than it does.
            if !self.can_be(&arc) {
                break;
            }
            let parts = (arc.length_mm / TRY_MM).ceil().max(1.0);
            for part in 0..parts as u32 {
                let cut = arc.with_length(arc.length_mm * f64::from(part) / parts);
                if !self.field.is_clear(&start, &cut) {
                    return best.map(Path::joined);
                }
                let rest = self.shortest_clear(&start.after(&cut));
                let whole = rest.map(|rest| Path {
                    start: last.start,
                    arcs: [&arcs[..], &[cut], &rest[..]].concat(),
                });
                let length_mm =
                    |path: &Option<Path>| path.as_ref().map_or(f64::INFINITY, Path::length_mm);
                if length_mm(&whole) < length_mm(&best) {
                    best = whole;
                }
            }
            if !self.field.is_clear(&start, &arc) {
                break;
            }
            arcs.push(arc);
        }
        best.map(Path::joined)
    }

    /// The shorter one of arc-then-straight and one arc from `tip` to the target that is clear.
    fn shortest_clear(&mut self, tip: &Tip) -> Option<Vec<Arc>> {
        let Problem { target_mm, curvature_per_mm, .. } = self.problem;
        let turning = tip.arc_then_straight_to(&target_mm, curvature_per_mm);
        let bent = tip.arc_to(&target_mm).filter(|arc| arc.curvature_per_mm <= curvature_per_mm);
        let ways = [turning.map(Vec::from), bent.map(|arc| vec![arc])];
        ways.into_iter()
            .flatten()
            .find(|arcs| self.is_clear(&Path { start: *tip, arcs: arcs.clone() }))
    }
}
