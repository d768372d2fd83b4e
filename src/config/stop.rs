//! The part of a configuration that a stop needs: the bus and the nodes of the two drives. No other error
//! in the configuration prevents a stop.

use super::reader::{Reader, contradictions, is_inside, merge};
use super::value::{self, Entries};
use super::{CanInterface, ConfigError, Source, checks};
use crate::stage;

const INTERFACE: &str = "can.interface";
const NODES: [&str; 2] = ["stage.insertion.node", "stage.rotation.node"];
const REQUIRED: [&str; 3] = [INTERFACE, NODES[0], NODES[1]];
/// Other keys that a stop uses, if they are valid.
const OPTIONAL: [&str; 5] = [
    "can.sdo_timeout_ms",
    "can.sdo_attempts",
    "stage.stop_timeout_s",
    "stage.insertion.counts_per_mm",
    "stage.rotation.counts_per_turn",
];
/// Coarse scales for axes whose scale is unknown. With them, a moving axis never counts as stopped; a fine axis is
/// only watched a little longer than necessary.
const COARSE_SCALES: [(&str, &str); 2] = [
    (OPTIONAL[3], "stage.insertion.counts_per_mm={ counts = 100, mm = 1 }"),
    (OPTIONAL[4], "stage.rotation.counts_per_turn={ counts = 500, turns = 1 }"),
];

/// Where a stop is sent, and how long the drives are given.
#[derive(Debug, Clone, PartialEq)]
pub struct StopConfig {
    /// The bus, which is never `memory`.
    pub interface: CanInterface,
    /// The drives. Nodes, scales, SDO timeout, SDO attempts and stop timeout are as configured; everything else
    /// has its default.
    pub stage: stage::StageConfig,
}

impl StopConfig {
    /// Reads what a stop needs from `source`, if there is one, overridden by `sets` (`key=value`). A wrong or
    /// missing time gets its default, a wrong or missing scale a coarse one. On a virtual bus the nodes have
    /// defaults as well; on any other bus they must be given. If `source` is not valid TOML, its readable lines are
    /// used.
    ///
    /// # Errors
    /// The interface or a node is wrong or missing. Syntax errors of `source` are reported only together with such
    /// an error.
    pub fn from_source(source: Option<Source<'_>>, sets: &[String]) -> Result<Self, ConfigError> {
        let mut entries = Vec::new();
        let mut problems = Vec::new();
        if let Some(Source { name, text }) = source {
            entries = value::parse_file(name, text, 1).unwrap_or_else(|error| {
                problems = error.problems;
                value::recover_file("salvaged", &readable_lines(text), 1).0
            });
        }
        for (set, layer) in sets.iter().zip(2..) {
            match value::parse_set(set, layer) {
                Ok(more) => entries.extend(more),
                // The operator meant to set the interface or a node.
                Err(error) if sets_required_key(set) => return Err(error),
                Err(_) => {}
            }
        }
        Self::read(entries).map_err(|error| {
            problems.extend(error.problems);
            ConfigError { problems }
        })
    }

    fn read(entries: Entries) -> Result<Self, ConfigError> {
        let mut tree = merge(entries);
        let mut reader = Reader::new(tree.clone());
        let config = reader.read();
        let is_named = reader.given(INTERFACE).is_some();
        let is_optional = |key| key != INTERFACE && is_named && config.can.interface.is_virtual();
        for key in REQUIRED {
            contradictions! { reader;
                [key] if !is_optional(key) && reader.given(key).is_none() =>
                    "{key} is not given, and a stop needs it";
            }
        }
        contradictions! { reader;
            [INTERFACE] if is_named && config.can.interface == CanInterface::Memory =>
                "{INTERFACE} is \"memory\", where there is no drive to stop";
        }
        checks::check_nodes(&NODES, &config, &mut reader);
        reader.check_found_no_problem_with(&REQUIRED)?;
        tree.retain(|key, _| {
            let used = OPTIONAL.iter().find(|used| key == *used || is_inside(key, used));
            used.is_some_and(|used| !reader.is_invalid(used))
        });
        for (key, coarse) in COARSE_SCALES {
            if !tree.keys().any(|given| given == key || is_inside(given, key)) {
                tree.extend(value::parse_set(coarse, 1)?);
            }
        }
        let mut stage = Reader::new(tree).read().stage;
        stage.insertion.node = config.stage.insertion.node;
        stage.rotation.node = config.stage.rotation.node;
        // The coarser the scale, the longer it takes to detect that an axis has stopped.
        let windows = stage::Axis::BOTH.map(|axis| 2 * stage.standstill_window(axis));
        stage.power.stop_timeout = stage.power.stop_timeout.max(windows[0]).max(windows[1]);
        Ok(StopConfig { interface: config.can.interface, stage })
    }
}

