//! `[tracker]`: where tip positions come from.

use std::time::Duration;

use super::{ConfigError, IDENTITY, RegistrationConfig};
use crate::calibration::TipRecord;
use crate::geometry::{FixedAngles, Pose};
use crate::keys::{Rule, choice, not_blank, section, within};
use crate::observer::PositionNoise;
use crate::session::HoldConfig;
use crate::tracker::openigtlink::ToolStream;
use crate::tracker::{
    ContentChecks, CsvMapping, Gate, Registration, StampPolicy, TrackSettings, TrackerKind,
    Workspace,
};

pub(super) const FILE: Rule = not_blank("the path of a file");
const ADDRESS: Rule =
    Rule::Text("host:port, such as \"127.0.0.1:18944\", or \"-\" for standard input", |address| {
        address == STANDARD_INPUT || is_address(address)
    });

section! {
    /// `[tracker]`: where tip positions come from.
    pub struct TrackerSection {
        /// The source of tip positions.
        source: TrackerSource = "emulated";
        /// host:port of the server, or to listen at; "-" is standard input, for "ndjson".
        address: String [ADDRESS] = "127.0.0.1:18944";
        /// The side that opens the connection.
        mode: TrackerMode = "connect";
        /// For "ndjson" and "csv": a recording in place of a connection, replayed at its own pace.
        file: Option<String> [FILE];
        /// For "openigtlink": the stream that the server is asked for, or "none".
        request: TrackerRequest = "none";
        /// Shortest time between two messages of that stream, ms; 0 is as fast as the server can.
        request_period_ms: i32 [within(0.0, 60_000.0)] = 25;
        /// The name of the tool that is the needle's tip.
        tool: String [not_blank("the name of a tool")] = "NeedleToTracker";
        /// Longest wait for the tool, without power.
        timeout as "timeout_s": Duration [within(0.1, 3600.0)] = 5.0;
        /// The kind of tracker, which says what a repeated value means.
        kind: TrackerKind = "electromagnetic";
        /// When the insertion is held.
        hold: HoldConfig, flat;
        /// Shortest delay from the measurement of a position to its receipt. The bench estimates a sender's clock
        /// from the samples with the least delay, so stamps show only delays beyond this one.
        latency as "latency_ms": Duration [within(0.0, 5000.0)] = 0.0;
        /// The stamp that dates a position.
        stamp: StampPolicy = "receive";
        /// Tip in the sensor's frame, mm. A value other than zero needs a source that sends orientations.
        tip_offset_mm: [f64; 3] [within(-1000.0, 1000.0)] = [0.0, 0.0, 0.0];
        /// Orientation of the tip in the sensor's frame.
        tip_tilt: FixedAngles => "{ yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }";
        /// How `tip_offset_mm` and `tip_tilt` were computed, as `needle-bench calibrate tip` wrote it.
        tip_fit: Option<TipRecord>;
        /// In place of `tip_offset_mm`, `tip_tilt` and `tip_fit`: the file that `needle-bench calibrate tip` wrote.
        tip_file: Option<String> [FILE];
        /// A box in the bench frame: tip positions outside it are refused.
        workspace: Option<Workspace>;
        /// Pose of the tracker frame T in the bench frame W, or fiducials to solve it from. Without
        /// one the bench does not move; only the emulated tracker has a default.
        registration: Option<RegistrationConfig> => IDENTITY, whole, tracker_must_give;
        /// In place of `[tracker.registration]`: the file that `needle-bench calibrate registration` wrote.
        registration_file: Option<String> [FILE];
        /// The columns of a CSV file; the defaults are those of a run's steps.csv.
        csv: CsvMapping;
        /// The noise of the positions, as `needle-bench calibrate tracker` measures it. Without it the
        /// observers estimate during the run how correlated the noise is, and weight positions accordingly.
        noise: Option<PositionNoise>;
        /// Gates that a tip position must pass to be accepted, in this order.
        gates: GatesConfig;
    }
}

section! {
    /// `[tracker.gates]`. A position that is not finite is always refused.
    pub struct GatesConfig {
        /// Checks of a sample by itself.
        checks: ContentChecks, flat;
        /// End the run where the stream as a whole contradicts the insertion: travel, handedness. Set false
        /// only for a stream that was recorded with another needle; refused with hardware.
        stream: bool = true;
        /// The gate against the other positions, and the model.
        track: TrackSettings, flat;
    }
}

