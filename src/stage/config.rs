//! The axes, and the configuration of the stage and its drives.

use std::fmt;
use std::ops::{Index, IndexMut};
use std::time::Duration;

use super::standstill::Standstill;
use super::{AxisLimits, CountsRatio, HomingConfig, Reference, Scale, Sign};
use crate::canopen::sdo::SdoValue;
use crate::canopen::{NodeId, ObjectAddress};

/// One of the two axes of the stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Axis {
    /// Pushes the needle; mm.
    Insertion,
    /// Turns the needle about its shaft; rad.
    Rotation,
}

impl Axis {
    /// Both, in the order in which they are served.
    pub const BOTH: [Axis; 2] = [Axis::Insertion, Axis::Rotation];

    /// `value`, mm or rad, in the unit of the configuration and the command line, with that unit.
    pub fn in_unit(self, value: f64) -> (f64, &'static str) {
        match self {
            Axis::Insertion => (value, "mm"),
            Axis::Rotation => (value.to_degrees(), "deg"),
        }
    }

    /// `value`, mm or rad, as an operator reads it: `1.500 mm`, `90.000 deg`.
    pub fn shown(self, value: f64) -> String {
        let (value, unit) = self.in_unit(value);
        format!("{value:.3} {unit}")
    }
}

impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Axis::Insertion => "insertion",
            Axis::Rotation => "rotation",
        })
    }
}

/// One value for each axis, indexed by [`Axis`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PerAxis<T> {
    /// The insertion axis's.
    pub insertion: T,
    /// The rotation axis's.
    pub rotation: T,
}

impl<T> PerAxis<T> {
    /// Makes one value for each axis.
    pub fn from_fn(mut make: impl FnMut(Axis) -> T) -> Self {
        PerAxis { insertion: make(Axis::Insertion), rotation: make(Axis::Rotation) }
    }

    /// True when both values pass.
    pub fn all(&self, mut passes: impl FnMut(&T) -> bool) -> bool {
        passes(&self.insertion) && passes(&self.rotation)
    }
}

impl<T> Index<Axis> for PerAxis<T> {
    type Output = T;
    fn index(&self, axis: Axis) -> &T {
        match axis {
            Axis::Insertion => &self.insertion,
            Axis::Rotation => &self.rotation,
        }
    }
}

impl<T> IndexMut<Axis> for PerAxis<T> {
    fn index_mut(&mut self, axis: Axis) -> &mut T {
        match axis {
            Axis::Insertion => &mut self.insertion,
            Axis::Rotation => &mut self.rotation,
        }
    }
}

/// An object that a particular drive needs written, before the stage's own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RawSdo {
    /// The object.
    pub object: ObjectAddress,
    /// What to write.
    pub value: SdoValue,
    /// Read it back and compare. False for objects that do not read as written (0x1010, 0x1011).
    pub read_back: bool,
}

/// Where an axis reads zero.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Zero {
    /// Where it stands when it is enabled.
    #[default]
    Here,
    /// At this position of the drive (0x6064), for an axis that was homed or is absolute.
    Counts(i32),
}

/// What an axis does in 30 ms at its highest speed: a servo's lag, where no following-error window
/// is configured.
const FOLLOWING_LAG: Duration = Duration::from_millis(30);

