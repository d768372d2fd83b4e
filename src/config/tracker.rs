//! `[tracker]`: where tip positions come from.

use serde::Serialize;
use std::time::Duration;

use super::choice::choice;
use super::error::ConfigError;
use super::gates::GatesConfig;
use super::pose::AnglesConfig;
use super::recording::CsvConfig;
use super::registration::{RegistrationConfig, TipFitConfig};
use super::rule::Range;
use super::section::Section;
use crate::geometry::Pose;
use crate::session::Resume;
use crate::tracker::openigtlink::{StartStream, ToolStream};
use crate::tracker::{
    AcquisitionClock, GateSettings, Protocol, Registration, StampPolicy, TrackSettings,
    TrackerKind, Workspace,
};

/// `[tracker]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackerConfig {
    /// Where tip positions come from.
    pub source: TrackerSource,
    /// `host:port`, of the server or to listen at; `-` is standard input.
    pub address: String,
    /// Who calls whom.
    pub mode: TrackerMode,
    /// A recording that is given in place of a connection, at its own pace.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    /// The stream that a server over OpenIGTLink is asked for.
    pub request: TrackerRequest,
    /// Shortest time between two messages of that stream, ms; 0 is as fast as the server can.
    pub request_period_ms: i32,
    /// The name of the tool that is the needle's tip.
    pub tool: String,
    /// How long to wait for the tool before giving up, s.
    pub timeout_s: f64,
    /// What a value that comes again says.
    pub kind: TrackerKindName,
    /// The insertion is held when the newest tip position is older than this, s.
    pub hold_after_s: f64,
    /// And before more than this is inserted without one, mm, the way to brake included.
    pub hold_after_mm: f64,
    /// Braking to a hold, mm/s².
    pub hold_braking_mm_per_s2: f64,
    /// The longest a hold may last, s.
    pub hold_timeout_s: f64,
    /// What comes after a hold.
    pub resume: ResumeKind,
    /// Fixed latency of the source, on top of its stamps, ms.
    pub latency_ms: f64,
    /// Which stamp tells the acquisition.
    pub stamp: StampKind,
    /// Tip in the sensor's frame, mm.
    pub tip_offset_mm: [f64; 3],
    /// Orientation of the tip in the sensor's frame.
    pub tip_tilt: AnglesConfig,
    /// How the two were computed, where `needle-bench calibrate tip` did it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tip_fit: Option<TipFitConfig>,
    /// Where the tip can be at all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub workspace: Option<WorkspaceConfig>,
    /// `X_WT`, the tracker frame in the bench frame. Only `source = "emulated"` has a default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registration: Option<RegistrationConfig>,
    /// What the columns of a CSV file hold.
    pub csv: CsvConfig,
    /// `[tracker.gates]`.
    pub gates: GatesConfig,
}

choice! {
    /// A source of tip positions.
    TrackerSource {
        /// The emulated needle's own, in this process.
        Emulated = "emulated",
        /// OpenIGTLink over TCP.
        OpenIgtLink = "openigtlink",
        /// A sample a line, in JSON: over TCP, from standard input or from a file.
        Ndjson = "ndjson",
        /// A CSV file.
        Csv = "csv",
    }
}

