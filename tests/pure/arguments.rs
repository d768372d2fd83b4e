//! How commands take their configuration; help, completions and man pages.

use crate::support::program::{Scratch, needle_bench};
use std::fs;
use std::process::Command;

/// Either of the two, not both.
#[test]
fn every_command_takes_its_configuration_as_argument_or_flag() {
    let scratch = Scratch::new();
    // The unknown key shows that the command has read the file.
    scratch.write("rig.toml", "[nowhere]\nkey = 1\n");
    scratch.write("points.csv", "");
    for command in [
        &["run"][..],
        &["plan"],
        &["check"],
        &["study"],
        &["stop"],
        &["stage", "status"],
        &["stage", "reset"],
        &["stage", "home"],
        &["stage", "jog", "--axis", "insertion", "--by", "1mm"],
        &["stage", "withdraw"],
        &["stage", "prove"],
        &["stage", "stop"],
        &["tracker", "list"],
        &["tracker", "watch"],
        &["tracker", "rest"],
        &["tracker", "record", "new.csv"],
        &["calibrate", "registration", "points.csv"],
        &["calibrate", "tracker", "points.csv"],
        &["calibrate", "needle", "points.csv"],
        &["evaluate", "points.csv"],
    ] {
        let named = [command, &["--config", "rig.toml"]].concat();
        let said = [[command, &["rig.toml"]].concat(), named.clone()].map(|arguments| {
            let said = needle_bench(&scratch, &arguments);
            assert_eq!(said.status, 2, "{}", said.screen());
            said.stderr
        });
        assert_eq!(said[0], said[1], "{command:?}");
        // `stop` reads [can] and the nodes only, and the file has none.
        let expected = if command.contains(&"stop") { "stage.insertion.node" } else { "rig.toml:" };
        assert!(said[0].contains(expected), "{command:?}: {}", said[0]);
        let twice = [&named[..], &["rig.toml"]].concat();
        let said = needle_bench(&scratch, &twice);
        // A command that takes many files finds its configuration among them by the extension.
        let refused = ["cannot be used with", "two configurations, rig.toml and rig.toml"];
        assert!(refused.iter().any(|text| said.stderr.contains(text)), "{}", said.screen());
    }
}

#[test]
fn a_mistyped_command_or_flag_is_answered_with_a_suggestion() {
    let scratch = Scratch::new();
    for (typed, meant) in [
        (&["chekc"][..], "'check'"),
        (&["jog", "--by", "2mm"], "'stage jog'"),
        (&["stage", "withdarw"], "'withdraw'"),
        (&["run", "--rehears"], "'--rehearse'"),
        (&["stage", "jog", "--axis", "insertion", "--spede", "2mm"], "'--speed'"),
    ] {
        let said = needle_bench(&scratch, typed);
        assert_eq!(said.status, 2);
        assert!(said.stderr.contains(meant), "{}", said.stderr);
    }
}

#[test]
fn completions_and_man_pages_name_the_commands() {
    let scratch = Scratch::new();
    for shell in ["bash", "zsh", "fish"] {
        let said = needle_bench(&scratch, &["generate", shell]);
        assert_eq!(said.status, 0, "{}", said.stderr);
        for word in ["withdraw", "rehearse", "calibrate"] {
            assert!(said.stdout.contains(word), "{shell}: {word}");
        }
    }
    let said = needle_bench(&scratch, &["generate", "man", "man1"]);
    assert_eq!((said.status, said.stdout.as_str()), (0, ""), "{}", said.stderr);
    let page = fs::read_to_string(scratch.path().join("man1/needle-bench-stage-jog.1")).unwrap();
    assert!(page.contains("how fast") || page.contains("How fast"), "{page}");
}

#[test]
fn generate_exits_3_on_a_full_device_and_0_on_a_closed_pipe() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    let full = fs::OpenOptions::new().write(true).open("/dev/full").expect("/dev/full");
    let status = command.args(["generate", "bash"]).stdout(full).status().expect("it starts");
    assert_eq!(status.code(), Some(3));
    // As in `needle-bench generate bash | true`.
    let (reader, closed) = std::io::pipe().expect("a pipe");
    drop(reader);
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    let status = command.args(["generate", "bash"]).stdout(closed).status().expect("it starts");
    assert_eq!(status.code(), Some(0));
}

/// The commands that this help lists, without `help`.
fn commands_in(help: &str) -> Vec<&str> {
    let commands = help.split_once("Commands:\n").expect("a list of commands").1;
    let lines = commands.lines().take_while(|line| !line.is_empty());
    let lines = lines.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    let names = lines.filter_map(|line| line.split_whitespace().next());
    names.filter(|name| *name != "help").collect()
}

#[test]
fn the_help_of_each_command_has_an_example() {
    let scratch = Scratch::new();
    let help = needle_bench(&scratch, &["--help"]).stdout;
    let names = commands_in(&help);
    assert!(names.len() >= 12, "{names:?}");
    for name in names {
        let help = needle_bench(&scratch, &[name, "--help"]).stdout;
        assert!(help.contains(&format!("Examples:\n  needle-bench {name}")), "{help}");
    }
}

#[test]
fn the_summary_of_stage_names_every_operation() {
    let help = needle_bench(&Scratch::new(), &["stage", "--help"]).stdout;
    let (summary, _) = help.split_once("Usage:").expect("a summary");
    let names = commands_in(&help);
    assert!(names.contains(&"reset"), "{help}");
    for name in names {
        assert!(summary.contains(name), "{name}: {summary}");
    }
}

#[test]
fn review_without_a_path_shows_the_newest_run() {
    let scratch = Scratch::new();
    let said = needle_bench(&scratch, &["review"]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("no run in runs"), "{}", said.stderr);
    for name in ["first", "second"] {
        let set = format!("name={name}");
        let run = ["run", "-q", "--set", "insertion.depth_mm=2", "--set", &set];
        assert_eq!(needle_bench(&scratch, &run).status, 0);
        // The name of a folder has the second at which the run started.
        std::thread::sleep(std::time::Duration::from_millis(1100));
    }
    let json = needle_bench(&scratch, &["review", "--json"]).json();
    assert_eq!(json["name"], "second");
}
