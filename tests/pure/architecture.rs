//! The invariants that ARCHITECTURE.md marks as tested.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// The table of ARCHITECTURE.md: for each folder those that it may use.
fn granted() -> BTreeMap<String, BTreeSet<String>> {
    let text = std::fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    text.lines()
        .filter_map(|line| {
            let mut cells = line.strip_prefix("| `")?.split('|');
            let folder = cells.next()?.trim().trim_matches('`').to_owned();
            let may_use = cells.nth(1)?;
            let names = may_use.split(',').map(|name| name.trim().to_owned());
            Some((folder, names.filter(|name| !name.is_empty()).collect()))
        })
        .collect()
}

/// Folder, path and code of every source file in `src`, without tests and comments.
fn sources() -> Vec<(String, PathBuf, String)> {
    fn walk(dir: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                if path.file_name().is_some_and(|name| name != "tests") {
                    walk(&path, found);
                }
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                found.push(path);
            }
        }
    }
    let src = root().join("src");
    let mut files = Vec::new();
    walk(&src, &mut files);
    files
        .into_iter()
        .filter_map(|path| {
            let inside = path.strip_prefix(&src).unwrap().to_path_buf();
            let first = inside.iter().next().unwrap().to_str().unwrap();
            let folder = first.trim_end_matches(".rs").to_owned();
            if ["lib", "main"].contains(&folder.as_str()) || inside.ends_with("tests.rs") {
                return None;
            }
            let text = std::fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
            let code = code.lines().filter(|line| !line.trim_start().starts_with("//"));
            Some((folder, inside, code.collect::<Vec<_>>().join("\n")))
        })
        .collect()
}

/// The folders that `code` names as `crate::folder`.
fn named(code: &str) -> BTreeSet<String> {
    let names = code.split("crate::").skip(1).map(|rest| {
        rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>()
    });
    names.filter(|name| !name.is_empty()).collect()
}

#[test]
fn a_folder_uses_only_the_folders_that_the_table_grants() {
    let granted = granted();
    let sources = sources();
    let folders: BTreeSet<&String> = sources.iter().map(|(folder, ..)| folder).collect();
    for folder in &folders {
        assert!(
            granted.contains_key(*folder),
            "ARCHITECTURE.md does not say what {folder} may use"
        );
    }
    for (folder, file, code) in &sources {
        for used in named(code) {
            let allowed = &granted[folder];
            assert!(
                used == *folder || allowed.contains(&used) || allowed.contains("everything"),
                "{}: {folder} may not use {used}",
                file.display()
            );
        }
    }
}

#[test]
fn the_table_of_folders_has_no_cycle() {
    let mut open = granted();
    while !open.is_empty() {
        let free: Vec<String> = open
            .iter()
            .filter(|(_, uses)| !uses.iter().any(|used| open.contains_key(used)))
            .map(|(folder, _)| folder.clone())
            .collect();
        assert!(!free.is_empty(), "a cycle among {:?}", open.keys());
        open.retain(|folder, _| !free.contains(folder));
    }
}

/// The folders that are not pure.
const OUTSIDE: [&str; 4] = ["transport", "telemetry", "runtime", "cli"];

#[test]
fn pure_code_names_no_clock_file_socket_or_thread() {
    let impure = [
        "std::fs",
        "std::net",
        "std::thread",
        "std::process",
        "std::env",
        "Instant",
        "SystemTime",
        "tokio",
        "socketcan::",
        "println!",
        "eprintln!",
    ];
    for (folder, file, code) in sources() {
        if OUTSIDE.contains(&folder.as_str()) {
            continue;
        }
        for word in impure {
            assert!(!code.contains(word), "{}: {folder} names {word}", file.display());
        }
    }
}

/// The system's library rounds sines and logarithms differently on each machine: a run would not replay
/// bit for bit.
#[test]
fn pure_code_takes_its_sines_from_math() {
    let of_the_system_library = [
        "sin", "cos", "tan", "sin_cos", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh",
        "asinh", "acosh", "atanh", "exp", "exp2", "exp_m1", "ln", "ln_1p", "log2", "log10", "powf",
        "cbrt", "hypot", "mul_add",
    ];
    for (folder, file, code) in sources() {
        if OUTSIDE.contains(&folder.as_str()) {
            continue;
        }
        for function in of_the_system_library {
            for called in [format!(".{function}("), format!("f64::{function}")] {
                assert!(!code.contains(&called), "{}: {called} is not from math", file.display());
            }
        }
        assert!(folder == "math" || !code.contains("libm::"), "{} names libm", file.display());
        // The first two iterate, and the others multiply, in an order that differs between machines.
        for word in ["HashMap", "HashSet", "DMatrix", "DVector"] {
            assert!(!code.contains(word), "{} names {word}", file.display());
        }
    }
}

#[test]
fn only_telemetry_names_rerun() {
    for (folder, file, code) in sources() {
        let names = code.contains("rerun::");
        assert!(!names || folder == "telemetry", "{} names rerun", file.display());
    }
}

/// If the scan found nothing, every test above would pass.
#[test]
fn the_scan_finds_paths() {
    assert_eq!(named("use crate::needle::{A, B};\nfn f() { crate::stage::g() }").len(), 2);
    assert!(
        sources()
            .iter()
            .any(|(folder, _, code)| folder == "session" && named(code).contains("stage"))
    );
}
