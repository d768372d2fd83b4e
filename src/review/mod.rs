//! Reviews of recorded runs, as text, JSON and HTML: one run, two side by side, or a campaign.
//!
//! Nothing here reads a file: the caller passes the content and the condition of each run folder.

mod campaign;
mod compare;
mod figures;
mod group;
mod motion;
mod report;
mod run;
mod summary;

pub use campaign::{Campaign, Line};
pub use compare::{Comparison, differences, keys};
pub use figures::figures_of_steps;
pub use motion::{Motion, TimedFrame, parse_frame, positions_at_sync};
pub use report::{GENERATOR, html};
pub use run::{Condition, Folder, Run, parse_event};
pub use summary::{to_json, to_text};
