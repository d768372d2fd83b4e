//! `[tracker]`: where tip positions come from.

use nalgebra::Vector3;
use serde::Serialize;

use super::choice::choice;
use super::pose::PoseConfig;
use super::reader::Section;
use super::rule::Range;

/// `[tracker]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackerConfig {
    /// Where tip positions come from.
    pub source: TrackerSource,
    /// `host:port`, of the server or to listen at.
    pub address: String,
    /// Who calls whom.
    pub mode: TrackerMode,
    /// The name of the tool that is the needle's tip.
    pub tool: String,
    /// How long to wait for the tool before giving up, s.
    pub timeout_s: f64,
    /// A tip position older than this stops the run, s.
    pub hold_after_s: f64,
    /// As does more than this inserted without one, mm.
    pub hold_after_mm: f64,
    /// Fixed latency of the source, on top of its stamps, ms.
    pub latency_ms: f64,
    /// Which stamp tells the acquisition.
    pub stamp: StampKind,
    /// Tip in the sensor's frame, mm.
    pub tip_offset_mm: [f64; 3],
    /// `X_WT`, the tracker frame in the bench frame. Only `source = "emulated"` has a default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registration: Option<PoseConfig>,
}

choice! {
    /// A source of tip positions.
    TrackerSource {
        /// The emulated needle's own, in this process.
        Emulated = "emulated",
        /// OpenIGTLink over TCP.
        OpenIgtLink = "openigtlink",
    }
}

choice! {
    /// Who opens the connection.
    TrackerMode {
        /// The bench connects to a server.
        Connect = "connect",
        /// The bench listens for a client.
        Listen = "listen",
    }
}

choice! {
    /// Which stamp tells when a position was acquired.
    StampKind {
        /// The time at which it was received.
        Receive = "receive",
        /// The source's own.
        Source = "source",
        /// The source's own where it gives one.
        Auto = "auto",
    }
}

impl TrackerConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        TrackerConfig {
            source: s.choice("source"),
            address: s.text("address", "host:port, such as \"127.0.0.1:18944\"", is_address),
            mode: s.choice("mode"),
            tool: s.text("tool", "the name of a tool", |tool| !tool.trim().is_empty()),
            timeout_s: s.number("timeout_s", Range::within(0.1, 3600.0)),
            hold_after_s: s.number("hold_after_s", Range::within(0.01, 60.0)),
            hold_after_mm: s.number("hold_after_mm", Range::within(0.1, 100.0)),
            latency_ms: s.number("latency_ms", Range::within(0.0, 5000.0)),
            stamp: s.choice("stamp"),
            tip_offset_mm: s.numbers("tip_offset_mm", Range::within(-1000.0, 1000.0)),
            registration: s.optional_section("registration", PoseConfig::read_frame),
        }
    }

    /// Tip in the sensor's frame, mm.
    pub fn tip_offset(&self) -> Vector3<f64> {
        self.tip_offset_mm.into()
    }
}

/// `host:port`; an IPv6 host is in brackets, a name is resolved later.
fn is_address(address: &str) -> bool {
    address.rsplit_once(':').is_some_and(|(host, port)| {
        let bracketed = host.starts_with('[') && host.ends_with(']');
        !host.is_empty()
            && !host.contains(char::is_whitespace)
            && (bracketed || !host.contains(':'))
            && port.parse::<u16>().is_ok_and(|port| port > 0)
    })
}
