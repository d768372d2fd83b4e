//! Tests of the bell.

use super::*;
use ratatui::{TerminalOptions, Viewport};

/// The bytes that a terminal gets.
#[derive(Clone, Default)]
struct Written(Arc<Mutex<Vec<u8>>>);

impl Write for Written {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        lock(&self.0).extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// How often a console rings the bell that is redrawn after each of `messages`.
fn bells(messages: Vec<Message>, is_interrupted: bool) -> usize {
    let shared = Shared::new(setup(), Interrupt::default());
    if is_interrupted {
        shared.interrupt.raise();
    }
    let (mut sender, mut queue) = RingBuffer::new(1);
    let written = Written::default();
    let viewport = Viewport::Fixed(Rect::new(0, 0, 80, 24));
    let backend = CrosstermBackend::new(written.clone());
    let mut terminal =
        Terminal::with_options(backend, TerminalOptions { viewport }).expect("a terminal");
    let mut drawing = Drawing::default();
    for message in messages {
        sender.push(message).expect("a queue");
        gather(&shared, &mut queue);
        for _ in 0..2 {
            drawing.redraw(&mut terminal, &mut written.clone(), &shared);
        }
    }
    let bytes = lock(&written.0);
    assert!(bytes.len() > 1000, "a screen is drawn");
    bytes.iter().filter(|byte| [**byte] == *BELL).count()
}

#[test]
fn the_bell_rings_once_for_what_holds_or_ends_the_run_and_never_for_success() {
    let state = |state| Message::Record(Record::State { time: at(1.0), state });
    let event =
        |severity, text: &str| Message::Event(at(1.0), Lane::Session, severity, text.to_owned());
    let fault = || event(Severity::Fault, "stage: insertion: fault (statusword 0x0208)");
    let warning = || event(Severity::Warning, "last tip 0.51 s old; insertion held");
    let success = vec![
        state(State::Inserting),
        warning(),
        state(State::HeldByOperator),
        state(State::Inserting),
        state(State::Stopping),
        state(State::Completed),
    ];
    assert_eq!(bells(success, false), 0);
    let faulty = vec![
        state(State::Inserting),
        fault(),
        state(State::Stopping),
        event(Severity::Warning, "then: can: the interface is down"),
        state(State::Stopped),
    ];
    assert_eq!(bells(faulty, false), 1);
    let held = || vec![state(State::Inserting), state(State::Holding), warning()];
    assert_eq!(bells(held(), false), 1);
    let ended = held().into_iter().chain([fault(), state(State::Stopped)]).collect();
    assert_eq!(bells(ended, false), 1, "a hold that ends the run");
    let twice = held().into_iter().chain(held()).collect();
    assert_eq!(bells(twice, false), 2, "two holds");
    let stopped = vec![state(State::Inserting), event(Severity::Fault, "operator: interrupted")];
    assert_eq!(bells(stopped, true), 0, "the operator stopped the run");
}
