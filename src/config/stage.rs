//! `[can]` and `[stage]`: the bus and the two drives.

use std::fmt;

use serde::{Serialize, Serializer};

use super::reader::Section;
use super::rule::Range;
use crate::canopen::frame::NodeId;

/// `[can]`: the bus and the times of CANopen on it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CanConfig {
    /// Which bus.
    pub interface: CanInterface,
    /// Period of SYNC, ms.
    pub sync_ms: u16,
    /// The bench's own node number.
    #[serde(serialize_with = "node_number")]
    pub bench_node: NodeId,
    /// Period of the bench's and the drives' heartbeats, ms.
    pub heartbeat_ms: u16,
    /// A heartbeat missed for this long stops the run, ms.
    pub heartbeat_timeout_ms: u16,
    /// For the answer to one SDO request, ms.
    pub sdo_timeout_ms: u16,
    /// How often an SDO request is made before giving up.
    pub sdo_attempts: u8,
    /// For a drive to boot, s.
    pub boot_timeout_s: f64,
}

/// A CAN bus by its name.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum CanInterface {
    /// `memory`: inside this process, with the virtual stage on it.
    Memory,
    /// `udp`: python-can's `udp_multicast`, for tests where the kernel has no CAN.
    Udp,
    /// A network interface of Linux, such as `can0`.
    Socket(String),
}

impl CanInterface {
    /// True for a bus made for tests, which never drives a real stage.
    pub fn is_for_tests(&self) -> bool {
        matches!(self, CanInterface::Memory | CanInterface::Udp)
    }

    fn named(name: String) -> Self {
        match name.as_str() {
            "memory" => CanInterface::Memory,
            "udp" => CanInterface::Udp,
            _ => CanInterface::Socket(name),
        }
    }
}

impl fmt::Display for CanInterface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            CanInterface::Memory => "memory",
            CanInterface::Udp => "udp",
            CanInterface::Socket(name) => name,
        })
    }
}

impl Serialize for CanInterface {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// What Linux takes for the name of a network interface: under 16 bytes (IFNAMSIZ), no space, no
/// slash.
fn is_interface(name: &str) -> bool {
    (1..16).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'/')
}

impl CanConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        let interfaces = "\"memory\", \"udp\" or the name of a CAN interface such as \"can0\"";
        CanConfig {
            interface: CanInterface::named(s.text("interface", interfaces, is_interface)),
            sync_ms: s.integer("sync_ms", 1, 100),
            bench_node: s.node("bench_node"),
            heartbeat_ms: s.integer("heartbeat_ms", 5, 10_000),
            heartbeat_timeout_ms: s.integer("heartbeat_timeout_ms", 10, 60_000),
            sdo_timeout_ms: s.integer("sdo_timeout_ms", 10, 10_000),
            sdo_attempts: s.integer("sdo_attempts", 1, 20),
            boot_timeout_s: s.number("boot_timeout_s", Range::within(0.1, 120.0)),
        }
    }
}

/// `[stage]`: the two drives.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageConfig {
    /// True for a real stage.
    pub hardware: bool,
    /// `[stage.insertion]`.
    pub insertion: InsertionAxisConfig,
    /// `[stage.rotation]`.
    pub rotation: RotationAxisConfig,
}

impl StageConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        StageConfig {
            hardware: s.boolean("hardware"),
            insertion: s.section("insertion", InsertionAxisConfig::read),
            rotation: s.section("rotation", RotationAxisConfig::read),
        }
    }
}

/// `[stage.insertion]`: the axis that pushes the needle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InsertionAxisConfig {
    /// What both drives have.
    #[serde(flatten)]
    pub drive: DriveConfig,
    /// Scale.
    pub counts_per_mm: CountsPerMm,
    /// Soft limit, mm from the depth where the run starts.
    pub min_mm: f64,
    /// Soft limit, mm from the depth where the run starts.
    pub max_mm: f64,
    /// mm/s.
    pub speed_max_mm_per_s: f64,
    /// The drive's following-error window (6065), mm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub following_error_mm: Option<f64>,
    /// The drive's quick-stop deceleration (6085), mm/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quick_stop_deceleration_mm_per_s2: Option<f64>,
}

/// A scale as a ratio of integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct CountsPerMm {
    /// So many counts …
    pub counts: u32,
    /// … for so many mm.
    pub mm: u32,
}

impl InsertionAxisConfig {
    fn read(s: &mut Section<'_>) -> Self {
        InsertionAxisConfig {
            drive: DriveConfig::read(s),
            counts_per_mm: s.section("counts_per_mm", |s| CountsPerMm {
                counts: s.integer("counts", 1, u32::MAX),
                mm: s.integer("mm", 1, u32::MAX),
            }),
            min_mm: s.number("min_mm", Range::within(-1000.0, 0.0)),
            max_mm: s.number("max_mm", Range::over(0.0, 1000.0)),
            speed_max_mm_per_s: s.number("speed_max_mm_per_s", Range::over(0.0, 100.0)),
            following_error_mm: s.optional_number("following_error_mm", Range::over(0.0, 100.0)),
            quick_stop_deceleration_mm_per_s2: s
                .optional_number("quick_stop_deceleration_mm_per_s2", Range::over(0.0, 100_000.0)),
        }
    }
}

