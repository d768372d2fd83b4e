//! Stopping both axes from outside a run: quick stop, standstill, power off.
//!
//! Both nodes leave Operational first, so that no master's PDO can take the stop back; then quick
//! stop goes to both by SDO, with no question asked. The drives' identities are not looked at:
//! whatever stands at these node numbers is to stop. Whatever the looks at a drive say, or do not,
//! its power is taken off in the end. A drive that does not obey is told again.
//!
//! The same looks without a word of command show whether drives stop by themselves.

use std::time::Duration;

use super::dialogue::SdoRetrier;
use super::drive::may_have_power;
use super::standstill::Standstill;
use super::{Axis, Dialogue, PerAxis, StageConfig, Unwrapper};
use crate::canopen::Frame;
use crate::canopen::cia402::{Controlword, DriveState, Statusword, object};
use crate::canopen::nmt::{NmtCommand, nmt_frame};
use crate::canopen::sdo::codec::ClientFrame;
use crate::canopen::sdo::{SdoReply, SdoRequest};
use crate::units::Time;

/// A node out of Operational takes no PDOs.
const LEAVE: NmtCommand = NmtCommand::EnterPreOperational;
/// Between two looks at a drive.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// Stops both axes, or watches them stop.
#[derive(Debug, Clone)]
pub struct Halt {
    axes: PerAxis<AxisHalt>,
    nmt: Vec<Frame>,
}

#[derive(Debug, Clone)]
struct AxisHalt {
    sdo: SdoRetrier,
    step: Step,
    /// It only looks.
    watches: bool,
    /// What went wrong before power off.
    trouble: Option<String>,
    /// The node is told once more to leave Operational: the first time it may not have heard it.
    last_word: Option<Frame>,
    /// A request got no answer.
    is_unanswered: bool,
    /// The present command once more, whatever the SDO client waits for.
    blind: Option<Frame>,
    /// Waiting until then before the next look.
    pause: Option<Time>,
    give_up: Time,
    /// A drive that keeps its power is told until then to take it off.
    off_by: Time,
    position: Unwrapper,
    /// When its position was seen last.
    seen: Option<Time>,
    standstill: Standstill,
}

#[derive(Debug, Clone, PartialEq)]
enum Step {
    QuickStop,
    /// Does it still follow set-points?
    LookAtState,
    /// Does it still move?
    LookAtPosition,
    PowerOff,
    /// Did it take its power off?
    LookAtPower,
    Over(Result<i32, String>),
}

impl Halt {
    /// Begins to stop at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        let give_up = now + config.stop_timeout;
        let axes = PerAxis::from_fn(|axis| AxisHalt::new(config, axis, false, now, give_up));
        let nodes = config.nodes();
        // The last comes out first.
        let leave = [nodes.rotation, nodes.insertion];
        Halt { axes, nmt: leave.map(|node| nmt_frame(LEAVE, Some(node))).into() }
    }

    /// Watches from `now` to `give_up` for both drives to leave Operation Enabled and to stand, by
    /// whatever makes them: nothing is written.
    pub fn watch(config: &StageConfig, now: Time, give_up: Time) -> Self {
        let axes = PerAxis::from_fn(|axis| AxisHalt::new(config, axis, true, now, give_up));
        Halt { axes, nmt: Vec::new() }
    }

    /// Where `axis` stands, counts, out of Operation Enabled: without power unless it was only
    /// watched. `None` while that is not known yet.
    ///
    /// # Errors
    /// What was not confirmed.
    pub fn result(&self, axis: Axis) -> Option<Result<i32, String>> {
        match &self.axes[axis].step {
            Step::Over(result) => Some(result.clone().map_err(|error| format!("{axis}: {error}"))),
            _ => None,
        }
    }
}

impl Dialogue for Halt {
    fn handle_frame(&mut self, now: Time, frame: &Frame) {
        for axis in Axis::BOTH {
            let result = self.axes[axis].sdo.handle_frame(now, frame);
            self.axes[axis].take_result(now, result);
        }
    }

    fn handle_timeout(&mut self, now: Time) {
        for axis in Axis::BOTH {
            self.axes[axis].handle_timeout(now);
        }
    }

