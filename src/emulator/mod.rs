//! The virtual stage: emulated drives, needle in tissue and tracker, sans-IO.

pub mod drive;
pub mod fault;
mod noise;
mod tissue;
mod tracker;
mod truth;
mod virtual_stage;

pub use noise::{CorrelatedNoise, WhiteNoise, split_mix64};
pub(crate) use tissue::Tissue;
pub use tracker::{TargetModel, TrackedTip, TrackerModel};
pub use truth::Truth;
pub use virtual_stage::{StageOutput, VirtualStage, VirtualStageConfig};