choice! {
    /// A source of tip positions.
    pub enum TrackerSource {
        /// The emulated needle's own, in this process.
        Emulated = "emulated",
        /// OpenIGTLink over TCP.
        OpenIgtLink = "openigtlink",
        /// One sample a line, in JSON: over TCP, from standard input or from a file.
        Ndjson = "ndjson",
        /// A CSV file.
        Csv = "csv",
    }
}

choice! {
    /// A stream that a server sends once it is asked to.
    pub enum TrackerRequest {
        /// The server is not asked.
        None = "none",
        /// TDATA, with matrices.
        Tdata = "tdata",
        /// QTDATA, with quaternions.
        Qtdata = "qtdata",
    }
}

choice! {
    /// The side that opens the connection.
    pub enum TrackerMode {
        /// The bench connects to a server.
        Connect = "connect",
        /// The bench listens for a client.
        Listen = "listen",
    }
}

impl TrackerSection {
    /// The poses of the tracker on the bench and of the tip on the sensor. Without them nothing moves.
    ///
    /// # Errors
    /// No registration is configured (the error names the key to set), or its fiducials determine none.
    pub fn to_registration(&self) -> Result<Registration, ConfigError> {
        let registration = self.registration.as_ref().ok_or_else(|| {
            format!(
                "tracker.registration is missing, and has no default for tracker.source = \"{}\": \
                 measure it by needle-bench calibrate registration, and name its file in \
                 tracker.registration_file",
                self.source
            )
        })?;
        let x_wt = match registration {
            RegistrationConfig::Given(given) => given.x_wt,
            RegistrationConfig::Fiducials(fiducials) => fiducials.fit()?.x_wt,
        };
        Ok(Registration::new(x_wt).with_tip(self.x_sb()))
    }

    /// True if the tip's place on the sensor is known. The default is that of a sensor in the tip itself.
    pub fn has_tip(&self) -> bool {
        self.tip_fit.is_some() || self.tip_offset_mm != [0.0; 3]
    }

    /// True if the sensor's orientation on the needle is known.
    pub fn has_tilt(&self) -> bool {
        self.tip_fit.is_some() || self.tip_tilt != FixedAngles::default()
    }

    /// `X_SB`: the tip in the sensor's frame.
    pub fn x_sb(&self) -> Pose {
        Pose { rotation: self.tip_tilt.to_rotation(), translation: self.tip_offset_mm.into() }
    }

    /// The gate that a sample must pass by itself.
    ///
    /// # Errors
    /// Those of [`TrackerSection::to_registration`].
    pub fn to_gate(&self) -> Result<Gate, ConfigError> {
        let registration = self.to_registration()?;
        Ok(Gate { registration, workspace: self.workspace, ..self.to_unregistered_gate() })
    }

    /// The same gate without a registration and a workspace: positions stay in the tracker's frame.
    pub fn to_unregistered_gate(&self) -> Gate {
        Gate {
            tool: self.tool.clone(),
            registration: Registration::new(Pose::identity()),
            workspace: None,
            checks: self.gates.checks,
        }
    }

    /// The gate that compares a position with the others and with the model. It uses the larger of
    /// `tracker.noise` and `tracker.gates.noise_sd_mm`.
    pub fn to_track(&self) -> TrackSettings {
        let configured_mm = self.noise.map_or(0.0, |noise| noise.sd_mm());
        let noise_sd_mm = self.gates.track.noise_sd_mm.max(configured_mm);
        let correlated = self
            .noise
            .filter(|noise| noise.correlated_sd_mm > 0.0)
            .map(|noise| ((noise.correlated_sd_mm / noise_sd_mm).powi(2), noise.correlation_time));
        TrackSettings { kind: self.kind, noise_sd_mm, correlated, ..self.gates.track }
    }

    /// The stream to request from the server, if any.
    pub fn to_request(&self) -> Option<ToolStream> {
        let name = match self.request {
            TrackerRequest::None => return None,
            TrackerRequest::Tdata => "TDATA",
            TrackerRequest::Qtdata => "QTDATA",
        };
        Some(ToolStream { name, period_ms: self.request_period_ms })
    }

    /// True if positions are read from standard input.
    pub fn is_standard_input(&self) -> bool {
        self.source == TrackerSource::Ndjson && self.address == STANDARD_INPUT
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