/// One axis: its drive, scale and limits.
#[derive(Debug, Clone, PartialEq)]
pub struct AxisConfig {
    /// The drive.
    pub node: NodeId,
    /// Refuse a drive of another vendor (0x1018:01).
    pub vendor: Option<u32>,
    /// Refuse another product (0x1018:02).
    pub product: Option<u32>,
    /// Counts per mm (insertion) or per turn (rotation).
    pub ratio: CountsRatio,
    /// Which way the counts grow.
    pub sign: Sign,
    /// Where the axis reads zero.
    pub zero: Zero,
    /// How the drive knows where it is.
    pub reference: Reference,
    /// How it is homed, where it can be.
    pub homing: Option<HomingConfig>,
    /// The drive goes on the short way past the end of its 32-bit position.
    pub wraps: bool,
    /// Soft limits, mm or rad and seconds.
    pub limits: AxisLimits,
    /// How far the drive may be from where it is to be (0x6065, but mm or rad); `None` for what it
    /// does in 30 ms at the highest speed. The stage allows for two SYNC periods more.
    pub following_error_max: Option<f64>,
    /// 0x6066: how long the drive waits beyond that window before it faults, in whole milliseconds;
    /// `None` leaves it as the drive has it.
    pub following_error_timeout: Option<Duration>,
    /// 0x6085, but mm/s² or rad/s²; `None` leaves it as the drive has it.
    pub quick_stop_deceleration: Option<f64>,
    /// 0x605A: how quick stop decelerates. 5 and 6 stay in Quick Stop Active.
    pub quick_stop_option: i16,
    /// 0x605E: how the drive stops on a fault of its own, where it can be told. 2 is on the
    /// quick-stop ramp.
    pub fault_reaction_option: i16,
    /// 0x6007: what the drive does by itself when the bench falls silent. 3 is quick stop.
    pub abort_connection_option: i16,
    /// 0x1029:01: where the node goes when the bench falls silent. 0 is Pre-operational, which
    /// makes the drive do what 0x6007 says.
    pub communication_error_behaviour: u8,
    /// Objects that this drive may lack: what is to be read or written there is skipped.
    pub optional_objects: Vec<ObjectAddress>,
    /// Written before the stage's own objects, in this order.
    pub raw_sdos: Vec<RawSdo>,
}

impl AxisConfig {
    /// How far the drive may be from where it is to be, mm or rad.
    pub fn following_error_window(&self) -> f64 {
        let lag = self.limits.speed_max * FOLLOWING_LAG.as_secs_f64();
        self.following_error_max.unwrap_or(lag)
    }

    /// How far the measured position may be from the target at a SYNC, mm or rad: more stops the
    /// run.
    ///
    /// To the drive's own window comes what the target does in two SYNC periods: the axis is at the
    /// target of one SYNC no sooner than at the next, and drives that interpolate take one more.
    pub fn following_error_limit(&self, sync_period: Duration) -> f64 {
        let way = self.limits.speed_max * 2.0 * sync_period.as_secs_f64();
        self.following_error_window() + way
    }

    /// The scale of `axis` whose zero is as configured, or at `here_counts`.
    pub fn scale(&self, axis: Axis, here_counts: i64) -> Scale {
        let zero_counts = match self.zero {
            Zero::Here => here_counts,
            Zero::Counts(counts) => counts.into(),
        };
        Scale::new(axis, self.ratio, self.sign, zero_counts)
    }
}

/// Who watches whom, and how closely. Periods are sent to the drives in whole milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HeartbeatConfig {
    /// Between two heartbeats, of the bench and of each drive (0x1017).
    pub producer_period: Duration,
    /// Silence that counts as loss, for the bench and for each drive (0x1016).
    pub consumer_time: Duration,
}

/// The whole stage.
#[derive(Debug, Clone, PartialEq)]
pub struct StageConfig {
    /// Between two SYNCs.
    pub sync_period: Duration,
    /// The bench's own node number, whose heartbeat the drives watch.
    pub bench_node: NodeId,
    /// Supervision, both ways.
    pub heartbeat: HeartbeatConfig,
    /// Longest wait for an SDO answer.
    pub sdo_timeout: Duration,
    /// How often an SDO is tried.
    pub sdo_attempts: u32,
    /// Longest wait for a drive to answer at all.
    pub boot_timeout: Duration,
    /// How often a drive may be brought up: it may restart in the middle of it.
    pub boot_attempts: u32,
    /// Longest way from Operational to both drives in Operation Enabled; brakes take their time.
    pub enable_timeout: Duration,
    /// For a drive to leave Switch On Disabled, and Ready To Switch On, once it is told to.
    pub state_transition_timeout: Duration,
    /// Longest wait for standstill, and for power to be off.
    pub stop_timeout: Duration,
    /// SYNCs in a row without both positions that are tolerated; the next is a fault.
    pub missed_feedback_max: u32,
    /// Reset a drive found in Fault. Otherwise it is an error that names the fault.
    pub fault_reset_on_start: bool,
    /// How long another master is listened for before the first frame is sent: as long as the
    /// heartbeat of a living one may be late.
    pub listen_first: Duration,
    /// The insertion axis.
    pub insertion: AxisConfig,
    /// The rotation axis.
    pub rotation: AxisConfig,
}

