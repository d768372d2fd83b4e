mod svg;

use super::screen::{Screen, Setup};
use super::*;
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::{Frame, NodeId};
use crate::geometry::{FixedAngles, Pose};
use crate::observer::Estimate;
use crate::session::news;
use crate::session::{Approach, Direction, SampleRecord, State, StepRecord};
use crate::stage::{Axis, Feedback, SetPoint, StageEvent};
use crate::tracker::{GateName, Refusal, Sample, Validity};
use insta::assert_snapshot;
use nalgebra::Vector3;
use proptest::prelude::*;
use ratatui::backend::TestBackend;
use ratatui::{TerminalOptions, Viewport};

const SIZES: [(u16, u16); 4] = [(80, 24), (120, 40), (40, 12), (1, 1)];

fn setup() -> Setup {
    Setup {
        nodes: [1, 2],
        sync_period: Duration::from_millis(10),
        tip_age_max_s: 0.5,
        noise_sd_mm: 1.0,
        step_mm: 1.0,
        speed_max_mm_per_s: 2.0,
    }
}

fn at(s: f64) -> Time {
    Time::from_nanos((s * 1e9) as i64)
}

/// A screen after 40 mm of an insertion of 100 mm at 2 mm/s, as its records fill it.
fn inserted() -> Screen {
    let mut screen = Screen::new(setup());
    screen.take(&Record::State { time: at(0.0), state: State::Inserting });
    for n in 0..2000 {
        let time = at(f64::from(n) * 0.01);
        let mm = f64::from(n) * 0.02;
        let sync = Frame::new(0x80, &[]);
        screen.take(&Record::Can { time, direction: Direction::Sent, frame: sync });
        for id in [0x181, 0x182] {
            let frame = Frame::new(id, &[0x37, 0x16, 0, 0, 0, 0]);
            screen.take(&Record::Can { time, direction: Direction::Received, frame });
        }
        let measured = SetPoint { insertion_mm: mm, rotation_rad: 0.3 };
        let commanded = SetPoint { insertion_mm: mm + 0.02, ..measured };
        screen.take(&Record::Stage(Feedback { time, sync: n as u64, measured, commanded }));
        if n % 4 == 0 {
            let mut sample = SampleRecord::received(Sample {
                tool: "N".to_owned(),
                receive_time: time,
                source_unix_ns: None,
                position_mm: Vector3::zeros(),
                orientation: None,
                validity: Validity::Valid,
            });
            let refusal = Refusal::new(GateName::Innovation, "3.1 mm off the model");
            sample.refused = (n % 400 == 0).then_some(refusal);
            screen.take(&Record::Sample(sample));
        }
        if n % 50 == 0 {
            let angles = FixedAngles { yaw: 0.0, pitch: 0.02, roll: 0.3 };
            let translation = Vector3::new(4.0 * (-mm / 12.0).exp(), 0.001 * mm * mm, mm);
            let x_pb = Pose { rotation: angles.to_rotation(), translation };
            let sd = Some([0.2, 0.2, 0.1, 0.01, 0.01, 0.08]);
            screen.take(&Record::Step(Box::new(StepRecord {
                time,
                insertion_meas_mm: mm,
                innovation_mm: Some(Vector3::new(0.8, -0.8, 0.8)),
                estimate: Some(Estimate { x_pb, sd, belief: None }),
                ..StepRecord::default()
            })));
        }
    }
    screen.event(at(1.0), Lane::Tracker, Severity::Info, "connected to 127.0.0.1:18944");
    screen.event(at(4.2), Lane::Tracker, Severity::Warning, "2 samples late");
    screen.why.clear();
    screen.record_bytes = 1_234_567;
    screen.progress = Progress {
        time: at(20.0),
        state: State::Inserting,
        insertion_meas_mm: 39.98,
        depth_mm: 100.0,
        speed_mm_per_s: 2.0,
        to_go_s: Some(30.0),
        tip_age_s: Some(0.03),
        ..Progress::default()
    };
    screen
}

fn held() -> Screen {
    let mut screen = inserted();
    screen.progress.state = State::HeldByOperator;
    screen.progress.to_go_s = None;
    screen.event(at(20.0), Lane::Session, Severity::Info, "operator: hold at 39.98 mm");
    screen
}

