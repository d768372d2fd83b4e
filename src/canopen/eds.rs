//! Electronic data sheets (EDS, CiA 306-1): files that describe a device's objects to CANopen tools.

use std::fmt;

use super::object_dictionary::{Access, DataType, Entry, ObjectDictionary};
use super::pdo::PdoDirection;
use super::{NodeId, ObjectAddress};

/// A data sheet: its sections, in the order of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Eds {
    sections: Vec<Section>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Section {
    name: String,
    /// Keys and values, in the order of the file.
    keys: Vec<(String, String)>,
}

impl Eds {
    /// Reads the text of a data sheet. Lines that are neither a section nor a key are left out.
    pub fn parse(text: &str) -> Self {
        let mut sections: Vec<Section> = Vec::new();
        for line in text.lines() {
            if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
                sections.push(Section { name: name.to_owned(), keys: Vec::new() });
            } else if let (Some(section), Some((key, value))) =
                (sections.last_mut(), line.split_once('='))
            {
                section.keys.push((key.to_owned(), value.to_owned()));
            }
        }
        Eds { sections }
    }

    /// Changes the value of a key. A key that the sheet does not have is not added.
    pub fn set(&mut self, section: &str, key: &str, value: impl fmt::Display) {
        let keys = self.sections.iter_mut().filter(|s| s.name == section).flat_map(|s| &mut s.keys);
        for (_, old) in keys.filter(|(name, _)| name == key) {
            *old = value.to_string();
        }
    }

    /// Adds `object` as a number (UNSIGNED8, 16 or 32, by `bits`) that can be read and written, unless the
    /// sheet has it.
    pub fn add_number(&mut self, object: ObjectAddress, bits: u8) {
        if self.sections.iter().any(|section| section.object() == Some(object)) {
            return;
        }
        let data_type = match bits {
            8 => "0x0005",
            16 => "0x0006",
            _ => "0x0007",
        };
        let keys = [("DataType", data_type), ("AccessType", "rw"), ("DefaultValue", "0")];
        let keys = keys.map(|(key, value)| (key.to_owned(), value.to_owned())).to_vec();
        let name = format!("{:04X}sub{:X}", object.index, object.subindex);
        self.sections.push(Section { name, keys });
    }

    /// Removes a section, such as `1800sub5`.
    pub fn remove_section(&mut self, name: &str) {
        self.sections.retain(|section| section.name != name);
    }

    /// Removes an optional object: its sections and its line in the list of optional objects.
    pub fn remove_object(&mut self, index: u16) {
        self.sections.retain(|section| section.object().is_none_or(|object| object.index != index));
        let removed = format!("0x{index:04X}");
        let lists = self.sections.iter_mut().filter(|section| section.name == "OptionalObjects");
        for keys in lists.map(|section| &mut section.keys) {
            keys.retain(|(_, value)| *value != removed);
            let count = keys.len().saturating_sub(1);
            for (n, (key, value)) in keys.iter_mut().enumerate() {
                // The value of the first key is the number of objects.
                if n == 0 { *value = count.to_string() } else { *key = n.to_string() }
            }
        }
    }

    /// The objects, with their values at power-on, of a device with the node number `node`.
    pub fn objects(&self, node: NodeId) -> ObjectDictionary {
        let entry = |section: &Section| Some((section.object()?, section.entry(node)?));
        self.sections.iter().filter_map(entry).collect()
    }
}

/// The text of the data sheet.
impl fmt::Display for Eds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Section { name, keys } in &self.sections {
            writeln!(f, "[{name}]")?;
            keys.iter().try_for_each(|(key, value)| writeln!(f, "{key}={value}"))?;
            writeln!(f)?;
        }
        Ok(())
    }
}

