//! Stopping both axes from outside a run: quick stop, standstill, power off.
//!
//! Both nodes leave Operational first, so that no master's PDO can cancel the stop. Then both drives get
//! quick stop by SDO. Their identities are not checked: whatever has these node numbers must stop. Power
//! is taken off in the end, whatever a drive reports and also if it reports nothing. A command that is
//! not obeyed is repeated.
//!
//! [`Halt::watch`] reads the same objects and writes nothing: it shows whether drives stop by themselves.

use std::time::Duration;

use super::dialogue::{ScriptRunner, Sdo, WithBothDrives};
use super::drive::may_have_power;
use super::standstill::Standstill;
use super::{Axis, StageConfig, Unwrapper};
use crate::canopen::cia402::{Controlword, DriveState, Statusword, object};
use crate::canopen::nmt::{NmtCommand, nmt_frame};
use crate::canopen::sdo::codec::ClientFrame;
use crate::canopen::sdo::{SdoRequest, SdoValue};
use crate::units::Time;

/// Interval between two readings of a drive.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// Stops both axes, or watches them stop; gives where each stands, counts.
pub type Halt = WithBothDrives<i32>;

impl Halt {
    /// Begins to stop at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        let give_up = now + config.power.stop_timeout;
        let nodes = config.nodes();
        let leave = [nodes.insertion, nodes.rotation]
            .map(|node| nmt_frame(NmtCommand::EnterPreOperational, Some(node)));
        WithBothDrives::begin(leave, |axis| {
            let drive = AxisHalt::new(config, axis, now, give_up);
            ScriptRunner::begin(&drive.sdo.clone(), now, drive.stop())
        })
    }

    /// Watches from `now` to `give_up` for both drives to leave Operation Enabled and to stand. Nothing is
    /// written.
    pub fn watch(config: &StageConfig, now: Time, give_up: Time) -> Self {
        WithBothDrives::begin([], |axis| {
            let mut drive = AxisHalt::new(config, axis, now, give_up);
            let sdo = drive.sdo.clone();
            ScriptRunner::begin(&sdo, now, async move { drive.come_to_stand(None).await })
        })
    }

    /// Where `axis` stands, counts, out of Operation Enabled: without power unless it was only
    /// watched. `None` while that is not known yet.
    ///
    /// # Errors
    /// What was not confirmed.
    pub fn result(&self, axis: Axis) -> Option<Result<i32, String>> {
        self.outcome(axis)
    }
}

#[derive(Debug)]
struct AxisHalt {
    sdo: Sdo,
    /// A request failed: from now on each command is also sent at once, see [`AxisHalt::command`].
    is_unanswered: bool,
    give_up: Time,
    /// Until then a drive that keeps its power is commanded again to take it off.
    off_by: Time,
    standstill: Standstill,
}

impl AxisHalt {
    fn new(config: &StageConfig, axis: Axis, now: Time, give_up: Time) -> Self {
        AxisHalt {
            sdo: Sdo::new(config, axis),
            is_unanswered: false,
            give_up,
            off_by: now + config.power.stop_timeout * 2,
            standstill: config.standstill(axis),
        }
    }

    /// Stops the axis and takes its power off, whether or not it was seen to stand.
    async fn stop(mut self) -> Result<i32, String> {
        let stood = self.come_to_stand(Some(Controlword::QUICK_STOP)).await;
        let result = self.take_power_off(stood).await;
        // Once more: the drive may have missed the first command.
        self.sdo.leave_operational();
        result
    }

    /// Waits until the axis has left Operation Enabled and stands; gives its position, counts. `command` is
    /// repeated until the axis has left Operation Enabled.
    async fn come_to_stand(&mut self, command: Option<Controlword>) -> Result<i32, String> {
        let node = self.sdo.node();
        loop {
            if let Some(word) = command {
                self.command(word).await?;
            }
            let word = self.statusword().await?;
            if word.state() != Some(DriveState::OperationEnabled) {
                break;
            }
            let trouble = format!("node {node} stays in operation enabled ({word})");
            self.wait_to_look_again(trouble).await?;
        }
        let (mut position, mut seen) = (Unwrapper::new(0), None);
        loop {
            let position_actual = self.sdo.read_at_least(object::POSITION_ACTUAL, 4).await;
            let counts = position_actual.inspect_err(|_| self.is_unanswered = true)? as i32;
            let (position_counts, now) = (position.unwrap(counts), self.sdo.now());
            match seen.replace(now) {
                Some(before) => self.standstill.take(position_counts, now.since(before)),
                None => self.standstill.watch_from(position_counts),
            }
            if self.standstill.stands() {
                return Ok(counts);
            }
            let trouble = format!("node {node} was not seen to stand, at {counts} counts");
            self.wait_to_look_again(trouble).await?;
        }
    }

    /// Takes power off until it is seen to be off. `stood` is the result of [`AxisHalt::come_to_stand`].
    async fn take_power_off(&mut self, stood: Result<i32, String>) -> Result<i32, String> {
        loop {
            if let Err(error) = self.command(Controlword::DISABLE_VOLTAGE).await {
                let trouble = stood.err().unwrap_or(error);
                return Err(format!("{trouble}; power off was not confirmed"));
            }
            let trouble = match self.statusword().await {
                Ok(word) if may_have_power(word.state()) => {
                    format!("node {} keeps its power (statusword {word})", self.sdo.node())
                }
                Ok(_) => {
                    return stood.map_err(|trouble| format!("{trouble}; its power was taken off"));
                }
                Err(error) => error,
            };
            if self.sdo.now() >= self.off_by {
                return Err(format!("{trouble}: power off was not seen, press the emergency stop"));
            }
            self.sdo.pause(LOOK_PERIOD).await;
        }
    }

    /// Gives a command, and repeats it until it is confirmed.
    async fn command(&mut self, word: Controlword) -> Result<(), String> {
        let (object, value) = (object::CONTROLWORD, SdoValue::from(word.0));
        loop {
            // After a request without an answer the client first reads another object, and sends the
            // command only when that is answered. So it is sent here at once, too.
            if self.is_unanswered {
                let request = SdoRequest::Download(object, value);
                self.sdo.send(ClientFrame::Request(request).to_frame(self.sdo.node()));
            }
            let Err(error) = self.sdo.write(object, value).await else { return Ok(()) };
            self.is_unanswered = true;
            if self.sdo.now() >= self.give_up {
                return Err(error);
            }
            self.sdo.pause(LOOK_PERIOD).await;
        }
    }

    async fn statusword(&mut self) -> Result<Statusword, String> {
        self.sdo.statusword().await.inspect_err(|_| self.is_unanswered = true)
    }

    /// Waits before the next look. Once there is no more time to look, `trouble` is the error.
    async fn wait_to_look_again(&self, trouble: String) -> Result<(), String> {
        if self.sdo.now() >= self.give_up {
            return Err(trouble);
        }
        self.sdo.pause(LOOK_PERIOD).await;
        Ok(())
    }
}
