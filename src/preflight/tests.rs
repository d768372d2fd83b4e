use super::*;
use crate::canopen::NodeId;
use crate::canopen::cia402::Statusword;
use crate::canopen::emcy::EmcyCode;
use crate::config::{Config, Source};
use crate::stage::{Axis, AxisStatus, Identity};
use crate::tracker::{Event, Sample, Validity};
use crate::units::Time;
use nalgebra::Vector3;

mod calibrations;

const RIG: &str = include_str!("../../bench-config/rig-epos4.toml");
const REGISTRATION: &str = "tracker.registration={ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, \
                            yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }";
/// 2026-11-22T12:00:00Z.
const NOW_UNIX_US: i64 = 1_795_348_800_000_000;

fn rig(sets: &[&str]) -> Config {
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    Config::from_sources(&[Source { name: "rig.toml", text: RIG }], &sets).expect("valid")
}

fn facts() -> BusFacts {
    BusFacts {
        is_up: true,
        state: Some("error active".to_owned()),
        may_send: true,
        bit_rate: Some(1_000_000),
        restart_ms: Some(0),
        errors: Some([0, 3]),
    }
}

fn status() -> AxisStatus {
    AxisStatus {
        node: NodeId::new(1).unwrap(),
        device_type: Some(0x0002_0192),
        identity: Identity { vendor: 0xfb, product: 7, revision: None, serial: None },
        statusword: Statusword(0x8240),
        mode: None,
        position_counts: Some(-5),
        position: Some(0.0),
        homed: Some(true),
        error_code: None,
        error_history: Vec::new(),
        digital_inputs: None,
        nmt_state: None,
        extra_answers: 0,
    }
}

/// The verdicts of `checks`: P, W or F for each.
fn verdicts(checks: &[Check]) -> String {
    checks.iter().map(|check| check.verdict.to_string().remove(0)).collect()
}

#[test]
fn a_bus_that_restarts_by_itself_or_is_down_fails() {
    let config = rig(&[]);
    assert_eq!(verdicts(&bus(&config, Ok(Some(facts())))), "PPPP");
    let restarting = BusFacts { restart_ms: Some(100), ..facts() };
    assert_eq!(verdicts(&bus(&config, Ok(Some(restarting)))), "PPFP");
    let slow = BusFacts { bit_rate: Some(100_000), errors: Some([96, 0]), ..facts() };
    assert_eq!(verdicts(&bus(&config, Ok(Some(slow)))), "PWPW");
    let too_slow = BusFacts { bit_rate: Some(50_000), ..facts() };
    assert_eq!(verdicts(&bus(&config, Ok(Some(too_slow)))), "PFPP");
    let off = BusFacts { may_send: false, ..facts() };
    assert_eq!(verdicts(&bus(&config, Ok(Some(off)))), "FPPP");
    let down = BusFacts { is_up: false, ..facts() };
    assert_eq!(verdicts(&bus(&config, Ok(Some(down)))), "FPPP");
    assert_eq!(verdicts(&bus(&config, Err("denied".to_owned()))), "W");
    let [row] = &bus(&config, Ok(None))[..] else { panic!("one row") };
    assert_eq!((row.verdict, row.found.as_str()), (Verdict::Fail, "no interface can0"));
    let next = row.next_step.as_ref().unwrap();
    assert!(next.ends_with("sudo ip link set can0 up type can bitrate 1000000 restart-ms 0"));
    // An unknown value is no PASS, except on a virtual interface, which has neither rate nor counters.
    let unknown = || BusFacts { bit_rate: None, restart_ms: None, errors: None, ..facts() };
    assert_eq!(verdicts(&bus(&config, Ok(Some(unknown())))), "PWWW");
    let mut emulated = rig(&[]);
    emulated.stage.hardware = false;
    assert_eq!(verdicts(&bus(&emulated, Ok(Some(unknown())))), "PPPP");
    let memory = rig(&["emulator.rehearse=true"]);
    let [row] = &bus(&memory, Err(String::new()))[..] else { panic!("one row") };
    assert_eq!((row.verdict, row.found.as_str()), (Verdict::Pass, "memory: not a CAN interface"));
}

