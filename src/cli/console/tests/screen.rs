//! Tests of what the screen keeps of the records and events.

use super::*;

/// Later events of the tracker, and the answers to the operator, do not replace the reason.
#[test]
fn the_reason_of_a_hold_stays_on_the_screen() {
    let mut screen = inserted();
    let why = "last tip 0.51 s old (limit 0.50)";
    // The order in which the session reports a hold.
    screen.event(at(19.0), Lane::Tracker, Severity::Warning, "1 sample refused");
    screen.take(&Record::State { time: at(20.0), state: State::Holding });
    screen.event(at(20.0), Lane::Tracker, Severity::Warning, why);
    screen.event(at(21.0), Lane::Tracker, Severity::Warning, "3 samples refused");
    let refused = "operator: resume refused: no fresh tip";
    ask(&mut screen, 22.0, OperatorCommand::Resume);
    screen.event(at(22.0), Lane::Session, Severity::Warning, refused);
    assert_eq!((screen.why.as_str(), screen.answer.as_str()), (why, refused));
    screen.take(&Record::State { time: at(23.0), state: State::Inserting });
    assert_eq!((screen.why.as_str(), screen.answer.as_str()), ("", ""));
    let fault = "stage: rotation: drive in fault";
    screen.event(at(24.0), Lane::Session, Severity::Fault, fault);
    screen.event(at(24.1), Lane::Tracker, Severity::Warning, "connection lost");
    ask(&mut screen, 24.2, OperatorCommand::Hold);
    screen.event(at(24.2), Lane::Session, Severity::Info, "operator: hold at 40.00 mm");
    assert_eq!(screen.why, fault);
}

/// The wording of the answer does not matter. Later answers do not replace it.
#[test]
fn the_operators_hold_is_explained_by_the_answer_to_it() {
    let mut screen = inserted();
    let info = |screen: &mut Screen, text| {
        screen.event(at(20.0), Lane::Session, Severity::Info, text);
        (screen.why.clone(), screen.answer.clone())
    };
    ask(&mut screen, 20.0, OperatorCommand::Hold);
    screen.take(&Record::State { time: at(20.0), state: State::HeldByOperator });
    let (why, answer) = info(&mut screen, "stands at 40 mm");
    assert_eq!((why.as_str(), answer.as_str()), ("stands at 40 mm", ""));
    ask(&mut screen, 21.0, OperatorCommand::Hold);
    let (why, answer) = info(&mut screen, "operator: hold is not needed");
    assert_eq!(
        (why.as_str(), answer.as_str()),
        ("stands at 40 mm", "operator: hold is not needed")
    );
    // An insertion that begins held.
    let mut screen = Screen::new(setup());
    ask(&mut screen, 20.0, OperatorCommand::Hold);
    info(&mut screen, "operator: hold: the insertion will begin held");
    screen.take(&Record::State { time: at(20.0), state: State::HeldByOperator });
    assert_eq!(info(&mut screen, "operator: speed 1.000 mm/s").0, "");
}

/// Two drives send an emergency each.
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

/// Frames that the screen missed do not count as skipped SYNCs either.
#[test]
fn figures_are_not_read_from_the_text_of_events() {
    let mut screen = inserted();
    let sync = Frame::new(0x80, &[]);
    screen.take(&Record::Can { time: at(25.0), direction: Direction::Sent, frame: sync });
    for text in [
        "the bench was late; SYNC periods skipped: 12, 12 so far",
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
    screen.progress.sync_late_max = Duration::from_millis(35);
    assert!(panels(&screen).contains("SYNC 35.0 ms, skip 24 "));
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut sender, mut queue) = RingBuffer::new(1);
    sender.push(Message::RecordTrouble("the disk is full".to_owned())).expect("a queue");
    gather(&shared, &mut queue);
    assert!(panels(&lock(&shared.screen)).contains(" MB the disk is full"));
}
