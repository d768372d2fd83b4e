//! The worked protocol of docs/rig.md.

use super::program::repository;

/// The commands of the page in its order: each as it is printed, and its words after `needle-bench`.
pub(crate) fn commands() -> Vec<(String, Vec<String>)> {
    let page = std::fs::read_to_string(repository("docs/rig.md")).expect("the page");
    let lines = page.lines().filter_map(|line| line.strip_prefix("needle-bench "));
    let commands = lines.map(|line| {
        let line = line.split(" #").next().unwrap_or_default().trim();
        (line.to_owned(), words(line))
    });
    commands.collect()
}

/// The words of a command line whose quoted argument has no space at its ends.
fn words(line: &str) -> Vec<String> {
    let parts = line.split('\'').enumerate();
    let words = parts.flat_map(|(n, part)| match n % 2 {
        0 => part.split_whitespace().map(str::to_owned).collect(),
        _ => vec![part.to_owned()],
    });
    words.collect()
}
