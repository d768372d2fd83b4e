//! The emulated tracker: noisy tip positions at a fixed rate. It may repeat a position as if it were new.

use super::noise::{CorrelatedNoise, WhiteNoise};
use super::truth::Truth;
use crate::geometry::Pose;
use crate::units::Time;
use nalgebra::{Rotation3, Vector2, Vector3};
use std::collections::VecDeque;
use std::time::Duration;

/// The settings of an emulated tracker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerModel {
    /// Noise of each position, independent of that of all others.
    pub noise: WhiteNoise,
    /// Noise that is correlated in time, added to it.
    pub correlated: Option<CorrelatedNoise>,
    /// Seed of the noise.
    pub seed: u64,
    /// Interval between two positions.
    pub period: Duration,
    /// Time from a position's acquisition to its arrival at the bench.
    pub latency: Duration,
    /// How many times each position is repeated with a new timestamp, as programs do that send faster
    /// than they acquire images.
    pub repeats: u32,
}

impl TrackerModel {
    /// Interval between two measurements: a repeated position is measured once.
    pub fn interval(&self) -> Duration {
        self.period * self.repeats.saturating_add(1)
    }

    /// True if the positions have no noise.
    pub fn is_exact(&self) -> bool {
        self.noise.variance_mm2() == 0.0 && self.correlated.is_none()
    }

    /// The noise of position number `k`, mm. It depends on the model and `k` only.
    pub fn noise_mm(&self, k: u64) -> Vector3<f64> {
        let white_mm = self.noise.draw(self.seed, k);
        self.correlated.map_or(white_mm, |noise| {
            white_mm + noise.draw(self.seed, k, self.interval().as_secs_f64())
        })
    }

    /// Variance of each coordinate of a mean of many positions, times their number, mm².
    pub fn long_mean_variance_mm2(&self) -> f64 {
        let interval_s = self.interval().as_secs_f64();
        let correlated = self.correlated.map(|noise| noise.long_mean_variance_mm2(interval_s));
        self.noise.variance_mm2() + correlated.unwrap_or_default()
    }
}

/// Changes the seed for the noise of the target, so that it differs from the noise of the tip.
const TARGET_SEED: u64 = 0x7a96_e700_0000_0000;

/// The emulated target: tissue moves as the needle goes in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetModel {
    /// Its position before the insertion, plane frame, mm.
    pub start_mm: Vector3<f64>,
    /// How far it moves with each millimetre that is inserted, mm.
    pub drift_mm_per_mm: Vector3<f64>,
}

impl TargetModel {
    /// Its position at this depth, plane frame, mm.
    pub fn position_mm(&self, insertion_mm: f64) -> Vector3<f64> {
        self.start_mm + self.drift_mm_per_mm * insertion_mm.max(0.0)
    }

    /// The tracker of the target: like that of the tip, with noise of its own.
    pub fn tracker_model(of_tip: TrackerModel) -> TrackerModel {
        TrackerModel { seed: of_tip.seed ^ TARGET_SEED, ..of_tip }
    }
}

/// A tracked position on its way to the bench.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedTip {
    /// When the tip had this pose.
    pub acquisition_time: Time,
    /// Sensor pose `X_TS` in tracker frame T, position in mm with its noise. For a sensor on the needle's
    /// axis the rotation has the tip's heading and no roll, as a coil with five degrees of freedom reports
    /// it.
    pub x_ts: Pose,
}

/// Samples the tip at a fixed rate and delivers each sample after a fixed latency.
#[derive(Debug, Clone)]
pub(crate) struct EmulatedTracker {
    model: TrackerModel,
    /// Pose `X_TP` of the plane frame in the tracker frame.
    x_tp: Pose,
    /// Pose `X_BS` of the sensor in the tip's frame.
    x_bs: Pose,
    next: Time,
    /// Positions measured so far.
    measured: u64,
    /// The last measurement, and how many repeats of it remain.
    last: Option<(Pose, u32)>,
    /// Samples on their way, with their time of arrival and the truth at acquisition.
    in_flight: VecDeque<(Time, TrackedTip, Truth)>,
}

impl EmulatedTracker {
    pub(crate) fn new(model: TrackerModel, x_tp: Pose, x_bs: Pose, start: Time) -> Self {
        EmulatedTracker {
            model,
            x_tp,
            x_bs,
            next: start,
            measured: 0,
            last: None,
            in_flight: VecDeque::new(),
        }
    }

    /// When the next sample is due to be taken.
    pub(crate) fn next_acquisition(&self) -> Time {
        self.next
    }

