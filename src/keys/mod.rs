//! How the keys of the configuration are declared: each with its type, range, default and text, and
//! whether hardware must give it. A folder declares the keys of its own settings beside the code that
//! uses them. `config` reads, prints and explains them all.

mod reference;
mod words;

pub(crate) use reference::{json_schema, toml_reference};
pub(crate) use words::{ValueError, Words};

use nalgebra::Vector3;
use std::time::Duration;
use toml::{Table, Value};

/// A key as it is declared.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Key {
    pub(crate) name: &'static str,
    /// What it means, one line of documentation a line.
    pub(crate) text: &'static str,
    pub(crate) kind: Kind,
    pub(crate) rule: Rule,
    /// True where the key may be left out although it has no default.
    pub(crate) is_optional: bool,
    /// In TOML.
    pub(crate) default: Option<&'static str>,
    pub(crate) default_holds: DefaultHolds,
    /// In the file it has the unit of its name, inside mm, rad and s.
    pub(crate) is_converted: bool,
    /// A table whose keys stand in the table around it.
    pub(crate) is_flat: bool,
    /// A table that is replaced as a whole when it is given.
    pub(crate) is_whole: bool,
    /// The key beside this one that it takes the place of.
    pub(crate) instead_of: Option<&'static str>,
    /// The dotted key whose value is the upper limit of this one.
    pub(crate) at_most: Option<&'static str>,
    /// Narrower ranges of keys inside this table.
    pub(crate) narrowed: &'static [(&'static str, Rule)],
}

/// When a default holds. A key of a drive has this decided, or does not compile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DefaultHolds {
    /// Always; nobody decided about hardware.
    Undecided,
    /// With an emulated tracker only.
    ForEmulatedTracker,
    /// With an emulated stage only: hardware must give the key.
    ForEmulatedStage,
    /// For hardware as well.
    ForHardware,
    /// Even inside a table that is given as a whole.
    Everywhere,
}

/// The type of a value.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Kind {
    Number,
    /// From, to.
    Integer(f64, f64),
    Boolean,
    Text,
    /// Names, each with what it means.
    OneOf(&'static [(&'static str, &'static str)]),
    /// Of one type, and so many where that is fixed.
    Array(&'static Kind, Option<usize>),
    Table(&'static [Key]),
    /// Either of two tables: the first where this key of it is given.
    Either(&'static str, [&'static [Key]; 2]),
}

/// What is allowed of the values of a type.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Rule {
    Any,
    Range(Range),
    /// One of these whole numbers.
    Integers(&'static [i64]),
    /// Text that the function accepts; in words.
    Text(&'static str, fn(&str) -> bool),
    /// This word, which stands for none, or a whole number, in words.
    Or(&'static str, &'static str),
    /// Tables of these keys, in words.
    Fields(&'static str),
}

/// A closed or half-open interval of numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Range {
    pub(crate) low: f64,
    pub(crate) low_is_allowed: bool,
    pub(crate) high: f64,
}

/// From `low` to `high`, both allowed.
pub(crate) const fn within(low: f64, high: f64) -> Rule {
    Rule::Range(Range { low, low_is_allowed: true, high })
}

/// Over `low`, up to `high`.
pub(crate) const fn over(low: f64, high: f64) -> Rule {
    Rule::Range(Range { low, low_is_allowed: false, high })
}

/// Text that is not blank: `what` in words.
pub(crate) const fn named(what: &'static str) -> Rule {
    Rule::Text(what, |text| !text.trim().is_empty())
}

impl Range {
    pub(crate) fn contains(self, value: f64) -> bool {
        value <= self.high && (value > self.low || self.low_is_allowed && value == self.low)
    }
}

impl Key {
    pub(crate) const fn new<T: Field>(name: &'static str, text: &'static str) -> Self {
        Key {
            name,
            text,
            kind: T::KIND,
            rule: Rule::Any,
            is_optional: T::IS_OPTIONAL,
            default: None,
            default_holds: DefaultHolds::Undecided,
            is_converted: false,
            is_flat: false,
            is_whole: false,
            instead_of: None,
            at_most: None,
            narrowed: &[],
        }
    }

    pub(crate) const fn rule(self, rule: Rule) -> Self {
        Key { rule, ..self }
    }

    pub(crate) const fn default(self, toml: &'static str) -> Self {
        Key { default: Some(toml), ..self }
    }

    pub(crate) const fn converted(self) -> Self {
        Key { is_converted: true, ..self }
    }

    pub(crate) const fn flat(self) -> Self {
        Key { is_flat: true, ..self }
    }

    pub(crate) const fn whole(self) -> Self {
        Key { is_whole: true, ..self }
    }

    pub(crate) const fn instead_of(self, other: &'static str) -> Self {
        Key { instead_of: Some(other), ..self }
    }

    pub(crate) const fn at_most(self, other: &'static str) -> Self {
        Key { at_most: Some(other), ..self }
    }

    pub(crate) const fn narrowed(self, narrowed: &'static [(&'static str, Rule)]) -> Self {
        Key { narrowed, ..self }
    }

    pub(crate) const fn hardware_must_give(self) -> Self {
        Key { default_holds: DefaultHolds::ForEmulatedStage, ..self }
    }

    pub(crate) const fn hardware_may_omit(self) -> Self {
        Key { default_holds: DefaultHolds::ForHardware, ..self }
    }

    pub(crate) const fn tracker_must_give(self) -> Self {
        Key { default_holds: DefaultHolds::ForEmulatedTracker, ..self }
    }

    pub(crate) const fn everywhere(self) -> Self {
        Key { default_holds: DefaultHolds::Everywhere, ..self }
    }

    /// The default, if there is one.
    pub(crate) fn default_value(&self) -> Option<Value> {
        toml::from_str::<Table>(&format!("default = {}", self.default?)).ok()?.remove("default")
    }

    /// The keys of a table; none of a value.
    pub(crate) const fn keys(&self) -> &'static [Key] {
        match self.kind {
            Kind::Table(keys) => keys,
            _ => &[],
        }
    }

    /// What `table` has at this key, in the units used inside; none for the word that stands for none.
    pub(crate) fn part(&self, table: Option<&Value>) -> Option<Value> {
        let value = if self.is_flat { table? } else { table?.get(self.name)? };
        match (self.rule, value) {
            (Rule::Or(word, _), Value::String(text)) if text == word => None,
            (_, value) if self.is_converted => Some(converted(self.name, value)),
            (_, value) => Some(value.clone()),
        }
    }

    /// True where either of the two stands for the other.
    pub(crate) fn is_alternative_to(&self, other: &Key) -> bool {
        self.instead_of == Some(other.name) || other.instead_of == Some(self.name)
    }
}

