//! Process data objects (CiA 301, 7.2.2, 7.5.2.35 on): mapping, transmission types, identifiers.

use super::ObjectAddress;

/// Transmission type of a PDO that is sent, or acted upon, at every SYNC (CiA 301, tables 72 and 74).
pub const EVERY_SYNC: u8 = 1;

/// How many PDOs a node has in each direction. In this module `offset` is the PDO's number less 1.
pub const PDOS: u16 = 4;

/// The direction of a PDO, seen from the node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PdoDirection {
    /// The node receives it.
    Receive,
    /// The node sends it.
    Transmit,
}

impl PdoDirection {
    /// Index of the communication parameters of the PDO at `offset`: 0x1400 or 0x1800 on.
    pub const fn communication_index(self, offset: u16) -> u16 {
        match self {
            PdoDirection::Receive => 0x1400 + offset,
            PdoDirection::Transmit => 0x1800 + offset,
        }
    }

    /// Index of the mapping parameters of the PDO at `offset`: 0x1600 or 0x1A00 on.
    pub const fn mapping_index(self, offset: u16) -> u16 {
        self.communication_index(offset) + 0x200
    }
}

/// An entry of a PDO mapping: an object and how many of its bits are carried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct MappedObject {
    /// The object.
    pub object: ObjectAddress,
    /// Its length in bits, 1 to 64.
    pub bits: u8,
}

impl MappedObject {
    /// `bits` bits of the object `index:subindex`.
    pub const fn new(index: u16, subindex: u8, bits: u8) -> Self {
        MappedObject { object: ObjectAddress::new(index, subindex), bits }
    }

    /// The entry in the mapping parameters: from the highest bit on, index, subindex and length.
    pub const fn to_u32(self) -> u32 {
        (self.object.index as u32) << 16 | (self.object.subindex as u32) << 8 | self.bits as u32
    }

    /// Reads an entry of the mapping parameters.
    pub const fn from_u32(entry: u32) -> Self {
        MappedObject::new((entry >> 16) as u16, (entry >> 8) as u8, entry as u8)
    }

    const fn mask(self) -> u64 {
        if self.bits >= 64 { u64::MAX } else { (1 << self.bits) - 1 }
    }
}

/// The objects of a PDO, in order, least significant bit first.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PdoMapping {
    objects: Vec<MappedObject>,
}

impl PdoMapping {
    /// A mapping of these objects; `None` when the length of one is 0, or their sum exceeds the 64 bits of a
    /// frame.
    pub fn new(objects: impl Into<Vec<MappedObject>>) -> Option<Self> {
        let objects = objects.into();
        let bits: u32 = objects.iter().map(|object| u32::from(object.bits)).sum();
        let fits = bits <= 64 && objects.iter().all(|object| object.bits > 0);
        fits.then_some(PdoMapping { objects })
    }

    /// The objects, in order.
    pub fn objects(&self) -> &[MappedObject] {
        &self.objects
    }

    /// The PDO's length in bytes, 0 to 8.
    pub fn len_bytes(&self) -> usize {
        self.objects.iter().map(|object| usize::from(object.bits)).sum::<usize>().div_ceil(8)
    }

    /// The payload that carries `values`, in the order of the mapping. A value is truncated to its object's
    /// length, so a negative `i32` may be given `as u64`. Missing values are zero.
    pub fn pack(&self, values: impl IntoIterator<Item = u64>) -> Vec<u8> {
        let mut word = 0;
        let mut shift = 0;
        for (object, value) in self.objects.iter().zip(values) {
            word |= (value & object.mask()) << shift;
            shift += u32::from(object.bits);
        }
        word.to_le_bytes()[..self.len_bytes()].to_vec()
    }

    /// The values in `payload`, in the order of the mapping; bytes beyond the mapping are ignored. `None`
    /// when the payload is shorter than the mapping: no part of it may be used then.
    pub fn unpack(&self, payload: &[u8]) -> Option<Vec<(ObjectAddress, u64)>> {
        let needed = self.len_bytes();
        let used = payload.get(..needed)?;
        let mut word = [0; 8];
        word[..needed].copy_from_slice(used);
        let word = u64::from_le_bytes(word);
        let mut shift = 0;
        let value = |object: &MappedObject| {
            let value = word >> shift & object.mask();
            shift += u32::from(object.bits);
            (object.object, value)
        };
        Some(self.objects.iter().map(value).collect())
    }
}

