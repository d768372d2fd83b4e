//! The public programs as child processes, and the files that they write.
//!
//! A test ends its child processes by handle or process number; at the latest they end with the test.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, Once, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Timeout of a wait, for an emulated machine on a busy host. Only a test that fails waits this long.
pub(crate) const LONG: Duration = Duration::from_secs(60);
const POLL: Duration = Duration::from_millis(10);

/// Held by one test alone, or by those that share the machine.
static MACHINE: RwLock<()> = RwLock::new(());

/// For a test that needs vcan0, the tracker's port or both cores to itself.
pub(crate) fn alone() -> RwLockWriteGuard<'static, ()> {
    let guard = MACHINE.write().unwrap_or_else(PoisonError::into_inner);
    read_programs();
    guard
}

/// For a test on a bus of its own that mostly waits: it runs beside others.
pub(crate) fn beside_others() -> RwLockReadGuard<'static, ()> {
    let guard = MACHINE.read().unwrap_or_else(PoisonError::into_inner);
    read_programs();
    guard
}

/// Reads the programs into the page cache. An emulated machine loads them at a few MB/s, and a page fault during a
/// run would stall it.
fn read_programs() {
    static READ: Once = Once::new();
    READ.call_once(|| {
        for program in [env!("CARGO_BIN_EXE_needle-bench"), env!("CARGO_BIN_EXE_vcan-stage")] {
            fs::read(program).unwrap_or_else(|error| panic!("{program}: {error}"));
        }
    });
}

/// A running program whose output is collected line by line.
pub(crate) struct Program {
    child: Child,
    stdout: Output,
    stderr: Output,
}

/// Exit status and output of a program.
pub(crate) struct Ended {
    pub(crate) status: ExitStatus,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

struct Output {
    text: Arc<Mutex<String>>,
    reader: Option<JoinHandle<()>>,
}

impl Output {
    fn collect(pipe: impl Read + Send + 'static) -> Self {
        let text = Arc::new(Mutex::new(String::new()));
        let lines = Arc::clone(&text);
        let reader = thread::spawn(move || {
            for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                let mut text = lines.lock().unwrap();
                text.push_str(&line);
                text.push('\n');
            }
        });
        Output { text, reader: Some(reader) }
    }

    fn so_far(&self) -> String {
        self.text.lock().unwrap().clone()
    }

    fn whole(&mut self) -> String {
        if let Some(reader) = self.reader.take() {
            reader.join().unwrap();
        }
        self.so_far()
    }
}

impl Program {
    pub(crate) fn start(command: &mut Command) -> Self {
        Program::start_on(command, Stdio::null())
    }

    /// Starts it with this standard input.
    pub(crate) fn start_on(command: &mut Command, stdin: impl Into<Stdio>) -> Self {
        let mut child = command
            .stdin(stdin)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|error| panic!("{command:?}: {error}"));
        let stdout = Output::collect(child.stdout.take().unwrap());
        let stderr = Output::collect(child.stderr.take().unwrap());
        Program { child, stdout, stderr }
    }

    /// Waits until the program has printed `text` on stdout or stderr.
    pub(crate) fn wait_for(&mut self, text: &str) {
        let end = Instant::now() + LONG;
        while !self.said().contains(text) {
            let ended = self.child.try_wait().unwrap();
            assert!(
                Instant::now() < end && ended.is_none_or(|_| self.said().contains(text)),
                "not printed: {text:?} ({ended:?}), but:\n{}",
                self.said()
            );
            thread::sleep(POLL);
        }
    }

    /// True once the program has ended.
    pub(crate) fn has_ended(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// The process number.
    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Stdout and stderr so far.
    pub(crate) fn said(&self) -> String {
        self.stdout.so_far() + &self.stderr.so_far()
    }

    /// Sends `signal`, such as INT, which is Ctrl-C.
    pub(crate) fn signal(&self, signal: &str) {
        send_signal(self.child.id(), signal);
    }

    /// Waits until the program ends.
    pub(crate) fn end(mut self) -> Ended {
        let end = Instant::now() + 3 * LONG;
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(
                Instant::now() < end,
                "the program does not end, and printed:\n{}",
                self.said()
            );
            thread::sleep(POLL);
        };
        Ended { status, stdout: self.stdout.whole(), stderr: self.stderr.whole() }
    }
}

/// Sends `signal` to a process.
pub(crate) fn send_signal(process: u32, signal: &str) {
    // The shell's builtin: not every machine has the program `kill`.
    let script = format!("kill -s {signal} {process}");
    let status = Command::new("sh").args(["-c", &script]).status();
    assert!(status.unwrap().success(), "{script}");
}

impl Drop for Program {
    fn drop(&mut self) {
        // The program may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if thread::panicking() {
            eprintln!("{}", self.said());
        }
    }
}

impl Ended {
    /// The last line on stdout.
    pub(crate) fn last_line(&self) -> &str {
        self.stdout.lines().last().unwrap_or("")
    }

