//! What a drive of the stage may be told of stopping, and which objects it may not lack.

use super::reader::Reader;
use super::{Config, DriveConfig};

/// Objects that a drive of the bench must have, and why. Of the others that the bring-up writes, a
/// drive may lack:
///
/// - 605A: by CiA 402 it then brakes on its quick-stop ramp, as by 2
/// - 6065 and 6066: the bench compares target and position itself
/// - 60C2: it takes the period from SYNC, and what it makes of that shows as a following error
/// - 6099 and 609A: it homes at a speed of its own, as without the keys
/// - 6502: the mode that it takes is read back (6061)
/// - 1029: by CiA 301 it then goes to Pre-operational, as by 0
///
/// The bring-up never insists on 1005, 1018:3, 1018:4, 605E, and PDOs beyond the first.
const NEEDED: [(&[u16], &str); 7] = [
    (&[0x1000, 0x1018], "by it the bench knows the drive"),
    (
        &[0x1016, 0x1017, 0x6007],
        "it stops the axis when the bench falls silent, or the bench when the drive does",
    ),
    (
        &[0x1400, 0x1600, 0x1800, 0x1A00],
        "without it set-points and positions are not where the bench takes them to be",
    ),
    (&[0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x607A], "no drive is moved or watched without it"),
    (&[0x6085], "a braking that is configured must hold; a drive without it is not to be told one"),
    (&[0x6098, 0x607C], "the drive would home in a way, or to a place, that is not configured"),
    (&[SOFTWARE_LIMITS], "the drive keeps its limits itself, unless wraps is true"),
];
/// The drive's own position limits.
const SOFTWARE_LIMITS: u16 = 0x607D;

/// Notes every drive of `config` that would not stop by itself, and every object that is written
/// twice, or not at all where it must be.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    let (insertion, rotation) = (&config.stage.insertion, &config.stage.rotation);
    let decelerates = (
        insertion.quick_stop_deceleration_mm_per_s2.is_some(),
        rotation.quick_stop_deceleration_deg_per_s2.is_some(),
    );
    let axes = [
        ("stage.insertion", &insertion.drive, decelerates.0, "mm"),
        ("stage.rotation", &rotation.drive, decelerates.1, "deg"),
    ];
    for (section, drive, decelerates, unit) in axes {
        if config.stage.hardware {
            stops(section, drive, reader);
        }
        lacks(section, drive, reader);
        waits(section, drive, config.can.sync_ms, reader);
        let braking = format!("quick_stop_deceleration_{unit}_per_s2");
        raw_sdos(section, drive, decelerates.then_some(&braking), reader);
    }
}

/// A real drive brakes on quick stop, on its own faults and when the bench dies.
fn stops(section: &str, drive: &DriveConfig, reader: &mut Reader) {
    let options = [
        (
            "abort_connection_option",
            drive.abort_connection_option,
            (1..=3).contains(&drive.abort_connection_option),
            "1 (fault), 2 (no power) or 3 (quick stop): by anything else the axis may go on when the \
             bench dies (6007)",
        ),
        (
            "communication_error_behaviour",
            drive.communication_error_behaviour.into(),
            matches!(drive.communication_error_behaviour, 0 | 2),
            "0 (Pre-operational) or 2 (Stopped): by anything else the node goes on when the bench \
             dies (1029:1)",
        ),
        (
            "quick_stop_option",
            drive.quick_stop_option,
            matches!(drive.quick_stop_option, 1..=3 | 5..=7),
            "1 to 3, or 5 to 7 to stay in quick stop: 0 coasts, and others are reserved or of the \
             maker's own (605A)",
        ),
        (
            "fault_reaction_option",
            drive.fault_reaction_option,
            (1..=3).contains(&drive.fault_reaction_option),
            "1 to 3: 0 coasts, and others are reserved or of the maker's own (605E)",
        ),
    ];
    for (name, value, stops, allowed) in options {
        let key = format!("{section}.{name}");
        reader.check(&["stage.hardware", &key], !stops, || {
            format!("{key} is {value}, allowed with stage.hardware = true: {allowed}")
        });
    }
}

fn lacks(section: &str, drive: &DriveConfig, reader: &mut Reader) {
    for (n, index) in drive.optional_objects.iter().enumerate() {
        let needed = NEEDED.iter().find(|(indexes, _)| indexes.contains(index));
        let has_none = *index == SOFTWARE_LIMITS && drive.wraps;
        let key = format!("{section}.optional_objects[{n}]");
        reader.check(&[&key], needed.is_some() && !has_none, || {
            let why = needed.map_or("", |(_, why)| why);
            format!("{key} is 0x{index:04X}, which is not optional: {why}")
        });
    }
}

/// The bench allows for what the target does in two SYNC periods beyond the drive's window: a drive
/// that waits no longer than these notices no later than the bench.
fn waits(section: &str, drive: &DriveConfig, sync_ms: u16, reader: &mut Reader) {
    let Some(timeout_ms) = drive.following_error_timeout_ms else { return };
    let key = format!("{section}.following_error_timeout_ms");
    reader.check(&["can.sync_ms", &key], timeout_ms > 2 * sync_ms, || {
        format!(
            "{key} is {timeout_ms}, allowed: up to twice can.sync_ms, which is {sync_ms}, so that the \
             drive notices no later than the bench"
        )
    });
}

