//! Stopping both axes from outside a run: quick stop, standstill, power off.
//!
//! Both nodes leave Operational first, so that no master's PDO can take the stop back; then quick
//! stop goes to both by SDO, with no question asked. The drives' identities are not looked at:
//! whatever stands at these node numbers is to stop.

use std::time::Duration;

use super::dialogue::Asker;
use super::{Axis, Dialogue, PerAxis, StageConfig};
use crate::canopen::cia402::{Controlword, DriveState, Statusword, object};
use crate::canopen::nmt::{NmtCommand, nmt_frame};
use crate::canopen::sdo::{SdoReply, SdoRequest};
use crate::canopen::{Frame, ObjectAddress};
use crate::units::Time;

/// Between two looks at a drive.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Looks in a row at one position that make standstill.
const STANDING_LOOKS: u32 = 3;
/// Encoder noise of a held axis, counts.
const STANDING_COUNTS: u32 = 10;

/// Stops both axes.
#[derive(Debug)]
pub struct Halt {
    axes: PerAxis<AxisHalt>,
    nmt: Vec<Frame>,
}

#[derive(Debug)]
struct AxisHalt {
    asker: Asker,
    step: Step,
    /// Waiting until then before the next look.
    pause: Option<Time>,
    give_up: Time,
    position_counts: i32,
    looks: u32,
}

#[derive(Debug, Clone, PartialEq)]
enum Step {
    QuickStop,
    /// Does it still follow set-points?
    LookAtState,
    /// Does it still move?
    LookAtPosition,
    PowerOff,
    Over(Result<i32, String>),
}

impl Halt {
    /// Begins to stop at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        let nodes = config.nodes();
        let halt = |axis| {
            let mut halt = AxisHalt {
                asker: Asker::new(config, axis),
                step: Step::QuickStop,
                pause: None,
                give_up: now + config.stop_timeout,
                position_counts: 0,
                looks: 0,
            };
            halt.act(now);
            halt
        };
        // The last comes out first.
        let leave = [nodes.rotation, nodes.insertion];
        Halt {
            axes: PerAxis::from_fn(halt),
            nmt: leave.map(|node| nmt_frame(NmtCommand::EnterPreOperational, Some(node))).into(),
        }
    }

    /// Where `axis` stands without power, counts; `None` while it is being stopped.
    ///
    /// # Errors
    /// Why nobody knows that it stands.
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
            self.axes[axis].asker.handle_frame(now, frame);
            self.axes[axis].take_result(now);
        }
    }

    fn handle_timeout(&mut self, now: Time) {
        for axis in Axis::BOTH {
            self.axes[axis].handle_timeout(now);
        }
    }

    fn poll_transmit(&mut self) -> Option<Frame> {
        let PerAxis { insertion, rotation } = &mut self.axes;
        let sdo = |axis: &mut AxisHalt| axis.asker.poll_transmit();
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
    fn deadline(&self) -> Time {
        self.pause.unwrap_or(Time::NEVER).min(self.asker.deadline())
    }

    fn handle_timeout(&mut self, now: Time) {
        self.asker.handle_timeout(now);
        self.take_result(now);
        if self.pause.is_some_and(|until| now >= until) {
            self.pause = None;
            self.act(now);
        }
    }

    /// Asks what the present step asks.
    fn act(&mut self, now: Time) {
        let write = |word: Controlword| {
            SdoRequest::Download(object::CONTROLWORD, word.0.to_le_bytes().to_vec())
        };
        let read = |object: ObjectAddress| SdoRequest::Upload(object);
        let request = match self.step {
            Step::QuickStop => write(Controlword::QUICK_STOP),
            Step::LookAtState => read(object::STATUSWORD),
            Step::LookAtPosition => read(object::POSITION_ACTUAL),
            Step::PowerOff => write(Controlword::DISABLE_VOLTAGE),
            Step::Over(_) => return,
        };
        self.asker.ask(now, request);
    }

    fn go_on(&mut self, now: Time, step: Step) {
        self.step = step;
        self.act(now);
    }

    fn look_again(&mut self, now: Time, trouble: String) {
        if now >= self.give_up {
            self.step = Step::Over(Err(trouble));
        } else {
            self.pause = Some(now + LOOK_PERIOD);
        }
    }

    fn take_result(&mut self, now: Time) {
        let Some(result) = self.asker.poll_result() else { return };
        match (self.step.clone(), result) {
            (_, Err(error)) => self.step = Step::Over(Err(error)),
            (Step::QuickStop, Ok(_)) => self.go_on(now, Step::LookAtState),
            (Step::LookAtState, Ok(SdoReply::Uploaded(bytes))) => self.take_state(now, &bytes),
            (Step::LookAtPosition, Ok(SdoReply::Uploaded(bytes))) => {
                self.take_position(now, &bytes);
            }
            (Step::PowerOff, Ok(_)) => self.step = Step::Over(Ok(self.position_counts)),
            (Step::LookAtState | Step::LookAtPosition | Step::Over(_), Ok(_)) => {}
        }
    }

    fn take_state(&mut self, now: Time, bytes: &[u8]) {
        let word = <[u8; 2]>::try_from(bytes).map(u16::from_le_bytes);
        match word.map(Statusword) {
            Ok(word) if word.state() == Some(DriveState::OperationEnabled) => {
                let node = self.asker.node();
                self.look_again(now, format!("node {node} stays in operation enabled ({word})"));
            }
            _ => self.go_on(now, Step::LookAtPosition),
        }
    }

    fn take_position(&mut self, now: Time, bytes: &[u8]) {
        let Ok(bytes) = bytes.try_into() else {
            let node = self.asker.node();
            self.step = Step::Over(Err(format!("node {node} 0x6064:00 has {} bytes", bytes.len())));
            return;
        };
        let counts = i32::from_le_bytes(bytes);
        let stands = self.position_counts.abs_diff(counts) <= STANDING_COUNTS;
        self.looks = if stands { self.looks + 1 } else { 0 };
        self.position_counts = counts;
        if self.looks >= STANDING_LOOKS {
            return self.go_on(now, Step::PowerOff);
        }
        let node = self.asker.node();
        self.look_again(now, format!("node {node} was not seen to stand, at {counts} counts"));
    }
}
