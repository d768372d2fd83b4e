//! The units with which the names of keys end.

use toml::Value;

/// Converts a number from the unit of its key to mm, rad or s.
type Conversion = fn(f64) -> f64;

/// The units, the longest suffix first: (suffix, unit in words, conversion).
static UNITS: [(&str, &str, Conversion); 11] = [
    ("_mm_per_s2", "mm/s²", |mm_per_s2| mm_per_s2),
    ("_deg_per_s2", "deg/s²", f64::to_radians),
    ("_mm_per_s", "mm/s", |mm_per_s| mm_per_s),
    ("_deg_per_s", "deg/s", f64::to_radians),
    ("_deg_per_mm", "deg/mm", f64::to_radians),
    ("_per_mm", "per mm", |per_mm| per_mm),
    ("_mm", "mm", |mm| mm),
    ("_deg", "deg", f64::to_radians),
    ("_ms", "ms", |ms| ms * 1e-3),
    ("_s", "s", |s| s),
    ("_hz", "Hz", |hz| hz),
];

/// The unit of the key `name` in the file, in words; `None` if the name ends with none.
pub(crate) fn unit_of(name: &str) -> Option<&'static str> {
    UNITS.iter().find(|(suffix, ..)| name.ends_with(suffix)).map(|&(_, words, _)| words)
}

/// The `value` of the key `name` in mm, rad or s.
pub(super) fn converted(name: &str, value: &Value) -> Value {
    let unit = UNITS.iter().find(|(suffix, ..)| name.ends_with(suffix));
    match (unit, value) {
        (Some((.., convert)), Value::Integer(integer)) => Value::Float(convert(*integer as f64)),
        (Some((.., convert)), Value::Float(number)) => Value::Float(convert(*number)),
        (Some(_), Value::Array(values)) => {
            Value::Array(values.iter().map(|value| converted(name, value)).collect())
        }
        (_, value) => value.clone(),
    }
}