    fn poll_transmit(&mut self) -> Option<Frame> {
        let PerAxis { insertion, rotation } = &mut self.axes;
        let sdo = |axis: &mut AxisHalt| {
            let blind = axis.blind.take().or_else(|| axis.sdo.poll_transmit());
            blind.or_else(|| axis.last_word.take())
        };
        self.nmt.pop().or_else(|| sdo(insertion)).or_else(|| sdo(rotation))
    }

    fn deadline(&self) -> Time {
        self.axes.insertion.deadline().min(self.axes.rotation.deadline())
    }

    fn is_over(&self) -> bool {
        self.axes.all(|axis| matches!(axis.step, Step::Over(_)))
    }
}

impl AxisHalt {
    fn new(config: &StageConfig, axis: Axis, watches: bool, now: Time, give_up: Time) -> Self {
        let step = if watches { Step::LookAtState } else { Step::QuickStop };
        AxisHalt {
            sdo: SdoRetrier::new(config, axis, now, request_of(&step)),
            step,
            watches,
            trouble: None,
            last_word: None,
            is_unanswered: false,
            blind: None,
            pause: None,
            give_up,
            off_by: now + config.stop_timeout * 2,
            position: Unwrapper::new(0),
            seen: None,
            standstill: Standstill::new(config.axis(axis).scale(axis, 0).counts_per_unit()),
        }
    }

    fn deadline(&self) -> Time {
        self.pause.unwrap_or(Time::NEVER).min(self.sdo.deadline())
    }

    fn handle_timeout(&mut self, now: Time) {
        let result = self.sdo.handle_timeout(now);
        self.take_result(now, result);
        if self.pause.is_some_and(|until| now >= until) {
            self.pause = None;
            self.act(now);
        }
    }

    /// Asks what the present step asks.
    fn act(&mut self, now: Time) {
        let request = request_of(&self.step);
        // After a request without an answer the client asks for something else first, and gives the
        // command only once that is answered.
        if matches!(request, SdoRequest::Download(..)) && self.is_unanswered {
            self.blind = Some(ClientFrame::Request(request).to_frame(self.sdo.node()));
        }
        self.sdo.ask(now, request);
    }

    fn go_on(&mut self, now: Time, step: Step) {
        self.step = step;
        self.act(now);
    }

    fn look_again(&mut self, now: Time, trouble: String) {
        if now >= self.give_up {
            self.give_up_looking(now, trouble);
        } else {
            self.pause = Some(now + LOOK_PERIOD);
        }
    }

    /// Nobody knows whether the axis stands: its power is taken off all the same.
    fn give_up_looking(&mut self, now: Time, trouble: String) {
        if self.watches {
            self.step = Step::Over(Err(trouble));
        } else {
            self.trouble = Some(trouble);
            self.go_on(now, Step::PowerOff);
        }
    }

    fn end(&mut self, result: Result<i32, String>) {
        self.last_word = Some(nmt_frame(LEAVE, Some(self.sdo.node())));
        self.step = Step::Over(result);
    }

    fn take_result(&mut self, now: Time, result: Option<Result<SdoReply, String>>) {
        let Some(result) = result else { return };
        self.is_unanswered |= result.is_err();
        let node = self.sdo.node();
        let result = result.and_then(|reply| {
            of_full_length(&self.step, reply).map_err(|error| format!("node {node} {error}"))
        });
        match (self.step.clone(), result) {
            // A command that was not confirmed is given again.
            (Step::QuickStop | Step::PowerOff, Err(_)) if now < self.give_up => {
                self.pause = Some(now + LOOK_PERIOD);
            }
            (Step::PowerOff, Err(error)) => {
                let before = self.trouble.take();
                let unconfirmed = |trouble| format!("{trouble}; power off was not confirmed");
                self.end(Err(before.map_or(error, unconfirmed)));
            }
            (Step::LookAtPower, Err(error)) => self.power_not_seen_off(now, error),
            (_, Err(error)) => self.give_up_looking(now, error),
            (Step::QuickStop, Ok(_)) => self.go_on(now, Step::LookAtState),
            (Step::PowerOff, Ok(_)) => self.go_on(now, Step::LookAtPower),
            (Step::LookAtState, Ok(SdoReply::Uploaded(value))) => {
                self.take_state(now, Statusword(value.to_u32() as u16));
            }
            (Step::LookAtPosition, Ok(SdoReply::Uploaded(value))) => {
                self.take_position(now, value.to_u32() as i32);
            }
            (Step::LookAtPower, Ok(SdoReply::Uploaded(value))) => {
                self.take_power(now, Statusword(value.to_u32() as u16));
            }
            (_, Ok(_)) => {}
        }
    }

