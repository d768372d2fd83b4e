use super::*;
use crate::emulator::WhiteNoise;
use crate::geometry::so3;
use proptest::prelude::*;
use std::f64::consts::TAU;

const X_SB: Pose = Pose {
    rotation: Rotation3::from_matrix_unchecked(nalgebra::Matrix3::new(
        1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0,
    )),
    translation: Vector3::new(-1.2, 0.5, 0.0),
};

/// The positions of a sensor while the base turns by `turn_rad` in `n` steps. The needle is at `x_tw`, its tip at
/// `x_sb` in the sensor.
fn turned(x_tw: &Pose, x_sb: &Pose, turn_rad: f64, n: u32) -> Vec<TurnSample> {
    (0..n)
        .map(|k| {
            let rotation_meas_rad = 0.7 + turn_rad * f64::from(k) / f64::from(n);
            let rolled = Pose {
                rotation: Rotation3::from_axis_angle(&Vector3::z_axis(), rotation_meas_rad),
                ..Pose::identity()
            };
            let x_ts = *x_tw * rolled * x_sb.inverse();
            TurnSample {
                rotation_meas_rad,
                position_meas_mm: x_ts.translation,
                orientation_meas: Some(x_ts.rotation),
            }
        })
        .collect()
}

fn noisy(mut samples: Vec<TurnSample>, sd_mm: f64, seed: u64) -> Vec<TurnSample> {
    for (k, sample) in samples.iter_mut().enumerate() {
        sample.position_meas_mm += WhiteNoise::Gaussian(sd_mm).draw(seed, k as u64);
    }
    samples
}

fn standing() -> Pose {
    Pose {
        rotation: so3::exp(&Vector3::new(0.9, -0.4, 1.3)),
        translation: Vector3::new(80.0, -30.0, -250.0),
    }
}

/// The axis from little more than half a turn is about half as certain as from a whole turn.
#[test]
fn the_standard_errors_match_the_scatter_of_noisy_fits() {
    let x_tw = standing();
    let true_axis = x_tw.rotation * Vector3::z();
    let mut axis_sds = Vec::new();
    for turn_rad in [TAU, 1.15 * PI] {
        let (mut centre, mut axis, mut stated) = (0.0, 0.0, (0.0, 0.0));
        for seed in 0..200 {
            let samples = noisy(turned(&x_tw, &X_SB, turn_rad, 60), 0.05, seed);
            let fit = TipFit::of(&samples, 0.5).expect("a circle");
            let off_mm = fit.centre_mm - x_tw.translation;
            centre += (off_mm - true_axis * true_axis.dot(&off_mm)).norm_squared();
            axis += fit.axis.angle(&true_axis).powi(2);
            stated = (stated.0 + fit.centre_sd_mm.powi(2), stated.1 + fit.axis_sd_rad.powi(2));
        }
        // The error has two directions; the standard error is that of the less certain one.
        for ratio in [(centre / stated.0).sqrt(), (axis / stated.1).sqrt()] {
            assert!((0.9..1.6).contains(&ratio), "{ratio} at {turn_rad}");
        }
        axis_sds.push((stated.1 / 200.0).sqrt());
    }
    assert!(axis_sds[1] > 1.5 * axis_sds[0], "{axis_sds:?}");
}

#[track_caller]
fn refusal(samples: &[TurnSample]) -> String {
    TipFit::of(samples, 0.5).expect_err("refused")
}

fn vector(max: f64) -> impl Strategy<Value = Vector3<f64>> {
    (-max..max, -max..max, -max..max).prop_map(|(x, y, z)| Vector3::new(x, y, z))
}

