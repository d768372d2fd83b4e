//! `run --console` on a pseudoterminal: its keys, and runs whose terminal is tiny, takes no output, or is closed.
#![cfg(target_os = "linux")]

use crate::support::needed;
use crate::support::programs::{self, LONG, Scratch, beside_others, send_signal};
use crate::support::recorded;
use crate::support::replays::assert_it_replays;
use crate::support::terminal::OnTerminal;
use crate::support::udp_stage::Stage;
use crate::support::witness::Witness;
use std::fs;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

/// The console leaves the alternate screen.
const LEFT: &str = "\x1b[?1049l";

/// Permits an insertion that is too short to reach the plane.
const FAR: &str = "insertion.plane_out_of_reach=\"insert\"";

const BELL: char = '\x07';

/// Starts an insertion to `depth_mm` on a terminal of `size` (rows, columns); `None` without `script`.
fn on_terminal(
    scratch: &Scratch,
    stage: &Stage,
    size: [u16; 2],
    depth_mm: u32,
) -> Option<OnTerminal> {
    let depth = format!("insertion.depth_mm={depth_mm}");
    let bench = scratch.command(&["--console"], &stage.settings(&[&depth, FAR]));
    OnTerminal::start(&bench, &scratch.path("keyboard"), size)
}

#[test]
fn the_keys_hold_step_slow_down_resume_and_stop() {
    let _machine = beside_others();
    let scratch = Scratch::new("console");
    let stage = Stage::start(&[]);
    let Some(mut bench) = on_terminal(&scratch, &stage, [24, 80], 100) else { return };
    scratch.wait_for_event("inserting");
    thread::sleep(Duration::from_millis(300));
    bench.press("-");
    scratch.wait_for_event("operator: speed 4.500 mm/s, was 5.000");
    thread::sleep(Duration::from_millis(300));
    bench.press("+");
    scratch.wait_for_event("operator: speed 5.000 mm/s, was 4.500");
    // Resume has no effect before the hold, nor has an arrow key.
    bench.press("r\x1b[A ");
    scratch.wait_for_event("operator: hold at ");
    thread::sleep(Duration::from_millis(300));
    bench.press("s");
    scratch.wait_for_event("the step ends; held, ");
    bench.press("+");
    scratch.wait_for_event("operator: speed 5.500 mm/s refused: allowed: over 0 and up to 5 mm/s");
    bench.press("---");
    scratch.wait_for_event("operator: speed 3.500 mm/s, was 4.000");
    thread::sleep(Duration::from_millis(300));
    bench.press("r");
    scratch.wait_for_event("operator: resume at ");
    let run_dir = scratch.run_dir();
    bench.press("q");
    scratch.wait_for_event("operator: interrupted");
    // The console stays open, and the needle is withdrawn as after a completed run.
    bench.press_to_the_end(&["w", "y"]);
    let ended = bench.program.end();
    ended.assert_status(1);
    assert!(ended.stdout.contains(LEFT), "{}", ended.stdout);
    assert!(ended.stdout.contains("insertion   from 0.000 to -"), "{}", ended.stdout);
    assert!(!ended.stdout.contains(BELL), "a bell without a fault");
    let manifest = programs::manifest(&run_dir);
    assert_eq!(manifest["stop_reason"], "operator: interrupted");
    assert_it_replays(&run_dir);
    assert!(stage.assert_it_stands().abs() < 0.1);
    recorded::keep(&run_dir, "operator");
}

/// An operator practises with the configuration of the rig.
#[test]
fn a_rehearsal_on_the_console_runs_in_real_time_and_obeys_the_keys() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-rehearsal");
    let mut bench = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    bench.current_dir(env!("CARGO_MANIFEST_DIR"));
    bench.args(["run", "bench-config/rig-epos4.toml", "--rehearse", "--console"]);
    let record = format!("record.dir=\"{}\"", scratch.path("runs").display());
    for set in [&record, "insertion.depth_mm=3", FAR] {
        bench.args(["--set", set]);
    }
    let begun = Instant::now();
    let Some(mut bench) = OnTerminal::start(&bench, &scratch.path("keyboard"), [24, 80]) else {
        return;
    };
    scratch.wait_for_event("inserting");
    bench.press(" ");
    scratch.wait_for_event("operator: hold at ");
    thread::sleep(Duration::from_secs(1));
    bench.press("r");
    scratch.wait_for_event("operator: resume at ");
    scratch.wait_for_event("completed");
    let took_s = begun.elapsed().as_secs_f64();
    let run_dir = scratch.run_dir();
    bench.press_to_the_end(&["w", "y"]);
    let ended = bench.program.end();
    ended.assert_status(0);
    assert!(ended.stdout.contains("insertion   from 3.0"), "{}", ended.stdout);
    let duration_s = programs::manifest(&run_dir)["duration_s"].as_f64().expect("a duration");
    println!("a run of {duration_s:.1} s took {took_s:.1} s");
    // 3 mm at 1 mm/s and a hold of 1 s.
    assert!(duration_s > 4.0 && took_s >= duration_s - 0.1, "{duration_s} s took {took_s} s");
    assert_it_replays(&run_dir);
}

