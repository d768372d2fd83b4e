//! Checks for contradictions within `[stage]`: settings of an axis, its drive and its operations.

use super::Config;
use super::checks::{ROTATION_ACCELERATION_MAX, rounded_down};
use super::reader::{Reader, contradictions};
use crate::session::PROFILE_PEAK;
use crate::stage::{Axis, AxisConfig, Reference, SOFTWARE_LIMITS, why_needed};

/// Settings that make a real drive brake on quick stop, on its own faults and when the bench dies: key, allowed
/// values, and the allowed values in words.
const STOPPING: [(&str, &[i16], &str); 4] = [
    (
        "abort_connection_option",
        &[1, 2, 3],
        "1 (fault), 2 (no power) or 3 (quick stop): with others the axis may go on when the bench dies \
         (6007)",
    ),
    (
        "communication_error_behaviour",
        &[0, 2],
        "0 (Pre-operational) or 2 (Stopped): by anything else the node goes on when the bench dies \
         (1029:1)",
    ),
    (
        "quick_stop_option",
        &[2, 3, 6, 7],
        "2 or 3, or 6 or 7 to stay in quick stop: 0 coasts, 1 and 5 brake by 6084, which is not set (605A)",
    ),
    (
        "fault_reaction_option",
        &[2, 3],
        "2 or 3: 0 coasts, 1 brakes by 6084, which is not set (605E)",
    ),
];

/// Objects that the bench writes if a key of the axis is given. If it is not given, a raw SDO may write them, in
/// the drive's own unit.
const SET_BY: [((u16, u8), &str); 5] = [
    ((0x607C, 0), "homing.offset_UNIT"),
    ((0x6098, 0), "homing.method"),
    ((0x6099, 1), "homing.speed_switch_UNIT_per_s"),
    ((0x6099, 2), "homing.speed_zero_UNIT_per_s"),
    ((0x609A, 0), "homing.acceleration_UNIT_per_s2"),
];

/// Reports every contradiction.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    for which in Axis::BOTH {
        let checks = Checks { config, which, axis: config.stage.axis(which) };
        checks.reference(reader);
        checks.home(reader);
        checks.drive(reader);
        checks.raw_sdos(reader);
    }
    accelerations(config, reader);
}

/// The checks of one axis. Numbers in messages are in the unit of their key.
struct Checks<'a> {
    config: &'a Config,
    which: Axis,
    axis: &'a AxisConfig,
}

