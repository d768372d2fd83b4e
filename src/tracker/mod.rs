//! The tracker's side: protocols, the samples they carry, and what a sample must pass before an
//! observer may see it.
//!
//! Everything here is pure: bytes and times come in, samples and refusals go out. Sockets are in
//! `transport`. A sample goes through [`gate`] (which holds the [`registration`]), is dated by
//! [`timing`], set against the stage's position by [`pairing`], and is then a tip position at a
//! known depth and rotation.

mod event;
pub mod gate;
pub mod openigtlink;
pub mod pairing;
pub mod registration;
pub mod sample;
pub mod timing;

pub use event::{Census, Event};
pub use gate::{Gate, GateCounts, GateSettings, Refusal, Workspace};
pub use pairing::{PairingError, StageHistory, StageIncrement, StagePoint};
pub use registration::{Registration, RegistrationError};
pub use sample::{Sample, Validity};
pub use timing::{AcquisitionClock, StampPolicy, TimingError};
