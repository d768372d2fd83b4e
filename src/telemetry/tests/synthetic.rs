//! A synthetic run by the needle's kinematics, with every kind of record of a real one.

use crate::canopen::Frame;
use crate::emulator::Truth;
use crate::geometry::{FixedAngles, Pose, Twist};
use crate::needle::{Increment, Needle};
use crate::observer::Estimate;
use crate::session::{
    Decision, Direction, Lane, Record, SampleRecord, Severity, State, StepRecord,
};
use crate::stage::{Feedback, SetPoint};
use crate::telemetry::Entry;
use crate::tracker::{Sample, Validity};
use crate::units::{Time, wrap_angle};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

const CURVATURE_PER_MM: f64 = 1.0 / 122.0;

/// A run of `steps` mm at 1 mm/s, each step with `syncs` SYNC cycles and at most 20 tracker samples.
pub(in crate::telemetry) fn run(steps: u32, syncs: u32) -> Vec<Entry> {
    let needle = Needle::new(CURVATURE_PER_MM).unwrap();
    let mut run = Run {
        entries: Vec::new(),
        noise: 1,
        tip: Pose {
            rotation: FixedAngles { yaw: 0.0, pitch: -0.06, roll: 0.6 }.to_rotation(),
            translation: Vector3::new(4.0, 0.0, 0.0),
        },
        rotation_rad: 0.0,
    };
    run.bring_up();
    for step in 0..steps {
        let time = Time::from_secs_f64(2.0 + f64::from(step));
        let rate = run.rotation_rate();
        run.step(step, time, rate);
        for sync in 0..syncs {
            let part = f64::from(sync) / f64::from(syncs);
            let time = Time::from_secs_f64(time.as_secs_f64() + part);
            run.cycle(time, f64::from(step) + part, rate * part, sync % syncs.div_ceil(20) == 0);
        }
        run.tip = needle.step(&run.tip, Increment::new(1.0, rate).unwrap());
        run.rotation_rad += rate;
    }
    let end = Time::from_secs_f64(2.0 + f64::from(steps));
    run.state(end, State::Completed);
    run.entries
}

/// Replaces numbers in `entry` by `value`.
pub(super) fn spoil(entry: &mut Entry, value: f64) {
    match &mut entry.record {
        Record::Stage(stage) => {
            stage.measured.insertion_mm = value;
            stage.commanded.rotation_rad = value;
        }
        Record::Sample(sample) | Record::Target(sample) => {
            sample.received.position_mm.x = value;
            let quaternion = Quaternion::new(value, value, value, value);
            sample.received.orientation = Some(UnitQuaternion::new_unchecked(quaternion));
        }
        Record::Step(step) => {
            step.insertion_meas_mm = value;
            step.decision.rotation_cmd_rad_per_mm = Some(value);
            step.tip_meas_mm = Some(Vector3::repeat(value));
            step.innovation_mm = Some(Vector3::repeat(value));
            if let Some(estimate) = &mut step.decision.estimate {
                estimate.x_pb.translation.y = value;
                estimate.sd = Some([value; 6]);
            }
            let mut x_pb = entry.truth.as_ref().unwrap().x_pb;
            x_pb.translation.x = value;
            entry.truth = Some(Truth { x_pb, target_mm: None });
        }
        Record::Begun { .. }
        | Record::Input { .. }
        | Record::Can { .. }
        | Record::Drive { .. }
        | Record::State { .. }
        | Record::Event { .. } => {}
    }
}

struct Run {
    entries: Vec<Entry>,
    noise: u64,
    tip: Pose,
    rotation_rad: f64,
}