#[test]
fn a_drive_that_a_run_would_refuse_fails() {
    let config = rig(&["stage.insertion.product_code=7"]);
    let of = |status: AxisStatus| verdicts(&drive(&config, Axis::Insertion, Ok(status)));
    assert_eq!(of(status()), "PPPP");
    assert_eq!(of(AxisStatus { homed: Some(false), ..status() }), "PPFP");
    assert_eq!(
        of(AxisStatus { homed: None, ..status() }),
        "PPPP",
        "unknown here; the run asks the drive"
    );
    // An insertion of 50 mm from there exceeds the limit of 60 mm.
    assert_eq!(of(AxisStatus { position: Some(10.01), ..status() }), "PPPF");
    assert_eq!(of(AxisStatus { position: Some(-1.01), ..status() }), "PPPF");
    // A jog to 10 mm ends at the next whole count, just beyond.
    let to_a_count = 46_457.0 * 127.0 / 590_000.0;
    assert_eq!(of(AxisStatus { position: Some(to_a_count), ..status() }), "PPPP");
    let known = vec![EmcyCode::HEARTBEAT];
    assert_eq!(of(AxisStatus { error_history: known, ..status() }), "PWPP");
    assert_eq!(of(AxisStatus { statusword: Statusword(0x8208), ..status() }), "FPPP");
    // Operation enabled, quick stop active and switched on have power.
    for powered in [0x8227, 0x8217, 0x8233] {
        assert_eq!(of(AxisStatus { statusword: Statusword(powered), ..status() }), "WPPP");
    }
    let other = Identity { product: 8, ..status().identity };
    assert_eq!(of(AxisStatus { identity: other, ..status() }), "FPPP");
    let twins = AxisStatus { extra_answers: 9, ..status() };
    let checks = drive(&config, Axis::Insertion, Ok(twins));
    assert_eq!(verdicts(&checks), "FPPP");
    assert!(checks[0].found.ends_with("; 9 answers more than requests"), "{}", checks[0].found);
    let next = checks[0].next_step.as_deref();
    assert_eq!(next, Some("two drives have node number 1: give one of them another"));
    for silent in [
        AxisStatus { position_counts: None, ..status() },
        AxisStatus { device_type: None, ..status() },
    ] {
        assert_eq!(of(silent), "F");
    }
    assert_eq!(verdicts(&drive(&config, Axis::Insertion, Err("silent".to_owned()))), "F");
    // The rotation turns by itself, and the last run may have left it near its limit of 720 degrees.
    let turned = |deg: f64| {
        let config = rig(&["stage.rotation.product_code=7"]);
        let status = AxisStatus { position: Some(deg.to_radians()), ..status() };
        verdicts(&drive(&config, Axis::Rotation, Ok(status)))
    };
    assert_eq!([turned(359.0), turned(-361.0), turned(721.0)], ["PPPP", "PPPW", "PPPF"]);
    // Two drives of one type can be exchanged, unless their serial numbers are given.
    let types = ["stage.insertion.product_code=7", "stage.rotation.product_code=7"];
    let numbered = Identity { serial: Some(9), ..status().identity };
    let numbered = || AxisStatus { identity: numbered, ..status() };
    let with = |serial: &[&str]| {
        let config = rig(&[&types[..], serial].concat());
        verdicts(&drive(&config, Axis::Insertion, Ok(numbered())))
    };
    assert_eq!([with(&[]), with(&["stage.insertion.serial=9"])], ["WPPP", "PPPP"]);
    assert_eq!(with(&["stage.insertion.serial=8"]), "FPPP");
    // The example file accepts any product code.
    assert_eq!(verdicts(&drive(&rig(&[]), Axis::Insertion, Ok(status()))), "WPPP");
    let resets = rig(&["stage.fault_reset_on_start=true", "stage.insertion.product_code=7"]);
    let faulty = AxisStatus { statusword: Statusword(0x8208), ..status() };
    assert_eq!(verdicts(&drive(&resets, Axis::Insertion, Ok(faulty))), "PPPP");
}

/// The report on 80 positions, 25 ms apart, each received `late_s` after its stamp.
fn listened(config: &Config, late_s: f64, at: impl Fn(u32) -> Vector3<f64>) -> TrackerReport {
    listened_stamped(config, |ns| ns - (late_s * 1e9) as i64, at)
}

