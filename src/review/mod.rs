//! What people are told of runs that were recorded: one run, two side by side, a campaign.
//!
//! Text, JSON and HTML out of what a run folder holds. Nothing here reads a file: the caller hands
//! over what it read, with what became of the folder since.

mod campaign;
mod compare;
mod configuration;
mod figures;
mod group;
mod interval;
mod limits;
mod report;
mod run;
mod summary;
mod text;
mod warnings;

pub use campaign::{Campaign, Entry, Exclusion, Line, NoSuchKey};
pub use compare::Comparison;
pub use configuration::{Difference, Keys, differences, keys};
pub use figures::{Bound, Figure, figures, figures_of_steps};
pub use group::Group;
pub use interval::{Median, Proportion};
pub use limits::Limits;
pub use report::{GENERATOR, html};
pub use run::{Condition, Folder, Run, StateChange, event_lines};
pub use summary::{to_json, to_text};
pub use text::plain;
pub use warnings::warnings;
