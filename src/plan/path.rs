//! A planned path: a chain of arcs that starts at the tip.

use super::arc::{Arc, Tip};
use super::obstacle::World;
use nalgebra::Vector3;

/// The shortest step along a path when its least distance is measured, mm.
const MEASURE_STEP_MM: f64 = 0.02;

/// Arcs, each from the end of the one before.
#[derive(Debug, Clone, PartialEq)]
pub struct Path {
    /// Where the path starts.
    pub start: Tip,
    /// The arcs; empty if the path ends at its start.
    pub arcs: Vec<Arc>,
}

impl Path {
    /// Length, mm.
    pub fn length_mm(&self) -> f64 {
        self.arcs.iter().map(|arc| arc.length_mm).sum()
    }

    /// The tip at the end.
    pub fn end(&self) -> Tip {
        self.arcs.iter().fold(self.start, |tip, arc| tip.after(arc))
    }

    /// Each arc with the tip at its start.
    pub fn pieces(&self) -> impl Iterator<Item = (Tip, Arc)> + '_ {
        self.arcs.iter().scan(self.start, |tip, arc| {
            let start = std::mem::replace(tip, tip.after(arc));
            Some((start, *arc))
        })
    }

    /// The tip `along_mm` from the start, and the arc that it is on; beyond the end of the path, the end and no arc.
    pub fn at(&self, along_mm: f64) -> (Tip, Option<Arc>) {
        let mut left_mm = along_mm.max(0.0);
        for (tip, arc) in self.pieces() {
            if left_mm <= arc.length_mm {
                return (tip.after(&arc.with_length(left_mm)), Some(arc));
            }
            left_mm -= arc.length_mm;
        }
        (self.end(), None)
    }

    /// The arcs of the first `length_mm` of the path.
    pub(super) fn first(&self, length_mm: f64) -> Vec<Arc> {
        let mut left_mm = length_mm;
        let cut = self.arcs.iter().map(|arc| {
            let length_mm = arc.length_mm.min(left_mm);
            left_mm -= length_mm;
            arc.with_length(length_mm)
        });
        cut.filter(|arc| arc.length_mm > 0.0).collect()
    }

    /// Points of the path, `step_mm` apart, and its end.
    pub fn points_mm(&self, step_mm: f64) -> Vec<Vector3<f64>> {
        let length_mm = self.length_mm();
        let steps = (length_mm / step_mm).ceil() as usize;
        let at = (0..steps).map(|step| self.at(step as f64 * step_mm).0.position_mm);
        at.chain([self.end().position_mm]).collect()
    }

    /// The least distance of the path to an obstacle, mm; infinite without obstacles.
    pub fn distance_mm(&self, world: &World) -> f64 {
        let mut least_mm = world.distance_mm(&self.start.position_mm);
        for (tip, arc) in self.pieces() {
            let mut along_mm = 0.0;
            while along_mm < arc.length_mm {
                let at = tip.after(&arc.with_length(along_mm)).position_mm;
                let distance_mm = world.distance_mm(&at);
                // The distance cannot fall below `least_mm` within this part of the way.
                along_mm += (distance_mm - least_mm).max(MEASURE_STEP_MM);
                least_mm = least_mm.min(distance_mm);
            }
        }
        least_mm.min(world.distance_mm(&self.end().position_mm))
    }

    /// The path without arcs of zero length; arcs that continue the one before are joined with it.
    pub(super) fn joined(mut self) -> Self {
        const SAME: f64 = 1e-6;
        let mut joined: Vec<(Tip, Arc)> = Vec::new();
        for (tip, arc) in self.pieces().filter(|(_, arc)| arc.length_mm > 0.0) {
            match joined.last_mut() {
                Some((start, last))
                    if last.curvature_per_mm == arc.curvature_per_mm
                        && (arc.curvature_per_mm == 0.0
                            || (bend_after(start, last) - arc.bend).norm() < SAME) =>
                {
                    last.length_mm += arc.length_mm;
                }
                _ => joined.push((tip, arc)),
            }
        }
        self.arcs = joined.into_iter().map(|(_, arc)| arc).collect();
        self
    }
}

/// The bend at the end of `arc`, which starts at `tip`.
pub(super) fn bend_after(tip: &Tip, arc: &Arc) -> Vector3<f64> {
    let (sin, cos) = crate::math::sin_cos(arc.curvature_per_mm * arc.length_mm);
    arc.bend * cos - tip.heading * sin
}