/// From the unit of a key to the one used inside.
type Inside = fn(f64) -> f64;

/// The units that names of keys end in, the longest first: (suffix, in words, to mm, rad or s).
static UNITS: [(&str, &str, Inside); 11] = [
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

/// The unit that the key `name` has in the file.
pub(crate) fn unit_of(name: &str) -> Option<&'static str> {
    UNITS.iter().find(|(suffix, ..)| name.ends_with(suffix)).map(|&(_, words, _)| words)
}

/// The `value` of the key `name` in mm, rad or s.
fn converted(name: &str, value: &Value) -> Value {
    let unit = UNITS.iter().find(|(suffix, ..)| name.ends_with(suffix));
    match (unit, value) {
        (Some((.., inside)), Value::Integer(integer)) => Value::Float(inside(*integer as f64)),
        (Some((.., inside)), Value::Float(number)) => Value::Float(inside(*number)),
        (Some(_), Value::Array(values)) => {
            Value::Array(values.iter().map(|value| converted(name, value)).collect())
        }
        (_, value) => value.clone(),
    }
}

/// The name where a table does not have the key.
pub(crate) const NO_KEY: &str = "";

/// True where each of `keys` says whether hardware must give it.
pub(crate) const fn hardware_is_decided(keys: &[Key]) -> bool {
    match keys {
        [] => true,
        [key, rest @ ..] => {
            let is_decided = match key.default_holds {
                DefaultHolds::Undecided => key.is_flat && hardware_is_decided(key.keys()),
                _ => true,
            };
            is_decided && hardware_is_decided(rest)
        }
    }
}

/// The keys of a table, with those of the flat tables in it. Rules in `narrowed` replace theirs.
pub(crate) fn expanded(keys: &[Key], narrowed: &[(&str, Rule)]) -> Vec<Key> {
    let mut all = Vec::new();
    for key in keys.iter().filter(|key| key.name != NO_KEY) {
        if key.is_flat {
            all.extend(expanded(key.keys(), narrowed));
        } else {
            let rule = narrowed.iter().find(|(name, _)| *name == key.name);
            all.push(rule.map_or(*key, |(_, rule)| key.rule(*rule)));
        }
    }
    all
}

