//! Listens to the tracker for a while, without a run.

use crate::tracker::{CoordinateWatch, Event, Gate, GateCounts, GateName, Refusal, Workspace};
use crate::units::Time;
use nalgebra::Vector3;
use serde::Serialize;

/// Fewest positions from which the noise is measured.
pub(super) const POSITIONS_MIN: usize = 10;
/// The pace of stamps is measured over at least this time, s.
const STAMPS_MIN_S: f64 = 0.5;
/// Stamps are coarse if most differ by less than this, ns …
const STAMP_STEP_MIN_NS: u64 = 1_000_000;
/// … between different positions that arrive at least this long after one another, ns.
const ARRIVAL_STEP_MIN_NS: i64 = 5_000_000;
/// If two tools of one name take turns, a position is farther than this from the next, mm …
const TURNS_MIN_MM: f64 = 3.0;
/// … and farther by this factor than from the next but one.
const TURNS_RATIO: f64 = 4.0;

/// What came from the tracker while the bench listened.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackerReport {
    /// Positions of the tool that passed the gates.
    pub accepted: u64,
    /// Positions of the tool that were refused.
    pub refused: u64,
    /// Accepted positions a second.
    pub rate_hz: f64,
    /// The last position in the bench frame, mm, inside the workspace or not.
    pub last_position_bench_mm: Option<[f64; 3]>,
    /// The tip's heading at that position in the bench frame, if the tracker sends orientations.
    pub last_heading_bench: Option<[f64; 3]>,
    /// Standard deviation of a coordinate, mm, from the differences of successive positions: a slow
    /// motion does not count.
    pub noise_sd_mm: Option<f64>,
    /// Smallest difference of receipt and stamp, each by its own clock, s.
    pub stamp_skew_s: Option<f64>,
    /// Seconds by which the stamps advance in a second; `None` if the positions span less than half a second.
    pub stamp_pace: Option<f64>,
    /// True if most stamps hardly differ from the one before, although the positions arrive one by one.
    pub has_coarse_stamps: bool,
    /// True if the last position is outside the workspace, and would be inside if it were in metres.
    pub is_in_metres: bool,
    /// True if positions jump back and forth, as they do if two tools have the same name.
    pub has_two_tools: bool,
    /// The coordinate of the tracker that never changes, and what to look at.
    pub constant_coordinate: Option<String>,
    /// Why no position was measured, and what to do; `None` if one was.
    pub trouble: Option<String>,
}

/// Counts the samples that pass those gates of a run that judge a sample by itself.
#[derive(Debug)]
pub struct Listening {
    gate: Gate,
    /// Kept apart from the gate: a run refuses a tip outside the workspace, the preflight shows where it is.
    workspace: Option<Workspace>,
    /// UTC at the origin of receive times, ns since 1970.
    origin_unix_ns: i64,
    counts: GateCounts,
    positions_mm: Vec<Vector3<f64>>,
    coordinates: CoordinateWatch,
    heading: Option<Vector3<f64>>,
    is_in_metres: bool,
    skew_ns: Option<i64>,
    /// Receipt and stamp of the first and the last sample that has one, ns.
    stamped_ns: Option<[[i64; 2]; 2]>,
    last_stamped_mm: Option<Vector3<f64>>,
    /// Steps from one stamp to the next between different positions that arrive one by one, and how many of them
    /// are too small.
    stamp_steps: [usize; 2],
    refusal: Option<String>,
}

impl Listening {
    /// Listens through `gate`; receive times count from `origin_unix_ns`.
    pub fn new(mut gate: Gate, origin_unix_ns: i64) -> Self {
        let workspace = gate.workspace.take();
        Listening {
            gate,
            workspace,
            origin_unix_ns,
            counts: GateCounts::default(),
            positions_mm: Vec::new(),
            coordinates: CoordinateWatch::default(),
            heading: None,
            is_in_metres: false,
            skew_ns: None,
            stamped_ns: None,
            last_stamped_mm: None,
            stamp_steps: [0; 2],
            refusal: None,
        }
    }

