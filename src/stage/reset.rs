//! Resetting both drives' faults on purpose. Nothing gets power by it.

use super::dialogue::{Conversation, Sdo, WithBothDrives};
use super::{Axis, StageConfig};
use crate::canopen::cia402::{Controlword, DriveState, Statusword, object};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::object::communication::error_history;
use crate::canopen::sdo::SdoValue;
use crate::units::Time;
use std::time::Duration;

/// A drive leaves Fault within this time, or stays there.
const SETTLE: Duration = Duration::from_millis(200);

/// Resets both drives, side by side; gives their statuswords after it.
pub type Reset = WithBothDrives<Statusword>;

impl Reset {
    /// Begins to reset at `now`.
    pub fn new(config: &StageConfig, now: Time) -> Self {
        WithBothDrives::begin([], |axis| {
            let sdo = Sdo::new(config, axis);
            Conversation::begin(&sdo.clone(), now, reset(sdo))
        })
    }

    /// The state of the drive of `axis` after the reset.
    ///
    /// # Errors
    /// Why it was not reset: it does not answer, has power, or its cause is still there.
    pub fn result(&self, axis: Axis) -> Result<Statusword, String> {
        let outcome = self.axis(axis).outcome().cloned();
        let outcome =
            outcome.unwrap_or_else(|| Err("the reset did not come to its end".to_owned()));
        outcome.map_err(|error| format!("{axis}: {error}"))
    }
}

async fn reset(sdo: Sdo) -> Result<Statusword, String> {
    let statusword =
        async || Ok::<_, String>(Statusword(sdo.read(object::STATUSWORD).await?.to_u32() as u16));
    let node = sdo.node();
    if statusword().await?.state() == Some(DriveState::OperationEnabled) {
        return Err(format!("node {node} has power: stop it first, needle-bench stop"));
    }
    // The drive takes the rising edge of the reset bit.
    for word in [Controlword::DISABLE_VOLTAGE.0, Controlword::FAULT_RESET_BIT, 0] {
        sdo.write(object::CONTROLWORD, SdoValue::from(word)).await?;
    }
    sdo.pause(SETTLE).await;
    let word = statusword().await?;
    if matches!(word.state(), Some(DriveState::Fault | DriveState::FaultReactionActive)) {
        let code = sdo.read(object::ERROR_CODE).await.map(|code| EmcyCode(code.to_u32() as u16));
        let code = code.map(|code| format!(", error {code}")).unwrap_or_default();
        return Err(format!("node {node} stays in fault{code}: its cause is still there"));
    }
    // A drive without a history has nothing to clear.
    let _ = sdo.write(error_history(0), SdoValue::from(0_u8)).await;
    Ok(word)
}
