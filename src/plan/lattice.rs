//! The lattice that a search expands: short arcs, and cells that are visited once.

use super::arc::{Arc, Chord, Tip};
use super::obstacle::Workspace;
use super::problem::Problem;
use crate::math;
use nalgebra::Vector3;
use std::f64::consts::TAU;

/// Turn of one arc of a path in the plane, rad.
const TURN_RAD: f64 = 0.02;
/// Shortest and longest such arc, mm.
const STEP_MM: [f64; 2] = [0.5, 2.0];
/// Side of a cell in the plane, mm.
const CELL_MM: f64 = 0.5;
/// Memory for the visited cells, bits: 128 MiB.
const BITS_MAX: f64 = (1u64 << 30) as f64;

/// The resolution of a search: its cells and headings, and the length of its arcs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resolution {
    /// Length of an arc, mm.
    pub step_mm: f64,
    /// Side of a cell, mm.
    pub cell_mm: f64,
    /// Angle between two headings, rad.
    pub heading_rad: f64,
}

/// From each tip, arcs of one length lead on: a straight one, and bent ones of one curvature. The places that they
/// reach are sorted into cells of position and heading.
#[derive(Debug)]
pub(super) struct Lattice {
    pub(super) resolution: Resolution,
    /// True if the cells are larger than intended, to fit into [`BITS_MAX`].
    pub(super) is_coarse: bool,
    pub(super) in_plane: bool,
    curvature_per_mm: f64,
    /// The chord of one step at full curvature.
    chord: Chord,
    first_mm: Vector3<f64>,
    counts: [usize; 3],
    /// Number of headings: in the plane around the circle; in space along an edge of a cube of directions.
    headings: usize,
    pub(super) visited: Visited,
}

/// A set of cells. Searches reuse its memory.
#[derive(Debug, Clone, Default)]
pub(super) struct Visited {
    words: Vec<u64>,
    /// Indices of the words that are not 0.
    touched: Vec<u32>,
}

impl Visited {
    /// The empty set, with room for `cells`.
    fn cleared(mut self, cells: usize) -> Self {
        for word in self.touched.drain(..) {
            self.words[word as usize] = 0;
        }
        let words = cells.div_ceil(64);
        if self.words.len() < words {
            // New pages are zero already; growing the old vector would copy them.
            self.words = vec![0; words];
        }
        self
    }

    /// True if the set has this cell.
    pub(super) fn contains(&self, cell: usize) -> bool {
        self.words[cell / 64] & 1 << (cell % 64) != 0
    }

    /// Adds a cell; true if it is new.
    pub(super) fn insert(&mut self, cell: usize) -> bool {
        let is_new = !self.contains(cell);
        let word = &mut self.words[cell / 64];
        if *word == 0 {
            self.touched.push((cell / 64) as u32);
        }
        *word |= 1 << (cell % 64);
        is_new
    }
}

/// Number of the straight arc; those from 1 on are bent, one for each direction.
pub(super) const STRAIGHT: u8 = 0;
/// Directions of bending in space.
const BENDS: u8 = 8;

/// A place on the lattice.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) tip: Tip,
    /// In the plane: number of arcs to the left minus number of arcs to the right.
    turns: i32,
}

impl Lattice {
    /// The lattice of a search for `problem`. In the plane there is only one resolution; in space, `level` 0 is the
    /// coarsest.
    pub(super) fn new(
        workspace: &Workspace,
        problem: &Problem,
        level: usize,
        visited: Visited,
    ) -> Self {
        let Problem { curvature_per_mm, in_plane, .. } = *problem;
        let (step_mm, mut cell_mm, headings) = match in_plane {
            true => {
                let step_mm = (TURN_RAD / curvature_per_mm).clamp(STEP_MM[0], STEP_MM[1]);
                let headings = (TAU / (curvature_per_mm * step_mm)).round();
                (step_mm, CELL_MM, headings as usize)
            }
            false => LEVELS[level.min(LEVELS.len() - 1)],
        };
        let heading_rad = match in_plane {
            true => TAU / headings as f64,
            false => 0.25 * TAU / headings as f64,
        };
        let bounds_mm = |[mut first_mm, mut last_mm]: [Vector3<f64>; 2]| {
            if in_plane {
                (first_mm.x, last_mm.x) = (0.0, 0.0);
            }
            (first_mm, last_mm - first_mm)
        };
        let all_headings = if in_plane { headings } else { 6 * headings * headings };
        let counts = |extent_mm: Vector3<f64>, cell_mm: f64| {
            extent_mm.map(|mm| (mm / cell_mm).floor() + 1.0)
        };
        let is_too_large = |extent_mm, cell_mm| {
            counts(extent_mm, cell_mm).product() * all_headings as f64 > BITS_MAX
        };
        let [low_mm, high_mm] = workspace.bounds_mm();
        let (mut first_mm, mut extent_mm) = bounds_mm([low_mm, high_mm]);
        if is_too_large(extent_mm, cell_mm) {
            let [down_mm, up_mm] = problem.reach_mm();
            let (low_mm, high_mm) = (low_mm.sup(&down_mm), high_mm.inf(&up_mm));
            (first_mm, extent_mm) = bounds_mm([low_mm, high_mm.sup(&low_mm)]);
        }
        let is_coarse = is_too_large(extent_mm, cell_mm);
        while is_too_large(extent_mm, cell_mm) {
            cell_mm *= 1.25;
        }
        let counts: [usize; 3] = counts(extent_mm, cell_mm).map(|count| count as usize).into();
        let cells = counts.iter().product::<usize>() * all_headings;
        Lattice {
            resolution: Resolution { step_mm, cell_mm, heading_rad },
            is_coarse,
            in_plane,
            curvature_per_mm,
            chord: Chord::of(curvature_per_mm, step_mm),
            first_mm,
            counts,
            headings,
            visited: visited.cleared(cells),
        }
    }

