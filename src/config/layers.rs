//! Laying one source over another, key by key.

use std::collections::BTreeMap;

use super::Config;
use super::value::{Entries, Entry, Value};
use crate::keys::find;

/// All sources laid over each other, by dotted key.
pub(super) type Tree = BTreeMap<String, Entry>;

pub(super) const REGISTRATION: &str = "tracker.registration";
pub(super) const FIDUCIALS: &str = "tracker.registration.fiducials";

/// Lays `layers` over each other, the lowest first.
pub(super) fn merge(layers: Vec<Entries>) -> Tree {
    let mut tree = Tree::new();
    for (key, entry) in layers.into_iter().flatten() {
        lay(&mut tree, key, entry);
    }
    tree
}

/// What is replaced as a whole is taken out of the layers below.
fn lay(tree: &mut Tree, key: String, entry: Entry) {
    let layer = entry.layer;
    let replaced = match entry.value {
        // Fiducials take the place of a pose.
        Value::Array(_) if key == FIDUCIALS => Some(REGISTRATION),
        Value::Array(_) => Some(key.as_str()),
        _ => find(Config::KEYS, &key).filter(|key| key.is_whole).map(|_| key.as_str()),
    };
    if let Some(replaced) = replaced {
        tree.retain(|other, below| {
            // Alternatives in one source are both kept, to be refused.
            let is_alternative = !is_inside(other, &key) && below.is_beside(&entry);
            below.layer >= layer || is_alternative || !is_inside(other, replaced)
        });
    }
    tree.insert(key, entry);
}

/// True for keys of the table `key` and elements of the array `key`.
pub(super) fn is_inside(other: &str, key: &str) -> bool {
    other.strip_prefix(key).is_some_and(|rest| rest.starts_with(['.', '[']))
}

/// The keys around `key`, nearest first: of `a.b[0].c`: `a.b[0]`, `a.b`, `a`.
pub(super) fn ancestors(key: &str) -> impl Iterator<Item = &str> {
    std::iter::successors(outer(key), |key| outer(key))
}

fn outer(key: &str) -> Option<&str> {
    key.rfind(['.', '[']).and_then(|end| key.get(..end))
}
