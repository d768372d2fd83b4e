//! One direction of a CAN line that loses, delays, repeats, reorders or changes frames on purpose.

use std::collections::VecDeque;
use std::time::Duration;

use super::{Fault, FaultKind};
use crate::canopen::{CanId, Frame};
use crate::units::Time;

/// A fault on a line.
#[derive(Debug, Clone)]
struct FrameFault {
    /// The fault; its count is the number of frames still to be affected.
    fault: Fault,
    /// The identifier of the frames it acts on; `None` for all frames.
    id: Option<CanId>,
    /// The fault acts before this time.
    until: Time,
}

impl FrameFault {
    fn acts_on(&self, now: Time, frame: &Frame) -> bool {
        now < self.until && self.fault.count != Some(0) && self.id.is_none_or(|id| id == frame.id())
    }
}

/// A line with its faults, sans-IO: [`handle`](Self::handle) each frame that is sent, drain
/// [`poll`](Self::poll), wait until [`deadline`](Self::deadline).
///
/// When several faults act on a frame, they act in the order in which they were added. A lost frame
/// ends the sequence.
#[derive(Debug, Clone, Default)]
pub(in crate::emulator) struct FaultyLine {
    faults: Vec<FrameFault>,
    /// Frames on their way with the time of their arrival, in the order of sending.
    in_flight: VecDeque<(Time, Frame)>,
    /// Reordered frames that wait for the next frame, and their delay after it.
    held: Vec<(Duration, Frame)>,
}

impl FaultyLine {
    /// Adds a fault after the others. It acts on the frames with this identifier, or on all, until `until`.
    pub(in crate::emulator) fn add(&mut self, fault: Fault, id: Option<CanId>, until: Time) {
        self.faults.push(FrameFault { fault, id, until });
    }

    /// Takes a frame that is sent at `now`.
    pub(in crate::emulator) fn handle(&mut self, now: Time, frame: &Frame) {
        let (mut changed, mut copies) = (*frame, 1);
        let (mut delay, mut is_held) = (Duration::ZERO, false);
        for FrameFault { fault, .. } in
            self.faults.iter_mut().filter(|fault| fault.acts_on(now, frame))
        {
            fault.count = fault.count.map(|count| count - 1);
            match fault.kind {
                FaultKind::Delay => delay += fault.delay.unwrap_or_default(),
                FaultKind::Duplicate => copies *= 2,
                // The frame after a held one passes.
                FaultKind::Reorder => is_held = self.held.is_empty(),
                FaultKind::Corrupt | FaultKind::Resize => changed = fault.altered(&changed),
                // Lost: dropped, or its node is off the bus.
                _ => {
                    copies = 0;
                    break;
                }
            }
        }
        for _ in 0..copies {
            if is_held {
                self.held.push((delay, changed));
            } else if delay.is_zero() {
                self.pass(now, changed);
            } else {
                self.in_flight.push_back((now + delay, changed));
            }
        }
    }

    /// The next frame that has arrived by `now`.
    pub(in crate::emulator) fn poll(&mut self, now: Time) -> Option<Frame> {
        let arrivals = self.in_flight.iter().map(|(due, _)| *due).enumerate();
        let (first, _) = arrivals.min_by_key(|(_, due)| *due).filter(|(_, due)| *due <= now)?;
        self.in_flight.remove(first).map(|(_, frame)| frame)
    }

    /// When [`poll`](Self::poll) next has a frame.
    pub(in crate::emulator) fn deadline(&self) -> Time {
        self.in_flight.iter().map(|(due, _)| *due).min().unwrap_or(Time::NEVER)
    }

    fn pass(&mut self, now: Time, frame: Frame) {
        self.in_flight.push_back((now, frame));
        self.in_flight.extend(self.held.drain(..).map(|(delay, held)| (now + delay, held)));
    }
}

