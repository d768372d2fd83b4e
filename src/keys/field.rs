//! The types that a key may have, and how their values are read.

use super::Kind;
use nalgebra::Vector3;
use std::time::Duration;
use toml::Value;

/// A type that a key may have.
pub(crate) trait Field: Sized {
    /// The kind of value in TOML.
    const KIND: Kind;
    /// True if the key may be absent.
    const IS_OPTIONAL: bool = false;
    /// Converts a value that was checked; a wrong or missing value gives a placeholder such as NaN or 0.
    fn take(value: Option<&Value>) -> Self;
}

impl Field for f64 {
    const KIND: Kind = Kind::Number;
    fn take(value: Option<&Value>) -> Self {
        value.and_then(Value::as_float).unwrap_or(f64::NAN)
    }
}

/// A duration in seconds.
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
