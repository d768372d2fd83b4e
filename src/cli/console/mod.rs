//! `run --console`: the run on the whole terminal, and its keys.
//!
//! Two threads serve it. One reads the keys and gathers the records, and never writes; the other draws.
//! A terminal that accepts no output therefore delays neither the keys nor the run. The control thread only
//! fills queues of fixed size; messages that find their queue full are dropped and counted.

mod keys;
mod screen;
mod view;

pub(super) use self::view::minutes;

use self::keys::Keys;
use self::screen::{Screen, Setup};
use super::ending::folder_bytes;
use super::output::plain;
use super::{Failure, Result};
use crate::config::Config;
use crate::runtime::{Interrupt, Operator};
use crate::session::{Input, Lane, OperatorCommand, Progress, Record, Severity};
use crate::units::Time;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use ratatui::Terminal;
use ratatui::backend::{Backend, CrosstermBackend};
use ratatui::crossterm::cursor::Show;
use ratatui::crossterm::event::{DisableBracketedPaste, EnableBracketedPaste};
use ratatui::crossterm::execute;
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};
use ratatui::layout::Rect;
use rtrb::{Consumer, Producer, RingBuffer};
use std::fs::File;
use std::io::{BufWriter, IsTerminal, Read, Stderr, Write, stderr};
use std::os::fd::AsFd;
use std::panic;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};
use thread_priority::{
    NormalThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Capacity of the queue of records and events.
const QUEUE: usize = 8192;
/// Capacity of the queue of commands to the control thread.
const COMMANDS: usize = 8;
/// Interval at which the queue is emptied if no key is pressed.
const GATHER_MS: u16 = 20;
const REDRAW: Duration = Duration::from_millis(100);
/// The size of the record is measured once in this many redraws.
const MEASURE_EVERY: u32 = 10;
/// How long the end waits for a terminal that accepts no output.
const FINISH: Duration = Duration::from_secs(1);
/// The whole screen is drawn anew once in this many redraws, every 2 s. Otherwise a size that changes and changes
/// back between two redraws would go unnoticed.
const CLEAR_EVERY: u32 = 20;
const BELL: &[u8] = b"\x07";

/// The console has taken the terminal. The thread that clears this flag gives the terminal back.
static TAKEN: AtomicBool = AtomicBool::new(false);

enum Message {
    Record(Record),
    Event(Time, Lane, Severity, String),
    RecordTrouble(String),
    Folder(PathBuf),
}

/// What the console's threads and the control thread share.
#[derive(Default)]
struct Shared {
    screen: Mutex<Screen>,
    latest: Mutex<Progress>,
    /// The operator has asked for a hold. A hold overtakes every other command.
    hold: AtomicBool,
    dropped: AtomicU64,
    /// The run has ended.
    is_over: AtomicBool,
    /// The operator leaves the screen, which stays after the run.
    is_leaving: AtomicBool,
    /// The operator has asked for the withdrawal of the needle.
    wants_withdrawal: AtomicBool,
    /// The console's threads must end.
    is_closing: AtomicBool,
    interrupt: Interrupt,
}

impl Shared {
    fn new(setup: Setup, interrupt: Interrupt) -> Self {
        Shared { screen: Mutex::new(Screen::new(setup)), interrupt, ..Shared::default() }
    }
}

/// Locks `mutex`, even if a thread panicked while it held the lock.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(super) struct Console {
    shared: Arc<Shared>,
    /// These rings never block: the control thread does not wait for a preempted thread at their other end
    /// (docs/decisions/0018-tracker-queue.md).
    messages: Producer<Message>,
    commands: Consumer<OperatorCommand>,
    /// Closed when the terminal is given back.
    drawn: Receiver<()>,
}

impl Console {
    /// Opens the terminal's input, for its keys.
    ///
    /// # Errors
    /// There is no terminal.
    pub(super) fn open_keys() -> Result<File> {
        let keys = File::open("/dev/tty").ok().filter(|_| stderr().is_terminal());
        keys.ok_or_else(|| {
            Failure::configuration(
                "--console needs a terminal for its screen (stderr) and its keys; over ssh use ssh -t, or leave out --console",
            )
        })
    }