impl Checks<'_> {
    /// The key of this axis; its `UNIT` is that of the axis.
    fn key(&self, key: &str) -> String {
        format!("stage.{}.{}", self.which, key.replace("UNIT", self.which.unit()))
    }

    fn number(&self, key: &str) -> f64 {
        self.config.number(&self.key(key))
    }

    fn reference(&self, reader: &mut Reader) {
        let axis = self.axis;
        let [reference, homing, zero, high] =
            ["reference", "homing", "zero", "max_UNIT"].map(|key| self.key(key));
        let [min, max] = ["min_UNIT", "max_UNIT"].map(|key| self.number(key));
        let unit = self.which.unit();
        let homed = axis.reference == Reference::Homing;
        // The limits of a real axis protect its screw, its needle or the sensor's cable. Limits that count from
        // the start of each command do not protect them: three jogs can go three times as far.
        let has_moving_limits = self.config.stage.hardware && axis.zero.is_none() && !axis.wraps;
        contradictions! { reader;
            [&reference, &homing] if homed && axis.homing.is_none() =>
                "{reference} is \"homing\", and there is no [{homing}] that says how";
            [&zero, &reference] if homed && axis.zero.is_none() =>
                "{zero} is \"start\", but {reference} is \"homing\": give the counts, 0 for the drive's \
                 zero";
            [&zero, &high, "stage.hardware"] if has_moving_limits =>
                "{zero} is \"start\": limits of {min} to {max} {unit} would count anew from each start; give \
                 the counts at 0 {unit} (stage status), or home the axis ({reference})";
        }
    }

    /// Checks that home is within the limits; the drive's zero is at home plus the home offset (607C). An insertion
    /// axis that homes on an end switch moves between that switch and the other end: the limits must be on that
    /// side of home.
    fn home(&self, reader: &mut Reader) {
        let [low, high, zero, offset_key, method_key, sign_key] =
            ["min_UNIT", "max_UNIT", "zero", "homing.offset_UNIT", "homing.method", "sign"]
                .map(|key| self.key(key));
        let [min, max, offset, sign] =
            [&low, &high, &offset_key, &sign_key].map(|key| self.config.number(key));
        let unit = self.which.unit();
        let (scale, units) =
            [("counts_per_mm", 1.0), ("counts_per_turn", 360.0)][self.which as usize];
        let is_unknown = reader.is_invalid(&self.key(scale));
        let counts_per_unit = if is_unknown { f64::NAN } else { self.axis.ratio.to_f64() / units };
        let zero_counts = self.axis.zero.map_or(f64::NAN, f64::from);
        // Not -offset, which would print as -0.000.
        let home_at = |offset: f64| 0.0 - offset - sign * zero_counts / counts_per_unit;
        let home = home_at(offset);
        contradictions! { reader;
            [&low, &high, &zero, &offset_key] if home < min || home > max =>
                "{offset_key} is {offset}, which puts home at {home:.3} {unit} with {zero} = {zero_counts}, \
                 allowed: {low} to {high}, which are {min} and {max}";
        }

        let Some(homing) = self.axis.homing.filter(|_| self.which == Axis::Insertion) else {
            return;
        };
        let method = homing.method;
        // The direction in which each method seeks its switch, and the method that seeks it in the opposite direction.
        // The direction of 3 to 6 and 19 to 22 depends on the switch's state; 33 and 34 move by at most one turn of
        // the motor, 35 and 37 not at all.
        let (direction, other_method) = match method {
            1 | 17 => (-sign, method + 1),
            2 | 18 => (sign, method - 1),
            7..=10 | 23..=26 => (sign, method + 4),
            11..=14 | 27..=30 => (-sign, method - 4),
            _ => return,
        };
        let home = home_at(if offset.is_nan() { 0.0 } else { offset });
        let (end, beyond, before) = match direction > 0.0 {
            true => ("deep", max - home, home - min),
            false => ("withdrawn", home - min, max - home),
        };
        contradictions! { reader;
            [&method_key, &sign_key, &zero, &low, &high] if beyond > before =>
                "{method_key} is {method}, which with sign = {sign} seeks the switch at the {end} end: home \
                 is {home:.3} {unit}, the limits of {min} to {max} {unit} go {beyond:.1} {unit} beyond it; \
                 is it {other_method}?";
        }
    }

    /// Refuses stopping options that leave the axis moving, optional objects that the bench needs, and a
    /// following-error timeout that is too long.
    fn drive(&self, reader: &mut Reader) {
        for (name, stopping, allowed) in STOPPING {
            let key = &*self.key(name);
            let value = self.config.number(key);
            let is_stopping = stopping.iter().any(|&option| f64::from(option) == value);
            contradictions! { reader;
                ["stage.hardware", key] if self.config.stage.hardware && !is_stopping =>
                    "{key} is {value}, allowed with stage.hardware = true: {allowed}";
            }
        }
        for (n, index) in self.axis.optional_objects.iter().enumerate() {
            let Some(why) = why_needed(*index) else { continue };
            let key = &*self.key(&format!("optional_objects[{n}]"));
            contradictions! { reader;
                [key] if *index != SOFTWARE_LIMITS || !self.axis.wraps =>
                    "{key} is 0x{index:04X}, which is not optional; remove it: {why}";
            }
        }
        // The bench's own limit is the drive's window plus the travel of two SYNC periods. With a timeout of at
        // most two SYNC periods the drive reacts no later than the bench.
        let key = &*self.key("following_error_timeout_ms");
        let timeout_ms = self.axis.following_error_timeout_ms.unwrap_or_default();
        let max_ms = 2 * self.config.can.bus.sync_ms;
        contradictions! { reader;
            ["can.sync_ms", key] if timeout_ms > max_ms =>
                "{key} is {timeout_ms}, allowed: up to {max_ms} (twice can.sync_ms), so that the drive \
                 notices no later than the bench";
        }
    }

    /// Refuses raw SDOs whose value does not fit, and those to objects that the bench writes itself.
    fn raw_sdos(&self, reader: &mut Reader) {
        for (n, sdo) in self.axis.sdo.iter().enumerate() {
            let [index_key, value_key, bits_key] =
                ["index", "value", "bits"].map(|name| self.key(&format!("sdo[{n}].{name}")));
            let (low, high) = (-(1i64 << (sdo.bits.max(1) - 1)), (1i64 << sdo.bits) - 1);
            let (index, value) = (sdo.index, sdo.value);
            let object = (index, sdo.subindex);
            let set_by = SET_BY.iter().find_map(|(set, key)| {
                let is_given = *set == object && !self.number(key).is_nan();
                let key = key.replace("UNIT", self.which.unit());
                is_given.then(|| format!("{key} sets it: give one of the two"))
            });
            let why = reserved(index).map(str::to_owned).or(set_by);
            contradictions! { reader;
                [&bits_key, &value_key] if !(low..=high).contains(&value) =>
                    "{value_key} is {value}, allowed: {low} to {high}";
                [&index_key] if why.is_some() =>
                    "{index_key} is 0x{index:04X}, not for raw SDOs: {}", why.unwrap_or_default();
            }
        }
    }
}