impl Fault {
    /// `frame` with bits of a byte inverted, or of another length: cut off, or filled up with zeros.
    fn altered(&self, frame: &Frame) -> Frame {
        let (mut data, mut len) = ([0; 8], frame.data().len());
        data[..len].copy_from_slice(frame.data());
        match self.kind {
            FaultKind::Resize => len = usize::from(self.length.unwrap_or(0).min(8)),
            _ => {
                let (byte, mask) = (self.byte.unwrap_or(0), self.mask.unwrap_or(u8::MAX));
                data[..len].iter_mut().skip(byte.into()).take(1).for_each(|byte| *byte ^= mask);
            }
        }
        Frame::from_parts(frame.id(), frame.is_remote(), &data[..len]).unwrap_or(*frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::at_ms;
    use proptest::prelude::*;

    fn frame(number: u8) -> Frame {
        Frame::new(0x181, &[number, 0xFF])
    }

    /// The frames that arrive of frames 0 to 3, sent 10 ms apart, with the time in ms. The fault acts on frames 1
    /// and 2.
    fn arrivals(fault: &Fault) -> Vec<(i64, Vec<u8>)> {
        let mut line = FaultyLine::default();
        let mut arrivals = Vec::new();
        for ms in 0..60 {
            if ms == 10 {
                line.add(fault.clone(), None, at_ms(30));
            }
            if ms % 10 == 0 && ms < 40 {
                line.handle(at_ms(ms), &frame(ms as u8 / 10));
            }
            assert!(line.deadline() >= at_ms(ms), "no frame is overdue");
            while let Some(frame) = line.poll(at_ms(ms)) {
                arrivals.push((ms, frame.data().to_vec()));
            }
        }
        assert_eq!(line.deadline(), Time::NEVER);
        arrivals
    }

    #[test]
    fn each_line_fault_changes_the_frames_as_configured() {
        let once = |fault: Fault| arrivals(&Fault { count: Some(1), ..fault });
        let order = |arrivals: Vec<(i64, Vec<u8>)>| {
            arrivals.into_iter().map(|(ms, data)| (ms, data[0])).collect::<Vec<_>>()
        };
        assert_eq!(order(arrivals(&Fault::of(FaultKind::Drop))), [(0, 0), (30, 3)]);
        let delay = Some(Duration::from_millis(15));
        let late = Fault { delay, ..Fault::of(FaultKind::Delay) };
        assert_eq!(order(once(late)), [(0, 0), (20, 2), (25, 1), (30, 3)]);
        let twice = once(Fault::of(FaultKind::Duplicate));
        assert_eq!(order(twice), [(0, 0), (10, 1), (10, 1), (20, 2), (30, 3)]);
        let swapped = once(Fault::of(FaultKind::Reorder));
        assert_eq!(order(swapped), [(0, 0), (20, 2), (20, 1), (30, 3)]);
        let pairs = arrivals(&Fault::of(FaultKind::Reorder));
        assert_eq!(
            order(pairs),
            [(0, 0), (20, 2), (20, 1), (30, 3)],
            "frame 1 is not held until the fault ends"
        );
        let corrupt = |byte| Fault { byte, ..Fault::of(FaultKind::Corrupt) };
        let resize = |length| Fault { length, ..Fault::of(FaultKind::Resize) };
        let second = |fault| once(fault)[1].1.clone();
        assert_eq!(second(corrupt(None)), [0xFE, 0xFF]);
        assert_eq!(second(corrupt(Some(1))), [1, 0x00]);
        assert_eq!(second(corrupt(Some(2))), [1, 0xFF]);
        let bit_9 = Fault { mask: Some(0x02), ..corrupt(Some(1)) };
        assert_eq!(second(bit_9), [1, 0xFD]);
        assert_eq!(second(resize(Some(1))), [1]);
        assert_eq!(second(resize(Some(8))), [1, 0xFF, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn a_fault_acts_on_its_own_identifier_and_in_order() {
        let mut line = FaultyLine::default();
        let add = |line: &mut FaultyLine, kind, id: Option<u16>| {
            line.add(Fault::of(kind), id.map(CanId::Base), Time::NEVER);
        };
        add(&mut line, FaultKind::Drop, Some(0x182));
        line.handle(at_ms(0), &frame(7));
        assert_eq!(line.poll(at_ms(0)), Some(frame(7)));
        add(&mut line, FaultKind::Drop, Some(0x181));
        add(&mut line, FaultKind::Duplicate, None);
        line.handle(at_ms(0), &frame(7));
        assert_eq!(line.poll(at_ms(0)), None);
    }

    proptest! {
        /// Every frame arrives at once and in order.
        #[test]
        fn a_line_without_faults_changes_nothing(numbers: Vec<u8>) {
            let mut line = FaultyLine::default();
            for &number in &numbers {
                line.handle(at_ms(5), &frame(number));
            }
            let arrived: Vec<u8> =
                std::iter::from_fn(|| line.poll(at_ms(5))).map(|frame| frame.data()[0]).collect();
            prop_assert_eq!(arrived, numbers);
        }
    }
}
