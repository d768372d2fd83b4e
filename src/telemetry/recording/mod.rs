//! The run for rerun's viewer: `run.rrd`, and a live view. Nothing outside this module names rerun.
//!
//! Rows are gathered in columns and sent ten times a second, so that a kill costs no more than
//! that. A call to rerun costs tens of microseconds and a chunk some two kilobytes, however little
//! is in it, so there are few tables with many columns, and when a run is over the file is written
//! once more with the chunks of each table joined. Angles are in degrees here: this is read by
//! people, `steps.csv` by programs.
//!
//! A finished file has 1.2 MB for the layout, and at 10 ms SYNC, with two observers alongside, 3 to 4 MB
//! a metre of insertion at 2 mm/s, 6 MB at 1 mm/s. Before it is joined it is several times as large.

mod can;
mod content;
mod document;
mod file;
mod index;
mod layout;
mod live;
mod log;
mod messages;
mod motion;
mod pace;
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