#[test]
fn a_fault_rings_the_bell_once() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-bell");
    let stage =
        Stage::start(&["--set", "emulator.fault=[{ at_mm = 3, kind = \"emergency-stop\" }]"]);
    let Some(mut bench) = on_terminal(&scratch, &stage, [24, 80], 20) else { return };
    scratch.wait_for_event("stopped");
    thread::sleep(Duration::from_millis(500));
    bench.press_to_the_end(&["q"]);
    let ended = bench.program.end();
    ended.assert_status(1);
    assert_eq!(ended.stdout.matches(BELL).count(), 1, "{}", ended.stdout);
}

/// After the run the console stays open. SIGTERM closes it, and the output ends with the command to withdraw the
/// needle.
#[test]
fn a_run_completes_on_a_terminal_of_one_character() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-tiny");
    let stage = Stage::start(&[]);
    let Some(bench) = on_terminal(&scratch, &stage, [1, 1], 3) else { return };
    scratch.wait_for_event("completed");
    send_signal(bench.process(), "TERM");
    let ended = bench.program.end();
    ended.assert_status(0);
    let config = scratch.run_dir().join("config.toml");
    let next = format!("next        needle-bench stage withdraw {} --by 3.0mm", config.display());
    assert!(ended.stdout.contains(&next), "{}", ended.stdout);
}

/// With `zero = "start"` the axis reads 0 where the withdrawal begins, so it goes to −3 mm.
#[test]
fn the_needle_is_withdrawn_after_the_run() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-withdraw");
    let stage = Stage::start(&[]);
    let Some(mut bench) = on_terminal(&scratch, &stage, [24, 80], 3) else { return };
    scratch.wait_for_event("completed");
    bench.press_to_the_end(&["w", "y"]);
    let ended = bench.program.end();
    ended.assert_status(0);
    assert!(ended.stdout.contains("from 0.000 to -3.0"), "{}", ended.stdout);
    assert!(stage.assert_it_stands().abs() < 0.1);
}

/// The folder of the runs has become a file meanwhile, so that no record can be made, as on a full disk.
#[test]
fn the_needle_is_withdrawn_although_nothing_can_be_recorded() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-no-record");
    let stage = Stage::start(&[]);
    let Some(mut bench) = on_terminal(&scratch, &stage, [24, 80], 3) else { return };
    scratch.wait_for_event("completed");
    fs::rename(scratch.path("runs"), scratch.path("before")).unwrap();
    fs::write(scratch.path("runs"), "").unwrap();
    bench.press_to_the_end(&["w", "y"]);
    let ended = bench.program.end();
    ended.assert_status(3);
    assert!(ended.stdout.contains("; the withdrawal is not recorded"), "{}", ended.stdout);
    assert!(ended.stdout.contains("from 0.000 to -3.0"), "{}", ended.stdout);
    assert!(stage.assert_it_stands().abs() < 0.1);
}

/// Ctrl-S with and without the terminal's own flow control, and a window that is made tiny and large again.
#[test]
fn a_run_completes_after_ctrl_s_and_resizing_of_its_terminal() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-resized");
    let stage = Stage::start(&[]);
    let Some(mut bench) = on_terminal(&scratch, &stage, [24, 80], 20) else { return };
    scratch.wait_for_event("inserting");
    let terminal = bench.terminal();
    let stty = |settings: &[&str]| {
        let set = Command::new("stty").arg("-F").arg(&terminal).args(settings).status();
        assert!(set.expect("stty").success(), "{settings:?}");
    };
    for size in [["1", "1"], ["60", "200"], ["1", "200"], ["60", "1"], ["24", "80"]] {
        stty(&["rows", size[0], "cols", size[1]]);
        thread::sleep(Duration::from_millis(250));
    }
    // In raw mode the console ignores Ctrl-S. With flow control by the terminal it stops the output until Ctrl-Q.
    bench.press("\x13");
    stty(&["ixon"]);
    bench.press("\x13");
    thread::sleep(Duration::from_secs(1));
    bench.press(" ");
    scratch.wait_for_event("operator: hold at ");
    thread::sleep(Duration::from_millis(500));
    bench.press("r");
    scratch.wait_for_event("operator: resume at ");
    scratch.wait_for_event("completed");
    bench.press("\x11");
    bench.press_to_the_end(&["q"]);
    let ended = bench.program.end();
    ended.assert_status(0);
    assert!(ended.stdout.contains(LEFT), "the alternate screen stays: {}", ended.stdout);
    assert_it_replays(&scratch.run_dir());
}