impl Section {
    fn get(&self, key: &str) -> Option<&str> {
        self.keys.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_str())
    }

    /// The object that the section describes: `6064` or `607Dsub1`, both in hexadecimal.
    fn object(&self) -> Option<ObjectAddress> {
        let (index, subindex) = self.name.split_once("sub").unwrap_or((&self.name, "0"));
        let index = u16::from_str_radix(index, 16).ok()?;
        Some(ObjectAddress::new(index, u8::from_str_radix(subindex, 16).ok()?))
    }

    /// The value that the section describes; `None` for a section that has no value of its own.
    fn entry(&self, node: NodeId) -> Option<Entry> {
        let number = |key| parse_integer(self.get(key)?, node);
        let data_type = DataType::from_index(number("DataType")?)?;
        let mappable = number("PDOMapping") == Some(1);
        let (access, direction) = match self.get("AccessType")? {
            "ro" | "const" => (Access::ReadOnly, PdoDirection::Transmit),
            "wo" => (Access::WriteOnly, PdoDirection::Receive),
            "rwr" => (Access::ReadWrite, PdoDirection::Transmit),
            _ => (Access::ReadWrite, PdoDirection::Receive),
        };
        let mut entry = match data_type {
            DataType::Text => Entry::text(self.get("DefaultValue")?),
            _ => Entry::new(data_type, access, number("DefaultValue")?),
        };
        entry.mappable = mappable.then_some(direction);
        entry.limits = number("LowLimit").zip(number("HighLimit")).map(|(low, high)| low..=high);
        Some(entry)
    }
}

/// A decimal or hexadecimal number. `$NODEID+0x80` is the sum of the node number and 0x80.
fn parse_integer(text: &str, node: NodeId) -> Option<i64> {
    if let Some(offset) = text.strip_prefix("$NODEID+") {
        return Some(parse_integer(offset, node)? + i64::from(node.get()));
    }
    match text.strip_prefix("0x") {
        Some(digits) => i64::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::sdo::AbortCode;

    const NODE: NodeId = NodeId::new(5).unwrap();
    const EDS: &str = "\
[OptionalObjects]
SupportedObjects=3
1=0x1008
2=0x1014
3=0x607D

[1008]
DataType=0x0009
AccessType=ro
DefaultValue=a device
PDOMapping=0

[1014]
ParameterName=COB-ID emergency
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x80
PDOMapping=0

[607D]
ParameterName=Software position limit
ObjectType=0x8
SubNumber=2

[607Dsub0]
DataType=0x0005
AccessType=ro
DefaultValue=1
PDOMapping=0

[607Dsub1]
DataType=0x0004
AccessType=rww
DefaultValue=-5
PDOMapping=1
LowLimit=-10
HighLimit=10

";

    fn limit() -> ObjectAddress {
        ObjectAddress::new(0x607d, 1)
    }

    #[test]
    fn an_eds_is_written_as_it_was_read() {
        assert_eq!(Eds::parse(EDS).to_string(), EDS);
    }

    #[test]
    fn values_have_type_access_limits_and_mapping() {
        let objects = Eds::parse(EDS).objects(NODE);
        assert_eq!(objects.read(ObjectAddress::new(0x1008, 0)).unwrap(), b"a device");
        assert_eq!(objects.integer(ObjectAddress::new(0x1014, 0)), 0x85);
        assert_eq!(objects.read(limit()).unwrap(), (-5i32).to_le_bytes());
        assert_eq!(objects.parse(limit(), 11_i32.into()), Err(AbortCode::VALUE_TOO_HIGH));
        assert!(objects.check_mappable(limit(), 32, PdoDirection::Receive).is_ok());
        let count = ObjectAddress::new(0x607d, 0);
        assert_eq!(objects.parse(count, 2_u8.into()), Err(AbortCode::READ_ONLY));
    }

    #[test]
    fn a_value_can_be_set_and_an_object_removed() {
        let mut eds = Eds::parse(EDS);
        eds.set("607Dsub1", "DefaultValue", 7);
        eds.set("607Dsub1", "NoSuchKey", 7);
        eds.remove_object(0x1008);
        assert_eq!(eds.objects(NODE).integer(limit()), 7);
        let text = eds.to_string();
        assert!(
            text.starts_with("[OptionalObjects]\nSupportedObjects=2\n1=0x1014\n2=0x607D\n\n[1014]")
        );
        assert!(!text.contains("NoSuchKey"), "{text}");
        eds.remove_section("607Dsub1");
        assert_eq!(eds.objects(NODE).read(limit()), Err(AbortCode::NO_SUCH_SUBINDEX));
    }
}
