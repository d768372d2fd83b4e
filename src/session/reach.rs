//! Whether an insertion can reach the plane, judged before the axes have power.

use super::config::SessionConfig;
use crate::needle::{Reduced, approach_max_mm, shortest_into_plane_mm};
use nalgebra::Vector3;

/// Number of standard deviations of position and heading that may count in the favour of a start.
const SD_FACTOR: f64 = 3.0;
/// A shorter insertion is a trial, mm. It is judged as if it were this deep.
const TRIAL_MM: f64 = 60.0;
/// Numbers of intervals into which the ranges of position and heading are divided to try their values.
const POSITION_INTERVALS: u32 = 8;
const HEADING_INTERVALS: u32 = 48;

/// Refuses a start from which the shortest way into the plane is longer than the depth (60 mm for a shorter
/// insertion), even from the most favourable position and heading within three standard deviations. On the way
/// to a target in the plane, the tip need only come within the target's tolerance of the plane. A target in
/// space does not need the plane.
///
/// # Errors
/// The reason, with its numbers.
pub(super) fn check_reach(config: &SessionConfig, tip_mm: &Vector3<f64>) -> Result<(), String> {
    if config.goal.as_ref().is_some_and(|goal| !goal.problem.in_plane) {
        return Ok(());
    }
    let tracker = &config.tracker;
    let variance_mm2 =
        tracker.track.noise_sd_mm.powi(2) + config.handedness.registration_sd_mm.powi(2);
    let margin_mm = SD_FACTOR * variance_mm2.sqrt();
    let (pitch_rad, pitch_sd_rad) =
        (config.handedness.start.pitch, config.handedness.start_sd.pitch);
    if let Some(goal) = &config.goal {
        let (off_mm, length_mm) = (tip_mm.x.abs(), goal.path.length_mm());
        let toward_rad = SD_FACTOR * pitch_sd_rad - tip_mm.x.signum() * pitch_rad;
        let correctable_mm = approach_max_mm(&config.needle, toward_rad, length_mm);
        let remaining_mm = off_mm - margin_mm - correctable_mm;
        let tolerance_mm = goal.problem.tolerance_mm;
        return match remaining_mm <= tolerance_mm {
            true => Ok(()),
            false => Err(format!(
                "the target is out of reach: the tip is {off_mm:.1} mm off the plane, and the path to the \
                 target, {length_mm:.1} mm, corrects {correctable_mm:.1} at most (plus {margin_mm:.1} for noise); \
                 goal.tolerance_mm is {tolerance_mm}"
            )),
        };
    }
    let states = spread(tip_mm.x, margin_mm, POSITION_INTERVALS).flat_map(|x_mm| {
        let headings = spread(pitch_rad, SD_FACTOR * pitch_sd_rad, HEADING_INTERVALS);
        headings.map(move |pitch_rad| Reduced { x_mm, pitch_rad, roll_rad: 0.0 })
    });
    let needed_mm = states
        .filter_map(|state| shortest_into_plane_mm(&config.needle, &state))
        .fold(f64::INFINITY, f64::min);
    let depth_mm = config.insertion.depth_mm;
    if needed_mm <= depth_mm.max(TRIAL_MM) {
        return Ok(());
    }
    let needs = match needed_mm.is_finite() {
        true => format!("takes {needed_mm:.0} mm at least"),
        false => "does not exist".to_owned(),
    };
    Err(format!(
        "the plane is out of reach: the tip is {:.1} mm off it, heading {:.0} ± {:.0} deg; the way into \
         it {needs}, insertion.depth_mm is {depth_mm:.0}",
        tip_mm.x,
        pitch_rad.to_degrees(),
        SD_FACTOR * pitch_sd_rad.to_degrees(),
    ))
}

