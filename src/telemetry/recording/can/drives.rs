//! The drives behind the node numbers: their scales and their states.

use super::service::Service;
use crate::canopen::Frame;
use crate::canopen::cia402::{DriveState, Statusword};
use crate::session::StageRecord;
use crate::stage::{Axis, PerAxis, Scale, Sign, StageConfig};

/// What is known of the two drives.
#[derive(Debug)]
pub(super) struct Drives(PerAxis<Drive>);

#[derive(Debug)]
struct Drive {
    node: u8,
    /// With the sign: mm, or degrees, for each count.
    unit_per_count: f64,
    /// Where the axis reads zero, once that was seen.
    zero_counts: Option<f64>,
    position_counts: Option<i32>,
    state: Option<DriveState>,
}

impl Drives {
    pub(super) fn new(stage: &StageConfig) -> Self {
        Drives(PerAxis::from_fn(|axis| {
            let config = stage.axis(axis);
            let scale = Scale::new(axis, config.ratio, config.sign, 0);
            let unit = match axis {
                Axis::Insertion => 1.0,
                Axis::Rotation => 1f64.to_degrees(),
            };
            let sign = match config.sign {
                Sign::Positive => 1.0,
                Sign::Negative => -1.0,
            };
            Drive {
                node: config.node.get(),
                unit_per_count: sign * unit / scale.counts_per_unit(),
                zero_counts: None,
                position_counts: None,
                state: None,
            }
        }))
    }

    /// Looks at a frame; the axis whose drive entered another state, and that state.
    pub(super) fn follow(&mut self, service: Service, frame: &Frame) -> Option<(Axis, DriveState)> {
        let Service::Tpdo(1, node) = service else { return None };
        let &[s0, s1, p0, p1, p2, p3] = frame.data() else { return None };
        let axis = self.axis_of(node)?;
        let drive = &mut self.0[axis];
        drive.position_counts = Some(i32::from_le_bytes([p0, p1, p2, p3]));
        let state = Statusword(u16::from_le_bytes([s0, s1])).state()?;
        (drive.state.replace(state) != Some(state)).then_some((axis, state))
    }

    /// The stage at the SYNC that the last feedback answered: where the counts have their zero.
    pub(super) fn locate(&mut self, stage: &StageRecord) {
        for axis in Axis::BOTH {
            let drive = &mut self.0[axis];
            if let (None, Some(counts)) = (drive.zero_counts, drive.position_counts) {
                let meas = match axis {
                    Axis::Insertion => stage.insertion_meas_mm,
                    Axis::Rotation => stage.rotation_meas_rad.to_degrees(),
                };
                drive.zero_counts = Some(f64::from(counts) - meas / drive.unit_per_count);
            }
        }
    }

    /// A position of the drive `node` in counts, and as the axis has it where that is known.
    pub(super) fn position(&self, node: u8, counts: i32) -> String {
        let Some(axis) = self.axis_of(node) else { return format!("{counts} counts") };
        let drive = &self.0[axis];
        let unit = match axis {
            Axis::Insertion => "mm",
            Axis::Rotation => "deg",
        };
        match drive.zero_counts {
            Some(zero) => {
                let value = (f64::from(counts) - zero) * drive.unit_per_count;
                format!("{counts} counts = {value:.3} {unit}")
            }
            None => format!("{counts} counts"),
        }
    }

    fn axis_of(&self, node: u8) -> Option<Axis> {
        Axis::BOTH.into_iter().find(|&axis| self.0[axis].node == node)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::run_info;
    use crate::units::Time;

    #[test]
    fn counts_have_a_unit_once_the_stage_told_where_it_is() {
        let mut drives = Drives::new(&run_info().scene.stage);
        let frame = Frame::new(0x181, &[0x37, 0x16, 0xE8, 3, 0, 0]);
        let entered = drives.follow(Service::of(&frame), &frame);
        assert_eq!(entered, Some((Axis::Insertion, DriveState::OperationEnabled)));
        assert_eq!(drives.follow(Service::of(&frame), &frame), None);
        assert_eq!(drives.position(1, 1000), "1000 counts");
        drives.locate(&StageRecord {
            time: Time::ZERO,
            insertion_meas_mm: 2.0,
            rotation_meas_rad: 0.0,
            insertion_cmd_mm: 2.0,
            rotation_cmd_rad: 0.0,
        });
        // 1000 counts a mm: 1000 counts are 2 mm, so 500 more are 2.5 mm.
        assert_eq!(drives.position(1, 1500), "1500 counts = 2.500 mm");
        assert_eq!(drives.position(9, 7), "7 counts");
    }
}