/// The COB-ID entry of a PDO, subindex 1 of its communication parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct PdoCobId(pub u32);

impl PdoCobId {
    /// Bit 31: the PDO is off.
    pub const INVALID: u32 = 1 << 31;
    const NO_RTR: u32 = 1 << 30;
    const EXTENDED: u32 = 1 << 29;

    /// An enabled PDO on the base identifier `cob_id`, no remote requests.
    pub const fn enabled(cob_id: u16) -> Self {
        PdoCobId(Self::NO_RTR | cob_id as u32)
    }

    /// True when the PDO exists: bit 31 is clear.
    pub const fn is_valid(self) -> bool {
        self.0 & Self::INVALID == 0
    }

    /// The base identifier; `None` when bit 29 says that it is an extended one.
    pub const fn cob_id(self) -> Option<u16> {
        if self.0 & Self::EXTENDED != 0 { None } else { Some((self.0 & 0x7ff) as u16) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn mapping_entries_read_as_in_manuals() {
        assert_eq!(MappedObject::new(0x607a, 0, 32).to_u32(), 0x607a_0020);
        assert_eq!(MappedObject::from_u32(0x6040_0010), MappedObject::new(0x6040, 0, 16));
        assert_eq!(PdoDirection::Receive.mapping_index(1), 0x1601);
        assert_eq!(PdoDirection::Transmit.communication_index(3), 0x1803);
        assert_eq!(PdoDirection::Transmit.mapping_index(0), 0x1a00);
    }

    #[test]
    fn controlword_and_target_are_six_bytes() {
        let rpdo =
            PdoMapping::new([MappedObject::new(0x6040, 0, 16), MappedObject::new(0x607a, 0, 32)])
                .unwrap();
        let payload = rpdo.pack([0x0f, -2i32 as u64]);
        assert_eq!(payload, [0x0f, 0x00, 0xfe, 0xff, 0xff, 0xff]);
        let values = rpdo.unpack(&payload).unwrap();
        assert_eq!(values[1], (ObjectAddress::new(0x607a, 0), 0xffff_fffe));
        assert_eq!(rpdo.unpack(&payload[..5]), None);
        assert!(rpdo.unpack(&[0; 8]).is_some());
    }

    #[test]
    fn mappings_longer_than_a_frame_and_empty_objects_are_refused() {
        let object = MappedObject::new(0x607a, 0, 32);
        assert_eq!(PdoMapping::new([object; 3]), None);
        let empty = MappedObject::new(0x607a, 0, 0);
        assert_eq!(PdoMapping::new([empty]), None);
    }

    #[test]
    fn a_pdo_cob_id_entry_has_its_three_flags() {
        let entry = PdoCobId::enabled(0x185);
        assert_eq!(entry.0, 0x4000_0185);
        assert!(entry.is_valid() && entry.0 & 1 << 30 != 0);
        assert_eq!(entry.cob_id(), Some(0x185));
        assert!(!PdoCobId(0xc000_0185).is_valid());
        assert_eq!(PdoCobId(0x2123_4567).cob_id(), None);
    }

    proptest! {
        #[test]
        fn unpacking_undoes_packing(
            entries in proptest::collection::vec((prop_oneof![1u8..=16, 1u8..=64], any::<u64>()), 0..8),
        ) {
            let objects: Vec<_> =
                entries.iter().map(|(bits, _)| MappedObject::new(0x2000, 0, *bits)).collect();
            let Some(mapping) = PdoMapping::new(objects) else { return Ok(()) };
            let payload = mapping.pack(entries.iter().map(|(_, value)| *value));
            let packed: Vec<_> =
                entries.iter().map(|(bits, value)| value & (u64::MAX >> (64 - bits))).collect();
            let unpacked = mapping.unpack(&payload).unwrap();
            prop_assert_eq!(unpacked.iter().map(|(_, value)| *value).collect::<Vec<_>>(), packed);
        }
    }
}
