//! What the console shows of a run, gathered from its records. It reads no clock, file or terminal.

use crate::canopen::cia402::{DriveState, Statusword};
use crate::canopen::emcy::{Emcy, parse_emcy};
use crate::canopen::{Frame, NodeId};
use crate::config::Config;
use crate::geometry::coordinates;
use crate::session::{
    Approach, Direction, Input, Lane, Progress, Record, Severity, State, StepRecord,
};
use crate::stage::Axis;
use crate::tracker::GateName;
use crate::units::Time;
use std::collections::{BTreeMap, VecDeque};
use std::mem;
use std::path::PathBuf;
use std::time::Duration;

/// The time over which rates are counted.
const RATE_WINDOW: Duration = Duration::from_secs(1);
/// Number of innovations from which the noise is measured.
const INNOVATIONS: usize = 20;
/// Events kept.
const EVENTS: usize = 40;
/// Bits of a CAN frame without its data and without stuffing.
const FRAME_BITS: u64 = 47;

/// What the screen needs to know of the configuration.
#[derive(Debug, Clone, Default)]
pub(super) struct Setup {
    /// Nodes of the insertion and of the rotation drive.
    pub(super) nodes: [u8; 2],
    /// Age at which a tip is too old to steer by, s.
    pub(super) tip_age_max_s: f64,
    /// Configured noise of a coordinate, mm.
    pub(super) noise_sd_mm: f64,
    /// Length of a single step, mm.
    pub(super) step_mm: f64,
    pub(super) speed_max_mm_per_s: f64,
}

impl Setup {
    pub(super) fn of(config: &Config) -> Self {
        let Config { insertion, stage, tracker, .. } = config;
        Setup {
            nodes: [stage.insertion.node, stage.rotation.node].map(NodeId::get),
            tip_age_max_s: tracker.hold.after.as_secs_f64(),
            noise_sd_mm: tracker.gates.track.noise_sd_mm,
            step_mm: insertion.step_mm,
            speed_max_mm_per_s: insertion.speed_mm_per_s,
        }
    }
}

/// One drive.
#[derive(Debug, Clone, Default)]
pub(super) struct Drive {
    pub(super) state: Option<DriveState>,
    /// Position from the start, mm or rad.
    pub(super) position: f64,
    /// Set-point less position, mm or rad.
    pub(super) following_error: f64,
    pub(super) emergency: Option<(Time, Emcy)>,
}

/// Everything on the screen.
#[derive(Debug, Clone, Default)]
pub(super) struct Screen {
    pub(super) setup: Setup,
    pub(super) progress: Progress,
    pub(super) time: Time,
    /// Why the run is in its state, from an event.
    pub(super) why: String,
    /// The answer to the operator's last command, unless it is the reason of the state.
    pub(super) answer: String,
    is_held: bool,
    /// The insertion is held, and the next event of this lane gives the reason.
    reason_due: Option<Lane>,
    /// The operator has asked for something, and the next event of the session answers it.
    is_answer_due: bool,
    /// x, y, z in mm and yaw, pitch, roll in rad, with their standard deviations.
    pub(super) pose: Option<([f64; 6], Option<[f64; 6]>)>,
    /// The line about the target; empty without one.
    pub(super) target: String,
    /// Depth, and the estimated x, y and z at each step, mm.
    pub(super) path: Vec<[f64; 4]>,
    samples: VecDeque<(Time, ())>,
    pub(super) refused: BTreeMap<GateName, u64>,
    innovations: VecDeque<f64>,
    pub(super) drives: [Drive; 2],
    frames: VecDeque<(Time, u64)>,
    /// Where the run is recorded.
    pub(super) folder: Option<PathBuf>,
    pub(super) record_bytes: u64,
    pub(super) record_trouble: Option<String>,
    pub(super) events: VecDeque<(Severity, String)>,
    pub(super) faults: u32,
    /// Number of alarms; each rings the bell. The first fault or hold by the tracker since the needle last moved
    /// is an alarm.
    pub(super) alarms: u32,
    is_alarmed: bool,
    /// The operator has stopped the run, which is not an alarm.
    pub(super) is_interrupted: bool,
    /// Messages and commands that found their queue full.
    pub(super) dropped: u64,
    pub(super) is_over: bool,
    /// How the needle can be withdrawn after the run, or why it cannot; `None` until that is known.
    pub(super) withdrawal: Option<Result<String, String>>,
    /// The operator is asked whether to withdraw the needle.
    pub(super) asks_to_withdraw: bool,
    pub(super) has_help: bool,
}

impl Screen {
    pub(super) fn new(setup: Setup) -> Self {
        Screen { setup, ..Screen::default() }
    }

    /// Takes a record of the run; events come by [`Screen::event`].
    pub(super) fn take(&mut self, record: &Record) {
        match record {
            Record::Can { time, direction, frame } => self.take_frame(*time, *direction, frame),
            Record::Sample(sample) => {
                push_recent(&mut self.samples, sample.received.receive_time, ());
                if let Some(refusal) = &sample.refused {
                    *self.refused.entry(refusal.gate).or_default() += 1;
                }
            }
            Record::Step(step) => self.take_step(step),
            Record::Stage(stage) => {
                self.time = stage.time;
                for (drive, axis) in self.drives.iter_mut().zip(Axis::BOTH) {
                    drive.position = stage.measured.along(axis);
                    drive.following_error = stage.commanded.along(axis) - drive.position;
                }
            }
            Record::State { state, .. } => self.take_state(*state),
            Record::Input { input: Input::Operator(_), .. } => self.is_answer_due = true,
            _ => {}
        }
    }

