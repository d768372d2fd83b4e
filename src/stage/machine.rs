//! The stage's state machine: distributes frames and time, runs the bring-up, begins and ends stops.

use std::collections::VecDeque;
use std::time::Duration;

use super::bring_up::BringUp;
use super::drive::Drive;
use super::event::DriveReport;
use super::flood::FloodWatch;
use super::homing::Homing;
use super::silence::SilenceTest;
use super::{
    Axis, AxisUse, Counters, Ignored, Output, PerAxis, SetPoint, StageConfig, StageEvent,
    StageProgress,
};
use crate::canopen::cia402::{Controlword, object};
use crate::canopen::heartbeat::{HeartbeatConsumer, HeartbeatProducer};
use crate::canopen::nmt::{NmtCommand, NmtState, nmt_frame};
use crate::canopen::object::communication::consumer_heartbeat;
use crate::canopen::sdo::SdoRequest;
use crate::canopen::sdo::codec::ClientFrame;
use crate::canopen::sync::SyncProducer;
use crate::canopen::{Frame, cob};
use crate::units::Time;

/// The phase of the stage. It never goes back to an earlier one, except from `Homing` to `Ready`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    /// The stage sends nothing, and listens for another master.
    Listening {
        until: Time,
    },
    BringUp,
    /// SYNC runs from here to the end of `Disabling`. The drives are supervised, and get no power before
    /// it is permitted.
    Standby {
        /// When both drives must have answered a SYNC in time.
        give_up: Time,
        /// [`StageEvent::Located`] was emitted.
        located: bool,
    },
    Enabling {
        give_up: Time,
    },
    Ready,
    /// A drive finds its home by itself; the other is held.
    Homing(Homing),
    Stopping {
        quick: bool,
        give_up: Time,
    },
    Disabling {
        quick: bool,
        standing: bool,
        give_up: Time,
    },
    Stopped,
}

/// The master of the two axes; the [module](super) states its contract.
#[derive(Debug)]
pub struct Stage {
    pub(crate) config: StageConfig,
    pub(super) phase: Phase,
    pub(super) bring_ups: PerAxis<Option<BringUp>>,
    pub(super) drives: PerAxis<Drive>,
    pub(super) monitors: PerAxis<HeartbeatConsumer>,
    pub(super) heartbeat: HeartbeatProducer,
    pub(super) sync: SyncProducer,
    pub(super) sync_time: Time,
    pub(super) sync_count: u64,
    pub(super) missed_in_a_row: u32,
    /// When drives that do not obey a quick stop are commanded again by SDO.
    pub(super) repeat_due: Time,
    /// A fault was reported.
    faulted: bool,
    /// The bench has stopped its heartbeat on purpose, see [`Stage::stop_heartbeat`].
    pub(super) silence_test: Option<SilenceTest>,
    /// The positions at the last SYNC before power, counts.
    pub(super) before_power_counts: PerAxis<i64>,
    /// The axes may be given power, see [`Stage::permit_power`].
    pub(super) power_permitted: bool,
    pub(super) counters: Counters,
    pub(super) flood: FloodWatch,
    /// The most SYNC periods that were skipped at once.
    longest_skip: u64,
    outputs: VecDeque<Output>,
}

impl Stage {
    /// A stage that begins at `now`: it listens, then brings up its drives. The configuration must be
    /// [valid](StageConfig::validate).
    pub fn new(config: StageConfig, now: Time) -> Self {
        Self::for_use(config, PerAxis::from_fn(|_| AxisUse::Steer), now)
    }

    /// A stage that begins at `now` and uses each axis for its `purpose`. An axis in homing mode takes no
    /// set-points; [`Stage::home`] homes it.
    pub fn for_use(config: StageConfig, purpose: PerAxis<AxisUse>, now: Time) -> Self {
        let timeout = config.bus.heartbeat_timeout();
        let until = now + config.listen_first;
        let mut stage = Stage {
            phase: Phase::Listening { until },
            bring_ups: PerAxis::default(),
            drives: PerAxis::from_fn(|axis| Drive::new(&config, axis, purpose[axis])),
            monitors: PerAxis::from_fn(|axis| {
                HeartbeatConsumer::new(config.axis(axis).node, timeout)
            }),
            heartbeat: HeartbeatProducer::new(
                config.bus.bench_node,
                Duration::from_millis(config.bus.heartbeat_ms.into()),
                until,
            ),
            sync: SyncProducer::new(config.bus.sync_period(), Time::NEVER),
            sync_time: now,
            sync_count: 0,
            missed_in_a_row: 0,
            repeat_due: Time::NEVER,
            faulted: false,
            silence_test: None,
            before_power_counts: PerAxis::from_fn(|_| 0),
            power_permitted: true,
            counters: Counters::default(),
            flood: FloodWatch::new(now),
            longest_skip: 0,
            outputs: VecDeque::new(),
            config,
        };
        stage.emit(StageEvent::Progress(StageProgress::Listening));
        stage.handle_timeout(now);
        stage
    }

