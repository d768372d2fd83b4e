//! UTC as text.

use jiff::Timestamp;

/// UTC of `unix_us`, µs since 1970, as `20260301T143000Z`: sorts by time and is valid in file names everywhere.
pub fn compact(unix_us: i64) -> String {
    formatted(unix_us, "%Y%m%dT%H%M%SZ")
}

/// UTC of `unix_us`, µs since 1970, as `2026-03-01T14:30:00.123456Z` (RFC 3339).
pub fn rfc3339(unix_us: i64) -> String {
    formatted(unix_us, "%Y-%m-%dT%H:%M:%S.%6fZ")
}

/// Formats a time; one that is out of range counts as 1970.
fn formatted(unix_us: i64, format: &str) -> String {
    Timestamp::from_microsecond(unix_us).unwrap_or_default().strftime(format).to_string()
}

/// Reads a time that [`rfc3339`] wrote, as µs since 1970; `None` for any other text.
pub fn unix_us_of(text: &str) -> Option<i64> {
    let unix_us = text.parse::<Timestamp>().ok()?.as_microsecond();
    Some(unix_us).filter(|unix_us| rfc3339(*unix_us) == text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_moments_are_formatted() {
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