/// The report on 80 positions, 25 ms apart; `stamp_ns` makes the stamp from the time of receipt, ns since 1970.
fn listened_stamped(
    config: &Config,
    stamp_ns: impl Fn(i64) -> i64,
    at: impl Fn(u32) -> Vector3<f64>,
) -> TrackerReport {
    let gate = config.tracker.to_gate().unwrap_or_else(|_| config.tracker.to_unregistered_gate());
    let mut listening = Listening::new(gate, 1_000_000_000);
    for k in 0..80 {
        let receive_time = Time::from_secs_f64(f64::from(k) * 0.025);
        listening.take(&Event::Sample(Sample {
            tool: config.tracker.tool.clone(),
            receive_time,
            source_unix_ns: Some(stamp_ns(receive_time.as_nanos() + 1_000_000_000)),
            position_mm: at(k),
            orientation: Some(nalgebra::UnitQuaternion::identity()),
            validity: Validity::Valid,
        }));
    }
    listening.report(Time::ZERO, Time::from_secs_f64(2.0), || "nothing came".to_owned())
}

#[test]
fn a_tracker_is_judged_by_its_positions_noise_and_stamps() {
    let config = rig(&[REGISTRATION]);
    let jitter = |sd: f64| {
        move |k: u32| {
            let sign = if (k / 2).is_multiple_of(2) { 1.0 } else { -1.0 };
            Vector3::new(1.0 + sd * sign, 2.0, 3.0)
        }
    };
    let quiet = listened(&config, 0.02, jitter(0.3));
    assert_eq!((quiet.accepted, quiet.rate_hz, quiet.trouble.as_deref()), (80, 40.0, None));
    assert!((quiet.stamp_skew_s.unwrap() - 0.02).abs() < 1e-9, "{quiet:?}");
    // The rig has no workspace yet.
    assert_eq!(verdicts(&tracker(&config, &quiet)), "PPPPPW");
    // A value that was not measured is no PASS.
    let unmeasured = TrackerReport { noise_sd_mm: None, stamp_skew_s: None, ..quiet.clone() };
    assert_eq!(verdicts(&tracker(&config, &unmeasured)), "PPPWWW");
    let unstamped = rig(&[REGISTRATION, "tracker.stamp=\"receive\""]);
    assert_eq!(verdicts(&tracker(&unstamped, &unmeasured)), "PPPWPW", "no stamp is used");
    let stamped = rig(&[REGISTRATION, "tracker.stamp=\"source\""]);
    assert_eq!(
        (quiet.stamp_pace, verdicts(&tracker(&stamped, &quiet))),
        (Some(1.0), "PPPPPW".to_owned())
    );
    let in_microseconds = TrackerReport { stamp_pace: Some(0.001), ..quiet.clone() };
    let row = &tracker(&stamped, &in_microseconds)[4];
    let next = "they advance by 0.001 s in a second (allowed 0.5 to 2.0): set tracker.stamp = \"receive\", or mend the \
                source's clock";
    assert_eq!((row.verdict, row.next_step.as_deref()), (Verdict::Warn, Some(next)));
    assert_eq!(verdicts(&tracker(&unstamped, &in_microseconds)), "PPPPPW", "no stamp is used");
    let noisy = listened(&config, -2.0, jitter(3.0));
    assert_eq!(verdicts(&tracker(&config, &noisy)), "PPPWWW");
    // A tool that is moved is not noisy.
    let moved = listened(&config, 0.0, |k| Vector3::new(0.5 * f64::from(k) + 0.1, 0.0, 0.0));
    assert_eq!(verdicts(&tracker(&config, &moved)), "PPPPPW");
    let flat = listened(&config, 0.0, |k| Vector3::new(0.3 + 0.004 * f64::from(k), 2.0, 3.0));
    let [row, ..] = &tracker(&config, &flat)[..] else { panic!("a row") };
    let next = "y of the tracker is 2.00 mm to the bit in 80 different positions: has it two dimensions, or its \
                transform a row of zeros?";
    assert_eq!((row.verdict, row.next_step.as_deref()), (Verdict::Fail, Some(next)));
    let two = listened(&config, 0.0, |k| Vector3::new(1.0, 2.0, f64::from(k % 2) * 80.0 + 0.1));
    assert!(two.has_two_tools);
    assert_eq!(verdicts(&tracker(&config, &two))[..1], *"F");
    let zero = listened(&config, 0.0, |_| Vector3::zeros());
    let [row] = &tracker(&config, &zero)[..] else { panic!("one row") };
    assert!(row.next_step.as_ref().unwrap().contains("zero"), "{row:?}");
    assert_eq!(quiet.last_position_bench_mm, Some([0.7, 2.0, 3.0]));
}

