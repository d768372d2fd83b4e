//! The virtual stage: drives, needle in tissue and tracker, all emulated, sans-IO.

pub mod drive;
mod truth;

pub use truth::Truth;
