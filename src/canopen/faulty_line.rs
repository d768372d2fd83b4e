//! A wire on which things go wrong on purpose: frames lost, late, doubled, swapped, changed.
//!
//! Pure, so that the same faults strike in virtual time and on a real bus.

use super::{CanId, Frame};
use crate::units::Time;
use std::collections::VecDeque;
use std::time::Duration;

/// What becomes of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Harm {
    /// It is lost.
    Drop,
    /// It arrives so much later; frames behind it pass it.
    Delay(Duration),
    /// It arrives twice.
    Duplicate,
    /// It is held until the next frame has passed it; with none behind it, it is lost.
    Reorder,
    /// Bits of one byte change, past the CRC. A frame without this byte passes unharmed.
    Corrupt {
        /// Which byte, from 0.
        byte: u8,
        /// The bits that change.
        bits: u8,
    },
    /// Its length changes: cut off, or filled up with zeros. Lengths over 8 are taken for 8.
    Resize(u8),
}

/// One fault: what happens to which frames, and when.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameFault {
    /// What becomes of them.
    pub harm: Harm,
    /// The identifier of the frames that it strikes; all frames without one.
    pub id: Option<CanId>,
    /// When it begins.
    pub from: Time,
    /// When it is over: frames at this time pass unharmed. [`Time::NEVER`] for good.
    pub until: Time,
    /// The most frames it strikes; any number without one.
    pub count: Option<u32>,
}

impl FrameFault {
    /// `harm` to every frame from `from` on, for good.
    pub const fn new(harm: Harm, from: Time) -> Self {
        FrameFault { harm, id: None, from, until: Time::NEVER, count: None }
    }

    fn strikes(&self, now: Time, frame: &Frame) -> bool {
        (self.from..self.until).contains(&now)
            && self.count != Some(0)
            && self.id.is_none_or(|id| id == frame.id())
    }
}

/// One direction of a wire with faults on it, sans-IO: [`handle`](Self::handle) each frame that
/// goes in, drain [`poll`](Self::poll), wait until [`deadline`](Self::deadline).
///
/// Of several faults that strike a frame each does its part, in the order in which they were added;
/// what is lost is lost.
#[derive(Debug, Clone, Default)]
pub struct FaultyLine {
    faults: Vec<FrameFault>,
    /// What leaves, in the order in which it went in, with the time at which it is due.
    under_way: VecDeque<(Time, Frame)>,
    /// What waits for the next frame to pass, and how late it is then.
    held: Vec<(Duration, Frame)>,
}

impl FaultyLine {
    /// Adds a fault behind the others.
    pub fn add(&mut self, fault: FrameFault) {
        self.faults.push(fault);
    }

    /// Takes a frame that goes in at `now`.
    pub fn handle(&mut self, now: Time, frame: &Frame) {
        let (mut changed, mut copies) = (*frame, 1);
        let (mut late, mut held) = (Duration::ZERO, false);
        for fault in self.faults.iter_mut().filter(|fault| fault.strikes(now, frame)) {
            fault.count = fault.count.map(|left| left - 1);
            match fault.harm {
                Harm::Drop => {
                    copies = 0;
                    break;
                }
                Harm::Delay(delay) => late += delay,
                Harm::Duplicate => copies *= 2,
                Harm::Reorder => held = true,
                Harm::Corrupt { byte, bits } => changed = corrupted(&changed, byte, bits),
                Harm::Resize(len) => changed = resized(&changed, len),
            }
        }
        for _ in 0..copies {
            if held {
                self.held.push((late, changed));
            } else if late.is_zero() {
                self.pass(now, changed);
            } else {
                self.under_way.push_back((now + late, changed));
            }
        }
    }

    /// The next frame to arrive at `now`; `None` when none is due.
    pub fn poll(&mut self, now: Time) -> Option<Frame> {
        let due = self.under_way.iter().map(|(due, _)| *due).min().filter(|due| *due <= now)?;
        let at = self.under_way.iter().position(|(at, _)| *at == due)?;
        self.under_way.remove(at).map(|(_, frame)| frame)
    }

    /// When [`poll`](Self::poll) next has a frame.
    pub fn deadline(&self) -> Time {
        self.under_way.iter().map(|(due, _)| *due).min().unwrap_or(Time::NEVER)
    }

    fn pass(&mut self, now: Time, frame: Frame) {
        self.under_way.push_back((now, frame));
        self.under_way.extend(self.held.drain(..).map(|(late, held)| (now + late, held)));
    }
}

