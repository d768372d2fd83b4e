//! The texts for the operator about events of the stage and of the tracker's link.

use super::Severity;
use crate::stage::StageEvent;
use crate::tracker::Event;

/// The text for the operator about `event`, with its severity; `None` if `event` has a record of its own.
pub(crate) fn stage_news(event: &StageEvent) -> Option<(Severity, String)> {
    let warning = match event {
        StageEvent::Progress(progress) => return Some((Severity::Info, progress.to_string())),
        StageEvent::Homed { axis, position } => {
            let text = format!("{axis}: home, at {}", axis.shown(*position));
            return Some((Severity::Info, text));
        }
        StageEvent::Emergency(axis, emcy) => format!("{axis}: emergency {emcy}"),
        StageEvent::InternalLimit(axis) => format!(
            "{axis}: a limit inside the drive holds (statusword bit 11); are its limits of position \
             (0x607D), speed, current and I2t those of this rig?"
        ),
        StageEvent::NotShown(axis, flag) => format!(
            "{axis}: the enabled drive has not set statusword {flag}, so the bench could not notice the \
             loss of that bit; see the drive's manual"
        ),
        StageEvent::Warns { axis, statusword, count } => format!(
            "{axis}: the drive warns (statusword {statusword}, bit 7), {count} so far; see its manual \
             and its display for why"
        ),
        StageEvent::StopNotObeyed(axis, statusword) => format!(
            "{axis}: the drive does not stop, or was enabled again (statusword {statusword}); its node is \
             sent to pre-operational and commanded again; does something delay frames on the bus?"
        ),
        StageEvent::Flood(frames) => {
            format!("a flood on the bus: {frames} frames outside the SYNC cycle within 100 ms")
        }
        StageEvent::Ignored { why, count, frame } => {
            format!("{why}, {count} so far, the newest {frame}")
        }
        StageEvent::SyncSkipped { periods, total } => {
            format!("the bench was late; SYNC periods skipped: {periods}, {total} so far")
        }
        StageEvent::Feedback(_)
        | StageEvent::Located(_)
        | StageEvent::Ready
        | StageEvent::Identity(..)
        | StageEvent::Fault(_)
        | StageEvent::Stopped { .. } => return None,
    };
    Some((Severity::Warning, warning))
}

/// The text for the operator about `event` of the tracker's link, with its severity; `None` if `event` has a
/// record of its own, or is only counted.
pub(crate) fn tracker_news(event: &Event) -> Option<(Severity, String)> {
    Some(match event {
        Event::Connected { peer } => (Severity::Info, format!("connected to {peer}")),
        Event::Unreachable { reason }
        | Event::TurnedAway { reason }
        | Event::Disconnected { reason } => (Severity::Warning, reason.clone()),
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

/// The part of a stop that the stage did not confirm; `None` if it was seen to stand without power.
pub(crate) fn unconfirmed_stop(standing: bool, off: bool) -> Option<&'static str> {
    match (standing, off) {
        (true, true) => None,
        (false, true) => Some("the axes were not seen to stand before power was taken off"),
        (true, false) => Some(
            "the drives have not confirmed that their power is off: press the emergency stop, then \
             look at the stage",
        ),
        (false, false) => Some(
            "the axes were not seen to stand, and the drives have not confirmed that their power is \
             off: press the emergency stop, then look at the stage",
        ),
    }
}
