//! How keys are declared. A declaration has the key's type, range, default and text, and whether the
//! hardware must give it. Reading, printing, hints, the reference and the JSON Schema follow from it.

use crate::canopen::NodeId;
use nalgebra::Vector3;
use toml::{Table, Value};

/// A key as it is declared.
#[derive(Debug, Clone, Copy)]
pub(super) struct Key {
    pub(super) name: &'static str,
    /// What it means, one line of documentation a line.
    pub(super) text: &'static str,
    pub(super) kind: Kind,
    pub(super) rule: Rule,
    /// True where the key may be left out although it has no default.
    pub(super) is_optional: bool,
    /// In TOML.
    pub(super) default: Option<&'static str>,
    pub(super) default_holds: DefaultHolds,
    /// A table whose keys stand in the table around it.
    pub(super) is_flat: bool,
    /// Defaults, in TOML, of keys inside a flat table.
    pub(super) defaults: &'static [(&'static str, &'static str)],
    /// A table that is replaced as a whole when it is given.
    pub(super) is_whole: bool,
    /// The key beside this one that it takes the place of.
    pub(super) instead_of: Option<&'static str>,
    /// The dotted key whose value is the upper limit of this one.
    pub(super) at_most: Option<&'static str>,
    /// Narrower ranges of keys inside this table.
    pub(super) narrowed: &'static [(&'static str, Rule)],
}

/// When a default holds. A key of a drive has this decided, or does not compile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DefaultHolds {
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
pub(super) enum Kind {
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
pub(super) enum Rule {
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
pub(super) struct Range {
    pub(super) low: f64,
    pub(super) low_is_allowed: bool,
    pub(super) high: f64,
}

/// From `low` to `high`, both allowed.
pub(super) const fn within(low: f64, high: f64) -> Rule {
    Rule::Range(Range { low, low_is_allowed: true, high })
}

/// Over `low`, up to `high`.
pub(super) const fn over(low: f64, high: f64) -> Rule {
    Rule::Range(Range { low, low_is_allowed: false, high })
}

/// Text that is not blank: `what` in words.
pub(super) const fn named(what: &'static str) -> Rule {
    Rule::Text(what, |text| !text.trim().is_empty())
}

impl Range {
    pub(super) fn contains(self, value: f64) -> bool {
        value <= self.high && (value > self.low || self.low_is_allowed && value == self.low)
    }
}

impl Key {
    pub(super) const fn new<T: Field>(name: &'static str, text: &'static str) -> Self {
        Key {
            name,
            text,
            kind: T::KIND,
            rule: Rule::Any,
            is_optional: T::IS_OPTIONAL,
            default: None,
            default_holds: DefaultHolds::Undecided,
            is_flat: false,
            defaults: &[],
            is_whole: false,
            instead_of: None,
            at_most: None,
            narrowed: &[],
        }
    }

    pub(super) const fn rule(self, rule: Rule) -> Self {
        Key { rule, ..self }
    }

    pub(super) const fn default(self, toml: &'static str) -> Self {
        Key { default: Some(toml), ..self }
    }

    pub(super) const fn flat(self) -> Self {
        Key { is_flat: true, ..self }
    }

    pub(super) const fn defaults(self, defaults: &'static [(&'static str, &'static str)]) -> Self {
        Key { defaults, ..self }
    }

    pub(super) const fn whole(self) -> Self {
        Key { is_whole: true, ..self }
    }

    pub(super) const fn instead_of(self, other: &'static str) -> Self {
        Key { instead_of: Some(other), ..self }
    }

    pub(super) const fn at_most(self, other: &'static str) -> Self {
        Key { at_most: Some(other), ..self }
    }

    pub(super) const fn narrowed(self, narrowed: &'static [(&'static str, Rule)]) -> Self {
        Key { narrowed, ..self }
    }

    pub(super) const fn hardware_must_give(self) -> Self {
        Key { default_holds: DefaultHolds::ForEmulatedStage, ..self }
    }

    pub(super) const fn hardware_may_omit(self) -> Self {
        Key { default_holds: DefaultHolds::ForHardware, ..self }
    }

    pub(super) const fn tracker_must_give(self) -> Self {
        Key { default_holds: DefaultHolds::ForEmulatedTracker, ..self }
    }

    pub(super) const fn everywhere(self) -> Self {
        Key { default_holds: DefaultHolds::Everywhere, ..self }
    }

    /// The default, if there is one.
    pub(super) fn default_value(&self) -> Option<Value> {
        toml::from_str::<Table>(&format!("default = {}", self.default?)).ok()?.remove("default")
    }

    /// The keys of a table; none of a value.
    pub(super) const fn keys(&self) -> &'static [Key] {
        match self.kind {
            Kind::Table(keys) => keys,
            _ => &[],
        }
    }

    /// True where either of the two stands for the other.
    pub(super) fn is_alternative_to(&self, other: &Key) -> bool {
        self.instead_of == Some(other.name) || other.instead_of == Some(self.name)
    }
}