/// `frame` with `bits` of data byte number `byte` inverted.
fn corrupted(frame: &Frame, byte: u8, bits: u8) -> Frame {
    let mut data = [0; 8];
    let data = &mut data[..frame.data().len()];
    data.copy_from_slice(frame.data());
    if let Some(byte) = data.get_mut(usize::from(byte)) {
        *byte ^= bits;
    }
    Frame::from_parts(frame.id(), frame.is_remote(), data).unwrap_or(*frame)
}

/// `frame` with `len` bytes of data.
fn resized(frame: &Frame, len: u8) -> Frame {
    let mut data = [0; 8];
    data.iter_mut().zip(frame.data()).for_each(|(to, from)| *to = *from);
    let data = &data[..usize::from(len.min(8))];
    Frame::from_parts(frame.id(), frame.is_remote(), data).unwrap_or(*frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn line(fault: FrameFault) -> FaultyLine {
        FaultyLine { faults: vec![fault], ..FaultyLine::default() }
    }

    fn frame(number: u8) -> Frame {
        Frame::new(0x181, &[number, 0xFF])
    }

    fn at(ms: i64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    /// What arrives, and when in ms, of frames 0 to 3 sent 10 ms apart.
    fn arrivals(fault: FrameFault) -> Vec<(i64, Vec<u8>)> {
        let mut line = line(fault);
        let mut arrivals = Vec::new();
        for ms in 0..60 {
            if ms % 10 == 0 && ms < 40 {
                line.handle(at(ms), &frame(ms as u8 / 10));
            }
            assert!(line.deadline() >= at(ms), "nothing is forgotten");
            while let Some(frame) = line.poll(at(ms)) {
                arrivals.push((ms, frame.data().to_vec()));
            }
        }
        assert_eq!(line.deadline(), Time::NEVER);
        arrivals
    }

    /// `harm` done to frames 1 and 2 at most.
    fn to_the_middle(harm: Harm) -> FrameFault {
        FrameFault { until: at(30), ..FrameFault::new(harm, at(10)) }
    }

    #[test]
    fn each_harm_is_what_it_says() {
        let once = |harm| arrivals(FrameFault { count: Some(1), ..to_the_middle(harm) });
        let order = |arrivals: Vec<(i64, Vec<u8>)>| {
            arrivals.into_iter().map(|(ms, data)| (ms, data[0])).collect::<Vec<_>>()
        };
        assert_eq!(order(arrivals(to_the_middle(Harm::Drop))), [(0, 0), (30, 3)]);
        let late = Harm::Delay(Duration::from_millis(15));
        assert_eq!(order(once(late)), [(0, 0), (20, 2), (25, 1), (30, 3)]);
        assert_eq!(order(once(Harm::Duplicate)), [(0, 0), (10, 1), (10, 1), (20, 2), (30, 3)]);
        assert_eq!(order(once(Harm::Reorder)), [(0, 0), (20, 2), (20, 1), (30, 3)]);
        let second = |harm| once(harm)[1].1.clone();
        assert_eq!(second(Harm::Corrupt { byte: 1, bits: 0x81 }), [1, 0x7E]);
        assert_eq!(second(Harm::Corrupt { byte: 2, bits: 0x81 }), [1, 0xFF]);
        assert_eq!(second(Harm::Resize(1)), [1]);
        assert_eq!(second(Harm::Resize(9)), [1, 0xFF, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn a_fault_strikes_its_own_identifier_alone_and_the_first_one_wins() {
        let only =
            |id| FrameFault { id: Some(CanId::Base(id)), ..FrameFault::new(Harm::Drop, at(0)) };
        let mut line = line(only(0x182));
        line.handle(at(0), &frame(7));
        assert_eq!(line.poll(at(0)), Some(frame(7)));
        line.add(only(0x181));
        line.add(FrameFault::new(Harm::Duplicate, at(0)));
        line.handle(at(0), &frame(7));
        assert_eq!(line.poll(at(0)), None);
    }

    proptest! {
        /// Without faults a line is a wire: all arrives, at once and in order.
        #[test]
        fn a_line_without_faults_changes_nothing(numbers: Vec<u8>) {
            let mut line = FaultyLine::default();
            for &number in &numbers {
                line.handle(at(5), &frame(number));
            }
            let arrived: Vec<u8> =
                std::iter::from_fn(|| line.poll(at(5))).map(|frame| frame.data()[0]).collect();
            prop_assert_eq!(arrived, numbers);
        }
    }
}
