//! The emulated stage as the bench sees it: drives, needle and tracker.

use super::drive::{Drive, DriveConfig};
use super::fault::{Fault, FaultKind, FaultyLine, Script, ScriptEvent, Toward};
use super::tissue::{Shares, Tissue};
use super::tracker::{EmulatedTracker, TargetModel, TrackedTip, TrackerModel};
use super::truth::Truth;
use crate::canopen::Frame;
use crate::geometry::Pose;
use crate::needle::{Needle, Torsion};
use crate::units::Time;
use nalgebra::Vector3;
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// At most this many frames are forwarded in one call; the others wait for the next call. So two drives that
/// are mapped to answer each other's PDOs cannot block the caller.
const FORWARDED_MAX: usize = 256;

/// The configuration of the virtual stage.
///
/// Counts per unit convert a drive's counts to motion; they are negative where the drive counts the other
/// way. The emulator converts in floating point and does not use the bench's exact scaling, so that an
/// error there does not cancel.
#[derive(Debug, Clone)]
pub struct VirtualStageConfig {
    /// The insertion drive, and counts per mm.
    pub insertion: (DriveConfig, f64),
    /// The rotation drive, and counts per turn.
    pub rotation: (DriveConfig, f64),
    /// The true needle.
    pub needle: Needle,
    /// The true torsion of its shaft.
    pub torsion: Torsion,
    /// True tip pose `X_PB` at the start, plane frame.
    pub start: Pose,
    /// Pose `X_TP` of the plane frame in the tracker frame.
    pub x_tp: Pose,
    /// Pose `X_BS` of the tracked sensor in the tip's frame.
    pub x_bs: Pose,
    /// The tracker's noise, rate and latency.
    pub tracker: TrackerModel,
    /// The target, where the tracker sees it as a tool of its own.
    pub target: Option<TargetModel>,
    /// The scripted faults.
    pub faults: Vec<Fault>,
}

/// An output of the virtual stage.
#[derive(Debug, Clone, PartialEq)]
pub enum StageOutput {
    /// A frame of one of the drives.
    Frame(Frame),
    /// A tracked tip position.
    Tip {
        /// The position that the tracker reports.
        tip: TrackedTip,
        /// The true tip pose when it was acquired; without a target.
        truth: Truth,
    },
    /// The tracked target.
    Target(TrackedTip),
    /// A scripted fault begins.
    FaultBegan(Fault),
}

/// The virtual stage, sans-IO: `handle_frame`, `handle_timeout`, drain `poll()`, wait until
/// `deadline()`.
#[derive(Debug)]
pub struct VirtualStage {
    /// Insertion, then rotation, as in all pairs here.
    drives: [Drive; 2],
    /// From the bus to each drive.
    to_drive: [FaultyLine; 2],
    /// From each drive to the bus.
    from_drive: [FaultyLine; 2],
    counts_per_unit: [f64; 2],
    origin_counts: [f64; 2],
    tissue: Tissue,
    tracker: EmulatedTracker,
    target: Option<(TargetModel, EmulatedTracker)>,
    script: Script,
    /// Frames for the drives that wait for the end of [`FaultKind::BusStuck`].
    held: Vec<Frame>,
    outputs: VecDeque<StageOutput>,
}

impl VirtualStage {
    /// A stage switched on at `now`.
    pub fn new(config: VirtualStageConfig, now: Time) -> Self {
        let (insertion, counts_per_mm) = config.insertion;
        let (rotation, counts_per_turn) = config.rotation;
        let drives = [Drive::new(insertion), Drive::new(rotation)];
        let target = config.target.map(|target| {
            let model = TargetModel::tracker_model(config.tracker);
            (target, EmulatedTracker::new(model, config.x_tp, Pose::identity(), now))
        });
        let mut stage = VirtualStage {
            target,
            origin_counts: drives.each_ref().map(|drive| drive.position_counts_at(now)),
            drives,
            to_drive: Default::default(),
            from_drive: Default::default(),
            counts_per_unit: [counts_per_mm, counts_per_turn],
            tissue: Tissue::new(config.needle, config.torsion, config.start),
            tracker: EmulatedTracker::new(config.tracker, config.x_tp, config.x_bs, now),
            script: Script::new(&config.faults, now),
            held: Vec::new(),
            outputs: VecDeque::new(),
        };
        stage.drain_drives(now);
        stage
    }

