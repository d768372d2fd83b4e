//! The tracker's side: protocols, the samples they carry, and what a sample must pass before an
//! observer may see it.
//!
//! Everything here is pure: bytes and times come in, samples and refusals go out. Sockets are in
//! `transport`. [`gate`] checks a sample by itself and transforms it with the [`registration`],
//! [`timing`] dates it, [`pairing`] finds the stage's position at that time, and [`track`] compares it
//! with its neighbours and the model. It is then a tip position at a known depth and rotation. A check
//! that refuses it says why in a [`refusal`].

mod clock_offset;
mod coordinate;
pub mod csv;
mod event;
pub mod gate;
pub mod ndjson;
pub mod openigtlink;
mod orientation;
pub mod pairing;
mod reader;
pub mod refusal;
pub mod registration;
mod replay;
pub mod sample;
mod sieve;
pub mod timing;
pub mod track;
mod travel;

pub use coordinate::{ConstantCoordinate, CoordinateWatch};
pub use csv::{CsvMapping, TimeColumns};
pub use event::{Census, Event};
pub use gate::{ContentChecks, Gate, Workspace};
pub use pairing::{StageHistory, StageIncrement, StagePoint};
pub use reader::{Protocol, Reader};
pub use refusal::{Effect, GateCounts, GateName, Refusal};
pub use registration::Registration;
pub use replay::StreamReplay;
pub use sample::{Sample, Validity};
pub use sieve::Sieve;
pub use timing::{AcquisitionClock, StampPolicy};
pub use track::{Fix, Prediction, Track, TrackSettings, TrackState, TrackerKind};
pub use travel::{TravelCheck, check_recorded};
