//! Stopping both axes from outside a run: quick stop, standstill, power off.
//!
//! Both nodes leave Operational first, so that no master's PDO can cancel the stop. Then both drives are
//! commanded to quick stop by SDO. Their identities are not checked: any node with these numbers must stop. At
//! the end power is taken off, whatever a drive reports, and even if it reports nothing. A command is repeated if
//! the drive does not obey it, and if its effect cannot be read.
//!
//! [`QuickStop::watch`] reads the same objects and writes nothing: it shows whether drives stop by themselves. It
//! only leads a node out of NMT Stopped, where it could not be read.

use std::time::Duration;

use super::dialogue::{ScriptRunner, Sdo, WithBothDrives};
use super::event::may_have_power;
use super::standstill::Standstill;
use super::{Axis, StageConfig, Unwrapper};
use crate::canopen::cia402::{Controlword, DriveState, Statusword, object};
use crate::canopen::nmt::{NmtCommand, NmtState, nmt_frame};
use crate::canopen::sdo::codec::ClientFrame;
use crate::canopen::sdo::{SdoRequest, SdoValue};
use crate::units::Time;

/// Interval between two reads of a drive.
const READ_PERIOD: Duration = Duration::from_millis(20);

/// Stops both axes, or watches them stop. Its `outcome` is where an axis stands, counts: its
/// drive has left Operation Enabled, and has no power unless it was only watched.
pub type QuickStop = WithBothDrives<i32>;

impl QuickStop {
    /// Begins to stop at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        let give_up = now + config.power.stop_timeout;
        let nodes = config.nodes();
        let leave_operational = [nodes.insertion, nodes.rotation]
            .map(|node| nmt_frame(NmtCommand::EnterPreOperational, Some(node)));
        WithBothDrives::begin(leave_operational, |axis| {
            let drive = AxisStop::new(config, axis, now, give_up);
            ScriptRunner::begin(&drive.sdo.clone(), now, drive.stop())
        })
    }

    /// Watches from `now` to `give_up` for both drives to leave Operation Enabled and to stand. Nothing is
    /// written.
    pub fn watch(config: &StageConfig, now: Time, give_up: Time) -> Self {
        WithBothDrives::begin([], |axis| {
            let mut drive = AxisStop::new(config, axis, now, give_up);
            let sdo = drive.sdo.clone();
            ScriptRunner::begin(&sdo, now, async move { drive.come_to_stand(None).await })
        })
    }
}

#[derive(Debug)]
struct AxisStop {
    sdo: Sdo,
    /// A request has failed: from now on each command is also sent at once, see [`AxisStop::command`].
    request_failed: bool,
    /// When to give up waiting for the axis to stand.
    give_up: Time,
    /// When to give up waiting for power to be off.
    give_up_power_off: Time,
    standstill: Standstill,
    position: Unwrapper,
    /// When the position was last read.
    last_read: Option<Time>,
}

impl AxisStop {
    fn new(config: &StageConfig, axis: Axis, now: Time, give_up: Time) -> Self {
        AxisStop {
            sdo: Sdo::new(config, axis),
            request_failed: false,
            give_up,
            give_up_power_off: now + config.power.stop_timeout * 2,
            standstill: config.standstill(axis),
            position: Unwrapper::new(0),
            last_read: None,
        }
    }

    /// Stops the axis and takes its power off, whether or not it was seen to stand.
    async fn stop(mut self) -> Result<i32, String> {
        let stood = self.come_to_stand(Some(Controlword::QUICK_STOP)).await;
        let result = self.take_power_off(stood).await;
        // Send it again: the drive may have missed the first command.
        self.sdo.leave_operational();
        result
    }

    /// Waits until the axis has left Operation Enabled and stands; returns its position, counts. `command` is
    /// given again whenever the axis was not seen to obey it.
    async fn come_to_stand(&mut self, command: Option<Controlword>) -> Result<i32, String> {
        let mut obeys = false;
        loop {
            let mut trouble = None;
            // Another master may enable a drive again after the command.
            if command.is_some() || !obeys {
                if let Some(word) = command.filter(|_| !obeys) {
                    self.command(word, self.give_up).await?;
                }
                trouble = self.why_not_stopped().await;
                obeys = trouble.is_none();
            }
            let trouble = match trouble {
                Some(trouble) => trouble,
                None => match self.read_position().await {
                    Err(error) => error,
                    Ok(counts) if self.standstill.stands() => return Ok(counts),
                    Ok(counts) => {
                        format!(
                            "node {} was not seen to stand, at {counts} counts",
                            self.sdo.node()
                        )
                    }
                },
            };
            let is_stopped = self.sdo.nmt_state() == Some(NmtState::Stopped);
            if is_stopped || command.is_some() && !obeys {
                // Another master may have started the node again. In Stopped a node answers no SDO, so this must
                // leave before the next request does.
                self.sdo.leave_operational();
            }
            if self.sdo.now() >= self.give_up {
                return Err(trouble);
            }
            self.sdo.pause(READ_PERIOD).await;
        }
    }

    /// Why the axis is not known to have left Operation Enabled; `None` if it has.
    async fn why_not_stopped(&mut self) -> Option<String> {
        match self.statusword().await {
            Err(error) => Some(error),
            Ok(word) if word.state() == Some(DriveState::OperationEnabled) => {
                Some(format!("node {} stays in operation enabled ({word})", self.sdo.node()))
            }
            Ok(_) => None,
        }
    }

    /// Reads the position, counts, and judges by it whether the axis stands.
    async fn read_position(&mut self) -> Result<i32, String> {
        let counts = self.sdo.read_at_least(object::POSITION_ACTUAL, 4).await;
        let counts = counts.inspect_err(|_| self.request_failed = true)? as i32;
        let (position_counts, now) = (self.position.unwrap(counts), self.sdo.now());
        match self.last_read.replace(now) {
            Some(before) => self.standstill.take(position_counts, now.since(before)),
            None => self.standstill.watch_from(position_counts),
        }
        Ok(counts)
    }

    /// Takes power off until it is seen to be off. `stood` is the result of [`AxisStop::come_to_stand`].
    async fn take_power_off(&mut self, stood: Result<i32, String>) -> Result<i32, String> {
        loop {
            let command = self.command(Controlword::DISABLE_VOLTAGE, self.give_up_power_off);
            if let Err(error) = command.await {
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
            if self.sdo.now() >= self.give_up_power_off {
                return Err(format!("{trouble}: power off was not seen, press the emergency stop"));
            }
            self.sdo.pause(READ_PERIOD).await;
        }
    }

    /// Gives a command, and repeats it until it is confirmed, or until `give_up`.
    async fn command(&mut self, word: Controlword, give_up: Time) -> Result<(), String> {
        let (object, value) = (object::CONTROLWORD, SdoValue::from(word.0));
        loop {
            // After an unanswered request the SDO client first reads another object, and sends the command only
            // when that is answered. So the command is also sent here, at once.
            if self.request_failed {
                let request = SdoRequest::Download(object, value);
                self.sdo.send(ClientFrame::Request(request).to_frame(self.sdo.node()));
            }
            let Err(error) = self.sdo.write(object, value).await else { return Ok(()) };
            self.request_failed = true;
            if self.sdo.now() >= give_up {
                return Err(error);
            }
            self.sdo.pause(READ_PERIOD).await;
        }
    }

    async fn statusword(&mut self) -> Result<Statusword, String> {
        self.sdo.statusword().await.inspect_err(|_| self.request_failed = true)
    }
}
