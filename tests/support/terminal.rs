//! A program on a pseudoterminal, which `script` (util-linux) makes, with a keyboard.

use super::needed;
use super::programs::{LONG, Program};
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

pub(crate) struct OnTerminal {
    pub(crate) program: Program,
    keyboard: File,
}

impl OnTerminal {
    /// Starts `command` on a terminal of `size` (rows, columns), with a new pipe at `keyboard` as its keys; `None`
    /// without `script`.
    pub(crate) fn start(command: &Command, keyboard: &Path, size: [u16; 2]) -> Option<Self> {
        if Command::new("script").arg("--version").output().is_err() {
            needed::skip("script", "install util-linux");
            return None;
        }
        let made = Command::new("mkfifo").arg(keyboard).status();
        assert!(made.expect("mkfifo").success());
        let words = [command.get_program()].into_iter().chain(command.get_args());
        let words = words.map(|word| format!("'{}'", word.to_str().expect("UTF-8")));
        let [rows, columns] = size;
        let inside = format!(
            "stty rows {rows} cols {columns}; exec {}",
            words.collect::<Vec<_>>().join(" ")
        );
        let mut script = Command::new("sh");
        script
            .args(["-c", "exec script -qfec \"$1\" /dev/null < \"$2\"", "sh", &inside])
            .arg(keyboard)
            .current_dir(command.get_current_dir().expect("a folder"))
            .env("TERM", "xterm");
        // Opened for reading and writing, because opening a pipe for one of them blocks until the other side
        // opens.
        let keyboard = File::options().read(true).write(true).open(keyboard).expect("a keyboard");
        Some(OnTerminal { program: Program::start(&mut script), keyboard })
    }

    /// The process number of the program, a child of `script`.
    pub(crate) fn process(&self) -> u32 {
        let parent = self.program.id().to_string();
        let is_child = |entry: &fs::DirEntry| {
            // The fields after the name, which is in parentheses: state, parent.
            let stat = fs::read_to_string(entry.path().join("stat")).unwrap_or_default();
            let after = stat.rsplit(')').next().unwrap_or_default();
            after.split_whitespace().nth(1) == Some(&parent)
        };
        let mut entries = fs::read_dir("/proc").expect("/proc").flatten();
        let child = entries.find(is_child).expect("a child of script");
        child.file_name().to_string_lossy().parse().expect("a process")
    }

    /// Presses `keys` in turn until the program ends: the console ignores keys until the record is closed.
    pub(crate) fn press_to_the_end(&mut self, keys: &[&str]) {
        let end = Instant::now() + 3 * LONG;
        for key in keys.iter().cycle() {
            self.press(key);
            thread::sleep(Duration::from_millis(500));
            if self.program.has_ended() {
                return;
            }
            assert!(Instant::now() < end, "the bench does not end:\n{}", self.program.said());
        }
    }

    /// The device of the terminal.
    pub(crate) fn terminal(&self) -> PathBuf {
        fs::read_link(format!("/proc/{}/fd/2", self.process())).expect("a terminal")
    }

    pub(crate) fn press(&mut self, keys: &str) {
        self.keyboard.write_all(keys.as_bytes()).expect("pressed");
    }
}