    /// Takes the terminal for a run of `config`. Ctrl-C and q raise `interrupt`.
    pub(super) fn open(config: &Config, interrupt: Interrupt) -> Result<Self> {
        let keys = Console::open_keys()?;
        let shared = Arc::new(Shared::new(Setup::of(config), interrupt));
        let terminal = take_terminal()?;
        let (messages, mut queue) = RingBuffer::new(QUEUE);
        let (mut command_sender, commands) = RingBuffer::new(COMMANDS);
        let (drawing, drawn) = sync_channel::<()>(0);
        let (keys_shared, draw_shared) = (Arc::clone(&shared), Arc::clone(&shared));
        let thread = |name: &str| thread::Builder::new().name(name.to_owned());
        let drawer = thread("console-draw").spawn(move || {
            draw(terminal, &draw_shared);
            give_terminal_back();
            drop(drawing);
        });
        let served = drawer.and_then(|_| {
            let serve = move || serve_keys(keys, &keys_shared, &mut queue, &mut command_sender);
            thread("console-keys").spawn(serve)
        });
        served.inspect_err(|_| give_terminal_back())?;
        Ok(Console { shared, messages, commands, drawn })
    }

    fn send(&mut self, message: Message) {
        if self.messages.is_abandoned() || self.messages.push(message).is_err() {
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Gives the terminal back. After a run, the screen stays first until the operator leaves it or a signal
    /// comes; `withdrawal` says how the needle can be withdrawn, or why it cannot. It is `None` if there was no
    /// run. True if the operator has asked for the withdrawal of the needle.
    pub(super) fn finish(self, withdrawal: Option<Result<String, String>>) -> bool {
        let Shared { is_over, is_leaving, wants_withdrawal, is_closing, interrupt, .. } =
            &*self.shared;
        let stays = withdrawal.is_some();
        lock(&self.shared.screen).withdrawal = withdrawal;
        is_over.store(true, Ordering::Relaxed);
        // A panic has given the terminal back already.
        let is_watched = || TAKEN.load(Ordering::Relaxed) && !interrupt.is_signalled();
        while stays && is_watched() && !is_leaving.load(Ordering::Relaxed) {
            thread::sleep(REDRAW / 2);
        }
        is_closing.store(true, Ordering::Relaxed);
        let _ = self.drawn.recv_timeout(FINISH);
        if TAKEN.load(Ordering::Relaxed) {
            // The terminal accepts no output, but its modes can still be restored.
            let _ = disable_raw_mode();
        }
        wants_withdrawal.load(Ordering::Relaxed)
    }
}

impl Operator for Console {
    fn progress(&mut self, progress: Progress) {
        if let Ok(mut latest) = self.shared.latest.try_lock() {
            *latest = progress;
        }
    }

    fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: &str) {
        self.send(Message::Event(time, lane, severity, plain(text, "")));
    }

    fn record(&mut self, record: &Record) {
        let is_shown = match record {
            // Events come by `event`.
            Record::Event { .. } => false,
            Record::Input { input, .. } => matches!(input, Input::Operator(_)),
            _ => true,
        };
        if is_shown {
            self.send(Message::Record(record.clone()));
        }
    }

    fn record_trouble(&mut self, text: &str) {
        self.send(Message::RecordTrouble(plain(text, "")));
    }

    fn recorded_to(&mut self, folder: &Path) {
        self.send(Message::Folder(folder.to_owned()));
    }

    fn command(&mut self) -> Option<OperatorCommand> {
        if self.shared.hold.swap(false, Ordering::Relaxed) {
            // The hold cancels the commands that came before it or together with it.
            let cancelled = std::iter::from_fn(|| self.commands.pop().ok()).count() as u64;
            self.shared.dropped.fetch_add(cancelled, Ordering::Relaxed);
            return Some(OperatorCommand::Hold);
        }
        self.commands.pop().ok()
    }
}

type ConsoleTerminal = Terminal<CrosstermBackend<BufWriter<Stderr>>>;

/// Puts the terminal into raw mode on its alternate screen. A panic of any thread gives the terminal back before
/// it is reported.
fn take_terminal() -> std::io::Result<ConsoleTerminal> {
    enable_raw_mode()?;
    TAKEN.store(true, Ordering::Relaxed);
    give_back_on_panic();
    let taken = execute!(stderr(), EnterAlternateScreen, EnableBracketedPaste)
        .and_then(|()| Terminal::new(CrosstermBackend::new(BufWriter::new(stderr()))));
    taken.inspect_err(|_| give_terminal_back())
}

fn give_back_on_panic() {
    let report = panic::take_hook();
    panic::set_hook(Box::new(move |panic| {
        give_terminal_back();
        report(panic);
    }));
}

fn give_terminal_back() {
    if TAKEN.swap(false, Ordering::Relaxed) {
        let _ = disable_raw_mode();
        let _ = execute!(stderr(), DisableBracketedPaste, LeaveAlternateScreen, Show);
    }
}

/// Draws until the console closes.
fn draw(mut terminal: ConsoleTerminal, shared: &Shared) {
    // With the lowest priority, drawing never delays the control thread.
    let idle = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Idle);
    let _ = set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, idle);
    let mut drawing = Drawing::default();
    loop {
        drawing.redraw(&mut terminal, &mut stderr(), shared);
        // A panic has given the terminal back already.
        if shared.is_closing.load(Ordering::Relaxed) || !TAKEN.load(Ordering::Relaxed) {
            return;
        }
        thread::sleep(REDRAW);
    }
}