/// Whole seconds; and MITK's stamps, whole seconds with the milliseconds as nanoseconds.
#[test]
fn stamps_of_a_coarse_resolution_are_warned_about() {
    let [stamped, received] = ["tracker.stamp=\"source\"", "tracker.stamp=\"receive\""]
        .map(|stamp| rig(&[REGISTRATION, stamp]));
    let at = |k: u32| Vector3::new(1.0 + 0.1 * f64::from(k % 7), 2.0 + 0.1 * f64::from(k % 5), 3.0);
    let second = |ns: i64| ns - ns % 1_000_000_000;
    let coarse: [fn(i64) -> i64; 2] = [
        |ns| ns - ns % 1_000_000_000,
        |ns| ns - ns % 1_000_000_000 + ns % 1_000_000_000 / 1_000_000,
    ];
    for stamp_ns in coarse {
        let report = listened_stamped(&stamped, stamp_ns, at);
        assert!(report.has_coarse_stamps);
        let row = &tracker(&stamped, &report)[4];
        let next = "most differ by under 1 ms although positions arrive 5 ms or more apart (coarse resolution): set \
                    tracker.stamp = \"receive\"";
        assert_eq!((row.verdict, row.next_step.as_deref()), (Verdict::Warn, Some(next)));
        assert_eq!(tracker(&received, &report)[4].verdict, Verdict::Pass, "no stamp is used");
    }
    // Stamps of whole milliseconds; and a server that repeats its last position with its last stamp.
    let repeated = listened_stamped(&stamped, second, |_| Vector3::new(1.0, 2.0, 3.0));
    let fine = listened_stamped(&stamped, |ns| ns - ns % 1_000_000, at);
    assert!(!repeated.has_coarse_stamps && !fine.has_coarse_stamps);
}

/// A run refuses such positions without a word on where they are.
#[test]
fn a_tip_outside_the_workspace_fails() {
    const BOX: &str =
        "tracker.workspace={ min_mm = [-30.0, -30.0, -10.0], max_mm = [30.0, 30.0, 80.0] }";
    let config = rig(&[REGISTRATION, BOX]);
    let at = |config: &Config, x_mm: f64| {
        let report = listened(config, 0.0, move |k| Vector3::new(x_mm, 0.1 * f64::from(k), 0.5));
        tracker(config, &report).pop().unwrap()
    };
    let in_metres = listened(
        &rig(&[&REGISTRATION.replacen("x_mm = 0.0", "x_mm = -400.0", 1), BOX]),
        0.0,
        |_| Vector3::new(0.41, 0.005, 0.02),
    );
    let row = tracker(&config, &in_metres).pop().unwrap();
    let next = "the positions look like metres; OpenIGTLink is in mm";
    assert_eq!((row.verdict, row.next_step.as_deref()), (Verdict::Fail, Some(next)));
    let inside = at(&config, 29.9);
    assert_eq!(
        (inside.verdict, inside.found.as_str()),
        (Verdict::Pass, "tip at 29.9, 7.9, 0.5 mm")
    );
    let outside = at(&config, 30.1);
    assert_eq!(
        (outside.verdict, outside.found.as_str(), outside.limit.as_str()),
        (
            Verdict::Fail,
            "tip at 30.1, 7.9, 0.5 mm",
            "-30.0 to 30.0, -30.0 to 30.0, -10.0 to 80.0 mm"
        )
    );
    let outside = listened(&config, 0.0, |k| Vector3::new(99.0, f64::from(k), 0.5));
    assert_eq!((outside.accepted, outside.refused), (0, 80), "counted as in a run");
    assert_eq!(verdicts(&tracker(&config, &outside)), "FWPPPF");
    // Without a registration the position in the bench frame is unknown.
    let unregistered = at(&rig(&[BOX]), 99.0);
    assert_eq!(unregistered.verdict, Verdict::Warn, "{unregistered:?}");
}

