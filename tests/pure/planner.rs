//! The planner against an exhaustive search, in planar scenes of circles and rectangles.

use crate::support::program::repository;
use nalgebra::Vector3;
use needle_bench::plan::{Obstacle, Problem, Status, Tip, Workspace, World, plan};
use serde_json::Value;

const SIDE_MM: f64 = 150.0;
const RADIUS_MM: f64 = 50.0;
const CLEARANCE_MM: f64 = 2.0;
const TOLERANCE_MM: f64 = 3.0;
/// The longest path that the search allows.
const LENGTH_MAX_MM: f64 = 300.0;
/// A path may be this much longer than the shortest of the exhaustive search.
const LONGER_MAX: f64 = 1.05;
/// The obstacles of a planar scene extend this far out of the plane.
const FAR_MM: f64 = 1000.0;

fn scenes(file: &str) -> Vec<Value> {
    let path = repository(&format!("tests/data/planner-scenes/{file}"));
    let scenes: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    scenes["scenes"].as_array().unwrap().clone()
}

fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("{key} in {value}"))
}

/// The scene's x and y are the planner's y and z.
fn obstacle(obstacle: &Value) -> Obstacle {
    let number = |key| number(obstacle, key);
    match obstacle["type"].as_str() {
        Some("circle") => Obstacle::Cylinder {
            from_mm: Vector3::new(-FAR_MM, number("x_mm"), number("y_mm")),
            to_mm: Vector3::new(FAR_MM, number("x_mm"), number("y_mm")),
            radius_mm: number("radius_mm"),
        },
        _ => Obstacle::Box {
            min_mm: Vector3::new(-FAR_MM, number("x_min_mm"), number("y_min_mm")),
            max_mm: Vector3::new(FAR_MM, number("x_max_mm"), number("y_max_mm")),
        },
    }
}

/// Distance of (y, z) to an obstacle of the scene, computed independently of the planner.
fn distance_mm(obstacle: &Value, point: &Vector3<f64>) -> f64 {
    let number = |key| number(obstacle, key);
    match obstacle["type"].as_str() {
        Some("circle") => {
            (point.y - number("x_mm")).hypot(point.z - number("y_mm")) - number("radius_mm")
        }
        _ => {
            let y = point.y.clamp(number("x_min_mm"), number("x_max_mm"));
            let z = point.z.clamp(number("y_min_mm"), number("y_max_mm"));
            (point.y - y).hypot(point.z - z)
        }
    }
}

/// Checks the planner's answer to a scene, and gives it as a line of the table.
fn line(scene: &Value) -> String {
    let obstacles = scene["obstacles"].as_array().unwrap();
    let workspace = Workspace {
        min_mm: Vector3::new(-1.0, 0.0, 0.0),
        max_mm: Vector3::new(1.0, SIDE_MM, SIDE_MM),
        start_mm: None,
    };
    let world = World { obstacles: obstacles.iter().map(obstacle).collect(), workspace };
    let heading_rad = number(&scene["start"], "heading_rad");
    let place = |at: &Value| Vector3::new(0.0, number(at, "x_mm"), number(at, "y_mm"));
    let problem = Problem {
        start: Tip {
            position_mm: place(&scene["start"]),
            heading: Vector3::new(0.0, heading_rad.cos(), heading_rad.sin()),
        },
        target_mm: place(&scene["goal"]),
        tolerance_mm: TOLERANCE_MM,
        curvature_per_mm: 1.0 / RADIUS_MM,
        clearance_mm: CLEARANCE_MM,
        length_max_mm: LENGTH_MAX_MM,
        in_plane: true,
        expansions_max: 2_000_000,
    };
    let answer = plan(&world, &problem);
    let name = scene["name"].as_str().unwrap();
    let exhaustive_mm = scene["exhaustive_search"]["length_mm"].as_f64();
    let expected = if exhaustive_mm.is_some() { Status::Plan } else { Status::None };
    assert_eq!(answer.status, expected, "{name}: {:?}", answer.reason);
    let (Some(path), Some(exhaustive_mm)) = (answer.path, exhaustive_mm) else {
        let reason = answer.reason.expect("a reason");
        return format!("{name:20} none  {:>7}  {reason}\n", answer.expansions);
    };
    let (length_mm, error_mm) =
        (path.length_mm(), (path.end().position_mm - problem.target_mm).norm());
    let ratio = length_mm / exhaustive_mm;
    assert!(ratio <= LONGER_MAX, "{name}: {length_mm} mm, exhaustive {exhaustive_mm}");
    assert!(error_mm <= TOLERANCE_MM, "{name}");
    let points = path.points_mm(0.5);
    assert!((points[0] - problem.start.position_mm).norm() < 1e-9);
    let mut clearance_mm = f64::INFINITY;
    for point in &points {
        assert!(point.x.abs() < 1e-9 && point.y.clamp(0.0, SIDE_MM) == point.y, "{name}");
        assert!(point.z.clamp(0.0, SIDE_MM) == point.z, "{name}");
        let nearest = obstacles.iter().map(|obstacle| distance_mm(obstacle, point));
        clearance_mm = nearest.fold(clearance_mm, f64::min);
    }
    assert!(clearance_mm >= CLEARANCE_MM - 1e-3, "{name}: {clearance_mm}");
    assert!((path.distance_mm(&world) - clearance_mm).abs() < 0.05, "{name}: {clearance_mm}");
    // Over half a millimetre the path turns no more than the tightest circle does.
    let steps: Vec<Vector3<f64>> = points.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let heading = problem.start.heading;
    assert!(steps[0].angle(&heading) <= 0.25 / RADIUS_MM + 1e-6, "{name}: the first heading");
    for pair in steps[..steps.len() - 1].windows(2) {
        assert!(pair[0].angle(&pair[1]) <= 0.5 / RADIUS_MM + 1e-6, "{name}: {}", pair[0]);
    }
    format!(
        "{name:20} plan  {:>7}  {length_mm:6.1} mm, ratio {ratio:.3}, off {error_mm:.2} mm, \
         clearance {clearance_mm:5.2} mm, {} arcs\n",
        answer.expansions,
        path.arcs.len()
    )
}

#[test]
fn the_scenes_are_solved_like_the_exhaustive_search() {
    let table: String = scenes("scenes.json").iter().map(line).collect();
    insta::assert_snapshot!(table);
}

/// `exhaustive.py` made these scenes and searched them.
#[test]
fn scenes_at_random_are_solved_like_the_exhaustive_search() {
    let table: String = scenes("random.json").iter().map(line).collect();
    insta::assert_snapshot!(table);
}