/// The reason why a raw SDO may not write the object `index`: the object moves the axis, or the bench writes it,
/// from the key named here. `None` if a raw SDO may write it.
fn reserved(index: u16) -> Option<&'static str> {
    Some(match index {
        0x1010 | 0x1011 => {
            "it would be written at every command: store or restore once, with the maker's tool"
        }
        0x1014 | 0x1015 => {
            "the bench needs every emergency message, under the drive's own identifier"
        }
        0x1016 | 0x1017 => "set can.heartbeat_ms and can.heartbeat_timeout_ms",
        0x1029 => "set communication_error_behaviour",
        0x1400..=0x1BFF => "the bench maps the PDOs it needs, and no others",
        0x6007 => "set abort_connection_option",
        0x6040 => "it is the controlword: the bench alone enables and stops the drive",
        0x605A => "set quick_stop_option",
        0x605E => "set fault_reaction_option",
        0x6060 => "the bench sets the mode that it moves the axis in",
        0x6065 => "set following_error_mm or following_error_deg",
        0x6066 => "set following_error_timeout_ms",
        0x607A | 0x60B0..=0x60B2 | 0x60FF | 0x6071 => "it moves the axis: `needle-bench stage jog`",
        0x607D => "set min_mm and max_mm, or min_deg and max_deg",
        0x60C2 => "set can.sync_ms",
        _ => return None,
    })
}

/// Checks that the configured accelerations are within the limits of their axis: beyond them every run would stop.
fn accelerations(config: &Config, reader: &mut Reader) {
    let along = "stage.insertion.acceleration_max_mm_per_s2";
    for (key, max_key) in [
        ("insertion.acceleration_mm_per_s2", along),
        ("stage.insertion.jog_acceleration_mm_per_s2", along),
        ("stage.rotation.jog_acceleration_deg_per_s2", ROTATION_ACCELERATION_MAX),
    ] {
        let [acceleration, max] = [key, max_key].map(|key| config.number(key));
        contradictions! { reader;
            [key, max_key] if PROFILE_PEAK * acceleration > max =>
                "{key} is {acceleration}, allowed: up to {:.3}: the last set-point brakes {PROFILE_PEAK} \
                 times as hard, and {max_key} is {max}",
                rounded_down(max / PROFILE_PEAK, 3);
        }
    }
}
