//! Reviews of recorded runs: one run, two side by side, a campaign.
//!
//! Text, JSON and HTML from the content of run folders. Nothing here reads a file: the caller
//! passes the content and the condition of each folder.

mod campaign;
mod compare;
mod figures;
mod group;
mod motion;
mod report;
mod run;
mod summary;

pub use campaign::{Campaign, Exclusion, Line};
pub use compare::{Comparison, Difference, Differences, Keys, differences, keys};
pub use figures::{Figure, Limits, figures, figures_of_steps};
pub use group::{Group, MedianInterval, Proportion};
pub use motion::{Motion, Stamped, stamped};
pub use report::{GENERATOR, html};
pub use run::{Condition, Folder, Run, StateChange, event};
pub use summary::{to_json, to_text, warnings};
