//! Works through the bring-up plan of one drive over SDO: retries, reads back, compares.

use std::collections::VecDeque;
use std::time::Duration;

use super::bring_up_error::{BringUpError, DRIVE_PROFILE, FoundFault, Identity, is_absent};
use super::plan::{Action, BringUpPart, End, Reading, Step, bring_up_plan, fault_plan};
use super::{Axis, AxisConfig, Output, Progress, Sign, StageConfig, StageEvent};
use crate::canopen::cia402::{DriveState, Mode, Statusword};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::nmt::{NmtCommand, nmt_frame};
use crate::canopen::sdo::{SdoClient, SdoError, SdoReply, SdoRequest, SdoValue};
use crate::canopen::{Frame, ObjectAddress, cob};
use crate::units::Time;

/// Bytes of an expedited answer that does not say how many count.
const UNSIZED: usize = 4;
/// Between two readings of an object that is to change by itself.
const POLL_PERIOD: Duration = Duration::from_millis(10);

/// What bring-up has to do or to tell.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum BringUpOutput {
    Stage(Output),
    /// Done; the axis stood here (0x6064).
    Done(i32),
    Failed(BringUpError),
}

/// The SDO under way for the present step.
#[derive(Debug, Clone, Copy)]
enum Doing {
    Read,
    Write(SdoValue),
    ReadBack(SdoValue),
    Pause(Time),
}

/// Brings up one drive.
#[derive(Debug)]
pub(super) struct BringUp {
    axis: Axis,
    client: SdoClient,
    plan: Vec<Step>,
    /// Of the plan, what is left to do.
    steps: VecDeque<Step>,
    restarts_left: u32,
    part: Option<BringUpPart>,
    doing: Doing,
    attempts: u32,
    /// When [`Action::Find`] or [`Action::Await`] gives up.
    give_up: Time,
    identity: Identity,
    identified: bool,
    disarmed: bool,
    found_in_fault: Option<FoundFault>,
    position: i32,
    outputs: VecDeque<BringUpOutput>,
    config: StageConfig,
    /// The axis is brought up to be homed.
    homed: bool,
}

impl BringUp {
    /// The bring-up of `axis`, to be moved or to be `homed`.
    pub(super) fn new(config: &StageConfig, axis: Axis, homed: bool, now: Time) -> Self {
        let plan = bring_up_plan(config, axis, homed);
        let mut bring_up = BringUp {
            axis,
            client: SdoClient::new(config.axis(axis).node, config.sdo_timeout),
            steps: plan.clone().into(),
            plan,
            restarts_left: config.boot_attempts.saturating_sub(1),
            part: None,
            doing: Doing::Read,
            attempts: 0,
            give_up: Time::NEVER,
            identity: Identity::default(),
            identified: false,
            disarmed: false,
            found_in_fault: None,
            position: 0,
            outputs: VecDeque::new(),
            config: config.clone(),
            homed,
        };
        bring_up.begin_step(now);
        bring_up
    }

