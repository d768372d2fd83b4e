//! The paper's Figures 3 and 4, from the shipped configurations.

use crate::support::program::{Scratch, needle_bench, repository};
use std::collections::HashMap;

const COORDINATES: [(&str, &str); 6] =
    [("x", "mm"), ("y", "mm"), ("z", "mm"), ("yaw", "rad"), ("pitch", "rad"), ("roll", "rad")];

/// The rows of a run's steps.csv, each as a map from column to number.
fn steps(config: &str, sets: &[&str]) -> Vec<HashMap<String, f64>> {
    let scratch = Scratch::new();
    let config = repository(config);
    let mut arguments = vec!["run", config.as_str(), "--json", "-q"];
    sets.iter().for_each(|set| arguments.extend(["--set", set]));
    let said = needle_bench(&scratch, &arguments);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    let json = said.json();
    let csv = scratch.path().join(json["run_dir"].as_str().unwrap()).join("steps.csv");
    let text = std::fs::read_to_string(csv).unwrap();
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().unwrap().split(',').collect();
    lines
        .map(|line| {
            let fields = header.iter().zip(line.split(','));
            fields.filter_map(|(name, v)| Some(((*name).to_owned(), v.parse().ok()?))).collect()
        })
        .collect()
}

fn error(row: &HashMap<String, f64>, (name, unit): (&str, &str)) -> f64 {
    let difference = row[&format!("{name}_est_{unit}")] - row[&format!("{name}_true_{unit}")];
    if unit == "rad" { needle_bench::units::wrap_angle(difference) } else { difference }
}

/// Figure 3.
#[test]
fn without_noise_all_six_errors_vanish() {
    let rows = steps("bench-config/paper-fig3.toml", &[]);
    assert_eq!(rows.len(), 301);
    let (first, last) = (&rows[0], &rows[300]);
    assert!((last["insertion_mm"] - 300.0).abs() < 1e-3);
    for angle in [("yaw", "rad"), ("pitch", "rad"), ("roll", "rad")] {
        assert!(error(first, angle).abs() > 0.05, "no error of {} at the start", angle.0);
    }
    for coordinate in COORDINATES {
        let at_end = error(last, coordinate).abs();
        assert!(at_end < 1e-6, "{}: {at_end} {}", coordinate.0, coordinate.1);
    }
    // One sample per millimetre, of the true position.
    for (step, row) in rows.iter().enumerate() {
        assert!((row["insertion_mm"] - step as f64).abs() < 1e-3);
        assert!((row["x_meas_mm"] - row["x_true_mm"]).abs() < 1e-9);
    }
}

/// Figure 4: uniform noise of ±1 mm.
#[test]
fn with_noise_the_run_settles() {
    for seed in 1..=5 {
        let rows = steps("bench-config/paper-fig4.toml", &[&format!("emulator.seed={seed}")]);
        let noise: Vec<f64> = rows.iter().map(|row| row["x_meas_mm"] - row["x_true_mm"]).collect();
        assert!(noise.iter().all(|n| n.abs() <= 1.0) && noise.iter().any(|n| n.abs() > 0.9));
        let last_third = &rows[201..];
        let rms = |f: &dyn Fn(&HashMap<String, f64>) -> f64| {
            let sum: f64 = last_third.iter().map(|row| f(row).powi(2)).sum();
            (sum / last_third.len() as f64).sqrt()
        };
        assert!(last_third.iter().all(|row| row["x_true_mm"].abs() < 1.0), "seed {seed}");
        assert!(rms(&|row| row["x_true_mm"]) < 0.4, "seed {seed}");
        for (coordinate, limit) in COORDINATES.into_iter().zip([0.5, 0.5, 0.5, 0.02, 0.03, 0.08]) {
            let rms = rms(&|row| error(row, coordinate));
            assert!(rms < limit, "seed {seed}: {} {rms} {}", coordinate.0, coordinate.1);
        }
    }
}
