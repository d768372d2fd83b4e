//! Homing (CiA 402-2, mode 6): its legs, and how the axis moves along them.

use super::axis::{Axis, whole};
use super::device::Device;
use super::inputs::{End, Switches};
use super::motion::Motion;
use super::objects::{ACCELERATION_MAX_COUNTS_PER_S2, MAX_ACCELERATION};
use super::profile::Profile;
use crate::canopen::cia402::{Controlword, Mode, object};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::units::Time;

/// Counts between two index pulses of the encoder.
const INDEX_COUNTS: i64 = 2000;

/// The homing methods (0x6098) of an emulated drive that has the switch which the method seeks.
pub const HOMING_METHODS: [i8; 9] = [1, 2, 17, 18, 24, 33, 34, 35, 37];

/// One move of a homing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Leg {
    /// Its end, in encoder counts.
    pub(super) to_counts: i64,
    /// True for the speed during search for switch (0x6099:01), false for the speed during search for zero (:02).
    pub(super) fast: bool,
    /// The limit switch that it moves onto. Any other closed limit switch is a homing error.
    pub(super) onto: Option<End>,
}

/// The state of homing.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) enum Homing {
    /// Not started, interrupted, or finished.
    #[default]
    Idle,
    InProgress {
        /// The legs after the present one.
        legs: Vec<Leg>,
        /// The limit switch that the present leg moves onto.
        onto: Option<End>,
        home_counts: i64,
    },
    /// Homing error: bit 13.
    Failed,
}

/// True for a homing method (0x6098) that works with these switches.
pub(super) fn is_supported(method: i64, switches: &Switches) -> bool {
    plan(method, 0, switches, INDEX_COUNTS, 0).is_some()
}

/// The legs and the home position of `method` (0x6098), started at `at_counts`. Methods 1 and 2 seek a limit
/// switch and then the index pulse, 17 and 18 the limit switch, 24 the home switch, 33 and 34 the
/// index pulse. Methods 35 and 37 take the present position.
///
/// The emulator knows the positions of its switches. The axis moves onto a switch, brakes `overrun_counts`
/// beyond it, and moves back. The encoder has an index pulse every `index_counts`. `None` for a method that
/// is not supported, or whose switch does not exist.
fn plan(
    method: i64,
    at_counts: i64,
    switches: &Switches,
    index_counts: i64,
    overrun_counts: i64,
) -> Option<(Vec<Leg>, i64)> {
    let index_above = |counts: i64| (counts.div_euclid(index_counts) + 1) * index_counts;
    let index_below = |counts: i64| (counts - 1).div_euclid(index_counts) * index_counts;
    let slow = |to_counts| Leg { to_counts, fast: false, onto: None };
    let seek = |to_counts, onto| Leg { to_counts, fast: true, onto };
    let plan = match method {
        1 | 17 => {
            let closes = switches.negative_counts?;
            let onto = seek(closes - overrun_counts, Some(End::Negative));
            let home = if method == 1 { index_above(closes) } else { closes + 1 };
            (vec![onto, Leg { onto: Some(End::Negative), ..slow(home) }], home)
        }
        2 | 18 => {
            let closes = switches.positive_counts?;
            let onto = seek(closes + overrun_counts, Some(End::Positive));
            let home = if method == 2 { index_below(closes) } else { closes - 1 };
            (vec![onto, Leg { onto: Some(End::Positive), ..slow(home) }], home)
        }
        // From a closed switch the axis first moves off it. It moves onto the switch from below.
        24 => {
            let closes = switches.home_counts?;
            let off = (at_counts >= closes).then(|| seek(closes - overrun_counts, None));
            (off.into_iter().chain([slow(closes)]).collect(), closes)
        }
        33 => (vec![slow(index_below(at_counts))], index_below(at_counts)),
        34 => (vec![slow(index_above(at_counts))], index_above(at_counts)),
        35 | 37 => (vec![], at_counts),
        _ => return None,
    };
    Some(plan)
}

impl Axis {
    /// Handles a controlword in homing mode. The rising edge of bit 4 since the one `before` starts homing,
    /// its falling edge stops it.
    pub(super) fn handle_homing_bit(
        &mut self,
        now: Time,
        word: Controlword,
        before: Controlword,
        device: &mut Device,
    ) {
        if self.mode(&device.objects) != Mode::HOMING {
            return;
        }
        match (word.has(Controlword::HOMING_START_BIT), before.has(Controlword::HOMING_START_BIT)) {
            (true, false) => self.begin_homing(now, device),
            (false, true) => self.interrupt_homing(now, &device.objects),
            _ => {}
        }
    }

