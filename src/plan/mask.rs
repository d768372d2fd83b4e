//! An obstacle given as the voxels of an image.

use crate::geometry::Pose;
use nalgebra::Vector3;
use std::ops::RangeInclusive;
use std::sync::Arc;

/// The signed distance field of occupied voxels. Clones share it.
#[derive(Debug, Clone, PartialEq)]
pub struct Mask {
    /// The plane frame P in the frame G of the grid, whose origin is the centre of voxel (0, 0, 0).
    x_gp: Pose,
    size: [usize; 3],
    spacing_mm: Vector3<f64>,
    /// Distance of each voxel's centre from the surface, mm, negative inside; the first coordinate runs fastest.
    distances_mm: Arc<[f32]>,
}

impl Mask {
    /// The most voxels that a mask may have: 256 in each direction.
    pub const VOXELS_MAX: usize = 1 << 24;
    /// Allowed spacing of the voxels. A header with a smaller one is not in mm.
    const SPACING_MM: RangeInclusive<f32> = 0.01..=100.0;

    /// The mask of `size` voxels, `spacing_mm` apart. `occupied` says which voxels are occupied, with the first
    /// coordinate running fastest. `x_pg` is `X_PG`, the pose of the grid in the plane frame.
    ///
    /// # Errors
    /// Those of [`Mask::voxel_count`], or `occupied` does not have one value for each voxel.
    pub fn new(
        size: [usize; 3],
        spacing_mm: Vector3<f64>,
        occupied: &[bool],
        x_pg: &Pose,
    ) -> Result<Self, String> {
        let voxels = Self::voxel_count(size, &spacing_mm)?;
        if occupied.len() != voxels {
            let [x, y, z] = size;
            let values = occupied.len();
            return Err(format!("the mask has {values} values for {x} x {y} x {z} voxels"));
        }
        let spacing = spacing_mm.into();
        let to_occupied = distances_mm(size, spacing, |voxel| occupied[voxel]);
        let to_free = distances_mm(size, spacing, |voxel| !occupied[voxel]);
        // Everything beyond the grid is free.
        let to_border = |voxel: usize| {
            let indices = [voxel % size[0], voxel / size[0] % size[1], voxel / size[0] / size[1]];
            let voxels = |i: usize| (indices[i] + 1).min(size[i] - indices[i]) as f64;
            (0..3).map(|i| voxels(i) * spacing_mm[i]).fold(f64::INFINITY, f64::min) as f32
        };
        let distances_mm =
            to_occupied.iter().zip(&to_free).enumerate().map(|(voxel, (out, inside))| {
                if *out > 0.0 { *out } else { -inside.min(to_border(voxel)) }
            });
        Ok(Mask { x_gp: x_pg.inverse(), size, spacing_mm, distances_mm: distances_mm.collect() })
    }

    /// Checks the `size` and the spacing of a mask, and returns its number of voxels.
    ///
    /// # Errors
    /// There are too many voxels or none, or the spacing is not between 0.01 and 100 mm.
    pub fn voxel_count(size: [usize; 3], spacing_mm: &Vector3<f64>) -> Result<usize, String> {
        let voxels = size.iter().try_fold(1usize, |product, count| product.checked_mul(*count));
        let voxels = voxels.unwrap_or(usize::MAX);
        if !(1..=Self::VOXELS_MAX).contains(&voxels) {
            let ([x, y, z], max) = (size, Self::VOXELS_MAX);
            return Err(format!(
                "the mask has {x} x {y} x {z} voxels, allowed: 1 to {max} in all; crop or resample it"
            ));
        }
        // The header has single precision.
        let sides_mm = <[f64; 3]>::from(*spacing_mm).map(|mm| mm as f32);
        if !sides_mm.iter().all(|mm| Self::SPACING_MM.contains(mm)) {
            let [x, y, z] = sides_mm;
            return Err(format!(
                "the mask's voxels are {x:?} x {y:?} x {z:?} mm, allowed: {} to {}; set pixdim in its header, in mm",
                Self::SPACING_MM.start(),
                Self::SPACING_MM.end()
            ));
        }
        Ok(voxels)
    }

    /// Distance between two voxels in each direction of the grid, mm.
    pub fn spacing_mm(&self) -> Vector3<f64> {
        self.spacing_mm
    }