/// True where each of `keys` says whether hardware must give it.
pub(super) const fn hardware_is_decided(keys: &[Key]) -> bool {
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
pub(super) fn expanded(keys: &[Key], narrowed: &[(&str, Rule)]) -> Vec<Key> {
    let mut all = Vec::new();
    for key in keys {
        if key.is_flat {
            all.extend(expanded(key.keys(), narrowed).into_iter().map(|inner| {
                let default = key.defaults.iter().find(|(name, _)| *name == inner.name);
                default.map_or(inner, |(_, default)| inner.default(default))
            }));
        } else {
            let rule = narrowed.iter().find(|(name, _)| *name == key.name);
            all.push(rule.map_or(*key, |(_, rule)| key.rule(*rule)));
        }
    }
    all
}

/// The key `path`, dotted, of a table with these `keys`.
pub(super) fn find(keys: &[Key], path: &str) -> Option<Key> {
    let (name, rest) = path.split_once('.').unwrap_or((path, ""));
    let name = name.split('[').next().unwrap_or(name);
    let key = expanded(keys, &[]).into_iter().find(|key| key.name == name)?;
    match rest {
        "" => Some(key),
        rest => tables(&key.kind).into_iter().find_map(|keys| find(keys, rest)),
    }
}

/// The tables that a value of this kind may be, or be made of.
pub(super) fn tables(kind: &Kind) -> Vec<&'static [Key]> {
    match *kind {
        Kind::Table(keys) => vec![keys],
        Kind::Either(_, tables) => tables.to_vec(),
        Kind::Array(of, _) => tables(of),
        _ => Vec::new(),
    }
}

/// A type that a key may have.
pub(super) trait Field: Sized {
    /// How it is written.
    const KIND: Kind;
    /// True where it may be absent.
    const IS_OPTIONAL: bool = false;
    /// From a value that was checked; something harmless from one that is wrong.
    fn take(value: Option<&Value>) -> Self;
    /// As it is written; `None` for what is left out.
    fn put(&self) -> Option<Value>;
}

impl Field for f64 {
    const KIND: Kind = Kind::Number;
    fn take(value: Option<&Value>) -> Self {
        value.and_then(Value::as_float).unwrap_or(f64::NAN)
    }
    fn put(&self) -> Option<Value> {
        Some(Value::Float(*self))
    }
}

macro_rules! integers {
    ($($type:ty),*) => {$(
        impl Field for $type {
            const KIND: Kind = Kind::Integer(<$type>::MIN as f64, <$type>::MAX as f64);
            fn take(value: Option<&Value>) -> Self {
                value.and_then(Value::as_integer).and_then(|i| i.try_into().ok()).unwrap_or_default()
            }
            fn put(&self) -> Option<Value> {
                Some(Value::Integer(i64::try_from(*self).unwrap_or(i64::MAX)))
            }
        }
    )*};
}
integers!(u8, u16, u32, u64, i8, i16, i32, i64);

impl Field for NodeId {
    const KIND: Kind = Kind::Integer(1.0, 127.0);
    fn take(value: Option<&Value>) -> Self {
        NodeId::new(u8::take(value)).unwrap_or(const { NodeId::new(1).unwrap() })
    }
    fn put(&self) -> Option<Value> {
        self.get().put()
    }
}

impl Field for bool {
    const KIND: Kind = Kind::Boolean;
    fn take(value: Option<&Value>) -> Self {
        value.and_then(Value::as_bool).unwrap_or_default()
    }
    fn put(&self) -> Option<Value> {
        Some(Value::Boolean(*self))
    }
}

impl Field for String {
    const KIND: Kind = Kind::Text;
    fn take(value: Option<&Value>) -> Self {
        value.and_then(Value::as_str).unwrap_or_default().to_owned()
    }
    fn put(&self) -> Option<Value> {
        Some(Value::String(self.clone()))
    }
}

impl<T: Field> Field for Option<T> {
    const KIND: Kind = T::KIND;
    const IS_OPTIONAL: bool = true;
    fn take(value: Option<&Value>) -> Self {
        value.map(|value| T::take(Some(value)))
    }
    fn put(&self) -> Option<Value> {
        self.as_ref().and_then(T::put)
    }
}

impl<T: Field> Field for Vec<T> {
    const KIND: Kind = Kind::Array(&T::KIND, None);
    fn take(value: Option<&Value>) -> Self {
        let values = value.and_then(Value::as_array);
        values.into_iter().flatten().map(|value| T::take(Some(value))).collect()
    }
    fn put(&self) -> Option<Value> {
        Some(Value::Array(self.iter().filter_map(T::put).collect()))
    }
}

impl<T: Field, const N: usize> Field for [T; N] {
    const KIND: Kind = Kind::Array(&T::KIND, Some(N));
    fn take(value: Option<&Value>) -> Self {
        std::array::from_fn(|i| T::take(value.and_then(|value| value.get(i))))
    }
    fn put(&self) -> Option<Value> {
        Some(Value::Array(self.iter().filter_map(T::put).collect()))
    }
}

