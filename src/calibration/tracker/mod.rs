//! Fits the noise of a tracker to a recording at rest.

mod likelihood;
#[cfg(test)]
mod tests;

pub use likelihood::{Measured, NoiseFit};

use self::likelihood::Residuals;
use super::check_distances;
use crate::tracker::CoordinateWatch;
use crate::units::Time;
use nalgebra::Vector3;

/// The fewest positions, and the shortest time.
const POSITIONS_MIN: usize = 100;
const DURATION_MIN_S: f64 = 5.0;
/// A sensor at rest drifts by at most this over the recording, mm, unless its noise hides more.
const DRIFT_MAX_MM: f64 = 0.5;
/// Noise may explain a drift of this many standard errors.
const DRIFT_ERRORS: f64 = 6.0;
/// A position that comes within this share of the mean interval after the one before belongs to the same burst.
const BURST_SHARE: f64 = 0.1;
/// The longest correlation time, as a share of the recording: with a longer one, noise looks like motion.
const TIME_SHARE_MAX: f64 = 0.05;
/// A correlation time over this share of the recording …
const TIME_SHARE_REFUSED: f64 = 0.035;
/// … is refused if the positions also wander by more than this, mm RMS.
const WANDER_MAX_MM: f64 = 0.2;
/// An outlier is more than this many robust standard deviations from the median.
const OUTLIER_SDS: f64 = 6.0;
/// A tracker at rest has at most this share of outliers.
const OUTLIER_SHARE_MAX: f64 = 0.05;
/// Standard deviation of a normal distribution divided by its median absolute deviation.
const SD_PER_MAD: f64 = 1.4826;
/// A position that swings has a correlation below this after half a period; noise has none.
const SWING_CORRELATION: f64 = -0.5;
/// A delay ends within this many samples; a sample that is missing delays all those after it.
const DELAYED_SAMPLES_MAX: usize = 12;
/// Of noise that the tracker does not filter, at least this share is white.
const WHITE_SHARE_MIN: f64 = 0.05;
/// Stamps date the positions if they span the same time as the receipts, to within the larger of these.
const SPAN_DIFFERENCE_MAX_NS: f64 = 1e9;
const SPAN_DIFFERENCE_SHARE_MAX: f64 = 0.01;

/// One sample of a recording at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RestSample {
    /// When it was received.
    pub receive_time: Time,
    /// When the sender says it was measured, ns since 1970.
    pub source_unix_ns: Option<i64>,
    /// Position of the sensor, mm; `None` where the tracker itself calls it invalid.
    pub position_mm: Option<Vector3<f64>>,
}

/// The times that date the positions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum DatedBy {
    /// The sender's stamps.
    Stamp,
    /// The times of receipt.
    Receipt,
}

/// The noise of one coordinate.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct AxisNoise {
    /// Its noise.
    #[serde(flatten)]
    pub noise: NoiseFit,
    /// Its drift, mm/min.
    pub drift_mm_per_min: Measured,
}

/// The noise of a tracker at rest, and the pace of its stream.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct TrackerFit {
    /// Positions that the noise is fitted to.
    pub positions: usize,
    /// The time that they span, s.
    pub duration_s: f64,
    /// The times that date them.
    pub dated_by: DatedBy,
    /// x, y and z of the tracker.
    pub axes: [AxisNoise; 3],
    /// One fit to all three axes.
    pub together: NoiseFit,
    /// Length of the drift, mm/min.
    pub drift_mm_per_min: Measured,
    /// New positions a second.
    pub rate_hz: Measured,
    /// Positions left out as outliers.
    pub outliers: usize,
    /// Samples that are missing in gaps of the stream.
    pub dropouts: usize,
    /// Samples that the tracker called invalid.
    pub invalid: usize,
    /// Samples that repeat the position before.
    pub repeats: usize,
    /// Standard deviation of receipt minus stamp, ms; `None` if stamps do not date the positions.
    pub latency_jitter_ms: Option<Measured>,
    /// 99% of the samples come later than the quickest by less than this, ms; `None` if stamps do not
    /// date the positions.
    pub latency_p99_ms: Option<f64>,
}