#[test]
fn the_plane_is_checked_from_the_last_position() {
    let config = rig(&[REGISTRATION]);
    let at =
        |x_mm: f64| listened(&config, 0.0, move |k| Vector3::new(x_mm, 0.1 * f64::from(k), 0.5));
    let near = plane(&config, &at(1.5)).unwrap();
    assert_eq!(
        (near.verdict, near.found.as_str()),
        (Verdict::Pass, "tip +1.50 mm off it, heading 0.0 deg from observer.start")
    );
    let far = plane(&config, &at(80.0)).unwrap();
    assert_eq!(far.verdict, Verdict::Fail);
    assert!(far.next_step.unwrap().contains("out of reach"));
    let inserts = rig(&[REGISTRATION, "insertion.plane_out_of_reach=\"insert\""]);
    assert_eq!(plane(&inserts, &at(80.0)).unwrap().verdict, Verdict::Warn, "as the run judges it");
    assert_eq!(plane(&rig(&[]), &at(1.5)), None, "not without a registration");
}

/// The x component of a heading hides that the sensor's frame is turned about x, or by nearly a half turn about y.
#[test]
fn a_tip_that_does_not_head_along_the_configured_start_is_found() {
    const OFFSET: &str = "tracker.tip_offset_mm=[0.0, 0.0, 7.0]";
    const TILT: &str = "tracker.tip_tilt={ yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 90.0 }";
    const SURE: &str =
        "observer.invariant.start_sd={ yaw_deg = 2.0, pitch_deg = 2.0, roll_deg = 180.0 }";
    let of = |sets: &[&str], axis: Vector3<f64>, deg: f64| {
        let config = rig(&[&[REGISTRATION], sets].concat());
        let still = listened(&config, 0.0, |k| Vector3::new(1.0, 0.1 * f64::from(k), 0.5));
        let rotation = nalgebra::Rotation3::from_scaled_axis(axis * deg.to_radians());
        let heading = Some((rotation * Vector3::z()).into());
        plane(&config, &TrackerReport { last_heading_bench: heading, ..still }).unwrap()
    };
    for axis in [Vector3::x(), Vector3::y()] {
        for (sets, deg, verdict) in [
            (&[OFFSET, TILT][..], 35.0, Verdict::Pass),
            (&[OFFSET, TILT], 37.0, Verdict::Fail),
            (&[OFFSET, TILT], 180.0, Verdict::Fail),
            (&[OFFSET, TILT, SURE], 14.0, Verdict::Pass),
            (&[OFFSET, TILT, SURE], 16.0, Verdict::Warn),
            (&[OFFSET, TILT, SURE], 31.0, Verdict::Fail),
            (&[OFFSET, SURE], 150.0, Verdict::Warn),
            (&[TILT, SURE], 150.0, Verdict::Warn),
        ] {
            let check = of(sets, axis, deg);
            assert_eq!(check.verdict, verdict, "{deg} deg: {check:?}");
            assert!(check.found.ends_with(&format!("heading {deg:.1} deg from observer.start")));
        }
    }
    assert!(of(&[OFFSET], Vector3::x(), 90.0).next_step.unwrap().contains("tracker.tip_tilt"));
}

#[test]
fn wide_gates_are_warned_about() {
    let jitter =
        |k: u32| Vector3::new(1.0 + if (k / 2).is_multiple_of(2) { 0.05 } else { -0.05 }, 2.0, 3.0);
    let of = |sets: &[&str]| {
        let config = rig(&[&[REGISTRATION], sets].concat());
        verdicts(&tracker(&config, &listened(&config, 0.02, jitter)))
    };
    let fine = "tracker.gates.noise_sd_mm=0.1";
    assert_eq!(of(&[fine]), "PPPPPW");
    assert_eq!(of(&["tracker.gates.noise_sd_mm=100.0"]), "PPPWPW");
    let noise =
        "tracker.noise={ white_sd_mm = 0.05, correlated_sd_mm = 5.0, correlation_time_s = 5.0 }";
    assert_eq!(of(&[noise]), "PPPPPW");
    // Half a second at 1 mm/s is less than 100 mm.
    assert_eq!(of(&[fine, "tracker.hold_after_mm=100.0"]), "PPPPPW");
    assert_eq!(of(&[fine, "tracker.hold_after_mm=100.0", "tracker.hold_after_s=60.0"]), "PPWPPW");
}

