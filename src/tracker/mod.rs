//! The tracker's side: protocols, the samples they carry, and what a sample must pass before an
//! observer may see it.
//!
//! Everything here is pure: bytes and times come in, samples and refusals go out. Sockets are in
//! `transport`. A sample goes through [`sample`] → [`gate`] (which holds the [`registration`]) →
//! [`timing`] → [`pairing`], and is then a tip position at a stage position.

pub mod openigtlink;
pub mod registration;
pub mod sample;

pub use registration::Registration;
pub use sample::{Sample, Validity};
