//! Laying one source over another, key by key.

use std::collections::BTreeMap;

use super::value::{Entries, Entry, Value};

/// All sources laid over each other, by dotted key.
pub(super) type Tree = BTreeMap<String, Entry>;

/// Keys of which one excludes the others: one given in a source takes the place of the others of
/// the sources under it.
const ALTERNATIVES: [&[&str]; 3] = [
    &["needle.radius_mm", "needle.curvature_per_mm"],
    &["emulator.radius_mm", "emulator.curvature_per_mm"],
    &["emulator.noise.uniform_mm", "emulator.noise.sd_mm"],
];

/// Tables that are replaced whole: `noise = {}` means none, and neither a ratio nor a pose nor a
/// time is half of another.
const WHOLE: [&str; 6] = [
    "emulator.noise",
    "stage.insertion.counts_per_mm",
    "stage.rotation.counts_per_turn",
    REGISTRATION,
    "tracker.csv.time",
    "tracker.csv.stamp",
];
pub(super) const REGISTRATION: &str = "tracker.registration";
pub(super) const FIDUCIALS: &str = "tracker.registration.fiducials";

/// What the defaults say of each virtual drive. A real one has no defaults for these.
const DRIVE_FACTS: [&str; 17] = [
    "node",
    "vendor_id",
    "product_code",
    "counts_per_mm",
    "counts_per_turn",
    "sign",
    "reference",
    "zero",
    "homing",
    "quick_stop_deceleration_mm_per_s2",
    "quick_stop_deceleration_deg_per_s2",
    "min_mm",
    "max_mm",
    "speed_max_mm_per_s",
    "min_deg",
    "max_deg",
    "speed_max_deg_per_s",
];

/// Lays `layers` over each other, the defaults first.
pub(super) fn merge(layers: Vec<Entries>) -> Tree {
    let mut tree = Tree::new();
    for layer in layers {
        for (key, entry) in layer {
            lay(&mut tree, key, entry);
        }
    }
    drop_virtual_defaults(&mut tree);
    tree
}

fn lay(tree: &mut Tree, key: String, entry: Entry) {
    let layer = entry.layer;
    let replaced = match entry.value {
        // Fiducials take the place of a pose.
        Value::Array(_) if key == FIDUCIALS => Some(REGISTRATION),
        Value::Array(_) => Some(key.as_str()),
        _ => WHOLE.contains(&key.as_str()).then_some(key.as_str()),
    };
    if let Some(replaced) = replaced {
        tree.retain(|other, below| below.layer >= layer || !is_inside(other, replaced));
    }
    if let Some(group) = ALTERNATIVES.iter().find(|group| group.contains(&key.as_str())) {
        tree.retain(|other, below| below.layer >= layer || !group.contains(&other.as_str()));
    }
    tree.insert(key, entry);
}

/// True for keys of the table `key` and elements of the array `key`.
pub(super) fn is_inside(other: &str, key: &str) -> bool {
    other.strip_prefix(key).is_some_and(|rest| rest.starts_with(['.', '[']))
}

/// The virtual rig is no default for a real one: its drives are dropped with
/// `stage.hardware = true`, its registration with any `tracker.source` but `"emulated"`.
fn drop_virtual_defaults(tree: &mut Tree) {
    let holds = |key: &str, value: Value| tree.get(key).is_some_and(|entry| entry.value == value);
    let hardware = holds("stage.hardware", Value::Boolean(true));
    let emulated_tracker = holds("tracker.source", Value::String("emulated".to_owned()));
    tree.retain(|key, entry| {
        let dropped = hardware && is_drive_fact(key)
            || !emulated_tracker && (key == REGISTRATION || is_inside(key, REGISTRATION));
        entry.layer > 0 || !dropped
    });
}

fn is_drive_fact(key: &str) -> bool {
    ["stage.insertion.", "stage.rotation."]
        .iter()
        .filter_map(|axis| key.strip_prefix(axis))
        .any(|rest| DRIVE_FACTS.contains(&rest.split('.').next().unwrap_or(rest)))
}

/// The keys around `key`, nearest first: of `a.b[0].c`: `a.b[0]`, `a.b`, `a`.
pub(super) fn ancestors(key: &str) -> impl Iterator<Item = &str> {
    std::iter::successors(outer(key), |key| outer(key))
}

fn outer(key: &str) -> Option<&str> {
    key.rfind(['.', '[']).and_then(|end| key.get(..end))
}
