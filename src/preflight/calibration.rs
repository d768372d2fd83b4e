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

/// The registration, the tip and the needle: how good and how old.
pub fn calibrations(config: &Config, now_unix_us: i64) -> Vec<Check> {
    let days_max = config.calibration.max_age_days;
    let aged = |name: &str, found: String, fit: Option<&Provenance>, next: &str| {
        let days = fit.map(|fit| age_days(&fit.date_utc, now_unix_us));
        let age = match days {
            Some(days) => ago(days),
            None => "typed in, no date".to_owned(),
        };
        let is_young = days.is_none_or(|days| is_young(days, days_max));
        Check::pass(name, format!("{found}{age}"))
            .within(format!("up to {days_max:.0} days"))
            .unless(is_young, Verdict::Warn, format!("measure it again: {next}"))
    };
    let register = "needle-bench calibrate registration";
    let collect = format!("nothing shows when and how it was measured: {register} --collect");
    let tracker = &config.tracker;
    let registration = match &tracker.registration {
        None => Check::pass("registration", "missing").unless(
            false,
            Verdict::Fail,
            format!("{register}, then name its file in tracker.registration_file"),
        ),
        Some(RegistrationConfig::Given(given)) => {
            let rms = given.fit.as_ref().map(|fit| format!("{:.2} mm RMS, ", fit.rms_mm));
            let fit = given.fit.as_ref().map(|fit| &fit.provenance);
            let check = aged("registration", rms.unwrap_or_default(), fit, register);
            let rms_max_mm = RegistrationConfig::rms_max_mm();
            let is_good = given.fit.as_ref().is_none_or(|fit| fit.rms_mm <= rms_max_mm);
            check.unless(fit.is_some(), Verdict::Warn, &collect).unless(
                is_good,
                Verdict::Fail,
                format!("over {rms_max_mm} mm RMS: {register}"),
            )
        }
        Some(RegistrationConfig::Fiducials(fiducials)) => {
            let points = fiducials.fiducials.len();
            let found = format!("{points} points, typed in, no date");
            Check::pass("registration", found).unless(false, Verdict::Warn, &collect)
        }
    };
    let tip = tracker.tip_fit.as_ref();
    let tip_rms = tip.map(|fit| format!("{:.2} mm RMS, ", fit.rms_mm)).unwrap_or_default();
    // The default, which stands for a sensor in the tip itself.
    let is_placeholder = tip.is_none() && tracker.tip_offset_mm == [0.0; 3];
    let tip_found = match is_placeholder {
        true => "0 mm from the sensor, ".to_owned(),
        false => tip_rms,
    };
    let needle = config.needle.fit.as_ref();
    let bend = needle.map(|fit| format!("{} insertions, ", fit.insertions)).unwrap_or_default();
    vec![
        registration,
        aged("tip", tip_found, tip.map(|fit| &fit.provenance), "needle-bench calibrate tip")
            .unless(
                !is_placeholder || !config.stage.hardware,
                Verdict::Warn,
                "is the sensor in the tip itself? Else: needle-bench calibrate tip",
            ),
        aged("needle", bend, needle.map(|fit| &fit.provenance), "needle-bench calibrate needle"),
    ]
}

/// The last completed `stage prove` on this bus, and the keys of stage and bus that changed since.
pub fn proof(config: &Config, last: Option<&Earlier>, now_unix_us: i64) -> Check {
    let next = "needle-bench stage prove, without a needle";
    let days_max = config.calibration.max_age_days;
    let Some(Earlier { started_utc, changed, proof }) = last else {
        return Check::pass("stage prove", "never").unless(false, Verdict::Warn, next);
    };
    let days = age_days(started_utc, now_unix_us);
    let proof = proof.as_ref().map(|proof| format!("{proof}, ")).unwrap_or_default();
    let found = format!("{proof}{}{}", ago(days), listed(changed, ", changed since: "));
    let is_valid = changed.is_empty() && is_young(days, days_max);
    Check::pass("stage prove", found)
        .within(format!("this configuration, up to {days_max:.0} days"))
        .unless(is_valid, Verdict::Warn, next)
}

/// What changed since the last run on this bus.
pub fn changes(last: Option<&Earlier>, now_unix_us: i64) -> Check {
    let name = "configuration";
    let Some(Earlier { started_utc, changed, .. }) = last else {
        return Check::pass(name, "no run before on this bus");
    };
    let since = ago(age_days(started_utc, now_unix_us));
    let found = match changed.is_empty() {
        true => format!("as in the last run, {since}"),
        false => format!("{} keys{}", changed.len(), listed(changed, " changed: ")),
    };
    let next = format!("compare: the last run was {since}");
    Check::pass(name, found).unless(changed.is_empty(), Verdict::Warn, next)
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