/// The key `path`, dotted, of a table with these `keys`.
pub(crate) fn find(keys: &[Key], path: &str) -> Option<Key> {
    let (name, rest) = path.split_once('.').unwrap_or((path, ""));
    let name = name.split('[').next().unwrap_or(name);
    let key = expanded(keys, &[]).into_iter().find(|key| key.name == name)?;
    match rest {
        "" => Some(key),
        rest => tables(&key.kind).into_iter().find_map(|keys| find(keys, rest)),
    }
}

/// The tables that a value of this kind may be, or be made of.
pub(crate) fn tables(kind: &Kind) -> Vec<&'static [Key]> {
    match *kind {
        Kind::Table(keys) => vec![keys],
        Kind::Either(_, tables) => tables.to_vec(),
        Kind::Array(of, _) => tables(of),
        _ => Vec::new(),
    }
}

/// A type that a key may have.
pub(crate) trait Field: Sized {
    /// How it is written.
    const KIND: Kind;
    /// True where it may be absent.
    const IS_OPTIONAL: bool = false;
    /// From a value that was checked; something harmless from one that is wrong.
    fn take(value: Option<&Value>) -> Self;
}

impl Field for f64 {
    const KIND: Kind = Kind::Number;
    fn take(value: Option<&Value>) -> Self {
        value.and_then(Value::as_float).unwrap_or(f64::NAN)
    }
}

/// In seconds.
impl Field for Duration {
    const KIND: Kind = Kind::Number;
    fn take(value: Option<&Value>) -> Self {
        Duration::try_from_secs_f64(f64::take(value)).unwrap_or_default()
    }
}

macro_rules! integers {
    ($($type:ty),*) => {$(
        impl Field for $type {
            const KIND: Kind = Kind::Integer(<$type>::MIN as f64, <$type>::MAX as f64);
            fn take(value: Option<&Value>) -> Self {
                value.and_then(Value::as_integer).and_then(|i| i.try_into().ok()).unwrap_or_default()
            }
        }
    )*};
}
integers!(u8, u16, u32, u64, i8, i16, i32, i64);

impl Field for bool {
    const KIND: Kind = Kind::Boolean;
    fn take(value: Option<&Value>) -> Self {
        value.and_then(Value::as_bool).unwrap_or_default()
    }
}

impl Field for String {
    const KIND: Kind = Kind::Text;
    fn take(value: Option<&Value>) -> Self {
        value.and_then(Value::as_str).unwrap_or_default().to_owned()
    }
}

impl<T: Field> Field for Option<T> {
    const KIND: Kind = T::KIND;
    const IS_OPTIONAL: bool = true;
    fn take(value: Option<&Value>) -> Self {
        value.map(|value| T::take(Some(value)))
    }
}

impl<T: Field> Field for Vec<T> {
    const KIND: Kind = Kind::Array(&T::KIND, None);
    fn take(value: Option<&Value>) -> Self {
        let values = value.and_then(Value::as_array);
        values.into_iter().flatten().map(|value| T::take(Some(value))).collect()
    }
}

impl<T: Field, const N: usize> Field for [T; N] {
    const KIND: Kind = Kind::Array(&T::KIND, Some(N));
    fn take(value: Option<&Value>) -> Self {
        std::array::from_fn(|i| T::take(value.and_then(|value| value.get(i))))
    }
}

impl Field for Vector3<f64> {
    const KIND: Kind = <[f64; 3]>::KIND;
    fn take(value: Option<&Value>) -> Self {
        <[f64; 3]>::take(value).into()
    }
}

