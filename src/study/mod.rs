//! Scores for observers on recorded insertions, the figures of a run, and Monte Carlo studies with
//! their theoretical bounds.

mod base_path;
mod bound;
mod consistency;
mod evaluation;
mod figures;
mod mount;
mod recording;
mod score;
mod statistics;
mod summary;
mod timetable;
mod trial;

pub use bound::{InformationBound, Prior};
pub use consistency::{Consistency, Nees, TrialNees, Verdict, student_95};
pub use evaluation::{Evaluation, Quantiles, RecordingScore, Scoring, evaluate};
pub use figures::{FigureReport, OFF_PLANE_LIMIT_MM, PlanStatus, RunFigures, TipError};
pub use mount::mount;
pub use recording::{RecordedRoll, RecordedRow, Recording};
pub use score::{TargetScore, TrialResult, TrialScorer};
pub use statistics::{quantile, rms};
pub use summary::{StudySummary, trial_seed};
pub use timetable::Timetable;
pub use trial::insert;