/// `parts + 1` values from `middle - reach` to `middle + reach`, and the value in that range nearest to zero.
fn spread(middle: f64, reach: f64, parts: u32) -> impl Iterator<Item = f64> {
    let nearest = middle - middle.clamp(-reach, reach);
    let part = move |part| middle + reach * (2.0 * f64::from(part) / f64::from(parts) - 1.0);
    (0..=parts).map(part).chain([nearest])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn reach(sets: &[&str], x_mm: f64) -> Result<(), String> {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        let config = Config::from_sources(&[], &sets).unwrap().session().unwrap();
        check_reach(&config, &Vector3::new(x_mm, 3.0, -2.0))
    }

    #[test]
    fn an_offset_that_the_depth_can_correct_is_accepted() {
        assert_eq!(reach(&[], 8.0), Ok(()));
        assert_eq!(reach(&["insertion.depth_mm=1"], 1.0), Ok(()), "within the noise");
        assert_eq!(reach(&["insertion.depth_mm=30"], -5.0), Ok(()));
    }

    #[test]
    fn a_plane_out_of_reach_is_refused_with_its_numbers() {
        assert_eq!(
            reach(&[], 500.0).unwrap_err(),
            "the plane is out of reach: the tip is 500.0 mm off it, heading 0 ± 24 deg; the way into it \
             takes 597 mm at least, insertion.depth_mm is 250"
        );
        assert_eq!(reach(&["insertion.depth_mm=600", "stage.insertion.max_mm=600"], 500.0), Ok(()));
        assert_eq!(
            reach(&["insertion.depth_mm=150"], -100.0).unwrap_err(),
            "the plane is out of reach: the tip is -100.0 mm off it, heading 0 ± 24 deg; the way into \
             it takes 189 mm at least, insertion.depth_mm is 150"
        );
        assert!(
            reach(&["insertion.depth_mm=10"], 5.0).is_ok(),
            "a short insertion is judged as a deeper one"
        );
        let error = reach(&["insertion.depth_mm=10"], 30.0).unwrap_err();
        assert!(
            error.starts_with("the plane is out of reach: the tip is 30.0 mm off it"),
            "{error}"
        );
    }

    #[test]
    fn a_target_too_near_to_correct_the_offset_is_refused() {
        let at = |z_mm: f64, x_mm: f64, more: &[&str]| {
            let target = format!("goal.position_mm=[0.0, 0.0, {z_mm:?}]");
            reach(&[&["goal.kind=\"target\"", &target], more].concat(), x_mm)
        };
        assert_eq!(at(3.0, 3.0, &[]), Ok(()), "within the noise");
        assert_eq!(at(30.0, 10.0, &[]), Ok(()));
        let missed = "the target is out of reach: the tip is 5.0 mm off the plane, and the path to the \
                      target, 3.0 mm, corrects 1.3 at most (plus 1.8 for noise); goal.tolerance_mm is 1";
        assert_eq!(at(3.0, 5.0, &[]).unwrap_err(), missed);
        assert_eq!(at(3.0, -5.0, &[]).unwrap_err(), missed);
        // A known heading leaves less reach, or leads to the target.
        let known = "observer.invariant.start_sd.pitch_deg=1";
        let is_missed = |result: Result<(), String>| {
            result.is_err_and(|error| error.starts_with("the target is out of reach: the tip is "))
        };
        assert!(is_missed(at(30.0, 10.0, &[known])));
        assert_eq!(at(30.0, 10.0, &[known, "observer.start.pitch_deg=-20"]), Ok(()));
        assert_eq!(at(30.0, -10.0, &[known, "observer.start.pitch_deg=20"]), Ok(()));
        assert!(is_missed(at(30.0, -10.0, &[known, "observer.start.pitch_deg=-20"])));
    }

    /// The heading is known to 1 deg.
    #[test]
    fn a_heading_away_from_the_plane_is_refused_and_toward_it_accepted() {
        let known = "observer.invariant.start_sd.pitch_deg=1";
        let away = ["insertion.depth_mm=60", "observer.start.pitch_deg=20", known];
        let error = reach(&away, 5.0).unwrap_err();
        assert!(
            error.starts_with("the plane is out of reach: the tip is 5.0 mm off it"),
            "{error}"
        );
        let toward = ["insertion.depth_mm=60", "observer.start.pitch_deg=-20", known];
        assert_eq!(reach(&toward, 5.0), Ok(()));
    }
}