    /// The centres of the occupied voxels, plane frame, mm.
    pub fn occupied_mm(&self) -> impl Iterator<Item = Vector3<f64>> + '_ {
        let ([nx, ny, _], x_pg) = (self.size, self.x_gp.inverse());
        let occupied = self.distances_mm.iter().enumerate().filter(|(_, mm)| **mm < 0.0);
        occupied.map(move |(voxel, _)| {
            let indices = [voxel % nx, voxel / nx % ny, voxel / nx / ny];
            let at = Vector3::from(indices.map(|index| index as f64));
            x_pg.transform(&at.component_mul(&self.spacing_mm))
        })
    }

    /// A lower bound of the distance of `point_mm`, plane frame, to the occupied voxels, mm, computed from the
    /// nearest voxel's centre. It is too small by at most one and a half diagonals of a voxel. Negative inside.
    pub fn distance_mm(&self, point_mm: &Vector3<f64>) -> f64 {
        let at = self.x_gp.transform(point_mm).component_div(&self.spacing_mm);
        let last = Vector3::from(self.size.map(|count| (count - 1) as f64));
        // The nearest point among the centres of the grid, and the centre nearest to it.
        let inside = at.sup(&Vector3::zeros()).inf(&last);
        let nearest = inside.map(f64::round);
        let length_mm = |voxels: Vector3<f64>| voxels.component_mul(&self.spacing_mm).norm();
        let (beyond_mm, away_mm) = (length_mm(at - inside), length_mm(inside - nearest));
        let [x, y, z] = nearest.map(|index| index as usize).into();
        let voxel = (z * self.size[1] + y) * self.size[0] + x;
        let bound_mm = f64::from(self.distances_mm[voxel]) - away_mm;
        let bound_mm = match beyond_mm > 0.0 {
            // For a point outside the grid, the angle at `inside` between that point and any centre is 90° or more.
            true => (beyond_mm.powi(2) + bound_mm.max(0.0).powi(2)).sqrt(),
            false => bound_mm,
        };
        bound_mm - 0.5 * self.spacing_mm.norm()
    }
}

/// Farther than any voxel, mm².
const FAR_MM2: f32 = 1e12;

/// Distance from each voxel's centre to the centre of the nearest voxel that `is_in`, mm (Felzenszwalb and
/// Huttenlocher, Distance transforms of sampled functions, 2012: one pass per coordinate).
fn distances_mm(size: [usize; 3], spacing_mm: [f64; 3], is_in: impl Fn(usize) -> bool) -> Vec<f32> {
    let voxels = size.iter().product();
    let mut squared_mm2: Vec<f32> =
        (0..voxels).map(|voxel| if is_in(voxel) { 0.0 } else { FAR_MM2 }).collect();
    let mut stride = 1;
    for (count, spacing_mm) in size.into_iter().zip(spacing_mm) {
        for first in (0..voxels).filter(|voxel| voxel / stride % count == 0) {
            let line_mm2: Vec<f64> =
                (0..count).map(|i| f64::from(squared_mm2[first + i * stride])).collect();
            for (i, mm2) in lowest_mm2(&line_mm2, spacing_mm).into_iter().enumerate() {
                squared_mm2[first + i * stride] = mm2 as f32;
            }
        }
        stride *= count;
    }
    squared_mm2.into_iter().map(f32::sqrt).collect()
}

