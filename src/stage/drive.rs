//! One drive under SYNC: what it was commanded, and what it reported.

use std::time::Duration;

use super::answers::Answers;
use super::bring_up::BringUpState;
use super::cycle::Reading;
use super::event::{DriveReport, may_have_power};
use super::homing::is_at_home;
use super::standstill::Standstill;
use super::{Axis, AxisConfig, AxisUse, Commanded, DriveFlag, LimitCheck, StageConfig, Unwrapper};
use crate::canopen::cia402::{Controlword, DriveState, EnableSequence, Statusword};
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::{Frame, cob};
use crate::units::Time;

/// Longest time from Fault Reset to the end of the fault.
const RESET_TIMEOUT: Duration = Duration::from_millis(500);
/// A TPDO1 shows the effect of a stop after this many SYNCs: the drive takes the controlword at the first, and the
/// TPDO1 after that may have been sampled before.
const STOP_SYNCS: u64 = 2;
/// A drive takes a command to stop within this time.
const OBEYS_WITHIN: Duration = Duration::from_millis(20);
/// The bits that a drive on its way to Operation Enabled keeps once it has shown them.
const BEFORE_POWER: u16 = Statusword::REMOTE | Statusword::VOLTAGE_ENABLED;

/// The one reset of a drive that was found in Fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FaultReset {
    /// The drive was not found in Fault, or that fault is over.
    None,
    /// To be sent. The code of the fault (0x603F) is `None` if the drive lacks that object.
    Due(Option<EmcyCode>),
    /// Sent this many SYNCs ago.
    Sent(u32),
}

/// Counts the rising edges of a bit of the statusword while the drive had to follow its targets.
#[derive(Debug, Default)]
pub(super) struct RisingEdges {
    was_set: bool,
    count: u64,
}

impl RisingEdges {
    /// Takes the bit of the next statusword. Returns the count at the 1st, 2nd, 4th, 8th … rising edge.
    pub(super) fn take(&mut self, is_set: bool) -> Option<u64> {
        let was_set = std::mem::replace(&mut self.was_set, is_set);
        let rises = is_set && !was_set;
        self.count += u64::from(rises);
        (rises && self.count.is_power_of_two()).then_some(self.count)
    }
}

/// A drive as the SYNC cycle sees it.
#[derive(Debug)]
pub(super) struct Drive {
    axis: Axis,
    config: AxisConfig,
    sync_period: Duration,
    pub(super) purpose: AxisUse,
    /// Scale and limits, once the drive is [armed](Self::arm).
    armed: Option<LimitCheck>,
    pub(super) commanded: Commanded,
    /// The target for the next SYNC; without one the axis is held.
    pub(super) next_counts: Option<i64>,
    /// RPDO1 as it was sent since the last SYNC.
    sent_ahead: Option<Frame>,
    pub(super) position: Unwrapper,
    /// The SYNC after which the newest position came.
    position_sync: u64,
    pub(super) statusword: Option<Statusword>,
    /// The SYNC after which it came. A statusword from before `off_sync` does not show that power is off.
    statusword_sync: u64,
    off_sync: u64,
    /// The SYNC after which the last stop began.
    stop_sync: u64,
    pub(super) answers: Answers,
    /// In this stop the bench has sent its node to Pre-operational, in which it takes no RPDO1.
    pub(super) sent_to_pre_operational: bool,
    sequence: EnableSequence,
    reset: FaultReset,
    /// SYNCs that the drive has stayed in a state that it is commanded to leave.
    transition_syncs: u32,
    /// Bit 11 (internal limit active).
    pub(super) limited: RisingEdges,
    /// The bits that the statusword has shown since the drive was enabled; those of `BEFORE_POWER` count from
    /// the first statusword.
    shown: u16,
    /// Bit 7 (warning).
    pub(super) warnings: RisingEdges,
    /// SYNCs in a row without a new target, and how many of them may be due to lost answers.
    held_syncs: u32,
    held_syncs_max: u32,
    pub(super) reading: Reading,
    /// Its position at home, counts, if it is to be homed and that is known.
    home_counts: Option<i32>,
    /// How far its bring-up had come, if that was abandoned.
    pub(super) abandoned: BringUpState,
    /// It has restarted since its bring-up.
    pub(super) restarted: bool,
    /// The last emergency message, and how many times in a row it came.
    emcy: (Option<Emcy>, u64),
    pub(super) controlword: Controlword,
    pub(super) standstill: Standstill,
}

