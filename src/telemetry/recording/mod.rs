//! The run for rerun's viewer: `run.rrd`, and a live view. Nothing outside this module names rerun.
//!
//! Rows are gathered in columns and sent ten times a second, so that a kill costs no more than
//! that. A call to rerun costs tens of microseconds and a chunk about a kilobyte, however little
//! is in it, so there are few tables with many columns, and when a run is over the file is written
//! once more with the chunks of ten minutes in one. Angles are in degrees here: this is read by
//! people, `steps.csv` by programs.

mod can;
mod content;
mod document;
mod file;
mod index;
mod layout;
mod live;
mod log;
mod motion;
mod palette;
mod progress;
mod rewrite;
mod samples;
mod scene;
mod space;
mod steps;
mod table;
mod views;

pub(super) use self::file::Recording;
pub(super) use self::live::Live;
pub use self::rewrite::repair_recording;
