//! A dialogue with the drives, on a bus or on the virtual stage.

use super::timing::Clock;
use crate::emulator::{StageOutput, VirtualStage};
use crate::stage::Dialogue;
use crate::transport::can::{BusEvent, CanBus, CanError};
use crate::units::Time;

/// Holds `dialogue` on `bus` to its end.
///
/// # Errors
/// What the bus says: off, down, or a frame that it does not take.
pub fn talk_live(
    dialogue: &mut dyn Dialogue,
    bus: &mut dyn CanBus,
    clock: Clock,
) -> Result<(), CanError> {
    loop {
        while let Some(frame) = dialogue.poll_transmit() {
            bus.send(&frame)?;
        }
        if dialogue.is_over() {
            return Ok(());
        }
        let (now, deadline) = (clock.now(), dialogue.deadline());
        if now >= deadline {
            dialogue.handle_timeout(now);
            continue;
        }
        match bus.receive(deadline.since(now))? {
            Some(BusEvent::Frame(frame)) => dialogue.handle_frame(clock.now(), &frame),
            Some(BusEvent::Error(error)) => tracing::warn!("{error}"),
            None => {}
        }
    }
}

/// Holds `dialogue` with the drives of `stage`, in virtual time, to its end.
pub fn talk_virtual(dialogue: &mut dyn Dialogue, stage: &mut VirtualStage) {
    let mut now = Time::ZERO;
    while !dialogue.is_over() {
        let mut quiet = true;
        while let Some(frame) = dialogue.poll_transmit() {
            quiet = false;
            stage.handle_frame(now, &frame);
        }
        while let Some(output) = stage.poll() {
            if let StageOutput::Frame(frame) = output {
                quiet = false;
                dialogue.handle_frame(now, &frame);
            }
        }
        if quiet {
            now = now.max(dialogue.deadline().min(stage.deadline()));
            stage.handle_timeout(now);
            dialogue.handle_timeout(now);
        }
    }
}