#[test]
fn drives_stop_when_the_bench_is_killed_with_its_console() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-killed");
    let stage = Stage::start(&[]);
    let Some(bench) = on_terminal(&scratch, &stage, [24, 80], 100) else { return };
    scratch.wait_for_event("inserting");
    let mut witness = Witness::of(&stage);
    send_signal(bench.process(), "KILL");
    let ended = bench.program.end();
    assert_ne!(ended.status.code(), Some(0), "killed");
    assert!(!ended.stdout.contains(LEFT), "a killed bench cannot leave the alternate screen");
    // The drives report the missing heartbeat.
    witness.wait_for_emergency();
    stage.assert_it_stands();
}

/// As with Ctrl-S in a terminal program, or a remote connection that hangs.
#[test]
fn a_run_completes_while_its_terminal_takes_no_output() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-frozen");
    let stage = Stage::start(&[]);
    let Some(mut bench) = on_terminal(&scratch, &stage, [40, 120], 15) else { return };
    scratch.wait_for_event("inserting");
    bench.program.signal("STOP");
    scratch.wait_for_event("completed");
    bench.program.signal("CONT");
    bench.press_to_the_end(&["q"]);
    let ended = bench.program.end();
    ended.assert_status(0);
    assert!(ended.stdout.contains(LEFT));
    let timing = &programs::manifest(&scratch.run_dir())["timing"];
    println!("{timing}");
}

#[test]
fn a_closed_terminal_stops_the_run() {
    let _machine = beside_others();
    let scratch = Scratch::new("console-gone");
    let stage = Stage::start(&[]);
    let Some(bench) = on_terminal(&scratch, &stage, [24, 80], 100) else { return };
    scratch.wait_for_event("inserting");
    bench.program.signal("KILL");
    scratch.wait_for_event("operator: interrupted");
    scratch.wait_for_event("stopped");
    assert_it_replays(&scratch.run_dir());
    stage.assert_it_stands();
}

/// Without the console, too, and although the last lines have nowhere to go.
#[test]
fn a_run_whose_terminal_is_closed_ends_as_stopped() {
    let _machine = beside_others();
    let scratch = Scratch::new("terminal-gone");
    let stage = Stage::start(&[]);
    let terminal = nix::pty::openpty(None, None).unwrap();
    let end = || terminal.slave.try_clone().unwrap();
    let mut bench = scratch.command(&[], &stage.settings(&["insertion.depth_mm=100", FAR]));
    let mut bench = bench.stdin(end()).stdout(end()).stderr(end()).spawn().unwrap();
    scratch.wait_for_event("inserting");
    drop(terminal);
    send_signal(bench.id(), "HUP");
    assert_eq!(bench.wait().unwrap().code(), Some(1));
    let manifest = programs::manifest(&scratch.run_dir());
    assert_eq!(manifest["stop_reason"], "operator: interrupted");
    stage.assert_it_stands();
}

/// A tmux server of its own, which ends with the test.
struct Tmux {
    socket: String,
}

impl Tmux {
    fn run(&self, words: &[&str]) -> String {
        let mut command = Command::new("tmux");
        let ran = command.args(["-f", "/dev/null", "-L", &self.socket]).args(words).output();
        let ran = ran.expect("tmux");
        assert!(ran.status.success(), "{words:?}: {}", String::from_utf8_lossy(&ran.stderr));
        String::from_utf8(ran.stdout).expect("UTF-8")
    }

    /// Waits until the screen contains `text`, and returns the screen.
    #[track_caller]
    fn wait_for(&self, text: &str) -> String {
        self.wait_until(|screen| screen.contains(text))
    }

