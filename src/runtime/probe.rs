//! Listens to the tracker as a run would, without a run.

use super::timing::Clock;
use crate::tracker::{Census, Event, Gate, GateCounts, Registration};
use crate::transport::link::Link;
use nalgebra::Vector3;
use serde::Serialize;
use std::time::Duration;

/// What came from the tracker in a while.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackerReport {
    /// Positions of the tool that passed the gates.
    pub accepted: u64,
    /// Positions of the tool that were refused.
    pub refused: u64,
    /// Accepted positions a second.
    pub rate_hz: f64,
    /// The last accepted position in the bench frame, mm.
    pub last_position_bench_mm: Option<[f64; 3]>,
    /// The tip's heading with it in the bench frame, where the tracker sends orientations.
    pub last_heading_bench: Option<[f64; 3]>,
    /// What to do about it, where no position was accepted.
    pub trouble: Option<String>,
}

/// Listens to the tracker for `duration`, through the gates of a run that look at a sample by itself.
pub fn probe_tracker(
    link: &mut Link,
    gate: &Gate,
    registration: &Registration,
    tool: &str,
    clock: Clock,
    duration: Duration,
    runtime: &tokio::runtime::Runtime,
) -> TrackerReport {
    let end = clock.now() + duration;
    let (mut census, mut counts) = (Census::default(), GateCounts::default());
    let (mut last, mut heading, mut trouble): (Option<Vector3<f64>>, _, Option<String>) =
        (None, None, None);
    while clock.now() < end {
        let wait = end.since(clock.now());
        let next = runtime.block_on(async { tokio::time::timeout(wait, link.next()).await });
        let Ok(Some(event)) = next else { break };
        census.note(&event);
        match &event {
            Event::Sample(sample) => {
                let admitted = gate.admit(sample);
                counts.count(admitted.as_ref().err());
                match admitted {
                    Ok(position) => {
                        (last, heading) = (Some(position), registration.heading(sample));
                    }
                    Err(refusal) => trouble = Some(format!("tracker: {refusal}")),
                }
            }
            Event::Unreachable { reason } | Event::Disconnected { reason } => {
                trouble = Some(reason.clone());
            }
            Event::Malformed(error) => trouble = Some(error.clone()),
            Event::Connected { .. }
            | Event::Status { .. }
            | Event::SawTool { .. }
            | Event::PassedOver { .. } => {}
        }
    }
    link.passed_over().iter().for_each(|event| census.note(event));
    if last.is_some() {
        trouble = None;
    } else if !census.has(tool) && census.messages() > 0 || trouble.is_none() {
        trouble = Some(census.explain_missing(tool));
    }
    TrackerReport {
        accepted: counts.accepted,
        refused: counts.refused(),
        rate_hz: counts.accepted as f64 / duration.as_secs_f64(),
        last_position_bench_mm: last.map(Into::into),
        last_heading_bench: heading.map(|heading: Vector3<f64>| heading.into()),
        trouble,
    }
}
