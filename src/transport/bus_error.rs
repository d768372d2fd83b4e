//! Error frames: reports of a CAN controller about itself and the wires.
//!
//! The kernel gives them to programs as frames with the layout of `linux/can/error.h`. They were never
//! on the bus. A [`BusError`] keeps all bits, including unknown ones, so that a log loses nothing.

use std::fmt;

/// One error frame. It may report several things at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct BusError {
    classes: u32,
    data: [u8; 8],
}

// Class bits in the identifier.
const CONTROLLER: u32 = 0x004;
const PROTOCOL: u32 = 0x008;
const BUS_OFF: u32 = 0x040;
const RESTARTED: u32 = 0x100;
const COUNTERS: u32 = 0x200;
/// All classes that the header defines.
const KNOWN: u32 = 0x3FF;
/// The identifier's 29 bits.
const CLASS_MASK: u32 = 0x1FFF_FFFF;

/// The classes that are printed by name only. The data has details for two of them, which are not
/// printed: arbitration lost (`data[0]`) and transceiver fault (`data[4]`).
const CLASSES: [(u32, &str); 7] = [
    (0x001, "transmit timeout"),
    (0x020, "no acknowledge (is another node on the bus?)"),
    (BUS_OFF, "bus off"),
    (0x080, "bus error"),
    (RESTARTED, "controller restarted"),
    (0x010, "transceiver fault"),
    (0x002, "arbitration lost"),
];

/// Bits of `data[1]`, the controller's state.
const CONTROLLER_STATES: [(u8, &str); 7] = [
    (0x01, "receive overflow"),
    (0x02, "transmit overflow"),
    (0x04, "error warning (receive)"),
    (0x08, "error warning (transmit)"),
    (0x10, "error passive (receive)"),
    (0x20, "error passive (transmit)"),
    (0x40, "error active again"),
];

/// Bits of `data[2]`, the protocol violation.
const VIOLATIONS: [(u8, &str); 8] = [
    (0x01, "single bit"),
    (0x02, "form"),
    (0x04, "bit stuffing"),
    (0x08, "dominant bit not sent"),
    (0x10, "recessive bit not sent"),
    (0x20, "overload"),
    (0x40, "active error announced"),
    (0x80, "on transmission"),
];

impl BusError {
    /// An error frame with these class bits and 8 data bytes. Bits of `classes` above the 29 of the
    /// identifier, such as the flags of a socket, are masked off.
    pub const fn new(classes: u32, data: [u8; 8]) -> Self {
        BusError { classes: classes & CLASS_MASK, data }
    }

    /// The controller has left the bus: nothing more is sent or received.
    pub const fn bus_off() -> Self {
        BusError::new(BUS_OFF, [0; 8])
    }

    /// The class bits.
    pub const fn classes(&self) -> u32 {
        self.classes
    }

    /// The data bytes.
    pub const fn data(&self) -> &[u8; 8] {
        &self.data
    }

    /// True when the controller has left the bus.
    pub const fn is_bus_off(&self) -> bool {
        self.classes & BUS_OFF != 0
    }

    /// True when the controller came back after bus off. Frames queued before may be sent now.
    pub const fn is_restarted(&self) -> bool {
        self.classes & RESTARTED != 0
    }

    /// The controller's transmit and receive error counters, if it reports them.
    pub const fn counters(&self) -> Option<(u8, u8)> {
        if self.classes & COUNTERS != 0 { Some((self.data[6], self.data[7])) } else { None }
    }
}

/// The names of all bits in `set`, or `none` when there are none.
fn names(table: &[(u8, &str)], set: u8, none: &str) -> String {
    let names: Vec<&str> =
        table.iter().filter(|(bit, _)| set & bit != 0).map(|(_, name)| *name).collect();
    if names.is_empty() { none.to_owned() } else { names.join(", ") }
}

/// Names all that is reported: `bus off; error counters: transmit 248, receive 0`.
impl fmt::Display for BusError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let has = |class| self.classes & class != 0;
        let mut parts: Vec<String> = CLASSES
            .iter()
            .filter(|(class, _)| has(*class))
            .map(|(_, name)| (*name).to_owned())
            .collect();
        if has(CONTROLLER) {
            parts.push(names(&CONTROLLER_STATES, self.data[1], "unspecified controller error"));
        }
        if has(PROTOCOL) {
            let violations = names(&VIOLATIONS, self.data[2], "unspecified");
            // The location codes are those of the SJA1000, CAN_ERR_PROT_LOC_* in the header.
            parts
                .push(format!("protocol violation: {violations} (location {:#04x})", self.data[3]));
        }
        if let Some((transmit, receive)) = self.counters() {
            parts.push(format!("error counters: transmit {transmit}, receive {receive}"));
        }
        let unknown = self.classes & !KNOWN;
        if unknown != 0 || self.classes == 0 {
            parts.push(format!("unknown error class {unknown:#x}"));
        }
        f.write_str(&parts.join("; "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The report of a controller that becomes error passive: both directions and the counters.
    const PASSIVE: BusError = BusError::new(0x204, [0, 0x30, 0, 0, 0, 0, 136, 128]);

    #[test]
    fn names_what_is_reported() {
        assert_eq!(BusError::bus_off().to_string(), "bus off");
        assert_eq!(
            PASSIVE.to_string(),
            "error passive (receive), error passive (transmit); \
             error counters: transmit 136, receive 128"
        );
        assert_eq!(
            BusError::new(0x08 | 0x80, [0, 0, 0x84, 0x08, 0, 0, 0, 0]).to_string(),
            "bus error; protocol violation: bit stuffing, on transmission (location 0x08)"
        );
        assert_eq!(BusError::new(0x4000, [0; 8]).to_string(), "unknown error class 0x4000");
        assert_eq!(BusError::new(0, [0; 8]).to_string(), "unknown error class 0x0");
    }

    #[test]
    fn bus_off_and_counters_are_read() {
        assert!(!PASSIVE.is_bus_off() && BusError::bus_off().is_bus_off());
        assert_eq!(PASSIVE.counters(), Some((136, 128)));
        assert_eq!(BusError::bus_off().counters(), None);
    }

    /// Compares with socketcan, another implementation of the same header.
    #[cfg(target_os = "linux")]
    mod against_socketcan {
        use super::*;
        use proptest::prelude::*;
        use socketcan::CanErrorFrame;

        proptest! {
            #[test]
            fn agrees(classes in 0..=CLASS_MASK, data: [u8; 8]) {
                let ours = BusError::new(classes, data);
                let theirs = CanErrorFrame::new_error(classes, &data).unwrap().into_error();
                prop_assert_eq!(ours.is_bus_off(), theirs.is_bus_off());
                prop_assert_eq!(ours.is_restarted(), theirs.is_restarted());
                prop_assert_eq!(ours.counters(), theirs.counters());
            }
        }
    }
}