impl StageConfig {
    /// The configuration of `axis`.
    pub fn axis(&self, axis: Axis) -> &AxisConfig {
        match axis {
            Axis::Insertion => &self.insertion,
            Axis::Rotation => &self.rotation,
        }
    }

    /// How long the counts of `axis` are watched to see that it stands.
    pub fn standstill_window(&self, axis: Axis) -> Duration {
        let counts_per_unit = self.axis(axis).scale(axis, 0).counts_per_unit();
        Standstill::new(counts_per_unit).window(self.sync_period)
    }

    /// The nodes of the drives.
    pub fn nodes(&self) -> PerAxis<NodeId> {
        PerAxis { insertion: self.insertion.node, rotation: self.rotation.node }
    }

    /// Checks what the types do not.
    ///
    /// # Errors
    /// The first thing that the stage cannot work with.
    pub fn validate(&self) -> Result<(), String> {
        let PerAxis { insertion, rotation } = self.nodes();
        let nodes = [insertion, rotation, self.bench_node];
        let is_used_twice = |node: &&NodeId| nodes.iter().filter(|other| other == node).count() > 1;
        if let Some(node) = nodes.iter().find(is_used_twice) {
            return Err(format!(
                "node {node} is used twice among the bench, insertion and rotation"
            ));
        }
        if interpolation_period(self.sync_period).is_none() {
            return Err(format!(
                "a SYNC period of {} µs does not fit object 0x60C2: 1 to 255 times 1, 0.1, 0.01 or \
                 0.001 ms",
                self.sync_period.as_micros()
            ));
        }
        let HeartbeatConfig { producer_period, consumer_time } = self.heartbeat;
        let (producer, consumer) = (millis(producer_period), millis(consumer_time));
        if !matches!((producer, consumer), (Some(1..), Some(1..))) || consumer <= producer {
            return Err(format!(
                "heartbeat every {} ms, lost after {} ms: 1 to 65535 ms, and the second must be the \
                 longer",
                producer_period.as_millis(),
                consumer_time.as_millis()
            ));
        }
        Axis::BOTH.into_iter().try_for_each(|axis| self.validate_axis(axis))
    }

    /// Checks the limits of `axis`, and what goes to its drive in counts.
    fn validate_axis(&self, axis: Axis) -> Result<(), String> {
        let config = self.axis(axis);
        let AxisLimits { min, max, speed_max, acceleration_max } = config.limits;
        let rates = [speed_max, acceleration_max.unwrap_or(1.0)];
        let range_ok = min.is_finite() && max.is_finite() && min < max;
        if !range_ok || rates.iter().any(|rate| !rate.is_finite() || *rate <= 0.0) {
            let [min, max, speed] = [min, max, speed_max].map(|value| axis.shown(value));
            return Err(format!(
                "{axis}: limits {min} to {max}, {speed}/s: the range and the speed must be finite and \
                 over zero"
            ));
        }
        let homing = config.homing.as_ref();
        if config.reference == Reference::Homing && homing.is_none() {
            return Err(no_homing(axis));
        }
        let values = [
            (config.following_error_max, "a following error", ""),
            (config.quick_stop_deceleration, "a quick-stop deceleration", "/s²"),
            (homing.and_then(|homing| homing.speed_switch), "a homing speed", "/s"),
            (homing.and_then(|homing| homing.speed_zero), "a homing speed", "/s"),
            (homing.and_then(|homing| homing.acceleration), "a homing acceleration", "/s²"),
        ];
        let scale = config.scale(axis, 0);
        for (value, what, per) in values {
            if let Some(value) = value.filter(|value| unsigned_counts(scale, *value).is_none()) {
                let (value, unit) = axis.in_unit(value);
                return Err(format!(
                    "{axis}: {what} of {value} {unit}{per}: it must be over zero and fit 32 bits in \
                     counts"
                ));
            }
        }
        let window = self.standstill_window(axis);
        // It brakes first, and the last SYNC counts when the next is due.
        if window + 2 * self.sync_period >= self.stop_timeout {
            return Err(format!(
                "{axis}: {:.0} ms of its counts are needed to see it stand, and stop_timeout_s is \
                 {:.3}: set a longer one",
                window.as_secs_f64() * 1e3,
                self.stop_timeout.as_secs_f64()
            ));
        }
        Ok(())
    }
}