impl TrackerFit {
    /// Fits the noise to `samples` in the order they were received.
    ///
    /// The model of a coordinate is an offset, a drift, white noise, and a stationary process whose
    /// correlation decays as `exp(-t / time)`. The noise is the likeliest one: the likelihood comes
    /// from a Kalman filter, which takes unequal intervals as they are. Standard errors are from its
    /// curvature. Positions are dated by their stamps where all have one, each is later than the one before, and
    /// they span the same time as the receipts; else by their receipt.
    ///
    /// # Errors
    /// A recording that is too short, that moves, that has positions no bench reaches, or of which a coordinate never
    /// changes.
    pub fn of(samples: &[RestSample]) -> Result<Self, String> {
        let mut valid: Vec<(&RestSample, Vector3<f64>)> =
            samples.iter().filter_map(|sample| Some((sample, sample.position_mm?))).collect();
        let positions_mm: Vec<Vector3<f64>> = valid.iter().map(|(_, position)| *position).collect();
        check_distances("position", "tracker", &positions_mm)?;
        valid.dedup_by_key(|(_, position)| *position);
        let repeats = positions_mm.len() - valid.len();
        let invalid = samples.len() - positions_mm.len();
        let stamps: Option<Vec<i64>> =
            valid.iter().map(|(sample, _)| sample.source_unix_ns).collect();
        let received: Vec<i64> = valid.iter().map(|(sample, _)| received_ns(sample)).collect();
        let stamps = stamps.filter(|stamps| keep_time(stamps, &received));
        let dated_by = if stamps.is_some() { DatedBy::Stamp } else { DatedBy::Receipt };
        let since_s = since_first_s(&stamps.unwrap_or(received));
        let points: Vec<(f64, Vector3<f64>)> =
            since_s.into_iter().zip(valid.iter().map(|(_, position_mm)| *position_mm)).collect();
        let duration_s = points.last().map_or(0.0, |(time_s, _)| *time_s);
        if points.len() < POSITIONS_MIN || duration_s < DURATION_MIN_S {
            let left_out = match (repeats, invalid) {
                (0, 0) => String::new(),
                (_, 0) => format!(" ({repeats} repeats)"),
                (0, _) => format!(" ({invalid} invalid)"),
                _ => format!(" ({repeats} repeats, {invalid} invalid)"),
            };
            let is_mostly_new = points.len() >= repeats + invalid;
            let next = if is_mostly_new { "record longer" } else { "is the tool in view?" };
            return Err(format!(
                "{} new positions in {duration_s:.1} s{left_out}, at least {POSITIONS_MIN} in \
                 {DURATION_MIN_S:.0} s are needed; {next}",
                points.len()
            ));
        }
        let mut gaps_s: Vec<f64> = points.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
        let rate_hz = rate(&gaps_s);
        // The gaps within a burst say nothing about the tracker's interval.
        let mean_gap_s = duration_s / gaps_s.len() as f64;
        gaps_s.retain(|gap_s| *gap_s > BURST_SHARE * mean_gap_s);
        let interval_s = median(&mut gaps_s);
        let dropouts = dropouts(&arrivals_s(samples, dated_by), interval_s);

        let with_outliers = points.len();
        let points = without_outliers(points)?;
        let outliers = with_outliers - points.len();
        let detrended = Detrended::of(&points);
        let spacing_s = duration_s / (points.len() - 1) as f64;
        detrended.check_swing(spacing_s)?;
        let residuals = |series| Residuals {
            gaps_s: &detrended.gaps_s,
            series,
            time_max_s: TIME_SHARE_MAX * duration_s,
            time_min_s: (0.5 * interval_s).min(0.01 * TIME_SHARE_MAX * duration_s),
        };
        let together = residuals(&detrended.residuals_mm[..]).fit();
        // A slow motion strays further than noise of the longest correlation time.
        let square_mm2 = detrended.residuals_mm.iter().flatten().map(|mm| mm * mm).sum::<f64>();
        let white_mm2 = 3.0 * together.white_sd_mm.value.powi(2);
        let wander_mm = (square_mm2 / points.len() as f64 - white_mm2).max(0.0).sqrt();
        let axes: [AxisNoise; 3] = std::array::from_fn(|axis| {
            let noise = residuals(&detrended.residuals_mm[axis..=axis]).fit();
            let variance = noise.long_mean_variance_mm2(spacing_s) / detrended.time_square_s2;
            AxisNoise {
                noise,
                drift_mm_per_min: Measured {
                    value: 60.0 * detrended.drift_mm_per_s[axis],
                    error: 60.0 * variance.sqrt(),
                },
            }
        });
        let drift = |part: fn(&Measured) -> f64| {
            axes.iter().map(|axis| part(&axis.drift_mm_per_min).powi(2)).sum::<f64>().sqrt()
        };
        let drift_mm_per_min =
            Measured { value: drift(|drift| drift.value), error: drift(|drift| drift.error) };
        let minutes = duration_s / 60.0;
        let drifted_mm = drift_mm_per_min.value * minutes;
        let limit_mm = DRIFT_MAX_MM.max(DRIFT_ERRORS * drift_mm_per_min.error * minutes);
        if drifted_mm > limit_mm {
            return Err(format!(
                "the sensor moves by {drifted_mm:.2} mm in {duration_s:.0} s (limit {limit_mm:.2} mm); hold \
                 it still and record again"
            ));
        }
        let refused_s = TIME_SHARE_REFUSED * duration_s;
        if together.correlation_time_s.value > refused_s && wander_mm > WANDER_MAX_MM {
            return Err(format!(
                "the positions wander by {wander_mm:.3} mm (limit {WANDER_MAX_MM}) over more than \
                 {refused_s:.1} s of {duration_s:.0} s; the sensor moved, or record longer"
            ));
        }
        // After the checks of motion, since a sensor that moves along one axis also keeps its other coordinates.
        let mut coordinates = CoordinateWatch::default();
        positions_mm.iter().for_each(|position_mm| coordinates.take(position_mm));
        if let Some(constant) = coordinates.constant(CoordinateWatch::POSITIONS_AT_REST) {
            return Err(format!("{constant}: {}", CoordinateWatch::ADVICE));
        }
        let by_stamp = valid.iter().filter(|_| dated_by == DatedBy::Stamp);
        let (latency_jitter_ms, latency_p99_ms) =
            latency(by_stamp.map(|(sample, _)| *sample)).unzip();
        Ok(TrackerFit {
            positions: points.len(),
            duration_s,
            dated_by,
            axes,
            together,
            drift_mm_per_min,
            rate_hz,
            outliers,
            dropouts,
            invalid,
            repeats,
            latency_jitter_ms,
            latency_p99_ms,
        })
    }