/// The progress of the drawing thread.
#[derive(Default)]
struct Drawing {
    redraws: u32,
    /// Alarms that have rung the bell.
    alarms: u32,
}

impl Drawing {
    fn redraw<B: Backend>(
        &mut self,
        terminal: &mut Terminal<B>,
        bell: &mut impl Write,
        shared: &Shared,
    ) {
        if self.redraws.is_multiple_of(MEASURE_EVERY) {
            let folder = lock(&shared.screen).folder.clone();
            let bytes = folder.map_or(0, |dir| folder_bytes(&dir));
            lock(&shared.screen).record_bytes = bytes;
        }
        // Something else may have written to the terminal. (Terminal::clear would ask it for its cursor.)
        if self.redraws % CLEAR_EVERY == CLEAR_EVERY - 1
            && let Ok(size) = terminal.size()
        {
            let _ = terminal.resize(Rect::new(0, 0, size.width, size.height));
        }
        self.redraws = self.redraws.wrapping_add(1);
        // Cloned, so that no lock is held while this thread draws and writes: it may be descheduled for long.
        let screen = lock(&shared.screen).clone();
        // A failed draw may succeed the next time; the keys are read in any case.
        let _ = terminal.draw(|frame| view::render(&screen, frame));
        if screen.alarms > self.alarms {
            self.alarms = screen.alarms;
            let _ = bell.write_all(BELL);
        }
    }
}

/// Reads keys and gathers the records until the console closes.
fn serve_keys(
    mut keys: File,
    shared: &Shared,
    queue: &mut Consumer<Message>,
    commands: &mut Producer<OperatorCommand>,
) {
    let mut pressed = [0; 64];
    let mut parser = Keys::default();
    while !shared.is_closing.load(Ordering::Relaxed) {
        let mut ready = [PollFd::new(keys.as_fd(), PollFlags::POLLIN)];
        let is_ready = poll(&mut ready, PollTimeout::from(GATHER_MS)).is_ok_and(|count| count > 0);
        if !is_ready {
            parser.idle(Instant::now());
        } else {
            match keys.read(&mut pressed) {
                Ok(count) if count > 0 => {
                    parser.take(Instant::now(), &pressed[..count], shared, commands);
                }
                // The terminal is gone, and with it the operator's way to hold or stop.
                _ => {
                    shared.interrupt.raise();
                    shared.is_leaving.store(true, Ordering::Relaxed);
                    thread::sleep(REDRAW);
                }
            }
        }
        gather(shared, queue);
    }
}

fn gather(shared: &Shared, queue: &mut Consumer<Message>) {
    let mut screen = lock(&shared.screen);
    screen.is_interrupted = shared.interrupt.is_raised();
    for message in std::iter::from_fn(|| queue.pop().ok()).take(QUEUE) {
        match message {
            Message::Record(record) => screen.take(&record),
            Message::Event(time, lane, severity, text) => {
                screen.event(time, lane, severity, &text);
            }
            Message::RecordTrouble(text) => screen.record_trouble = Some(text),
            Message::Folder(folder) => screen.folder = Some(folder),
        }
    }
    if let Ok(latest) = shared.latest.try_lock() {
        screen.progress = *latest;
    }
    screen.dropped = shared.dropped.load(Ordering::Relaxed);
    screen.is_over = shared.is_over.load(Ordering::Relaxed);
}

#[cfg(test)]
mod tests;
