//! `can.log`: every frame in the format of `candump -L -x`.

use crate::canopen::Frame;
use crate::session::Direction;
use crate::units::Time;
use std::fmt;

/// A line of `can.log`, as `candump -L -x` writes it: `(1700000000.123456) vcan0 601#2F60600008000000 T`.
///
/// The stamp is UTC in seconds with six decimals, as canplayer requires. The last letter is the direction
/// as seen from the bench: `T` sent, `R` received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CandumpLine<'a> {
    /// UTC, µs since 1970.
    pub unix_us: i64,
    /// Name of the CAN interface.
    pub interface: &'a str,
    /// Sent or received, as seen from the bench.
    pub direction: Direction,
    /// The frame.
    pub frame: Frame,
}

/// UTC of `time`, µs since 1970, rounded down. The run began at `started_unix_us`, in the same unit.
pub fn unix_us(started_unix_us: i64, time: Time) -> i64 {
    started_unix_us.saturating_add(time.as_nanos().div_euclid(1000))
}

impl fmt::Display for CandumpLine<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (s, us) = (self.unix_us.div_euclid(1_000_000), self.unix_us.rem_euclid(1_000_000));
        let direction = match self.direction {
            Direction::Sent => 'T',
            Direction::Received => 'R',
        };
        write!(f, "({s:010}.{us:06}) {} {} {direction}", self.interface, self.frame)
    }
}

impl<'a> CandumpLine<'a> {
    /// The time of the frame on the time line of a run that began at `started_unix_us`, UTC in µs since 1970.
    pub fn time(&self, started_unix_us: i64) -> Time {
        Time::from_nanos(self.unix_us.saturating_sub(started_unix_us).saturating_mul(1000))
    }

    /// Parses a line; `None` for any other text.
    pub fn parse(line: &'a str) -> Option<Self> {
        let mut words = line.split(' ');
        let stamp = words.next()?.strip_prefix('(')?.strip_suffix(')')?;
        let (s, us) = stamp.split_once('.')?;
        let (s, us): (i64, i64) = (s.parse().ok()?, us.parse().ok().filter(|_| us.len() == 6)?);
        let (interface, frame) = (words.next()?, Frame::parse(words.next()?)?);
        let direction = match (words.next()?, words.next()) {
            ("T", None) => Direction::Sent,
            ("R", None) => Direction::Received,
            _ => return None,
        };
        let unix_us = s.checked_mul(1_000_000)?.checked_add(us)?;
        Some(CandumpLine { unix_us, interface, direction, frame })
    }
}

/// `bus` as an interface name: no white space, at most 15 bytes (Linux IFNAMSIZ).
pub fn interface_name(bus: &str) -> String {
    let name: String = bus.chars().filter(|c| c.is_ascii_graphic()).take(15).collect();
    if name.is_empty() { "can".to_owned() } else { name }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::CanId;

    fn line(time_ns: i64, direction: Direction, frame: Frame) -> String {
        let unix_us = unix_us(1_700_000_000_000_000, Time::from_nanos(time_ns));
        CandumpLine { unix_us, interface: "vcan0", direction, frame }.to_string()
    }

    /// Do not edit: python-can and canplayer read these lines.
    #[test]
    fn lines_are_frozen() {
        let sdo = Frame::new(0x601, &[0x2F, 0x60, 0x60, 0, 8, 0, 0, 0]);
        assert_eq!(
            line(123_456_000, Direction::Sent, sdo),
            "(1700000000.123456) vcan0 601#2F60600008000000 T"
        );
        assert_eq!(
            line(1_000_000_999, Direction::Received, Frame::new(0x80, &[])),
            "(1700000001.000000) vcan0 080# R"
        );
        let extended = Frame::from_parts(CanId::Extended(0x1234), false, &[1]).unwrap();
        assert_eq!(
            line(-1_000, Direction::Received, extended),
            "(1699999999.999999) vcan0 00001234#01 R"
        );
    }

    #[test]
    fn lines_are_read_back() {
        let frame = Frame::new(0x601, &[0x2F, 0x60]);
        let text = line(123_456_000, Direction::Sent, frame);
        let (unix_us, interface) = (1_700_000_000_123_456, "vcan0");
        let expected = CandumpLine { unix_us, interface, direction: Direction::Sent, frame };
        assert_eq!(CandumpLine::parse(&text), Some(expected));
        assert_eq!(expected.time(1_700_000_000_000_000), Time::from_nanos(123_456_000));
        for broken in ["", "(1.5) vcan0 080# R", "(1.000000) vcan0 080#", "(1.000000) vcan0 08# R"]
        {
            assert_eq!(CandumpLine::parse(broken), None, "{broken}");
        }
        assert_eq!(CandumpLine::parse("(1.000000) vcan0 080# T x"), None);
    }

    #[test]
    fn any_bus_gives_an_interface_name() {
        assert_eq!(interface_name("vcan0"), "vcan0");
        assert_eq!(interface_name("udp 239.74.163.2:43113"), "udp239.74.163.2");
        assert_eq!(interface_name("\n"), "can");
    }
}