    fn take_state(&mut self, state: State) {
        match state {
            State::Inserting | State::Stepping => {
                self.why.clear();
                self.answer.clear();
                self.is_alarmed = false;
            }
            State::Holding => {
                self.why.clear();
                self.alarm();
            }
            _ => {}
        }
        if state.lane() == Lane::Session {
            self.reason_due = match state {
                State::Holding => Some(Lane::Tracker),
                // An insertion that begins held was asked for that before.
                State::HeldByOperator if self.is_answer_due => Some(Lane::Session),
                _ => None,
            };
            self.is_held = state.is_held();
        }
    }

    fn take_frame(&mut self, time: Time, direction: Direction, frame: &Frame) {
        self.time = time;
        let data = frame.data();
        let bits = FRAME_BITS + 8 * data.len() as u64;
        push_recent(&mut self.frames, time, bits);
        let Some(id) = frame.cob_id() else { return };
        let emergency = parse_emcy(frame).filter(|_| direction == Direction::Received);
        for (drive, node) in self.drives.iter_mut().zip(self.setup.nodes) {
            if let Some((_, emcy)) = emergency.filter(|(sender, _)| sender.get() == node) {
                drive.emergency = Some((time, emcy));
            }
            if id == 0x180 + u16::from(node)
                && let [low, high, ..] = *data
            {
                drive.state = Statusword(u16::from_le_bytes([low, high])).state();
            }
        }
    }

    fn take_step(&mut self, step: &StepRecord) {
        self.time = step.time;
        if let Some(innovation_mm) = step.innovation_mm {
            self.innovations.push_back(innovation_mm.norm_squared() / 3.0);
            keep_last(&mut self.innovations, INNOVATIONS);
        }
        self.target = step.decision.approach.as_ref().map_or(String::new(), |approach| {
            let Approach { distance_mm, error_mm, path, .. } = approach;
            let path =
                path.as_ref().map_or("-".to_owned(), |path| format!("{:.1}", path.length_mm()));
            format!("  target {distance_mm:.1} mm, {error_mm:.2} off, path {path}")
        });
        if let Some(estimate) = &step.decision.estimate {
            let pose = coordinates(&estimate.x_pb);
            self.pose = Some((pose, estimate.sd));
            self.path.push([step.insertion_meas_mm, pose[0], pose[1], pose[2]]);
        }
    }

    pub(super) fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: &str) {
        let line = format!("{:>8.2} s  {lane}: {text}", time.as_secs_f64());
        self.events.push_back((severity, line));
        keep_last(&mut self.events, EVENTS);
        if severity == Severity::Fault {
            self.faults += 1;
            self.alarm();
        }
        // The first fault explains the end. The first warning of the tracker, or the answer to the operator, explains a
        // hold. No other event in the meantime explains anything.
        let is_answer = lane == Lane::Session && mem::take(&mut self.is_answer_due);
        let is_of_tracker = lane == Lane::Tracker && severity == Severity::Warning;
        let is_reason = self.reason_due == Some(lane) && (is_answer || is_of_tracker);
        if is_reason {
            self.reason_due = None;
        }
        let explains = match severity {
            Severity::Fault => self.faults == 1,
            _ => self.faults == 0 && (is_reason || is_of_tracker && !self.is_held),
        };
        if explains {
            self.why = text.to_owned();
        } else if is_answer {
            self.answer = text.to_owned();
        }
    }

    /// Rings the bell, but only once until the needle moves again: a hold and the fault that ends it are one alarm.
    fn alarm(&mut self) {
        let is_new = !self.is_interrupted && !mem::replace(&mut self.is_alarmed, true);
        self.alarms += u32::from(is_new);
    }

    /// Samples of the tool a second.
    pub(super) fn samples_per_s(&self) -> usize {
        self.samples.iter().filter(|(at, ())| self.time.since(*at) < RATE_WINDOW).count()
    }

    /// RMS of the last innovations, per coordinate, mm.
    pub(super) fn innovation_mm(&self) -> Option<f64> {
        let count = self.innovations.len() as f64;
        (count > 0.0).then(|| (self.innovations.iter().sum::<f64>() / count).sqrt())
    }

    /// Frames a second, and bits a second without stuffing.
    pub(super) fn bus_load(&self) -> (usize, u64) {
        (self.frames.len(), self.frames.iter().map(|(_, bits)| bits).sum())
    }
}

/// Adds `item`, and removes those that are older than a second.
fn push_recent<T>(queue: &mut VecDeque<(Time, T)>, now: Time, item: T) {
    queue.push_back((now, item));
    while queue.front().is_some_and(|(time, _)| now.since(*time) >= RATE_WINDOW) {
        queue.pop_front();
    }
}

fn keep_last<T>(queue: &mut VecDeque<T>, count: usize) {
    queue.drain(..queue.len().saturating_sub(count));
}
