//! A bus with a witness: everything that passes is shown to it.

use super::bus_error::BusError;
use super::can::{BusEvent, CanBus, CanError};
use crate::canopen::Frame;
use std::time::{Duration, SystemTime};

/// Which way something passed, seen from the endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// Put on the bus.
    Sent,
    /// Taken from it.
    Received,
}

/// A bus of which `witness` sees every event, once it was sent or received; it stacks on any
/// other. What the bus did not take is not shown.
pub struct RecordedBus<W> {
    bus: Box<dyn CanBus>,
    witness: W,
}

impl<W: FnMut(Way, &BusEvent) + Send> RecordedBus<W> {
    /// `bus`, seen by `witness`.
    pub fn new(bus: Box<dyn CanBus>, witness: W) -> Self {
        RecordedBus { bus, witness }
    }
}

impl<W: FnMut(Way, &BusEvent) + Send> CanBus for RecordedBus<W> {
    fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
        self.bus.send(frame)?;
        (self.witness)(Way::Sent, &BusEvent::Frame(*frame));
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError> {
        let event = self.bus.receive(timeout)?;
        event.iter().for_each(|event| (self.witness)(Way::Received, event));
        Ok(event)
    }

    fn received_at(&self) -> Option<SystemTime> {
        self.bus.received_at()
    }

    fn report(&mut self, error: &BusError) -> Result<(), CanError> {
        self.bus.report(error)?;
        (self.witness)(Way::Sent, &BusEvent::Error(*error));
        Ok(())
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
    use crate::transport::memory::MemoryBus;
    use std::sync::mpsc::channel;

    const AT_ONCE: Duration = Duration::ZERO;

    /// Sent and received frames and error reports, in the endpoint's order.
    #[test]
    fn the_witness_sees_what_the_endpoint_sees() {
        let wire = MemoryBus::new();
        let (seen, witness) = channel();
        let mut bus = RecordedBus::new(Box::new(wire.endpoint()), move |way, event: &BusEvent| {
            seen.send((way, *event)).unwrap();
        });
        let mut peer = wire.endpoint();
        let [there, back] = [0x601, 0x581].map(|id| Frame::new(id, &[1]));
        bus.send(&there).unwrap();
        peer.send(&back).unwrap();
        wire.report(BusError::bus_off());
        while bus.receive(AT_ONCE).unwrap().is_some() {}
        let expected = [
            (Way::Sent, BusEvent::Frame(there)),
            (Way::Received, BusEvent::Frame(back)),
            (Way::Received, BusEvent::Error(BusError::bus_off())),
        ];
        assert_eq!(witness.try_iter().collect::<Vec<_>>(), expected);
    }
}
