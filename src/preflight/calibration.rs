//! Judges earlier work: calibrations, the last proof, the last run.

use super::Check;
use super::Verdict::{Fail, Warn};
use crate::archive::unix_us_of;
use crate::calibration::{FiducialPair, Provenance, RegistrationFit, RegistrationRecord};
use crate::config::{Config, RegistrationConfig, TrackerSection};
use crate::observer::ROLL_JUDGED_SD_MAX_RAD;
use nalgebra::Vector3;

const DAY_US: f64 = 86_400e6;
/// A date may be ahead of this machine's clock by an hour; a later one is wrong.
const AHEAD_MAX_DAYS: f64 = 1.0 / 24.0;

/// Largest difference between the configured pose and that of its fiducials, mm and rad: the rounding of its numbers.
const SAME_POSE: f64 = 1e-6;

/// The largest standard error of a calibrated curvature, relative to the curvature.
const CURVATURE_PART_MAX: f64 = 0.2;

/// Largest difference between the present tip offset and the one with which the fiducials were touched, mm.
const TIP_MOVED_MAX_MM: f64 = 0.05;

/// The largest error of the registration at the tip, mm, one standard deviation.
const SD_MAX_MM: f64 = 1.0;

/// A run before this one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Earlier {
    /// When it began, RFC 3339.
    pub started_utc: String,
    /// What it proved about the drives, if it was a `stage prove`.
    pub proof: Option<String>,
    /// The keys in which its configuration differs from the present one.
    pub changed: Vec<String>,
}

/// Days from `date_utc` to `now_unix_us`; `None` if `date_utc` is not a date.
fn age_days(date_utc: &str, now_unix_us: i64) -> Option<f64> {
    Some((now_unix_us - unix_us_of(date_utc)?) as f64 / DAY_US)
}

/// True for a known age that is not ahead of the clock and at most `days_max`.
fn is_recent(days: Option<f64>, days_max: f64) -> bool {
    days.is_some_and(|days| (-AHEAD_MAX_DAYS..=days_max).contains(&days))
}

fn ago(days: Option<f64>) -> String {
    match days {
        Some(days) if days < -AHEAD_MAX_DAYS => format!("dated {:.0} days ahead", -days),
        Some(days) if days < 2.0 => format!("{:.0} h ago", days.max(0.0) * 24.0),
        Some(days) => format!("{days:.0} days ago"),
        None => "no date".to_owned(),
    }
}