    /// What the operator should know about this noise, if anything.
    pub fn remark(&self) -> Option<String> {
        let NoiseFit { sd_mm, white_sd_mm, correlated_sd_mm, correlation_time_s } = &self.together;
        let share = white_sd_mm.value / sd_mm.value;
        let is_filtered = correlated_sd_mm.value > 0.0 && share < WHITE_SHARE_MIN;
        let time_s = correlation_time_s.value;
        is_filtered.then(|| {
            format!(
                "only {:.0}% of the noise is white (under {:.0}%): the stream looks filtered, which delays a moving tip \
                 by about {time_s:.2} s: switch the filter off, or add that to tracker.latency_ms",
                100.0 * share,
                100.0 * WHITE_SHARE_MIN,
            )
        })
    }
}

fn received_ns(sample: &RestSample) -> i64 {
    sample.receive_time.as_nanos()
}

/// Times since the first of them, s.
fn since_first_s(times_ns: &[i64]) -> Vec<f64> {
    let first_ns = times_ns.first().copied().unwrap_or(0);
    times_ns.iter().map(|ns| ns.saturating_sub(first_ns) as f64 * 1e-9).collect()
}

/// True if `stamps` increase strictly and span the same time as the receipts. The clock of such stamps has a
/// resolution, is in ns, and was not set.
fn keep_time(stamps: &[i64], received: &[i64]) -> bool {
    let span_ns = |times: &[i64]| match times {
        [first, .., last] => last.saturating_sub(*first) as f64,
        _ => 0.0,
    };
    let received_ns = span_ns(received);
    let limit_ns = SPAN_DIFFERENCE_MAX_NS.max(SPAN_DIFFERENCE_SHARE_MAX * received_ns);
    stamps.is_sorted_by(|a, b| a < b) && (span_ns(stamps) - received_ns).abs() <= limit_ns
}