impl Run {
    /// Uniform noise from −1 to 1 (MMIX's linear congruential generator).
    fn noise(&mut self) -> f64 {
        self.noise = self
            .noise
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.noise >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// Steers into the plane: the distance gives the pitch, the pitch the roll, and the roll the rotation rate.
    fn rotation_rate(&self) -> f64 {
        let FixedAngles { pitch, roll, .. } = FixedAngles::from_rotation(&self.tip.rotation);
        let pitch_wanted = -(0.02 * self.tip.translation.x).clamp(-0.15, 0.15);
        let roll_wanted = (8.0 * (pitch_wanted - pitch)).clamp(-0.9, 0.9).asin();
        (0.3 * wrap_angle(roll_wanted - roll)).clamp(-0.3, 0.3)
            + CURVATURE_PER_MM * roll.cos() * pitch.tan()
    }

    fn push(&mut self, record: Record) {
        self.entries.push(Entry { record, truth: None });
    }

    fn state(&mut self, time: Time, state: State) {
        self.push(Record::State { time, state });
    }

    fn frame(&mut self, time: Time, cob_id: u16, data: &[u8]) {
        let sent = matches!(cob_id, 0x000 | 0x080 | 0x200..=0x27F | 0x600..=0x67F);
        let direction = if sent { Direction::Sent } else { Direction::Received };
        self.push(Record::Can { time, direction, frame: Frame::new(cob_id, data) });
    }

    fn bring_up(&mut self) {
        let at = Time::from_secs_f64;
        self.state(at(0.0), State::Preparing);
        self.state(at(0.0), State::AwaitingTip);
        self.frame(at(0.001), 0x000, &[0x82, 0]);
        for (node, begun) in [(1u16, 0.1), (2, 0.5)] {
            let at = |time| at(begun + time);
            self.frame(at(0.0), 0x700 + node, &[0]);
            for sub in 1..=4u8 {
                let time = at(0.1 + 0.01 * f64::from(sub));
                self.frame(time, 0x600 + node, &[0x40, 0x18, 0x10, sub, 0, 0, 0, 0]);
                self.frame(time, 0x580 + node, &[0x43, 0x18, 0x10, sub, 0xFB, 0, 0, 0]);
            }
            self.frame(at(0.2), 0x600 + node, &[0x2F, 0x60, 0x60, 0, 8, 0, 0, 0]);
            self.frame(at(0.21), 0x580 + node, &[0x60, 0x60, 0x60, 0, 0, 0, 0, 0]);
        }
        self.frame(at(1.0), 0x000, &[1, 0]);
        self.state(at(1.0), State::Enabled);
        self.state(at(1.2), State::Tracking);
        self.state(at(2.0), State::Inserting);
        self.state(at(2.0), State::RollUnknown);
        self.state(at(40.0), State::Estimating);
        self.state(at(2.0), State::Saturated);
        self.state(at(20.0), State::Steering);
        self.push(Record::Event {
            time: at(2.0),
            lane: Lane::Session,
            severity: Severity::Info,
            text: "insertion of 150.0 mm at 1.0 mm/s begins".to_owned(),
        });
    }

    fn cycle(&mut self, time: Time, depth_mm: f64, rotated_rad: f64, sample: bool) {
        let counts = (depth_mm * 1000.0) as i32;
        let [a, b, c, d] = counts.to_le_bytes();
        for cob_id in [0x201, 0x202] {
            self.frame(time, cob_id, &[0x1F, 0, a, b, c, d]);
        }
        self.frame(time, 0x080, &[]);
        for cob_id in [0x181, 0x182] {
            self.frame(time, cob_id, &[0x37, 0x16, a, b, c, d]);
        }
        let rotation_cmd_rad = self.rotation_rad + rotated_rad;
        let rotation_meas_rad = rotation_cmd_rad + 1e-4 * self.noise();
        self.push(Record::Stage(Feedback {
            time,
            sync: 0,
            measured: SetPoint { insertion_mm: depth_mm - 0.01, rotation_rad: rotation_meas_rad },
            commanded: SetPoint { insertion_mm: depth_mm, rotation_rad: rotation_cmd_rad },
        }));
        if sample {
            let position = self.measure();
            self.push(Record::Sample(SampleRecord {
                received: Sample {
                    receive_time: time,
                    source_unix_ns: Some(1_700_000_000_000_000_000 + time.as_nanos()),
                    tool: "Needle".to_owned(),
                    position_mm: position,
                    orientation: None,
                    validity: Validity::Valid,
                },
                position_plane_mm: Some(position),
                acquisition_time: Some(Time::from_nanos(time.as_nanos() - 20_000_000)),
                refused: None,
            }));
        }
    }

    fn measure(&mut self) -> Vector3<f64> {
        self.tip.translation + Vector3::new(self.noise(), self.noise(), self.noise())
    }

    /// The error of the estimate is a screw that decays with depth.
    fn step(&mut self, step: u32, time: Time, rate: f64) {
        let fade = (-f64::from(step) / 25.0).exp();
        let screw = Twist {
            v: Vector3::new(-2.0, 1.0, 0.5) * fade,
            w: Vector3::new(0.05, -0.04, 0.9) * fade,
        };
        let x_pb = self.tip * Pose::exp(&screw);
        let sd = [0.3, 0.3, 0.2, 0.01, 0.01, 0.03].map(|sd| sd * (1.0 + 6.0 * fade));
        let tip_meas_mm = self.measure();
        let step = StepRecord {
            step,
            time,
            insertion_meas_mm: f64::from(step),
            rotation_meas_rad: self.rotation_rad,
            tip_positions: 1,
            tip_meas_mm: Some(tip_meas_mm),
            tip_meas_insertion_mm: Some(f64::from(step)),
            tip_meas_age_s: Some(0.02),
            innovation_mm: Some(tip_meas_mm - x_pb.translation),
            decision: Decision {
                estimate: (step > 2).then_some(Estimate { x_pb, sd: Some(sd), belief: None }),
                shadows: vec![("finite-difference".to_owned(), Some(Estimate::of_pose(x_pb)))],
                rotation_cmd_rad_per_mm: Some(rate),
                command_saturated: step < 20,
                ..Decision::default()
            },
        };
        let truth = Some(Truth { x_pb: self.tip, target_mm: None });
        self.entries.push(Entry { record: Record::Step(Box::new(step)), truth });
    }
}