/// Checks the quality and age of the registration, the tip and the needle. On hardware a value that was typed in
/// does not pass: nothing shows when and how it was measured.
pub fn calibrations(config: &Config, now_unix_us: i64) -> Vec<Check> {
    let (tracker, is_emulated) = (&config.tracker, !config.stage.hardware);
    let days_max = config.calibration.max_age_days;
    let dated =
        |name: &str, found: String, limit: &str, fit: Option<&Provenance>, next: &str| {
            let days = fit.map(|fit| age_days(&fit.date_utc, now_unix_us));
            let age = days.map_or_else(|| "typed in, no date".to_owned(), ago);
            let found = if found.is_empty() { age } else { format!("{found}, {age}") };
            let is_in_date = days.is_none_or(|days| is_recent(days, days_max));
            let undated = format!("nothing shows when and how it was measured: {next}");
            Check::new(name, found, limit)
                .unless(fit.is_some() || is_emulated, Warn, undated)
                .unless(is_in_date, Warn, format!("measure it again: {next}"))
        };
    let register = "needle-bench calibrate registration";
    let collect = format!("{register} --collect");
    let rms_max_mm = RegistrationConfig::rms_max_mm();
    let limit = format!("up to {rms_max_mm} mm RMS and {days_max:.0} days");
    let close = |check: Check, rms_mm: f64| {
        check.unless(rms_mm <= rms_max_mm, Fail, format!("over {rms_max_mm} mm RMS: {register}"))
    };
    let sd_mm = config.registration_sd_mm().unwrap_or_default();
    let vague = format!(
        "the tip would be off by over {SD_MAX_MM} mm: touch more points, around the needle's path"
    );
    let fits = |rms_mm: f64| format!("{rms_mm:.2} mm RMS, {sd_mm:.2} mm at the tip");
    let judged = |check: Check, fit: &RegistrationFit, pairs: &[FiducialPair], rms_max_mm: f64| {
        let remarks = fit.remarks(pairs, rms_max_mm);
        check.unless(remarks.is_empty(), Warn, remarks.join("\n"))
    };
    let registration = match &tracker.registration {
        None => {
            let next = format!("{register}, then name its file in tracker.registration_file");
            Check::new("registration", "missing", limit).with(Fail, next)
        }
        Some(RegistrationConfig::Given(given)) => {
            let of_fiducials = given.of_fiducials();
            let off = of_fiducials.map(|fit| (fit.x_wt.inverse() * given.x_wt).log().to_vector());
            // A pose that was changed by hand has no known origin.
            let fit = given.fit.as_ref().filter(|_| off.is_none_or(|off| off.amax() < SAME_POSE));
            let found = fit.map(|fit| fits(fit.rms_mm)).unwrap_or_default();
            let provenance = fit.map(|fit| &fit.provenance);
            let rms_mm = fit.map_or(0.0, |fit| fit.rms_mm);
            let old = "its file has no fiducials to compute its error from: sd_mm is of the depth and plane of that time";
            let check = close(dated("registration", found, &limit, provenance, &collect), rms_mm)
                .unless(
                    fit.is_none() || of_fiducials.is_some(),
                    Warn,
                    format!("{old}: {register}"),
                );
            let check = match (fit, &of_fiducials) {
                (Some(RegistrationRecord { fiducials, .. }), Some(of_fiducials)) => {
                    judged(check, of_fiducials, fiducials, rms_max_mm)
                }
                _ => check,
            };
            match fit {
                Some(fit) => collected_with_tip(check, fit, tracker),
                None => check,
            }
        }
        Some(RegistrationConfig::Fiducials(fiducials)) => match fiducials.fit() {
            Ok(fit) => {
                let found = format!("{} points, {}", fit.points, fits(fit.rms_mm));
                let check = dated("registration", found, &limit, None, &collect);
                let check = close(check, fit.rms_mm);
                judged(check, &fit, &fiducials.fiducials, fiducials.rms_max_mm)
            }
            Err(error) => {
                let check = Check::new("registration", error.to_string(), limit);
                check.with(Fail, collect)
            }
        },
    };
    let registration = registration.unless(sd_mm <= SD_MAX_MM, Warn, vague);
    let days_limit = format!("up to {days_max:.0} days");
    let fit = tracker.tip_fit.as_ref();
    let is_placeholder = !tracker.has_tip();
    let found = match fit {
        Some(fit) => format!("{:.2} mm RMS", fit.rms_mm),
        None if is_placeholder => "0 mm from the sensor".to_owned(),
        None => String::new(),
    };
    let next = "needle-bench calibrate tip";
    let tip = dated("tip", found, &days_limit, fit.map(|fit| &fit.provenance), next);
    let next = format!("is the sensor in the tip itself? Else: {next}");
    let tip = tip.unless(!is_placeholder || is_emulated, Warn, next);

    let fit = config.needle.fit.as_ref();
    let found = fit.map(|fit| format!("{} insertions", fit.insertions)).unwrap_or_default();
    let next = "needle-bench calibrate needle";
    let needle = dated("needle", found, &days_limit, fit.map(|fit| &fit.provenance), next);
    let part = fit.map(|fit| fit.curvature_sd_per_mm / config.needle.arc.curvature_per_mm());
    let vague =
        "its curvature is known to no better than a fifth: calibrate it from more insertions";
    let needle = needle.unless(part.is_none_or(|part| part <= CURVATURE_PART_MAX), Warn, vague);
    vec![registration, tip, needle]
}

