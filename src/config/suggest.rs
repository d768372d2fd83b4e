//! What the writer of an unknown key may have meant.

/// Similarity under which a known key is no suggestion.
const LEAST: f64 = 0.55;

/// Characters of a list of keys.
const LISTED_MAX: usize = 110;

/// A hint for the unknown `key`: the nearest of the known `keys`, or those of its section.
pub fn nearest_key<'a>(key: &str, keys: impl Iterator<Item = &'a str> + Clone) -> String {
    let rated = keys.clone().map(|known| (similarity(key, known), known));
    if let Some((similarity, known)) = rated.max_by(|a, b| a.0.total_cmp(&b.0))
        && similarity >= LEAST
    {
        return format!("did you mean \"{known}\"?");
    }
    let (section, _) = split(key);
    let siblings: Vec<&str> =
        keys.map(split).filter(|(of, _)| *of == section).map(|(_, name)| name).collect();
    match (siblings.is_empty(), section) {
        (true, _) => "nothing known is like it".to_owned(),
        (false, "") => format!("known are {}", listed(&siblings)),
        (false, section) => format!("known in [{section}] are {}", listed(&siblings)),
    }
}

/// As many of `names` as a line has room for.
fn listed(names: &[&str]) -> String {
    let mut length = 0;
    let fitting = names.iter().take_while(|name| {
        length += name.len() + 2;
        length <= LISTED_MAX
    });
    let shown: Vec<&str> = fitting.copied().collect();
    match names.len() - shown.len() {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

/// Mostly of the last parts, so that a key in the wrong section is found too.
fn similarity(key: &str, known: &str) -> f64 {
    let ((section, name), (known_section, known_name)) = (split(key), split(known));
    0.8 * strsim::normalized_damerau_levenshtein(name, known_name)
        + 0.2 * strsim::normalized_damerau_levenshtein(section, known_section)
}

/// (section, name) of a dotted key.
fn split(key: &str) -> (&str, &str) {
    key.rsplit_once('.').unwrap_or(("", key))
}