/// `braking`: the key that sets 6085, where it is given. Where it is not, the object may be written
/// in the units that the drive has of its own.
fn raw_sdos(section: &str, drive: &DriveConfig, braking: Option<&String>, reader: &mut Reader) {
    for (n, sdo) in drive.sdo.iter().enumerate() {
        let [key, value, bits] =
            ["index", "value", "bits"].map(|key| format!("{section}.sdo[{n}].{key}"));
        let (low, high) = (-(1i64 << (sdo.bits.max(1) - 1)), (1i64 << sdo.bits) - 1);
        reader.check(&[&bits, &value], !(low..=high).contains(&sdo.value), || {
            format!("{value} is {}, allowed: {low} to {high}", sdo.value)
        });
        let twice = braking.filter(|_| sdo.index == 0x6085);
        let why = match twice {
            Some(braking) => Some(format!("{braking} sets it: give one of the two")),
            None => reserved(sdo.index).map(str::to_owned),
        };
        let index = sdo.index;
        reader.check(&[&key], why.is_some(), || {
            format!("{key} is 0x{index:04X}, not for raw SDOs: {}", why.unwrap_or_default())
        });
    }
}

/// Why an object is not for raw SDOs: it moves the axis, or the bench writes it by itself; with what
/// to set instead. `None` where it may be written.
fn reserved(index: u16) -> Option<&'static str> {
    Some(match index {
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

#[cfg(test)]
mod tests {
    use crate::config::{Config, Source};

    const RIG: &str = include_str!("../../bench-config/rig-epos4.toml");

    fn said(text: &str, sets: &[&str]) -> Result<Config, String> {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        let source = Source { name: "rig.toml", text };
        Config::from_sources(&[source], &sets).map_err(|error| error.to_string())
    }

    #[test]
    fn a_real_drive_must_stop_by_itself() {
        for (key, allowed, refused) in [
            ("abort_connection_option", &[1, 2, 3][..], &[-1, 0, 4][..]),
            ("communication_error_behaviour", &[0, 2], &[1, 3]),
            ("quick_stop_option", &[1, 2, 3, 5, 6, 7], &[-1, 0, 4, 8]),
            ("fault_reaction_option", &[1, 2, 3], &[-1, 0, 4]),
        ] {
            let set = |value| format!("stage.rotation.{key}={value}");
            for value in allowed {
                assert!(said(RIG, &[&set(value)]).is_ok(), "{key} = {value}");
            }
            for value in refused {
                let message = said(RIG, &[&set(value)]).unwrap_err();
                let expected =
                    format!("--set stage.rotation.{key} is {value}, allowed with stage.hardware");
                assert!(message.starts_with(&expected), "{message}");
            }
            assert!(
                said("", &[&set(refused.last().unwrap())]).is_ok(),
                "an emulated one may be told so"
            );
        }
    }

    #[test]
    fn what_moves_or_watches_an_axis_is_not_optional() {
        for index in [
            0x1000, 0x1016, 0x1017, 0x1018, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6007, 0x6040, 0x6041,
            0x6060, 0x6061, 0x6064, 0x607A, 0x607C, 0x607D, 0x6085, 0x6098,
        ] {
            let set = format!("stage.insertion.optional_objects=[0x60C2, {index}]");
            let message = said("", &[&set]).unwrap_err();
            let expected = format!(
                "--set stage.insertion.optional_objects[1] is 0x{index:04X}, which is not optional"
            );
            assert!(message.starts_with(&expected), "{message}");
        }
        let sets = ["stage.rotation.wraps=true", "stage.rotation.optional_objects=[0x607D]"];
        assert!(said("", &sets).is_ok(), "an axis that goes round has no limits of its own");
        let others = "stage.rotation.optional_objects=[0x1005, 0x1029, 0x1401, 0x605A, 0x605E, \
                      0x6065, 0x6066, 0x6099, 0x609A, 0x60C2, 0x6502]";
        assert!(said("", &[others]).is_ok());
        assert!(said(RIG, &[others]).is_ok());
    }

    #[test]
    fn a_drive_notices_no_later_than_the_bench() {
        let timeout = |ms| format!("stage.insertion.following_error_timeout_ms={ms}");
        assert!(said("", &[&timeout(20)]).is_ok());
        assert_eq!(
            said("", &[&timeout(21)]).unwrap_err(),
            "--set stage.insertion.following_error_timeout_ms is 21, allowed: up to twice \
             can.sync_ms, which is 10, so that the drive notices no later than the bench"
        );
    }

    #[test]
    fn what_the_bench_writes_itself_is_not_for_raw_sdos() {
        let raw = |index: u16| {
            format!(
                "stage.insertion.sdo=[{{ index = {index}, subindex = 0, value = 0, bits = 8 }}]"
            )
        };
        for (index, instead) in [
            (0x6040, "the bench alone enables"),
            (0x6060, "the bench sets the mode"),
            (0x607A, "`needle-bench stage jog`"),
            (0x60FF, "`needle-bench stage jog`"),
            (0x6071, "`needle-bench stage jog`"),
            (0x1016, "can.heartbeat_timeout_ms"),
            (0x1017, "can.heartbeat_ms"),
            (0x1029, "communication_error_behaviour"),
            (0x6007, "abort_connection_option"),
            (0x605A, "quick_stop_option"),
            (0x605E, "fault_reaction_option"),
            (0x607D, "max_mm"),
            (0x6065, "following_error_mm"),
            (0x6066, "following_error_timeout_ms"),
            (0x6085, "quick_stop_deceleration_mm_per_s2"),
            (0x60C2, "can.sync_ms"),
            (0x1400, "maps the PDOs"),
            (0x1BFF, "maps the PDOs"),
        ] {
            let message = said("", &[&raw(index)]).unwrap_err();
            let key =
                format!("--set stage.insertion.sdo[0].index is 0x{index:04X}, not for raw SDOs");
            assert!(message.starts_with(&key) && message.contains(instead), "{message}");
        }
        assert!(said("", &[&raw(0x2000)]).is_ok());
        assert!(said(RIG, &[]).is_ok(), "6085 in the drive's own units, where no key sets it");
    }
}
