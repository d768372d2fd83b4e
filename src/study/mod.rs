//! Scoring: observers over recorded insertions, and the figures of a run.

mod evaluation;
mod figures;
mod recording;
mod statistics;

pub use evaluation::{Evaluation, EvaluationError, Mount, MountError, Score, evaluate};
pub use figures::{RunFigures, TipError};
pub use recording::{RecordedRow, Recording, RecordingError};
pub use statistics::{quantile, rms};