    /// The limits of a move of homing: counts/s and counts/s².
    fn limits(&self, fast: bool, objects: &ObjectDictionary) -> (f64, f64) {
        let speed = if fast { object::HOMING_SPEED_SWITCH } else { object::HOMING_SPEED_ZERO };
        let acceleration = (objects.integer(object::HOMING_ACCELERATION) as f64)
            .min(objects.integer(MAX_ACCELERATION) as f64)
            .min(ACCELERATION_MAX_COUNTS_PER_S2);
        let speed = (objects.integer(speed) as f64).min(self.speed_limit(objects));
        (speed.max(1.0), acceleration.max(1.0))
    }

    /// Starts a move of an axis at rest. A blocked axis faults with a following error.
    fn begin_move(&mut self, now: Time, leg: Leg, device: &mut Device) {
        if self.is_stalled {
            return self.fault(now, EmcyCode::FOLLOWING_ERROR, device);
        }
        let (speed, acceleration) = self.limits(leg.fast, &device.objects);
        let (from, to) = (self.motion.position_at(now), leg.to_counts as f64);
        self.demand = leg.to_counts;
        self.motion = Motion::Ramped(Profile::new(now, from, to, speed, acceleration));
    }

    /// Plans homing from where the axis stands, or will stand.
    fn begin_homing(&mut self, now: Time, device: &mut Device) {
        self.referenced = false;
        let objects = &device.objects;
        let method = objects.integer(object::HOMING_METHOD);
        let (speed, acceleration) = self.limits(true, objects);
        let overrun = whole(speed * speed / (2.0 * acceleration)).max(1);
        self.brake(now, whole(acceleration));
        let (at, switches) = (whole(self.motion.to()), &self.inputs.switches);
        self.homing = match plan(method, at, switches, INDEX_COUNTS, overrun) {
            Some((legs, home_counts)) => Homing::InProgress { legs, onto: None, home_counts },
            None => Homing::Failed,
        };
        if matches!(self.motion, Motion::Hold { .. }) {
            self.begin_next_leg(now, device);
        }
    }

    /// Starts the next leg of homing; the axis stands.
    pub(super) fn begin_next_leg(&mut self, now: Time, device: &mut Device) {
        let Homing::InProgress { legs, onto, home_counts } = &mut self.homing else { return };
        if legs.is_empty() {
            // The zero position is the home position plus the home offset.
            self.zero = *home_counts + device.objects.integer(object::HOME_OFFSET);
            self.referenced = true;
            self.homing = Homing::Idle;
        } else {
            let leg = legs.remove(0);
            *onto = leg.onto;
            self.begin_move(now, leg, device);
        }
    }

    /// Interrupts homing; the axis brakes.
    pub(super) fn interrupt_homing(&mut self, now: Time, objects: &ObjectDictionary) {
        if matches!(self.homing, Homing::InProgress { .. }) {
            self.homing = Homing::Idle;
            self.brake(now, objects.integer(object::PROFILE_DECELERATION));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SWITCHES: Switches = Switches {
        negative_counts: Some(-1000),
        positive_counts: Some(5000),
        home_counts: Some(2000),
    };

    /// Rows are (method, start, home), with an index pulse every 300 counts.
    #[test]
    fn every_homing_method_finds_its_home() {
        for (method, from, home) in [
            (1, 0, -900),
            (17, 0, -999),
            (2, 0, 4800),
            (18, 0, 4999),
            (24, 0, 2000),
            (24, 3000, 2000),
            (33, 100, 0),
            (33, 300, 0),
            (34, 100, 300),
            (34, 300, 600),
            (35, 123, 123),
            (37, -7, -7),
        ] {
            let (legs, found) = plan(method, from, &SWITCHES, 300, 50).unwrap();
            assert_eq!(found, home, "method {method} from {from}");
            assert_eq!(legs.last().map_or(from, |leg| leg.to_counts), home, "method {method}");
        }
        assert_eq!(plan(3, 0, &SWITCHES, 300, 50), None);
    }

    #[test]
    fn a_method_needs_its_switch() {
        let all = HOMING_METHODS.map(i64::from);
        let [negative, positive, home] = [&[1, 17][..], &[2, 18], &[24]];
        for (switches, lacking) in [
            (SWITCHES, vec![]),
            (Switches { negative_counts: None, ..SWITCHES }, negative.to_vec()),
            (Switches { positive_counts: None, ..SWITCHES }, positive.to_vec()),
            (Switches { home_counts: None, ..SWITCHES }, home.to_vec()),
            (Switches::default(), [negative, positive, home].concat()),
        ] {
            for method in -128..128 {
                let expected = all.contains(&method) && !lacking.contains(&method);
                assert_eq!(is_supported(method, &switches), expected, "{method}, {switches:?}");
            }
        }
    }
}
