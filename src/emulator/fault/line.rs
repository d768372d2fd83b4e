//! One way of frames between a drive and the bus, with what goes wrong on it.

use std::time::Duration;

use super::{Effect, FrameClass};
use crate::canopen::Frame;
use crate::units::Time;

/// What goes wrong on a line at present.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Spoiler {
    /// Which fault of the script this is.
    fault: usize,
    effect: Effect,
    frames: FrameClass,
    left: Option<u32>,
}

/// One way of frames: what is handed in comes out at once and unchanged, but for its faults.
#[derive(Debug, Default)]
pub(in crate::emulator) struct Line {
    spoilers: Vec<Spoiler>,
    /// On their way, with the time of their arrival.
    late: Vec<(Time, Frame)>,
    /// Waiting for the next frame to overtake it.
    overtaken: Option<Frame>,
}

impl Line {
    /// Fault number `fault` begins.
    pub(in crate::emulator) fn spoil(
        &mut self,
        fault: usize,
        effect: Effect,
        frames: FrameClass,
        count: Option<u32>,
    ) {
        self.spoilers.push(Spoiler { fault, effect, frames, left: count });
    }

    /// Fault number `fault` is over.
    pub(in crate::emulator) fn mend(&mut self, fault: usize) {
        self.spoilers.retain(|spoiler| spoiler.fault != fault);
    }

    /// What comes out at `now` for `frame` handed in: of several faults the first that is meant
    /// for it has its way.
    pub(in crate::emulator) fn pass(&mut self, now: Time, frame: Frame) -> Vec<Frame> {
        let meant = |spoiler: &&mut Spoiler| {
            spoiler.left != Some(0) && spoiler.frames.has(&frame)
        };
        let effect = self.spoilers.iter_mut().find(meant).map(|spoiler| {
            spoiler.left = spoiler.left.map(|left| left - 1);
            spoiler.effect
        });
        let mut out = match effect {
            None => vec![frame],
            Some(Effect::Drop) => vec![],
            Some(Effect::Delay(delay)) => {
                self.late.push((now + delay, frame));
                vec![]
            }
            Some(Effect::Duplicate) => vec![frame; 2],
            Some(Effect::Reorder) if self.overtaken.is_none() => {
                self.overtaken = Some(frame);
                return vec![];
            }
            Some(Effect::Reorder) => vec![frame],
            Some(Effect::Corrupt) => vec![changed(&frame, |data| {
                if let Some(first) = data.first_mut() {
                    *first = !*first;
                }
            })],
            Some(Effect::Shorten) => vec![changed(&frame, |data| {
                data.pop();
            })],
        };
        if !out.is_empty() {
            out.extend(self.overtaken.take());
        }
        out
    }

    /// The next frame that was late and has come by `now`.
    pub(in crate::emulator) fn arrived(&mut self, now: Time) -> Option<Frame> {
        let due = self.late.iter().enumerate().filter(|(_, (due, _))| *due <= now);
        let (first, _) = due.min_by_key(|(_, (due, _))| *due)?;
        Some(self.late.remove(first).1)
    }

    /// When the next late frame arrives.
    pub(in crate::emulator) fn deadline(&self) -> Time {
        self.late.iter().map(|(due, _)| *due).min().unwrap_or(Time::NEVER)
    }
}

/// `frame` with other data; itself where that is no frame.
fn changed(frame: &Frame, change: impl FnOnce(&mut Vec<u8>)) -> Frame {
    let mut data = frame.data().to_vec();
    change(&mut data);
    Frame::from_parts(frame.id(), frame.is_remote(), &data).unwrap_or(*frame)
}

/// The shortest time between two frames of another node: a full bus at 1 Mbit/s.
pub(super) const FOREIGN_SPACING_MIN: Duration = Duration::from_micros(100);

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    fn frame(byte: u8) -> Frame {
        Frame::new(0x181, &[byte, 2, 3])
    }

    /// Frames 1, 2, 3 and a heartbeat handed in a millisecond apart, and what came out when.
    fn passed(effect: Effect, count: Option<u32>) -> String {
        let mut line = Line::default();
        line.spoil(0, effect, FrameClass::Pdo, count);
        let mut out = Vec::new();
        let heartbeat = Frame::new(0x701, &[5]);
        for (ms, given) in (0..).zip([frame(1), frame(2), frame(3), heartbeat]) {
            out.extend(line.pass(at(ms), given).into_iter().map(|frame| format!("{ms}:{frame}")));
            out.extend(line.arrived(at(ms)).map(|frame| format!("{ms}:{frame}")));
        }
        assert_eq!(line.deadline(), Time::NEVER);
        out.join(" ")
    }

    #[test]
    fn every_effect_does_what_it_says() {
        let all = "0:181#010203 1:181#020203 2:181#030203 3:701#05";
        assert_eq!(passed(Effect::Drop, Some(0)), all);
        assert_eq!(passed(Effect::Drop, None), "3:701#05");
        assert_eq!(passed(Effect::Drop, Some(1)), "1:181#020203 2:181#030203 3:701#05");
        assert_eq!(
            passed(Effect::Delay(Duration::from_millis(2)), Some(1)),
            "1:181#020203 2:181#030203 2:181#010203 3:701#05"
        );
        assert_eq!(
            passed(Effect::Duplicate, Some(1)),
            "0:181#010203 0:181#010203 1:181#020203 2:181#030203 3:701#05"
        );
        assert_eq!(
            passed(Effect::Reorder, Some(1)),
            "1:181#020203 1:181#010203 2:181#030203 3:701#05"
        );
        assert_eq!(
            passed(Effect::Reorder, None),
            "1:181#020203 1:181#010203 3:701#05 3:181#030203"
        );
        assert_eq!(
            passed(Effect::Corrupt, Some(1)),
            "0:181#FE0203 1:181#020203 2:181#030203 3:701#05"
        );
        assert_eq!(
            passed(Effect::Shorten, Some(1)),
            "0:181#0102 1:181#020203 2:181#030203 3:701#05"
        );
    }

    #[test]
    fn a_fault_that_is_over_is_over() {
        let mut line = Line::default();
        line.spoil(3, Effect::Drop, FrameClass::Any, None);
        assert_eq!(line.pass(at(0), frame(1)), []);
        line.mend(3);
        assert_eq!(line.pass(at(0), frame(1)), [frame(1)]);
    }
}