    /// Takes a frame received at `now`.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.flood.frames += 1;
        let Some(cob_id) = frame.cob_id() else { return self.ignore(Ignored::Foreign, frame) };
        self.watch_for_another_master(now, frame);
        for axis in Axis::BOTH {
            let node = self.config.axis(axis).node;
            if cob_id == cob::tpdo1(node) {
                return self.handle_tpdo(now, axis, frame);
            } else if cob_id == cob::heartbeat(node) {
                return self.handle_heartbeat(now, axis, frame);
            } else if cob_id == cob::emcy(node) {
                return self.handle_emcy(now, axis, frame);
            } else if cob_id == cob::sdo_tx(node) {
                return self.handle_sdo(now, axis, frame);
            } else if cob_id == cob::sdo_rx(node)
                && let Some(bring_up) = &mut self.bring_ups[axis]
            {
                bring_up.runner.handle_frame(now, frame);
                self.drain_bring_ups(now);
            }
        }
        let why = if self.is_own(cob_id) { Ignored::OwnIdentifier } else { Ignored::Foreign };
        self.ignore(why, frame);
    }

    /// Does what is due at `now`. Call it at [`deadline`](Self::deadline) or later.
    pub fn handle_timeout(&mut self, now: Time) {
        if let Phase::Listening { until } = self.phase
            && now >= until
        {
            self.phase = Phase::BringUp;
            self.bring_ups = PerAxis::from_fn(|axis| {
                Some(BringUp::new(&self.config, axis, self.drives[axis].purpose, now))
            });
        }
        for axis in Axis::BOTH {
            if let Some(bring_up) = &mut self.bring_ups[axis] {
                bring_up.runner.handle_timeout(now);
            }
            if let Some(event) = self.monitors[axis].handle_timeout(now) {
                self.handle_heartbeat_event(now, axis, event);
            }
        }
        self.drain_bring_ups(now);
        let sync_due = self.sync_due();
        if self.sync_runs()
            && let Some(periods) = self.sync.handle_timeout(now).map(u64::from)
        {
            let late = now.since(sync_due);
            self.counters.sync_late_max = self.counters.sync_late_max.max(late);
            self.note_skipped(periods);
            self.cycle(now);
        }
        // This comes after the SYNC, which must not wait.
        if let Some(frames) = self.flood.check(now) {
            self.emit(StageEvent::Flood(frames));
        }
        if let Some(frame) = self.heartbeat.handle_timeout(now, NmtState::Operational) {
            self.send(frame);
        }
    }

    /// The next frame to send or event to handle. Drain to `None` after every call that may make one.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        let mut deadline = self.heartbeat.deadline();
        if let Phase::Listening { until } = self.phase {
            deadline = deadline.min(until);
        }
        deadline = deadline.min(self.sync_due());
        for axis in Axis::BOTH {
            deadline = deadline.min(self.monitors[axis].deadline());
            if let Some(bring_up) = &self.bring_ups[axis] {
                deadline = deadline.min(bring_up.runner.deadline());
            }
        }
        deadline
    }

    /// When the next SYNC is due.
    pub fn sync_due(&self) -> Time {
        if self.sync_runs() { self.sync.deadline } else { Time::NEVER }
    }

    /// Makes `set_point` the target of both axes at the next SYNC; a later call before that SYNC
    /// replaces it. Without a new set-point the axes are held. RPDO1 takes it to the drives at once, and they
    /// act on it at the SYNC (transmission type 1), so that the SYNC need not wait for it. A stop in between is
    /// sent before that SYNC.
    ///
    /// # Errors
    /// A limit is exceeded, the stage is not ready, or the positions at the last SYNC have not come. Nothing is
    /// sent then, and both axes keep their targets.
    pub fn command(&mut self, set_point: SetPoint) -> Result<(), String> {
        let not_ready = match self.phase {
            Phase::Ready if self.drives.all(|drive| !drive.in_homing_mode()) => None,
            Phase::Ready | Phase::Homing(_) => Some("in homing mode"),
            Phase::Stopping { .. } | Phase::Disabling { .. } => Some("while it stops"),
            Phase::Stopped => Some("after it has stopped"),
            _ => Some("before it is ready"),
        };
        if let Some(why) = not_ready {
            return Err(format!("the stage takes no set-points {why}"));
        }
        if !self.drives.all(|drive| drive.answers.fresh) {
            return Err(format!(
                "the positions at SYNC {} have not arrived; older ones must not be used",
                self.sync_count
            ));
        }
        let counts = PerAxis {
            insertion: self.drives.insertion.check(set_point.insertion_mm)?,
            rotation: self.drives.rotation.check(set_point.rotation_rad)?,
        };
        for axis in Axis::BOTH {
            let rpdo = self.drives[axis].rpdo_ahead(counts[axis]);
            self.send(rpdo);
        }
        Ok(())
    }

    /// Checks `goal` against the position limits of both axes; sends nothing. An axis that is not to be steered may
    /// stand outside its limits, and may come back. Call it only after
    /// [`StageEvent::Located`], since the limits of an axis may count from where it stands.
    ///
    /// # Errors
    /// The position limit that `goal` exceeds.
    pub fn check_goal(&self, goal: SetPoint) -> Result<(), String> {
        Axis::BOTH.into_iter().try_for_each(|axis| self.drives[axis].check_goal(goal.along(axis)))
    }

    /// Permits or forbids to give the axes power; at first it is permitted. While it is forbidden, the drives
    /// are brought up, SYNC runs and everything is supervised, and the axes stay without power. Once enabling
    /// has begun this changes nothing: only a stop takes power off.
    pub fn permit_power(&mut self, permitted: bool) {
        self.power_permitted = permitted;
    }

    /// Stops both axes by the drives' quick stop, then takes power off.
    pub fn quick_stop(&mut self, now: Time) {
        match self.phase {
            Phase::Listening { .. } => {
                self.heartbeat.stop();
                self.end(false, false);
            }
            Phase::BringUp => self.abandon_bring_up(),
            _ => self.begin_quick_stop(now),
        }
    }

    /// Holds both axes until they stand, then takes power off: the orderly end.
    pub fn disable(&mut self, now: Time) {
        match self.phase {
            Phase::Ready => self.begin_stop(now, false),
            _ if self.is_ending() => {}
            _ => self.quick_stop(now),
        }
    }

    /// Frames without effect, missed answers, skipped and late SYNCs.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// The last state and error of each drive.
    pub fn drive_reports(&self) -> PerAxis<DriveReport> {
        PerAxis::from_fn(|axis| self.drives[axis].report())
    }

    /// Where the axes were last measured; `None` before both drives have answered a SYNC.
    pub fn position(&self) -> Option<SetPoint> {
        let both_answered = self.drives.all(|drive| drive.statusword.is_some());
        both_answered.then(|| self.positions(Drive::measured))
    }

    /// True once a stop has begun.
    pub(super) fn is_ending(&self) -> bool {
        matches!(self.phase, Phase::Stopping { .. } | Phase::Disabling { .. } | Phase::Stopped)
    }

    pub(super) fn sync_runs(&self) -> bool {
        !matches!(self.phase, Phase::Listening { .. } | Phase::BringUp | Phase::Stopped)
    }

    /// Reports `fault` and stops. Only the first fault is reported: others follow from it.
    pub(super) fn fail(&mut self, now: Time, fault: String) {
        if self.faulted || self.phase == Phase::Stopped {
            return;
        }
        self.faulted = true;
        self.emit(StageEvent::Fault(fault));
        self.quick_stop(now);
    }

    pub(super) fn send(&mut self, frame: Frame) {
        self.outputs.push_back(Output::Transmit(frame));
    }

    pub(super) fn emit(&mut self, event: StageEvent) {
        self.outputs.push_back(Output::Event(event));
    }

    pub(super) fn send_nmt(&mut self, command: NmtCommand, axis: Axis) {
        self.send(nmt_frame(command, Some(self.config.axis(axis).node)));
    }

    /// Requests to read or write an object, without waiting for the reply.
    pub(super) fn send_sdo(&mut self, axis: Axis, request: SdoRequest) {
        self.send(ClientFrame::Request(request).to_frame(self.config.axis(axis).node));
    }

    /// Writes a controlword, without waiting for the reply.
    pub(super) fn send_controlword(&mut self, axis: Axis, word: Controlword) {
        // In Stopped a node takes neither PDO nor SDO (CiA 301, 7.3.2.2).
        let is_stopped = self.monitors[axis].state() == Some(NmtState::Stopped);
        if is_stopped || self.drives[axis].sent_to_pre_operational {
            self.send_nmt(NmtCommand::EnterPreOperational, axis);
        }
        self.send_sdo(axis, SdoRequest::Download(object::CONTROLWORD, word.0.into()));
    }

    /// Counts SYNC periods that were skipped. A slow machine skips one again and again, so not each is an event.
    fn note_skipped(&mut self, periods: u64) {
        let before = self.counters.syncs_skipped;
        let total = before + periods;
        let is_longest = periods > self.longest_skip;
        self.counters.syncs_skipped = total;
        self.longest_skip = self.longest_skip.max(periods);
        if is_longest || total.checked_ilog2() != before.checked_ilog2() {
            self.emit(StageEvent::SyncSkipped { periods, total });
        }
    }

    pub(super) fn ignore(&mut self, why: Ignored, frame: &Frame) {
        let counter = &mut self.counters.ignored[why as usize];
        *counter += 1;
        let count = *counter;
        if count.is_power_of_two() {
            self.emit(StageEvent::Ignored { why, count, frame: *frame });
        }
    }

    pub(super) fn drain_bring_ups(&mut self, now: Time) {
        for axis in Axis::BOTH {
            let Some(bring_up) = &mut self.bring_ups[axis] else { continue };
            self.outputs.extend(std::iter::from_fn(|| bring_up.runner.poll()));
            match bring_up.runner.outcome().cloned() {
                Some(Ok(position)) => self.finish_bring_up(now, axis, position),
                Some(Err(error)) => {
                    let node = self.config.axis(axis).node;
                    self.fail(now, format!("node {node} ({axis}): {error}"));
                }
                None => {}
            }
        }
    }

    fn finish_bring_up(&mut self, now: Time, axis: Axis, position: i32) {
        let bring_up = self.bring_ups[axis].take();
        let state = bring_up.map(|bring_up| bring_up.state()).unwrap_or_default();
        self.drives[axis].take_bring_up(position, state);
        // Only a heartbeat that comes from here on can say that this stage's start command was obeyed.
        self.monitors[axis].expect_by(now + self.config.bus.heartbeat_timeout());
        if self.bring_ups.all(Option::is_none) {
            for axis in Axis::BOTH {
                self.send_nmt(NmtCommand::StartRemoteNode, axis);
            }
            let give_up = now + self.config.power.enable_timeout;
            self.phase = Phase::Standby { give_up, located: false };
            self.sync.deadline = now + self.config.bus.sync_period();
            self.emit(StageEvent::Progress(StageProgress::Standby));
        }
    }

    /// Ends bring-up without success. An earlier run may have left a drive enabled, so power is taken off. A
    /// heartbeat consumer that this bring-up has not written stays as that run left it. A node that is not
    /// identified is not written to.
    fn abandon_bring_up(&mut self) {
        for axis in Axis::BOTH {
            let (identified, may_be_supervised) = match self.bring_ups[axis].take() {
                Some(mut bring_up) => {
                    bring_up.runner.cancel();
                    let unsent = std::iter::from_fn(|| bring_up.runner.poll());
                    self.outputs.extend(unsent);
                    let abandoned = bring_up.state();
                    self.drives[axis].abandoned = abandoned;
                    (abandoned.identified, abandoned.may_be_supervised)
                }
                None => (true, true),
            };
            if identified {
                self.send_controlword(axis, Controlword::DISABLE_VOLTAGE);
                self.release(axis, may_be_supervised);
            }
        }
        self.end(false, false);
    }

    /// Ends SYNC, with both nodes in Pre-operational. A drive that is known to be without power stops monitoring
    /// the bench: it would go to Fault when the bench's heartbeat ends.
    pub(super) fn finish(&mut self, standing: bool) {
        for axis in Axis::BOTH {
            self.release(axis, self.drives[axis].is_off());
        }
        self.end(standing, self.drives.all(Drive::is_off));
    }

    fn release(&mut self, axis: Axis, end_monitoring: bool) {
        self.send_nmt(NmtCommand::EnterPreOperational, axis);
        if end_monitoring {
            self.send_sdo(axis, SdoRequest::Download(consumer_heartbeat(1), 0_u32.into()));
        }
    }

    fn end(&mut self, standing: bool, off: bool) {
        self.phase = Phase::Stopped;
        self.emit(StageEvent::Stopped { standing, off });
    }
}
