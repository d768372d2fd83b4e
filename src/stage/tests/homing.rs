//! Homing, and the check before a run that an axis is homed.

use super::drive::Homing;
use super::*;
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::DriveState;

const INSERTION: PerAxis<AxisUse> =
    PerAxis { insertion: AxisUse::Home { again: false }, rotation: AxisUse::Hold };

fn homing_config() -> StageConfig {
    let mut config = config();
    config.insertion.reference = Reference::Homing;
    config.insertion.zero = Some(0);
    config.insertion.homing = Some(HomingConfig {
        speed_switch: Some(2.0),
        speed_zero: Some(0.5),
        acceleration: Some(10.0),
        offset: Some(-1.0),
        ..homing_by(17)
    });
    config
}

/// A stage that is ready to home the insertion.
fn ready_to_home(setup: impl FnOnce(&mut Bench)) -> Bench {
    let config = homing_config();
    let nodes = config.nodes();
    let stage = Stage::for_use(config, INSERTION, Time::from_secs_f64(1.0));
    let mut bench = Bench::with(stage, nodes);
    setup(&mut bench);
    bench.until_ready();
    bench
}

fn home(bench: &mut Bench) {
    bench.stage.home(bench.now, Axis::Insertion).expect("ready");
    bench.sent.clear();
}

/// The home event, and the SYNCs until it.
fn until_homed(bench: &mut Bench) -> (f64, usize) {
    let event = bench.run_until(|event| matches!(event, StageEvent::Homed { .. }));
    let StageEvent::Homed { axis: Axis::Insertion, position } = event else { panic!("{event:?}") };
    let syncs = bench.sent.iter().filter(|(_, frame)| frame.cob_id() == Some(0x080)).count();
    (position, syncs)
}

#[test]
fn homing_writes_its_parameters_and_finds_home() {
    let mut bench = ready_to_home(|_| ());
    let drive = &bench.insertion;
    assert_eq!(drive.value(0x6098, 0), 17);
    assert_eq!((drive.value(0x6099, 1), drive.value(0x6099, 2)), (9292, 2323));
    assert_eq!(drive.value(0x609a, 0), 46_460);
    assert_eq!(drive.value(0x607c, 0) as i32, -COUNTS_PER_MM);
    assert_eq!(drive.value(0x607d, 1) as i32, -5000, "unchanged while the position is unknown");
    assert_eq!((drive.value(0x6060, 0), bench.rotation.value(0x6060, 0)), (6, 8));

    home(&mut bench);
    let (position, syncs) = until_homed(&mut bench);
    assert_eq!((position, bench.insertion.counts), (1.0, COUNTS_PER_MM));
    assert!((20..25).contains(&syncs), "{syncs}");
    let words = bench.sent.iter().filter(|(_, frame)| frame.cob_id() == Some(0x201));
    assert!(words.map(|(_, frame)| frame.data()[0]).all(|word| word == 0x1f));
    assert_eq!(bench.rotation.counts, -20, "the other axis is held");
    bench.sent.clear();
    bench.run_for(Duration::from_millis(20));
    assert_eq!(bench.until_feedback().measured.insertion_mm, 1.0);
    assert!(bench.has_sent("201#0F"));

    let refused = bench.command(1.0, 0.0).expect_err("homing mode");
    assert_eq!(refused.to_string(), "the stage takes no set-points in homing mode");
    bench.stage.disable(bench.now);
    assert!(bench.until_stopped());
}

/// The drive clears the bits of the earlier homing late.
#[test]
fn the_result_of_an_earlier_homing_is_not_taken_for_the_new_one() {
    for before in [Homing::Attained, Homing::Failed] {
        let mut bench = ready_to_home(|bench| {
            bench.insertion.homing = before;
            bench.insertion.clears_late = 18;
        });
        home(&mut bench);
        let (_, syncs) = until_homed(&mut bench);
        assert!(syncs >= 20, "{syncs}");
    }
}

/// The bits of an earlier homing stay during the whole motion.
#[test]
fn a_moving_axis_is_not_home_whatever_its_bits_say() {
    let mut bench = ready_to_home(|bench| {
        bench.insertion.homing = Homing::Attained;
        bench.insertion.homing_cycles = 300;
        bench.insertion.clears_late = 300;
    });
    home(&mut bench);
    let (_, syncs) = until_homed(&mut bench);
    assert!(syncs >= 300, "{syncs}");
}

/// By methods 35 and 37 the bits are never clear. They count after 1 s at standstill.
#[test]
fn a_homing_that_takes_no_time_is_accepted_after_a_second() {
    let mut bench = ready_to_home(|bench| {
        bench.insertion.homing = Homing::Attained;
        bench.insertion.homing_cycles = 0;
    });
    home(&mut bench);
    let (_, syncs) = until_homed(&mut bench);
    assert!((100..=103).contains(&syncs), "{syncs}");
}

#[test]
fn a_homing_that_fails_or_never_ends_stops_the_stage() {
    let mut bench = ready_to_home(|bench| bench.insertion.homing_fails = true);
    home(&mut bench);
    assert_eq!(
        bench.until_fault(),
        "insertion: homing failed (statusword 0x2637 operation enabled); check switches, method \
         (0x6098) and speeds"
    );
    bench.until_stopped();
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);

    let mut bench = ready_to_home(|bench| bench.insertion.homing_cycles = u32::MAX);
    home(&mut bench);
    let fault = bench.until_fault();
    assert!(fault.starts_with("insertion: not home within 60.0 s (statusword 0x0237"), "{fault}");
    bench.until_stopped();
}

