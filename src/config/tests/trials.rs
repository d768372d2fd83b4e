//! Trials of a study, drawn from the ranges of `[study]`.

use super::*;
use crate::geometry::coordinates;

/// The same seed draws the same trial. A value does not depend on which others are drawn.
#[test]
fn a_trial_is_drawn_within_its_ranges_by_its_seed() {
    let ranges = ["study.curvature_error=[-0.3, 0.3]", "study.torsion_half_width_deg=[30, 50]"];
    let plain = loaded("", &[]);
    let wide = loaded("", &ranges);
    for seed in 0..50 {
        let drawn = wide.drawn(seed).unwrap();
        assert_eq!(drawn, wide.drawn(seed).unwrap());
        assert_eq!(drawn.emulator.start, plain.drawn(seed).unwrap().emulator.start);
        assert_eq!((drawn.emulator.seed, &drawn.needle), (seed, &wide.needle));
        let start = drawn.emulator.start;
        assert!(
            start.translation.x.abs() <= 8.0
                && coordinates(&start)[4].abs() <= 11.5f64.to_radians() + 1e-12
                && start.translation.z == 0.0
        );
        let error = drawn.emulator.arc.curvature_per_mm() * 122.0 - 1.0;
        assert!(error.abs() <= 0.3 && error != 0.0, "{error}");
        assert!((30.0..=50.0).contains(&drawn.number("emulator.torsion.half_width_deg")));
        assert_eq!(loaded(&drawn.to_toml().unwrap(), &[]), drawn);
    }
    assert_ne!(wide.drawn(1).unwrap().emulator, wide.drawn(2).unwrap().emulator);
}

/// This keeps the record of every trial readable.
#[test]
fn a_range_that_exceeds_that_of_its_key_is_refused() {
    let curved = ["emulator.radius_mm=20", "study.curvature_error=[-0.5, 1.0]"];
    let creep = ["emulator.torsion.creep_mm=50", "study.creep_error=[0.0, 1.0]"];
    for sets in [curved, creep] {
        let config = loaded("", &sets);
        for seed in 0..50 {
            let drawn = config.drawn(seed).unwrap();
            assert_eq!(loaded(&drawn.to_toml().unwrap(), &[]), drawn);
        }
    }
    for (sets, error) in [
        (
            [curved[0], "study.curvature_error=[-0.5, 1.5]"],
            "study.curvature_error = [-0.5, 1.5] may draw emulator.curvature_per_mm = 0.125, allowed: \
             0.00001 to 0.1 per mm",
        ),
        (
            [creep[0], "study.creep_error=[0, 1.5]"],
            "study.creep_error = [0, 1.5] may draw emulator.torsion.creep_mm = 125, allowed: 0 to 100 mm",
        ),
    ] {
        assert_eq!(loaded("", &sets).drawn(1).expect_err("refused").to_string(), error);
    }
}

#[test]
fn the_two_constants_of_creep_are_drawn_independently() {
    let torsion = "emulator.torsion.creep_mm=0.75";
    let growth = "emulator.torsion.creep_mm_per_mm=0.006";
    let config = loaded("", &[torsion, growth, "study.creep_error=[-0.3, 0.3]"]);
    let (mut product, mut squares) = (0.0, [0.0, 0.0]);
    for seed in 0..400 {
        let torsion = config.drawn(seed).unwrap().emulator.torsion;
        let errors = [torsion.creep_mm / 0.75 - 1.0, torsion.creep_mm_per_mm / 0.006 - 1.0];
        assert!(errors.iter().all(|error| error.abs() <= 0.3 + 1e-12), "{errors:?}");
        product += errors[0] * errors[1];
        squares = [squares[0] + errors[0] * errors[0], squares[1] + errors[1] * errors[1]];
    }
    assert!(squares.iter().all(|sum| (0.02..0.04).contains(&(sum / 400.0))), "{squares:?}");
    let correlation = product / (squares[0] * squares[1]).sqrt();
    assert!(correlation.abs() < 0.15, "{correlation}");
}

/// In space from the tip as drawn; in the plane from where the path begins, which is nearer.
#[test]
fn drawn_obstacles_leave_room_around_the_drawn_start() {
    let sets = [
        "goal.kind=target",
        "goal.position_mm=[0.0, 0.0, 100.0]",
        "study.x_mm=[-8, 8]",
        "study.y_mm=[20, 40]",
        "study.z_mm=[10, 20]",
        "study.obstacles=5",
    ];
    for in_plane in [true, false] {
        let in_plane_set = format!("goal.in_plane={in_plane}");
        let config = loaded("", &[&sets[..], &[in_plane_set.as_str()]].concat());
        for seed in 0..50 {
            let drawn = config.drawn(seed).unwrap();
            let mut start_mm = drawn.emulator.start.translation;
            if in_plane {
                start_mm.x = 0.0;
            }
            for obstacle in &drawn.goal.obstacle {
                let off_mm = (obstacle.centre_mm.unwrap() - start_mm).norm();
                let room_mm = off_mm - obstacle.radius_mm.unwrap();
                assert!(room_mm >= drawn.goal.clearance_mm, "{in_plane} {seed}: {room_mm}");
            }
        }
    }
}

/// The number of attempts to place a sphere is limited.
#[test]
fn obstacles_that_have_no_room_are_refused() {
    let goal = ["goal.kind=\"target\"", "goal.position_mm=[0.0, 0.0, 100.0]"];
    let wide = ["study.obstacles=2", "study.obstacle_radius_mm=[200, 300]"];
    let refused = loaded("", &[goal, wide].concat()).drawn(1).expect_err("no room").to_string();
    for part in ["study.obstacle_radius_mm = [200, 300]", "1000 spheres", "draw smaller ones"] {
        assert!(refused.contains(part), "{refused}");
    }
}