    /// Waits until `is_shown`, and returns the screen. A test of a whole screen must wait for what is drawn last,
    /// because tmux also returns a screen that is half drawn.
    #[track_caller]
    fn wait_until(&self, is_shown: impl Fn(&str) -> bool) -> String {
        let end = Instant::now() + LONG;
        loop {
            let screen = self.run(&["capture-pane", "-p"]);
            if is_shown(&screen) {
                return screen;
            }
            assert!(Instant::now() < end, "not on the screen, which is:\n{screen}");
            thread::sleep(Duration::from_millis(50));
        }
    }
}

impl Drop for Tmux {
    fn drop(&mut self) {
        let _ = Command::new("tmux").args(["-L", &self.socket, "kill-server"]).output();
    }
}

/// Reads the screens as another terminal program shows them.
#[test]
fn tmux_shows_the_console_at_several_sizes() {
    let _machine = beside_others();
    if Command::new("tmux").arg("-V").output().is_err() {
        return needed::skip("tmux", "install it: apt-get install tmux");
    }
    let scratch = Scratch::new("console-tmux");
    let stage = Stage::start(&[]);
    let bench = scratch.command(&["--console"], &stage.settings(&["insertion.depth_mm=100", FAR]));
    let words = [bench.get_program()].into_iter().chain(bench.get_args());
    let words: Vec<_> = words.map(|word| word.to_str().expect("UTF-8")).collect();
    let tmux = Tmux { socket: format!("needle-bench-{}", std::process::id()) };
    let folder = env!("CARGO_MANIFEST_DIR");
    // Keeps the last output of the bench on the screen.
    let shell = ["sh", "-c", "\"$@\"; echo status $?; exec sleep 600", "sh"];
    let start = ["new-session", "-d", "-x", "80", "-y", "24", "-c", folder];
    tmux.run(&[&start[..], &shell, &words].concat());
    let resize = |columns: &str, rows: &str| {
        tmux.run(&["resize-window", "-x", columns, "-y", rows]);
    };
    let press = |key: &str| tmux.run(&["send-keys", key]);

    tmux.wait_for(" INSERTING");
    press("Space");
    let has_event =
        |screen: &str| screen.lines().skip(19).any(|line| line.contains("operator: hold at "));
    let screen =
        tmux.wait_until(|screen| screen.contains(" HELD BY OPERATOR") && has_event(screen));
    let lines: Vec<&str> = screen.lines().collect();
    assert_eq!(lines.len(), 24, "{screen}");
    assert!(lines[1].contains(" of 100.0 mm "), "{screen}");
    assert!(lines[2].starts_with(" x ") && lines[2].contains(" roll "), "{screen}");
    assert!(lines[3].starts_with("┌x mm over depth─") && lines[3].contains("┌from above: x─"));
    assert!(lines[14].starts_with("┌tracker─") && lines[14].contains("┌bus, record─"), "{screen}");
    assert!(lines[19..23].iter().any(|line| line.contains("operator: hold at ")), "{screen}");
    assert!(lines[23].starts_with(" space hold   r resume   s step 1 mm "), "{screen}");

    resize("60", "20");
    let keys = "space hold r resume s step + - speed q stop ? help";
    let screen =
        tmux.wait_until(|screen| screen.contains("┌x mm over depth") && screen.contains(keys));
    assert!(screen.starts_with(" HELD BY OPERATOR"), "{screen}");
    assert!(!screen.contains("┌tracker"), "{screen}");
    resize("40", "10");
    tmux.wait_for("\nspace hold r resume s step + - q stop ?");
    resize("1", "1");
    thread::sleep(Duration::from_millis(300));
    resize("120", "40");
    press("?");
    let last = "withdraw the needle; y confirms";
    let helped = tmux.wait_until(|screen| screen.contains("┌keys─") && screen.contains(last));
    assert!(helped.starts_with(" HELD BY OPERATOR"), "{helped}");
    press("?");
    press("s");
    tmux.wait_for(" HELD AFTER STEP");
    press("-");
    tmux.wait_for("4.50 mm/s");
    press("r");
    tmux.wait_for(" INSERTING  operator: resume");
    press("q");
    tmux.wait_for(" STOPPED  operator: interrupted");
    tmux.wait_for("w withdraw the needle");
    press("w");
    tmux.wait_for("y yes   any other key no");
    press("y");
    tmux.wait_for("status 1");
    assert!(stage.assert_it_stands().abs() < 0.1);
}