/// When each sample came, valid or not, s: by the stamps if these date the positions and no invalid sample lacks
/// one. Samples with the stamp of the one before are one measurement, and count once.
fn arrivals_s(samples: &[RestSample], dated_by: DatedBy) -> Vec<f64> {
    let stamps: Option<Vec<i64>> = samples.iter().map(|sample| sample.source_unix_ns).collect();
    let stamps = stamps.filter(|stamps| dated_by == DatedBy::Stamp && stamps.is_sorted());
    since_first_s(&match stamps {
        Some(mut stamps) => {
            stamps.dedup();
            stamps
        }
        None => samples.iter().map(received_ns).collect(),
    })
}

/// The number of samples that are missing between those that came at `times_s`, about `interval_s` apart. A sample
/// that is delayed is late by itself; after one that is missing, all are late by an interval. So each step counts
/// by which the least delay of the next few samples rises.
fn dropouts(times_s: &[f64], interval_s: f64) -> usize {
    // Delays skew the median gap, but hardly the mean of the gaps without dropouts.
    let gaps_s = times_s.windows(2).map(|pair| pair[1] - pair[0]);
    let is_near = |gap_s: &f64| (0.5..1.5).contains(&(gap_s / interval_s));
    let interval_s = moments(&gaps_s.filter(is_near).collect::<Vec<_>>()).0;
    let late = |(k, time_s): (usize, &f64)| time_s / interval_s - k as f64;
    let late: Vec<f64> = times_s.iter().enumerate().map(late).collect();
    let least = |k: usize| {
        let next = late[k..].iter().take(DELAYED_SAMPLES_MAX).copied();
        next.fold(f64::INFINITY, f64::min)
    };
    let rises = (1..late.len()).map(|k| (least(k) - least(k - 1)).round().max(0.0) as usize);
    rises.sum()
}

/// The median, the upper one of an even number of values; 0 without values.
fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Mean and variance of `values`.
fn moments(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (mean, values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count)
}

/// New positions a second, with the standard error from the scatter of the intervals.
fn rate(gaps_s: &[f64]) -> Measured {
    let (mean_s, variance) = moments(gaps_s);
    let error = (variance / gaps_s.len() as f64).sqrt() / (mean_s * mean_s);
    Measured { value: mean_s.recip(), error }
}

/// The points without the outliers.
///
/// # Errors
/// There are too many of them: the sensor was moved.
fn without_outliers(points: Vec<(f64, Vector3<f64>)>) -> Result<Vec<(f64, Vector3<f64>)>, String> {
    let limits: [(f64, f64); 3] = std::array::from_fn(|axis| {
        let mut values: Vec<f64> = points.iter().map(|(_, position)| position[axis]).collect();
        let middle = median(&mut values);
        values.iter_mut().for_each(|value| *value = (*value - middle).abs());
        let mad = median(&mut values);
        let squares = values.iter().map(|value| value * value).sum::<f64>();
        // A tracker with a coarse resolution may give one value most of the time.
        let sd_mm =
            if mad > 0.0 { SD_PER_MAD * mad } else { (squares / values.len() as f64).sqrt() };
        (middle, OUTLIER_SDS * sd_mm)
    });
    let total = points.len();
    let is_near = |(_, position): &(f64, Vector3<f64>)| {
        position.iter().zip(limits).all(|(value, (middle, limit))| (value - middle).abs() <= limit)
    };
    let kept: Vec<_> = points.into_iter().filter(is_near).collect();
    let outliers = total - kept.len();
    if outliers as f64 > OUTLIER_SHARE_MAX * total as f64 {
        return Err(format!(
            "{outliers} of {total} positions are over {OUTLIER_SDS:.0} standard deviations from the median \
             (limit {:.0}%); the sensor moved, or another tool is in the recording",
            100.0 * OUTLIER_SHARE_MAX
        ));
    }
    Ok(kept)
}

