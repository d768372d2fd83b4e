//! The picture of a plan, as SVG.

use super::ROW_MM;
use crate::cli::{Failure, Result};
use crate::plan::{Answer, Obstacle, Problem, Tip, World};
use crate::text::screen;
use minijinja::context;
use nalgebra::Vector3;
use serde_json::json;
use std::collections::BTreeSet;

/// Points of the outline of a circle.
const CIRCLE_POINTS: u32 = 48;
/// Smallest side of the squares that show a mask, mm.
const MASK_STEP_MM: f64 = 2.0;

/// Draws the plan as SVG: from the side, y over z, and from above, x over z.
pub(super) fn picture(world: &World, problem: &Problem, answer: &Answer) -> Result<String> {
    let [min, max] = [world.workspace.min_mm, world.workspace.max_mm];
    let path = answer.path.as_ref();
    let points = path.map(|path| path.points_mm(ROW_MM)).unwrap_or_default();
    // z to the right, y or x up.
    let views = [1, 0].map(|up| {
        let place = |point: &Vector3<f64>| json!([point.z - min.z, max[up] - point[up]]);
        let outlines = world.obstacles.iter().flat_map(|obstacle| outlines(obstacle, up));
        json!({
            "axis": if up == 1 { "y" } else { "x" },
            "high_mm": max[up] - min[up],
            "obstacles": outlines
                .map(|outline| outline.iter().map(place).collect::<Vec<_>>())
                .collect::<Vec<_>>(),
            "path": points.iter().map(place).collect::<Vec<_>>(),
            "start": place(&problem.start.position_mm),
            "target": place(&problem.target_mm),
            "nearest": answer.nearest_mm.filter(|_| path.is_none()).as_ref().map(place),
        })
    });
    let object = json!({
        "views": views,
        "wide_mm": max.z - min.z,
        "tolerance_mm": problem.tolerance_mm,
        "status": answer.status.to_string(),
        "length_mm": path.map(|path| path.length_mm()),
    });
    screen(include_str!("picture.svg"), &object, context! {}).map_err(Failure::environment)
}

/// The outlines of an obstacle, seen along x (`up` is y) or along y (`up` is x).
fn outlines(obstacle: &Obstacle, up: usize) -> Vec<Vec<Vector3<f64>>> {
    let circle = |centre: &Vector3<f64>, radius_mm: f64, [first, second]: [Vector3<f64>; 2]| {
        let turn = |i| std::f64::consts::TAU * f64::from(i) / f64::from(CIRCLE_POINTS);
        let point = move |i| centre + (first * turn(i).cos() + second * turn(i).sin()) * radius_mm;
        (0..CIRCLE_POINTS).map(point).collect::<Vec<_>>()
    };
    let points = match obstacle {
        Obstacle::Sphere { centre_mm, radius_mm } => {
            circle(centre_mm, *radius_mm, [Vector3::z(), Vector3::ith(up, 1.0)])
        }
        Obstacle::Cylinder { from_mm, to_mm, radius_mm } => {
            let heading = (to_mm - from_mm).normalize();
            let across = Tip { position_mm: *from_mm, heading }.across();
            [from_mm, to_mm].map(|end| circle(end, *radius_mm, across)).concat()
        }
        Obstacle::Box { min_mm, max_mm } => {
            let corner =
                |i: usize| Vector3::from_fn(|axis, _| [min_mm, max_mm][i >> axis & 1][axis]);
            (0..8).map(corner).collect()
        }
        Obstacle::Mask(mask) => {
            let side_mm = MASK_STEP_MM.max(mask.spacing_mm().max());
            let index = |mm: f64| (mm / side_mm).floor() as i64;
            let squares: BTreeSet<_> =
                mask.occupied_mm().map(|point| (index(point.z), index(point[up]))).collect();
            let outline = |(z, v): (i64, i64)| {
                [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(dz, dv)| {
                    let mm = |index: i64| index as f64 * side_mm;
                    Vector3::z() * mm(z + dz) + Vector3::ith(up, mm(v + dv))
                })
            };
            return squares.into_iter().map(|square| outline(square).to_vec()).collect();
        }
    };
    vec![hull(points, up)]
}

/// The corners of the convex hull of `points` in z and the coordinate `up`, in order.
fn hull(mut points: Vec<Vector3<f64>>, up: usize) -> Vec<Vector3<f64>> {
    points.sort_by(|a, b| a.z.total_cmp(&b.z).then(a[up].total_cmp(&b[up])));
    let mut hull: Vec<Vector3<f64>> = Vec::new();
    let back: Vec<Vector3<f64>> = points.iter().rev().copied().collect();
    for half in [points, back] {
        let first = hull.len();
        for point in half {
            let is_inside = |hull: &[Vector3<f64>]| match hull[first..] {
                [.., a, b] => {
                    (b.z - a.z) * (point[up] - a[up]) <= (b[up] - a[up]) * (point.z - a.z)
                }
                _ => false,
            };
            while is_inside(&hull) {
                hull.pop();
            }
            hull.push(point);
        }
    }
    hull
}
