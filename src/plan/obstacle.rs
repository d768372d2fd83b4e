//! Obstacles and the distance to them.

use super::mask::Mask;
use crate::geometry::{POSITION, Pose, Twist};
use crate::keys::section;
use nalgebra::Vector3;

/// The distance to obstacles on a way between two poses is computed at points at most this far apart, mm …
const WAY_SPACING_MM: f64 = 0.25;
/// … but at no more points than this.
const WAY_POINTS_MAX: f64 = 1000.0;

/// Something that the needle must not come near. Lengths in mm, plane frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Obstacle {
    /// A ball.
    Sphere {
        /// Its centre.
        centre_mm: Vector3<f64>,
        /// Its radius.
        radius_mm: f64,
    },
    /// A cylinder with flat ends.
    Cylinder {
        /// The middle of one end.
        from_mm: Vector3<f64>,
        /// The middle of the other end.
        to_mm: Vector3<f64>,
        /// Its radius.
        radius_mm: f64,
    },
    /// A box along the axes.
    Box {
        /// The corner with the smallest coordinates.
        min_mm: Vector3<f64>,
        /// The corner with the largest coordinates.
        max_mm: Vector3<f64>,
    },
    /// Voxels of an image.
    Mask(Mask),
}

impl Obstacle {
    /// Distance of `point_mm` to the surface, mm, negative inside. It is exact, except that for a mask it is a
    /// lower bound.
    pub fn distance_mm(&self, point_mm: &Vector3<f64>) -> f64 {
        match self {
            Obstacle::Sphere { centre_mm, radius_mm } => (point_mm - centre_mm).norm() - radius_mm,
            Obstacle::Cylinder { from_mm, to_mm, radius_mm } => {
                let length_mm = (to_mm - from_mm).norm();
                // A cylinder of zero length has no axis and acts as a sphere.
                let axis = (to_mm - from_mm).try_normalize(0.0).unwrap_or_default();
                let to_point = point_mm - from_mm;
                let along_mm = to_point.dot(&axis);
                let off_axis_mm = (to_point - axis * along_mm).norm();
                // In the half plane through its axis and the point, the cylinder is a rectangle.
                signed_distance([
                    off_axis_mm - radius_mm,
                    (along_mm - 0.5 * length_mm).abs() - 0.5 * length_mm,
                ])
            }
            Obstacle::Box { min_mm, max_mm } => {
                let over = (min_mm - point_mm).sup(&(point_mm - max_mm));
                signed_distance(over.into())
            }
            Obstacle::Mask(mask) => mask.distance_mm(point_mm),
        }
    }

    /// The corners of a box along the axes that contains the obstacle, mm.
    fn bounds_mm(&self) -> [Vector3<f64>; 2] {
        let around = |a: &Vector3<f64>, b: &Vector3<f64>, mm: f64| {
            [a.inf(b).add_scalar(-mm), a.sup(b).add_scalar(mm)]
        };
        match self {
            Obstacle::Sphere { centre_mm, radius_mm } => around(centre_mm, centre_mm, *radius_mm),
            Obstacle::Cylinder { from_mm, to_mm, radius_mm } => around(from_mm, to_mm, *radius_mm),
            Obstacle::Box { min_mm, max_mm } => [*min_mm, *max_mm],
            Obstacle::Mask(mask) => {
                let half_mm = 0.5 * mask.spacing_mm().norm();
                let centres = mask.occupied_mm().map(|mm| around(&mm, &mm, half_mm));
                let empty = [f64::INFINITY, f64::NEG_INFINITY].map(Vector3::repeat);
                centres.fold(empty, |all, one| [all[0].inf(&one[0]), all[1].sup(&one[1])])
            }
        }
    }
}

/// Signed distance to a box, negative inside. For each coordinate, `over` is how far the point is past the nearer
/// end of the box's interval, negative within it.
fn signed_distance<const N: usize>(over: [f64; N]) -> f64 {
    let squared: f64 = over.iter().map(|over| over.max(0.0).powi(2)).sum();
    if squared > 0.0 { squared.sqrt() } else { over.into_iter().fold(f64::NEG_INFINITY, f64::max) }
}

/// Within this distance of the start the tip may be outside the workspace, mm: the start may lie on a wall, and the
/// first positions and estimates scatter about it.
const START_ROOM_MM: f64 = 3.0;

section! {
    /// A box that the tip never leaves, except near the start of a run. Lengths are in mm.
    #[derive(Copy)]
    pub struct Workspace {
        /// The corner with the smallest coordinates.
        min_mm as "min": Vector3<f64> [POSITION];
        /// The corner with the largest coordinates.
        max_mm as "max": Vector3<f64> [POSITION];
    }
    beside {
        /// The tip at the start of a run and where its path starts, mm: what is near the line between them counts as
        /// inside.
        pub start_mm: Option<[Vector3<f64>; 2]> = None,
    }
}

