//! Homing, mode 6.

use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// An enabled drive of `config` in homing mode.
fn in_homing(config: DriveConfig) -> Bench {
    let mut bench = Bench::new(config);
    bench.map_cyclic();
    bench.enable();
    bench.write(object::MODES_OF_OPERATION, &[6]);
    bench
}

impl Bench {
    /// Starts homing by a rising bit 4.
    fn start(&mut self) -> Statusword {
        self.control(0x1f)
    }

    /// The statusword a millisecond after `controlword`.
    fn control(&mut self, controlword: u16) -> Statusword {
        self.write(object::CONTROLWORD, &controlword.to_le_bytes());
        self.pass(Duration::from_millis(1));
        self.status()
    }

    fn status(&mut self) -> Statusword {
        let bytes = self.read(object::STATUSWORD);
        Statusword(u16::from_le_bytes([bytes[0], bytes[1]]))
    }

    fn reported(&mut self) -> i32 {
        let bytes = self.read(object::POSITION_ACTUAL);
        i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
    }
}

/// Bits 10 and 12: (target reached, homing attained).
fn bits(word: Statusword) -> (bool, bool) {
    (word.has(Statusword::TARGET_REACHED), word.has(Statusword::HOMING_ATTAINED))
}

fn homed(method: i8, config: DriveConfig) -> Bench {
    let mut bench = in_homing(config);
    bench.write(object::HOMING_METHOD, &[method as u8]);
    bench.write(object::HOMING_SPEED_SWITCH, &2000u32.to_le_bytes());
    bench.write(object::HOMING_SPEED_ZERO, &500u32.to_le_bytes());
    bench.write(object::HOMING_ACCELERATION, &20_000u32.to_le_bytes());
    let begun = bench.start();
    assert!(!begun.has(Statusword::FOLLOWING_ERROR), "no error");
    bench.pass(10 * SECOND);
    bench
}

fn with_switches() -> DriveConfig {
    let switches = Switches {
        negative_counts: Some(-3000),
        positive_counts: Some(4000),
        home_counts: Some(1000),
    };
    DriveConfig { switches, start_counts: 300, ..config() }
}

/// Rows are (method, true position of home).
#[test]
fn after_each_homing_method_home_reads_zero() {
    for (method, home) in [
        (1, -2000.0),
        (17, -2999.0),
        (2, 2000.0),
        (18, 3999.0),
        (24, 1000.0),
        (33, 0.0),
        (34, 2000.0),
        (35, 300.0),
        (37, 300.0),
    ] {
        let mut bench = homed(method, with_switches());
        assert_eq!((bits(bench.status()), bench.position()), ((true, true), home), "{method}");
        assert_eq!(bench.reported(), 0, "method {method}");
        assert_eq!(bench.emergencies, [""; 0]);
        // Back in homing mode, also without power, the drive still reports that it is homed.
        bench.write(object::MODES_OF_OPERATION, &[8]);
        bench.write(object::CONTROLWORD, &[0, 0]);
        bench.write(object::MODES_OF_OPERATION, &[6]);
        assert!(bench.status().has(Statusword::HOMING_ATTAINED), "method {method}");
    }
}

/// Zero is home plus the offset (CiA 402-2, 0x607C).
#[test]
fn after_homing_targets_count_from_zero() {
    let mut bench = in_homing(with_switches());
    bench.write(object::HOME_OFFSET, &100i32.to_le_bytes());
    bench.write(object::HOMING_METHOD, &[37]);
    bench.start();
    assert_eq!((bench.reported(), bench.position()), (-100, 300.0));
    bench.write(object::MODES_OF_OPERATION, &[8]);
    bench.cycle(0x0f, -90);
    bench.cycle(0x0f, -80);
    assert_eq!((bench.reported(), bench.position()), (-80, 320.0));
}

#[test]
fn a_homing_can_be_interrupted_and_fails_on_the_wrong_switch() {
    let mut bench = in_homing(with_switches());
    bench.write(object::HOMING_METHOD, &[1]);
    bench.start();
    bench.pass(SECOND / 10);
    bench.control(0x0f);
    bench.pass(SECOND);
    let word = bench.status();
    assert_eq!(
        (bits(word), word.has(Statusword::FOLLOWING_ERROR)),
        ((true, false), false),
        "interrupted"
    );
    let stood = bench.position();
    bench.pass(SECOND);
    assert_eq!(bench.position(), stood);

    // The home switch lies behind the positive limit switch.
    let switches =
        Switches { positive_counts: Some(500), home_counts: Some(1000), ..Switches::default() };
    let mut bench = homed(24, DriveConfig { switches, ..config() });
    let word = bench.status();
    assert_eq!(
        (bits(word), word.has(Statusword::FOLLOWING_ERROR)),
        ((true, false), true),
        "homing error"
    );
    assert_eq!(bench.state(), DriveState::OperationEnabled);
}

/// python-canopen writes it again during a homing.
#[test]
fn writing_the_active_mode_again_does_not_interrupt_homing() {
    let mut bench = in_homing(with_switches());
    bench.write(object::HOMING_METHOD, &[34]);
    bench.start();
    bench.pass(SECOND / 10);
    bench.write(object::MODES_OF_OPERATION, &[6]);
    assert_ne!(bench.read(object::VELOCITY_ACTUAL), [0; 4], "it moves on");
    bench.pass(10 * SECOND);
    assert_eq!((bits(bench.status()), bench.reported()), ((true, true), 0));
}

#[test]
fn a_method_without_its_switch_is_refused() {
    let mut bench = Bench::new(config());
    let refused = bench.sdo(SdoRequest::Download(object::HOMING_METHOD, 17_i8.into()));
    assert_eq!(refused, Err(SdoError::Aborted(AbortCode::INVALID_VALUE)));
}