    /// Takes the sample that is due; the true tip pose is `X_PB`.
    pub(crate) fn acquire(&mut self, tip_true: &Pose) {
        let acquisition_time = self.next;
        let (x_ts, repeats) = match self.last {
            Some((x_ts, repeats)) if repeats > 0 => (x_ts, repeats - 1),
            _ => (self.measure(tip_true), self.model.repeats),
        };
        self.last = Some((x_ts, repeats));
        let sample = TrackedTip { acquisition_time, x_ts };
        let arrival = acquisition_time + self.model.latency;
        self.in_flight.push_back((arrival, sample, Truth { x_pb: *tip_true, target_mm: None }));
        self.next = acquisition_time + self.model.period;
    }

    fn measure(&mut self, tip_true: &Pose) -> Pose {
        let exact = self.x_tp * *tip_true * self.x_bs;
        let is_on_axis = self.x_bs.translation.xy() == Vector2::zeros()
            && self.x_bs.rotation == Rotation3::identity();
        let rotation = if is_on_axis { without_roll(&exact.rotation) } else { exact.rotation };
        let noise_mm = self.model.noise_mm(self.measured);
        self.measured += 1;
        Pose { rotation, translation: exact.translation + noise_mm }
    }

    /// The next sample that has arrived by `now`, with the truth of its acquisition.
    pub(crate) fn deliver(&mut self, now: Time) -> Option<(TrackedTip, Truth)> {
        let (_, sample, truth) = self.in_flight.pop_front_if(|(arrival, ..)| *arrival <= now)?;
        Some((sample, truth))
    }

    /// When the next sample is taken or arrives.
    pub(crate) fn deadline(&self) -> Time {
        self.in_flight.front().map_or(self.next, |&(arrival, ..)| arrival.min(self.next))
    }
}

/// A rotation with the same z axis and no turn about it.
fn without_roll(rotation: &Rotation3<f64>) -> Rotation3<f64> {
    let heading = rotation * Vector3::z();
    Rotation3::rotation_between(&Vector3::z(), &heading)
        .unwrap_or_else(|| Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tracker(noise: WhiteNoise, latency_ms: u64, repeats: u32) -> EmulatedTracker {
        let model = TrackerModel {
            noise,
            correlated: None,
            seed: 7,
            period: Duration::from_millis(25),
            latency: Duration::from_millis(latency_ms),
            repeats,
        };
        EmulatedTracker::new(model, Pose::identity(), Pose::identity(), Time::ZERO)
    }

    #[test]
    fn samples_arrive_after_their_latency_with_their_own_time() {
        let mut tracker = tracker(WhiteNoise::None, 40, 0);
        let pose = |z_mm| Pose { translation: Vector3::z() * z_mm, ..Pose::identity() };
        tracker.acquire(&pose(1.0));
        assert_eq!(tracker.deadline(), Time::from_secs_f64(0.025));
        tracker.acquire(&pose(2.0));
        assert_eq!(tracker.deliver(Time::from_secs_f64(0.039)), None);
        let (sample, truth) = tracker.deliver(Time::from_secs_f64(0.040)).unwrap();
        assert_eq!(sample.acquisition_time, Time::ZERO);
        assert_eq!(truth.x_pb, pose(1.0));
    }

    #[test]
    fn the_kth_position_has_the_kth_noise() {
        for noise in [WhiteNoise::Uniform(1.0), WhiteNoise::Gaussian(0.5)] {
            let mut tracker = tracker(noise, 0, 0);
            for k in 0..50 {
                tracker.acquire(&Pose::identity());
                let (sample, _) = tracker.deliver(Time::NEVER).unwrap();
                assert_eq!(sample.x_ts.translation, noise.draw(7, k));
            }
        }
    }

    #[test]
    fn a_repeated_position_has_a_new_stamp_and_an_old_value() {
        let mut tracker = tracker(WhiteNoise::Uniform(1.0), 0, 4);
        let samples: Vec<(TrackedTip, Truth)> = (0..10u32)
            .map(|n| {
                let translation = Vector3::z() * f64::from(n);
                tracker.acquire(&Pose { translation, ..Pose::identity() });
                tracker.deliver(Time::NEVER).unwrap()
            })
            .collect();
        for (n, (sample, truth)) in samples.iter().enumerate() {
            let measured = &samples[n - n % 5];
            assert_eq!(sample.x_ts, measured.0.x_ts);
            assert_eq!(
                truth.x_pb.translation.z, n as f64,
                "the true pose at the time of the stamp"
            );
        }
        assert_ne!(samples[4].0.x_ts, samples[5].0.x_ts);
        assert_eq!(samples[9].0.acquisition_time, Time::from_secs_f64(0.225));
    }

    #[test]
    fn the_target_drifts_with_the_depth() {
        let target = TargetModel {
            start_mm: Vector3::new(0.0, 5.0, 100.0),
            drift_mm_per_mm: Vector3::new(0.0, 0.03, 0.0),
        };
        assert_eq!(target.position_mm(-1.0), target.start_mm, "no drift before the insertion");
        assert!((target.position_mm(100.0) - Vector3::new(0.0, 8.0, 100.0)).norm() < 1e-12);
    }
}