    /// Takes a frame from the bus. The needle first moves to the present position of the drives, so that
    /// a target latched by this frame acts from here on only.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.handle_timeout(now);
        match self.bus_fault() {
            None => self.send_to_both(now, frame),
            Some(FaultKind::BusStuck) => self.held.push(*frame),
            Some(_) => {}
        }
        self.drain_drives(now);
    }

    /// Does what is due by `now`.
    pub fn handle_timeout(&mut self, now: Time) {
        while self.tracker.next_acquisition() <= now {
            self.move_needle(self.tracker.next_acquisition());
            self.tracker.acquire(self.tissue.tip_true());
        }
        self.sample_target(now);
        self.move_needle(now);
        while let Some(event) = self.script.poll(now, self.position_true(now).0) {
            self.apply(now, event);
        }
        for drive in &mut self.drives {
            if drive.deadline() <= now {
                drive.handle_timeout(now);
            }
        }
        for drive in 0..2 {
            self.deliver_to(drive, now);
            self.forward_from(drive, now);
        }
        self.drain_drives(now);
        while let Some((tip, truth)) = self.tracker.deliver(now) {
            self.outputs.push_back(StageOutput::Tip { tip, truth });
        }
        while let Some((seen, _)) = self.target.as_mut().and_then(|(_, t)| t.deliver(now)) {
            self.outputs.push_back(StageOutput::Target(seen));
        }
    }

    /// Takes the samples of the target that are due.
    fn sample_target(&mut self, now: Time) {
        while let Some(due) = self.target.as_ref().map(|(_, tracker)| tracker.next_acquisition())
            && due <= now
        {
            let translation = self.target_true_mm(due).unwrap_or_default();
            if let Some((_, tracker)) = &mut self.target {
                tracker.acquire(&Pose { translation, ..Pose::identity() });
            }
        }
    }

    /// The true target, where there is one.
    fn target_true_mm(&self, now: Time) -> Option<Vector3<f64>> {
        let (insertion_mm, _) = self.position_true(now);
        self.target.as_ref().map(|(target, _)| target.position_mm(insertion_mm))
    }

    /// The next output.
    pub fn poll(&mut self) -> Option<StageOutput> {
        self.outputs.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        let drives = self.drives.iter().map(Drive::deadline);
        let lines = self.to_drive.iter().chain(&self.from_drive).map(FaultyLine::deadline);
        let own = [self.tracker.deadline(), self.script.deadline()];
        let target = self.target.iter().map(|(_, tracker)| tracker.deadline());
        drives.chain(lines).chain(own).chain(target).min().unwrap_or(Time::NEVER)
    }

    /// The present fault of the bus; if there are several, the first in the script. A bus with a fault carries
    /// no frame.
    pub fn bus_fault(&self) -> Option<FaultKind> {
        self.script.active().map(|fault| fault.kind).find(|kind| kind.is_of_bus())
    }

    /// How many frames for the drives wait for the end of [`FaultKind::BusStuck`].
    pub fn frames_held(&self) -> usize {
        self.held.len()
    }

    /// The true tip pose at the last call, and the target at `now`.
    pub fn truth(&self, now: Time) -> Truth {
        Truth { x_pb: *self.tissue.tip_true(), target_mm: self.target_true_mm(now) }
    }

    /// True depth, mm, and rotation, rad, at `now`, relative to the position at power-on.
    pub fn position_true(&self, now: Time) -> (f64, f64) {
        let units = |n: usize| {
            let counts = self.drives[n].position_counts_at(now) - self.origin_counts[n];
            counts / self.counts_per_unit[n]
        };
        (units(0), units(1) * TAU)
    }

    /// The insertion drive and the rotation drive.
    pub fn drives(&self) -> [&Drive; 2] {
        self.drives.each_ref()
    }

    fn move_needle(&mut self, now: Time) {
        let (insertion_mm, rotation_rad) = self.position_true(now);
        let left = |kind: FaultKind| -> f64 {
            let faults = self.script.active().filter(|fault| fault.kind == kind);
            faults.map(Fault::share_left).product()
        };
        self.tissue.set_shares(Shares {
            curvature: left(FaultKind::Tissue),
            turn: left(FaultKind::ChuckSlip),
            advance: left(FaultKind::Buckling),
        });
        self.tissue.advance(insertion_mm, rotation_rad);
    }

    /// Sends a frame of the bus to both drives.
    fn send_to_both(&mut self, now: Time, frame: &Frame) {
        (0..2).for_each(|drive| self.send_to(drive, now, frame));
    }

    /// Sends a frame of the bus to `drive`.
    fn send_to(&mut self, drive: usize, now: Time, frame: &Frame) {
        self.to_drive[drive].handle(now, frame);
        self.deliver_to(drive, now);
    }

    /// Gives `drive` the frames that have arrived.
    fn deliver_to(&mut self, drive: usize, now: Time) {
        while let Some(frame) = self.to_drive[drive].poll(now) {
            self.drives[drive].handle_frame(now, &frame);
        }
    }

    /// Forwards the frames that have arrived from `drive` to the outside and to the other drive, as on a
    /// real bus.
    fn forward_from(&mut self, drive: usize, now: Time) {
        while let Some(frame) = self.from_drive[drive].poll(now) {
            if self.bus_fault().is_none() {
                self.send_to(1 - drive, now, &frame);
                self.outputs.push_back(StageOutput::Frame(frame));
            }
        }
    }

    /// Forwards the frames that the drives send.
    fn drain_drives(&mut self, now: Time) {
        for _ in 0..FORWARDED_MAX {
            let sent = (0..2).find_map(|n| Some((n, self.drives[n].poll_transmit()?)));
            let Some((drive, frame)) = sent else { return };
            self.from_drive[drive].handle(now, &frame);
            self.forward_from(drive, now);
        }
    }

    /// Applies an event of the script.
    fn apply(&mut self, now: Time, event: ScriptEvent) {
        match event {
            ScriptEvent::Begins(fault, end) => {
                self.outputs.push_back(StageOutput::FaultBegan(fault.clone()));
                for n in (0..2).filter(|n| fault.concerns(*n)) {
                    self.add_frame_faults(n, end, &fault);
                    self.change_drive(n, now, &fault, true);
                }
            }
            ScriptEvent::Ends(fault) => {
                self.release_held(now);
                for n in (0..2).filter(|n| fault.concerns(*n)) {
                    let is_same = |other: &Fault| other.kind == fault.kind && other.concerns(n);
                    if !self.script.active().any(is_same) {
                        self.change_drive(n, now, &fault, false);
                    }
                }
            }
            ScriptEvent::Foreign(frame) if self.bus_fault().is_none() => {
                self.send_to_both(now, &frame);
                self.outputs.push_back(StageOutput::Frame(frame));
            }
            ScriptEvent::Foreign(_) => {}
        }
    }

    /// Sends the frames that the bench's interface held, once it no longer holds them. Another fault of the
    /// bus loses them.
    fn release_held(&mut self, now: Time) {
        let bus_fault = self.bus_fault();
        if bus_fault == Some(FaultKind::BusStuck) {
            return;
        }
        for frame in std::mem::take(&mut self.held) {
            if bus_fault.is_none() {
                self.send_to_both(now, &frame);
                self.drain_drives(now);
            }
        }
    }

    /// Adds to the lines of drive `n` what `fault` does to its frames until `end`.
    fn add_frame_faults(&mut self, n: usize, end: Time, fault: &Fault) {
        let id = fault.frame_id(self.drives[n].id());
        let changes_frames = |toward: Toward| match fault.kind {
            FaultKind::Silent => true,
            // A restart without a duration takes no time.
            FaultKind::Restart => fault.duration.is_some(),
            kind => kind.has("frames") && fault.toward == toward,
        };
        if changes_frames(Toward::Bench) {
            self.from_drive[n].add(fault.clone(), id, end);
        }
        if changes_frames(Toward::Drives) {
            self.to_drive[n].add(fault.clone(), id, end);
        }
    }

    /// A fault of drive `n` (0 insertion, 1 rotation) begins or ends; what is due by `now` has been done.
    pub fn change_drive(&mut self, n: usize, now: Time, fault: &Fault, begins: bool) {
        self.drives[n].apply_fault(now, fault, begins);
        // The drive's answer goes through the lines as they are now.
        self.drain_drives(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::units::at_ms;

    fn stage(faults: &[&str]) -> VirtualStage {
        let set = format!("emulator.fault=[{}]", faults.join(", "));
        let config = Config::from_sources(&[], &[set]).expect("valid");
        VirtualStage::new(config.virtual_stage().expect("valid"), Time::ZERO)
    }

    /// First byte of the statusword that the insertion drive sends on request; `None` without an answer.
    fn statusword(stage: &mut VirtualStage, now: Time) -> Option<u8> {
        stage.handle_frame(now, &Frame::new(0x601, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]));
        let answers = std::iter::from_fn(|| stage.poll()).filter_map(|output| match output {
            StageOutput::Frame(frame) if frame.cob_id() == Some(0x581) => Some(frame.data()[4]),
            _ => None,
        });
        answers.last()
    }

    #[test]
    fn overlapping_faults_each_last_their_own_time() {
        let mut stage = stage(&[
            r#"{ kind = "no-voltage", at_s = 0.1, duration_s = 0.3, axis = "insertion" }"#,
            r#"{ kind = "no-voltage", at_s = 0.2, duration_s = 0.1 }"#,
            r#"{ kind = "bus-down", at_s = 0.5, duration_s = 0.3 }"#,
            r#"{ kind = "bus-off", at_s = 0.6, duration_s = 0.1 }"#,
        ]);
        let (with_voltage, without) = (Some(0x50), Some(0x40));
        for (ms, answer) in [
            (0, with_voltage),
            (150, without),
            (250, without),
            (350, without),
            (450, with_voltage),
            (550, None),
            (650, None),
            (750, None),
            (850, with_voltage),
        ] {
            assert_eq!(statusword(&mut stage, at_ms(ms)), answer, "at {ms} ms");
            let is_down = (500..800).contains(&ms);
            assert_eq!(stage.bus_fault(), is_down.then_some(FaultKind::BusDown), "at {ms} ms");
        }
    }

    #[test]
    fn held_frames_are_sent_at_the_end_or_lost_with_the_interface() {
        for (down, answers) in [("", 1), (r#"{ kind = "bus-down", at_s = 0.15 }"#, 0)] {
            let stuck = r#"{ kind = "bus-stuck", at_s = 0.1, duration_s = 0.1 }"#;
            let mut stage = stage(&[stuck, down]);
            assert_eq!(statusword(&mut stage, at_ms(120)), None);
            assert_eq!(stage.frames_held(), 1);
            [160, 250].into_iter().for_each(|ms| stage.handle_timeout(at_ms(ms)));
            let frames = std::iter::from_fn(|| stage.poll());
            let frames = frames.filter(|output| matches!(output, StageOutput::Frame(_)));
            assert_eq!((frames.count(), stage.frames_held()), (answers, 0));
        }
    }
}