/// An axis is to be homed, and no homing is configured.
pub(super) fn no_homing(axis: Axis) -> String {
    format!("{axis}: its position is to come from homing, and no homing is configured")
}

/// `value`, in mm or rad (a second, a second squared), in the counts of an unsigned object; `None`
/// when that would be 0, or not fit.
pub(super) fn unsigned_counts(scale: Scale, value: f64) -> Option<u32> {
    let counts = (value * scale.counts_per_unit()).round();
    (1.0..=f64::from(u32::MAX)).contains(&counts).then_some(counts as u32)
}

/// A duration in whole milliseconds that fit 16 bits.
pub(super) fn millis(duration: Duration) -> Option<u16> {
    u16::try_from(duration.as_millis()).ok()
}

/// `period` as object 0x60C2 has it: a count of 1 to 255 and a power of ten of a second.
pub(super) fn interpolation_period(period: Duration) -> Option<(u8, i8)> {
    [(-3, 1_000_000), (-4, 100_000), (-5, 10_000), (-6, 1_000)].into_iter().find_map(
        |(exponent, unit_ns): (i8, u128)| {
            let whole = period.as_nanos().is_multiple_of(unit_ns);
            let count = u8::try_from(period.as_nanos() / unit_ns).ok()?;
            (whole && count > 0).then_some((count, exponent))
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> StageConfig {
        let node = |id| NodeId::new(id).expect("in range");
        let ratio = CountsRatio::new(1000, 1).expect("not zero");
        let limits = AxisLimits { min: 0.0, max: 150.0, speed_max: 5.0, acceleration_max: None };
        StageConfig::new(
            AxisConfig::new(node(1), ratio, limits),
            AxisConfig::new(node(2), ratio, limits),
        )
    }

    #[test]
    fn the_interpolation_period_is_a_count_and_a_power_of_ten() {
        let period = |us| interpolation_period(Duration::from_micros(us));
        assert_eq!(period(10_000), Some((10, -3)));
        assert_eq!(period(255_000), Some((255, -3)));
        assert_eq!(period(1_500), Some((15, -4)));
        assert_eq!(period(125), Some((125, -6)));
        assert_eq!(period(256_000), None);
        assert_eq!(period(1_255), None);
        assert_eq!(period(0), None);
    }

    #[test]
    fn mistakes_are_named() {
        assert_eq!(config().validate(), Ok(()));
        let text = |change: fn(&mut StageConfig)| {
            let mut config = config();
            change(&mut config);
            config.validate().expect_err("refused").to_string()
        };
        assert!(text(|c| c.rotation.node = c.bench_node).starts_with("node 127 is used twice"));
        assert!(text(|c| c.sync_period = Duration::from_secs(1)).contains("1000000 µs"));
        assert!(
            text(|c| c.heartbeat.consumer_time = c.heartbeat.producer_period).contains("100 ms")
        );
        assert!(
            text(|c| c.rotation.following_error_max = Some(0.0))
                .starts_with("rotation: a following error of 0 deg: ")
        );
        assert!(
            text(|c| c.insertion.quick_stop_deceleration = Some(1e9))
                .starts_with("insertion: a quick-stop deceleration of 1000000000 mm/s²: ")
        );
        assert_eq!(
            text(|c| c.insertion.reference = Reference::Homing),
            "insertion: its position is to come from homing, and no homing is configured"
        );
        assert_eq!(
            text(|c| c.insertion.ratio = CountsRatio::new(20, 1).expect("not zero")),
            "insertion: 2500 ms of its counts are needed to see it stand, and stop_timeout_s is 2.000: \
             set a longer one"
        );
        assert!(text(|c| c.insertion.limits.speed_max = f64::NAN).starts_with("insertion: limits"));
    }
}
