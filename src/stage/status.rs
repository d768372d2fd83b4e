//! Reads the status of both drives by SDO, which writes nothing, and resets their faults on request. Neither
//! gives a drive power.

use super::dialogue::{ScriptRunner, Sdo, WithBothDrives};
use super::event::may_have_power;
use super::{Axis, AxisConfig, HomingConfig, Identity, StageConfig};
use crate::canopen::NodeId;
use crate::canopen::cia402::{Controlword, Mode, Statusword, object};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::nmt::NmtState;
use crate::canopen::object::communication::{DEVICE_TYPE, error_history, identity};
use crate::canopen::sdo::SdoValue;
use crate::units::Time;
use std::time::Duration;

/// At most this many entries of an error history are read.
const HISTORY_MAX: u32 = 8;

/// The status of one drive; `None` for an object that the drive lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct AxisStatus {
    /// Node ID.
    pub node: NodeId,
    /// Device type (0x1000).
    pub device_type: Option<u32>,
    /// Identity object (0x1018).
    pub identity: Identity,
    /// Statusword (0x6041).
    pub statusword: Statusword,
    /// Mode of operation (0x6061).
    pub mode: Option<Mode>,
    /// Actual position (0x6064), counts.
    pub position_counts: Option<i32>,
    /// The same in mm or rad, measured from the axis's configured zero, or else from the drive's zero.
    pub position: Option<f64>,
    /// Whether the axis is homed; `None` if it cannot be homed, or if the present mode does not show it.
    pub homed: Option<bool>,
    /// Error code (0x603F), if it is not 0.
    pub error_code: Option<EmcyCode>,
    /// Error history (0x1003), the newest first.
    pub error_history: Vec<EmcyCode>,
    /// Digital inputs (0x60FD): bit 0 negative limit switch, 1 positive limit switch, 2 home switch.
    pub digital_inputs: Option<u32>,
    /// NMT state, if a heartbeat came while the status was read.
    pub nmt_state: Option<NmtState>,
    /// How many more answers than requests there were, if they show that two drives have this node number; else 0.
    pub extra_answers: u32,
}

/// Reads the status of both drives at the same time.
pub type StatusReader = WithBothDrives<AxisStatus>;

impl StatusReader {
    /// Begins to read at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        WithBothDrives::begin([], |axis| {
            let sdo = Sdo::new(config, axis);
            let script = read_status(sdo.clone(), axis, config.axis(axis).clone());
            ScriptRunner::begin(&sdo, now, script)
        })
    }

    /// The status of the drive of `axis`.
    ///
    /// # Errors
    /// If the drive does not answer, has no statusword, or was not read to the end.
    pub fn status(&self, axis: Axis) -> Result<AxisStatus, String> {
        let interrupted = || Err(format!("{axis}: reading the status was interrupted"));
        let sdo = &self.axes[axis].sdo;
        let (nmt_state, extra_answers) = (sdo.nmt_state(), sdo.extra_answers());
        let status = self.outcome(axis).unwrap_or_else(interrupted);
        match (status, nmt_state) {
            (Err(_), Some(NmtState::Stopped)) => Err(format!(
                "{axis}: the node is in NMT stopped, where it answers no SDO; needle-bench stop CONFIG \
                 leads it to Pre-operational"
            )),
            (status, nmt_state) => Ok(AxisStatus { nmt_state, extra_answers, ..status? }),
        }
    }
}

/// Reads one object after the other. The drive must have the first; it may lack the others.
async fn read_status(sdo: Sdo, axis: Axis, config: AxisConfig) -> Result<AxisStatus, String> {
    let statusword = sdo.statusword().await?;
    let number = async |object| {
        let value = sdo.read_optional(object).await?;
        Ok::<_, String>(value.map(SdoValue::to_u32))
    };
    let device_type = number(DEVICE_TYPE).await?;
    let identity = Identity {
        vendor: number(identity(1)).await?.unwrap_or(0),
        product: number(identity(2)).await?.unwrap_or(0),
        revision: number(identity(3)).await?,
        serial: number(identity(4)).await?,
    };
    let mode = number(object::MODES_OF_OPERATION_DISPLAY).await?.map(|mode| Mode(mode as i8));
    let position_counts = number(object::POSITION_ACTUAL).await?.map(|counts| counts as i32);
    let scale = config.scale(axis, 0);
    let error_code = number(object::ERROR_CODE).await?.filter(|code| *code != 0);
    let errors = number(error_history(0)).await?.unwrap_or(0).min(HISTORY_MAX);
    let mut history = Vec::new();
    for entry in 1..=errors as u8 {
        // The upper 16 bits are manufacturer-specific.
        history.extend(number(error_history(entry)).await?.map(|error| EmcyCode(error as u16)));
    }
    Ok(AxisStatus {
        node: config.node,
        device_type,
        identity,
        statusword,
        mode,
        position_counts,
        position: position_counts.map(|counts| scale.value(counts.into())),
        homed: config.homing.and_then(|homing| is_homed(homing, statusword, mode)),
        error_code: error_code.map(|code| EmcyCode(code as u16)),
        error_history: history,
        digital_inputs: number(object::DIGITAL_INPUTS).await?,
        nmt_state: None,
        extra_answers: 0,
    })
}

/// Whether the axis is homed; `None` if the present mode does not show it: bit 12 (homing attained) means that
/// in homing mode only.
fn is_homed(homing: HomingConfig, statusword: Statusword, mode: Option<Mode>) -> Option<bool> {
    let is_valid = homing.homed_bit != HomingConfig::ATTAINED_BIT || mode == Some(Mode::HOMING);
    is_valid.then_some(homing.says_homed(statusword))
}

/// A drive that a reset leads out of Fault leaves it within this time.
const RESET_TIME: Duration = Duration::from_millis(200);

/// Resets the faults of both drives at the same time; returns their statuswords after it.
pub type Reset = WithBothDrives<Statusword>;

impl Reset {
    /// Begins the reset at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        WithBothDrives::begin([], |axis| {
            let sdo = Sdo::new(config, axis);
            ScriptRunner::begin(&sdo.clone(), now, reset(sdo))
        })
    }

    /// The statusword of the drive of `axis` after the reset.
    ///
    /// # Errors
    /// The drive does not answer, has power, or stays in Fault because the cause is still there.
    pub fn result(&self, axis: Axis) -> Result<Statusword, String> {
        let interrupted = || Err(format!("{axis}: the reset did not come to its end"));
        self.outcome(axis).unwrap_or_else(interrupted)
    }
}

async fn reset(sdo: Sdo) -> Result<Statusword, String> {
    let (node, word) = (sdo.node(), sdo.statusword().await?);
    if may_have_power(word.state()) {
        return Err(format!(
            "node {node} has power ({word}): stop it first, needle-bench stop CONFIG"
        ));
    }
    // A rising edge of bit 7 resets the fault.
    for word in
        [Controlword::DISABLE_VOLTAGE, Controlword::FAULT_RESET, Controlword::DISABLE_VOLTAGE]
    {
        sdo.write(object::CONTROLWORD, SdoValue::from(word.0)).await?;
    }
    sdo.pause(RESET_TIME).await;
    let word = sdo.statusword().await?;
    if word.is_fault() {
        let code = sdo.read(object::ERROR_CODE).await.map(|code| EmcyCode(code.to_u32() as u16));
        let code = code.map(|code| format!(", error {code}")).unwrap_or_default();
        return Err(format!("node {node} stays in fault{code}: its cause is still there"));
    }
    // A drive without a history has nothing to clear.
    let _ = sdo.write(error_history(0), SdoValue::from(0_u8)).await;
    Ok(word)
}