impl Drive {
    /// The drive of an axis that is used for this `purpose`.
    pub(super) fn new(config: &StageConfig, axis: Axis, purpose: AxisUse) -> Self {
        Drive {
            axis,
            config: config.axis(axis).clone(),
            sync_period: config.bus.sync_period(),
            purpose,
            armed: None,
            commanded: Commanded { counts: 0, step_counts: 0 },
            next_counts: None,
            sent_ahead: None,
            position: Unwrapper::new(0),
            position_sync: 0,
            statusword: None,
            statusword_sync: 0,
            off_sync: 0,
            stop_sync: 0,
            answers: Answers::default(),
            sent_to_pre_operational: false,
            sequence: EnableSequence::default(),
            reset: FaultReset::None,
            transition_syncs: 0,
            limited: RisingEdges::default(),
            shown: 0,
            warnings: RisingEdges::default(),
            held_syncs: 0,
            held_syncs_max: config.bus.missed_feedback_max.max(1).into(),
            reading: Reading::begun(Time::ZERO),
            home_counts: None,
            abandoned: BringUpState::default(),
            restarted: false,
            emcy: (None, 0),
            controlword: Controlword::DISABLE_VOLTAGE,
            standstill: config.standstill(axis),
        }
    }

    /// True in homing mode: the drive follows no target, and its position is not known.
    pub(super) fn in_homing_mode(&self) -> bool {
        matches!(self.purpose, AxisUse::Home { .. })
    }

    /// Takes the position that the bring-up has read, and its `state`.
    pub(super) fn take_bring_up(&mut self, position: i32, state: BringUpState) {
        self.seed(position);
        self.home_counts = state.home_counts;
        if let Some(fault) = state.found_in_fault {
            self.reset = FaultReset::Due(fault.error_code);
        }
    }

    /// Makes `position`, where the axis stands, its target.
    fn seed(&mut self, position: i32) {
        self.position = Unwrapper::new(position);
        self.commanded = Commanded { counts: position.into(), step_counts: 0 };
    }

    /// Takes the payload of TPDO1 after a SYNC, as [`plan::TPDO1`](super::plan::TPDO1) maps it.
    pub(super) fn take_tpdo(&mut self, payload: [u8; 6], sync: u64) {
        let [s0, s1, p0, p1, p2, p3] = payload;
        self.take_statusword(Statusword(u16::from_le_bytes([s0, s1])), sync);
        self.take_position(i32::from_le_bytes([p0, p1, p2, p3]), sync);
        // Until the drive follows its target, the target follows the drive.
        if self.armed.is_none() || self.in_homing_mode() {
            self.commanded = Commanded { counts: self.position.counts(), step_counts: 0 };
        }
    }

    /// Takes a statusword, received by PDO or SDO after the SYNC of this number.
    pub(super) fn take_statusword(&mut self, statusword: Statusword, sync: u64) {
        self.statusword = Some(statusword);
        self.statusword_sync = sync;
        self.end_reset(statusword.state());
        use DriveState as S;
        self.shown = match statusword.state() {
            Some(S::OperationEnabled) => self.shown | statusword.0,
            Some(S::SwitchOnDisabled | S::ReadyToSwitchOn | S::SwitchedOn) => {
                (self.shown | statusword.0) & BEFORE_POWER
            }
            _ => 0,
        };
    }

    /// Takes a position, received by PDO or SDO after the SYNC of this number.
    pub(super) fn take_position(&mut self, position: i32, sync: u64) {
        let counts = self.position.unwrap(position);
        let syncs = u32::try_from(sync - self.position_sync).unwrap_or(u32::MAX);
        self.position_sync = sync;
        self.standstill.take(counts, self.sync_period.saturating_mul(syncs));
    }

    /// RPDO1 with the target for the next SYNC, to be sent before that is due.
    pub(super) fn rpdo_ahead(&mut self, next_counts: i64) -> Frame {
        self.next_counts = Some(next_counts);
        let rpdo = self.rpdo(next_counts);
        self.sent_ahead = Some(rpdo);
        rpdo
    }

