//! Recordings of an insertion with known parameters.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use needle_bench::geometry::Pose;
use needle_bench::needle::{Increment, Needle, Play, Torsion};
use std::fmt::Write as _;

/// CSV of an insertion of 60 mm in 600 rows, the sensor in line with the tip. `turns` gives the turn of the base
/// at each row, rad.
pub(crate) fn recording(needle: Needle, torsion: &Torsion, turns: impl Fn(u32) -> f64) -> String {
    let mut csv = "insertion_mm,rotation_rad,x_mm,y_mm,z_mm,qw,qx,qy,qz\n".to_owned();
    let (mut tip, mut rotation, mut play) = (Pose::identity(), 0.0, Play::default());
    for n in 0..600u32 {
        let q = UnitQuaternion::from_rotation_matrix(&tip.rotation);
        let [x, y, z]: [f64; 3] = tip.translation.into();
        let depth = 0.1 * f64::from(n);
        writeln!(csv, "{depth},{rotation},{x},{y},{z},{},{},{},{}", q.w, q.i, q.j, q.k).unwrap();
        let turn = turns(n);
        for part in play.advance(torsion, Increment::new(0.1, turn).unwrap()) {
            tip = needle.step(&tip, part);
        }
        rotation += turn;
    }
    csv
}

/// Turns the base to and fro, by 0.6 and −0.5 rad/mm, each way for `way_mm`.
pub(crate) fn to_and_fro(way_mm: u32) -> impl Fn(u32) -> f64 {
    move |n| if (n / (10 * way_mm)).is_multiple_of(2) { 0.06 } else { -0.05 }
}

/// The recording `csv` as a sensor of five degrees of freedom gives it: its orientations contain only the heading.
pub(crate) fn heading_only(csv: &str) -> String {
    let (header, rows) = csv.split_once('\n').unwrap();
    let row = |line: &str| {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let [insertion, rotation, x, y, z, w, i, j, k] = cells[..] else { panic!("{line}") };
        let heading = UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k)) * Vector3::z();
        let q = UnitQuaternion::rotation_between(&Vector3::z(), &heading).unwrap();
        format!("{insertion},{rotation},{x},{y},{z},{},{},{},{}\n", q.w, q.i, q.j, q.k)
    };
    format!("{header}\n{}", rows.lines().map(row).collect::<String>())
}