proptest! {
    /// With the fitted pose, the tip of the turning sensor stands still and keeps its direction.
    #[test]
    fn any_mount_is_recovered(
        standing in (vector(1.8), vector(500.0)),
        // Less than a quarter turn: beyond it the sensor points backwards, which is refused.
        tilt in vector(0.85),
        across_mm in (0.1..5.0f64, 0.0..TAU),
        along_mm in -20.0..20.0f64,
    ) {
        let x_tw = Pose { rotation: so3::exp(&standing.0), translation: standing.1 };
        let rotation = so3::exp(&tilt);
        let across = Vector3::new(across_mm.0 * across_mm.1.cos(), across_mm.0 * across_mm.1.sin(), 0.0);
        let x_sb = Pose { rotation, translation: rotation * (across + Vector3::z() * along_mm) };
        let samples = turned(&x_tw, &x_sb, TAU, 60);
        let fit = TipFit::of(&samples, 0.5).expect("a circle");
        prop_assert!((fit.radius_mm - across_mm.0).abs() < 1e-9);
        prop_assert!(fit.mount.is_some());
        let found = fit.x_sb(along_mm);
        prop_assert!((found.translation - x_sb.translation).norm() < 1e-8, "{found:?} {x_sb:?}");
        for sample in &samples {
            let x_ts = Pose {
                rotation: sample.orientation_meas.expect("oriented"),
                translation: sample.position_meas_mm,
            };
            let tip = x_ts * found;
            prop_assert!((tip.translation - x_tw.translation).norm() < 1e-8);
            prop_assert!((tip.rotation * Vector3::z() - x_tw.rotation * Vector3::z()).norm() < 1e-8);
        }
    }

    /// No input makes it panic.
    #[test]
    fn any_samples_are_fitted_or_refused(
        numbers in prop::collection::vec(prop_oneof![any::<f64>(), -9.0..9.0f64], 0..80),
        rms_max_mm in any::<f64>(),
    ) {
        let samples: Vec<_> = numbers
            .chunks_exact(4)
            .map(|c| TurnSample {
                rotation_meas_rad: c[0],
                position_meas_mm: Vector3::from_column_slice(&c[1..]),
                orientation_meas: None,
            })
            .collect();
        if let Ok(fit) = TipFit::of(&samples, rms_max_mm) {
            prop_assert!((fit.axis.norm() - 1.0).abs() < 1e-9 && fit.radius_mm.is_finite());
        }
    }
}

/// Noise gives an RMS of √2 standard deviations, within the plane and out of it, and changes the
/// result little.
#[test]
fn the_rms_of_noise_is_as_predicted() {
    let sd_mm = 0.05;
    for turn_rad in [TAU, 3.5] {
        let samples = noisy(turned(&standing(), &X_SB, turn_rad, 400), sd_mm, 1);
        let fit = TipFit::of(&samples, 0.5).expect("a circle");
        assert!((fit.rms_mm / (2f64.sqrt() * sd_mm) - 1.0).abs() < 0.1, "{fit:?}");
        assert!((fit.radius_mm - 1.3).abs() < 0.01, "{fit:?}");
        let found = fit.x_sb(0.0);
        assert!((found.translation - X_SB.translation).norm() < 0.02, "{found:?}");
        assert!((found.rotation * Vector3::z() - Vector3::z()).norm() < 0.02, "{found:?}");
    }
}

/// The base turns backwards, and the shaft lags by 10 degrees in either direction.
#[test]
fn the_axis_points_where_the_needle_does_whichever_way_it_turns() {
    for turn_rad in [TAU, -TAU] {
        let mut samples = turned(&standing(), &X_SB, turn_rad, 100);
        for sample in &mut samples {
            sample.rotation_meas_rad += 0.17 * turn_rad.signum();
        }
        let fit = TipFit::of(&samples, 0.5).expect("a circle");
        assert!((fit.axis - standing().rotation * Vector3::z()).norm() < 1e-9, "{fit:?}");
    }
}

/// With five degrees of freedom the sensor measures its direction but not its roll.
#[test]
fn a_sensor_without_roll_gives_the_axis_and_no_mount() {
    let mut samples = turned(&standing(), &X_SB, TAU, 100);
    for sample in &mut samples {
        let heading = standing().rotation * Vector3::z();
        sample.orientation_meas = Rotation3::rotation_between(&Vector3::z(), &heading);
    }
    let fit = TipFit::of(&samples, 0.5).expect("a circle");
    assert_eq!(fit.mount, None);
    assert!((fit.radius_mm - 1.3).abs() < 1e-9);
    assert_eq!(fit.x_sb(4.0), Pose { translation: Vector3::z() * 4.0, ..Pose::identity() });
}

/// The tip is taken to be ahead on the sensor's z axis.
#[test]
fn a_sensor_without_roll_must_point_along_the_needle() {
    let tilted = |deg: f64| {
        let mut samples = turned(&standing(), &X_SB, TAU, 100);
        let tilt = so3::exp(&(Vector3::x() * deg.to_radians()));
        for sample in &mut samples {
            sample.orientation_meas = Some(standing().rotation * tilt);
        }
        samples
    };
    assert!(TipFit::of(&tilted(29.0), 0.5).is_ok());
    for deg in [31.0, 90.0, 180.0] {
        let expected =
            format!("tip: the sensor's z axis is {deg:.0} deg from the needle's (limit 30");
        assert!(refusal(&tilted(deg)).starts_with(&expected), "{}", refusal(&tilted(deg)));
    }
}

