//! The worked protocol of docs/rig.md over UDP.

use crate::support::programs::alone;
use crate::support::protocol::{Protocol, follow};
use crate::support::udp_stage::group;

/// Every command. A bus made for tests asks for `hardware = false`; the braking is configured then, and 0x6085
/// is not written raw. The sensor is 3 mm off the needle's axis and 7 mm behind the tip.
#[test]
fn the_worked_protocol_from_power_on_to_the_withdrawn_needle() {
    let _alone = alone();
    let bus = format!("interface = \"udp:{}\"", group());
    let done = follow(&Protocol {
        changes: &[
            ("interface = \"can0\"", &bus),
            ("hardware = true\n", "hardware = false\n"),
            ("[[stage.insertion.sdo]]\nindex = 0x6085", "[[stage.insertion.sdo]]\nindex = 0x3001"),
            ("[[stage.rotation.sdo]]\nindex = 0x6085", "[[stage.rotation.sdo]]\nindex = 0x3001"),
        ],
        rig: &["emulator.sensor.x_mm=3.0", "emulator.sensor.z_mm=-7.0"],
        run: &[],
        leaves_out: &[],
    });
    assert!(done.is_empty() || done.len() == 15, "{done:#?}");
}
