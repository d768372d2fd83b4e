//! The script: when each fault begins and ends.

use std::time::Duration;

use super::Fault;
use crate::canopen::Frame;
use crate::units::Time;

/// Interval between two checks of the depth while a fault waits for it.
const DEPTH_CHECK_INTERVAL: Duration = Duration::from_millis(1);

/// The shortest time between two frames of another node: a full bus at 1 Mbit/s.
const FOREIGN_SPACING_MIN: Duration = Duration::from_micros(100);

/// An event of the script.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::emulator) enum ScriptEvent {
    /// A fault begins, and ends at this time.
    Begins(Fault, Time),
    /// A fault ends.
    Ends(Fault),
    /// Another node sends this frame.
    Foreign(Frame),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    Waiting,
    Active {
        end: Time,
        /// When the next frame of [`FaultKind::Foreign`](super::FaultKind::Foreign) is due.
        next_frame: Time,
    },
    Over,
}

/// The faults of a stage, in the order they were written.
#[derive(Debug)]
pub(in crate::emulator) struct Script {
    faults: Vec<(Fault, State)>,
    start: Time,
    next_check: Time,
    /// The depth at the last check, mm.
    depth_mm: f64,
}

impl Script {
    pub(in crate::emulator) fn new(faults: &[Fault], now: Time) -> Self {
        let faults = faults.iter().map(|fault| (fault.clone(), State::Waiting)).collect();
        Script { faults, start: now, next_check: now, depth_mm: 0.0 }
    }

    /// The next event that is due at `now`, when the true depth is `insertion_mm`.
    pub(in crate::emulator) fn poll(
        &mut self,
        now: Time,
        insertion_mm: f64,
    ) -> Option<ScriptEvent> {
        self.next_check = now + DEPTH_CHECK_INTERVAL;
        let (low_mm, high_mm) = (self.depth_mm.min(insertion_mm), self.depth_mm.max(insertion_mm));
        for (fault, state) in &mut self.faults {
            match *state {
                State::Waiting => {
                    let is_due = fault.start_after.is_some_and(|after| now >= self.start + after);
                    let is_passed = fault.at_mm.is_some_and(|mm| (low_mm..=high_mm).contains(&mm));
                    if is_due || is_passed {
                        let end = fault.duration.map_or(Time::NEVER, |duration| now + duration);
                        *state = State::Active { end, next_frame: now };
                        return Some(ScriptEvent::Begins(fault.clone(), end));
                    }
                }
                State::Active { end, .. } if now >= end => {
                    *state = State::Over;
                    return Some(ScriptEvent::Ends(fault.clone()));
                }
                State::Active { end, next_frame } if now >= next_frame => {
                    if let Some(frame) = fault.foreign_frame() {
                        let period = fault.period.map(|period| period.max(FOREIGN_SPACING_MIN));
                        let next_frame = period.map_or(Time::NEVER, |period| next_frame + period);
                        *state = State::Active { end, next_frame };
                        return Some(ScriptEvent::Foreign(frame));
                    }
                }
                State::Active { .. } | State::Over => {}
            }
        }
        self.depth_mm = insertion_mm;
        None
    }

    /// The faults that have begun and not ended, in the order they were written.
    pub(in crate::emulator) fn active(&self) -> impl Iterator<Item = &Fault> {
        let is_active = |(_, state): &&(Fault, State)| matches!(state, State::Active { .. });
        self.faults.iter().filter(is_active).map(|(fault, _)| fault)
    }

    /// When [`poll`](Self::poll) is due.
    pub(in crate::emulator) fn deadline(&self) -> Time {
        let due = |(fault, state): &(Fault, State)| match *state {
            State::Waiting => fault.start_after.map_or(self.next_check, |after| self.start + after),
            State::Active { end, next_frame } if fault.frame.is_some() => end.min(next_frame),
            State::Active { end, .. } => end,
            State::Over => Time::NEVER,
        };
        self.faults.iter().map(due).min().unwrap_or(Time::NEVER)
    }
}

#[cfg(test)]
mod tests {
    use super::super::FaultKind;
    use super::*;
    use crate::units::at_ms;

    fn at_mm(mm: f64) -> Fault {
        Fault { at_mm: Some(mm), ..Fault::of(FaultKind::Stall) }
    }

    #[test]
    fn faults_begin_once_at_their_time_or_depth_and_end() {
        let deep = at_mm(10.0);
        let [after, duration] = [5, 20].map(|ms| Some(Duration::from_millis(ms)));
        let timed = Fault { start_after: after, duration, ..Fault::of(FaultKind::Silent) };
        let mut script = Script::new(&[deep.clone(), timed.clone()], at_ms(100));
        assert_eq!(script.poll(at_ms(100), 0.0), None);
        assert_eq!(script.deadline(), at_ms(101), "depths are checked every millisecond");
        assert_eq!(
            script.poll(at_ms(106), 9.0),
            Some(ScriptEvent::Begins(timed.clone(), at_ms(126)))
        );
        assert_eq!(script.poll(at_ms(107), 10.0), Some(ScriptEvent::Begins(deep, Time::NEVER)));
        assert_eq!(script.poll(at_ms(107), 10.0), None);
        assert_eq!(script.deadline(), at_ms(126));
        assert_eq!(script.poll(at_ms(126), 0.0), Some(ScriptEvent::Ends(timed)));
        assert_eq!((script.poll(at_ms(900), 99.0), script.deadline()), (None, Time::NEVER));
    }

    /// A withdrawal passes depths too.
    #[test]
    fn a_depth_triggers_in_either_direction() {
        let mut script = Script::new(&[at_mm(-3.0), at_mm(0.0)], at_ms(0));
        assert_eq!(script.poll(at_ms(0), 0.0), Some(ScriptEvent::Begins(at_mm(0.0), Time::NEVER)));
        assert_eq!(script.poll(at_ms(1), 5.0), None);
        assert_eq!(script.poll(at_ms(2), -2.9), None);
        assert_eq!(
            script.poll(at_ms(3), -3.1),
            Some(ScriptEvent::Begins(at_mm(-3.0), Time::NEVER))
        );
    }

    #[test]
    fn a_foreign_node_sends_every_period_until_its_fault_ends() {
        let [after, period, duration] = [0, 2, 5].map(|ms| Some(Duration::from_millis(ms)));
        let frame = Some("181#01".to_owned());
        let foreign = Fault::of(FaultKind::Foreign);
        let mut script = Script::new(
            &[Fault { start_after: after, frame, period, duration, ..foreign }],
            at_ms(0),
        );
        let mut seen = Vec::new();
        for ms in 0..10 {
            while let Some(change) = script.poll(at_ms(ms), 0.0) {
                seen.push((ms, matches!(change, ScriptEvent::Foreign(_))));
            }
        }
        assert_eq!(seen, [(0, false), (0, true), (2, true), (4, true), (5, false)]);
    }
}