    /// RPDO1 with the present target; `None` if this very frame was sent ahead of the SYNC.
    pub(super) fn rpdo_due(&mut self) -> Option<Frame> {
        let rpdo = self.rpdo_now();
        (self.sent_ahead.take() != Some(rpdo)).then_some(rpdo)
    }

    /// RPDO1 with the present target, which replaces one that was sent ahead of the SYNC.
    pub(super) fn rpdo_now(&self) -> Frame {
        self.rpdo(self.commanded.counts)
    }

    /// RPDO1, as [`plan::RPDO1`](super::plan::RPDO1) maps it.
    fn rpdo(&self, target_counts: i64) -> Frame {
        let [c0, c1] = self.controlword.0.to_le_bytes();
        // Truncated to 32 bits: a target that the limits allow beyond them wraps.
        let [t0, t1, t2, t3] = (target_counts as i32).to_le_bytes();
        let cob_id = cob::rpdo1(self.config.node);
        Frame::new(cob_id, &[c0, c1, t0, t1, t2, t3])
    }

    /// The controlword one step nearer to Operation Enabled; the last step is to be sent only together with
    /// the other drive's. One rising edge of Fault Reset leads a drive out of the Fault that it was found in.
    pub(super) fn next_controlword(&mut self) -> Controlword {
        let Some(statusword) = self.statusword.filter(|_| self.answers.fresh) else {
            return self.controlword;
        };
        if let FaultReset::Sent(syncs) = &mut self.reset {
            *syncs = syncs.saturating_add(1);
            return Controlword::DISABLE_VOLTAGE;
        }
        let controlword = self.sequence.step(statusword);
        if controlword.has(Controlword::FAULT_RESET_BIT) {
            self.reset = FaultReset::Sent(0);
        }
        controlword
    }

    /// Withdraws the reset once the fault that the drive was found in is over, by the reset or by itself.
    /// Another fault is a new one, which is not reset.
    fn end_reset(&mut self, state: Option<DriveState>) {
        let same_fault = match self.reset {
            FaultReset::None => false,
            FaultReset::Due(_) => state.is_some_and(DriveState::is_fault),
            FaultReset::Sent(_) => state == Some(DriveState::Fault),
        };
        if !same_fault {
            self.reset = FaultReset::None;
        }
    }

    /// Whether an emergency message with this code belongs to the fault that the drive was found in, whose
    /// reset was not sent yet.
    pub(super) fn is_of_found_fault(&self, code: EmcyCode) -> bool {
        self.reset == FaultReset::Due(Some(code))
    }

    /// Whether the fault that the drive was found in may not be over yet.
    pub(super) fn may_be_in_found_fault(&self) -> bool {
        match self.reset {
            FaultReset::None => false,
            FaultReset::Due(_) => true,
            FaultReset::Sent(syncs) => self.sync_period.saturating_mul(syncs) < RESET_TIMEOUT,
        }
    }

    /// Returns the statusword if the drive has stayed for longer than `timeout` in a state on the way to Switched On
    /// that it is commanded to leave. Call it once a SYNC.
    pub(super) fn count_transition(&mut self, timeout: Duration) -> Option<Statusword> {
        let is_commanded_on = matches!(
            (self.state(), self.controlword),
            (Some(DriveState::SwitchOnDisabled), Controlword::SHUTDOWN)
                | (Some(DriveState::ReadyToSwitchOn), Controlword::SWITCH_ON)
        );
        self.transition_syncs =
            if is_commanded_on { self.transition_syncs.saturating_add(1) } else { 0 };
        let waited = self.sync_period.saturating_mul(self.transition_syncs);
        self.statusword.filter(|_| waited > timeout)
    }

    /// The bits that an enabled drive must show.
    fn flags(&self) -> impl Iterator<Item = DriveFlag> + use<> {
        // In homing mode bit 12 says that the axis is homed.
        let homing_mode = self.in_homing_mode();
        let means_homed = move |flag: &DriveFlag| homing_mode && *flag == DriveFlag::FollowsCommand;
        DriveFlag::ALL.into_iter().filter(move |flag| !means_homed(flag))
    }