/// `[stage.rotation]`: the axis that turns the needle about its shaft.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RotationAxisConfig {
    /// What both drives have.
    #[serde(flatten)]
    pub drive: DriveConfig,
    /// Scale.
    pub counts_per_turn: CountsPerTurn,
    /// Soft limit, degrees from the angle where the run starts.
    pub min_deg: f64,
    /// Soft limit, degrees from the angle where the run starts.
    pub max_deg: f64,
    /// degrees/s.
    pub speed_max_deg_per_s: f64,
    /// The drive's following-error window (6065), degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub following_error_deg: Option<f64>,
    /// The drive's quick-stop deceleration (6085), degrees/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quick_stop_deceleration_deg_per_s2: Option<f64>,
}

/// A scale as a ratio of integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct CountsPerTurn {
    /// So many counts …
    pub counts: u32,
    /// … for so many turns.
    pub turns: u32,
}

impl RotationAxisConfig {
    fn read(s: &mut Section<'_>) -> Self {
        RotationAxisConfig {
            drive: DriveConfig::read(s),
            counts_per_turn: s.section("counts_per_turn", |s| CountsPerTurn {
                counts: s.integer("counts", 1, u32::MAX),
                turns: s.integer("turns", 1, u32::MAX),
            }),
            min_deg: s.number("min_deg", Range::within(-360_000.0, 0.0)),
            max_deg: s.number("max_deg", Range::within(0.0, 360_000.0)),
            speed_max_deg_per_s: s.number("speed_max_deg_per_s", Range::over(0.0, 36_000.0)),
            following_error_deg: s.optional_number("following_error_deg", Range::over(0.0, 3600.0)),
            quick_stop_deceleration_deg_per_s2: s.optional_number(
                "quick_stop_deceleration_deg_per_s2",
                Range::over(0.0, 10_000_000.0),
            ),
        }
    }
}

/// What `[stage.insertion]` and `[stage.rotation]` have in common.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DriveConfig {
    /// Its node number.
    #[serde(serialize_with = "node_number")]
    pub node: NodeId,
    /// Expected in 1018:1; `None` for any.
    #[serde(serialize_with = "identity")]
    pub vendor_id: Option<u32>,
    /// Expected in 1018:2; `None` for any.
    #[serde(serialize_with = "identity")]
    pub product_code: Option<u32>,
    /// 1, or -1 where the drive counts the other way.
    pub sign: i8,
    /// Objects that this drive may lack: the bring-up goes on without them.
    pub optional_objects: Vec<u16>,
    /// Resets a fault that stands when the run starts, once.
    pub fault_reset_on_start: bool,
    /// The drive's quick-stop option (605A).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quick_stop_option: Option<i16>,
    /// Written after the bench's own objects, in this order, before the drive is enabled.
    pub sdo: Vec<RawSdo>,
}

impl DriveConfig {
    fn read(s: &mut Section<'_>) -> Self {
        DriveConfig {
            node: s.node("node"),
            vendor_id: s.identity("vendor_id"),
            product_code: s.identity("product_code"),
            sign: s.integer_of("sign", &[1, -1], 1),
            optional_objects: s.integers("optional_objects", 0x1000, u16::MAX),
            fault_reset_on_start: s.boolean("fault_reset_on_start"),
            quick_stop_option: s.optional_integer("quick_stop_option", i16::MIN, i16::MAX),
            sdo: s.tables("sdo", "index, subindex, value, bits", RawSdo::read),
        }
    }
}

/// One object of a drive to write as it stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct RawSdo {
    /// Index.
    pub index: u16,
    /// Subindex.
    pub subindex: u8,
    /// Signed or unsigned: it fits `bits` as either.
    pub value: i64,
    /// 8, 16 or 32.
    pub bits: u8,
}

impl RawSdo {
    fn read(s: &mut Section<'_>) -> Self {
        let bits = s.integer_of("bits", &[8, 16, 32], 32u8);
        let (low, high) = (-(1i64 << (bits - 1)), (1i64 << bits) - 1);
        RawSdo {
            index: s.integer("index", 0x1000, u16::MAX),
            subindex: s.integer("subindex", 0, u8::MAX),
            value: s.integer("value", low, high),
            bits,
        }
    }

    /// The value as it goes into the frame: `bits / 8` bytes, little-endian.
    pub fn bytes(&self) -> Vec<u8> {
        self.value.to_le_bytes().into_iter().take(usize::from(self.bits / 8)).collect()
    }
}

fn node_number<S: Serializer>(node: &NodeId, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u8(node.get())
}

fn identity<S: Serializer>(identity: &Option<u32>, serializer: S) -> Result<S::Ok, S::Error> {
    match identity {
        Some(number) => serializer.serialize_u32(*number),
        None => serializer.serialize_str("any"),
    }
}
