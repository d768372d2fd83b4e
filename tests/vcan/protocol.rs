//! The worked protocol of docs/rig.md with `hardware = true`, as on a rig.

use crate::support::protocol::{Protocol, follow};
use crate::support::vcan;

/// In an emulated machine each record takes seconds to be made, so what talks to the tracker alone, and the
/// second motion of a kind, are left to the test over UDP. An emulated drive takes 0x6085 in counts per second
/// squared: 21.5 mm/s² and 475°/s².
#[test]
fn the_worked_protocol_with_hardware() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let done = follow(&Protocol {
        changes: &[
            ("interface = \"can0\"", "interface = \"vcan0\""),
            ("value = 10_000  ", "value = 100_000  "),
            ("value = 10_000\n", "value = 100_000\n"),
        ],
        rig: &[],
        // The default observer takes most of a SYNC period there.
        run: &[
            "--set",
            "observer.kind=\"coupled\"",
            "--set",
            "observer.coupled.gains=\"placed\"",
            "--set",
            "observer.shadows=[]",
            "--set",
            "control.kind=\"feedback-linearization\"",
        ],
        leaves_out: &[
            "tracker",
            "stage jog my-rig.toml --axis rotation",
            "stage prove my-rig.toml --handedness",
            "calibrate tip",
            "replay",
        ],
    });
    assert!(done.is_empty() || done.len() == 10, "{done:#?}");
}