impl Workspace {
    /// How far `point_mm` is inside, mm: at most the distance to the boundary. Negative outside, where the
    /// distance to the workspace may be larger. A point with a NaN is outside.
    pub fn depth_mm(&self, point_mm: &Vector3<f64>) -> f64 {
        // `inf` and `min` ignore NaN.
        if point_mm.iter().any(|mm| mm.is_nan()) {
            return f64::NEG_INFINITY;
        }
        let depth_mm = (point_mm - self.min_mm).inf(&(self.max_mm - point_mm)).min();
        let of_start_mm = |start_mm| START_ROOM_MM - distance_to_line_mm(point_mm, start_mm);
        self.start_mm.map_or(depth_mm, |start_mm| depth_mm.max(of_start_mm(start_mm)))
    }

    /// A lower bound of the distance of `obstacle` to the places where the tip may be, mm; 0 if they meet.
    pub fn outside_mm(&self, obstacle: &Obstacle) -> f64 {
        let [low_mm, high_mm] = obstacle.bounds_mm();
        let gap_mm = (low_mm - self.max_mm).sup(&(self.min_mm - high_mm));
        (gap_mm.sup(&Vector3::zeros()).norm() - START_ROOM_MM).max(0.0)
    }

    /// Lets a run begin with the tip at `tip_mm` and its path at `path_mm`, unless the tip is too far outside.
    pub(super) fn begin_at(&mut self, tip_mm: Vector3<f64>, path_mm: Vector3<f64>) {
        if (Workspace { start_mm: None, ..*self }).depth_mm(&tip_mm) >= -START_ROOM_MM {
            self.start_mm = Some([tip_mm, path_mm]);
        }
    }

    /// The corners of the bounding box, with the room around the start, mm.
    pub(super) fn bounds_mm(&self) -> [Vector3<f64>; 2] {
        let room = Vector3::repeat(START_ROOM_MM);
        let [low_mm, high_mm] = match self.start_mm {
            Some([tip_mm, path_mm]) => [tip_mm.inf(&path_mm) - room, tip_mm.sup(&path_mm) + room],
            None => [self.min_mm, self.max_mm],
        };
        [self.min_mm.inf(&low_mm), self.max_mm.sup(&high_mm)]
    }
}

/// Distance of a point from the line between two others, mm.
fn distance_to_line_mm(point_mm: &Vector3<f64>, [from_mm, to_mm]: [Vector3<f64>; 2]) -> f64 {
    let line = to_mm - from_mm;
    // The line may have no length.
    let length2_mm2 = line.norm_squared().max(f64::MIN_POSITIVE);
    let share = ((point_mm - from_mm).dot(&line) / length2_mm2).clamp(0.0, 1.0);
    (point_mm - from_mm - line * share).norm()
}

/// Obstacles in a workspace.
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    /// The obstacles.
    pub obstacles: Vec<Obstacle>,
    /// Where the tip may be.
    pub workspace: Workspace,
}

impl World {
    /// Distance of `point_mm` to the nearest obstacle, mm, negative inside; infinite without obstacles.
    pub fn distance_mm(&self, point_mm: &Vector3<f64>) -> f64 {
        let distances = self.obstacles.iter().map(|obstacle| obstacle.distance_mm(point_mm));
        distances.fold(f64::INFINITY, f64::min)
    }

    /// The least distance of the tip to an obstacle, mm, on its way `from` one pose `to` another with a constant twist,
    /// which is the motion of a needle whose base turns at a constant rate per mm.
    pub fn distance_on_way_mm(&self, from: &Pose, to: &Pose) -> f64 {
        let twist = (from.inverse() * *to).log();
        let points = (twist.v.norm() / WAY_SPACING_MM).ceil().clamp(1.0, WAY_POINTS_MAX) as u32;
        let passed = (0..points).map(|point| {
            let fraction = f64::from(point) / f64::from(points);
            let passed = Twist { v: twist.v * fraction, w: twist.w * fraction };
            self.distance_mm(&(*from * Pose::exp(&passed)).translation)
        });
        passed.fold(self.distance_mm(&to.translation), f64::min)
    }

    /// How far the tip may go from `point_mm` in any direction, mm, before it leaves the workspace or
    /// comes nearer than `clearance_mm` to an obstacle; negative where the tip must not be.
    pub fn slack_mm(&self, point_mm: &Vector3<f64>, clearance_mm: f64) -> f64 {
        (self.distance_mm(point_mm) - clearance_mm).min(self.workspace.depth_mm(point_mm))
    }

