//! What earlier work is worth now: calibrations, the last proof, the last run.

use super::{Check, Verdict};
use crate::archive::unix_us_of;
use crate::calibration::Provenance;
use crate::config::{Config, RegistrationConfig};

const DAY_US: f64 = 86_400e6;
/// Two clocks may differ by an hour; what is dated further ahead has no date.
const AHEAD_MAX_DAYS: f64 = 1.0 / 24.0;

/// A run before this one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Earlier {
    /// When it began, RFC 3339.
    pub started_utc: String,
    /// What it has proved.
    pub proof: Option<String>,
    /// The keys in which its configuration differs from this one.
    pub changed: Vec<String>,
}

/// Days from `date_utc` to `now_unix_us`; `None` where it is no date.
fn age_days(date_utc: &str, now_unix_us: i64) -> Option<f64> {
    Some((now_unix_us - unix_us_of(date_utc)?) as f64 / DAY_US)
}

/// True if the date is one, not ahead of the clock, and no older than `days_max`.
fn is_young(days: Option<f64>, days_max: f64) -> bool {
    days.is_some_and(|days| (-AHEAD_MAX_DAYS..=days_max).contains(&days))
}

fn ago(days: Option<f64>) -> String {
    match days {
        Some(days) if days < -AHEAD_MAX_DAYS => format!("dated {:.0} days ahead", -days),
        Some(days) if days < 2.0 => format!("{:.0} h ago", days * 24.0),
        Some(days) => format!("{days:.0} days ago"),
        None => "no date".to_owned(),
    }
}

/// The registration, the tip and the needle: how good and how old. On hardware one that was typed in is
/// no PASS: nothing shows when and how it was measured.
pub fn calibrations(config: &Config, now_unix_us: i64) -> Vec<Check> {
    let days_max = config.calibration.max_age_days;
    let days_limit = format!("up to {days_max:.0} days");
    let aged = |check: Check, fit: Option<&Provenance>, next: &str| {
        let days = fit.map(|fit| age_days(&fit.date_utc, now_unix_us));
        let age = days.map_or_else(|| "typed in, no date".to_owned(), ago);
        let found = [check.found.as_str(), &age].into_iter().filter(|part| !part.is_empty());
        let found = found.collect::<Vec<_>>().join(", ");
        Check { found, ..check }
            .unless(
                fit.is_some() || !config.stage.hardware,
                Verdict::Warn,
                format!("nothing shows when and how it was measured: {next}"),
            )
            .unless(
                days.is_none_or(|days| is_young(days, days_max)),
                Verdict::Warn,
                format!("measure it again: {next}"),
            )
    };
    let tracker = &config.tracker;
    let tip = tracker.tip_fit.as_ref();
    // The default, which stands for a sensor in the tip itself.
    let is_placeholder = tip.is_none() && tracker.tip_offset_mm == [0.0; 3];
    let tip_found = match tip {
        Some(fit) => format!("{:.2} mm RMS", fit.rms_mm),
        None if is_placeholder => "0 mm from the sensor".to_owned(),
        None => String::new(),
    };
    let calibrate_tip = "needle-bench calibrate tip";
    let needle = config.needle.fit.as_ref();
    let needle_found = needle.map(|fit| format!("{} insertions", fit.insertions));
    let needle_found = needle_found.unwrap_or_default();
    vec![
        registration(config, aged),
        aged(
            Check::new("tip", tip_found, &days_limit),
            tip.map(|fit| &fit.provenance),
            calibrate_tip,
        )
        .unless(
            !is_placeholder || !config.stage.hardware,
            Verdict::Warn,
            format!("is the sensor in the tip itself? Else: {calibrate_tip}"),
        ),
        aged(
            Check::new("needle", needle_found, &days_limit),
            needle.map(|fit| &fit.provenance),
            "needle-bench calibrate needle",
        ),
    ]
}

/// The registration: its residual, and its age by `aged`.
fn registration(
    config: &Config,
    aged: impl Fn(Check, Option<&Provenance>, &str) -> Check,
) -> Check {
    let register = "needle-bench calibrate registration";
    let collect = format!("{register} --collect");
    let rms_max_mm = RegistrationConfig::rms_max_mm();
    let days_max = config.calibration.max_age_days;
    let limit = format!("up to {rms_max_mm} mm RMS and {days_max:.0} days");
    let check = |found: String| Check::new("registration", found, &limit);
    match &config.tracker.registration {
        None => check("missing".to_owned()).unless(
            false,
            Verdict::Fail,
            format!("{register}, then name its file in tracker.registration_file"),
        ),
        Some(RegistrationConfig::Given(given)) => {
            let rms_mm = given.fit.as_ref().map(|fit| fit.rms_mm);
            let found = rms_mm.map(|rms_mm| format!("{rms_mm:.2} mm RMS")).unwrap_or_default();
            let fit = given.fit.as_ref().map(|fit| &fit.provenance);
            aged(check(found), fit, &collect).unless(
                rms_mm.is_none_or(|rms_mm| rms_mm <= rms_max_mm),
                Verdict::Fail,
                format!("over {rms_max_mm} mm RMS: {register}"),
            )
        }
        Some(RegistrationConfig::Fiducials(fiducials)) => match fiducials.fit() {
            Ok(fit) => {
                let points = fiducials.fiducials.len();
                let found = format!("{points} points, {:.2} mm RMS", fit.rms_mm);
                aged(check(found), None, &collect)
            }
            Err(error) => check(error.to_string()).unless(false, Verdict::Fail, collect),
        },
    }
}

/// The last completed `stage prove` on this bus, and the keys of stage and bus that changed since.
pub fn proof(config: &Config, last: Option<&Earlier>, now_unix_us: i64) -> Check {
    let next = "needle-bench stage prove, without a needle";
    let days_max = config.calibration.max_age_days;
    let limit = format!("this configuration, up to {days_max:.0} days");
    let Some(Earlier { started_utc, changed, proof }) = last else {
        return Check::new("stage prove", "never", limit).unless(false, Verdict::Warn, next);
    };
    let days = age_days(started_utc, now_unix_us);
    let proof = proof.as_ref().map(|proof| format!("{proof}, ")).unwrap_or_default();
    let found = format!("{proof}{}{}", ago(days), listed(changed, ", changed since: "));
    let is_valid = changed.is_empty() && is_young(days, days_max);
    Check::new("stage prove", found, limit).unless(is_valid, Verdict::Warn, next)
}

/// What changed since the last run on this bus.
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
    check(found).unless(changed.is_empty(), Verdict::Warn, next)
}

/// The first of `keys` after `lead`; nothing where there are none.
fn listed(keys: &[String], lead: &str) -> String {
    const SHOWN_MAX: usize = 4;
    let shown: Vec<&str> = keys.iter().take(SHOWN_MAX).map(String::as_str).collect();
    match keys.len().saturating_sub(SHOWN_MAX) {
        _ if keys.is_empty() => String::new(),
        0 => format!("{lead}{}", shown.join(", ")),
        more => format!("{lead}{} and {more} more", shown.join(", ")),
    }
}