fn stopped() -> Screen {
    let mut screen = inserted();
    screen.progress.state = State::Stopped;
    let why = "stage: insertion: fault (statusword 0x0208)";
    let emcy = Emcy { code: EmcyCode(0x3210), register: 0x04, manufacturer: [0; 5] };
    let frame = emcy.to_frame(NodeId::new(1).expect("a node"));
    screen.take(&Record::Can { time: at(20.0), direction: Direction::Received, frame });
    let told = StageEvent::Emergency(Axis::Insertion, emcy);
    let (severity, text) = news(&told).expect("news");
    screen.event(at(20.0), Lane::Stage, severity, &text);
    screen.event(at(20.0), Lane::Session, Severity::Fault, why);
    screen.is_over = true;
    screen.left = Some(Ok("by 40.0 mm".to_owned()));
    screen
}

fn shown(screen: &Screen, (width, height): (u16, u16)) -> String {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("a screen");
    terminal.draw(|frame| view::render(screen, frame)).expect("drawn");
    terminal.backend().to_string()
}

#[test]
fn the_screen_at_every_size() {
    let mut screens = String::new();
    for size in SIZES {
        screens += &format!("{size:?}\n{}\n", shown(&inserted(), size));
    }
    assert_snapshot!(screens);
}

#[test]
fn a_hold_a_fault_and_the_help_on_a_small_screen() {
    let mut helped = held();
    helped.has_help = true;
    let mut asked = stopped();
    asked.asks_to_withdraw = true;
    let screens = [held(), stopped(), asked, helped, Screen::new(setup())];
    let screens = screens.map(|screen| shown(&screen, SIZES[0]));
    assert_snapshot!(screens.join("\n"));
}

/// The pictures in docs/rig.md show this console; INSTA_UPDATE=always draws them again.
#[test]
fn the_pictures_of_the_documentation_are_of_this_console() {
    let mut in_fault = stopped();
    for (cob_id, status) in [(0x181, [0x08, 0x02]), (0x182, [0x50, 0x02])] {
        let frame = Frame::new(cob_id, &status);
        in_fault.take(&Record::Can { time: at(20.0), direction: Direction::Received, frame });
    }
    let is_redrawn = std::env::var("INSTA_UPDATE").is_ok_and(|update| update == "always");
    for (name, screen, size) in [
        ("inserting", inserted(), (110, 32)),
        ("held", held(), (110, 32)),
        ("fault", in_fault, (110, 32)),
        ("small", inserted(), (80, 24)),
    ] {
        let (width, height) = size;
        let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("a screen");
        terminal.draw(|frame| view::render(&screen, frame)).expect("drawn");
        let picture = svg::svg(terminal.backend().buffer());
        let path = format!("{}/docs/console-{name}.svg", env!("CARGO_MANIFEST_DIR"));
        if is_redrawn {
            std::fs::write(&path, &picture).expect("written");
        }
        let shown = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(shown == picture, "{path} is old: INSTA_UPDATE=always cargo test --lib pictures");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// No size and no number is too much for the screen.
    #[test]
    fn no_size_panics(
        width in 1..200u16,
        height in 1..60u16,
        number in prop::sample::select(vec![0.0, f64::NAN, f64::INFINITY, -1e300, 1e300, 1e-300]),
    ) {
        for mut screen in [inserted(), stopped()] {
            screen.progress.insertion_meas_mm = number;
            screen.progress.depth_mm = number;
            screen.progress.to_go_s = Some(number);
            screen.path.push([number; 4]);
            screen.pose = Some(([number; 6], Some([number; 6])));
            screen.has_help = true;
            prop_assert!(!shown(&screen, (width, height)).is_empty());
        }
    }
}

/// Without threads that serve it: what finds a queue full is dropped, the caller does not wait, and a
/// hold overtakes what was asked for before.
#[test]
fn a_console_that_stands_still_delays_nothing() {
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
    Keys::default().take(b"rrs++---rrrr", &shared, &mut orders);
    assert_eq!(shared.dropped.load(Ordering::Relaxed), 3 + 4);
    assert_eq!(console.command(), Some(OperatorCommand::Resume));
    Keys::default().take(b" ", &shared, &mut orders);
    assert_eq!(console.command(), Some(OperatorCommand::Hold));
    assert_eq!(console.command(), None);
}

#[test]
fn keys_are_commands_and_escape_sequences_are_none() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    lock(&shared.screen).progress.speed_mm_per_s = 1.0;
    let mut keyboard = Keys::default();
    let mut asked = |keys: &[u8]| {
        keyboard.take(keys, &shared, &mut orders);
        std::iter::from_fn(|| commands.pop().ok())
            .map(|command| command.to_string())
            .collect::<Vec<_>>()
            .join(", ")
    };
    assert_eq!(asked(b"rs-"), "resume, step of 1 mm, speed 0.800 mm/s");
    // Those that come together add up.
    assert_eq!(asked(b"++"), "speed 1.200 mm/s, speed 1.400 mm/s");
    // F3, page down, an arrow in two parts, F5 in three.
    for sequence in [
        &b"\x1bOR"[..],
        b"\x1b[6~",
        b"\x1b",
        b"[A",
        b"\x1b[",
        b"15",
        b"~",
        b"xyz\n\t\0",
        b"\x1b[99999999999999999999999999999999999999999999",
    ] {
        assert_eq!(asked(sequence), "");
    }
    // A key behind a sequence counts.
    assert_eq!(asked(b"\x1b[Ar\x1b[6~r\x1bOSr\x1br"), "resume, resume, resume, resume");
    assert!(!shared.interrupt.is_raised());
    asked(b"\x03");
    assert!(shared.interrupt.is_raised());
}