    /// The slack without masks. It grows by at most the distance from `point_mm` to another point. With masks it
    /// may grow by more, because the distance to a mask jumps between voxels.
    pub fn slack_upper_bound_mm(&self, point_mm: &Vector3<f64>, clearance_mm: f64) -> f64 {
        let is_exact = |obstacle: &&Obstacle| !matches!(obstacle, Obstacle::Mask(_));
        let exact = self.obstacles.iter().filter(is_exact);
        let distances = exact.map(|obstacle| obstacle.distance_mm(point_mm));
        let distance_mm = distances.fold(f64::INFINITY, f64::min);
        (distance_mm - clearance_mm).min(self.workspace.depth_mm(point_mm))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    /// Half a circle of 10 mm about the centre of a ball, and a straight past one.
    #[test]
    fn the_distance_on_a_way_is_that_of_its_nearest_point() {
        let past_ball_at = |centre_mm| {
            let everywhere = Vector3::repeat(f64::INFINITY);
            World {
                obstacles: vec![Obstacle::Sphere { centre_mm, radius_mm: 1.0 }],
                workspace: Workspace { min_mm: -everywhere, max_mm: everywhere, start_mm: None },
            }
        };
        let start = Pose::identity();
        let half_circle = Twist { v: Vector3::z() * 9.9 * PI, w: -Vector3::x() * 0.99 * PI };
        let distance_mm =
            past_ball_at(Vector3::y() * 10.0).distance_on_way_mm(&start, &Pose::exp(&half_circle));
        assert!((distance_mm - 9.0).abs() < 1e-9, "{distance_mm}");
        let world = past_ball_at(Vector3::new(3.0, 0.0, 5.0));
        let end = Pose { translation: Vector3::z() * 10.0, ..start };
        assert!((world.distance_on_way_mm(&start, &end) - 2.0).abs() < 1e-9);
        assert_eq!(world.distance_on_way_mm(&start, &start), world.distance_mm(&Vector3::zeros()));
    }

    fn point(reach_mm: f64) -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-reach_mm..reach_mm).prop_map(Vector3::from)
    }

    fn cylinder() -> impl Strategy<Value = Obstacle> {
        (point(20.0), point(20.0), 0.5..10.0f64)
            .prop_filter("a length", |(from, to, _)| (to - from).norm() > 0.1)
            .prop_map(|(from_mm, to_mm, radius_mm)| Obstacle::Cylinder {
                from_mm,
                to_mm,
                radius_mm,
            })
    }

    fn obstacle() -> impl Strategy<Value = Obstacle> {
        let sphere = (point(20.0), 0.5..15.0f64)
            .prop_map(|(centre_mm, radius_mm)| Obstacle::Sphere { centre_mm, radius_mm });
        let box_ = (point(20.0), point(20.0))
            .prop_map(|(a, b)| Obstacle::Box { min_mm: a.inf(&b), max_mm: a.sup(&b) });
        prop_oneof![sphere, cylinder(), box_]
    }

    proptest! {
        /// `plan` refuses targets without a search by this bound. The mask's voxels are larger than a step.
        #[test]
        fn no_point_near_has_more_slack_than_the_bound(
            other in obstacle(), p in point(25.0), step in point(5.0),
        ) {
            let spacing_mm = Vector3::repeat(8.0);
            let mask = Mask::new([3, 3, 3], spacing_mm, &[true; 27], &Pose::identity()).unwrap();
            let workspace = Workspace {
                min_mm: Vector3::repeat(-20.0),
                max_mm: Vector3::repeat(20.0),
                start_mm: None,
            };
            let world = World { obstacles: vec![other, Obstacle::Mask(mask)], workspace };
            let bound_mm = world.slack_upper_bound_mm(&p, 2.0) + step.norm();
            prop_assert!(world.slack_mm(&(p + step), 2.0) <= bound_mm + 1e-9);
        }

        /// A distance changes by at most the step, and following its slope leads to the surface.
        #[test]
        fn distances_are_exact(obstacle in obstacle(), p in point(60.0), step in point(5.0)) {
            let d = |p: &Vector3<f64>| obstacle.distance_mm(p);
            let here_mm = d(&p);
            prop_assert!((d(&(p + step)) - here_mm).abs() <= step.norm() + 1e-9);
            let h = 1e-6;
            let slope = Vector3::from_fn(|i, _| {
                let step = Vector3::ith(i, h);
                (d(&(p + step)) - d(&(p - step))) / (2.0 * h)
            });
            // The slope is 1 except where two surfaces are equally near.
            if (slope.norm() - 1.0).abs() < 1e-6 {
                prop_assert!(d(&(p - slope * here_mm)).abs() < 1e-4, "{here_mm}");
            } else {
                prop_assert!(slope.norm() < 1.0 + 1e-6);
            }
        }

        #[test]
        fn a_cylinder_is_the_same_with_its_ends_swapped(cylinder in cylinder(), p in point(60.0)) {
            let Obstacle::Cylinder { from_mm, to_mm, radius_mm } = cylinder.clone() else { return Ok(()) };
            let other = Obstacle::Cylinder { from_mm: to_mm, to_mm: from_mm, radius_mm };
            prop_assert!((cylinder.distance_mm(&p) - other.distance_mm(&p)).abs() < 1e-9);
        }
    }

    #[test]
    fn distances_equal_those_found_by_hand() {
        let at = Vector3::new;
        let cylinder = Obstacle::Cylinder {
            from_mm: at(0.0, 0.0, 0.0),
            to_mm: at(0.0, 0.0, 10.0),
            radius_mm: 2.0,
        };
        assert_eq!(cylinder.distance_mm(&at(5.0, 0.0, 5.0)), 3.0);
        assert_eq!(cylinder.distance_mm(&at(0.0, 0.0, 13.0)), 3.0, "flat ends");
        assert_eq!(cylinder.distance_mm(&at(5.0, 0.0, 14.0)), 5.0, "the rim");
        assert_eq!(cylinder.distance_mm(&at(0.0, 1.5, 5.0)), -0.5);
        let [from_mm, to_mm] = [at(1e-200, 0.0, 0.0), at(0.0, 0.0, 0.0)];
        let flat = Obstacle::Cylinder { from_mm, to_mm, radius_mm: 2.0 };
        assert_eq!(flat.distance_mm(&at(0.0, 5.0, 0.0)), 3.0, "too short for an axis");
        let box_ = Obstacle::Box { min_mm: at(-1.0, -2.0, -3.0), max_mm: at(1.0, 2.0, 3.0) };
        assert_eq!(box_.distance_mm(&at(4.0, 6.0, 0.0)), 5.0);
        assert_eq!(box_.distance_mm(&at(0.0, 0.0, 1.0)), -1.0);
        let [min_mm, max_mm] = [at(0.0, 0.0, 0.0), at(10.0, 10.0, 10.0)];
        let workspace = Workspace { min_mm, max_mm, start_mm: None };
        let world = World { obstacles: vec![], workspace };
        assert_eq!(world.distance_mm(&at(5.0, 5.0, 5.0)), f64::INFINITY);
        assert_eq!(world.slack_mm(&at(5.0, 9.0, 5.0), 2.0), 1.0, "walls need no clearance");
        assert_eq!(world.slack_mm(&at(5.0, 11.0, 5.0), 2.0), -1.0);
        assert_eq!(world.slack_mm(&at(5.0, f64::NAN, 5.0), 2.0), f64::NEG_INFINITY);
    }

    #[test]
    fn room_beyond_a_wall_is_at_the_start_alone() {
        let at = Vector3::new;
        let [min_mm, max_mm] = [at(0.0, 0.0, 0.0), at(10.0, 10.0, 10.0)];
        let start_mm = Some([at(5.0, 5.0, 0.0); 2]);
        let workspace = Workspace { min_mm, max_mm, start_mm };
        assert_eq!(workspace.depth_mm(&at(5.0, 5.0, -2.0)), 1.0);
        assert_eq!(workspace.depth_mm(&at(5.0, 5.0, -4.0)), -1.0);
        assert_eq!(workspace.depth_mm(&at(9.0, 5.0, -2.0)), 3.0 - 20f64.sqrt(), "to the ball");
        assert_eq!(workspace.depth_mm(&at(5.0, 11.0, 9.0)), -1.0);
        assert_eq!(workspace.bounds_mm(), [at(0.0, 0.0, -3.0), max_mm]);

        let mut aside = workspace;
        aside.begin_at(at(1.0, 5.0, -0.5), at(5.0, 5.0, -0.5));
        assert_eq!(aside.depth_mm(&at(3.0, 5.0, -2.5)), 1.0, "between the tip and its path");
        assert_eq!(aside.depth_mm(&at(1.0, 5.0, -2.5)), 1.0);
        let mut too_far = workspace;
        too_far.begin_at(at(1.0, 5.0, -3.5), at(5.0, 5.0, -3.5));
        assert_eq!(too_far, workspace);
    }
}
