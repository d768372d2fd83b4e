//! Configurations that load, and those that are refused.

use std::path::Path;

use proptest::prelude::*;

use super::*;

mod axes;
mod contradictions;
mod faults;
mod loads;
mod refusals;
mod trials;

const RIG: &str = include_str!("../../../bench-config/rig-epos4.toml");

/// Maximum length of a line of an error message, in characters.
const MESSAGE_MAX: usize = 200;

fn load(text: &str, sets: &[&str]) -> Result<Config, ConfigError> {
    let sets: Vec<String> = sets.iter().map(|&set| set.to_owned()).collect();
    Config::from_sources(&[Source { name: "bench.toml", text }], &sets)
}

#[track_caller]
fn loaded(text: &str, sets: &[&str]) -> Config {
    load(text, sets).unwrap_or_else(|error| panic!("{error}"))
}

/// The error of a file.
#[track_caller]
fn refusal(text: &str) -> String {
    refused(text, &[])
}

#[track_caller]
fn refused(text: &str, sets: &[&str]) -> String {
    let error = load(text, sets).expect_err("refused").to_string();
    for line in error.lines() {
        assert!(line.chars().count() <= MESSAGE_MAX, "{} characters: {line}", line.chars().count());
    }
    error
}

/// The error of `--set` alone.
#[track_caller]
fn set_refusal(sets: &[&str]) -> String {
    refused("", sets)
}

fn shipped() -> Vec<(String, String)> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("bench-config");
    let mut files: Vec<(String, String)> = std::fs::read_dir(dir)
        .expect("bench-config")
        .map(|entry| entry.expect("entry").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "toml"))
        .map(|path| {
            let name = path.file_name().expect("name").to_string_lossy().into_owned();
            (name, std::fs::read_to_string(&path).expect("text"))
        })
        .collect();
    files.sort();
    files
}

/// The dotted names of `keys` and of the keys inside them.
fn dotted(keys: &[keys::Key], path: &str) -> Vec<String> {
    let inside = |key: keys::Key| {
        let at = keys::join(path, key.name);
        let tables = keys::tables(&key.kind);
        let mut names: Vec<String> = tables.iter().flat_map(|keys| dotted(keys, &at)).collect();
        names.push(at);
        names
    };
    keys::expanded(keys, &[]).into_iter().flat_map(inside).collect()
}

/// A TOML value of any kind.
fn value() -> impl Strategy<Value = String> {
    let leaf = prop_oneof![
        any::<f64>().prop_map(|x| format!("{x:?}").to_lowercase()),
        any::<i64>().prop_map(|x| x.to_string()),
        (-20.0..20.0f64).prop_map(|x| format!("{x:?}")),
        any::<bool>().prop_map(|x| x.to_string()),
        "[ -~]{0,12}".prop_map(|x| format!("{x:?}")),
        Just("1979-05-27T07:32:00Z".to_owned()),
        Just("\"openigtlink\"".to_owned()),
        Just("\"can0\"".to_owned()),
    ];
    leaf.prop_recursive(2, 8, 4, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..4).prop_map(|x| format!("[{}]", x.join(", "))),
            prop::collection::btree_map("(counts|mm|turns|x_mm|sd_mm|index|bits|q)", inner, 0..4)
                .prop_map(|table| {
                    let fields: Vec<_> = table.iter().map(|(k, v)| format!("{k} = {v}")).collect();
                    format!("{{ {} }}", fields.join(", "))
                }),
        ]
    })
}

/// A known key, the section of one, or an unknown key.
fn key() -> impl Strategy<Value = String> {
    let known = dotted(Config::KEYS, "");
    (prop::sample::select(known), 0..4usize, "[a-z_]{1,8}").prop_map(|(known, change, other)| {
        match change {
            0 | 1 => known,
            2 => known.rsplit_once('.').map_or(other, |(section, _)| section.to_owned()),
            _ => format!("{known}{other}"),
        }
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn any_overlay_is_refused_or_loads_and_reads_back(
        file in prop::collection::btree_map(key(), value(), 0..4),
        sets in prop::collection::vec((key(), value()), 0..3),
    ) {
        let text: String = file.iter().map(|(key, value)| format!("{key} = {value}\n")).collect();
        let sets: Vec<String> = sets.iter().map(|(key, value)| format!("{key}={value}")).collect();
        let source = Source { name: "bench.toml", text: &text };
        match Config::from_sources(&[source], &sets) {
            Ok(config) => {
                prop_assert_eq!(&loaded(&config.to_toml().expect("TOML"), &[]), &config);
                let _ = config.session().map_err(|error| error.to_string());
            }
            Err(error) => prop_assert!(!error.problems.is_empty()),
        }
    }

    #[test]
    fn any_text_loads_or_is_refused(text in "\\PC{0,60}", set in "\\PC{0,30}") {
        let source = Source { name: "bench.toml", text: &text };
        let _ = Config::from_sources(&[source], &[set]).map_err(|error| error.to_string());
    }

    #[test]
    fn numbers_in_range_are_kept_to_the_last_bit(
        depth_mm in 10.0..310.0f64,
        yaw_deg in -360.0..360.0f64,
        pole in 1e-6..1.0f64,
        curvature in 1e-6..0.1f64,
    ) {
        let sets = [
            format!("insertion.depth_mm={depth_mm:?}"),
            format!("plane.yaw_deg={yaw_deg:?}"),
            format!("observer.coupled.fibre_poles_per_mm=[{pole:?}, 1]"),
            format!("needle.curvature_per_mm={curvature:?}"),
        ];
        let config = Config::from_sources(&[], &sets).expect("in range");
        prop_assert_eq!(config.insertion.depth_mm, depth_mm);
        prop_assert_eq!(config.number("plane.yaw_deg"), yaw_deg);
        prop_assert_eq!(config.observer.coupled.fibre_poles_per_mm, [pole, 1.0]);
        prop_assert_eq!(config.needle.arc.curvature_per_mm(), curvature);
        prop_assert_eq!(&loaded(&config.to_toml().expect("TOML"), &[]), &config);
    }
}

/// Printed defaults would override what a rehearsal derives.
#[test]
fn a_printed_rig_is_rehearsed_like_its_file() {
    let rehearse = ["emulator.rehearse=true"];
    let sets = ["needle.radius_mm=95.0", "needle.torsion.half_width_deg=4.0"];
    let printed = loaded(RIG, &sets).to_toml().expect("TOML");
    let of_file = loaded(RIG, &[&sets[..], &rehearse].concat());
    assert!(of_file.emulator.homed);
    assert_eq!(loaded(&printed, &rehearse).emulator, of_file.emulator);
}
