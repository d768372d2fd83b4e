//! Tests of the keys.

use super::*;

#[test]
fn keys_are_commands_and_escape_sequences_are_none() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    lock(&shared.screen).progress.speed_mm_per_s = 1.0;
    let (now, mut keyboard) = (Instant::now(), Keys::default());
    let mut asked = |keys: &[u8]| {
        keyboard.take(now, keys, &shared, &mut orders);
        std::iter::from_fn(|| commands.pop().ok())
            .map(|command| command.to_string())
            .collect::<Vec<_>>()
            .join(", ")
    };
    assert_eq!(asked(b"rs-"), "resume, step of 1 mm, speed 0.800 mm/s");
    // Keys that are read together add up.
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
    // A key after a sequence counts.
    assert_eq!(asked(b"\x1b[Ar\x1b[6~r\x1bOSr\x1br"), "resume, resume, resume, resume");
    assert!(!shared.interrupt.is_raised());
    asked(b"\x03");
    assert!(shared.interrupt.is_raised());
}

/// An operator who has hit Escape and `[` must still be able to stop.
#[test]
fn half_an_escape_sequence_does_not_swallow_a_later_key() {
    let begun = Instant::now();
    let is_stopped_after = |is_held_up: bool, reads: &[(u64, &[u8])]| {
        let shared = Shared::new(setup(), Interrupt::default());
        let (mut orders, _commands) = RingBuffer::new(COMMANDS);
        let mut keyboard = Keys::default();
        for (ms, keys) in reads {
            let now = begun + Duration::from_millis(*ms);
            if !is_held_up {
                keyboard.idle(now);
            }
            keyboard.take(now, keys, &shared, &mut orders);
        }
        shared.interrupt.is_raised()
    };
    let is_stopped = |reads: &[(u64, &[u8])]| is_stopped_after(false, reads);
    for half in [&b"\x1b["[..], b"\x1bO", b"\x1b[15;2", b"\x1b[Ar\x1b["] {
        assert!(is_stopped(&[(0, half), (101, b"q")]), "{half:?}");
        assert!(!is_stopped(&[(0, half), (100, b"q")]), "the end of the sequence: {half:?}");
        assert!(!is_stopped_after(true, &[(0, half), (500, b"q")]), "it was waiting: {half:?}");
        // The time counts from the first byte of this sequence.
        assert!(is_stopped(&[(0, half), (90, b"1"), (101, b"q")]));
        assert!(!is_stopped(&[(0, b"\x1b["), (90, &[b"A", half].concat()), (180, b"q")]));
    }
}

/// The paste may be a mistake, so only keys that hold or stop are obeyed.
#[test]
fn a_paste_can_hold_or_stop_but_resumes_nothing() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    let (now, mut keyboard) = (Instant::now(), Keys::default());
    let mut asked = |keys: &[u8]| {
        keyboard.take(now, keys, &shared, &mut orders);
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
    lock(&shared.screen).withdrawal = Some(Ok("to depth 0".to_owned()));
    asked(b"\x1b[200~wy\x1b[201~");
    assert!(!shared.wants_withdrawal.load(Ordering::Relaxed));
}

/// The key gives a command like any other; the session refuses it, and the screen shows the limit.
#[test]
fn a_speed_at_its_limit_is_refused_on_the_screen() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    for (key, speed_mm_per_s, asked) in
        [(b"+", 2.0, "speed 2.200 mm/s"), (b"-", 0.2, "speed 0.000 mm/s")]
    {
        *lock(&shared.screen) = inserted();
        lock(&shared.screen).progress.speed_mm_per_s = speed_mm_per_s;
        Keys::default().take(Instant::now(), key, &shared, &mut orders);
        let command = commands.pop().expect("a command");
        assert_eq!(command.to_string(), asked);
        ask(&mut lock(&shared.screen), 20.0, command);
        let refused = format!("operator: {asked} refused: allowed: over 0 and up to 2 mm/s");
        lock(&shared.screen).event(at(20.0), Lane::Session, Severity::Warning, &refused);
        for size in [(80, 24), (120, 3)] {
            let screen = shown(&lock(&shared.screen), size);
            assert!(screen.contains(&refused), "{screen}");
        }
    }
}

/// The screen has no speed before the first progress of the insertion.
#[test]
fn a_speed_asked_for_at_once_counts_from_the_highest() {
    let shared = Shared::new(setup(), Interrupt::default());
    let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
    *lock(&shared.screen) = inserted();
    lock(&shared.screen).progress.speed_mm_per_s = 0.0;
    Keys::default().take(Instant::now(), b"-", &shared, &mut orders);
    assert_eq!(commands.pop().expect("a command").to_string(), "speed 1.800 mm/s");
}

/// A y without a w just before it withdraws nothing.
#[test]
fn the_needle_is_withdrawn_after_a_w_and_a_y() {
    let pressed = |keys: &[u8], can_withdraw: bool| {
        let shared = Shared::new(setup(), Interrupt::default());
        let left = can_withdraw.then(|| "to depth 0".to_owned());
        lock(&shared.screen).withdrawal = Some(left.ok_or_else(|| "it is out".to_owned()));
        let (mut orders, mut commands) = RingBuffer::new(COMMANDS);
        shared.is_over.store(true, Ordering::Relaxed);
        Keys::default().take(Instant::now(), keys, &shared, &mut orders);
        assert_eq!(commands.pop().ok(), None, "nothing is left to command");
        [&shared.wants_withdrawal, &shared.is_leaving].map(|flag| flag.load(Ordering::Relaxed))
    };
    assert_eq!(pressed(b"wy", true), [true, true]);
    assert_eq!(pressed(b"w nwy", true), [true, true]);
    for keys in [&b"y"[..], b"w", b"wny", b"w\x1b[Ay y", b" rs+"] {
        assert_eq!(pressed(keys, true)[0], keys == b"w\x1b[Ay y", "{keys:?}");
    }
    assert_eq!(pressed(b"q", true), [false, true]);
    assert_eq!(pressed(b"wy", false), [false, false], "no withdrawal is possible");
}
