//! The checks of registration, tip and needle.

use super::*;

const FIT: &str = "tracker.registration={ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, \
    pitch_deg = 0.0, roll_deg = 0.0, fit = { file = \"p.csv\", sha256 = \"0\", version = \"0\", \
    date_utc = \"2026-08-01T12:00:00.000000Z\", points = 4, rms_mm = 0.4, spread_mm = [9.0, 9.0, 9.0], \
    fiducials = [\
        { tracker_mm = [0.0, 0.0, 0.0], bench_mm = [0.0, 0.0, 0.0] }, \
        { tracker_mm = [50.0, 0.0, 0.0], bench_mm = [50.0, 0.0, 0.0] }, \
        { tracker_mm = [0.0, 0.0, 50.0], bench_mm = [0.0, 0.0, 50.0] }, \
        { tracker_mm = [0.0, 70.0, 0.0], bench_mm = [0.0, 70.0, 0.0] }] } }";

#[test]
fn missing_poor_or_old_calibrations_do_not_pass() {
    let of = |sets: &[&str]| verdicts(&calibrations(&rig(sets), NOW_UNIX_US));
    const OFFSET: &str = "tracker.tip_offset_mm=[0.0, 0.0, 7.0]";
    assert_eq!(of(&[OFFSET]), "FWW", "missing");
    assert_eq!(of(&[FIT]), "WWW", "113 days old, and the default tip");
    assert_eq!(of(&[FIT, "calibration.max_age_days=120"]), "PWW");
    assert_eq!(of(&[&FIT.replace("0.4", "1.4"), "calibration.max_age_days=120"]), "FWW");
    // Values without a fit do not show when and how they were measured.
    assert_eq!(of(&[REGISTRATION, OFFSET]), "WWW");
    let mut emulated = rig(&[REGISTRATION]);
    emulated.stage.hardware = false;
    assert_eq!(
        verdicts(&calibrations(&emulated, NOW_UNIX_US)),
        "PPP",
        "an emulated needle is exactly as configured"
    );
    let points = "tracker.registration={ fiducials = [\
        { tracker_mm = [0.0, 0.0, 0.0], bench_mm = [0.0, 0.0, 0.0] }, \
        { tracker_mm = [50.0, 0.0, 0.0], bench_mm = [50.0, 0.0, 0.0] }, \
        { tracker_mm = [0.0, 50.0, 0.0], bench_mm = [0.0, 50.0, 0.0] }] }";
    assert_eq!(of(&[points, OFFSET]), "WWW");
    let found = |fit: &str| calibrations(&rig(&[fit]), NOW_UNIX_US)[0].found.clone();
    assert_eq!(found(points), "3 points, 0.00 mm RMS, 0.00 mm at the tip, typed in, no date");
    assert_eq!(found(FIT), "0.40 mm RMS, 0.00 mm at the tip, 113 days ago");
    for (date, age) in [("2036-08-01", "dated 3540 days ahead"), ("rubbish", "no date")] {
        let fit = FIT.replace("2026-08-01", date);
        assert_eq!(
            (of(&[&fit]).as_str(), found(&fit).as_str()),
            ("WWW", &*format!("0.40 mm RMS, 0.00 mm at the tip, {age}"))
        );
    }
}

/// The verdict on the registration alone, and the next step.
#[test]
fn a_registration_is_judged_by_its_fiducials() {
    let of = |set: &str| {
        let sets = [set, "calibration.max_age_days=120"];
        let check = calibrations(&rig(&sets), NOW_UNIX_US).swap_remove(0);
        (check.verdict, check.found, check.next_step.unwrap_or_default())
    };
    let (verdict, found, _) = of(FIT);
    assert_eq!(
        (verdict, found.as_str()),
        (Verdict::Pass, "0.40 mm RMS, 0.00 mm at the tip, 113 days ago")
    );
    // A pose that is not theirs was changed by hand.
    let (verdict, found, _) = of(&FIT.replacen("x_mm = 0.0", "x_mm = 0.01", 1));
    assert_eq!((verdict, found.as_str()), (Verdict::Warn, "typed in, no date"));
    let (start, fiducials) = FIT.split_once(", fiducials").unwrap();
    let (verdict, _, next) = of(&format!("{start} }} }}"));
    assert_eq!(verdict, Verdict::Warn);
    assert!(next.starts_with("its file has no fiducials"), "{next}");
    // The same ones in the configuration itself, near their places and off them.
    let inline = |x_mm: f64, z_mm: f64| {
        let fiducials = fiducials
            .replace("bench_mm = [50.0, 0.0, 0.0]", &format!("bench_mm = [{x_mm:.1}, 0.0, 0.0]"));
        let fiducials = fiducials.replace("0.0, 50.0]", &format!("0.0, {z_mm:.1}]"));
        let fiducials = fiducials.trim_end_matches(" }");
        of(&format!("tracker.registration={{ rms_max_mm = 99.0, fiducials{fiducials} }}"))
    };
    let (verdict, _, next) = inline(50.0, 50.0);
    assert_eq!((verdict, next.starts_with("nothing shows when")), (Verdict::Warn, true), "{next}");
    let (verdict, found, next) = inline(60.0, 50.0);
    assert_eq!(verdict, Verdict::Fail, "{found}");
    assert!(next.starts_with("over 1 mm RMS"), "{next}");
    let (verdict, _, next) = inline(50.0, 0.1);
    assert_eq!(
        (
            verdict,
            next.contains("the points lie in a plane") && next.contains("nothing shows when")
        ),
        (Verdict::Warn, true),
        "{next}"
    );
}

