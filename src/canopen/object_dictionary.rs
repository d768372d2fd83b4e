//! A node's object dictionary: typed values with access rights, limits and defaults
//! (CiA 301, 7.4).

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use super::ObjectAddress;
use super::pdo::PdoDirection;
use super::sdo::{AbortCode, SdoValue};

/// The data types (CiA 301, 7.4.7) that the emulated drives need.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum DataType {
    /// An INTEGER of so many bits, up to 32.
    Signed(u8),
    /// An UNSIGNED of so many bits, up to 32.
    Unsigned(u8),
    /// VISIBLE_STRING.
    Text,
}

impl DataType {
    /// The type with this index in the object dictionary.
    pub(super) const fn from_index(index: i64) -> Option<Self> {
        Some(match index {
            0x02 => DataType::Signed(8),
            0x03 => DataType::Signed(16),
            0x04 => DataType::Signed(32),
            0x05 => DataType::Unsigned(8),
            0x06 => DataType::Unsigned(16),
            0x07 => DataType::Unsigned(32),
            0x09 => DataType::Text,
            _ => return None,
        })
    }

    /// Length in bits; `None` for a string.
    const fn bits(self) -> Option<u8> {
        match self {
            DataType::Signed(bits) | DataType::Unsigned(bits) => Some(bits),
            DataType::Text => None,
        }
    }

    /// `raw` truncated to the length of the type, as a number.
    const fn integer(self, raw: u64) -> i64 {
        match self {
            DataType::Signed(len) => (raw << (64 - len)) as i64 >> (64 - len),
            DataType::Unsigned(len) => (raw << (64 - len) >> (64 - len)) as i64,
            DataType::Text => 0,
        }
    }
}

/// Access to an entry over the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Access {
    /// Read only.
    ReadOnly,
    /// Write only.
    WriteOnly,
    /// Both.
    ReadWrite,
}

/// One value of the dictionary.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Entry {
    data_type: DataType,
    access: Access,
    /// The direction of the PDOs that may carry it.
    pub(super) mappable: Option<PdoDirection>,
    /// The range of the values that can be written over the bus.
    pub(super) limits: Option<RangeInclusive<i64>>,
    /// The value at power-on.
    default: i64,
    value: i64,
    /// The content of a constant string.
    text: String,
}

impl Entry {
    /// A number whose power-on value is `default`.
    pub(super) fn new(data_type: DataType, access: Access, default: i64) -> Self {
        let value = data_type.integer(default as u64);
        let text = String::new();
        Entry { data_type, access, mappable: None, limits: None, default: value, value, text }
    }

    /// A constant string.
    pub(super) fn text(text: &str) -> Self {
        let text = text.to_owned();
        Entry { text, ..Entry::new(DataType::Text, Access::ReadOnly, 0) }
    }

    fn bytes(&self) -> Vec<u8> {
        match self.data_type.bits() {
            None => self.text.clone().into_bytes(),
            Some(bits) => self.value.to_le_bytes()[..usize::from(bits / 8)].to_vec(),
        }
    }

    fn parse(&self, value: SdoValue) -> Result<i64, AbortCode> {
        let own = self.data_type.bits().map_or(0, usize::from);
        match value.size().map_or(own, |size| 8 * size).cmp(&own) {
            Ordering::Greater => Err(AbortCode::LENGTH_TOO_HIGH),
            Ordering::Less => Err(AbortCode::LENGTH_TOO_LOW),
            Ordering::Equal => self.parse_raw(value.to_u32().into()),
        }
    }

    fn parse_raw(&self, raw: u64) -> Result<i64, AbortCode> {
        let value = self.data_type.integer(raw);
        match &self.limits {
            Some(limits) if value > *limits.end() => Err(AbortCode::VALUE_TOO_HIGH),
            Some(limits) if value < *limits.start() => Err(AbortCode::VALUE_TOO_LOW),
            _ => Ok(value),
        }
    }
}

/// The objects of a node.
///
/// An SDO uses [`read`](Self::read) and [`parse`](Self::parse), which check access rights and limits. A PDO
/// uses [`check_mappable`](Self::check_mappable), which checks access rights when the PDO is mapped, and
/// [`parse_raw`](Self::parse_raw), which checks limits. The device's own program uses
/// [`integer`](Self::integer) and [`set`](Self::set), which check nothing.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ObjectDictionary {
    /// Each object once, sorted. A drive looks its objects up at every frame of the bus, and this takes less
    /// time than a `BTreeMap`.
    entries: Vec<(ObjectAddress, Entry)>,
}

