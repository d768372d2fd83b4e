//! What of the events of the stage and of the tracker's link is for the operator to read.

use super::Severity;
use crate::stage::StageEvent;
use crate::tracker::Event;

/// The news in `event`, with how much it matters; `None` for what has a record of its own.
pub(crate) fn news(event: &StageEvent) -> Option<(Severity, String)> {
    Some(match event {
        StageEvent::Progress(progress) => (Severity::Info, progress.to_string()),
        StageEvent::Homed { axis, position } => {
            (Severity::Info, format!("{axis}: home, at {position:.3} {}", axis.unit()))
        }
        StageEvent::Emergency(axis, emcy) => {
            (Severity::Warning, format!("{axis}: emergency {emcy}"))
        }
        StageEvent::InternalLimit(axis) => {
            let text = format!(
                "{axis}: a limit inside the drive holds (statusword bit 11); are its 0x607D, 0x607B \
                 and current limits those of this rig?"
            );
            (Severity::Warning, text)
        }
        StageEvent::NotShown(axis, flag) => {
            let text = format!(
                "{axis}: the enabled drive has not set statusword {flag}: its loss could not be \
                 noticed; see its manual"
            );
            (Severity::Warning, text)
        }
        StageEvent::Warns { axis, statusword, count } => {
            let text = format!(
                "{axis}: the drive warns (statusword {statusword}, bit 7), {count} so far; see its \
                 manual and its display for why"
            );
            (Severity::Warning, text)
        }
        StageEvent::Flood(frames) => {
            let text =
                format!("a flood on the bus: {frames} frames within 100 ms that no run is made of");
            (Severity::Warning, text)
        }
        StageEvent::Ignored { why, count, frame } => {
            (Severity::Warning, format!("{why}, {count} so far, the newest {frame}"))
        }
        StageEvent::SyncSkipped(periods) => {
            (Severity::Warning, format!("the bench was late: {periods} SYNC periods skipped"))
        }
        StageEvent::Feedback(_)
        | StageEvent::Located(_)
        | StageEvent::Ready
        | StageEvent::Identity(..)
        | StageEvent::Fault(_)
        | StageEvent::Stopped { .. } => return None,
    })
}

/// The news in what the tracker's link says; `None` for what has a record of its own, or is counted.
pub(crate) fn tracker_news(event: &Event) -> Option<(Severity, String)> {
    Some(match event {
        Event::Connected { peer } => (Severity::Info, format!("connected to {peer}")),
        Event::Unreachable { reason } | Event::Disconnected { reason } => {
            (Severity::Warning, reason.clone())
        }
        Event::Status { device, status } => {
            let (code, name, message) = (status.code, &status.error_name, &status.message);
            (Severity::Info, format!("{device}: status {code} {name} {message}"))
        }
        Event::SawTool { tool, message_type } => {
            (Severity::Info, format!("\"{tool}\" is on the stream ({message_type})"))
        }
        Event::Malformed(error) => (Severity::Warning, error.clone()),
        Event::Sample(_) | Event::PassedOver { .. } => return None,
    })
}

/// What is not known of a stage that was told to stop; `None` where it was seen to stand without
/// power.
pub(crate) fn left_unknown(standing: bool, off: bool) -> Option<&'static str> {
    match (standing, off) {
        (true, true) => None,
        (false, true) => Some("the axes were not seen to stand before power was taken off"),
        (true, false) => Some(
            "the drives have not confirmed that their power is off: press the emergency stop, then \
             look at the stage",
        ),
        (false, false) => Some(
            "neither were the axes seen to stand nor have the drives confirmed that their power is \
             off: press the emergency stop, then look at the stage",
        ),
    }
}