/// True if `key=value` sets a key that a stop needs, or a table around one.
fn sets_required_key(set: &str) -> bool {
    let key = set.split('=').next().unwrap_or(set).trim();
    REQUIRED.iter().any(|needed| *needed == key || is_inside(needed, key))
}

/// The lines of `text` that are valid TOML by themselves. So bus and nodes can still be read from a file that as a
/// whole is not valid, for example while it is being edited. Keys below a broken header go into an unused table.
fn readable_lines(text: &str) -> String {
    let lines = text.split(['\n', '\r']).map(|line| match value::parse_file("", line, 1) {
        Ok(_) => line,
        Err(_) if line.trim_start().starts_with('[') => "[unreadable]",
        Err(_) => "",
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::stage::CountsRatio;
    use std::time::Duration;

    const RIG: &str = include_str!("../../bench-config/rig-epos4.toml");

    fn read(text: &str, sets: &[&str]) -> Result<StopConfig, String> {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        let source = (!text.is_empty()).then_some(Source { name: "rig.toml", text });
        StopConfig::from_source(source, &sets).map_err(|error| error.to_string())
    }

    fn nodes(stop: &StopConfig) -> [u8; 2] {
        [stop.stage.insertion.node.get(), stop.stage.rotation.node.get()]
    }

    #[test]
    fn a_stop_reads_a_valid_configuration() {
        let rig = read(RIG, &["can.sdo_timeout_ms=300", "stage.stop_timeout_s=4"]).unwrap();
        assert_eq!(rig.interface, CanInterface::Socket("can0".to_owned()));
        assert_eq!(nodes(&rig), [1, 2]);
        assert_eq!(rig.stage.insertion.ratio, CountsRatio::new(590_000, 127).unwrap());
        assert_eq!(rig.stage.rotation.ratio, CountsRatio::new(75_760, 1).unwrap());
        assert_eq!(rig.stage.bus.sdo_timeout(), Duration::from_millis(300));
        assert_eq!(rig.stage.power.stop_timeout, Duration::from_secs(4));
    }

    /// A run refuses each of these values.
    #[test]
    fn an_error_elsewhere_does_not_prevent_a_stop() {
        let elsewhere = [
            "insertion.dpeth_mm=3",
            "insertion.depth_mm=-3",
            "tracker.registration_file=absent.toml",
            "control.kind=none",
            "can.sync_ms=0",
            "can.bench_node=1",
            "can.sdo_timeout_ms=soon",
            "can.sdo_attempts=0",
            "stage.stop_timeout_s=never",
            "stage.hardware=perhaps",
            "stage.insertion.counts_per_mm={ counts = 0 }",
            "stage.insertion.acceleration_max_mm_per_s2=-1",
            "stage.rotation.optional_objects=[0x6040]",
            "nothing",
        ];
        for set in elsewhere {
            let sets = vec![set.to_owned()];
            let source = Source { name: "rig.toml", text: RIG };
            assert!(Config::from_sources(&[source], &sets).is_err(), "{set}");
            let stop = read(RIG, &[set]).unwrap_or_else(|error| panic!("{set}: {error}"));
            assert_eq!(nodes(&stop), [1, 2], "{set}");
        }
        let all = read(RIG, &elsewhere).expect("all at once");
        assert_eq!(all.stage.insertion.ratio, CountsRatio::new(100, 1).unwrap(), "a default");
        assert_eq!(all.stage.power.stop_timeout, Duration::from_secs(2), "the default");
        assert_eq!(
            (all.stage.bus.sdo_timeout(), all.stage.bus.sdo_attempts),
            (Duration::from_millis(150), 3)
        );
    }

    /// Such a stage is stopped too. The timeout grows to what the coarse counts need to detect standstill.
    #[test]
    fn a_scale_or_a_time_that_a_run_refuses_does_not_prevent_a_stop() {
        let stop_timeout = |set| read(RIG, &[set]).unwrap().stage.power.stop_timeout;
        assert_eq!(stop_timeout("stage.stop_timeout_s=0.5"), Duration::from_millis(500));
        let coarse = "stage.insertion.counts_per_mm={ counts = 20, mm = 1 }";
        assert_eq!(stop_timeout(coarse), Duration::from_secs(5));
        let unknown = ["can.interface=udp", "stage.stop_timeout_s=0.5"];
        let stop = read("", &unknown).unwrap();
        assert!(
            stop.stage.power.stop_timeout > Duration::from_secs(1),
            "{:?}",
            stop.stage.power.stop_timeout
        );
    }

    /// A file may be saved half-way through an edit, while a needle moves.
    #[test]
    fn bus_and_nodes_are_read_from_a_file_with_broken_toml_elsewhere() {
        let appended =
            ["\n[tracker.gates]\nnoise_sd_mm = 0.6,\n", "\n[insertion]\n", "\nx = = 1\n"]
                .map(|broken| format!("{RIG}{broken}"));
        let edited = [
            ("counts_per_mm = ", "counts_per_mm = { counts = 590_000, mm =\n#"),
            ("counts_per_mm = ", "counts_per_mm = [\n#"),
            ("counts_per_mm = ", "counts_per_mm\n#"),
            ("counts_per_mm = ", "counts_per_mm = \"\"\"\n#"),
            ("[can]", "[ can ]\nsync_ms ="),
            ("[tracker]", "[tracker"),
            ("\n", "\r"),
        ]
        .map(|(from, to)| {
            assert!(RIG.contains(from), "{from}");
            RIG.replace(from, to)
        });
        for text in appended.iter().chain(&edited) {
            let stop = read(text, &[]).unwrap_or_else(|error| panic!("{error}: {text}"));
            assert_eq!((stop.interface.to_string().as_str(), nodes(&stop)), ("can0", [1, 2]));
        }
        let dotted =
            "can.interface = \"can0\"\nstage.insertion.node = 1\nstage.rotation.node = 2\nx =\n";
        assert_eq!(nodes(&read(dotted, &[]).unwrap()), [1, 2]);
        // Keys below a broken header belong to no table, not even to the table before.
        let headless =
            "[can]\ninterface = \"can0\"\n[stage.insertion]\nnode = 1\n[stage.rotation\nnode = 2\n";
        let error = read(headless, &[]).unwrap_err();
        assert!(
            error.ends_with("stage.rotation.node is not given, and a stop needs it"),
            "{error}"
        );
        let indented = "[can]\ninterface = \"can0\"\n  [stage.insertion]\n  node = 1\n\t[stage.rotation]\nnode = 2\n\
                        [tracker]\n=\n";
        assert_eq!(nodes(&read(indented, &[]).unwrap()), [1, 2]);
        let stop = read(RIG, &["stage.stop_timeout_s"]).unwrap();
        assert_eq!(nodes(&stop), [1, 2]);
    }

    #[test]
    fn a_stop_needs_no_file_if_bus_and_nodes_are_set() {
        let sets = ["can.interface=can1", "stage.insertion.node=5", "stage.rotation.node=6"];
        let stop = read("", &sets).unwrap();
        assert_eq!((stop.interface.to_string().as_str(), nodes(&stop)), ("can1", [5, 6]));
        assert_eq!(stop.stage.insertion.ratio, CountsRatio::new(100, 1).unwrap());
        assert_eq!(stop.stage.rotation.ratio, CountsRatio::new(500, 1).unwrap());
        // Broken TOML does not matter then.
        assert_eq!(nodes(&read("[can\n", &sets).unwrap()), [5, 6]);
        let error = read("[can\n", &sets[1..]).unwrap_err();
        assert!(error.starts_with("rig.toml:1:"), "{error}");
        assert!(error.ends_with("\ncan.interface is not given, and a stop needs it"), "{error}");
    }

    /// Only on a virtual bus do the nodes default to those of the virtual stage.
    #[test]
    fn a_stop_without_interface_or_nodes_is_refused() {
        assert_eq!(
            read("", &[]).unwrap_err(),
            "can.interface is not given, and a stop needs it\n\
             stage.insertion.node is not given, and a stop needs it\n\
             stage.rotation.node is not given, and a stop needs it"
        );
        for virtual_bus in ["udp", "vcan0", "vxcan1", "udp:239.1.2.3:4000"] {
            let stop = read("", &[&format!("can.interface={virtual_bus}")]).unwrap();
            assert_eq!(nodes(&stop), [1, 2], "{virtual_bus}");
        }
        for (set, problem) in [
            ("can.interface=memory", "can.interface is \"memory\", where there is no drive"),
            ("can.interface=\"a b\"", "can.interface is \"a b\", allowed: "),
            ("can=3", "can is 3, expected a table"),
            ("can.interface", "can.interface: expected key=value"),
            ("stage.insertion.node=200", "stage.insertion.node is 200, allowed: 1 to 127"),
            ("stage.rotation.node=two", "stage.rotation.node is \"two\", expected"),
            ("stage.rotation.node=1", "stage.rotation.node is 1, the same as stage.insertion.node"),
        ] {
            let error = read(RIG, &[set]).unwrap_err();
            assert!(error.starts_with(&format!("--set {problem}")), "{set}: {error}");
        }
        let without = RIG.replace("node = 2 ", "nod = 2 ").replace("node = 2\n", "nod = 2\n");
        assert_ne!(without, RIG);
        let error = read(&without, &[]).unwrap_err();
        assert!(error.contains("stage.rotation.node is missing"), "{error}");
        let error = read(&without, &["stage.hardware=false"]).unwrap_err();
        assert_eq!(error, "stage.rotation.node is not given, and a stop needs it");
    }
}
