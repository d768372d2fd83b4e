//! Electronic data sheets (CiA 306-1): an object dictionary as a file that tools read.

use std::fmt::{self, Write};

use super::object_dictionary::{
    Access, DataType, Description, Entry, ObjectDictionary, ObjectKind, Value,
};
use super::pdo::PdoDirection;
use super::{NodeId, ObjectAddress};

/// What an EDS says of the device, beside its objects.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EdsHeader {
    /// The file's own name.
    pub file_name: String,
    /// What it describes.
    pub description: String,
    /// The device's maker.
    pub vendor_name: String,
}

/// The data sheet of a device whose dictionary at node number `node` is `objects`.
///
/// Values are those at power-on. COB-IDs that follow the node number are written with `$NODEID`,
/// so that the sheet is right for every number. Every index is to be
/// [described](ObjectDictionary::describe); one that is not goes by its number.
pub fn write_eds(objects: &ObjectDictionary, node: NodeId, header: &EdsHeader) -> String {
    let mut eds = Eds { objects, node, text: String::new() };
    eds.head(header);
    let indices = eds.indices();
    let manufacturers = |index: &u16| (0x2000..=0x5fff).contains(index);
    let (own, standard): (Vec<u16>, Vec<u16>) = indices.iter().copied().partition(manufacturers);
    let is_mandatory = |index: &u16| MANDATORY.contains(index);
    let (mandatory, optional) = standard.into_iter().partition(is_mandatory);
    eds.list("MandatoryObjects", mandatory);
    eds.list("OptionalObjects", optional);
    eds.list("ManufacturerObjects", own);
    indices.iter().for_each(|index| eds.object(*index));
    eds.text
}

/// Objects that every device has (CiA 301, 7.5).
const MANDATORY: [u16; 3] = [0x1000, 0x1001, 0x1018];

struct Eds<'a> {
    objects: &'a ObjectDictionary,
    node: NodeId,
    text: String,
}

impl Eds<'_> {
    fn indices(&self) -> Vec<u16> {
        let mut indices: Vec<u16> = self.objects.entries.keys().map(|o| o.index).collect();
        indices.dedup();
        indices
    }

    /// One line; a `String` takes whatever is written to it.
    fn line(&mut self, line: fmt::Arguments<'_>) {
        let _ = self.text.write_fmt(line);
        self.text.push('\n');
    }

    fn head(&mut self, header: &EdsHeader) {
        let identity = |sub| self.objects.integer(ObjectAddress::new(0x1018, sub));
        let [vendor, product, revision] = [1, 2, 3].map(identity);
        let pdos = |first: u16| {
            let exists = |index: &u16| (first..first + 512).contains(index);
            self.indices().iter().filter(|index| exists(index)).count()
        };
        let (received, transmitted) = (pdos(0x1400), pdos(0x1800));
        let name = self.text_of(0x1008);
        let EdsHeader { file_name, description, vendor_name } = header;
        self.line(format_args!(
            "[FileInfo]\nFileName={file_name}\nFileVersion=1\nFileRevision=1\nEDSVersion=4.0\n\
             Description={description}\nCreationTime=12:00AM\nCreationDate=01-01-2026\n\
             CreatedBy=needle-bench\nModificationTime=12:00AM\nModificationDate=01-01-2026\n\
             ModifiedBy=needle-bench\n"
        ));
        self.line(format_args!(
            "[DeviceInfo]\nVendorName={vendor_name}\nVendorNumber=0x{vendor:08X}\n\
             ProductName={name}\nProductNumber=0x{product:08X}\nRevisionNumber=0x{revision:08X}\n\
             OrderCode=none"
        ));
        for kbit_per_s in [10, 20, 50, 125, 250, 500, 800, 1000] {
            self.line(format_args!("BaudRate_{kbit_per_s}=1"));
        }
        self.line(format_args!(
            "SimpleBootUpMaster=0\nSimpleBootUpSlave=1\nGranularity=8\n\
             DynamicChannelsSupported=0\nGroupMessaging=0\nNrOfRXPDO={received}\n\
             NrOfTXPDO={transmitted}\nLSS_Supported=0\n"
        ));
        self.line(format_args!("[DummyUsage]"));
        (1..=7).for_each(|data_type| self.line(format_args!("Dummy{data_type:04}=0")));
        self.line(format_args!("\n[Comments]\nLines=0\n"));
    }

    fn text_of(&self, index: u16) -> String {
        let bytes = self.objects.read(ObjectAddress::new(index, 0)).unwrap_or_default();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    fn list(&mut self, section: &str, indices: Vec<u16>) {
        self.line(format_args!("[{section}]\nSupportedObjects={}", indices.len()));
        for (n, index) in (1..).zip(indices) {
            self.line(format_args!("{n}=0x{index:04X}"));
        }
        self.line(format_args!(""));
    }

    fn object(&mut self, index: u16) {
        let all = ObjectAddress::new(index, 0)..=ObjectAddress::new(index, 255);
        let objects = self.objects;
        let entries: Vec<_> = objects.entries.range(all).collect();
        let nameless = Description {
            kind: if entries.len() > 1 { ObjectKind::Record } else { ObjectKind::Variable },
            name: format!("Object 0x{index:04X}"),
            members: Vec::new(),
        };
        let description = objects.descriptions.get(&index).unwrap_or(&nameless);
        let Description { kind, name, members } = description;
        self.line(format_args!("[{index:04X}]\nParameterName={name}"));
        if *kind != ObjectKind::Variable {
            let code = if *kind == ObjectKind::Array { 8 } else { 9 };
            self.line(format_args!("ObjectType=0x{code}\nSubNumber={}\n", entries.len()));
        }
        for (address, entry) in entries {
            let sub = address.subindex;
            if *kind != ObjectKind::Variable {
                let member = match sub.checked_sub(1).map(|n| members.get(usize::from(n))) {
                    None => "Highest sub-index supported".to_owned(),
                    Some(Some(member)) => (*member).to_owned(),
                    Some(None) => format!("{name} {sub}"),
                };
                self.line(format_args!("[{index:04X}sub{sub:X}]\nParameterName={member}"));
            }
            self.entry(*address, entry);
        }
    }

    fn entry(&mut self, address: ObjectAddress, entry: &Entry) {
        let data_type = data_type(entry.data_type);
        let access = access(entry);
        let mappable = u8::from(entry.mappable.is_some());
        let default = self.default(address, &entry.default);
        self.line(format_args!(
            "ObjectType=0x7\nDataType=0x{data_type:04X}\nAccessType={access}\n\
             DefaultValue={default}\nPDOMapping={mappable}"
        ));
        if let Some(limits) = &entry.limits {
            let (low, high) = (limits.start(), limits.end());
            self.line(format_args!("LowLimit={low}\nHighLimit={high}"));
        }
        self.line(format_args!(""));
    }

    fn default(&self, address: ObjectAddress, default: &Value) -> String {
        match default {
            Value::Text(text) => String::from_utf8_lossy(text).into_owned(),
            Value::Integer(value) if follows_node(address) => {
                let base = value - i64::from(self.node.get());
                format!("$NODEID+0x{base:X}")
            }
            Value::Integer(value) => value.to_string(),
        }
    }
}