/// Text that was pasted by mistake lets nothing go on; what stops is obeyed wherever it comes from.
#[test]
fn a_paste_holds_and_stops_and_lets_nothing_go_on() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    let mut keyboard = Keys::default();
    let mut asked = |keys: &[u8]| {
        keyboard.take(keys, &shared, &mut orders);
        let is_held = shared.hold.swap(false, Ordering::Relaxed);
        (std::iter::from_fn(|| commands.pop().ok()).count(), is_held)
    };
    assert_eq!(asked(b"\x1b[200~rs+"), (0, false));
    assert_eq!(asked(b"r\nr \x1b[20"), (0, true));
    assert_eq!(asked(b"1~r"), (1, false), "the paste is over");
    // A space after half of a sequence.
    assert_eq!(asked(b"\x1b[ "), (0, true));
    assert_eq!(asked(b"\x1bO "), (0, true));
    shared.is_over.store(true, Ordering::Relaxed);
    lock(&shared.screen).left = Some(Ok("to depth 0".to_owned()));
    asked(b"\x1b[200~wy\x1b[201~");
    assert!(!shared.wants_withdrawal.load(Ordering::Relaxed));
}

/// What the operator asks for while the needle is held, and what the tracker says, is not why it is held.
#[test]
fn the_reason_of_a_hold_stays_on_the_screen() {
    let mut screen = inserted();
    let why = "last tip 0.51 s old (limit 0.50)";
    // As the session says it.
    screen.event(at(19.0), Lane::Tracker, Severity::Warning, "1 sample refused");
    screen.take(&Record::State { time: at(20.0), state: State::Holding });
    screen.event(at(20.0), Lane::Tracker, Severity::Warning, why);
    screen.event(at(21.0), Lane::Tracker, Severity::Warning, "3 samples refused");
    let refused = "operator: resume refused: no fresh tip";
    screen.event(at(22.0), Lane::Session, Severity::Warning, refused);
    assert_eq!((screen.why.as_str(), screen.answer.as_str()), (why, refused));
    screen.take(&Record::State { time: at(23.0), state: State::Inserting });
    assert_eq!((screen.why.as_str(), screen.answer.as_str()), ("", ""));
    let fault = "stage: rotation: drive in fault";
    screen.event(at(24.0), Lane::Session, Severity::Fault, fault);
    screen.event(at(24.1), Lane::Tracker, Severity::Warning, "connection lost");
    screen.event(at(24.2), Lane::Session, Severity::Info, "operator: hold at 40.00 mm");
    assert_eq!(screen.why, fault);
}

