//! `needle-bench calibrate tracker`, and the use of its result.

use crate::support::needed::data;
use crate::support::program::{Scratch, needle_bench};
use nalgebra::Vector3;
use needle_bench::emulator::{CorrelatedNoise, TrackerModel, WhiteNoise};
use std::time::Duration;

/// A tracker with half of its variance correlated over 0.2 s.
fn model() -> TrackerModel {
    TrackerModel {
        noise: WhiteNoise::Gaussian(0.4),
        correlated: Some(CorrelatedNoise { sd_mm: 0.4, time_s: 0.2 }),
        seed: 11,
        period: Duration::from_millis(25),
        latency: Duration::ZERO,
        repeats: 0,
    }
}

fn positions() -> impl Iterator<Item = (u64, Vector3<f64>)> {
    (0..2400).map(|k| (k, Vector3::new(100.0, -20.0, 5.0) + model().noise_mm(k)))
}

/// A minute at rest, as `tracker record` writes it.
fn csv() -> String {
    let rows = positions().map(|(k, p_mm)| {
        let ns = k * 25_000_000;
        let stamp = 1_700_000_000_000_000_000 + ns;
        format!("{},{stamp},{},{},{}\n", ns + 5_000_000 + k % 3, p_mm.x, p_mm.y, p_mm.z)
    });
    format!("receive_time_ns,stamp_unix_ns,x_mm,y_mm,z_mm\n{}", rows.collect::<String>())
}

fn ndjson(tool: &str) -> String {
    let line = |(k, p_mm): (u64, Vector3<f64>)| {
        format!(
            r#"{{"tool":"{tool}","position_tracker_mm":[{},{},{}],"receive_time_ns":{}}}"#,
            p_mm.x,
            p_mm.y,
            p_mm.z,
            k * 25_000_000
        )
    };
    positions().map(line).collect::<Vec<_>>().join("\n")
}

/// The printed result is a configuration, and has the noise of the model within its standard errors.
#[test]
fn the_noise_of_a_recording_becomes_a_configuration() {
    let scratch = Scratch::new();
    scratch.write("rest.csv", &csv());
    let said = needle_bench(&scratch, &["calibrate", "tracker", "rest.csv", "--out", "noise.toml"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert!(said.stderr.contains("tracker: 2400 positions in 60.0 s, 40.00 Hz"), "{}", said.stderr);
    let text = std::fs::read_to_string(scratch.path().join("noise.toml")).expect("a result");
    println!("{text}");
    let result: toml::Table = text.parse().expect("TOML");
    let noise = &result["tracker"]["noise"];
    for (key, truth) in
        [("white_sd_mm", 0.4), ("correlated_sd_mm", 0.4), ("correlation_time_s", 0.2)]
    {
        let line = text.lines().find(|line| line.starts_with(key)).expect("a line");
        let error = line.split("+- ").nth(1).and_then(|rest| rest.split(';').next());
        let error: f64 = error.and_then(|error| error.trim().parse().ok()).expect("its error");
        let value = noise[key].as_float().expect("a number");
        assert!((value - truth).abs() < 4.0 * error && error < 0.2 * truth, "{line}");
    }
    let checked = needle_bench(&scratch, &["check", "noise.toml"]);
    assert_eq!(checked.status, 0, "{}", checked.stderr);

    scratch.write("rest.ndjson", &ndjson("NeedleToTracker"));
    let of_lines = needle_bench(&scratch, &["calibrate", "tracker", "rest.ndjson", "--json"]);
    assert_eq!(of_lines.status, 0, "{}", of_lines.stderr);
    let json = of_lines.json();
    let (of_csv, of_lines) =
        (noise["white_sd_mm"].as_float(), &json["tracker"]["noise"]["white_sd_mm"]);
    assert!((of_csv.unwrap() - of_lines.as_f64().unwrap()).abs() < 1e-5);
    assert_eq!(json["fit"]["latency_jitter_ms"], serde_json::Value::Null, "without stamps");
    assert!(json["fit"]["axes"][2]["drift_mm_per_min"]["error"].as_f64().unwrap() > 0.0);
}

/// The configuration takes no noise under 0.001 mm.
#[test]
fn a_tracker_in_metres_or_without_noise_is_refused() {
    let scratch = Scratch::new();
    let refused = |scale: f64| {
        let row = |(k, p_mm): (u64, Vector3<f64>)| {
            let p = p_mm * scale;
            format!("{},{},{},{}\n", k * 25_000_000, p.x, p.y, p.z)
        };
        let rows: String = positions().map(row).collect();
        scratch.write("rest.csv", &format!("receive_time_ns,x_mm,y_mm,z_mm\n{rows}"));
        let said = needle_bench(&scratch, &["calibrate", "tracker", "rest.csv"]);
        assert_eq!((said.status, said.stdout.as_str()), (2, ""), "{}", said.stderr);
        said.stderr.replace("\n       ", " ")
    };
    let metres = refused(1e-3);
    assert!(metres.contains("rest.csv: the noise is 0.0005"), "{metres}");
    assert!(
        metres.contains("mm (at least 0.001 needed): the positions look like metres"),
        "{metres}"
    );
    let noiseless = refused(1e-9);
    assert!(noiseless.contains("an emulated tracker without noise?"), "{noiseless}");
}

#[test]
fn a_file_that_is_not_a_recording_at_rest_is_refused_with_the_reason() {
    let scratch = Scratch::new();
    let refused = |arguments: &[&str]| {
        let arguments = [&["calibrate", "tracker"], arguments].concat();
        let said = needle_bench(&scratch, &arguments);
        assert_eq!(said.status, 2, "{arguments:?}: {}", said.stderr);
        said.screen()
    };
    scratch.write("rest.ndjson", &ndjson("Stylus"));
    let short: Vec<String> = csv().lines().take(60).map(str::to_owned).collect();
    scratch.write("short.csv", &short.join("\n"));
    scratch.write("other.csv", "t,x,y,z\n0,1,2,3\n");
    let screens = [
        refused(&["rest.ndjson"]),
        refused(&["short.csv"]),
        refused(&["other.csv"]),
        refused(&["absent.csv"]),
    ];
    insta::assert_snapshot!(screens.concat());
}

/// A real recording at two rows a second: two thirds of the rows repeat a frozen tip, and the others are too few.
#[test]
fn a_recording_of_a_frozen_stream_is_too_short() {
    let Some(path) = data("tracker-recordings/phantomA_closedloop_03.csv") else { return };
    let scratch = Scratch::new();
    let said = needle_bench(
        &scratch,
        &[
            "calibrate",
            "tracker",
            path.to_str().expect("UTF-8"),
            "--set",
            "tracker.csv.time={ s = \"Timestamp sec\", ns = \"Timestamp nanosec\" }",
            "--set",
            "tracker.csv.position=[\"AuroraTip x\", \"AuroraTip y\", \"AuroraTip z\"]",
        ],
    );
    assert_eq!(said.status, 2, "{}", said.stdout);
    assert!(
        said.stderr.contains("63 new positions in 31.0 s (118 repeats, 1 invalid), at least 100"),
        "{}",
        said.stderr
    );
}