    /// A bit that the drive has set before and has cleared now. While an internal limit is active, a drive
    /// may clear bit 12: if it then stays behind its target, the following error stops the run.
    pub(super) fn lost_flag(&self) -> Option<DriveFlag> {
        let word = self.statusword?;
        self.flags().find(|flag| {
            let was_lost = self.shown & !word.0 & *flag as u16 != 0;
            let may_clear =
                *flag == DriveFlag::FollowsCommand && word.has(Statusword::INTERNAL_LIMIT);
            was_lost && !may_clear
        })
    }

    /// The bits that the enabled drive has not set yet, so that their loss could not be noticed.
    pub(super) fn flags_not_shown(&self) -> impl Iterator<Item = DriveFlag> + use<> {
        let shown = self.shown;
        self.flags().filter(move |flag| shown & *flag as u16 == 0)
    }

    /// Notes `emcy`. Returns whether to report it: a repeated one is reported only the 2nd, 4th, 8th … time.
    pub(super) fn note_emcy(&mut self, emcy: Emcy) -> bool {
        let count = if self.emcy.0 == Some(emcy) { self.emcy.1 + 1 } else { 1 };
        self.emcy = (Some(emcy), count);
        count.is_power_of_two()
    }

    /// Reports the next emergency message even if it repeats the last one.
    pub(super) fn restart_emcy_count(&mut self) {
        self.emcy.1 = 0;
    }

    /// Fixes zero, scale and limits: from here on the drive follows its target.
    ///
    /// # Errors
    /// The limit outside which the axis stands.
    pub(super) fn arm(&mut self) -> Result<(), String> {
        let limits = self.limits_from_here();
        if self.purpose == AxisUse::Steer {
            limits.check_position(limits.scale.value(self.commanded.counts))?;
        }
        self.armed = Some(limits);
        Ok(())
    }

    pub(super) fn is_armed(&self) -> bool {
        self.armed.is_some()
    }

    /// Scale and limits; before the drive is armed, as they would be if it were armed now.
    pub(super) fn limits(&self) -> LimitCheck {
        self.armed.unwrap_or_else(|| self.limits_from_here())
    }

    /// Scale and limits. If the axis has no configured zero, its present target is zero.
    fn limits_from_here(&self) -> LimitCheck {
        let AxisConfig { limits, wraps, quick_stop_deceleration, .. } = self.config;
        let scale = self.config.scale(self.axis, self.commanded.counts);
        LimitCheck::new(self.axis, scale, limits, self.sync_period, wraps)
            .with_quick_stop(quick_stop_deceleration)
    }

    /// Where the axis reads and where its home is, mm or rad, if it is not there; `None` also if that is not known.
    pub(super) fn off_home(&self) -> Option<(f64, f64)> {
        let scale = self.config.scale(self.axis, 0);
        // The low 32 bits of the unwrapped position are the last reading.
        let here = i64::from(self.position.counts() as i32);
        let [here, home] = [here, self.home_counts?.into()].map(|counts| scale.value(counts));
        (!is_at_home(self.axis, here - home)).then_some((here, home))
    }

    /// Restarts from the drive's last reading after homing, which has changed the drive's zero. Returns the position,
    /// mm or rad.
    pub(super) fn take_home(&mut self) -> f64 {
        // The low 32 bits of the unwrapped position are the last reading.
        self.seed(self.position.counts() as i32);
        self.armed = Some(self.limits_from_here());
        self.measured()
    }

    /// Checks that the axis may be at `goal` (mm or rad).
    pub(super) fn check_goal(&self, goal: f64) -> Result<(), String> {
        match self.purpose {
            AxisUse::Steer => self.limits().check_position(goal).map(drop),
            _ => self.limits().check_position_from(goal, self.commanded.counts).map(drop),
        }
    }

    /// The counts of `target` (mm or rad), if the axis may go there next.
    pub(super) fn check(&self, target: f64) -> Result<i64, String> {
        self.limits().check(target, self.commanded)
    }

