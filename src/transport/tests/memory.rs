//! A CAN bus inside one process, for tests and runs with real threads and no CAN in the kernel.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::canopen::Frame;
use crate::transport::can::{BusError, BusEvent, CanBus, CanError};

/// Capacity of an endpoint's receive queue. Further events are dropped and counted, as by a kernel's socket, which
/// holds some 280 frames by default.
const RECEIVE_QUEUE: usize = 512;

/// The bus. Each node gets an [endpoint](MemoryBus::endpoint).
#[derive(Debug, Clone, Default)]
pub(crate) struct MemoryBus {
    wire: Arc<Mutex<Wire>>,
}

#[derive(Debug, Default)]
struct Wire {
    taps: Vec<Tap>,
    taps_made: usize,
}

/// The wire's end of one endpoint.
#[derive(Debug)]
struct Tap {
    number: usize,
    events: SyncSender<BusEvent>,
    dropped: Arc<AtomicU64>,
}

impl MemoryBus {
    /// A bus without nodes.
    pub(crate) fn new() -> Self {
        MemoryBus::default()
    }

    /// A new node's connection. It receives what is sent from now on by all others.
    pub(crate) fn endpoint(&self) -> MemoryEndpoint {
        let (sender, events) = sync_channel(RECEIVE_QUEUE);
        let dropped = Arc::default();
        let number = self.with_wire(|wire| {
            let number = wire.taps_made;
            wire.taps_made += 1;
            wire.taps.push(Tap { number, events: sender, dropped: Arc::clone(&dropped) });
            number
        });
        MemoryEndpoint { bus: self.clone(), number, events, dropped }
    }

    /// Lets every endpoint receive `error`, as if its own controller had reported it.
    pub(crate) fn report(&self, error: BusError) {
        self.carry(BusEvent::Error(error), None);
    }

    /// Delivers `event` to all endpoints but `sender`. One lock covers all endpoints, so all see the same order.
    fn carry(&self, event: BusEvent, sender: Option<usize>) {
        self.with_wire(|wire| {
            wire.taps.retain(|tap| {
                if Some(tap.number) == sender {
                    return true;
                }
                match tap.events.try_send(event) {
                    Ok(()) => true,
                    Err(TrySendError::Full(_)) => {
                        tap.dropped.fetch_add(1, Ordering::Relaxed);
                        true
                    }
                    Err(TrySendError::Disconnected(_)) => false,
                }
            });
        });
    }

    /// No action leaves the wire half changed, so a lock that a panic poisoned can be used.
    fn with_wire<T>(&self, action: impl FnOnce(&mut Wire) -> T) -> T {
        action(&mut self.wire.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// One node's connection to a [`MemoryBus`].
#[derive(Debug)]
pub(crate) struct MemoryEndpoint {
    bus: MemoryBus,
    number: usize,
    events: Receiver<BusEvent>,
    dropped: Arc<AtomicU64>,
}

impl CanBus for MemoryEndpoint {
    fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
        self.bus.carry(BusEvent::Frame(*frame), Some(self.number));
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError> {
        match self.events.recv_timeout(timeout) {
            Ok(event) => Ok(Some(event)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            // The wire holds the other end as long as `self.bus` lives.
            Err(RecvTimeoutError::Disconnected) => Err(CanError::Gone(self.name().to_owned())),
        }
    }

    fn report(&mut self, error: &BusError) -> Result<(), CanError> {
        self.bus.carry(BusEvent::Error(*error), Some(self.number));
        Ok(())
    }

    fn name(&self) -> &str {
        "memory"
    }

    fn dropped(&self) -> Option<u64> {
        Some(self.dropped.load(Ordering::Relaxed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread;

    const LONG: Duration = Duration::from_secs(10);
    const AT_ONCE: Duration = Duration::ZERO;

    #[test]
    fn a_frame_reaches_all_others_and_not_its_sender() {
        let bus = MemoryBus::new();
        let (mut a, mut b, mut c) = (bus.endpoint(), bus.endpoint(), bus.endpoint());
        let frame = Frame::new(0x80, &[]);
        a.send(&frame).unwrap();
        assert_eq!(b.receive(AT_ONCE).unwrap(), Some(BusEvent::Frame(frame)));
        assert_eq!(c.receive(AT_ONCE).unwrap(), Some(BusEvent::Frame(frame)));
        assert_eq!(a.receive(AT_ONCE).unwrap(), None);
    }

    #[test]
    fn frames_pass_between_two_threads() {
        let bus = MemoryBus::new();
        let (mut master, mut drive) = (bus.endpoint(), bus.endpoint());
        let echo = thread::spawn(move || {
            while let Some(BusEvent::Frame(frame)) = drive.receive(LONG).unwrap() {
                if frame.data().is_empty() {
                    break;
                }
                drive.send(&frame).unwrap();
            }
        });
        for byte in 0..=255 {
            let frame = Frame::new(0x181, &[byte]);
            master.send(&frame).unwrap();
            assert_eq!(master.receive(LONG).unwrap(), Some(BusEvent::Frame(frame)));
        }
        master.send(&Frame::new(0x181, &[])).unwrap();
        echo.join().unwrap();
    }

    #[test]
    fn frames_of_concurrent_senders_have_one_order_for_all() {
        let bus = MemoryBus::new();
        let mut listeners = [bus.endpoint(), bus.endpoint()];
        let senders: Vec<_> = (1..=4)
            .map(|id| {
                let mut node = bus.endpoint();
                thread::spawn(move || {
                    (0..50).for_each(|byte| node.send(&Frame::new(id, &[byte])).unwrap());
                })
            })
            .collect();
        senders.into_iter().for_each(|sender| sender.join().unwrap());
        let [first, second] = listeners.each_mut().map(|listener| {
            let seen = std::iter::from_fn(|| listener.receive(AT_ONCE).unwrap());
            seen.collect::<Vec<_>>()
        });
        assert_eq!(first.len(), 200);
        assert_eq!(first, second);
    }

    #[test]
    fn frames_not_received_in_time_are_dropped_and_counted() {
        let bus = MemoryBus::new();
        let (mut sender, mut sleeper) = (bus.endpoint(), bus.endpoint());
        let frame = Frame::new(0x80, &[]);
        (0..RECEIVE_QUEUE + 3).for_each(|_| sender.send(&frame).unwrap());
        assert_eq!(sleeper.dropped().unwrap(), 3);
        let received = std::iter::from_fn(|| sleeper.receive(AT_ONCE).unwrap()).count();
        assert_eq!(received, RECEIVE_QUEUE);
    }

    #[test]
    fn an_error_report_reaches_every_endpoint() {
        let bus = MemoryBus::new();
        let (mut a, mut b, dropped) = (bus.endpoint(), bus.endpoint(), bus.endpoint());
        drop(dropped);
        bus.report(BusError::bus_off());
        for endpoint in [&mut a, &mut b] {
            let event = endpoint.receive(AT_ONCE).unwrap();
            assert_eq!(event, Some(BusEvent::Error(BusError::bus_off())));
        }
    }
}