/// The `check` of a registration, with a worse verdict if its fiducials were touched with another tip offset than the
/// present one, since the difference went into the pose.
fn collected_with_tip(check: Check, fit: &RegistrationRecord, tracker: &TrackerSection) -> Check {
    let now_mm = tracker.tip_offset_mm;
    // A separate probe has a tip of its own.
    if fit.tool.as_ref().is_some_and(|tool| *tool != tracker.tool) {
        return check;
    }
    let Some(then_mm) = fit.tip_offset_mm else {
        let next = "its file does not say with which tip_offset_mm its points were touched; if with this needle, \
                    collect them anew: calibrate registration --collect";
        return check.unless(now_mm == [0.0; 3], Warn, next);
    };
    let moved_mm = (Vector3::from(now_mm) - Vector3::from(then_mm)).norm();
    // After a change of needle the offset differs, although the registration is right.
    let (verdict, why) = match then_mm == [0.0; 3] {
        true => (Fail, "the tip's offset would count twice; collect the fiducials again"),
        false => (Warn, "if the needle is the same, collect the fiducials again"),
    };
    let next = format!("collected with tip_offset_mm {then_mm:.2?}, now {now_mm:.2?}: {why}");
    check.unless(moved_mm <= TIP_MOVED_MAX_MM, verdict, next)
}

/// Checks that the roll at the start is known. Only by comparison with it can a run detect a registration that is
/// turned about the needle. `None` for an emulated rig.
pub fn start_roll(config: &Config) -> Option<Check> {
    let sd_deg = config.observer.invariant.start_sd.roll.to_degrees();
    let limit = format!("up to {:.0} deg", ROLL_JUDGED_SD_MAX_RAD.to_degrees());
    let next = "a registration turned about the needle would go unnoticed: compare tracker watch with a tool \
                moved along each axis, or set observer.start.roll_deg and observer.invariant.start_sd";
    let check = Check::new("start roll", format!("known to {sd_deg:.0} deg"), limit);
    let is_known = sd_deg <= ROLL_JUDGED_SD_MAX_RAD.to_degrees();
    config.stage.hardware.then(|| check.unless(is_known, Warn, next))
}

/// Judges the `last` completed `stage prove` on this bus, or `stage prove --handedness`: its age, and the keys that
/// affect it and have changed since.
pub fn proof(
    config: &Config,
    is_of_handedness: bool,
    last: Option<&Earlier>,
    now_unix_us: i64,
) -> Check {
    let (name, next) = match is_of_handedness {
        false => ("stage prove", "needle-bench stage prove CONFIG, without a needle"),
        true => (
            "handedness",
            "a base or a tracker of the wrong sign steers away from the plane: needle-bench stage prove CONFIG \
             --handedness, without a needle",
        ),
    };
    let days_max = config.calibration.max_age_days;
    let limit = format!("this configuration, up to {days_max:.0} days");
    let Some(Earlier { started_utc, changed, proof }) = last else {
        return Check::new(name, "never", limit).with(Warn, next);
    };
    let days = age_days(started_utc, now_unix_us);
    let proof = proof.as_ref().map(|proof| format!("{proof}, ")).unwrap_or_default();
    let found = format!("{proof}{}{}", ago(days), listed(changed, ", changed since: "));
    let is_valid = changed.is_empty() && is_recent(days, days_max);
    Check::new(name, found, limit).unless(is_valid, Warn, next)
}

/// Judges what changed since the `last` run on this bus.
pub fn changes(last: Option<&Earlier>, now_unix_us: i64) -> Check {
    const UNCHANGED: &str = "0 keys changed";
    let check = |found: String| Check::new("configuration", found, UNCHANGED);
    let Some(Earlier { started_utc, changed, .. }) = last else {
        return check("no run before on this bus".to_owned());
    };
    let since = ago(age_days(started_utc, now_unix_us));
    let found = match changed.is_empty() {
        true => format!("as in the last run, {since}"),
        false => {
            let keys = if changed.len() == 1 { "key" } else { "keys" };
            format!("{} {keys}{}", changed.len(), listed(changed, " changed: "))
        }
    };
    let next = format!("compare: the last run was {since}");
    check(found).unless(changed.is_empty(), Warn, next)
}

/// The first of `keys` after `lead`; empty if there are none.
fn listed(keys: &[String], lead: &str) -> String {
    const SHOWN_MAX: usize = 4;
    let shown: Vec<&str> = keys.iter().take(SHOWN_MAX).map(String::as_str).collect();
    match keys.len().saturating_sub(SHOWN_MAX) {
        _ if keys.is_empty() => String::new(),
        0 => format!("{lead}{}", shown.join(", ")),
        more => format!("{lead}{} and {more} more", shown.join(", ")),
    }
}