    fn end_without_power(&mut self) {
        let after = |trouble| Err(format!("{trouble}; its power was taken off"));
        let position_counts = self.position.counts() as i32;
        let result = self.trouble.take().map_or(Ok(position_counts), after);
        self.end(result);
    }

    fn take_power(&mut self, now: Time, word: Statusword) {
        if may_have_power(word.state()) {
            let node = self.sdo.node();
            let trouble = format!("node {node} keeps its power (statusword {word})");
            self.power_not_seen_off(now, trouble);
        } else {
            self.end_without_power();
        }
    }

    /// The command was confirmed, its effect was not seen: it is given again, as long as there is time.
    fn power_not_seen_off(&mut self, now: Time, trouble: String) {
        if now < self.off_by {
            self.step = Step::PowerOff;
            self.pause = Some(now + LOOK_PERIOD);
        } else {
            self.end(Err(format!("{trouble}: power off was not seen, press the emergency stop")));
        }
    }

    fn take_state(&mut self, now: Time, word: Statusword) {
        if word.state() != Some(DriveState::OperationEnabled) {
            return self.go_on(now, Step::LookAtPosition);
        }
        if !self.watches {
            self.step = Step::QuickStop;
        }
        let node = self.sdo.node();
        self.look_again(now, format!("node {node} stays in operation enabled ({word})"));
    }

    fn take_position(&mut self, now: Time, counts: i32) {
        let position_counts = self.position.unwrap(counts);
        match self.seen.replace(now) {
            Some(before) => self.standstill.look(position_counts, now.since(before)),
            None => self.standstill.watch_from(position_counts),
        }
        if self.standstill.stands() {
            return match self.watches {
                true => self.step = Step::Over(Ok(counts)),
                false => self.go_on(now, Step::PowerOff),
            };
        }
        let node = self.sdo.node();
        self.look_again(now, format!("node {node} was not seen to stand, at {counts} counts"));
    }
}

/// What `step` asks of the drive.
fn request_of(step: &Step) -> SdoRequest {
    let write = |word: Controlword| SdoRequest::Download(object::CONTROLWORD, word.0.into());
    match step {
        Step::QuickStop => write(Controlword::QUICK_STOP),
        Step::PowerOff | Step::Over(_) => write(Controlword::DISABLE_VOLTAGE),
        Step::LookAtState | Step::LookAtPower => SdoRequest::Upload(object::STATUSWORD),
        Step::LookAtPosition => SdoRequest::Upload(object::POSITION_ACTUAL),
    }
}

/// `reply`, unless it is shorter than what `step` looks at. An expedited answer may leave out how many of
/// its four bytes are the object's.
fn of_full_length(step: &Step, reply: SdoReply) -> Result<SdoReply, String> {
    let (object, len_min) = match step {
        Step::LookAtPosition => (object::POSITION_ACTUAL, 4),
        _ => (object::STATUSWORD, 2),
    };
    match reply {
        SdoReply::Uploaded(value) if value.as_bytes().len() < len_min => {
            Err(format!("{object} has {} bytes", value.as_bytes().len()))
        }
        reply => Ok(reply),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_answer_is_neither_statusword_nor_position() {
        let is_taken = |step, value| of_full_length(&step, SdoReply::Uploaded(value)).is_ok();
        assert!(!is_taken(Step::LookAtPower, 0x40_u8.into()));
        assert!(is_taken(Step::LookAtPower, 0x0250_u16.into()));
        assert!(is_taken(Step::LookAtState, 0x0237_u32.into()), "of no size");
        assert!(!is_taken(Step::LookAtPosition, 7_u16.into()));
    }
}
