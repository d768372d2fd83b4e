//! Faults on any bus: a [`FaultyLine`] on each way, and the controller's reports by schedule.

use super::bus_error::BusError;
use super::can::{BusEvent, CanBus, CanError};
use crate::canopen::Frame;
use crate::canopen::faulty_line::{FaultyLine, FrameFault};
use crate::units::Time;
use std::time::Duration;

/// What goes wrong on a bus, seen from one endpoint.
#[derive(Debug, Clone, Default)]
pub struct BusFaults {
    /// On frames that the endpoint sends.
    pub sent: Vec<FrameFault>,
    /// On frames that it receives.
    pub received: Vec<FrameFault>,
    /// What its controller reports, and when.
    pub reports: Vec<(Time, BusError)>,
}

/// A bus on which `faults` happen; it stacks on any other.
///
/// What is late on its way out leaves during the next call that comes after its time: a caller
/// that waits in [`receive`](CanBus::receive) is on time. The kernel's stamps are not handed on: a
/// frame may have been held up here since.
pub struct FaultyBus<C> {
    bus: Box<dyn CanBus>,
    clock: C,
    sent: FaultyLine,
    received: FaultyLine,
    /// The next report last.
    reports: Vec<(Time, BusError)>,
}

impl<C: Fn() -> Time + Send> FaultyBus<C> {
    /// `faults` on `bus`, at the times of `clock`.
    pub fn new(bus: Box<dyn CanBus>, faults: BusFaults, clock: C) -> Self {
        let mut reports = faults.reports;
        reports.sort_by_key(|(due, _)| std::cmp::Reverse(*due));
        FaultyBus {
            bus,
            clock,
            sent: FaultyLine::new(faults.sent),
            received: FaultyLine::new(faults.received),
            reports,
        }
    }

    /// Sends what is due.
    fn flush(&mut self, now: Time) -> Result<(), CanError> {
        while let Some(frame) = self.sent.poll(now) {
            self.bus.send(&frame)?;
        }
        Ok(())
    }

    fn due_report(&mut self, now: Time) -> Option<BusError> {
        self.reports.pop_if(|(due, _)| *due <= now).map(|(_, error)| error)
    }
}

impl<C: Fn() -> Time + Send> CanBus for FaultyBus<C> {
    fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
        let now = (self.clock)();
        self.sent.handle(now, frame);
        self.flush(now)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError> {
        let end = (self.clock)() + timeout;
        loop {
            let now = (self.clock)();
            self.flush(now)?;
            if let Some(error) = self.due_report(now) {
                return Ok(Some(BusEvent::Error(error)));
            }
            if let Some(frame) = self.received.poll(now) {
                return Ok(Some(BusEvent::Frame(frame)));
            }
            let report = self.reports.last().map_or(Time::NEVER, |(due, _)| *due);
            let due = self.sent.deadline().min(self.received.deadline()).min(report);
            match self.bus.receive(due.min(end).since(now))? {
                Some(BusEvent::Frame(frame)) => self.received.handle((self.clock)(), &frame),
                Some(error) => return Ok(Some(error)),
                None if (self.clock)() >= end => {
                    // Due at the very end, or not at all.
                    return Ok(self.received.poll(end).map(BusEvent::Frame));
                }
                None => {}
            }
        }
    }

    fn report(&mut self, error: &BusError) -> Result<(), CanError> {
        self.bus.report(error)
    }

    fn name(&self) -> &str {
        self.bus.name()
    }

    fn dropped(&self) -> Result<u64, CanError> {
        self.bus.dropped()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::faulty_line::Harm;
    use crate::transport::memory::{MemoryBus, MemoryEndpoint};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicI64, Ordering};

    const AT_ONCE: Duration = Duration::ZERO;

    /// A clock that goes when it is told to.
    #[derive(Clone, Default)]
    struct Hand(Arc<AtomicI64>);

    impl Hand {
        fn set_ms(&self, ms: i64) {
            self.0.store(ms * 1_000_000, Ordering::Relaxed);
        }
    }

    fn bus(faults: BusFaults) -> (Box<dyn CanBus>, MemoryEndpoint, Hand) {
        let wire = MemoryBus::new();
        let hand = Hand::default();
        let clock = {
            let hand = hand.clone();
            move || Time::from_nanos(hand.0.load(Ordering::Relaxed))
        };
        (Box::new(FaultyBus::new(Box::new(wire.endpoint()), faults, clock)), wire.endpoint(), hand)
    }

    fn frame(number: u8) -> Frame {
        Frame::new(0x181, &[number])
    }

    #[test]
    fn without_faults_it_is_the_bus_below() {
        let (mut faulty, mut peer, _) = bus(BusFaults::default());
        faulty.send(&frame(1)).unwrap();
        assert_eq!(peer.receive(AT_ONCE).unwrap(), Some(BusEvent::Frame(frame(1))));
        peer.send(&frame(2)).unwrap();
        assert_eq!(faulty.receive(AT_ONCE).unwrap(), Some(BusEvent::Frame(frame(2))));
        assert_eq!(faulty.receive(AT_ONCE).unwrap(), None);
        assert_eq!(faulty.name(), "memory");
    }

    #[test]
    fn each_way_has_its_own_faults() {
        let late = Harm::Delay(Duration::from_millis(5));
        let (mut faulty, mut peer, hand) = bus(BusFaults {
            sent: vec![FrameFault::new(late, Time::ZERO)],
            received: vec![FrameFault::new(Harm::Duplicate, Time::ZERO)],
            reports: Vec::new(),
        });
        faulty.send(&frame(1)).unwrap();
        assert_eq!(peer.receive(AT_ONCE).unwrap(), None);
        peer.send(&frame(2)).unwrap();
        for _ in 0..2 {
            assert_eq!(faulty.receive(AT_ONCE).unwrap(), Some(BusEvent::Frame(frame(2))));
        }
        hand.set_ms(5);
        assert_eq!(faulty.receive(AT_ONCE).unwrap(), None);
        assert_eq!(peer.receive(AT_ONCE).unwrap(), Some(BusEvent::Frame(frame(1))));
    }

    #[test]
    fn reports_come_in_their_time() {
        let at = |ms: i64| Time::from_nanos(ms * 1_000_000);
        let warning = BusError::new(0x04, [0, 0x08, 0, 0, 0, 0, 0, 0]);
        let (mut faulty, _peer, hand) = bus(BusFaults {
            reports: vec![(at(20), BusError::bus_off()), (at(10), warning)],
            ..BusFaults::default()
        });
        let mut next = |ms| {
            hand.set_ms(ms);
            faulty.receive(AT_ONCE).unwrap()
        };
        assert_eq!(next(9), None);
        assert_eq!(next(25), Some(BusEvent::Error(warning)));
        assert_eq!(next(25), Some(BusEvent::Error(BusError::bus_off())));
        assert_eq!(next(25), None);
    }
}
