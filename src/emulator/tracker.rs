//! The emulated tracker: noisy tip positions at a fixed rate.

use super::truth::Truth;
use crate::geometry::Pose;
use crate::units::Time;
use nalgebra::{Rotation3, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::collections::VecDeque;
use std::time::Duration;

/// Noise added to each coordinate of a tracked position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Noise {
    /// None: the position is exact.
    None,
    /// Uniform within ± so many mm.
    Uniform(f64),
    /// Gaussian of this standard deviation, mm.
    Gaussian(f64),
}

impl Noise {
    fn draw(self, rng: &mut impl Rng) -> Vector3<f64> {
        Vector3::from_fn(|_, _| match self {
            Noise::None => 0.0,
            Noise::Uniform(half_mm) => half_mm * (2.0 * rng.random::<f64>() - 1.0),
            Noise::Gaussian(sd_mm) => sd_mm * standard_normal(rng),
        })
    }
}

/// A draw from the standard normal distribution (Box and Muller).
fn standard_normal(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// A tracked position on its way to the bench.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedTip {
    /// When the tip was there.
    pub acquisition_time: Time,
    /// Sensor pose `X_TB` in tracker frame T, position in mm with its noise. The rotation has the
    /// tip's heading and no roll, as a coil of five degrees of freedom reports it.
    pub x_tb: Pose,
}

/// Samples the tip at a fixed rate and delivers each sample after a fixed latency.
#[derive(Debug, Clone)]
pub(crate) struct EmulatedTracker {
    period: Duration,
    latency: Duration,
    noise: Noise,
    rng: Pcg64,
    /// Pose `X_TP` of the plane frame in the tracker frame.
    x_tp: Pose,
    next: Time,
    /// Samples on their way, with their arrival and the truth of their acquisition.
    under_way: VecDeque<(Time, TrackedTip, Truth)>,
}

impl EmulatedTracker {
    pub(crate) fn new(
        period: Duration,
        latency: Duration,
        noise: Noise,
        seed: u64,
        x_tp: Pose,
        start: Time,
    ) -> Self {
        let rng = Pcg64::seed_from_u64(seed);
        EmulatedTracker {
            period,
            latency,
            noise,
            rng,
            x_tp,
            next: start,
            under_way: VecDeque::new(),
        }
    }

    /// When the next sample is due to be taken.
    pub(crate) fn next_acquisition(&self) -> Time {
        self.next
    }

    /// Takes the sample that is due, of the true tip `X_PB`.
    pub(crate) fn acquire(&mut self, tip_true: &Pose) {
        let acquisition_time = self.next;
        let exact = self.x_tp * *tip_true;
        let heading = exact.rotation * Vector3::z();
        let rotation = Rotation3::rotation_between(&Vector3::z(), &heading).unwrap_or_else(|| {
            Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
        });
        let translation = exact.translation + self.noise.draw(&mut self.rng);
        let sample = TrackedTip { acquisition_time, x_tb: Pose { rotation, translation } };
        let arrival = acquisition_time + self.latency;
        self.under_way.push_back((arrival, sample, Truth::new(*tip_true)));
        self.next = acquisition_time + self.period;
    }

    /// The next sample that has arrived by `now`, with the truth of its acquisition.
    pub(crate) fn deliver(&mut self, now: Time) -> Option<(TrackedTip, Truth)> {
        let (_, sample, truth) = self.under_way.pop_front_if(|(arrival, ..)| *arrival <= now)?;
        Some((sample, truth))
    }

    /// When the tracker next has something to do.
    pub(crate) fn deadline(&self) -> Time {
        self.under_way.front().map_or(self.next, |&(arrival, ..)| arrival.min(self.next))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tracker(noise: Noise, latency_ms: u64) -> EmulatedTracker {
        let period = Duration::from_millis(25);
        let latency = Duration::from_millis(latency_ms);
        EmulatedTracker::new(period, latency, noise, 7, Pose::identity(), Time::ZERO)
    }

    #[test]
    fn samples_arrive_after_their_latency_with_their_own_time() {
        let mut tracker = tracker(Noise::None, 40);
        let pose = |z_mm| Pose { translation: Vector3::z() * z_mm, ..Pose::identity() };
        tracker.acquire(&pose(1.0));
        assert_eq!(tracker.deadline(), Time::from_secs_f64(0.025));
        tracker.acquire(&pose(2.0));
        assert_eq!(tracker.deliver(Time::from_secs_f64(0.039)), None);
        let (sample, truth) = tracker.deliver(Time::from_secs_f64(0.040)).unwrap();
        assert_eq!(sample.acquisition_time, Time::ZERO);
        assert_eq!(truth.x_pb(), &pose(1.0));
    }

    #[test]
    fn noise_has_the_spread_it_is_told() {
        for (noise, variance) in [(Noise::Uniform(1.0), 1.0 / 3.0), (Noise::Gaussian(0.5), 0.25)] {
            let mut tracker = tracker(noise, 0);
            let (mut sum, mut squares) = (0.0, 0.0);
            for _ in 0..20_000 {
                tracker.acquire(&Pose::identity());
                let (sample, _) = tracker.deliver(Time::NEVER).unwrap();
                let p = sample.x_tb.translation;
                assert!(!matches!(noise, Noise::Uniform(half) if p.amax() > half));
                sum += p.sum();
                squares += p.norm_squared();
            }
            assert!((sum / 60_000.0).abs() < 0.02 && (squares / 60_000.0 - variance).abs() < 0.01);
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_stream() {
        let draw = || {
            let mut tracker = tracker(Noise::Uniform(1.0), 0);
            tracker.acquire(&Pose::identity());
            tracker.deliver(Time::ZERO)
        };
        assert_eq!(draw(), draw());
    }
}
