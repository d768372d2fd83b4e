//! UTC as text: the civil calendar, without leap seconds.

/// `20260301T143000Z`: sorts by time and is a file name everywhere.
pub fn compact(unix_us: i64) -> String {
    let (y, mo, d, h, mi, s, _) = civil(unix_us);
    format!("{y:04}{mo:02}{d:02}T{h:02}{mi:02}{s:02}Z")
}

/// `2026-03-01T14:30:00.123456Z` (RFC 3339).
pub fn rfc3339(unix_us: i64) -> String {
    let (y, mo, d, h, mi, s, us) = civil(unix_us);
    format!("{y:04}-{mo:02}-{d:02}T{h:02}:{mi:02}:{s:02}.{us:06}Z")
}

/// The microseconds since 1970 of which [`rfc3339`] makes `text`; `None` of anything else.
pub fn unix_us_of(text: &str) -> Option<i64> {
    let number = |from: usize, to: usize| text.get(from..to)?.parse::<i64>().ok();
    let (y, mo, d) = (number(0, 4)?, number(5, 7)?, number(8, 10)?);
    let (h, mi, s, us) = (number(11, 13)?, number(14, 16)?, number(17, 19)?, number(20, 26)?);
    // Days from 1970 to the year's 1 March and from there, as in `civil`.
    let (year, month) = if mo > 2 { (y, mo - 3) } else { (y - 1, mo + 9) };
    let day_of_year = (153 * month + 2) / 5 + d - 1;
    let years = 365 * year + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400);
    let s = (years + day_of_year - 719_468) * 86_400 + (h * 60 + mi) * 60 + s;
    Some(s * 1_000_000 + us).filter(|unix_us| rfc3339(*unix_us) == text)
}

/// Year, month, day, hour, minute, second, microsecond in the Gregorian calendar, counted from
/// 1 March so that the leap day is the last of its year.
fn civil(unix_us: i64) -> (i64, i64, i64, i64, i64, i64, i64) {
    const DAYS_PER_ERA: i64 = 146_097;
    let (s_all, us) = (unix_us.div_euclid(1_000_000), unix_us.rem_euclid(1_000_000));
    let (days, s) = (s_all.div_euclid(86_400), s_all.rem_euclid(86_400));
    let days = days + 719_468;
    let (era, day_of_era) = (days.div_euclid(DAYS_PER_ERA), days.rem_euclid(DAYS_PER_ERA));
    let year_of_era =
        (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = (month_from_march + 2) % 12 + 1;
    let year = era * 400 + year_of_era + i64::from(month <= 2);
    (year, month, day, s / 3_600, s / 60 % 60, s % 60, us)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_moments() {
        assert_eq!(rfc3339(0), "1970-01-01T00:00:00.000000Z");
        assert_eq!(rfc3339(1_700_000_000_123_456), "2023-11-14T22:13:20.123456Z");
        assert_eq!(rfc3339(951_782_400_000_000), "2000-02-29T00:00:00.000000Z");
        assert_eq!(rfc3339(951_868_800_000_000), "2000-03-01T00:00:00.000000Z");
        assert_eq!(rfc3339(4_107_542_399_999_999), "2100-02-28T23:59:59.999999Z");
        assert_eq!(rfc3339(4_107_542_400_000_000), "2100-03-01T00:00:00.000000Z");
        assert_eq!(rfc3339(-1), "1969-12-31T23:59:59.999999Z");
        assert_eq!(compact(1_700_000_000_123_456), "20231114T221320Z");
    }

    #[test]
    fn moments_are_read_back() {
        for unix_us in (-80_000..80_000).map(|days: i64| days * 86_400_000_000 + days * 1_234_567) {
            assert_eq!(unix_us_of(&rfc3339(unix_us)), Some(unix_us));
        }
        for text in
            ["", "2023-11-14", "2023-02-30T00:00:00.000000Z", "2023-11-14T22:13:20.123456+01"]
        {
            assert_eq!(unix_us_of(text), None, "{text}");
        }
    }
}
