//! Macros that declare the keys of a table, and the names of a choice.

/// Declares a table of the configuration: a struct, and the keys that fill it. A key is
/// `name: type [rule] = default, more;` with the default as a literal, or as `=> "TOML"`. Further
/// properties are the methods of [`Key`]. With `field as "key"` the key has another name than the
/// field, and its value is converted from the unit of the key to mm, rad or s. Fields under `beside`
/// have no key: they start with the value given there, and the caller sets them.
///
/// The table of an axis is declared as `struct NAME of AXIS`: the names and rules of its keys may depend on AXIS, 0
/// or 1. The key that holds such a table says whose keys are allowed: `table(NAME::keys_of::<1>())`. The struct is the
/// same for both axes: a field is read from the key of either.
macro_rules! section {
    (
        $(#[$attribute:meta])*
        pub struct $section:ident $(of $axis:ident)? {
            $($(#[doc = $text:literal])* $field:ident $(as $key:tt)?: $type:ty
                $([$rule:expr])? $(= $default:expr)? $(=> $toml:expr)?
                $(, $more:ident $(($($value:expr),*))?)*;)*
        }
        $(beside { $($(#[$about:meta])* $seen:vis $beside:ident: $other:ty = $initial:expr,)* })?
    ) => {
        $(#[$attribute])*
        #[derive(Debug, Clone, PartialEq)]
        pub struct $section {
            $($(#[doc = $text])* pub $field: $type,)*
            $($($(#[$about])* $seen $beside: $other,)*)?
        }
        impl $section {
            pub(crate) const KEYS: &'static [$crate::keys::Key] =
                Self::keys_of $(::<{ const $axis: usize = 0; $axis }>)? ();
            pub(crate) const fn keys_of $(<const $axis: usize>)? () -> &'static [$crate::keys::Key] {
                const { &[$(
                    $crate::keys::section!(@key $type, concat!($($text, "\n"),*), $field $($key)?)
                    $(.rule($rule))? $(.default(stringify!($default)))? $(.default($toml))?
                    $(.$more($($($value),*)?))*
                ),*] }
            }
        }
        impl $crate::keys::Field for $section {
            const KIND: $crate::keys::Kind = $crate::keys::Kind::Table(Self::KEYS);
            fn take(table: Option<&toml::Value>) -> Self {
                let others = Self::keys_of $(::<{ const $axis: usize = 1; $axis }>)? ();
                let mut parts = Self::KEYS.iter().zip(others);
                let mut part = || {
                    parts.next().and_then(|(key, other)| {
                        key.value_in(table).or_else(|| other.value_in(table))
                    })
                };
                $section {
                    $($field: $crate::keys::Field::take(part().as_ref()),)*
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

/// Declares an enumeration: its variants, the words that stand for them in TOML, and their meanings.
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
        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(match self { $($name::$variant => $word),+ })
            }
        }
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
    use crate::keys::{Field as _, Rule};
    use std::time::Duration;
    use toml::Value;

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
    fn values_are_converted_to_mm_rad_and_s() {
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