    pub(super) fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.client.handle_frame(now, frame);
        self.handle_result(now);
    }

    /// A boot-up message: expected of a drive still waited for. Later all that was written is lost,
    /// and it is begun anew, but not for ever.
    pub(super) fn handle_boot_up(&mut self, now: Time) {
        match self.part {
            Some(BringUpPart::Find) | None => {}
            Some(_) if self.restarts_left > 0 => {
                self.restarts_left -= 1;
                self.client.cancel();
                self.steps = self.plan.clone().into();
                self.identified = false;
                self.disarmed = false;
                self.found_in_fault = None;
                self.tell(StageEvent::Progress(Progress::Restarted(self.axis)));
                self.begin_step(now);
            }
            Some(part) => self.fail(BringUpError::Rebooted(part)),
        }
    }

    pub(super) fn handle_timeout(&mut self, now: Time) {
        self.client.handle_timeout(now);
        self.handle_result(now);
        if let Doing::Pause(until) = self.doing
            && now >= until
        {
            self.request(now, Doing::Read);
        }
    }

    pub(super) fn deadline(&self) -> Time {
        match self.doing {
            Doing::Pause(until) => until.min(self.client.deadline()),
            _ => self.client.deadline(),
        }
    }

    pub(super) fn poll(&mut self) -> Option<BringUpOutput> {
        let frame = self.client.poll_transmit();
        let transmit = frame.map(|frame| BringUpOutput::Stage(Output::Transmit(frame)));
        transmit.or_else(|| self.outputs.pop_front())
    }

    /// The drive is known to be the one of the configuration.
    pub(super) fn is_identified(&self) -> bool {
        self.identified
    }

    /// Its power is off, and whether it was in Fault is known: what goes wrong from here on is of now.
    pub(super) fn is_disarmed(&self) -> bool {
        self.disarmed
    }

    /// It was in Fault when it was looked at, and may be reset.
    pub(super) fn found_in_fault(&self) -> Option<FoundFault> {
        self.found_in_fault
    }

    /// The drive may have been told to watch the bench; its power was taken off before.
    pub(super) fn may_be_supervised(&self) -> bool {
        self.part >= Some(BringUpPart::Supervise)
    }

    /// Ends it early; what is left to send.
    pub(super) fn cancel(&mut self) -> impl Iterator<Item = Frame> + '_ {
        self.client.cancel();
        std::iter::from_fn(|| self.client.poll_transmit())
    }

    fn begin_step(&mut self, now: Time) {
        let Some(step) = self.steps.front().copied() else {
            return match self.found_in_fault {
                Some(fault) if !self.config.fault_reset_on_start => {
                    self.fail(BringUpError::Fault(fault));
                }
                _ => self.outputs.push_back(BringUpOutput::Done(self.position)),
            };
        };
        if self.part != Some(step.part) {
            self.part = Some(step.part);
            self.tell(StageEvent::Progress(Progress::BringUp(self.axis, step.part)));
        }
        let patience = match step.action {
            Action::Find => self.config.boot_timeout,
            _ => self.config.sdo_timeout.saturating_mul(self.config.sdo_attempts),
        };
        self.give_up = now + patience;
        self.attempts = 0;
        let doing = match step.action {
            Action::Write(value) | Action::Command(value) => Doing::Write(value),
            Action::SeedTarget => Doing::Write(self.position.into()),
            Action::Limit(end) => Doing::Write(self.limit_counts(end).into()),
            _ => Doing::Read,
        };
        self.request(now, doing);
    }

    fn request(&mut self, now: Time, doing: Doing) {
        let Some(step) = self.steps.front() else { return };
        let request = match doing {
            Doing::Read | Doing::ReadBack(_) => SdoRequest::Upload(step.object),
            Doing::Write(value) => SdoRequest::Download(step.object, value),
            Doing::Pause(_) => return,
        };
        self.doing = doing;
        self.attempts += 1;
        self.client.start(now, request);
    }

    /// Does the present step with other means; its attempts start anew.
    fn go_on(&mut self, now: Time, doing: Doing) {
        self.attempts = 0;
        self.request(now, doing);
    }

    fn next_step(&mut self, now: Time) {
        let done = self.steps.pop_front();
        if done.is_some_and(|step| step.action == Action::Read(Reading::Product)) {
            self.identified = true;
            // Not a reset: the drive may hold a load.
            self.leave_operational();
        }
        self.begin_step(now);
    }

    fn handle_result(&mut self, now: Time) {
        let Some(result) = self.client.poll_result() else { return };
        let Some(step) = self.steps.front().copied() else { return };
        match (result, self.doing) {
            (Ok(SdoReply::Uploaded(value)), _) => self.handle_read(now, step, value),
            (Ok(SdoReply::Downloaded), Doing::Write(value)) => match step.action {
                Action::Command(_) => self.next_step(now),
                _ => self.go_on(now, Doing::ReadBack(value)),
            },
            (Ok(SdoReply::Downloaded), _) => {}
            (Err(error), doing) => self.handle_error(now, step, doing, error),
        }
    }

    fn handle_error(&mut self, now: Time, step: Step, doing: Doing, error: SdoError) {
        let StageConfig { sdo_timeout: timeout, sdo_attempts, boot_timeout, .. } = self.config;
        let object = step.object;
        match error {
            SdoError::Aborted(code) if step.optional && is_absent(code) => {
                self.tell(StageEvent::Progress(Progress::Skipped(self.axis, object)));
                self.next_step(now);
            }
            SdoError::Aborted(code) => self.fail(match doing {
                Doing::Write(value) => BringUpError::WriteRefused(object, value, code),
                _ => BringUpError::ReadRefused(object, code),
            }),
            error if step.action == Action::Find && now < self.give_up => {
                if matches!(error, SdoError::Timeout(_)) {
                    // It may have been left in NMT Stopped, where no node answers.
                    self.leave_operational();
                }
                self.request(now, doing);
            }
            SdoError::Timeout(_) if step.action == Action::Find => {
                let cob_id = cob::sdo_rx(self.client.node());
                self.fail(BringUpError::NoAnswer(cob_id, boot_timeout));
            }
            _ if self.attempts < sdo_attempts => self.request(now, doing),
            SdoError::Timeout(_) => {
                self.fail(BringUpError::NoReply { object, timeout, attempts: self.attempts });
            }
            error => self.fail(BringUpError::Sdo(object, error)),
        }
    }

    fn handle_read(&mut self, now: Time, step: Step, received: SdoValue) {
        let object = step.object;
        let mismatch = |expected| BringUpError::Mismatch { object, expected, received };
        match (self.doing, step.action) {
            (Doing::ReadBack(written), _) if reads_as(object, written, received) => {
                self.next_step(now);
            }
            (Doing::ReadBack(written), _) => self.fail(mismatch(written)),

            (_, Action::Find) => match received.to_u32() as u16 {
                DRIVE_PROFILE => self.next_step(now),
                received => self.fail(BringUpError::Profile(received)),
            },
            (_, Action::Read(reading)) => match self.take(reading, object, received) {
                Ok(()) => self.next_step(now),
                Err(error) => self.fail(error),
            },
            (_, Action::Expect { value, mask }) if received.to_u32() & mask == value => {
                self.next_step(now);
            }
            (_, Action::Expect { value, .. }) => self.fail(mismatch(value.into())),
            (_, Action::Await(value)) if reads_as(object, value, received) => self.next_step(now),
            (_, Action::Await(value)) if now >= self.give_up => self.fail(mismatch(value)),
            (_, Action::Await(_)) => {
                self.attempts = 0;
                self.doing = Doing::Pause(now + POLL_PERIOD);
            }
            (_, Action::DisablePdo) => {
                const OFF: u32 = 1 << 31;
                match received.to_u32() {
                    cob_id if cob_id & OFF != 0 => self.next_step(now),
                    cob_id => self.go_on(now, Doing::Write((cob_id | OFF).into())),
                }
            }
            (_, Action::Write(_) | Action::Command(_) | Action::SeedTarget | Action::Limit(_)) => {}
        }
    }

    /// Takes what was read for what it says.
    fn take(
        &mut self,
        reading: Reading,
        object: ObjectAddress,
        received: SdoValue,
    ) -> Result<(), BringUpError> {
        let value = received.to_u32();
        let drive = self.config.axis(self.axis);
        let check = |expected: Option<u32>| match expected {
            Some(expected) if expected != value => {
                Err(BringUpError::Identity { object, expected, received: value })
            }
            _ => Ok(()),
        };
        match reading {
            Reading::Vendor => {
                self.identity.vendor = value;
                check(drive.vendor)?;
            }
            Reading::Product => {
                self.identity.product = value;
                check(drive.product)?;
            }
            Reading::Revision => self.identity.revision = Some(value),
            Reading::Serial => self.identity.serial = Some(value),
            Reading::SupportedModes => {
                self.tell(StageEvent::Identity(self.axis, self.identity));
                let mode = if self.homed { Mode::HOMING } else { Mode::CSP };
                if !mode.is_in(value) {
                    return Err(BringUpError::NoMode(mode, value));
                }
            }
            Reading::Homed => {
                let bit = drive.homing.map_or(0, |homing| homing.homed_bit);
                let statusword = Statusword(value as u16);
                if value.checked_shr(bit.into()).unwrap_or(0) & 1 == 0 {
                    return Err(BringUpError::NotHomed(statusword, bit));
                }
            }
            Reading::Statusword => self.take_statusword(Statusword(value as u16)),
            Reading::ErrorCode => {
                if let Some(fault) = &mut self.found_in_fault {
                    fault.error_code = Some(EmcyCode(value as u16));
                }
            }
            Reading::ErrorHistory => {
                if let Some(fault) = &mut self.found_in_fault {
                    fault.history = Some(value);
                }
            }
            Reading::Position => match received.as_bytes().try_into() {
                Ok(bytes) => self.position = i32::from_le_bytes(bytes),
                Err(_) => {
                    return Err(BringUpError::Length(object, received.as_bytes().len()));
                }
            },
        }
        Ok(())
    }

    /// Of a drive found in Fault it is read why; without leave to reset it nothing else is done.
    fn take_statusword(&mut self, statusword: Statusword) {
        let faulty =
            matches!(statusword.state(), Some(DriveState::Fault | DriveState::FaultReactionActive));
        self.disarmed = true;
        if !faulty {
            return;
        }
        self.found_in_fault = Some(FoundFault { statusword, error_code: None, history: None });
        let plan = std::mem::take(&mut self.steps);
        let mut plan = plan.into_iter();
        let statusword_step = plan.next().into_iter();
        self.steps = match self.config.fault_reset_on_start {
            true => statusword_step.chain(fault_plan().into_iter().take(1)).chain(plan).collect(),
            false => statusword_step.chain(fault_plan()).collect(),
        };
    }

    /// The drive's own limit, counts: the soft limit, and beyond it what the axis may be from its
    /// target. The bench's limits refuse; these hold when the bench does not.
    fn limit_counts(&self, end: End) -> i32 {
        let drive = self.config.axis(self.axis);
        let AxisConfig { limits, sign, .. } = drive;
        let margin = drive.following_error_window();
        let upper = (end == End::Max) == (*sign == Sign::Positive);
        let value = if upper { limits.max + margin } else { limits.min - margin };
        let counts = drive.scale(self.axis, self.position.into()).counts(value);
        let fits = counts.and_then(|counts| i32::try_from(counts).ok());
        fits.unwrap_or(if end == End::Max { i32::MAX } else { i32::MIN })
    }

    fn tell(&mut self, event: StageEvent) {
        self.outputs.push_back(BringUpOutput::Stage(Output::Event(event)));
    }

    fn leave_operational(&mut self) {
        let frame = nmt_frame(NmtCommand::EnterPreOperational, Some(self.client.node()));
        self.outputs.push_back(BringUpOutput::Stage(Output::Transmit(frame)));
    }

    fn fail(&mut self, error: BringUpError) {
        self.steps.clear();
        self.client.cancel();
        self.doing = Doing::Read;
        self.outputs.push_back(BringUpOutput::Failed(error));
    }
}

/// True when `received` is what `written` reads as. An expedited answer may leave out how many of its
/// four bytes are the object's (CiA 301, 7.2.4.3.6); the others are then zero. Bit 30 of a PDO's COB-ID (remote requests) is
/// fixed in many drives and of no consequence here.
fn reads_as(object: ObjectAddress, written: SdoValue, received: SdoValue) -> bool {
    let is_pdo_cob_id =
        matches!(object.index, 0x1400..=0x15ff | 0x1800..=0x19ff) && object.subindex == 1;
    let ignored = if is_pdo_cob_id { 1 << 30 } else { 0 };
    let length = received.as_bytes().len();
    (length == written.as_bytes().len() || length == UNSIZED)
        && (written.to_u32() ^ received.to_u32()) & !ignored == 0
}
