//! A look at the drives and the tracker: nothing is written, nothing moves.

use super::timing::Clock;
use crate::canopen::sdo::{SdoClient, SdoReply, SdoRequest};
use crate::canopen::{NodeId, ObjectAddress};
use crate::tracker::{Census, Event, Gate, GateCounts, Registration};
use crate::transport::can::{BusEvent, CanBus};
use crate::transport::link::Link;
use nalgebra::Vector3;
use serde::Serialize;
use std::time::Duration;

/// What a drive says of itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DriveReport {
    /// 0x1000.
    pub device_type: u32,
    /// 0x1018:01.
    pub vendor_id: u32,
    /// 0x1018:02.
    pub product_code: u32,
    /// 0x6041.
    pub statusword: u16,
    /// 0x6064, counts.
    pub position_counts: i32,
}

/// Reads identity, statusword and position of `node`.
///
/// # Errors
/// What happened, with what to do: no answer, or a bus that fails.
pub fn probe_drive(
    bus: &mut dyn CanBus,
    node: NodeId,
    timeout: Duration,
    attempts: u32,
) -> Result<DriveReport, String> {
    let mut read = |index, subindex| {
        read_object(bus, node, ObjectAddress::new(index, subindex), timeout, attempts)
    };
    Ok(DriveReport {
        device_type: read(0x1000, 0)?,
        vendor_id: read(0x1018, 1)?,
        product_code: read(0x1018, 2)?,
        statusword: read(0x6041, 0)? as u16,
        position_counts: read(0x6064, 0)? as i32,
    })
}

fn read_object(
    bus: &mut dyn CanBus,
    node: NodeId,
    object: ObjectAddress,
    timeout: Duration,
    attempts: u32,
) -> Result<u32, String> {
    let clock = Clock::start();
    let mut client = SdoClient::new(node, timeout);
    let mut failure = String::new();
    for _ in 0..attempts.max(1) {
        let started = client.start(clock.now(), SdoRequest::Upload(object));
        started.map_err(|error| error.to_string())?;
        let result = loop {
            while let Some(frame) = client.poll_transmit() {
                bus.send(&frame).map_err(|error| error.to_string())?;
            }
            if let Some(result) = client.poll_result() {
                break result;
            }
            let wait = client.deadline().since(clock.now());
            match bus.receive(wait).map_err(|error| error.to_string())? {
                Some(BusEvent::Frame(frame)) => client.handle_frame(clock.now(), &frame),
                Some(BusEvent::Error(_)) => {}
                None => client.handle_timeout(clock.now()),
            }
        };
        match result {
            Ok(SdoReply::Uploaded(bytes)) => {
                let mut value = [0; 4];
                let len = bytes.len().min(4);
                value[..len].copy_from_slice(&bytes[..len]);
                return Ok(u32::from_le_bytes(value));
            }
            Ok(SdoReply::Downloaded) => failure = format!("{object}: answered a write"),
            Err(error) => failure = error.to_string(),
        }
    }
    Err(failure)
}

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
            Event::Malformed(error) => trouble = Some(error.to_string()),
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