/// The coordinates of positions without their offset and drift.
struct Detrended {
    /// Time from the previous position to each position, s; 0 for the first.
    gaps_s: Vec<f64>,
    residuals_mm: [Vec<f64>; 3],
    drift_mm_per_s: [f64; 3],
    /// Sum of the squared times from their mean, s².
    time_square_s2: f64,
}

impl Detrended {
    /// Subtracts a straight line from each coordinate.
    fn of(points: &[(f64, Vector3<f64>)]) -> Self {
        let count = points.len() as f64;
        let mean_s = points.iter().map(|(time_s, _)| time_s).sum::<f64>() / count;
        let mean_mm = points.iter().map(|(_, position)| position).sum::<Vector3<f64>>() / count;
        let time_square_s2: f64 = points.iter().map(|(time_s, _)| (time_s - mean_s).powi(2)).sum();
        let drift_sum: Vector3<f64> =
            points.iter().map(|(time_s, position)| (position - mean_mm) * (time_s - mean_s)).sum();
        let drift = drift_sum / time_square_s2;
        let residual = |axis: usize| {
            let without_line = |(time_s, position): &(f64, Vector3<f64>)| {
                position[axis] - mean_mm[axis] - drift[axis] * (time_s - mean_s)
            };
            points.iter().map(without_line).collect()
        };
        let gaps_s = points.windows(2).map(|pair| pair[1].0 - pair[0].0);
        Detrended {
            gaps_s: std::iter::once(0.0).chain(gaps_s).collect(),
            residuals_mm: std::array::from_fn(residual),
            drift_mm_per_s: drift.into(),
            time_square_s2,
        }
    }

    /// Refuses positions that swing, as under a breathing hand: after half a period they are on the other
    /// side.
    fn check_swing(&self, spacing_s: f64) -> Result<(), String> {
        let count = self.gaps_s.len();
        let autocovariance_mm2 = |lag: usize| -> f64 {
            let products = |series: &Vec<f64>| -> f64 {
                series.iter().zip(&series[lag..]).map(|(a, b)| a * b).sum()
            };
            self.residuals_mm.iter().map(products).sum::<f64>() / (count - lag) as f64
        };
        let square_mm2 = autocovariance_mm2(0);
        // From a lag of 3: a tracker's own filter may make close neighbours negatively correlated. In steps
        // of a tenth: a lag that misses half a period by a twentieth still shows it.
        let lags = std::iter::successors(Some(3), |lag: &usize| Some(lag + (lag / 10).max(1)));
        let correlations = lags
            .take_while(|lag| *lag < count / 4)
            .map(|lag| (lag, autocovariance_mm2(lag) / square_mm2));
        let Some((lag, correlation)) = correlations.min_by(|a, b| a.1.total_cmp(&b.1)) else {
            return Ok(());
        };
        if correlation < SWING_CORRELATION {
            return Err(format!(
                "the sensor swings by {:.2} mm with a period of {:.1} s (correlation {correlation:.2} after \
                 half of it, limit {SWING_CORRELATION}); hold it still and record again",
                square_mm2.sqrt(),
                2.0 * lag as f64 * spacing_s
            ));
        }
        Ok(())
    }
}

/// Standard deviation of receipt minus stamp, and its 99th percentile above the smallest, ms; `None` without
/// stamps.
fn latency<'a>(samples: impl Iterator<Item = &'a RestSample>) -> Option<(Measured, f64)> {
    let offset_ns =
        |sample: &RestSample| Some(received_ns(sample).saturating_sub(sample.source_unix_ns?));
    let offsets_ns: Vec<i64> = samples.filter_map(offset_ns).collect();
    let least_ns = *offsets_ns.iter().min()?;
    let mut delays_ms: Vec<f64> =
        offsets_ns.iter().map(|ns| ns.saturating_sub(least_ns) as f64 * 1e-6).collect();
    let value = moments(&delays_ms).1.sqrt();
    let jitter = Measured { value, error: value / (2.0 * delays_ms.len() as f64).sqrt() };
    let rank = (delays_ms.len() - 1) * 99 / 100;
    Some((jitter, *delays_ms.select_nth_unstable_by(rank, f64::total_cmp).1))
}
