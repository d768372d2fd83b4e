//! Scoring: observers over recorded insertions, and the figures of a run.

mod evaluation;
mod figures;
mod mount;
mod recording;
mod statistics;

pub use evaluation::{Evaluation, EvaluationError, Quantiles, Score, Scoring, evaluate};
pub use figures::{RunFigures, TipError};
pub use mount::{Mount, MountError};
pub use recording::{RecordedRow, Recording, RecordingError};
pub use statistics::{quantile, rms};