/// Collects objects. If several have the same address, the last one counts.
impl FromIterator<(ObjectAddress, Entry)> for ObjectDictionary {
    fn from_iter<T: IntoIterator<Item = (ObjectAddress, Entry)>>(entries: T) -> Self {
        ObjectDictionary { entries: BTreeMap::from_iter(entries).into_iter().collect() }
    }
}

impl ObjectDictionary {
    fn find(&self, object: ObjectAddress) -> Option<usize> {
        let key = |object: ObjectAddress| u32::from(object.index) << 8 | u32::from(object.subindex);
        self.entries.binary_search_by_key(&key(object), |(object, _)| key(*object)).ok()
    }

    /// The number in `object`; 0 when there is no such object. For the device's own program.
    pub fn integer(&self, object: ObjectAddress) -> i64 {
        self.find(object).map_or(0, |n| self.entries[n].1.value)
    }

    /// Sets `object`, truncated to its type. Access and limits are not checked: this is for the
    /// device's own program. It has no effect when there is no such object.
    pub fn set(&mut self, object: ObjectAddress, value: i64) {
        if let Some(n) = self.find(object) {
            let entry = &mut self.entries[n].1;
            entry.value = entry.data_type.integer(value as u64);
        }
    }

    /// The bytes of `object` as an SDO upload gives them.
    ///
    /// # Errors
    /// The abort code: no such object or subindex, or write only.
    pub fn read(&self, object: ObjectAddress) -> Result<Vec<u8>, AbortCode> {
        let entry = self.entry(object)?;
        if entry.access == Access::WriteOnly {
            return Err(AbortCode::WRITE_ONLY);
        }
        Ok(entry.bytes())
    }

    /// The number in `value`, if it may be written to `object`. It is not written yet.
    ///
    /// # Errors
    /// The abort code: no such object or subindex, read only, wrong length, out of limits.
    pub fn parse(&self, object: ObjectAddress, value: SdoValue) -> Result<i64, AbortCode> {
        let entry = self.entry(object)?;
        if entry.access == Access::ReadOnly {
            return Err(AbortCode::READ_ONLY);
        }
        entry.parse(value)
    }

    /// The number in the bits `raw` of a PDO, if they are within the limits of the mapped `object`. It is not
    /// written yet.
    ///
    /// # Errors
    /// The abort code: no such object or subindex, out of limits.
    pub fn parse_raw(&self, object: ObjectAddress, raw: u64) -> Result<i64, AbortCode> {
        self.entry(object)?.parse_raw(raw)
    }

    /// Checks that `object` is `bits` long and may be mapped into a PDO of this direction.
    ///
    /// # Errors
    /// The abort code: no such object or subindex, or not mappable.
    pub fn check_mappable(
        &self,
        object: ObjectAddress,
        bits: u8,
        direction: PdoDirection,
    ) -> Result<(), AbortCode> {
        let entry = self.entry(object)?;
        // An object that an RPDO may write can also be sent in a TPDO, if it can be read.
        let readable = direction == PdoDirection::Transmit && entry.access == Access::ReadWrite;
        let mappable = entry.mappable.is_some_and(|allowed| allowed == direction || readable);
        if mappable && entry.data_type.bits() == Some(bits) {
            Ok(())
        } else {
            Err(AbortCode::NOT_MAPPABLE)
        }
    }

    /// Gives every object in this range of indices its power-on value.
    pub fn reset(&mut self, indices: RangeInclusive<u16>) {
        for (_, entry) in self.entries.iter_mut().filter(|(o, _)| indices.contains(&o.index)) {
            entry.value = entry.default;
        }
    }