/// Of two drives in trouble the newest message is shown.
#[test]
fn the_newest_emergency_is_on_the_screen() {
    let mut screen = inserted();
    let mut tell = |s: f64, node: u8, code: u16| {
        let emcy = Emcy { code: EmcyCode(code), register: 1, manufacturer: [0; 5] };
        let frame = emcy.to_frame(NodeId::new(node).expect("a node"));
        screen.take(&Record::Can { time: at(s), direction: Direction::Received, frame });
        shown(&screen, SIZES[1])
    };
    assert!(tell(20.0, 2, 0x8611).contains("EMCY 0x8611"));
    assert!(tell(21.0, 1, 0x3210).contains("EMCY 0x3210"));
}

/// No key is left out where there is room for its letter.
#[test]
fn every_key_is_named_at_any_width() {
    for width in 17..=80 {
        let shown = shown(&inserted(), (width, 10));
        let line = shown.lines().last().expect("a line");
        let line = format!(" {} ", line.trim_matches('"'));
        for key in ["space", "r", "s", "+", "-", "q", "?"] {
            assert!(line.contains(&format!(" {key} ")), "{key} at {width}: {line}");
        }
    }
}

/// A key at the limit is a command like any other: the session refuses it with the limit, and the screen
/// and the log say so.
#[test]
fn a_speed_at_its_limit_is_refused_on_the_screen() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    for (key, speed_mm_per_s, asked) in
        [(b"+", 2.0, "speed 2.200 mm/s"), (b"-", 0.2, "speed 0.000 mm/s")]
    {
        *lock(&shared.screen) = inserted();
        lock(&shared.screen).progress.speed_mm_per_s = speed_mm_per_s;
        Keys::default().take(key, &shared, &mut orders);
        assert_eq!(commands.pop().expect("a command").to_string(), asked);
        let refused = format!("operator: {asked} refused: allowed: over 0 and up to 2 mm/s");
        lock(&shared.screen).event(at(20.0), Lane::Session, Severity::Warning, &refused);
        for size in [(80, 24), (120, 3)] {
            let screen = shown(&lock(&shared.screen), size);
            assert!(screen.contains(&refused), "{screen}");
        }
    }
}

/// The screen has no speed before the first news of the insertion.
#[test]
fn a_speed_asked_for_at_once_counts_from_the_highest() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    *lock(&shared.screen) = inserted();
    lock(&shared.screen).progress.speed_mm_per_s = 0.0;
    Keys::default().take(b"-", &shared, &mut orders);
    assert_eq!(commands.pop().expect("a command").to_string(), "speed 1.800 mm/s");
}

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

