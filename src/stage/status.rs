//! What both drives say of themselves. Nothing is written.

use std::collections::BTreeMap;

use super::dialogue::SdoRetrier;
use super::{Axis, AxisConfig, Dialogue, HomingConfig, Identity, PerAxis, StageConfig, Zero};
use crate::canopen::cia402::{Mode, Statusword, object};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::nmt::{NmtState, parse_heartbeat};
use crate::canopen::object::communication::{DEVICE_TYPE, identity};
use crate::canopen::sdo::{SdoReply, SdoRequest, SdoValue};
use crate::canopen::{Frame, NodeId, ObjectAddress};
use crate::units::Time;

/// What is read, in order. The first has to be there.
const OBJECTS: [ObjectAddress; 10] = [
    object::STATUSWORD,
    DEVICE_TYPE,
    identity(1),
    identity(2),
    identity(3),
    identity(4),
    object::MODES_OF_OPERATION_DISPLAY,
    object::POSITION_ACTUAL,
    object::ERROR_CODE,
    object::DIGITAL_INPUTS,
];

/// What a drive says of itself; `None` for what it does not have.
#[derive(Debug, Clone, PartialEq)]
pub struct AxisStatus {
    /// Its node.
    pub node: NodeId,
    /// 0x1000.
    pub device_type: Option<u32>,
    /// 0x1018.
    pub identity: Identity,
    /// 0x6041.
    pub statusword: Statusword,
    /// 0x6061.
    pub mode: Option<Mode>,
    /// 0x6064, counts.
    pub position_counts: Option<i32>,
    /// The same in mm or rad, where the axis has a zero of its own.
    pub position: Option<f64>,
    /// Whether it was homed, where it can be and its statusword says so in this mode.
    pub homed: Option<bool>,
    /// 0x603F, where it is not 0.
    pub error_code: Option<EmcyCode>,
    /// 0x60FD: bit 0 negative limit switch, 1 positive, 2 home.
    pub digital_inputs: Option<u32>,
    /// NMT state, where a heartbeat was heard meanwhile.
    pub nmt_state: Option<NmtState>,
}

/// Reads the status of both drives, side by side.
#[derive(Debug)]
pub struct StatusReader {
    axes: PerAxis<AxisReader>,
}

#[derive(Debug)]
struct AxisReader {
    axis: Axis,
    config: AxisConfig,
    sdo: SdoRetrier,
    left: &'static [ObjectAddress],
    values: BTreeMap<ObjectAddress, SdoValue>,
    trouble: Option<String>,
    nmt_state: Option<NmtState>,
}

impl StatusReader {
    /// Begins to read at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        let reader = |axis| AxisReader {
            axis,
            config: config.axis(axis).clone(),
            sdo: SdoRetrier::new(config, axis, now, SdoRequest::Upload(OBJECTS[0])),
            left: &OBJECTS,
            values: BTreeMap::new(),
            trouble: None,
            nmt_state: None,
        };
        StatusReader { axes: PerAxis::from_fn(reader) }
    }

    /// What the drive of `axis` has said.
    ///
    /// # Errors
    /// That it does not answer, or has no statusword.
    pub fn status(&self, axis: Axis) -> Result<AxisStatus, String> {
        self.axes[axis].status()
    }
}

impl Dialogue for StatusReader {
    fn handle_frame(&mut self, now: Time, frame: &Frame) {
        for axis in Axis::BOTH {
            self.axes[axis].handle_frame(now, frame);
        }
    }

    fn handle_timeout(&mut self, now: Time) {
        for axis in Axis::BOTH {
            let reader = &mut self.axes[axis];
            let result = reader.sdo.handle_timeout(now);
            reader.take_result(now, result);
        }
    }

    fn poll_transmit(&mut self) -> Option<Frame> {
        let PerAxis { insertion, rotation } = &mut self.axes;
        insertion.sdo.poll_transmit().or_else(|| rotation.sdo.poll_transmit())
    }

    fn deadline(&self) -> Time {
        self.axes.insertion.sdo.deadline().min(self.axes.rotation.sdo.deadline())
    }

    fn is_over(&self) -> bool {
        self.axes.all(|reader| reader.left.is_empty())
    }
}

impl AxisReader {
    fn handle_frame(&mut self, now: Time, frame: &Frame) {
        if let Some((node, state)) = parse_heartbeat(frame)
            && node == self.config.node
        {
            self.nmt_state = Some(state);
        }
        let result = self.sdo.handle_frame(now, frame);
        self.take_result(now, result);
    }

    fn take_result(&mut self, now: Time, result: Option<Result<SdoReply, String>>) {
        let (Some(result), Some((object, left))) = (result, self.left.split_first()) else {
            return;
        };
        self.left = left;
        match result {
            Ok(SdoReply::Uploaded(value)) => {
                self.values.insert(*object, value);
            }
            Err(trouble) if *object == object::STATUSWORD => {
                self.trouble = Some(trouble);
                self.left = &[];
            }
            // It does without.
            Err(_) | Ok(SdoReply::Downloaded) => {}
        }
        if let Some(object) = self.left.first() {
            self.sdo.ask(now, SdoRequest::Upload(*object));
        }
    }

    fn status(&self) -> Result<AxisStatus, String> {
        if let Some(trouble) = &self.trouble {
            return Err(format!("{}: {trouble}", self.axis));
        }
        let number = |object| self.values.get(&object).map(|value| value.to_u32());
        let statusword = number(object::STATUSWORD)
            .ok_or_else(|| format!("{}: node {} has no statusword", self.axis, self.config.node))?;
        let statusword = Statusword(statusword as u16);
        let mode = number(object::MODES_OF_OPERATION_DISPLAY).map(|mode| Mode(mode as i8));
        let position_counts = number(object::POSITION_ACTUAL).map(|counts| counts as i32);
        let has_zero = self.config.zero != Zero::Here;
        let scale = self.config.scale(self.axis, 0);
        let position =
            position_counts.filter(|_| has_zero).map(|counts| scale.value(counts.into()));
        Ok(AxisStatus {
            node: self.config.node,
            device_type: number(DEVICE_TYPE),
            identity: Identity {
                vendor: number(identity(1)).unwrap_or(0),
                product: number(identity(2)).unwrap_or(0),
                revision: number(identity(3)),
                serial: number(identity(4)),
            },
            statusword,
            mode,
            position_counts,
            position,
            homed: self.config.homing.and_then(|homing| is_homed(homing, statusword, mode)),
            error_code: number(object::ERROR_CODE)
                .filter(|code| *code != 0)
                .map(|code| EmcyCode(code as u16)),
            digital_inputs: number(object::DIGITAL_INPUTS),
            nmt_state: self.nmt_state,
        })
    }
}

/// The standard's bit says it in homing mode alone.
fn is_homed(homing: HomingConfig, statusword: Statusword, mode: Option<Mode>) -> Option<bool> {
    let says = homing.homed_bit != HomingConfig::ATTAINED_BIT || mode == Some(Mode::HOMING);
    says.then_some(statusword.0.checked_shr(homing.homed_bit.into()).unwrap_or(0) & 1 != 0)
}