/// The lowest of the parabolas `line_mm2[k] + (x − x_k)²` at each voxel of a line, mm².
fn lowest_mm2(line_mm2: &[f64], spacing_mm: f64) -> Vec<f64> {
    let position_mm = |voxel: usize| voxel as f64 * spacing_mm;
    let height = |voxel: usize| line_mm2[voxel] + position_mm(voxel) * position_mm(voxel);
    // The voxels whose parabolas form the lower envelope, each with the position from which it is the lowest, mm.
    let mut envelope: Vec<(usize, f64)> = Vec::with_capacity(line_mm2.len());
    for voxel in 0..line_mm2.len() {
        let mut begin_mm = f64::NEG_INFINITY;
        while let Some(&(last, last_begin_mm)) = envelope.last() {
            begin_mm =
                0.5 * (height(voxel) - height(last)) / (position_mm(voxel) - position_mm(last));
            if begin_mm > last_begin_mm {
                break;
            }
            envelope.pop();
            begin_mm = f64::NEG_INFINITY;
        }
        envelope.push((voxel, begin_mm));
    }
    let mut lowest_here = 0;
    let lowest = |voxel: usize| {
        while envelope.get(lowest_here + 1).is_some_and(|(_, begin)| *begin < position_mm(voxel)) {
            lowest_here += 1;
        }
        let (at, _) = envelope[lowest_here];
        line_mm2[at] + (position_mm(voxel) - position_mm(at)).powi(2)
    };
    (0..line_mm2.len()).map(lowest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::FixedAngles;
    use proptest::prelude::*;

    const SIZE: [usize; 3] = [7, 5, 6];
    const SPACING_MM: Vector3<f64> = Vector3::new(1.0, 2.0, 0.5);

    fn centre_mm(voxel: usize) -> Vector3<f64> {
        let [x, y, _] = SIZE;
        Vector3::new((voxel % x) as f64, (voxel / x % y) as f64, (voxel / x / y) as f64)
            .component_mul(&SPACING_MM)
    }

    fn pose() -> Pose {
        let rotation = FixedAngles { yaw: 0.4, pitch: -0.7, roll: 2.0 }.to_rotation();
        Pose { rotation, translation: Vector3::new(3.0, -8.0, 40.0) }
    }

    proptest! {
        #[test]
        fn the_distance_is_a_lower_bound(
            seeds in prop::collection::vec(0..210usize, 1..20),
            at in (-0.5..6.5f64, -1.0..9.0f64, -0.25..2.75f64),
        ) {
            let occupied: Vec<bool> = (0..210).map(|voxel| seeds.contains(&voxel)).collect();
            let mask = Mask::new(SIZE, SPACING_MM, &occupied, &pose()).unwrap();
            let at = Vector3::new(at.0, at.1, at.2);
            let true_mm = seeds
                .iter()
                .map(|&voxel| {
                    let off = (at - centre_mm(voxel)).abs() - 0.5 * SPACING_MM;
                    off.sup(&Vector3::zeros()).norm()
                })
                .fold(f64::INFINITY, f64::min);
            let found_mm = mask.distance_mm(&pose().transform(&at));
            prop_assert!(found_mm <= true_mm + 1e-6, "{found_mm} of {true_mm}");
            prop_assert!(found_mm >= true_mm - 1.5 * SPACING_MM.norm(), "{found_mm} of {true_mm}");
        }

        #[test]
        fn beyond_the_grid_the_bound_holds_as_well(at in prop::array::uniform3(-60.0..60.0f64)) {
            let mask = Mask::new(SIZE, SPACING_MM, &[true; 210], &Pose::identity()).unwrap();
            let high = Vector3::from(SIZE.map(|count| count as f64 - 0.5)).component_mul(&SPACING_MM);
            let over = (-0.5 * SPACING_MM - Vector3::from(at)).sup(&(Vector3::from(at) - high));
            let true_mm = over.sup(&Vector3::zeros()).norm();
            let found_mm = mask.distance_mm(&at.into());
            prop_assert!(found_mm <= true_mm + 1e-6, "{found_mm} of {true_mm}");
            let is_tight = found_mm >= true_mm - 1.5 * SPACING_MM.norm();
            prop_assert!(is_tight || true_mm == 0.0, "{found_mm} of {true_mm}");
        }
    }

    #[test]
    fn distances_between_centres_are_exact() {
        let seeds = [3usize, 77, 150];
        let found = distances_mm(SIZE, SPACING_MM.into(), |voxel| seeds.contains(&voxel));
        for (voxel, found_mm) in found.iter().enumerate() {
            let nearest = seeds.iter().map(|&seed| (centre_mm(seed) - centre_mm(voxel)).norm());
            let nearest_mm = nearest.fold(f64::INFINITY, f64::min);
            assert!((f64::from(*found_mm) - nearest_mm).abs() < 1e-5, "{found_mm} {nearest_mm}");
        }
    }

    #[test]
    fn the_depth_in_a_full_mask_is_that_to_the_edge_of_the_grid() {
        let mask = Mask::new(SIZE, SPACING_MM, &[true; 210], &Pose::identity()).unwrap();
        let depth_mm = -mask.distance_mm(&Vector3::new(3.0, 4.0, 1.5));
        assert!((1.5..4.0).contains(&depth_mm), "{depth_mm}");
    }

    #[test]
    fn an_empty_mask_is_far_away() {
        let mask =
            Mask::new([2, 2, 2], Vector3::repeat(1.0), &[false; 8], &Pose::identity()).unwrap();
        assert!(mask.distance_mm(&Vector3::zeros()) > 1e5);
    }

    #[test]
    fn the_smallest_and_the_largest_voxels_are_allowed() {
        for mm in [0.01f32, 100.0] {
            assert_eq!(Mask::voxel_count([2; 3], &Vector3::repeat(mm.into())), Ok(8));
        }
    }

    #[test]
    fn a_mask_of_impossible_size_is_refused() {
        let refused = |size, spacing: f64, count: usize| {
            let occupied = vec![false; count];
            Mask::new(size, Vector3::repeat(spacing), &occupied, &Pose::identity()).unwrap_err()
        };
        insta::assert_snapshot!(
            [
                refused([2, 2, 2], 0.0, 8),
                refused([2, 2, 2], f64::NAN, 8),
                refused([2, 2, 2], 1.0, 9),
                refused([0, 2, 2], 1.0, 0),
                refused([512, 512, 400], 1.0, 0),
                refused([usize::MAX, 2, 2], 1.0, 0),
            ]
            .join("\n"),
            @r"
        the mask's voxels are 0.0 x 0.0 x 0.0 mm, allowed: 0.01 to 100; set pixdim in its header, in mm
        the mask's voxels are NaN x NaN x NaN mm, allowed: 0.01 to 100; set pixdim in its header, in mm
        the mask has 9 values for 2 x 2 x 2 voxels
        the mask has 0 x 2 x 2 voxels, allowed: 1 to 16777216 in all; crop or resample it
        the mask has 512 x 512 x 400 voxels, allowed: 1 to 16777216 in all; crop or resample it
        the mask has 18446744073709551615 x 2 x 2 voxels, allowed: 1 to 16777216 in all; crop or resample it
        "
        );
    }
}
