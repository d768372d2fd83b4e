//! Runs `needle-bench` as a user does, in a folder of the test's own.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicU32, Ordering};

/// A folder that is removed with the test.
pub(crate) struct Scratch(PathBuf);

impl Scratch {
    pub(crate) fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let dir =
            std::env::temp_dir().join(format!("needle-bench-test-{}-{number}", std::process::id()));
        std::fs::create_dir_all(&dir).expect("a folder for the test");
        Scratch(dir)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }

    pub(crate) fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.join(name);
        std::fs::write(&path, text).expect("a file for the test");
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Output and exit status of a program.
pub(crate) struct Said {
    command: String,
    pub(crate) status: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Said {
    /// Command, output and exit status, for a snapshot. Asserts that no line on stderr is longer than 200
    /// characters.
    pub(crate) fn screen(&self) -> String {
        let Said { command, status, stdout, stderr } = self;
        for line in stderr.lines() {
            assert!(line.chars().count() <= 200, "{} characters: {line}", line.chars().count());
        }
        format!("$ {command}\n{stdout}{stderr}exit {status}\n\n")
    }

    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.stdout)
            .unwrap_or_else(|error| panic!("{error} in {:?}\n{}", self.stdout, self.stderr))
    }

    /// The run folder that the JSON names.
    #[track_caller]
    pub(crate) fn run_dir(&self, scratch: &Scratch) -> PathBuf {
        let json = self.json();
        let dir = json["run_dir"].as_str();
        scratch.path().join(dir.unwrap_or_else(|| panic!("no run folder: {}", self.stderr)))
    }
}

/// `needle-bench ARGUMENTS` in `scratch`.
pub(crate) fn needle_bench(scratch: &Scratch, arguments: &[&str]) -> Said {
    let output: Output = Command::new(env!("CARGO_BIN_EXE_needle-bench"))
        .args(arguments)
        .current_dir(scratch.path())
        .output()
        .expect("the program starts");
    let quoted = arguments.iter().map(|argument| match argument.contains(' ') {
        true => format!(" '{argument}'"),
        false => format!(" {argument}"),
    });
    Said {
        command: format!("needle-bench{}", quoted.collect::<String>()),
        status: output.status.code().expect("an exit status"),
        stdout: String::from_utf8(output.stdout).expect("UTF-8"),
        stderr: String::from_utf8(output.stderr).expect("UTF-8"),
    }
}

/// The screens of commands that are refused as bad usage (exit 2), for a snapshot.
pub(crate) fn refusals(scratch: &Scratch, commands: &[&[&str]]) -> String {
    let refused = |arguments: &&[&str]| {
        let said = needle_bench(scratch, arguments);
        assert_eq!(said.status, 2, "{}", said.screen());
        said.screen()
    };
    commands.iter().map(refused).collect()
}

/// The absolute path of a file in the repository.
pub(crate) fn repository(path: &str) -> String {
    format!("{}/{path}", env!("CARGO_MANIFEST_DIR"))
}