/// Declares a table of the configuration: a struct, and the keys that fill it. A key is
/// `name: type [rule] = default, more;` with the default as a literal, or as `=> "TOML"`. Further
/// properties are the methods of [`Key`]. With `field as "key"` the field has another name, and the
/// value is converted from the unit of the key to mm, rad or s. Fields under `beside` have no key,
/// and a value to begin with.
macro_rules! section {
    (
        $(#[$attribute:meta])*
        pub struct $section:ident $(<const $unit:ident: $of:ty>)? {
            $($(#[doc = $text:literal])* $field:ident $(as $key:tt)?: $type:ty
                $([$rule:expr])? $(= $default:expr)? $(=> $toml:expr)?
                $(, $more:ident $(($($value:expr),*))?)*;)*
        }
        $(beside { $($(#[$about:meta])* $seen:vis $beside:ident: $other:ty = $initial:expr,)* })?
    ) => {
        $(#[$attribute])*
        #[derive(Debug, Clone, PartialEq)]
        pub struct $section $(<const $unit: $of>)? {
            $($(#[doc = $text])* pub $field: $type,)*
            $($($(#[$about])* $seen $beside: $other,)*)?
        }
        impl $(<const $unit: $of>)? $section $(<$unit>)? {
            pub(crate) const KEYS: &'static [$crate::keys::Key] = &[$(
                $crate::keys::section!(@key $type, concat!($($text, "\n"),*), $field $($key)?)
                $(.rule($rule))? $(.default(stringify!($default)))? $(.default($toml))?
                $(.$more($($($value),*)?))*
            ),*];
        }
        impl $(<const $unit: $of>)? $crate::keys::Field for $section $(<$unit>)? {
            const KIND: $crate::keys::Kind = $crate::keys::Kind::Table(Self::KEYS);
            fn take(table: Option<&toml::Value>) -> Self {
                let mut parts = Self::KEYS.iter().map(|key| key.part(table));
                $section {
                    $($field: $crate::keys::Field::take(parts.next().flatten().as_ref()),)*
                    $($($beside: $initial,)*)?
                }
            }
        }
    };
    (@key $type:ty, $text:expr, $field:ident) => {
        $crate::keys::Key::new::<$type>(stringify!($field), $text)
    };
    (@key $type:ty, $text:expr, $field:ident $key:tt) => {
        $crate::keys::Key::new::<$type>($key, $text).converted()
    };
}
pub(crate) use section;

/// Declares an enumeration: the names that its variants have in TOML, and what they mean. After `for`,
/// of one that is declared elsewhere.
macro_rules! choice {
    (
        $(#[$doc:meta])*
        pub enum $name:ident { $($(#[doc = $text:literal])* $variant:ident = $word:literal,)+ }
    ) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum $name {
            $($(#[doc = $text])* $variant,)+
        }
        $crate::keys::choice! {
            for $name { $($(#[doc = $text])* $variant = $word,)+ }
        }
        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(match self { $($name::$variant => $word),+ })
            }
        }
    };
    (for $name:ident { $($(#[doc = $text:literal])* $variant:ident = $word:literal,)+ }) => {
        impl $crate::keys::Field for $name {
            const KIND: $crate::keys::Kind =
                $crate::keys::Kind::OneOf(&[$(($word, concat!($($text, "\n"),*))),+]);
            fn take(value: Option<&toml::Value>) -> Self {
                let all = [$(($word, $name::$variant)),+];
                let word = value.and_then(toml::Value::as_str).unwrap_or_default();
                all.into_iter().find(|&(name, _)| name == word).unwrap_or(all[0]).1
            }
        }
    };
}
pub(crate) use choice;

#[cfg(test)]
mod tests {
    use super::*;

    section! {
        /// Values in units of the file.
        #[expect(unreachable_pub, reason = "a section is public")]
        pub struct Sample {
            /// An angle.
            angles_rad as "angles_deg": [f64; 2];
            /// A time.
            pause as "pause_ms": Duration;
            /// A number without a unit.
            count as "counts_per_mm_or_turn": u32;
            /// A number, or none.
            limit: Option<f64> [Rule::Or("any", "a number")];
        }
        beside {
            given: bool = true,
        }
    }

    #[test]
    fn values_are_taken_in_mm_rad_and_s() {
        let text = "angles_deg = [180.0, 90.0]\npause_ms = 20\ncounts_per_mm_or_turn = 3\n";
        let take = |text: &str| Sample::take(Some(&Value::Table(text.parse().unwrap())));
        let expected = Sample {
            angles_rad: [180f64.to_radians(), 90f64.to_radians()],
            pause: Duration::from_millis(20),
            count: 3,
            limit: None,
            given: true,
        };
        assert_eq!(take(&format!("{text}limit = \"any\"")), expected);
        assert_eq!(take(&format!("{text}limit = 2.5")), Sample { limit: Some(2.5), ..expected });
    }
}