/// True for a COB-ID whose power-on value is made of the node number.
fn follows_node(ObjectAddress { index, subindex }: ObjectAddress) -> bool {
    match index {
        0x1014 => true,
        0x1200 => subindex > 0,
        0x1400..=0x15ff | 0x1800..=0x19ff => subindex == 1,
        _ => false,
    }
}

/// The index of a data type (CiA 301, 7.4.7).
fn data_type(data_type: DataType) -> u8 {
    match data_type {
        DataType::I8 => 0x02,
        DataType::I16 => 0x03,
        DataType::I32 => 0x04,
        DataType::U8 => 0x05,
        DataType::U16 => 0x06,
        DataType::U32 => 0x07,
        DataType::Text => 0x09,
    }
}

/// The access type; of what can be read and written, with the PDO that carries it.
fn access(entry: &Entry) -> &'static str {
    match (entry.access, entry.mappable) {
        (Access::ReadOnly, _) => "ro",
        (Access::WriteOnly, _) => "wo",
        (Access::ReadWrite, None) => "rw",
        (Access::ReadWrite, Some(PdoDirection::Transmit)) => "rwr",
        (Access::ReadWrite, Some(PdoDirection::Receive)) => "rww",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sections of CiA 306-1 in the small: a variable, a record, a COB-ID that follows the node.
    #[test]
    fn a_small_sheet() {
        let mut objects = ObjectDictionary::new();
        let mut put = |index, sub, entry| objects.insert(ObjectAddress::new(index, sub), entry);
        put(0x1008, 0, Entry::text("a device"));
        put(0x1014, 0, Entry::new(DataType::U32, Access::ReadWrite, 0x85));
        put(0x607d, 0, Entry::new(DataType::U8, Access::ReadOnly, 2));
        let limit = Entry::new(DataType::I32, Access::ReadWrite, -5).limits(-10..=10);
        put(0x607d, 1, limit.mappable(PdoDirection::Receive));
        put(0x607d, 2, Entry::new(DataType::I32, Access::ReadWrite, 5));
        objects.describe(0x1014, ObjectKind::Variable, "COB-ID emergency", &[]);
        objects.describe(0x607d, ObjectKind::Array, "Software limit", &["Minimum"]);
        let header = EdsHeader {
            file_name: "device.eds".into(),
            description: "for a test".into(),
            vendor_name: "nobody".into(),
        };
        let eds = write_eds(&objects, NodeId::new(5).unwrap(), &header);
        for section in [
            "ProductName=a device\n",
            "[OptionalObjects]\nSupportedObjects=3\n1=0x1008\n2=0x1014\n3=0x607D\n",
            "[1014]\nParameterName=COB-ID emergency\nObjectType=0x7\nDataType=0x0007\n\
             AccessType=rw\nDefaultValue=$NODEID+0x80\nPDOMapping=0\n",
            "[607D]\nParameterName=Software limit\nObjectType=0x8\nSubNumber=3\n",
            "[607Dsub0]\nParameterName=Highest sub-index supported\n",
            "[607Dsub1]\nParameterName=Minimum\nObjectType=0x7\nDataType=0x0004\n\
             AccessType=rww\nDefaultValue=-5\nPDOMapping=1\nLowLimit=-10\nHighLimit=10\n",
            "[607Dsub2]\nParameterName=Software limit 2\n",
        ] {
            assert!(eds.contains(section), "{section}\nin\n{eds}");
        }
    }
}
