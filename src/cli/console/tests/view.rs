//! Tests of what is drawn.

use super::*;
use insta::assert_snapshot;
use proptest::prelude::*;

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
        terminal.draw(|frame| render(&screen, frame)).expect("drawn");
        let picture = svg::svg(terminal.backend().buffer());
        let path = format!("{}/docs/console-{name}.svg", env!("CARGO_MANIFEST_DIR"));
        if is_redrawn {
            std::fs::write(&path, &picture).expect("written");
        }
        let shown = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(shown == picture, "{path} differs: INSTA_UPDATE=always cargo test --lib pictures");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_size_and_number_can_be_drawn(
        width in 1..200u16,
        height in 1..60u16,
        number in prop::sample::select(vec![0.0, f64::NAN, f64::INFINITY, -1e300, 1e300, 1e-300]),
    ) {
        for mut screen in [inserted(), stopped()] {
            screen.progress.insertion_meas_mm = number;
            screen.progress.depth_mm = number;
            screen.progress.remaining_s = Some(number);
            screen.path.push([number; 4]);
            screen.pose = Some(([number; 6], Some([number; 6])));
            screen.has_help = true;
            prop_assert!(!shown(&screen, (width, height)).is_empty());
        }
    }
}

/// From 17 columns on there is room for each letter.
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

/// The state is shown in full, however narrow the panel.
#[test]
fn a_disabled_drive_is_shown_as_disabled() {
    let mut screen = inserted();
    let disabled = Frame::new(0x182, &[0x50, 0x02, 0, 0, 0, 0]);
    screen.take(&Record::Can { time: at(20.0), direction: Direction::Received, frame: disabled });
    screen.drives[1].position = -1000f64.to_radians();
    let shown = shown(&screen, SIZES[0]);
    assert!(shown.contains("-1000.00 ° +0.00 disabled│"), "{shown}");
}

#[test]
fn the_distance_to_a_target_is_shown() {
    let mut screen = inserted();
    let target_mm = Vector3::new(0.0, 20.0, 100.0);
    let approach = Approach {
        target_mm,
        distance_mm: 61.2,
        clearance_mm: 5.0,
        error_mm: 0.12,
        error_sd_mm: None,
        path: None,
    };
    screen.take(&Record::Step(Box::new(StepRecord {
        decision: Decision { approach: Some(approach), ..Decision::default() },
        ..StepRecord::default()
    })));
    let shown = shown(&screen, SIZES[0]);
    assert!(shown.contains("target 61.2 mm, 0.12 off, path -"), "{shown}");
}

#[test]
fn why_a_needle_is_not_withdrawn_is_on_the_screen() {
    let keys = |screen: &Screen| {
        let shown = shown(screen, SIZES[0]);
        shown.lines().last().expect("a line").trim_matches(['"', ' ']).to_owned()
    };
    let mut screen = stopped();
    assert_eq!(keys(&screen), "the run is over:   q leave   w withdraw the needle");
    screen.withdrawal = Some(Err("the needle is out, at 0.01 mm".to_owned()));
    assert_eq!(keys(&screen), "q leave   no withdrawal: the needle is out, at 0.01 mm");
    screen.is_over = false;
    assert_eq!(keys(&screen), "the run is over; its record is being closed");
}