/// The bells among what a console writes that is redrawn after each of these messages.
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
    let mut drawn = Drawn::default();
    for message in messages {
        sender.push(message).expect("a queue");
        gather(&shared, &mut queue);
        for _ in 0..2 {
            drawn.again(&mut terminal, &mut written.clone(), &shared);
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
    assert_eq!(bells(twice, false), 2, "it went on in between");
    let stopped = vec![state(State::Inserting), event(Severity::Fault, "operator: interrupted")];
    assert_eq!(bells(stopped, true), 0, "the operator knows");
}

/// A terminal that shrinks and grows between two redraws has lost what the bench believes to be on it.
#[test]
fn a_size_that_comes_and_goes_is_redrawn_whole() {
    let shared = Shared::new(setup(), Interrupt::default());
    *lock(&shared.screen) = inserted();
    let mut terminal = Terminal::new(TestBackend::new(80, 24)).expect("a screen");
    let mut drawn = Drawn::default();
    let mut redraw = |terminal: &mut Terminal<TestBackend>| {
        drawn.again(terminal, &mut std::io::sink(), &shared);
        terminal.backend().to_string()
    };
    let whole = redraw(&mut terminal);
    terminal.backend_mut().resize(20, 5);
    terminal.backend_mut().resize(80, 24);
    let clear_every = CLEAR_EVERY as usize;
    let screens: Vec<String> = (1..clear_every).map(|_| redraw(&mut terminal)).collect();
    let (last, before) = screens.split_last().expect("redraws");
    assert!(before.iter().all(|screen| *screen != whole), "the test shows nothing");
    assert_eq!(*last, whole);
}

/// A state of a drive is whole, however narrow its panel.
#[test]
fn a_drive_that_is_disabled_is_not_said_to_be_on() {
    let mut screen = inserted();
    let disabled = Frame::new(0x182, &[0x50, 0x02, 0, 0, 0, 0]);
    screen.take(&Record::Can { time: at(20.0), direction: Direction::Received, frame: disabled });
    screen.drives[1].position = -1000f64.to_radians();
    let shown = shown(&screen, SIZES[0]);
    assert!(shown.contains("-1000.00 ° +0.00 disabled│"), "{shown}");
}

#[test]
fn the_way_to_a_target_is_shown() {
    let mut screen = inserted();
    let target_mm = Vector3::new(0.0, 20.0, 100.0);
    let approach =
        Approach { target_mm, distance_mm: 61.2, clearance_mm: 5.0, error_mm: 0.12, path: None };
    screen.take(&Record::Step(Box::new(StepRecord {
        approach: Some(approach),
        ..StepRecord::default()
    })));
    let shown = shown(&screen, SIZES[0]);
    assert!(shown.contains("target 61.2 mm, 0.12 off, path -"), "{shown}");
}

/// Frames that the screen missed are no SYNCs that the bench skipped, and no text is a figure.
#[test]
fn figures_are_not_read_from_the_text_of_events() {
    let mut screen = inserted();
    let sync = Frame::new(0x80, &[]);
    screen.take(&Record::Can { time: at(25.0), direction: Direction::Sent, frame: sync });
    for text in [
        "the bench was late: 12 SYNC periods skipped",
        "insertion: emergency 0x3210 overvoltage",
        "record: the disk is full",
    ] {
        screen.event(at(25.0), Lane::Tracker, Severity::Warning, text);
    }
    let panels = |screen: &Screen| shown(screen, (120, 40));
    let before = panels(&screen);
    for figure in [", skip 0 ", "EMCY none ", " MB ok "] {
        assert!(before.contains(figure), "{before}");
    }
    screen.progress.syncs_skipped = 24;
    assert!(panels(&screen).contains(", skip 24 "));
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut sender, mut queue) = RingBuffer::new(1);
    sender.push(Message::RecordTrouble("the disk is full".to_owned())).expect("a queue");
    gather(&shared, &mut queue);
    assert!(panels(&lock(&shared.screen)).contains(" MB the disk is full"));
}

/// A y alone, or after another key, wants_withdrawal nothing.
#[test]
fn the_needle_is_withdrawn_after_a_w_and_a_y() {
    let pressed = |keys: &[u8], can_withdraw: bool| {
        let shared = Shared::new(setup(), Interrupt::default());
        let left = can_withdraw.then(|| "to depth 0".to_owned());
        lock(&shared.screen).left = Some(left.ok_or_else(|| "it is out".to_owned()));
        let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
        shared.is_over.store(true, Ordering::Relaxed);
        Keys::default().take(keys, &shared, &mut orders);
        assert_eq!(commands.pop().ok(), None, "nothing is left to command");
        [&shared.wants_withdrawal, &shared.is_leaving].map(|flag| flag.load(Ordering::Relaxed))
    };
    assert_eq!(pressed(b"wy", true), [true, true]);
    assert_eq!(pressed(b"w nwy", true), [true, true]);
    for keys in [&b"y"[..], b"w", b"wny", b"w\x1b[Ay y", b" rs+"] {
        assert_eq!(pressed(keys, true)[0], keys == b"w\x1b[Ay y", "{keys:?}");
    }
    assert_eq!(pressed(b"q", true), [false, true]);
    assert_eq!(pressed(b"wy", false), [false, false], "an emulated stage is gone");
}

/// Where the needle is not withdrawn, the last line says why.
#[test]
fn why_a_needle_is_not_withdrawn_is_on_the_screen() {
    let keys = |screen: &Screen| {
        let shown = shown(screen, SIZES[0]);
        shown.lines().last().expect("a line").trim_matches(['"', ' ']).to_owned()
    };
    let mut screen = stopped();
    assert_eq!(keys(&screen), "the run is over:   q leave   w withdraw the needle");
    screen.left = Some(Err("the needle is out, at 0.01 mm".to_owned()));
    assert_eq!(keys(&screen), "q leave   no withdrawal: the needle is out, at 0.01 mm");
    screen.is_over = false;
    assert_eq!(keys(&screen), "the run is over; its record is being closed");
}

/// The other thread reads the keys on, and the operator is not waited for on a screen that is gone.
#[test]
fn a_drawing_thread_that_panics_gives_the_terminal_back() {
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
        panic!("drawing failed, as this test wants it");
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