    /// The JSON object that `--json` prints on stdout.
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.stdout)
            .unwrap_or_else(|error| panic!("{error}: {}\n{}", self.stdout, self.stderr))
    }

    #[track_caller]
    pub(crate) fn assert_status(&self, status: i32) {
        assert_eq!(self.status.code(), Some(status), "{}\n{}", self.stdout, self.stderr);
    }
}

/// A folder for the files of a test, removed with it.
pub(crate) struct Scratch(PathBuf);

impl Scratch {
    pub(crate) fn new(test: &str) -> Self {
        let path = std::env::temp_dir().join(format!("needle-bench-{test}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Scratch(path)
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Settings of the runs recorded here, which an emulated machine can keep.
    ///
    /// Such a machine deschedules a thread for 20 to 40 ms now and then, for 100 ms on a busy host. With the
    /// default limits a run would stop there, because an answer of a drive or a heartbeat is late, or the
    /// following error grows meanwhile. The default observer takes most of a SYNC period there; most tests do not
    /// need it.
    fn settings(&self) -> Vec<String> {
        let settings = [
            "can.missed_feedback_max=30",
            "can.heartbeat_timeout_ms=1000",
            "stage.insertion.following_error_mm=3.0",
            "stage.rotation.following_error_deg=90.0",
            "observer.kind=\"coupled\"",
            "observer.coupled.gains=\"placed\"",
            "observer.shadows=[]",
            "control.kind=\"feedback-linearization\"",
        ];
        let record = format!("record.dir=\"{}\"", self.path("runs").display());
        settings.map(str::to_owned).into_iter().chain([record]).collect()
    }

    /// Starts `needle-bench run bench-config/vcan.toml` at 5 mm/s with these flags and settings.
    pub(crate) fn bench(&self, flags: &[&str], settings: &[&str]) -> Program {
        Program::start(&mut self.command(flags, settings))
    }

    /// The command that [`bench`](Self::bench) starts.
    pub(crate) fn command(&self, flags: &[&str], settings: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        command.current_dir(env!("CARGO_MANIFEST_DIR"));
        command.args(["run", "bench-config/vcan.toml"]).args(flags);
        let given = self.settings();
        // At this speed the default `hold_after_mm` is reached in 0.1 s, and a virtual machine may stall longer.
        let fast =
            ["insertion.speed_mm_per_s=5", "tracker.hold_after_mm=3", "tracker.hold_after_s=3"];
        let given = given.iter().map(String::as_str).chain(fast);
        for setting in given.chain(settings.iter().copied()) {
            command.args(["--set", setting]);
        }
        command
    }

    /// The only run folder made so far.
    pub(crate) fn run_dir(&self) -> PathBuf {
        let there = fs::read_dir(self.path("runs")).unwrap().map(|entry| entry.unwrap().path());
        let mut dirs = there.filter(|path| path.is_dir());
        let dir = dirs.next().expect("a run folder");
        assert!(dirs.next().is_none(), "more than one run folder");
        dir
    }

    /// Waits until an `events.log` of the runs contains `text`.
    #[track_caller]
    pub(crate) fn wait_for_event(&self, text: &str) {
        let end = Instant::now() + 3 * LONG;
        let events = || {
            let runs = fs::read_dir(self.path("runs")).into_iter().flatten().flatten();
            let logs = runs.map(|run| fs::read_to_string(run.path().join("events.log")));
            logs.filter_map(Result::ok).collect::<String>()
        };
        while !events().contains(text) {
            assert!(Instant::now() < end, "not recorded: {text:?}, but:\n{}", events());
            thread::sleep(POLL);
        }
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// An address on the loopback where nothing listens.
pub(crate) fn free_address() -> SocketAddr {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
    listener.local_addr().expect("an address")
}

/// Starts `vcan-stage` and waits until it serves.
pub(crate) fn stage(arguments: &[&str]) -> Program {
    let mut command = Command::new(env!("CARGO_BIN_EXE_vcan-stage"));
    let mut stage = Program::start(command.args(arguments));
    stage.wait_for("\"NeedleToTracker\" at");
    stage
}

/// The rows of a CSV file by column name, without an unfinished last line.
pub(crate) fn csv(path: &Path) -> Vec<std::collections::HashMap<String, String>> {
    let text = read(path);
    let mut lines = text[..text.rfind('\n').map_or(0, |end| end + 1)].lines();
    let header: Vec<&str> = lines.next().unwrap_or("").split(',').collect();
    lines
        .map(|line| {
            let values: Vec<&str> = line.split(',').collect();
            assert_eq!(values.len(), header.len(), "{line}");
            header.iter().zip(values).map(|(k, v)| ((*k).to_owned(), v.to_owned())).collect()
        })
        .collect()
}

pub(crate) fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The manifest of a run folder.
pub(crate) fn manifest(run_dir: &Path) -> Value {
    serde_json::from_str(&read(&run_dir.join("manifest.json"))).unwrap()
}