#[test]
fn turns_that_determine_no_tip_are_refused() {
    let whole = || turned(&standing(), &X_SB, TAU, 100);
    assert_eq!(refusal(&whole()[..7]), "tip: 7 positions, at least 8 needed; record a whole turn");
    assert_eq!(
        refusal(&turned(&standing(), &X_SB, 1.5, 100)),
        "tip: the positions cover 85 deg of a circle and the base turned 85 deg (at least 180 \
         needed); turn the base a whole turn"
    );
    let mut unturned = whole();
    unturned.iter_mut().for_each(|sample| sample.rotation_meas_rad = 0.0);
    assert!(refusal(&unturned).contains("the base turned 0 deg"));
    let on_a_line = |k: usize| Vector3::new(0.02 * k as f64, 1.0, 2.0);
    let mut line = whole();
    (0..).zip(&mut line).for_each(|(k, sample)| sample.position_meas_mm = on_a_line(k));
    assert!(refusal(&line).contains("are all the same, or on one line"), "{}", refusal(&line));

    let mut inserted = whole();
    let axis = standing().rotation * Vector3::z();
    (0..100u32)
        .zip(&mut inserted)
        .for_each(|(k, sample)| sample.position_meas_mm += axis * (0.05 * f64::from(k)));
    let text = refusal(&inserted);
    assert!(text.contains("mm RMS off a circle (limit 0.50, --rms-max-mm)"), "{text}");
    assert!(
        text.ends_with("turn only the base, in air, with the insertion axis at rest"),
        "{text}"
    );

    let coaxial = noisy(turned(&standing(), &Pose::identity(), TAU, 100), 0.05, 2);
    let text = refusal(&coaxial);
    assert!(text.contains("no offset from the needle's axis can be seen"), "{text}");

    let scaled = |scale: f64| {
        let mut samples = whole();
        samples.iter_mut().for_each(|sample| sample.position_meas_mm *= scale);
        samples
    };
    assert_eq!(
        refusal(&scaled(1e-3)),
        "tip: the circle's radius is 0.00130 mm (at least 0.02 needed): the positions look like metres; OpenIGTLink \
         is in mm; for a sensor on the axis leave tracker.tip_offset_mm at zero"
    );
    let on_axis = refusal(&scaled(1e-6));
    assert!(on_axis.contains("can be seen; leave") && !on_axis.contains("metres"), "{on_axis}");
    // An ideal sensor exactly on the axis.
    let ideal = refusal(&turned(&standing(), &Pose::identity(), TAU, 100));
    assert!(ideal.contains("axis") && !ideal.contains("metres"), "{ideal}");

    let mut in_degrees = whole();
    in_degrees.iter_mut().for_each(|s| s.rotation_meas_rad = s.rotation_meas_rad.to_degrees());
    let text = refusal(&in_degrees);
    assert!(text.contains("is rotation_rad in rad"), "{text}");

    let mut unknown = whole();
    unknown[50].rotation_meas_rad = f64::NAN;
    let text = refusal(&unknown);
    assert!(text.contains("their angles agree to NaN"), "{text}");

    let mut far = whole();
    far[4].position_meas_mm.x = f64::NAN;
    assert!(refusal(&far).starts_with("tip: position 5 is NaN mm"), "{}", refusal(&far));
}

#[test]
fn a_recording_is_read_by_its_header() {
    let plain = TurnSample::parse("x_mm,y_mm,z_mm,rotation_rad\n1,2,3,0.5\n").expect("read");
    assert_eq!(plain[0].position_meas_mm, Vector3::new(1.0, 2.0, 3.0));
    assert_eq!((plain[0].rotation_meas_rad, plain[0].orientation_meas), (0.5, None));
    let header = "rotation_rad,x_mm,y_mm,z_mm,qw,qx,qy,qz";
    let posed = TurnSample::parse(&format!("{header}\n0,1,2,3,1,0,0,0\n")).expect("read");
    assert_eq!(posed[0].orientation_meas, Some(Rotation3::identity()));
    let error = TurnSample::parse(&format!("{header}\n0,1,2,3,0,0,0,0\n")).expect_err("zero");
    assert!(error.starts_with("line 2: "), "{error}");
}

/// A base that counts in the other direction looks like a sensor mounted backwards, which would put
/// the tip on the wrong side.
#[test]
fn a_sensor_that_looks_backwards_is_refused() {
    let backwards = so3::exp(&Vector3::new(3.0, 0.0, 0.0));
    let x_sb = Pose { rotation: backwards, translation: Vector3::new(2.0, 0.0, 0.0) };
    let refused = refusal(&turned(&standing(), &x_sb, TAU, 60));
    assert!(refused.starts_with("tip: the needle's axis is 172 deg"), "{refused}");
}