    /// Makes the next target the present one; without a next one the axis is held. A hold of no more SYNCs than
    /// answers may be lost is no commanded acceleration: the step after it is compared with the step before it.
    pub(super) fn advance_target(&mut self) {
        if let Some(counts) = self.next_counts.take() {
            let step_counts = counts - self.commanded.counts;
            self.commanded = Commanded { counts, step_counts };
            self.held_syncs = 0;
            return;
        }
        self.held_syncs = self.held_syncs.saturating_add(1);
        if self.held_syncs > self.held_syncs_max {
            self.commanded.step_counts = 0;
        }
    }

    /// Measured position, mm or rad.
    pub(super) fn measured(&self) -> f64 {
        self.limits().scale.value(self.position.counts())
    }

    /// The target that was sent last, mm or rad; before the drive is armed, where the axis stands.
    pub(super) fn commanded(&self) -> f64 {
        self.limits().scale.value(self.commanded.counts)
    }

    /// Target minus position, mm or rad; 0 before the drive is armed.
    pub(super) fn following_error(&self) -> f64 {
        if self.is_armed() { self.commanded() - self.measured() } else { 0.0 }
    }

    /// The fault of a measured position that is too far from the target, whether or not the drive reports it.
    pub(super) fn following_error_fault(&self) -> Option<String> {
        let following_error = self.following_error();
        let limit = self.config.following_error_limit(self.sync_period);
        if following_error.abs() <= limit {
            return None;
        }
        let (error, limit) = (self.axis.shown(following_error), self.axis.in_unit(limit).0);
        Some(format!(
            "following error of {error} (limit {limit:.3}); is the axis blocked, or the encoder lost?"
        ))
    }

    pub(super) fn state(&self) -> Option<DriveState> {
        self.statusword.and_then(Statusword::state)
    }

    pub(super) fn is_enabled(&self) -> bool {
        self.state() == Some(DriveState::OperationEnabled)
    }

    pub(super) fn report(&self) -> DriveReport {
        let statusword = self.statusword.or(self.abandoned.statusword);
        let found_code = self.abandoned.found_in_fault.and_then(|fault| fault.error_code);
        let reported_code = self.emcy.0.map(|emcy| emcy.code);
        let error = reported_code.or(found_code).filter(|code| *code != EmcyCode::NO_ERROR);
        let state = statusword.and_then(Statusword::state);
        DriveReport { state, error, restarted: self.restarted }
    }

    /// Begins a stop after the SYNC of this number. In a quick stop the axis does not count as standing before it can
    /// have braked. If the drive was commanded to switch on, a statusword from before the stop does not show that it is
    /// off.
    pub(super) fn begin_stop(&mut self, now: Time, sync: u64, quick: bool) {
        self.next_counts = None;
        self.stop_sync = sync;
        let braking = if quick { self.braking_time() } else { Duration::ZERO };
        self.standstill.watch_braking(self.position.counts(), braking);
        self.reading = Reading::begun(now);
        if self.controlword.has(Controlword::SWITCH_ON_BIT) {
            self.off_sync = sync + STOP_SYNCS;
        }
    }

    /// How long the quick stop takes from the commanded speed; in homing mode from the highest homing speed.
    fn braking_time(&self) -> Duration {
        let AxisConfig { homing, quick_stop_deceleration, .. } = self.config;
        let speeds = homing.filter(|_| self.in_homing_mode()).map(|homing| {
            [homing.speed_switch, homing.speed_zero].into_iter().flatten().fold(0.0, f64::max)
        });
        let counts_per_s =
            self.commanded.step_counts.unsigned_abs() as f64 / self.sync_period.as_secs_f64();
        let speed = speeds.unwrap_or(counts_per_s / self.limits().scale.counts_per_unit());
        let braking_s = quick_stop_deceleration.map_or(0.0, |by| speed / by);
        Duration::try_from_secs_f64(braking_s).unwrap_or(Duration::MAX)
    }

    /// True if the drive is in Operation Enabled although it has had time to take the command to stop.
    pub(super) fn ignores_stop(&self) -> bool {
        let syncs = OBEYS_WITHIN.div_duration_f64(self.sync_period) as u64;
        self.is_enabled() && self.statusword_sync >= self.stop_sync + syncs.max(STOP_SYNCS)
    }

    /// True if the motor has no power, or is losing it.
    pub(super) fn is_off(&self) -> bool {
        !may_have_power(self.state()) && self.statusword_sync >= self.off_sync
    }
}
