//! `[tracker]`: where tip positions come from.

use std::time::Duration;

use super::error::ConfigError;
use super::pose::AnglesConfig;
use super::recording::CsvConfig;
use super::registration::{RegistrationConfig, TipFitConfig};
use super::schema::{Rule, choice, named, over, section, within};
use crate::geometry::Pose;
use crate::session::{self, Resume};
use crate::tracker::openigtlink::{StartStream, ToolStream};
use crate::tracker::{
    AcquisitionClock, Gate, Protocol, Registration, StampPolicy, TrackSettings, TrackerKind,
    Workspace,
};
use nalgebra::Vector3;

const POSITION: Rule = within(-10_000.0, 10_000.0);
const FILE: Rule = named("the path of a file");
const ADDRESS: Rule =
    Rule::Text("host:port, such as \"127.0.0.1:18944\", or \"-\" for standard input", |address| {
        address == STANDARD_INPUT || is_address(address)
    });

section! {
    /// `[tracker]`: where tip positions come from.
    pub struct TrackerConfig {
        /// The source of tip positions.
        source: TrackerSource = "emulated";
        /// host:port of the server, or to listen at; "-" is standard input, for "ndjson".
        address: String [ADDRESS] = "127.0.0.1:18944";
        /// Who opens the connection.
        mode: TrackerMode = "connect";
        /// For "ndjson" and "csv": a recording in place of a connection, replayed at its own pace.
        file: Option<String> [FILE];
        /// For "openigtlink": the stream that the server is asked for.
        request: TrackerRequest = "none";
        /// Shortest time between two messages of that stream, ms; 0 is as fast as the server can.
        request_period_ms: i32 [within(0.0, 60_000.0)] = 25;
        /// The name of the tool that is the needle's tip.
        tool: String [named("the name of a tool")] = "NeedleToTracker";
        /// Longest wait for the tool, without power, s.
        timeout_s: f64 [within(0.1, 3600.0)] = 5.0;
        /// What a repeated value means.
        kind: TrackerKind = "electromagnetic";
        /// The insertion is held when the newest tip position is older than this, s.
        hold_after_s: f64 [within(0.01, 60.0)] = 0.5;
        /// The insertion is held before more than this is inserted without a tip position, mm, braking
        /// included.
        hold_after_mm: f64 [within(0.1, 100.0)] = 1.0;
        /// Braking of the insertion to a hold, mm/s²; both axes stay enabled.
        hold_braking_mm_per_s2: f64 [within(0.1, 1000.0)] = 40.0,
            at_most("stage.insertion.acceleration_max_mm_per_s2");
        /// The run is stopped when a hold lasts longer, s.
        hold_timeout_s: f64 [within(0.1, 3600.0)] = 5.0;
        /// What comes after a hold.
        resume: Resume = "stop";
        /// Fixed latency of the source, on top of its stamps, ms.
        latency_ms: f64 [within(0.0, 5000.0)] = 0.0;
        /// The stamp that dates a position.
        stamp: StampPolicy = "receive";
        /// Tip in the sensor's frame, mm. Any but zero needs a source that sends orientations.
        tip_offset_mm: [f64; 3] [within(-1000.0, 1000.0)] = [0.0, 0.0, 0.0];
        /// Orientation of the tip in the sensor's frame.
        tip_tilt: AnglesConfig => "{ yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }";
        /// How the two were computed, as `needle-bench calibrate tip` wrote it.
        tip_fit: Option<TipFitConfig>;
        /// In place of the three: the file that `needle-bench calibrate tip` wrote.
        tip_file: Option<String> [FILE];
        /// A box in the bench frame outside of which no tip position is believed.
        workspace: Option<Workspace>;
        /// Pose of the tracker frame T in the bench frame W, or fiducials to solve it from. Without
        /// one the bench does not move; only the emulated tracker has a default.
        registration: Option<RegistrationConfig> => "{ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, \
            yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }", whole, tracker_must_give;
        /// In its place: the file that `needle-bench calibrate registration` wrote.
        registration_file: Option<String> [FILE];
        /// What the columns of a CSV file hold; the defaults are those of a run's steps.csv.
        csv: CsvConfig;
        /// What a tip position must pass to be believed, in this order.
        gates: GatesConfig;
    }
}

section! {
    impl Workspace {
        /// The corner with the smallest coordinates, mm.
        min_mm: Vector3<f64> [POSITION];
        /// The corner with the largest coordinates, mm.
        max_mm: Vector3<f64> [POSITION];
    }
}