    /// Takes an event of the tool's stream.
    pub fn take(&mut self, event: &Event) {
        let Event::Sample(sample) = event else { return };
        match self.gate.admit(sample) {
            Ok(position_mm) => {
                let outside = self.workspace.and_then(|workspace| workspace.outside(&position_mm));
                self.is_in_metres = outside.is_some()
                    && self.workspace.is_some_and(|workspace| {
                        workspace.fits_in_metres(&self.gate.registration, sample)
                    });
                let outside = outside
                    .map(|outside| Refusal::new(GateName::Workspace, format!("tip at {outside}")));
                self.counts.count(outside.as_ref());
                self.positions_mm.push(position_mm);
                self.coordinates.take(&sample.position_mm);
                self.heading = self.gate.registration.heading(sample);
            }
            Err(refusal) => {
                self.counts.count(Some(&refusal));
                self.refusal = Some(format!("tracker: {refusal}"));
            }
        }
        if let Some(stamp_ns) = sample.source_unix_ns {
            let received_ns = self.origin_unix_ns.saturating_add(sample.receive_time.as_nanos());
            let newest_ns = [received_ns, stamp_ns];
            let is_new =
                self.last_stamped_mm.replace(sample.position_mm) != Some(sample.position_mm);
            if let Some([_, [before_ns, stamp_before_ns]]) = self.stamped_ns
                && is_new
                && received_ns.saturating_sub(before_ns) >= ARRIVAL_STEP_MIN_NS
            {
                self.stamp_steps[0] += 1;
                self.stamp_steps[1] +=
                    usize::from(stamp_ns.abs_diff(stamp_before_ns) < STAMP_STEP_MIN_NS);
            }
            self.stamped_ns.get_or_insert([newest_ns; 2])[1] = newest_ns;
            let skew_ns = received_ns.saturating_sub(stamp_ns);
            self.skew_ns = Some(self.skew_ns.map_or(skew_ns, |least| least.min(skew_ns)));
        }
    }

    /// The report from `since` to `now`. `missing` explains why nothing came from the tool.
    pub fn report(self, since: Time, now: Time, missing: impl FnOnce() -> String) -> TrackerReport {
        let last = self.positions_mm.last();
        // RMS distance between each position and the one `lag` later.
        let jumps_mm = |lag: usize| {
            let pairs = self.positions_mm.iter().zip(self.positions_mm.iter().skip(lag));
            let squares: Vec<f64> = pairs.map(|(a, b)| (b - a).norm_squared()).collect();
            (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
        };
        let stamp_pace = self.stamped_ns.and_then(|[first, last]| {
            let [received_s, stamp_s] =
                [0, 1].map(|i| last[i].saturating_sub(first[i]) as f64 * 1e-9);
            (received_s >= STAMPS_MIN_S).then(|| stamp_s / received_s)
        });
        let (to_next_mm, to_next_but_one_mm) = (jumps_mm(1), jumps_mm(2));
        let is_enough = self.positions_mm.len() >= POSITIONS_MIN;
        let constant = self.coordinates.constant(CoordinateWatch::POSITIONS_AT_REST);
        let trouble = match (last, self.refusal) {
            (Some(_), _) => None,
            (None, Some(refusal)) => Some(refusal),
            (None, None) => Some(missing()),
        };
        TrackerReport {
            accepted: self.counts.accepted,
            refused: self.counts.refused(),
            rate_hz: self.counts.accepted as f64 / now.seconds_after(since).max(1e-3),
            last_position_bench_mm: last.map(|position| (*position).into()),
            last_heading_bench: self.heading.map(Into::into),
            // A difference has twice the variance, in each of three coordinates.
            noise_sd_mm: is_enough.then(|| to_next_mm / 6f64.sqrt()),
            stamp_skew_s: self.skew_ns.map(|ns| ns as f64 * 1e-9),
            stamp_pace,
            has_coarse_stamps: self.stamp_steps[0] + 1 >= POSITIONS_MIN
                && 2 * self.stamp_steps[1] > self.stamp_steps[0],
            is_in_metres: self.is_in_metres,
            has_two_tools: is_enough
                && to_next_mm > TURNS_MIN_MM
                && to_next_mm > TURNS_RATIO * to_next_but_one_mm,
            constant_coordinate: constant
                .map(|constant| format!("{constant}: {}", CoordinateWatch::ADVICE)),
            trouble,
        }
    }
}