impl Field for Vector3<f64> {
    const KIND: Kind = <[f64; 3]>::KIND;
    fn take(value: Option<&Value>) -> Self {
        <[f64; 3]>::take(value).into()
    }
    fn put(&self) -> Option<Value> {
        <[f64; 3]>::from(*self).put()
    }
}

/// The values of `keys` in `table`, in the order of the declaration.
pub(super) fn parts<'a>(
    keys: &'static [Key],
    table: Option<&'a Value>,
) -> impl Iterator<Item = Option<&'a Value>> {
    keys.iter().map(move |key| if key.is_flat { table } else { table?.get(key.name) })
}

/// A table of `values`, in the order of the declaration.
pub(super) fn table<const N: usize>(keys: &'static [Key], values: [Option<Value>; N]) -> Value {
    let mut table = Table::new();
    for (key, value) in keys.iter().zip(values) {
        match (value, key.rule) {
            (Some(Value::Table(inner)), _) if key.is_flat => table.extend(inner),
            (Some(value), _) => _ = table.insert(key.name.to_owned(), value),
            (None, Rule::Or(word, _)) => _ = table.insert(key.name.to_owned(), word.into()),
            (None, _) => {}
        }
    }
    Value::Table(table)
}

/// Declares a table of the configuration: a struct, and the keys that fill it. A key is
/// `name: type [rule] = default, more;` with the default as a literal, or as `=> "TOML"`. Further
/// properties are the methods of [`Key`].
macro_rules! section {
    (
        $(#[$attribute:meta])*
        pub struct $section:ident {
            $($(#[doc = $text:literal])* $field:ident: $type:ty $([$rule:expr])? $(= $default:expr)?
                $(=> $toml:literal)? $(, $more:ident $(($($value:expr),*))?)*;)*
        }
    ) => {
        $(#[$attribute])*
        #[derive(Debug, Clone, PartialEq)]
        pub struct $section {
            $($(#[doc = $text])* pub $field: $type,)*
        }
        $crate::config::schema::section! {
            impl $section {
                $($(#[doc = $text])* $field: $type $([$rule])? $(= $default)? $(=> $toml)?
                    $(, $more $(($($value),*))?)*;)*
            }
        }
        impl serde::Serialize for $section {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serde::Serialize::serialize(&$crate::config::schema::Field::put(self), serializer)
            }
        }
    };
    (
        impl $section:ident {
            $($(#[doc = $text:literal])* $field:ident: $type:ty $([$rule:expr])? $(= $default:expr)?
                $(=> $toml:literal)? $(, $more:ident $(($($value:expr),*))?)*;)*
        }
    ) => {
        impl $section {
            pub(in crate::config) const KEYS: &'static [$crate::config::schema::Key] = &[$(
                $crate::config::schema::Key::new::<$type>(
                    stringify!($field), concat!($($text, "\n"),*)
                )
                $(.rule($rule))? $(.default(stringify!($default)))? $(.default($toml))?
                $(.$more($($($value),*)?))*
            ),*];
        }
        impl $crate::config::schema::Field for $section {
            const KIND: $crate::config::schema::Kind =
                $crate::config::schema::Kind::Table(Self::KEYS);
            fn take(value: Option<&toml::Value>) -> Self {
                let mut parts = $crate::config::schema::parts(Self::KEYS, value);
                $section {
                    $($field: $crate::config::schema::Field::take(parts.next().flatten()),)*
                }
            }
            fn put(&self) -> Option<toml::Value> {
                let values = [$($crate::config::schema::Field::put(&self.$field)),*];
                Some($crate::config::schema::table(Self::KEYS, values))
            }
        }
    };
}
pub(super) use section;

/// Declares the names that the variants of an enumeration have in TOML, and what they mean: of an
/// enumeration declared here, or, after `for`, of one from another module.
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
        $crate::config::schema::choice! {
            for $name { $($(#[doc = $text])* $variant = $word,)+ }
        }
        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(match self { $($name::$variant => $word),+ })
            }
        }
    };
    (for $name:ident { $($(#[doc = $text:literal])* $variant:ident = $word:literal,)+ }) => {
        impl $crate::config::schema::Field for $name {
            const KIND: $crate::config::schema::Kind =
                $crate::config::schema::Kind::OneOf(&[$(($word, concat!($($text, "\n"),*))),+]);
            fn take(value: Option<&toml::Value>) -> Self {
                let all = [$(($word, $name::$variant)),+];
                let word = value.and_then(toml::Value::as_str).unwrap_or_default();
                all.into_iter().find(|&(name, _)| name == word).unwrap_or(all[0]).1
            }
            fn put(&self) -> Option<toml::Value> {
                let all = [$(($word, $name::$variant)),+];
                all.into_iter().find(|(_, value)| value == self).map(|(name, _)| name.into())
            }
        }
    };
}
pub(super) use choice;