/// A run notices a registration that is turned about the needle only if the roll at the start is known.
#[test]
fn an_unknown_roll_at_the_start_is_a_warning() {
    let of = |sd_deg: f64| {
        let sd = format!("yaw_deg = 12.0, pitch_deg = 8.0, roll_deg = {sd_deg:.1}");
        let check = start_roll(&rig(&[&format!("observer.invariant.start_sd={{ {sd} }}")]));
        check.map(|check| (check.verdict, check.found))
    };
    assert_eq!(of(180.0), Some((Verdict::Warn, "known to 180 deg".to_owned())));
    assert_eq!(of(90.0), Some((Verdict::Pass, "known to 90 deg".to_owned())));
    let mut emulated = rig(&[]);
    emulated.stage.hardware = false;
    assert_eq!(start_roll(&emulated), None);
}

#[test]
fn a_proof_counts_while_it_is_young_and_its_keys_unchanged() {
    let config = rig(&[]);
    let earlier = |date: &str, changed: &[&str]| Earlier {
        started_utc: date.to_owned(),
        proof: None,
        changed: changed.iter().map(|key| (*key).to_owned()).collect(),
    };
    let of = |last: Option<&Earlier>| proof(&config, false, last, NOW_UNIX_US);
    assert_eq!(of(None).verdict, Verdict::Warn);
    let young = earlier("2026-11-22T09:00:00.000000Z", &[]);
    assert_eq!(
        (of(Some(&young)).verdict, of(Some(&young)).found.as_str()),
        (Verdict::Pass, "3 h ago")
    );
    let ahead = of(Some(&earlier("2026-11-22T12:40:00.000000Z", &[])));
    assert_eq!(
        (ahead.verdict, ahead.found.as_str()),
        (Verdict::Pass, "0 h ago"),
        "a date slightly ahead, from another clock"
    );
    let changed = earlier("2026-11-22T09:00:00.000000Z", &["can.heartbeat_timeout_ms"]);
    assert_eq!(of(Some(&changed)).verdict, Verdict::Warn);
    for date in ["2026-01-22T09:00:00.000000Z", "2027-01-22T09:00:00.000000Z"] {
        assert_eq!(of(Some(&earlier(date, &[]))).verdict, Verdict::Warn, "{date}");
    }
    let keys = ["a", "b", "c", "d", "e", "f"];
    let many = changes(Some(&earlier("2026-11-22T09:00:00.000000Z", &keys)), NOW_UNIX_US);
    assert_eq!(many.found, "6 keys changed: a, b, c, d and 2 more");
    let one = changes(Some(&earlier("2026-11-22T09:00:00.000000Z", &["a"])), NOW_UNIX_US);
    assert_eq!(one.found, "1 key changed: a");
    assert_eq!(changes(None, NOW_UNIX_US).verdict, Verdict::Pass);
}

#[test]
fn a_proof_of_handedness_is_asked_for() {
    let never = proof(&rig(&[]), true, None, NOW_UNIX_US);
    assert_eq!((never.name.as_str(), never.verdict), ("handedness", Verdict::Warn));
    assert!(never.next_step.unwrap().contains("stage prove CONFIG --handedness"));
}

#[test]
fn a_full_disk_fails() {
    let config = rig(&[]);
    for (free_mb, verdict) in [
        (Ok(Some(100)), Verdict::Pass),
        (Ok(Some(99)), Verdict::Fail),
        (Ok(None), Verdict::Warn),
        (Err("gone".to_owned()), Verdict::Fail),
    ] {
        assert_eq!(disk(&config, free_mb).verdict, verdict);
    }
}

#[test]
fn the_worst_verdict_stays_and_the_next_step_is_under_its_line() {
    let checks = [
        Check::new("disk", "9 MB free", "at least 100 MB").with(Verdict::Fail, "make room"),
        // A later warning does not replace a failure.
        Check::unlimited("bus", "can0").with(Verdict::Fail, "a").with(Verdict::Warn, "b"),
        Check::new("tip", "fine", "fine"),
    ];
    assert_eq!(
        to_text(&checks),
        "FAIL  disk                     9 MB free (at least 100 MB)\n      make room\n\
         FAIL  bus                      can0 (no limit)\n      a\n\
         PASS  tip                      fine (fine)"
    );
}
