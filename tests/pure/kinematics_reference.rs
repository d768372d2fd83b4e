//! The exact step against values that were computed independently by matrix exponentials.
//!
//! Emulator and bench share the kinematics, so an error in it would cancel in every other test.

use nalgebra::Vector3;
use needle_bench::geometry::{FixedAngles, Pose};
use needle_bench::needle::{Increment, Needle};
use needle_bench::units::wrap_angle;

#[test]
fn steps_agree_with_the_reference_to_1e_9() {
    let text = include_str!("../data/kinematics.csv");
    let mut rows = 0;
    for line in text.lines().skip(1) {
        let v: Vec<f64> = line.split(',').map(|field| field.parse().unwrap()).collect();
        let start = Pose {
            rotation: FixedAngles { yaw: v[3], pitch: v[4], roll: v[5] }.to_rotation(),
            translation: Vector3::new(v[0], v[1], v[2]),
        };
        let needle = Needle::new(v[6]).unwrap();
        let end = needle.step(&start, Increment::new(v[8], v[7] * v[8]).unwrap());
        let angles = FixedAngles::from_rotation(&end.rotation);
        let position_mm = (end.translation - Vector3::new(v[9], v[10], v[11])).norm();
        assert!(position_mm < 1e-9, "row {rows}: position differs by {position_mm} mm");
        for (name, ours, theirs) in [
            ("yaw", angles.yaw, v[12]),
            ("pitch", angles.pitch, v[13]),
            ("roll", angles.roll, v[14]),
        ] {
            let difference = wrap_angle(ours - theirs).abs();
            assert!(difference < 1e-9, "row {rows}: {name} differs by {difference} rad");
        }
        rows += 1;
    }
    assert_eq!(rows, 250);
}
