use super::*;
use crate::emulator::WhiteNoise;
use crate::geometry::so3;
use proptest::prelude::*;

fn vector(max: f64) -> impl Strategy<Value = Vector3<f64>> {
    (-max..max, -max..max, -max..max).prop_map(|(x, y, z)| Vector3::new(x, y, z))
}

fn pose() -> impl Strategy<Value = Pose> {
    (vector(1.8), vector(1000.0))
        .prop_map(|(w, translation)| Pose { rotation: so3::exp(&w), translation })
}

/// The points `tracker_mm` and where `x_wt` puts them.
fn pairs(x_wt: &Pose, tracker_mm: &[Vector3<f64>]) -> Vec<FiducialPair> {
    let pair = |&tracker_mm: &Vector3<f64>| FiducialPair {
        tracker_mm,
        bench_mm: x_wt.transform(&tracker_mm),
    };
    tracker_mm.iter().map(pair).collect()
}

/// The corners of a square, in a plane.
fn square(side_mm: f64) -> Vec<Vector3<f64>> {
    [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        .map(|(x, y)| Vector3::new(x * side_mm, y * side_mm, 0.0))
        .to_vec()
}

#[track_caller]
fn refusal(pairs: &[FiducialPair]) -> String {
    RegistrationFit::of(pairs, 1.0).expect_err("refused")
}

/// Rounding error allowed in a rotation. The decomposition works on fourth powers of lengths (covariance, then its
/// square). The narrowest set that is accepted has a breadth of 2% of its length, so its error is
/// 1e-16 / 0.02^4 = 1e-9, a thousandth of a micrometre at 1 m.
const TURN_MAX: f64 = 1e-8;

proptest! {
    /// The sets are solid or flat, down to triangles. Thin sets are refused.
    #[test]
    fn a_rigid_motion_is_recovered(
        x_wt in pose(),
        points_mm in prop::collection::vec(vector(150.0), 3..20),
        flat in any::<bool>(),
    ) {
        let flatten = |p: &Vector3<f64>| if flat { Vector3::new(p.x, p.y, 7.0) } else { *p };
        let points_mm: Vec<_> = points_mm.iter().map(flatten).collect();
        match RegistrationFit::of(&pairs(&x_wt, &points_mm), 1.0) {
            Ok(fit) => {
                let turned = fit.x_wt.rotation.matrix() - x_wt.rotation.matrix();
                prop_assert!(turned.norm() < TURN_MAX, "{turned}");
                let moved = fit.x_wt.translation - x_wt.translation;
                prop_assert!(moved.norm() < 1e3 * TURN_MAX, "{moved}");
                prop_assert!(fit.rms_mm < 1e3 * TURN_MAX && fit.worst_mm < 1e3 * TURN_MAX);
                prop_assert!((fit.x_wt.rotation.matrix().determinant() - 1.0).abs() < 1e-12);
            }
            Err(error) => {
                let thin = error.contains(" RMS off a line ");
                prop_assert!(thin, "{error}");
            }
        }
    }

    /// No input makes it panic, and every result is a rotation.
    #[test]
    fn any_pairs_are_fitted_or_refused(
        coordinates in prop::collection::vec(prop_oneof![any::<f64>(), -9.0..9.0f64], 0..60),
        rms_max_mm in any::<f64>(),
    ) {
        let pairs: Vec<_> = coordinates
            .chunks_exact(6)
            .map(|c| FiducialPair {
                tracker_mm: Vector3::from_column_slice(&c[..3]),
                bench_mm: Vector3::from_column_slice(&c[3..]),
            })
            .collect();
        if let Ok(fit) = RegistrationFit::of(&pairs, rms_max_mm) {
            let r = fit.x_wt.rotation.matrix();
            prop_assert!((r.tr_mul(r) - Matrix3::identity()).norm() < 1e-9);
            prop_assert!((r.determinant() - 1.0).abs() < 1e-9);
            prop_assert!(fit.target_sd_mm(&Vector3::zeros()).is_finite());
        }
    }
}

/// Without the choice of sign half of these flat, noisy sets would give reflections.
#[test]
fn flat_sets_give_no_reflection() {
    let noise = WhiteNoise::Gaussian(0.2);
    let mut mirrored = 0;
    for set in 0..200u64 {
        let mut pairs = pairs(&Pose::identity(), &square(100.0));
        for (point, pair) in pairs.iter_mut().enumerate() {
            pair.tracker_mm += noise.draw(set, point as u64);
        }
        let fit = RegistrationFit::of(&pairs, 1.0).expect("fits");
        assert!((fit.x_wt.rotation.matrix() - Matrix3::identity()).norm() < 0.02, "{fit:?}");
        let cross = pairs.iter().map(|p| p.bench_mm * p.tracker_mm.transpose());
        let n = pairs.len() as f64;
        let mean = |of: fn(&FiducialPair) -> Vector3<f64>| pairs.iter().map(of).sum::<Vector3<_>>();
        let m = cross.sum::<Matrix3<f64>>()
            - mean(|p| p.bench_mm) * mean(|p| p.tracker_mm).transpose() / n;
        mirrored += usize::from(nearest_rotation(&m).1.is_some());
    }
    assert!((50..150).contains(&mirrored), "{mirrored} of 200 sets would have been mirrored");
}

/// FRE and target error agree with the formulas for the added noise. The points are flat, so the target is
/// uncertain in one direction more than in the others.
#[test]
fn fre_and_target_error_are_as_predicted() {
    let (sd_mm, sets) = (0.3, 2000u32);
    let x_wt = Pose { rotation: so3::exp(&Vector3::new(0.3, -1.2, 0.4)), ..Pose::identity() };
    let points_mm: Vec<_> =
        (0..8u64).map(|point| WhiteNoise::Uniform(60.0).draw(5, point)).collect();
    let points_mm: Vec<_> = points_mm.iter().map(|p| Vector3::new(p.x, 0.3 * p.y, 0.0)).collect();
    let target_mm = Vector3::new(20.0, 10.0, 150.0);
    let (mut fre2, mut covariance, mut predicted2) = (0.0, Matrix3::zeros(), 0.0);
    for set in 0..sets {
        let mut pairs = pairs(&x_wt, &points_mm);
        for (point, pair) in pairs.iter_mut().enumerate() {
            pair.tracker_mm += WhiteNoise::Gaussian(sd_mm).draw(u64::from(set), point as u64);
        }
        let fit = RegistrationFit::of(&pairs, 1.0).expect("fits");
        fre2 += fit.rms_mm.powi(2) / f64::from(sets);
        let error_mm = fit.x_wt.transform(&target_mm) - x_wt.transform(&target_mm);
        covariance += error_mm * error_mm.transpose() / f64::from(sets);
        // 18 degrees of freedom.
        let without_t2 = fit.target_sd_mm(&x_wt.transform(&target_mm)).powi(2) * (16.0 / 18.0);
        predicted2 += without_t2 / f64::from(sets);
    }
    let fle2 = 3.0 * sd_mm * sd_mm;
    assert!((fre2 / (fle2 * (1.0 - 2.0 / 8.0)) - 1.0).abs() < 0.05, "FRE² {fre2}");
    let worst2 = covariance.symmetric_eigenvalues().max();
    assert!((worst2 / predicted2 - 1.0).abs() < 0.1, "{worst2} mm² for {predicted2} mm²");
    assert!(worst2 > 2.0 * covariance.trace() / 3.0, "the error is the same in all directions");
}

/// The tracker's scale is 1% off, and each point is located to 0.3 mm.
#[test]
fn a_wrong_scale_is_reported_and_noise_is_not() {
    let points_mm: Vec<_> =
        (0..12u64).map(|point| WhiteNoise::Uniform(80.0).draw(5, point)).collect();
    let fit = |set: u64, scale: f64| {
        let mut pairs = pairs(&Pose::identity(), &points_mm);
        for (point, pair) in pairs.iter_mut().enumerate() {
            pair.tracker_mm =
                pair.tracker_mm * scale + WhiteNoise::Gaussian(0.3).draw(set, point as u64);
        }
        RegistrationFit::of(&pairs, 3.0).expect("fits")
    };
    let scales: Vec<f64> = (0..100).filter_map(|set| fit(set, 1.01).scale).collect();
    assert!(scales.len() >= 95, "named in {} of 100", scales.len());
    assert!(scales.iter().all(|scale| (scale - 1.01).abs() < 0.004), "{scales:?}");
    assert_eq!((0..1000).filter(|&set| fit(set, 1.0).scale.is_some()).count(), 0);
    let remarks = fit(1, 1.01).remarks(&[], 3.0).join("; ");
    assert!(remarks.starts_with("the tracker has the points 1.0"), "{remarks}");
}

#[test]
fn points_in_a_plane_are_reported() {
    let remarks = |points_mm: &[Vector3<f64>]| {
        let pairs = pairs(&Pose::identity(), points_mm);
        RegistrationFit::of(&pairs, 1.0).expect("fits").remarks(&pairs, 1.0)
    };
    let flat = square(100.0);
    assert!(remarks(&flat)[0].contains("lie in a plane"));
    let solid = [flat, vec![Vector3::new(70.0, 40.0, 20.0)]].concat();
    assert_eq!(remarks(&solid), Vec::<String>::new());
}

/// Points that were read from another corner fit as well, and turn the frame.
#[test]
fn points_that_fit_in_another_order_are_reported() {
    let corner = |lengths_mm: [f64; 3]| {
        let ends = (0..3).map(|k| Vector3::ith(k, lengths_mm[k]));
        [Vector3::zeros()].into_iter().chain(ends).collect::<Vec<_>>()
    };
    let top = square(60.0).into_iter().map(|p| p + Vector3::z() * 60.0);
    let cube: Vec<_> = square(60.0).into_iter().chain(top).collect();
    let remarks = |points_mm: &[Vector3<f64>], rms_max_mm: f64| {
        let mut pairs = pairs(&Pose::identity(), points_mm);
        for (point, pair) in pairs.iter_mut().enumerate() {
            pair.tracker_mm += WhiteNoise::Gaussian(0.1).draw(3, point as u64);
        }
        let fit = RegistrationFit::of(&pairs, 3.0).expect("fits");
        fit.remarks(&pairs, rms_max_mm).pop().filter(|remark| remark.contains(" fit in the order "))
    };
    for (layout, order, turned) in [
        (square(60.0), "1,4,3,2 as well (0.", "turned by 180 deg"),
        (corner([60.0; 3]), "1,3,4,2 as well (0.", "turned by 120 deg"),
        (cube, "1,4,8,5,2,3,7,6 as well (0.", "turned by 120 deg"),
    ] {
        let remark = remarks(&layout, 1.0).expect("a remark");
        assert!(remark.contains(order) && remark.contains(turned), "{remark}");
        assert!(remark.len() + "warning: ".len() <= 200, "{remark}");
    }
    // Nothing can be exchanged, or it does not fit within the limit.
    assert_eq!(remarks(&corner([50.0, 60.0, 70.0]), 1.0), None);
    assert_eq!(remarks(&corner([60.0, 60.0, 62.5]), 1.0), None);
    assert!(remarks(&corner([60.0, 60.0, 62.5]), 3.0).is_some());
    let unlike: Vec<_> = (0..9u64).map(|p| WhiteNoise::Uniform(80.0).draw(5, p)).collect();
    assert_eq!(remarks(&unlike, 1.0), None);
    // All orders of points this close together are too many to try.
    let close: Vec<_> = (0..12u64).map(|p| WhiteNoise::Uniform(1.5).draw(5, p)).collect();
    let count = Orders::new(&pairs(&Pose::identity(), &close)).count();
    assert!(count < ORDER_TRIES_MAX, "{count}");
}

/// The factor is √(ν/(ν − 2)) for ν = 3N − 6.
#[test]
fn the_error_at_a_target_allows_for_few_points() {
    for (points, factor) in [(3, 3f64.sqrt()), (4, 1.5f64.sqrt()), (12, (30f64 / 28.0).sqrt())] {
        let layout: Vec<_> = (0..points).map(|p| WhiteNoise::Uniform(60.0).draw(5, p)).collect();
        let mut pairs = pairs(&Pose::identity(), &layout);
        for (point, pair) in (0..).zip(&mut pairs) {
            pair.tracker_mm += WhiteNoise::Gaussian(0.1).draw(1, point);
        }
        let fit = RegistrationFit::of(&pairs, 1.0).expect("fits");
        // At the centroid it is that of the mean.
        let of_mean_mm = fit.localisation_error_mm() / (3.0 * points as f64).sqrt();
        let ratio = fit.target_sd_mm(&fit.centre_bench) / of_mean_mm;
        assert!((ratio - factor).abs() < 1e-9, "{points} points: {ratio}");
    }
}

#[test]
fn the_error_at_a_target_grows_with_its_distance() {
    let noisy = pairs(&Pose::identity(), &square(100.0));
    let noisy: Vec<_> = (0..)
        .zip(&noisy)
        .map(|(point, pair)| FiducialPair {
            tracker_mm: pair.tracker_mm + WhiteNoise::Gaussian(0.2).draw(1, point),
            ..*pair
        })
        .collect();
    let fit = RegistrationFit::of(&noisy, 1.0).expect("fits");
    let sd_mm = |z_mm: f64| fit.target_sd_mm(&Vector3::new(50.0, 50.0, z_mm));
    // Four points have six degrees of freedom.
    let least_mm = fit.localisation_error_mm() / (3.0 * 4.0f64).sqrt() * 1.5f64.sqrt();
    // At the centroid it is that of the mean. Above it a tilt adds: the points are 50 mm RMS from either axis.
    for z_mm in [0.0, 100.0, 250.0] {
        let expected_mm = least_mm * (z_mm / 50.0f64).hypot(1.0);
        assert!((sd_mm(z_mm) - expected_mm).abs() < 1e-9, "{} at {z_mm} mm", sd_mm(z_mm));
    }
}

#[test]
fn points_that_determine_no_pose_are_refused() {
    let good = pairs(&Pose::identity(), &square(100.0));
    assert_eq!(
        refusal(&good[..2]),
        "registration: too few points, 2 of at least 3; touch more fiducials"
    );
    let line: Vec<_> = (0..6).map(|n| Vector3::new(20.0 * f64::from(n), 5.0, 1.0)).collect();
    assert_eq!(
        refusal(&pairs(&Pose::identity(), &line)),
        "registration: 6 points lie 0.00 mm RMS off a line (at least 1.00 needed for their \
         length and error): the turn about it is unknown; add points to its sides"
    );
    let mut twice = good.clone();
    twice[3].tracker_mm = twice[1].tracker_mm;
    assert_eq!(
        refusal(&twice),
        "registration: points 2 and 4 have the same tracker position; remove the copy, or give the \
         mean of repeated measurements as one pair"
    );
    for (x_mm, text) in
        [(f64::NAN, "NaN"), (f64::INFINITY, "inf"), (5000.1, "5000.1"), (1e100, "1e100")]
    {
        let mut far = good.clone();
        far[2].bench_mm = Vector3::new(x_mm, 0.0, 0.0);
        assert_eq!(
            refusal(&far),
            format!(
                "registration: point 3 is {text} mm from the bench's origin (limit 5000); give \
                 positions in mm"
            )
        );
    }
}

/// The message names the unit, and does not ask for more points.
#[test]
fn positions_in_metres_are_recognised() {
    let good = pairs(&Pose::identity(), &square(100.0));
    let scaled = |tracker: f64, bench: f64| {
        let pair = |p: &FiducialPair| FiducialPair {
            tracker_mm: p.tracker_mm * tracker,
            bench_mm: p.bench_mm * bench,
        };
        refusal(&good.iter().map(pair).collect::<Vec<_>>())
    };
    for (tracker, bench, said) in [
        (
            1e-3,
            1.0,
            "the tracker's points are 0.0010 times as far apart as the bench's; the positions look like \
             metres; OpenIGTLink is in mm",
        ),
        (
            1.0,
            1e-3,
            "the tracker's points are 1000.0000 times as far apart as the bench's; the bench's points look \
             like metres; give both in mm",
        ),
        (
            0.1,
            1.0,
            "the tracker's points are 0.1000 times as far apart as the bench's; give both in mm",
        ),
        (
            1e-3,
            1e-3,
            "the points are 0.050 mm RMS apart (at least 1 needed): the positions look like metres; \
             OpenIGTLink is in mm",
        ),
    ] {
        assert_eq!(scaled(tracker, bench), format!("registration: {said}"));
    }
}

/// The points are on a line, and their errors are as large as their distances from it.
#[test]
fn noise_across_a_line_does_not_count_as_breadth() {
    let line: Vec<_> = (0..8).map(|n| Vector3::new(5.0 * f64::from(n), 0.0, 0.0)).collect();
    let mut pairs = pairs(&Pose::identity(), &line);
    for (point, pair) in pairs.iter_mut().enumerate() {
        let beside_mm = 0.9 * WhiteNoise::Gaussian(1.0).draw(3, point as u64);
        pair.tracker_mm += Vector3::new(0.0, beside_mm.y, beside_mm.z);
        pair.bench_mm += 1.5 * WhiteNoise::Uniform(1.0).draw(4, point as u64);
    }
    let error = RegistrationFit::of(&pairs, 3.0).expect_err("the turn is unknown");
    assert!(error.contains(" RMS off a line "), "{error}");
}

#[test]
fn the_worst_point_is_named() {
    let mut points_mm = square(100.0);
    points_mm.extend(square(100.0).iter().map(|p| p + Vector3::z() * 100.0));
    let mut pairs = pairs(&Pose::identity(), &points_mm);
    pairs[2].bench_mm.z += 8.0;
    assert_eq!(
        refusal(&pairs),
        "registration: 8 points, 2.45 mm RMS (limit 1.00); worst is point 3, 6.0 mm; measure that \
         one again, and check that both frames have the points in the same order"
    );
    let fit = RegistrationFit::of(&pairs, 3.0).expect("under that limit");
    assert_eq!((fit.points, fit.worst_point), (8, 3));
}

/// The sets are mirror images, as they are in a left-handed frame of the tracker.
#[test]
fn a_mirrored_axis_or_two_exchanged_ones_are_recognised() {
    let mut points_mm = square(100.0);
    points_mm.push(Vector3::new(50.0, 40.0, 80.0));
    let noise = WhiteNoise::Gaussian(0.1);
    let x_wt = Pose { rotation: so3::exp(&Vector3::new(0.3, -1.2, 0.4)), ..Pose::identity() };
    let changed = |change: fn(&mut Vector3<f64>)| {
        let mut pairs = pairs(&x_wt, &points_mm);
        for (point, pair) in pairs.iter_mut().enumerate() {
            change(&mut pair.tracker_mm);
            pair.tracker_mm += noise.draw(1, point as u64);
        }
        pairs
    };
    for change in [
        |p: &mut Vector3<f64>| p.z = -p.z,
        |p: &mut Vector3<f64>| p.swap_rows(0, 1),
        |p: &mut Vector3<f64>| *p = -*p,
    ] {
        let text = refusal(&changed(change));
        let fits = text.split("; a mirrored frame, or two exchanged axes, fits to ").nth(1);
        let mm = fits.and_then(|fits| fits.strip_suffix(" mm: check the tracker's axes"));
        assert!(mm.and_then(|mm| mm.parse().ok()).is_some_and(|mm: f64| mm < 0.3), "{text}");
    }
    // One bad point besides: a reflection fits better, but not well.
    let mut bad = changed(|p| p.z = -p.z);
    bad[0].bench_mm.z += 8.0;
    let text = refusal(&bad);
    assert!(text.ends_with(SCATTERED), "{text}");
}

#[test]
fn a_file_of_pairs_is_read_by_its_header() {
    let csv = "x_bench_mm,y_bench_mm,z_bench_mm,x_tracker_mm,y_tracker_mm,z_tracker_mm\n\
               1,2,3,4,5,6\n";
    let pair = FiducialPair {
        tracker_mm: Vector3::new(4.0, 5.0, 6.0),
        bench_mm: Vector3::new(1.0, 2.0, 3.0),
    };
    assert_eq!(FiducialPair::parse(csv), Ok(vec![pair]));
    let error = FiducialPair::parse("x_bench_mm\n1\n").expect_err("too few columns");
    assert!(error.contains("no column "), "{error}");
}