    pub(super) fn start(&self, tip: Tip) -> Place {
        Place { tip, turns: 0 }
    }

    /// The number of arcs that lead on from a place.
    pub(super) fn arcs(&self) -> u8 {
        1 + if self.in_plane { 2 } else { BENDS }
    }

    /// Where arc number `arc_number` ends. `previous_heading` is the heading at the start of the arc that led here.
    pub(super) fn next(
        &self,
        from: &Place,
        previous_heading: Option<Vector3<f64>>,
        arc_number: u8,
    ) -> Place {
        let Tip { position_mm, heading } = from.tip;
        if arc_number == STRAIGHT {
            let position_mm = position_mm + heading * self.resolution.step_mm;
            return Place { tip: Tip { position_mm, heading }, ..*from };
        }
        let bend = self.bend(&from.tip, previous_heading, arc_number);
        let tip = from.tip.at_end_of(&self.chord, &bend);
        Place { tip, turns: from.turns + if arc_number == 1 { 1 } else { -1 } }
    }

    /// Arc number `arc_number` from `tip`.
    pub(super) fn arc(
        &self,
        tip: &Tip,
        previous_heading: Option<Vector3<f64>>,
        arc_number: u8,
    ) -> Arc {
        let curvature_per_mm = if arc_number == STRAIGHT { 0.0 } else { self.curvature_per_mm };
        let length_mm = self.resolution.step_mm;
        Arc { bend: self.bend(tip, previous_heading, arc_number), curvature_per_mm, length_mm }
    }

    fn bend(
        &self,
        tip: &Tip,
        previous_heading: Option<Vector3<f64>>,
        arc_number: u8,
    ) -> Vector3<f64> {
        let heading = tip.heading;
        if self.in_plane {
            // The heading turned by 90 degrees about the plane's normal.
            let left = Vector3::new(0.0, -heading.z, heading.y);
            return if arc_number == 2 { -left } else { left };
        }
        // The first direction continues the bend of the arc that led here.
        let first = previous_heading.map(|previous| heading * self.chord.cos - previous);
        let first = first.and_then(|bend| bend.try_normalize(1e-6));
        let first = first.unwrap_or_else(|| tip.across()[0]);
        let (sin, cos) = math::sin_cos(TAU * f64::from(arc_number.max(1) - 1) / f64::from(BENDS));
        (first * cos + heading.cross(&first) * sin).normalize()
    }

    /// The number of the cell of `place`.
    pub(super) fn cell(&self, place: &Place) -> usize {
        let mut cell = 0;
        for i in (0..3).rev() {
            let index = (place.tip.position_mm[i] - self.first_mm[i]) / self.resolution.cell_mm;
            cell = cell * self.counts[i] + (index as usize).min(self.counts[i] - 1);
        }
        match self.in_plane {
            true => cell * self.headings + place.turns.rem_euclid(self.headings as i32) as usize,
            false => {
                cell * 6 * self.headings * self.headings
                    + cube_cell(&place.tip.heading, self.headings)
            }
        }
    }
}

/// Resolutions of a search in space, the coarsest first: length of an arc and side of a cell, mm, and headings
/// along an edge of the cube.
pub(super) const LEVELS: [(f64, f64, usize); 3] = [(12.0, 5.0, 6), (6.0, 3.0, 10), (3.0, 2.0, 16)];

/// The number of the cell of a heading, if each face of a cube of directions is divided into `divisions` ×
/// `divisions` squares.
fn cube_cell(heading: &Vector3<f64>, divisions: usize) -> usize {
    let axis = heading.iamax();
    let face = 2 * axis + usize::from(heading[axis] < 0.0);
    let square = |coordinate: f64| {
        let part = 0.5 + 0.5 * coordinate / heading[axis].abs();
        ((part * divisions as f64) as usize).min(divisions - 1)
    };
    let (u, v) = (heading[(axis + 1) % 3], heading[(axis + 2) % 3]);
    (face * divisions + square(u)) * divisions + square(v)
}
