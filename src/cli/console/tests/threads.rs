//! Tests with threads that stall, draw late or panic.

use super::*;

/// No threads serve the console. Messages to a full queue are dropped, the caller does not wait, and a hold overtakes
/// the commands before it.
#[test]
fn a_stalled_console_delays_nothing() {
    let shared = Arc::new(Shared::new(setup(), Interrupt::default()));
    let (messages, _queue) = RingBuffer::new(2);
    let (mut orders, commands) = RingBuffer::new(COMMANDS);
    let (_, drawn) = sync_channel(0);
    let mut console = Console { shared: Arc::clone(&shared), messages, commands, drawn };
    let _held_by_another = lock(&shared.latest);
    for _ in 0..5 {
        console.event(Time::ZERO, Lane::Session, Severity::Fault, "again");
        console.progress(Progress::default());
    }
    assert_eq!(shared.dropped.load(Ordering::Relaxed), 3);
    Keys::default().take(Instant::now(), b"rrs++---rrrr", &shared, &mut orders);
    assert_eq!(shared.dropped.load(Ordering::Relaxed), 3 + 4);
    assert_eq!(console.command(), Some(OperatorCommand::Resume));
    Keys::default().take(Instant::now(), b" ", &shared, &mut orders);
    assert_eq!(console.command(), Some(OperatorCommand::Hold));
    assert_eq!(console.command(), None);
}

/// A terminal that shrinks and grows between two redraws has lost part of what the bench drew.
#[test]
fn a_terminal_that_shrinks_and_grows_back_is_redrawn_whole() {
    let shared = Shared::new(setup(), Interrupt::default());
    *lock(&shared.screen) = inserted();
    let mut terminal = Terminal::new(TestBackend::new(80, 24)).expect("a screen");
    let mut drawing = Drawing::default();
    let mut redraw = |terminal: &mut Terminal<TestBackend>| {
        drawing.redraw(terminal, &mut std::io::sink(), &shared);
        terminal.backend().to_string()
    };
    let whole = redraw(&mut terminal);
    terminal.backend_mut().resize(20, 5);
    terminal.backend_mut().resize(80, 24);
    let clear_every = CLEAR_EVERY as usize;
    let screens: Vec<String> = (1..clear_every).map(|_| redraw(&mut terminal)).collect();
    let (last, before) = screens.split_last().expect("redraws");
    assert!(before.iter().all(|screen| *screen != whole), "the resizing lost nothing");
    assert_eq!(*last, whole);
}

/// The other thread still reads the keys, and the end of the run does not wait for a key.
#[test]
fn a_drawing_thread_that_panics_restores_the_terminal() {
    let shared = Arc::new(Shared::new(setup(), Interrupt::default()));
    let (messages, mut queue) = RingBuffer::new(2);
    let (mut orders, commands) = RingBuffer::new(COMMANDS);
    let (drawing, drawn) = sync_channel::<()>(0);
    let (keyboard, mut pressed) = {
        let (read, write) = nix::unistd::pipe().expect("a pipe");
        (File::from(read), File::from(write))
    };
    TAKEN.store(true, Ordering::Relaxed);
    give_back_on_panic();
    let died = thread::spawn(move || {
        let _drawing = drawing;
        panic!("drawing fails on purpose in this test");
    });
    assert!(died.join().is_err());
    assert!(!TAKEN.load(Ordering::Relaxed), "the terminal is given back");
    let seen = Arc::clone(&shared);
    let keys = thread::spawn(move || serve_keys(keyboard, &seen, &mut queue, &mut orders));
    let mut console = Console { shared: Arc::clone(&shared), messages, commands, drawn };
    pressed.write_all(b" ").expect("a key");
    let hold = std::iter::from_fn(|| {
        thread::sleep(REDRAW);
        Some(console.command())
    });
    assert_eq!(hold.take(100).flatten().next(), Some(OperatorCommand::Hold));
    pressed.write_all(&[3]).expect("a key");
    while !shared.interrupt.is_raised() {
        thread::sleep(REDRAW);
    }
    assert!(!console.finish(Some(Ok("to depth 0".to_owned()))));
    keys.join().expect("the keys are read to the end");
}