section! {
    /// `[tracker.gates]`. That a position is finite is always required.
    pub struct GatesConfig {
        /// Refuse an orientation that is not a rotation; false uses the position alone.
        rotation: bool = true;
        /// Refuse the exact zero or identity, which stands for "not seen".
        zero: bool = true;
        /// Refuse what the tracker itself calls invalid.
        status: bool = true;
        /// End the run where the stream as a whole contradicts the insertion: travel, handedness. False
        /// is for streams of another needle, and refused with hardware.
        stream: bool = true;
        /// Standard deviation of the noise of each coordinate, mm; ±1 mm uniform has 0.58.
        noise_sd_mm: f64 [over(0.0, 100.0)] = 0.6;
        /// The tip moves no faster, mm/s.
        tip_speed_max_mm_per_s: f64 [within(0.1, 10_000.0)] = 10.0;
        /// Noise allowed between two positions, in standard deviations.
        step_sds: f64 [within(1.0, 1e6)] = 6.0;
        /// Limit of the squared Mahalanobis distance from the model; 0.1% of good positions exceed 16.3.
        innovation_chi2: f64 [within(1.0, 1e9)] = 16.3;
        /// Standard deviation of each coordinate of the model, mm, for observers without a covariance.
        model_sd_mm: f64 [within(0.0, 100.0)] = 1.0;
        /// Added to any observer's, per mm since it was last corrected, mm.
        model_sd_per_mm: f64 [within(0.0, 10.0)] = 0.2;
        /// After so many refusals in a row the track is lost.
        lost_after: u32 [within(1.0, 1000.0)] = 5;
        /// It is found again when so many positions in a row agree with the model.
        found_after: u32 [within(1.0, 1000.0)] = 3;
        /// After so many periods of the stream without a position the run is coasting.
        coast_after_periods: f64 [within(1.0, 1000.0)] = 2.0;
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
    /// Who opens the connection.
    pub enum TrackerMode {
        /// The bench connects to a server.
        Connect = "connect",
        /// The bench listens for a client.
        Listen = "listen",
    }
}

choice! {
    for StampPolicy {
        /// The time of receipt.
        Receive = "receive",
        /// The source's own stamp.
        Source = "source",
        /// The source's own stamp where there is one.
        Auto = "auto",
    }
}

choice! {
    for TrackerKind {
        /// Every sample is a measurement: a repeated value is a frozen stream.
        Electromagnetic = "electromagnetic",
        /// Most frames are repeated: a repeated value is no measurement.
        Imaging = "imaging",
    }
}

choice! {
    for Resume {
        /// The run is stopped once the needle stands.
        Stop = "stop",
        /// The insertion goes on by itself once the tip is found again.
        Automatic = "automatic",
    }
}

impl TrackerConfig {
    /// What a session is told.
    ///
    /// # Errors
    /// Without a registration.
    pub(super) fn to_session(&self) -> Result<session::TrackerConfig, ConfigError> {
        Ok(session::TrackerConfig {
            gate: self.to_gate()?,
            judges_stream: self.gates.stream,
            clock: self.to_clock(),
            track: self.to_track(),
            timeout: Duration::from_secs_f64(self.timeout_s),
            hold_after: Duration::from_secs_f64(self.hold_after_s),
            hold_after_mm: self.hold_after_mm,
            hold_braking_mm_per_s2: self.hold_braking_mm_per_s2,
            hold_timeout: Duration::from_secs_f64(self.hold_timeout_s),
            resume: self.resume,
        })
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
    pub fn to_gate(&self) -> Result<Gate, ConfigError> {
        Ok(Gate {
            tool: self.tool.clone(),
            registration: self.to_registration()?,
            workspace: self.workspace,
            rotation: self.gates.rotation,
            zero: self.gates.zero,
            status: self.gates.status,
        })
    }

    /// What a position has to pass against the others and the model.
    pub fn to_track(&self) -> TrackSettings {
        let gates = &self.gates;
        TrackSettings {
            kind: self.kind,
            noise_sd_mm: gates.noise_sd_mm,
            tip_speed_max_mm_per_s: gates.tip_speed_max_mm_per_s,
            step_sds: gates.step_sds,
            innovation_chi2: gates.innovation_chi2,
            model_sd_mm: gates.model_sd_mm,
            model_sd_per_mm: gates.model_sd_per_mm,
            lost_after: gates.lost_after,
            found_after: gates.found_after,
            coast_after_periods: gates.coast_after_periods,
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
        AcquisitionClock::new(self.stamp, latency)
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
