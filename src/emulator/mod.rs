//! The virtual stage: drives, needle in tissue and tracker, all emulated, sans-IO.

mod truth;

pub use truth::Truth;
