//! `run --console` on a pseudoterminal, which `script` (util-linux) makes: its keys, and what becomes of a
//! run whose terminal is tiny, takes no output, or is gone.
#![cfg(target_os = "linux")]

use crate::support::programs::{self, LONG, Program, Scratch, alone};
use crate::support::recorded;
use crate::support::replays::assert_it_replays;
use crate::support::udp_stage::Stage;
use std::fs::{self, File};
use std::io::Write;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

/// What gives the terminal back: the other screen is left.
const LEFT: &str = "\x1b[?1049l";

/// A bench on a terminal, and its keyboard.
struct OnTerminal {
    program: Program,
    keyboard: File,
}

impl OnTerminal {
    /// Starts an insertion to this depth on a terminal of so many rows and columns; `None` without
    /// `script`.
    fn start(scratch: &Scratch, stage: &Stage, size: [u16; 2], depth_mm: u32) -> Option<Self> {
        if Command::new("script").arg("--version").output().is_err() {
            eprintln!("skipped: script (util-linux) is not installed");
            return None;
        }
        let fifo = scratch.path("keyboard");
        let made = Command::new("mkfifo").arg(&fifo).status();
        assert!(made.expect("mkfifo").success());
        let depth = format!("insertion.depth_mm={depth_mm}");
        let far = "insertion.plane_out_of_reach=\"insert\"";
        let bench = scratch.command(&["--console"], &stage.settings(&[&depth, far]));
        let words = [bench.get_program()].into_iter().chain(bench.get_args());
        let words = words.map(|word| format!("'{}'", word.to_str().expect("UTF-8")));
        let [rows, columns] = size;
        let inside = format!(
            "stty rows {rows} cols {columns}; exec {}",
            words.collect::<Vec<_>>().join(" ")
        );
        // Open to read and write, so that neither side waits for the other.
        let keyboard = File::options().read(true).write(true).open(&fifo).expect("a keyboard");
        let mut script = Command::new("sh");
        script
            .args(["-c", "exec script -qfec \"$1\" /dev/null < \"$2\"", "sh", &inside])
            .arg(&fifo)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .env("TERM", "xterm");
        Some(OnTerminal { program: Program::start(&mut script), keyboard })
    }

    fn press(&mut self, keys: &str) {
        self.keyboard.write_all(keys.as_bytes()).expect("pressed");
    }
}

/// Waits until the run's `events.log` has `text`.
#[track_caller]
fn wait_for(scratch: &Scratch, text: &str) {
    let end = Instant::now() + 3 * LONG;
    let said = || {
        let runs = fs::read_dir(scratch.path("runs")).into_iter().flatten().flatten();
        let logs = runs.map(|run| fs::read_to_string(run.path().join("events.log")));
        logs.filter_map(Result::ok).collect::<String>()
    };
    while !said().contains(text) {
        assert!(Instant::now() < end, "not recorded: {text:?}, but:\n{}", said());
        thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn the_keys_hold_step_slow_down_resume_and_stop() {
    let _alone = alone();
    let scratch = Scratch::new("console");
    let stage = Stage::start(&[]);
    let Some(mut bench) = OnTerminal::start(&scratch, &stage, [24, 80], 100) else { return };
    wait_for(&scratch, "inserting");
    // A resume before the hold is void; so is an arrow.
    bench.press("r\x1b[A ");
    wait_for(&scratch, "operator: hold at ");
    thread::sleep(Duration::from_millis(300));
    bench.press("s");
    wait_for(&scratch, "the step ends; held, ");
    bench.press("-");
    wait_for(&scratch, "operator: speed 4.500 mm/s, was 5.000");
    bench.press("+");
    wait_for(&scratch, "operator: speed 5.000 mm/s, was 4.500");
    thread::sleep(Duration::from_millis(300));
    bench.press("+");
    wait_for(&scratch, "refused: allowed: over 0 and up to 5 mm/s");
    thread::sleep(Duration::from_millis(300));
    bench.press("r");
    wait_for(&scratch, "operator: resume at ");
    bench.press("q");
    let ended = bench.program.end();
    ended.assert_status(1);
    assert!(ended.stdout.contains(LEFT), "{}", ended.stdout);
    let manifest = programs::manifest(&scratch.run_dir());
    assert_eq!(manifest["stop_reason"], "operator: interrupted");
    assert_it_replays(&scratch.run_dir());
    stage.assert_it_stands();
    recorded::keep(&scratch.run_dir(), "operator");
}

/// After its end the screen stays until the operator leaves it, to the command that withdraws.
#[test]
fn a_terminal_of_one_character() {
    let _alone = alone();
    let scratch = Scratch::new("console-tiny");
    let stage = Stage::start(&[]);
    let Some(mut bench) = OnTerminal::start(&scratch, &stage, [1, 1], 3) else { return };
    wait_for(&scratch, "completed");
    thread::sleep(Duration::from_secs(2));
    bench.press("w");
    let ended = bench.program.end();
    ended.assert_status(0);
    let next = "next        needle-bench stage withdraw ";
    assert!(ended.stdout.contains(next), "{}", ended.stdout);
}

/// A terminal that takes no output (Ctrl-S at its far end, a link that hangs) delays nothing.
#[test]
fn a_terminal_that_is_frozen() {
    let _alone = alone();
    let scratch = Scratch::new("console-frozen");
    let stage = Stage::start(&[]);
    let Some(mut bench) = OnTerminal::start(&scratch, &stage, [40, 120], 15) else { return };
    wait_for(&scratch, "inserting");
    bench.program.signal("STOP");
    wait_for(&scratch, "completed");
    bench.program.signal("CONT");
    thread::sleep(Duration::from_secs(3));
    bench.press("q");
    let ended = bench.program.end();
    ended.assert_status(0);
    assert!(ended.stdout.contains(LEFT));
    let timing = &programs::manifest(&scratch.run_dir())["timing"];
    println!("{timing}");
}

/// The terminal is closed, or its connection ends: the run stops, as without a console.
#[test]
fn a_terminal_that_is_gone() {
    let _alone = alone();
    let scratch = Scratch::new("console-gone");
    let stage = Stage::start(&[]);
    let Some(bench) = OnTerminal::start(&scratch, &stage, [24, 80], 100) else { return };
    wait_for(&scratch, "inserting");
    bench.program.signal("KILL");
    wait_for(&scratch, "operator: interrupted");
    wait_for(&scratch, "stopped");
    assert_it_replays(&scratch.run_dir());
    stage.assert_it_stands();
}