/// The drive ignores the command and shows the bits of an earlier homing; or takes the offset with the other sign; or
/// moves its position some SYNCs after it says that it is home.
#[test]
fn a_position_that_is_not_that_of_home_stops_the_stage() {
    let reads = |moved: fn(&mut Bench)| {
        let mut bench = ready_to_home(|bench| bench.insertion.homing_cycles = 0);
        home(&mut bench);
        bench.run_for(Duration::from_millis(500));
        moved(&mut bench);
        bench
    };
    let mut bench = reads(|bench| bench.insertion.counts = -COUNTS_PER_MM);
    assert_eq!(
        bench.until_fault(),
        "insertion: the drive says that it is home, but reads -1.000 mm, and home is 1.000 mm by its offset \
         (0x607C; EPOS4: 0x30B0): it did not move, or counts the offset otherwise; set zero instead"
    );
    bench.until_stopped();

    // Without the object home is 0.
    let mut config = homing_config();
    config.insertion.homing =
        config.insertion.homing.map(|homing| HomingConfig { offset: None, ..homing });
    let nodes = config.nodes();
    let stage = Stage::for_use(config, INSERTION, Time::from_secs_f64(1.0));
    let mut bench = Bench::with(stage, nodes);
    bench.insertion.objects.remove(&ObjectAddress::new(0x607c, 0));
    bench.insertion.homing_cycles = 0;
    bench.until_ready();
    home(&mut bench);
    bench.run_for(Duration::from_millis(500));
    bench.insertion.counts = 5 * COUNTS_PER_MM;
    let fault = bench.until_fault();
    assert!(fault.contains("but reads 5.000 mm, and home is 0.000 mm by its offset"), "{fault}");

    let mut bench = reads(|_| ());
    assert_eq!(until_homed(&mut bench).0, 1.0);
}

/// Its home would be lost, and with it where the cable is untwisted and the needle out.
#[test]
fn a_homed_axis_away_from_home_is_homed_again_only_if_asked() {
    let far = |again, bits| {
        let purpose = PerAxis { insertion: AxisUse::Home { again }, ..INSERTION };
        let config = homing_config();
        let nodes = config.nodes();
        let stage = Stage::for_use(config, purpose, Time::from_secs_f64(1.0));
        let mut bench = Bench::with(stage, nodes);
        bench.insertion.counts = 41 * COUNTS_PER_MM;
        bench.insertion.homing = bits;
        bench
    };
    let mut bench = far(false, Homing::Attained);
    assert_eq!(
        bench.until_fault(),
        "node 1 (insertion): homed already, and 40.000 mm from its home, which would be lost; jog it back \
         there, or home it --again (take the needle off, untwist the cable)"
    );
    bench.until_stopped();
    far(true, Homing::Attained).until_ready();
    far(false, Homing::NotDone).until_ready();
}

#[test]
fn a_stop_ends_a_homing() {
    let mut bench = ready_to_home(|_| ());
    home(&mut bench);
    bench.run_for(Duration::from_millis(50));
    bench.stage.disable(bench.now);
    assert!(bench.until_stopped());
    assert!(bench.has_sent("201#0200"));
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Homed { .. })));
}

#[test]
fn only_an_axis_in_homing_mode_is_homed() {
    let mut bench = ready_to_home(|_| ());
    let refused = bench.stage.home(bench.now, Axis::Rotation).expect_err("not in homing mode");
    assert_eq!(refused.to_string(), "the stage is not ready to home");
}

#[test]
fn an_axis_that_needs_homing_is_not_enabled_without_it() {
    let mut bench = Bench::new(homing_config());
    assert_eq!(
        bench.until_fault(),
        "node 1 (insertion): not homed (bit 12 of statusword 0x0650 is clear); take the needle off and home it \
         first: needle-bench stage home CONFIG --axis insertion"
    );
    bench.until_stopped();

    let mut bench = Bench::new(homing_config());
    bench.insertion.homing = Homing::Attained;
    let feedback = bench.until_feedback();
    let from_zero_mm = 1000.0 / f64::from(COUNTS_PER_MM);
    assert!((feedback.measured.insertion_mm - from_zero_mm).abs() < 1e-9);
    assert_eq!(bench.insertion.value(0x6060, 0), 8);
}

#[test]
fn a_configured_homed_bit_is_read_in_any_mode() {
    let mut config = homing_config();
    config.insertion.homing = Some(HomingConfig { homed_bit: 15, ..homing_by(17) });
    let mut bench = Bench::new(config.clone());
    assert!(bench.until_fault().contains("bit 15 of statusword"));

    let mut bench = Bench::new(config);
    bench.insertion.extra_bits = 1 << 15;
    bench.until_ready();
    assert!(!bench.has_sent("601#2F60600006"), "the drive is not asked in homing mode");
}

/// Homing by `method` within 1 min; bit 12 is the homed bit, and the drive keeps its own speeds and offset.
fn homing_by(method: i8) -> HomingConfig {
    HomingConfig {
        method,
        speed_switch: None,
        speed_zero: None,
        acceleration: None,
        offset: None,
        timeout: Duration::from_secs(60),
        homed_bit: HomingConfig::ATTAINED_BIT,
    }
}

#[test]
fn a_home_offset_that_no_drive_holds_is_refused_before_the_bring_up() {
    let mut config = config();
    config.insertion.homing = Some(HomingConfig { offset: Some(1e8), ..homing_by(37) });
    assert_eq!(
        config.validate().expect_err("refused"),
        "insertion: a home offset of 100000000.000 mm: more than 32 bits hold in counts"
    );
}