choice! {
    /// A stream that a server sends once it is asked to.
    TrackerRequest {
        /// Nothing is asked for.
        None = "none",
        /// TDATA, with matrices.
        Tdata = "tdata",
        /// QTDATA, with quaternions.
        Qtdata = "qtdata",
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

choice! {
    /// A kind of tracker.
    TrackerKindName {
        /// Every sample is a measurement: a value that comes again is frozen.
        Electromagnetic = "electromagnetic",
        /// Frames come again many times over: a value that does is no news.
        Imaging = "imaging",
    }
}

choice! {
    /// What comes after a hold.
    ResumeKind {
        /// The run is stopped as soon as the needle stands.
        Stop = "stop",
        /// The insertion goes on by itself once the tip is found again.
        Automatic = "automatic",
    }
}

impl TrackerConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        // What these name has been laid in already.
        for file in ["registration_file", "tip_file"] {
            let _ = s.optional_text(file, "the path of a file");
        }
        TrackerConfig {
            source: s.choice("source"),
            address: s.text(
                "address",
                "host:port, such as \"127.0.0.1:18944\", or \"-\" for standard input",
                |address| address == STANDARD_INPUT || is_address(address),
            ),
            mode: s.choice("mode"),
            file: s.optional_text("file", "the path of a file"),
            request: s.choice("request"),
            request_period_ms: s.integer("request_period_ms", 0, 60_000),
            tool: s.text("tool", "the name of a tool", |tool| !tool.trim().is_empty()),
            timeout_s: s.number("timeout_s", Range::within(0.1, 3600.0)),
            kind: s.choice("kind"),
            hold_after_s: s.number("hold_after_s", Range::within(0.01, 60.0)),
            hold_after_mm: s.number("hold_after_mm", Range::within(0.1, 100.0)),
            hold_braking_mm_per_s2: s.number("hold_braking_mm_per_s2", Range::within(0.1, 1000.0)),
            hold_timeout_s: s.number("hold_timeout_s", Range::within(0.1, 3600.0)),
            resume: s.choice("resume"),
            latency_ms: s.number("latency_ms", Range::within(0.0, 5000.0)),
            stamp: s.choice("stamp"),
            tip_offset_mm: s.numbers("tip_offset_mm", Range::within(-1000.0, 1000.0)),
            tip_tilt: s.section("tip_tilt", AnglesConfig::read_frame),
            tip_fit: s.optional_section("tip_fit", TipFitConfig::read),
            workspace: s.optional_section("workspace", WorkspaceConfig::read),
            registration: s.optional_section("registration", RegistrationConfig::read),
            csv: s.section("csv", CsvConfig::read),
            gates: s.section("gates", GatesConfig::read),
        }
    }

    /// Where the tracker stands on the bench and the tip on the sensor; without it nothing moves.
    ///
    /// # Errors
    /// When there is none, the key to set; fiducials that determine none.
    pub fn to_registration(&self) -> Result<Registration, ConfigError> {
        let registration = self.registration.as_ref().ok_or_else(|| {
            ConfigError::of(format!(
                "tracker.registration is missing, and has no default for tracker.source = \"{}\": \
                 measure it by needle-bench calibrate registration, and name its file in \
                 tracker.registration_file",
                self.source
            ))
        })?;
        let x_sb = Pose {
            rotation: self.tip_tilt.to_fixed_angles().to_rotation(),
            translation: self.tip_offset_mm.into(),
        };
        Ok(Registration::new(registration.x_wt()?).with_tip(x_sb))
    }

    /// What a sample has to pass by itself.
    ///
    /// # Errors
    /// Without a registration.
    pub fn to_gate(&self) -> Result<GateSettings, ConfigError> {
        Ok(GateSettings {
            tool: self.tool.clone(),
            registration: self.to_registration()?,
            workspace: self.workspace.map(WorkspaceConfig::to_workspace),
            rotation: self.gates.rotation,
            zero: self.gates.zero,
            status: self.gates.status,
        })
    }

    /// What a position has to pass against the others and the model.
    pub fn to_track(&self) -> TrackSettings {
        self.gates.to_track(match self.kind {
            TrackerKindName::Electromagnetic => TrackerKind::Electromagnetic,
            TrackerKindName::Imaging => TrackerKind::Imaging,
        })
    }

    /// What comes after a hold.
    pub fn to_resume(&self) -> Resume {
        match self.resume {
            ResumeKind::Stop => Resume::Stop,
            ResumeKind::Automatic => Resume::Automatic,
        }
    }

    /// What the tracker's connection speaks.
    pub fn to_protocol(&self) -> Protocol {
        match self.source {
            TrackerSource::Ndjson => Protocol::Ndjson,
            _ => Protocol::OpenIgtLink,
        }
    }

    /// What a server is asked for, if anything.
    pub fn to_request(&self) -> Option<StartStream> {
        let stream = match self.request {
            TrackerRequest::None => return None,
            TrackerRequest::Tdata => ToolStream::Tdata,
            TrackerRequest::Qtdata => ToolStream::Qtdata,
        };
        Some(StartStream { stream, period_ms: self.request_period_ms, coordinates: String::new() })
    }

    /// True where positions come by standard input.
    pub fn is_standard_input(&self) -> bool {
        self.source == TrackerSource::Ndjson && self.address == STANDARD_INPUT
    }

    /// The clock that dates samples.
    pub fn to_clock(&self) -> AcquisitionClock {
        let latency = Duration::from_secs_f64(self.latency_ms * 1e-3);
        AcquisitionClock::new(self.stamp.to_policy(), latency)
    }
}

impl StampKind {
    /// As the tracker module has it.
    pub fn to_policy(self) -> StampPolicy {
        match self {
            StampKind::Receive => StampPolicy::Receive,
            StampKind::Source => StampPolicy::Source,
            StampKind::Auto => StampPolicy::Auto,
        }
    }
}

/// A box in the bench frame outside of which no tip position is believed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WorkspaceConfig {
    /// The corner with the smallest coordinates, mm.
    pub min_mm: [f64; 3],
    /// The corner with the largest coordinates, mm.
    pub max_mm: [f64; 3],
}

impl WorkspaceConfig {
    fn read(s: &mut Section<'_>) -> Self {
        let range = Range::within(-10_000.0, 10_000.0);
        WorkspaceConfig { min_mm: s.numbers("min_mm", range), max_mm: s.numbers("max_mm", range) }
    }

    /// As the tracker's gate has it.
    pub fn to_workspace(self) -> Workspace {
        Workspace { min_mm: self.min_mm.into(), max_mm: self.max_mm.into() }
    }
}

/// The address that stands for standard input.
pub(super) const STANDARD_INPUT: &str = "-";

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
