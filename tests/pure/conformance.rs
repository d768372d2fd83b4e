//! The tests that `docs/conformance.md` and `docs/hazards.md` name exist; those of the first are run.

use std::path::Path;

/// The names in backquotes in the last cell of each row.
fn named(text: &str) -> impl Iterator<Item = Vec<&str>> {
    let rows = text.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| what"));
    let cells = rows.filter_map(|row| row.trim_end_matches(['|', ' ']).rsplit('|').next());
    cells.map(|cell| cell.split('`').skip(1).step_by(2).collect())
}

fn sources(dir: &Path, text: &mut String) {
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, text);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            text.push_str(&std::fs::read_to_string(&path).unwrap());
        }
    }
}

/// How many tests of this name `code` has that are run: functions with `#[test]` and without `#[ignore]` or
/// `#[cfg]`.
fn tests_of(name: &str, code: &str) -> usize {
    let definition = format!("fn {name}(");
    let lines: Vec<&str> = code.lines().map(str::trim).collect();
    let is_test = |at: &usize| {
        let above = lines[..*at].iter().rev();
        let attributes: Vec<_> =
            above.take_while(|line| line.starts_with("#[") || line.starts_with("///")).collect();
        attributes.contains(&&"#[test]")
            && !attributes.iter().any(|line| line.starts_with("#[ignore") || line.contains("cfg"))
    };
    (0..lines.len()).filter(|at| lines[*at].starts_with(&definition)).filter(is_test).count()
}

/// The page, and all code of the project.
fn page_and_code(page: &str) -> (String, String) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut code = String::new();
    ["src", "tests"].iter().for_each(|dir| sources(&root.join(dir), &mut code));
    (std::fs::read_to_string(root.join(page)).unwrap(), code)
}

#[test]
fn every_row_of_conformance_names_tests_that_are_run() {
    let (table, code) = page_and_code("docs/conformance.md");
    let rows: Vec<_> = named(&table).collect();
    assert!(rows.len() > 40, "{} rows", rows.len());
    for names in rows {
        assert!(!names.is_empty(), "a row names no test");
        for name in names {
            assert!(tests_of(name, &code) > 0, "{name} is missing, ignored or not a test");
        }
    }
}

#[test]
fn every_test_that_hazards_names_exists() {
    let (tables, code) = page_and_code("docs/hazards.md");
    let is_word = |name: &&str| {
        name.contains('_') && name.chars().all(|c| c == '_' || c.is_ascii_alphanumeric())
    };
    let names: Vec<&str> = named(&tables).flatten().filter(is_word).collect();
    assert!(names.len() > 200, "{} names", names.len());
    for name in names {
        // A test is a function; a case within a test has its name as a string.
        let forms = [format!("fn {name}("), format!("\"{name}\"")];
        assert!(forms.iter().any(|form| code.contains(form)), "no test {name}");
    }
}

#[test]
fn names_are_read_from_the_last_cell() {
    let rows: Vec<_> = named("| what | test |\n| a `b` | `c`, `d` |\ntext `e`").collect();
    assert_eq!(rows, [["c", "d"]]);
}

#[test]
fn helpers_and_ignored_tests_do_not_count() {
    let code = "#[test]\n/// Why.\nfn run() {}\nfn helper() {}\n\
                #[test]\n#[ignore = \"slow\"]\nfn ignored() {}\n";
    assert_eq!(["run", "helper", "ignored", "gone"].map(|name| tests_of(name, code)), [1, 0, 0, 0]);
}