/// What a configuration with these fiducials is warned of, so is a file that keeps them.
#[test]
fn the_fiducials_of_a_registration_file_are_judged_too() {
    let of = |from: &str, to: &str| {
        let fit = FIT.replace(from, to);
        assert_ne!(fit, FIT, "{from}");
        let sets = [&*fit, "calibration.max_age_days=120", "insertion.depth_mm=50.0"];
        let check = calibrations(&rig(&sets), NOW_UNIX_US).swap_remove(0);
        (check.verdict, check.found, check.next_step.unwrap_or_default())
    };
    let (verdict, _, next) = of("0.0, 50.0]", "0.0, 0.1]");
    assert_eq!(
        (verdict, next.starts_with("the points lie in a plane")),
        (Verdict::Warn, true),
        "{next}"
    );
    let (verdict, _, next) = of("70.0", "50.0");
    let said = "the bench's points fit in the order 1,3,4,2 as well";
    assert_eq!((verdict, next.starts_with(said)), (Verdict::Warn, true), "{next}");
    let (verdict, found, next) = of("pitch_deg = 0.0,", "pitch_deg = 0.0, sd_mm = 1.01,");
    assert_eq!(
        (verdict, found.as_str()),
        (Verdict::Warn, "0.40 mm RMS, 1.01 mm at the tip, 113 days ago")
    );
    assert_eq!(
        next,
        "the tip would be off by over 1 mm: touch more points, around the needle's path"
    );
    let (verdict, ..) = of("pitch_deg = 0.0,", "pitch_deg = 0.0, sd_mm = 0.99,");
    assert_eq!(verdict, Verdict::Pass);
}

/// A tip that was calibrated after the fiducials were touched with it is in the pose already.
#[test]
fn a_registration_collected_with_another_tip_fails() {
    let of = |kept: &str, tip: &str| {
        let fit = FIT.replace("points = 4,", &format!("points = 4, {kept}"));
        let sets = [&*fit, "calibration.max_age_days=120", tip];
        let check = calibrations(&rig(&sets), NOW_UNIX_US).swap_remove(0);
        (check.verdict, check.next_step.unwrap_or_default())
    };
    let (before, with) = ("tip_offset_mm = [0.0, 0.0, 0.0],", "tip_offset_mm = [-3.0, 0.0, 7.0],");
    let at = |x_mm: f64| format!("tracker.tip_offset_mm=[{x_mm:.3}, 0.0, 7.0]");
    assert_eq!(of(with, &at(-3.0)), (Verdict::Pass, String::new()));
    assert_eq!(of(with, &at(-3.049)).0, Verdict::Pass);
    // Another needle, or a corrected offset of the same one.
    assert_eq!(of(with, &at(-3.051)).0, Verdict::Warn);
    assert_eq!(of(before, "tracker.tip_offset_mm=[0.0, 0.0, 0.0]").0, Verdict::Pass);
    let (verdict, next) = of(before, &at(-3.0));
    assert_eq!(
        (verdict, next.as_str()),
        (
            Verdict::Fail,
            "collected with tip_offset_mm [0.00, 0.00, 0.00], now [-3.00, 0.00, 7.00]: the tip's offset would count \
             twice; collect the fiducials again"
        )
    );
    // Touched with a probe.
    let probe = format!("tool = \"Probe\", {before}");
    assert_eq!(of(&probe, &at(-3.0)), (Verdict::Pass, String::new()));
    // A file of an earlier version.
    assert_eq!(of("", "tracker.tip_offset_mm=[0.0, 0.0, 0.0]").0, Verdict::Pass);
    let (verdict, next) = of("", &at(-3.0));
    assert_eq!(verdict, Verdict::Warn);
    assert!(next.starts_with("its file does not say with which tip_offset_mm"), "{next}");
}

#[test]
fn a_curvature_that_is_poorly_known_is_warned_about() {
    const TORSION: &str = "half_width_deg = 0.0, half_width_deg_per_mm = 0.0, offset_deg = 0.0, creep_mm = 0.0, \
                           creep_mm_per_mm = 0.0";
    let of = |sd_per_mm: f64| {
        let fit = format!(
            "needle.fit={{ file = \"a.csv\", sha256 = \"0\", version = \"0\", date_utc = \"2026-11-01T12:00:00.000000Z\", \
             insertions = 3, roll_rms_deg = 5.0, curvature_sd_per_mm = {sd_per_mm}, tip_ahead_sd_mm = 0.1, \
             bend_axis_sd_deg = 1.0, offset_spread_deg = 1.0, torsion_sd = {{ {TORSION} }} }}"
        );
        let needle = calibrations(
            &rig(&["needle.radius_mm=100.0", "calibration.max_age_days=120", &fit]),
            NOW_UNIX_US,
        )
        .remove(2);
        (needle.verdict, needle.next_step.unwrap_or_default())
    };
    assert_eq!(of(0.0015), (Verdict::Pass, String::new()));
    let (verdict, next) = of(0.0025);
    assert_eq!(
        (verdict, next.starts_with("its curvature is known to no better")),
        (Verdict::Warn, true),
        "{next}"
    );
}