    fn entry(&self, object: ObjectAddress) -> Result<&Entry, AbortCode> {
        match self.find(object) {
            Some(n) => Ok(&self.entries[n].1),
            None if self.entries.iter().any(|(other, _)| other.index == object.index) => {
                Err(AbortCode::NO_SUCH_SUBINDEX)
            }
            None => Err(AbortCode::NO_SUCH_OBJECT),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RW: ObjectAddress = ObjectAddress::new(0x607a, 0);
    const RO: ObjectAddress = ObjectAddress::new(0x6041, 0);
    const WO: ObjectAddress = ObjectAddress::new(0x2001, 0);
    const LIMITED: ObjectAddress = ObjectAddress::new(0x60c2, 1);
    const NAME: ObjectAddress = ObjectAddress::new(0x1008, 0);

    fn dictionary() -> ObjectDictionary {
        let mut target = Entry::new(DataType::Signed(32), Access::ReadWrite, -5);
        target.mappable = Some(PdoDirection::Receive);
        let mut status = Entry::new(DataType::Unsigned(16), Access::ReadOnly, 0x250);
        status.mappable = Some(PdoDirection::Transmit);
        let mut limited = Entry::new(DataType::Unsigned(8), Access::ReadWrite, 1);
        limited.limits = Some(1..=100);
        let command = Entry::new(DataType::Unsigned(8), Access::WriteOnly, 0);
        let entries = [
            (RW, target),
            (RO, status),
            (WO, command),
            (LIMITED, limited),
            (NAME, Entry::text("drive")),
        ];
        entries.into_iter().collect()
    }

    #[test]
    fn values_are_little_endian_of_their_own_length() {
        let dictionary = dictionary();
        assert_eq!(dictionary.read(RW), Ok(vec![0xfb, 0xff, 0xff, 0xff]));
        assert_eq!(dictionary.read(RO), Ok(vec![0x50, 0x02]));
        assert_eq!(dictionary.read(NAME), Ok(b"drive".to_vec()));
        assert_eq!(dictionary.parse(RW, (-2_i32).into()), Ok(-2));
        assert_eq!(dictionary.parse_raw(RW, 0xffff_fffe), Ok(-2));
    }

    #[test]
    fn refusals_have_the_code_of_the_standard() {
        let dictionary = dictionary();
        let absent = ObjectAddress::new(0x5000, 0);
        assert_eq!(dictionary.read(absent), Err(AbortCode::NO_SUCH_OBJECT));
        let sub = ObjectAddress::new(0x607a, 1);
        assert_eq!(dictionary.read(sub), Err(AbortCode::NO_SUCH_SUBINDEX));
        assert_eq!(dictionary.read(WO), Err(AbortCode::WRITE_ONLY));
        assert_eq!(dictionary.parse(RO, 0_u16.into()), Err(AbortCode::READ_ONLY));
        assert_eq!(dictionary.parse(LIMITED, 1_u16.into()), Err(AbortCode::LENGTH_TOO_HIGH));
        assert_eq!(dictionary.parse(RW, 0_u16.into()), Err(AbortCode::LENGTH_TOO_LOW));
        assert_eq!(dictionary.parse(LIMITED, 101_u8.into()), Err(AbortCode::VALUE_TOO_HIGH));
        assert_eq!(dictionary.parse(LIMITED, 0_u8.into()), Err(AbortCode::VALUE_TOO_LOW));
    }

    #[test]
    fn mapping_needs_direction_and_length() {
        let dictionary = dictionary();
        let (receive, transmit) = (PdoDirection::Receive, PdoDirection::Transmit);
        assert_eq!(dictionary.check_mappable(RW, 32, receive), Ok(()));
        assert_eq!(dictionary.check_mappable(RW, 32, transmit), Ok(()));
        assert_eq!(dictionary.check_mappable(RW, 16, receive), Err(AbortCode::NOT_MAPPABLE));
        assert_eq!(dictionary.check_mappable(RO, 16, receive), Err(AbortCode::NOT_MAPPABLE));
        assert_eq!(dictionary.check_mappable(NAME, 32, transmit), Err(AbortCode::NOT_MAPPABLE));
    }

    #[test]
    fn a_reset_restores_the_defaults_of_its_index_range() {
        let mut dictionary = dictionary();
        dictionary.set(RW, 7);
        dictionary.set(LIMITED, 300);
        assert_eq!(dictionary.integer(LIMITED), 44, "truncated to 8 bits");
        dictionary.reset(0x6070..=0x607f);
        assert_eq!((dictionary.integer(RW), dictionary.integer(LIMITED)), (-5, 44));
    }
}
